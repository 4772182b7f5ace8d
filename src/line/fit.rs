//! The most likely stripe in one column: all pixels about it, the noise of each, and nothing known but the model.
//!
//! The light of a Gaussian of row v, width s, flux A over a background b falls on pixel i as
//! μ(i) = b + A·[Φ((i + ½ − v)/s) − Φ((i − ½ − v)/s)], with variance dark + shot·μ (EMVA 1288, quantisation in `dark`).
//! Fisher's scoring finds the four of them; σ is that of v with the other three unknown (inverse of the 4 × 4 Fisher
//! information). A saturated pixel says only "at least white": it counts while the model is darker than that.

use nalgebra::{Matrix4, Vector4};

use super::gauss::{Noise, SHAPE};
use super::peak::{Column, Offset};

/// Most rows above or below the brightest one.
const REACH_MAX: usize = 40;
/// Steps until it must have settled.
const STEPS_MAX: usize = 40;
/// It has settled when a step is shorter than this [px].
const STEP_END_PX: f64 = 1e-4;
/// Narrowest and widest stripe [px].
const WIDTH: [f64; 2] = [0.12, 20.0];
/// A rise by this many σ ends the stripe: something else begins there.
const RISE_SIGMAS: f32 = 4.0;
/// Where residuals are this much larger than noise and shape allow (χ² per degree of freedom), the stripe is none of the
/// model's (a mixed peak at an edge, two stripes in one), and half its width is added to σ.
const MISFIT: f64 = 3.0;

/// Row, width, flux, background.
#[derive(Clone, Copy, Debug)]
struct Stripe {
    v: f64,
    width: f64,
    flux: f64,
    background: f64,
}

/// What was seen: rows from `first` on.
struct Seen<'a> {
    first: usize,
    level: &'a [f64],
    white: f64,
    noise: Noise,
    /// Mean and variance of the background from the boxes above and below.
    background: (f64, f64),
}

/// The row and its variance; `None` where no Gaussian stripe is.
pub(super) fn full(column: &Column, row: usize, top: usize) -> Option<Offset> {
    let first_guess = column.first_guess(row, top)?;
    let (height, peak) = (column.image.height(), column.level(top));
    // Rows over half the height: the full width at half maximum.
    let half = |v: &usize| column.level(*v) > 0.5 * peak;
    let below = (top + 1..height).take(REACH_MAX).take_while(half).count();
    let above = (0..top).rev().take(REACH_MAX).take_while(half).count();
    let width = f64::max((above + below + 1) as f64 / 2.355, 0.4);
    let reach = |rows: usize| (rows + (2.5 * width) as usize + 3).min(REACH_MAX);
    let down = extent(column, (top + below..height).take(reach(1)));
    let up = extent(column, (0..=top - above).rev().take(reach(1)));
    let rows = top - above + 1 - up..top + below + down;
    let mut level = [0.0; 4 * REACH_MAX];
    let level = level.get_mut(..rows.len())?;
    for (level, v) in level.iter_mut().zip(rows.clone()) {
        *level = f64::from(column.raw(v));
    }
    let noise = column.noise();
    let seen = Seen {
        first: rows.start,
        level,
        white: f64::from(column.image.white()),
        noise,
        background: (f64::from(column.background), f64::from(noise.dark) / 8.0 + 1.0 / 12.0),
    };
    let flux = f64::from(peak) * width * 2.507;
    let start = Stripe { v: f64::from(first_guess.0), width, flux, background: seen.background.0 };
    let (stripe, variance) = seen.most_likely(start)?;
    let moved = (stripe.v - f64::from(first_guess.0)).abs();
    (moved <= 1.0 + stripe.width).then_some((stripe.v as f32, variance as f32))
}

/// How many rows from the stripe's flank outwards are its own: until it rises again.
fn extent(column: &Column, rows: impl Iterator<Item = usize>) -> usize {
    let mut lowest = f32::INFINITY;
    rows.take_while(|v| {
        let level = column.level(*v);
        let is_own = level <= lowest + RISE_SIGMAS * column.deviation(level);
        lowest = lowest.min(level);
        is_own
    })
    .count()
}

impl Seen<'_> {
    /// Fisher's scoring from a first guess; the stripe, and the variance of its row.
    fn most_likely(&self, mut stripe: Stripe) -> Option<(Stripe, f64)> {
        for count in 0..STEPS_MAX {
            let (information, score, _, _) = self.information(&stripe);
            let step = information.cholesky()?.solve(&score);
            // Never far at once: half a width along the column, and not to a third of the width or three times as wide.
            let longest = 0.5 * stripe.width.max(0.5);
            let scale = (longest / step[0].abs()).min(0.4 * stripe.width / step[1].abs()).min(1.0);
            // A pixel at the edge of saturation may count in one step and not in the next: then half a step, and near enough.
            let (part, end) = if count < STEPS_MAX / 3 { (1.0, STEP_END_PX) } else { (0.5, 30.0 * STEP_END_PX) };
            let step = part * scale * step;
            stripe.v += step[0];
            stripe.width = (stripe.width + step[1]).clamp(WIDTH[0], WIDTH[1]);
            stripe.flux += step[2];
            stripe.background += step[3];
            if !(stripe.v.is_finite() && stripe.flux.is_finite() && stripe.flux > 0.0) {
                return None;
            }
            if scale == 1.0 && step[0].abs().max(step[1].abs()) < part * end {
                let (information, _, misfit, count) = self.information(&stripe);
                let variance = information.try_inverse()?[(0, 0)];
                let excess = misfit / (count.saturating_sub(4).max(1) as f64);
                let variance = variance + if excess > MISFIT { 0.25 * stripe.width * stripe.width } else { 0.0 };
                return (variance.is_finite() && variance > 0.0).then_some((stripe, variance));
            }
        }
        None
    }

    /// Fisher information of row, width, flux and background, the score, χ² and how many pixels count.
    fn information(&self, stripe: &Stripe) -> (Matrix4<f64>, Vector4<f64>, f64, usize) {
        let Stripe { v, width, flux, background } = *stripe;
        let (mut information, mut score) = (Matrix4::zeros(), Vector4::zeros());
        let (mut misfit, mut count) = (0.0, 0);
        let edge = |i: usize| {
            let x = ((self.first + i) as f64 - 0.5 - v) / width;
            let density = (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt();
            (x, density, cumulative(x, density))
        };
        let shape = f64::from(SHAPE) * flux / (width * std::f64::consts::TAU.sqrt());
        let mut upper = edge(0);
        for (i, level) in self.level.iter().enumerate() {
            let (x0, density0, part0) = upper;
            upper = edge(i + 1);
            let (x1, density1, part1) = upper;
            let part = part1 - part0;
            let mean = background + flux * part;
            // A saturated pixel says nothing where the model is brighter; in between, its weight goes over a level, lest the
            // steps go back and forth.
            let says = if *level >= self.white { (self.white + 0.5 - mean).clamp(0.0, 1.0) } else { 1.0 };
            if says == 0.0 {
                continue;
            }
            let slopes = Vector4::new(
                flux * (density0 - density1) / width,
                flux * (x0 * density0 - x1 * density1) / width,
                part,
                1.0,
            );
            let weight =
                says / (f64::from(self.noise.dark) + f64::from(self.noise.shot) * (mean - self.background.0).max(0.0));
            let residual = level - mean;
            information += weight * slopes * slopes.transpose();
            score += weight * residual * slopes;
            misfit += residual * residual / (1.0 / weight + shape * shape);
            count += 1;
        }
        // What the boxes say of the background. A trace of stiffness keeps a width that nothing is known of in place.
        let (box_mean, box_variance) = self.background;
        information[(3, 3)] += 1.0 / box_variance;
        score[3] += (box_mean - background) / box_variance;
        information[(1, 1)] += 1e-6 * information[(1, 1)] + 1e-9;
        (information, score, misfit, count)
    }
}

/// The integral of the standard normal density up to x, given the density there: right to 1e-7 (Abramowitz and Stegun
/// 26.2.17).
fn cumulative(x: f64, density: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.231_641_9 * x.abs());
    let series =
        t * (0.319_381_530 + t * (-0.356_563_782 + t * (1.781_477_937 + t * (-1.821_255_978 + t * 1.330_274_429))));
    let tail = density * series;
    if x > 0.0 { 1.0 - tail } else { tail }
}
