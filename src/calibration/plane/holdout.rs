//! How well a plane holds on images that had no part in it: its stripes, triangulated, must lie on their boards.

use super::super::pose::board_pose;
use super::{Frame, PlaneFit, PlaneParams, board_plane};
use crate::geometry::Point;

/// One image that had no part in the calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct HeldOut {
    /// Its name.
    pub name: String,
    /// Whether its board is known by its own corners, not through the arm.
    pub seen: bool,
    /// Distances of the triangulated points from the board [m].
    pub from_board_m: Vec<f64>,
}

/// Triangulates the stripes of `frames` with the plane of `fit`, and measures them against boards that are posed by their own
/// corners, or else through the arm. Frames without stripe or board are left out.
pub fn held_out(fit: &PlaneFit, frames: &[Frame], params: &PlaneParams) -> Vec<HeldOut> {
    let mut all = Vec::new();
    for frame in frames {
        let Some(stripe) = &frame.stripe else { continue };
        let own =
            board_pose(&fit.camera, &frame.marks, params.outlier_sigmas).ok().map(|found| found.camera_from_board);
        let arm = || Some(fit.hand_eye.as_ref()?.camera_from_board(frame.base_from_hand.as_ref()?));
        let seen = own.is_some();
        let Some(board) = own.or_else(arm).and_then(|pose| board_plane(&pose)) else { continue };
        let distance = |[u, v]: &[f64; 2]| {
            let ray = fit.camera.ray(*u, *v)?;
            let far = fit.plane.meet(Point::new(0.0, 0.0, 0.0), &ray)?;
            Some(board.distance((ray * far).into()))
        };
        let from_board_m = stripe.points.iter().filter_map(distance).collect();
        all.push(HeldOut { name: frame.name.clone(), seen, from_board_m });
    }
    all
}
