//! Parse, run, exit code.

use std::process::ExitCode;

use clap::Parser;
use metromap::cli::{Cli, Exit, run};

fn main() -> ExitCode {
    match run(Cli::parse()) {
        Ok(Exit::Done) => ExitCode::SUCCESS,
        Ok(Exit::Lossy) => ExitCode::from(3),
        Ok(Exit::NotAccepted) => ExitCode::from(4),
        Err(fault) => {
            eprintln!("metromap: {fault}");
            ExitCode::FAILURE
        }
    }
}
