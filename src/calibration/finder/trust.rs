//! What a calibrated finder is good for: the error that the calibration itself leaves in a point, and a verdict.

use nalgebra::{DMatrix, Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::bundle::FinderFit;
use super::known::Assumptions;
use super::measured::Observations;
use super::model::{Model, PARAMETERS};
use crate::fault::{Fault, Result, positive};
use crate::geometry::Point;
use crate::optics::{Laser, Rig, Uncertainty, triangulate};

/// When a calibration is good enough.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Most that the RMS of the readings, each over its standard deviation, may be.
    pub rms_max: f64,
    /// Largest share of slits that may have been thrown out.
    pub rejected_share_max: f64,
    /// Largest error that the calibration may leave in the range of the floor at `floor_m` [m, standard deviation].
    pub range_sigma_m_max: f64,
    /// Where on the floor, ahead [m].
    pub floor_m: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self { rms_max: 1.5, rejected_share_max: 0.1, range_sigma_m_max: 5e-3, floor_m: 2.0 }
    }
}

/// Whether a calibration is good enough, and why not.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Verdict {
    /// Whether it is.
    pub accepted: bool,
    /// What is wrong; empty if it is accepted.
    pub reasons: Vec<String>,
    /// The error that the calibration leaves in the range of the floor there [m, standard deviation].
    pub range_sigma_m: f64,
}

impl FinderFit {
    /// The covariance [m²] that the calibration leaves in a point of the robot's frame, common to all points there: from
    /// mirror and cylinder pulses and a pixel. `None` where the finder sees no point.
    ///
    /// Errors: an encoder outside its travel.
    pub fn point_covariance(
        &self,
        mirror_pulse: i32,
        cylinder_pulse: i32,
        u: f64,
        v: f64,
    ) -> Result<Option<Matrix3<f64>>> {
        let seen = nothing();
        let assumptions = Assumptions { sensor: self.sensor, ..Assumptions::free() };
        let model = Model { nominal: &self.rig, assumptions: &assumptions, seen: &seen };
        let numbers = model.numbers_of(&self.rig)?;
        let count = PARAMETERS.len().min(self.covariance.nrows());
        let mut slopes = DMatrix::zeros(3, count);
        for (i, (.., scale)) in PARAMETERS.iter().enumerate().take(count) {
            let step = 1e-5 * scale;
            let moved = |by: f64| {
                let mut numbers = numbers.clone();
                numbers[i] += by;
                point(&model.rig(&numbers), mirror_pulse, cylinder_pulse, u, v)
            };
            let (Some(high), Some(low)) = (moved(step)?, moved(-step)?) else { return Ok(None) };
            slopes.set_column(i, &((high - low) / (2.0 * step)));
        }
        let covariance = &slopes * self.covariance.view((0, 0), (count, count)) * slopes.transpose();
        Ok(Some(Matrix3::from_fn(|i, j| covariance[(i, j)])))
    }

    /// The error that the calibration leaves in the range of the floor straight ahead [m, standard deviation]; `None`
    /// where camera and laser do not reach it.
    fn range_sigma(&self, ahead_m: f64) -> Result<Option<f64>> {
        let Laser::Mirror(mirror) = self.rig.laser else { return Ok(None) };
        let beam = (mirror.mirror_m[2] / (ahead_m - mirror.mirror_m[0])).atan();
        let pulse = ((beam - mirror.beam.zero_rad) / mirror.beam.rad_per_pulse).round();
        let camera = &self.rig.camera;
        let on_camera = self.rig.sensor_from_camera.inverse() * Point::new(ahead_m, 0.0, 0.0);
        let inside =
            |[u, v]: &[f64; 2]| (0.0..camera.width as f64).contains(u) && (0.0..camera.height as f64).contains(v);
        let travel = f64::from(mirror.beam.pulse_min)..=f64::from(mirror.beam.pulse_max);
        let Some([u, v]) = camera.project(&on_camera.xyz).filter(inside).filter(|_| travel.contains(&pulse)) else {
            return Ok(None);
        };
        Ok(self.point_covariance(pulse as i32, 0, u, v)?.map(|covariance| covariance.m11.max(0.0).sqrt()))
    }

    /// The same over the floor, from near to far, where it is seen: distance ahead and standard deviation [m].
    pub fn range_sigmas(&self) -> Vec<(f64, f64)> {
        let places = (1..=100).map(|i| f64::from(i) * 0.1);
        places.filter_map(|at| Some((at, self.range_sigma(at).ok()??))).collect()
    }

    /// The numbers of a finder, in the order of this calibration's parameters.
    ///
    /// Errors: a finder without a mirror.
    pub fn numbers_of(&self, rig: &Rig) -> Result<Vec<f64>> {
        let (seen, assumptions) = (nothing(), Assumptions { sensor: self.sensor, ..Assumptions::free() });
        let mut numbers = Model { nominal: rig, assumptions: &assumptions, seen: &seen }.numbers_of(rig)?;
        numbers.truncate(PARAMETERS.len());
        Ok(numbers)
    }

    /// Whether this calibration keeps within limits.
    ///
    /// Errors: limits that are not positive; a place on the floor that the finder does not see.
    pub fn verdict(&self, limits: &Limits) -> Result<Verdict> {
        let at = positive("limits.floor_m", limits.floor_m)?;
        for (what, limit) in [("rms_max", limits.rms_max), ("range_sigma_m_max", limits.range_sigma_m_max)] {
            positive(&format!("limits.{what}"), limit)?;
        }
        let unseen = || Fault::new("limits.floor_m", at, "a place on the floor that laser and camera reach");
        let range_sigma_m = self.range_sigma(at)?.ok_or_else(unseen)?;
        let report = &self.report;
        let thrown = report.rejected.len() as f64 / (report.used + report.rejected.len()).max(1) as f64;
        let mut reasons = Vec::new();
        let mut ask = |what: &str, found: f64, most: f64| {
            if found.is_nan() || found > most {
                reasons.push(format!("{what}: {found:.3}, at most {most} is accepted"));
            }
        };
        ask("rms of the readings over their standard deviations", report.residual.rms, limits.rms_max);
        ask("share of slits thrown out", thrown, limits.rejected_share_max);
        ask("range error from the calibration [mm]", range_sigma_m * 1e3, limits.range_sigma_m_max * 1e3);
        Ok(Verdict { accepted: reasons.is_empty(), reasons, range_sigma_m })
    }
}

fn nothing() -> Observations {
    Observations { slits: Vec::new(), walls: Vec::new(), pulse_sigma: 1.0, mark_sigma_m: 1.0 }
}

/// What a finder makes of a pixel, in the robot's frame.
fn point(rig: &Rig, mirror_pulse: i32, cylinder_pulse: i32, u: f64, v: f64) -> Result<Option<Vector3<f64>>> {
    let exact = Uncertainty { u_px: 0.0, v_px: 0.0, beam_rad: 0.0, cylinder_rad: 0.0 };
    let sheet = rig.laser_plane(mirror_pulse)?;
    let robot_from_sensor = rig.robot_from_sensor(cylinder_pulse)?;
    Ok(triangulate(rig, &sheet, u, v, &exact).map(|seen| (robot_from_sensor * seen.point).xyz))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::finder::{CameraPrior, Procedure, calibrate, normal, uniform};
    use rand::SeedableRng;
    use rand_chacha::ChaCha12Rng;

    #[test]
    fn points_of_calibrated_finders_scatter_as_their_covariance_says() {
        let mut draw = ChaCha12Rng::seed_from_u64(9);
        let (mut square, mut variance, repeats) = (0.0, 0.0, 60);
        for _ in 0..repeats {
            let truth = Rig::metro_i();
            let start = 0.9 + uniform(&mut draw, 0.02);
            let seen = Procedure::on_marks(truth.clone(), start, Procedure::marks(21, 2.0)).measure(&mut draw).unwrap();
            let mut camera = CameraPrior::two_planes([11.434, 1.095, 0.00335, 256.0, 239.0]);
            for i in 0..5 {
                camera.values[i] += camera.covariance[i][i].sqrt() * normal(&mut draw);
            }
            let fit = calibrate(&truth, &seen, &Assumptions { camera: Some(camera), ..Assumptions::paper() }).unwrap();
            let (pulse, u, v) = (40, 300.0, 200.0);
            let found = point(&fit.rig, pulse, 0, u, v).unwrap().unwrap();
            let true_point = point(&truth, pulse, 0, u, v).unwrap().unwrap();
            square += (found.x - true_point.x).powi(2);
            variance += fit.point_covariance(pulse, 0, u, v).unwrap().unwrap().m11;
        }
        let ratio = f64::sqrt(square / variance);
        eprintln!("range: rms {:.2} mm, σ {:.2} mm", (square / 60.0).sqrt() * 1e3, (variance / 60.0).sqrt() * 1e3);
        assert!((0.75..1.25).contains(&ratio), "{ratio}"); // 60 repeats: ±9 %
    }

    #[test]
    fn a_good_calibration_is_accepted_and_a_poor_one_told_why() {
        let mut draw = ChaCha12Rng::seed_from_u64(10);
        let camera = Some(CameraPrior::two_planes([11.434, 1.095, 0.00335, 256.0, 239.0]));
        let assumptions = Assumptions { camera, ..Assumptions::paper() };
        let rig = Rig::metro_i();
        let many = Procedure::on_marks(rig.clone(), 0.9, Procedure::marks(21, 2.0)).measure(&mut draw).unwrap();
        let good = calibrate(&rig, &many, &assumptions).unwrap().verdict(&Limits::default()).unwrap();
        assert!(good.accepted && good.reasons.is_empty(), "{good:?}");
        let three = Procedure::on_marks(rig.clone(), 1.5, [0.0, 0.6, 1.2]).measure(&mut draw).unwrap();
        let fit = calibrate(&rig, &three, &assumptions).unwrap();
        let poor = fit.verdict(&Limits::default()).unwrap();
        assert!(!poor.accepted && poor.reasons[0].starts_with("range error"), "{poor:?}");
        assert!(fit.verdict(&Limits { floor_m: -1.0, ..Limits::default() }).is_err());
    }
}
