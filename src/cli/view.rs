//! `metromap view`: a recording in the embedded web viewer, or in the native one.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::mpsc;

use super::Exit;
use super::tell::tell;
use crate::fault::{Fault, Result};
use crate::sinks::rerun::{FileServer, check_file};

/// What `metromap view` is told.
#[derive(Clone, Debug, clap::Args)]
pub struct Options {
    /// The recording: an .rrd or .mcap file
    file: PathBuf,
    /// Port of the page on 127.0.0.1; 0 takes a free one
    #[arg(long, default_value_t = 0)]
    port: u16,
    /// Only print where the page is
    #[arg(long)]
    no_browser: bool,
    /// Open the native viewer: `rerun`, which must be on PATH
    #[arg(long, conflicts_with_all = ["port", "no_browser"])]
    native: bool,
}

/// Shows the recording until Ctrl-C.
///
/// Errors: a file that is missing, empty, damaged, cut off or of another kind; a port that is taken; no native viewer.
pub fn run(options: Options) -> Result<Exit> {
    if options.native {
        check_file(&options.file)?;
        return native(&options.file);
    }
    let server = FileServer::start(&options.file, options.port, !options.no_browser)?;
    let (interrupt, interrupted) = mpsc::channel();
    ctrlc::set_handler(move || interrupt.send(()).unwrap_or_default())
        .map_err(|e| Fault::new("Ctrl-C", e, "a signal that can be handled"))?;
    tell!("open this: {}", server.url());
    tell!("Ctrl-C ends it.");
    interrupted.recv().ok();
    Ok(Exit::Done)
}

fn native(file: &Path) -> Result<Exit> {
    let expected = "the native viewer `rerun` on PATH, or no --native";
    let status = Command::new("rerun").arg(file).status().map_err(|e| Fault::new("--native", e, expected))?;
    if !status.success() {
        return Err(Fault::new("the native viewer", status, "an end without error"));
    }
    Ok(Exit::Done)
}
