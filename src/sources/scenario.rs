//! Scenario files: a world, a robot with a finder, and a mission. `worlds/*.toml`, or an SDF world as it lies.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Vector3};
use serde::Deserialize;

use super::files::read_text;
use super::obstacles::{CompareParams, line_of_target};
use super::rig_file;
use crate::calibration::finder::drift::DriftParams;
use crate::calibration::finder::shifted;
use crate::fault::{Fault, Result, positive};
use crate::line::LineParams;
use crate::maps::MapParams;
use crate::navigation::{DriveStep, Mission, ScanKind, Step};
use crate::optics::{Laser, Rig};
use crate::pipeline::PipelineParams;
use crate::robot::{RobotParams, StartParams};
use crate::scanner::{ImageParams, Schedule, SweepParams};
use crate::sonar::RingParams;
use crate::world::{Scene, Shape, Source, WorldSpec, load_sdf, toml_fault};

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
    /// The finder as it was calibrated: what the robot believes.
    pub rig: Rig,
    /// The finder as it truly is: the same, unless it was bumped.
    pub true_rig: Rig,
    /// Where the finder looks.
    pub sweep: SweepParams,
    /// How its camera makes images.
    pub image: ImageParams,
    /// The ultrasonic ring beside the finder; `None`: the robot has none.
    pub sonar: Option<RingParams>,
    /// On what terms sensors are compared.
    pub compare: CompareParams,
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
    /// An ultrasonic ring, METRO-I's by default; without the table there is none.
    sonar: Option<RingParams>,
    #[serde(default)]
    compare: CompareParams,
    #[serde(default)]
    maps: MapParams,
    /// On by default over a level ground plane, and off elsewhere.
    drift: Option<DriftParams>,
    #[serde(default)]
    mission: Mission,
}

#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Finder {
    /// A rig.toml, relative to the scenario; METRO-I without one.
    rig: Option<PathBuf>,
    /// How the true finder differs from the rig, by parameter of its calibration: `tilt_rad = 0.005`.
    bumped: BTreeMap<String, f64>,
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
        let image = file.finder.image.validated().map_err(here)?;
        let scene = file.world.build(&source)?;
        let at_key = |fault: Fault| match source.line_of_key(&fault.what) {
            Some(line) => here(fault.at_line(line)),
            None => here(fault),
        };
        let sonar = file.sonar.map(RingParams::validated).transpose().map_err(at_key)?;
        let at_target = |fault: Fault| match line_of_target(&source.text, &fault.what) {
            Some(line) => here(fault.at_line(line)),
            None => at_key(fault),
        };
        let compare = file.compare.validated(&scene).map_err(at_target)?;
        let drift = file.drift.unwrap_or_else(|| drift_over(&scene)).validated().map_err(here)?;
        Ok(Self {
            scene,
            name: file.name,
            seed: file.seed,
            duration_s: file.duration_s,
            start_given: file.robot.is_some(),
            robot: file.robot.unwrap_or_default().validated().map_err(here)?,
            true_rig: bumped(&rig, &file.finder.bumped).map_err(here)?,
            rig: rig.clone(),
            sweep: checked_sweep(file.finder.sweep, &rig).map_err(here)?,
            pipeline: PipelineParams {
                line: told_of_speckle(file.finder.line, &source.text, &image, &rig).validated().map_err(here)?,
                maps: file.maps.validated().map_err(here)?,
                drift,
            },
            image,
            sonar,
            compare,
            mission: file.mission.validated().map_err(here)?,
            text: source.text,
        })
    }

    fn load_world(path: &Path, model_path: &[PathBuf]) -> Result<Self> {
        let stem = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let name = stem.split('.').next().unwrap_or("world").to_string();
        let scene = load_sdf(path, model_path)?;
        let line = told_of_speckle(LineParams::default(), "", &ImageParams::default(), &Rig::metro_i());
        Ok(Self {
            pipeline: PipelineParams { line, drift: drift_over(&scene), ..PipelineParams::default() },
            scene,
            text: format!("name = {name:?}\n\n[world]\nsdf = {:?}\n", path.display().to_string()),
            name,
            seed: 0,
            duration_s: duration_default_s(),
            start_given: false,
            robot: RobotParams::default(),
            rig: Rig::metro_i(),
            true_rig: Rig::metro_i(),
            sweep: SweepParams::default(),
            image: ImageParams::default(),
            sonar: None,
            compare: CompareParams::default(),
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

    /// Moves parameters of the true finder's calibration, as a bump would: the robot goes on believing the old one.
    ///
    /// Errors: a name that is no parameter, or a finder that cannot be.
    pub fn bump(&mut self, by: &BTreeMap<String, f64>) -> Result<()> {
        self.true_rig = bumped(&self.true_rig, by)?;
        Ok(())
    }

    /// Another mission: a full scan at the start and at every goal.
    pub fn visit(&mut self, goals: &[[f64; 2]]) {
        let scan = Step::Scan(ScanKind::Turn);
        let legs = goals.iter().flat_map(|&to_m| [Step::GoTo { to_m, speed_m_s: None }, scan]);
        self.mission.steps = std::iter::once(scan).chain(legs).collect();
    }
}

fn bumped(rig: &Rig, by: &BTreeMap<String, f64>) -> Result<Rig> {
    if by.is_empty() {
        return Ok(rig.clone());
    }
    shifted(rig, by).map_err(|fault| Fault { what: format!("finder.bumped: {}", fault.what), ..fault })
}

/// Parameters of the extraction with the camera's own speckle in σ, unless the scenario's text says otherwise: no image
/// shows it, so who knows the camera must tell.
fn told_of_speckle(line: LineParams, text: &str, image: &ImageParams, rig: &Rig) -> LineParams {
    let table = toml::from_str::<toml::Table>(text).unwrap_or_default();
    let said = table.get("finder").and_then(|finder| finder.get("line")?.get("sigma_min_px")).is_some();
    if said { line } else { LineParams { sigma_min_px: image.speckle_sigma_px(rig) as f32, ..line } }
}

/// The calibration is watched where the ground is a level plane at height 0.
fn drift_over(scene: &Scene) -> DriftParams {
    let level = |pose: &Isometry3<f64>| (pose * Vector3::z()).z > 1.0 - 1e-9 && pose.translation.z.abs() < 1e-6;
    let flat_floor = scene.bodies.iter().any(|body| body.ground && body.shape == Shape::Plane && level(&body.pose));
    DriftParams { flat_floor, ..DriftParams::default() }
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
