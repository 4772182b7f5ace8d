//! The command line: one file a command. People read stderr, programs read stdout.

pub mod extract;
pub mod map;
mod output;
pub mod recover;
pub mod run;
mod session;
mod summary;
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
}

/// Maps for mobile robots from a laser-slit range finder: simulated, recorded or real.
#[derive(Debug, Parser)]
#[command(
    version,
    about,
    after_help = "Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done but data was lost (and counted).\n\
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
        Command::Recover(options) => recover::run(options),
    }
}
