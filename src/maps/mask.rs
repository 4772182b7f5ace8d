//! A set of cells as runs: morphology and counting without an array as large as the world.

use std::collections::BTreeMap;

/// Cells, line by line of x, as runs of y (both ends included), sorted and apart.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Mask {
    lines: BTreeMap<i32, Vec<(i32, i32)>>,
}

impl Mask {
    /// From cells in the order of their keys.
    pub fn new(cells: impl IntoIterator<Item = [i32; 2]>) -> Self {
        let mut lines = BTreeMap::<i32, Vec<(i32, i32)>>::new();
        for [x, y] in cells {
            let runs = lines.entry(x).or_default();
            match runs.last_mut() {
                Some((_, end)) if *end + 1 >= y => *end = y.max(*end),
                _ => runs.push((y, y)),
            }
        }
        Self { lines }
    }

    /// Fills holes and inlets less than 2·`reach` + 1 cells wide (closing with a square).
    pub fn closed(&self, reach: i32) -> Self {
        self.dilated(reach).eroded(reach)
    }

    /// How many cells of a line are in the set, from y `low` to `high`.
    pub fn count(&self, x: i32, low: i32, high: i32) -> u64 {
        let Some(runs) = self.lines.get(&x) else { return 0 };
        let from = runs.partition_point(|run| run.1 < low);
        let within = runs[from..].iter().take_while(|run| run.0 <= high);
        within.map(|run| (run.1.min(high) - run.0.max(low) + 1) as u64).sum()
    }

    /// Whether a cell is in the set.
    pub fn has(&self, [x, y]: [i32; 2]) -> bool {
        self.count(x, y, y) == 1
    }

    fn dilated(&self, reach: i32) -> Self {
        let mut wide = BTreeMap::<i32, Vec<(i32, i32)>>::new();
        for (x, runs) in &self.lines {
            let longer = runs.iter().map(|run| (run.0 - reach, run.1 + reach));
            (x - reach..=x + reach).for_each(|x| wide.entry(x).or_default().extend(longer.clone()));
        }
        for runs in wide.values_mut() {
            runs.sort_unstable();
            let mut merged = Vec::<(i32, i32)>::with_capacity(runs.len());
            for run in runs.iter() {
                match merged.last_mut() {
                    Some(last) if run.0 <= last.1 + 1 => last.1 = last.1.max(run.1),
                    _ => merged.push(*run),
                }
            }
            *runs = merged;
        }
        Self { lines: wide }
    }

    fn eroded(&self, reach: i32) -> Self {
        let none = Vec::new();
        let line = |x: i32| self.lines.get(&x).unwrap_or(&none);
        let narrow = self.lines.keys().map(|x| {
            let common = (x - reach..=x + reach).fold(line(*x).clone(), |common, x| intersection(&common, line(x)));
            let shorter = common.iter().map(|run| (run.0 + reach, run.1 - reach)).filter(|run| run.0 <= run.1);
            (*x, shorter.collect::<Vec<_>>())
        });
        Self { lines: narrow.filter(|(_, runs)| !runs.is_empty()).collect() }
    }
}

/// What two lines have in common.
fn intersection(a: &[(i32, i32)], b: &[(i32, i32)]) -> Vec<(i32, i32)> {
    let (mut i, mut j, mut common) = (0, 0, Vec::new());
    while let (Some(one), Some(other)) = (a.get(i), b.get(j)) {
        let both = (one.0.max(other.0), one.1.min(other.1));
        if both.0 <= both.1 {
            common.push(both);
        }
        if one.1 < other.1 { i += 1 } else { j += 1 }
    }
    common
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    proptest! {
        #[test]
        fn closing_is_what_its_definition_says(
            cells in prop::collection::btree_set(prop::array::uniform2(-12..12i32), 0..60), reach in 0..4i32,
        ) {
            let square = |[x, y]: [i32; 2]| (-reach..=reach).flat_map(move |i| (-reach..=reach).map(move |j| [x + i, y + j]));
            let wide: BTreeSet<[i32; 2]> = cells.iter().flat_map(|cell| square(*cell)).collect();
            let closed = Mask::new(cells.iter().copied()).closed(reach);
            for x in -20..20 {
                let expected: Vec<bool> = (-20..20).map(|y| square([x, y]).all(|cell| wide.contains(&cell))).collect();
                for (y, expected) in (-20..20).zip(&expected) {
                    prop_assert_eq!(closed.has([x, y]), *expected, "{:?}", (x, y));
                }
                let counted = expected.iter().filter(|covered| **covered).count() as u64;
                prop_assert_eq!(closed.count(x, -20, 19), counted);
            }
        }
    }
}
