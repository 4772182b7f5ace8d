//! Image → Line: the paper's five steps (2.3), with sub-pixel rows and thresholds that come from the image's own noise.
//!
//! Steps (1) and (2) are the `Image`. The rest, for every image:
//!
//! 1. `scan`: one pass over the rows gives, for each column and each band of 16 rows, the strongest *ridge*: how much
//!    four pixels' worth of light, `I(v−1) + 2·I(v) + I(v+1)`, exceed the brighter of two boxes of four rows above and
//!    below (`ridge`). What is as bright above or below as it is itself (a wall, a step, a lamp's glow) has none. Step (3).
//!    The pass rounds to whole levels; where the image is so quiet that this would hide a faint line, it is made again
//!    with exact sums. The median ridge of all bands is noise, since the line fills few of them (`noise`).
//! 2. `tops`: the exact strength of each column's strongest ridge and, of a plain stripe, its peak, 32 columns at once.
//! 3. `choose`: ridges above a multiple of the noise are candidates, at most four a column, none eight times weaker than
//!    the strongest. One path through them, from left to right, has the largest sum of strengths minus jumps: a false
//!    line or a bright object wins a column only if it is also where its neighbours are. (`LineParams::keep` has other
//!    rules.) Rows are not changed by this, only chosen: nothing is smoothed along the line.
//! 4. `peak`, `gauss`, `fit`: the row of the chosen ridge to a fraction of a pixel from its own column alone, and its σ.
//!    A mixed peak at an edge says so in its σ.
//! 5. The distance test, step (4): a peak stays if one of its neighbours is near.
//!
//! Loops over many columns are compiled twice, for AVX2 and for any machine, and chosen between at run time (`lanes`); both
//! give the same bits. A line in the first or last four rows has no background on its outer side and is not found. Two
//! ridges in one band, or in neighbouring groups of four rows, count as one.
//!
//! How near the estimators are to the Cramér–Rao bound (stripes of 0.5 to 1.2 px, peaks of 25 to 110 of 127 levels, no
//! speckle; tests in `peak`): `Estimator::Auto` and `Estimator::FullFit` both within 1.1 of it, their σ right to 6 %.

mod choose;
mod fit;
#[allow(clippy::needless_range_loop)] // Lanes of several arrays, side by side.
mod gauss;
mod lanes;
mod noise;
mod peak;
mod ridge;
#[allow(clippy::needless_range_loop)] // Lanes of several arrays, side by side.
mod scan;
#[allow(clippy::needless_range_loop)] // Lanes of several arrays, side by side.
mod tops;
mod view;

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within, positive};
use crate::image::{Drop, Image, Line, Peak};

pub use peak::Estimator;

use choose::{Chooser, find_isolated};
use lanes::{LANES, run};
use ridge::{Found, Grid};
use scan::{Limits, Scan};
use tops::{LookAll, Tops};
use view::View;

/// Which of several peaks in a column is the line's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Keep {
    /// The one that lies where the line of the neighbouring columns goes on.
    #[default]
    Path,
    /// The strongest ridge.
    Brightest,
    /// The highest in the image: with a camera above the sheet, the farthest.
    Topmost,
    /// The lowest in the image: with a camera above the sheet, the nearest.
    Lowest,
}

/// What the extraction is free to choose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LineParams {
    /// How the row is found to a fraction of a pixel.
    pub estimator: Estimator,
    /// Which of several peaks in a column is taken.
    pub keep: Keep,
    /// How far from the line the background is taken, above and below [px]: a multiple of 4, at least the stripe's full
    /// width. A stripe wider than this is not found.
    pub background_px: usize,
    /// A line stands out by this many times the median ridge of the image. 3.1 is about ten times the noise of a pixel:
    /// on noise alone, one column in a hundred has such a ridge, and one in ten thousand passes the distance test.
    pub ridge_min: f32,
    /// A weaker one, down to this many, is taken if it runs on from one that stands out.
    pub ridge_min_beside: f32,
    /// And by at least this level, however dark and quiet the image is [levels]. Where an even background lies between two
    /// levels, pixels flip from one to the other: what they make is no ridge of more than one level, even where most of the
    /// image does not flip and its median ridge is none.
    pub level_min: f32,
    /// ε₁: a peak is kept if it is nearer than this to the one in the column before it [px].
    pub epsilon1_px: f32,
    /// ε₂: or nearer than this to the one in the column after it [px].
    pub epsilon2_px: f32,
    /// Runs of near peaks shorter than this are dropped; 2 is the paper's test [columns].
    pub run_columns_min: usize,
    /// What a jump of one row costs the path, in strengths of the median line.
    pub jump_cost_per_px: f32,
    /// What the longest jump costs: the path leaves the line of its neighbours for something stronger than this.
    pub jump_cost_max: f32,
    /// Electrons that fill a pixel, for the shot noise in σ [A].
    pub well_electrons: f32,
    /// Read noise, for σ where the image shows less [electrons, A].
    pub read_electrons: f32,
    /// The smallest σ given to a peak [px], added in quadrature: speckle that no single image shows [A].
    pub sigma_min_px: f32,
}

impl Default for LineParams {
    fn default() -> Self {
        Self {
            estimator: Estimator::Auto,
            keep: Keep::Path,
            background_px: 8,
            ridge_min: 3.1,
            ridge_min_beside: 2.5,
            level_min: 1.0,
            epsilon1_px: 5.0,
            epsilon2_px: 5.0,
            run_columns_min: 3,
            jump_cost_per_px: 0.1,
            jump_cost_max: 2.0,
            well_electrons: 1e5,
            read_electrons: 60.0,
            sigma_min_px: 0.05,
        }
    }
}

impl LineParams {
    /// Refuses numbers that make no extraction.
    pub fn validated(self) -> Result<Self> {
        if !(4..=64).contains(&self.background_px) || !self.background_px.is_multiple_of(4) {
            return Err(Fault::new("line.background_px", self.background_px, "a multiple of 4 from 4 to 64"));
        }
        number_within("line.ridge_min", f64::from(self.ridge_min), 1.0, 100.0)?;
        number_within("line.ridge_min_beside", f64::from(self.ridge_min_beside), 0.5, f64::from(self.ridge_min))?;
        number_within("line.level_min", f64::from(self.level_min), 0.0, 255.0)?;
        positive("line.epsilon1_px", f64::from(self.epsilon1_px))?;
        positive("line.epsilon2_px", f64::from(self.epsilon2_px))?;
        if !(1..=1000).contains(&self.run_columns_min) {
            return Err(Fault::new("line.run_columns_min", self.run_columns_min, "1 to 1000"));
        }
        number_within("line.jump_cost_per_px", f64::from(self.jump_cost_per_px), 0.0, 100.0)?;
        number_within("line.jump_cost_max", f64::from(self.jump_cost_max), 0.0, 100.0)?;
        positive("line.well_electrons", f64::from(self.well_electrons))?;
        number_within("line.read_electrons", f64::from(self.read_electrons), 0.0, f64::from(self.well_electrons))?;
        number_within("line.sigma_min_px", f64::from(self.sigma_min_px), 0.0, 10.0)?;
        Ok(self)
    }
}

/// Finds the line in one image after the other. Its buffers grow to the largest image and are used again.
#[derive(Clone, Debug)]
pub struct Extractor {
    params: LineParams,
    /// Whether wide vectors may be used where the machine has them.
    is_wide: bool,
    scan: Scan,
    tops: Vec<Tops>,
    chooser: Chooser,
    /// Rows of the peaks; no number where there is none.
    rows: Vec<f32>,
    /// 1 where a ridge stands out by itself.
    is_strong: Vec<u8>,
    isolated: Vec<usize>,
    /// The image less the one taken with the laser off.
    difference: Vec<u8>,
}

impl Extractor {
    /// An error if the parameters make no extraction.
    pub fn new(params: LineParams) -> Result<Self> {
        Ok(Self {
            params: params.validated()?,
            is_wide: true,
            scan: Scan::default(),
            tops: Vec::new(),
            chooser: Chooser::default(),
            rows: Vec::new(),
            is_strong: Vec::new(),
            isolated: Vec::new(),
            difference: Vec::new(),
        })
    }

    /// The line in `image`, at most one peak a column, and why the other columns have none. Depends on this image and
    /// the parameters only.
    pub fn extract(&mut self, image: &Image) -> Line {
        let mut line = Line::empty();
        self.extract_into(image, &mut line);
        line
    }

    /// The same into a line that was used before, whose memory is used again.
    pub fn extract_into(&mut self, image: &Image, line: &mut Line) {
        self.find(&View::plain(image, &self.params), line);
    }

    /// The line in what `image` shows more than `off`, an image of the same scene with the laser off: walls, lamps and
    /// windows are gone, the noise of both images is in σ. Levels are over `off`. An error if the sizes differ.
    pub fn extract_above(&mut self, image: &Image, off: &Image) -> Result<Line> {
        self.with_view(image, Some(off), |extractor, view| {
            let mut line = Line::empty();
            extractor.find(view, &mut line);
            line
        })
    }

    /// The line, and beside it, a list a column, the other peaks that stand out by themselves, strongest first: at most
    /// three, none eight times weaker than the strongest. `off` as for `extract_above`.
    pub fn extract_all(&mut self, image: &Image, off: Option<&Image>) -> Result<(Line, Vec<Vec<Peak>>)> {
        self.with_view(image, off, |extractor, view| {
            let mut line = Line::empty();
            let (noise, limits) = extractor.find(view, &mut line);
            let mut rivals = vec![Vec::new(); line.width()];
            for column in &extractor.chooser.contested {
                let peak =
                    |found: Found| view.column(column.u, found, noise).peak(usize::from(found.row), &extractor.params);
                rivals[column.u].extend(column.rivals(limits).filter_map(peak));
            }
            (line, rivals)
        })
    }

    /// Does something with an image, or with what it shows more than another.
    fn with_view<R>(
        &mut self,
        image: &Image,
        off: Option<&Image>,
        work: impl FnOnce(&mut Self, &View) -> R,
    ) -> Result<R> {
        let Some(off) = off else {
            let view = View::plain(image, &self.params);
            return Ok(work(self, &view));
        };
        let difference = view::difference(image, off, std::mem::take(&mut self.difference))?;
        let view = View::above(&difference, off, image.white(), &self.params);
        let result = work(self, &view);
        self.difference = difference.into_levels();
        Ok(result)
    }

    /// Ridges, path, peaks, distance test; returns the noise of a pixel [levels] and what a ridge had to have.
    fn find(&mut self, view: &View, line: &mut Line) -> (f32, Limits) {
        let Self { params, is_wide, scan, tops, chooser, .. } = self;
        let (image, is_wide) = (view.image, *is_wide);
        let grid = Grid::new(image, params.background_px / 4);
        let mut median = scan.scan(image, grid, is_wide);
        if scan.is_too_coarse(choose::limits(median, params)) {
            median = scan.scan_again(image, grid, is_wide);
        }
        let (noise, limits) = (noise::of_pixel(median), choose::limits(median, params));
        scan.find(grid, limits, is_wide);
        tops.resize(scan.tops.len(), Tops::default());
        run(LookAll { image, grid, look: view.look(noise), limits, groups: &scan.tops, tops }, is_wide);
        let top = |u: usize| tops[u / LANES].found(u % LANES, limits);
        let other = |(u, group): &(u32, u16)| {
            let (u, group) = (*u as usize, usize::from(*group));
            (u, grid.exact(image, u, group))
        };
        chooser.collect(scan.others.iter().map(other), top, limits);
        chooser.choose(image.width(), top, limits, params);
        self.finish(view, noise, limits);
        self.reject(image, line);
        (noise, limits)
    }

    /// The peaks that are not plain ones, and those of other ridges than the strongest.
    fn finish(&mut self, view: &View, noise: f32, limits: Limits) {
        let Self { params, tops, chooser, .. } = self;
        let set = |tops: &mut Tops, u: usize, found: Found| {
            let peak = view.column(u, found, noise).peak(usize::from(found.row), params);
            let lane = u % LANES;
            tops.v[lane] = peak.map_or(f32::NAN, |peak| peak.v);
            (tops.sigma[lane], tops.level[lane]) = peak.map_or((0.0, 0.0), |peak| (peak.sigma, peak.level));
            tops.is_strong[lane] = u8::from(found.strength >= limits.strong);
        };
        for (chunk, tops) in tops.iter_mut().enumerate() {
            for eight in (0..LANES).step_by(8) {
                if tops.is_special[eight..eight + 8] == [0; 8] {
                    continue;
                }
                for lane in eight..eight + 8 {
                    if let Some(found) = tops.found(lane, limits).filter(|_| tops.is_special[lane] != 0) {
                        set(tops, chunk * LANES + lane, found);
                    }
                }
            }
        }
        for column in &chooser.contested {
            let tops = &mut tops[column.u / LANES];
            let chosen = column.chosen();
            if tops.found(column.u % LANES, limits) != Some(chosen) {
                set(tops, column.u, chosen);
            }
        }
    }

    /// The distance test; the line, and the count of what has no peak.
    fn reject(&mut self, image: &Image, line: &mut Line) {
        let Self { params, tops, rows, is_strong, isolated, .. } = self;
        rows.clear();
        is_strong.clear();
        for tops in tops.iter() {
            rows.extend_from_slice(&tops.v);
            is_strong.extend_from_slice(&tops.is_strong);
        }
        rows.truncate(image.width());
        let none = || rows.iter().zip(is_strong.iter()).filter(|(v, _)| v.is_nan());
        let no_line = none().filter(|(_, is)| **is != 0).count();
        let mut dark = none().count() - no_line;
        find_isolated(rows, is_strong, params, isolated);
        let strong = isolated.iter().filter(|u| is_strong[**u] != 0).count();
        dark += isolated.len() - strong;
        for u in isolated.iter() {
            rows[*u] = f32::NAN;
        }
        line.height = image.height();
        line.columns.clear();
        for (tops, rows) in tops.iter().zip(rows.chunks(LANES)) {
            let peaks = rows.iter().zip(&tops.sigma).zip(&tops.level);
            line.columns.extend(
                peaks.map(|((v, sigma), level)| (!v.is_nan()).then_some(Peak { v: *v, sigma: *sigma, level: *level })),
            );
        }
        line.dropped.0.clear();
        line.dropped.add_many(Drop::Dark, dark as u64);
        line.dropped.add_many(Drop::NotALine, no_line as u64);
        line.dropped.add_many(Drop::Isolated, strong as u64);
    }
}

#[cfg(test)]
mod synthetic;

#[cfg(test)]
mod tests {
    use super::synthetic::{Look, Noise, render, sensor};
    use super::*;

    fn extract(image: &Image) -> Line {
        Extractor::new(LineParams::default()).unwrap().extract(image)
    }

    fn wavy(u: usize) -> f64 {
        100.0 + 30.0 * (u as f64 / 40.0).sin()
    }

    #[test]
    fn a_clean_stripe_is_found_in_every_column() {
        let mut noise = Noise::new(1);
        let line = extract(&render((320, 240), sensor(0.5, 60.0), &mut noise, |u| Some(wavy(u))));
        assert_eq!((line.width(), line.height, line.count()), (320, 240, 320));
        assert!(line.dropped.0.is_empty());
        for (u, peak) in line.columns.iter().enumerate() {
            let peak = peak.unwrap();
            assert!((f64::from(peak.v) - wavy(u)).abs() < 0.06, "{u}: {peak:?}");
            assert!(peak.level > 30.0 && peak.level < 70.0, "{peak:?}");
        }
    }

    #[test]
    fn a_stripe_of_two_to_three_levels_is_found() {
        // The far floor of the simulated finder: f/4, X = 3 to 3.7 m (instrument.md 1).
        for (background, least) in [(0.0, 0.99), (0.2, 0.99), (1.0, 0.99), (1.8, 0.99), (0.5, 0.90)] {
            let look = Look { background, ..sensor(0.5, 2.7) };
            let line = extract(&render((512, 480), look, &mut Noise::new(2), |u| Some(50.0 + 0.1 * u as f64)));
            let right = line
                .columns
                .iter()
                .enumerate()
                .filter(|(u, peak)| peak.is_some_and(|p| (f64::from(p.v) - 50.0 - 0.1 * *u as f64).abs() < 0.6));
            let (right, found) = (right.count(), line.count());
            assert!(right as f64 >= least * 512.0, "background {background}: {right} right of {found}");
            assert!(found - right <= 2, "background {background}: {} wrong", found - right);
        }
    }

    #[test]
    fn noise_alone_is_no_line() {
        for (background, read) in [(0.0, 0.08), (0.5, 0.08), (0.3, 0.1), (1.0, 0.3), (5.0, 2.0), (60.0, 15.0)] {
            let look = Look { background, read, ..sensor(0.5, 0.0) };
            let mut noise = Noise::new(3);
            let mut found = 0;
            for _ in 0..8 {
                let line = extract(&render((512, 480), look, &mut noise, |_| None));
                let dropped: u64 = line.dropped.0.values().sum();
                assert_eq!(dropped as usize + line.count(), 512);
                assert!(line.dropped.0[&Drop::Dark] > 450, "{background} {read}: {:?}", line.dropped);
                found += line.count();
            }
            assert!(found <= 3, "{background} {read}: {found} of 4096 columns"); // under 0.1 %
        }
    }

    #[test]
    fn a_background_that_falls_off_from_level_to_level_is_no_line() {
        // Ambient light of 2.8 levels behind a lens that is 12 % darker in the corners: in a ring, pixels flip.
        let mut noise = Noise::new(13);
        let (width, height) = (512usize, 480usize);
        let mut found = 0;
        for _ in 0..8 {
            let level = |i: usize, noise: &mut Noise| {
                let off = |at: usize, size: usize| at as f64 / size as f64 - 0.5;
                let (x, y) = (off(i % width, width), off(i / width, height));
                (2.8 * (1.0 - 0.24 * (x * x + y * y)) + 0.1 * noise.normal()).round() as u8
            };
            let levels = (0..width * height).map(|i| level(i, &mut noise)).collect();
            found += extract(&Image::new(width, height, 127, levels).unwrap()).count();
        }
        assert!(found <= 3, "{found} of 4096 columns");
    }

    #[test]
    fn dark_columns_are_dark_and_their_neighbours_are_found() {
        let image =
            render((256, 240), sensor(0.5, 80.0), &mut Noise::new(4), |u| (!(90..120).contains(&u)).then(|| wavy(u)));
        let line = extract(&image);
        assert_eq!(line.count(), 226);
        assert_eq!(line.dropped.0[&Drop::Dark], 30);
        assert!(line.columns[90..120].iter().all(Option::is_none));
    }

    #[test]
    fn a_step_of_the_line_is_kept_on_both_sides() {
        let v = |u: usize| if (60..90).contains(&u) { 70.0 } else { 130.3 };
        let line = extract(&render((200, 240), sensor(0.5, 80.0), &mut Noise::new(5), |u| Some(v(u))));
        for (u, peak) in line.columns.iter().enumerate() {
            assert!((f64::from(peak.unwrap().v) - v(u)).abs() < 0.1, "{u}");
        }
    }

    /// The image with `add` more light, as far as there are levels.
    fn lit(image: &Image, add: impl Fn(usize, usize) -> f64) -> Image {
        let levels = image.levels().iter().enumerate().map(|(i, level)| {
            let (u, v) = (i % image.width(), i / image.width());
            (f64::from(*level) + add(u, v)).round().clamp(0.0, 127.0) as u8
        });
        Image::new(image.width(), image.height(), image.white(), levels.collect()).unwrap()
    }

    #[test]
    fn bright_walls_lamps_and_slopes_of_light_do_not_win() {
        let image =
            render((320, 240), Look { background: 8.0, ..sensor(0.6, 40.0) }, &mut Noise::new(6), |u| Some(wavy(u)));
        let walls = |u: usize, v: usize| {
            let wall = if v < 40 { 90.0 } else { 0.0 };
            let lamp = if (200..215).contains(&u) && (180..200).contains(&v) { 110.0 } else { 0.0 };
            wall + lamp + 0.1 * v as f64
        };
        let line = extract(&lit(&image, walls));
        assert_eq!(line.count(), 320);
        for (u, peak) in line.columns.iter().enumerate() {
            assert!((f64::from(peak.unwrap().v) - wavy(u)).abs() < 0.2, "{u}");
        }
    }

    #[test]
    fn a_brighter_false_line_does_not_win_a_few_columns() {
        let image = render((320, 240), sensor(0.6, 40.0), &mut Noise::new(7), |u| Some(wavy(u)));
        let glints = |u: usize, v: usize| if v == 200 && (100..104).contains(&u) { 120.0 } else { 0.0 };
        let line = extract(&lit(&image, glints));
        assert!((f64::from(line.columns[102].unwrap().v) - wavy(102)).abs() < 0.2);
    }

    #[test]
    fn lone_peaks_are_dropped_by_the_distance_test() {
        let v = |u: usize| u.is_multiple_of(7).then_some(if u.is_multiple_of(2) { 60.0 } else { 180.0 });
        let line = extract(&render((140, 240), sensor(0.5, 80.0), &mut Noise::new(8), v));
        assert_eq!(line.count(), 0);
        assert_eq!(line.dropped.0[&Drop::Isolated], 20);
        assert_eq!(line.dropped.0[&Drop::Dark], 120);
        // The paper's own test keeps pairs.
        let pairs = |u: usize| (u % 9 < 2).then_some(100.0);
        let image = render((90, 240), sensor(0.5, 80.0), &mut Noise::new(8), pairs);
        let paper = LineParams { run_columns_min: 2, ..LineParams::default() };
        assert_eq!(Extractor::new(paper).unwrap().extract(&image).count(), 20);
        assert_eq!(extract(&image).count(), 0);
    }

    #[test]
    fn an_extractor_used_again_gives_the_same_as_a_new_one() {
        let images = [(320, 240), (64, 480), (320, 240)]
            .map(|size| render(size, sensor(0.5, 60.0), &mut Noise::new(9), |u| Some(wavy(u))));
        let mut extractor = Extractor::new(LineParams::default()).unwrap();
        for image in &images {
            assert_eq!(extractor.extract(image), extract(image));
        }
    }

    /// Images of all looks.
    fn looks() -> Vec<Image> {
        let mut dice = Noise::new(21);
        let mut images = Vec::new();
        for (size, width_px, peak, background, read) in [
            ((320, 240), 0.5, 60.0, 0.0, 0.08),
            ((512, 480), 0.8, 90.0, 5.0, 2.0),
            ((333, 250), 1.2, 30.0, 20.0, 1.0),
            ((129, 481), 0.7, 300.0, 2.0, 0.5),
            ((64, 200), 0.5, 2.7, 0.5, 0.08),
            ((40, 300), 2.5, 100.0, 30.0, 4.0),
        ] {
            let look = Look { background, read, ..sensor(width_px, peak) };
            images.push(render(size, look, &mut dice, |u| {
                (u % 97 > 4).then(|| wavy(u) + if u % 64 < 20 { 20.0 } else { 0.0 })
            }));
        }
        images
    }

    /// All numbers of a line as bits.
    fn bits(line: &Line) -> Vec<Option<[u32; 3]>> {
        let of = |peak: &Peak| [peak.v.to_bits(), peak.sigma.to_bits(), peak.level.to_bits()];
        line.columns.iter().map(|peak| peak.as_ref().map(of)).collect()
    }

    #[test]
    fn narrow_vectors_give_the_same_bits_as_wide_ones() {
        for image in looks() {
            let mut narrow = Extractor::new(LineParams::default()).unwrap();
            narrow.is_wide = false;
            let (wide, narrow) = (extract(&image), narrow.extract(&image));
            assert_eq!(bits(&wide), bits(&narrow), "{image:?}");
            assert_eq!(wide.dropped, narrow.dropped);
        }
    }

    #[test]
    fn many_columns_at_once_give_the_same_bits_as_one_at_a_time() {
        for image in looks() {
            let mut extractor = Extractor::new(LineParams::default()).unwrap();
            let view = View::plain(&image, &extractor.params);
            let mut line = Line::empty();
            let (noise, limits) = extractor.find(&view, &mut line);
            let mut one = line.clone();
            for (u, peak) in one.columns.iter_mut().enumerate().filter(|(_, peak)| peak.is_some()) {
                let contested = extractor.chooser.contested.iter().find(|c| c.u == u).map(|c| c.chosen());
                let found = contested.or_else(|| extractor.tops[u / LANES].found(u % LANES, limits)).unwrap();
                *peak = view.column(u, found, noise).peak(found.row.into(), &extractor.params);
            }
            assert_eq!(bits(&line), bits(&one), "{image:?}");
            assert!(line.count() > line.width() * 8 / 10, "{image:?}: {}", line.count());
        }
    }

    #[test]
    fn exact_sums_find_the_same_line_where_rounded_ones_will_do() {
        for (read, peak) in [(1.5, 30.0), (2.0, 90.0), (3.0, 60.0), (5.0, 110.0)] {
            let look = Look { background: 12.0, read, ..sensor(0.8, peak) };
            let image = render((512, 480), look, &mut Noise::new(22), |u| (u % 40 > 2).then(|| wavy(u)));
            let mut exact = Extractor::new(LineParams::default()).unwrap();
            exact.scan.always_fine = true;
            let (rounded, exact) = (extract(&image), exact.extract(&image));
            let mut differ = 0;
            for (u, pair) in rounded.columns.iter().zip(&exact.columns).enumerate() {
                match pair {
                    (Some(a), Some(b)) => {
                        // Of two rows alike, another one may be the ridge's, with other background boxes.
                        assert!((a.v - b.v).abs() < 2.0 * a.sigma, "{read} {peak}: {u}: {a:?} {b:?}");
                        differ += usize::from(a.v != b.v);
                    }
                    // A column of nothing but noise may fall on either side of a threshold.
                    (a, b) => assert!(a == b || u % 40 <= 2, "{read} {peak}: {u}: {a:?} {b:?}"),
                }
            }
            assert!(differ <= 25, "{read} {peak}: {differ} of 512");
        }
    }

    #[test]
    fn a_line_used_again_is_the_same_as_a_new_one() {
        let mut extractor = Extractor::new(LineParams::default()).unwrap();
        let mut line = Line::empty();
        for image in looks() {
            extractor.extract_into(&image, &mut line);
            assert_eq!(line, extract(&image));
        }
    }

    #[test]
    fn the_rule_says_which_of_several_peaks_is_kept_and_the_others_are_told() {
        // The line with two false ones: a bright one below it, a dim one above.
        let image = render((320, 240), sensor(0.6, 40.0), &mut Noise::new(23), |u| Some(wavy(u)));
        let false_lines = |u: usize, v: usize| match v {
            190 if (100..104).contains(&u) => 100.0,
            20 if (101..103).contains(&u) => 25.0,
            _ => 0.0,
        };
        let image = lit(&image, false_lines);
        for (keep, row) in
            [(Keep::Path, wavy(102)), (Keep::Brightest, 190.0), (Keep::Lowest, 190.0), (Keep::Topmost, 20.0)]
        {
            let params = LineParams { keep, run_columns_min: 2, ..LineParams::default() };
            let mut extractor = Extractor::new(params).unwrap();
            let (line, others) = extractor.extract_all(&image, None).unwrap();
            assert_eq!(line, extractor.extract(&image));
            assert!((f64::from(line.columns[102].unwrap().v) - row).abs() < 0.3, "{keep:?}: {:?}", line.columns[102]);
            let mut rows: Vec<f64> = others[102].iter().map(|peak| f64::from(peak.v)).collect();
            rows.push(row);
            rows.sort_by(f64::total_cmp);
            let expected = [20.0, wavy(102), 190.0];
            assert!(
                rows.len() == 3 && rows.iter().zip(expected).all(|(a, b)| (a - b).abs() < 0.3),
                "{keep:?}: {rows:?}"
            );
            assert!(others.iter().enumerate().all(|(u, peaks)| (100..104).contains(&u) || peaks.is_empty()));
        }
    }

    #[test]
    fn an_image_with_the_laser_off_takes_the_scene_away() {
        let mut dice = Noise::new(24);
        // Bright stripes that no ridge can tell from the line, a wall, a texture.
        let scene = |u: usize, v: usize| {
            let bars = if v % 30 < 2 { 70.0 } else { 0.0 };
            10.0 + bars + if v < 60 { 20.0 } else { 0.0 } + ((u * 7 + v * 13) % 5) as f64
        };
        let look = Look { read: 0.6, background: 5.0, ..sensor(0.8, 25.0) };
        let dark = Look { peak: 0.0, ..look };
        let on = lit(&render((320, 240), look, &mut dice, |u| Some(wavy(u))), scene);
        let off = lit(&render((320, 240), dark, &mut dice, |_| None), scene);
        let mut extractor = Extractor::new(LineParams { sigma_min_px: 0.0, ..LineParams::default() }).unwrap();
        let wrong = |line: &Line| {
            let is_right =
                |(u, peak): (usize, &Option<Peak>)| peak.is_some_and(|peak| (f64::from(peak.v) - wavy(u)).abs() < 0.5);
            line.width() - line.columns.iter().enumerate().filter(|c| is_right(*c)).count()
        };
        assert!(wrong(&extractor.extract(&on)) > 50);
        let line = extractor.extract_above(&on, &off).unwrap();
        assert!(wrong(&line) <= 2, "{}", wrong(&line));
        // σ holds the noise of both images.
        let errors =
            line.columns.iter().enumerate().filter_map(|(u, peak)| peak.map(|p| (f64::from(p.v) - wavy(u), p)));
        let scaled: Vec<f64> =
            errors.filter(|(e, _)| e.abs() < 0.5).map(|(e, peak)| (e / f64::from(peak.sigma)).powi(2)).collect();
        let ratio = (scaled.iter().sum::<f64>() / scaled.len() as f64).sqrt();
        assert!((0.75..1.25).contains(&ratio), "errors are {ratio:.2} sigma");
        // Used again, and after another image, it gives the same; without the laser, nothing.
        assert_eq!(extractor.extract_above(&on, &off).unwrap(), line);
        assert_eq!(extractor.extract_all(&on, Some(&off)).unwrap().0, line);
        assert!(extractor.extract_above(&off, &off).unwrap().count() <= 1);
        let small = Image::new(320, 239, 127, vec![0; 320 * 239]).unwrap();
        let fault = extractor.extract_above(&on, &small).unwrap_err();
        assert!(fault.to_string().contains("320 x 239") && fault.to_string().contains("320 x 240"), "{fault}");
    }

    #[test]
    fn small_and_odd_images_are_no_trouble() {
        for (width, height) in [(1, 1), (1, 1000), (1000, 1), (3, 5), (17, 16), (16, 17), (5, 63)] {
            for level in [0, 255] {
                let image = Image::new(width, height, 255, vec![level; width * height]).unwrap();
                assert_eq!(extract(&image).count(), 0, "{width} x {height}");
            }
            let mut noise = Noise::new(10);
            let levels = (0..width * height).map(|_| (noise.uniform() * 256.0) as u8).collect();
            assert_eq!(extract(&Image::new(width, height, 255, levels).unwrap()).width(), width);
        }
    }

    #[test]
    fn parameters_that_make_no_sense_are_refused() {
        let good = LineParams::default();
        let bad = [
            LineParams { background_px: 6, ..good },
            LineParams { background_px: 0, ..good },
            LineParams { ridge_min: f32::NAN, ..good },
            LineParams { ridge_min_beside: 99.0, ..good },
            LineParams { epsilon1_px: 0.0, ..good },
            LineParams { epsilon2_px: f32::INFINITY, ..good },
            LineParams { well_electrons: 0.0, ..good },
            LineParams { run_columns_min: 0, ..good },
            LineParams { read_electrons: f32::NAN, ..good },
        ];
        for params in bad {
            assert!(Extractor::new(params).is_err(), "{params:?}");
        }
        assert!(toml::from_str::<LineParams>("estimator = \"full_fit\"\nkeep = \"lowest\"\nepsilon1_px = 3.0").is_ok());
        assert!(toml::from_str::<LineParams>("keep = \"best\"").is_err());
        assert!(toml::from_str::<LineParams>("epsilon = 3.0").is_err());
    }
}
