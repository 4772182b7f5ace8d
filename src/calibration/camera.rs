//! (19)–(26): one view of a dot block, the linear stage and then all parameters at once, with covariance.

use std::f64::consts::{PI, TAU};

use super::Target;
pub use super::params::{BlockParams, Sensor, Unknown};
use super::points::Mark;
use super::report::{Estimate, Rejected, Report, Residual, robust_sigma};
use super::solve::{Noise, Options, Parameter, Solution, minimise};
use super::tsai::{self, ChipMark, Guess, Shape};
use crate::fault::{Fault, Result};
use crate::geometry::{Camera as CameraFrame, Transform};
use crate::optics::{Camera, Distortion};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Places of the parameters in [`BlockFit::solution`].
pub mod place {
    /// Turn of the pose about the camera's x, y, z [rad], 0 at the result: the three places from here.
    pub const TURN: usize = 0;
    /// The target's origin in the camera's frame [m]: the three places from here.
    pub const ORIGIN: usize = 3;
    /// Focal length [mm].
    pub const F: usize = 6;
    /// Distortion k [1/mm²].
    pub const K: usize = 7;
    /// Column scale.
    pub const SCALE_U: usize = 8;
    /// Optical axis, column and row [px]: the two places from here.
    pub const CENTRE: usize = 9;
}

/// A calibrated camera.
#[derive(Clone, Debug)]
pub struct BlockFit {
    /// The camera.
    pub camera: Camera,
    /// The pose of the target.
    pub camera_from_target: Transform<CameraFrame, Target>,
    /// Focal length [mm].
    pub f_mm: f64,
    /// Distortion factor [1/mm²].
    pub k_per_mm2: f64,
    /// Column scale su.
    pub scale_u: f64,
    /// The linear stage alone.
    pub linear: Guess,
    /// Covariance, weak directions; parameters in the order of [`place`].
    pub solution: Solution,
    /// Whether the target was flat.
    pub flat: bool,
    /// Angle between the target's flattest direction and the line of sight [rad].
    pub tilt_rad: f64,
    /// Seen minus predicted [px], a pair a mark that was used.
    pub residuals_px: Vec<[f64; 2]>,
    /// The marks used, as places in the input.
    pub used: Vec<usize>,
    /// The marks left out.
    pub rejected: Vec<Rejected>,
}

impl BlockFit {
    /// What is left, as distances in the image.
    pub fn residual(&self) -> Residual {
        Residual::of(self.residuals_px.iter().map(|[u, v]| u.hypot(*v)), "px")
    }

    /// Roll, pitch, yaw of the target about the camera's x, y, z axes, with their standard deviations [rad].
    fn angles(&self) -> [(f64, f64); 3] {
        let rotation = self.camera_from_target.iso.rotation;
        let angles = |turn: Vector3<f64>| {
            let (roll, pitch, yaw) = (UnitQuaternion::new(turn) * rotation).euler_angles();
            Vector3::new(roll, pitch, yaw)
        };
        let here = angles(Vector3::zeros());
        let step = 1e-6;
        let slope = |i: usize| {
            let change = angles(Vector3::ith(i, step)) - here;
            change.map(|a| (a + PI).rem_euclid(TAU) - PI) / step
        };
        let slopes = Matrix3::from_columns(&[slope(0), slope(1), slope(2)]);
        let turn = self.solution.covariance.fixed_view::<3, 3>(place::TURN, place::TURN);
        let covariance = slopes * turn * slopes.transpose();
        [0, 1, 2].map(|i| (here[i], covariance[(i, i)].max(0.0).sqrt()))
    }

    /// For people and programs.
    pub fn report(&self) -> Report {
        let units = ["rad", "rad", "rad", "m", "m", "m", "mm", "1/mm2", "1", "px", "px"];
        let mut parameters: Vec<Estimate> = (self.solution.parameters.iter().zip(units).enumerate())
            .skip(place::ORIGIN)
            .map(|(i, (p, unit))| Estimate::new(&p.name, self.solution.values[i], self.solution.sigma(i), unit))
            .collect();
        let names = ["roll_rad", "pitch_rad", "yaw_rad"];
        parameters.extend(names.into_iter().zip(self.angles()).map(|(name, (v, s))| Estimate::new(name, v, s, "rad")));
        Report { parameters, residual: self.residual(), used: self.used.len(), rejected: self.rejected.clone() }
    }
}

/// Calibrates a camera on one view of a target whose marks are known: flat or with depth.
///
/// Errors: what is not a calibration (`image` numbers that differ, fewer marks than unknowns, marks on one line, lengths
/// that look like another unit, a mirrored image, marks behind the camera) and what cannot be recovered from these marks
/// (a flat target parallel to the image; su and f of a flat target tilted about one axis of the image; whatever the data
/// leave wider than the limits of `params`), each with the reason.
pub fn calibrate(marks: &[Mark], sensor: &Sensor, params: &BlockParams) -> Result<BlockFit> {
    let (sensor, params) = (sensor.validated()?, params.validated()?);
    checked(marks, &sensor)?;
    let points: Vec<Vector3<f64>> = marks.iter().map(|m| m.target.xyz).collect();
    let shape = Shape::of(&points);
    shape.at_least_flat()?;
    let mut problem = Problem { sensor, params, flat: shape.is_flat(), marks: marks.to_vec() };
    let mut used: Vec<usize> = (0..marks.len()).collect();
    let mut rejected = Vec::new();
    // Each round may leave out what the fit without it shows to be off; a fifth of the marks at most.
    loop {
        let linear = problem.linear()?;
        let (rotation, solution) = problem.fitted(&linear)?;
        let off = problem.outliers(&pairs(&solution.residuals));
        if off.is_empty() {
            return problem.concluded(linear, &rotation, solution, used, rejected);
        }
        for &(i, size) in off.iter().rev() {
            let mark = problem.marks.remove(i);
            used.remove(i);
            let why = format!("{size:.2} px from where the other marks put it");
            rejected.push(Rejected { what: format!("mark {}", mark.line), why });
        }
        if rejected.len() * 5 > marks.len() {
            let found = format!("{} of {} that do not fit the others", rejected.len(), marks.len());
            return Err(Fault::new("marks", found, "positions and pixels that belong together"));
        }
    }
}

fn checked(marks: &[Mark], sensor: &Sensor) -> Result<()> {
    if marks.len() < 5 {
        return Err(Fault::new("marks", marks.len(), "at least 5 on a flat target, 7 on one with depth"));
    }
    for mark in marks {
        let numbers = [mark.target.xyz.x, mark.target.xyz.y, mark.target.xyz.z, mark.u_px, mark.v_px];
        if let Some(bad) = numbers.iter().find(|n| !n.is_finite()) {
            return Err(Fault::new("mark", bad, "finite numbers").at_line(mark.line));
        }
        if mark.image != marks[0].image {
            let found = format!("images {} and {}", marks[0].image, mark.image);
            return Err(Fault::new("marks", found, "one view of one target").at_line(mark.line));
        }
        let (u_max, v_max) = (sensor.width as f64, sensor.height as f64);
        if !(-0.5 * u_max..1.5 * u_max).contains(&mark.u_px) || !(-0.5 * v_max..1.5 * v_max).contains(&mark.v_px) {
            let found = format!("pixel ({}, {})", mark.u_px, mark.v_px);
            return Err(Fault::new("mark", found, format!("a pixel of {u_max} x {v_max}")).at_line(mark.line));
        }
    }
    let size = marks.iter().map(|m| (m.target.xyz - marks[0].target.xyz).norm()).fold(0.0, f64::max);
    if size > 10.0 {
        let found = format!("a target {size:.1} m across");
        return Err(Fault::new("marks", found, "at most 10 m: are these millimetres?"));
    }
    if size < 1e-3 {
        let found = format!("a target {:.6} mm across", size * 1e3);
        return Err(Fault::new("marks", found, "at least 1 mm: are these metres read as millimetres?"));
    }
    Ok(())
}

struct Problem {
    sensor: Sensor,
    params: BlockParams,
    flat: bool,
    marks: Vec<Mark>,
}

impl Problem {
    fn centre(&self) -> Unknown<[f64; 2]> {
        let middle = [(self.sensor.width - 1) as f64 / 2.0, (self.sensor.height - 1) as f64 / 2.0];
        self.params.centre_px.unwrap_or(Unknown::From(middle))
    }

    /// The linear stage with the marks as they are.
    fn linear(&self) -> Result<Guess> {
        let points: Vec<Vector3<f64>> = self.marks.iter().map(|m| m.target.xyz).collect();
        let shape = Shape::of(&points);
        let ([cu, cv], su) = (self.centre().value(), self.params.scale_u.value());
        // (25), (26) undone; su is divided out where it is known or cannot be had from the linear stage.
        let divided = if self.flat { su } else { 1.0 };
        let chip = |m: &Mark| ChipMark {
            target: m.target.xyz,
            x_mm: (m.u_px - cu) * self.sensor.column_pitch_mm / divided,
            y_mm: (m.v_px - cv) * self.sensor.row_pitch_mm,
        };
        let chip: Vec<ChipMark> = self.marks.iter().map(chip).collect();
        if self.flat {
            Ok(Guess { scale_u: su, ..tsai::flat(&chip, &shape, self.sensor.diagonal_mm())? })
        } else {
            let guess = tsai::solid(&chip, &shape)?;
            Ok(Guess { scale_u: if self.params.scale_u.is_known() { su } else { guess.scale_u }, ..guess })
        }
    }

    /// All parameters at once, in two steps: first f, Tz and k alone (step 5), then everything.
    fn fitted(&self, linear: &Guess) -> Result<(Rotation3<f64>, Solution)> {
        let t = linear.translation;
        let depth = t.norm().max(1e-6);
        let f = linear.f_mm;
        let [cu, cv] = self.centre().value();
        let mut parameters = vec![
            Parameter::new("turn_x", 0.0, 1.0),
            Parameter::new("turn_y", 0.0, 1.0),
            Parameter::new("turn_z", 0.0, 1.0),
            Parameter::new("tx_m", t.x, depth),
            Parameter::new("ty_m", t.y, depth),
            Parameter::new("tz_m", t.z, depth),
            Parameter::new("f_mm", f, f),
            Parameter::new("k_per_mm2", 0.0, 1.0 / (f * f)),
            Parameter::new("scale_u", linear.scale_u, 1.0),
            Parameter::new("cu_px", cu, 100.0),
            Parameter::new("cv_px", cv, 100.0),
        ];
        let noise = self.params.pixel_sigma_px.map_or(Noise::FromResiduals, Noise::Known);
        let options = Options { noise, steps_max: 500, ..Options::default() };
        let started = self.residuals(&linear.rotation, &parameters.iter().map(|p| p.start).collect::<Vec<_>>());
        if started.is_none() {
            return Err(self.behind(linear));
        }
        let staged: Vec<Parameter> = (parameters.iter().cloned().enumerate())
            .map(|(i, p)| if [place::ORIGIN + 2, place::F, place::K].contains(&i) { p } else { p.fixed() })
            .collect();
        // Where the first step finds nothing better, the second one starts from the linear stage.
        if let Ok(first) = minimise(&staged, &|p| self.residuals(&linear.rotation, p), &options) {
            parameters.iter_mut().zip(&first.values).for_each(|(p, v)| p.start = *v);
        }
        parameters[place::SCALE_U].fixed = self.params.scale_u.is_known();
        for c in &mut parameters[place::CENTRE..] {
            c.fixed = self.centre().is_known();
        }
        let needed = parameters.iter().filter(|p| !p.fixed).count();
        if 2 * self.marks.len() <= needed {
            let expected = format!("at least {} for {needed} unknowns", needed / 2 + 1);
            return Err(Fault::new("marks", self.marks.len(), expected));
        }
        let mut found = Found { rotation: linear.rotation, solution: None };
        // A second round from the rotation found, so that its three errors are about the camera's own axes.
        for _ in 0..2 {
            let fit = minimise(&parameters, &|p| self.residuals(&found.rotation, p), &options)
                .map_err(|fault| self.reasoned(&found.rotation, fault.found))?;
            parameters.iter_mut().zip(&fit.values).for_each(|(p, v)| p.start = *v);
            parameters[..3].iter_mut().for_each(|p| p.start = 0.0);
            found = Found { rotation: turned(&found.rotation, &fit.values), solution: Some(fit) };
        }
        self.judged(found)
    }

    /// Seen minus predicted [px], u and v of each mark in turn; `None` where one is behind the camera or beyond the lens.
    fn residuals(&self, rotation: &Rotation3<f64>, p: &[f64]) -> Option<Vec<f64>> {
        let camera = self.camera(p)?;
        let (turn, origin) = (turned(rotation, p), Vector3::new(p[3], p[4], p[5]));
        let mut residuals = Vec::with_capacity(2 * self.marks.len());
        for mark in &self.marks {
            let [u, v] = camera.project(&(turn * mark.target.xyz + origin))?; // (19)–(26)
            residuals.extend([mark.u_px - u, mark.v_px - v]);
        }
        Some(residuals)
    }

    fn camera(&self, p: &[f64]) -> Option<Camera> {
        let (f, k, su) = (p[place::F], p[place::K], p[place::SCALE_U]);
        let Sensor { width, height, column_pitch_mm, row_pitch_mm } = self.sensor;
        let (fx, fy) = (su * f / column_pitch_mm, f / row_pitch_mm); // (25), (26)
        let distortion = Distortion::Tsai { k: k * f * f }; // r in focal lengths
        (f > 0.0 && su > 0.0).then_some(Camera {
            width,
            height,
            fx,
            fy,
            cx: p[place::CENTRE],
            cy: p[place::CENTRE + 1],
            distortion,
        })
    }

    /// What the data leave too wide is refused.
    fn judged(&self, found: Found) -> Result<(Rotation3<f64>, Solution)> {
        let Found { rotation, solution: Some(fit) } = found else {
            return Err(self.reasoned(&found.rotation, "no fit".into()));
        };
        let fit = fit.full_rank().map_err(|fault| self.reasoned(&rotation, fault.found))?;
        let f_sigma = fit.sigma(place::F) / fit.values[place::F];
        if f_sigma.is_nan() || f_sigma > self.params.f_sigma_max {
            let found = format!("a focal length of {:.3} mm ± {:.1} %", fit.values[place::F], f_sigma * 100.0);
            return Err(self.reasoned(&rotation, found));
        }
        let su_sigma = fit.sigma(place::SCALE_U);
        if su_sigma.is_nan() || su_sigma > self.params.scale_sigma_max {
            let found = format!("a column scale of {:.4} ± {su_sigma:.4}", fit.values[place::SCALE_U]);
            return Err(self.reasoned(&rotation, found));
        }
        let distance = Vector3::new(fit.values[3], fit.values[4], fit.values[5]).norm();
        if distance > 100.0 {
            let found = format!("a target {distance:.0} m away");
            return Err(Fault::new("marks", found, "at most 100 m: are these millimetres?"));
        }
        Ok((rotation, fit))
    }

    /// Tilt of the flattest direction of the target against the line of sight [rad], and the image direction of the axis
    /// it is tilted about [rad].
    fn tilt(&self, rotation: &Rotation3<f64>) -> (f64, f64) {
        let points: Vec<Vector3<f64>> = self.marks.iter().map(|m| m.target.xyz).collect();
        let normal = rotation * Shape::of(&points).axes.column(2).into_owned();
        (normal.x.hypot(normal.y).atan2(normal.z.abs()), normal.x.atan2(-normal.y))
    }

    /// The reason why these marks do not give the camera, from how the target stands.
    fn reasoned(&self, rotation: &Rotation3<f64>, found: String) -> Fault {
        let (tilt, axis) = self.tilt(rotation);
        let degrees = tilt.to_degrees();
        if self.flat && degrees < 10.0 {
            let found = format!("flat and {degrees:.1}° from parallel to the image: {found}");
            let expected =
                "a tilt of 20° or more, or a target with depth (else f shows only in its ratio to the distance)";
            return Fault::new("target", found, expected);
        }
        if self.flat && !self.params.scale_u.is_known() {
            // Folded to within 45° of an axis of the image.
            let off = (axis.to_degrees() + 720.0) % 90.0;
            let about = if off.min(90.0 - off) < 10.0 { "one axis of the image" } else { "an axis" };
            let found = format!("flat and tilted {degrees:.1}° about {about}: {found}");
            return Fault::new(
                "target",
                found,
                "scale_u known, or a target with depth (else f and su show only together)",
            );
        }
        let expected = "marks with more depth, tilt and spread, or what is known (scale_u, centre_px) given as known";
        Fault::new("target", found, expected)
    }

    /// The linear stage has put marks behind the camera.
    fn behind(&self, linear: &Guess) -> Fault {
        let z = |m: &Mark| (linear.rotation * m.target.xyz + linear.translation).z;
        match self.marks.iter().find(|m| z(m) <= 0.0) {
            Some(mark) => {
                let found = format!("{:.3} m behind the camera by the linear stage", -z(mark));
                Fault::new("mark", found, "marks in front, pixels that belong to them").at_line(mark.line)
            }
            None => Fault::new("marks", "no camera by the linear stage", "positions and pixels that belong together"),
        }
    }

    /// Marks too far off, as places among those used and their distance [px].
    fn outliers(&self, residuals: &[[f64; 2]]) -> Vec<(usize, f64)> {
        // A residual is one coordinate: Rayleigh's median is 1.1774 σ against the normal's 0.6745.
        let sigma = robust_sigma(residuals.iter().map(|[u, v]| u.hypot(*v))) * (0.6745 / 1.1774);
        let limit = self.params.outlier_sigmas * sigma.max(1e-6);
        let sizes = residuals.iter().map(|[u, v]| u.hypot(*v)).enumerate();
        sizes.filter(|(_, size)| *size > limit).collect()
    }

    fn concluded(
        &self,
        linear: Guess,
        rotation: &Rotation3<f64>,
        solution: Solution,
        used: Vec<usize>,
        rejected: Vec<Rejected>,
    ) -> Result<BlockFit> {
        let p = &solution.values;
        let camera = self.camera(p).ok_or_else(|| Fault::new("camera", "no focal length", "one greater than 0"))?;
        let origin = Translation3::new(p[place::ORIGIN], p[place::ORIGIN + 1], p[place::ORIGIN + 2]);
        Ok(BlockFit {
            camera: camera.validated()?,
            camera_from_target: Isometry3::from_parts(origin, UnitQuaternion::from_rotation_matrix(rotation)).into(),
            f_mm: p[place::F],
            k_per_mm2: p[place::K],
            scale_u: p[place::SCALE_U],
            linear,
            flat: self.flat,
            tilt_rad: self.tilt(rotation).0,
            residuals_px: pairs(&solution.residuals),
            solution,
            used,
            rejected,
        })
    }
}

/// Where the search for all parameters stands.
struct Found {
    rotation: Rotation3<f64>,
    solution: Option<Solution>,
}

/// exp(turn)·rotation.
fn turned(rotation: &Rotation3<f64>, values: &[f64]) -> Rotation3<f64> {
    Rotation3::new(Vector3::new(values[0], values[1], values[2])) * rotation
}

fn pairs(residuals: &[f64]) -> Vec<[f64; 2]> {
    residuals.chunks_exact(2).map(|r| [r[0], r[1]]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::points::{LengthUnit, Rows, parse};
    use crate::geometry::Point;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha12Rng;

    /// Sum of uniform numbers: normal enough.
    fn normal(rng: &mut ChaCha12Rng) -> f64 {
        (0..12).map(|_| rng.random_range(-0.5..0.5)).sum()
    }

    fn tsai_data() -> Option<Vec<Mark>> {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data/tsai/CC_CD.DAT");
        let Ok(text) = std::fs::read_to_string(path) else {
            eprintln!("skipped: ../shared/data is absent");
            return None;
        };
        Some(parse(&text, LengthUnit::Mm, Rows::FromTop).unwrap())
    }

    /// The camera of `tsai/CCAL.LOG`.
    fn star_i() -> (Sensor, BlockParams) {
        let sensor = Sensor { width: 576, height: 576, column_pitch_mm: 0.023, row_pitch_mm: 0.023 };
        let centre_px = Some(Unknown::From([258.0, 204.0]));
        (sensor, BlockParams { scale_u: Unknown::Known(1.0), centre_px, ..BlockParams::default() })
    }

    #[test]
    fn the_data_of_1995_give_what_they_gave_in_1995() {
        let Some(marks) = tsai_data() else { return };
        let (sensor, params) = star_i();
        let fit = calibrate(&marks, &sensor, &params).unwrap();
        let residual = fit.residual();
        assert!((residual.mean - 0.09675).abs() < 1e-4, "{residual:?}");
        let score = fit.camera_from_target.xyz().z * 1e3 / fit.f_mm;
        assert!((score - 24.436).abs() < 0.01, "{score}");
        // The truth of the simulation lies within three standard deviations.
        let truth = [(place::F, 270.0), (place::K, -6e-4), (place::CENTRE, 262.0), (place::CENTRE + 1, 212.0)];
        for (i, truth) in truth {
            assert!((fit.solution.values[i] - truth).abs() < 3.0 * fit.solution.sigma(i), "{i}");
        }
    }

    /// The paper's block: top 160 × 100 mm, two planes 45 mm apart, 30 marks each.
    fn block() -> Vec<Point<Target>> {
        let plane = |z: f64| (0..30).map(move |i| Point::new((i % 6) as f64 * 0.032, (i / 6) as f64 * 0.025, z));
        plane(0.0).chain(plane(0.045)).collect()
    }

    /// METRO-I's camera over a target, its middle on the axis at `distance_m`, turned by `rpy`.
    fn view(
        points: &[Point<Target>],
        rpy: [f64; 3],
        distance_m: f64,
        noise_px: f64,
        seed: u64,
    ) -> (Vec<Mark>, Isometry3<f64>) {
        let mut rng = ChaCha12Rng::seed_from_u64(seed);
        let rotation = Rotation3::from_euler_angles(rpy[0], rpy[1], rpy[2]);
        let middle = points.iter().map(|p| p.xyz).sum::<Vector3<f64>>() / points.len() as f64;
        let origin = Vector3::new(0.003, -0.002, distance_m) - rotation * middle;
        let camera = Camera::metro_i();
        let mut marks = Vec::new();
        for (i, p) in points.iter().enumerate() {
            let [u, v] = camera.project(&(rotation * p.xyz + origin)).unwrap();
            let (du, dv) = (normal(&mut rng) * noise_px, normal(&mut rng) * noise_px);
            marks.push(Mark { target: *p, u_px: u + du, v_px: v + dv, image: 0, line: i + 1 });
        }
        (marks, Isometry3::from_parts(origin.into(), UnitQuaternion::from_rotation_matrix(&rotation)))
    }

    #[test]
    fn the_block_of_the_paper_has_the_error_bars_of_the_study() {
        // instrument.md 4: untilted block, 0.1 px: σ_f ≈ 0.019 mm, σ_su 2e-4, σ_k 6e-5, Cu, Cv ± 2–3 px.
        let (marks, _) = view(&block(), [0.0; 3], 0.44, 0.1, 1);
        let params = BlockParams { pixel_sigma_px: Some(0.1), ..BlockParams::default() };
        let fit = calibrate(&marks, &Sensor::metro_i(), &params).unwrap();
        let sigma = |i: usize| fit.solution.sigma(i);
        assert!((sigma(place::F) - 0.019).abs() < 0.002, "{}", sigma(place::F));
        assert!((sigma(place::SCALE_U) - 2e-4).abs() < 0.2e-4, "{}", sigma(place::SCALE_U));
        assert!((sigma(place::K) - 6e-5).abs() < 1e-5, "{}", sigma(place::K));
        for i in [place::CENTRE, place::CENTRE + 1] {
            assert!((2.0..3.0).contains(&sigma(i)), "{}", sigma(i));
        }
        assert_eq!(fit.report().parameters[3].name, "f_mm");
    }

    /// How often the truth lies inside the 95 % interval of each parameter.
    fn coverage(
        points: &[Point<Target>],
        rpy: [f64; 3],
        distance_m: f64,
        params: &BlockParams,
        repeats: u64,
    ) -> [f64; 11] {
        let mut inside = [0.0; 11];
        for seed in 0..repeats {
            let (marks, pose) = view(points, rpy, distance_m, 0.1, 1000 + seed);
            let fit = calibrate(&marks, &Sensor::metro_i(), params).unwrap();
            let turn = (pose.rotation * fit.camera_from_target.iso.rotation.inverse()).scaled_axis();
            let t = pose.translation.vector - fit.camera_from_target.xyz();
            let (c, p) = (Camera::metro_i(), &fit.solution.values);
            let errors = [
                [turn.x, turn.y, turn.z],
                [t.x, t.y, t.z],
                [p[place::F] - 11.434, p[place::K] - 0.00335, p[place::SCALE_U] - 1.095],
                [p[place::CENTRE] - c.cx, p[place::CENTRE + 1] - c.cy, 0.0],
            ];
            for (i, count) in inside.iter_mut().enumerate() {
                let sigma = fit.solution.sigma(i);
                *count +=
                    f64::from(u8::from(sigma == 0.0 || errors[i / 3][i % 3].abs() < 1.96 * sigma)) / repeats as f64;
            }
        }
        inside
    }

    #[test]
    fn the_truth_lies_inside_the_95_percent_intervals() {
        let inside = coverage(&block(), [0.0; 3], 0.44, &BlockParams::default(), 200);
        assert!(inside.iter().all(|share| (0.905..=0.99).contains(share)), "untilted: {inside:?}");
        let inside = coverage(&block(), [0.4, -0.3, 0.2], 0.44, &BlockParams::default(), 200);
        assert!(inside.iter().all(|share| (0.905..=0.99).contains(share)), "tilted: {inside:?}");
        let flat = BlockParams { scale_u: Unknown::Known(1.095), ..BlockParams::default() };
        let inside = coverage(&block()[..30], [0.5, -0.3, 0.2], 0.40, &flat, 200);
        let free = inside.iter().enumerate().filter(|(i, _)| *i != place::SCALE_U);
        assert!(free.map(|(_, share)| share).all(|share| (0.905..=0.99).contains(share)), "flat: {inside:?}");
    }

    #[test]
    fn what_a_flat_target_cannot_give_is_refused_with_the_reason() {
        let known = BlockParams { scale_u: Unknown::Known(1.095), ..BlockParams::default() };
        let refused = |rpy: [f64; 3], params: &BlockParams| {
            let (marks, _) = view(&block()[..30], rpy, 0.40, 0.1, 5);
            calibrate(&marks, &Sensor::metro_i(), params).map(|fit| fit.solution.sigma(place::F))
        };
        for tilt_deg in [0.0f64, 0.5, 2.0] {
            let fault = refused([tilt_deg.to_radians(), 0.0, 0.0], &known).unwrap_err().to_string();
            assert!(fault.contains("from parallel to the image"), "{tilt_deg}: {fault}");
        }
        // Little tilt: wide, and said so. More: narrow.
        let (narrow, wide) = (refused([0.6, 0.0, 0.1], &known).unwrap(), refused([0.17, 0.0, 0.1], &known).unwrap());
        assert!(narrow < 0.04 && (0.07..0.15).contains(&wide), "{narrow} {wide}"); // instrument.md 4: 0.1 mm under 10°
        let fault = refused([0.4, 0.0, 0.0], &BlockParams::default()).unwrap_err().to_string();
        assert!(fault.contains("about one axis of the image") && fault.contains("f and su"), "{fault}");
    }

    #[test]
    fn what_is_no_view_of_a_target_is_refused() {
        let (good, _) = view(&block(), [0.1, 0.2, 0.3], 0.44, 0.1, 3);
        let fault =
            |marks: &[Mark]| calibrate(marks, &Sensor::metro_i(), &BlockParams::default()).unwrap_err().to_string();
        let changed = |change: &dyn Fn(&mut Mark)| {
            let mut marks = good.clone();
            marks.iter_mut().for_each(change);
            fault(&marks)
        };
        assert!(calibrate(&good, &Sensor::metro_i(), &BlockParams::default()).is_ok());
        assert!(fault(&good[..4]).contains("at least 5"));
        assert!(
            fault(&good[..6]).contains("on one line") || fault(&good[..6]).contains("at least"),
            "{}",
            fault(&good[..6])
        );
        assert!(changed(&|m| m.v_px = 479.0 - m.v_px).contains("mirrored image"));
        assert!(changed(&|m| m.target.xyz.x = -m.target.xyz.x).contains("mirrored image"));
        assert!(changed(&|m| m.target.xyz *= 1000.0).contains("are these millimetres?"));
        assert!(changed(&|m| m.target.xyz /= 1000.0).contains("metres read as millimetres"));
        assert!(changed(&|m| m.target.xyz = Vector3::new(m.target.xyz.x, 0.0, 0.0)).contains("on one line"));
        assert!(changed(&|m| m.image = m.line as u32).starts_with("line 2: marks: found images 1 and 2"));
        assert!(
            changed(&|m| m.u_px = if m.line == 7 { f64::NAN } else { m.u_px }).starts_with("line 7: mark: found NaN")
        );
        assert!(changed(&|m| m.u_px += 5000.0).contains("a pixel of 512 x 480"));
        // Pixels in another order than positions.
        let mut shuffled = good.clone();
        for (i, m) in shuffled.iter_mut().enumerate() {
            (m.u_px, m.v_px) = (good[(i * 7) % 60].u_px, good[(i * 7) % 60].v_px);
        }
        assert!(fault(&shuffled).contains("belong"), "{}", fault(&shuffled));
    }

    #[test]
    fn a_mark_that_is_off_is_left_out_and_named() {
        let (mut marks, _) = view(&block(), [0.1, 0.2, 0.3], 0.44, 0.1, 3);
        marks[16].u_px += 3.0;
        let fit = calibrate(&marks, &Sensor::metro_i(), &BlockParams::default()).unwrap();
        assert_eq!((fit.used.len(), fit.rejected.len()), (59, 1));
        assert_eq!(fit.rejected[0].what, "mark 17");
        assert!(fit.residual().rms < 0.2);
    }

    #[test]
    fn a_chip_in_another_unit_is_suspected() {
        let metres = Sensor { column_pitch_mm: 12.5e-6, row_pitch_mm: 9.9e-6, ..Sensor::metro_i() };
        assert!(metres.validated().unwrap_err().to_string().contains("micrometres or metres"));
        assert!(Sensor { width: 0, ..Sensor::metro_i() }.validated().is_err());
    }
}
