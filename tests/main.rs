//! All integration tests in one binary: each test binary links the embedded viewer, so one is enough.

#![allow(clippy::unwrap_used)] // A test that panics is a test that fails.

mod browser;
mod commands;
mod layers;
mod mutations;
mod real_images;
mod recordings;
