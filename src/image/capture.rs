//! One reading of the instrument, whether simulated, recorded or live.

use super::{Image, Line};
use crate::geometry::{Odom, Robot, Transform};
use crate::time::Stamp;

/// What the camera gave.
#[derive(Clone, Debug, PartialEq)]
pub enum Reading {
    /// The image itself.
    Image(Image),
    /// The line that was found in it before.
    Line(Line),
}

/// One exposure with all that is needed to map it. Truth travels beside it, never in it.
#[derive(Clone, Debug, PartialEq)]
pub struct Capture {
    /// Number of the exposure, from 0.
    pub id: u64,
    /// Middle of the exposure.
    pub stamp: Stamp,
    /// Cylinder encoder: θR [pulses].
    pub cylinder_pulse: i32,
    /// Mirror encoder: θB [pulses].
    pub mirror_pulse: i32,
    /// Where the robot was at `stamp`, as its odometry has it (interpolated along the arc between two readings).
    pub odom_from_robot: Transform<Odom, Robot>,
    /// The image or the line.
    pub reading: Reading,
}
