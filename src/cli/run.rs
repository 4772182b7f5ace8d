//! `metromap run`: simulate and map.

use std::path::{Path, PathBuf};

use clap::Args;

use super::Exit;
use super::output::{Output, start};
use super::session::{Session, stop_requested};
use super::summary::Summary;
use crate::fault::{Fault, Result};
use crate::pipeline::Pipeline;
use crate::robot::OdometryParams;
use crate::sinks::Truth;
use crate::sonar::RingParams;
use crate::sources::{Heard, Judge, PlanTruth, Scenario, Shot, Simulation, rig_file};

/// Simulate a robot with a finder in a world, and map it.
#[derive(Args, Clone, Debug, Default)]
#[command(after_long_help = JSON_HELP)]
pub struct Options {
    /// A scenario (.toml) or an SDF world (.sdf, .world, also .gz) [default: worlds/lab.toml]
    pub scenario: Option<PathBuf>,
    /// Seed of every random draw [default: the scenario's]
    #[arg(long)]
    pub seed: Option<u64>,
    /// Odometry: as the scenario has it, or without any error
    #[arg(long, value_enum, default_value_t, value_name = "WHICH")]
    pub odometry: Odometry,
    /// Where the robot starts: x, y [m], yaw [degrees]
    #[arg(long, value_name = "X,Y,YAW", allow_hyphen_values = true, value_parser = numbers::<3>)]
    pub start: Option<[f64; 3]>,
    /// Drive there, scanning at every stop; instead of the scenario's mission. May be repeated
    #[arg(long = "goto", value_name = "X,Y", allow_hyphen_values = true, value_parser = numbers::<2>)]
    pub goals: Vec<[f64; 2]>,
    /// End of the run at the latest [s]
    #[arg(long, value_name = "S", allow_hyphen_values = true, value_parser = positive)]
    pub duration_s: Option<f64>,
    /// Bump the finder: a parameter of its calibration and by how much, such as tilt_rad=0.005. The robot does not know;
    /// over a flat floor it should notice. May be repeated
    #[arg(long = "bump", value_name = "NAME=BY", allow_hyphen_values = true, value_parser = shift)]
    pub bumps: Vec<(String, f64)>,
    /// Put METRO-I's ultrasonic ring on the robot (24 transducers), where the scenario has none
    #[arg(long)]
    pub sonar: bool,
    /// Where else `model://` is looked up
    #[arg(long, value_name = "DIR")]
    pub model_path: Vec<PathBuf>,
    /// Where results go.
    #[command(flatten)]
    pub output: Output,
}

/// Which odometry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Odometry {
    /// With the scenario's errors.
    #[default]
    Scenario,
    /// The true pose.
    Perfect,
}

/// What `--json` prints.
pub const JSON_HELP: &str = "\
JSON keys: captures, profiles, points, dropped {reason: count}, sim_s, wall_s, realtime_factor, frames_per_s, travel_m, \
collisions, mission {steps, ended, given_up}, occupancy {resolution_m, occupied, free, bytes}, terrain {vertices, triangles, max_error_m, area_m2}, \
truth {point_rms_m, point_rms_m_within_3m, point_outliers, occupancy_precision, occupancy_recall (also _low, _high: below \
and above 0.1 m), terrain_rmse_m, terrain_coverage, pose_rms_m, pose_rms_rad, objects {name: {seen, found, is_found}}}, \
truth.map {laser, ultrasonic, fused: {precision, recall, iou, free_space_error, free_found, free_blocked}} and \
ranges {readings, no_echo, transducers} (with an ultrasonic ring or recorded ranges), absent [what the world asks for and is not simulated], \
drift {state: unseen | fits | moved | several | no_floor, captures, captures_needed, lines, readings, floor_share, \
below_share, misfit_m, misfit_after_m, moved [{parameter, by, sigma, unit, explains}], first_alarm_capture} (where the \
floor is known to be flat: whether the calibration fits it, and what moved), digest (SHA-256 of the maps), files, interrupted.";

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    let path = options.scenario.clone().unwrap_or_else(|| PathBuf::from("worlds/lab.toml"));
    let mut scenario = Scenario::load(&path, &options.model_path)?;
    apply(&options, &mut scenario)?;
    let mut simulation = Simulation::new(&scenario).map_err(|fault| fault.in_file(&path))?;
    let pipeline = Pipeline::new(scenario.rig.clone(), scenario.pipeline.clone())?;
    let mut judge = Judge::new(&scenario.scene, scenario.pipeline.maps.grid.voxel_m);

    let mut opened = options.output.open(&stem(&path), true)?;
    opened.announce();
    let mut begin = start(&scenario.name, &scenario.rig);
    begin.scene = simulation.pictures();
    begin.transducers = simulation.transducers();
    begin.metadata.push(("seed".into(), scenario.seed.to_string()));
    begin.metadata.push(("overrides".into(), overrides(&options)));
    begin.attachments = vec![
        ("scenario.toml".into(), "application/toml".into(), scenario.text.clone().into_bytes()),
        ("rig.toml".into(), "application/toml".into(), rig_file::to_toml(&scenario.rig).into_bytes()),
        ("pipeline.toml".into(), "application/toml".into(), scenario.pipeline.to_toml()?.into_bytes()),
    ];
    let mut session = Session::begin(pipeline, begin, opened.take_sinks(), Some(1000))?;
    let result = drive(&mut session, &mut simulation, &mut judge, true);
    if let Err(fault) = &result {
        session.log("ERROR", fault.to_string());
    }
    let failed = session.finish();
    result?;

    let mut truth = judge.verdict(session.pipeline.maps(), simulation.surfaces());
    let mut files = opened.export(session.pipeline.maps())?;
    if let Some(layers) = session.pipeline.maps().layers() {
        let (scene, plan) = (&scenario.scene, &scenario.pipeline.maps.plan);
        let plan = PlanTruth::new(&layers.fused, scene, simulation.surfaces(), plan, judge.way_m())?;
        truth.map = Some(plan.judge(&layers));
        files.push(opened.picture(&layers, Some(&plan.of(&layers.fused)))?);
    }
    if session.captures == 0 && !stop_requested() {
        let found = format!("none in {} s", scenario.duration_s);
        return Err(Fault::new("captures", found, "time for at least one exposure").in_file(&path));
    }
    let mut summary = Summary::of(&session, Some(truth), Some(simulation.collisions()), files);
    summary.mission = Some(simulation.mission());
    summary.absent.clone_from(&scenario.scene.absent);
    opened.close(&summary, options.output.json, &failed, &session)
}

/// What the command line changed in the scenario that rides along.
fn overrides(options: &Options) -> String {
    let Options { odometry, start, goals, duration_s, bumps, sonar, .. } = options;
    let ring = if *sonar { ", sonar" } else { "" };
    format!("odometry {odometry:?}, start {start:?}, goto {goals:?}, duration_s {duration_s:?}, bump {bumps:?}{ring}")
}

/// The loop: simulate, map, judge, show. A robot that does not look at its maps drives into what is in its way.
pub(super) fn drive(session: &mut Session, simulation: &mut Simulation, judge: &mut Judge, looks: bool) -> Result<()> {
    while !stop_requested() {
        if looks {
            simulation.look_at(session.pipeline.maps(), session.pipeline.world_from_odom());
        }
        let Some(Shot { capture, truth, heard, notes }) = simulation.next_shot()? else { break };
        log_notes(session, notes);
        hear(session, heard);
        session.progress(simulation.thousandths(), simulation.doing());
        if let Some(step) = session.step(&capture) {
            let point_rms_m = judge.step(&step, &truth.world_from_robot, &truth.sights);
            let beside = Truth { world_from_robot: truth.world_from_robot, moved: truth.moved, point_rms_m };
            session.show(&step, &capture.reading, Some(beside));
        }
    }
    hear(session, simulation.take_heard());
    log_notes(session, simulation.take_notes());
    session.dropped.merge(simulation.dropped());
    Ok(())
}

/// What the ring heard, in its order.
fn hear(session: &mut Session, heard: Vec<Heard>) {
    for Heard { reading, truth } in heard {
        session.hear(&reading, Some(truth.ping));
    }
}

/// What the mission said; what it could not do is a warning.
fn log_notes(session: &mut Session, notes: Vec<String>) {
    for note in notes {
        session.log(if note.contains("given up") { "WARN" } else { "INFO" }, note);
    }
}

/// The name of a file up to its first dot: results go to `out/` and that.
pub(super) fn stem(path: &Path) -> String {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    name.split('.').next().filter(|s| !s.is_empty()).unwrap_or("run").to_string()
}

/// Flags win over the scenario.
fn apply(options: &Options, scenario: &mut Scenario) -> Result<()> {
    if let Some(seed) = options.seed {
        scenario.seed = seed;
    }
    if options.odometry == Odometry::Perfect {
        scenario.robot.odometry = OdometryParams::perfect();
    }
    if let Some([x_m, y_m, yaw_deg]) = options.start {
        scenario.place_robot(x_m, y_m, yaw_deg);
    }
    if !options.goals.is_empty() {
        scenario.visit(&options.goals);
    }
    if let Some(duration_s) = options.duration_s {
        scenario.duration_s = duration_s;
    }
    if options.sonar {
        scenario.sonar.get_or_insert_with(RingParams::default);
    }
    scenario.bump(&options.bumps.iter().cloned().collect())
}

/// Exactly N finite numbers with commas between them.
fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let parts: Vec<f64> = text.split(',').map(|part| finite(part.trim())).collect::<Result<_, _>>()?;
    let found = parts.len();
    parts.try_into().map_err(|_| format!("found {found} numbers, expected {N}"))
}

/// `NAME=NUMBER`.
fn shift(text: &str) -> Result<(String, f64), String> {
    let (name, by) = text.split_once('=').ok_or_else(|| format!("found `{text}`, expected NAME=BY"))?;
    Ok((name.trim().to_string(), finite(by.trim())?))
}

fn finite(text: &str) -> Result<f64, String> {
    let number: f64 = text.parse().map_err(|_| format!("found `{text}`, expected a number"))?;
    if number.is_finite() { Ok(number) } else { Err(format!("found {number}, expected a finite number")) }
}

fn positive(text: &str) -> Result<f64, String> {
    let number = finite(text)?;
    if number > 0.0 { Ok(number) } else { Err(format!("found {number}, expected a number greater than 0")) }
}
