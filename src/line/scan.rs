//! One pass over the rows: where in each column and band of 16 rows the strongest ridge is.
//!
//! The pass takes 32 columns at once, rows in memory order, and keeps what it needs of the rows above in the fastest
//! cache. It comes with two kinds of sums (`Sums`): rounded means in eight bits, which are fast, and exact ones, for
//! images so quiet that the rounding would hide a faint line. Both only say where to look.

use super::lanes::{Aligned, LANES, Lanes, Work, bits, chunk_of, fetch, run};
use super::noise::Bytes;
use super::ridge::{GROUP, GROUPS, Grid};
use crate::image::Image;

/// Chunks of bands that count for the noise: at least so many, spread over the image.
const PLACES: usize = 32;
/// Under this threshold the eight-bit pass is too coarse [4 × levels].
const FINE_BELOW: i16 = 12;
/// In a column, what is this many powers of two weaker than the strongest (to the rounding) is not looked at.
const RIVAL_SHIFT: u32 = 3;
/// Groups that are summed at once.
const STEP: usize = 2;
/// Rows that this takes: their own, and the first one below.
const ROWS: usize = STEP * GROUP + 1;
/// Rows ahead that are fetched.
const AHEAD: usize = 3 * GROUP;
/// Rows ahead of which a page's place in the memory is asked for, and the bytes of a page.
const FAR: usize = 16 * GROUP;
const PAGE: usize = 4096;

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
    #[inline(always)]
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
    #[inline(always)]
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
    /// The latest groups, a ring of `kept`.
    groups: Vec<Group<T>>,
    kept: usize,
    /// The group that is at the ring's beginning.
    first: usize,
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
    ridges: Bytes,
    /// The bands of a chunk that are worth a look, and the columns where, a bit each.
    hits: Vec<(u16, u32)>,
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
    /// Chunks of columns.
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
        self.is_fine = false;
        run(Pass::<Coarse> { image, grid, rows: &mut self.coarse, best: &mut self.best }, is_wide);
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
        self.is_fine = true;
        run(Pass::<Fine> { image, grid, rows: &mut self.fine, best: &mut self.best }, is_wide);
        self.median::<Fine>()
    }

    /// Fills `tops` and `others`: all that reach the limits, and some that do not quite, but none that is eight times
    /// weaker than the strongest of its column.
    pub fn find(&mut self, limits: Limits, is_wide: bool) {
        let least = if self.is_fine { Fine::least(limits.weak) } else { Coarse::least(limits.weak) }.max(1);
        run(Find { scan: self, least }, is_wide);
    }

    /// The median ridge of bands in columns all over the image.
    fn median<S: Sums>(&mut self) -> f32 {
        let Self { best: Best { width, chunks, bands }, ridges, .. } = self;
        ridges.clear();
        let in_band = (PLACES * *chunks).div_ceil(bands.len()).min(*chunks);
        for (number, band) in bands.chunks_exact(*chunks).enumerate() {
            for place in number * in_band..(number + 1) * in_band {
                // The golden ratio spreads the places; no pattern of the image is in step with it.
                let chunk = (((place * 40_503) & 0xFFFF) * *chunks) >> 16;
                let lanes = LANES.min(*width - chunk * LANES);
                ridges.add_half(&band[chunk].ridge.0[..lanes]);
            }
        }
        ridges.median(S::strength)
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
    /// Band after band: sums of its own rows, then the ridges of the band `late` above, whose lower boxes are now known.
    #[inline(always)]
    fn run(self) {
        let Self { image, grid, rows, best } = self;
        let chunks = grid.width.div_ceil(LANES);
        (best.width, best.chunks) = (grid.width, chunks);
        best.bands.resize(grid.bands * chunks, Band::default());
        let late = grid.gap.div_ceil(GROUPS);
        rows.reset::<S>(image, chunks, (2 * late + 1) * GROUPS);
        fetch_pages(image, 0..FAR);
        for band in 0..grid.bands + late {
            if band < grid.bands {
                for step in 0..GROUPS / STEP {
                    rows.sum::<S>(image, grid.height, band * GROUPS + step * STEP);
                }
            }
            if let Some(band) = band.checked_sub(late) {
                rows.compare::<S>(grid, band, &mut best.bands[band * chunks..(band + 1) * chunks]);
            }
        }
    }
}

/// What of the pass is worth a look.
struct Find<'a> {
    scan: &'a mut Scan,
    /// The smallest byte that may reach the limit.
    least: u8,
}

impl Work for Find<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { scan: Scan { best, tops, hits, others, .. }, least } = self;
        others.clear();
        tops.clear();
        hits.resize(best.bands.len() / best.chunks, (0, 0));
        for chunk in 0..best.chunks {
            let bands = || best.bands.chunks_exact(best.chunks).map(|band| &band[chunk]);
            let mut top = [0u8; LANES];
            for Band { ridge, .. } in bands() {
                for i in 0..LANES {
                    top[i] = top[i].max(ridge.0[i]);
                }
            }
            // Beyond the last column all is 0, and `least` is not.
            let mut limit = [0u8; LANES];
            for i in 0..LANES {
                limit[i] = (top[i] >> RIVAL_SHIFT).max(least);
            }
            // Without a branch that no machine could guess.
            let mut count = 0;
            for (number, band) in bands().enumerate() {
                let columns = band.reaches(&limit);
                hits[count] = (number as u16, columns);
                count += usize::from(columns != 0);
            }
            let hits = &hits[..count];
            let band = |number: u16| &best.bands[usize::from(number) * best.chunks + chunk];
            let mut groups = [NOTHING; LANES];
            // Of equals, the upper one: it comes last.
            for (number, _) in hits.iter().rev() {
                band(*number).place(&top, *number, &mut groups);
            }
            for i in 0..LANES {
                groups[i] = if top[i] >= least { groups[i] } else { NOTHING };
            }
            let start = others.len();
            for (number, columns) in hits {
                let mut columns = columns & band(*number).is_far(*number, &groups);
                while columns != 0 {
                    let lane = columns.trailing_zeros() as usize % LANES;
                    columns &= columns - 1;
                    let group = number * GROUPS as u16 + u16::from(band(*number).group.0[lane]);
                    others.push(((chunk * LANES + lane) as u32, group));
                }
            }
            // A few: columns come in order, groups of a column in theirs.
            others[start..].sort_by_key(|(u, _)| *u);
            tops.push(groups);
        }
    }
}

impl Band {
    /// The columns whose ridge does, a bit each.
    #[inline(always)]
    fn reaches(&self, limit: &Lanes<u8>) -> u32 {
        let mut reaches = [0u8; LANES];
        for i in 0..LANES {
            reaches[i] = 0u8.wrapping_sub(u8::from(self.ridge.0[i] >= limit[i]));
        }
        bits(&reaches)
    }

    /// Notes the band and the group in it of each ridge that is the strongest of its column.
    #[inline(always)]
    fn place(&self, top: &Lanes<u8>, number: u16, groups: &mut Lanes<u16>) {
        let (ridge, group) = (&self.ridge.0, &self.group.0);
        let mut new = [0u16; LANES];
        for i in 0..LANES {
            let is = 0u16.wrapping_sub(u16::from(ridge[i] == top[i]));
            new[i] = (groups[i] & !is) | ((number * GROUPS as u16 + u16::from(group[i])) & is);
        }
        *groups = new;
    }

    /// Columns whose group is not the strongest's nor beside it, where it is the flank of that, a bit each.
    #[inline(always)]
    fn is_far(&self, number: u16, strongest: &Lanes<u16>) -> u32 {
        let mut is_far = [0u8; LANES];
        for i in 0..LANES {
            let group = number * GROUPS as u16 + u16::from(self.group.0[i]);
            is_far[i] = 0u8.wrapping_sub(u8::from(group.wrapping_sub(strongest[i]).wrapping_add(1) > 2));
        }
        bits(&is_far)
    }
}

impl<T: Copy + Default + Ord> Rows<T> {
    /// For an image of so many chunks of columns, to keep so many groups.
    #[inline(always)]
    fn reset<S: Sums<Sum = T>>(&mut self, image: &Image, chunks: usize, kept: usize) {
        self.pairs.resize(chunks, Aligned::default());
        self.groups.resize(chunks * kept, Group::default());
        // Beyond the image, its edge goes on.
        for (k, pairs) in self.pairs.iter_mut().enumerate() {
            let edge = chunk_of(image.row(0), k);
            for i in 0..LANES {
                pairs.0[i] = S::add(S::of(edge[i]), S::of(edge[i]));
            }
        }
        (self.kept, self.first) = (kept, 0);
    }

    /// Pair sums, strongest rows and background boxes of `STEP` groups, for all columns.
    #[inline(always)]
    fn sum<S: Sums<Sum = T>>(&mut self, image: &Image, height: usize, group: usize) {
        if group == self.first + self.kept {
            self.first = group;
        }
        let (width, chunks) = (image.width(), self.pairs.len());
        let place = (group - self.first) * chunks;
        let pairs = &mut self.pairs[..chunks];
        let (upper, lower) = self.groups[place..place + STEP * chunks].split_at_mut(chunks);
        let (upper, lower) = (&mut upper[..chunks], &mut lower[..chunks]);
        // Where the width is known, one address serves all rows. These are the most usual ones.
        let v = group * GROUP;
        let is_inside = v + ROWS <= height;
        fetch_pages(image, v + FAR..v + FAR + STEP * GROUP);
        if is_inside
            && (width == 512 && sum_fixed::<S, 16>(image, v, pairs, upper, lower)
                || width == 640 && sum_fixed::<S, 20>(image, v, pairs, upper, lower)
                || width == 1280 && sum_fixed::<S, 40>(image, v, pairs, upper, lower))
        {
            return;
        }
        let whole = width / LANES;
        let row = |i: usize| image.row((v + i).min(height - 1));
        let rows: [&[Lanes<u8>]; ROWS] = std::array::from_fn(|i| &row(i).as_chunks().0[..whole]);
        for k in 0..whole {
            fetch_ahead(image, v * width + k * STEP * GROUP * LANES);
            sum::<S>(std::array::from_fn(|i| &rows[i][k]), &mut pairs[k].0, [&mut upper[k], &mut lower[k]]);
        }
        for k in whole..chunks {
            let rest: [Lanes<u8>; ROWS] = std::array::from_fn(|i| chunk_of(row(i), k));
            sum::<S>(rest.each_ref(), &mut pairs[k].0, [&mut upper[k], &mut lower[k]]);
        }
    }

    /// The strongest ridges of a band, for all columns.
    #[inline(always)]
    fn compare<S: Sums<Sum = T>>(&self, grid: Grid, band: usize, bands: &mut [Band]) {
        let (chunks, group) = (bands.len(), band * GROUPS);
        // Above the image its first group goes on, below it the last. That makes no new ridge there: of equals, the
        // upper one is taken.
        let of = |group: usize| {
            let group = group.min(grid.groups - 1);
            let place = if group < self.first { group + self.kept } else { group } - self.first;
            &self.groups[place * chunks..][..chunks]
        };
        let here: [_; GROUPS] = std::array::from_fn(|i| of(group + i));
        let above: [_; GROUPS] = std::array::from_fn(|i| of((group + i).min(grid.groups - 1).saturating_sub(grid.gap)));
        let below: [_; GROUPS] = std::array::from_fn(|i| of(group + i + grid.gap));
        for k in 0..chunks {
            let ridge = |g: usize, i: usize| {
                let side = above[g][k].side.0[i].max(below[g][k].side.0[i]);
                S::excess(here[g][k].top.0[i], side)
            };
            let (mut largest, mut tags) = ([0u8; LANES], [0u8; LANES]);
            for i in 0..LANES {
                let (a, b, c, d) = (ridge(0, i), ridge(1, i), ridge(2, i), ridge(3, i));
                let (ab, cd) = (a.max(b), c.max(d));
                let top = ab.max(cd);
                // A choice without branches: all ones where it is so.
                let is = |is: bool| 0u8.wrapping_sub(u8::from(is));
                let (in_ab, is_a, is_c) = (is(ab == top), is(a == ab), is(c == cd));
                tags[i] = (!is_a & 1 & in_ab) | (((!is_c & 1) | 2) & !in_ab);
                largest[i] = top;
            }
            bands[k] = Band { ridge: Aligned(largest), group: Aligned(tags) };
        }
    }
}

/// Asks for what will be needed of the image: the machine does not guess that so many rows are read at once.
#[inline(always)]
fn fetch_ahead(image: &Image, from: usize) {
    for line in 0..STEP * GROUP * LANES / 64 {
        fetch(image.levels(), from + line * 64 + AHEAD * image.width());
    }
}

/// Asks for a level of each page of these rows, much earlier: where a page is takes longest to find.
#[inline(always)]
fn fetch_pages(image: &Image, rows: std::ops::Range<usize>) {
    for from in (rows.start * image.width()..rows.end * image.width()).step_by(PAGE) {
        fetch(image.levels(), from);
    }
}

/// `Rows::sum` for images of so many whole chunks; `false` if these are not as many.
#[inline(always)]
fn sum_fixed<S: Sums, const CHUNKS: usize>(
    image: &Image,
    v: usize,
    pairs: &mut [Aligned<S::Sum>],
    upper: &mut [Group<S::Sum>],
    lower: &mut [Group<S::Sum>],
) -> bool {
    let levels = image.levels()[v * CHUNKS * LANES..].as_chunks::<LANES>().0.as_chunks::<CHUNKS>().0;
    let sums =
        (pairs.first_chunk_mut::<CHUNKS>(), upper.first_chunk_mut::<CHUNKS>(), lower.first_chunk_mut::<CHUNKS>());
    let (Some(rows), (Some(pairs), Some(upper), Some(lower))) = (levels.first_chunk::<ROWS>(), sums) else {
        return false;
    };
    for k in 0..CHUNKS {
        fetch_ahead(image, v * CHUNKS * LANES + k * STEP * GROUP * LANES);
        sum::<S>(std::array::from_fn(|i| &rows[i][k]), &mut pairs[k].0, [&mut upper[k], &mut lower[k]]);
    }
    true
}

/// One chunk of `Rows::sum`. No branches: compilers make vectors of it.
#[inline(always)]
fn sum<S: Sums>(rows: [&Lanes<u8>; ROWS], pairs: &mut Lanes<S::Sum>, groups: [&mut Group<S::Sum>; STEP]) {
    let nothing = [S::Sum::default(); LANES];
    let mut last = *pairs;
    for (g, group) in groups.into_iter().enumerate() {
        let (mut next, mut tops, mut sides) = (nothing, nothing, nothing);
        for i in 0..LANES {
            let at = |row: usize| S::of(rows[g * GROUP + row][i]);
            let (a, b, c, d, e) = (at(0), at(1), at(2), at(3), at(4));
            let (ab, bc, cd, de) = (S::add(a, b), S::add(b, c), S::add(c, d), S::add(d, e));
            // The larger of x + y and y + z is y and the larger of x and z.
            tops[i] = S::add(ab, bc.max(last[i])).max(S::add(cd, bc.max(de)));
            sides[i] = S::add(ab, cd);
            next[i] = de;
        }
        (last, group.top.0, group.side.0) = (next, tops, sides);
    }
    *pairs = last;
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
            scan.find(limits, true);
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
                scan.find(Limits { strong: 20, weak: 10 }, is_wide);
                (scan.tops, scan.others)
            });
            assert_eq!(found[0], found[1]);
        }
    }
}
