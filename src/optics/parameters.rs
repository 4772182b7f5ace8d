//! The parameters of a finder by name, and how well they are known.
//!
//! Names are those of the finder's calibration, but for the camera, which is in pixels here: `fx_px`, `fy_px`, `cu_px`,
//! `cv_px` and the coefficients of its distortion on coordinates over the focal length.

use nalgebra::{DMatrix, Rotation3, Vector3};
use serde::{Deserialize, Serialize};

use super::camera::Distortion;
use super::rig::{Laser, Rig};
use crate::fault::{Fault, Result, number_within};

/// The parameters of every finder.
const COMMON: [&str; 12] = [
    "camera_height_m",
    "x0_m",
    "camera_y_m",
    "tilt_rad",
    "roll_rad",
    "pan_rad",
    "axis_pitch_rad",
    "axis_roll_rad",
    "fx_px",
    "fy_px",
    "cu_px",
    "cv_px",
];
/// Those of a laser that a mirror tilts.
const MIRROR: [&str; 5] = ["mirror_height_m", "mirror_x_m", "beam_zero_rad", "beam_rad_per_pulse", "slit_roll_rad"];
/// Those of a laser fixed to the camera: the normal as the rig has it, and the offset for it.
const PLANE: [&str; 4] = ["normal_x", "normal_y", "normal_z", "offset_m"];
/// The smallest eigenvalue of a covariance over its largest, for rounding.
const EIGENVALUE_MIN: f64 = -1e-9;

/// What calibration does not know of a finder: the covariance of some of its parameters. Those that are not named are
/// exact. Unlike noise it is the same for all points, which no averaging takes away.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigCovariance {
    /// Names, as [`Rig::parameters`] lists them.
    pub parameters: Vec<String>,
    /// Row by row, in the order and the units of the names.
    pub matrix: Vec<Vec<f64>>,
}

impl RigCovariance {
    /// Independent parameters with these standard deviations.
    pub fn with_sigmas<'a>(sigmas: impl IntoIterator<Item = (&'a str, f64)>) -> Self {
        let (parameters, sigmas): (Vec<String>, Vec<f64>) =
            sigmas.into_iter().map(|(name, sigma)| (name.to_string(), sigma)).unzip();
        let row = |i: usize| (0..sigmas.len()).map(|j| if i == j { sigmas[i] * sigmas[i] } else { 0.0 }).collect();
        Self { parameters, matrix: (0..sigmas.len()).map(row).collect() }
    }

    /// Whether every parameter is exact.
    pub fn is_empty(&self) -> bool {
        self.parameters.is_empty()
    }

    /// Refuses what is no covariance of a finder's parameters. It may be singular: what is certain has none.
    pub fn validated(self, rig: &Rig) -> Result<Self> {
        let known = rig.parameters();
        for (i, name) in self.parameters.iter().enumerate() {
            if !known.contains(&name.as_str()) {
                return Err(Fault::new("covariance.parameters", format!("`{name}`"), known.join(", ")));
            }
            if self.parameters[..i].contains(name) {
                return Err(Fault::new("covariance.parameters", format!("`{name}` twice"), "each name once"));
            }
        }
        let size = self.parameters.len();
        if self.matrix.len() != size || self.matrix.iter().any(|row| row.len() != size) {
            let rows: Vec<usize> = self.matrix.iter().map(Vec::len).collect();
            let expected = format!("{size} rows of {size} numbers, one a parameter");
            return Err(Fault::new("covariance.matrix", format!("rows of {rows:?} numbers"), expected));
        }
        for (i, row) in self.matrix.iter().enumerate() {
            for (j, value) in row.iter().enumerate() {
                number_within("covariance.matrix", *value, -1e12, 1e12)?;
                let scale = (self.matrix[i][i] * self.matrix[j][j]).abs().sqrt();
                if (value - self.matrix[j][i]).abs() > 1e-9 * scale {
                    let found = format!(
                        "{value} and {} for {} and {}",
                        self.matrix[j][i], self.parameters[i], self.parameters[j]
                    );
                    return Err(Fault::new("covariance.matrix", found, "a symmetric matrix"));
                }
            }
        }
        if size == 0 {
            return Ok(self);
        }
        // Of the correlations, since units differ by orders of magnitude.
        let sigma: Vec<f64> = (0..size).map(|i| self.matrix[i][i].max(0.0).sqrt()).collect();
        let over = |a: f64, b: f64| if b > 0.0 { a / b } else { a };
        let scaled = DMatrix::from_fn(size, size, |i, j| over(self.matrix[i][j], sigma[i] * sigma[j]));
        let lowest = scaled.symmetric_eigenvalues().iter().copied().fold(0.0, f64::min);
        if lowest < EIGENVALUE_MIN * size as f64 {
            let found = format!("an eigenvalue of {lowest:.3} times the largest possible");
            return Err(Fault::new("covariance.matrix", found, "no negative ones"));
        }
        Ok(self)
    }
}

impl Rig {
    /// The names of the parameters that [`Self::shifted`] knows for this finder.
    pub fn parameters(&self) -> Vec<&'static str> {
        let laser: &[&str] = match self.laser {
            Laser::Mirror(_) => &MIRROR,
            Laser::Plane(_) => &PLANE,
        };
        let distortion: &[&str] = match self.camera.distortion {
            Distortion::Pinhole => &[],
            Distortion::Tsai { .. } => &["k"],
            Distortion::BrownConrady { .. } => &["k1", "k2", "p1", "p2", "k3"],
        };
        COMMON.iter().chain(laser).chain(distortion).copied().collect()
    }

    /// The same finder with one parameter larger by `by`, not checked for sense.
    ///
    /// Errors: a name that is none of [`Self::parameters`].
    pub fn shifted(&self, parameter: &str, by: f64) -> Result<Self> {
        let mut rig = self.clone();
        let (camera, mount) = (&mut rig.camera, &mut rig.sensor_from_camera.iso);
        match parameter {
            "camera_height_m" => mount.translation.vector.z += by,
            "x0_m" => mount.translation.vector.x -= by, // (38): the camera is at −x0
            "camera_y_m" => mount.translation.vector.y += by,
            "tilt_rad" => {
                // About the axis to the left of the view, level.
                let view = mount.rotation * Vector3::z();
                let left = Rotation3::from_axis_angle(&Vector3::z_axis(), view.y.atan2(view.x)) * Vector3::y_axis();
                mount.rotation = Rotation3::from_axis_angle(&left, by) * mount.rotation;
            }
            "roll_rad" => mount.rotation *= Rotation3::from_axis_angle(&Vector3::z_axis(), by), // about the view
            "pan_rad" => mount.rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), by) * mount.rotation,
            "axis_pitch_rad" | "axis_roll_rad" => {
                let finder = &mut rig.robot_from_finder.iso.rotation;
                let (mut roll, mut pitch, yaw) = finder.euler_angles();
                *(if parameter == "axis_roll_rad" { &mut roll } else { &mut pitch }) += by;
                *finder = Rotation3::from_euler_angles(roll, pitch, yaw).into();
            }
            "fx_px" => camera.fx += by,
            "fy_px" => camera.fy += by,
            "cu_px" => camera.cx += by,
            "cv_px" => camera.cy += by,
            other => {
                let found = shift_laser(&mut rig.laser, other, by) || shift_lens(&mut camera.distortion, other, by);
                if !found {
                    let expected = format!("one of {}", self.parameters().join(", "));
                    return Err(Fault::new("parameter", format!("`{other}`"), expected));
                }
            }
        }
        Ok(rig)
    }
}

fn shift_laser(laser: &mut Laser, parameter: &str, by: f64) -> bool {
    let slot = match (laser, parameter) {
        (Laser::Mirror(mirror), "mirror_height_m") => &mut mirror.mirror_m[2],
        (Laser::Mirror(mirror), "mirror_x_m") => &mut mirror.mirror_m[0],
        (Laser::Mirror(mirror), "beam_zero_rad") => &mut mirror.beam.zero_rad,
        (Laser::Mirror(mirror), "beam_rad_per_pulse") => &mut mirror.beam.rad_per_pulse,
        (Laser::Mirror(mirror), "slit_roll_rad") => &mut mirror.roll_rad,
        (Laser::Plane(plane), "normal_x") => &mut plane.normal[0],
        (Laser::Plane(plane), "normal_y") => &mut plane.normal[1],
        (Laser::Plane(plane), "normal_z") => &mut plane.normal[2],
        (Laser::Plane(plane), "offset_m") => &mut plane.offset_m,
        _ => return false,
    };
    *slot += by;
    true
}

fn shift_lens(lens: &mut Distortion, parameter: &str, by: f64) -> bool {
    let slot = match (lens, parameter) {
        (Distortion::Tsai { k }, "k") => k,
        (Distortion::BrownConrady { k1, .. }, "k1") => k1,
        (Distortion::BrownConrady { k2, .. }, "k2") => k2,
        (Distortion::BrownConrady { p1, .. }, "p1") => p1,
        (Distortion::BrownConrady { p2, .. }, "p2") => p2,
        (Distortion::BrownConrady { k3, .. }, "k3") => k3,
        _ => return false,
    };
    *slot += by;
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::rig::tilted_camera;
    use crate::optics::{Camera, PlaneLaser};

    fn fixed() -> Rig {
        let laser = Laser::Plane(PlaneLaser { normal: [0.0, -0.9, 0.3], offset_m: 0.1, origin_m: None });
        let distortion = Distortion::BrownConrady { k1: -0.3, k2: 0.1, p1: 1e-3, p2: 1e-3, k3: 0.0 };
        Rig { laser, camera: Camera { distortion, ..Camera::metro_i() }, ..Rig::metro_i() }
    }

    #[test]
    fn every_parameter_changes_the_finder_and_comes_back() {
        for rig in [Rig::metro_i(), fixed()] {
            let names = rig.parameters();
            assert!(names.len() >= 18, "{names:?}");
            let mut seen: Vec<Rig> = Vec::new();
            for name in names {
                let there = rig.shifted(name, 1e-3).unwrap();
                assert!(there != rig && !seen.contains(&there), "{name}");
                let back = there.shifted(name, -1e-3).unwrap();
                let apart = (back.sensor_from_camera.iso.inverse() * rig.sensor_from_camera.iso).rotation.angle();
                assert!(apart < 1e-9 && (back.camera.fx - rig.camera.fx).abs() < 1e-9, "{name}");
                seen.push(there);
            }
            assert!(rig.shifted("tilt", 0.1).unwrap_err().to_string().contains("one of camera_height_m"));
        }
        assert!(fixed().shifted("beam_zero_rad", 0.1).is_err());
    }

    #[test]
    fn tilt_looks_farther_down_and_x0_is_the_papers() {
        // Table 4: h_B 1032.411 mm, x0 −164.630 mm, θv 0.484 rad.
        let rig = Rig::metro_i();
        let moved = rig.shifted("tilt_rad", 0.01).unwrap().shifted("x0_m", 0.02).unwrap();
        let expected = tilted_camera([0.164_630 - 0.02, 0.0, rig.sensor_from_camera.xyz().z], 0.494);
        assert!((moved.sensor_from_camera.iso.inverse() * expected.iso).rotation.angle() < 1e-12);
        assert!((moved.sensor_from_camera.xyz() - expected.xyz()).norm() < 1e-12);
    }

    #[test]
    fn what_is_no_covariance_is_refused() {
        let rig = Rig::metro_i();
        let fault = |c: RigCovariance| c.validated(&rig).unwrap_err().to_string();
        let good = RigCovariance::with_sigmas([("tilt_rad", 1e-3), ("fy_px", 2.0)]);
        assert!(good.clone().validated(&rig).is_ok() && RigCovariance::default().validated(&rig).is_ok());
        let with = |matrix: [[f64; 2]; 2]| RigCovariance { matrix: matrix.map(Vec::from).to_vec(), ..good.clone() };
        assert!(with([[1e-6, 2e-3], [2e-3, 4.0]]).validated(&rig).is_ok(), "fully correlated is possible");
        assert!(fault(with([[1e-6, 2.1e-3], [2.1e-3, 4.0]])).contains("eigenvalue"));
        assert!(fault(with([[-1e-6, 0.0], [0.0, 4.0]])).contains("eigenvalue"));
        assert!(fault(with([[1e-6, 1e-4], [0.0, 4.0]])).contains("symmetric"));
        assert!(fault(with([[f64::NAN, 0.0], [0.0, 4.0]])).contains("NaN"));
        assert!(fault(RigCovariance { matrix: vec![vec![1.0]], ..good.clone() }).contains("2 rows of 2"));
        assert!(fault(RigCovariance::with_sigmas([("tilt", 1.0)])).contains("tilt_rad"));
        assert!(fault(RigCovariance::with_sigmas([("k", 1.0), ("k", 1.0)])).contains("twice"));
        assert!(fault(RigCovariance::with_sigmas([("normal_x", 1.0)])).contains("beam_zero_rad"));
    }
}
