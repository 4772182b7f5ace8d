//! Instants and durations in whole nanoseconds: exact, ordered, and the same in memory and on disk.

use std::ops::{Add, Sub};

use serde::{Deserialize, Serialize};

/// An instant [ns]: since the start of a simulated run, or since the Unix epoch for a real one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Stamp(pub i64);

/// A duration [ns].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Span(pub i64);

impl Stamp {
    /// The nearest nanosecond to `seconds`.
    pub fn from_secs(seconds: f64) -> Self {
        Self((seconds * 1e9).round() as i64)
    }

    /// Seconds as a float; exact to a nanosecond for some 100 days.
    pub fn as_secs(self) -> f64 {
        self.0 as f64 * 1e-9
    }
}

impl Span {
    /// The nearest nanosecond to `seconds`.
    pub fn from_secs(seconds: f64) -> Self {
        Self((seconds * 1e9).round() as i64)
    }

    /// Seconds as a float.
    pub fn as_secs(self) -> f64 {
        self.0 as f64 * 1e-9
    }
}

impl Add<Span> for Stamp {
    type Output = Stamp;
    fn add(self, span: Span) -> Stamp {
        Stamp(self.0.saturating_add(span.0))
    }
}

impl Sub for Stamp {
    type Output = Span;
    fn sub(self, earlier: Stamp) -> Span {
        Span(self.0.saturating_sub(earlier.0))
    }
}
