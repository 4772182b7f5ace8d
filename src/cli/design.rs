//! `metromap design`: what a finder will see, before it is built.

use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use clap::Args;

use super::Exit;
use crate::design::{Design, DesignParams, Instrument, Volume, design, page};
use crate::fault::{Fault, Result, number_within, positive};
use crate::optics::{Laser, SlitOptics};
use crate::scanner::ImageParams;
use crate::sources::{Scenario, rig_file};

const HELP: &str = "\
Without a FILE: METRO-I, the paper's own finder. A rig.toml says nothing of its sensor: its pixels are taken to be \
METRO-I's 9.9 um unless --pixel-um says otherwise. A line of --lens starts with the lens that the laser meets first.

Examples:
  metromap design
  metromap design worlds/lab.toml --volume 1.5:3,-0.5:0.5,0:0.3 --resolution-mm 30
  metromap design rig.toml --pixel-um 5.6 --f-number 4 --power-mw 5 --wavelength-nm 650

With --json, one object:
{\"name\", \"given\": {what went in}, \"findings\": [{\"topic\", \"kind\": good|note|warning, \"text\"}],
 \"view\": {\"horizontal_deg\", \"vertical_deg\", the same as _pinhole_deg, \"depression_deg\": [top, bottom], \"camera_m\": [x, z],
   \"laser_m\": [x, z], \"beam_deg\": [flattest, steepest], \"floor_m\": [from, to]|null, \"blind_m\", \"ceiling_m\", \"ceiling_slope\",
   \"table_seen_to_m\", \"sees_up_to_m\": [[x, z]], \"shadow_m\": [[x, length]], \"widths\": [{\"distance_m\", \"width_m\", ...}]},
 \"optics\": {\"theta2_deg\", \"width_at_3_m_m\", the same as printed_, ...}|null,
 \"floor\": [row], \"upright_beam_deg\", \"upright\": [row],
   a row: {\"range_m\", \"from_camera_m\", \"height_m\", \"beam_deg\", \"pulse\", \"row_px\", \"mm_per_px\", \"mm_per_pulse\", \"mm_per_mrad_pitch\",
   \"mm_per_column\", \"floor_mm_per_pulse\", \"stripe_px\", \"electrons\", \"peak_level\", \"saturated\", \"found\", \"pixel_noise_px\", \"speckle_px\",
   \"range\"|\"lateral\"|\"height\": {\"pixel_noise_mm\", \"speckle_mm\", \"mirror_stop_mm\", \"encoder_mm\", \"column_mm\", \"calibration_mm\", \"pose_mm\",
   \"timing_mm\", \"instrument_mm\", \"total_mm\"}, \"dominant\", \"dominant_share\", \"smallest_step_mm\", \"smallest_step_in_line_mm\"},
 \"light\": {\"background_level\", \"noise_level\", ..., \"facing\": [{\"distance_m\", \"electrons\", \"peak_level\", ...}],
   \"reach\": [{\"target\", \"albedo\", \"ambient\", \"exposure_ms\", \"saturated_to_m\", \"found_to_m\", \"floor_found_to_m\"}]},
 \"safety\": {\"wavelength_nm\", \"limits_mw\": [class 1, 2, 3R, 3B]|null, \"line\"|\"bare_beam\": {\"power_mw\", \"through_7_mm_mw\",
   \"through_50_mm_mw\", \"class\", \"power_for_class_2_mw\"}|null, \"leaves_out\": [text]},
 \"volume\": {\"seen_ahead\", \"seen_turned\", \"unseen\": {reason: share}, \"views\", \"view_deg\", \"lines\": [{\"pulse\", \"beam_deg\", \"floor_m\"}],
   \"floor_gap_m\", \"wall_gap_m\", \"limited_by_pulse\", \"sweep_s\", ...}, \"changes\": [{\"what\", \"seen\", \"floor_m\", \"range_mm\"}],
 \"assumed\": [text],
 \"files\": [path]}
Errors are one standard deviation of a single point. Shares are 0 to 1.";

/// Work out what a finder will see.
#[derive(Args, Clone, Debug)]
#[command(after_long_help = HELP, after_help = "--help tells what the JSON holds.")]
pub struct Options {
    /// A rig.toml, or a scenario with its finder [default: METRO-I]
    #[arg(value_name = "FILE")]
    pub file: Option<PathBuf>,
    /// Directory for design.html and design.json
    #[arg(long, value_name = "DIR", default_value = "out/design")]
    pub out: PathBuf,
    /// Print one JSON object on stdout instead of a summary on stderr
    #[arg(long)]
    pub json: bool,
    /// Focal lengths of the four cylindrical lenses that make the sheet, negative ones diverge [mm]
    #[arg(long, value_name = "F1,F2,F3,F4", allow_hyphen_values = true, value_parser = numbers::<4>)]
    pub lens: Option<[f64; 4]>,
    /// Distances of the lenses within each pair [mm]
    #[arg(long, value_name = "D1,D2", allow_hyphen_values = true, value_parser = numbers::<2>)]
    pub pair_gaps: Option<[f64; 2]>,
    /// Distance between the two pairs, lm of the paper [mm]
    #[arg(long, value_name = "MM", allow_hyphen_values = true)]
    pub gap: Option<f64>,
    /// Diameter of the laser beam before the lenses, 1/e² [mm]
    #[arg(long, value_name = "MM", allow_hyphen_values = true)]
    pub laser_mm: Option<f64>,
    /// Power in the line [mW]
    #[arg(long, value_name = "MW", allow_hyphen_values = true)]
    pub power_mw: Option<f64>,
    /// Power of the bare laser beam [mW] [default: that of the line; METRO-I: 10]
    #[arg(long, value_name = "MW", allow_hyphen_values = true)]
    pub source_mw: Option<f64>,
    /// Wavelength of the laser [nm]
    #[arg(long, value_name = "NM", allow_hyphen_values = true)]
    pub wavelength_nm: Option<f64>,
    /// Focal length over aperture of the camera's lens
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    pub f_number: Option<f64>,
    /// Exposure time [ms]
    #[arg(long, value_name = "MS", allow_hyphen_values = true)]
    pub exposure_ms: Option<f64>,
    /// Height of a pixel of the camera [um]
    #[arg(long, value_name = "UM", allow_hyphen_values = true)]
    pub pixel_um: Option<f64>,
    /// Another lens before the same sensor: its focal length [mm]
    #[arg(long, value_name = "MM", allow_hyphen_values = true)]
    pub focal_mm: Option<f64>,
    /// Nearest and farthest X to tabulate [m] [default: 1:4; less for a rig of shorter reach]
    #[arg(long, value_name = "FROM:TO", allow_hyphen_values = true, value_parser = span)]
    pub range: Option<[f64; 2]>,
    /// Beam of the upright targets, below the horizontal [°] [default: that of encoder 0]
    #[arg(long, value_name = "DEG", allow_hyphen_values = true)]
    pub beam_deg: Option<f64>,
    /// Volume to watch in the robot's frame [m] [default: 1.5:3,-0.5:0.5,0:0.5; less for a rig of shorter
    /// reach]
    #[arg(long, value_name = "X:X,Y:Y,Z:Z", allow_hyphen_values = true, value_parser = volume)]
    pub volume: Option<Volume>,
    /// Widest gap between lines in that volume [mm] [default: 50]
    #[arg(long, value_name = "MM", allow_hyphen_values = true)]
    pub resolution_mm: Option<f64>,
    /// Albedo of floor and targets in the error budget [default: 0.5]
    #[arg(long, value_name = "0..1", allow_hyphen_values = true)]
    pub albedo: Option<f64>,
    /// Ambient light within the band-pass [W/m²] [default: the scenario's, or 0.06: a lit room]
    #[arg(long, value_name = "W/M2", allow_hyphen_values = true)]
    pub ambient: Option<f64>,
    /// Speed of the robot while it looks [m/s] [default: 0.3]
    #[arg(long, value_name = "M/S", allow_hyphen_values = true)]
    pub speed: Option<f64>,
    /// Standard deviation of the calibrated pitch of the camera [mrad] [default: 0]
    #[arg(long, value_name = "MRAD", allow_hyphen_values = true)]
    pub pitch_mrad: Option<f64>,
    /// Standard deviation of the calibrated zero of the beam [mrad] [default: 0]
    #[arg(long, value_name = "MRAD", allow_hyphen_values = true)]
    pub beam_zero_mrad: Option<f64>,
}

/// Largest file that is looked into [bytes]; the readers have limits of their own.
const FILE_BYTES_MAX: u64 = 16 << 20;

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    let (mut instrument, mut params) = loaded(options.file.as_deref())?;
    options.change(&mut instrument, &mut params)?;
    let all = design(instrument, params).map_err(|fault| match &options.file {
        Some(file) => fault.in_file(file),
        None => fault,
    })?;
    std::fs::create_dir_all(&options.out).map_err(|e| Fault::io(&options.out, &e))?;
    let (html, json) = (options.out.join("design.html"), options.out.join("design.json"));
    let mut value = serde_json::to_value(&all).map_err(|e| Fault::new("design", e, "numbers that JSON can hold"))?;
    value["files"] = [&html, &json].map(|path| path.display().to_string()).to_vec().into();
    for (path, text) in [(&html, page(&all)), (&json, format!("{value:#}\n"))] {
        std::fs::write(path, text).map_err(|e| Fault::io(path, &e))?;
    }
    if options.json {
        // Whoever read has seen enough if this fails.
        let _ = writeln!(std::io::stdout(), "{value}");
    } else {
        summary(&all, &html);
    }
    Ok(Exit::Done)
}

fn summary(all: &Design, html: &Path) {
    eprintln!("{}", all.name);
    for finding in &all.findings {
        eprintln!("  {}: {}", finding.topic, finding.text);
    }
    eprintln!("open {}", html.display());
}

/// The finder of a rig file or a scenario, or METRO-I.
fn loaded(file: Option<&Path>) -> Result<(Instrument, DesignParams)> {
    let mut params = DesignParams::default();
    let Some(file) = file else {
        params.source_power_w = Some(10e-3); // paper.md 1
        return Ok((Instrument::metro_i(), params));
    };
    if is_scenario(file) {
        let scenario = Scenario::load(file, &[])?;
        params.robot_radius_m = scenario.robot.radius_m;
        params.ambient_w_per_m2 = scenario.scene.ambient_w_per_m2;
        // A sheet that stands still has no sweep.
        let sweep = matches!(scenario.rig.laser, Laser::Mirror(_)).then_some(scenario.sweep);
        let assumed = Vec::new();
        return Ok((Instrument { rig: scenario.rig, image: scenario.image, optics: None, sweep, assumed }, params));
    }
    let rig = rig_file::load(file)?.rig;
    let metro = Instrument::metro_i();
    let pixel_m = metro.image.focal_length_m / metro.rig.camera.fy;
    let image = ImageParams { focal_length_m: rig.camera.fy * pixel_m, ..ImageParams::default() };
    let assumed = vec![
        "Lens, sensor and robot are those of the simulation where no option says otherwise: a rig file does not know them."
            .to_string(),
    ];
    Ok((Instrument { rig, image, optics: None, sweep: None, assumed }, params))
}

/// Whether a file has a world in it. What cannot be read is left to the readers, who say what is wrong.
fn is_scenario(file: &Path) -> bool {
    let name = file.to_string_lossy().to_lowercase();
    if [".sdf", ".world", ".sdf.gz", ".world.gz"].iter().any(|end| name.ends_with(end)) {
        return true;
    }
    let mut text = String::new();
    let regular = std::fs::metadata(file).is_ok_and(|about| about.is_file());
    let read =
        regular && std::fs::File::open(file).and_then(|f| f.take(FILE_BYTES_MAX).read_to_string(&mut text)).is_ok();
    read && toml::from_str::<toml::Table>(&text).is_ok_and(|table| table.contains_key("world"))
}

impl Options {
    /// Puts in what the command line says.
    fn change(&self, instrument: &mut Instrument, params: &mut DesignParams) -> Result<()> {
        self.change_light(instrument, params)?;
        if let Some(pixel_um) = self.pixel_um {
            number_within("--pixel-um", pixel_um, 0.1, 1e3)?;
            instrument.image.focal_length_m = instrument.rig.camera.fy * pixel_um * 1e-6;
        } else if !instrument.assumed.is_empty() {
            let pixel_um = instrument.image.focal_length_m / instrument.rig.camera.fy * 1e6;
            instrument.assumed.push(format!("Its pixels are {pixel_um:.1} µm high, as METRO-I's: see --pixel-um."));
        }
        if let Some(focal_mm) = self.focal_mm {
            let factor = number_within("--focal-mm", focal_mm, 0.1, 1e4)? * 1e-3 / instrument.image.focal_length_m;
            instrument.image.focal_length_m *= factor;
            instrument.rig.camera.fx *= factor;
            instrument.rig.camera.fy *= factor;
        }
        if let Some(n) = self.f_number {
            instrument.image.f_number = number_within("--f-number", n, 0.5, 100.0)?;
        }
        if let Some(ms) = self.exposure_ms {
            instrument.image.exposure_s = number_within("--exposure-ms", ms, 1e-6, 1e4)? * 1e-3;
        }
        // What nobody asked for suits a finder of METRO-I's reach; one that reaches less is asked about what is nearer.
        let scale = (instrument.rig.range_m_max / 4.0).min(1.0);
        let nearer = |span: [f64; 2]| span.map(|m| m * scale);
        let Volume { x_m, y_m, z_m } = params.volume;
        params.range_m = self.range.unwrap_or(nearer(params.range_m));
        params.volume = self.volume.unwrap_or(Volume { x_m: nearer(x_m), y_m: nearer(y_m), z_m: nearer(z_m) });
        if let Some(deg) = self.beam_deg {
            if deg.is_nan() || deg <= 0.0 {
                let expected = "an angle below the horizon: a beam above it never meets the floor";
                return Err(Fault::new("--beam-deg", deg, expected));
            }
            params.beam_rad = Some(number_within("--beam-deg", deg, 0.0, 85.0)?.to_radians());
        }
        let within = |flag: &str, given: Option<f64>, to: &mut f64, scale: f64, low: f64, high: f64| -> Result<()> {
            if let Some(value) = given {
                *to = number_within(flag, value, low, high)? * scale;
            }
            Ok(())
        };
        within("--resolution-mm", self.resolution_mm, &mut params.resolution_m, 1e-3, 1.0, 1e4)?;
        within("--albedo", self.albedo, &mut params.albedo, 1.0, 1e-6, 1.0)?;
        within("--ambient", self.ambient, &mut params.ambient_w_per_m2, 1.0, 0.0, 1e6)?;
        within("--speed", self.speed, &mut params.speed_m_s, 1.0, 0.0, 100.0)?;
        within("--pitch-mrad", self.pitch_mrad, &mut params.pitch_sigma_rad, 1e-3, 0.0, 1e3)?;
        within("--beam-zero-mrad", self.beam_zero_mrad, &mut params.beam_zero_sigma_rad, 1e-3, 0.0, 1e3)
    }

    /// Laser and lenses.
    fn change_light(&self, instrument: &mut Instrument, params: &mut DesignParams) -> Result<()> {
        if self.lens.is_some() || self.pair_gaps.is_some() || self.gap.is_some() || self.laser_mm.is_some() {
            let mut optics = instrument.optics.unwrap_or_default();
            if let Some([a, b, c, d]) = self.lens {
                (optics.set1.first_mm, optics.set1.second_mm) = (a, b);
                (optics.set2.first_mm, optics.set2.second_mm) = (c, d);
            }
            if let Some([first, second]) = self.pair_gaps {
                (optics.set1.gap_mm, optics.set2.gap_mm) = (first, second);
            }
            optics.between_mm = self.gap.unwrap_or(optics.between_mm);
            optics.laser_mm = self.laser_mm.unwrap_or(optics.laser_mm);
            instrument.optics = Some(SlitOptics::validated(optics)?);
        }
        if let Some(mw) = self.power_mw {
            positive("--power-mw", mw)?;
            instrument.rig.sheet.power_w = number_within("--power-mw", mw, 0.0, 1e6)? * 1e-3;
            // What was known of the source was of another laser.
            params.source_power_w = None;
        }
        if let Some(mw) = self.source_mw {
            positive("--source-mw", mw)?;
            params.source_power_w = Some(number_within("--source-mw", mw, 0.0, 1e6)? * 1e-3);
        }
        if let Some(nm) = self.wavelength_nm {
            instrument.rig.sheet.wavelength_m = number_within("--wavelength-nm", nm, 200.0, 2000.0)? * 1e-9;
        }
        let source = params.source_power_w.unwrap_or(f64::INFINITY);
        if source < instrument.rig.sheet.power_w {
            let found =
                format!("{} mW, less than the {} mW of the line", source * 1e3, instrument.rig.sheet.power_w * 1e3);
            return Err(Fault::new("--source-mw", found, "at least the power of the line"));
        }
        Ok(())
    }
}

/// N numbers between commas.
fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let all: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    let all = all.map_err(|_| format!("expected {N} numbers between commas"))?;
    let found = all.len();
    all.try_into().map_err(|_| format!("{found} numbers where {N} belong"))
}

/// FROM:TO.
fn span(text: &str) -> Result<[f64; 2], String> {
    let wrong = || "expected FROM:TO, such as 1:4".to_string();
    let (from, to) = text.split_once(':').ok_or_else(wrong)?;
    Ok([from.trim().parse().map_err(|_| wrong())?, to.trim().parse().map_err(|_| wrong())?])
}

/// X:X,Y:Y,Z:Z.
fn volume(text: &str) -> Result<Volume, String> {
    let spans: Vec<[f64; 2]> = text.split(',').map(span).collect::<Result<_, _>>()?;
    let [x_m, y_m, z_m] = spans.try_into().map_err(|_| "expected X:X,Y:Y,Z:Z, such as 1.5:3,-0.5:0.5,0:0.5")?;
    Ok(Volume { x_m, y_m, z_m })
}
