//! Which ridge of a column is the line: noise level, candidates, the best path through them, and the distance test.

use super::noise::Counts;
use super::ridge::Found;
use super::scan::Limits;
use super::{Keep, LineParams};

/// Most candidates a column; further, weaker ones are forgotten.
const CANDIDATES: usize = 4;
/// A strength counts at most this many times the median one: what is brighter than the line is no better a line.
const STRENGTH_MAX: f32 = 1.0;

/// Ridges that stand out of the noise in one column, strongest first.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Candidates {
    pub u: usize,
    count: u8,
    /// The one that is taken.
    chosen: u8,
    found: [Found; CANDIDATES],
}

/// What the path knows in a column where it could go several ways.
#[derive(Clone, Copy, Debug, Default)]
struct Crossing {
    /// Value of the best path that ends in each candidate.
    value: [f32; CANDIDATES],
    /// The candidate of the column before that this path came through.
    from: [u8; CANDIDATES],
}

/// Chooses one ridge a column; holds the buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Chooser {
    /// The columns with more than one candidate, from the left.
    pub contested: Vec<Candidates>,
    crossings: Vec<Crossing>,
    strengths: Counts,
}

/// From which strengths on ridges are wanted of an image with this median ridge.
pub(super) fn limits(median: f32, params: &LineParams) -> Limits {
    let strong = (params.ridge_min * median).max(4.0 * params.level_min);
    let share = (params.ridge_min_beside / params.ridge_min).min(1.0);
    let above = |threshold: f32| (threshold.floor() as i16).saturating_add(1);
    Limits { strong: above(strong), weak: above(strong * share) }
}

impl Chooser {
    /// Takes the ridges beside the strongest ones, column by column from the left.
    pub fn collect(
        &mut self,
        others: impl Iterator<Item = (usize, Found)>,
        top: impl Fn(usize) -> Option<Found>,
        limits: Limits,
    ) {
        self.contested.clear();
        let mut column = Candidates::default();
        for (u, found) in others.filter(|(_, found)| found.strength >= limits.weak) {
            if column.count == 0 || column.u != u {
                self.contested.extend(Some(column).filter(|c| c.count > 1));
                column = Candidates { u, ..Candidates::default() };
                if let Some(top) = top(u) {
                    column.insert(top);
                }
            }
            column.insert(found);
        }
        self.contested.extend(Some(column).filter(|c| c.count > 1));
    }

    /// Chooses one of the candidates of each column.
    pub fn choose(&mut self, width: usize, top: impl Fn(usize) -> Option<Found>, limits: Limits, params: &LineParams) {
        match params.keep {
            Keep::Path => self.follow(width, top, limits, params),
            Keep::Brightest => {}
            Keep::Topmost => self.take(limits, |a, b| a.row < b.row),
            Keep::Lowest => self.take(limits, |a, b| a.row > b.row),
        }
    }

    /// In each column the first by `is_before` of those that stand out by themselves, if there is one.
    fn take(&mut self, limits: Limits, is_before: impl Fn(&Found, &Found) -> bool) {
        for column in &mut self.contested {
            for i in 1..column.all().len() {
                let (new, old) = (&column.found[i], &column.found[usize::from(column.chosen)]);
                if new.strength >= limits.strong && is_before(new, old) {
                    column.chosen = i as u8;
                }
            }
        }
    }

    /// The path of the largest sum of strengths minus jumps (Viterbi's way). Columns without candidates are passed over.
    /// In a column with one candidate all paths meet: what comes after does not depend on what was before, so only
    /// the columns in between, where there is a choice, are searched.
    fn follow(&mut self, width: usize, top: impl Fn(usize) -> Option<Found>, limits: Limits, params: &LineParams) {
        if self.contested.is_empty() {
            return;
        }
        self.strengths.clear();
        for strongest in (0..width).filter_map(&top).filter(|found| found.strength >= limits.strong) {
            self.strengths.add(strongest.strength);
        }
        let typical = self.strengths.median().max(1.0);
        let Self { contested, crossings, .. } = self;
        let mut start = 0;
        for i in 0..contested.len() {
            let next = contested.get(i + 1).map_or(width, |c| c.u);
            // The nearest columns without a choice, if there is one before the next with a choice.
            if i == start {
                let from = i.checked_sub(1).map_or(0, |last| contested[last].u + 1);
                let before = (from..contested[i].u).rev().find_map(&top);
                crossings.clear();
                crossings.push(Crossing::first(&contested[i], before, typical, params));
            } else {
                let last = crossings.last().copied().unwrap_or_default();
                let before = contested[i - 1].all();
                crossings.push(Crossing::after(&contested[i], before, &last.value, typical, params));
            }
            let after = (contested[i].u + 1..next).find_map(&top);
            if after.is_some() || next == width {
                decide(crossings, &mut contested[start..=i], after, typical, params);
                start = i + 1;
            }
        }
    }
}

/// Follows the best path back through columns with a choice, from the one without after them.
fn decide(crossings: &[Crossing], columns: &mut [Candidates], after: Option<Found>, typical: f32, params: &LineParams) {
    let (Some(last), Some(column)) = (crossings.last(), columns.last()) else { return };
    let mut at = match after {
        Some(after) => {
            let after = Candidates { count: 1, found: [after; CANDIDATES], ..Candidates::default() };
            Crossing::after(&after, column.all(), &last.value, typical, params).from[0]
        }
        None => {
            // Of equals, the strongest.
            let best = (0..column.all().len()).rev().max_by(|a, b| last.value[*a].total_cmp(&last.value[*b]));
            best.unwrap_or(0) as u8
        }
    };
    for (column, crossing) in columns.iter_mut().zip(crossings).rev() {
        column.chosen = at;
        at = crossing.from[usize::from(at)];
    }
}

impl Crossing {
    /// The first column with a choice, after one without or after none at all.
    fn first(column: &Candidates, before: Option<Found>, typical: f32, params: &LineParams) -> Self {
        match before {
            Some(before) => Self::after(column, &[before], &[0.0; CANDIDATES], typical, params),
            None => {
                let mut crossing = Self::default();
                for (value, here) in crossing.value.iter_mut().zip(column.all()) {
                    *value = worth(here, typical);
                }
                crossing
            }
        }
    }

    /// The best ways into the candidates of a column from those of the one before, with their values.
    fn after(
        column: &Candidates,
        before: &[Found],
        values: &[f32; CANDIDATES],
        typical: f32,
        params: &LineParams,
    ) -> Self {
        let mut crossing = Self::default();
        for (i, here) in column.all().iter().enumerate() {
            let (mut best, mut from) = (f32::NEG_INFINITY, 0);
            for (j, (there, value)) in before.iter().zip(values).enumerate() {
                let jump = f32::from(here.row.abs_diff(there.row)) * params.jump_cost_per_px;
                let value = value - jump.min(params.jump_cost_max);
                if value > best {
                    (best, from) = (value, j as u8);
                }
            }
            crossing.value[i] = best + worth(here, typical);
            crossing.from[i] = from;
        }
        crossing
    }
}

/// What a candidate adds to the value of a path.
fn worth(found: &Found, typical: f32) -> f32 {
    (f32::from(found.strength) / typical).min(STRENGTH_MAX)
}

impl Candidates {
    /// The one that is taken.
    pub fn chosen(&self) -> Found {
        self.found[usize::from(self.chosen)]
    }

    /// The others, strongest first; those that stand out by themselves only.
    pub fn rivals(&self, limits: Limits) -> impl Iterator<Item = Found> + '_ {
        let others = self.all().iter().enumerate().filter(|(i, _)| *i != usize::from(self.chosen));
        others.map(|(_, found)| *found).filter(move |found| found.strength >= limits.strong)
    }

    fn all(&self) -> &[Found] {
        &self.found[..usize::from(self.count)]
    }

    /// Keeps the strongest, in order; of equals, the first comes first.
    fn insert(&mut self, new: Found) {
        let count = usize::from(self.count);
        let place = self.found[..count].iter().position(|f| new.strength > f.strength).unwrap_or(count);
        if place < CANDIDATES {
            self.count = (count + 1).min(CANDIDATES) as u8;
            self.found[place..usize::from(self.count)].rotate_right(1);
            self.found[place] = new;
        }
    }
}

/// Columns whose peak is not to be used, into `isolated`. Step (4) of the paper's 2.3: those with neither
/// |V(U) − V(U−1)| < ε₁ nor |V(U) − V(U+1)| < ε₂; and, beyond the paper, those of runs of near peaks that are too short,
/// or all too weak. `rows` holds no number (NaN) where there is no peak, `is_strong` 1 where one stands out by itself.
pub(super) fn find_isolated(rows: &[f32], is_strong: &[u8], params: &LineParams, isolated: &mut Vec<usize>) {
    let (back, ahead) = (params.epsilon1_px, params.epsilon2_px);
    let epsilon = back.max(ahead);
    let near = |a: usize, b: usize, epsilon: f32| (rows[a] - rows[b]).abs() < epsilon;
    isolated.clear();
    let mut run = |start: usize, end: usize| {
        if end - start == 1 && rows[start].is_nan() {
            return;
        }
        let is_line = end - start >= params.run_columns_min && is_strong[start..end].contains(&1);
        // With one ε, whoever is in a run of two or more has a near neighbour.
        if is_line && back == ahead && end - start > 1 {
            return;
        }
        isolated.extend((start..end).filter(|&u| {
            let near_previous = u > start && near(u - 1, u, back);
            let near_next = u + 1 < end && near(u, u + 1, ahead);
            !is_line || !(near_previous || near_next)
        }));
    };
    let mut start = 0;
    let mut from = 1;
    // Most of the line is near its neighbours: so many columns at once.
    for (left, right) in rows.as_chunks::<16>().0.iter().zip(rows.get(1..).unwrap_or(&[]).as_chunks::<16>().0) {
        let mut are_near = true;
        for i in 0..16 {
            are_near &= (left[i] - right[i]).abs() < epsilon;
        }
        for end in if are_near { 0..0 } else { from..from + 16 } {
            if !near(end - 1, end, epsilon) {
                run(start, end);
                start = end;
            }
        }
        from += 16;
    }
    for end in from..=rows.len() {
        if end == rows.len() || !near(end - 1, end, epsilon) {
            run(start, end);
            start = end;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::synthetic::Noise;
    use super::*;

    #[test]
    fn a_column_keeps_its_strongest_candidates_in_order() {
        let mut choice = Candidates::default();
        for (row, strength) in [5, 9, 1, 7, 9, 3].into_iter().enumerate() {
            choice.insert(Found { strength, row: row as u16, boxes: 0 });
        }
        let kept: Vec<i16> = choice.all().iter().map(|f| f.strength).collect();
        assert_eq!(kept, [9, 9, 7, 5]);
        assert_eq!(choice.found[0].row, 1); // of equals, the first stays first
    }

    /// The value of the best path, by trying every way through the candidates.
    fn best_of_all(columns: &[Candidates], typical: f32, params: &LineParams) -> f32 {
        let filled: Vec<&Candidates> = columns.iter().filter(|c| c.count > 0).collect();
        let ways: usize = filled.iter().map(|c| usize::from(c.count)).product();
        let value = |way: usize| {
            let mut rest = way;
            let mut path = Vec::new();
            for column in &filled {
                path.push(column.found[rest % usize::from(column.count)]);
                rest /= usize::from(column.count);
            }
            path_value(&path, typical, params)
        };
        (0..ways).map(value).fold(f32::NEG_INFINITY, f32::max)
    }

    fn path_value(path: &[Found], typical: f32, params: &LineParams) -> f32 {
        let worth: f32 = path.iter().map(|f| worth(f, typical)).sum();
        let jump =
            |w: &[Found]| (f32::from(w[0].row.abs_diff(w[1].row)) * params.jump_cost_per_px).min(params.jump_cost_max);
        worth - path.windows(2).map(jump).sum::<f32>()
    }

    #[test]
    fn no_path_is_better_than_the_one_taken() {
        let (params, limits) = (LineParams::default(), Limits { strong: 0, weak: 0 });
        let mut noise = Noise::new(31);
        for _ in 0..500 {
            let columns: Vec<Candidates> = (0..8)
                .map(|u| {
                    let mut column = Candidates { u, ..Candidates::default() };
                    for _ in 0..(noise.uniform() * 4.0) as usize {
                        let (strength, row) = ((noise.uniform() * 200.0) as i16, (noise.uniform() * 60.0) as u16);
                        column.insert(Found { strength, row, boxes: 0 });
                    }
                    column
                })
                .collect();
            let top = |u: usize| columns[u].all().first().copied();
            let others = columns.iter().flat_map(|c| c.all().iter().skip(1).map(|found| (c.u, *found)));
            let mut chooser = Chooser::default();
            chooser.collect(others, top, limits);
            chooser.choose(8, top, limits, &params);
            let chosen = |u: usize| chooser.contested.iter().find(|c| c.u == u).map(Candidates::chosen);
            let path: Vec<Found> = (0..8).filter_map(|u| chosen(u).or_else(|| top(u))).collect();
            let typical = chooser.strengths.median().max(1.0);
            let (taken, best) = (path_value(&path, typical, &params), best_of_all(&columns, typical, &params));
            assert!(chooser.contested.is_empty() || (taken - best).abs() < 1e-4, "{taken} for {best}: {columns:?}");
        }
    }

    #[test]
    fn the_distance_test_is_the_papers() {
        const NONE: f32 = f32::NAN;
        let rows = [10.0, 12.0, 30.0, NONE, 31.0, 40.0, 43.0, NONE, 43.0];
        let isolated = |epsilon1_px, epsilon2_px, run_columns_min| {
            let params = LineParams { epsilon1_px, epsilon2_px, run_columns_min, ..LineParams::default() };
            let mut isolated = Vec::new();
            find_isolated(&rows, &[1; 9], &params, &mut isolated);
            isolated
        };
        assert_eq!(isolated(5.0, 5.0, 2), [2, 4, 8]);
        assert_eq!(isolated(2.5, 2.5, 2), [2, 4, 5, 6, 8]);
        // ε₁ looks back, ε₂ ahead: the first of a pair has only ε₂.
        assert_eq!(isolated(2.5, 5.0, 2), [2, 4, 6, 8]);
        assert_eq!(isolated(5.0, 2.5, 2), [2, 4, 5, 8]);
        assert_eq!(isolated(5.0, 5.0, 3), [0, 1, 2, 4, 5, 6, 8]);
        // A lone peak with run_columns_min 1 is still lone.
        assert_eq!(isolated(5.0, 5.0, 1), [2, 4, 8]);
    }
}
