//! `rig.toml`: a finder, real or simulated, as a file; and the camera of a ROS `camera_info` YAML.
//!
//! ```toml
//! version = 1
//! name = "robot floor"
//! range_m_max = 4.5             # points farther from the robot's origin are not used
//! beam_sigma_rad = 0.0          # standard deviations of the two angles
//! cylinder_sigma_rad = 0.0
//!
//! [camera]                      # or: camera_info = "camera.yaml", beside this file
//! width = 640
//! height = 480
//! fx = 514.4
//! fy = 685.9
//! cx = 329.8
//! cy = 237.7
//! distortion = { model = "pinhole" }   # tsai: k; brown_conrady: k1 k2 p1 p2 k3
//!
//! [mount]                       # the camera on the cylinder: x forward, y left, z up
//! position_m = [0.0, 0.0, 0.2]
//! tilt_deg = 21.1               # down; also pan (to the left) and roll, each _deg or _rad
//! # rotation = [x, y, z, w]     # instead: the optical camera's quaternion, taken as it is
//!
//! [laser]                       # kind = "mirror": mirror_m, beam = {zero_rad, rad_per_pulse, pulse_min, pulse_max}, roll_rad
//! kind = "plane"                # n·x = d in the camera's optical frame
//! normal = [0.045, -0.937, 0.346]
//! offset_m = 0.166
//! ```
//!
//! May be left out: `[sheet]`, `[cylinder]` (an axis), `[finder]` (position_m, rotation on the robot), `[images]`, `[line]`, `[maps]`,
//! `[covariance]` (what its calibration does not know: `parameters = ["tilt_rad", ...]`, `matrix = [[...], ...]`),
//! `[drift]` (`flat_floor = true`: the calibration is watched while the images are mapped).

use std::path::{Path, PathBuf};

use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::files::read_text;
use super::images::ImagesSpec;
use crate::calibration::finder::drift::DriftParams;
use crate::fault::{Fault, Result, exactly, exactly_if_there, number_within};
use crate::geometry::Transform;
use crate::line::LineParams;
use crate::maps::MapParams;
use crate::optics::{Axis, Camera, Distortion, Laser, Rig, RigCovariance, Sheet};

/// The version of the format that is written, and the newest one that is read.
const VERSION: i64 = 1;
/// Largest file that is read [bytes].
const FILE_BYTES_MAX: u64 = 1 << 20;

/// All that a rig file says.
#[derive(Clone, Debug, PartialEq)]
pub struct RigFile {
    /// Where it was read from: other paths in it are relative to this.
    pub path: PathBuf,
    /// The finder.
    pub rig: Rig,
    /// Images taken with it.
    pub images: Option<ImagesSpec>,
    /// How its line is found.
    pub line: LineParams,
    /// How its maps are made.
    pub maps: MapParams,
    /// Whether its calibration is watched.
    pub drift: DriftParams,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Document {
    version: i64,
    name: String,
    range_m_max: f64,
    #[serde(default)]
    beam_sigma_rad: f64,
    #[serde(default)]
    cylinder_sigma_rad: f64,
    camera: CameraTable,
    mount: Mount,
    laser: Laser,
    #[serde(default)]
    sheet: Sheet,
    #[serde(default = "still")]
    cylinder: Axis,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    finder: Option<Mount>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    images: Option<ImagesSpec>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    line: Option<LineParams>,
    maps: Option<MapParams>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    drift: Option<DriftParams>,
    #[serde(default, skip_serializing_if = "RigCovariance::is_empty")]
    covariance: RigCovariance,
}

fn still() -> Axis {
    Axis::FIXED
}

/// Either a file or all the numbers.
#[derive(Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct CameraTable {
    #[serde(skip_serializing_if = "Option::is_none")]
    camera_info: Option<PathBuf>,
    #[serde(skip_serializing_if = "Option::is_none")]
    width: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    height: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fx: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fy: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cx: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cy: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    distortion: Option<Distortion>,
}

/// A position with either a quaternion or angles.
#[derive(Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Mount {
    #[serde(deserialize_with = "exactly")]
    position_m: [f64; 3],
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "exactly_if_there")]
    rotation: Option<[f64; 4]>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    tilt_deg: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    tilt_rad: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pan_deg: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pan_rad: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    roll_deg: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    roll_rad: Option<f64>,
}

/// Reads a rig file.
///
/// Errors name the file and, where it is known, the line: unknown keys, a newer version, numbers that make no finder.
pub fn load(path: &Path) -> Result<RigFile> {
    parse(&read_text(path, FILE_BYTES_MAX)?, path)
}

/// The same from text; `path` is what errors name, and what other files are looked up beside.
pub fn parse(text: &str, path: &Path) -> Result<RigFile> {
    let document = document(text).map_err(|fault| fault.in_file(path))?;
    assembled(document, path).map_err(|fault| {
        let line = if fault.file.is_none() { line_of(text, &fault.what) } else { None };
        let fault = fault.in_file(path);
        match line {
            Some(line) => fault.at_line(line),
            None => fault,
        }
    })
}

/// Only the camera: of a rig file, which may have nothing else, or a ROS `camera_info` file (`.yaml`, `.yml`).
///
/// Errors: those of `load`, as far as they are about the version and the camera.
pub fn load_camera(path: &Path) -> Result<Camera> {
    if path.extension().is_some_and(|e| e == "yaml" || e == "yml") {
        return camera_info(path);
    }
    let text = read_text(path, FILE_BYTES_MAX)?;
    let placed = |fault: Fault| match line_of(&text, &fault.what) {
        Some(line) if fault.file.is_none() => fault.in_file(path).at_line(line),
        _ => fault.in_file(path),
    };
    let mut table = versioned(&text).map_err(placed)?;
    let nothing = || Fault::new("camera", "nothing", "a table [camera], or a camera_info file");
    let camera = table.remove("camera").ok_or_else(|| placed(nothing()))?;
    let camera: CameraTable =
        camera.try_into().map_err(|e: toml::de::Error| placed(Fault::new("camera", e.message(), "a camera")))?;
    camera.camera(path).and_then(Camera::validated).map_err(placed)
}

/// The whole rig, or `None` if the file is about a camera only: a ROS `camera_info` file, or neither mount nor laser in it.
///
/// Errors: those of `load`.
pub fn load_if_whole(path: &Path) -> Result<Option<RigFile>> {
    if path.extension().is_some_and(|e| e == "yaml" || e == "yml") {
        return Ok(None);
    }
    let text = read_text(path, FILE_BYTES_MAX)?;
    let table = versioned(&text).map_err(|fault| fault.in_file(path))?;
    if table.contains_key("mount") || table.contains_key("laser") { parse(&text, path).map(Some) } else { Ok(None) }
}

/// A rig file of which only the camera is known yet; `load_camera` reads it back bit for bit.
pub fn camera_to_toml(name: &str, camera: &Camera) -> String {
    #[derive(Serialize)]
    struct Partial {
        version: i64,
        name: String,
        camera: CameraTable,
    }
    let document = Partial { version: VERSION, name: name.into(), camera: CameraTable::of(camera) };
    // Strings, numbers and tables of them: there is nothing in a camera that TOML cannot hold.
    toml::to_string(&document).unwrap_or_default()
}

/// The finder as text that `parse` reads back bit for bit.
pub fn to_toml(rig: &Rig) -> String {
    let stored = |xyz: Vector3<f64>, q: [f64; 4]| Mount {
        position_m: [xyz.x, xyz.y, xyz.z],
        rotation: Some(q),
        ..Mount::default()
    };
    let document = Document {
        version: VERSION,
        name: rig.name.clone(),
        range_m_max: rig.range_m_max,
        beam_sigma_rad: rig.beam_sigma_rad,
        cylinder_sigma_rad: rig.cylinder_sigma_rad,
        camera: CameraTable::of(&rig.camera),
        mount: stored(rig.sensor_from_camera.xyz(), rig.sensor_from_camera.quaternion()),
        laser: rig.laser,
        sheet: rig.sheet,
        cylinder: rig.cylinder,
        finder: Some(stored(rig.robot_from_finder.xyz(), rig.robot_from_finder.quaternion())),
        images: None,
        line: None,
        maps: None,
        drift: None,
        covariance: rig.covariance.clone(),
    };
    // Strings, numbers and tables of them: there is nothing in a rig that TOML cannot hold.
    toml::to_string(&document).unwrap_or_default()
}

fn document(text: &str) -> Result<Document> {
    versioned(text)?;
    toml::from_str(text).map_err(|error| wrong(text, &error))
}

/// The file as a table. The version is looked at first: a newer file has keys that this one does not know.
fn versioned(text: &str) -> Result<toml::Table> {
    let table: toml::Table = toml::from_str(text).map_err(|error| wrong(text, &error))?;
    if let Some(version) = table.get("version").and_then(toml::Value::as_integer).filter(|v| *v != VERSION) {
        let expected = if version > VERSION { "1: a newer metromap wrote this file" } else { "1" };
        let fault = Fault::new("version", version, expected);
        return Err(match line_of(text, "version") {
            Some(line) => fault.at_line(line),
            None => fault,
        });
    }
    Ok(table)
}

fn wrong(text: &str, error: &toml::de::Error) -> Fault {
    let fault = Fault::new("rig file", error.message(), "a rig of version 1");
    match error.span() {
        Some(span) => fault.at_line(text[..span.start.min(text.len())].matches('\n').count() + 1),
        None => fault,
    }
}

fn assembled(document: Document, path: &Path) -> Result<RigFile> {
    let laser = document.laser;
    if let Laser::Plane(plane) = laser {
        for value in plane.normal.into_iter().chain([plane.offset_m]).chain(plane.origin_m.unwrap_or_default()) {
            number_within("laser", value, -1e6, 1e6)?;
        }
    }
    let robot_from_finder = match document.finder {
        Some(finder) => finder.pose("finder", Rotation3::identity())?,
        None => Transform::identity(),
    };
    let rig = Rig {
        name: document.name,
        camera: document.camera.camera(path)?,
        sensor_from_camera: document.mount.pose("mount", optical())?,
        laser,
        sheet: document.sheet,
        cylinder: document.cylinder,
        robot_from_finder,
        beam_sigma_rad: document.beam_sigma_rad,
        cylinder_sigma_rad: document.cylinder_sigma_rad,
        range_m_max: document.range_m_max,
        covariance: document.covariance,
    };
    let images = document.images.map(ImagesSpec::validated).transpose()?;
    let line = document.line.unwrap_or_default().validated()?;
    let maps = document.maps.unwrap_or_default().validated()?;
    let drift = document.drift.unwrap_or_default().validated()?;
    Ok(RigFile { path: path.to_path_buf(), rig: rig.validated()?, images, line, maps, drift })
}

impl CameraTable {
    fn of(camera: &Camera) -> Self {
        Self {
            camera_info: None,
            width: Some(camera.width),
            height: Some(camera.height),
            fx: Some(camera.fx),
            fy: Some(camera.fy),
            cx: Some(camera.cx),
            cy: Some(camera.cy),
            distortion: Some(camera.distortion),
        }
    }

    fn camera(self, rig_path: &Path) -> Result<Camera> {
        let numbers = [self.fx, self.fy, self.cx, self.cy];
        if let Some(info) = self.camera_info {
            if self.width.or(self.height).is_some() || numbers.iter().any(Option::is_some) || self.distortion.is_some()
            {
                let expected = "either camera_info or the camera's own numbers";
                return Err(Fault::new("camera.camera_info", "both", expected));
            }
            return camera_info(&rig_path.parent().unwrap_or(Path::new("")).join(info));
        }
        let missing = |name: &str| Fault::new(format!("camera.{name}"), "nothing", "a number, or camera.camera_info");
        Ok(Camera {
            width: self.width.ok_or_else(|| missing("width"))?,
            height: self.height.ok_or_else(|| missing("height"))?,
            fx: self.fx.ok_or_else(|| missing("fx"))?,
            fy: self.fy.ok_or_else(|| missing("fy"))?,
            cx: self.cx.ok_or_else(|| missing("cx"))?,
            cy: self.cy.ok_or_else(|| missing("cy"))?,
            distortion: self.distortion.unwrap_or(Distortion::Pinhole),
        })
    }
}

impl Mount {
    /// The pose; `unturned` is the rotation at tilt, pan and roll 0.
    fn pose<To, From>(&self, what: &str, unturned: Rotation3<f64>) -> Result<Transform<To, From>> {
        for value in self.position_m {
            number_within(&format!("{what}.position_m"), value, -1e4, 1e4)?;
        }
        let one = |name: &str, deg: Option<f64>, rad: Option<f64>| -> Result<Option<f64>> {
            let angle = match (deg, rad) {
                (Some(_), Some(_)) => {
                    return Err(Fault::new(format!("{what}.{name}_deg"), "both _deg and _rad", "one of them"));
                }
                (Some(deg), None) => deg.to_radians(),
                (None, Some(rad)) => rad,
                (None, None) => return Ok(None),
            };
            number_within(&format!("{what}.{name}"), angle, -7.0, 7.0).map(Some)
        };
        let tilt = one("tilt", self.tilt_deg, self.tilt_rad)?;
        let pan = one("pan", self.pan_deg, self.pan_rad)?;
        let roll = one("roll", self.roll_deg, self.roll_rad)?;
        if let Some(q) = self.rotation {
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            if length.is_nan() || (length - 1.0).abs() > 1e-6 {
                return Err(Fault::new(
                    format!("{what}.rotation"),
                    format!("length {length}"),
                    "a unit quaternion [x, y, z, w]",
                ));
            }
            if tilt.or(pan).or(roll).is_some() {
                return Err(Fault::new(format!("{what}.rotation"), "angles too", "either a quaternion or angles"));
            }
            return Ok(Transform::from_stored(self.position_m, q));
        }
        // About the fixed x, y, z axes in this order: roll, tilt (nose down), pan (to the left).
        let turn = Rotation3::from_euler_angles(roll.unwrap_or(0.0), tilt.unwrap_or(0.0), pan.unwrap_or(0.0));
        let q = UnitQuaternion::from_rotation_matrix(&(turn * unturned));
        Ok(Transform::from_stored(self.position_m, [q.i, q.j, q.k, q.w]))
    }
}

/// A camera that looks along x: its x (right) is −y, its y (down) is −z, its z (view) is x.
fn optical() -> Rotation3<f64> {
    Rotation3::from_matrix_unchecked(nalgebra::Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0))
}

/// The line (from 1) on which a field such as `camera.fx` stands, or else its table.
fn line_of(text: &str, field: &str) -> Option<usize> {
    let (table, key) = field.split_once('.').unwrap_or(("", field));
    let key = key.split('.').next().unwrap_or(key);
    let (mut at_table, mut current) = (None, String::new());
    for (i, line) in text.lines().map(str::trim).enumerate() {
        if let Some(name) = line.strip_prefix('[').and_then(|l| l.split(']').next()) {
            current = name.trim().to_string();
            if at_table.is_none() && (current == table || current == field) {
                at_table = Some(i + 1);
            }
        } else if current == table && line.split('=').next().is_some_and(|word| word.trim() == key) {
            return Some(i + 1);
        }
    }
    at_table
}

/// The parts of a ROS camera calibration file that matter here.
#[derive(Deserialize)]
struct CameraInfo {
    image_width: usize,
    image_height: usize,
    camera_matrix: Matrix,
    distortion_model: String,
    distortion_coefficients: Matrix,
}

#[derive(Deserialize)]
struct Matrix {
    rows: usize,
    cols: usize,
    data: Vec<f64>,
}

/// Reads a ROS `camera_info` YAML: its camera matrix and `plumb_bob` distortion, for images as they are (not rectified).
pub fn camera_info(path: &Path) -> Result<Camera> {
    let text = read_text(path, FILE_BYTES_MAX)?;
    let info: CameraInfo = serde_saphyr::from_str(&text).map_err(|error| {
        let fault = Fault::new("camera info", first_line(&error.to_string()), "a ROS camera calibration").in_file(path);
        match error.location() {
            Some(location) => fault.at_line(location.line() as usize),
            None => fault,
        }
    })?;
    camera_of(&info).and_then(Camera::validated).map_err(|fault| fault.in_file(path))
}

fn first_line(text: &str) -> &str {
    text.lines().next().unwrap_or_default()
}

fn camera_of(info: &CameraInfo) -> Result<Camera> {
    let matrix = &info.camera_matrix;
    let (shape, data) = ((matrix.rows, matrix.cols), matrix.data.as_slice());
    let &[fx, skew, cx, zero, fy, cy, a, b, one] = data else {
        return Err(Fault::new("camera_matrix", format!("{} numbers", data.len()), "9"));
    };
    if shape != (3, 3) || [skew, zero, a, b] != [0.0; 4] || one != 1.0 {
        return Err(Fault::new("camera_matrix", format!("{data:?}"), "3 x 3: fx 0 cx 0 fy cy 0 0 1"));
    }
    let coefficients = &info.distortion_coefficients;
    if coefficients.rows.checked_mul(coefficients.cols) != Some(coefficients.data.len()) {
        let expected = format!("{} x {}", coefficients.rows, coefficients.cols);
        return Err(Fault::new("distortion_coefficients", format!("{} numbers", coefficients.data.len()), expected));
    }
    let distortion = match (info.distortion_model.as_str(), coefficients.data.as_slice()) {
        ("plumb_bob", &[k1, k2, p1, p2]) => Distortion::BrownConrady { k1, k2, p1, p2, k3: 0.0 },
        ("plumb_bob", &[k1, k2, p1, p2, k3]) => Distortion::BrownConrady { k1, k2, p1, p2, k3 },
        ("plumb_bob", other) => {
            return Err(Fault::new(
                "distortion_coefficients",
                format!("{} numbers", other.len()),
                "4 or 5 for plumb_bob",
            ));
        }
        (other, _) => return Err(Fault::new("distortion_model", other, "plumb_bob")),
    };
    Ok(Camera { width: info.image_width, height: info.image_height, fx, fy, cx, cy, distortion })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::{MirrorLaser, PlaneLaser};
    use proptest::prelude::*;

    const GOOD: &str = r#"version = 1
name = "test"
range_m_max = 4.5

[camera]
width = 640
height = 480
fx = 514.4
fy = 685.9
cx = 329.8
cy = 237.7

[mount]
position_m = [0.1, 0.0, 0.2]
tilt_deg = 20.0

[laser]
kind = "plane"
normal = [0.0, -0.937, 0.346]
offset_m = 0.166
"#;

    fn read_text(text: &str) -> Result<RigFile> {
        parse(text, Path::new("some/rig.toml"))
    }

    #[test]
    fn a_rig_comes_back_bit_for_bit() {
        let rig = Rig::metro_i();
        assert_eq!(read_text(&to_toml(&rig)).unwrap().rig, rig);
        let rig = read_text(GOOD).unwrap().rig;
        assert_eq!(read_text(&to_toml(&rig)).unwrap().rig, rig);
    }

    proptest! {
        #[test]
        fn any_rig_comes_back_bit_for_bit(
            xyz in prop::array::uniform3(-9.0..9.0f64), rpy in prop::array::uniform3(-3.0..3.0f64),
            k in prop::array::uniform5(-0.9..0.9f64), n in prop::array::uniform3(0.1..1.0f64), mirror: bool,
            sigma in 1e-9..1e-3f64, name in "\\PC{0,20}",
        ) {
            let [k1, k2, p1, p2, k3] = k;
            let plane = PlaneLaser { normal: n, offset_m: 3.0 + k1, origin_m: (k2 > 0.0).then_some(xyz) };
            let metro = Rig::metro_i();
            let rig = Rig {
                name,
                camera: Camera { distortion: Distortion::BrownConrady { k1, k2, p1, p2, k3 }, ..metro.camera },
                sensor_from_camera: Transform::from_xyz_rpy(xyz, rpy),
                robot_from_finder: Transform::from_xyz_rpy(rpy, xyz),
                laser: if mirror { metro.laser } else { Laser::Plane(plane) },
                beam_sigma_rad: sigma,
                ..metro
            };
            if let Ok(rig) = rig.validated() {
                prop_assert_eq!(read_text(&to_toml(&rig)).unwrap().rig, rig);
            }
        }

        #[test]
        fn a_damaged_file_is_never_a_panic(at in 0usize..GOOD.len(), byte in any::<u8>(), cut: bool) {
            let mut bytes = GOOD.as_bytes().to_vec();
            if cut { bytes.truncate(at) } else { bytes[at] = byte }
            let _ = read_text(&String::from_utf8_lossy(&bytes));
        }
    }

    #[test]
    fn tilt_pan_and_roll_turn_the_camera_as_they_say() {
        let mount = |text: &str| read_text(&GOOD.replace("tilt_deg = 20.0", text)).unwrap().rig.sensor_from_camera;
        let sees = |text: &str, v: Vector3<f64>| mount(text).rotate(&v);
        let near = |a: Vector3<f64>, b: [f64; 3]| (a - Vector3::from(b)).norm() < 1e-12;
        assert!(near(sees("", Vector3::z()), [1.0, 0.0, 0.0]));
        assert!(near(sees("", Vector3::x()), [0.0, -1.0, 0.0]));
        assert!(near(sees("tilt_deg = 90", Vector3::z()), [0.0, 0.0, -1.0]));
        assert!(near(sees("pan_deg = 90", Vector3::z()), [0.0, 1.0, 0.0]));
        assert!(near(sees("roll_deg = 90", Vector3::x()), [0.0, 0.0, -1.0]));
        assert!(near(sees("tilt_rad = 0.3\npan_deg = 90", Vector3::z()), [0.0, 0.3f64.cos(), -0.3f64.sin()]));
        // The same as the paper's mount.
        let metro = Rig::metro_i().sensor_from_camera;
        let turned = mount("tilt_rad = 0.484");
        assert!(turned.iso.rotation.angle_to(&metro.iso.rotation) < 1e-12);
    }

    #[test]
    fn a_mirror_rig_and_all_optional_tables_are_read() {
        let (head, _) = GOOD.split_once("[laser]").unwrap();
        let text = format!(
            "{head}[laser]\nkind = \"mirror\"\nmirror_m = [0.0, 0.0, 0.8]\nbeam = {{ zero_rad = 0.3, rad_per_pulse = 0.001, \
             pulse_min = -5, pulse_max = 9 }}\n[cylinder]\nzero_rad = 0.0\nrad_per_pulse = 0.001\npulse_min = 0\npulse_max = 1\n\
             [sheet]\nwaist_m = 0.001\n[finder]\nposition_m = [0.0, 0.0, 0.1]\n[images]\nstep_m = 0.1\nperiod_s = 1.0\n\
             [line]\nestimator = \"gauss3\"\n"
        );
        let file = read_text(&text).unwrap();
        assert!(matches!(file.rig.laser, Laser::Mirror(MirrorLaser { roll_rad, .. }) if roll_rad == 0.0));
        assert_eq!((file.rig.cylinder.pulse_max, file.rig.sheet.waist_m), (1, 0.001));
        assert_eq!(file.rig.robot_from_finder.xyz().z, 0.1);
        assert_eq!(file.images.unwrap().step_m, Some(0.1));
        assert_eq!(file.line.estimator, crate::line::Estimator::Gauss3);
    }

    #[test]
    fn what_is_wrong_is_named_with_file_and_line() {
        for (from, to, line, word) in [
            ("version = 1", "version = 2", Some(1), "newer"),
            ("version = 1", "", None, "version"),
            ("fx = 514.4", "fx = -514.4", Some(8), "camera.fx"),
            ("fx = 514.4", "fx = nan", Some(8), "camera.fx"),
            ("fx = 514.4", "fx = \"a\"", Some(8), "rig file"),
            ("fx = 514.4", "fz = 514.4", Some(8), "fz"),
            ("fx = 514.4\n", "", Some(5), "camera.fx"),
            ("width = 640", "width = 0", Some(6), "camera.width"),
            ("width = 640", "width = -1", Some(6), "rig file"),
            ("tilt_deg = 20.0", "tilt_deg = inf", Some(13), "mount.tilt"),
            ("tilt_deg = 20.0", "tilt_deg = 2.0\ntilt_rad = 1.0", Some(15), "both"),
            ("tilt_deg = 20.0", "rotation = [0.0, 0.0, 0.0, 0.0]", Some(15), "unit quaternion"),
            ("tilt_deg = 20.0", "tilt = 20.0", Some(15), "tilt"),
            ("position_m = [0.1, 0.0, 0.2]", "position_m = [0.1, nan, 0.2]", Some(14), "mount.position_m"),
            ("offset_m = 0.166", "offset_m = 0.0", Some(17), "camera's centre"),
            ("offset_m = 0.166", "offset_m = nan", Some(17), "laser"),
            ("offset_m = 0.166", "offset_m = 0.1\norigin_m = [nan, 0.0, 0.0]", Some(17), "laser"),
            ("normal = [0.0, -0.937, 0.346]", "normal = [0.0, 0.0, 0.0]", Some(19), "laser.normal"),
            ("range_m_max = 4.5", "range_m_max = 0.0", Some(3), "range_m_max"),
            ("range_m_max = 4.5", "range_m_max = 4.5\nspeed = 3", Some(4), "speed"),
            ("[laser]", "[line]\nridge_min = 0.0\n[laser]", Some(18), "line.ridge_min"),
            ("[laser]", "[images]\nstep_m = 0.1\n[laser]", Some(17), "images.period_s"),
            ("[laser]", "[camera.laser]", None, ""),
            ("name = \"test\"", "name = \"test", Some(2), "rig file"),
        ] {
            let fault = read_text(&GOOD.replace(from, to)).unwrap_err();
            let text = fault.to_string();
            assert!(text.starts_with("some/rig.toml") && text.contains(word), "{from} -> {to}: {text}");
            if line.is_some() && word != "mount.tilt" {
                assert_eq!(fault.line, line, "{from} -> {to}: {text}");
            }
        }
        assert!(read_text("").is_err());
        assert!(load(Path::new("none/rig.toml")).unwrap_err().to_string().contains("none/rig.toml"));
    }

    #[test]
    fn a_camera_alone_is_written_and_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.toml");
        let camera = Camera::metro_i();
        std::fs::write(&path, camera_to_toml("c", &camera)).unwrap();
        assert_eq!(load_camera(&path).unwrap(), camera);
        // It is no whole rig yet, and says what is missing.
        assert!(load_if_whole(&path).unwrap().is_none());
        assert!(load(&path).unwrap_err().to_string().contains("missing field"));
        std::fs::write(&path, GOOD).unwrap();
        assert!(load_if_whole(&path).unwrap().is_some());
        assert_eq!(load_camera(&path).unwrap(), load(&path).unwrap().rig.camera);
        for (from, to, word) in [
            ("version = 1", "version = 9", "newer"),
            ("fx = 514.4", "fx = -1.0", "camera.fx"),
            ("fx = 514.4", "fx = \"a\"", "camera"),
            ("[camera]", "[kamera]", "camera"),
        ] {
            std::fs::write(&path, GOOD.replace(from, to)).unwrap();
            let fault = load_camera(&path).unwrap_err().to_string();
            assert!(fault.contains("rig.toml") && fault.contains(word), "{from}: {fault}");
        }
    }

    const INFO: &str = "image_width: 640\nimage_height: 480\ncamera_name: c\ncamera_matrix:\n  rows: 3\n  cols: 3\n  \
        data: [514.4, 0.0, 329.8, 0, 685.9, 237.7, 0, 0, 1]\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  \
        rows: 1\n  cols: 5\n  data: [-0.35, 0.158, 0.0007, -0.0002, 0.0]\nrectification_matrix:\n  rows: 3\n  cols: 3\n  \
        data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n";

    #[test]
    fn a_ros_camera_is_read_from_beside_the_rig() {
        let folder = tempfile::tempdir().unwrap();
        let (start, rest) = GOOD.split_once("width").unwrap();
        let (_, end) = rest.split_once("[mount]").unwrap();
        let text = format!("{start}camera_info = \"camera.yaml\"\n[mount]{end}");
        let rig_path = folder.path().join("rig.toml");
        std::fs::write(&rig_path, &text).unwrap();
        std::fs::write(folder.path().join("camera.yaml"), INFO).unwrap();
        let camera = load(&rig_path).unwrap().rig.camera;
        assert_eq!((camera.width, camera.fx, camera.cy), (640, 514.4, 237.7));
        assert_eq!(
            camera.distortion,
            Distortion::BrownConrady { k1: -0.35, k2: 0.158, p1: 0.0007, p2: -0.0002, k3: 0.0 }
        );
        for (from, to, word) in [
            ("plumb_bob", "equidistant", "distortion_model"),
            ("data: [514.4, 0.0", "data: [514.4, 3.0", "camera_matrix"),
            ("514.4", "-514.4", "camera.fx"),
            ("514.4", ".nan", "camera"),
            ("cols: 5", "cols: 4", "distortion_coefficients"),
            (", 237.7, 0, 0, 1]", "]", "camera_matrix"),
            ("image_width: 640", "image_width: x", "camera info"),
            ("image_width: 640", "", "image_width"),
            ("camera_matrix:", "camera_matrix: [", "camera info"),
        ] {
            std::fs::write(folder.path().join("camera.yaml"), INFO.replace(from, to)).unwrap();
            let fault = load(&rig_path).unwrap_err().to_string();
            assert!(fault.contains("camera.yaml") && fault.contains(word), "{from} -> {to}: {fault}");
        }
        std::fs::remove_file(folder.path().join("camera.yaml")).unwrap();
        assert!(load(&rig_path).unwrap_err().to_string().contains("camera.yaml"));
        std::fs::write(&rig_path, text.replace("camera.yaml\"", "camera.yaml\"\nfx = 3.0")).unwrap();
        assert!(load(&rig_path).unwrap_err().to_string().contains("both"));
    }
}
