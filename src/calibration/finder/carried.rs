//! What a calibrated finder carries of its error bars into every point it will ever measure.

use nalgebra::DMatrix;

use super::model::{CAMERA_AT, PARAMETERS, TAPE_AT};
use crate::calibration::params::Sensor;
use crate::optics::RigCovariance;

/// The names of the camera's parameters in a rig, which is in pixels, in the order of those of a calibration.
const CAMERA: [&str; 5] = ["fx_px", "fy_px", "k", "cu_px", "cv_px"];

/// The covariance of a rig's parameters from that of a calibration's `numbers`; tape and walls stay behind. What was
/// taken as known is exact and is not named. Empty where the data leave a parameter open: then no error bar is true.
pub(super) fn rig_covariance(numbers: &[f64], covariance: &DMatrix<f64>, sensor: &Sensor) -> RigCovariance {
    let mut slopes = DMatrix::<f64>::identity(TAPE_AT, TAPE_AT);
    let [focal, scale, k] = [numbers[CAMERA_AT], numbers[CAMERA_AT + 1], numbers[CAMERA_AT + 2]];
    let mut camera = slopes.view_mut((CAMERA_AT, CAMERA_AT), (3, 3));
    camera[(0, 0)] = scale / sensor.column_pitch_mm; // fx = Su·lf/d'u (25)
    camera[(0, 1)] = focal / sensor.column_pitch_mm;
    camera[(1, 0)] = 1.0 / sensor.row_pitch_mm; // fy = lf/dv (26)
    camera[(1, 1)] = 0.0;
    camera[(2, 0)] = 2.0 * k * focal; // k·lf², on coordinates over the focal length
    camera[(2, 2)] = focal * focal;
    let spread = &slopes * covariance.view((0, 0), (TAPE_AT, TAPE_AT)) * slopes.transpose();
    let own = PARAMETERS[..CAMERA_AT].iter().map(|(name, ..)| *name);
    let names: Vec<&str> = own.chain(CAMERA).collect();
    let open: Vec<usize> = (0..TAPE_AT).filter(|&i| spread[(i, i)] != 0.0).collect();
    if open.iter().any(|&i| open.iter().any(|&j| !spread[(i, j)].is_finite())) {
        return RigCovariance::default();
    }
    // Rounding must not make it less symmetric than it is.
    let entry = |i: usize, j: usize| (spread[(i, j)] + spread[(j, i)]) / 2.0;
    RigCovariance {
        parameters: open.iter().map(|&i| names[i].to_string()).collect(),
        matrix: open.iter().map(|&i| open.iter().map(|&j| entry(i, j)).collect()).collect(),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::calibration::finder::shifted;
    use crate::optics::Rig;

    #[test]
    fn calibration_and_rig_mean_the_same_by_a_name() {
        let rig = Rig::metro_i();
        for (name, ..) in PARAMETERS[..CAMERA_AT].iter().chain(&PARAMETERS[CAMERA_AT + 3..]) {
            let by = 1e-3;
            let calibrated = shifted(&rig, &BTreeMap::from([(name.to_string(), by)])).unwrap();
            let carried = rig.shifted(name, by).unwrap();
            let apart = calibrated.sensor_from_camera.iso.inverse() * carried.sensor_from_camera.iso;
            assert!(apart.translation.vector.norm() < 1e-9 && apart.rotation.angle() < 1e-9, "{name}");
            let upright = calibrated.robot_from_finder.iso.rotation.angle_to(&carried.robot_from_finder.iso.rotation);
            assert!(upright < 1e-7, "{name}");
            let numbers = |rig: &Rig| {
                let plane = rig.laser_plane_at(0.3).unwrap().plane;
                [rig.camera.cx, rig.camera.cy, plane.normal.x, plane.normal.y, plane.normal.z, plane.offset]
            };
            for (a, b) in numbers(&calibrated).iter().zip(numbers(&carried)) {
                assert!((a - b).abs() < 1e-9, "{name}");
            }
        }
    }

    #[test]
    fn the_camera_s_covariance_is_in_pixels() {
        // lf 11.434 ± 0.02 mm alone: fx, fy and k·lf² move together, by the same share, twice that for k·lf².
        let sensor = Sensor::metro_i();
        let mut numbers = vec![0.0; TAPE_AT + 1];
        numbers[CAMERA_AT..CAMERA_AT + 3].copy_from_slice(&[11.434, 1.095, 0.00335]);
        let mut covariance = DMatrix::zeros(TAPE_AT + 1, TAPE_AT + 1);
        covariance[(CAMERA_AT, CAMERA_AT)] = 0.02 * 0.02;
        let found = rig_covariance(&numbers, &covariance, &sensor);
        assert_eq!(found.parameters, ["fx_px", "fy_px", "k"]);
        let camera = crate::optics::Camera::metro_i();
        let share = 0.02 / 11.434;
        for (i, size) in [camera.fx, camera.fy, 2.0 * 0.00335 * 11.434 * 11.434].into_iter().enumerate() {
            let sigma = found.matrix[i][i].sqrt();
            assert!((sigma / (size * share) - 1.0).abs() < 1e-3, "{i}: {sigma}");
        }
        found.validated(&Rig::metro_i()).unwrap();
        covariance[(0, 0)] = f64::INFINITY;
        assert!(rig_covariance(&numbers, &covariance, &sensor).is_empty());
    }
}
