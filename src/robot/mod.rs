//! The robot: its numbers, how its motors move it, and what its wheels let it know about that.

mod drive;
mod metro;
mod odometry;

pub use drive::{BodyCommand, Drive, DriveLimits, Mode, Synchro, WheelMotion};
pub use metro::{DriveKind, RobotParams, StartParams};
pub use odometry::{Odometry, OdometryParams, normal};
