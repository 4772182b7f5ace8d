//! Scenario files: a world, a robot with a finder, and a mission. `worlds/*.toml`, or an SDF world as it lies.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::files::read_text;
use super::rig_file;
use crate::fault::{Fault, Result, positive};
use crate::line::LineParams;
use crate::maps::MapParams;
use crate::navigation::{DriveStep, Mission, ScanKind, Step};
use crate::optics::{Laser, Rig};
use crate::pipeline::PipelineParams;
use crate::robot::{RobotParams, StartParams};
use crate::scanner::{ImageParams, Schedule, SweepParams};
use crate::world::{Scene, Source, WorldSpec, load_sdf, toml_fault};

/// Longest scenario file read.
const FILE_BYTES_MAX: u64 = 16 << 20;

/// Everything a simulated run needs.
#[derive(Clone, Debug)]
pub struct Scenario {
    /// Its name: results go to `out/NAME`.
    pub name: String,
    /// Seed of every random draw.
    pub seed: u64,
    /// The run ends here at the latest [s].
    pub duration_s: f64,
    /// The world.
    pub scene: Scene,
    /// The robot.
    pub robot: RobotParams,
    /// The finder as it truly is.
    pub rig: Rig,
    /// Where the finder looks.
    pub sweep: SweepParams,
    /// How its camera makes images.
    pub image: ImageParams,
    /// How lines are found and maps are made.
    pub pipeline: PipelineParams,
    /// What the robot does.
    pub mission: Mission,
    /// The file as it was read, to ride along in recordings.
    pub text: String,
    /// Whether the start was given; an SDF world does not say.
    pub start_given: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    name: String,
    #[serde(default)]
    seed: u64,
    #[serde(default = "duration_default_s")]
    duration_s: f64,
    world: WorldSpec,
    robot: Option<RobotParams>,
    #[serde(default)]
    finder: Finder,
    #[serde(default)]
    maps: MapParams,
    #[serde(default)]
    mission: Mission,
}

#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Finder {
    /// A rig.toml, relative to the scenario; METRO-I without one.
    rig: Option<PathBuf>,
    sweep: Option<SweepParams>,
    image: ImageParams,
    line: LineParams,
}

fn duration_default_s() -> f64 {
    600.0
}

impl Scenario {
    /// Reads a scenario (`.toml`) or an SDF world (`.sdf`, `.world`, either also with `.gz`). `model_path`: where
    /// `model://` is looked up besides the usual places.
    pub fn load(path: &Path, model_path: &[PathBuf]) -> Result<Self> {
        let name = path.file_name().map(|n| n.to_string_lossy().to_lowercase()).unwrap_or_default();
        if name.ends_with(".toml") {
            Self::load_toml(path, model_path)
        } else if [".sdf", ".world", ".sdf.gz", ".world.gz"].iter().any(|end| name.ends_with(end)) {
            Self::load_world(path, model_path)
        } else {
            let expected = "a scenario (.toml) or an SDF world (.sdf, .world, .sdf.gz, .world.gz)";
            Err(Fault::new("file name", format!("`{name}`"), expected).in_file(path))
        }
    }

    fn load_toml(path: &Path, model_path: &[PathBuf]) -> Result<Self> {
        let text = read_text(path, FILE_BYTES_MAX)?;
        let source = Source { file: path.to_path_buf(), text, model_path: model_path.to_vec() };
        let file: File = toml::from_str(&source.text).map_err(|e| toml_fault(&source, &e))?;
        let here = |fault: Fault| fault.in_file(path);
        let rig = match &file.finder.rig {
            Some(rig) => rig_file::load(&path.parent().unwrap_or(Path::new(".")).join(rig))?.rig,
            None => Rig::metro_i(),
        };
        let rig = rig.validated().map_err(here)?;
        positive("duration_s", file.duration_s).map_err(here)?;
        if file.name.is_empty() || file.name.contains(['/', '\\']) || file.name.starts_with('.') {
            return Err(here(Fault::new("name", format!("{:?}", file.name), "a name that can be a directory")));
        }
        Ok(Self {
            scene: file.world.build(&source)?,
            name: file.name,
            seed: file.seed,
            duration_s: file.duration_s,
            start_given: file.robot.is_some(),
            robot: file.robot.unwrap_or_default().validated().map_err(here)?,
            rig: rig.clone(),
            sweep: checked_sweep(file.finder.sweep, &rig).map_err(here)?,
            image: file.finder.image.validated().map_err(here)?,
            pipeline: PipelineParams {
                line: file.finder.line.validated().map_err(here)?,
                maps: file.maps.validated().map_err(here)?,
            },
            mission: file.mission.validated().map_err(here)?,
            text: source.text,
        })
    }

    fn load_world(path: &Path, model_path: &[PathBuf]) -> Result<Self> {
        let stem = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let name = stem.split('.').next().unwrap_or("world").to_string();
        Ok(Self {
            scene: load_sdf(path, model_path)?,
            text: format!("name = {name:?}\n\n[world]\nsdf = {:?}\n", path.display().to_string()),
            name,
            seed: 0,
            duration_s: duration_default_s(),
            start_given: false,
            robot: RobotParams::default(),
            rig: Rig::metro_i(),
            sweep: SweepParams::default(),
            image: ImageParams::default(),
            pipeline: PipelineParams::default(),
            mission: look_and_move(),
        })
    }
}

impl Scenario {
    /// Starts the robot elsewhere: x, y [m], yaw [degrees].
    pub fn place_robot(&mut self, x_m: f64, y_m: f64, yaw_deg: f64) {
        self.robot.start = StartParams { x_m, y_m, yaw_deg };
        self.start_given = true;
    }

    /// Another mission: a full scan at the start and at every goal.
    pub fn visit(&mut self, goals: &[[f64; 2]]) {
        let scan = Step::Scan(ScanKind::Turn);
        let legs = goals.iter().flat_map(|&to_m| [Step::GoTo { to_m, speed_m_s: None }, scan]);
        self.mission.steps = std::iter::once(scan).chain(legs).collect();
    }
}

/// A sweep that the finder's axes can make; one that does not tilt its laser looks straight on unless told otherwise.
fn checked_sweep(sweep: Option<SweepParams>, rig: &Rig) -> Result<SweepParams> {
    let sweep = match (sweep, &rig.laser) {
        (Some(sweep), _) => sweep,
        (None, Laser::Mirror(_)) => SweepParams::default(),
        (None, Laser::Plane(_)) => {
            let still = Schedule::Table { stops: vec![vec![0, 0]] };
            let lines = vec![0];
            SweepParams { lines, driving: still.clone(), turn: still.clone(), view: still, ..SweepParams::default() }
        }
    };
    let sweep = sweep.validated()?;
    for (what, schedule) in [("driving", &sweep.driving), ("turn", &sweep.turn), ("view", &sweep.view)] {
        let named = |fault: Fault| Fault { what: format!("finder.sweep.{what}: {}", fault.what), ..fault };
        sweep.stops(schedule, rig).map_err(named)?;
    }
    Ok(sweep)
}

/// The mission in a world that brings none: look around, drive 2 m ahead as far as the map shows it free, look again.
fn look_and_move() -> Mission {
    let scan = Step::Scan(ScanKind::Turn);
    let ahead = Step::Drive(DriveStep { v_m_s: 0.25, omega_rad_s: 0.0, seconds: 8.0, blind: false });
    Mission { steps: vec![scan, ahead, scan] }
}
