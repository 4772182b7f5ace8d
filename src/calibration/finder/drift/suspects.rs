//! Which single parameter explains a floor that does not fit.

use super::floor::{Floor, Seen};
use super::{Drift, DriftState, DriftWatch, Moved};
use crate::calibration::finder::model::{PARAMETERS, slit_line};
use crate::calibration::finder::simulate::row_at;
use crate::optics::Rig;

/// What a bump moves, and a step of it that bends rows but little, as places in [`PARAMETERS`]: all but the chip's scale and
/// distortion, which no bump changes, and the optical centre, which a floor does not tell from tilt and pan.
const SUSPECTS: [&str; 14] = [
    "camera_height_m",
    "x0_m",
    "tilt_rad",
    "roll_rad",
    "pan_rad",
    "mirror_height_m",
    "beam_zero_rad",
    "beam_rad_per_pulse",
    "slit_roll_rad",
    "mirror_x_m",
    "camera_y_m",
    "axis_pitch_rad",
    "axis_roll_rad",
    "f_mm",
];
/// So many captures are asked, evenly over those there are.
const CAPTURES: usize = 100;
/// Two parameters are told apart if one leaves more misfit by so many in χ²: three deviations.
const APART: f64 = 9.0;
/// A parameter that explains less of the floor's squared height than this is not the only one that moved.
const EXPLAINS_MIN: f64 = 0.9;
/// Each is fitted in so many steps: rows bend with large shifts.
const STEPS: usize = 3;

/// What is left of the readings.
#[derive(Clone, Copy)]
struct Left {
    /// Square sum of the whitened rows.
    square: f64,
    /// Apparent height of the floor [m, rms], its noise included.
    height_m: f64,
}

/// One parameter's answer.
struct Answer {
    moved: Moved,
    left: Left,
}

/// Names what moved.
pub(super) fn suspected(watch: &DriftWatch, floor: &Floor, drift: Drift) -> Drift {
    let every = floor.seen.len().div_ceil(CAPTURES).max(1);
    let seen: Vec<&Seen> = floor.seen.iter().step_by(every).collect();
    let Some(slopes) = seen.iter().map(|s| by_a_pulse(watch, s)).collect::<Option<Vec<_>>>() else {
        return drift;
    };
    let asked = Asked { watch, seen, slopes };
    let Some(none) = asked.left(&watch.rig) else { return drift };
    let smooth = asked.left_by_the_bend();
    let mut answers: Vec<Answer> = SUSPECTS.iter().filter_map(|name| asked.answer(name, none, smooth)).collect();
    answers.sort_by(|a, b| a.left.square.total_cmp(&b.left.square));
    let Some(best) = answers.first() else { return drift };
    // Scatter beyond the standard deviations enlarges what counts as the same.
    let scale = asked.scale(smooth);
    if best.moved.by.abs() < watch.params.significance * best.moved.sigma {
        return drift;
    }
    let misfit_after_m = Some(best.left.height_m);
    if best.moved.explains < EXPLAINS_MIN {
        return Drift { state: DriftState::Several, misfit_after_m, ..drift };
    }
    let most = best.left.square + APART * scale;
    let moved =
        answers.into_iter().take_while(|answer| answer.left.square <= most).map(|answer| answer.moved).collect();
    Drift { state: DriftState::Moved, misfit_after_m, moved, ..drift }
}

/// The captures that are asked.
struct Asked<'a> {
    watch: &'a DriftWatch,
    seen: Vec<&'a Seen<'a>>,
    /// For each capture and reading, what one standard deviation of the mirror's reading moves it by, over its own.
    slopes: Vec<Vec<f64>>,
}

impl Asked<'_> {
    fn answer(&self, name: &'static str, none: Left, smooth: Left) -> Option<Answer> {
        let place = PARAMETERS.iter().position(|(known, ..)| *known == name)?;
        let (_, unit, _, scale) = PARAMETERS[place];
        let step = 1e-4 * scale;
        let (mut by, mut weight) = (0.0, 0.0);
        for _ in 0..STEPS {
            let here = self.rows(&self.watch.moved(place, by))?;
            let there = self.rows(&self.watch.moved(place, by + step))?;
            let (mut along, mut square) = (0.0, 0.0);
            for ((here, there), w) in here.iter().zip(&there).zip(&self.slopes) {
                let slope: Vec<f64> = here.iter().zip(there).map(|(h, t)| (t - h) / step).collect();
                let (here, slope) = (whitened(here, w), whitened(&slope, w));
                along += here.iter().zip(&slope).map(|(h, s)| h * s).sum::<f64>();
                square += slope.iter().map(|s| s * s).sum::<f64>();
            }
            // Nothing that is seen depends on it.
            if square.is_nan() || square * (100.0 * scale).powi(2) <= 1.0 {
                return None;
            }
            by -= along / square;
            weight = square;
        }
        let left = self.left(&self.watch.moved(place, by))?;
        let gone = |left: Left| none.height_m.powi(2) - left.height_m.powi(2);
        let explains = gone(left) / gone(smooth).max(1e-12);
        let sigma = (self.scale(smooth) / weight).sqrt();
        let moved = Moved { parameter: name, by, sigma, unit, explains: explains.min(1.0) };
        (by.is_finite() && left.square.is_finite()).then_some(Answer { moved, left })
    }

    /// By how much the noise is larger than its standard deviations say, as a square; 1 or more.
    fn scale(&self, smooth: Left) -> f64 {
        let readings: usize = self.seen.iter().map(|seen| seen.readings.len()).sum();
        (smooth.square / (readings as f64 - 12.0).max(1.0)).max(1.0)
    }

    /// Read minus predicted rows of a finder over their standard deviations, capture by capture.
    fn rows(&self, rig: &Rig) -> Option<Vec<Vec<f64>>> {
        let of = |seen: &&Seen| {
            let line = slit_line(rig, seen.look.mirror_pulse, seen.look.cylinder_pulse, &self.watch.floor)?;
            let rows = seen.readings.iter().map(|r| {
                // Outside the image as well: a finder that moved far may see the floor elsewhere.
                let off = line.rows_off(&rig.camera, r.block.u, r.block.v)?;
                Some(off / r.block.sigma)
            });
            rows.collect::<Option<Vec<f64>>>()
        };
        self.seen.iter().map(of).collect()
    }

    /// What a finder leaves.
    fn left(&self, rig: &Rig) -> Option<Left> {
        self.rows(rig).map(|rows| self.left_of(&rows))
    }

    /// What is left when all that bends smoothly is taken out.
    fn left_by_the_bend(&self) -> Left {
        let of = |seen: &&Seen| seen.readings.iter().map(|r| (r.block.off - r.bend) / r.block.sigma).collect();
        self.left_of(&self.seen.iter().map(of).collect::<Vec<Vec<f64>>>())
    }

    fn left_of(&self, rows: &[Vec<f64>]) -> Left {
        let (mut square, mut heights, mut count) = (0.0, 0.0, 0.0);
        for ((rows, w), seen) in rows.iter().zip(&self.slopes).zip(&self.seen) {
            square += whitened(rows, w).iter().map(|r| r * r).sum::<f64>();
            for (row, reading) in rows.iter().zip(&seen.readings) {
                heights += (row * reading.block.sigma / reading.px_per_m).powi(2);
                count += 1.0;
            }
        }
        Left { square, height_m: (heights / f64::max(count, 1.0)).sqrt() }
    }
}

/// What one standard deviation of the mirror's reading moves the rows of a capture by, over their own.
fn by_a_pulse(watch: &DriftWatch, seen: &Seen) -> Option<Vec<f64>> {
    let row = |later: f64, u: f64| {
        let line = slit_line(&watch.rig, seen.look.mirror_pulse + later, seen.look.cylinder_pulse, &watch.floor)?;
        row_at(&watch.rig, &line, u)
    };
    let slope = |r: &super::floor::Reading| {
        Some((row(0.5, r.block.u)? - row(-0.5, r.block.u)?) * watch.pulse_sigma / r.block.sigma)
    };
    seen.readings.iter().map(slope).collect()
}

/// Rows of covariance 1 + w·wᵀ made independent and of size 1.
fn whitened(rows: &[f64], w: &[f64]) -> Vec<f64> {
    let (w2, along) = rows.iter().zip(w).fold((0.0, 0.0), |(w2, along), (r, w)| (w2 + w * w, along + w * r));
    let c = if w2 > 1e-12 { (1.0 - 1.0 / (1.0 + w2).sqrt()) / w2 } else { 0.5 };
    rows.iter().zip(w).map(|(r, w)| r - c * along * w).collect()
}
