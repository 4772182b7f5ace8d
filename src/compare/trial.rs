//! One seed: the scenario is driven once with both sensors at work, and all that they say is held against the truth.

use std::collections::BTreeMap;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::layers::{MapScore, Picture, Shown};
use super::ledger::{Encounter, LASER, Ledger, Reports, ULTRASONIC};
use super::matching::{Cone, LaserPoint, Slit};
use super::stage::{Stage, V3};
use crate::fault::{Fault, Result};
use crate::maps::{Layers, PlanView};
use crate::navigation::Step as MissionStep;
use crate::pipeline::{Pipeline, Step};
use crate::sources::{Heard, PlanTruth, Scenario, ShotTruth, Simulation};

/// Places of the robot's way are this far apart [m].
const WAY_STEP_M: f64 = 0.25;
/// A reading of the ring takes so many bytes: range, number, time.
const READING_BYTES: u64 = 13;
/// A column of an extracted line takes so many bytes: row, σ, level.
const COLUMN_BYTES: u64 = 12;

/// Which sensors are at work.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sensors {
    /// The finder's points are used.
    pub laser: bool,
    /// The ring is fired.
    pub ultrasonic: bool,
}

impl Sensors {
    /// Both.
    pub const BOTH: Self = Self { laser: true, ultrasonic: true };

    /// Refuses an empty set.
    pub fn validated(self) -> Result<Self> {
        if self.laser || self.ultrasonic {
            return Ok(self);
        }
        Err(Fault::new("sensors", "none", "laser, sonar, or both"))
    }

    /// Whether the sensor of this index is at work.
    pub fn has(self, sensor: usize) -> bool {
        [self.laser, self.ultrasonic][sensor]
    }
}

/// All that one seed gave.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trial {
    /// Its seed.
    pub seed: u64,
    /// Simulated time [s].
    pub sim_s: f64,
    /// Way of the robot [m].
    pub travel_m: f64,
    /// Times its body touched something.
    pub collisions: u64,
    /// Exposures.
    pub captures: u64,
    /// Pings.
    pub pings: u64,
    /// Bytes of all images, of all lines found in them, of all ultrasonic readings.
    pub bytes: [u64; 3],
    /// Captures without a profile and ultrasonic readings that the maps refused.
    pub refused: [u64; 2],
    /// Obstacles in the world.
    pub targets: u64,
    /// Encounters by class.
    pub classes: BTreeMap<String, Vec<Encounter>>,
    /// All that each sensor reported.
    pub reports: [Reports; 2],
    /// The maps of laser, ultrasonic and both.
    pub maps: [Option<MapScore>; 3],
    /// Maps, way and world; of one seed only.
    pub shown: Option<Shown>,
}

/// The scenario as a seed has it: its own noise, and a start and goals that are moved a little and begin a little later,
/// the same for both sensors.
pub fn scenario_of(scenario: &Scenario, seed: u64, sensors: Sensors) -> Scenario {
    let mut own = scenario.clone();
    own.seed = seed;
    own.sonar = sensors.ultrasonic.then(|| scenario.sonar.unwrap_or_default());
    let (reach, turn) = (scenario.compare.jitter_m, scenario.compare.jitter_deg);
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x6a69_7474_6572);
    let mut off = |most: f64| if most > 0.0 { rng.random_range(-most..=most) } else { 0.0 };
    let start = own.robot.start;
    let moved = [start.x_m + off(reach), start.y_m + off(reach), start.yaw_deg + off(turn)];
    if own.start_given {
        own.place_robot(moved[0], moved[1], moved[2]);
    }
    for step in &mut own.mission.steps {
        if let MissionStep::GoTo { to_m, .. } = step {
            to_m.iter_mut().for_each(|at| *at += off(reach));
        }
    }
    if !own.mission.steps.is_empty() && scenario.compare.jitter_s > 0.0 {
        let seconds = (off(scenario.compare.jitter_s) + scenario.compare.jitter_s) / 2.0;
        own.mission.steps.insert(0, MissionStep::Wait { seconds });
    }
    own
}

/// Drives one seed. `go_on` hears how many thousandths are done, and ends it early by returning false: `None` then.
///
/// # Errors
/// What the simulation or the maps refuse.
pub fn run(
    scenario: &Scenario,
    seed: u64,
    sensors: Sensors,
    is_shown: bool,
    go_on: &dyn Fn(u64) -> bool,
) -> Result<Option<Trial>> {
    let sensors = sensors.validated()?;
    let scenario = scenario_of(scenario, seed, sensors);
    let mut simulation = Simulation::new(&scenario)?;
    let mut book = Book::new(&scenario, sensors)?;
    while let Some(shot) = simulation.next_shot()? {
        shot.heard.iter().try_for_each(|heard| book.hear(heard))?;
        book.look(&shot.truth, shot.capture.stamp)?;
        book.captures += 1;
        let step = book.pipeline.step(&shot.capture);
        book.refused[LASER] += u64::from(step.is_err() && sensors.laser);
        if let Ok(step) = step
            && sensors.laser
        {
            let columns = step.line.columns.iter().flatten().count() as u64;
            book.bytes[0] += (step.line.columns.len() * step.line.height) as u64;
            book.bytes[1] += columns * COLUMN_BYTES;
            book.ledger.slit(step.stamp, &slit(&step, &shot.truth));
        }
        if !go_on(simulation.thousandths()) {
            return Ok(None);
        }
    }
    simulation.take_heard().iter().try_for_each(|heard| book.hear(heard))?;
    let mut trial = book.close(&scenario, is_shown)?;
    (trial.sim_s, trial.collisions) = (simulation.now().as_secs(), simulation.collisions());
    Ok(Some(trial))
}

/// All that is written down during a run.
struct Book {
    sensors: Sensors,
    ledger: Ledger,
    way_m: Vec<[f64; 2]>,
    pipeline: Pipeline,
    captures: u64,
    pings: u64,
    bytes: [u64; 3],
    refused: [u64; 2],
    travel_m: f64,
    foot: Option<V3>,
    moved: Vec<(usize, nalgebra::Isometry3<f64>)>,
}

impl Book {
    fn new(scenario: &Scenario, sensors: Sensors) -> Result<Self> {
        Ok(Self {
            sensors,
            ledger: Ledger::new(Stage::new(scenario)?),
            way_m: Vec::new(),
            pipeline: Pipeline::new(scenario.rig.clone(), scenario.pipeline.clone())?,
            captures: 0,
            pings: 0,
            bytes: [0; 3],
            refused: [0; 2],
            travel_m: 0.0,
            foot: None,
            moved: Vec::new(),
        })
    }

    fn look(&mut self, truth: &ShotTruth, stamp: crate::time::Stamp) -> Result<()> {
        let foot = truth.world_from_robot.xyz();
        self.travel_m += self.foot.map_or(0.0, |last| (foot - last).norm());
        self.foot = Some(foot);
        self.moved.clone_from(&truth.moved);
        self.ledger.look(stamp, &truth.world_from_robot, &self.moved)?;
        if self.way_m.last().is_none_or(|last| (foot.x - last[0]).hypot(foot.y - last[1]) >= WAY_STEP_M) {
            self.way_m.push([foot.x, foot.y]);
        }
        Ok(())
    }

    fn hear(&mut self, heard: &Heard) -> Result<()> {
        self.pings += 1;
        self.bytes[2] += READING_BYTES;
        // A reading that the pipeline refuses is counted, and says nothing.
        if self.pipeline.hear(&heard.reading).is_err() {
            self.refused[ULTRASONIC] += 1;
            return Ok(());
        }
        self.ledger.look(heard.reading.stamp, &heard.truth.world_from_robot, &self.moved)?;
        let ping = &heard.truth.ping;
        let Some(range_m) = heard.reading.range_m.map(f64::from) else { return Ok(()) };
        let cause = ping.causes.first().and_then(|cause| ping.echoes.get(*cause));
        let cone = Cone {
            from: ping.aim.at.xyz,
            axis: ping.aim.axis,
            half_rad: f64::from(heard.reading.field_of_view_rad) / 2.0,
            range_m,
            truth: cause.map(|echo| echo.place.xyz),
        };
        self.ledger.cone(heard.reading.stamp, &cone);
        Ok(())
    }

    fn close(mut self, scenario: &Scenario, is_shown: bool) -> Result<Trial> {
        self.ledger.finish();
        let maps = self.pipeline.maps();
        let layers = maps.layers().unwrap_or_else(|| {
            // The ring said nothing: of its map nothing is known.
            let laser = maps.plan_view();
            let ultrasonic = PlanView { cells: vec![-1; laser.cells.len()], ..laser.clone() };
            Layers { fused: laser.clone(), ultrasonic, laser }
        });
        let (stage, plan) = (&self.ledger.stage, &scenario.pipeline.maps.plan);
        let truth = PlanTruth::new(&layers.fused, &scenario.scene, &stage.surfaces, plan, &self.way_m)?;
        let verdicts = truth.judge(&layers);
        let used = [self.sensors.laser, self.sensors.ultrasonic, self.sensors == Sensors::BOTH];
        let scores = [verdicts.laser, verdicts.ultrasonic, verdicts.fused];
        let views = [&truth.view, &layers.laser, &layers.ultrasonic, &layers.fused].into_iter();
        let shown = views.zip([true, used[0], used[1], used[2]]).filter(|view| view.1);
        let shown = is_shown.then(|| Shown {
            maps: shown.map(|(view, _)| Picture::of(view)).collect(),
            way_m: self.way_m.clone(),
            places: stage.places(),
        });
        Ok(Trial {
            seed: scenario.seed,
            sim_s: 0.0,
            travel_m: self.travel_m,
            collisions: 0,
            captures: self.captures,
            pings: self.pings,
            bytes: self.bytes,
            refused: self.refused,
            targets: self.ledger.stage.sites.len() as u64,
            classes: self.ledger.classes,
            reports: self.ledger.reports,
            maps: std::array::from_fn(|which| used[which].then(|| scores[which].into())),
            shown,
        })
    }
}

/// What a capture's profile says, as the robot truly stood: the instrument alone, without odometry.
fn slit(step: &Step, truth: &ShotTruth) -> Slit {
    let point = |seen: &crate::points::ProfilePoint<crate::geometry::Robot>| {
        let v =
            step.line.columns.get(usize::from(seen.column)).copied().flatten().map_or(0.0, |peak| f64::from(peak.v));
        let here = truth.sights.iter().filter(|sight| sight.column == seen.column);
        let nearest = here.min_by(|a, b| (a.v - v).abs().total_cmp(&(b.v - v).abs()));
        LaserPoint {
            column: seen.column,
            at: (truth.world_from_robot * seen.point).xyz,
            truth: nearest.map(|sight| sight.point.xyz),
        }
    };
    Slit { eye: (truth.world_from_robot * step.seen.eye).xyz, points: step.seen.points.iter().map(point).collect() }
}

/// Bytes a second of a sensor: as it sends them, and of the laser also the line alone.
pub fn bytes_per_s(trial: &Trial, sensor: usize) -> f64 {
    let bytes = if sensor == LASER { trial.bytes[0] } else { trial.bytes[2] };
    bytes as f64 / trial.sim_s.max(1e-9)
}

/// Power of a sensor [W].
pub fn power_w(trial: &Trial, scenario: &Scenario, sensor: usize) -> f64 {
    let params = &scenario.compare;
    if sensor != ULTRASONIC {
        return params.laser_w;
    }
    let count = scenario.sonar.unwrap_or_default().count as f64;
    count * params.module_w + params.ping_j * trial.pings as f64 / trial.sim_s.max(1e-9)
}
