//! Speckle: laser light scattered by a rough surface interferes, and each column's centroid is off by a little that no
//! second image shows, since the same surface seen from the same place has the same grains.
//!
//! Dorsch, Häusler, Herrmann (1994): δz = C·λ/(2π·sin u·sin θ), which in the image is δv = C·λN/π: 0.08 px at f/4, 0.04 px
//! at the default f/2. A column also gets more or less light, with a contrast of C/√M, where M is the number of grains of
//! area (4/π)·(λN)² that its stretch of the stripe holds.
//!
//! Both are smooth random functions of the place on the surface: the seed, the body and the point decide, never the frame.
//! They change over a grain as seen on the surface, or over half of what a column sees of it where that is larger: so
//! neighbouring columns agree only if grains are larger than columns, and a surface that moves by the width of what a
//! column sees shows another pattern.

use nalgebra::Vector3;

use super::super::camera::ImageParams;
use super::super::noise::{deviate, scatter};
use crate::optics::Rig;

/// Steps of the grain's size a doubling of the range: within a step the lattice stays the same.
const STEPS: f64 = 4.0;

/// What speckle does to one column's stretch of a stripe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Grain {
    /// How far the centroid is off [px rows].
    pub shift_px: f64,
    /// The light over its mean.
    pub gain: f64,
}

impl Grain {
    /// Light without speckle.
    pub const NONE: Self = Self { shift_px: 0.0, gain: 1.0 };
}

/// The speckle of a camera and a laser.
#[derive(Clone, Copy, Debug)]
pub(super) struct Speckle {
    contrast: f64,
    /// RMS error of a column's centroid [px rows].
    pub shift_px: f64,
    /// Grains of speckle in a column, a row of stripe width.
    grains_per_px: f64,
    /// Size of the lattice's cells a metre of range.
    cell_per_m: f64,
}

impl Speckle {
    pub fn new(rig: &Rig, params: &ImageParams) -> Self {
        let (camera, lf) = (&rig.camera, params.focal_length_m);
        let grain_m = rig.sheet.wavelength_m * params.f_number; // λN
        let (column_m, row_m) = (lf / camera.fx, lf / camera.fy);
        Self {
            contrast: params.speckle_contrast,
            shift_px: params.speckle_sigma_px(rig),
            grains_per_px: column_m * row_m / (4.0 / std::f64::consts::PI * grain_m * grain_m),
            cell_per_m: (grain_m / lf).max(0.5 / camera.fx),
        }
    }

    /// What the place `point` of a body does to a stripe of RMS width `sigma_px`, seen from `range_m` away.
    pub fn at(&self, seed: u64, body: usize, point: &Vector3<f64>, range_m: f64, sigma_px: f64) -> Grain {
        if self.contrast == 0.0 {
            return Grain::NONE;
        }
        let step = (STEPS * range_m.log2()).round();
        let place = point / ((step / STEPS).exp2() * self.cell_per_m);
        let [shift, light] = smooth(scatter(scatter(seed ^ body as u64) ^ step.to_bits()), &place);
        // The equivalent width of a normal profile is 2√π·σ. Light summed over M grains has a gamma distribution, here by
        // Wilson and Hilferty's cube.
        let width_px = 2.0 * std::f64::consts::PI.sqrt() * sigma_px;
        let grains = (self.grains_per_px * width_px).max(1.0) / (self.contrast * self.contrast);
        let root = 1.0 - 1.0 / (9.0 * grains) + light / (3.0 * grains.sqrt());
        Grain { shift_px: shift * self.shift_px, gain: root.max(0.0).powi(3) }
    }
}

/// Two random fields of mean 0 and variance 1 everywhere: normal deviates on the integer lattice, mixed in between.
fn smooth(key: u64, place: &Vector3<f64>) -> [f64; 2] {
    let (corner, within) = (place.map(f64::floor), place.map(|x| x - x.floor()));
    let (mut sum, mut power) = ([0.0; 2], 0.0);
    for i in 0..8u8 {
        let mut weight = 1.0;
        let mut hash = key;
        for axis in 0..3 {
            let upper = (i >> axis) & 1;
            weight *= if upper == 1 { within[axis] } else { 1.0 - within[axis] };
            hash = scatter(hash ^ (corner[axis] as i64 + i64::from(upper)) as u64);
        }
        sum[0] += weight * deviate(hash as u16);
        sum[1] += weight * deviate((hash >> 16) as u16);
        power += weight * weight;
    }
    sum.map(|s| s / power.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn speckle(f_number: f64, contrast: f64) -> Speckle {
        let params = ImageParams { f_number, speckle_contrast: contrast, ..ImageParams::default() };
        Speckle::new(&Rig::metro_i(), &params)
    }

    /// Grains along a line across the view, `step` columns apart, 2 m away.
    fn along(speckle: &Speckle, step: f64, seed: u64) -> Vec<Grain> {
        let apart = 2.0 / Rig::metro_i().camera.fx * step;
        (0..4000).map(|i| speckle.at(seed, 3, &Vector3::new(2.0, f64::from(i) * apart, 0.1), 2.0, 0.45)).collect()
    }

    fn correlation(a: &[f64], b: &[f64]) -> f64 {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
    }

    #[test]
    fn the_centroid_is_off_by_c_lambda_n_over_pi() {
        // instrument.md 1: 0.08 px at f/4, 632.8 nm, rows of 4.8/485 mm. 4000 columns: the RMS is good to 1.1 %.
        for (f_number, contrast, rms) in [(4.0, 1.0, 0.0814), (2.0, 1.0, 0.0407), (4.0, 0.5, 0.0407)] {
            let grains = along(&speckle(f_number, contrast), 1.0, 1);
            let sum: f64 = grains.iter().map(|g| g.shift_px * g.shift_px).sum();
            let found = (sum / grains.len() as f64).sqrt();
            assert!((found / rms - 1.0).abs() < 0.05, "{found} for {rms} at f/{f_number}");
        }
        assert!((speckle(4.0, 1.0).shift_px - 0.08).abs() < 0.002);
    }

    #[test]
    fn the_light_varies_by_the_root_of_the_number_of_grains() {
        // f/2: a grain has 4/π·(1.2656 µm)² = 2.04 µm², a column 11.416 µm by 2√π·0.45·9.897 = 15.79 µm: 88.4 grains.
        // f/16: 1.38 grains; half the contrast quarters the variance.
        for (f_number, contrast, expected) in [(2.0, 1.0, 0.1064), (16.0, 1.0, 0.851), (16.0, 0.5, 0.425)] {
            let grains = along(&speckle(f_number, contrast), 3.0, 2);
            let n = grains.len() as f64;
            let mean = grains.iter().map(|g| g.gain).sum::<f64>() / n;
            let rms = (grains.iter().map(|g| (g.gain - mean).powi(2)).sum::<f64>() / n).sqrt();
            assert!((mean - 1.0).abs() < 0.05, "{mean}");
            assert!((rms / expected - 1.0).abs() < 0.06, "{rms} for {expected} at f/{f_number}");
        }
        assert_eq!(speckle(2.0, 0.0).at(1, 2, &Vector3::zeros(), 2.0, 0.4), Grain::NONE);
    }

    #[test]
    fn neighbouring_columns_agree_only_where_grains_are_larger_than_columns() {
        let shifts =
            |f_number: f64| along(&speckle(f_number, 1.0), 1.0, 5).iter().map(|g| g.shift_px).collect::<Vec<_>>();
        // f/2: 1.27 µm grains in 11.4 µm columns. f/64: 40.5 µm grains, 3.5 columns wide.
        let (fine, coarse) = (shifts(2.0), shifts(64.0));
        let at = |s: &[f64], lag: usize| correlation(&s[lag..], &s[..s.len() - lag]);
        assert!(at(&fine, 1).abs() < 0.06, "{}", at(&fine, 1));
        assert!(at(&coarse, 1) > 0.8 && at(&coarse, 3) > 0.1 && at(&coarse, 9).abs() < 0.1);
    }

    #[test]
    fn the_pattern_belongs_to_the_place_on_the_surface() {
        let (speckle, place) = (speckle(2.0, 1.0), Vector3::new(2.1, 0.3, 0.0));
        let at = |seed, body, place: Vector3<f64>| speckle.at(seed, body, &place, 2.0, 0.45);
        assert_eq!(at(1, 2, place), at(1, 2, place));
        assert!(at(1, 2, place) != at(2, 2, place) && at(1, 2, place) != at(1, 3, place));
        // Moved by a tenth of what a column sees (2 mm), much the same; moved by all of it, another one.
        let all = |moved: f64| {
            let shift = |i: i32| at(1, 2, Vector3::new(2.0 + moved, f64::from(i) * 0.01, 0.0)).shift_px;
            (0..3000).map(shift).collect::<Vec<_>>()
        };
        let still = all(0.0);
        assert!(correlation(&still, &all(0.0002)) > 0.8);
        assert!(correlation(&still, &all(0.0022)).abs() < 0.1);
    }
}
