//! A board is never quite what its drawing says: printing, glue and paper move each mark by some tenths of a millimetre,
//! the same in every view. Seen − predicted of one mark is therefore alike in all views: taken as independent noise, it gets the
//! wrong weight and bends the camera.
//!
//! With offsets δ of a mark ~ N(0, σ_b²) in x, y, z and pixels ~ N(0, σ_px²), its residuals r (all views stacked) have the
//! covariance σ_px²·(1 + q²·J·Jᵀ), q = σ_b/σ_px, J = d pixel/d mark. Dividing r by the Cholesky factor of 1 + q²·J·Jᵀ makes
//! plain least squares of it, without an unknown more; the best estimate of δ is q²·Jᵀ·(1 + q²·J·Jᵀ)⁻¹·r.

use std::collections::BTreeMap;

use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Isometry3, Point3, Vector3};

use super::Target;
use super::points::Mark;
use crate::fault::{Fault, Result};
use crate::geometry::Point;
use crate::optics::Camera;

/// A mark, and the views and rows it is seen in.
type Marked = (Point<Target>, Vec<(usize, usize)>);

/// All sightings of one mark: the places of their u in the residuals (v follows), and the derivatives [px/m], two rows each.
pub(super) struct Sightings {
    pub rows: Vec<usize>,
    pub slopes: DMatrix<f64>,
}

/// All marks of a board in a fixed order, and how the pixels of each move with its place on the board. `views` are poses of the
/// board in the camera's frame with the marks seen; their residuals are u, v of each mark in turn. `None` out of sight.
pub(super) fn sightings(
    camera: &Camera,
    views: &[(Isometry3<f64>, Vec<Mark>)],
) -> Option<(Vec<Point<Target>>, Vec<Sightings>)> {
    const STEP_M: f64 = 1e-6;
    let mut seen: BTreeMap<[u64; 3], Marked> = BTreeMap::new();
    let mut row = 0;
    for (j, (_, marks)) in views.iter().enumerate() {
        for mark in marks {
            let p = mark.target.xyz;
            seen.entry([p.x, p.y, p.z].map(f64::to_bits)).or_insert((mark.target, vec![])).1.push((j, row));
            row += 2;
        }
    }
    let mut all = Vec::with_capacity(seen.len());
    let mut places = Vec::with_capacity(seen.len());
    for (target, seen) in seen.into_values() {
        let mut slopes = DMatrix::zeros(2 * seen.len(), 3);
        for (k, (j, _)) in seen.iter().enumerate() {
            let pixel = |d: Vector3<f64>| camera.project(&(views[*j].0 * Point3::from(target.xyz + d)).coords);
            for axis in 0..3 {
                let [u1, v1] = pixel(Vector3::ith(axis, STEP_M))?;
                let [u0, v0] = pixel(Vector3::ith(axis, -STEP_M))?;
                slopes[(2 * k, axis)] = (u1 - u0) / (2.0 * STEP_M);
                slopes[(2 * k + 1, axis)] = (v1 - v0) / (2.0 * STEP_M);
            }
        }
        places.push(target);
        all.push(Sightings { rows: seen.into_iter().map(|(_, row)| row).collect(), slopes });
    }
    Some((places, all))
}

/// Turns residuals into independent ones.
pub(super) struct Whitening {
    marks: Vec<(Sightings, Cholesky<f64, Dyn>)>,
    ratio: f64,
}

impl Whitening {
    /// For marks that are off by `ratio` = σ_b/σ_px [m/px].
    pub fn new(marks: Vec<Sightings>, ratio: f64) -> Result<Self> {
        let refused = || Fault::new("board_sigma_m", ratio, "a standard deviation that a board can have");
        let factor = |mark: Sightings| {
            let size = mark.slopes.nrows();
            let spread = DMatrix::identity(size, size) + &mark.slopes * mark.slopes.transpose() * (ratio * ratio);
            spread.cholesky().map(|factor| (mark, factor)).ok_or_else(refused)
        };
        Ok(Self { marks: marks.into_iter().map(factor).collect::<Result<_>>()?, ratio })
    }

    /// Divides a column of residuals, or of their derivatives, by the factor.
    pub fn apply(&self, column: &mut [f64]) {
        for (mark, factor) in &self.marks {
            let mut own = gathered(mark, column);
            factor.l_dirty().solve_lower_triangular_mut(&mut own);
            for (k, &row) in mark.rows.iter().enumerate() {
                (column[row], column[row + 1]) = (own[2 * k], own[2 * k + 1]);
            }
        }
    }

    /// The offset of each mark [m], and the residuals that are left when it is taken into account.
    pub fn explained(&self, residuals: &[f64]) -> (Vec<Vector3<f64>>, Vec<f64>) {
        let mut left = residuals.to_vec();
        let mut offsets = Vec::with_capacity(self.marks.len());
        for (mark, factor) in &self.marks {
            let own = factor.solve(&gathered(mark, residuals));
            let offset = mark.slopes.tr_mul(&own) * (self.ratio * self.ratio);
            offsets.push(Vector3::new(offset[0], offset[1], offset[2]));
            for (k, &row) in mark.rows.iter().enumerate() {
                (left[row], left[row + 1]) = (own[2 * k], own[2 * k + 1]);
            }
        }
        (offsets, left)
    }
}

fn gathered(mark: &Sightings, column: &[f64]) -> DVector<f64> {
    DVector::from_iterator(2 * mark.rows.len(), mark.rows.iter().flat_map(|&row| [column[row], column[row + 1]]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_offset_seen_in_many_views_is_found_and_taken_out() {
        let slopes = DMatrix::from_fn(12, 3, |i, j| ((i * i + 5 * j * i + 1) as f64 * 1.7).sin() * 3000.0);
        let offset = Vector3::new(1e-4, -2e-4, 5e-5);
        let seen = &slopes * DVector::from_column_slice(offset.as_slice());
        let rows = (0..6).map(|k| 2 * k).collect();
        let whitening = Whitening::new(vec![Sightings { rows, slopes }], 1.0).unwrap();
        let (offsets, left) = whitening.explained(seen.as_slice());
        assert!((offsets[0] - offset).norm() < 1e-9);
        assert!(left.iter().all(|r| r.abs() < 1e-6));
    }

    #[test]
    fn an_exact_board_changes_nothing() {
        let slopes = DMatrix::from_fn(4, 3, |i, j| (i + j) as f64);
        let whitening = Whitening::new(vec![Sightings { rows: vec![0, 2], slopes }], 0.0).unwrap();
        let mut column = [1.0, 2.0, 3.0, 4.0];
        whitening.apply(&mut column);
        assert_eq!(column, [1.0, 2.0, 3.0, 4.0]);
    }
}
