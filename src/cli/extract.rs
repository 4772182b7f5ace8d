//! `metromap extract`: only the laser line, image by image.

use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use indicatif::ProgressBar;
use serde::Serialize;

use super::Exit;
use super::session::{progress_bar, stop_requested};
use crate::fault::{Fault, Result};
use crate::image::{Drop, Dropped, Image, Line, Peak};
use crate::line::{Estimator, Extractor, Keep, LineParams};
use crate::sources::images::{Channel, ENDINGS, read_image};
use crate::sources::rig_file;

/// A progress bar appears after this long.
const PATIENCE: Duration = Duration::from_secs(2);

const JSON_HELP: &str = "With --json, one object a line for each image, in the order given:\n\
    {\"image\": path, \"width\": px, \"height\": px,\n \
     \"columns\": [null or [v_px, sigma_px, peak], ... from the left],\n \
     \"dropped\": {reason: columns}}\n\
    With --all-peaks also \"others\": [[[v_px, sigma_px, peak], ...], ... from the left], the other peaks of each column\n\
    that stand out of the noise by themselves, strongest first; at most three, none eight times weaker than the strongest.\n\
    v_px is the row from the top with pixel centres at integers, sigma_px its standard deviation, peak the level over the\n\
    background (with --background, over that image). Reasons: dark, not_a_line, isolated. An image that cannot be read is told on stderr and has no line;\n\
    the exit code is then 3.";

/// Find the laser line in images.
#[derive(Args, Clone, Debug)]
#[command(after_help = JSON_HELP)]
pub struct Options {
    /// Images: PNG, JPEG, BMP or PNM; or folders of them, taken in the order of their names
    #[arg(value_name = "IMAGE", required = true)]
    pub images: Vec<PathBuf>,
    /// Print one JSON object a line for each image on stdout
    #[arg(long)]
    pub json: bool,
    /// What of a colour image is looked at [default: the rig's, or red]
    #[arg(long, value_enum, value_name = "CHANNEL")]
    pub channel: Option<Channel>,
    /// An image taken with the laser off: only what the others show more than it is looked at
    #[arg(long, value_name = "FILE")]
    pub background: Option<PathBuf>,
    /// Print the peaks that were not taken for the line, too
    #[arg(long, requires = "json")]
    pub all_peaks: bool,
    /// Which of several peaks in a column is the line's: path (where the line of the neighbours goes on), brightest,
    /// topmost or lowest [default: the rig's, or path]
    #[arg(long, value_name = "RULE", value_parser = keep)]
    pub keep: Option<Keep>,
    /// How rows are found to a fraction of a pixel: auto, full_fit, whole_pixel, centroid, gauss3, gauss5 or blais_rioux
    /// [default: the rig's, or auto]
    #[arg(long, value_name = "NAME", value_parser = estimator)]
    pub estimator: Option<Estimator>,
    /// Take channel, white level and [line] from a rig file; images must be of its camera's size
    #[arg(long, value_name = "FILE")]
    pub rig: Option<PathBuf>,
}

/// How images are read and looked at.
struct Setup {
    channel: Channel,
    white: u8,
    size: Option<(usize, usize)>,
    line: LineParams,
    /// The image taken with the laser off.
    off: Option<Image>,
}

/// The estimator of this name, as rig files have it.
pub(super) fn estimator(name: &str) -> Result<Estimator, String> {
    named(name)
}

fn keep(name: &str) -> Result<Keep, String> {
    named(name)
}

/// A choice by its name in files; the error lists all of them.
fn named<T: serde::de::DeserializeOwned>(name: &str) -> Result<T, String> {
    serde_json::from_value(serde_json::Value::from(name)).map_err(|error| error.to_string())
}

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    let setup = setup(&options)?;
    let mut extractor = Extractor::new(setup.line)?;
    let images = listed(&options.images)?;
    let mut dropped = Dropped::default();
    let mut progress = Progress::new(images.len());
    let mut out = io::BufWriter::new(io::stdout().lock());
    for path in images.iter() {
        if stop_requested() {
            break;
        }
        match read(path, &setup).and_then(|image| extract(&mut extractor, &image, &setup, &options, path)) {
            Ok((line, others)) => {
                let written = if options.json {
                    let found = Found::new(path, &line, others);
                    serde_json::to_writer(&mut out, &found).map_err(io::Error::from).and_then(|()| {
                        out.write_all(b"\n")?;
                        out.flush()
                    })
                } else {
                    progress.say(&summary(path, &line));
                    Ok(())
                };
                match written {
                    // Whoever read has seen enough.
                    Err(error) if error.kind() == io::ErrorKind::BrokenPipe => break,
                    Err(error) => return Err(Fault::io("standard output", &error)),
                    Ok(()) => {}
                }
            }
            Err((why, fault)) => {
                dropped.add(why);
                progress.say(&format!("{fault}"));
            }
        }
        progress.step();
    }
    progress.end();
    let lost = dropped.lost();
    if lost == 0 {
        return Ok(Exit::Done);
    }
    eprintln!("{lost} of {} images could not be used", images.len());
    Ok(Exit::Lossy)
}

/// The images named, and those of the folders named; an empty folder is an error.
fn listed(paths: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut images = Vec::new();
    for path in paths {
        if !path.is_dir() {
            images.push(path.clone());
            continue;
        }
        let start = images.len();
        for entry in std::fs::read_dir(path).map_err(|error| Fault::io(path, &error))? {
            let file = entry.map_err(|error| Fault::io(path, &error))?.path();
            let ending = file.extension().map(|e| e.to_string_lossy().to_lowercase());
            if ending.is_some_and(|e| ENDINGS.contains(&e.as_str())) {
                images.push(file);
            }
        }
        if images.len() == start {
            return Err(Fault::new("folder", "no images", ENDINGS.join(", ")).in_file(path));
        }
        images[start..].sort();
    }
    Ok(images)
}

/// A line, and the other peaks of each column if they are asked for.
type Peaks = (Line, Option<Vec<Vec<Peak>>>);

/// The line of an image, and the other peaks if they are asked for.
fn extract(
    extractor: &mut Extractor,
    image: &Image,
    setup: &Setup,
    options: &Options,
    path: &Path,
) -> Result<Peaks, (Drop, Fault)> {
    let wrong = |fault: Fault| (Drop::WrongSize, fault.in_file(path));
    if options.all_peaks {
        let (line, others) = extractor.extract_all(image, setup.off.as_ref()).map_err(wrong)?;
        return Ok((line, Some(others)));
    }
    match &setup.off {
        Some(off) => extractor.extract_above(image, off).map_err(wrong).map(|line| (line, None)),
        None => Ok((extractor.extract(image), None)),
    }
}

fn setup(options: &Options) -> Result<Setup> {
    let (channel, white, size, line) = match &options.rig {
        None => (options.channel.unwrap_or_default(), u8::MAX, None, LineParams::default()),
        Some(path) => {
            let file = rig_file::load(path)?;
            let images = file.images.unwrap_or_default();
            let channel = options.channel.unwrap_or(images.channel);
            let size = (file.rig.camera.width, file.rig.camera.height);
            (channel, images.white.unwrap_or(u8::MAX), Some(size), file.line)
        }
    };
    let line = LineParams {
        keep: options.keep.unwrap_or(line.keep),
        estimator: options.estimator.unwrap_or(line.estimator),
        ..line
    };
    let off = options.background.as_ref().map(|path| read_image(path, channel, white)).transpose()?;
    Ok(Setup { channel, white, size, line, off })
}

fn read(path: &Path, setup: &Setup) -> Result<Image, (Drop, Fault)> {
    let image = read_image(path, setup.channel, setup.white).map_err(|fault| (Drop::Unreadable, fault))?;
    match setup.size {
        Some((width, height)) if (image.width(), image.height()) != (width, height) => {
            let found = format!("{} x {}", image.width(), image.height());
            let fault = Fault::new("image size", found, format!("{width} x {height}, the camera's")).in_file(path);
            Err((Drop::WrongSize, fault))
        }
        _ => Ok(image),
    }
}

/// The line of one image as JSON.
#[derive(Serialize)]
struct Found<'a> {
    image: String,
    width: usize,
    height: usize,
    columns: Vec<Option<[f32; 3]>>,
    dropped: &'a Dropped,
    #[serde(skip_serializing_if = "Option::is_none")]
    others: Option<Vec<Vec<[f32; 3]>>>,
}

/// A peak as JSON has it.
fn numbers(peak: &Peak) -> [f32; 3] {
    [peak.v, peak.sigma, peak.level]
}

impl<'a> Found<'a> {
    fn new(path: &Path, line: &'a Line, others: Option<Vec<Vec<Peak>>>) -> Self {
        Self {
            image: path.display().to_string(),
            width: line.width(),
            height: line.height,
            columns: line.columns.iter().map(|peak| peak.as_ref().map(numbers)).collect(),
            dropped: &line.dropped,
            others: others.map(|all| all.iter().map(|peaks| peaks.iter().map(numbers).collect()).collect()),
        }
    }
}

/// One row of the table for people.
fn summary(path: &Path, line: &Line) -> String {
    let mut text = format!("{}: {} of {} columns", path.display(), line.count(), line.width());
    let sorted = |value: fn(&Peak) -> f32| {
        let mut values: Vec<f32> = line.columns.iter().flatten().map(value).collect();
        values.sort_by(f32::total_cmp);
        values
    };
    let (rows, sigmas, levels) = (sorted(|p| p.v), sorted(|p| p.sigma), sorted(|p| p.level));
    if let (Some(first), Some(last)) = (rows.first(), rows.last()) {
        let middle = rows.len() / 2;
        text += &format!(
            ", rows {first:.1} to {last:.1}, sigma {:.2} px, peak {:.0} levels",
            sigmas[middle], levels[middle]
        );
    }
    for (why, count) in &line.dropped.0 {
        text += &format!(", {count} {why}");
    }
    text
}

/// A progress bar that comes only if it takes long, and only on a terminal.
struct Progress {
    total: usize,
    done: u64,
    started: Instant,
    bar: Option<ProgressBar>,
}

impl Progress {
    fn new(total: usize) -> Self {
        Self { total, done: 0, started: Instant::now(), bar: None }
    }

    fn step(&mut self) {
        self.done += 1;
        if self.bar.is_none() && self.started.elapsed() > PATIENCE && io::stderr().is_terminal() {
            self.bar = Some(progress_bar(Some(self.total as u64)));
        }
        if let Some(bar) = &self.bar {
            bar.set_position(self.done);
        }
    }

    /// A line on stderr, above the bar.
    fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{text}")),
            None => eprintln!("{text}"),
        }
    }

    fn end(self) {
        if let Some(bar) = self.bar {
            bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line() -> Line {
        let peak = |v| Some(Peak { v, sigma: 0.25, level: 40.0 });
        let mut dropped = Dropped::default();
        dropped.add(Drop::Dark);
        Line { height: 480, columns: vec![peak(100.5), None, peak(103.0)], dropped }
    }

    #[test]
    fn the_json_of_a_line_has_the_fixed_names() {
        let json = serde_json::to_string(&Found::new(Path::new("a/b.png"), &line(), None)).unwrap();
        let expected = r#"{"image":"a/b.png","width":3,"height":480,"columns":[[100.5,0.25,40.0],null,[103.0,0.25,40.0]],"dropped":{"dark":1}}"#;
        assert_eq!(json, expected);
    }

    #[test]
    fn the_table_says_what_is_there_and_what_is_not() {
        let text = summary(Path::new("b.png"), &line());
        assert_eq!(text, "b.png: 2 of 3 columns, rows 100.5 to 103.0, sigma 0.25 px, peak 40 levels, 1 dark");
        let empty = Line { height: 1, columns: vec![None], dropped: Dropped::default() };
        assert_eq!(summary(Path::new("b.png"), &empty), "b.png: 0 of 1 columns");
    }

    fn options() -> Options {
        let (json, all_peaks) = (false, false);
        let (images, background, keep, estimator) = (Vec::new(), None, None, None);
        Options { images, json, channel: None, background, all_peaks, keep, estimator, rig: None }
    }

    #[test]
    fn names_are_those_of_the_files_and_folders_are_images_by_name() {
        assert_eq!(estimator("full_fit"), Ok(Estimator::FullFit));
        assert_eq!(keep("lowest"), Ok(Keep::Lowest));
        assert!(estimator("fullfit").unwrap_err().contains("full_fit"));
        let folder = tempfile::tempdir().unwrap();
        assert!(listed(&[folder.path().into()]).is_err());
        for name in ["b.png", "a.JPG", "notes.txt"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let names = listed(&[folder.path().into(), "c.png".into()]).unwrap();
        assert_eq!(names, [folder.path().join("a.JPG"), folder.path().join("b.png"), "c.png".into()]);
    }

    #[test]
    fn a_background_of_another_size_is_a_loss_with_the_reason() {
        let folder = tempfile::tempdir().unwrap();
        let (image, off) = (folder.path().join("image.png"), folder.path().join("off.png"));
        ::image::GrayImage::new(16, 16).save(&image).unwrap();
        ::image::GrayImage::new(16, 17).save(&off).unwrap();
        let all = Options { images: vec![image.clone()], background: Some(off), ..options() };
        assert_eq!(run(all).unwrap(), Exit::Lossy);
        let same = Options { images: vec![image.clone()], background: Some(image.clone()), ..options() };
        assert_eq!(run(same).unwrap(), Exit::Done);
        let none = Options { images: vec![image], background: Some("none.png".into()), ..options() };
        assert!(run(none).is_err());
    }

    #[test]
    fn a_bad_image_is_counted_and_the_rest_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let (good, bad) = (folder.path().join("good.png"), folder.path().join("bad.png"));
        ::image::GrayImage::new(16, 16).save(&good).unwrap();
        std::fs::write(&bad, "").unwrap();
        let options = |images: Vec<PathBuf>| Options { images, ..options() };
        assert_eq!(run(options(vec![good.clone()])).unwrap(), Exit::Done);
        assert_eq!(run(options(vec![bad, good.clone(), folder.path().join("none.png"), good])).unwrap(), Exit::Lossy);
    }
}
