//! One pass over the rows: where in each column and band of 16 rows the strongest ridge is.
//!
//! The pass takes 32 columns at once, rows in memory order, and keeps what it needs of the rows above in the fastest
//! cache. It comes with two kinds of sums (`Sums`): rounded means in eight bits, which are fast, and exact ones, for
//! images so quiet that the rounding would hide a faint line. Both only say where to look.

use super::lanes::{Aligned, LANES, Lanes, Work, chunk_of, run};
use super::noise::Counts;
use super::ridge::{GROUP, GROUPS, Grid};
use crate::image::Image;

/// Chunks of bands that count for the noise: at least so many, spread over the image.
const PLACES: usize = 32;
/// Under this threshold the eight-bit pass is too coarse [4 × levels].
const FINE_BELOW: i16 = 12;
/// In a column, what is this many powers of two weaker than the strongest (to the rounding) is not looked at.
const RIVAL_SHIFT: u32 = 3;
/// Rows that are fetched ahead: far enough for the memory, near enough for the fastest cache.
const AHEAD: usize = 3 * GROUP;

/// A way to add up levels.
trait Sums {
    /// A level, or a sum of them.
    type Sum: Copy + Default + Ord;
    fn of(level: u8) -> Self::Sum;
    fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum;
    /// How much a ridge exceeds its background, as a byte that grows with it.
    fn excess(top: Self::Sum, background: Self::Sum) -> u8;
    /// The smallest byte that a ridge of `strength` [4 × levels] may have.
    fn least(strength: i16) -> u8;
    /// The strength of a byte, to its rounding.
    fn strength(byte: u8) -> i16;
}

/// Means instead of sums, rounded up: at most a level above the exact ones.
struct Coarse;

impl Sums for Coarse {
    type Sum = u8;
    #[inline(always)]
    fn of(level: u8) -> u8 {
        level
    }
    #[inline(always)]
    fn add(a: u8, b: u8) -> u8 {
        // One instruction on machines that have vectors.
        ((u16::from(a) + u16::from(b) + 1) >> 1) as u8
    }
    #[inline(always)]
    fn excess(top: u8, background: u8) -> u8 {
        top.saturating_sub(background)
    }
    fn least(strength: i16) -> u8 {
        // A ridge of this strength is at least strength/4 − 1, its background being at most a level too bright.
        (strength.max(0) as u16).div_ceil(4).saturating_sub(1).min(255) as u8
    }
    fn strength(byte: u8) -> i16 {
        4 * i16::from(byte)
    }
}

/// Exact sums: four times the levels.
struct Fine;

impl Fine {
    /// Up to this a byte is the ridge itself, above it every sixteenth step counts.
    const KNEE: u16 = 192;
}

impl Sums for Fine {
    type Sum = u16;
    #[inline(always)]
    fn of(level: u8) -> u16 {
        u16::from(level)
    }
    #[inline(always)]
    fn add(a: u16, b: u16) -> u16 {
        a + b
    }
    #[inline(always)]
    fn excess(top: u16, background: u16) -> u8 {
        let ridge = top.saturating_sub(background);
        (ridge.min(Self::KNEE) + (ridge.saturating_sub(Self::KNEE) >> 4)) as u8
    }
    fn least(strength: i16) -> u8 {
        Self::excess(strength.max(0) as u16, 0)
    }
    fn strength(byte: u8) -> i16 {
        let above = i16::from(byte) - Self::KNEE as i16;
        if above > 0 { Self::KNEE as i16 + 16 * above } else { i16::from(byte) }
    }
}

/// What a pass keeps of the rows above, `LANES` columns an entry.
#[derive(Clone, Debug, Default)]
struct Rows<T: Copy + Default> {
    /// Sum of the last row of the group above and the first of this one.
    pairs: Vec<Aligned<T>>,
    /// The latest groups, a ring.
    groups: Vec<Group<T>>,
}

/// A group of rows in `LANES` columns.
#[derive(Clone, Copy, Debug, Default)]
struct Group<T: Copy + Default> {
    /// Its strongest row.
    top: Aligned<T>,
    /// All of it, the background of others.
    side: Aligned<T>,
}

/// No group.
pub(super) const NOTHING: u16 = u16::MAX;

/// From which strengths on a ridge is looked at [4 × levels].
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Limits {
    /// Stands out by itself.
    pub strong: i16,
    /// Counts beside one that does.
    pub weak: i16,
}

/// Where the strongest ridges of one image are; holds the buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Scan {
    coarse: Rows<u8>,
    fine: Rows<u16>,
    best: Best,
    /// Whether that is from exact sums.
    is_fine: bool,
    ridges: Counts,
    /// For the tests: exact sums for every image.
    #[cfg(test)]
    pub always_fine: bool,
    /// The group of the strongest ridge of each column; `NOTHING` where none reaches the limits.
    pub tops: Vec<Lanes<u16>>,
    /// Column and group of the other ridges that may reach the limits; by column, then from the top.
    pub others: Vec<(u32, u16)>,
}

/// The strongest ridges of the bands.
#[derive(Clone, Debug, Default)]
struct Best {
    /// Columns.
    width: usize,
    /// Entries a row of columns.
    chunks: usize,
    /// Bands × chunks.
    bands: Vec<Band>,
}

/// The strongest ridge of a band in each of `LANES` columns.
#[derive(Clone, Copy, Debug, Default)]
struct Band {
    /// As `Sums::excess` has it.
    ridge: Aligned<u8>,
    /// Its group in the band. Of equals, the upper one.
    group: Aligned<u8>,
}

impl Scan {
    /// Looks at every pixel of the image; returns the median of the bands' strongest ridges [4 × levels].
    pub fn scan(&mut self, image: &Image, grid: Grid, is_wide: bool) -> f32 {
        run(Pass::<Coarse> { image, grid, rows: &mut self.coarse, best: &mut self.best }, is_wide);
        self.is_fine = false;
        self.median::<Coarse>()
    }

    /// Whether the rounded sums of `scan` would hide a line that just reaches the limits.
    pub fn is_too_coarse(&self, limits: Limits) -> bool {
        #[cfg(test)]
        if self.always_fine {
            return true;
        }
        limits.weak < FINE_BELOW
    }

    /// The same as `scan` with exact sums.
    pub fn scan_again(&mut self, image: &Image, grid: Grid, is_wide: bool) -> f32 {
        run(Pass::<Fine> { image, grid, rows: &mut self.fine, best: &mut self.best }, is_wide);
        self.is_fine = true;
        self.median::<Fine>()
    }

    /// Fills `tops` and `others`: all that reach the limits, and some that do not quite, but none that is eight times
    /// weaker than the strongest of its column.
    pub fn find(&mut self, grid: Grid, limits: Limits, is_wide: bool) {
        let least = if self.is_fine { Fine::least(limits.weak) } else { Coarse::least(limits.weak) }.max(1);
        run(Find { scan: self, least, width: grid.width }, is_wide);
    }

    /// The median ridge of bands in columns all over the image.
    fn median<S: Sums>(&mut self) -> f32 {
        let Self { best: Best { width, chunks, bands }, ridges, .. } = self;
        ridges.clear();
        let in_band = (PLACES * *chunks).div_ceil(bands.len()).min(*chunks);
        for (place, band) in bands.chunks_exact(*chunks).flat_map(|band| std::iter::repeat_n(band, in_band)).enumerate()
        {
            // The golden ratio spreads the places; no pattern of the image is in step with it.
            let chunk = (((place * 40_503) & 0xFFFF) * *chunks) >> 16;
            let lanes = LANES.min(*width - chunk * LANES);
            for byte in band[chunk].ridge.0[..lanes].iter().step_by(2) {
                ridges.add(S::strength(*byte));
            }
        }
        ridges.median()
    }
}

/// The pass itself, with one kind of sums.
struct Pass<'a, S: Sums> {
    image: &'a Image,
    grid: Grid,
    rows: &'a mut Rows<S::Sum>,
    best: &'a mut Best,
}

impl<S: Sums> Work for Pass<'_, S> {
    /// Group after group: sums of its own rows, then the ridges of the group `gap` above, whose lower box is now known.
    #[inline(always)]
    fn run(self) {
        let Self { image, grid, rows: Rows { pairs, groups }, best } = self;
        let chunks = grid.width.div_ceil(LANES);
        (best.width, best.chunks) = (grid.width, chunks);
        best.bands.clear();
        best.bands.resize(grid.bands * chunks, Band::default());
        pairs.resize(chunks, Aligned::default());
        // Beyond the image, its edge goes on.
        for (k, pairs) in pairs.iter_mut().enumerate() {
            let edge = chunk_of(image.row(0), k);
            for i in 0..LANES {
                pairs.0[i] = S::add(S::of(edge[i]), S::of(edge[i]));
            }
        }
        let places = 2 * grid.gap + 1;
        groups.resize(chunks * places, Group::default());
        let of = |place: usize| place * chunks..(place + 1) * chunks;
        // Where the latest group is in the ring. Counted, as a division would find its way into the innermost loop.
        let mut at = 0;
        for group in 0..grid.groups + grid.gap {
            let is_inside = group < grid.groups;
            if is_inside {
                fetch(image, group * GROUP + AHEAD);
                at = if group == 0 || at + 1 == places { 0 } else { at + 1 };
            }
            let Some(here) = group.checked_sub(grid.gap) else {
                if is_inside {
                    sum_group::<S>(image, grid.height, group, pairs, &mut groups[of(at)], None);
                }
                continue;
            };
            // Beyond the last group, its box goes on, and the ring turns no more: as many steps back as there are left.
            let late = (group + 1).saturating_sub(grid.groups);
            let back = |steps: usize| if at >= steps { at - steps } else { at + places - steps };
            let of_here = back(grid.gap - late);
            let of_above = if here < grid.gap { 0 } else { back(2 * grid.gap - late) };
            let bands = &mut best.bands[of(here / GROUPS)];
            let tag = (here % GROUPS) as u8;
            if !is_inside {
                for k in 0..chunks {
                    let (top, above) = (&groups[of_here * chunks + k].top, &groups[of_above * chunks + k].side);
                    compare::<S>([&top.0, &above.0, &groups[at * chunks + k].side.0], tag, &mut bands[k]);
                }
            } else if of_here == of_above {
                // In the first group its own box is the one above.
                if let Ok([new, top]) = groups.get_disjoint_mut([of(at), of(of_here)]) {
                    let compared = Compared { top, above: top, tag, bands };
                    sum_group::<S>(image, grid.height, group, pairs, new, Some(compared));
                }
            } else if let Ok([new, top, above]) = groups.get_disjoint_mut([of(at), of(of_here), of(of_above)]) {
                let compared = Compared { top, above, tag, bands };
                sum_group::<S>(image, grid.height, group, pairs, new, Some(compared));
            }
        }
    }
}

/// What of the pass is worth a look.
struct Find<'a> {
    scan: &'a mut Scan,
    /// The smallest byte that may reach the limit.
    least: u8,
    width: usize,
}

impl Work for Find<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { scan: Scan { best, tops, others, .. }, least, width } = self;
        others.clear();
        tops.clear();
        for chunk in 0..best.chunks {
            let (top, group) = best.strongest(chunk);
            let (mut limit, mut seen) = ([0u8; LANES], [NOTHING; LANES]);
            for i in 0..LANES {
                limit[i] = (top[i] >> RIVAL_SHIFT).max(least);
            }
            for i in 0..LANES {
                seen[i] = if top[i] >= least { group[i] } else { NOTHING };
            }
            tops.push(seen);
            best.mark(chunk, &limit, &group);
        }
        best.marked(width, others);
        // Beyond the last column there is nothing.
        if let Some(last) = tops.last_mut() {
            let beyond = width % LANES;
            last[if beyond == 0 { LANES } else { beyond }..].fill(NOTHING);
        }
    }
}

impl Best {
    /// The strongest ridge of each column of a chunk, and its group. Of equals, the upper one.
    #[inline(always)]
    fn strongest(&self, chunk: usize) -> (Lanes<u8>, Lanes<u16>) {
        let (mut top, mut bands, mut groups) = ([0u8; LANES], [0u16; LANES], [0u8; LANES]);
        for (band, all) in self.bands.chunks_exact(self.chunks).enumerate() {
            let (ridge, group, band) = (&all[chunk].ridge.0, &all[chunk].group.0, band as u16);
            let (mut larger, mut its_band, mut its_group) = ([0u8; LANES], [0u16; LANES], [0u8; LANES]);
            for i in 0..LANES {
                // All ones where it is larger: a choice without a branch.
                let mask = 0u16.wrapping_sub(u16::from(ridge[i] > top[i]));
                its_band[i] = (bands[i] & !mask) | (band & mask);
            }
            for i in 0..LANES {
                let mask = 0u8.wrapping_sub(u8::from(ridge[i] > top[i]));
                its_group[i] = (groups[i] & !mask) | (group[i] & mask);
                larger[i] = top[i].max(ridge[i]);
            }
            (top, bands, groups) = (larger, its_band, its_group);
        }
        for i in 0..LANES {
            bands[i] = bands[i] * GROUPS as u16 + u16::from(groups[i]);
        }
        (top, bands)
    }

    /// Makes of the ridges of a chunk marks: 1 where one reaches the limit of its column and is neither the strongest nor
    /// its flank in the group beside it.
    #[inline(always)]
    fn mark(&mut self, chunk: usize, limit: &Lanes<u8>, strongest: &Lanes<u16>) {
        for (band, all) in self.bands.chunks_exact_mut(self.chunks).enumerate() {
            let Band { ridge, group } = &mut all[chunk];
            let (ridge, group, first) = (&mut ridge.0, &group.0, (band * GROUPS) as u16);
            let (mut is_far, mut marks) = ([0u8; LANES], [0u8; LANES]);
            for i in 0..LANES {
                is_far[i] = u8::from((first + u16::from(group[i])).abs_diff(strongest[i]) > 1);
            }
            for i in 0..LANES {
                marks[i] = u8::from(ridge[i] >= limit[i]) & is_far[i];
            }
            *ridge = marks;
        }
    }

    /// Column and group of what is marked; by column, then from the top.
    #[inline(always)]
    fn marked(&self, width: usize, others: &mut Vec<(u32, u16)>) {
        for chunk in 0..self.chunks {
            let start = others.len();
            for (band, all) in self.bands.chunks_exact(self.chunks).enumerate() {
                for (eight, marks) in all[chunk].ridge.0.as_chunks::<8>().0.iter().enumerate() {
                    let mut marks = u64::from_le_bytes(*marks);
                    while marks != 0 {
                        let lane = (eight * 8 + marks.trailing_zeros() as usize / 8) % LANES;
                        marks &= marks - 1;
                        let u = chunk * LANES + lane;
                        if u < width {
                            let in_band = all[chunk].group.0[lane];
                            others.push((u as u32, (band * GROUPS) as u16 + u16::from(in_band)));
                        }
                    }
                }
            }
            // A few: columns come in order, groups of a column in theirs.
            others[start..].sort_by_key(|(u, _)| *u);
        }
    }
}

/// Asks for the rows of a group before they are needed: the machine does not guess that five rows are read at once.
#[inline(always)]
fn fetch(image: &Image, v: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let from = (v * image.width()).min(image.levels().len());
        let to = (from + GROUP * image.width()).min(image.levels().len());
        for line in image.levels()[from..to].chunks_exact(64) {
            // SAFETY: a hint that reads nothing and cannot fail, whatever the address; SSE is part of x86_64.
            #[allow(unsafe_code)]
            unsafe {
                _mm_prefetch::<_MM_HINT_T0>(line.as_ptr().cast());
            }
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (image, v);
}

/// The group whose ridges are found while another one, `gap` below it, is summed.
struct Compared<'a, S: Sums> {
    top: &'a [Group<S::Sum>],
    above: &'a [Group<S::Sum>],
    /// Its number in its band.
    tag: u8,
    bands: &'a mut [Band],
}

/// Pair sums, strongest row and background box of a group, for all columns.
#[inline(always)]
fn sum_group<S: Sums>(
    image: &Image,
    height: usize,
    group: usize,
    pairs: &mut [Aligned<S::Sum>],
    sums: &mut [Group<S::Sum>],
    compared: Option<Compared<S>>,
) {
    let (whole, chunks) = (image.width() / LANES, pairs.len());
    let v = group * GROUP;
    let (a, b, c) = (row(image, height, v), row(image, height, v + 1), row(image, height, v + 2));
    let (d, e) = (row(image, height, v + 3), row(image, height, v + 4));
    let mut rest = [[0; LANES]; 5];
    if whole < chunks {
        for (i, rest) in rest.iter_mut().enumerate() {
            *rest = chunk_of(row(image, height, v + i), whole);
        }
    }
    let (a, b, c) = (chunks_of(a, whole), chunks_of(b, whole), chunks_of(c, whole));
    let (d, e) = (chunks_of(d, whole), chunks_of(e, whole));
    let sums = &mut sums[..chunks];
    match compared {
        None => {
            for k in 0..whole {
                sum::<S>([&a[k], &b[k], &c[k], &d[k], &e[k]], &mut pairs[k].0, &mut sums[k]);
            }
            for k in whole..chunks {
                sum::<S>(rest.each_ref(), &mut pairs[k].0, &mut sums[k]);
            }
        }
        Some(Compared { top, above, tag, bands }) => {
            let (top, above, bands) = (&top[..chunks], &above[..chunks], &mut bands[..chunks]);
            for k in 0..whole {
                sum::<S>([&a[k], &b[k], &c[k], &d[k], &e[k]], &mut pairs[k].0, &mut sums[k]);
                compare::<S>([&top[k].top.0, &above[k].side.0, &sums[k].side.0], tag, &mut bands[k]);
            }
            for k in whole..chunks {
                sum::<S>(rest.each_ref(), &mut pairs[k].0, &mut sums[k]);
                compare::<S>([&top[k].top.0, &above[k].side.0, &sums[k].side.0], tag, &mut bands[k]);
            }
        }
    }
}

/// A row; beyond the image, its edge goes on.
#[inline(always)]
fn row(image: &Image, height: usize, v: usize) -> &[u8] {
    image.row(v.min(height - 1))
}

/// The whole chunks of a row.
#[inline(always)]
fn chunks_of(row: &[u8], whole: usize) -> &[Lanes<u8>] {
    &row.as_chunks().0[..whole]
}

/// One chunk of `sum_group`. No branches: compilers make vectors of it.
#[inline(always)]
fn sum<S: Sums>(rows: [&Lanes<u8>; 5], pairs: &mut Lanes<S::Sum>, group: &mut Group<S::Sum>) {
    let [a, b, c, d, e] = rows;
    let nothing = [S::Sum::default(); LANES];
    let (mut next, mut tops, mut sides) = (nothing, nothing, nothing);
    for i in 0..LANES {
        let (a, b, c, d, e) = (S::of(a[i]), S::of(b[i]), S::of(c[i]), S::of(d[i]), S::of(e[i]));
        let (ab, bc, cd, de) = (S::add(a, b), S::add(b, c), S::add(c, d), S::add(d, e));
        tops[i] = S::add(pairs[i], ab).max(S::add(ab, bc)).max(S::add(bc, cd).max(S::add(cd, de)));
        sides[i] = S::add(ab, cd);
        next[i] = de;
    }
    (*pairs, group.top.0, group.side.0) = (next, tops, sides);
}

/// Keeps the ridges of a group where they are larger than those of its band so far.
#[inline(always)]
fn compare<S: Sums>([top, above, below]: [&Lanes<S::Sum>; 3], tag: u8, band: &mut Band) {
    let (best, group) = (&band.ridge.0, &band.group.0);
    let (mut larger, mut tags) = ([0u8; LANES], [0u8; LANES]);
    for i in 0..LANES {
        let ridge = S::excess(top[i], above[i].max(below[i]));
        let mask = 0u8.wrapping_sub(u8::from(ridge > best[i]));
        tags[i] = (group[i] & !mask) | (tag & mask);
        larger[i] = best[i].max(ridge);
    }
    (band.ridge.0, band.group.0) = (larger, tags);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Levels that look like nothing.
    fn pattern(u: usize, v: usize) -> u8 {
        ((u * 7919 + v * 104_729 + u * v * 31) % 251) as u8
    }

    fn image(width: usize, height: usize) -> Image {
        let levels = (0..height).flat_map(|v| (0..width).map(move |u| pattern(u, v))).collect();
        Image::new(width, height, 255, levels).unwrap()
    }

    /// Four times the ridge of each group of a column by its definition, one pixel at a time.
    fn ridges(image: &Image, u: usize, gap: usize) -> Vec<i32> {
        let (height, groups) = (image.height() as isize, image.height().div_ceil(GROUP) as isize);
        let at = |v: isize| i32::from(image.row(v.clamp(0, height - 1) as usize)[u]);
        let side = |g: isize| (0..4).map(|i| at(g.clamp(0, groups - 1) * 4 + i)).sum::<i32>();
        let top = |v: isize| at(v - 1) + 2 * at(v) + at(v + 1);
        let gap = gap as isize;
        (0..groups).map(|g| (g * 4..g * 4 + 4).map(top).max().unwrap() - side(g - gap).max(side(g + gap))).collect()
    }

    const SIZES: [(usize, usize); 8] = [(37, 100), (8, 16), (3, 7), (1, 1), (19, 482), (64, 64), (33, 130), (96, 9)];

    #[test]
    fn every_band_holds_its_strongest_ridge_as_well_as_its_sums_allow() {
        for ((width, height), gap) in SIZES.into_iter().flat_map(|size| [(size, 1), (size, 2), (size, 5)]) {
            let image = image(width, height);
            let grid = Grid::new(&image, gap);
            let mut scan = Scan::default();
            scan.scan(&image, grid, true);
            let coarse = scan.best.clone();
            scan.scan_again(&image, grid, true);
            for u in 0..width {
                let ridges = ridges(&image, u, gap);
                for (band, ridges) in ridges.chunks(GROUPS).enumerate() {
                    let (at, lane) = (band * grid.width.div_ceil(LANES) + u / LANES, u % LANES);
                    let strongest = ridges.iter().copied().max().unwrap().max(0);
                    let fine = scan.best.bands[at].ridge.0[lane];
                    assert_eq!(fine, Fine::excess(strongest as u16, 0), "{width} x {height}: {u} {band}");
                    if fine > 0 {
                        let found = ridges[usize::from(scan.best.bands[at].group.0[lane])];
                        assert_eq!(Fine::excess(found as u16, 0), fine);
                    }
                    // Rounded: off by a level at most.
                    let rounded = i32::from(coarse.bands[at].ridge.0[lane]);
                    assert!((4 * rounded - strongest).abs() <= 4, "{width} x {height}: {u} {band}");
                    if rounded > 0 {
                        assert!(strongest - ridges[usize::from(coarse.bands[at].group.0[lane])] <= 8);
                    }
                }
            }
        }
    }

    #[test]
    fn what_reaches_the_limit_is_found_but_for_trifles_and_flanks() {
        for (width, height) in SIZES {
            let image = image(width, height);
            let grid = Grid::new(&image, 2);
            let limits = Limits { strong: 300, weak: 300 };
            let mut scan = Scan::default();
            scan.scan(&image, grid, true);
            scan.find(grid, limits, true);
            for u in 0..width {
                let ridges = ridges(&image, u, 2);
                let band_best = |g: usize| *ridges[g / 4 * 4..(g / 4 * 4 + 4).min(ridges.len())].iter().max().unwrap();
                let top = scan.tops[u / LANES][u % LANES];
                let strongest = ridges.iter().copied().max().unwrap();
                assert!(top != NOTHING || strongest < 300, "{width} x {height}: {u}");
                for (g, ridge) in ridges.iter().enumerate() {
                    // Two levels over the limit and over every other of its band, it must be there.
                    let is_clear =
                        ridges[g / 4 * 4..(g / 4 * 4 + 4).min(ridges.len())].iter().filter(|r| **r > ridge - 8).count()
                            == 1;
                    if *ridge == band_best(g) && is_clear && *ridge >= 308 && top.abs_diff(g as u16) > 1 {
                        assert!(scan.others.contains(&(u as u32, g as u16)), "{width} x {height}: {u} {g}");
                    }
                }
            }
            assert!(scan.others.is_sorted_by_key(|(u, _)| *u));
        }
    }

    #[test]
    fn narrow_vectors_find_the_same() {
        for (width, height) in SIZES {
            let image = image(width, height);
            let grid = Grid::new(&image, 2);
            let found = [true, false].map(|is_wide| {
                let mut scan = Scan::default();
                scan.scan_again(&image, grid, is_wide);
                scan.find(grid, Limits { strong: 20, weak: 10 }, is_wide);
                (scan.tops, scan.others)
            });
            assert_eq!(found[0], found[1]);
        }
    }
}
