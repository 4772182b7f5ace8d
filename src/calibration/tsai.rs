//! The linear stage of Tsai's calibration: pose, focal length and column scale of one view, without distortion.
//!
//! With X = d'u·(Uf − Cu) and Y = dv·(Vf − Cv) on the chip, (20)–(21) and (25)–(26) leave rows that are linear in the
//! rotation and two translations (the radial alignment constraint): any radial distortion drops out of them.

use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, SVD, SymmetricEigen, Vector3};

use crate::fault::{Fault, Result};

/// A mark: its place on the target [m] and on the chip [mm], column scale 1.
#[derive(Clone, Copy, Debug)]
pub(super) struct ChipMark {
    pub target: Vector3<f64>,
    pub x_mm: f64,
    pub y_mm: f64,
}

/// The first guess.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Guess {
    /// Rotation from target to camera.
    pub rotation: Rotation3<f64>,
    /// The target's origin in the camera's frame [m].
    pub translation: Vector3<f64>,
    /// Focal length [mm].
    pub f_mm: f64,
    /// Column scale su.
    pub scale_u: f64,
}

/// How the marks lie on the target.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    pub centre: Vector3<f64>,
    /// RMS extents along the principal axes, largest first [m].
    pub extents_m: [f64; 3],
    /// Principal axes as columns, right-handed.
    pub axes: Matrix3<f64>,
}

impl Shape {
    /// Of at least one mark.
    pub fn of(points: &[Vector3<f64>]) -> Self {
        let count = points.len().max(1) as f64;
        let centre = points.iter().sum::<Vector3<f64>>() / count;
        let scatter: Matrix3<f64> = points.iter().map(|p| (p - centre) * (p - centre).transpose()).sum();
        let eigen = SymmetricEigen::new(scatter / count);
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let column = |k: usize| eigen.eigenvectors.column(order[k]).into_owned();
        let (first, second) = (column(0), column(1));
        let axes = Matrix3::from_columns(&[first, second, first.cross(&second)]);
        let extents_m = order.map(|k| eigen.eigenvalues[k].max(0.0).sqrt());
        Self { centre, extents_m, axes }
    }

    /// Whether all marks are on one plane, as far as a target can be made.
    pub fn is_flat(&self) -> bool {
        self.extents_m[2] < 1e-3 * self.extents_m[0]
    }

    /// Refuses marks that are all on one line (or one point).
    pub fn at_least_flat(&self) -> Result<()> {
        if self.extents_m[1] > 1e-3 * self.extents_m[0] {
            return Ok(());
        }
        let [length, width, _] = self.extents_m.map(|e| e * 1e3);
        let found = format!("all on one line ({length:.3} mm RMS along it, {width:.6} mm across)");
        Err(Fault::new("marks", found, "marks spread over a plane or a block"))
    }
}

/// Non-coplanar marks: `instrument.md` 4, steps 1–4.
///
/// Errors: fewer than 7 marks, marks that leave the rows dependent, a mirrored order.
pub(super) fn solid(marks: &[ChipMark], shape: &Shape) -> Result<Guess> {
    if marks.len() < 7 {
        return Err(Fault::new("marks", marks.len(), "at least 7 for a target with depth"));
    }
    let (origin, size) = (shifted_origin(marks)?, shape.extents_m[0]);
    // Step 1: [Y·x, Y·y, Y·z, Y, −X·x, −X·y, −X·z]·a = X.
    let local = |m: &ChipMark| (m.target - origin) / size;
    let rows = DMatrix::from_fn(marks.len(), 7, |i, j| {
        let (m, p) = (&marks[i], local(&marks[i]));
        match j {
            0..3 => m.y_mm * p[j],
            3 => m.y_mm,
            _ => -m.x_mm * p[j - 4],
        }
    });
    let right = DVector::from_iterator(marks.len(), marks.iter().map(|m| m.x_mm));
    let a = solved(rows, &right, "marks that leave the pose open (all rows of the linear stage depend on each other)")?;
    let (first, second) = (Vector3::new(a[0], a[1], a[2]), Vector3::new(a[4], a[5], a[6]));
    // Step 2.
    let mut ty = 1.0 / second.norm();
    let scale_u = first.norm() * ty;
    if !(scale_u.is_finite() && scale_u > 0.0) {
        return Err(Fault::new("marks", "no scale of the columns", "marks spread over the image"));
    }
    // Step 3, for Ty > 0; the sign is that which puts the marks on the side of the image where they are.
    let agreement: f64 = marks
        .iter()
        .map(|m| {
            let p = local(m);
            (first.dot(&p) + a[3]) * m.x_mm / scale_u + (second.dot(&p) + 1.0) * m.y_mm
        })
        .sum();
    if agreement < 0.0 {
        ty = -ty;
    }
    let (row1, row2, tx) = (first * ty / scale_u, second * ty, a[3] * ty / scale_u);
    let third = row1.cross(&row2);
    let rotation = nearest_rotation(&Matrix3::from_rows(&[row1.transpose(), row2.transpose(), third.transpose()]))?;
    // Step 4.
    let seen: Vec<ChipMark> = marks.iter().map(|m| ChipMark { x_mm: m.x_mm / scale_u, ..*m }).collect();
    let (f_mm, tz) = focal_length(&seen, &rotation, origin, size, [tx, ty])?;
    if f_mm <= 0.0 || tz <= 0.0 {
        let found = format!("a mirrored image (focal length {f_mm:.3} mm, target at {:.3} m)", tz * size);
        let expected = "right-handed x y z, and rows counted as they are (rows from the bottom are mirrored)";
        return Err(Fault::new("marks", found, expected));
    }
    let translation = Vector3::new(tx, ty, tz) * size - rotation * origin;
    Ok(Guess { rotation, translation, f_mm, scale_u })
}

/// Coplanar marks, with the column scale already divided out of `x_mm`: `instrument.md` 4.
///
/// Errors: fewer than 5 marks, marks that leave the rows dependent.
pub(super) fn flat(marks: &[ChipMark], shape: &Shape, chip_mm: f64) -> Result<Guess> {
    if marks.len() < 5 {
        return Err(Fault::new("marks", marks.len(), "at least 5 on a flat target"));
    }
    let (origin, size) = (shifted_origin(marks)?, shape.extents_m[0]);
    let local = |m: &ChipMark| shape.axes.tr_mul(&((m.target - origin) / size));
    // [Y·x, Y·y, Y, −X·x, −X·y]·a = X.
    let rows = DMatrix::from_fn(marks.len(), 5, |i, j| {
        let (m, p) = (&marks[i], local(&marks[i]));
        match j {
            0 | 1 => m.y_mm * p[j],
            2 => m.y_mm,
            _ => -m.x_mm * p[j - 3],
        }
    });
    let right = DVector::from_iterator(marks.len(), marks.iter().map(|m| m.x_mm));
    let a = solved(rows, &right, "marks that leave the pose open (all rows of the linear stage depend on each other)")?;
    let (s, q) = (a[0].powi(2) + a[1].powi(2) + a[3].powi(2) + a[4].powi(2), a[0] * a[4] - a[3] * a[1]);
    // Ty² = (S − √(S² − 4q²))/(2q²), written so that q = 0 does not divide.
    let mut ty = (2.0 / (s + (s * s - 4.0 * q * q).max(0.0).sqrt())).sqrt();
    let agreement: f64 = marks
        .iter()
        .map(|m| {
            let p = local(m);
            (a[0] * p.x + a[1] * p.y + a[2]) * m.x_mm + (a[3] * p.x + a[4] * p.y + 1.0) * m.y_mm
        })
        .sum();
    if agreement < 0.0 {
        ty = -ty;
    }
    let [r1, r2, tx, r4, r5] = [a[0] * ty, a[1] * ty, a[2] * ty, a[3] * ty, a[4] * ty];
    let r3 = (1.0 - r1 * r1 - r2 * r2).max(0.0).sqrt();
    let r6 = (1.0 - r4 * r4 - r5 * r5).max(0.0).sqrt() * if r1 * r4 + r2 * r5 >= 0.0 { -1.0 } else { 1.0 };
    // Both signs of (r3, r6) fit the two rows: the right one has f > 0.
    let mut best: Option<(Rotation3<f64>, f64, f64)> = None;
    for sign in [1.0, -1.0] {
        let (row1, row2) = (Vector3::new(r1, r2, sign * r3), Vector3::new(r4, r5, sign * r6));
        let third = row1.cross(&row2);
        let turn = Matrix3::from_rows(&[row1.transpose(), row2.transpose(), third.transpose()]);
        // From the plane's own axes back to the target's.
        let rotation = nearest_rotation(&(turn * shape.axes.transpose()))?;
        if let Ok((f, tz)) = focal_length(marks, &rotation, origin, size, [tx, ty]) {
            let better = best.is_none_or(|(_, known, _)| f > known);
            best = if better { Some((rotation, f, tz)) } else { best };
        }
    }
    let straight = Matrix3::from_rows(&[
        Vector3::new(r1, r2, r3).transpose(),
        Vector3::new(r4, r5, r6).transpose(),
        Vector3::new(r1, r2, r3).cross(&Vector3::new(r4, r5, r6)).transpose(),
    ]);
    // Nearly parallel to the image, distance and focal length show only as a ratio: any length will do as a guess.
    let (rotation, f_mm, tz) = match best.filter(|(_, f, _)| (0.1 * chip_mm..100.0 * chip_mm).contains(f)) {
        Some(found) => found,
        None => {
            let rotation = nearest_rotation(&(straight * shape.axes.transpose()))?;
            let f_mm = 2.0 * chip_mm;
            let lever: f64 = marks.iter().map(|m| m.x_mm.hypot(m.y_mm)).sum();
            let reach: f64 = marks
                .iter()
                .map(|m| rotation * ((m.target - origin) / size) + Vector3::new(tx, ty, 0.0))
                .map(|p| p.x.hypot(p.y))
                .sum();
            (rotation, f_mm, f_mm * reach / lever.max(f64::MIN_POSITIVE))
        }
    };
    let translation = Vector3::new(tx, ty, tz) * size - rotation * origin;
    Ok(Guess { rotation, translation, f_mm, scale_u: 1.0 })
}

/// [y, −Y; x, −X]·[f, Tz]ᵀ = w·[Y; X] (step 4, with the columns too): f [mm], Tz in units of `size`.
fn focal_length(
    marks: &[ChipMark],
    rotation: &Rotation3<f64>,
    origin: Vector3<f64>,
    size: f64,
    [tx, ty]: [f64; 2],
) -> Result<(f64, f64)> {
    let mut rows = DMatrix::zeros(2 * marks.len(), 2);
    let mut right = DVector::zeros(2 * marks.len());
    for (i, m) in marks.iter().enumerate() {
        let p = rotation * ((m.target - origin) / size);
        for (k, (along, seen)) in [(p.y + ty, m.y_mm), (p.x + tx, m.x_mm)].into_iter().enumerate() {
            rows[(2 * i + k, 0)] = along;
            rows[(2 * i + k, 1)] = -seen;
            right[2 * i + k] = p.z * seen;
        }
    }
    let answer = solved(rows, &right, "a target that shows no depth")?;
    Ok((answer[0], answer[1]))
}

/// Least squares with columns of equal length; refuses columns that depend on each other.
fn solved(mut rows: DMatrix<f64>, right: &DVector<f64>, why: &str) -> Result<DVector<f64>> {
    let refused = || Fault::new("marks", why, "marks that determine each unknown");
    let lengths: Vec<f64> = rows.column_iter().map(|c| c.norm()).collect();
    if lengths.iter().any(|n| !n.is_finite() || *n <= 0.0) {
        return Err(refused());
    }
    for (mut column, length) in rows.column_iter_mut().zip(&lengths) {
        column /= *length;
    }
    let svd = SVD::try_new(rows, true, true, f64::EPSILON, 10_000).ok_or_else(refused)?;
    if svd.singular_values.min() < 1e-9 * svd.singular_values.max() {
        return Err(refused());
    }
    let mut answer = svd.solve(right, 0.0).map_err(|_| refused())?;
    answer.iter_mut().zip(&lengths).for_each(|(a, n)| *a /= n);
    Ok(answer)
}

/// The mark farthest from the image's middle row, taken as origin: there Ty, by which the linear stage divides, is not 0.
fn shifted_origin(marks: &[ChipMark]) -> Result<Vector3<f64>> {
    let farthest = marks.iter().max_by(|a, b| a.y_mm.abs().total_cmp(&b.y_mm.abs()));
    match farthest {
        Some(m) if m.y_mm.abs() > 1e-6 => Ok(m.target),
        _ => Err(Fault::new("marks", "all on the image's middle row", "marks over the whole image")),
    }
}

/// The rotation nearest to a matrix.
pub(super) fn nearest_rotation(matrix: &Matrix3<f64>) -> Result<Rotation3<f64>> {
    let refused = || Fault::new("marks", "a rotation that is no number", "marks that determine the pose");
    let svd = SVD::try_new(*matrix, true, true, f64::EPSILON, 1000).ok_or_else(refused)?;
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Err(refused()) };
    let sign = (u * v_t).determinant().signum();
    let turn = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    if turn.iter().all(|x| x.is_finite()) { Ok(Rotation3::from_matrix_unchecked(turn)) } else { Err(refused()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// What a pinhole of 12 mm and scale 1.1 sees of `points`.
    fn seen(points: &[Vector3<f64>], rotation: &Rotation3<f64>, t: Vector3<f64>, scale_u: f64) -> Vec<ChipMark> {
        points
            .iter()
            .map(|p| {
                let q = rotation * p + t;
                ChipMark { target: *p, x_mm: 12.0 * q.x / q.z * scale_u, y_mm: 12.0 * q.y / q.z }
            })
            .collect()
    }

    fn block(depths: &[f64]) -> Vec<Vector3<f64>> {
        let grid = |z: f64| (0..30).map(move |i| Vector3::new((i % 6) as f64 * 0.032, (i / 6) as f64 * 0.025, z));
        depths.iter().flat_map(|z| grid(*z)).collect()
    }

    proptest! {
        #[test]
        fn exact_marks_of_a_block_give_the_exact_camera(
            rpy in prop::array::uniform3(-0.5..0.5f64), x in -0.1..0.0f64, y in -0.1..0.0f64, z in 0.4..0.9f64,
        ) {
            let points = block(&[0.0, 0.045]);
            let rotation = Rotation3::from_euler_angles(rpy[0], rpy[1], rpy[2]);
            let t = Vector3::new(x, y, z);
            let guess = solid(&seen(&points, &rotation, t, 1.1), &Shape::of(&points)).unwrap();
            prop_assert!((guess.f_mm - 12.0).abs() < 1e-6 && (guess.scale_u - 1.1).abs() < 1e-7, "{guess:?}");
            prop_assert!((guess.translation - t).norm() < 1e-7);
            prop_assert!((guess.rotation.matrix() - rotation.matrix()).norm() < 1e-7);
        }

        #[test]
        fn exact_marks_of_a_tilted_plane_give_the_exact_camera(
            turn in -3.0..3.0f64, tilt in 0.2..0.6f64, spin in -3.0..3.0f64, lean in 0.0..0.5f64,
        ) {
            // A plane at a slant in the target's own frame too.
            let slant = Rotation3::from_euler_angles(lean, 0.3, 0.0);
            let points: Vec<_> = block(&[0.0]).iter().map(|p| slant * p).collect();
            let axis = nalgebra::Unit::new_normalize(Vector3::new(turn.cos(), turn.sin(), 0.0));
            let face = Rotation3::from_axis_angle(&axis, tilt) * Rotation3::from_euler_angles(0.0, 0.0, spin);
            let rotation = face * slant.inverse();
            let t = Vector3::new(-0.02, 0.01, 0.7);
            let guess = flat(&seen(&points, &rotation, t, 1.0), &Shape::of(&points), 8.0).unwrap();
            prop_assert!((guess.f_mm - 12.0).abs() < 1e-4, "{guess:?}");
            prop_assert!((guess.translation - t).norm() < 1e-5);
            prop_assert!((guess.rotation.matrix() - rotation.matrix()).norm() < 1e-5);
        }
    }

    #[test]
    fn an_origin_on_the_middle_row_is_no_matter() {
        let points = block(&[0.0, 0.045]);
        let (rotation, t) = (Rotation3::from_euler_angles(0.3, 0.2, 0.1), Vector3::new(0.0, 0.0, 0.6));
        let guess = solid(&seen(&points, &rotation, t, 1.0), &Shape::of(&points)).unwrap();
        assert!((guess.translation - t).norm() < 1e-9);
    }

    #[test]
    fn a_mirrored_block_is_refused() {
        let points = block(&[0.0, 0.045]);
        let (rotation, t) = (Rotation3::from_euler_angles(0.3, 0.2, 0.1), Vector3::new(0.0, 0.0, 0.6));
        let mut marks = seen(&points, &rotation, t, 1.0);
        marks.iter_mut().for_each(|m| m.y_mm = -m.y_mm);
        let fault = solid(&marks, &Shape::of(&points)).unwrap_err();
        assert!(fault.to_string().contains("mirrored"), "{fault}");
    }

    #[test]
    fn too_few_and_badly_spread_marks_are_refused() {
        let points = block(&[0.0, 0.045]);
        let (rotation, t) = (Rotation3::from_euler_angles(0.3, 0.2, 0.1), Vector3::new(0.0, 0.0, 0.6));
        let marks = seen(&points, &rotation, t, 1.0);
        assert!(solid(&marks[..6], &Shape::of(&points)).is_err());
        let line: Vec<_> = (0..9).map(|i| Vector3::new(i as f64, 2.0 * i as f64, 0.0)).collect();
        assert!(Shape::of(&line).at_least_flat().is_err());
        assert!(Shape::of(&block(&[0.0])).is_flat() && !Shape::of(&points).is_flat());
        // A flat target in the method for targets with depth.
        assert!(solid(&marks[..30], &Shape::of(&points[..30])).is_err());
    }
}
