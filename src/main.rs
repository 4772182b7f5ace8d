//! Parse, run, exit code.

use std::io::Write;
use std::process::ExitCode;

use clap::Parser;
use metromap::cli::{Cli, Exit, run};

fn main() -> ExitCode {
    match run(Cli::parse()) {
        Ok(Exit::Done) => ExitCode::SUCCESS,
        Ok(Exit::Lossy) => ExitCode::from(3),
        Ok(Exit::NotAccepted) => ExitCode::from(4),
        Err(fault) => {
            // That nobody reads it any more is no further error.
            let _ = writeln!(std::io::stderr(), "metromap: {fault}");
            ExitCode::FAILURE
        }
    }
}
