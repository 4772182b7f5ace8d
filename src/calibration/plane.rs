//! The laser plane of any camera with a laser: its stripe on boards whose poses are known.
//!
//! 1. `poses`: each board by its own corners; or, where an arm carries the camera and its poses are given, through the arm
//!    (hand-eye), so that an image that is black but for the stripe counts too.
//! 2. Stripe points (`stripe`) are lines of sight that meet the board: through all of them goes a plane, by SVD.
//! 3. `bundle`: everything at once on reprojection: plane, camera, boards, hand-eye and the arm's own errors, with covariance.

mod bundle;
mod holdout;
mod page;

use nalgebra::{Isometry3, Matrix3, Vector3};
use serde::{Deserialize, Serialize};

pub use super::hand_eye::HandEye;
pub use holdout::{HeldOut, held_out};
pub use page::{PlaneLimits, residuals_of};

use super::board::Chessboard;
use super::hand_eye;
use super::points::Mark;
use super::pose::board_pose;
use super::report::{Estimate, Rejected, Report, Residual};
use super::solve::Solution;
use super::stripe::Stripe;
use super::tsai::Shape;
use crate::fault::{Fault, Result, number_within};
use crate::geometry::{Camera as CameraFrame, Plane, Point, fit_plane};
use crate::optics::{Camera, PlaneLaser, RigCovariance};
use bundle::{Bundle, Member, place};

/// How a laser plane is calibrated.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlaneParams {
    /// Marks, and whole boards, this many robust standard deviations off are left out, and named.
    pub outlier_sigmas: f64,
    /// Standard deviation of a mark's own place on the board in x, y and z [m] (see `BoardParams`).
    pub board_sigma_m: f64,
    /// Whether the camera stays as it was given; otherwise corners and stripes refine it, where enough boards are seen.
    pub hold_camera: bool,
    /// Standard deviation of the arm's positions along each axis [m]; from the boards seen if left out.
    pub arm_sigma_m: Option<f64>,
    /// Standard deviation of the arm's turns about each axis [rad]; from the boards seen if left out.
    pub arm_sigma_rad: Option<f64>,
}

impl Default for PlaneParams {
    fn default() -> Self {
        Self { outlier_sigmas: 6.0, board_sigma_m: 1e-5, hold_camera: false, arm_sigma_m: None, arm_sigma_rad: None }
    }
}

impl PlaneParams {
    /// Refuses numbers that make no sense.
    pub fn validated(self) -> Result<Self> {
        number_within("outlier_sigmas", self.outlier_sigmas, 3.0, 1e9)?;
        number_within("board_sigma_m", self.board_sigma_m, 0.0, 0.01)?;
        if let Some(sigma) = self.arm_sigma_m {
            number_within("arm_sigma_m", sigma, 1e-7, 0.1)?;
        }
        if let Some(sigma) = self.arm_sigma_rad {
            number_within("arm_sigma_rad", sigma, 1e-7, 0.1)?;
        }
        Ok(self)
    }
}

/// One image, or a pair of images taken from the same place.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// What faults and tables call it: the image's file name.
    pub name: String,
    /// The corners of the board; none where it is not seen.
    pub marks: Vec<Mark>,
    /// The pose of the arm's hand.
    pub base_from_hand: Option<Isometry3<f64>>,
    /// The stripe, where one was found.
    pub stripe: Option<Stripe>,
}

/// The part of the board's plane where the stripe counts [m].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outline {
    low: [f64; 2],
    high: [f64; 2],
}

impl Outline {
    /// The board's inner corners and `margin_m` more on each side.
    pub fn of(board: &Chessboard, margin_m: f64) -> Result<Self> {
        let board = board.validated()?;
        number_within("margin_m", margin_m, 0.0, 10.0)?;
        let end = |count: usize, pitch: f64| (count - 1) as f64 * pitch + margin_m;
        let high = [end(board.columns, board.column_pitch_m), end(board.rows, board.row_pitch_m)];
        Ok(Self { low: [-margin_m; 2], high })
    }

    /// Whether a line of sight (x, y, 1) meets it.
    pub fn is_met(&self, camera_from_board: &Isometry3<f64>, ray: &Vector3<f64>) -> bool {
        let Some(point) = met(camera_from_board, ray) else { return false };
        let on_board = camera_from_board.inverse_transform_point(&point.into());
        (0..2).all(|i| (self.low[i]..=self.high[i]).contains(&on_board[i]))
    }
}

/// Where a line of sight meets the board's plane, in the camera's frame.
fn met(camera_from_board: &Isometry3<f64>, ray: &Vector3<f64>) -> Option<Vector3<f64>> {
    let plane = board_plane(camera_from_board)?;
    let far = plane.meet(Point::new(0.0, 0.0, 0.0), ray)?;
    (far > 0.0).then(|| ray * far)
}

fn board_plane(camera_from_board: &Isometry3<f64>) -> Option<Plane<CameraFrame>> {
    let normal = camera_from_board.rotation * Vector3::z();
    Plane::through(camera_from_board.translation.vector.into(), normal)
}

/// A board whose pose is known.
#[derive(Clone, Debug, PartialEq)]
pub struct Board {
    /// Its pose.
    pub camera_from_board: Isometry3<f64>,
    /// The corners that it is known by; none if it is known through the arm.
    pub marks: Vec<Mark>,
    /// RMS distance of the corners in the image [px].
    pub rms_px: f64,
}

/// Boards and hand-eye as they are without the stripe.
#[derive(Clone, Debug)]
pub struct Poses {
    /// Where the camera sits on the arm, if the arm's poses are known.
    pub hand_eye: Option<HandEye>,
    /// The board of each frame; `None` where it is neither seen nor known through the arm.
    pub boards: Vec<Option<Board>>,
    /// Corners, and boards, that do not fit.
    pub rejected: Vec<Rejected>,
}

/// Finds the boards of all frames.
///
/// Errors: no board at all, or what makes no hand-eye calibration.
pub fn poses(camera: &Camera, frames: &[Frame], params: &PlaneParams) -> Result<Poses> {
    let params = params.validated()?;
    let (mut boards, mut rejected, mut pairs) = (Vec::with_capacity(frames.len()), Vec::new(), Vec::new());
    for frame in frames {
        if frame.marks.is_empty() {
            boards.push(None);
            continue;
        }
        match board_pose(camera, &frame.marks, params.outlier_sigmas) {
            Ok(found) => {
                for (mark, size) in found.off {
                    let what = format!("{}: mark {}", frame.name, mark.line);
                    rejected.push(Rejected { what, why: format!("{size:.2} px from where the other marks put it") });
                }
                pairs.extend(frame.base_from_hand.map(|arm| (arm, found.camera_from_board)));
                let (camera_from_board, marks, rms_px) = (found.camera_from_board, found.marks, found.rms_px);
                boards.push(Some(Board { camera_from_board, marks, rms_px }));
            }
            Err(fault) => {
                rejected.push(Rejected { what: frame.name.clone(), why: fault.to_string() });
                boards.push(None);
            }
        }
    }
    if boards.iter().all(Option::is_none) {
        return Err(Fault::new("boards", format!("none in {} images", frames.len()), "boards in at least two"));
    }
    let any_arm = frames.iter().any(|frame| frame.base_from_hand.is_some());
    let hand_eye = if any_arm { Some(hand_eye::guess(&pairs)?) } else { None };
    for (board, frame) in boards.iter_mut().zip(frames) {
        if let (None, Some(hand_eye), Some(arm)) = (&board, &hand_eye, &frame.base_from_hand) {
            let camera_from_board = hand_eye.camera_from_board(arm);
            *board = Some(Board { camera_from_board, marks: Vec::new(), rms_px: 0.0 });
        }
    }
    Ok(Poses { hand_eye, boards, rejected })
}

/// One frame after calibration.
#[derive(Clone, Debug)]
pub struct FrameFit {
    /// Its name.
    pub name: String,
    /// The board's pose.
    pub camera_from_board: Isometry3<f64>,
    /// Corners that went into it; 0: the board is known through the arm.
    pub corners: usize,
    /// RMS distance of the corners in the image [px], the board as it is estimated to be.
    pub corners_px: f64,
    /// How the stripe was found; empty without one.
    pub look: String,
    /// Points of the stripe.
    pub points: Vec<[f64; 2]>,
    /// Points that were outside the board.
    pub outside: usize,
    /// Distance of each point from where plane and board cross in the image [px].
    pub stripe_px: Vec<f64>,
    /// Distance of each point, as a point of the board, from the plane [m].
    pub from_plane_m: Vec<f64>,
    /// How far the arm's pose is estimated to be off, position [m] and turn [rad]; 0 without an arm.
    pub arm_off: [f64; 2],
}

impl FrameFit {
    /// RMS distance of the stripe from the plane [m].
    pub fn plane_rms_m(&self) -> f64 {
        rms(self.from_plane_m.iter().copied())
    }
}

fn rms(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len().max(1) as f64;
    (values.map(|v| v * v).fold(0.0, |a, b| a + b) / count).sqrt()
}

/// A calibrated laser plane.
#[derive(Clone, Debug)]
pub struct PlaneFit {
    /// The camera, refined where it was not held.
    pub camera: Camera,
    /// n·x = d in the camera's optical frame, d > 0.
    pub plane: Plane<CameraFrame>,
    /// Covariance of n and d.
    pub covariance: nalgebra::Matrix4<f64>,
    /// Where the camera sits on the arm, if there is one.
    pub hand_eye: Option<HandEye>,
    /// Standard deviations of the arm: positions [m] and turns [rad] along and about each axis.
    pub arm_sigma: Option<[f64; 2]>,
    /// The frames used, in the order given.
    pub frames: Vec<FrameFit>,
    /// All parameters of the bundle.
    pub solution: Solution,
    /// The plane by SVD before anything was refined: how far its normal is from the result [rad].
    pub svd_off_rad: f64,
    /// What was left out.
    pub rejected: Vec<Rejected>,
}

impl PlaneFit {
    /// The laser of a rig file.
    pub fn laser(&self) -> PlaneLaser {
        let n = self.plane.normal;
        PlaneLaser { normal: [n.x, n.y, n.z], offset_m: self.plane.offset, origin_m: None }
    }

    /// What the rig carries of it into every point: the plane's part. The camera's own is that of its calibration.
    pub fn rig_covariance(&self) -> RigCovariance {
        let entry = |i: usize, j: usize| (self.covariance[(i, j)] + self.covariance[(j, i)]) / 2.0;
        RigCovariance {
            parameters: ["normal_x", "normal_y", "normal_z", "offset_m"].map(String::from).to_vec(),
            matrix: (0..4).map(|i| (0..4).map(|j| entry(i, j)).collect()).collect(),
        }
    }

    /// Distances of all stripe points from the plane [mm].
    pub fn residual(&self) -> Residual {
        Residual::of(self.frames.iter().flat_map(|f| f.from_plane_m.iter().map(|d| d.abs() * 1e3)), "mm")
    }

    /// Distances of all stripe points in the image from where they should be [px].
    pub fn stripe_residual(&self) -> Residual {
        Residual::of(self.frames.iter().flat_map(|f| f.stripe_px.iter().map(|d| d.abs())), "px")
    }

    /// How many frames have a stripe, and how many a board of their own.
    pub fn counts(&self) -> [usize; 2] {
        let count = |of: &dyn Fn(&FrameFit) -> bool| self.frames.iter().filter(|f| of(f)).count();
        [count(&|f| !f.points.is_empty()), count(&|f| f.corners > 0)]
    }

    /// For people and programs.
    pub fn report(&self) -> Report {
        let n = self.plane.normal;
        let sigma = |i: usize| self.covariance[(i, i)].max(0.0).sqrt();
        let mut parameters = vec![
            Estimate::new("normal_x", n.x, sigma(0), "1"),
            Estimate::new("normal_y", n.y, sigma(1), "1"),
            Estimate::new("normal_z", n.z, sigma(2), "1"),
            Estimate::new("offset_m", self.plane.offset, sigma(3), "m"),
        ];
        let of = |i: usize, unit: &'static str| {
            let p = &self.solution.parameters[i];
            Estimate::new(&p.name, self.solution.values[i], self.solution.sigma(i), unit)
        };
        let camera = (0..place::PLANE).filter(|i| !self.solution.parameters[*i].fixed);
        parameters.extend(camera.map(|i| of(i, if i < 4 { "px" } else { "1" })));
        if let (Some(hand_eye), Some([shift, turn])) = (&self.hand_eye, self.arm_sigma) {
            let x = hand_eye.hand_from_camera;
            let (at, about) = (x.translation.vector, x.rotation.scaled_axis());
            for (i, axis) in ["x", "y", "z"].into_iter().enumerate() {
                let sigma = self.solution.sigma(place::HAND + 3 + i);
                parameters.push(Estimate::new(format!("hand_{axis}_m"), at[i], sigma, "m"));
            }
            for (i, axis) in ["x", "y", "z"].into_iter().enumerate() {
                let sigma = self.solution.sigma(place::HAND + i);
                parameters.push(Estimate::new(format!("hand_turn_{axis}_rad"), about[i], sigma, "rad"));
            }
            parameters.push(Estimate::new("arm_position_m", shift, 0.0, "m"));
            parameters.push(Estimate::new("arm_turn_rad", turn, 0.0, "rad"));
        }
        let used = self.frames.iter().map(|f| f.points.len()).sum();
        Report { parameters, residual: self.residual(), used, rejected: self.rejected.clone() }
    }
}

/// Calibrates the plane on the stripes of `frames`.
///
/// Errors: what `poses` refuses; a stripe on one board only, or on boards that leave all its points on one line; a plane through
/// the camera's centre; stripes that no plane explains.
pub fn calibrate(camera: &Camera, frames: &[Frame], params: &PlaneParams) -> Result<PlaneFit> {
    let camera = camera.validated()?;
    let params = params.validated()?;
    let known = poses(&camera, frames, &params)?;
    let mut rejected = known.rejected;
    let mut members: Vec<Member> = Vec::new();
    for (frame, board) in frames.iter().zip(known.boards) {
        let Some(board) = board else {
            if frame.stripe.is_some() {
                let why = "its board is neither seen nor known through the arm".to_string();
                rejected.push(Rejected { what: frame.name.clone(), why });
            }
            continue;
        };
        if frame.stripe.is_some() || !board.marks.is_empty() {
            members.push(Member::new(frame, board, known.hand_eye.is_some()));
        }
    }
    let mut left_out = 0;
    loop {
        let start = first_plane(&camera, &members)?;
        let fit = Bundle::new(camera, members.clone(), known.hand_eye, params).solved(&start)?;
        let off = far_off(&fit.frames, params.outlier_sigmas);
        if off.is_empty() {
            let turn = fit.plane.normal.dot(&start.normal).abs().min(1.0).acos();
            return Ok(PlaneFit { svd_off_rad: turn, rejected, ..fit });
        }
        left_out += off.len();
        for (i, why) in off.into_iter().rev() {
            rejected.push(Rejected { what: format!("{}: stripe", members[i].name), why });
            members[i].points.clear();
        }
        members.retain(|m| !m.points.is_empty() || !m.marks.is_empty());
        if left_out * 3 > frames.len() {
            let found = format!("{left_out} of {} stripes that do not fit the others", frames.len());
            return Err(Fault::new("stripes", found, "one plane of light, on flat boards"));
        }
    }
}

/// The plane of least squared distances through the stripes on their boards.
fn first_plane(camera: &Camera, members: &[Member]) -> Result<Plane<CameraFrame>> {
    let with_stripe = members.iter().filter(|m| !m.points.is_empty()).count();
    if with_stripe < 2 {
        let expected =
            "on at least 2 boards, better 10 at different distances and tilts: one line does not give a plane";
        return Err(Fault::new("stripe", format!("on {with_stripe} boards"), expected));
    }
    let mut points: Vec<Point<CameraFrame>> = Vec::new();
    for member in members {
        let seen = member.points.iter().filter_map(|[u, v]| met(&member.camera_from_board, &camera.ray(*u, *v)?));
        points.extend(seen.map(Point::from));
    }
    let places: Vec<Vector3<f64>> = points.iter().map(|p| p.xyz).collect();
    let [length, width, _] = Shape::of(&places).extents_m;
    let fit = fit_plane(&points).filter(|_| width > 0.02 * length).ok_or_else(|| {
        let found = format!("on one line in space ({:.2} mm across {:.1} mm)", width * 1e3, length * 1e3);
        Fault::new("stripes", found, "boards at different distances: move or tilt the board along the line of sight")
    })?;
    let plane = if fit.plane.offset < 0.0 { Plane::new(-fit.plane.normal, -fit.plane.offset) } else { Some(fit.plane) };
    plane.filter(|plane| plane.offset > 1e-3).ok_or_else(|| {
        let found = format!("a plane {:.3} mm from the camera's centre", fit.plane.offset.abs() * 1e3);
        Fault::new("stripes", found, "at least 1 mm: nothing can be triangulated otherwise")
    })
}

/// Frames whose stripe is much farther off the plane than those of the others, with the reason.
fn far_off(frames: &[FrameFit], sigmas: f64) -> Vec<(usize, String)> {
    let mut sizes: Vec<f64> =
        frames.iter().filter(|f| !f.points.is_empty()).map(|f| rms(f.stripe_px.iter().copied())).collect();
    sizes.sort_by(f64::total_cmp);
    let limit = sigmas * sizes.get(sizes.len() / 2).copied().unwrap_or(0.0).max(0.05);
    let off = frames.iter().enumerate().filter(|(_, f)| rms(f.stripe_px.iter().copied()) > limit);
    off.map(|(i, f)| {
        let size = rms(f.stripe_px.iter().copied());
        (i, format!("{size:.2} px from where the plane of the others cuts its board"))
    })
    .collect()
}

/// The covariance of n = m/|m| and d = 1/|m| from that of m.
fn spread(m: &Vector3<f64>, covariance: &Matrix3<f64>) -> nalgebra::Matrix4<f64> {
    let size = m.norm();
    let n = m / size;
    let turn = (Matrix3::identity() - n * n.transpose()) / size;
    let mut slopes = nalgebra::Matrix4x3::zeros();
    slopes.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
    slopes.fixed_view_mut::<1, 3>(3, 0).copy_from(&(-n.transpose() / (size * size)));
    slopes * covariance * slopes.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::Target;
    use crate::optics::Distortion;
    use nalgebra::{Point3, UnitQuaternion};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha12Rng;

    fn normal(rng: &mut ChaCha12Rng) -> f64 {
        (0..12).map(|_| rng.random_range(-0.5..0.5)).sum()
    }

    fn camera() -> Camera {
        let distortion = Distortion::BrownConrady { k1: -0.1, k2: 0.05, p1: 0.0, p2: 0.0, k3: 0.0 };
        Camera { width: 640, height: 480, fx: 600.0, fy: 605.0, cx: 322.0, cy: 236.0, distortion }
    }

    /// 0.8·y + 0.6·z = 0.25.
    fn light() -> Plane<CameraFrame> {
        Plane::new(Vector3::new(0.05, 0.8, 0.6), 0.25).unwrap()
    }

    const BOARD: Chessboard = Chessboard { columns: 6, rows: 5, column_pitch_m: 0.02, row_pitch_m: 0.02 };

    /// Boards at several distances and tilts.
    fn boards(count: usize) -> Vec<Isometry3<f64>> {
        (0..count)
            .map(|i| {
                let x = i as f64;
                let turn =
                    UnitQuaternion::new(Vector3::new(0.4 * (1.7 * x).sin(), 0.4 * (2.3 * x + 1.0).cos(), 0.3 * x));
                let middle = Vector3::new(0.02 * x.sin(), 0.01 * x.cos(), 0.30 + 0.02 * x);
                Isometry3::from_parts((middle - turn * Vector3::new(0.05, 0.04, 0.0)).into(), turn)
            })
            .collect()
    }

    /// What the camera sees of a board, with noise [px].
    fn frame(i: usize, board: &Isometry3<f64>, noise_px: f64, rng: &mut ChaCha12Rng) -> Frame {
        let camera = camera();
        let marks = (0..30).map(|k| {
            let target = Point::<Target>::new((k % 6) as f64 * 0.02, (k / 6) as f64 * 0.02, 0.0);
            let [u, v] = camera.project(&(board * Point3::from(target.xyz)).coords).unwrap();
            Mark { target, u_px: u + noise_px * normal(rng), v_px: v + noise_px * normal(rng), image: 0, line: k + 1 }
        });
        let marks = marks.collect();
        // Both planes: along their common direction from the point nearest to the board's middle.
        let (n, b) = (light().normal, board.rotation * Vector3::z());
        let along = n.cross(&b).normalize();
        let middle = (board * Point3::new(0.05, 0.04, 0.0)).coords;
        let across = along.cross(&b).normalize();
        let start = middle - across * (light().distance(middle.into()) / n.dot(&across));
        let points = (-20..20).filter_map(|k| {
            let [u, v] = camera.project(&(start + along * f64::from(k) * 0.003))?;
            Some([u + noise_px * normal(rng), v + noise_px * normal(rng)])
        });
        let points = points.collect();
        let stripe =
            Stripe { points, sigma_px: noise_px.max(0.02), alike: 1.0, outside: 0, off: 0, look: "drawn".into() };
        Frame { name: format!("im{i}"), marks, base_from_hand: None, stripe: Some(stripe) }
    }

    fn frames(count: usize, noise_px: f64, seed: u64) -> Vec<Frame> {
        let mut rng = ChaCha12Rng::seed_from_u64(seed);
        boards(count).iter().enumerate().map(|(i, board)| frame(i, board, noise_px, &mut rng)).collect()
    }

    /// A board without errors of its own.
    fn exact() -> PlaneParams {
        PlaneParams { board_sigma_m: 0.0, ..PlaneParams::default() }
    }

    #[test]
    fn exact_stripes_give_the_exact_plane() {
        let fit = calibrate(&camera(), &frames(6, 0.0, 1), &exact()).unwrap();
        assert!((fit.plane.normal - light().normal).norm() < 1e-6, "{:?}", fit.plane);
        assert!((fit.plane.offset - light().offset).abs() < 1e-6 && fit.residual().rms < 1e-4);
        assert_eq!(fit.counts(), [6, 6]);
        assert!((fit.camera.fx - 600.0).abs() < 1e-3, "{:?}", fit.camera);
    }

    #[test]
    fn the_truth_lies_inside_the_95_percent_intervals() {
        const REPEATS: u64 = 60;
        let mut inside = [0.0; 4];
        for seed in 0..REPEATS {
            let fit = calibrate(&camera(), &frames(5, 0.2, 100 + seed), &exact()).unwrap();
            let (n, d) = (fit.plane.normal - light().normal, fit.plane.offset - light().offset);
            for (i, off) in [n.x, n.y, n.z, d].into_iter().enumerate() {
                let near = off.abs() < 1.96 * fit.covariance[(i, i)].sqrt();
                inside[i] += f64::from(u8::from(near)) / REPEATS as f64;
            }
        }
        // 60 repeats: 95 % ± 2.8 %.
        assert!(inside.iter().all(|share| *share >= 0.87), "{inside:?}");
        assert!(inside.iter().sum::<f64>() / 4.0 >= 0.91, "{inside:?}");
    }

    #[test]
    fn black_images_count_through_the_arm() {
        let truth = HandEye {
            hand_from_camera: Isometry3::new(Vector3::new(0.1, -0.02, 0.03), Vector3::new(0.1, 0.2, 1.5)),
            base_from_board: Isometry3::new(Vector3::new(0.5, 0.2, 0.05), Vector3::new(3.0, 0.1, 0.2)),
        };
        let mut rng = ChaCha12Rng::seed_from_u64(5);
        let mut all: Vec<Frame> = Vec::new();
        for (i, board) in boards(10).iter().enumerate() {
            let arm = truth.base_from_board * board.inverse() * truth.hand_from_camera.inverse();
            // An arm of 0.1 mm and 0.5 mrad.
            let shift = Vector3::from_fn(|_, _| normal(&mut rng)) * 1e-4;
            let turn = Vector3::from_fn(|_, _| normal(&mut rng)) * 5e-4;
            let mut seen = frame(i, board, 0.1, &mut rng);
            if i >= 6 {
                seen.marks.clear();
            }
            all.push(Frame { base_from_hand: Some(arm * Isometry3::new(shift, turn)), ..seen });
        }
        let fit = calibrate(&camera(), &all, &exact()).unwrap();
        assert_eq!(fit.counts(), [10, 6]);
        let [shift, turn] = fit.arm_sigma.unwrap();
        assert!((3e-5..3e-4).contains(&shift) && (1e-4..1.5e-3).contains(&turn), "{shift} {turn}");
        let hand = fit.hand_eye.unwrap().hand_from_camera;
        assert!((hand.translation.vector - truth.hand_from_camera.translation.vector).norm() < 1e-3);
        let sigma = fit.covariance[(3, 3)].sqrt();
        assert!((fit.plane.offset - light().offset).abs() < 4.0 * sigma, "{} ± {sigma}", fit.plane.offset);
        // Calibrated without two of them, their stripes lie on their boards.
        let held = held_out(&calibrate(&camera(), &all[..8], &exact()).unwrap(), &all[8..], &exact());
        assert!(held.len() == 2 && held.iter().all(|h| !h.seen));
        let [off, ..] = residuals_of(&held);
        assert!(off.rms < 1.0 && off.unit == "mm", "{off:?}");
    }

    #[test]
    fn stripes_that_give_no_plane_are_refused_with_the_reason() {
        let all = frames(5, 0.1, 7);
        let fault = |frames: &[Frame]| calibrate(&camera(), frames, &exact()).unwrap_err().to_string();
        assert!(fault(&all[..1]).contains("on 1 boards"));
        let same: Vec<Frame> = (0..4).map(|_| all[2].clone()).collect();
        assert!(fault(&same).contains("on one line"), "{}", fault(&same));
        let unseen: Vec<Frame> = all.iter().map(|f| Frame { marks: Vec::new(), ..f.clone() }).collect();
        assert!(fault(&unseen).contains("none in 5 images"));
        let dark: Vec<Frame> = all.iter().map(|f| Frame { stripe: None, ..f.clone() }).collect();
        assert!(fault(&dark).contains("on 0 boards"));
        assert!(PlaneParams { board_sigma_m: f64::NAN, ..exact() }.validated().is_err());
    }

    #[test]
    fn the_outline_is_the_board_and_its_margin() {
        let board = Isometry3::new(Vector3::new(-0.05, -0.04, 0.4), Vector3::zeros());
        let outline = Outline::of(&BOARD, 0.01).unwrap();
        let meets = |x: f64, y: f64| outline.is_met(&board, &Vector3::new((x - 0.05) / 0.4, (y - 0.04) / 0.4, 1.0));
        assert!(meets(0.0, 0.0) && meets(0.109, 0.089) && meets(-0.009, 0.04));
        assert!(!meets(0.111, 0.04) && !meets(0.05, -0.011));
        assert!(Outline::of(&BOARD, -1.0).is_err() && Outline::of(&BOARD, f64::NAN).is_err());
    }
}
