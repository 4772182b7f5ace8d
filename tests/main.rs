//! All integration tests in one binary: each test binary links the embedded viewer, so one is enough.

#![allow(clippy::unwrap_used)] // A test that panics is a test that fails.

mod browser;
mod calibration;
mod commands;
mod compare;
mod design;
mod drift;
mod finder;
mod instrument;
mod layers;
mod mutations;
mod real_images;
mod recordings;
mod reproduce;
mod sonar;
