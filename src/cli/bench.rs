//! `metromap bench`: the same work as the tools a user would pick instead, on the same inputs, one JSON line a figure.
//!
//! Each work reads its input, checks its answer, and only then takes the time, on one thread. A further work is a function
//! of the data's folder in `WORKS`.

use std::hint::black_box;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use serde_json::{Value, json};

use super::Exit;
use super::extract::estimator;
use crate::fault::{Fault, Result};
use crate::image::{Image, Line};
use crate::line::{Estimator, Extractor, LineParams};

const JSON_HELP: &str = "Prints one JSON object a line on stdout, with the time of the fastest of many runs on one thread:\n\
    {\"work\": \"line\", \"tool\": \"metromap\", \"estimator\": name, \"per_s\": frames,\n \
     \"argmax_agreement\": share, \"found\": share, \"rms_px\": px, \"wrong\": share}\n\
    line: DIR/frames.bin, 64 slit images of 512 x 480 bytes. Before the time is taken, the rows to whole pixels are held\n\
    against each column's brightest pixel (argmax_agreement, of the columns found), and the rows to a fraction of a pixel\n\
    against the curve that the images were made from (rms_px of those within 3 px of it; wrong, of all columns, are the\n\
    others; a few columns have no stripe).";

/// The size of the frames, and how many there are.
const FRAMES: (usize, usize, usize) = (512, 480, 64);
/// Their white level: 7 bits.
const WHITE: u8 = 127;
/// Farther from the true row than this, a peak is wrong [px].
const WRONG_PX: f64 = 3.0;
/// A run takes all frames this many times.
const ROUNDS: usize = 4;
/// At least so many runs, in at least this time.
const RUNS: (usize, Duration) = (5, Duration::from_millis(1500));

/// Take the time of the kernels, on the inputs of the peers' benchmarks.
#[derive(Args, Clone, Debug)]
#[command(after_help = JSON_HELP)]
pub struct Options {
    /// Folder with the inputs: frames.bin
    #[arg(value_name = "DATA_DIR")]
    pub data: PathBuf,
    /// How the row of the line is found: auto, full_fit, whole_pixel, centroid, gauss3, gauss5 or blais_rioux
    #[arg(long, value_name = "NAME", default_value = "auto", value_parser = estimator)]
    pub estimator: Estimator,
}

/// A work: its figures from the inputs.
type Work = fn(&Options) -> Result<Value>;

/// All that is measured.
const WORKS: [Work; 1] = [line];

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    for work in WORKS {
        let figures = work(&options)?;
        writeln!(io::stdout(), "{figures}").map_err(|error| Fault::io("standard output", &error))?;
    }
    Ok(Exit::Done)
}

/// Frames a second of the extraction.
fn line(options: &Options) -> Result<Value> {
    let frames = frames(&options.data.join("frames.bin"))?;
    let params = LineParams { estimator: options.estimator, ..LineParams::default() };
    let answer = check(&frames, params)?;
    let mut extractor = Extractor::new(params)?;
    let mut found = Line::empty();
    let seconds = fastest(|| {
        for _ in 0..ROUNDS {
            for frame in &frames {
                extractor.extract_into(black_box(frame), &mut found);
                black_box(&found);
            }
        }
    });
    let mut figures = json!({
        "work": "line",
        "tool": "metromap",
        "estimator": options.estimator,
        "per_s": ((ROUNDS * frames.len()) as f64 / seconds).round(),
    });
    if let (Some(all), Value::Object(answer)) = (figures.as_object_mut(), answer) {
        all.extend(answer);
    }
    Ok(figures)
}

/// The fastest of many runs [s]: what the machine can do when nobody disturbs it.
fn fastest(mut run: impl FnMut()) -> f64 {
    let began = Instant::now();
    let mut fastest = f64::INFINITY;
    let mut runs = 0;
    while runs < RUNS.0 || began.elapsed() < RUNS.1 {
        let start = Instant::now();
        run();
        fastest = fastest.min(start.elapsed().as_secs_f64());
        runs += 1;
    }
    fastest
}

/// 64 images without a header.
fn frames(path: &Path) -> Result<Vec<Image>> {
    let (width, height, count) = FRAMES;
    let size = width * height * count;
    let expected = format!("{size} bytes: {count} frames of {width} x {height}, a byte a pixel");
    let is = std::fs::metadata(path).map_err(|error| Fault::io(path, &error))?.len();
    if is != size as u64 {
        return Err(Fault::new("size", format!("{is} bytes"), expected).in_file(path));
    }
    let bytes = std::fs::read(path).map_err(|error| Fault::io(path, &error))?;
    bytes
        .chunks(width * height)
        .map(|frame| Image::new(width, height, WHITE, frame.to_vec()).map_err(|fault| fault.in_file(path)))
        .collect()
}

/// How right the answer is.
fn check(frames: &[Image], params: LineParams) -> Result<Value> {
    let mut whole = Extractor::new(LineParams { estimator: Estimator::WholePixel, ..params })?;
    let mut fine = Extractor::new(params)?;
    let (mut agree, mut whole_found, mut found, mut wrong, mut squares) = (0, 0, 0, 0, 0.0);
    for (number, frame) in frames.iter().enumerate() {
        for (u, peak) in whole.extract(frame).columns.iter().enumerate() {
            let Some(peak) = peak else { continue };
            whole_found += 1;
            agree += usize::from(f64::from(peak.v) == brightest(frame, u) as f64);
        }
        for (u, peak) in fine.extract(frame).columns.iter().enumerate() {
            let Some(peak) = peak else { continue };
            let error = f64::from(peak.v) - true_row(number, u);
            if error.abs() <= WRONG_PX {
                found += 1;
                squares += error * error;
            } else {
                wrong += 1;
            }
        }
    }
    let columns = (frames.len() * FRAMES.0) as f64;
    Ok(json!({
        "argmax_agreement": rounded(agree as f64 / whole_found as f64),
        "found": rounded((found + wrong) as f64 / columns),
        "rms_px": rounded((squares / found as f64).sqrt()),
        "wrong": rounded(wrong as f64 / columns),
    }))
}

/// The first of the brightest pixels of a column.
fn brightest(frame: &Image, u: usize) -> usize {
    let level = |v: usize| frame.levels()[v * frame.width() + u];
    (0..frame.height()).rev().max_by_key(|v| level(*v)).unwrap_or(0)
}

/// The row that the stripe of a frame was drawn at: the formula of the inputs' maker.
fn true_row(frame: usize, u: usize) -> f64 {
    240.0 + 60.0 * (u as f64 / 50.0 + frame as f64).sin() + if u % 128 < 30 { 40.0 } else { 0.0 }
}

/// To five digits after the point; no number of none.
fn rounded(value: f64) -> Option<f64> {
    value.is_finite().then(|| (value * 1e5).round() / 1e5)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames after the maker's formula, without noise.
    fn bytes() -> Vec<u8> {
        let (width, height, count) = FRAMES;
        let mut bytes = vec![5; width * height * count];
        for frame in 0..count {
            for u in 0..width {
                let v = true_row(frame, u);
                for row in (v - 6.0) as usize..(v + 7.0) as usize {
                    let x = (row as f64 - v) / 0.8;
                    bytes[(frame * height + row) * width + u] = (5.0 + 90.0 * (-0.5 * x * x).exp()).round() as u8;
                }
            }
        }
        bytes
    }

    #[test]
    fn the_answer_is_checked_against_the_truth() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("frames.bin"), bytes()).unwrap();
        let frames = frames(&folder.path().join("frames.bin")).unwrap();
        let answer = check(&frames, LineParams::default()).unwrap();
        assert!(answer["rms_px"].as_f64().unwrap() < 0.01, "{answer}");
        assert!(answer["argmax_agreement"].as_f64().unwrap() > 0.999, "{answer}");
        // Of 512 columns: where u % 128 wraps, the line steps by 40 px; nothing may be lost there.
        assert_eq!((answer["found"].as_f64(), answer["wrong"].as_f64()), (Some(1.0), Some(0.0)));
    }

    #[test]
    fn wrong_inputs_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let options = Options { data: folder.path().into(), estimator: Estimator::Auto };
        let fault = run(options.clone()).unwrap_err();
        assert!(fault.to_string().contains("frames.bin"), "{fault}");
        std::fs::write(folder.path().join("frames.bin"), [0; 1000]).unwrap();
        let fault = run(options).unwrap_err();
        assert!(fault.to_string().contains("15728640 bytes"), "{fault}");
    }
}
