//! What a ring's readings look like on the whole: how often there is none, and how often it jumps.

use serde::Serialize;

/// Width of a bin of the histograms [m].
pub const BIN_M: f64 = 0.1;
/// A reading that changes by more than this is a jump [m].
pub const JUMP_M: f64 = 1.0;

/// Counts over readings that are cut off at a limit, and over the steps from each reading to the next one of the same
/// transducer.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RangeStatistics {
    /// Where readings are cut off [m]; no echo counts as this.
    pub limit_m: f64,
    /// Readings in all.
    pub readings: u64,
    /// Readings at the limit.
    pub dropped: u64,
    /// Steps in all.
    pub steps: u64,
    /// Steps of more than a metre.
    pub jumps: u64,
    /// Readings per bin of range; those at the limit are in the last one.
    pub ranges: Vec<u64>,
    /// Steps per bin of |change|.
    pub changes: Vec<u64>,
}

impl RangeStatistics {
    /// Nothing counted yet. A limit that is not from 0.1 to 100 m is taken as the nearest that is.
    pub fn new(limit_m: f64) -> Self {
        let limit_m = if limit_m.is_nan() { 100.0 } else { limit_m.clamp(BIN_M, 100.0) };
        let bins = vec![0; (limit_m / BIN_M - 1e-9).ceil() as usize + 1];
        Self { limit_m, readings: 0, dropped: 0, steps: 0, jumps: 0, ranges: bins.clone(), changes: bins }
    }

    /// Counts a run: rows in the order of time, each with a reading [m] of every transducer (`None`: no echo).
    pub fn add_run<R: AsRef<[C]>, C: Copy + Into<Option<f64>>>(&mut self, rows: &[R]) {
        let limit_m = self.limit_m;
        let cut = |reading: &C| (*reading).into().map_or(limit_m, |range| range.clamp(0.0, limit_m));
        for range in rows.iter().flat_map(|row| row.as_ref()).map(cut) {
            self.readings += 1;
            self.dropped += u64::from(range >= limit_m);
            count(&mut self.ranges, if range >= limit_m { f64::INFINITY } else { range });
        }
        for pair in rows.windows(2) {
            for (before, after) in pair[0].as_ref().iter().zip(pair[1].as_ref()) {
                let change = (cut(after) - cut(before)).abs();
                self.steps += 1;
                self.jumps += u64::from(change > JUMP_M);
                count(&mut self.changes, change);
            }
        }
    }

    /// Share of readings at the limit; `None` without readings.
    pub fn dropout_rate(&self) -> Option<f64> {
        (self.readings > 0).then(|| self.dropped as f64 / self.readings as f64)
    }

    /// Share of steps of more than a metre; `None` without steps.
    pub fn jump_rate(&self) -> Option<f64> {
        (self.steps > 0).then(|| self.jumps as f64 / self.steps as f64)
    }
}

fn count(bins: &mut [u64], value: f64) {
    let last = bins.len().saturating_sub(1);
    if let Some(bin) = bins.get_mut(((value / BIN_M + 1e-9) as usize).min(last)) {
        *bin += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dropouts_and_jumps_are_counted() {
        let mut s = RangeStatistics::new(5.0);
        assert_eq!((s.dropout_rate(), s.jump_rate()), (None, None));
        s.add_run(&[vec![Some(1.0), None], vec![Some(2.5), Some(7.0)], vec![Some(2.4), Some(4.9)]]);
        assert_eq!((s.readings, s.dropped, s.steps, s.jumps), (6, 2, 4, 1));
        assert_eq!((s.ranges[10], s.ranges[50], s.ranges[49], s.changes[15], s.changes[0]), (1, 2, 1, 1, 1));
        assert_eq!(s.changes.iter().sum::<u64>(), 4);
        assert_eq!(RangeStatistics::new(f64::NAN).limit_m, 100.0);
        // The last bin is for the limit alone, wherever it lies.
        for limit_m in [4.94, 4.96, 5.0] {
            let mut s = RangeStatistics::new(limit_m);
            s.add_run(&[vec![Some(4.93), Some(limit_m)]]);
            assert_eq!((s.ranges.last(), s.ranges[49]), (Some(&1), 1), "{limit_m}");
        }
    }
}
