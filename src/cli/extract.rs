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
use crate::image::{Drop, Dropped, Image, Line};
use crate::line::{Extractor, LineParams};
use crate::sources::images::{Channel, read_image};
use crate::sources::rig_file;

/// A progress bar appears after this long.
const PATIENCE: Duration = Duration::from_secs(2);

const JSON_HELP: &str = "With --json, one object a line for each image, in the order given:\n\
    {\"image\": path, \"width\": px, \"height\": px,\n \
     \"columns\": [null or [v_px, sigma_px, peak], ... from the left],\n \
     \"dropped\": {reason: columns}}\n\
    v_px is the row from the top with pixel centres at integers, sigma_px its standard deviation, peak the level over the\n\
    background. Reasons: dark, not_a_line, isolated. An image that cannot be read is told on stderr and has no line;\n\
    the exit code is then 3.";

/// Find the laser line in images.
#[derive(Args, Clone, Debug)]
#[command(after_help = JSON_HELP)]
pub struct Options {
    /// Images: PNG, JPEG, BMP or PNM
    #[arg(value_name = "IMAGE", required = true)]
    pub images: Vec<PathBuf>,
    /// Print one JSON object a line for each image on stdout
    #[arg(long)]
    pub json: bool,
    /// What of a colour image is looked at [default: the rig's, or red]
    #[arg(long, value_enum, value_name = "CHANNEL")]
    pub channel: Option<Channel>,
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
}

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    let setup = setup(&options)?;
    let mut extractor = Extractor::new(setup.line)?;
    let mut dropped = Dropped::default();
    let mut progress = Progress::new(options.images.len());
    let mut out = io::BufWriter::new(io::stdout().lock());
    for path in options.images.iter() {
        if stop_requested() {
            break;
        }
        match read(path, &setup) {
            Ok(image) => {
                let line = extractor.extract(&image);
                let written = if options.json {
                    serde_json::to_writer(&mut out, &Found::new(path, &line)).map_err(io::Error::from).and_then(|()| {
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
    eprintln!("{lost} of {} images could not be used", options.images.len());
    Ok(Exit::Lossy)
}

fn setup(options: &Options) -> Result<Setup> {
    let Some(path) = &options.rig else {
        let channel = options.channel.unwrap_or_default();
        return Ok(Setup { channel, white: u8::MAX, size: None, line: LineParams::default() });
    };
    let file = rig_file::load(path)?;
    let images = file.images.unwrap_or_default();
    Ok(Setup {
        channel: options.channel.unwrap_or(images.channel),
        white: images.white.unwrap_or(u8::MAX),
        size: Some((file.rig.camera.width, file.rig.camera.height)),
        line: file.line,
    })
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
}

impl<'a> Found<'a> {
    fn new(path: &Path, line: &'a Line) -> Self {
        Self {
            image: path.display().to_string(),
            width: line.width(),
            height: line.height,
            columns: line.columns.iter().map(|peak| peak.map(|p| [p.v, p.sigma, p.level])).collect(),
            dropped: &line.dropped,
        }
    }
}

/// One row of the table for people.
fn summary(path: &Path, line: &Line) -> String {
    let mut text = format!("{}: {} of {} columns", path.display(), line.count(), line.width());
    let sorted = |value: fn(&crate::image::Peak) -> f32| {
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
    use crate::image::Peak;

    fn line() -> Line {
        let peak = |v| Some(Peak { v, sigma: 0.25, level: 40.0 });
        let mut dropped = Dropped::default();
        dropped.add(Drop::Dark);
        Line { height: 480, columns: vec![peak(100.5), None, peak(103.0)], dropped }
    }

    #[test]
    fn the_json_of_a_line_has_the_fixed_names() {
        let json = serde_json::to_string(&Found::new(Path::new("a/b.png"), &line())).unwrap();
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

    #[test]
    fn a_bad_image_is_counted_and_the_rest_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let (good, bad) = (folder.path().join("good.png"), folder.path().join("bad.png"));
        ::image::GrayImage::new(16, 16).save(&good).unwrap();
        std::fs::write(&bad, "").unwrap();
        let options = |images: Vec<PathBuf>| Options { images, json: false, channel: None, rig: None };
        assert_eq!(run(options(vec![good.clone()])).unwrap(), Exit::Done);
        assert_eq!(run(options(vec![bad, good.clone(), folder.path().join("none.png"), good])).unwrap(), Exit::Lossy);
    }
}
