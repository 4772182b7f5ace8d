//! The file of a finder's calibration: slits on floor and walls as they were measured, and what was known before.
//!
//! ```toml
//! version = 1
//! rig = "nominal.toml"          # the drawing or an older calibration, beside this file; METRO-I without it
//! recording = "floor.mcap"      # where `capture` is looked up
//! table = "slits.csv"           # more slits: a line a row, its columns named in the first line
//! columns = 16                  # of an image or a capture so many columns are used
//! pulse_sigma = 0.289           # of the mirror's reading: 0.289 whole pulses on a mark, 0.1 a mirror sent to whole pulses
//! mark_sigma_m = 0.0005         # of tape and ruler
//! assume = "nothing"            # or "paper": no roll and pan, mirror on an upright axis, gain known
//! known = { beam_zero_rad = 8e-5, roll_rad = "exactly" }   # standard deviation, or held
//! camera = "camera.json"        # of `calibrate camera --json`; or { f_mm = [11.434, 0.019], … }: value and σ
//!
//! [[walls]]
//! mark_m = 1.05                 # where the tape meets it, if it was read
//! square_sigma_rad = 0.01       # how well it was set square to the tape
//!
//! [[slits]]
//! mirror_pulse = 130
//! on = "floor"                  # or { wall = 0 }
//! mark_m = 0.0                  # the tape's reading where the slit crosses it
//! peaks = [{ u = 256, v = 437.8, sigma = 0.1 }]     # or image = "slit_0.png", or capture = 12
//! ```
//!
//! Columns of the table: `name on mirror_pulse cylinder_pulse mark_m height_m u v sigma`; `on` is `floor` or `wall 0`. Rows
//! one after the other with the same name are one slit.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use toml::Spanned;

use super::files::read_text;
use super::images::{Channel, read_image};
use super::replay::Replay;
use super::rig_file;
use crate::calibration::camera::Sensor;
use crate::calibration::finder::{
    Assumptions, CameraPrior, Knowledge, Limits, Observations, Slit, SlitEnd, SlitPeak, Surface, Wall,
};
use crate::fault::{Fault, Result, positive};
use crate::image::{Capture, Line, Reading};
use crate::line::{Extractor, LineParams};
use crate::optics::Rig;

/// Largest file that is read [bytes].
const FILE_BYTES_MAX: u64 = 64 << 20;
/// The version of the format.
const VERSION: i64 = 1;

/// All that a calibration needs.
#[derive(Clone, Debug)]
pub struct SlitFile {
    /// The finder to start from.
    pub nominal: Rig,
    /// What was measured.
    pub seen: Observations,
    /// What was known.
    pub assumptions: Assumptions,
    /// What is asked of the result.
    pub limits: Limits,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Document {
    version: i64,
    rig: Option<PathBuf>,
    recording: Option<PathBuf>,
    table: Option<PathBuf>,
    #[serde(default = "columns_default")]
    columns: usize,
    #[serde(default = "pulse_sigma_default")]
    pulse_sigma: f64,
    #[serde(default = "mark_sigma_default_m")]
    mark_sigma_m: f64,
    #[serde(default)]
    assume: Assume,
    #[serde(default)]
    known: BTreeMap<String, Known>,
    camera: Option<CameraKnown>,
    sensor: Option<Sensor>,
    #[serde(default)]
    channel: Channel,
    #[serde(default)]
    line: LineParams,
    #[serde(default)]
    limits: Limits,
    #[serde(default)]
    walls: Vec<Wall>,
    #[serde(default)]
    slits: Vec<Spanned<SlitSpec>>,
}

fn columns_default() -> usize {
    16
}

fn pulse_sigma_default() -> f64 {
    1.0 / 12f64.sqrt()
}

fn mark_sigma_default_m() -> f64 {
    5e-4
}

#[derive(Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Assume {
    #[default]
    Nothing,
    Paper,
}

#[derive(Deserialize)]
#[serde(untagged, expecting = "a standard deviation, or \"exactly\"")]
enum Known {
    Within(f64),
    Word(Exactly),
}

#[derive(Deserialize)]
#[serde(rename_all = "lowercase")]
enum Exactly {
    Exactly,
}

#[derive(Deserialize)]
#[serde(
    untagged,
    expecting = "a file of `calibrate camera --json`, or f_mm, scale_u, k_per_mm2, cu_px, cv_px, each [value, sigma]"
)]
enum CameraKnown {
    File(PathBuf),
    Numbers(CameraNumbers),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraNumbers {
    f_mm: [f64; 2],
    scale_u: [f64; 2],
    k_per_mm2: [f64; 2],
    cu_px: [f64; 2],
    cv_px: [f64; 2],
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SlitSpec {
    #[serde(default)]
    name: String,
    mirror_pulse: Option<f64>,
    cylinder_pulse: Option<f64>,
    on: Surface,
    mark_m: Option<f64>,
    height_m: Option<f64>,
    end: Option<SlitEnd>,
    #[serde(default)]
    peaks: Vec<SlitPeak>,
    image: Option<PathBuf>,
    capture: Option<u64>,
}

/// Reads a file of slits (`.toml`), or a table of slits alone (`.csv`). `rig`: instead of the file's own.
///
/// Errors name file and line: unknown keys, another version, numbers out of range or in millimetres, images or captures
/// that are not there or hold no line.
pub fn load(path: &Path, rig: Option<&Path>) -> Result<SlitFile> {
    let text = read_text(path, FILE_BYTES_MAX)?;
    let is_table = path.extension().is_some_and(|end| end.eq_ignore_ascii_case("csv"));
    let document = if is_table { parse("version = 1") } else { parse(&text) };
    let document = document.map_err(|fault| fault.in_file(path))?;
    let beside = |file: &Path| path.parent().unwrap_or(Path::new(".")).join(file);
    let nominal = match (rig, &document.rig) {
        (Some(rig), _) => rig_file::load(rig)?.rig,
        (None, Some(rig)) => rig_file::load(&beside(rig))?.rig,
        (None, None) => Rig::metro_i(),
    };
    let assumptions = document.assumptions(&nominal, &beside).map_err(|fault| fault.in_file(path))?;
    let mut slits = document.read_slits(&text, &beside, &nominal).map_err(|fault| fault.in_file(path))?;
    let walls = document.walls.len();
    if is_table {
        slits.extend(table(&text, walls).map_err(|fault| fault.in_file(path))?);
    } else if let Some(file) = &document.table {
        let file = beside(file);
        slits.extend(table(&read_text(&file, FILE_BYTES_MAX)?, walls).map_err(|fault| fault.in_file(&file))?);
    }
    if slits.is_empty() {
        return Err(Fault::new("slits", "none", "[[slits]], or a table of them").in_file(path));
    }
    let Document { walls, pulse_sigma, mark_sigma_m, limits, .. } = document;
    let seen = Observations { slits, walls, pulse_sigma, mark_sigma_m };
    let seen = seen.validated().map_err(|fault| fault.in_file(path))?;
    Ok(SlitFile { nominal, seen, assumptions, limits })
}

fn parse(text: &str) -> Result<Document> {
    let line = |at: usize| text[..at.min(text.len())].matches('\n').count() + 1;
    let wrong = |error: toml::de::Error| {
        let fault = Fault::new("file of slits", error.message(), "slits of version 1");
        error.span().map_or(fault.clone(), |span| fault.at_line(line(span.start)))
    };
    // The version is looked at first: a newer file has keys that this one does not know.
    let about: toml::Table = toml::from_str(text).map_err(wrong)?;
    let newer = about.get("version").and_then(toml::Value::as_integer).filter(|version| *version > VERSION);
    if let Some(version) = newer {
        return Err(Fault::new("version", version, "1: a newer metromap wrote this file"));
    }
    let document: Document = toml::from_str(text).map_err(wrong)?;
    if document.version != VERSION {
        return Err(Fault::new("version", document.version, "1"));
    }
    if !(1..=65_536).contains(&document.columns) {
        return Err(Fault::new("columns", document.columns, "1 to 65536"));
    }
    Ok(document)
}

impl Document {
    fn assumptions(&self, nominal: &Rig, beside: &dyn Fn(&Path) -> PathBuf) -> Result<Assumptions> {
        let mut assumptions = match self.assume {
            Assume::Nothing => Assumptions::free(),
            Assume::Paper => Assumptions::paper(),
        };
        for (name, known) in &self.known {
            let knowledge = match known {
                Known::Within(sigma) => Knowledge::Within(positive(&format!("known.{name}"), *sigma)?),
                Known::Word(Exactly::Exactly) => Knowledge::Known,
            };
            assumptions = assumptions.with(name, knowledge);
        }
        let size = Sensor { width: nominal.camera.width, height: nominal.camera.height, ..Sensor::metro_i() };
        assumptions.sensor = self.sensor.unwrap_or(size).validated()?;
        assumptions.camera = match &self.camera {
            None => None,
            Some(CameraKnown::Numbers(n)) => Some(prior([n.f_mm, n.scale_u, n.k_per_mm2, n.cu_px, n.cv_px])?),
            Some(CameraKnown::File(file)) => Some(prior_of_report(&beside(file))?),
        };
        Ok(assumptions)
    }

    /// The slits of the file itself; what is wrong with one names its line.
    fn read_slits(&self, text: &str, beside: &dyn Fn(&Path) -> PathBuf, rig: &Rig) -> Result<Vec<Slit>> {
        let mut extractor = Extractor::new(self.line)?;
        let wanted = self.slits.iter().filter_map(|slit| slit.get_ref().capture).collect();
        let captures = self.captures(wanted, beside)?;
        let mut slits = Vec::with_capacity(self.slits.len());
        for (i, spanned) in self.slits.iter().enumerate() {
            let line = text[..spanned.span().start.min(text.len())].matches('\n').count() + 1;
            let here = |fault: Fault| if fault.file.is_none() { fault.at_line(line) } else { fault };
            let slit = self.slit(i, spanned.get_ref(), &captures, &mut extractor, beside, rig).map_err(here)?;
            // All of them together are checked later; alone, the line is known.
            let alone = Observations {
                slits: vec![slit.clone()],
                walls: self.walls.clone(),
                pulse_sigma: self.pulse_sigma,
                mark_sigma_m: self.mark_sigma_m,
            };
            alone.validated().map_err(here)?;
            slits.push(slit);
        }
        Ok(slits)
    }

    fn slit(
        &self,
        index: usize,
        spec: &SlitSpec,
        captures: &BTreeMap<u64, Capture>,
        extractor: &mut Extractor,
        beside: &dyn Fn(&Path) -> PathBuf,
        rig: &Rig,
    ) -> Result<Slit> {
        let name = if spec.name.is_empty() { format!("slit {}", index + 1) } else { spec.name.clone() };
        let given = [!spec.peaks.is_empty(), spec.image.is_some(), spec.capture.is_some()];
        if given.iter().filter(|given| **given).count() > 1 {
            return Err(Fault::new(name, "several of peaks, image, capture", "one of them"));
        }
        let capture = match spec.capture {
            None => None,
            Some(number) => Some(captures.get(&number).ok_or_else(|| {
                Fault::new(format!("{name}: capture"), number, "the number of a capture in the recording")
            })?),
        };
        let line = match (&spec.image, capture.map(|c| &c.reading)) {
            (Some(file), _) => {
                let file = beside(file);
                let image = read_image(&file, self.channel, u8::MAX)?;
                if (image.width(), image.height()) != (rig.camera.width, rig.camera.height) {
                    let found = format!("{} x {}", image.width(), image.height());
                    let expected = format!("{} x {}, as the rig's camera", rig.camera.width, rig.camera.height);
                    return Err(Fault::new("image size", found, expected).in_file(file));
                }
                Some(extractor.extract(&image))
            }
            (None, Some(Reading::Line(line))) => Some(line.clone()),
            (None, Some(Reading::Image(image))) => Some(extractor.extract(image)),
            (None, None) => None,
        };
        let peaks = match line {
            None => spec.peaks.clone(),
            Some(line) => spread(&line, self.columns).ok_or_else(|| {
                Fault::new(format!("{name}: line"), "none in the image", "a laser line in some columns")
            })?,
        };
        let pulse = spec.mirror_pulse.or(capture.map(|c| f64::from(c.mirror_pulse)));
        let expected = "the mirror's encoder (only a capture brings its own)";
        Ok(Slit {
            mirror_pulse: pulse.ok_or_else(|| Fault::new(format!("{name}: mirror_pulse"), "nothing", expected))?,
            cylinder_pulse: spec.cylinder_pulse.or(capture.map(|c| f64::from(c.cylinder_pulse))).unwrap_or(0.0),
            name,
            on: spec.on,
            mark_m: spec.mark_m,
            height_m: spec.height_m,
            end: spec.end,
            peaks,
        })
    }

    /// The captures of these numbers, from the recording.
    fn captures(&self, wanted: Vec<u64>, beside: &dyn Fn(&Path) -> PathBuf) -> Result<BTreeMap<u64, Capture>> {
        let mut found = BTreeMap::new();
        if wanted.is_empty() {
            return Ok(found);
        }
        let Some(recording) = &self.recording else {
            return Err(Fault::new("recording", "nothing", "the file where `capture` is looked up"));
        };
        let mut replay = Replay::open(&beside(recording), false)?;
        while let Some(capture) = replay.next_capture()? {
            if wanted.contains(&capture.id) {
                found.insert(capture.id, capture);
            }
        }
        Ok(found)
    }
}

/// Up to `count` peaks of a line, evenly over the columns that have one; `None` without any.
fn spread(line: &Line, count: usize) -> Option<Vec<SlitPeak>> {
    let peaks: Vec<SlitPeak> = (line.columns.iter().enumerate())
        .filter_map(|(u, peak)| {
            peak.map(|p| SlitPeak { u: u as f64, v: p.v.into(), sigma: f64::from(p.sigma).max(1e-3) })
        })
        .collect();
    let count = count.min(peaks.len());
    let at = |i: usize| (2 * i + 1) * peaks.len() / (2 * count.max(1));
    (count > 0).then(|| (0..count).filter_map(|i| peaks.get(at(i)).copied()).collect())
}

fn prior(pairs: [[f64; 2]; 5]) -> Result<CameraPrior> {
    for ([value, sigma], name) in pairs.iter().zip(CAMERA) {
        if !value.is_finite() {
            return Err(Fault::new(format!("camera.{name}"), value, "a finite number"));
        }
        positive(&format!("camera.{name}: σ"), *sigma)?;
    }
    Ok(CameraPrior::with_sigmas(pairs.map(|[value, _]| value), pairs.map(|[_, sigma]| sigma)))
}

/// The camera's parameters in the order of [`CameraPrior`], as `calibrate camera` names them too.
const CAMERA: [&str; 5] = ["f_mm", "scale_u", "k_per_mm2", "cu_px", "cv_px"];

/// The camera of `calibrate camera --json`; what was held there is as good as known here.
fn prior_of_report(path: &Path) -> Result<CameraPrior> {
    let text = read_text(path, FILE_BYTES_MAX)?;
    let wrong = |error: serde_json::Error| {
        Fault::new("camera", &error, "the JSON of `calibrate camera --json`").in_file(path).at_line(error.line())
    };
    let report: serde_json::Value = serde_json::from_str(&text).map_err(wrong)?;
    let mut pairs = [[0.0; 2]; 5];
    for (pair, name) in pairs.iter_mut().zip(CAMERA) {
        let estimate = &report["parameters"][name];
        let number = |key: &str| estimate[key].as_f64();
        let (Some(value), Some(sigma)) = (number("value"), number("sigma")) else {
            let expected = format!("{{\"value\", \"sigma\"}}: a camera with Tsai's model, with {}", CAMERA.join(", "));
            return Err(Fault::new(format!("parameters.{name}"), estimate, expected).in_file(path));
        };
        *pair = [value, if sigma == 0.0 { 1e-9 * value.abs().max(1e-6) } else { sigma }];
    }
    prior(pairs).map_err(|fault| fault.in_file(path))
}

/// Slits of a table: a line a row, or a slit without one.
fn table(text: &str, walls: usize) -> Result<Vec<Slit>> {
    const KNOWN: [&str; 9] = ["name", "on", "mirror_pulse", "cylinder_pulse", "mark_m", "height_m", "u", "v", "sigma"];
    let mut lines = (text.lines().enumerate())
        .map(|(i, line)| (i + 1, line.split('#').next().unwrap_or_default().trim()))
        .filter(|(_, line)| !line.is_empty());
    let Some((at, head)) = lines.next() else {
        return Err(Fault::new("table", "nothing", format!("a first line with names of {}", KNOWN.join(", "))));
    };
    let head: Vec<&str> = head.split(',').map(str::trim).collect();
    for (i, name) in head.iter().enumerate() {
        if !KNOWN.contains(name) || head.iter().position(|n| n == name) != Some(i) {
            let expected = format!("each at most once: {}", KNOWN.join(", "));
            return Err(Fault::new("column", format!("`{name}`"), expected).at_line(at));
        }
    }
    let mut slits: Vec<Slit> = Vec::new();
    for (at, line) in lines {
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        if cells.len() != head.len() {
            return Err(Fault::new("row", format!("{} cells", cells.len()), format!("{}", head.len())).at_line(at));
        }
        let row = Row { head: &head, cells: &cells };
        let (slit, peak) = row.slit(walls).map_err(|fault| fault.at_line(at))?;
        match slits.last_mut() {
            Some(last) if row.is_of(last, &slit) => last.peaks.extend(peak),
            _ => slits.push(Slit { peaks: peak.into_iter().collect(), ..slit }),
        }
    }
    Ok(slits)
}

struct Row<'a> {
    head: &'a [&'a str],
    cells: &'a [&'a str],
}

impl Row<'_> {
    fn text(&self, name: &str) -> Option<&str> {
        let at = self.head.iter().position(|n| *n == name)?;
        self.cells.get(at).copied().filter(|cell| !cell.is_empty())
    }

    fn number(&self, name: &str) -> Result<Option<f64>> {
        let Some(text) = self.text(name) else { return Ok(None) };
        let number = text.parse::<f64>().ok().filter(|n| n.is_finite());
        number.map(Some).ok_or_else(|| Fault::new(name, format!("`{text}`"), "a finite number"))
    }

    fn needed(&self, name: &str) -> Result<f64> {
        self.number(name)?.ok_or_else(|| Fault::new(name, "nothing", "a number"))
    }

    fn slit(&self, walls: usize) -> Result<(Slit, Option<SlitPeak>)> {
        let on = match self.text("on") {
            None | Some("floor") => Surface::Floor,
            Some(text) => {
                let wall = text.strip_prefix("wall").and_then(|number| number.trim().parse::<usize>().ok());
                let expected = format!("`floor`, or `wall N` with N under {walls}: walls stand in the .toml file");
                let known = wall.filter(|wall| *wall < walls);
                Surface::Wall(known.ok_or_else(|| Fault::new("on", format!("`{text}`"), expected))?)
            }
        };
        let peak = match (self.number("u")?, self.number("v")?) {
            (Some(u), Some(v)) => Some(SlitPeak { u, v, sigma: self.number("sigma")?.unwrap_or(0.1) }),
            (None, None) => None,
            _ => return Err(Fault::new("u, v", "one of them", "both, or neither")),
        };
        let slit = Slit {
            name: self.text("name").unwrap_or_default().to_string(),
            mirror_pulse: self.needed("mirror_pulse")?,
            cylinder_pulse: self.number("cylinder_pulse")?.unwrap_or(0.0),
            on,
            mark_m: self.number("mark_m")?,
            height_m: self.number("height_m")?,
            end: None,
            peaks: Vec::new(),
        };
        // Alone, so that its line is named.
        let walls = vec![Wall { mark_m: None, square_sigma_rad: 0.01 }; walls];
        let alone = Slit { peaks: peak.into_iter().collect(), ..slit.clone() };
        Observations { slits: vec![alone], walls, pulse_sigma: 1.0, mark_sigma_m: 1e-3 }.validated()?;
        Ok((slit, peak))
    }

    /// Whether this row goes on with the slit of the row before.
    fn is_of(&self, last: &Slit, slit: &Slit) -> bool {
        let same = Slit { peaks: Vec::new(), ..last.clone() } == *slit;
        same && !slit.name.is_empty()
    }
}
