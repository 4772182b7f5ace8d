//! `metromap run`: simulate and map.

use std::path::PathBuf;

use clap::Args;

use super::Exit;
use super::output::{Output, complain, start, stay_open};
use super::session::{Session, stop_requested};
use super::summary::Summary;
use crate::fault::{Fault, Result};
use crate::pipeline::Pipeline;
use crate::robot::OdometryParams;
use crate::sinks::Truth;
use crate::sources::{Judge, Scenario, Shot, Simulation, rig_file};

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
    #[arg(long, value_name = "X,Y,YAW", value_delimiter = ',', allow_hyphen_values = true, num_args = 1)]
    pub start: Vec<f64>,
    /// Drive there, scanning at every stop; instead of the scenario's mission. May be repeated
    #[arg(long = "goto", value_name = "X,Y", allow_hyphen_values = true)]
    pub goals: Vec<String>,
    /// End of the run at the latest [s]
    #[arg(long, value_name = "S")]
    pub duration_s: Option<f64>,
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
collisions, occupancy {resolution_m, occupied, free, bytes}, terrain {vertices, triangles, max_error_m, area_m2}, \
truth {point_rms_m, point_rms_m_within_3m, point_outliers, occupancy_precision, occupancy_recall (also _low, _high: below \
and above 0.1 m), terrain_rmse_m, terrain_coverage, pose_rms_m, pose_rms_rad, objects {name: {seen, found, is_found}}}, \
absent [what the world asks for and is not simulated], digest (SHA-256 of the maps), files, interrupted.";

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    let path = options.scenario.clone().unwrap_or_else(|| PathBuf::from("worlds/lab.toml"));
    let mut scenario = Scenario::load(&path, &options.model_path)?;
    apply(&options, &mut scenario)?;
    let mut simulation = Simulation::new(&scenario).map_err(|fault| fault.in_file(&path))?;
    let pipeline = Pipeline::new(scenario.rig.clone(), scenario.pipeline.clone())?;
    let mut judge = Judge::new(&scenario.scene, scenario.pipeline.maps.grid.voxel_m);

    let mut opened = options.output.open(&scenario.name, true)?;
    opened.announce();
    let mut begin = start(&scenario.name, &scenario.rig);
    begin.scene = simulation.pictures();
    begin.metadata.push(("seed".into(), scenario.seed.to_string()));
    begin.attachments = vec![
        ("scenario.toml".into(), "application/toml".into(), scenario.text.clone().into_bytes()),
        ("rig.toml".into(), "application/toml".into(), rig_file::to_toml(&scenario.rig).into_bytes()),
        ("pipeline.toml".into(), "application/toml".into(), scenario.pipeline.to_toml()?.into_bytes()),
    ];
    let total_ms = (scenario.duration_s * 1e3) as u64;
    let mut session = Session::begin(pipeline, begin, opened.take_sinks(), Some(total_ms))?;
    let result = drive(&mut session, &mut simulation, &mut judge);
    if let Err(fault) = &result {
        session.log("ERROR", fault.to_string());
    }
    let failed = session.finish();
    result?;

    let truth = judge.verdict(session.pipeline.maps(), simulation.surfaces());
    let files = opened.export(session.pipeline.maps())?;
    let mut summary = Summary::of(&session, Some(truth), Some(simulation.collisions()), files);
    summary.absent.clone_from(&scenario.scene.absent);
    summary.save(&opened.dir)?;
    if options.output.json {
        println!("{}", summary.json());
    } else {
        eprint!("{}", summary.text());
        opened.advise();
    }
    stay_open(&opened, &session);
    if complain(&failed) || summary.dropped.lost() > 0 { Ok(Exit::Lossy) } else { Ok(Exit::Done) }
}

/// The loop: simulate, map, judge, show.
fn drive(session: &mut Session, simulation: &mut Simulation, judge: &mut Judge) -> Result<()> {
    while !stop_requested() {
        simulation.look_at(session.pipeline.maps(), session.pipeline.world_from_odom());
        let Some(Shot { capture, truth, notes }) = simulation.next_shot()? else { break };
        for note in notes {
            session.log("INFO", note);
        }
        session.progress(capture.stamp.0.unsigned_abs() / 1_000_000, simulation.doing());
        if let Some(step) = session.step(&capture) {
            let point_rms_m = judge.step(&step, &truth.world_from_robot, &truth.sights);
            let beside = Truth { world_from_robot: truth.world_from_robot, moved: truth.moved, point_rms_m };
            session.show(&step, &capture.reading, Some(beside));
        }
    }
    session.dropped.merge(simulation.dropped());
    Ok(())
}

/// Flags win over the scenario.
fn apply(options: &Options, scenario: &mut Scenario) -> Result<()> {
    if let Some(seed) = options.seed {
        scenario.seed = seed;
    }
    if options.odometry == Odometry::Perfect {
        scenario.robot.odometry = OdometryParams::perfect();
    }
    match options.start[..] {
        [] => {}
        [x_m, y_m, yaw_deg] if options.start.iter().all(|v| v.is_finite()) => {
            scenario.place_robot(x_m, y_m, yaw_deg);
        }
        _ => {
            return Err(Fault::new(
                "--start",
                format!("{:?}", options.start),
                "three numbers: x, y [m], yaw [degrees]",
            ));
        }
    }
    if !options.goals.is_empty() {
        let mut goals = Vec::new();
        for goal in &options.goals {
            let numbers: Vec<f64> = goal.split(',').filter_map(|n| n.trim().parse().ok()).collect();
            match numbers[..] {
                [x, y] if x.is_finite() && y.is_finite() => goals.push([x, y]),
                _ => return Err(Fault::new("--goto", format!("`{goal}`"), "two numbers: x,y [m]")),
            }
        }
        scenario.visit(&goals);
    }
    if let Some(duration_s) = options.duration_s {
        scenario.duration_s = crate::fault::positive("--duration-s", duration_s)?;
    }
    Ok(())
}
