//! `metromap calibrate finder`: slits on floor and walls in, rig.toml and a report out.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write;
use std::path::{Path, PathBuf};

use clap::Args;
use rand::SeedableRng;
use rand_chacha::ChaCha12Rng;
use serde::Serialize;
use serde_json::json;

use super::super::Exit;
use crate::calibration::finder::{
    FinderFit, Held, Observations, Procedure, Slit, Surface, Verdict, calibrate, page, shifted,
};
use crate::fault::{Fault, Result};
use crate::optics::Rig;
use crate::report::html::with_sigma;
use crate::sources::{rig_file, slits};

const HELP: &str = "\
The file of slits (.toml) says which finder to start from, what was known, and for each slit the encoders, what it lies on, \
the mark of a tape where it crosses it, and rows of its line in the image: numbers, an image, or a capture of a recording. \
A table (.csv) of slits alone will do. To see the form, and to try it:\n\n    \
metromap calibrate finder --example out/slits\n    metromap calibrate finder out/slits/slits.toml\n\n\
JSON keys: parameters {name: {value, sigma, unit}}, residual {rms, mean, max, unit} (over the readings' standard deviations), \
used, rejected [{what, why}], held {name: data | prior | weak | known}, slits [{what, mirror_pulse, rms, readings, pulse_off, \
mark_off_m}], weak [{changes {name: by}, left}], advice [{measure, settles {name: [sigma now, then]}}], verdict {accepted, \
reasons, range_sigma_m}, covariance {names, rows}, files.";

/// Calibrate mirror, camera and encoders of a finder.
#[derive(Args, Clone, Debug)]
#[command(after_long_help = HELP)]
pub struct Options {
    /// Slits (.toml, or a table .csv)
    #[arg(value_name = "SLITS", required_unless_present = "example")]
    pub input: Option<PathBuf>,
    /// The finder to start from: its drawing, or an older calibration [default: the file's own, or METRO-I]
    #[arg(long, value_name = "FILE")]
    pub rig: Option<PathBuf>,
    /// Directory for rig.toml, report.html and calibration.json
    #[arg(long, value_name = "DIR", default_value = "out/finder")]
    pub out: PathBuf,
    /// Print one JSON object on stdout instead of a summary on stderr
    #[arg(long)]
    pub json: bool,
    /// Write slits.toml, nominal.toml and truth.toml of a simulated finder there, and do nothing else
    #[arg(long, value_name = "DIR", conflicts_with = "input")]
    pub example: Option<PathBuf>,
    /// Seed of the example
    #[arg(long, value_name = "SEED", default_value_t = 1996, requires = "example")]
    pub seed: u64,
}

/// What `--json` prints.
#[derive(Serialize)]
struct Outcome<'a> {
    #[serde(flatten)]
    fit: &'a FinderFit,
    verdict: &'a Verdict,
    covariance: serde_json::Value,
    files: Vec<String>,
}

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    if let Some(dir) = &options.example {
        return example(dir, options.seed);
    }
    let Some(input) = &options.input else {
        return Err(Fault::new("SLITS", "nothing", "a file of slits"));
    };
    let file = slits::load(input, options.rig.as_deref())?;
    let fit = calibrate(&file.nominal, &file.seen, &file.assumptions).map_err(|fault| fault.in_file(input))?;
    let verdict = fit.verdict(&file.limits).map_err(|fault| fault.in_file(input))?;
    std::fs::create_dir_all(&options.out).map_err(|e| Fault::io(&options.out, &e))?;
    let path = |name: &str| options.out.join(name);
    let (rig, report, json) = (path("rig.toml"), path("report.html"), path("calibration.json"));
    let matrix: Vec<Vec<f64>> = fit.covariance.row_iter().map(|row| row.iter().copied().collect()).collect();
    let outcome = Outcome {
        fit: &fit,
        verdict: &verdict,
        covariance: json!({ "names": fit.names, "rows": matrix }),
        files: [&rig, &report, &json].map(|path| path.display().to_string()).to_vec(),
    };
    let text =
        serde_json::to_string(&outcome).map_err(|e| Fault::new("calibration", e, "numbers that JSON can hold"))?;
    let html = page(&fit, &verdict, &file.limits, &file.nominal)?;
    for (path, text) in [(&rig, rig_file::to_toml(&fit.rig)), (&report, html), (&json, text.clone() + "\n")] {
        std::fs::write(path, text).map_err(|e| Fault::io(path, &e))?;
    }
    if options.json {
        // Whoever read has seen enough if this fails.
        let _ = writeln!(std::io::stdout(), "{text}");
    } else {
        eprint!("{}", summary(&fit, &verdict));
        eprintln!("report: {}", report.display());
        eprintln!("use it: metromap map RECORDING --rig {}", rig.display());
    }
    Ok(Exit::Done)
}

/// A few lines for people.
fn summary(fit: &FinderFit, verdict: &Verdict) -> String {
    let mut text = String::new();
    let mut line = |s: String| {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{s}");
    };
    for p in &fit.report.parameters {
        // A plain minus, which other programs read too.
        let [value, sigma] = with_sigma(p.value, p.sigma).map(|number| number.replace('−', "-"));
        let unit = if p.unit == "1" { "" } else { p.unit };
        match fit.held.get(&p.name) {
            Some(Held::Data | Held::Prior) => line(format!("{:20} {value:>10} ± {sigma} {unit}", p.name)),
            Some(Held::Weak) => line(format!("{:20} {value:>10} ± {sigma} {unit}: the slits do not hold it", p.name)),
            _ => {}
        }
    }
    line(format!(
        "{} slits, readings off by {:.2} standard deviations rms; range error from the calibration {:.1} mm",
        fit.report.used,
        fit.report.residual.rms,
        verdict.range_sigma_m * 1e3
    ));
    for rejected in &fit.report.rejected {
        line(format!("left out: {}: {}", rejected.what, rejected.why));
    }
    for advice in &fit.advice {
        let names: Vec<&str> = advice.settles.keys().map(String::as_str).collect();
        line(format!("measure next: {}: settles {}", advice.measure, names.join(", ")));
    }
    if verdict.accepted {
        line("accepted".into());
    } else {
        line(format!("NOT accepted: {}", verdict.reasons.join("; ")));
    }
    text
}

/// A simulated calibration: a finder that is not quite as drawn, and what was measured with it.
fn example(dir: &Path, seed: u64) -> Result<Exit> {
    let nominal = Rig::metro_i();
    let built: BTreeMap<String, f64> = [
        ("mirror_height_m", 0.012),
        ("beam_zero_rad", -0.004),
        ("camera_height_m", -0.008),
        ("x0_m", 0.010),
        ("tilt_rad", 0.007),
        ("roll_rad", 0.006),
        ("slit_roll_rad", -0.004),
        ("camera_y_m", 0.003),
    ]
    .map(|(name, by)| (name.to_string(), by))
    .into();
    let truth = shifted(&nominal, &built)?;
    let seen = Procedure::thorough(truth.clone()).measure(&mut ChaCha12Rng::seed_from_u64(seed))?;
    std::fs::create_dir_all(dir).map_err(|e| Fault::io(dir, &e))?;
    let files = [
        ("nominal.toml", rig_file::to_toml(&nominal)),
        ("truth.toml", rig_file::to_toml(&truth)),
        ("slits.toml", example_text(&seen)),
    ];
    for (name, text) in files {
        let path = dir.join(name);
        std::fs::write(&path, text).map_err(|e| Fault::io(&path, &e))?;
    }
    eprintln!("try it: metromap calibrate finder {}", dir.join("slits.toml").display());
    Ok(Exit::Done)
}

const EXAMPLE_HEAD: &str = "\
# A simulated calibration of a finder. Lengths in metres, pixels from the image's top left, pulses as the encoders count.
version = 1
rig = \"nominal.toml\"     # the finder as drawn; it was built a little different (truth.toml)
assume = \"nothing\"       # \"paper\": no roll and pan, the mirror on an upright axis, the encoder's gain known
known = { beam_rad_per_pulse = \"exactly\" }

# The camera's own calibration: value and standard deviation. Or the file that `calibrate camera --json` prints.
[camera]
f_mm = [11.434, 0.019]
scale_u = [1.095, 2e-4]
k_per_mm2 = [0.00335, 6e-5]
cu_px = [256.0, 2.5]
cv_px = [239.0, 2.5]
";

/// The measurements as a file that a person can read and change.
fn example_text(seen: &Observations) -> String {
    let (head, camera) = EXAMPLE_HEAD.split_at(EXAMPLE_HEAD.find("\n# The camera").unwrap_or(EXAMPLE_HEAD.len()));
    let mut text = String::from(head);
    // Writing to a string cannot fail.
    let _ = writeln!(
        text,
        "pulse_sigma = {:.4}     # whole pulses were read, the mirror turned until the slit lay on its mark",
        seen.pulse_sigma
    );
    let _ = writeln!(text, "mark_sigma_m = {}     # of tape and ruler", seen.mark_sigma_m);
    text += camera;
    for wall in &seen.walls {
        let mark =
            wall.mark_m.map_or(String::new(), |mark| format!("mark_m = {mark:.4}         # where the tape meets it\n"));
        let _ = write!(text, "\n[[walls]]\n{mark}square_sigma_rad = {}\n", wall.square_sigma_rad);
    }
    for slit in &seen.slits {
        text += &example_slit(slit);
    }
    text
}

fn example_slit(slit: &Slit) -> String {
    let mut text = format!("\n[[slits]]\nmirror_pulse = {}\n", slit.mirror_pulse);
    if slit.cylinder_pulse != 0.0 {
        let _ = writeln!(text, "cylinder_pulse = {}", slit.cylinder_pulse);
    }
    text += &match slit.on {
        Surface::Floor => "on = \"floor\"\n".to_string(),
        Surface::Wall(wall) => format!("on = {{ wall = {wall} }}\n"),
    };
    for (key, value) in [("mark_m", slit.mark_m), ("height_m", slit.height_m)] {
        if let Some(value) = value {
            let _ = writeln!(text, "{key} = {value:.4}");
        }
    }
    if let Some(end) = slit.end {
        let _ = writeln!(text, "end = {{ y_m = {}, u = {:.2}, sigma = {:.2} }}", end.y_m, end.u, end.sigma);
    }
    let peak =
        |p: &crate::calibration::finder::SlitPeak| format!("{{ u = {}, v = {:.3}, sigma = {} }}", p.u, p.v, p.sigma);
    let _ = writeln!(text, "peaks = [{}]", slit.peaks.iter().map(peak).collect::<Vec<_>>().join(", "));
    text
}
