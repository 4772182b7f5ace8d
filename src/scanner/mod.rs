//! The simulated finder: what its camera sees of the laser line in a world.

mod blooming;
mod camera;
mod noise;
mod render;
mod sweep;

pub use camera::ImageParams;
pub use render::{Exposure, Moment, Movement, Renderer, TrueSight};
pub use sweep::{Head, Schedule, Servo, ServoParams, Shot, Stop, Sweep, SweepParams, Trigger};
