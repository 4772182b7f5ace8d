//! What `run` and `map` say at the end: one JSON object for programs, a few lines for people.

use std::fmt::Write;
use std::path::Path;

use serde::Serialize;

use super::session::Session;
use crate::calibration::finder::drift::{Drift, DriftState};
use crate::fault::{Fault, Result};
use crate::image::Dropped;
use crate::maps::{Maps, OccupancySummary, TerrainSummary};
use crate::navigation::MissionProgress;
use crate::sources::Verdict;

/// The result of a run. Keys are fixed: other programs rely on them (`metromap run --help` documents them).
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Captures offered to the pipeline.
    pub captures: u64,
    /// Captures that gave at least one point.
    pub profiles: u64,
    /// Points placed in the map.
    pub points: u64,
    /// What was not used, by reason.
    pub dropped: Dropped,
    /// Time that the captures span [s].
    pub sim_s: f64,
    /// Wall time [s].
    pub wall_s: f64,
    /// `sim_s / wall_s`.
    pub realtime_factor: f64,
    /// Slit images rendered [1/s of wall time]; only for a simulation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frames_per_s: Option<f64>,
    /// Way of the robot by its own reckoning [m].
    pub travel_m: f64,
    /// Times the robot's body touched something; only for a simulation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub collisions: Option<u64>,
    /// How the mission went; only for a simulation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mission: Option<MissionProgress>,
    /// The occupancy grid.
    pub occupancy: OccupancySummary,
    /// The terrain mesh.
    pub terrain: Terrain,
    /// Against the truth; only for a simulation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<Verdict>,
    /// Ultrasonic ranges; only where there were some.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ranges: Option<Ranges>,
    /// What the floor says of the calibration; only where it is known to be flat.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drift: Option<Watched>,
    /// What the world file asks for and is not simulated.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub absent: Vec<String>,
    /// SHA-256 of the maps.
    pub digest: String,
    /// Files written.
    pub files: Vec<String>,
    /// Whether the user stopped it early.
    pub interrupted: bool,
}

/// Ultrasonic ranges in numbers.
#[derive(Clone, Debug, Serialize)]
pub struct Ranges {
    /// Readings taken.
    pub readings: u64,
    /// Of these, without an echo.
    pub no_echo: u64,
    /// Transducers.
    pub transducers: usize,
}

impl Ranges {
    fn of(maps: &Maps) -> Option<Self> {
        let layer = maps.ultrasonic();
        let [readings, no_echo] = [layer.readings(), layer.silent()];
        (readings > 0).then(|| Self { readings, no_echo, transducers: layer.transducers() })
    }
}

/// What the floor last said of the calibration, and when it first did not fit.
#[derive(Clone, Debug, Serialize)]
pub struct Watched {
    /// What it last said.
    #[serde(flatten)]
    pub drift: Drift,
    /// The capture of the first alarm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first_alarm_capture: Option<u64>,
}

/// The terrain mesh in numbers.
#[derive(Clone, Debug, Serialize)]
pub struct Terrain {
    /// The mesh.
    #[serde(flatten)]
    pub mesh: TerrainSummary,
    /// Ground seen [m²].
    pub area_m2: f64,
}

impl Summary {
    /// The numbers of a finished session.
    pub fn of(session: &Session, truth: Option<Verdict>, collisions: Option<u64>, files: Vec<String>) -> Self {
        let maps = session.pipeline.maps().summary();
        let ground = session.pipeline.maps().ground();
        let wall_s = session.wall_s();
        let simulated = collisions.is_some();
        Self {
            captures: session.captures,
            profiles: session.profiles,
            points: session.points,
            dropped: session.dropped.clone(),
            sim_s: session.span_s(),
            wall_s,
            realtime_factor: session.span_s() / wall_s,
            frames_per_s: simulated.then(|| session.captures as f64 / wall_s),
            travel_m: session.travelled.metres(),
            collisions,
            mission: None,
            occupancy: maps.occupancy,
            terrain: Terrain { mesh: maps.terrain, area_m2: ground.cells.len() as f64 * ground.cell_m * ground.cell_m },
            truth,
            ranges: Ranges::of(session.pipeline.maps()),
            drift: session
                .pipeline
                .drift()
                .map(|drift| Watched { drift: drift.clone(), first_alarm_capture: session.first_alarm }),
            absent: Vec::new(),
            digest: session.pipeline.maps().digest(),
            files,
            interrupted: super::session::stop_requested(),
        }
    }

    /// One line of JSON.
    pub fn json(&self) -> String {
        // Numbers, strings and string keys only: it cannot fail, and NaN becomes null.
        serde_json::to_string(self).unwrap_or_default()
    }

    /// Writes summary.json into a directory.
    pub fn save(&self, dir: &Path) -> Result<()> {
        let path = dir.join("summary.json");
        let text = serde_json::to_string_pretty(self).unwrap_or_default();
        std::fs::write(&path, text + "\n").map_err(|e| Fault::io(&path, &e))
    }

    /// A few lines for people.
    pub fn text(&self) -> String {
        let mut text = String::new();
        let mut line = |s: String| {
            let _ = writeln!(text, "{s}");
        };
        if self.interrupted {
            line("stopped early: all files are complete up to here".into());
        }
        line(format!(
            "{} captures, {} profiles, {} points; {:.1} m travelled in {:.1} s, {:.1} s of wall time ({:.0} x real time)",
            self.captures, self.profiles, self.points, self.travel_m, self.sim_s, self.wall_s, self.realtime_factor
        ));
        line(format!(
            "occupancy {} occupied, {} free voxels of {:.0} mm; terrain {} triangles over {:.1} m², within {:.0} mm",
            self.occupancy.occupied,
            self.occupancy.free,
            self.occupancy.resolution_m * 1e3,
            self.terrain.mesh.triangles,
            self.terrain.area_m2,
            self.terrain.mesh.max_error_m * 1e3
        ));
        if let Some(mission) = self.mission {
            let cut = if mission.ended < mission.steps { ": the time was over before the mission" } else { "" };
            let blocked = match mission.given_up {
                0 => String::new(),
                count => format!(", {count} of them given up: the way was blocked (see the log)"),
            };
            line(format!("mission: {} of {} steps ended{blocked}{cut}", mission.ended, mission.steps));
        }
        if let Some(Ranges { readings, no_echo, transducers }) = self.ranges {
            line(format!(
                "{readings} ultrasonic ranges of {transducers} transducers, {no_echo} of them without an echo"
            ));
        }
        if let Some(truth) = &self.truth {
            line(truth.text());
            truth.map_text().into_iter().for_each(&mut line);
        }
        if let Some(watched) = self.drift.as_ref().filter(|watched| watched.drift.state != DriftState::Unseen) {
            line(watched.drift.to_string());
        }
        // Elements such as <gui> are many and change little; what is missing from the world is told one by one.
        let (elements, things): (Vec<_>, Vec<_>) = self.absent.iter().partition(|what| what.starts_with('<'));
        for thing in things {
            line(format!("not simulated: {thing}"));
        }
        if !elements.is_empty() {
            line(format!(
                "not simulated: {} kinds of elements, named in summary.json under \"absent\"",
                elements.len()
            ));
        }
        let lost = self.dropped.lost();
        if lost > 0 {
            let reasons: Vec<String> =
                self.dropped.0.iter().filter(|(why, _)| why.is_loss()).map(|(why, n)| format!("{n} {why}")).collect();
            line(format!("data lost: {}", reasons.join(", ")));
        }
        line(format!("digest of the maps: {}", self.digest));
        text
    }
}
