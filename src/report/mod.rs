//! Reports for people: plots as SVG, and pages that are one file.

mod drawing;
pub mod html;
mod plot;

pub use drawing::{Drawing, Ink};
pub use plot::{Axis, Plot, Series, Style, escaped};
