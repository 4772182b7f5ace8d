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
