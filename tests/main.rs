//! All integration tests in one binary: each test binary links the embedded viewer, so one is enough.

mod commands;
mod layers;
mod real_images;
mod recordings;
