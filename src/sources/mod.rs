//! Where captures come from: simulation, recordings, folders of images.

pub mod arm_poses;
mod files;
mod image_poses;
pub mod images;
pub mod marks;
mod obstacles;
mod plan_truth;
pub mod range_table;
mod recorded_ranges;
pub mod replay;
pub mod rig_file;
mod scenario;
mod simulation;
mod slit_table;
pub mod slits;
mod truth;
mod ultrasound;

pub use obstacles::{CompareParams, Kind, TargetParams};
pub use plan_truth::{LayerVerdict, LayerVerdicts, PlanTruth};
pub use scenario::Scenario;
pub use simulation::{Shot, ShotTruth, Simulation};
pub use truth::{Found, Judge, Verdict};
pub use ultrasound::{Heard, HeardTruth};
