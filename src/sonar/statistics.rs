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
        let bins = vec![0; (limit_m / BIN_M).round() as usize + 1];
        Self { limit_m, readings: 0, dropped: 0, steps: 0, jumps: 0, ranges: bins.clone(), changes: bins }
    }

    /// Counts a run: rows in the order of time, each with a reading [m] of every transducer (`None`: no echo).
    pub fn add_run<R: AsRef<[Option<f64>]>>(&mut self, rows: &[R]) {
        let cut = |reading: &Option<f64>| reading.map_or(self.limit_m, |r| r.clamp(0.0, self.limit_m));
        let rows: Vec<Vec<f64>> = rows.iter().map(|row| row.as_ref().iter().map(cut).collect()).collect();
        for row in &rows {
            for range in row {
                self.readings += 1;
                self.dropped += u64::from(*range >= self.limit_m);
                count(&mut self.ranges, *range);
            }
        }
        for pair in rows.windows(2) {
            for (before, after) in pair[0].iter().zip(&pair[1]) {
                let change = (after - before).abs();
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
    use std::path::Path;

    use nalgebra::{Isometry3, Vector3};
    use serde::Deserialize;

    use super::*;
    use crate::geometry::{Robot, Transform, World};
    use crate::sonar::{Ring, RingParams, Targets};
    use crate::time::Stamp;
    use crate::world::{Source, WorldSpec};

    #[test]
    fn dropouts_and_jumps_are_counted() {
        let mut s = RangeStatistics::new(5.0);
        assert_eq!((s.dropout_rate(), s.jump_rate()), (None, None));
        s.add_run(&[vec![Some(1.0), None], vec![Some(2.5), Some(7.0)], vec![Some(2.4), Some(4.9)]]);
        assert_eq!((s.readings, s.dropped, s.steps, s.jumps), (6, 2, 4, 1));
        assert_eq!((s.ranges[10], s.ranges[50], s.ranges[49], s.changes[15], s.changes[0]), (1, 2, 1, 1, 1));
        assert_eq!(s.changes.iter().sum::<u64>(), 4);
        assert_eq!(RangeStatistics::new(f64::NAN).limit_m, 100.0);
    }

    /// The recording of 24 transducers: 5456 rows.
    fn recorded() -> Option<RangeStatistics> {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data/sonar_ring/sensor_readings_24.data");
        let text = std::fs::read_to_string(Path::new(file)).ok()?;
        let row = |line: &str| line.split(',').take(24).map(|v| v.parse().ok()).collect::<Vec<Option<f64>>>();
        let rows: Vec<_> = text.lines().skip(1).map(row).collect();
        assert_eq!(rows.len(), 5456);
        let mut statistics = RangeStatistics::new(5.0);
        statistics.add_run(&rows);
        Some(statistics)
    }

    #[derive(Deserialize)]
    struct Goal {
        go_to: [f64; 2],
    }

    #[derive(Deserialize)]
    struct Room {
        world: WorldSpec,
        sonar: RingParams,
        mission: Vec<Goal>,
    }

    /// The robot's pose at each time: along the goals at 0.1 m/s, turning on the spot at 0.165 rad/s.
    fn poses(goals: &[[f64; 2]], step_s: f64) -> Vec<Transform<World, Robot>> {
        let (speed, rate) = (0.1, 0.165);
        let mut out = Vec::new();
        let mut yaw = 0.0;
        for (from, to) in goals.iter().zip(goals.iter().cycle().skip(1)) {
            let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
            let turn = dy.atan2(dx) - yaw;
            let turn = turn.sin().atan2(turn.cos());
            let turns = (turn.abs() / rate / step_s) as usize;
            out.extend((0..turns).map(|i| (from[0], from[1], yaw + turn * i as f64 / turns as f64)));
            yaw += turn;
            let steps = (dx.hypot(dy) / speed / step_s) as usize;
            let at = |i: usize| i as f64 / steps as f64;
            out.extend((0..steps).map(|i| (from[0] + dx * at(i), from[1] + dy * at(i), yaw)));
        }
        let pose = |(x, y, yaw)| Isometry3::new(Vector3::new(x, y, 0.0), Vector3::new(0.0, 0.0, yaw)).into();
        out.into_iter().map(pose).collect()
    }

    /// Readings along the round, in runs of `rows` with `skipped` rows between two of them.
    fn simulated(rows: usize, skipped: usize) -> RangeStatistics {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("worlds/sonar_room.toml");
        let source = Source::read(&file, &[]).unwrap();
        let room: Room = toml::from_str(&source.text).unwrap();
        let targets = Targets::new(&room.world.build(&source).unwrap()).unwrap();
        let goals: Vec<[f64; 2]> = room.mission.iter().map(|goal| goal.go_to).collect();
        let params = room.sonar;
        let groups = params.schedule.steps(params.count);
        let poses = poses(&goals, params.interval_s);
        let mut statistics = RangeStatistics::new(5.0);
        let run = groups * (rows + skipped);
        for (number, leg) in poses.chunks_exact(run).enumerate() {
            let mut ring = Ring::new(params, number as u64).unwrap();
            let mut table = Vec::new();
            // The first row only fills the room with echoes.
            for (row, poses) in leg[..groups * (rows + 1).min(run / groups)].chunks_exact(groups).enumerate() {
                let mut readings = vec![None; params.count];
                for (step, pose) in poses.iter().enumerate() {
                    let stamp = Stamp::from_secs((row * groups + step) as f64 * params.interval_s);
                    for ping in ring.fire(stamp, pose, &targets).unwrap() {
                        readings[ping.reading.transducer] = ping.reading.range_m();
                    }
                }
                table.push(readings);
            }
            statistics.add_run(&table[1..]);
        }
        statistics
    }

    #[test]
    fn a_robot_along_the_walls_of_a_room_reads_what_a_real_one_read() {
        let found = simulated(8, 40);
        let (drops, jumps) = (found.dropout_rate().unwrap(), found.jump_rate().unwrap());
        eprintln!(
            "simulated: {} readings, {:.2} % at the limit, {:.2} % jumps",
            found.readings,
            100.0 * drops,
            100.0 * jumps
        );
        eprintln!("simulated: {}", serde_json::to_string(&found).unwrap());
        let Some(real) = recorded() else {
            eprintln!("skipped: ../shared/data is absent");
            return;
        };
        eprintln!("recorded: {}", serde_json::to_string(&real).unwrap());
        let (real_drops, real_jumps) = (real.dropout_rate().unwrap(), real.jump_rate().unwrap());
        assert!((real_drops - 0.138).abs() < 1e-3 && (real_jumps - 0.0598).abs() < 1e-3, "{real_drops} {real_jumps}");
        let within = |found: f64, real: f64| (real / 2.0..=real * 2.0).contains(&found);
        assert!(within(drops, real_drops), "{drops} at the limit, {real_drops} recorded");
        assert!(within(jumps, real_jumps), "{jumps} jumps, {real_jumps} recorded");
    }
}
