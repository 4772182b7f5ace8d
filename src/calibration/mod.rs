//! From measurements to calibrated instruments, with error bars.
//!
//! | file | what |
//! |---|---|
//! | `solve` | the least-squares solver they all share: covariance, and what the data cannot tell apart |
//! | `points` | point files (`x y z u v`), and the camera as `rig.toml` and ROS `camera_info` |
//! | `params` | what is known before: the chip, what is held |
//! | `tsai` | the linear stage of Tsai's method, flat and solid targets |
//! | `camera` | one view of a dot block: the linear stage, then all parameters at once (19)–(26) |
//! | `views` | many views of a flat board: Zhang's guess, then all parameters at once, Brown–Conrady |
//! | `true_board` | a board that is not quite what its drawing says |
//! | `zhang` | the first guess from homographies |
//! | `dots`, `board` | the images of such targets: centres of dots, corners of chessboards |
//! | `pose` | the pose of a board seen by a known camera |
//! | `hand_eye` | where the camera sits on a robot's arm |
//! | `stripe` | the laser's stripe on a board |
//! | `plane` | the laser's plane from stripes on posed boards, all at once |
//! | `camera_page`, `page` | reports for people, verdicts |
//! | `report` | what a calibration says of itself |
//!
//! A target that cannot give a parameter is refused with the reason; nothing is returned that only looks like a result.

pub mod board;
pub mod camera;
mod camera_page;
pub mod dots;
pub mod finder;
pub mod hand_eye;
mod page;
pub mod params;
pub mod plane;
pub mod points;
pub mod pose;
pub mod report;
pub mod solve;
pub mod stripe;
mod true_board;
pub mod tsai;
mod view_checks;
pub mod views;
mod zhang;

pub use camera_page::CameraLimits;
pub use page::said;

use crate::geometry::Frame;

/// The frame of a calibration target: the block with dots, or the board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Target;

impl Frame for Target {
    const NAME: &'static str = "target";
}
