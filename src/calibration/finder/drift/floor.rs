//! Which blocks of columns show floor: those that agree with each other, however far off they are together.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{Block, DriftWatch, Look, median};
use crate::calibration::finder::model::{SlitLine, slit_line};
use crate::calibration::finder::simulate::row_at;
use crate::geometry::{Plane, Robot};
use crate::optics::Rig;

/// A line that is off by more than this is no floor [px].
const OFF_MAX_PX: f64 = 100.0;
/// Half the width of the first look: how far the floor's misfit may bend over the image [px].
const BEND_PX: usize = 3;
/// How near the bend blocks must be, one look after the other [px]; the last one by their own scatter.
const GATES_PX: [f64; 6] = [6.0, 4.0, 3.0, 2.0, 1.5, 1.0];
/// The floor must be so large a part of what is seen.
const SHARE_MIN: f64 = 0.35;
/// Numbers that describe how the floor's misfit bends over image, mirror and cylinder.
const BENDS: usize = 12;

/// A block on the floor.
pub(super) struct Reading {
    pub block: Block,
    /// The smooth misfit there [px].
    pub bend: f64,
    /// Rows that a floor higher by one metre would move by [px/m].
    pub px_per_m: f64,
}

/// The readings of one capture.
pub(super) struct Seen<'a> {
    pub look: &'a Look,
    pub readings: Vec<Reading>,
}

/// What of the captures is floor.
pub(super) struct Floor<'a> {
    pub seen: Vec<Seen<'a>>,
    /// Share of all blocks that is floor.
    pub share: f64,
}

impl<'a> Floor<'a> {
    /// The floor in what the watch has seen; `None` if there is no telling.
    pub fn in_looks(watch: &'a DriftWatch) -> Option<Self> {
        let all: Vec<(&Look, &Block, [f64; BENDS])> = (watch.looks.iter())
            .flat_map(|look| look.blocks.iter().map(move |block| (look, block, bends(watch, look, block))))
            .collect();
        let mut fit = DVector::zeros(BENDS);
        fit[0] = most_common(all.iter().map(|(_, block, _)| block.off))?;
        let mut gate = 0.0;
        for step in GATES_PX.into_iter().map(Some).chain([None, None]) {
            let off = |(_, block, bends): &(&Look, &Block, [f64; BENDS])| block.off - dot(bends, &fit);
            gate = step.unwrap_or_else(|| {
                let mut sizes: Vec<f64> = all.iter().map(|b| off(b).abs()).filter(|size| *size < gate).collect();
                (4.0 * 1.4826 * median(&mut sizes)).max(0.4)
            });
            let near: Vec<&(&Look, &Block, [f64; BENDS])> =
                all.iter().filter(|block| off(block).abs() < gate).collect();
            fit = least_squares(&near)?;
        }
        let near = |block: &Block, bend: f64| (block.off - bend).abs() < gate;
        let mut seen: Vec<Seen> = Vec::new();
        let mut count = 0;
        for look in &watch.looks {
            let mut readings = Vec::new();
            let raised = Raised::of(watch, look);
            for block in &look.blocks {
                let bend = dot(&bends(watch, look, block), &fit);
                if near(block, bend)
                    && let Some(px_per_m) = raised.as_ref().and_then(|raised| raised.px_per_m(&watch.rig, block.u))
                {
                    readings.push(Reading { block: *block, bend, px_per_m });
                }
            }
            count += readings.len();
            // A block or two in a capture may be anything.
            if readings.len() >= 3 {
                seen.push(Seen { look, readings });
            }
        }
        let share = count as f64 / all.len().max(1) as f64;
        (share >= SHARE_MIN).then_some(Self { seen, share })
    }

    pub fn captures(&self) -> usize {
        self.seen.len()
    }

    pub fn readings(&self) -> usize {
        self.seen.iter().map(|seen| seen.readings.len()).sum()
    }

    /// Apparent height of the floor, rms [m]: of what bends smoothly, without the noise.
    pub fn misfit_m(&self) -> f64 {
        let heights = self.seen.iter().flat_map(|seen| seen.readings.iter().map(|r| r.bend / r.px_per_m));
        (heights.map(|h| h * h).sum::<f64>() / self.readings().max(1) as f64).sqrt()
    }
}

/// How a misfit may bend: over rows to the third, columns to the second, and with the cylinder's heading.
fn bends(watch: &DriftWatch, look: &Look, block: &Block) -> [f64; BENDS] {
    let camera = &watch.rig.camera;
    let u = 2.0 * block.u / camera.width as f64 - 1.0;
    let v = 2.0 * (block.v - block.off) / camera.height as f64 - 1.0;
    let (s, c) = (watch.rig.cylinder.zero_rad + look.cylinder_pulse * watch.rig.cylinder.rad_per_pulse).sin_cos();
    [1.0, v, v * v, v * v * v, u, u * v, u * v * v, u * u, s, c, u * s, u * c]
}

fn dot(bends: &[f64; BENDS], fit: &DVector<f64>) -> f64 {
    bends.iter().zip(fit.iter()).map(|(b, f)| b * f).sum()
}

/// The middle of the most common offset, some pixels wide.
fn most_common(offs: impl Iterator<Item = f64>) -> Option<f64> {
    let size = 2 * OFF_MAX_PX as usize;
    let mut counts = vec![0usize; size];
    for off in offs.filter(|off| off.abs() < OFF_MAX_PX) {
        if let Some(count) = counts.get_mut((off + OFF_MAX_PX) as usize) {
            *count += 1;
        }
    }
    let around = |i: usize| counts[i.saturating_sub(BEND_PX)..(i + BEND_PX + 1).min(size)].iter().sum::<usize>();
    let best = (0..size).rev().max_by_key(|i| around(*i)).filter(|i| around(*i) > 0)?;
    Some(best as f64 - OFF_MAX_PX + 0.5)
}

fn least_squares(near: &[&(&Look, &Block, [f64; BENDS])]) -> Option<DVector<f64>> {
    if near.len() < 4 * BENDS {
        return None;
    }
    let mut normal = DMatrix::<f64>::zeros(BENDS, BENDS);
    let mut right = DVector::zeros(BENDS);
    for (_, block, bends) in near {
        for (a, x) in bends.iter().enumerate() {
            right[a] += x * block.off;
            for (b, y) in bends.iter().enumerate() {
                normal[(a, b)] += x * y;
            }
        }
    }
    // A pinch of nothing-has-bent: a robot that only looks ahead tells its heading from a constant by nothing.
    for i in 0..BENDS {
        normal[(i, i)] += 1e-4 * near.len() as f64;
    }
    Some(normal.cholesky()?.solve(&right))
}

/// The lines of a capture on a floor that is as it should be, and on one a little higher.
struct Raised {
    floor: SlitLine,
    higher: SlitLine,
}

impl Raised {
    const STEP_M: f64 = 0.005;

    fn of(watch: &DriftWatch, look: &Look) -> Option<Self> {
        let higher = Plane::<Robot>::new(Vector3::z(), Self::STEP_M)?;
        let line = |floor| slit_line(&watch.rig, look.mirror_pulse, look.cylinder_pulse, floor);
        Some(Self { floor: line(&watch.floor)?, higher: line(&higher)? })
    }

    /// How the row answers to the floor's height at a column [px/m].
    fn px_per_m(&self, rig: &Rig, u: f64) -> Option<f64> {
        let rows = row_at(rig, &self.higher, u)? - row_at(rig, &self.floor, u)?;
        Some(rows / Self::STEP_M).filter(|slope| slope.abs() > 1.0)
    }
}
