//! The geometry of light: camera, laser sheet, and the point where a line of sight meets the sheet.
//!
//! Simulation and extraction both stand on this module, so a mistake here would cancel: its tests compare with numbers
//! from outside (the oracle of the paper's own constants), never only with itself.

mod camera;
mod lens;
mod parameters;
mod rig;
mod sheet;
mod triangulate;

pub use camera::{Camera, Distortion};
pub use lens::{Fan, INDEX, LensPair, SlitOptics, gap_mm, radius_mm};
pub use parameters::RigCovariance;
pub use rig::{Axis, Laser, MirrorLaser, PlaneLaser, Rig};
pub use sheet::{LaserPlane, Sheet};
pub use triangulate::{PaperGeometry, Sighting, Uncertainty, place, triangulate};
