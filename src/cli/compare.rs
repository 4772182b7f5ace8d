//! `metromap compare`: laser against ultrasonic, many seeds, one report.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::Exit;
use super::output::start;
use super::run::{drive, stem};
use super::session::{Session, interrupted, progress_bar, stop_requested};
use super::tell::{answer, make_out, tell};
use crate::compare::{
    LASER, Plan, Readings, Recorded, Sensors, Trial, ULTRASONIC, csv, fingerprint, json, page, ring_against_readings,
};
use crate::compare::{run_all, scenario_of, sum_up, verdict, write_whole};
use crate::fault::{Fault, Result};
use crate::pipeline::Pipeline;
use crate::sinks::Sink;
use crate::sinks::rerun::{RerunSink, Target};
use crate::sources::{Judge, Scenario, Simulation};

const JSON_HELP: &str = "\
JSON keys: name, version, fingerprint, seeds, sensors, terms, sim_s, travel_m, collisions, \
classes {class: {laser | ultrasonic: {opportunities, detected, rate, ci95, encounters, false_share {hits, of, rate, ci95}, \
range_rmse_m, bearing_rmse_rad, first_detection_m, first_detection_s, by_distance [{from_m, to_m, hits, of, rate, ci95}]}}}, \
either {class: {hits, of, rate, ci95}}, order [class], false_obstacles {sensor: {of_reports, of_seconds}}, \
map {laser | ultrasonic | fused: {iou, precision, recall, free_space_error, free_found, free_blocked}}, \
needs {sensor: {power_w, kb_per_s, line_kb_per_s, per_s}}, \
differences [{what, measure, more_is_better, laser, ultrasonic, difference, p, p_holm, winner}], verdict [sentence], files, redone, kept (seeds done before), \
readings {file, world_file, world, about [paragraph], row_s, rates {dropout | jump: {real, simulated, ratio, within_factor_2}}, \
real | simulated: {limit_m, readings, dropped, steps, jumps, ranges [count per 0.1 m], changes [count per 0.1 m]}} (with --readings). \
Of each figure without a ci95 of its own the 95 % interval is beside it, as NAME_ci95. null: not measured.

A run that was stopped goes on where it was: every finished seed is kept in DIR/seeds.";

/// Ranges of so much and more are no echo in a recording, unless the user says otherwise [m].
const READINGS_LIMIT_M: f64 = 5.0;

/// Laser against ultrasonic: the same robot, world, way and seconds, over many seeds, and a report.
#[derive(Args, Clone, Debug)]
#[command(after_long_help = JSON_HELP)]
pub struct Options {
    /// A scenario (.toml), or an SDF world [default: worlds/compare.toml]
    pub scenario: Option<PathBuf>,
    /// How many seeds, counted up from the scenario's own
    #[arg(long, value_name = "N", default_value_t = 20)]
    pub seeds: u64,
    /// Directory for all results [default: out/compare/FILE]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Which sensors are at work
    #[arg(long, value_enum, value_name = "WHICH", value_delimiter = ',', num_args = 0..=1, default_values_t = [Sensor::Laser, Sensor::Sonar])]
    pub sensors: Vec<Sensor>,
    /// Seeds at a time [default: as many as there are processors]
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Leave out view.rrd, the first seed with both sensors for the viewer
    #[arg(long)]
    pub no_recording: bool,
    /// Ranges [m] that a real robot's ring read, for the report: a text table, a scan a row, a transducer a column
    #[arg(long, value_name = "FILE")]
    pub readings: Option<PathBuf>,
    /// The scenario whose ring and room are held against --readings [default: worlds/sonar_room.toml]
    #[arg(long, value_name = "FILE", requires = "readings")]
    pub readings_world: Option<PathBuf>,
    /// Ranges of so much and more count as no echo, in --readings and its simulation [m] [default: 5]
    #[arg(long, value_name = "M", requires = "readings")]
    pub readings_limit: Option<f64>,
    /// Print one JSON object on stdout instead of a summary on stderr
    #[arg(long)]
    pub json: bool,
    /// Where else `model://` is looked up
    #[arg(long, value_name = "DIR")]
    pub model_path: Vec<PathBuf>,
}

/// A sensor by its name on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Sensor {
    /// The range finder.
    Laser,
    /// The ultrasonic ring.
    Sonar,
}

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    let path = options.scenario.clone().unwrap_or_else(|| PathBuf::from("worlds/compare.toml"));
    let sensors = Sensors {
        laser: options.sensors.contains(&Sensor::Laser),
        ultrasonic: options.sensors.contains(&Sensor::Sonar),
    };
    let sensors = sensors.validated().map_err(|fault| Fault { what: "--sensors".into(), ..fault })?;
    let scenario = Scenario::load(&path, &options.model_path)?;
    let dir = options.out.clone().unwrap_or_else(|| Path::new("out/compare").join(stem(&path)));
    let recorded = recorded(&options)?;
    let threads = options.threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
    make_out(&dir)?;
    let fingerprint = fingerprint(&scenario, sensors);
    let seeds_dir = dir.join("seeds");
    let plan = Plan {
        scenario: &scenario,
        fingerprint: &fingerprint,
        seeds: options.seeds,
        sensors,
        threads,
        dir: &seeds_dir,
    };
    let readings = simulated(recorded, threads)?;
    if stop_requested() {
        tell!("stopped while the ring's readings were simulated: the same command begins again");
        return Ok(Exit::Lossy);
    }
    let bar = progress_bar(Some(1000));
    bar.set_message(format!("{} seeds", options.seeds));
    let outcome = run_all(&plan, interrupted(), &|thousandths| bar.set_position(thousandths));
    bar.finish_and_clear();
    let outcome = outcome?;
    for fault in &outcome.redone {
        tell!("metromap: done again: {fault}");
    }
    if outcome.trials.is_empty() {
        tell!("stopped with {} of {} seeds done: the same command goes on", outcome.done, options.seeds);
        return Ok(if stop_requested() { Exit::Lossy } else { Exit::Done });
    }
    tell_refused(&outcome.trials);
    let found = sum_up(&scenario, &fingerprint, sensors, &outcome.trials)?;
    let shown = outcome.trials.iter().find_map(|trial| trial.shown.as_ref());
    let mut value = json(&found)?;
    if let Some(readings) = &readings {
        value["readings"] =
            serde_json::to_value(readings).map_err(|e| Fault::new("--readings", e, "numbers that JSON can hold"))?;
    }
    let files = ["compare.json", "compare.csv", "report.html", "view.rrd"].map(|name| dir.join(name));
    let written = if options.no_recording { &files[..3] } else { &files[..] };
    value["files"] = written.iter().map(|file| file.display().to_string()).collect::<Vec<_>>().into();
    let extra = readings.as_ref().map(ring_against_readings).unwrap_or_default();
    let texts = [format!("{value:#}\n"), csv(&found), page(&found, shown, &extra)?];
    for (file, text) in files.iter().zip(&texts) {
        write_whole(file, text.as_bytes())?;
    }
    let first = scenario_of(&scenario, scenario.seed, sensors);
    let is_whole = if options.no_recording {
        leave_out(&files[3], &fingerprint)?
    } else {
        record(&files[3], &first, &fingerprint)?
    };
    value["redone"] = outcome.redone.len().into();
    value["kept"] = outcome.kept.into();
    if options.json {
        answer(&value)?;
    } else {
        for sentence in verdict(&found).into_iter().chain(readings.iter().flat_map(Readings::sentences)) {
            tell!("{sentence}");
        }
        tell!("open {}", files[2].display());
    }
    if !is_whole {
        tell!("stopped before {} was whole: the same command goes on", files[3].display());
        return Ok(Exit::Lossy);
    }
    Ok(Exit::Done)
}

/// Tells what the pipeline refused: seeds in which a sensor was partly deaf or blind are no fair comparison.
fn tell_refused(trials: &[Trial]) {
    let refused = |sensor: usize| trials.iter().map(|trial| trial.refused[sensor]).sum::<u64>();
    match [refused(LASER), refused(ULTRASONIC)] {
        [0, 0] => {}
        [captures, readings] => {
            tell!(
                "metromap: not used: {captures} captures and {readings} ultrasonic readings, refused by the pipeline"
            );
        }
    }
}

/// A recording of something else does not stay beside the report.
fn leave_out(path: &Path, fingerprint: &str) -> Result<bool> {
    let mark = path.with_extension("of");
    if mark.exists() && !std::fs::read_to_string(&mark).is_ok_and(|of| of == fingerprint) {
        for file in [path, &mark] {
            std::fs::remove_file(file).or_else(|e| if file.exists() { Err(Fault::io(file, &e)) } else { Ok(()) })?;
        }
        tell!("metromap: removed {}, which was of another comparison", path.display());
    }
    Ok(true)
}

/// What was recorded of a real ring, if the user named it: read before anything long begins.
fn recorded(options: &Options) -> Result<Option<Recorded>> {
    let Some(file) = &options.readings else { return Ok(None) };
    let world = options.readings_world.clone().unwrap_or_else(|| PathBuf::from("worlds/sonar_room.toml"));
    Recorded::load(file, &world, options.readings_limit.unwrap_or(READINGS_LIMIT_M), &options.model_path).map(Some)
}

/// Recorded readings beside simulated ones; `None` without any, or if the user stopped it.
fn simulated(recorded: Option<Recorded>, threads: usize) -> Result<Option<Readings>> {
    let Some(recorded) = recorded else { return Ok(None) };
    let bar = progress_bar(Some(1000));
    bar.set_message(format!("the ring's readings in {}", recorded.world()));
    let readings = recorded.compare(threads, interrupted(), &|thousandths| bar.set_position(thousandths));
    bar.finish_and_clear();
    readings
}

/// Drives the first seed once more into a file for the viewer, unless it is there already; whether it is whole.
fn record(path: &Path, scenario: &Scenario, fingerprint: &str) -> Result<bool> {
    let mark = path.with_extension("of");
    if path.exists() && std::fs::read_to_string(&mark).is_ok_and(|of| of == fingerprint) {
        return Ok(true);
    }
    let beside = path.with_extension("part.rrd");
    let mut simulation = Simulation::new(scenario)?;
    let mut judge = Judge::new(&scenario.scene, scenario.pipeline.maps.grid.voxel_m);
    let mut begin = start(&scenario.name, &scenario.rig);
    begin.scene = simulation.pictures();
    begin.transducers = simulation.transducers();
    begin.metadata.push(("seed".into(), scenario.seed.to_string()));
    let sinks: Vec<Box<dyn Sink>> = vec![Box::new(RerunSink::new(&[Target::Save(beside.clone())])?)];
    let pipeline = Pipeline::new(scenario.rig.clone(), scenario.pipeline.clone())?;
    let mut session = Session::begin(pipeline, begin, sinks, Some(1000))?;
    session.progress(0, "one seed for the viewer");
    let driven = drive(&mut session, &mut simulation, &mut judge, false);
    let failed = session.finish();
    driven?;
    if let Some(fault) = failed.into_iter().next() {
        return Err(fault);
    }
    if stop_requested() {
        return Ok(false);
    }
    std::fs::rename(&beside, path).map_err(|e| Fault::io(path, &e))?;
    write_whole(&mark, fingerprint.as_bytes())?;
    Ok(true)
}
