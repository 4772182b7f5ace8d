//! Plane, camera, boards, hand-eye and the arm's errors at once, on reprojection.
//!
//! Rows: corners seen minus predicted; each stripe point's distance from the line where plane and board cross in the image; and
//! what each pose of the arm is off by. Each is divided by its standard deviation, and those are found from the data in turn:
//! a corner's and a stripe point's from what is left, the arm's from what its poses are off by and how well that is known.

use nalgebra::{DMatrix, Isometry3, Matrix3, Vector2, Vector3};

use super::{Board, Frame, FrameFit, PlaneFit, PlaneParams, met, spread};
use crate::calibration::hand_eye::HandEye;
use crate::calibration::points::Mark;
use crate::calibration::pose::moved;
use crate::calibration::solve::{Noise, Options, Parameter, Solution, minimise_with};
use crate::calibration::true_board::{Whitening, sightings};
use crate::fault::{Fault, Result};
use crate::geometry::{Camera as CameraFrame, Plane};
use crate::optics::{Camera, Distortion};

/// Places of the parameters.
pub(super) mod place {
    /// m = n/d [1/m]: the three places from here; the camera's nine are before.
    pub const PLANE: usize = 9;
    /// What the camera on the hand is turned and shifted by: six.
    pub const HAND: usize = 12;
    /// What the board in the base is turned and shifted by: six.
    pub const BOARD: usize = 18;
    /// Six for each frame: what the hand is turned and shifted by in its own frame, or the board in the camera's.
    pub const FRAMES: usize = 24;
}

/// Boards that must be seen for the camera to be refined.
const BOARDS_FOR_CAMERA: usize = 4;
/// Stripe points of a frame that go into the bundle: more would hold the same, since neighbours err alike.
const POINTS_MAX: usize = 48;
/// Rounds of fitting and finding standard deviations.
const ROUNDS_MAX: usize = 12;

/// A frame in the bundle.
#[derive(Clone, Debug)]
pub(super) struct Member {
    pub name: String,
    pub marks: Vec<Mark>,
    pub camera_from_board: Isometry3<f64>,
    /// The arm's pose, if the board is tied to it.
    arm: Option<Isometry3<f64>>,
    pub points: Vec<[f64; 2]>,
    /// Standard deviation of one point [px], and how many independent ones there are.
    sigma_px: f64,
    independent: f64,
    outside: usize,
    look: String,
}

impl Member {
    pub fn new(frame: &Frame, board: Board, has_hand_eye: bool) -> Self {
        let stripe = frame.stripe.clone();
        let independent = stripe.as_ref().map_or(1.0, |s| (s.points.len() as f64 / s.alike).max(2.0));
        Self {
            name: frame.name.clone(),
            marks: board.marks,
            camera_from_board: board.camera_from_board,
            arm: frame.base_from_hand.filter(|_| has_hand_eye),
            sigma_px: stripe.as_ref().map_or(1.0, |s| s.sigma_px),
            independent,
            outside: stripe.as_ref().map_or(0, |s| s.outside),
            look: stripe.as_ref().map_or(String::new(), |s| s.look.clone()),
            points: stripe.map_or(Vec::new(), |s| s.points),
        }
    }

    /// The points that go into the bundle.
    fn thinned(&self) -> impl Iterator<Item = &[f64; 2]> {
        self.points.iter().step_by(self.points.len().div_ceil(POINTS_MAX).max(1))
    }

    /// The standard deviation of one of them: together they hold as much as the independent ones.
    fn thinned_sigma_px(&self) -> f64 {
        self.sigma_px * (self.thinned().count() as f64 / self.independent).sqrt()
    }
}

/// Standard deviations that the data tell.
#[derive(Clone, Copy)]
struct Sigmas {
    corner_px: f64,
    /// Stripe points are off by this many times what their own straight line says.
    stripe: f64,
    arm_m: f64,
    arm_rad: f64,
}

impl Sigmas {
    fn near(&self, other: &Self) -> bool {
        let near = |a: f64, b: f64| (a / b - 1.0).abs() < 0.01;
        near(self.corner_px, other.corner_px)
            && near(self.stripe, other.stripe)
            && near(self.arm_m, other.arm_m)
            && near(self.arm_rad, other.arm_rad)
    }
}

pub(super) struct Bundle {
    camera: Camera,
    members: Vec<Member>,
    hand_eye: Option<HandEye>,
    params: PlaneParams,
    whitening: Option<Whitening>,
    sigmas: Sigmas,
}

impl Bundle {
    pub fn new(camera: Camera, members: Vec<Member>, hand_eye: Option<HandEye>, params: PlaneParams) -> Self {
        let (arm_m, arm_rad) = (params.arm_sigma_m.unwrap_or(2e-4), params.arm_sigma_rad.unwrap_or(2e-3));
        let sigmas = Sigmas { corner_px: 0.2, stripe: 1.0, arm_m, arm_rad };
        Self { camera, members, hand_eye, params, whitening: None, sigmas }
    }

    pub fn solved(mut self, start: &Plane<CameraFrame>) -> Result<PlaneFit> {
        let mut parameters = self.parameters(start);
        let options = Options { noise: Noise::Known(1.0), fall_min: 1e-9, ..Options::default() };
        for round in 0..ROUNDS_MAX {
            let values: Vec<f64> = parameters.iter().map(|p| p.start).collect();
            if round > 0 {
                self.whitening = self.board_errors(&values)?;
            }
            let fit = {
                let residuals = |p: &[f64]| self.residuals(p);
                let jacobian = |p: &[f64]| self.jacobian(p, &parameters);
                minimise_with(&parameters, &residuals, &jacobian, &options).map_err(|fault| reasoned(fault.found))?
            };
            parameters.iter_mut().zip(&fit.values).for_each(|(p, v)| p.start = *v);
            let found = self.sigmas_from(&fit);
            let settled = round > 1 && found.near(&self.sigmas);
            if settled || round + 1 == ROUNDS_MAX {
                let fit = fit.full_rank().map_err(|fault| reasoned(fault.found))?;
                return self.concluded(fit);
            }
            self.sigmas = found;
        }
        Err(reasoned("no end to the search".into()))
    }

    fn parameters(&self, start: &Plane<CameraFrame>) -> Vec<Parameter> {
        let Camera { fx, fy, cx, cy, .. } = self.camera;
        let boards = self.members.iter().filter(|m| !m.marks.is_empty()).count();
        let held = self.params.hold_camera || boards < BOARDS_FOR_CAMERA;
        let (names, lens) = match self.camera.distortion {
            Distortion::Pinhole => (["k1", "k2", "p1", "p2", "k3"], [0.0; 5]),
            Distortion::Tsai { k } => (["k", "k2", "p1", "p2", "k3"], [k, 0.0, 0.0, 0.0, 0.0]),
            Distortion::BrownConrady { k1, k2, p1, p2, k3 } => (["k1", "k2", "p1", "p2", "k3"], [k1, k2, p1, p2, k3]),
        };
        let mut all = vec![
            Parameter::new("fx_px", fx, fx),
            Parameter::new("fy_px", fy, fy),
            Parameter::new("cx_px", cx, 100.0),
            Parameter::new("cy_px", cy, 100.0),
        ];
        all.extend(names.into_iter().zip(lens).map(|(name, value)| Parameter::new(name, value, 1.0)));
        // Coefficients that the camera does not have stay at 0.
        for (i, p) in all.iter_mut().enumerate() {
            p.fixed = held || (i >= 4 && p.start == 0.0);
        }
        let m = start.normal / start.offset;
        let axes = ["x", "y", "z"];
        all.extend(axes.iter().zip(m.iter()).map(|(axis, v)| Parameter::new(format!("plane_{axis}"), *v, m.norm())));
        let distance = self.members.iter().map(|m| m.camera_from_board.translation.vector.norm()).fold(1e-3, f64::max);
        let six = |what: &str| {
            let turns = axes.map(|axis| Parameter::new(format!("{what} turn_{axis}"), 0.0, 1.0));
            let shifts = axes.map(|axis| Parameter::new(format!("{what} {axis}_m"), 0.0, distance));
            turns.into_iter().chain(shifts)
        };
        let with_arm = self.members.iter().any(|m| m.arm.is_some());
        all.extend(six("hand").chain(six("board")).map(|p| if with_arm { p } else { p.fixed() }));
        all.extend(self.members.iter().flat_map(|m| six(&format!("{}:", m.name))));
        all
    }

    fn camera(&self, p: &[f64]) -> Option<Camera> {
        let &[fx, fy, cx, cy, k1, k2, p1, p2, k3, ..] = p else { return None };
        let distortion = match self.camera.distortion {
            Distortion::Pinhole => Distortion::Pinhole,
            Distortion::Tsai { .. } => Distortion::Tsai { k: k1 },
            Distortion::BrownConrady { .. } => Distortion::BrownConrady { k1, k2, p1, p2, k3 },
        };
        (fx > 0.0 && fy > 0.0).then_some(Camera { fx, fy, cx, cy, distortion, ..self.camera })
    }

    fn hand_eye(&self, p: &[f64]) -> Option<HandEye> {
        self.hand_eye.map(|start| HandEye {
            hand_from_camera: moved(&start.hand_from_camera, &p[place::HAND..]),
            base_from_board: moved(&start.base_from_board, &p[place::BOARD..]),
        })
    }

    fn board(&self, j: usize, p: &[f64]) -> Isometry3<f64> {
        let (member, own) = (&self.members[j], own(p, j));
        match (member.arm, self.hand_eye(p)) {
            (Some(arm), Some(hand_eye)) => hand_eye.camera_from_board(&(arm * moved(&Isometry3::identity(), own))),
            _ => moved(&member.camera_from_board, own),
        }
    }

    /// All rows: the corners of all frames, then stripe and arm of each frame.
    fn residuals(&self, p: &[f64]) -> Option<Vec<f64>> {
        let (mut corners, mut others) = (Vec::new(), Vec::new());
        let camera = self.camera(p)?;
        for j in 0..self.members.len() {
            self.rows(j, p, &camera, &mut corners, &mut others)?;
        }
        self.weigh(&mut corners);
        corners.extend(others);
        Some(corners)
    }

    /// Makes corner rows independent, and divides them by their standard deviation.
    fn weigh(&self, corners: &mut [f64]) {
        if let Some(whitening) = &self.whitening {
            whitening.apply(corners);
        }
        corners.iter_mut().for_each(|r| *r /= self.sigmas.corner_px);
    }

    /// Appends the rows of frame `j`: its corners [px], and the others, divided by their standard deviations.
    fn rows(&self, j: usize, p: &[f64], camera: &Camera, corners: &mut Vec<f64>, others: &mut Vec<f64>) -> Option<()> {
        let (member, board) = (&self.members[j], self.board(j, p));
        for mark in &member.marks {
            let [u, v] = camera.project(&(board * nalgebra::Point3::from(mark.target.xyz)).coords)?;
            corners.extend([mark.u_px - u, mark.v_px - v]);
        }
        let line = crossing(&board, p)?;
        let sigma = member.thinned_sigma_px() * self.sigmas.stripe;
        for point in member.thinned() {
            others.push(from_crossing(camera, &line, point)? / sigma);
        }
        if member.arm.is_some() {
            let own = own(p, j);
            others.extend(own[..3].iter().map(|turn| turn / self.sigmas.arm_rad));
            others.extend(own[3..].iter().map(|shift| shift / self.sigmas.arm_m));
        }
        Some(())
    }

    /// Central differences; what belongs to one frame moves only that frame's rows.
    fn jacobian(&self, p: &[f64], parameters: &[Parameter]) -> Option<DMatrix<f64>> {
        let corner_rows: usize = self.members.iter().map(|m| 2 * m.marks.len()).sum();
        let other_rows = |m: &Member| m.thinned().count() + if m.arm.is_some() { 6 } else { 0 };
        let rows = corner_rows + self.members.iter().map(other_rows).sum::<usize>();
        let mut slopes = DMatrix::zeros(rows, p.len());
        let mut moved = p.to_vec();
        let mut from = (0, corner_rows);
        for j in 0..=self.members.len() {
            // The last turn is that of the shared parameters.
            let frame = self.members.get(j);
            let range =
                if frame.is_some() { place::FRAMES + 6 * j..place::FRAMES + 6 * (j + 1) } else { 0..place::FRAMES };
            let side = |moved: &[f64]| -> Option<(Vec<f64>, Vec<f64>)> {
                let camera = self.camera(moved)?;
                let (mut corners, mut others) = (Vec::new(), Vec::new());
                let which = if frame.is_some() { j..j + 1 } else { 0..self.members.len() };
                for k in which {
                    self.rows(k, moved, &camera, &mut corners, &mut others)?;
                }
                Some((corners, others))
            };
            let (corner_from, other_from) = if frame.is_some() { from } else { (0, corner_rows) };
            for i in range.filter(|&i| !parameters[i].fixed) {
                let step = 6e-6 * parameters[i].scale;
                moved[i] = p[i] + step;
                let high = side(&moved)?;
                moved[i] = p[i] - step;
                let low = side(&moved)?;
                moved[i] = p[i];
                for (first, high, low) in [(corner_from, &high.0, &low.0), (other_from, &high.1, &low.1)] {
                    for (k, (h, l)) in high.iter().zip(low).enumerate() {
                        slopes[(first + k, i)] = (h - l) / (2.0 * step);
                    }
                }
            }
            if let Some(member) = frame {
                from = (from.0 + 2 * member.marks.len(), from.1 + other_rows(member));
            }
        }
        for mut column in slopes.column_iter_mut() {
            self.weigh(&mut column.as_mut_slice()[..corner_rows]);
        }
        Some(slopes)
    }

    /// The errors of the board itself, for corners as the parameters have them.
    fn board_errors(&self, p: &[f64]) -> Result<Option<Whitening>> {
        if self.params.board_sigma_m == 0.0 || self.members.iter().all(|m| m.marks.is_empty()) {
            return Ok(None);
        }
        let camera = self.camera(p).ok_or_else(|| reasoned("no camera".into()))?;
        let views: Vec<_> = self.members.iter().enumerate().map(|(j, m)| (self.board(j, p), m.marks.clone())).collect();
        let (_, seen) = sightings(&camera, &views).ok_or_else(|| reasoned("marks out of sight".into()))?;
        Whitening::new(seen, self.params.board_sigma_m / self.sigmas.corner_px.max(1e-4)).map(Some)
    }

    /// The standard deviations that this fit shows.
    fn sigmas_from(&self, fit: &Solution) -> Sigmas {
        let corner_rows: usize = self.members.iter().map(|m| 2 * m.marks.len()).sum();
        let seen = self.members.iter().filter(|m| !m.marks.is_empty()).count();
        let mut sigmas = self.sigmas;
        if corner_rows > 0 {
            let square: f64 = fit.residuals[..corner_rows].iter().map(|r| r * r).sum();
            let free = corner_rows.saturating_sub(6 * seen + 9).max(corner_rows / 2);
            sigmas.corner_px = (sigmas.corner_px * (square / free as f64).sqrt()).max(1e-3);
        }
        let (mut from, mut square, mut independent) = (corner_rows, 0.0, 0.0);
        let (mut turns, mut shifts, mut count) = (0.0, 0.0, 0.0);
        for (j, member) in self.members.iter().enumerate() {
            let points = member.thinned().count();
            square += fit.residuals[from..from + points].iter().map(|r| r * r).sum::<f64>();
            independent += if points > 0 { member.independent } else { 0.0 };
            from += points + if member.arm.is_some() { 6 } else { 0 };
            // Only where the board's own corners tell: elsewhere the arm's error is what was assumed.
            if member.arm.is_some() && !member.marks.is_empty() {
                for i in 0..3 {
                    let [turn, shift] = [i, i + 3].map(|i| place::FRAMES + 6 * j + i);
                    turns += fit.values[turn].powi(2) + fit.covariance[(turn, turn)];
                    shifts += fit.values[shift].powi(2) + fit.covariance[(shift, shift)];
                    count += 1.0;
                }
            }
        }
        if independent > 0.0 {
            sigmas.stripe = (sigmas.stripe * (square / independent).sqrt()).clamp(1.0, 100.0);
        }
        if count > 0.0 {
            let found = |known: Option<f64>, squares: f64| known.unwrap_or((squares / count).sqrt().max(1e-7));
            sigmas.arm_rad = found(self.params.arm_sigma_rad, turns);
            sigmas.arm_m = found(self.params.arm_sigma_m, shifts);
        }
        sigmas
    }

    fn concluded(self, solution: Solution) -> Result<PlaneFit> {
        let p = &solution.values;
        let out_of_sight = || reasoned("points out of sight".into());
        let camera = self.camera(p).ok_or_else(out_of_sight)?.validated()?;
        let m = Vector3::new(p[place::PLANE], p[place::PLANE + 1], p[place::PLANE + 2]);
        let plane = Plane::new(m, 1.0).filter(|plane| plane.offset > 1e-3).ok_or_else(|| {
            let found = format!("a plane {:.3} mm from the camera's centre", 1e3 / m.norm());
            Fault::new("stripes", found, "at least 1 mm: nothing can be triangulated otherwise")
        })?;
        let covariance: Matrix3<f64> = solution.covariance.fixed_view::<3, 3>(place::PLANE, place::PLANE).into_owned();
        let mut raw = Vec::new();
        let mut frames = Vec::with_capacity(self.members.len());
        for (j, member) in self.members.iter().enumerate() {
            let board = self.board(j, p);
            let line = crossing(&board, p).ok_or_else(out_of_sight)?;
            let mut fit = FrameFit {
                name: member.name.clone(),
                camera_from_board: board,
                corners: member.marks.len(),
                corners_px: 0.0,
                look: member.look.clone(),
                points: member.points.clone(),
                outside: member.outside,
                stripe_px: Vec::with_capacity(member.points.len()),
                from_plane_m: Vec::with_capacity(member.points.len()),
                arm_off: [0.0; 2],
            };
            for point in &member.points {
                fit.stripe_px.push(from_crossing(&camera, &line, point).ok_or_else(out_of_sight)?);
                let ray = camera.ray(point[0], point[1]).ok_or_else(out_of_sight)?;
                let on_board = met(&board, &ray).ok_or_else(out_of_sight)?;
                fit.from_plane_m.push(plane.distance(on_board.into()));
            }
            for mark in &member.marks {
                let seen = camera.project(&(board * nalgebra::Point3::from(mark.target.xyz)).coords);
                let [u, v] = seen.ok_or_else(out_of_sight)?;
                raw.extend([mark.u_px - u, mark.v_px - v]);
            }
            if member.arm.is_some() {
                let own = own(p, j);
                let length = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
                fit.arm_off = [length(&own[3..]), length(&own[..3])];
            }
            frames.push(fit);
        }
        let left = self.whitening.as_ref().map_or(raw.clone(), |whitening| whitening.explained(&raw).1);
        let mut pairs = left.chunks_exact(2).map(|r| r[0] * r[0] + r[1] * r[1]);
        for fit in &mut frames {
            let square: f64 = pairs.by_ref().take(fit.corners).sum();
            fit.corners_px = if fit.corners > 0 { (square / fit.corners as f64).sqrt() } else { 0.0 };
        }
        let has_arm = self.members.iter().any(|m| m.arm.is_some());
        Ok(PlaneFit {
            camera,
            plane,
            covariance: spread(&m, &covariance),
            hand_eye: self.hand_eye(p).filter(|_| has_arm),
            arm_sigma: has_arm.then_some([self.sigmas.arm_m, self.sigmas.arm_rad]),
            frames,
            solution,
            svd_off_rad: 0.0,
            rejected: Vec::new(),
        })
    }
}

/// The six parameters of frame `j`.
fn own(p: &[f64], j: usize) -> &[f64] {
    let from = place::FRAMES + 6 * j;
    &p[from..from + 6]
}

/// The line l·(x, y, 1) = 0 in which a camera without distortion sees plane (m·x = 1) and board cross, |l.xy| = 1.
fn crossing(board: &Isometry3<f64>, p: &[f64]) -> Option<Vector3<f64>> {
    let normal = board.rotation * Vector3::z();
    let offset = normal.dot(&board.translation.vector);
    let line = Vector3::new(p[place::PLANE], p[place::PLANE + 1], p[place::PLANE + 2]) - normal / offset;
    let size = line.xy().norm();
    (offset.abs() > 1e-9 && size.is_finite() && size > 1e-12).then(|| line / size)
}

/// How far a pixel is from that line [px].
fn from_crossing(camera: &Camera, line: &Vector3<f64>, [u, v]: &[f64; 2]) -> Option<f64> {
    let off = line.dot(&camera.ray(*u, *v)?);
    // The line in pixels: (line.x/fx)·u + (line.y/fy)·v + … = 0.
    Some(off / Vector2::new(line.x / camera.fx, line.y / camera.fy).norm())
}

fn reasoned(found: String) -> Fault {
    Fault::new("laser plane", found, "more boards at more different distances and tilts, with the stripe on each")
}
