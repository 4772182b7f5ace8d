//! Zhang's first guess: a homography a view, the focal lengths that make all of them views of one plane, and the poses.

use nalgebra::{DMatrix, Matrix2, Matrix3, Rotation3, SVD, Vector2, Vector3};

use super::points::Mark;
use super::tsai::{Shape, nearest_rotation};
use crate::fault::{Fault, Result};

/// Board plane (units of its RMS extent) → pixels from `middle`, by the normalised direct linear transform.
pub(super) fn homography(marks: &[Mark], shape: &Shape, middle: Vector2<f64>) -> Result<Matrix3<f64>> {
    let refused = || Fault::new("marks", "no view of a plane", "marks spread over the board");
    let plane = |m: &Mark| on_plane(m, shape);
    let pixel = |m: &Mark| Vector2::new(m.u_px, m.v_px) - middle;
    let (from, to) = (normaliser(marks.iter().map(plane)), normaliser(marks.iter().map(pixel)));
    let mut rows = DMatrix::zeros(2 * marks.len(), 9);
    for (i, m) in marks.iter().enumerate() {
        let (p, q) = (from * plane(m).push(1.0), to * pixel(m).push(1.0));
        for k in 0..3 {
            rows[(2 * i, k)] = p[k];
            rows[(2 * i, 6 + k)] = -q.x * p[k];
            rows[(2 * i + 1, 3 + k)] = p[k];
            rows[(2 * i + 1, 6 + k)] = -q.y * p[k];
        }
    }
    let r = rows.qr().r();
    let svd = SVD::try_new(r, false, true, f64::EPSILON, 10_000).ok_or_else(refused)?;
    let v_t = svd.v_t.ok_or_else(refused)?;
    let h = v_t.row(svd.singular_values.imin());
    let scaled = Matrix3::from_fn(|i, j| h[3 * i + j]);
    let h = to.try_inverse().ok_or_else(refused)? * scaled * from;
    // The board is in front: its middle has positive depth.
    let h = if h[(2, 2)] < 0.0 { -h } else { h };
    if h.iter().all(|x| x.is_finite()) { Ok(h / h.norm()) } else { Err(refused()) }
}

/// How far the marks are from any straight view of a plane, RMS, relative to how far they spread in the image: some per cent
/// where a lens bends it, much where pixels belong to other marks.
pub(super) fn misfit(marks: &[Mark], shape: &Shape) -> Result<f64> {
    let h = homography(marks, shape, Vector2::zeros())?;
    let pixel = |m: &Mark| Vector2::new(m.u_px, m.v_px);
    let mean = marks.iter().map(pixel).sum::<Vector2<f64>>() / marks.len() as f64;
    let (mut off, mut spread) = (0.0, f64::MIN_POSITIVE);
    for m in marks {
        let q = h * on_plane(m, shape).push(1.0);
        off += (q.xy() / q.z - pixel(m)).norm_squared();
        spread += (pixel(m) - mean).norm_squared();
    }
    Ok((off / spread).sqrt())
}

fn on_plane(m: &Mark, shape: &Shape) -> Vector2<f64> {
    shape.axes.tr_mul(&(m.target.xyz - shape.centre)).xy() / shape.extents_m[0]
}

/// Moves points to mean 0 and RMS distance √2.
fn normaliser(points: impl Iterator<Item = Vector2<f64>> + Clone) -> Matrix3<f64> {
    let count = points.clone().count().max(1) as f64;
    let mean = points.clone().sum::<Vector2<f64>>() / count;
    let rms = (points.map(|p| (p - mean).norm_squared()).sum::<f64>() / count).sqrt();
    let scale = if rms > 0.0 { 2f64.sqrt() / rms } else { 1.0 };
    Matrix3::new(scale, 0.0, -scale * mean.x, 0.0, scale, -scale * mean.y, 0.0, 0.0, 1.0)
}

/// fx, fy from the two constraints of each homography (columns of a rotation), the axis at pixel 0.
pub(super) fn focal_lengths(homographies: &[Matrix3<f64>]) -> Option<[f64; 2]> {
    let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
    let (mut square, mut onto) = (0.0, 0.0);
    for h in homographies {
        let (a, b): (Vector3<f64>, Vector3<f64>) = (h.column(0).into_owned(), h.column(1).into_owned());
        let (sum, difference) = ((a + b) / 2.0, (a - b) / 2.0);
        for (x, y) in [(a, b), (sum, difference)] {
            // x'·diag(1/fx², 1/fy², 1)·y = 0, divided by the pixels' size.
            let size = (x.xy().norm() * y.xy().norm()).max(f64::MIN_POSITIVE);
            let (row, value) = (Vector2::new(x.x * y.x, x.y * y.y) / size, -x.z * y.z / size);
            normal += row * row.transpose();
            right += row * value;
            let both = row.x + row.y;
            square += both * both;
            onto += both * value;
        }
    }
    let inverse = normal.try_inverse().map(|n| n * right);
    let length = |x: f64| (x.is_finite() && x > 0.0).then(|| 1.0 / x.sqrt()).filter(|f| (1.0..1e6).contains(f));
    let apart =
        inverse.and_then(|q| Some([length(q.x)?, length(q.y)?])).filter(|[fx, fy]| (0.3..3.0).contains(&(fx / fy)));
    // One length for both where two cannot be had.
    apart.or_else(|| length(onto / square).map(|f| [f, f]))
}

/// The pose of the target from its homography.
pub(super) fn pose(h: &Matrix3<f64>, [fx, fy]: [f64; 2], shape: &Shape) -> Result<(Rotation3<f64>, Vector3<f64>)> {
    let rays = Matrix3::from_diagonal(&Vector3::new(1.0 / fx, 1.0 / fy, 1.0)) * h;
    let (a, b, t) = (rays.column(0).into_owned(), rays.column(1).into_owned(), rays.column(2).into_owned());
    let size = (a.norm() + b.norm()) / 2.0;
    let rotation = nearest_rotation(&Matrix3::from_columns(&[a / size, b / size, a.cross(&b) / (size * size)]))?;
    let rotation = rotation * Rotation3::from_matrix_unchecked(shape.axes.transpose());
    Ok((rotation, t / size * shape.extents_m[0] - rotation * shape.centre))
}
