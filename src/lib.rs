//! metromap: maps for mobile robots from a laser-slit range finder, simulated, recorded or real.
//!
//! ```text
//! worlds/*.toml, *.sdf ─► world ─► robot ─► scanner ─┐                          (sources::simulation)
//!                                    └────► sonar ──┐ │
//! recording.mcap ──────────────────────────────────┐│ ├─► Capture ─► line ─► points ─► maps ─► Step
//! folder of images + rig.toml ─────────────────────┼┼─┘          (pipeline: one call a stage)  │
//!                                                  └┴─► RangeReading ─► cones ─► maps ─► RangeStep
//!                                                       sinks: rerun · mcap · export ◄─────────┘
//! ```
//!
//! A [`image::Capture`] is what the instrument gives: an image (or the line in it), the middle of the exposure, two
//! encoders and odometry; a [`ranges::RangeReading`] is a ping of one ultrasonic transducer. Each is the same type whether
//! simulated, recorded or real, so a recording maps to the same bits as the run that made it. Truth travels beside a
//! capture, never in it.
//!
//! Before the first capture stands the instrument: `design` says what a finder will see, `calibration` turns what was
//! measured with it into a `rig.toml` with error bars, and `reproduce` recomputes the paper it all comes from. Beside it
//! stands its rival: `compare` runs both sensors over many seeds and holds what each said against the truth.
//!
//! # Levels
//!
//! A module imports only from a lower level or its own folder (the test `layers` reads this table).
//!
//! | level | modules |
//! |---|---|
//! | 0 | fault geometry time |
//! | 1 | image optics ranges report |
//! | 2 | line world |
//! | 3 | calibration points robot sonar |
//! | 4 | maps scanner |
//! | 5 | navigation |
//! | 6 | pipeline |
//! | 7 | record |
//! | 8 | sinks sources |
//! | 9 | compare design reproduce |
//! | 10 | cli |
//! | 11 | main |
//!
//! Truth barrier: `line points calibration maps navigation pipeline` never import `world robot scanner sonar`. Up to
//! `pipeline` there are no files (but for the readers of worlds), no clocks, no printing, no unseeded randomness.
//!
//! # Frames and units
//!
//! SI inside; other units only where a name says so (`_px`, `_deg`, `_mm`, pulses). Frames as REP-103 and REP-105,
//! x forward, y left, z up: `map → odom → base_link → finder_base → finder_camera, finder_laser`. Transforms carry their
//! frames in their type: `world_from_robot * robot_from_sensor`. Image rows count from the top, pixel centres are integers.
//!
//! # Deliberately absent
//!
//! Drift correction (map and odom coincide), path planning (the robot stops before what its map shows); in
//! the image, light between matt surfaces and lines seen in a mirror.

pub mod calibration;
pub mod cli;
pub mod compare;
pub mod design;
pub mod fault;
pub mod geometry;
pub mod image;
pub mod line;
pub mod maps;
pub mod navigation;
pub mod optics;
pub mod pipeline;
pub mod points;
pub mod ranges;
pub mod record;
pub mod report;
pub mod reproduce;
pub mod robot;
pub mod scanner;
pub mod sinks;
pub mod sonar;
pub mod sources;
pub mod time;
pub mod world;
