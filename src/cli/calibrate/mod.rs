//! `metromap calibrate`: from measurements to a calibrated instrument, with error bars.

pub mod camera;
pub mod finder;
pub mod plane;
mod shared;

use clap::Subcommand;

use super::Exit;
use crate::fault::Result;

/// What to calibrate.
#[derive(Clone, Debug, Subcommand)]
pub enum Command {
    /// A camera, from images of a chessboard or of dots, or from a file of points.
    Camera(camera::Options),
    /// The laser plane of any camera with a laser, from its stripe on chessboards.
    Plane(plane::Options),
    /// Mirror, camera and encoders of a finder, from slits on floor and walls.
    Finder(finder::Options),
}

/// Runs the command.
pub fn run(command: Command) -> Result<Exit> {
    match command {
        Command::Camera(options) => camera::run(options),
        Command::Plane(options) => plane::run(options),
        Command::Finder(options) => finder::run(options),
    }
}
