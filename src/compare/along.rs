//! A ring carried around the goals of a scenario: what it reads, row by row.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crate::fault::{Fault, Result};
use crate::geometry::{Robot, Transform, World};
use crate::navigation::{FollowParams, Step};
use crate::sonar::{Ring, RingParams, Targets};
use crate::sources::Scenario;
use crate::time::Stamp;

/// Rows of a run. Every run has noise and air of its own, and can be worked out beside the others.
const ROWS: usize = 24;
/// Most runs; along a longer way as many, evenly spread.
const RUNS_MAX: usize = 40;
/// Most steps of the ring's schedule around the goals.
const STEPS_MAX: f64 = 1e6;

/// Rows in the order of time, a reading [m] of every transducer in each (`None`: no echo).
pub type Rows = Vec<Vec<Option<f64>>>;

/// A ring, its world, and where the robot is at each step of the ring's schedule.
pub struct Round {
    ring: RingParams,
    seed: u64,
    targets: Targets,
    poses: Vec<Transform<World, Robot>>,
}

/// Straight from a goal to the next.
struct Leg {
    from: [f64; 2],
    to: [f64; 2],
    /// Speed [m/s].
    speed_m_s: f64,
}

impl Round {
    /// Around the scenario's goals and back to the first, turning on the spot at each; as fast as the mission says and the
    /// robot can. Nothing in the world moves.
    ///
    /// # Errors
    /// A scenario without a ring, one whose mission is not of two goals or more and nothing else, a way that takes too long
    /// or is too short for two rows.
    pub fn new(scenario: &Scenario) -> Result<Self> {
        let ring = scenario.sonar.ok_or_else(|| {
            Fault::new("sonar", "nothing", "a table [sonar]: the ring whose readings are held against recorded ones")
        })?;
        let follow = FollowParams::default();
        let turn_rad_s = follow.turn_rad_s.min(scenario.robot.turn_rad_s_max);
        let goal = |step: &Step| match step {
            Step::GoTo { to_m, speed_m_s } => {
                Ok((*to_m, speed_m_s.unwrap_or(follow.speed_m_s).min(scenario.robot.speed_m_s_max)))
            }
            _ => {
                Err(Fault::new("mission", "a step that is no goal", "go_to only: the ring is carried around the goals"))
            }
        };
        let goals: Vec<([f64; 2], f64)> = scenario.mission.steps.iter().map(goal).collect::<Result<_>>()?;
        let next = goals.iter().cycle().skip(1);
        let legs = goals.iter().zip(next).map(|((from, _), (to, speed_m_s))| Leg {
            from: *from,
            to: *to,
            speed_m_s: *speed_m_s,
        });
        let legs: Vec<Leg> = legs.filter(|leg| leg.from != leg.to).collect();
        let poses = poses(&legs, scenario.robot.start_yaw(), turn_rad_s, ring.interval_s)?;
        let rows = poses.len() / ring.schedule.steps(ring.count);
        if rows < 3 {
            let expected = "goals so far apart that the ring goes round three times on its way around them";
            return Err(Fault::new("mission", format!("a way of {rows} rows of readings"), expected));
        }
        Ok(Self { ring, seed: scenario.seed, targets: Targets::new(&scenario.scene)?, poses })
    }

    /// The poses of each run. A run begins with the last row of the one before: it only fills the room with echoes.
    fn runs(&self) -> Vec<&[Transform<World, Robot>]> {
        let steps = self.ring.schedule.steps(self.ring.count);
        let rows = self.poses.len() / steps;
        let all: Vec<_> = (0..rows - 1)
            .step_by(ROWS)
            .map(|first| &self.poses[first * steps..(first + ROWS + 1).min(rows) * steps])
            .collect();
        let every = all.len().div_ceil(RUNS_MAX);
        all.into_iter().step_by(every).collect()
    }

    /// What the ring reads, run by run; `None` if `stop` ended it. `progress` hears how many thousandths are done. The
    /// result does not depend on the number of threads.
    ///
    /// # Errors
    /// What the ring cannot do.
    pub fn read(
        &self,
        threads: usize,
        stop: &AtomicBool,
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<Option<Vec<Rows>>> {
        let runs = self.runs();
        let (next, done) = (AtomicUsize::new(0), Mutex::new(BTreeMap::new()));
        let work = || {
            loop {
                let index = next.fetch_add(1, Ordering::SeqCst);
                let Some(poses) = runs.get(index).filter(|_| !stop.load(Ordering::SeqCst)) else { return };
                let rows = self.run(index, poses);
                if let Ok(mut done) = done.lock() {
                    done.insert(index, rows);
                    progress(done.len() as u64 * 1000 / runs.len() as u64);
                }
            }
        };
        std::thread::scope(|scope| {
            for _ in 0..threads.clamp(1, runs.len()) {
                scope.spawn(work);
            }
        });
        let done = done.into_inner().unwrap_or_default();
        if done.len() < runs.len() {
            return Ok(None);
        }
        done.into_values().collect::<Result<_>>().map(Some)
    }

    fn run(&self, index: usize, poses: &[Transform<World, Robot>]) -> Result<Rows> {
        let mut ring = Ring::new(self.ring, self.seed.wrapping_add(index as u64))?;
        let steps = self.ring.schedule.steps(self.ring.count);
        let mut rows = Rows::new();
        for (row, poses) in poses.chunks_exact(steps).enumerate() {
            let mut readings = vec![None; self.ring.count];
            for (step, pose) in poses.iter().enumerate() {
                let stamp = Stamp::from_secs((row * steps + step) as f64 * self.ring.interval_s);
                for ping in ring.fire(stamp, pose, &self.targets)? {
                    readings[ping.reading.transducer] = ping.reading.range_m();
                }
            }
            rows.push(readings);
        }
        rows.remove(0);
        Ok(rows)
    }
}

/// The robot's pose every `step_s`: along the legs, turning on the spot before each.
fn poses(legs: &[Leg], mut yaw: f64, turn_rad_s: f64, step_s: f64) -> Result<Vec<Transform<World, Robot>>> {
    let mut out = Vec::new();
    for Leg { from, to, speed_m_s } in legs {
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let turn = dy.atan2(dx) - yaw;
        let turn = turn.sin().atan2(turn.cos());
        let (turns, steps) = (turn.abs() / turn_rad_s / step_s, dx.hypot(dy) / speed_m_s / step_s);
        if out.len() as f64 + turns + steps > STEPS_MAX {
            let expected = format!("at most {STEPS_MAX}: goals nearer to each other, or a faster robot");
            return Err(Fault::new("mission", format!("a way of more than {STEPS_MAX} pings"), expected));
        }
        let (turns, steps) = (turns as usize, steps as usize);
        out.extend((0..turns).map(|i| Transform::planar(from[0], from[1], yaw + turn * i as f64 / turns as f64)));
        yaw += turn;
        let at = |i: usize| i as f64 / steps as f64;
        out.extend((0..steps).map(|i| Transform::planar(from[0] + dx * at(i), from[1] + dy * at(i), yaw)));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    const WORLD: &str = "name = 'w'\n[world]\nground = true\n[[world.box]]\nname = 'wall'\nposition = [2, 0]\n\
        size = [0.1, 4, 2]\n[sonar]\ncount = 4\n[robot]\nturn_rad_s_max = 0.5\n";

    fn scenario(more: &str) -> Scenario {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("w.toml");
        std::fs::write(&path, format!("{WORLD}{more}")).unwrap();
        Scenario::load(&path, &[]).unwrap()
    }

    fn fault(scenario: &Scenario) -> String {
        Round::new(scenario).err().unwrap().to_string()
    }

    #[test]
    fn the_robot_goes_around_its_goals_as_fast_as_the_file_says() {
        let round = Round::new(&scenario(
            "[[mission]]\ngo_to = [0, 0]\n[[mission]]\ngo_to = [0, 0]\n[[mission]]\ngo_to = [1, 0]\nspeed_m_s = 0.1\n",
        ))
        .unwrap();
        // There at 0.1 m/s, about at 0.5 rad/s, back at the usual 0.3 m/s: pings every 65 ms.
        let expected = [10.0, std::f64::consts::PI / 0.5, 1.0 / 0.3].map(|s| (s / 0.065) as usize);
        assert_eq!(round.poses.len(), expected.iter().sum::<usize>());
        let at = |i: usize| round.poses[i].xyz();
        assert!((at(77)[0] - 0.5).abs() < 0.01 && (at(expected[0] + 3)[0] - 1.0).abs() < 1e-12);

        let stop = AtomicBool::new(false);
        let read = |threads| round.read(threads, &stop, &|_| {}).unwrap().unwrap();
        let (one, two) = (read(1), read(2));
        assert_eq!(one, two);
        let rows = round.poses.len() / 4;
        assert_eq!(one.iter().map(Vec::len).sum::<usize>(), rows - 1);
        // The first reading ahead is the wall's, 1.95 m from the robot's middle, which the ring is 0.3 m before.
        let ahead = one[0][0][0].unwrap();
        assert!((ahead - 1.65).abs() < 0.1, "{ahead}");
        stop.store(true, Ordering::SeqCst);
        assert_eq!(round.read(2, &stop, &|_| {}).unwrap(), None);
    }

    #[test]
    fn ways_that_cannot_be_gone_are_refused() {
        assert!(fault(&scenario("[[mission]]\ngo_to = [1, 0]\n")).starts_with("mission: found a way of 0 rows"));
        assert!(fault(&scenario("[[mission]]\nwait_s = 3\n")).starts_with("mission: found a step that is no goal"));
        let slow = "[[mission]]\ngo_to = [0, 0]\n[[mission]]\ngo_to = [1, 0]\nspeed_m_s = 1e-300\n";
        assert!(fault(&scenario(slow)).starts_with("mission: found a way of more than 1000000 pings"));
        let mut deaf = scenario("");
        deaf.sonar = None;
        assert!(fault(&deaf).starts_with("sonar: found nothing"));
    }
}
