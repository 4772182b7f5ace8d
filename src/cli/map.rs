//! `metromap map`: the pipeline over a recording, or over a folder of images.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::Exit;
use super::output::{Output, start};
use super::session::{Session, stop_requested};
use super::summary::Summary;
use crate::fault::{Fault, Result};
use crate::image::Dropped;
use crate::optics::Rig;
use crate::pipeline::{Pipeline, PipelineParams};
use crate::sources::images::ImageFolder;
use crate::sources::replay::{Input as Next, Replay};
use crate::sources::rig_file;

/// Map a recording, or a folder of images with a rig.toml.
#[derive(Args, Clone, Debug)]
#[command(after_long_help = super::run::JSON_HELP)]
pub struct Options {
    /// A recording (.mcap), or a folder of images
    #[arg(value_name = "RECORDING|DIR")]
    pub input: PathBuf,
    /// The finder [default: the recording's, or DIR/rig.toml]
    #[arg(long, value_name = "FILE")]
    pub rig: Option<PathBuf>,
    /// What of a recording is mapped
    #[arg(long, value_enum, default_value_t, value_name = "WHICH")]
    pub from: From,
    /// Where results go.
    #[command(flatten)]
    pub output: Output,
}

/// What of a recording is mapped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum From {
    /// The lines that were found when it was made.
    #[default]
    Lines,
    /// The images, found anew.
    Images,
}

/// Captures from somewhere, with what is needed to map them.
struct Input {
    name: String,
    rig: Rig,
    params: PipelineParams,
    total: Option<u64>,
    captures: Box<dyn Captures>,
    /// Whether a finder took captures; a recording of another robot may hold ultrasonic ranges alone.
    has_finder: bool,
    is_recording: bool,
}

/// A stream of captures that counts what it could not read.
trait Captures {
    fn next(&mut self) -> Result<Option<Next>>;
    fn dropped(&self) -> Dropped;
    /// What people should know of that.
    fn complaints(&self) -> Vec<String>;
}

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    let mut input = open(&options)?;
    let same = |a: &Path, b: &Path| a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b));
    let from = if input.is_recording { options.input.parent().unwrap_or(Path::new(".")) } else { &options.input };
    if options.output.out.as_deref().is_some_and(|out| same(out, from)) {
        let expected = "another directory than the input's, whose files would be replaced";
        return Err(Fault::new("--out", from.display(), expected));
    }
    let pipeline = Pipeline::new(input.rig.clone(), input.params.clone())?;
    let mut opened = options.output.open(&format!("{}-map", input.name), !input.is_recording)?;
    opened.announce();
    let mut begin = start(&input.name, &input.rig);
    begin.has_finder = input.has_finder;
    begin.attachments = vec![
        ("rig.toml".into(), "application/toml".into(), rig_file::to_toml(&input.rig).into_bytes()),
        ("pipeline.toml".into(), "application/toml".into(), input.params.to_toml()?.into_bytes()),
    ];
    let mut session = Session::begin(pipeline, begin, opened.take_sinks(), input.total)?;
    let result = map_all(&mut session, input.captures.as_mut());
    session.dropped.merge(&input.captures.dropped());
    let failed = session.finish();
    result?;
    for complaint in input.captures.complaints() {
        eprintln!("metromap: {complaint}");
    }
    if session.captures == 0 && session.pipeline.maps().ultrasonic().readings() == 0 && !stop_requested() {
        let found = format!("none that could be read; dropped: {:?}", session.dropped.0);
        return Err(Fault::new("captures", found, "at least one").in_file(&options.input));
    }
    let mut files = opened.export(session.pipeline.maps())?;
    if let Some(layers) = session.pipeline.maps().layers() {
        files.push(opened.picture(&layers, None)?);
    }
    let summary = Summary::of(&session, None, None, files);
    opened.close(&summary, options.output.json, &failed, &session)
}

fn map_all(session: &mut Session, captures: &mut dyn Captures) -> Result<()> {
    while !stop_requested() {
        let Some(next) = captures.next()? else { break };
        let capture = match next {
            Next::Capture(capture) => capture,
            Next::Range(reading) => {
                session.hear(&reading, None);
                continue;
            }
        };
        if let Some(step) = session.step(&capture) {
            session.show(&step, &capture.reading, None);
        }
        session.progress(session.captures, "mapping");
    }
    Ok(())
}

fn open(options: &Options) -> Result<Input> {
    let kind = std::fs::metadata(&options.input).map_err(|e| Fault::io(&options.input, &e))?;
    if kind.is_dir() { open_folder(options) } else { open_recording(options) }
}

fn open_recording(options: &Options) -> Result<Input> {
    let replay = Replay::open(&options.input, options.from == From::Images)?;
    let attached = |name: &str| -> Result<Option<String>> {
        let Some(bytes) = replay.attachment(name) else { return Ok(None) };
        let wrong =
            |_| Fault::new(format!("attachment {name}"), "bytes that are not UTF-8", "UTF-8").in_file(&options.input);
        String::from_utf8(bytes.to_vec()).map(Some).map_err(wrong)
    };
    let rig = match (&options.rig, attached("rig.toml")?) {
        (Some(path), _) => rig_file::load(path)?.rig,
        (None, Some(text)) => rig_file::parse(&text, &options.input)?.rig,
        (None, None) if !replay.has_captures() => Rig::metro_i(), // stands there, and sees nothing
        (None, None) => {
            let expected = "the attachment rig.toml, or --rig FILE";
            return Err(Fault::new("finder", "none in the recording", expected).in_file(&options.input));
        }
    };
    let params = match attached("pipeline.toml")? {
        Some(text) => PipelineParams::from_toml(&text).map_err(|f| f.in_file(&options.input))?,
        None => PipelineParams::default(),
    };
    let stem = |p: &Path| p.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_else(|| "recording".into());
    // out/lab/recording.mcap is the lab's.
    let name = match stem(&options.input).as_str() {
        "recording" => options.input.canonicalize().ok().and_then(|p| p.parent().map(stem)),
        other => Some(other.to_string()),
    };
    let name = name.unwrap_or_else(|| "recording".into());
    let (has_finder, total) = (replay.has_captures(), replay.captures_expected().filter(|total| *total > 0));
    Ok(Input { name, rig, params, total, captures: Box::new(replay), has_finder, is_recording: true })
}

fn open_folder(options: &Options) -> Result<Input> {
    let rig_path = options.rig.clone().unwrap_or_else(|| options.input.join("rig.toml"));
    let file = rig_file::load(&rig_path)?;
    let params = PipelineParams { line: file.line, maps: file.maps, drift: file.drift };
    let folder = ImageFolder::open(&options.input, &file)?;
    let name = options.input.canonicalize().ok().and_then(|p| p.file_name().map(|n| n.to_string_lossy().into_owned()));
    Ok(Input {
        name: name.unwrap_or_else(|| "images".into()),
        rig: file.rig,
        params,
        total: Some(folder.len() as u64),
        captures: Box::new(folder),
        has_finder: true,
        is_recording: false,
    })
}

impl Captures for Replay {
    fn next(&mut self) -> Result<Option<Next>> {
        self.next_input()
    }
    fn dropped(&self) -> Dropped {
        self.dropped()
    }
    fn complaints(&self) -> Vec<String> {
        let told = |count: u64, what: &str| (count > 0).then(|| format!("{count} {what}"));
        let images = told(self.without_image(), "captures were recorded without their image, and are not mapped");
        let infrared = told(self.other_ranges(), "ranges are infrared, not ultrasonic, and are not mapped");
        images.into_iter().chain(infrared).collect()
    }
}

impl Captures for ImageFolder {
    fn next(&mut self) -> Result<Option<Next>> {
        Ok(self.next_capture()?.map(|capture| Next::Capture(Box::new(capture))))
    }
    fn dropped(&self) -> Dropped {
        self.dropped().clone()
    }
    fn complaints(&self) -> Vec<String> {
        self.faults().iter().map(ToString::to_string).collect()
    }
}
