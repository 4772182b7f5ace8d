//! Laser against ultrasonic: one scenario, both sensors at once, many seeds, and what each saw held against the truth.
//!
//! ```text
//! scenario ─► trial (a seed: simulation, pipeline, ledger) ─► a file a seed ─► summary ─► verdict ─► page
//! ```
//!
//! # What is measured
//!
//! The same for both sensors, with the robot's true pose: it is the instrument that is judged, not the odometry.
//!
//! - **Reading**: of the laser, a point more than the clearance over the floor; of the ring, the arc of a transducer's cone
//!   at the range of its first echo. No echo is no reading.
//! - **In play**: an obstacle some part of which is within range, within the sector about the robot's heading, and not hidden
//!   behind something else.
//! - **Encounter**: from when an obstacle comes into play until it has been out of it for 1.5 s.
//! - **Opportunity**: an encounter while the obstacle's nearest visible place was within one bin of distance (0.5 m), for at
//!   least 0.4 s in all, and not farther than the nominal range of both sensors (3 m). Rates by distance and first sightings
//!   reach farther, as far as obstacles are in play.
//! - **Detected**: a reading says that there is something within the tolerance (0.15 m) of a visible place of the obstacle,
//!   and its light or sound truly came from there; three points of one capture for the laser, one range for the ring. A drop is detected where a line of sight passes the
//!   floor's height within the hole, or by a range of its near edge; a way through by a reading from behind it that passes between its posts.
//! - **False obstacle**: a report (a run of three or more neighbouring points of the laser's; a range of the ring's), not
//!   farther than obstacles are in play, where none has any surface within the tolerance, hidden or not.
//! - **Range, bearing error**: of a sighting against the place where its light or sound truly came from.
//! - **Intervals**: 95 %, over seeds: Wilson's for rates with the number of tries that the spread between seeds leaves; the
//!   percentiles of a bootstrap over seeds for everything else.
//! - **Winner**: of a difference paired over seeds whose sign could not be chance (signs flipped), corrected for the number
//!   of comparisons (Holm), at 5 %.
//!
//! What never could happen was not measured: `None`, null in JSON, never 0.

mod along;
mod layers;
mod ledger;
mod matching;
mod page;
mod plan;
mod readings;
mod readings_page;
mod runs;
mod stage;
mod statistics;
mod summary;
mod table;
mod trial;
mod verdict;

pub use layers::{MapScore, Picture, Place, Shown};
pub use ledger::{Account, BIN_M, Encounter, LASER, Reports, SENSORS, ULTRASONIC};
pub use page::page;
pub use readings::{RatePair, Rates, Readings, Recorded};
pub use readings_page::ring_against_readings;
pub use runs::{Outcome, Plan, SEEDS_MAX, fingerprint, run_all, write_whole};
pub use statistics::{Rate, Value};
pub use summary::{
    ALPHA, ClassResult, Comparison, Difference, DistanceRate, FalseObstacles, MAPS, MapResult, Needs, sum_up,
};
pub use table::{csv, json};
pub use trial::{Sensors, Trial, scenario_of};
pub use verdict::verdict;
