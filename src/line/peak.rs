//! The row of a stripe in one column to a fraction of a pixel: one function an estimator, each with its σ.
//!
//! All work on levels over the background in a window about the ridge, with `variance` the noise of each pixel [levels²]:
//! read noise and texture as seen in the image, quantisation (1/12) and shot noise. σ follows from the estimator's own
//! derivatives, so it is for noise that is white along the column.

use serde::{Deserialize, Serialize};

use super::LineParams;
use crate::image::{Image, Peak};

/// How a row is found to a fraction of a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Estimator {
    /// By the stripe's look: the middle of the edges where it is saturated, Gauss-5 where it is wide, Gauss-3 where it is
    /// narrow, and the centroid where it is too dim for logarithms.
    #[default]
    Auto,
    /// The row of the brightest pixel, as the paper has it: σ = 1/√12.
    WholePixel,
    /// Centre of the light over seven rows.
    Centroid,
    /// The Gaussian through three pixels.
    Gauss3,
    /// The Gaussian nearest to five pixels, weighted by their levels squared.
    Gauss5,
    /// The zero of the Blais–Rioux filter of order four.
    BlaisRioux,
}

/// Rows above and below the middle of a window.
const REACH: usize = 6;
/// Rows of a window.
const SIZE: usize = 2 * REACH + 1;
/// A peak farther than this from its ridge's row is not that ridge's [px].
const STRAY_MAX: f32 = 2.5;
/// Longest saturated run that is followed [px].
const RUN_MAX: usize = 64;

/// Levels over the background about a row.
struct Window {
    level: [f32; SIZE],
    /// Variance of a pixel without light from the stripe [levels²].
    read: f32,
    /// Shot noise of the stripe's light: variance a level.
    shot: f32,
}

impl Window {
    /// Noise of a pixel [levels²] (EMVA 1288: read noise and texture, quantisation, shot noise).
    fn variance(&self, i: usize) -> f32 {
        self.read + self.shot * self.level[i].max(0.0)
    }
}

/// An offset from the middle of a window [px] with its variance [px²].
type Offset = (f32, f32);

/// One column of an image with what is known of its light.
pub(super) struct Column<'a> {
    pub image: &'a Image,
    pub u: usize,
    /// Level without the stripe.
    pub background: f32,
    /// Noise of a pixel [levels].
    pub noise: f32,
}

impl Column<'_> {
    /// The peak near a ridge's row; `None` if what is there has no peak.
    pub fn peak(&self, row: usize, params: &LineParams) -> Option<Peak> {
        let top = self.brightest(row);
        let level = self.level(top);
        let (v, variance) = match params.estimator {
            Estimator::WholePixel => Some((top as f32, 1.0 / 12.0)),
            Estimator::Centroid => at(top, centroid(&self.window(top, params), 3)),
            Estimator::Gauss3 => at(top, gauss3(&self.window(top, params))),
            Estimator::Gauss5 => self.gauss5_centred(row, params),
            Estimator::BlaisRioux => at(row, blais_rioux(&self.window(row, params))),
            Estimator::Auto => self.auto(row, top, params),
        }?;
        let sigma = (variance + params.sigma_min_px * params.sigma_min_px).sqrt();
        let inside = v >= -0.5 && v <= self.image.height() as f32 - 0.5;
        (level > 0.0 && inside && sigma.is_finite()).then_some(Peak { v, sigma, level })
    }

    /// The estimator that fits the stripe's look.
    fn auto(&self, row: usize, top: usize, params: &LineParams) -> Option<Offset> {
        if self.is_full(top) {
            return self.plateau(top, params);
        }
        let window = self.window(top, params);
        let beside = |rows: usize| window.level[REACH - rows].min(window.level[REACH + rows]);
        let seen = 2.0 * self.noise.max(0.5); // what a logarithm may be taken of
        let near = |found: &Offset| (found.0 - row as f32).abs() <= STRAY_MAX;
        let gauss = if beside(2) > seen.max(0.1 * window.level[REACH]) {
            self.gauss5_centred(row, params)
        } else if beside(1) > seen {
            at(top, gauss3(&window))
        } else {
            None
        };
        gauss.filter(near).or_else(|| at(top, centroid(&window, 2))).filter(near)
    }

    /// The brightest pixel within a row of the ridge's.
    fn brightest(&self, row: usize) -> usize {
        let rows = row.saturating_sub(1)..=(row + 1).min(self.image.height() - 1);
        rows.rev().max_by(|a, b| self.level(*a).total_cmp(&self.level(*b))).unwrap_or(row)
    }

    /// Level over the background; outside the image, that of its edge.
    fn level(&self, v: usize) -> f32 {
        let v = v.min(self.image.height() - 1);
        f32::from(self.image.levels()[v * self.image.width() + self.u]) - self.background
    }

    fn is_full(&self, v: usize) -> bool {
        self.image.levels()[v * self.image.width() + self.u] >= self.image.white()
    }

    fn window(&self, middle: usize, params: &LineParams) -> Window {
        let (width, levels) = (self.image.width(), self.image.levels());
        let level = if middle >= REACH && middle + REACH < self.image.height() {
            let column = levels.iter().skip((middle - REACH) * width + self.u).step_by(width);
            let mut level = [0.0; SIZE];
            level.iter_mut().zip(column).for_each(|(to, from)| *to = f32::from(*from) - self.background);
            level
        } else {
            std::array::from_fn(|i| self.level((middle + i).saturating_sub(REACH)))
        };
        let shot = f32::from(self.image.white()) / params.well_electrons;
        Window { level, read: self.noise * self.noise + 1.0 / 12.0 + shot * self.background, shot }
    }

    /// Gauss-5, moved until its peak is in the window's middle row.
    fn gauss5_centred(&self, row: usize, params: &LineParams) -> Option<Offset> {
        let mut middle = row;
        for _ in 0..3 {
            let (offset, variance) = gauss5(&self.window(middle, params))?;
            if offset.abs() <= 0.6 {
                return Some((middle as f32 + offset, variance));
            }
            middle = if offset > 0.0 { (middle + 1).min(self.image.height() - 1) } else { middle.saturating_sub(1) };
        }
        None
    }

    /// A saturated stripe: the middle between the rows where its two edges cross half its height.
    fn plateau(&self, top: usize, params: &LineParams) -> Option<Offset> {
        let (mut first, mut last) = (top, top);
        while first > 0 && self.is_full(first - 1) && last - first < RUN_MAX {
            first -= 1;
        }
        while last + 1 < self.image.height() && self.is_full(last + 1) && last - first < RUN_MAX {
            last += 1;
        }
        if first == last {
            return at(top, centroid(&self.window(top, params), 3));
        }
        let half = self.level(top) / 2.0;
        let window = self.window(top, params);
        let noise = window.read + window.shot * half;
        // The edge lies between the last row above half and the first one below it.
        let edge = |rows: &mut dyn Iterator<Item = usize>| {
            let mut inner = self.level(top);
            for (steps, v) in rows.enumerate().take(REACH) {
                let outer = self.level(v);
                if outer < half {
                    let slope = inner - outer;
                    return Some((steps as f32 + (inner - half) / slope, noise / (slope * slope)));
                }
                inner = outer;
            }
            None
        };
        let (up, up_variance) = edge(&mut (0..first).rev())?;
        let (down, down_variance) = edge(&mut (last + 1..self.image.height()))?;
        let v = (first as f32 - up + last as f32 + down) / 2.0;
        Some((v, (up_variance + down_variance) / 4.0))
    }
}

fn at(row: usize, offset: Option<Offset>) -> Option<Offset> {
    offset.map(|(offset, variance)| (row as f32 + offset, variance))
}

/// Σi·J/ΣJ over `reach` rows on both sides. What is darker than the background counts as none, which keeps dim stripes
/// in place; the error is then up to a third smaller than σ says.
fn centroid(window: &Window, reach: usize) -> Option<Offset> {
    let rows = || (REACH - reach..=REACH + reach).map(|i| (i, i as f32 - REACH as f32));
    let light: f32 = rows().map(|(i, _)| window.level[i].max(0.0)).sum();
    if light <= 0.0 {
        return None;
    }
    let offset = rows().map(|(i, v)| v * window.level[i].max(0.0)).sum::<f32>() / light;
    let variance: f32 = rows().map(|(i, v)| (v - offset) * (v - offset) * window.variance(i)).sum();
    Some((offset, variance / (light * light)))
}

/// δ = ½(ln I₋ − ln I₊)/(ln I₋ − 2 ln I₀ + ln I₊), with half a level for what is darker than that.
fn gauss3(window: &Window) -> Option<Offset> {
    let [a, b, c] = [REACH - 1, REACH, REACH + 1].map(|i| window.level[i].max(0.5));
    let (slope, bend) = (a.ln() - c.ln(), a.ln() - 2.0 * b.ln() + c.ln());
    if bend >= 0.0 {
        return None;
    }
    let offset = 0.5 * slope / bend;
    // dδ/d(ln I) for the three, times d(ln I)/dI.
    let parts = [(0.5 - offset) / bend / a, 2.0 * offset / bend / b, (-0.5 - offset) / bend / c];
    let variance = (0..3).map(|i| parts[i] * parts[i] * window.variance(REACH - 1 + i)).sum();
    (offset.abs() <= 1.0).then_some((offset, variance))
}

/// The parabola nearest to the logarithms of five pixels, weighted by their levels squared (Guo 2011).
fn gauss5(window: &Window) -> Option<Offset> {
    let peak = window.level[REACH];
    if peak <= 0.0 {
        return None;
    }
    // Moments of the weights and of the weighted logarithms, relative to the peak: Σw·xⁿ and Σw·xⁿ·ln I.
    let (mut s, mut t) = ([0f32; 5], [0f32; 3]);
    let mut weights = [0f32; 5];
    for (i, weight) in weights.iter_mut().enumerate() {
        let (x, y) = (i as f32 - 2.0, (window.level[REACH - 2 + i] / peak).max(1e-3));
        let log = y.ln();
        *weight = y * y;
        let mut power = *weight;
        for n in 0..5 {
            s[n] += power;
            if n < 3 {
                t[n] += power * log;
            }
            power *= x;
        }
    }
    // Cofactors of the normal equations' matrix [s0 s1 s2; s1 s2 s3; s2 s3 s4], second and third row.
    let slope_row = [s[2] * s[3] - s[1] * s[4], s[0] * s[4] - s[2] * s[2], s[1] * s[2] - s[0] * s[3]];
    let bend_row = [s[1] * s[3] - s[2] * s[2], s[1] * s[2] - s[0] * s[3], s[0] * s[2] - s[1] * s[1]];
    let dot = |row: &[f32; 3], x: [f32; 3]| row[0] * x[0] + row[1] * x[1] + row[2] * x[2];
    let (slope, bend) = (dot(&slope_row, t), dot(&bend_row, t)); // both times the determinant
    if bend.is_nan() || bend >= 0.0 {
        return None;
    }
    let offset = -0.5 * slope / bend;
    let mut variance = 0.0;
    for (i, weight) in weights.iter().enumerate() {
        let x = i as f32 - 2.0;
        let row = [1.0, x, x * x];
        let log_part = -weight * (dot(&slope_row, row) + 2.0 * offset * dot(&bend_row, row)) / (2.0 * bend);
        let part = log_part / (window.level[REACH - 2 + i].max(1e-3 * peak));
        variance += part * part * window.variance(REACH - 2 + i);
    }
    offset.is_finite().then_some((offset, variance))
}

/// The zero of g(i) = I(i−2) + I(i−1) − I(i+1) − I(i+2) nearest to the middle, on the line between two rows.
fn blais_rioux(window: &Window) -> Option<Offset> {
    let g = |i: usize| window.level[i - 2] + window.level[i - 1] - window.level[i + 1] - window.level[i + 2];
    let mut best: Option<Offset> = None;
    for i in REACH - 3..REACH + 3 {
        let (here, next) = (g(i), g(i + 1));
        if here < 0.0 && next >= 0.0 {
            let t = here / (here - next);
            let offset = i as f32 + t - REACH as f32;
            // g between the rows is (1 − t)·g(i) + t·g(i+1): the sum of these parts of six pixels.
            let parts = [1.0 - t, 1.0, t, t - 1.0, -1.0, -t];
            let noise: f32 = (0..6).map(|n| parts[n] * parts[n] * window.variance(i + n - 2)).sum();
            let variance = noise / ((next - here) * (next - here));
            if best.is_none_or(|(other, _)| offset.abs() < other.abs()) {
                best = Some((offset, variance));
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::super::synthetic::{Look, Noise, render, sensor};
    use super::*;

    /// RMS error and RMS σ of an estimator over many phases [px], and how many columns it gave.
    fn trial(estimator: Estimator, look: Look, noise: f32) -> (f64, f64, usize) {
        let params = LineParams { estimator, sigma_min_px: 0.0, ..LineParams::default() };
        let columns = 3000;
        let truth = |u: usize| 20.0 + ((u as f64 * 0.618_034) % 1.0) - 0.5;
        let image = render((columns, 41), look, &mut Noise::new(11), |u| Some(truth(u)));
        let (mut squares, mut variances, mut count) = (0.0, 0.0, 0);
        for u in 0..columns {
            let column = Column { image: &image, u, background: look.background as f32, noise };
            if let Some(peak) = column.peak(20, &params) {
                squares += (f64::from(peak.v) - truth(u)).powi(2);
                variances += f64::from(peak.sigma).powi(2);
                count += 1;
            }
        }
        ((squares / count as f64).sqrt(), (variances / count as f64).sqrt(), count)
    }

    /// instrument.md 2, Monte Carlo: stripe σ [px], peak level, then RMS [px] of centroid-7, Gauss-3 and Blais–Rioux.
    const MONTE_CARLO: [(f64, f64, [f64; 3]); 5] = [
        (0.35, 100.0, [0.021, 0.015, 0.018]),
        (0.5, 100.0, [0.005, 0.005, 0.009]),
        (0.8, 25.0, [0.022, 0.014, 0.019]),
        (0.8, 100.0, [0.006, 0.004, 0.014]),
        (1.2, 25.0, [0.025, 0.026, 0.020]),
    ];

    #[test]
    fn each_estimator_is_as_good_as_its_monte_carlo_figure() {
        for (width, level, expected) in MONTE_CARLO {
            let estimators = [Estimator::Centroid, Estimator::Gauss3, Estimator::BlaisRioux];
            for (estimator, expected) in estimators.into_iter().zip(expected) {
                let (rms, _, count) = trial(estimator, sensor(width, level), 0.076);
                assert_eq!(count, 3000);
                assert!((rms - expected).abs() <= 0.1 * expected + 0.0012, "{estimator:?} {width} {level}: {rms:.4}");
            }
        }
    }

    #[test]
    fn auto_is_as_good_as_the_best_of_them() {
        for (width, level, expected) in MONTE_CARLO {
            let best = expected.iter().copied().fold(f64::INFINITY, f64::min);
            let (rms, _, count) = trial(Estimator::Auto, sensor(width, level), 0.076);
            assert_eq!(count, 3000);
            assert!(rms <= 1.1 * best + 0.001, "{width} {level}: {rms:.4} against {best}");
        }
        // Dim: where logarithms fail, the centroid.
        for (width, level, limit) in [(0.4, 3.0, 0.10), (0.5, 3.0, 0.09), (0.8, 3.0, 0.14), (0.5, 6.0, 0.06)] {
            let (rms, _, count) = trial(Estimator::Auto, sensor(width, level), 0.076);
            assert!(rms < limit && count == 3000, "{width} {level}: {rms:.4} {count}");
        }
    }

    #[test]
    fn a_whole_pixel_has_the_error_of_a_box() {
        let (rms, sigma, _) = trial(Estimator::WholePixel, sensor(0.8, 100.0), 0.076);
        assert!((rms - 0.289).abs() < 0.01 && (sigma - 0.289).abs() < 0.001, "{rms} {sigma}");
    }

    #[test]
    fn without_noise_the_row_is_exact() {
        // 7-bit steps are noise too, and seven rows cut off the tails.
        let look = Look { read: 0.0, shot: 0.0, ..sensor(1.0, 120.0) };
        for estimator in [Estimator::Auto, Estimator::Gauss3, Estimator::Gauss5, Estimator::Centroid] {
            let (rms, _, _) = trial(estimator, look, 0.0);
            let limit = if estimator == Estimator::Centroid { 0.008 } else { 0.004 };
            assert!(rms < limit, "{estimator:?}: {rms:.4}");
        }
    }

    #[test]
    fn sigma_is_right_to_30_percent() {
        // Noise well above the quantisation, as it is white then.
        for (width, level, read) in
            [(0.8, 60.0, 1.5), (0.8, 100.0, 3.0), (1.2, 60.0, 2.0), (2.0, 80.0, 3.0), (2.0, 80.0, 8.0)]
        {
            let look = Look { read, background: 25.0, ..sensor(width, level) };
            let estimators = if width > 1.0 {
                vec![Estimator::Auto, Estimator::Gauss5, Estimator::BlaisRioux]
            } else {
                vec![Estimator::Auto, Estimator::Gauss3, Estimator::Centroid, Estimator::BlaisRioux]
            };
            for estimator in estimators {
                let (rms, sigma, _) = trial(estimator, look, read as f32);
                let ratio = sigma / rms;
                let most = if estimator == Estimator::Centroid { 1.5 } else { 1.3 };
                assert!((0.7..most).contains(&ratio), "{estimator:?} {width} {level} {read}: {sigma:.4} for {rms:.4}");
            }
        }
    }

    #[test]
    fn a_saturated_stripe_is_found_between_its_edges() {
        for (width, level) in [(0.8, 300.0), (1.5, 500.0), (2.0, 1000.0)] {
            let (rms, sigma, count) = trial(Estimator::Auto, sensor(width, level), 0.076);
            assert!(rms < 0.1 && count == 3000, "{width} {level}: {rms:.4} {count}");
            assert!(sigma < 0.05, "{sigma}");
        }
    }

    #[test]
    fn a_peak_at_the_edge_of_the_image_is_no_trouble() {
        let levels: Vec<u8> =
            (0..30).flat_map(|v| [if v < 2 { 120 } else { 3 }, if v > 27 { 127 } else { 3 }, 127]).collect();
        let image = Image::new(3, 30, 127, levels).unwrap();
        for estimator in ["auto", "whole_pixel", "centroid", "gauss3", "gauss5", "blais_rioux"] {
            let params: LineParams = toml::from_str(&format!("estimator = \"{estimator}\"")).unwrap();
            for (u, row) in [(0, 0), (0, 1), (1, 29), (1, 28), (2, 0), (2, 29)] {
                if let Some(peak) = (Column { image: &image, u, background: 3.0, noise: 0.1 }).peak(row, &params) {
                    assert!(peak.v >= -0.5 && peak.v <= 29.5 && peak.sigma > 0.0, "{peak:?}");
                }
            }
        }
    }
}
