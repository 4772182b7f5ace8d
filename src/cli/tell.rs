//! How commands speak: to people on stderr, to programs on stdout. Where results go.

use std::fmt::Display;
use std::io::{ErrorKind, Write, stdout};
use std::path::Path;

use crate::fault::{Fault, Result};

/// A line for people, on stderr. That nobody reads it any more is no error.
macro_rules! tell {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stderr(), $($text)*);
    }};
}
pub(crate) use tell;

/// A line for programs, on stdout. Whoever read and left has seen enough; a full disk is an error.
pub fn answer(value: &impl Display) -> Result<()> {
    let mut out = stdout().lock();
    match writeln!(out, "{value}").and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(Fault::io("standard output", &error)),
        _ => Ok(()),
    }
}

/// Makes the directory of `--out`, before anything long begins.
pub fn make_out(dir: &Path) -> Result<()> {
    let wrong = |error: std::io::Error| {
        Fault::new("--out", error, "a directory that exists or can be made, and can be written to").in_file(dir)
    };
    std::fs::create_dir_all(dir).map_err(wrong)?;
    tempfile_in(dir).map_err(wrong)
}

/// Whether a file can be made there.
fn tempfile_in(dir: &Path) -> std::io::Result<()> {
    let probe = dir.join(format!(".metromap-{}", std::process::id()));
    std::fs::File::create(&probe)?;
    std::fs::remove_file(&probe)
}
