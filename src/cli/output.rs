//! Where `run` and `map` put their results: options, sinks, exports.

use std::io::Write;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::Exit;
use super::session::{Session, stop_requested};
use super::summary::Summary;
use crate::fault::{Fault, Result};
use crate::maps::{Layers, Maps, PlanView};
use crate::sinks::export;
use crate::sinks::mcap::{Images, McapSink};
use crate::sinks::rerun::{RerunSink, Target};
use crate::sinks::{Sink, Start};

/// Which images a recording keeps. The line of every capture is always kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum KeepImages {
    /// None.
    None,
    /// One a second.
    #[default]
    Keyframes,
    /// Every one, lossless.
    All,
}

/// Where results go.
#[derive(Args, Clone, Debug, Default)]
pub struct Output {
    /// Directory for all results [default: out/NAME]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Print one JSON object on stdout instead of a summary on stderr
    #[arg(long)]
    pub json: bool,
    /// Show the run live in the embedded viewer, on this machine only
    #[arg(long)]
    pub web: bool,
    /// Port of the embedded viewer
    #[arg(long, value_name = "PORT", default_value_t = 9090, requires = "web")]
    pub port: u16,
    /// Send the run live to a viewer, such as rerun+http://127.0.0.1:9876/proxy
    #[arg(long, value_name = "URL")]
    pub connect: Option<String>,
    /// Write view.rrd for the viewer (the default, unless --web or --connect is given)
    #[arg(long)]
    pub save: bool,
    /// Images kept in the recording (which `map` makes of a folder of images only)
    #[arg(long, value_enum, default_value_t, value_name = "WHICH")]
    pub images: KeepImages,
}

/// A directory with sinks that write into it.
pub struct Opened {
    /// The directory.
    pub dir: PathBuf,
    /// The sinks.
    pub sinks: Vec<Box<dyn Sink>>,
    /// The address of the live viewer.
    pub live: Option<String>,
    /// The file for the viewer.
    view: Option<PathBuf>,
    files: Vec<PathBuf>,
}

impl Output {
    /// Makes the directory and the sinks.
    pub fn open(&self, name: &str, record: bool) -> Result<Opened> {
        let dir = self.out.clone().unwrap_or_else(|| Path::new("out").join(name));
        std::fs::create_dir_all(&dir)
            .map_err(|e| Fault::new("--out", e, "a directory that exists or can be made").in_file(&dir))?;
        let (mut targets, mut view) = (Vec::new(), None);
        if self.web {
            targets.push(Target::Web { port: self.port });
        }
        if let Some(url) = &self.connect {
            targets.push(Target::Connect(url.clone()));
        }
        if self.save || targets.is_empty() {
            let path = dir.join("view.rrd");
            targets.push(Target::Save(path.clone()));
            view = Some(path);
        }
        // What can be refused (a taken port, a viewer that is not there) comes before any file is replaced.
        let viewer = RerunSink::new(&targets)?;
        let live = viewer.url().map(String::from);
        let mut sinks: Vec<Box<dyn Sink>> = Vec::new();
        let mut files = Vec::new();
        if record {
            let path = dir.join("recording.mcap");
            let images = match self.images {
                KeepImages::None => Images::None,
                KeepImages::Keyframes => Images::Keyframes,
                KeepImages::All => Images::All,
            };
            sinks.push(Box::new(McapSink::create(&path, images)?));
            files.push(path);
        }
        sinks.push(Box::new(viewer));
        files.extend(view.clone());
        Ok(Opened { dir, sinks, live, view, files })
    }
}

impl Opened {
    /// Says where the live viewer is.
    pub fn announce(&self) {
        if let Some(url) = &self.live {
            eprintln!("live: open {url}");
        }
    }

    /// Says how it went, on stdout or stderr, keeps a live viewer up until Ctrl-C, and gives the exit code.
    pub fn close(&self, summary: &Summary, json: bool, failed: &[Fault], session: &Session) -> Result<Exit> {
        summary.save(&self.dir)?;
        if json {
            // A reader that has gone away is no error.
            let _ = writeln!(std::io::stdout(), "{}", summary.json());
        } else {
            eprint!("{}", summary.text());
            if let Some(view) = &self.view {
                eprintln!("look at it: metromap view {}", view.display());
            }
        }
        for fault in failed {
            eprintln!("metromap: {fault}");
        }
        self.stay_open(session);
        let lossy = !failed.is_empty() || summary.dropped.lost() > 0;
        Ok(if lossy { Exit::Lossy } else { Exit::Done })
    }

    /// Keeps a live viewer up until Ctrl-C.
    fn stay_open(&self, session: &Session) {
        let Some(url) = &self.live else { return };
        session.hide_progress();
        eprintln!("the viewer stays at {url} until Ctrl-C");
        while !stop_requested() {
            std::thread::sleep(std::time::Duration::from_millis(100));
        }
    }

    /// Takes the sinks into a session.
    pub fn take_sinks(&mut self) -> Vec<Box<dyn Sink>> {
        std::mem::take(&mut self.sinks)
    }

    /// Draws laser, ultrasonic and fused layer side by side; returns the file.
    pub fn picture(&self, layers: &Layers, truth: Option<&PlanView>) -> Result<String> {
        let name = export::layers_png(&self.dir, layers, truth)?;
        Ok(self.dir.join(name).display().to_string())
    }

    /// Writes the maps; returns all files of the directory.
    pub fn export(&self, maps: &Maps) -> Result<Vec<String>> {
        let mut files: Vec<String> = self.files.iter().map(|f| f.display().to_string()).collect();
        let exported = export::export(&self.dir, maps)?;
        files.extend(exported.iter().map(|name| self.dir.join(name).display().to_string()));
        Ok(files)
    }
}

/// What every session starts with.
pub fn start(session_name: &str, rig: &crate::optics::Rig) -> Start {
    Start {
        name: session_name.to_string(),
        rig: rig.clone(),
        has_finder: true,
        transducers: Vec::new(),
        scene: Vec::new(),
        attachments: Vec::new(),
        metadata: vec![("metromap_version".into(), env!("CARGO_PKG_VERSION").into())],
    }
}
