//! Where captures come from: simulation, recordings, folders of images.

mod files;
mod image_poses;
pub mod images;
pub mod replay;
pub mod rig_file;
mod scenario;
mod simulation;
mod truth;

pub use scenario::Scenario;
pub use simulation::{Shot, ShotTruth, Simulation};
pub use truth::{Found, Judge, Verdict};
