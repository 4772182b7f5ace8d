//! Where a plane of light cuts a board, in the image of a camera without distortion.

use nalgebra::{Isometry3, Vector2, Vector3};

use crate::optics::Camera;

/// The line l·(x, y, 1) = 0 in which a camera without distortion sees plane (m·x = 1) and board cross, |l.xy| = 1.
pub(super) fn crossing(board: &Isometry3<f64>, m: &Vector3<f64>) -> Option<Vector3<f64>> {
    let normal = board.rotation * Vector3::z();
    let offset = normal.dot(&board.translation.vector);
    let line = m - normal / offset;
    let size = line.xy().norm();
    (offset.abs() > 1e-9 && size.is_finite() && size > 1e-12).then(|| line / size)
}

/// How far a pixel is from that line [px].
pub(super) fn from_crossing(camera: &Camera, line: &Vector3<f64>, [u, v]: &[f64; 2]) -> Option<f64> {
    Some(from_crossing_ray(camera, line, &camera.ray(*u, *v)?))
}

/// The same for a line of sight (x, y, 1).
pub(super) fn from_crossing_ray(camera: &Camera, line: &Vector3<f64>, ray: &Vector3<f64>) -> f64 {
    // The line in pixels: (line.x/fx)·u + (line.y/fy)·v + … = 0.
    line.dot(ray) / Vector2::new(line.x / camera.fx, line.y / camera.fy).norm()
}
