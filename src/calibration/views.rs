//! Many views of a flat board: Zhang's first guess from the homographies, then camera and poses all at once.

use nalgebra::{DMatrix, Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use super::Target;
use super::points::Mark;
use super::report::{Estimate, Rejected, Report, Residual, robust_sigma};
use super::solve::{Noise, Options, Parameter, Solution, minimise_with};
use super::true_board::{Sightings, Whitening, sightings};
use super::tsai::Shape;
use super::view_checks::{checked, left, ordered};
use super::zhang::{focal_lengths, homography, pose};
use crate::fault::{Fault, Result, number_within, positive};
use crate::geometry::{Camera as CameraFrame, Point, Transform};
use crate::optics::{Camera, Distortion};

/// One image of the board.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// What faults and tables call it: the image's file name.
    pub name: String,
    /// The marks seen in it.
    pub marks: Vec<Mark>,
}

/// How a board is calibrated on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BoardParams {
    /// How many radial coefficients are fitted, 0 to 3 (k1, k2, k3).
    pub radial: usize,
    /// Whether p1 and p2 are fitted.
    pub tangential: bool,
    /// Standard deviation of a mark's pixel in u and v [px]; from the residuals if left out.
    pub pixel_sigma_px: Option<f64>,
    /// Standard deviation of a mark's own place on the board in x, y and z [m]; 0 for a perfect board. The default is that of a
    /// good print on something flat [A]; paper on cardboard has 5e-5.
    pub board_sigma_m: f64,
    /// Marks this many robust standard deviations off are left out, and named.
    pub outlier_sigmas: f64,
    /// Refused above this relative standard deviation of the focal lengths.
    pub f_sigma_max: f64,
}

impl Default for BoardParams {
    fn default() -> Self {
        Self {
            radial: 2,
            tangential: true,
            pixel_sigma_px: None,
            board_sigma_m: 1e-5,
            outlier_sigmas: 6.0,
            f_sigma_max: 0.05,
        }
    }
}

impl BoardParams {
    fn validated(self) -> Result<Self> {
        if self.radial > 3 {
            return Err(Fault::new("radial", self.radial, "0 to 3 coefficients"));
        }
        if let Some(sigma) = self.pixel_sigma_px {
            number_within("pixel_sigma_px", sigma, 1e-6, 1e3)?;
        }
        number_within("board_sigma_m", self.board_sigma_m, 0.0, 0.01)?;
        number_within("outlier_sigmas", self.outlier_sigmas, 3.0, 1e9)?;
        positive("f_sigma_max", self.f_sigma_max)?;
        Ok(self)
    }
}

/// The camera's own parameters, before the six of each view.
const INTRINSIC: [(&str, &str); 9] = [
    ("fx_px", "px"),
    ("fy_px", "px"),
    ("cx_px", "px"),
    ("cy_px", "px"),
    ("k1", "1"),
    ("k2", "1"),
    ("p1", "1"),
    ("p2", "1"),
    ("k3", "1"),
];

/// A view after calibration.
#[derive(Clone, Debug)]
pub struct PosedView {
    /// Its name.
    pub name: String,
    /// The pose of the board.
    pub camera_from_target: Transform<CameraFrame, Target>,
    /// The marks used.
    pub marks: Vec<Mark>,
    /// Seen minus predicted [px], a pair a mark: with the board as it is estimated to be.
    pub residuals_px: Vec<[f64; 2]>,
    /// The same with the board as its drawing says.
    pub drawn_residuals_px: Vec<[f64; 2]>,
}

impl PosedView {
    /// What is left in this view, as distances in the image.
    pub fn residual(&self) -> Residual {
        distances(&self.residuals_px)
    }
}

/// A camera calibrated on a board.
#[derive(Clone, Debug)]
pub struct BoardFit {
    /// The camera.
    pub camera: Camera,
    /// The views used, in the order given.
    pub views: Vec<PosedView>,
    /// Each mark of the board, and how far it is estimated to be from there [m].
    pub board: Vec<(Point<Target>, Vector3<f64>)>,
    /// Covariance, weak directions: fx, fy, cx, cy, k1, k2, p1, p2, k3, then for each view three turns about the camera's
    /// axes [rad] and the board's origin in its frame [m].
    pub solution: Solution,
    /// Marks and views left out.
    pub rejected: Vec<Rejected>,
}

impl BoardFit {
    /// What is left over all views, as distances in the image.
    pub fn residual(&self) -> Residual {
        let all: Vec<[f64; 2]> = self.views.iter().flat_map(|v| v.residuals_px.iter().copied()).collect();
        distances(&all)
    }

    /// The same with the board as its drawing says.
    pub fn drawn_residual(&self) -> Residual {
        let all: Vec<[f64; 2]> = self.views.iter().flat_map(|v| v.drawn_residuals_px.iter().copied()).collect();
        distances(&all)
    }

    /// How far the marks of the board are estimated to be from their drawing, RMS over x, y and z together [m].
    pub fn board_rms_m(&self) -> f64 {
        (self.board.iter().map(|(_, offset)| offset.norm_squared()).sum::<f64>() / self.board.len().max(1) as f64)
            .sqrt()
    }

    /// For people and programs.
    pub fn report(&self) -> Report {
        let estimate = |(i, (name, unit)): (usize, &(&str, &'static str))| {
            Estimate::new(*name, self.solution.values[i], self.solution.sigma(i), unit)
        };
        let parameters = INTRINSIC.iter().enumerate().map(estimate).collect();
        let used = self.views.iter().map(|v| v.marks.len()).sum();
        Report { parameters, residual: self.residual(), used, rejected: self.rejected.clone() }
    }
}

fn distances(residuals: &[[f64; 2]]) -> Residual {
    Residual::of(residuals.iter().map(|[u, v]| u.hypot(*v)), "px")
}

/// Calibrates a camera of `width` × `height` pixels on views of one flat board.
///
/// Errors: a board seen once, views with fewer than six marks or with all of them on one line, marks that are not on one
/// plane, lengths that look like another unit, boards that are all parallel (then only the ratio of focal length and
/// distance shows), whatever the data leave wider than the limits of `params`: each with the reason.
pub fn calibrate(views: &[View], width: usize, height: usize, params: &BoardParams) -> Result<BoardFit> {
    let params = params.validated()?;
    let (views, shape) = checked(views)?;
    let (mut views, mut rejected) = ordered(views, &shape)?;
    let total: usize = views.iter().map(|v| v.marks.len()).sum();
    loop {
        let mut bundle = Bundle { views, rotations: Vec::new(), whitening: None, width, height, params };
        let solution = bundle.solved(&shape)?;
        let off = bundle.off(&solution.left);
        if off.iter().all(Vec::is_empty) {
            return bundle.concluded(solution, rejected);
        }
        views = left(bundle.views, off, &mut rejected);
        let remaining: usize = views.iter().map(|v| v.marks.len()).sum();
        if remaining * 2 < total || views.len() < 2 {
            let found = format!("{} of {total} that do not fit the others", total - remaining);
            return Err(Fault::new("marks", found, "positions and pixels that belong together"));
        }
    }
}

/// Camera and poses being solved; `rotations` are those that the turns of the parameters start from.
struct Bundle {
    views: Vec<View>,
    rotations: Vec<Rotation3<f64>>,
    whitening: Option<Whitening>,
    width: usize,
    height: usize,
    params: BoardParams,
}

impl Bundle {
    /// First without distortion and with the axis in the middle, then everything, then again from the poses found: so that
    /// the turns are about the camera's own axes, and the board's own errors have the weight that the noise found gives them.
    fn solved(&mut self, shape: &Shape) -> Result<Solved> {
        const ROUNDS_MAX: usize = 12;
        let mut parameters = self.guessed(shape)?;
        let known = self.params.pixel_sigma_px;
        let options = Options { noise: known.map_or(Noise::FromResiduals, Noise::Known), ..Options::default() };
        let mut noise = f64::INFINITY;
        for round in 0..ROUNDS_MAX {
            self.hold(&mut parameters, round == 0);
            let values: Vec<f64> = parameters.iter().map(|p| p.start).collect();
            if round > 1 && self.params.board_sigma_m > 0.0 {
                let ratio = self.params.board_sigma_m / known.unwrap_or(noise).max(1e-4);
                self.whitening = Some(Whitening::new(self.sightings(&values)?.1, ratio)?);
            }
            let found = {
                let residuals = |p: &[f64]| self.residuals(p).map(|r| self.whitened(r));
                let jacobian = |p: &[f64]| self.jacobian(p, &parameters);
                minimise_with(&parameters, &residuals, &jacobian, &options)
                    .map_err(|fault| self.reasoned(fault.found))?
            };
            for (j, rotation) in self.rotations.iter_mut().enumerate() {
                *rotation = turned(rotation, pose_of(&found.values, j));
            }
            for (i, parameter) in parameters.iter_mut().enumerate() {
                let is_turn = i >= INTRINSIC.len() && (i - INTRINSIC.len()) % 6 < 3;
                parameter.start = if is_turn { 0.0 } else { found.values[i] };
            }
            if round == 1 {
                self.facing(&parameters)?;
            }
            let settled = (found.noise / noise - 1.0).abs() < 1e-3;
            noise = found.noise;
            if round > 1 && (settled || round + 1 == ROUNDS_MAX) {
                return self.judged(found, &parameters);
            }
        }
        Err(self.reasoned("no end to the search".into()))
    }

    fn hold(&self, parameters: &mut [Parameter], all: bool) {
        for (i, parameter) in parameters.iter_mut().enumerate().take(INTRINSIC.len()) {
            parameter.fixed = match i {
                0 | 1 => false,
                2 | 3 => all,
                4 => all || self.params.radial < 1,
                5 => all || self.params.radial < 2,
                6 | 7 => all || !self.params.tangential,
                _ => all || self.params.radial < 3,
            };
        }
    }

    /// What the data leave too wide is refused.
    fn judged(&self, fit: Solution, parameters: &[Parameter]) -> Result<Solved> {
        let fit = fit.full_rank().map_err(|fault| self.reasoned(fault.found))?;
        let f_sigma = (0..2).map(|i| fit.sigma(i) / fit.values[i]).fold(0.0, f64::max);
        if f_sigma.is_nan() || f_sigma > self.params.f_sigma_max {
            let found = format!("a focal length of {:.1} px ± {:.1} %", fit.values[0], f_sigma * 100.0);
            return Err(self.reasoned(found));
        }
        let values: Vec<f64> = parameters.iter().map(|p| p.start).collect();
        let drawn = self.residuals(&values).ok_or_else(|| self.reasoned("marks out of sight".into()))?;
        let (offsets, left) = match &self.whitening {
            Some(whitening) => whitening.explained(&drawn),
            None => (Vec::new(), drawn.clone()),
        };
        Ok(Solved { fit, drawn, left, offsets })
    }

    /// A flat board can be seen from behind as well: but then in all views.
    fn facing(&self, parameters: &[Parameter]) -> Result<()> {
        let values: Vec<f64> = parameters.iter().map(|p| p.start).collect();
        // The board's z axis points away from the camera or towards it.
        let faces = |(j, rotation): (usize, &Rotation3<f64>)| {
            let p = pose_of(&values, j);
            (rotation * Vector3::z()).dot(&Vector3::new(p[3], p[4], p[5])) > 0.0
        };
        let front: Vec<bool> = self.rotations.iter().enumerate().map(faces).collect();
        let fronts = front.iter().filter(|f| **f).count();
        let odd = front.iter().position(|f| *f != (fronts * 2 >= front.len()));
        match odd {
            None => Ok(()),
            Some(j) => {
                let found = "a mirrored order (the board seen from behind, unlike in most other views)";
                let fault = Fault::new("marks", found, "the same order of marks in each view");
                Err(fault.in_file(&self.views[j].name))
            }
        }
    }

    fn whitened(&self, mut residuals: Vec<f64>) -> Vec<f64> {
        if let Some(whitening) = &self.whitening {
            whitening.apply(&mut residuals);
        }
        residuals
    }

    /// The marks of the board, and how the pixels of each move with its place on it.
    fn sightings(&self, p: &[f64]) -> Result<(Vec<Point<Target>>, Vec<Sightings>)> {
        let refused = || self.reasoned("marks out of sight".into());
        let camera = self.camera(p).ok_or_else(refused)?;
        let posed = |(j, view): (usize, &View)| {
            let pose = pose_of(p, j);
            let origin = Translation3::new(pose[3], pose[4], pose[5]);
            let rotation = UnitQuaternion::from_rotation_matrix(&turned(&self.rotations[j], pose));
            (Isometry3::from_parts(origin, rotation), view.marks.clone())
        };
        let views: Vec<(Isometry3<f64>, Vec<Mark>)> = self.views.iter().enumerate().map(posed).collect();
        sightings(&camera, &views).ok_or_else(refused)
    }

    /// Zhang: focal lengths from the homographies, with the axis in the middle of the image; then a pose a view.
    fn guessed(&mut self, shape: &Shape) -> Result<Vec<Parameter>> {
        let middle = Vector2::new((self.width as f64 - 1.0) / 2.0, (self.height as f64 - 1.0) / 2.0);
        let named = |fault: Fault, view: &View| fault.in_file(&view.name);
        let homographies: Vec<Matrix3<f64>> = (self.views.iter())
            .map(|view| homography(&view.marks, shape, middle).map_err(|fault| named(fault, view)))
            .collect::<Result<_>>()?;
        let [fx, fy] = focal_lengths(&homographies).ok_or_else(|| {
            let found = format!("{} views, all nearly parallel to the image", self.views.len());
            Fault::new("board", found, "views at different tilts of 20° or more")
        })?;
        let starts = [fx, fy, middle.x, middle.y, 0.0, 0.0, 0.0, 0.0, 0.0];
        let scales = [fx, fy, 100.0, 100.0, 1.0, 1.0, 1.0, 1.0, 1.0];
        let mut parameters: Vec<Parameter> = (INTRINSIC.iter().zip(starts).zip(scales))
            .map(|(((name, _), start), scale)| Parameter::new(*name, start, scale))
            .collect();
        self.rotations.clear();
        for (view, h) in self.views.iter().zip(&homographies) {
            let (rotation, origin) = pose(h, [fx, fy], shape).map_err(|fault| named(fault, view))?;
            self.rotations.push(rotation);
            let name = |what: &str| format!("{}: {what}", view.name);
            parameters.extend(["turn_x", "turn_y", "turn_z"].map(|what| Parameter::new(name(what), 0.0, 1.0)));
            let axes = ["x_m", "y_m", "z_m"].into_iter().zip(origin.iter());
            parameters.extend(axes.map(|(what, value)| Parameter::new(name(what), *value, origin.norm().max(1e-3))));
        }
        Ok(parameters)
    }

    fn camera(&self, p: &[f64]) -> Option<Camera> {
        let &[fx, fy, cx, cy, k1, k2, p1, p2, k3, ..] = p else { return None };
        let distortion = Distortion::BrownConrady { k1, k2, p1, p2, k3 };
        (fx > 0.0 && fy > 0.0).then_some(Camera { width: self.width, height: self.height, fx, fy, cx, cy, distortion })
    }

    fn residuals(&self, p: &[f64]) -> Option<Vec<f64>> {
        let camera = self.camera(p)?;
        let mut all = Vec::with_capacity(2 * self.views.iter().map(|v| v.marks.len()).sum::<usize>());
        for j in 0..self.views.len() {
            self.view_residuals(j, &camera, pose_of(p, j), &mut all)?;
        }
        Some(all)
    }

    /// Seen minus predicted [px] of view `j`, appended.
    fn view_residuals(&self, j: usize, camera: &Camera, pose: &[f64], out: &mut Vec<f64>) -> Option<()> {
        let (rotation, origin) = (turned(&self.rotations[j], pose), Vector3::new(pose[3], pose[4], pose[5]));
        for mark in &self.views[j].marks {
            let [u, v] = camera.project(&(rotation * mark.target.xyz + origin))?;
            out.extend([mark.u_px - u, mark.v_px - v]);
        }
        Some(())
    }

    /// Central differences; a pose moves only the marks of its own view.
    fn jacobian(&self, p: &[f64], parameters: &[Parameter]) -> Option<DMatrix<f64>> {
        let rows: usize = self.views.iter().map(|v| 2 * v.marks.len()).sum();
        let mut slopes = DMatrix::zeros(rows, p.len());
        let mut moved = p.to_vec();
        let mut step_of = |i: usize, from: usize, side: &dyn Fn(&[f64]) -> Option<Vec<f64>>| -> Option<()> {
            let step = 6e-6 * parameters[i].scale;
            moved[i] = p[i] + step;
            let high = side(&moved)?;
            moved[i] = p[i] - step;
            let low = side(&moved)?;
            moved[i] = p[i];
            for (k, (h, l)) in high.iter().zip(&low).enumerate() {
                slopes[(from + k, i)] = (h - l) / (2.0 * step);
            }
            Some(())
        };
        for i in (0..INTRINSIC.len()).filter(|&i| !parameters[i].fixed) {
            step_of(i, 0, &|moved| self.residuals(moved))?;
        }
        let camera = self.camera(p)?;
        let mut from = 0;
        for (j, view) in self.views.iter().enumerate() {
            for i in INTRINSIC.len() + 6 * j..INTRINSIC.len() + 6 * (j + 1) {
                step_of(i, from, &|moved| {
                    let mut out = Vec::with_capacity(2 * view.marks.len());
                    self.view_residuals(j, &camera, pose_of(moved, j), &mut out)?;
                    Some(out)
                })?;
            }
            from += 2 * view.marks.len();
        }
        if let Some(whitening) = &self.whitening {
            slopes.column_iter_mut().for_each(|mut column| whitening.apply(column.as_mut_slice()));
        }
        Some(slopes)
    }

    /// The reason why these views do not give the camera.
    fn reasoned(&self, found: String) -> Fault {
        let normals: Vec<Vector3<f64>> = self.rotations.iter().map(|r| r.matrix().column(2).into_owned()).collect();
        let spread = normals
            .iter()
            .flat_map(|a| normals.iter().map(move |b| a.dot(b).abs().min(1.0).acos()))
            .fold(0.0, f64::max)
            .to_degrees();
        if spread < 10.0 {
            let found = format!("{} views within {spread:.1}° of each other: {found}", self.views.len());
            return Fault::new("board", found, "views at different tilts of 20° or more (parallel ones add nothing)");
        }
        Fault::new("views", found, "more views at more different tilts, or fewer distortion coefficients")
    }

    /// For each view the marks too far off, with their distance [px].
    fn off(&self, residuals: &[f64]) -> Vec<Vec<(usize, f64)>> {
        let sizes: Vec<f64> = residuals.chunks_exact(2).map(|r| r[0].hypot(r[1])).collect();
        let sigma = robust_sigma(sizes.iter().copied()) * (0.6745 / 1.1774); // Rayleigh's median against the normal's
        let limit = self.params.outlier_sigmas * sigma.max(1e-6);
        let mut sizes = sizes.into_iter();
        let mut off = Vec::with_capacity(self.views.len());
        for view in &self.views {
            let own = sizes.by_ref().take(view.marks.len()).enumerate();
            off.push(own.filter(|(_, size)| *size > limit).collect());
        }
        off
    }

    fn concluded(self, solved: Solved, rejected: Vec<Rejected>) -> Result<BoardFit> {
        let Solved { fit, drawn, left, offsets } = solved;
        let camera = self.camera(&fit.values).ok_or_else(|| Fault::new("camera", "none", "a focal length"))?;
        let board = if offsets.is_empty() {
            Vec::new()
        } else {
            self.sightings(&fit.values)?.0.into_iter().zip(offsets).collect()
        };
        let pairs = |r: Vec<f64>| r.chunks_exact(2).map(|r| [r[0], r[1]]).collect::<Vec<_>>().into_iter();
        let (mut drawn, mut left) = (pairs(drawn), pairs(left));
        let mut views = Vec::with_capacity(self.views.len());
        for (j, (view, rotation)) in self.views.into_iter().zip(&self.rotations).enumerate() {
            let p = pose_of(&fit.values, j);
            let origin = Translation3::new(p[3], p[4], p[5]);
            let iso = Isometry3::from_parts(origin, UnitQuaternion::from_rotation_matrix(rotation));
            let count = view.marks.len();
            views.push(PosedView {
                name: view.name,
                camera_from_target: iso.into(),
                marks: view.marks,
                residuals_px: left.by_ref().take(count).collect(),
                drawn_residuals_px: drawn.by_ref().take(count).collect(),
            });
        }
        Ok(BoardFit { camera: camera.validated()?, views, board, solution: fit, rejected })
    }
}

/// A minimum, with its residuals [px] against the drawn board and against the estimated one, and the marks' offsets [m].
struct Solved {
    fit: Solution,
    drawn: Vec<f64>,
    left: Vec<f64>,
    offsets: Vec<Vector3<f64>>,
}

fn pose_of(p: &[f64], j: usize) -> &[f64] {
    let from = INTRINSIC.len() + 6 * j;
    &p[from..from + 6]
}

fn turned(rotation: &Rotation3<f64>, pose: &[f64]) -> Rotation3<f64> {
    Rotation3::new(Vector3::new(pose[0], pose[1], pose[2])) * rotation
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha12Rng;

    fn normal(rng: &mut ChaCha12Rng) -> f64 {
        (0..12).map(|_| rng.random_range(-0.5..0.5)).sum()
    }

    fn camera() -> Camera {
        let distortion = Distortion::BrownConrady { k1: -0.2, k2: 0.05, p1: 1e-3, p2: -5e-4, k3: 0.0 };
        Camera { width: 640, height: 480, fx: 700.0, fy: 710.0, cx: 330.0, cy: 235.0, distortion }
    }

    /// A board of 9 × 6 corners, 20 mm apart, its middle 0.4 m in front, turned by each of `turns`.
    fn views(turns: &[[f64; 3]], noise_px: f64, seed: u64) -> (Vec<View>, Vec<Isometry3<f64>>) {
        let mut rng = ChaCha12Rng::seed_from_u64(seed);
        let mut poses = Vec::new();
        let views = turns.iter().enumerate().map(|(j, turn)| {
            let rotation = UnitQuaternion::new(Vector3::from(*turn));
            let side = Vector3::new(0.02 * (j as f64).sin(), 0.01 * (j as f64).cos(), 0.21 + 0.005 * j as f64);
            let origin = side - rotation * Vector3::new(0.08, 0.05, 0.0);
            let pose = Isometry3::from_parts(origin.into(), rotation);
            poses.push(pose);
            let marks = (0..54).map(|i| {
                let target = Point::<Target>::new((i % 9) as f64 * 0.02, (i / 9) as f64 * 0.02, 0.0);
                let [u, v] = camera().project(&(rotation * target.xyz + origin)).unwrap();
                let (u_px, v_px) = (u + normal(&mut rng) * noise_px, v + normal(&mut rng) * noise_px);
                Mark { target, u_px, v_px, image: j as u32, line: i + 1 }
            });
            View { name: format!("image{j:03}.png"), marks: marks.collect() }
        });
        (views.collect(), poses)
    }

    /// A board without errors of its own.
    const EXACT: BoardParams = BoardParams {
        radial: 2,
        tangential: true,
        pixel_sigma_px: None,
        board_sigma_m: 0.0,
        outlier_sigmas: 6.0,
        f_sigma_max: 0.05,
    };

    const TURNS: [[f64; 3]; 7] = [
        [0.1, 0.0, 0.0],
        [0.5, 0.1, 0.1],
        [-0.5, 0.1, 1.5],
        [0.1, 0.6, -0.1],
        [0.0, -0.6, 0.2],
        [0.4, 0.4, 3.0],
        [-0.3, 0.5, 0.3],
    ];

    #[test]
    fn exact_corners_give_the_exact_camera() {
        let (views, poses) = views(&TURNS, 0.0, 1);
        let fit = calibrate(&views, 640, 480, &EXACT).unwrap();
        let truth = [700.0, 710.0, 330.0, 235.0, -0.2, 0.05, 1e-3, -5e-4, 0.0];
        for (i, truth) in truth.into_iter().enumerate() {
            assert!(
                (fit.solution.values[i] - truth).abs() < 1e-5 * truth.abs().max(1.0),
                "{i}: {}",
                fit.solution.values[i]
            );
        }
        for (view, pose) in fit.views.iter().zip(&poses) {
            assert!((view.camera_from_target.iso.inverse() * pose).translation.vector.norm() < 1e-7);
        }
    }

    #[test]
    fn the_truth_lies_inside_the_95_percent_intervals() {
        const REPEATS: u64 = 100;
        let truth = [700.0, 710.0, 330.0, 235.0, -0.2, 0.05, 1e-3, -5e-4];
        let mut inside = [0.0; 8];
        for seed in 0..REPEATS {
            let (views, _) = views(&TURNS, 0.2, 50 + seed);
            let fit = calibrate(&views, 640, 480, &EXACT).unwrap();
            for (i, count) in inside.iter_mut().enumerate() {
                let off = (fit.solution.values[i] - truth[i]).abs();
                *count += f64::from(u8::from(off < 1.96 * fit.solution.sigma(i))) / REPEATS as f64;
            }
        }
        // 100 repeats: 95 % ± 2.2 %.
        assert!(inside.iter().all(|share| (0.89..=1.001).contains(share)), "{inside:?}");
    }

    #[test]
    fn the_published_corners_of_the_turntable_give_the_published_camera() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data/slit_turntable/calibration.json");
        let Ok(text) = std::fs::read_to_string(path) else {
            eprintln!("skipped: ../shared/data is absent");
            return;
        };
        let json: serde_json::Value = serde_json::from_str(&text).unwrap();
        let pairs = |value: &serde_json::Value| -> Vec<Vec<f64>> { serde_json::from_value(value.clone()).unwrap() };
        let views: Vec<View> = (json["boards"].as_array().unwrap().iter())
            .map(|board| {
                let (pixels, places) = (pairs(&board["corners_px"]), pairs(&board["board_mm"]));
                let marks = pixels.iter().zip(&places).enumerate().map(|(i, (px, mm))| {
                    let target = Point::new(mm[0] * 1e-3, mm[1] * 1e-3, mm[2] * 1e-3);
                    Mark { target, u_px: px[0], v_px: px[1], image: 0, line: i + 1 }
                });
                View { name: board["image"].as_str().unwrap().into(), marks: marks.collect() }
            })
            .collect();
        let fit = calibrate(&views, 1152, 768, &BoardParams { outlier_sigmas: 1e9, ..EXACT }).unwrap();
        // cv2.calibrateCamera 5.0 with K3 fixed, on the same corners.
        assert!((fit.residual().rms - 0.222554).abs() < 1e-5, "{:?}", fit.residual());
        let opencv = [819.79994537, 821.1397980, 589.42306, 356.47690, 0.0948964, -0.1727786, -0.00745126, 2.7291e-5];
        // The publisher's own, from more images than these; its errors are three standard deviations.
        let published = [819.580391, 820.871851, 589.729088, 355.784866, 0.098104, -0.182481, -0.007731, 0.000151];
        let errors = [0.975988, 0.732922, 1.192389, 1.320806, 0.0031, 0.009811, 0.000468, 0.000594];
        for (i, ((value, opencv), (published, error))) in
            fit.solution.values.iter().zip(opencv).zip(published.into_iter().zip(errors)).enumerate()
        {
            assert!((value - opencv).abs() < 1e-3 * error, "{i}: {value} {opencv}");
            assert!((value - published).abs() < 3.0 * fit.solution.sigma(i) + error, "{i}: {value} {published}");
        }
        // With a board that may be off by 0.05 mm the same corners agree to a tenth of a pixel.
        let fit = calibrate(&views, 1152, 768, &BoardParams { board_sigma_m: 5e-5, ..EXACT }).unwrap();
        assert!(fit.residual().rms < 0.12 && fit.drawn_residual().rms < 0.3, "{:?}", fit.residual());
    }

    #[test]
    fn boards_that_do_not_give_a_camera_are_refused_with_the_reason() {
        let refused =
            |turns: &[[f64; 3]]| calibrate(&views(turns, 0.2, 3).0, 640, 480, &EXACT).unwrap_err().to_string();
        assert!(refused(&TURNS[..1]).contains("seen 1 times"));
        let straight = refused(&[[0.0; 3], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]]);
        assert!(straight.contains("parallel"), "{straight}");
        let same = refused(&[[0.02, 0.01, 0.0], [0.0, 0.02, 0.0], [0.01, 0.0, 0.3], [0.0, 0.0, 0.9]]);
        assert!(same.contains("board: found"), "{same}");
        let (good, _) = views(&TURNS, 0.2, 3);
        let fault = |change: &dyn Fn(&mut Vec<View>)| {
            let mut views = good.clone();
            change(&mut views);
            calibrate(&views, 640, 480, &EXACT).unwrap_err().to_string()
        };
        assert!(fault(&|v| v[1].marks.truncate(5)).starts_with("image001.png: marks: found 5"));
        assert!(fault(&|v| v[1].marks.truncate(9)).starts_with("image001.png: marks: found all on one line"));
        assert!(fault(&|v| v[1].marks[3].v_px = f64::NAN).starts_with("image001.png: mark 4: found NaN"));
        assert!(fault(&|v| v[1].marks[3].target.xyz.z = 0.05).contains("off one plane"));
        assert!(
            fault(&|v| v.iter_mut().flat_map(|v| &mut v.marks).for_each(|m| m.target.xyz *= 1e3)).contains("mixed")
        );
    }

    /// Gives mark i the pixel of mark `of(i)`.
    fn reordered(view: &mut View, of: impl Fn(usize) -> usize) {
        let pixels: Vec<(f64, f64)> = view.marks.iter().map(|m| (m.u_px, m.v_px)).collect();
        for (i, mark) in view.marks.iter_mut().enumerate() {
            (mark.u_px, mark.v_px) = pixels[of(i)];
        }
    }

    #[test]
    fn a_mirrored_board_is_refused() {
        let (mut views, _) = views(&TURNS, 0.1, 3);
        reordered(&mut views[5], |i| (i / 9) * 9 + (8 - i % 9));
        let fault = calibrate(&views, 640, 480, &EXACT).unwrap_err().to_string();
        assert!(fault.starts_with("image005.png: marks: found a mirrored order"), "{fault}");
    }

    #[test]
    fn a_board_with_errors_of_its_own_still_gives_honest_error_bars() {
        let truth = [700.0, 710.0, 330.0, 235.0, -0.2, 0.05, 1e-3, -5e-4];
        let (mut inside, mut squares, repeats) = ([0.0; 8], [0.0; 2], 40);
        for seed in 0..repeats {
            let mut rng = ChaCha12Rng::seed_from_u64(9000 + seed);
            let offsets: Vec<Vector3<f64>> =
                (0..54).map(|_| Vector3::from_fn(|_, _| normal(&mut rng) * 1e-4)).collect();
            let (mut views, poses) = views(&TURNS, 0.1, 50 + seed);
            for (view, pose) in views.iter_mut().zip(&poses) {
                for (mark, offset) in view.marks.iter_mut().zip(&offsets) {
                    let pixel = |p: Vector3<f64>| camera().project(&(pose * nalgebra::Point3::from(p)).coords).unwrap();
                    let (there, here) = (pixel(mark.target.xyz + offset), pixel(mark.target.xyz));
                    mark.u_px += there[0] - here[0];
                    mark.v_px += there[1] - here[1];
                }
            }
            let fit = calibrate(&views, 640, 480, &BoardParams { board_sigma_m: 1e-4, ..EXACT }).unwrap();
            assert!(fit.residual().rms < 0.5 * fit.drawn_residual().rms);
            for (i, count) in inside.iter_mut().enumerate() {
                let off = (fit.solution.values[i] - truth[i]).abs();
                *count += f64::from(u8::from(off < 1.96 * fit.solution.sigma(i))) / repeats as f64;
            }
            let plain = calibrate(&views, 640, 480, &EXACT).unwrap();
            squares[0] += (fit.solution.values[0] - truth[0]).powi(2);
            squares[1] += (plain.solution.values[0] - truth[0]).powi(2);
        }
        // 40 repeats: 95 % ± 3.4 %.
        assert!(inside.iter().all(|share| *share >= 0.85), "{inside:?}");
        // And the camera is nearer the truth than if the board were taken as exact.
        assert!(squares[0] < 0.7 * squares[1], "{squares:?}");
    }

    #[test]
    fn marks_and_views_that_are_off_are_named() {
        let (mut views, _) = views(&TURNS, 0.1, 3);
        views[2].marks[10].u_px += 4.0;
        // A board read in the wrong order.
        reordered(&mut views[5], |i| (i / 9) * 9 + (i % 9 + 3) % 9);
        let fit = calibrate(&views, 640, 480, &EXACT).unwrap();
        let names: Vec<&str> = fit.rejected.iter().map(|r| r.what.as_str()).collect();
        assert!(names.contains(&"image005.png") && names.contains(&"image002.png: mark 11"), "{names:?}");
        assert!(fit.views.len() == 6 && fit.residual().rms < 0.2, "{names:?}");
    }
}
