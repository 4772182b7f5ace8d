//! Image → Line: the paper's five steps (2.3), with sub-pixel rows and thresholds that come from the image's own noise.
//!
//! Steps (1) and (2) are the `Image`. The rest, for every image:
//!
//! 1. `ridge`: one pass over the rows gives, for each column and each band of 16 rows, the strongest *ridge*: how much
//!    four pixels' worth of light, `I(v−1) + 2·I(v) + I(v+1)`, exceed the brighter of two boxes of four rows above and
//!    below. What is as bright above or below as it is itself (a wall, a step, a lamp's glow) has none. Step (3).
//! 2. `choose`: the median ridge of all bands is noise, since the line fills few of them; ridges above a multiple of it
//!    are candidates, at most four a column. One path through them, from left to right, has the largest sum of strengths
//!    minus jumps: a false line or a bright object wins a column only if it is also where its neighbours are. Rows are
//!    not changed by this, only chosen: nothing is smoothed along the line.
//! 3. `peak`: the row of the chosen ridge to a fraction of a pixel from its own column alone, and its σ.
//! 4. The distance test, step (4): a peak stays if one of its neighbours is near.
//!
//! A line in the first or last four rows has no background on its outer side and is not found.

mod choose;
mod peak;
mod ridge;

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within, positive};
use crate::image::{Drop, Dropped, Image, Line, Peak};

pub use peak::Estimator;

use choose::{Chooser, Chosen};
use peak::Column;
use ridge::Ridge;

/// What the extraction is free to choose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LineParams {
    /// How the row is found to a fraction of a pixel.
    pub estimator: Estimator,
    /// How far from the line the background is taken, above and below [px]: a multiple of 4, at least the stripe's full
    /// width. A stripe wider than this is not found.
    pub background_px: usize,
    /// A line stands out by this many times the median ridge of the image. 3.1 is about ten times the noise of a pixel:
    /// on noise alone, one column in a hundred has such a ridge, and one in ten thousand passes the distance test.
    pub ridge_min: f32,
    /// A weaker one, down to this many, is taken if it runs on from one that stands out.
    pub ridge_min_beside: f32,
    /// And by at least this level, however dark the image is [levels].
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
    /// The smallest σ given to a peak [px], added in quadrature: speckle that no single image shows [A].
    pub sigma_min_px: f32,
}

impl Default for LineParams {
    fn default() -> Self {
        Self {
            estimator: Estimator::Auto,
            background_px: 8,
            ridge_min: 3.1,
            ridge_min_beside: 2.5,
            level_min: 0.75,
            epsilon1_px: 5.0,
            epsilon2_px: 5.0,
            run_columns_min: 3,
            jump_cost_per_px: 0.1,
            jump_cost_max: 2.0,
            well_electrons: 1e5,
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
        number_within("line.sigma_min_px", f64::from(self.sigma_min_px), 0.0, 10.0)?;
        Ok(self)
    }
}

/// Finds the line in one image after the other. Its buffers grow to the largest image and are used again.
#[derive(Clone, Debug)]
pub struct Extractor {
    params: LineParams,
    ridge: Ridge,
    chooser: Chooser,
}

impl Extractor {
    /// An error if the parameters make no extraction.
    pub fn new(params: LineParams) -> Result<Self> {
        let params = params.validated()?;
        Ok(Self { params, ridge: Ridge::new(params.background_px / 4), chooser: Chooser::default() })
    }

    /// The line in `image`, at most one peak a column, and why the other columns have none. Depends on this image and
    /// the parameters only.
    pub fn extract(&mut self, image: &Image) -> Line {
        self.ridge.scan(image);
        let noise = self.chooser.choose(&self.ridge, &self.params);
        let mut columns = Vec::with_capacity(image.width());
        for (u, chosen) in self.chooser.path.iter().enumerate() {
            columns.push(chosen.and_then(|Chosen { band, .. }| {
                let (row, background) = (self.ridge.row(band, u), self.ridge.background(band, u));
                Column { image, u, background, noise }.peak(row, &self.params)
            }));
        }
        self.chooser.find_isolated(&columns, &self.params);
        let mut dropped = Dropped::default();
        let without = self.chooser.path.iter().zip(&columns).filter(|(_, peak)| peak.is_none());
        for (chosen, _) in without {
            let stands_out = chosen.is_some_and(|chosen| chosen.is_strong);
            dropped.add(if stands_out { Drop::NotALine } else { Drop::Dark });
        }
        for u in &self.chooser.isolated {
            let stands_out = self.chooser.path[*u].is_some_and(|chosen| chosen.is_strong);
            dropped.add(if stands_out { Drop::Isolated } else { Drop::Dark });
            columns[*u] = None;
        }
        Line { height: image.height(), columns, dropped }
    }
}

/// Row distance of two peaks [px]; infinite where there is none.
fn distance(a: Option<&Peak>, b: Option<&Peak>) -> f32 {
    a.zip(b).map_or(f32::INFINITY, |(a, b)| (a.v - b.v).abs())
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
        ];
        for params in bad {
            assert!(Extractor::new(params).is_err(), "{params:?}");
        }
        assert!(toml::from_str::<LineParams>("estimator = \"gauss3\"\nepsilon1_px = 3.0").is_ok());
        assert!(toml::from_str::<LineParams>("epsilon = 3.0").is_err());
    }
}
