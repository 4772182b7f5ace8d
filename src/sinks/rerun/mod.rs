//! The sink that draws: Rerun, as a file, to a viewer that runs already, or to the embedded web viewer.
//!
//! Files hold no wall-clock time: every row is on `sim_time` and `scan`. What is drawn where:
//!
//! ```text
//! /world/scene/NAME          the true bodies (simulation only)
//! /world/robot/...           body, finder with camera frustum, sheet of laser light
//! /world/profile             the points of this capture
//! /world/points              all points up to now, coloured by height
//! /world/occupancy/I_J_K     occupied voxels of a block, coloured by height
//! /world/terrain/I_J         a tile of the terrain mesh, coloured by height
//! /path/{estimated,true}     where the robot went
//! /plan                      the plan view
//! /camera/image, image/line  the capture and the line found in it
//! /metrics/..., /log, /about
//! ```

mod blueprint;
mod draw;
mod maps;
mod scene;
mod serve;

use std::path::{Path, PathBuf};
use std::time::Duration;

use nalgebra::Vector3;
use rerun::external::re_uri::ProxyUri;
use rerun::sink::{FileSink, FileSinkError, GrpcSink, LogSink};
use rerun::{AsComponents, EntityPath, EntityPathPart, RecordingStream, RecordingStreamBuilder, TimeCell};
use sha2::{Digest, Sha256};

use self::draw::{Drawing, HeightColours};
use self::serve::Web;
use super::{Frame, Sink, Start};
use crate::fault::{Fault, Result};
use crate::time::Stamp;

pub use self::serve::{FileServer, check_file};

/// The name under which viewers keep the layout.
const APPLICATION: &str = "metromap";

/// Stamps beyond this are since the Unix epoch (2001), not since the start of a run.
const EPOCH_NS_MIN: i64 = 1_000_000_000_000_000_000;

/// How long to wait for a viewer to take what is left.
const FLUSH_S_MAX: u64 = 60;

/// Where the drawing goes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Target {
    /// To an `.rrd` file.
    Save(PathBuf),
    /// To a viewer or server that listens at `rerun+http://HOST:PORT/proxy`.
    Connect(String),
    /// To the embedded web viewer, served on 127.0.0.1.
    Web {
        /// Port of the page; 0 takes a free one.
        port: u16,
    },
}

/// Draws every step for Rerun.
pub struct RerunSink {
    sinks: Vec<Box<dyn LogSink>>,
    files: Vec<PathBuf>,
    live: bool,
    web: Option<Web>,
    run: Option<Run>,
}

/// What exists between `begin` and `finish`.
struct Run {
    out: Out,
    drawing: Drawing,
    begun: bool,
}

/// A recording stream whose errors name the entity.
struct Out(RecordingStream);

impl Out {
    fn log(&self, entity: impl Into<EntityPath>, what: &dyn AsComponents) -> Result<()> {
        let entity = entity.into();
        self.0.log(entity.clone(), what).map_err(|e| refused(&entity, &e))
    }

    fn log_static(&self, entity: impl Into<EntityPath>, what: &dyn AsComponents) -> Result<()> {
        let entity = entity.into();
        self.0.log_static(entity.clone(), what).map_err(|e| refused(&entity, &e))
    }
}

fn refused(entity: &EntityPath, error: &dyn std::fmt::Display) -> Fault {
    Fault::new(format!("drawing {entity}"), error, "data the viewer takes")
}

/// An entity path of parts that may hold any character.
fn entity(parts: &[&str]) -> EntityPath {
    EntityPath::new(parts.iter().map(|part| EntityPathPart::new(*part)).collect())
}

/// The viewer works in single precision.
fn f32s(v: &Vector3<f64>) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

impl RerunSink {
    /// Opens the targets; several at once are fine, and all get the same.
    ///
    /// Errors: a file that cannot be created, a malformed or silent URL, a port that is taken.
    pub fn new(targets: &[Target]) -> Result<Self> {
        let mut this = Self { sinks: vec![], files: vec![], live: false, web: None, run: None };
        for target in targets {
            match target {
                Target::Save(file) => {
                    this.sinks.push(Box::new(FileSink::new(file).map_err(|e| cannot_create(file, e))?));
                    this.files.push(file.clone());
                }
                Target::Connect(url) => {
                    this.sinks.push(Box::new(connect(url)?));
                    this.live = true;
                }
                Target::Web { port } => {
                    let (web, sink) = Web::start(*port)?;
                    this.sinks.push(Box::new(sink));
                    this.web = Some(web);
                    this.live = true;
                }
            }
        }
        Ok(this)
    }

    /// Where to point a browser, if there is a web target. The page is served until the sink is dropped.
    pub fn url(&self) -> Option<&str> {
        self.web.as_ref().map(Web::url)
    }
}

impl Sink for RerunSink {
    fn begin(&mut self, start: &Start) -> Result<()> {
        let rejected = |e: rerun::RecordingStreamError| Fault::new("viewer", e, "a working Rerun stream");
        let mut builder = RecordingStreamBuilder::new(APPLICATION).enabled(true);
        if !self.live {
            // A live viewer would mix two runs under one id; a file of the same run is always the same recording.
            builder = builder.recording_id(recording_id(start));
        }
        let stream = builder.send_properties(false).set_sinks(std::mem::take(&mut self.sinks)).map_err(rejected)?;
        stream.set_log_tick_enabled(false);
        stream.set_log_time_enabled(false);
        stream.send_recording_name(start.name.clone()).map_err(rejected)?;
        let out = Out(stream);
        let colours = HeightColours::new(start.rig.range_m_max);
        scene::draw_start(&out, start, &colours)?;
        self.run = Some(Run { out, drawing: Drawing::new(start, colours), begun: false });
        Ok(())
    }

    fn step(&mut self, frame: &Frame) -> Result<()> {
        let Some(run) = self.run.as_mut() else {
            return Err(Fault::new("drawing a step", "no begin before it", "begin, step, finish"));
        };
        let at = frame.step.stamp.0;
        let time = if at < EPOCH_NS_MIN {
            TimeCell::from_duration_nanos(at)
        } else {
            TimeCell::from_timestamp_nanos_since_epoch(at)
        };
        run.out.0.set_time("sim_time", time);
        run.out.0.set_time("scan", TimeCell::from_sequence(i64::try_from(frame.step.id).unwrap_or(i64::MAX)));
        if !run.begun {
            run.begun = true;
            run.drawing.send_blueprint(&run.out)?;
        }
        run.drawing.step(&run.out, frame)
    }

    fn finish(&mut self, _at: Stamp) -> Result<()> {
        let Some(run) = self.run.as_mut() else { return Ok(()) };
        if !self.live {
            // Now it is known what there is to frame; a live viewer keeps the eye its user has turned by then.
            run.drawing.send_blueprint(&run.out)?;
        }
        let unfinished = |e: rerun::sink::SinkFlushError| {
            let what = self.files.first().map_or("viewer".into(), |file| file.display().to_string());
            Fault::new(what, e, "room on the disk, and a viewer that still listens")
        };
        run.out.0.flush_with_timeout(Duration::from_secs(FLUSH_S_MAX)).map_err(unfinished)?;
        run.out.0.finalize_deferred_sinks();
        self.files.iter().try_for_each(|file| check_file(file))
    }
}

/// The same run has the same id, whenever and wherever it is drawn.
fn recording_id(start: &Start) -> String {
    let mut hash = Sha256::new();
    hash.update(start.name.as_bytes());
    for (key, value) in &start.metadata {
        hash.update(format!("\n{key}={value}"));
    }
    for (name, _, bytes) in &start.attachments {
        hash.update(format!("\n{name}:{}:", bytes.len()));
        hash.update(bytes);
    }
    hash.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect()
}

fn cannot_create(file: &Path, error: FileSinkError) -> Fault {
    match error {
        FileSinkError::CreateFile { source, .. } => Fault::io(file, &source),
        other => Fault::new("file", other, "a file that can be written").in_file(file),
    }
}

/// A sink to a running viewer. It is asked once whether it is there, since Rerun itself would go on trying for ever.
fn connect(url: &str) -> Result<GrpcSink> {
    let expected = "rerun+http://HOST:PORT/proxy";
    let uri: ProxyUri = url.parse().map_err(|_| Fault::new("--connect", url, expected))?;
    let (host, port) = (uri.origin.host.to_string(), uri.origin.port);
    let host = host.trim_start_matches('[').trim_end_matches(']');
    let addresses = std::net::ToSocketAddrs::to_socket_addrs(&(host, port));
    let addresses = addresses.map_err(|e| Fault::new("--connect", format!("{url} ({e})"), expected))?;
    let mut error = "no address".to_string();
    for address in addresses {
        match std::net::TcpStream::connect_timeout(&address, Duration::from_secs(3)) {
            Ok(_) => return Ok(GrpcSink::new(uri)),
            Err(e) => error = e.to_string(),
        }
    }
    Err(Fault::new("--connect", format!("{url} ({error})"), "a viewer that listens there"))
}
