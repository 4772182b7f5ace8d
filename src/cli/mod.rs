//! The command line: one file a command. People read stderr, programs read stdout.

pub mod bench;
pub mod calibrate;
pub mod compare;
pub mod design;
pub mod extract;
pub mod gallery;
pub mod map;
mod output;
pub mod recover;
pub mod reproduce;
pub mod run;
mod session;
mod summary;
mod tell;
pub mod view;

use clap::{Parser, Subcommand};

use crate::fault::Result;

/// How a command ended well.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// Done: exit code 0.
    Done,
    /// Done, but data was lost, and counted: exit code 3.
    Lossy,
    /// A calibration was done and its files are written, but it keeps not all its limits: exit code 4.
    NotAccepted,
}

/// Maps for mobile robots from a laser-slit range finder: simulated, recorded or real.
#[derive(Debug, Parser)]
#[command(
    version,
    about,
    after_help = "Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done but data was lost (and counted), 4 calibrated but NOT accepted.\n\
    Without a command: `metromap run worlds/lab.toml`."
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Option<Command>,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Simulate a robot with a finder in a world, and map it.
    Run(run::Options),
    /// Map a recording, or a folder of images with a rig.toml.
    Map(map::Options),
    /// Show a recording in the embedded viewer.
    View(view::Options),
    /// Find the laser line in images.
    Extract(extract::Options),
    /// Calibrate a camera, a laser plane or a whole finder from what was measured.
    #[command(subcommand)]
    Calibrate(calibrate::Command),
    /// Recompute the tables and figures of the paper that this finder comes from.
    Reproduce(reproduce::Options),
    /// What a finder will see, how well and how safely, before you build it.
    Design(Box<design::Options>),
    /// Laser against ultrasonic: many seeds of one scenario, one report.
    Compare(compare::Options),
    /// Take the time of the kernels, beside the peers'.
    Bench(bench::Options),
    /// Draw what each effect in the simulated image does.
    Gallery(gallery::Options),
    /// Make a cut-off recording whole again.
    Recover(recover::Options),
}

/// Does what the command line says.
pub fn run(cli: Cli) -> Result<Exit> {
    match cli.command.unwrap_or_else(|| Command::Run(run::Options::default())) {
        Command::Run(options) => run::run(options),
        Command::Map(options) => map::run(options),
        Command::View(options) => view::run(options),
        Command::Extract(options) => extract::run(options),
        Command::Calibrate(command) => calibrate::run(command),
        Command::Reproduce(options) => reproduce::run(options),
        Command::Compare(options) => compare::run(options),
        Command::Bench(options) => bench::run(options),
        Command::Design(options) => design::run(*options),
        Command::Gallery(options) => gallery::run(options),
        Command::Recover(options) => recover::run(options),
    }
}
