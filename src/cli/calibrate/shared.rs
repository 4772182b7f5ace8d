//! What `calibrate camera` and `calibrate plane` have in common: the board, its images, files, words.

use std::fmt::Write as _;
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use indicatif::ProgressBar;
use serde_json::Value;

use super::super::Exit;
use super::super::session::progress_bar;
use crate::calibration::board::{self, Chessboard};
use crate::calibration::points::Mark;
use crate::calibration::report::{Rejected, Report, Verdict, Weak};
use crate::calibration::said;
use crate::fault::{Fault, Result};
use crate::report::html::figures;
use crate::sources::images::{Channel, image_files, read_image};

/// A progress bar appears after this long.
const PATIENCE: Duration = Duration::from_secs(2);

/// The chessboard.
#[derive(Args, Clone, Copy, Debug)]
pub struct BoardArgs {
    /// Inner corners of the chessboard, columns x rows
    #[arg(long, value_name = "COLSxROWS", value_parser = counts, requires = "square")]
    pub board: Option<[usize; 2]>,
    /// Side of its squares, or width x height [mm]
    #[arg(long, value_name = "MM[xMM]", value_parser = lengths, requires = "board")]
    pub square: Option<[f64; 2]>,
    /// How far its corners may be off their drawing, standard deviation [mm]: 0 for glass, 0.01 for a good
    /// print on something flat, 0.05 for paper on cardboard
    #[arg(long, value_name = "MM", default_value_t = 0.01)]
    pub board_sigma_mm: f64,
}

impl BoardArgs {
    /// The board, if one was announced.
    pub fn chessboard(&self) -> Result<Option<Chessboard>> {
        let (Some([columns, rows]), Some([width, height])) = (self.board, self.square) else { return Ok(None) };
        let board =
            Chessboard { columns, rows, column_pitch_m: width * 1e-3, row_pitch_m: height * 1e-3 }.validated()?;
        Ok(Some(board))
    }
}

/// `9x6`.
pub fn counts(text: &str) -> Result<[usize; 2], String> {
    let wrong = || format!("{text:?} is not two whole numbers such as 9x6");
    let (a, b) = text.split_once('x').ok_or_else(wrong)?;
    Ok([a.trim().parse().map_err(|_| wrong())?, b.trim().parse().map_err(|_| wrong())?])
}

/// `5` or `21.167x21.125`.
pub fn lengths(text: &str) -> Result<[f64; 2], String> {
    let one = |text: &str| {
        let number = text.trim().parse::<f64>().ok().filter(|x| x.is_finite() && *x > 0.0);
        number.ok_or_else(|| format!("{text:?} is not a length greater than 0"))
    };
    match text.split_once('x') {
        Some((a, b)) => Ok([one(a)?, one(b)?]),
        None => one(text).map(|x| [x, x]),
    }
}

/// `258,204`.
pub fn numbers(text: &str) -> Result<[f64; 2], String> {
    let one = |text: &str| text.trim().parse::<f64>().ok().filter(|x| x.is_finite());
    let both = text.split_once(',').and_then(|(a, b)| Some([one(a)?, one(b)?]));
    both.ok_or_else(|| format!("{text:?} is not two numbers such as 258,204"))
}

/// The files themselves; for a folder, the images in it.
pub fn files(inputs: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for input in inputs {
        if input.is_dir() { files.extend(image_files(input)?) } else { files.push(input.clone()) }
    }
    Ok(files)
}

/// The name that tables and faults call an image.
pub fn name_of(path: &Path) -> String {
    path.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned())
}

/// What an image shows of the board.
pub enum Seen {
    /// Its corners, and the size of the image.
    Board(Vec<Mark>, [usize; 2]),
    /// No board, and why not; the size of the image.
    Nothing(Fault, [usize; 2]),
}

/// Looks for the board in an image file; an error if the file cannot be read.
pub fn look(path: &Path, chessboard: &Chessboard, number: u32) -> Result<Seen> {
    let image = read_image(path, Channel::Gray, u8::MAX)?;
    let size = [image.width(), image.height()];
    Ok(match board::find(&image, chessboard, number) {
        Ok(marks) => Seen::Board(marks, size),
        Err(fault) => Seen::Nothing(fault, size),
    })
}

/// Writes the files into the directory, which is made; returns their names.
pub fn save(dir: &Path, files: &[(&str, String)]) -> Result<()> {
    std::fs::create_dir_all(dir)
        .map_err(|e| Fault::new("--out", e, "a directory that exists or can be made").in_file(dir))?;
    for (name, text) in files {
        let path = dir.join(name);
        std::fs::write(&path, text).map_err(|e| Fault::io(&path, &e))?;
    }
    Ok(())
}

/// The agreed keys of a report, with more beside them.
pub fn with(report: &Report, more: Value) -> Result<Value> {
    let wrong = |e| Fault::new("calibration", e, "numbers that JSON can hold");
    let mut value = serde_json::to_value(report).map_err(wrong)?;
    if let (Some(all), Value::Object(more)) = (value.as_object_mut(), more) {
        all.extend(more);
    }
    Ok(value)
}

/// One JSON object on stdout.
pub fn print(value: &Value) {
    // Whoever read has seen enough if this fails.
    let _ = writeln!(std::io::stdout(), "{value}");
}

/// Parameters, what is weak, what was left out, and the verdict, for people.
pub fn summary(report: &Report, weak: &[Weak], verdict: &Verdict) -> String {
    const REJECTED_MAX: usize = 8;
    let mut text = String::new();
    let mut line = |s: String| {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{s}");
    };
    for p in &report.parameters {
        let sigma = if p.sigma == 0.0 { String::new() } else { format!("± {} ", figures(p.sigma, 2)) };
        line(format!("{:18} {:>12} {sigma}{}", p.name, figures(p.value, 6), if p.unit == "1" { "" } else { p.unit }));
    }
    for weak in weak.iter().take(3) {
        line(format!("hardly told apart: {} (correlation {})", said(weak), figures(weak.correlation, 3)));
    }
    for Rejected { what, why } in report.rejected.iter().take(REJECTED_MAX) {
        line(format!("left out: {what}: {why}"));
    }
    if report.rejected.len() > REJECTED_MAX {
        line(format!("left out: {} more, see the report", report.rejected.len() - REJECTED_MAX));
    }
    if verdict.accepted {
        line("accepted".into());
    } else {
        line(format!("NOT accepted: {}", verdict.reasons.join("; ")));
    }
    text
}

/// Exit code 3 if files could not be read.
pub fn exit(unreadable: usize) -> Exit {
    if unreadable > 0 { Exit::Lossy } else { Exit::Done }
}

/// A progress bar that comes only if it takes long, and only on a terminal.
pub struct Progress {
    total: usize,
    done: u64,
    started: Instant,
    bar: Option<ProgressBar>,
}

impl Progress {
    /// For so many steps.
    pub fn new(total: usize) -> Self {
        Self { total, done: 0, started: Instant::now(), bar: None }
    }

    /// One step on; says what comes next.
    pub fn step(&mut self, next: &str) {
        self.done += 1;
        if self.bar.is_none() && self.started.elapsed() > PATIENCE && std::io::stderr().is_terminal() {
            self.bar = Some(progress_bar(Some(self.total as u64)));
        }
        if let Some(bar) = &self.bar {
            bar.set_position(self.done);
            bar.set_message(next.to_string());
        }
    }

    /// Takes it away.
    pub fn end(self) {
        if let Some(bar) = self.bar {
            bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_lengths_are_read_as_people_write_them() {
        assert_eq!(counts("9x6"), Ok([9, 6]));
        assert_eq!(lengths("21.167x21.125"), Ok([21.167, 21.125]));
        assert_eq!(lengths("5"), Ok([5.0, 5.0]));
        assert_eq!(numbers("258, 204.5"), Ok([258.0, 204.5]));
        for bad in ["9", "9x", "x", "9x-6", "9x6x3", ""] {
            assert!(counts(bad).is_err(), "{bad}");
        }
        for bad in ["", "-5", "nan", "0", "5x", "5xinf"] {
            assert!(lengths(bad).is_err(), "{bad}");
        }
        assert!(numbers("1").is_err() && numbers("1,nan").is_err());
    }
}
