//! Numbers from outside: `instrument.md` 1 and 3, `paper.md` 5.6 and 5.7.

use super::bench::Bench;
use super::budget::Budget;
use super::*;
use crate::optics::{Distortion, Laser, PaperGeometry, Rig};
use crate::scanner::ImageParams;

/// METRO-I without distortion at f/4, as `instrument.md` counts.
fn ideal() -> Instrument {
    let mut instrument = Instrument::metro_i();
    instrument.rig.camera.distortion = Distortion::Pinhole;
    instrument.image.f_number = 4.0;
    instrument.validated().unwrap()
}

fn with<R>(instrument: &Instrument, ask: impl Fn(&Bench, &Budget) -> R) -> R {
    let params = DesignParams::default();
    let bench = Bench::new(&instrument.rig, &instrument.image);
    ask(&bench, &Budget::new(&bench, instrument, &params))
}

#[track_caller]
fn near(value: f64, known: f64, within: f64) {
    assert!((value - known).abs() <= within, "{value}, expected {known} ± {within}");
}

#[test]
fn what_it_can_see() {
    let all = design(Instrument::metro_i(), DesignParams::default()).unwrap();
    let v = &all.view;
    near(v.horizontal_pinhole_deg, 28.7, 0.05);
    near(v.vertical_pinhole_deg, 23.5, 0.05);
    near(v.depression_deg[0], 15.8, 0.05);
    near(v.depression_deg[1], 39.7, 0.05);
    let [from, to] = v.floor_m.unwrap();
    near(from, 1.41, 0.005);
    near(to, 3.82, 0.01);
    // Nothing above Z = 1.032 − 0.283·X'.
    near(v.ceiling_m, 1.032, 5e-4);
    near(v.ceiling_slope, 0.283, 5e-4);
    near(v.table_seen_to_m.unwrap(), 1.16, 0.005);
    let at = |d: f64| v.widths.iter().find(|w| w.distance_m == d).unwrap();
    near(at(2.0).width_pinhole_m, 1.022, 5e-4);
    near(at(3.0).mm_per_column, 3.00, 0.006);
    near(at(3.0).mm_per_row, 2.60, 0.005);
    near(at(3.0).sheet_width_m, 3.6676, 1e-3);
    near(at(3.0).sheet_thickness_mm, 1.56, 0.01);
}

#[test]
fn the_nominal_camera_sees_what_the_paper_says() {
    // 6.4 mm behind 12 mm: 1.066 m at 2 m, 1.6 m at 3 m, 3.1 x 2.5 mm a pixel there (6.4/512, 4.8/480).
    let mut instrument = Instrument::metro_i();
    instrument.rig.camera.distortion = Distortion::Pinhole;
    instrument.rig.camera.fx = 12.0 / (6.4 / 512.0);
    instrument.rig.camera.fy = 12.0 / (4.8 / 480.0);
    let view = design(instrument, DesignParams::default()).unwrap().view;
    let at = |d: f64| *view.widths.iter().find(|w| w.distance_m == d).unwrap();
    near(at(2.0).width_pinhole_m, 1.0667, 5e-4);
    near(at(3.0).width_pinhole_m, 1.6, 1e-3);
    near(at(3.0).mm_per_column, 3.125, 1e-3);
    near(at(3.0).mm_per_row, 2.5, 1e-3);
}

#[test]
fn sensitivities_on_upright_targets() {
    // The recovered constants (paper.md 5.4): l'B = 266.19 mm; X' counts from the camera's foot.
    let mut instrument = ideal();
    let (mirror_m, r, lc, c, x0) = (0.817_244, 1.504_209, 2.197_878, 0.489_647f64, -0.164_585);
    let camera_m = lc * c.sin();
    instrument.rig.sensor_from_camera.iso.translation.vector = nalgebra::Vector3::new(-x0, 0.0, camera_m);
    let beam = (mirror_m / (r + 1.2f64)).atan();
    if let Laser::Mirror(mirror) = &mut instrument.rig.laser {
        (mirror.mirror_m[2], mirror.beam.zero_rad) = (mirror_m, beam);
    }
    let paper =
        PaperGeometry { mirror_height_m: mirror_m, camera_height_m: camera_m, x0_m: x0, ..PaperGeometry::metro_i() };
    near(paper.camera_height_m - paper.mirror_height_m - paper.x0_m * beam.tan(), 0.266_19, 5e-6);
    with(&instrument, |_, budget| {
        for (x, px, pulse, mrad) in
            [(1.5, 8.99, 16.1, 10.4), (1.8, 12.6, 22.8, 14.6), (2.1, 16.9, 30.6, 19.6), (2.4, 21.7, 39.6, 25.3)]
        {
            let row = budget.upright(beam, x - x0).unwrap();
            near(row.from_camera_m, x, 1e-9);
            near(row.mm_per_px, px, 0.05);
            near(row.mm_per_pulse, pulse, 0.06);
            near(row.mm_per_mrad_pitch, mrad, 0.06);
        }
    });
}

#[test]
fn errors_on_the_floor() {
    // X, per pulse, per pixel, in all at 0.1 pulse + 0.08 px + noise [mm], peak level of 127; f/4, albedo 0.5. The noise and
    // the peaks there are of a stripe as wide as on an upright target, g = cosθ_view/cosθ_laser; on the floor, where
    // g = sinθ_view/sinθ_laser, it is a third wider: 1.4 levels and 12.4 mm at 3.7 m.
    let known = [
        (1.42, 12.0, 7.0, 1.3, 19.0),
        (2.0, 24.0, 14.0, 2.7, 9.0),
        (3.0, 55.0, 30.0, 6.5, 3.0),
        (3.7, 86.0, 45.0, 11.4, 1.6),
    ];
    with(&ideal(), |bench, budget| {
        near(budget.speckle_px(), 0.08, 0.002);
        for (x, pulse, px, total, peak) in known {
            let row = budget.floor(x).unwrap();
            near(row.mm_per_pulse, pulse, 0.5);
            near(row.mm_per_px, px, 0.5);
            let view = (bench.eye.z / (x - bench.eye.x)).atan();
            let upright = row.beam_deg.to_radians().tan() / view.tan();
            let others = bench.stripe_px(x, (x - bench.eye.x).hypot(bench.eye.z), 0.0);
            let thick = (row.stripe_px.powi(2) - others.powi(2)).sqrt() * upright;
            near(budget.detector.peak_levels(row.electrons, thick.hypot(others)), peak, 0.04 * peak);
            let noise = row.mm_per_px * budget.detector.row_bound_px(row.electrons, thick.hypot(others));
            let (stop, speckle) = (row.range.mirror_stop_mm, row.range.speckle_mm);
            near((noise * noise + stop * stop + speckle * speckle).sqrt(), total, 0.04 * total);
            near(row.range.instrument_mm, total, 0.09 * total);
        }
    });
}

#[test]
fn electrons_of_a_target_that_faces_it() {
    for (f_number, electrons) in [(1.4, 1.8e5), (4.0, 2.2e4)] {
        let mut instrument = Instrument::metro_i();
        instrument.image = ImageParams { f_number, ..ImageParams::default() };
        let light = design(instrument, DesignParams::default()).unwrap().light;
        let row = light.facing.iter().find(|row| row.distance_m == 2.0).unwrap();
        near(row.electrons, electrons, 0.03 * electrons);
        near(row.irradiance_w_per_m2, 3.4, 0.05);
        assert!(f_number > 2.0 || row.peak_level > 127.0, "a 100 ke⁻ well saturates at f/1.4");
    }
}

#[test]
fn a_fan_without_light_in_the_picture_and_one_with_all() {
    let share = |width_per_m: f64| {
        let mut instrument = Instrument { optics: None, ..Instrument::metro_i() };
        instrument.rig.sheet.width_per_m = width_per_m;
        let view = design(instrument, DesignParams::default()).unwrap().view;
        view.widths.iter().find(|w| w.distance_m == 2.0).unwrap().power_share
    };
    // Φ(2·w/D): a picture of half the sheet's width holds Φ(±1) = 68.3 % of it.
    let width = Rig::metro_i().camera.ray(511.5, 239.5).unwrap().x - Rig::metro_i().camera.ray(-0.5, 239.5).unwrap().x;
    near(share((2.0 * 2.0 * width - 5.895e-3) / 2.0), 0.682_689, 1e-4);
    assert!(share(0.1) > 0.999_999);
}
