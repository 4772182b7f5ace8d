//! The one error of this crate: what was found where, and what was expected instead.

use std::fmt;

/// Something in the input is wrong. Displays as `file:line: what: found …, expected …`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// The file, as the user named it.
    pub file: Option<String>,
    /// The line in the file, from 1.
    pub line: Option<usize>,
    /// The field, option or record that is wrong.
    pub what: String,
    /// What stands there.
    pub found: String,
    /// What would be right.
    pub expected: String,
}

/// The result of anything that reads input.
pub type Result<T, E = Fault> = std::result::Result<T, E>;

impl Fault {
    /// `what` holds `found`, where `expected` should be.
    pub fn new(what: impl fmt::Display, found: impl fmt::Display, expected: impl fmt::Display) -> Self {
        Self {
            file: None,
            line: None,
            what: what.to_string(),
            found: found.to_string(),
            expected: expected.to_string(),
        }
    }

    /// Names the file, unless an inner layer already did.
    pub fn in_file(mut self, file: impl AsRef<std::path::Path>) -> Self {
        self.file.get_or_insert_with(|| file.as_ref().display().to_string());
        self
    }

    /// Names the line (from 1), unless an inner layer already did.
    pub fn at_line(mut self, line: usize) -> Self {
        self.line.get_or_insert(line);
        self
    }

    /// A file that could not be read or written.
    pub fn io(file: impl AsRef<std::path::Path>, error: &std::io::Error) -> Self {
        use std::io::ErrorKind::{IsADirectory, NotADirectory, NotFound, PermissionDenied};
        let expected = match error.kind() {
            NotFound => "a file that exists",
            PermissionDenied => "a file this user may open",
            IsADirectory => "a file",
            NotADirectory => "a directory",
            _ => "a file that can be read and written",
        };
        Self::new("file", error, expected).in_file(file)
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (&self.file, self.line) {
            (Some(file), Some(line)) => write!(f, "{file}:{line}: ")?,
            (Some(file), None) => write!(f, "{file}: ")?,
            (None, Some(line)) => write!(f, "line {line}: ")?,
            (None, None) => {}
        }
        write!(f, "{}: found {}, expected {}", self.what, self.found, self.expected)
    }
}

impl std::error::Error for Fault {}

/// Checks that a number is finite and within `[low, high]`.
pub fn number_within(what: &str, value: f64, low: f64, high: f64) -> Result<f64> {
    if value.is_finite() && (low..=high).contains(&value) {
        return Ok(value);
    }
    let expected = match (low.is_finite(), high.is_finite()) {
        (true, true) => format!("a number from {low} to {high}"),
        (true, false) => format!("a number of at least {low}"),
        (false, true) => format!("a number of at most {high}"),
        (false, false) => "a finite number".to_string(),
    };
    Err(Fault::new(what, shown(value), expected))
}

/// Checks that a number is finite and greater than zero.
pub fn positive(what: &str, value: f64) -> Result<f64> {
    if value.is_finite() && value > 0.0 {
        return Ok(value);
    }
    Err(Fault::new(what, shown(value), "a number greater than 0"))
}

/// Reads exactly N numbers; TOML's own arrays pass over what is too many. For `#[serde(deserialize_with)]`.
pub fn exactly<'de, D: serde::Deserializer<'de>, const N: usize>(input: D) -> Result<[f64; N], D::Error> {
    let numbers = <Vec<f64> as serde::Deserialize>::deserialize(input)?;
    let found = numbers.len();
    numbers.try_into().map_err(|_| serde::de::Error::custom(format!("{found} numbers where {N} belong")))
}

/// The same for a field that may be left out (with `#[serde(default)]`).
pub fn exactly_if_there<'de, D: serde::Deserializer<'de>, const N: usize>(
    input: D,
) -> Result<Option<[f64; N]>, D::Error> {
    exactly(input).map(Some)
}

/// A number as people write it: not three hundred digits of 1e300.
fn shown(value: f64) -> String {
    if value.abs() >= 1e15 { format!("{value:e}") } else { value.to_string() }
}
