//! What is known before the first slit.

use std::collections::BTreeMap;

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use super::model::PARAMETERS;
use crate::calibration::camera::{BlockFit, Sensor, place};
use crate::fault::{Fault, Result, positive};

/// What is known of a parameter beforehand.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Knowledge {
    /// It is the first guess, exactly.
    Known,
    /// It is the first guess, give or take this (standard deviation, in its unit).
    Within(f64),
    /// Nothing but that the finder was built as drawn: the data must say.
    Free,
}

/// A calibrated camera: lf [mm], Su, k [1/mm²], Cu, Cv [px], with covariance (rows and columns in that order).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraPrior {
    /// lf [mm], Su, k [1/mm²], Cu, Cv [px].
    pub values: [f64; 5],
    /// Their covariance.
    pub covariance: [[f64; 5]; 5],
}

impl CameraPrior {
    /// Uncorrelated, with these standard deviations.
    pub fn with_sigmas(values: [f64; 5], sigmas: [f64; 5]) -> Self {
        let mut covariance = [[0.0; 5]; 5];
        for (i, sigma) in sigmas.iter().enumerate() {
            covariance[i][i] = sigma * sigma;
        }
        Self { values, covariance }
    }

    /// A camera calibrated on two planes of 30 points 45 mm apart, at 0.1 px (`instrument.md` 4).
    pub fn two_planes(values: [f64; 5]) -> Self {
        Self::with_sigmas(values, [0.019, 2e-4, 6e-5, 2.5, 2.5])
    }

    /// What a calibration on a dot block found.
    pub fn of(block: &BlockFit) -> Self {
        let places = [place::F, place::SCALE_U, place::K, place::CENTRE, place::CENTRE + 1];
        let held = |i: usize| block.solution.parameters.get(i).is_some_and(|p| p.fixed);
        let covariance = |i: usize, j: usize| {
            // What was held there is as good as known here: a billionth of itself.
            let known = if i == j && held(i) { (1e-9 * block.solution.values[i].abs().max(1e-6)).powi(2) } else { 0.0 };
            block.solution.covariance[(i, j)] + known
        };
        Self {
            values: places.map(|i| block.solution.values[i]),
            covariance: places.map(|i| places.map(|j| covariance(i, j))),
        }
    }

    /// L⁻¹ with L·Lᵀ = covariance: what makes its errors independent and of size 1.
    pub(super) fn whitening(&self) -> Result<Vec<Vec<f64>>> {
        let refused = || {
            Fault::new("camera covariance", "a matrix that is no covariance", "symmetric, positive definite, finite")
        };
        let matrix = DMatrix::from_fn(5, 5, |i, j| self.covariance[i][j]);
        if (&matrix - matrix.transpose()).norm().is_nan()
            || (&matrix - matrix.transpose()).norm() > 1e-9 * matrix.norm()
        {
            return Err(refused());
        }
        let inverse = matrix.cholesky().and_then(|c| c.l().try_inverse()).ok_or_else(refused)?;
        Ok(inverse.row_iter().map(|row| row.iter().copied().collect()).collect())
    }
}

/// What is taken as known before the first slit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Assumptions {
    /// Knowledge by parameter; those not named are `Free`.
    pub knowledge: BTreeMap<String, Knowledge>,
    /// The camera's own calibration.
    #[serde(default)]
    pub camera: Option<CameraPrior>,
    /// The chip: what makes millimetres of pixels.
    pub sensor: Sensor,
}

impl Assumptions {
    /// METRO-I's sensor, everything free.
    pub fn free() -> Self {
        Self { knowledge: BTreeMap::new(), camera: None, sensor: Sensor::metro_i() }
    }

    /// What the paper takes for granted (4.2): no roll and pan, the slit normal to X', mirror on the cylinder's axis, axis
    /// upright, gain known.
    pub fn paper() -> Self {
        let mut paper = Self::free();
        for name in [
            "roll_rad",
            "pan_rad",
            "beam_rad_per_pulse",
            "slit_roll_rad",
            "mirror_x_m",
            "camera_y_m",
            "axis_pitch_rad",
            "axis_roll_rad",
        ] {
            paper.knowledge.insert(name.into(), Knowledge::Known);
        }
        paper
    }

    /// The same, but for one parameter.
    pub fn with(mut self, name: &str, knowledge: Knowledge) -> Self {
        self.knowledge.insert(name.into(), knowledge);
        self
    }

    pub(super) fn validated(self) -> Result<Self> {
        self.sensor.validated()?;
        for (name, knowledge) in &self.knowledge {
            if !PARAMETERS.iter().any(|(known, ..)| known == name) {
                let known: Vec<&str> = PARAMETERS.iter().map(|(name, ..)| *name).collect();
                return Err(Fault::new("knowledge", name, format!("one of {}", known.join(", "))));
            }
            if let Knowledge::Within(sigma) = knowledge {
                positive(name, *sigma)?;
            }
        }
        Ok(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parameter_that_is_not_there_is_told() {
        let unknown = Assumptions::free().with("tlit_rad", Knowledge::Known).validated().unwrap_err().to_string();
        assert!(unknown.contains("tlit_rad") && unknown.contains("tilt_rad"), "{unknown}");
    }

    #[test]
    fn whitening_undoes_a_covariance() {
        let mut prior = CameraPrior::two_planes([11.4, 1.1, 0.003, 256.0, 239.0]);
        (prior.covariance[0][2], prior.covariance[2][0]) = (5e-7, 5e-7);
        let rows = prior.whitening().unwrap();
        let whitened = DMatrix::from_fn(5, 5, |i, j| rows[i][j]);
        let covariance = DMatrix::from_fn(5, 5, |i, j| prior.covariance[i][j]);
        assert!((&whitened * covariance * whitened.transpose() - DMatrix::identity(5, 5)).norm() < 1e-9);
    }
}
