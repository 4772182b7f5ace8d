//! The strongest ridge of every column with its peak, 32 columns at once: what most columns of most images need.

use super::gauss::{self, Noise, OFFSET_MAX, Sensor, centroid5, gauss5};
use super::lanes::{LANES, Lanes, Work, lanes_at};
use super::ridge::{Found, GROUP, Grid};
use super::scan::{Limits, NOTHING};
use crate::image::Image;

/// Rows looked at beside those of the group.
const MARGIN: usize = gauss::REACH + 1;
/// Rows about a group.
const SIZE: usize = GROUP + 2 * MARGIN;

/// The pixels about one group of rows in each of 32 columns.
struct Window {
    /// From `MARGIN` rows above the group to as many below.
    rows: [Lanes<u8>; SIZE],
    /// The rows of the background boxes.
    above: [Lanes<u8>; GROUP],
    below: [Lanes<u8>; GROUP],
}

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
    fn look(&mut self, image: &Image, u: usize, groups: &Lanes<u16>, grid: &Grid, limits: Limits, look: &Look) {
        let window = Window::read(image, u, groups, grid);
        let mut first = [0u16; LANES];
        for i in 0..LANES {
            first[i] = groups[i].wrapping_mul(GROUP as u16);
        }
        let last = (grid.height - 1) as u16;
        let (five, brightest) = self.place(&window, &first, last);
        // What is no ridge has no strength.
        for i in 0..LANES {
            self.strength[i] = if groups[i] == NOTHING { i16::MIN } else { self.strength[i] };
        }
        let mut is_plain = [0u8; LANES];
        for i in 0..LANES {
            let is_inside = first[i] >= MARGIN as u16 && first[i] <= last.saturating_sub((GROUP + MARGIN - 1) as u16);
            is_plain[i] = u8::from(is_inside & look.is_plain);
        }
        for i in 0..LANES {
            is_plain[i] &= u8::from(five[gauss::REACH][i] < image.white());
        }
        self.solve(&five, &brightest, &is_plain, limits, look);
    }

    /// Row, strength and boxes; the five levels about the brightest pixel of the ridge's row and its two neighbours, and
    /// whether that is 0, 1 or 2 rows down from the first of them. Loops without branches: compilers make vectors of them.
    #[inline(always)]
    fn place(&mut self, window: &Window, first: &Lanes<u16>, row_max: u16) -> ([Lanes<u8>; gauss::SIZE], Lanes<u8>) {
        let Window { rows, above, below } = window;
        let mut in_window = [0u16; LANES];
        for i in 0..LANES {
            let at = |k: usize| u16::from(rows[k][i]);
            let (a, b, c) = (at(MARGIN - 1), at(MARGIN), at(MARGIN + 1));
            let (d, e, f) = (at(MARGIN + 2), at(MARGIN + 3), at(MARGIN + 4));
            let (bc, cd, de) = (b + c, c + d, d + e);
            let sums = [a + b + bc, bc + cd, cd + de, de + e + f];
            // Of equals, the upper one.
            let top = sums[0].max(sums[1]).max(sums[2].max(sums[3]));
            let steps = u16::from(sums[0] < top) * (1 + u16::from(sums[1] < top) * (1 + u16::from(sums[2] < top)));
            let sum = |side: &[Lanes<u8>; GROUP]| {
                u16::from(side[0][i]) + u16::from(side[1][i]) + u16::from(side[2][i]) + u16::from(side[3][i])
            };
            let (upper, lower) = (sum(above), sum(below));
            in_window[i] = steps;
            self.row[i] = (first[i] + steps).min(row_max);
            self.strength[i] = top as i16 - upper.max(lower) as i16;
            self.boxes[i] = upper + lower;
        }
        let mut five = [[0u8; LANES]; gauss::SIZE];
        let mut brightest = [0u8; LANES];
        for i in 0..LANES {
            // The ridge's row is MARGIN + steps; the brightest of it and its two neighbours, of equals the upper one.
            let is = |steps: u16| 0u8.wrapping_sub(u8::from(in_window[i] == steps));
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
        let (offset, variance) = offsets(&level, &background, *look);
        let (mut v, mut sigma, mut is_good) = ([0.0; LANES], [0.0; LANES], [0u8; LANES]);
        for i in 0..LANES {
            v[i] = f32::from(self.row[i]) + (f32::from(brightest[i]) - 1.0) + offset[i];
            sigma[i] = (variance[i] + look.extra).sqrt();
        }
        for i in 0..LANES {
            let is_peak = (level[gauss::REACH][i] > 0.0) & (sigma[i] < f32::INFINITY);
            is_good[i] = u8::from((offset[i].abs() <= OFFSET_MAX) & is_peak) & is_plain[i];
        }
        let (mut is_there, mut is_strong) = ([0u8; LANES], [0u8; LANES]);
        for i in 0..LANES {
            is_there[i] = u8::from(self.strength[i] >= limits.weak);
            is_strong[i] = u8::from(self.strength[i] >= limits.strong);
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
fn offsets(level: &[Lanes<f32>; gauss::SIZE], background: &Lanes<f32>, look: Look) -> (Lanes<f32>, Lanes<f32>) {
    let (mut offset, mut variance) = ([0.0; LANES], [0.0; LANES]);
    let mut is_dim = [0u8; LANES];
    for i in 0..LANES {
        let five = [level[0][i], level[1][i], level[2][i], level[3][i], level[4][i]];
        let noise = Noise { dark: look.sensor.dark(background[i]), shot: look.sensor.shot };
        (offset[i], variance[i]) = gauss5(five, noise);
        is_dim[i] = u8::from(gauss::is_dim(five, look.seen));
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

impl Window {
    /// Reads it row by row, as rows are what lies together in memory.
    #[inline(always)]
    fn read(image: &Image, u: usize, groups: &Lanes<u16>, grid: &Grid) -> Self {
        let mut window = Self { rows: [[0; LANES]; SIZE], above: [[0; LANES]; GROUP], below: [[0; LANES]; GROUP] };
        let mut done = [0u8; LANES];
        // One group after the other, each for all the columns that have it: neighbours mostly have the same.
        for lane in 0..LANES {
            let group = groups[lane];
            if done[lane] != 0 || group == NOTHING {
                continue;
            }
            let mut mask = [0u8; LANES];
            for i in 0..LANES {
                mask[i] = 0u8.wrapping_sub(u8::from(groups[i] == group));
                done[i] |= mask[i];
            }
            let columns = Columns { levels: image.levels(), grid, u, mask };
            let [above, below] = grid.boxes(usize::from(group));
            columns.read(usize::from(group) * GROUP, MARGIN, &mut window.rows);
            columns.read(above, 0, &mut window.above);
            columns.read(below, 0, &mut window.below);
        }
        window
    }
}

/// Some of the columns from `u` on.
struct Columns<'a> {
    levels: &'a [u8],
    grid: &'a Grid,
    u: usize,
    /// All ones in the lanes that are meant.
    mask: Lanes<u8>,
}

impl Columns<'_> {
    /// Adds the rows from `margin` above `v` on to what is 0 so far; beyond the image, its edge goes on.
    #[inline(always)]
    fn read<const N: usize>(&self, v: usize, margin: usize, rows: &mut [Lanes<u8>; N]) {
        let Self { levels, grid, u, mask } = self;
        let is_inside = v >= margin && v - margin + N <= grid.height;
        let levels = &levels[if is_inside { (v - margin) * grid.width + u } else { 0 }..];
        for (k, kept) in rows.iter_mut().enumerate() {
            let from = if is_inside {
                k * grid.width
            } else {
                (v + k).saturating_sub(margin).min(grid.height - 1) * grid.width + u
            };
            let row = lanes_at(levels, from);
            for i in 0..LANES {
                kept[i] |= row[i] & mask[i];
            }
        }
    }
}

/// Looks at the strongest ridges of an image.
pub(super) struct LookAll<'a> {
    pub image: &'a Image,
    pub grid: Grid,
    pub look: Look,
    pub limits: Limits,
    /// The group of each column's.
    pub groups: &'a [Lanes<u16>],
    pub tops: &'a mut [Tops],
}

impl Work for LookAll<'_> {
    #[inline(always)]
    fn run(self) {
        for (chunk, (tops, groups)) in self.tops.iter_mut().zip(self.groups).enumerate() {
            tops.look(self.image, chunk * LANES, groups, &self.grid, self.limits, &self.look);
        }
    }
}
