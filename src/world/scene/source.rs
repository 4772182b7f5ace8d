//! The text a scenario comes from: its lines, and errors that name them.

use std::ops::Range;
use std::path::{Path, PathBuf};

use toml::de::{DeTable, DeValue};

use super::super::mesh;
use crate::fault::{Fault, Result};

/// The largest scenario that is read (bytes).
const SCENARIO_BYTES_MAX: u64 = 16 << 20;

/// Where a scenario comes from: to name lines in errors, and to find files beside it.
#[derive(Clone, Debug)]
pub struct Source {
    /// The scenario file, as the user named it. Relative paths in it start in its folder.
    pub file: PathBuf,
    /// Its text.
    pub text: String,
    /// More folders in which SDF's `model://` is looked up.
    pub model_path: Vec<PathBuf>,
}

impl Source {
    /// Reads a scenario's text.
    ///
    /// # Errors
    /// A file that cannot be read, is larger than 16 MB, or is not UTF-8.
    pub fn read(file: &Path, model_path: &[PathBuf]) -> Result<Self> {
        let bytes = mesh::read_bounded(file, SCENARIO_BYTES_MAX)?;
        let text = mesh::utf8(&bytes).map_err(|fault| fault.in_file(file))?.to_string();
        Ok(Self { file: file.to_path_buf(), text, model_path: model_path.to_vec() })
    }

    /// The line, from 1, in which the byte at this offset stands.
    pub fn line_of(&self, byte_offset: usize) -> usize {
        let before = self.text.as_bytes().iter().take(byte_offset);
        1 + before.filter(|byte| **byte == b'\n').count()
    }

    /// The line, from 1, of a key by its dotted path, such as `sonar.air.temperature_k`; of the table it would stand in, if it
    /// is not there; `None` if there is nothing of the path.
    pub fn line_of_key(&self, path: &str) -> Option<usize> {
        let document = DeTable::parse(&self.text).ok()?;
        let (mut table, mut at) = (document.get_ref(), None);
        for name in path.split('.') {
            let Some((key, value)) = table.iter().find(|(key, _)| key.get_ref() == name) else { break };
            at = Some(key.span().start);
            match value.get_ref() {
                DeValue::Table(inner) => table = inner,
                _ => break,
            }
        }
        at.map(|offset| self.line_of(offset))
    }

    /// A path of the scenario, from its folder.
    pub(super) fn beside(&self, path: &str) -> PathBuf {
        self.file.parent().unwrap_or(Path::new("")).join(path)
    }

    /// Names the file and the line of `span`, unless an inner layer already named a file.
    pub(super) fn locate(&self, fault: Fault, span: &Range<usize>) -> Fault {
        match fault.file {
            Some(_) => fault,
            None => fault.at_line(self.line_of(span.start)).in_file(&self.file),
        }
    }

    /// The key that the line of this offset sets, if it sets one.
    fn key_at(&self, byte_offset: usize) -> Option<String> {
        let line = self.text.lines().nth(self.line_of(byte_offset) - 1)?;
        let key = line.split_once('=')?.0.trim();
        let is_key = !key.is_empty() && key.chars().all(|c| c.is_alphanumeric() || "_-.\"'".contains(c));
        is_key.then(|| key.to_string())
    }
}

/// Turns an error of the TOML reader, syntax or type, into a fault with file, line, found and expected.
pub fn toml_fault(source: &Source, error: &toml::de::Error) -> Fault {
    let message = error.message().lines().collect::<Vec<_>>().join(", ");
    let span = error.span();
    let key = || span.as_ref().and_then(|span| source.key_at(span.start));
    let (head, expected) = message.split_once(", expected ").unwrap_or((&message, ""));
    let quoted = |prefix: &str| head.strip_prefix(prefix).map(|rest| rest.trim_matches('`').to_string());
    let or = |text: &str, default: &str| if text.is_empty() { default.to_string() } else { text.to_string() };
    let fault = if let Some(name) = quoted("unknown field ") {
        Fault::new(format!("key `{name}`"), "a key that is not known here", or(expected, "no key"))
    } else if let Some(name) = quoted("unknown variant ") {
        Fault::new(key().unwrap_or("value".into()), format!("`{name}`"), or(expected, "another value"))
    } else if let Some(name) = quoted("missing field ") {
        Fault::new(format!("key `{name}`"), "no such key", "a value for it")
    } else if let Some((_, found)) = head.split_once(": ").filter(|(kind, _)| kind.starts_with("invalid ")) {
        Fault::new(key().unwrap_or("value".into()), found, or(expected, "another value"))
    } else if let Some(found) = head.strip_prefix("invalid length ") {
        Fault::new(key().unwrap_or("value".into()), format!("{found} elements"), or(expected, "another number of them"))
    } else {
        Fault::new(key().unwrap_or("TOML".into()), head, or(expected, "valid TOML"))
    };
    let fault = match span {
        Some(span) => fault.at_line(source.line_of(span.start)),
        None => fault,
    };
    fault.in_file(&source.file)
}
