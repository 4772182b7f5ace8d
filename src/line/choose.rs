//! Which ridge of a column is the line: noise level, candidates, the best path through them, and the distance test.

use super::ridge::Ridge;
use super::{LineParams, distance};
use crate::image::Peak;

/// Most candidates a column; further, weaker ones are forgotten.
const CANDIDATES: usize = 4;
/// Every so many columns count for the noise: enough for a median, and cheap.
const STRIDE: usize = 11;
/// Median of the strongest ridge in a band, over the standard deviation of a pixel, for white noise (see the test).
const RIDGE_OF_NOISE: f32 = 3.42;
/// A strength counts at most this many times the median one: what is brighter than the line is no better a line.
const STRENGTH_MAX: f32 = 1.0;

/// A ridge that stands out of the noise.
#[derive(Clone, Copy, Debug, Default)]
struct Candidate {
    strength: i16,
    band: u16,
    /// Whole row, for the path.
    row: f32,
}

/// The candidates of one column, strongest first, and the path's state in it.
#[derive(Clone, Copy, Debug, Default)]
struct Choice {
    count: usize,
    candidates: [Candidate; CANDIDATES],
    /// Value of the best path that ends in each candidate.
    value: [f32; CANDIDATES],
    /// The candidate of the column before that this path came through.
    from: [u8; CANDIDATES],
}

/// A ridge on the path.
#[derive(Clone, Copy, Debug)]
pub(super) struct Chosen {
    /// The band it is the best of.
    pub band: usize,
    /// Whether it stands out by itself, not only beside another.
    pub is_strong: bool,
}

/// Chooses one ridge a column; holds the buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Chooser {
    /// The chosen ridge in each column; `None` where nothing stands out.
    pub path: Vec<Option<Chosen>>,
    /// Columns whose peak is not to be used.
    pub isolated: Vec<usize>,
    choices: Vec<Choice>,
    strengths: Vec<i16>,
}

impl Chooser {
    /// Fills `path`; returns the noise of a pixel [levels, standard deviation].
    pub fn choose(&mut self, ridge: &Ridge, params: &LineParams) -> f32 {
        let median = self.median_ridge(ridge);
        let strong = (params.ridge_min * median).max(4.0 * params.level_min);
        let share = (params.ridge_min_beside / params.ridge_min).min(1.0);
        self.collect(ridge, strong * share);
        self.path.clear();
        self.path.resize(ridge.width, None);
        self.strengths.clear();
        let best = self.choices.iter().filter(|c| c.count > 0).map(|c| c.candidates[0].strength);
        self.strengths.extend(best.filter(|strength| f32::from(*strength) > strong));
        if !self.strengths.is_empty() {
            let typical = f32::from(median_of(&mut self.strengths)).max(1.0);
            self.follow(typical, strong, params);
        }
        median / RIDGE_OF_NOISE
    }

    /// The median over the bands of many columns, interpolated between whole strengths.
    fn median_ridge(&mut self, ridge: &Ridge) -> f32 {
        self.strengths.clear();
        for band in 0..ridge.bands {
            // Another column first in every band, so that no pattern of the image is in step with the sampling.
            self.strengths
                .extend(ridge.band(band).iter().skip(band % STRIDE).step_by(STRIDE).map(|packed| packed >> 4));
        }
        if self.strengths.is_empty() {
            return 0.0;
        }
        let middle = median_of(&mut self.strengths);
        let below = self.strengths.iter().filter(|s| **s < middle).count() as f32;
        let equal = self.strengths.iter().filter(|s| **s == middle).count() as f32;
        let within = (self.strengths.len() as f32 / 2.0 - below) / equal;
        (f32::from(middle) - 0.5 + within).max(0.0)
    }

    /// The ridges above `threshold`, the strongest few of each column.
    fn collect(&mut self, ridge: &Ridge, threshold: f32) {
        self.choices.clear();
        self.choices.resize(ridge.width, Choice::default());
        // The lowest packed value whose strength is above the threshold.
        let limit = ((threshold.floor() as i16).saturating_add(1)).saturating_mul(16);
        for band in 0..ridge.bands {
            for (chunk, lanes) in ridge.band(band).chunks(16).enumerate() {
                if lanes.iter().fold(0, |a, b| a.max(*b)) < limit {
                    continue;
                }
                for (lane, packed) in lanes.iter().enumerate().filter(|(_, packed)| **packed >= limit) {
                    let u = chunk * 16 + lane;
                    let row = ridge.row(band, u) as f32;
                    self.choices[u].insert(Candidate { strength: packed >> 4, band: band as u16, row });
                }
            }
        }
    }

    /// The path of the largest sum of strengths minus jumps (Viterbi's way). Columns without candidates are passed over.
    fn follow(&mut self, typical: f32, strong: f32, params: &LineParams) {
        let worth = |c: &Candidate| (f32::from(c.strength) / typical).min(STRENGTH_MAX);
        let mut before: Option<Choice> = None;
        for choice in self.choices.iter_mut().filter(|c| c.count > 0) {
            for i in 0..choice.count {
                let here = choice.candidates[i];
                let (mut best, mut from) = (0.0, 0);
                if let Some(before) = &before {
                    best = f32::NEG_INFINITY;
                    for j in 0..before.count {
                        let jump = (before.candidates[j].row - here.row).abs() * params.jump_cost_per_px;
                        let value = before.value[j] - jump.min(params.jump_cost_max);
                        if value > best {
                            (best, from) = (value, j as u8);
                        }
                    }
                }
                choice.value[i] = best + worth(&here);
                choice.from[i] = from;
            }
            before = Some(*choice);
        }
        let Some(last) = before else { return };
        let mut at = (0..last.count).rev().max_by(|a, b| last.value[*a].total_cmp(&last.value[*b])).unwrap_or(0);
        for (choice, path) in self.choices.iter().zip(&mut self.path).rev().filter(|(c, _)| c.count > 0) {
            let Candidate { strength, band, .. } = choice.candidates[at];
            *path = Some(Chosen { band: usize::from(band), is_strong: f32::from(strength) > strong });
            at = usize::from(choice.from[at]);
        }
    }

    /// Fills `isolated`. Step (4) of the paper's 2.3: the columns with neither |V(U) − V(U−1)| < ε₁ nor |V(U) − V(U+1)| < ε₂; and, beyond
    /// the paper, those of runs of near peaks that are too short, or all too weak.
    pub fn find_isolated(&mut self, columns: &[Option<Peak>], params: &LineParams) {
        let apart = |a: usize, b: usize| distance(columns[a].as_ref(), columns[b].as_ref());
        let epsilon = params.epsilon1_px.max(params.epsilon2_px);
        self.isolated.clear();
        let mut start = 0;
        for end in 1..=columns.len() {
            if end < columns.len() && apart(end - 1, end) < epsilon {
                continue;
            }
            let is_seen = self.path[start..end].iter().flatten().any(|chosen| chosen.is_strong);
            let is_nothing = end - start < params.run_columns_min || !is_seen;
            self.isolated.extend((start..end).filter(|&u| {
                let near_previous = u > start && apart(u - 1, u) < params.epsilon1_px;
                let near_next = u + 1 < end && apart(u, u + 1) < params.epsilon2_px;
                columns[u].is_some() && (is_nothing || !(near_previous || near_next))
            }));
            start = end;
        }
    }
}

impl Choice {
    /// Keeps the strongest, in order; of equals, the upper one comes first.
    fn insert(&mut self, new: Candidate) {
        let place = self.candidates[..self.count].iter().position(|c| new.strength > c.strength).unwrap_or(self.count);
        if place < CANDIDATES {
            self.count = (self.count + 1).min(CANDIDATES);
            self.candidates[place..self.count].rotate_right(1);
            self.candidates[place] = new;
        }
    }
}

/// The upper median; the slice is reordered. Not for an empty one.
fn median_of(values: &mut [i16]) -> i16 {
    let middle = values.len() / 2;
    *values.select_nth_unstable(middle).1
}

#[cfg(test)]
mod tests {
    use super::super::synthetic::{Look, Noise, render, sensor};
    use super::*;

    #[test]
    fn the_noise_of_a_pixel_is_seen_to_15_percent_whatever_the_line() {
        for read in [1.0, 3.0, 10.0] {
            for peak in [0.0, 90.0] {
                let look = Look { background: 60.0, read, ..sensor(0.8, peak) };
                let image = render((512, 480), look, &mut Noise::new(12), |_| Some(200.0));
                let mut ridge = Ridge::new(2);
                ridge.scan(&image);
                let seen = f64::from(Chooser::default().choose(&ridge, &LineParams::default()));
                let truth = (read * read + 1.0 / 12.0 + look.shot * 60.0).sqrt();
                assert!((seen / truth - 1.0).abs() < 0.15, "{read} {peak}: {seen} for {truth}");
            }
        }
    }

    #[test]
    fn a_column_keeps_its_strongest_candidates_in_order() {
        let mut choice = Choice::default();
        for strength in [5, 9, 1, 7, 9, 3] {
            choice.insert(Candidate { strength, band: choice.count as u16, row: 0.0 });
        }
        let kept: Vec<i16> = choice.candidates[..choice.count].iter().map(|c| c.strength).collect();
        assert_eq!(kept, [9, 9, 7, 5]);
        assert_eq!(choice.candidates[0].band, 1); // of equals, the first stays first
    }

    #[test]
    fn the_distance_test_is_the_papers() {
        let peaks = [Some(10.0), Some(12.0), Some(30.0), None, Some(31.0), Some(40.0), Some(43.0), None, Some(43.0)];
        let columns: Vec<Option<Peak>> = peaks.iter().map(|v| v.map(|v| Peak { v, sigma: 0.1, level: 9.0 })).collect();
        let mut chooser = Chooser { path: vec![Some(Chosen { band: 0, is_strong: true }); 9], ..Chooser::default() };
        let mut isolated = |epsilon1_px, epsilon2_px, run_columns_min| {
            let params = LineParams { epsilon1_px, epsilon2_px, run_columns_min, ..LineParams::default() };
            chooser.find_isolated(&columns, &params);
            chooser.isolated.clone()
        };
        assert_eq!(isolated(5.0, 5.0, 2), [2, 4, 8]);
        assert_eq!(isolated(2.5, 2.5, 2), [2, 4, 5, 6, 8]);
        // ε₁ looks back, ε₂ ahead: the first of a pair has only ε₂.
        assert_eq!(isolated(2.5, 5.0, 2), [2, 4, 6, 8]);
        assert_eq!(isolated(5.0, 2.5, 2), [2, 4, 5, 8]);
        assert_eq!(isolated(5.0, 5.0, 3), [0, 1, 2, 4, 5, 6, 8]);
    }
}
