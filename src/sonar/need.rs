//! What an echo needs to be of any use, so that the search for echoes may stop early.

use super::transducer::Transducer;

/// Width of a cell of the table [m].
const CELL_M: f64 = 0.02;

/// The least amplitude, without air, that an echo may have, by its way.
#[derive(Clone, Debug)]
pub(super) struct Need {
    /// Per cell of the way; ∞ where nothing is listened for.
    table: Vec<f64>,
    /// The least up to each cell.
    least: Vec<f64>,
    ratio_min: f64,
    /// The longest way that matters [m].
    pub way_m_max: f64,
}

impl Need {
    /// For echoes of a ping that began `delay_s` before the receiver's own; `share` of the threshold is enough.
    pub fn new(it: &Transducer, delay_s: f64, share: f64) -> Self {
        let way_m_max = (it.last_s() + delay_s) * it.sound_m_s;
        let count = (way_m_max / CELL_M) as usize + 2;
        let table: Vec<f64> = (0..count)
            .map(|i| {
                // An echo counts from its beginning in the cell to its end.
                let begin = i as f64 * CELL_M / it.sound_m_s - delay_s;
                let end = begin + CELL_M / it.sound_m_s + it.echo_s();
                let moments = [begin, end, begin.max(it.params.blanking_s), (begin + end) / 2.0];
                let threshold = moments.iter().filter(|t| **t >= begin && **t <= end).map(|t| it.threshold(*t));
                share * threshold.fold(f64::INFINITY, f64::min) / it.air_leaves(i as f64 * CELL_M)
            })
            .collect();
        let least = table.iter().scan(f64::INFINITY, |least, need| {
            *least = need.min(*least);
            Some(*least)
        });
        let least = least.collect();
        let ratio = |(i, need): (usize, &f64)| need * (i as f64 * CELL_M).max(CELL_M) / 2.0;
        let ratio_min = table.iter().enumerate().map(ratio).fold(f64::INFINITY, f64::min);
        Self { table, least, ratio_min, way_m_max }
    }

    /// What an echo by a way of this length [m] needs.
    pub fn at(&self, way_m: f64) -> f64 {
        self.table.get((way_m / CELL_M) as usize).copied().unwrap_or(f64::INFINITY)
    }

    /// No echo by a way of at most this length needs less.
    pub fn least(&self, way_m: f64) -> f64 {
        let last = self.least.last().copied().unwrap_or(f64::INFINITY);
        self.least.get((way_m / CELL_M) as usize).copied().unwrap_or(last)
    }

    /// What is the least share of a wall's echo that is heard anywhere.
    pub fn ratio_min(&self) -> f64 {
        self.ratio_min
    }

    /// Whether even a wall square to the beam can be heard.
    pub fn hopeless(&self) -> bool {
        self.ratio_min > 1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sonar::{Air, TransducerParams};

    #[test]
    fn a_wall_in_range_is_wanted_and_what_comes_too_early_or_late_is_not() {
        let it = Transducer::new(TransducerParams::default(), &Air::default()).unwrap();
        let need = Need::new(&it, 0.0, 1.0);
        assert!(need.at(0.5).is_infinite() && need.at(2.0) < 1.0 && need.at(22.0).is_infinite());
        assert!(need.least(4.0) <= need.at(4.0) && need.least(1e9) <= need.at(20.0));
        assert!(!need.hopeless());
        // A ping 65 ms ago is past hearing, one 28 ms ago is not.
        assert!(Need::new(&it, 0.065, 1.0).hopeless());
        assert!(!Need::new(&it, 0.028, 1.0).hopeless());
    }
}
