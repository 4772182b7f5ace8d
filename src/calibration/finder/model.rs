//! A finder as a list of numbers, and how it explains what was measured.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::known::{Assumptions, Knowledge};
use super::measured::{Observations, Slit, Surface};
use crate::calibration::solve::Parameter;
use crate::fault::{Fault, Result, number_within};
use crate::geometry::{Plane, Point, Robot};
use crate::optics::{Axis, Camera, Distortion, Laser, MirrorLaser, Rig};

/// The parameters of the finder that every bundle has: name, unit, how far from its first guess it may be where nobody
/// knows better, and the change over which residuals bend.
pub(super) const PARAMETERS: [(&str, &str, f64, f64); 18] = [
    ("camera_height_m", "m", 1.0, 1.0),            // h_B
    ("x0_m", "m", 1.0, 1.0),                       // (38)
    ("tilt_rad", "rad", 0.5, 1.0),                 // θv
    ("roll_rad", "rad", 0.1, 1.0),                 // of the camera about its view
    ("pan_rad", "rad", 0.1, 1.0),                  // of the camera about the vertical
    ("mirror_height_m", "m", 1.0, 1.0),            // lA
    ("beam_zero_rad", "rad", 0.5, 1.0),            // θB at pulse 0
    ("beam_rad_per_pulse", "rad", 1.6e-5, 1.6e-3), // the gain: 1 %
    ("slit_roll_rad", "rad", 0.05, 1.0),           // of the slit about the beam
    ("mirror_x_m", "m", 0.02, 1.0),                // of A ahead of the cylinder's axis; beside it, no slit tells
    ("camera_y_m", "m", 0.02, 1.0),                // of the camera beside it
    ("axis_pitch_rad", "rad", 0.02, 1.0),          // of the cylinder's axis from the floor's normal
    ("axis_roll_rad", "rad", 0.02, 1.0),           //
    ("f_mm", "mm", 1.0, 10.0),                     // lf
    ("scale_u", "1", 0.1, 1.0),                    // Su (25)
    ("k_per_mm2", "1/mm2", 5e-3, 1e-2),            // (22), (23)
    ("cu_px", "px", 30.0, 500.0),                  // (25)
    ("cv_px", "px", 30.0, 500.0),                  // (26)
];

/// Where the camera's parameters start among these.
pub(super) const CAMERA_AT: usize = 13;
/// After those of the finder: where the tape begins (xR), and two for each wall.
pub(super) const TAPE_AT: usize = PARAMETERS.len();

/// A finder with numbers in the order of [`PARAMETERS`], then the tape, then the walls (angle and distance on the tape).
pub(super) struct Model<'a> {
    pub nominal: &'a Rig,
    pub assumptions: &'a Assumptions,
    pub seen: &'a Observations,
}

impl Model<'_> {
    /// How many unknowns there are in all.
    pub fn size(&self) -> usize {
        TAPE_AT + 1 + 2 * self.seen.walls.len()
    }

    /// The numbers of a finder; 0 for tape and walls.
    pub fn numbers_of(&self, rig: &Rig) -> Result<Vec<f64>> {
        let Laser::Mirror(mirror) = rig.laser else {
            return Err(Fault::new(
                "laser",
                "a plane fixed to the camera",
                "a mirror: calibrate a fixed plane on boards",
            ));
        };
        let pose = rig.sensor_from_camera.iso;
        let view = pose.rotation * Vector3::z();
        let (tilt, pan) = ((-view.z).clamp(-1.0, 1.0).asin(), view.y.atan2(view.x));
        let level = camera_pose([0.0; 3], tilt, pan, 0.0).rotation;
        let across = level.inverse() * (pose.rotation * Vector3::x());
        let (axis_roll, axis_pitch, _) = rig.robot_from_finder.iso.rotation.euler_angles();
        let camera = &rig.camera;
        let focal = camera.fy * self.assumptions.sensor.row_pitch_mm;
        let k = if let Distortion::Tsai { k } = camera.distortion { k / (focal * focal) } else { 0.0 };
        let at = pose.translation.vector;
        let mut numbers = vec![
            at.z,
            -at.x,
            tilt,
            across.y.atan2(across.x),
            pan,
            mirror.mirror_m[2],
            mirror.beam.zero_rad,
            mirror.beam.rad_per_pulse,
            mirror.roll_rad,
            mirror.mirror_m[0],
            at.y,
            axis_pitch,
            axis_roll,
            focal,
            camera.fx * self.assumptions.sensor.column_pitch_mm / focal,
            k,
            camera.cx,
            camera.cy,
        ];
        numbers.resize(self.size(), 0.0);
        Ok(numbers)
    }

    /// The finder of these numbers.
    pub fn rig(&self, p: &[f64]) -> Rig {
        let nominal = self.nominal;
        let (_, _, yaw) = nominal.robot_from_finder.iso.rotation.euler_angles();
        let upright = Rotation3::from_euler_angles(p[12], p[11], yaw);
        let foot = Translation3::from(nominal.robot_from_finder.xyz());
        let (beam, side) = match nominal.laser {
            Laser::Mirror(mirror) => (mirror.beam, mirror.mirror_m[1]),
            Laser::Plane(_) => (Axis::FIXED, 0.0),
        };
        let focal = p[CAMERA_AT];
        let distortion = match nominal.camera.distortion {
            Distortion::Tsai { .. } => Distortion::Tsai { k: p[CAMERA_AT + 2] * focal * focal },
            other => other,
        };
        Rig {
            camera: Camera {
                fx: p[CAMERA_AT + 1] * focal / self.assumptions.sensor.column_pitch_mm, // (25)
                fy: focal / self.assumptions.sensor.row_pitch_mm,                       // (26)
                cx: p[CAMERA_AT + 3],
                cy: p[CAMERA_AT + 4],
                distortion,
                ..nominal.camera
            },
            sensor_from_camera: camera_pose([-p[1], p[10], p[0]], p[2], p[4], p[3]).into(),
            laser: Laser::Mirror(MirrorLaser {
                mirror_m: [p[9], side, p[5]],
                beam: Axis { zero_rad: p[6], rad_per_pulse: p[7], ..beam },
                roll_rad: p[8],
            }),
            robot_from_finder: Isometry3::from_parts(foot, upright.into()).into(),
            ..nominal.clone()
        }
    }

    /// The solver's view of these numbers: names, first guesses, scales; what is known is fixed.
    pub fn unknowns(&self, start: &[f64]) -> Vec<Parameter> {
        let mut unknowns = Vec::with_capacity(start.len());
        for (i, (name, _, _, scale)) in PARAMETERS.iter().enumerate() {
            let parameter = Parameter::new(*name, start[i], *scale);
            let tsai = matches!(self.nominal.camera.distortion, Distortion::Tsai { .. });
            let known = self.knowledge(i) == Knowledge::Known || (!tsai && *name == "k_per_mm2");
            unknowns.push(if known { parameter.fixed() } else { parameter });
        }
        // Without a mark there is no tape.
        let tape = Parameter::new("tape_start_m", start[TAPE_AT], 1.0);
        unknowns.push(if self.has_tape() { tape } else { tape.fixed() });
        for (wall, at) in (TAPE_AT + 1..start.len()).step_by(2).enumerate() {
            let angle = Parameter::new(format!("wall_{wall}_rad"), start[at], 1.0);
            let used = self.seen.slits.iter().any(|slit| slit.on == Surface::Wall(wall));
            unknowns.push(if used { angle } else { angle.fixed() });
            let distance = Parameter::new(format!("wall_{wall}_m"), start[at + 1], 1.0);
            unknowns.push(if used { distance } else { distance.fixed() });
        }
        unknowns
    }

    /// What is known of parameter `i` of the finder.
    pub fn knowledge(&self, i: usize) -> Knowledge {
        let name = PARAMETERS.get(i).map_or("", |(name, ..)| *name);
        self.assumptions.knowledge.get(name).copied().unwrap_or(Knowledge::Free)
    }

    /// The width of what is believed of parameter `i` before the data, in its unit.
    pub fn sigma_before(&self, i: usize) -> f64 {
        match (PARAMETERS.get(i), self.knowledge(i)) {
            (Some(_), Knowledge::Within(sigma)) => sigma,
            (Some(_), Knowledge::Known) => 0.0,
            (Some(_), Knowledge::Free) if i >= CAMERA_AT && self.assumptions.camera.is_some() => {
                self.assumptions.camera.map_or(0.0, |c| c.covariance[i - CAMERA_AT][i - CAMERA_AT].sqrt())
            }
            (Some((_, _, ignorance, _)), Knowledge::Free) => *ignorance,
            _ => {
                let wall = i.saturating_sub(TAPE_AT + 1) / 2;
                let angle = i > TAPE_AT && (i - TAPE_AT) % 2 == 1;
                self.seen.walls.get(wall).filter(|_| angle).map_or(1.0, |wall| wall.square_sigma_rad)
            }
        }
    }

    fn has_tape(&self) -> bool {
        self.seen.slits.iter().any(|slit| slit.mark_m.is_some())
            || self.seen.walls.iter().any(|wall| wall.mark_m.is_some())
    }

    /// Rows of what is known beforehand: (p − expected)/σ, independent.
    pub fn prior_rows(&self, p: &[f64], expected: &[f64], whitening: Option<&[Vec<f64>]>, out: &mut Vec<f64>) {
        for i in (0..p.len()).filter(|i| whitening.is_none() || !(CAMERA_AT..TAPE_AT).contains(i)) {
            let sigma = self.sigma_before(i);
            if sigma > 0.0 {
                out.push((p[i] - expected[i]) / sigma);
            }
        }
        let camera = self.assumptions.camera.map_or([0.0; 5], |camera| camera.values);
        for row in whitening.unwrap_or_default() {
            out.push((0..5).map(|j| row[j] * (p[CAMERA_AT + j] - camera[j])).sum());
        }
        for (wall, at) in self.seen.walls.iter().zip((TAPE_AT + 1..).step_by(2)) {
            if let Some(mark) = wall.mark_m {
                out.push((p[at + 1] - mark) / self.seen.mark_sigma_m);
            }
        }
    }

    /// What a slit measures minus what the finder `rig` of numbers `p` explains, over the standard deviations; independent
    /// rows of size 1, the error of the mirror's reading (common to all rows of the slit) taken out. `None` where the
    /// finder cannot see such a slit.
    pub fn slit_rows(&self, rig: &Rig, p: &[f64], slit: &Slit, out: &mut Vec<f64>) -> Option<()> {
        let from = out.len();
        self.raw_rows(rig, p, slit, 0.0, out)?;
        // Covariance 1 + w·wᵀ, w = d(rows)/d(pulse)·σ: its inverse root is 1 − c·w·wᵀ with c = (1 − 1/√(1+w²))/w².
        let w = self.by_a_pulse(rig, p, slit)?;
        let w2: f64 = w.iter().map(|w| w * w).sum();
        let c = if w2 > 1e-12 { (1.0 - 1.0 / (1.0 + w2).sqrt()) / w2 } else { 0.5 };
        let along: f64 = w.iter().zip(&out[from..]).map(|(w, r)| w * r).sum();
        for (row, w) in out[from..].iter_mut().zip(&w) {
            *row -= c * along * w;
        }
        Some(())
    }

    /// d(raw rows)/d(mirror pulse), for one standard deviation of the mirror's reading.
    fn by_a_pulse(&self, rig: &Rig, p: &[f64], slit: &Slit) -> Option<Vec<f64>> {
        let half = 0.5;
        let (mut later, mut earlier) = (Vec::new(), Vec::new());
        self.raw_rows(rig, p, slit, half, &mut later)?;
        self.raw_rows(rig, p, slit, -half, &mut earlier)?;
        Some(later.iter().zip(&earlier).map(|(l, e)| (l - e) / (2.0 * half) * self.seen.pulse_sigma).collect())
    }

    /// By how much a slit's readings are off, in their own units.
    pub fn slit_off(&self, rig: &Rig, p: &[f64], slit: &Slit) -> Option<SlitOff> {
        let mut rows = Vec::new();
        self.raw_rows(rig, p, slit, 0.0, &mut rows)?;
        let w = self.by_a_pulse(rig, p, slit)?;
        let (w2, along) = w.iter().zip(&rows).fold((0.0, 0.0), |(w2, along), (w, r)| (w2 + w * w, along + w * r));
        // The most likely error of the reading, in its standard deviations: rows = w·e + noise, e and noise of size 1.
        let e = along / (1.0 + w2);
        rows.iter_mut().zip(&w).for_each(|(row, w)| *row -= w * e);
        let peaks = rows.split_off(rows.len() - slit.peaks.len());
        let tape = slit.mark_m.or(slit.height_m).and(rows.first());
        Some(SlitOff {
            pulses: e * self.seen.pulse_sigma,
            mark_m: tape.map(|row| row * self.seen.mark_sigma_m),
            rows_px: slit.peaks.iter().zip(peaks).map(|(peak, row)| [peak.u, row * peak.sigma]).collect(),
        })
    }

    /// The same before the reading's error is taken out, the mirror `later` pulses on.
    fn raw_rows(&self, rig: &Rig, p: &[f64], slit: &Slit, later: f64, out: &mut Vec<f64>) -> Option<()> {
        let cut = self.cut(rig, p, slit, slit.mirror_pulse + later)?;
        let sigma_m = self.seen.mark_sigma_m;
        if let Some(mark) = slit.mark_m {
            out.push((cut.at_tape()?.x - p[TAPE_AT] - mark) / sigma_m);
        }
        if let Some(height) = slit.height_m {
            out.push((cut.at_tape()?.z - height) / sigma_m);
        }
        if let Some(end) = slit.end {
            out.push((cut.beside(&rig.camera, end.y_m)?[0] - end.u) / end.sigma);
        }
        for peak in &slit.peaks {
            out.push(cut.rows_off(&rig.camera, peak.u, peak.v)? / peak.sigma);
        }
        Some(())
    }

    /// The line that a slit draws, as the camera of this finder has it.
    pub fn cut(&self, rig: &Rig, p: &[f64], slit: &Slit, mirror_pulse: f64) -> Option<SlitLine> {
        let surface = match slit.on {
            Surface::Floor => Plane::<Robot>::new(Vector3::z(), 0.0)?,
            Surface::Wall(wall) => {
                let at = TAPE_AT + 1 + 2 * wall;
                let (angle, distance) = (*p.get(at)?, p.get(at + 1)? + p[TAPE_AT]);
                Plane::through(Point::new(distance, 0.0, 0.0), Vector3::new(angle.cos(), angle.sin(), 0.0))?
            }
        };
        slit_line(rig, mirror_pulse, slit.cylinder_pulse, &surface)
    }
}

/// The finder with some of its parameters moved by so much, as by a bump: names as in a calibration, such as `tilt_rad`.
///
/// Errors: a name that is no parameter, a number that is not finite, a finder without a mirror or one that cannot be.
pub fn shifted(rig: &Rig, by: &BTreeMap<String, f64>) -> Result<Rig> {
    let seen = Observations { slits: Vec::new(), walls: Vec::new(), pulse_sigma: 1.0, mark_sigma_m: 1.0 };
    let model = Model { nominal: rig, assumptions: &Assumptions::free(), seen: &seen };
    let mut numbers = model.numbers_of(rig)?;
    for (name, by) in by {
        let Some(at) = PARAMETERS.iter().position(|(known, ..)| known == name) else {
            let known: Vec<&str> = PARAMETERS.iter().map(|(name, ..)| *name).collect();
            return Err(Fault::new("parameter", name, format!("one of {}", known.join(", "))));
        };
        numbers[at] += number_within(name, *by, -1e3, 1e3)?;
    }
    model.rig(&numbers).validated()
}

/// By how much the readings of a slit are off.
#[derive(Clone, Debug, Default)]
pub(super) struct SlitOff {
    /// The most likely error of the mirror's reading [pulses].
    pub pulses: f64,
    /// The tape's or the ruler's error beside that [m].
    pub mark_m: Option<f64>,
    /// Columns and errors of the rows beside that [px].
    pub rows_px: Vec<[f64; 2]>,
}

/// The line in which the sheet meets a surface, in the robot's frame, and the plane through it and the camera.
pub(super) struct SlitLine {
    point: Vector3<f64>,
    direction: Vector3<f64>,
    /// Normal of the plane through line and camera, in the camera's frame.
    normal: Vector3<f64>,
    camera_from_robot: Isometry3<f64>,
}

/// Where the sheet at these encoder readings (whole or not) meets a surface; `None` if it does not.
pub(super) fn slit_line(rig: &Rig, mirror_pulse: f64, cylinder_pulse: f64, surface: &Plane<Robot>) -> Option<SlitLine> {
    let Laser::Mirror(mirror) = rig.laser else { return None };
    let beam = mirror.beam.zero_rad + mirror_pulse * mirror.beam.rad_per_pulse;
    let turned = rig.cylinder.zero_rad + cylinder_pulse * rig.cylinder.rad_per_pulse;
    let robot_from_sensor = rig.robot_from_sensor_at(turned);
    let sheet = (robot_from_sensor * rig.laser_plane_at(beam).ok()?).plane;
    let direction = sheet.normal.cross(&surface.normal);
    if direction.norm() < 1e-9 {
        return None;
    }
    // The point of both planes nearest to the origin.
    let planes = Matrix3::from_rows(&[sheet.normal.transpose(), surface.normal.transpose(), direction.transpose()]);
    let point = planes.try_inverse()? * Vector3::new(sheet.offset, surface.offset, 0.0);
    let robot_from_camera = (robot_from_sensor * rig.sensor_from_camera).iso;
    let eye = robot_from_camera.translation.vector;
    let normal = robot_from_camera.rotation.inverse() * (point - eye).cross(&direction);
    let camera_from_robot = robot_from_camera.inverse();
    normal.iter().all(|n| n.is_finite()).then_some(SlitLine { point, direction, normal, camera_from_robot })
}

impl SlitLine {
    /// Where the line crosses the upright plane of the tape, y = 0.
    pub fn at_tape(&self) -> Option<Vector3<f64>> {
        self.at_side(0.0)
    }

    fn at_side(&self, y_m: f64) -> Option<Vector3<f64>> {
        let t = (y_m - self.point.y) / self.direction.y;
        t.is_finite().then(|| self.point + self.direction * t)
    }

    /// The pixel of the line's point at `y_m` beside the tape.
    pub fn beside(&self, camera: &Camera, y_m: f64) -> Option<[f64; 2]> {
        camera.project(&(self.camera_from_robot * nalgebra::Point3::from(self.at_side(y_m)?)).coords)
    }

    /// How far ahead of the turned cylinder's axis the line crosses its heading [m].
    pub fn ahead(&self, rig: &Rig, cylinder_pulse: f64) -> Option<f64> {
        let turned = rig.cylinder.zero_rad + cylinder_pulse * rig.cylinder.rad_per_pulse;
        let (heading, side) =
            (Vector3::new(turned.cos(), turned.sin(), 0.0), Vector3::new(-turned.sin(), turned.cos(), 0.0));
        let t = -side.dot(&self.point) / side.dot(&self.direction);
        t.is_finite().then(|| heading.dot(&(self.point + self.direction * t)))
    }

    /// How many rows a pixel lies below the line in the image.
    pub fn rows_off(&self, camera: &Camera, u: f64, v: f64) -> Option<f64> {
        let side = |v: f64| Some(self.normal.dot(&camera.ray(u, v)?));
        let step = 0.5;
        let slope = (side(v + step)? - side(v - step)?) / (2.0 * step);
        let off = side(v)? / slope;
        off.is_finite().then_some(off)
    }
}

/// The camera's pose on the cylinder: panned about the vertical, tilted down, rolled about its view.
fn camera_pose(xyz: [f64; 3], tilt: f64, pan: f64, roll: f64) -> Isometry3<f64> {
    let (s, c) = tilt.sin_cos();
    let level = Rotation3::from_matrix_unchecked(Matrix3::new(0.0, -s, c, -1.0, 0.0, 0.0, 0.0, -c, -s));
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), pan)
        * level
        * Rotation3::from_axis_angle(&Vector3::z_axis(), roll);
    Isometry3::from_parts(Translation3::new(xyz[0], xyz[1], xyz[2]), UnitQuaternion::from_rotation_matrix(&turn))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::{Uncertainty, triangulate};
    use proptest::prelude::*;

    fn nothing() -> Observations {
        Observations { slits: vec![], walls: vec![], pulse_sigma: 0.3, mark_sigma_m: 1e-3 }
    }

    proptest! {
        #[test]
        fn a_finder_is_its_numbers(
            angles in prop::array::uniform6(-0.05..0.05f64), lengths in prop::array::uniform4(-0.05..0.05f64)
        ) {
            let nominal = Rig::metro_i();
            let (seen, assumptions) = (nothing(), Assumptions::free());
            let model = Model { nominal: &nominal, assumptions: &assumptions, seen: &seen };
            let mut numbers = model.numbers_of(&nominal).unwrap();
            for (i, by) in [2, 3, 4, 8, 11, 12].into_iter().zip(angles) {
                numbers[i] += by;
            }
            for (i, by) in [0, 1, 9, 10].into_iter().zip(lengths) {
                numbers[i] += by;
            }
            let back = model.numbers_of(&model.rig(&numbers)).unwrap();
            for (a, b) in numbers.iter().zip(&back) {
                prop_assert!((a - b).abs() < 1e-9, "{numbers:?} {back:?}");
            }
        }

        #[test]
        fn a_point_of_the_line_is_what_triangulation_finds(
            u in 60.0..450.0f64, pulse in 0.0..90.0f64, cylinder in -600.0..600.0f64, roll in -0.03..0.03f64
        ) {
            // Against the other road: the pixel's ray meets the sheet on the floor.
            let mut rig = Rig::metro_i();
            if let Laser::Mirror(mirror) = &mut rig.laser {
                mirror.roll_rad = roll;
            }
            let (pulse, cylinder) = (pulse.round(), cylinder.round());
            let floor = Plane::<Robot>::new(Vector3::z(), 0.0).unwrap();
            let line = slit_line(&rig, pulse, cylinder, &floor).unwrap();
            let mut v = rig.camera.cy;
            for _ in 0..30 {
                v -= line.rows_off(&rig.camera, u, v).unwrap();
            }
            prop_assume!((0.0..480.0).contains(&v));
            let exact = Uncertainty { u_px: 0.0, v_px: 0.0, beam_rad: 0.0, cylinder_rad: 0.0 };
            let sheet = rig.laser_plane(pulse as i32).unwrap();
            let seen = triangulate(&rig, &sheet, u, v, &exact).unwrap().point;
            let seen = rig.robot_from_sensor(cylinder as i32).unwrap() * seen;
            prop_assert!(seen.xyz.z.abs() < 1e-9, "{seen:?}");
            prop_assert!((seen.xyz - line.point).cross(&line.direction).norm() < 1e-9);
        }
    }
}
