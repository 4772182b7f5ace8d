//! The strongest ridge of every column with its peak, 32 columns at once: what most columns of most images need.

use super::gauss::{self, Noise, OFFSET_MAX, Sensor, centroid5};
use super::lanes::{LANES, Lanes, Work, bits, lanes_at};
use super::ridge::{Found, GROUP, Grid};
use super::scan::{Limits, NOTHING};
use crate::image::Image;

/// Rows looked at beside those of the group.
const MARGIN: usize = gauss::REACH + 1;
/// Rows about a group.
const SIZE: usize = GROUP + 2 * MARGIN;
/// Groups that are read at once.
const SPAN: usize = 16;

/// The tops of 32 columns.
#[derive(Clone, Debug)]
pub(super) struct Tops {
    row: Lanes<u16>,
    strength: Lanes<i16>,
    boxes: Lanes<u16>,
    /// Row of the peak [px]; no number where there is none, or none without further ado.
    pub v: Lanes<f32>,
    /// Its standard deviation [px].
    pub sigma: Lanes<f32>,
    /// Level over the background.
    pub level: Lanes<f32>,
    /// 1 where there is a ridge that stands out by itself.
    pub is_strong: Lanes<u8>,
    /// 1 where a ridge is no plain peak: saturated, at the edge of the image, or not in the middle of its window.
    pub is_special: Lanes<u8>,
}

impl Default for Tops {
    fn default() -> Self {
        Self {
            row: [0; LANES],
            strength: [0; LANES],
            boxes: [0; LANES],
            v: [0.0; LANES],
            sigma: [0.0; LANES],
            level: [0.0; LANES],
            is_strong: [0; LANES],
            is_special: [0; LANES],
        }
    }
}

/// What the tops of an image have in common.
#[derive(Clone, Copy, Debug)]
pub(super) struct Look {
    /// Noise of the pixels.
    pub sensor: Sensor,
    /// What is not brighter than this is too dark for a logarithm [levels].
    pub seen: f32,
    /// Variance added to that of each peak [px²].
    pub extra: f32,
    /// Whether plain peaks are wanted: the default estimator, and an image whose background has its own noise.
    pub is_plain: bool,
}

impl Tops {
    /// The ridge in a lane; `None` if it is weaker than asked.
    #[inline(always)]
    pub fn found(&self, lane: usize, limits: Limits) -> Option<Found> {
        let found = Found { strength: self.strength[lane], row: self.row[lane], boxes: self.boxes[lane] };
        (found.strength >= limits.weak).then_some(found)
    }

    /// Looks at a group of rows in each of the columns from `u` on.
    #[inline(always)]
    fn look(&mut self, scene: &Scene, u: usize, groups: &Lanes<u16>, window: &mut Window) {
        let Scene { image, grid, look, limits } = scene;
        // Where the window would reach beyond the image, columns are looked at one by one.
        let (first, last) = (grid.gap as u16, (grid.height / GROUP) as i32 - 1 - grid.gap as i32);
        let mut inside = [NOTHING; LANES];
        for i in 0..LANES {
            let is_inside = (groups[i] >= first) & (i32::from(groups[i]) <= last);
            inside[i] = if is_inside { groups[i] } else { NOTHING };
        }
        window.read(image, u, &inside, grid);
        let (five, brightest) = self.place(window, &inside, grid.gap);
        let (mut is_plain, mut is_edge) = ([0u8; LANES], [0u8; LANES]);
        for i in 0..LANES {
            is_plain[i] = u8::from((inside[i] != NOTHING) & (five[gauss::REACH][i] < image.white()) & look.is_plain);
            is_edge[i] = u8::from(inside[i] != groups[i]);
        }
        if is_edge != [0; LANES] {
            for i in (0..LANES).filter(|i| is_edge[*i] != 0) {
                let Found { strength, row, boxes } = grid.exact(image, u + i, usize::from(groups[i]));
                (self.strength[i], self.row[i], self.boxes[i]) = (strength, row, boxes);
            }
        }
        self.solve(&five, &brightest, &is_plain, *limits, look);
    }

    /// Row, strength and boxes; the five levels about the brightest pixel of the ridge's row and its two neighbours, and
    /// whether that is 0, 1 or 2 rows down from the first of them. Loops without branches: compilers make vectors of them.
    #[inline(always)]
    fn place(&mut self, window: &Window, groups: &Lanes<u16>, gap: usize) -> ([Lanes<u8>; gauss::SIZE], Lanes<u8>) {
        let all = window.rows[..2 * gap + 1].as_flattened();
        let (above, below) = (&all[..GROUP], &all[2 * gap * GROUP..][..GROUP]);
        let rows = &all[gap * GROUP - MARGIN..][..SIZE];
        let mut in_window = [0u8; LANES];
        for i in 0..LANES {
            let at = |k: usize| u16::from(rows[k][i]);
            let (a, b, c) = (at(MARGIN - 1), at(MARGIN), at(MARGIN + 1));
            let (d, e, f) = (at(MARGIN + 2), at(MARGIN + 3), at(MARGIN + 4));
            let (bc, cd, de) = (b + c, c + d, d + e);
            let sums = [a + b + bc, bc + cd, cd + de, de + e + f];
            // Of equals, the upper one.
            let top = sums[0].max(sums[1]).max(sums[2].max(sums[3]));
            let steps = u16::from(sums[0] < top) * (1 + u16::from(sums[1] < top) * (1 + u16::from(sums[2] < top)));
            let sum = |side: &[Lanes<u8>]| {
                u16::from(side[0][i]) + u16::from(side[1][i]) + u16::from(side[2][i]) + u16::from(side[3][i])
            };
            let (upper, lower) = (sum(above), sum(below));
            in_window[i] = steps as u8;
            self.row[i] = groups[i].wrapping_mul(GROUP as u16) + steps;
            // What is no ridge has no strength.
            self.strength[i] = if groups[i] == NOTHING { i16::MIN } else { top as i16 - upper.max(lower) as i16 };
            self.boxes[i] = upper + lower;
        }
        let mut five = [[0u8; LANES]; gauss::SIZE];
        let mut brightest = [0u8; LANES];
        for i in 0..LANES {
            // The ridge's row is MARGIN + steps; the brightest of it and its two neighbours, of equals the upper one.
            let is = |steps: u8| 0u8.wrapping_sub(u8::from(in_window[i] == steps));
            let (is0, is1, is2, is3) = (is(0), is(1), is(2), is(3));
            let pick = |k: usize| {
                (rows[k][i] & is0) | (rows[k + 1][i] & is1) | (rows[k + 2][i] & is2) | (rows[k + 3][i] & is3)
            };
            let (over, here, under) = (pick(MARGIN - 1), pick(MARGIN), pick(MARGIN + 1));
            let most = over.max(here).max(under);
            let is_over = 0u8.wrapping_sub(u8::from(over == most));
            let is_here = 0u8.wrapping_sub(u8::from(here == most)) & !is_over;
            let is_under = !(is_over | is_here);
            let (outer, inner) = (pick(MARGIN - 3), pick(MARGIN - 2));
            let (next, end) = (pick(MARGIN + 2), pick(MARGIN + 3));
            let of = |a: u8, b: u8, c: u8| (a & is_over) | (b & is_here) | (c & is_under);
            five[0][i] = of(outer, inner, over);
            five[1][i] = of(inner, over, here);
            five[2][i] = most;
            five[3][i] = of(here, under, next);
            five[4][i] = of(under, next, end);
            // 0, 1 or 2 rows down from the one above the ridge's.
            brightest[i] = (is_here & 1) | (is_under & 2);
        }
        (five, brightest)
    }

    /// The peaks.
    #[inline(always)]
    fn solve(
        &mut self,
        five: &[Lanes<u8>; gauss::SIZE],
        brightest: &Lanes<u8>,
        is_plain: &Lanes<u8>,
        limits: Limits,
        look: &Look,
    ) {
        let (mut level, mut background) = ([[0.0f32; LANES]; gauss::SIZE], [0.0f32; LANES]);
        for i in 0..LANES {
            background[i] = f32::from(self.boxes[i]) / (2 * GROUP) as f32;
        }
        for (level, five) in level.iter_mut().zip(five) {
            for i in 0..LANES {
                level[i] = f32::from(five[i]) - background[i];
            }
        }
        let (mut is_there, mut is_strong) = ([0u8; LANES], [0u8; LANES]);
        for i in 0..LANES {
            is_there[i] = u8::from(self.strength[i] >= limits.weak);
            is_strong[i] = u8::from(self.strength[i] >= limits.strong);
        }
        let (offset, variance) = offsets(&level, &background, &is_there, *look);
        let (mut v, mut sigma, mut is_good) = ([0.0; LANES], [0.0; LANES], [0u8; LANES]);
        for i in 0..LANES {
            v[i] = f32::from(self.row[i]) + (f32::from(brightest[i]) - 1.0) + offset[i];
            sigma[i] = (variance[i] + look.extra).sqrt();
        }
        for i in 0..LANES {
            let is_peak = (level[gauss::REACH][i] > 0.0) & (sigma[i] < f32::INFINITY);
            is_good[i] = u8::from((offset[i].abs() <= OFFSET_MAX) & is_peak) & is_plain[i];
        }
        for i in 0..LANES {
            self.is_special[i] = is_there[i] & (is_good[i] ^ 1);
        }
        for i in 0..LANES {
            v[i] = if is_there[i] & is_good[i] != 0 { v[i] } else { f32::NAN };
        }
        (self.v, self.sigma, self.level, self.is_strong) = (v, sigma, level[gauss::REACH], is_strong);
    }
}

/// Offset of each peak from the middle of its five levels [px], and its variance [px²].
#[inline(always)]
fn offsets(
    level: &[Lanes<f32>; gauss::SIZE],
    background: &Lanes<f32>,
    is_there: &Lanes<u8>,
    look: Look,
) -> (Lanes<f32>, Lanes<f32>) {
    let (mut offset, mut variance) = ([0.0; LANES], [0.0; LANES]);
    let mut is_dim = [0u8; LANES];
    let (mut scale, mut ratio, mut logs) = ([0.0; LANES], [[0.0; LANES]; 4], [[0.0; LANES]; 4]);
    for i in 0..LANES {
        let five = [level[0][i], level[1][i], level[2][i], level[3][i], level[4][i]];
        scale[i] = 1.0 / five[gauss::REACH];
        [ratio[0][i], ratio[1][i], ratio[2][i], ratio[3][i]] = gauss::ratios(five, scale[i]);
    }
    for (logs, ratio) in logs.iter_mut().zip(&ratio) {
        for i in 0..LANES {
            logs[i] = gauss::ln(ratio[i]);
        }
    }
    for i in 0..LANES {
        let five = [level[0][i], level[1][i], level[2][i], level[3][i], level[4][i]];
        let noise = Noise { dark: look.sensor.dark(background[i]), shot: look.sensor.shot };
        let of = |rows: &[Lanes<f32>; 4]| [rows[0][i], rows[1][i], rows[2][i], rows[3][i]];
        (offset[i], variance[i]) = gauss::fit(scale[i], of(&ratio), of(&logs), noise);
        is_dim[i] = u8::from(gauss::is_dim(five, look.seen)) & is_there[i];
    }
    if is_dim != [0; LANES] {
        for i in 0..LANES {
            let five = [level[0][i], level[1][i], level[2][i], level[3][i], level[4][i]];
            let noise = Noise { dark: look.sensor.dark(background[i]), shot: look.sensor.shot };
            let centroid = centroid5(five, noise);
            offset[i] = if is_dim[i] != 0 { centroid.0 } else { offset[i] };
            variance[i] = if is_dim[i] != 0 { centroid.1 } else { variance[i] };
        }
    }
    (offset, variance)
}

/// A group's rows of 32 columns.
type Rows = [Lanes<u8>; GROUP];

/// Rows from the upper background box to the lower one, another group's in each of 32 columns.
#[derive(Clone, Debug, Default)]
pub(super) struct Window {
    rows: Vec<Rows>,
    /// The rows of several groups.
    seen: Vec<Rows>,
}

impl Window {
    /// Reads it. Rows are what lies together in memory, and neighbours mostly have groups near each other: from the
    /// uppermost group on, all rows are read that any column needs, and then each column is moved up to its own, by powers
    /// of two.
    #[inline(always)]
    fn read(&mut self, image: &Image, u: usize, groups: &Lanes<u16>, grid: &Grid) {
        let size = 2 * grid.gap + 1;
        let Self { rows, seen } = self;
        for rows in [&mut *rows, &mut *seen] {
            rows.resize(size + SPAN - 1, Rows::default());
        }
        let (mut left, mut is_first) = (*groups, true);
        loop {
            let mut first = NOTHING;
            for i in 0..LANES {
                first = first.min(left[i]);
            }
            if first == NOTHING {
                return;
            }
            let (mut steps, mut mask, mut more) = ([0u8; LANES], [0u8; LANES], [0u8; LANES]);
            for i in 0..LANES {
                let is_near = left[i] - first < SPAN as u16;
                mask[i] = 0u8.wrapping_sub(u8::from(is_near));
                steps[i] = (left[i] - first) as u8 & mask[i];
                left[i] = if is_near { NOTHING } else { left[i] };
                more[i] = 0u8.wrapping_sub(u8::from(left[i] != NOTHING));
            }
            let mut deepest = 0;
            for i in 0..LANES {
                deepest = deepest.max(steps[i]);
            }
            let from = (usize::from(first) - grid.gap) * GROUP * grid.width + u;
            fill(&mut seen[..size + usize::from(deepest)], &image.levels()[from..], grid.width);
            for bit in [8, 4, 2, 1] {
                if deepest >= bit {
                    move_up(&mut seen[..size + 2 * usize::from(bit) - 1], &steps, bit);
                }
            }
            if is_first && bits(&more) == 0 {
                std::mem::swap(rows, seen);
                return;
            }
            is_first = false;
            for (row, seen) in rows[..size].as_flattened_mut().iter_mut().zip(seen.as_flattened()) {
                for i in 0..LANES {
                    row[i] = (row[i] & !mask[i]) | (seen[i] & mask[i]);
                }
            }
        }
    }
}

/// Moves the columns whose `steps` have this bit up by so many groups.
#[inline(always)]
fn move_up(groups: &mut [Rows], steps: &Lanes<u8>, bit: u8) {
    let mut moves = [0u8; LANES];
    for i in 0..LANES {
        moves[i] = 0u8.wrapping_sub(u8::from(steps[i] & bit != 0));
    }
    let by = usize::from(bit);
    for g in 0..groups.len() - by {
        let below = groups[g + by];
        for (here, below) in groups[g].iter_mut().zip(&below) {
            for i in 0..LANES {
                here[i] = (here[i] & !moves[i]) | (below[i] & moves[i]);
            }
        }
    }
}

/// Reads groups of rows of an image from the first of its levels on.
#[inline(always)]
fn fill(groups: &mut [Rows], levels: &[u8], width: usize) {
    let rows = groups.as_flattened_mut();
    if (rows.len() - 1) * width + LANES <= levels.len() {
        for (k, row) in rows.iter_mut().enumerate() {
            row.copy_from_slice(&levels[k * width..][..LANES]);
        }
    } else {
        for (k, row) in rows.iter_mut().enumerate() {
            *row = lanes_at(levels, k * width);
        }
    }
}

/// What is looked at, and for what.
#[derive(Clone, Copy)]
pub(super) struct Scene<'a> {
    pub image: &'a Image,
    pub grid: Grid,
    pub look: Look,
    pub limits: Limits,
}

/// Looks at the strongest ridges of an image.
pub(super) struct LookAll<'a> {
    pub scene: Scene<'a>,
    /// The group of each column's.
    pub groups: &'a [Lanes<u16>],
    pub tops: &'a mut [Tops],
    pub window: &'a mut Window,
}

impl Work for LookAll<'_> {
    #[inline(always)]
    fn run(self) {
        for (chunk, (tops, groups)) in self.tops.iter_mut().zip(self.groups).enumerate() {
            tops.look(&self.scene, chunk * LANES, groups, self.window);
        }
    }
}
