//! Where results go: viewer, recording, files. A sink may be slow or fail without changing any result.

pub mod export;
mod layers_png;
pub mod mcap;
pub mod rerun;

use std::sync::Arc;

use crate::fault::Result;
use crate::geometry::{Robot, Transducer, Transform, World};
use crate::image::{Dropped, Image};
use crate::maps::MapChanges;
use crate::optics::Rig;
use crate::pipeline::{RangeStep, Step};
use crate::sonar::Ping;
use crate::time::Stamp;
use crate::world::Mesh;

/// What is known before the first capture.
#[derive(Clone, Debug)]
pub struct Start {
    /// Name of the scenario or recording.
    pub name: String,
    /// The finder.
    pub rig: Rig,
    /// Whether the finder is there: a recording of another robot may hold ultrasonic ranges alone.
    pub has_finder: bool,
    /// Ultrasonic transducers on the robot, where they are known before their first range: frame, and pose.
    pub transducers: Vec<(String, Transform<Robot, Transducer>)>,
    /// Simulated bodies to draw: name, colour (sRGB), triangles in the world at the start.
    pub scene: Vec<(String, [u8; 3], Arc<Mesh>)>,
    /// Files that make the run again: name (such as `scenario.toml`, `rig.toml`), media type, bytes.
    pub attachments: Vec<(String, String, Vec<u8>)>,
    /// Key and value pairs: seed, version.
    pub metadata: Vec<(String, String)>,
}

/// What is true, where a simulation knows it.
#[derive(Clone, Debug)]
pub struct Truth {
    /// Where the robot truly was.
    pub world_from_robot: Transform<World, Robot>,
    /// Moved bodies: index in `Start::scene`, and how far each has moved since the start (world from world).
    pub moved: Vec<(usize, nalgebra::Isometry3<f64>)>,
    /// RMS distance of this capture's points from the truth [m].
    pub point_rms_m: Option<f64>,
}

/// An ultrasonic range for the sinks.
#[derive(Clone, Debug)]
pub struct Ranged {
    /// What it became.
    pub step: RangeStep,
    /// The truth beside it, where a simulation knows it.
    pub ping: Option<Ping>,
}

/// One step for the sinks: ultrasonic ranges, and the capture after them. Without ranges there is always a capture.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Ultrasonic ranges since the capture before, in order.
    pub ranges: Vec<Ranged>,
    /// The step that a capture became; none where there are ranges alone.
    pub step: Option<Arc<Step>>,
    /// The image it came from, where there was one.
    pub image: Option<Arc<Image>>,
    /// The truth beside it.
    pub truth: Option<Truth>,
    /// What changed in the maps; given about once a second of run time, and with the last frame.
    pub maps: Option<Arc<MapChanges>>,
    /// Lines for the log: (level as in `tracing`: "INFO", "WARN", "ERROR", text).
    pub log: Vec<(&'static str, String)>,
    /// All that was dropped up to now.
    pub dropped: Dropped,
}

impl Frame {
    /// The time of its capture, else of its last range.
    pub fn stamp(&self) -> Stamp {
        let heard = || self.ranges.last().map(|range| range.step.reading.stamp);
        self.step.as_ref().map(|step| step.stamp).or_else(heard).unwrap_or_default()
    }
}

/// Somewhere results go.
pub trait Sink: Send {
    /// Called once, first.
    fn begin(&mut self, start: &Start) -> Result<()>;
    /// Called for every capture with the ranges before it, in order.
    fn step(&mut self, frame: &Frame) -> Result<()>;
    /// Called once, last, also after Ctrl-C: everything must be on disk when it returns.
    fn finish(&mut self, at: Stamp) -> Result<()>;
}
