//! Which blocks of columns show floor: those that agree with each other, however far off they are together.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{Block, DriftWatch, Look, SCATTER_MAX_PX, median};
use crate::calibration::finder::model::{SlitLine, slit_line};
use crate::geometry::{Plane, Robot};
use crate::optics::Rig;

/// A line that is off by more than this is no floor [px].
const OFF_MAX_PX: f64 = 100.0;
/// Half the width of the first look: how far the floor's misfit may bend over the image [px].
const BEND_PX: usize = 3;
/// How near the bend blocks must be, one look after the other [px]; the last one by their own scatter.
const GATES_PX: [f64; 6] = [6.0, 4.0, 3.0, 2.0, 1.5, 1.0];
/// The floor must be so large a part of what could be floor by its slope.
const SHARE_MIN: f64 = 0.35;
/// Numbers that describe how the floor's misfit bends over image, mirror and cylinder.
const BENDS: usize = 12;
/// A block is off the floor, above or below, beyond so many times the height that is overlooked, and so many pixels.
const OFF_FLOOR: (f64, f64) = (3.0, 3.0);

/// A block on the floor.
pub(super) struct Reading {
    pub block: Block,
    /// The smooth misfit there, of the calibrated finder [px].
    pub bend: f64,
    /// What is left without it: the noise [px].
    pub noise: f64,
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
    /// The shift about which it was found: name and size. Nothing moved, otherwise.
    pub about: Option<(&'static str, f64)>,
}

/// A block that may be floor of some finder.
struct Candidate<'a> {
    look: &'a Look,
    block: &'a Block,
    /// Its row minus that of the floor [px].
    off: f64,
    bends: [f64; BENDS],
}

/// The blocks that lie along the floor's line of some finder, off it or not.
pub(super) struct Candidates<'a>(Vec<Candidate<'a>>);

impl<'a> Candidates<'a> {
    pub fn of(watch: &DriftWatch, rig: &Rig, looks: impl Iterator<Item = &'a Look>) -> Self {
        let half = watch.block_px() / 2.0;
        let rows = 0.0..rig.camera.height as f64;
        let mut candidates = Vec::new();
        for look in looks {
            let Some(line) = slit_line(rig, look.mirror_pulse, look.cylinder_pulse, &watch.floor) else { continue };
            for block in &look.blocks {
                let at = |du: f64| line.rows_off(&rig.camera, block.u + du, block.v + block.slope * du);
                let (Some(off), Some(left), Some(right)) = (at(0.0), at(-half), at(half)) else { continue };
                // Across the floor's line by more than rows may scatter: a wall, or the edge of something.
                let along = (right - left).abs() / 4.0 <= SCATTER_MAX_PX;
                if along && rows.contains(&(block.v - off)) {
                    candidates.push(Candidate { look, block, off, bends: bends(rig, look, block, off) });
                }
            }
        }
        Self(candidates)
    }

    /// How many of them are off by the same.
    pub fn most_alike(&self) -> usize {
        most_common(self.0.iter().map(|candidate| candidate.off)).map_or(0, |(_, count)| count)
    }
}

impl<'a> Floor<'a> {
    /// The floor about where the finder with one shift would see it, or the calibrated one; `None` if there is no telling.
    pub fn about(watch: &'a DriftWatch, about: Option<(&'static str, f64)>) -> Option<Self> {
        let calibrated = watch.shifts.nominal();
        let rig = about.map_or_else(|| calibrated.clone(), |(name, by)| watch.shifts.moved(name, by));
        let all = Candidates::of(watch, &rig, watch.looks.iter()).0;
        let (fit, gate) = bent(&all)?;
        let mut seen: Vec<Seen> = Vec::new();
        let mut count = 0;
        let mut lines = None;
        for Candidate { look, block, off, bends } in all.iter() {
            let noise = off - dot(bends, &fit);
            if noise.abs() >= gate {
                continue;
            }
            count += 1;
            if seen.last().is_none_or(|last| !std::ptr::eq(last.look, *look)) {
                seen.push(Seen { look, readings: Vec::new() });
                lines = Lines::of(watch, &rig, look);
            }
            if let Some(last) = seen.last_mut()
                && let Some(reading) = lines.as_ref().and_then(|lines| lines.reading(watch, &rig, block, noise))
            {
                last.readings.push(reading);
            }
        }
        // A block or two in a capture may be anything.
        seen.retain(|seen| seen.readings.len() >= 3);
        let share = count as f64 / all.len().max(1) as f64;
        let blocks: usize = watch.looks.iter().map(|look| look.blocks.len()).sum();
        (share >= SHARE_MIN).then(|| Self { seen, share: count as f64 / blocks.max(1) as f64, about })
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

/// The shares of all blocks that lie on the floor of the calibrated finder and below it, where nothing can be.
pub(super) fn on_and_below(watch: &DriftWatch) -> (f64, f64) {
    let rig = watch.shifts.nominal();
    let (mut all, mut on, mut below) = (0.0, 0.0, 0.0);
    for look in &watch.looks {
        let Some(lines) = Lines::of(watch, rig, look) else { continue };
        for block in &look.blocks {
            let Some(Reading { bend: off, px_per_m, .. }) = lines.reading(watch, rig, block, 0.0) else { continue };
            let gate = (OFF_FLOOR.0 * watch.params.misfit_m * px_per_m.abs()).max(OFF_FLOOR.1);
            all += 1.0;
            on += f64::from(u8::from(off.abs() < gate));
            below += f64::from(u8::from(off * px_per_m.signum() <= -gate));
        }
    }
    (on / f64::max(all, 1.0), below / f64::max(all, 1.0))
}

/// How the most of these are off, and how near to that a block must be.
fn bent(all: &[Candidate]) -> Option<(DVector<f64>, f64)> {
    let mut fit = DVector::zeros(BENDS);
    fit[0] = most_common(all.iter().map(|candidate| candidate.off))?.0;
    let mut gate = 0.0;
    for step in GATES_PX.into_iter().map(Some).chain([None, None]) {
        let off = |candidate: &Candidate| candidate.off - dot(&candidate.bends, &fit);
        gate = step.unwrap_or_else(|| {
            let mut sizes: Vec<f64> = all.iter().map(|c| off(c).abs()).filter(|size| *size < gate).collect();
            (4.0 * 1.4826 * median(&mut sizes)).max(0.4)
        });
        let near: Vec<&Candidate> = all.iter().filter(|candidate| off(candidate).abs() < gate).collect();
        fit = least_squares(&near)?;
    }
    Some((fit, gate))
}

/// How a misfit may bend: over rows to the third, columns to the second, and with the cylinder's heading.
fn bends(rig: &Rig, look: &Look, block: &Block, off: f64) -> [f64; BENDS] {
    let u = 2.0 * block.u / rig.camera.width as f64 - 1.0;
    let v = 2.0 * (block.v - off) / rig.camera.height as f64 - 1.0;
    let (s, c) = (rig.cylinder.zero_rad + look.cylinder_pulse * rig.cylinder.rad_per_pulse).sin_cos();
    [1.0, v, v * v, v * v * v, u, u * v, u * v * v, u * u, s, c, u * s, u * c]
}

fn dot(bends: &[f64; BENDS], fit: &DVector<f64>) -> f64 {
    bends.iter().zip(fit.iter()).map(|(b, f)| b * f).sum()
}

/// The middle of the most common offset, some pixels wide, and how many have it.
fn most_common(offs: impl Iterator<Item = f64>) -> Option<(f64, usize)> {
    let size = 2 * OFF_MAX_PX as usize;
    let mut counts = vec![0usize; size];
    for off in offs.filter(|off| off.abs() < OFF_MAX_PX) {
        if let Some(count) = counts.get_mut((off + OFF_MAX_PX) as usize) {
            *count += 1;
        }
    }
    let around = |i: usize| counts[i.saturating_sub(BEND_PX)..(i + BEND_PX + 1).min(size)].iter().sum::<usize>();
    let best = (0..size).rev().max_by_key(|i| around(*i)).filter(|i| around(*i) > 0)?;
    Some((best as f64 - OFF_MAX_PX + 0.5, around(best)))
}

fn least_squares(near: &[&Candidate]) -> Option<DVector<f64>> {
    if near.len() < 4 * BENDS {
        return None;
    }
    let mut normal = DMatrix::<f64>::zeros(BENDS, BENDS);
    let mut right = DVector::zeros(BENDS);
    for candidate in near {
        for (a, x) in candidate.bends.iter().enumerate() {
            right[a] += x * candidate.off;
            for (b, y) in candidate.bends.iter().enumerate() {
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

/// The lines of a capture on the floor: of the calibrated finder, of the one that is asked, and of that on a floor a little
/// higher.
struct Lines {
    calibrated: SlitLine,
    floor: SlitLine,
    higher: SlitLine,
}

impl Lines {
    const STEP_M: f64 = 0.005;

    fn of(watch: &DriftWatch, rig: &Rig, look: &Look) -> Option<Self> {
        let higher = Plane::<Robot>::new(Vector3::z(), Self::STEP_M)?;
        let line = |rig, floor| slit_line(rig, look.mirror_pulse, look.cylinder_pulse, floor);
        let calibrated = line(watch.shifts.nominal(), &watch.floor)?;
        Some(Self { calibrated, floor: line(rig, &watch.floor)?, higher: line(rig, &higher)? })
    }

    fn reading(&self, watch: &DriftWatch, rig: &Rig, block: &Block, noise: f64) -> Option<Reading> {
        // Against lines outside the image as well.
        let off = |line: &SlitLine, rig: &Rig| line.rows_off(&rig.camera, block.u, block.v);
        let px_per_m = (off(&self.floor, rig)? - off(&self.higher, rig)?) / Self::STEP_M;
        let bend = off(&self.calibrated, watch.shifts.nominal())? - noise;
        (px_per_m.abs() > 1.0).then_some(Reading { block: *block, bend, noise, px_per_m })
    }
}
