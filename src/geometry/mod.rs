//! Points, poses and planes that know their frame, and least-squares fits.

mod fit;
mod frame;
mod plane;

pub use fit::{LineFit, PlaneFit, fit_line, fit_plane};
pub use frame::{Camera, Frame, Odom, Point, Robot, Sensor, Transducer, Transform, World};
pub use plane::Plane;
