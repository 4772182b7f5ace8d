//! What the instrument gives: images, the line in them, and the capture that carries either with its time and encoders.

mod capture;
mod gray;
mod line;

pub use capture::{Capture, Reading};
pub use gray::Image;
pub use line::{Drop, Dropped, Line, Peak};
