//! Where results go: viewer, recording, files. A sink may be slow or fail without changing any result.

pub mod export;
pub mod mcap;
pub mod rerun;

use std::sync::Arc;

use crate::fault::Result;
use crate::geometry::{Robot, Transform, World};
use crate::image::{Dropped, Image};
use crate::maps::MapChanges;
use crate::optics::Rig;
use crate::pipeline::Step;
use crate::time::Stamp;
use crate::world::Mesh;

/// What is known before the first capture.
#[derive(Clone, Debug)]
pub struct Start {
    /// Name of the scenario or recording.
    pub name: String,
    /// The finder.
    pub rig: Rig,
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

/// One step for the sinks.
#[derive(Clone, Debug)]
pub struct Frame {
    /// The step.
    pub step: Arc<Step>,
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

/// Somewhere results go.
pub trait Sink: Send {
    /// Called once, first.
    fn begin(&mut self, start: &Start) -> Result<()>;
    /// Called for every capture, in order.
    fn step(&mut self, frame: &Frame) -> Result<()>;
    /// Called once, last, also after Ctrl-C: everything must be on disk when it returns.
    fn finish(&mut self, at: Stamp) -> Result<()>;
}
