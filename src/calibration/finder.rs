//! Calibration of a finder: mirror, camera and encoders from slits thrown on the floor and on walls.
//!
//! [`closed_form`] is the paper's own way (27)–(41), from three slits a distance d apart: exact, ill-conditioned (one
//! pulse moves lA by 31 to 63 mm, `paper.md` 5.5), and so only the first guess. [`calibrate`] is the bundle over every
//! parameter of the finder, from any number of slits, with what is known beforehand; it says which parameters the data do
//! not hold apart and what to measure next. [`Procedure`] simulates both, for those who plan a calibration.

mod advice;
mod bundle;
mod carried;
pub mod drift;
mod known;
mod measured;
mod model;
mod page;
mod plausible;
mod simulate;
mod trust;

use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within};
use crate::optics::Camera;

pub use advice::{Advice, Weak};
pub use bundle::{FinderFit, Held, SlitResidual, calibrate};
pub use known::{Assumptions, CameraPrior, Knowledge};
pub use measured::{Observations, Slit, SlitEnd, SlitPeak, Surface, Wall};
pub use model::shifted;
pub use page::page;
pub use simulate::{Aim, Procedure, Reading, normal, uniform};
pub use trust::{Limits, Verdict};

/// The paper's three slits on a flat floor, the same distance apart: at R, Q and P, R nearest (section 4.2).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ThreeSlits {
    /// Distance d from slit to slit [m].
    pub spacing_m: f64,
    /// Mirror pulses from R to Q: θL1.
    pub pulses_near: f64,
    /// Mirror pulses from Q to P: θL2.
    pub pulses_far: f64,
    /// Angle that the beam turns by at one pulse [rad].
    pub rad_per_pulse: f64,
    /// Rows of the slits at R, Q, P in the image [px], from the top.
    pub rows_px: [f64; 3],
}

impl ThreeSlits {
    /// What Table 4 was computed from, recovered (`paper.md` 5.4): 81 and 49 pulses, rows −199, −6, +113 px above `cy_px`.
    pub fn paper(cy_px: f64) -> Self {
        Self {
            spacing_m: 0.6,
            pulses_near: 81.0,
            pulses_far: 49.0,
            rad_per_pulse: std::f64::consts::TAU / 4000.0,
            rows_px: [cy_px + 199.0, cy_px + 6.0, cy_px - 113.0],
        }
    }
}

/// What the closed form gives: Table 4.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ClosedForm {
    /// Height of the mirror lA [m].
    pub mirror_height_m: f64,
    /// Floor distance of the nearest slit xR [m].
    pub nearest_m: f64,
    /// Distance from camera to Q, lc [m].
    pub camera_distance_m: f64,
    /// Depression of the line from camera to Q, θc [rad].
    pub camera_depression_rad: f64,
    /// Tilt of the viewing axis θv [rad].
    pub tilt_rad: f64,
    /// Signed OO' x0 [m]: negative where the camera is ahead of the mirror.
    pub x0_m: f64,
    /// Depression of the line from mirror to Q, θL [rad].
    pub beam_to_middle_rad: f64,
    /// Distance from mirror to Q, lL [m].
    pub mirror_distance_m: f64,
    /// θB for the slit at P [rad].
    pub beam_at_far_rad: f64,
    /// l'A: the beam at P over the camera's foot [m].
    pub beam_over_foot_m: f64,
    /// l'B: the camera over that [m].
    pub camera_over_beam_m: f64,
}

impl ClosedForm {
    /// h_B, the height of the camera over the floor [m].
    pub fn camera_height_m(&self) -> f64 {
        self.camera_distance_m * self.camera_depression_rad.sin()
    }

    fn as_vector(&self) -> SVector<f64, 6> {
        let Self { mirror_height_m, nearest_m, camera_distance_m, camera_depression_rad, tilt_rad, x0_m, .. } = *self;
        SVector::from([mirror_height_m, nearest_m, camera_distance_m, camera_depression_rad, tilt_rad, x0_m])
    }
}

/// Equations (27)–(41). The camera's own calibration is taken as right; its roll as zero, the floor as flat, the slits as
/// normal to X'.
///
/// Errors: numbers that are not finite or not positive; angles and rows that no three slits give.
pub fn closed_form(camera: &Camera, slits: &ThreeSlits) -> Result<ClosedForm> {
    let d = number_within("spacing_m", slits.spacing_m, 1e-3, 100.0)
        .map_err(|fault| Fault { expected: format!("{} (metres, not millimetres)", fault.expected), ..fault })?;
    let gain = number_within("rad_per_pulse", slits.rad_per_pulse, 1e-9, 0.1)?;
    let (near, far) = (slits.pulses_near * gain, slits.pulses_far * gain); // θL1, θL2
    for (what, angle) in [("pulses_near", near), ("pulses_far", far)] {
        if !(angle.is_finite() && angle > 0.0 && angle < 1.5) {
            let expected =
                "a positive number of pulses of less than a right angle: from the nearer slit to the farther";
            return Err(Fault::new(what, format!("{angle} rad"), expected));
        }
    }
    let (beam_to_middle, mirror_distance) = triangle(near, far, d)
        .ok_or_else(|| Fault::new("pulses", format!("{} then {}", slits.pulses_near, slits.pulses_far), FAN))?; // (29)–(32)
    let mirror_height = mirror_distance * beam_to_middle.sin(); // (33)
    let [v1, v0, v2] = undistorted(camera, &slits.rows_px)?;
    let tan_far = (v2 - v0) / (1.0 + v2 * v0); // (27)
    let tan_near = (v0 - v1) / (1.0 + v0 * v1); // (28)
    let (depression, camera_distance) = triangle(tan_near.atan(), tan_far.atan(), d)
        .ok_or_else(|| Fault::new("rows_px", format!("{:?}", slits.rows_px), FAN))?; // (34), (35) with ½
    let tilt = v0.atan() + depression; // (36)
    let nearest = mirror_height / beam_to_middle.tan() - d; // (37)
    let x0 = camera_distance * depression.cos() - nearest - d; // (38)
    let beam_at_far = (mirror_height / (nearest + 2.0 * d)).atan(); // (39)
    let beam_over_foot = (x0 + nearest + 2.0 * d) * beam_at_far.tan(); // (40)
    Ok(ClosedForm {
        mirror_height_m: mirror_height,
        nearest_m: nearest,
        camera_distance_m: camera_distance,
        camera_depression_rad: depression,
        tilt_rad: tilt,
        x0_m: x0,
        beam_to_middle_rad: beam_to_middle,
        mirror_distance_m: mirror_distance,
        beam_at_far_rad: beam_at_far,
        beam_over_foot_m: beam_over_foot,
        camera_over_beam_m: camera_distance * depression.sin() - beam_over_foot, // (41)
    })
}

const FAN: &str = "an angle to the nearer slit that is larger than that to the farther one: R, Q, P on a floor";

/// The point over a line that sees two neighbouring stretches of length `d` under these angles: the depression of the
/// middle (31, 34) and the distance to it (32, 35).
fn triangle(near_rad: f64, far_rad: f64, d: f64) -> Option<(f64, f64)> {
    let (near, far) = (1.0 / near_rad.tan(), 1.0 / far_rad.tan());
    if !(near > 0.0 && far > near) {
        return None;
    }
    let depression = (2.0 / (far - near)).atan(); // (31), (34)
    Some((depression, d / 2.0 * (far + near) * depression.sin())) // (32), (35)
}

/// v'/lf of rows on the camera's middle column, upwards (23).
fn undistorted(camera: &Camera, rows_px: &[f64; 3]) -> Result<[f64; 3]> {
    let mut out = [0.0; 3];
    for (v, row) in out.iter_mut().zip(rows_px) {
        number_within("rows_px", *row, -1e5, 1e5)?;
        let ray = camera.ray(camera.cx, *row);
        *v = -ray.ok_or_else(|| Fault::new("rows_px", row, "a row that the lens model reaches"))?.y;
    }
    Ok(out)
}

/// The standard deviations of lA, xR, lc, θc, θv, x0 (m and rad, in this order), from those of one pulse count at each slit
/// (R, Q, P) and of one row, by linear propagation; the camera taken as known.
///
/// Errors: as [`closed_form`].
pub fn closed_form_sigmas(camera: &Camera, slits: &ThreeSlits, pulse: f64, row_px: f64) -> Result<[f64; 6]> {
    let mut spread = SMatrix::<f64, 6, 6>::zeros();
    for reading in 0..6 {
        let moved = |by: f64| {
            let mut slits = *slits;
            match reading {
                0 => slits.pulses_near += by, // a later count at R
                1 => (slits.pulses_near, slits.pulses_far) = (slits.pulses_near - by, slits.pulses_far + by),
                2 => slits.pulses_far -= by,
                row => slits.rows_px[row - 3] += by,
            }
            closed_form(camera, &slits).map(|found| found.as_vector())
        };
        let (step, sigma) = (1e-3, if reading < 3 { pulse } else { row_px });
        let slope = (moved(step)? - moved(-step)?) / (2.0 * step) * sigma;
        spread += slope * slope.transpose();
    }
    Ok(std::array::from_fn(|i| spread[(i, i)].sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn table_4_to_the_last_digit() {
        // paper.md 5.4
        let camera = Camera::metro_i();
        let found = closed_form(&camera, &ThreeSlits::paper(camera.cy)).unwrap();
        let mm = |metres: f64| format!("{:.3}", metres * 1e3);
        assert_eq!(mm(found.mirror_height_m), "817.244");
        assert_eq!(mm(found.nearest_m), "1504.209");
        assert_eq!(mm(found.camera_distance_m), "2197.878");
        assert_eq!(mm(found.x0_m), "-164.585");
        assert_eq!(format!("{:.6}", found.camera_depression_rad), "0.489647");
        assert_eq!(format!("{:.5}", found.tilt_rad), "0.48445");
        assert_eq!(format!("{:.6}", found.beam_to_middle_rad), "0.370454"); // paper.md 6: 0.370448 with the printed constants
        assert_eq!(format!("{:.1}", found.mirror_distance_m * 1e3), "2257.3");
        assert_eq!(format!("{:.2}", found.camera_over_beam_m * 1e3), "266.19"); // paper.md 5.6
    }

    #[test]
    fn one_pulse_moves_the_mirror_as_the_paper_forgot_to_say() {
        // paper.md 5.5
        let camera = Camera::metro_i();
        let paper = ThreeSlits::paper(camera.cy);
        for (near, far, height_mm) in
            [(80.0, 49.0, 849.2), (82.0, 49.0, 787.6), (81.0, 48.0, 756.8), (81.0, 50.0, 882.6)]
        {
            let found = closed_form(&camera, &ThreeSlits { pulses_near: near, pulses_far: far, ..paper }).unwrap();
            assert!((found.mirror_height_m * 1e3 - height_mm).abs() < 0.05, "{near} {far}: {found:?}");
        }
        let sigma = closed_form_sigmas(&camera, &paper, 1.0 / 12f64.sqrt(), 0.1).unwrap();
        assert!((sigma[0] * 1e3 - 34.0).abs() < 0.5, "{sigma:?}");
    }

    proptest! {
        #[test]
        fn three_slits_give_back_the_finder_that_made_them(
            height in 0.3..1.5f64, nearest in 0.8..2.5f64, d in 0.2..0.8f64, above in 0.05..0.4f64, ahead in -0.3..0.3f64
        ) {
            let camera = Camera { distortion: crate::optics::Distortion::Pinhole, ..Camera::metro_i() };
            let beam = |i: f64| (height / (nearest + i * d)).atan();
            let tilt = 0.45;
            let row = |i: f64| {
                let depression = ((height + above) / (nearest + i * d + ahead)).atan();
                camera.cy - camera.fy * (tilt - depression).tan()
            };
            let slits = ThreeSlits {
                spacing_m: d,
                pulses_near: (beam(0.0) - beam(1.0)) / 1e-3,
                pulses_far: (beam(1.0) - beam(2.0)) / 1e-3,
                rad_per_pulse: 1e-3,
                rows_px: [row(0.0), row(1.0), row(2.0)],
            };
            let found = closed_form(&camera, &slits).unwrap();
            prop_assert!((found.mirror_height_m - height).abs() < 1e-8);
            prop_assert!((found.nearest_m - nearest).abs() < 1e-8);
            prop_assert!((found.camera_height_m() - height - above).abs() < 1e-8);
            prop_assert!((found.x0_m - ahead).abs() < 1e-8);
            prop_assert!((found.tilt_rad - tilt).abs() < 1e-8);
        }
    }

    #[test]
    fn what_no_floor_gives_is_refused() {
        let camera = Camera::metro_i();
        let paper = ThreeSlits::paper(camera.cy);
        let refused = |slits: ThreeSlits| closed_form(&camera, &slits).unwrap_err().to_string();
        assert!(refused(ThreeSlits { pulses_near: 49.0, pulses_far: 81.0, ..paper }).contains("R, Q, P"));
        assert!(refused(ThreeSlits { pulses_far: f64::NAN, ..paper }).contains("pulses_far"));
        assert!(refused(ThreeSlits { pulses_near: 0.0, ..paper }).contains("pulses_near"));
        assert!(refused(ThreeSlits { spacing_m: 600.0, ..paper }).contains("metres, not millimetres"));
        let mut mirrored = paper;
        mirrored.rows_px.reverse();
        assert!(refused(mirrored).contains("rows_px"));
        assert!(refused(ThreeSlits { rows_px: [f64::INFINITY; 3], ..paper }).contains("rows_px"));
    }
}
