//! Least-squares lines and planes.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use super::frame::Point;
use super::plane::Plane;

/// A plane fitted to points, with what is left.
#[derive(Clone, Copy, Debug)]
pub struct PlaneFit<F> {
    /// The plane of least squared distances.
    pub plane: Plane<F>,
    /// Centre of the points.
    pub centre: Point<F>,
    /// RMS distance of the points from the plane [m].
    pub rms: f64,
}

/// The plane of least squared orthogonal distances; `None` for fewer than three points or points on a line.
pub fn fit_plane<F>(points: &[Point<F>]) -> Option<PlaneFit<F>> {
    if points.len() < 3 {
        return None;
    }
    let count = points.len() as f64;
    let centre = points.iter().map(|p| p.xyz).sum::<Vector3<f64>>() / count;
    let scatter: Matrix3<f64> = points.iter().map(|p| (p.xyz - centre) * (p.xyz - centre).transpose()).sum();
    let eigen = SymmetricEigen::new(scatter);
    let smallest = eigen.eigenvalues.imin();
    let mut sorted = [eigen.eigenvalues[0], eigen.eigenvalues[1], eigen.eigenvalues[2]];
    sorted.sort_by(f64::total_cmp);
    if !sorted[2].is_finite() || sorted[1] <= 1e-12 * sorted[2] {
        return None;
    }
    let normal = eigen.eigenvectors.column(smallest).into_owned();
    let plane = Plane::through(centre.into(), normal)?;
    Some(PlaneFit { plane, centre: centre.into(), rms: (sorted[0].max(0.0) / count).sqrt() })
}

/// A line y = slope·x + intercept, with what is left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineFit {
    /// dy/dx.
    pub slope: f64,
    /// y at x = 0.
    pub intercept: f64,
    /// RMS of y − slope·x − intercept.
    pub rms: f64,
}

/// The line of least squared vertical distances; `None` for fewer than two distinct x.
pub fn fit_line(points: &[(f64, f64)]) -> Option<LineFit> {
    let count = points.len() as f64;
    let (mx, my) = points.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + x / count, b + y / count));
    let (sxx, sxy) = points.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + (x - mx).powi(2), b + (x - mx) * (y - my)));
    if sxx.is_nan() || sxx <= 0.0 {
        return None;
    }
    let slope = sxy / sxx;
    let intercept = my - slope * mx;
    let squares: f64 = points.iter().map(|(x, y)| (y - slope * x - intercept).powi(2)).sum();
    Some(LineFit { slope, intercept, rms: (squares / count).sqrt() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::World;

    #[test]
    fn the_plane_of_a_tilted_square_is_found() {
        let points: Vec<Point<World>> = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)]
            .iter()
            .map(|&(x, y)| Point::new(x, y, 0.5 * x + 0.25))
            .collect();
        let fit = fit_plane(&points).unwrap();
        assert!(fit.rms < 1e-9);
        assert!((fit.plane.normal.dot(&Vector3::new(-0.5, 0.0, 1.0).normalize()).abs() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn points_on_a_line_have_no_plane() {
        let points: Vec<Point<World>> = (0..9).map(|i| Point::new(i as f64, 2.0 * i as f64, 0.0)).collect();
        assert!(fit_plane(&points).is_none());
    }

    #[test]
    fn a_line_is_fitted_and_a_vertical_one_refused() {
        let fit = fit_line(&[(0.0, 1.0), (1.0, 3.0), (2.0, 5.0)]).unwrap();
        assert!((fit.slope - 2.0).abs() < 1e-12 && (fit.intercept - 1.0).abs() < 1e-12 && fit.rms < 1e-12);
        assert!(fit_line(&[(1.0, 0.0), (1.0, 5.0)]).is_none());
    }
}
