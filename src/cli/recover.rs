//! `metromap recover`: a whole recording out of one that was cut off or damaged.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::json;

use super::Exit;
use super::tell::{answer, tell};
use crate::fault::Result;
use crate::record::bag::{Recovered, recover};

/// Make a cut-off recording whole again: any MCAP file, never changed itself.
#[derive(Args, Clone, Debug)]
#[command(
    after_long_help = "With --json, one object: {\"input\",\"output\",\"whole\",\"messages\",\"chunks\",\"attachments\",\
    \"metadata\",\"lost\":{\"cut_off\",\"chunks\",\"records\",\"messages\":{topic:count},\"bytes\"}}. messages, attachments and \
    metadata were written, chunks were read whole; lost counts damaged chunks, the messages their indexes name, other damaged \
    records, and the bytes of all these; cut_off says that the file has no end. Exit code 3 if the file was not whole."
)]
pub struct Options {
    /// The recording (.mcap)
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Where the whole one goes; a file that exists is not overwritten [default: NAME.recovered.mcap beside FILE]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Print one JSON object on stdout instead of a summary on stderr
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    let output = options.out.unwrap_or_else(|| beside(&options.file));
    let recovered = recover(&options.file, &output)?;
    if options.json {
        answer(&object(&options.file, &output, &recovered))?;
    } else {
        tell!("{}", text(&output, &recovered).trim_end());
    }
    Ok(if recovered.losses.is_none() { Exit::Done } else { Exit::Lossy })
}

/// NAME.recovered.mcap in the same folder.
fn beside(file: &Path) -> PathBuf {
    let mut name = file.file_stem().map_or_else(|| OsString::from("recording"), OsString::from);
    name.push(".recovered.mcap");
    file.with_file_name(name)
}

fn object(input: &Path, output: &Path, recovered: &Recovered) -> serde_json::Value {
    json!({
        "input": input.display().to_string(),
        "output": output.display().to_string(),
        "whole": recovered.losses.is_none(),
        "messages": recovered.messages,
        "chunks": recovered.chunks,
        "attachments": recovered.attachments,
        "metadata": recovered.metadata,
        "lost": recovered.losses,
    })
}

fn text(output: &Path, recovered: &Recovered) -> String {
    let Recovered { messages, attachments, losses, .. } = recovered;
    let mut text = format!("{messages} messages and {attachments} attachments written to {}\n", output.display());
    if losses.is_none() {
        text.push_str("nothing lost: the file was whole\n");
    } else {
        let end = if losses.cut_off { "the file was cut off; " } else { "" };
        let (chunks, records, bytes) = (losses.chunks, losses.records, losses.bytes);
        text.push_str(&format!("{end}lost: {chunks} chunks and {records} records, {bytes} bytes\n"));
        for (topic, count) in &losses.messages {
            text.push_str(&format!("  {topic}: {count} messages\n"));
        }
    }
    text.push_str(&format!("map it: metromap map {}\n", output.display()));
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_whole_file_is_named_after_the_cut_one() {
        assert_eq!(beside(Path::new("a/b.c.mcap")), Path::new("a/b.c.recovered.mcap"));
        assert_eq!(beside(Path::new("run")), Path::new("run.recovered.mcap"));
    }

    #[test]
    fn what_is_no_recording_is_refused_and_leaves_no_file() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("notes.txt");
        std::fs::write(&file, "no MCAP").unwrap();
        let options = Options { file: file.clone(), out: None, json: false };
        let fault = run(options).unwrap_err().to_string();
        assert!(fault.contains("notes.txt") && fault.contains("MCAP"), "{fault}");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
        assert!(run(Options { file: dir.path().join("absent"), out: None, json: false }).is_err());
    }
}
