//! When a sensor has seen something: the same rule for both. A reading says that there is a surface somewhere in a set of
//! places (a point of the laser's; the arc of an ultrasonic cone at its range), and it is right about an obstacle if a
//! visible place of it is within the tolerance of that set, and if its light or sound truly came from there: a cone is wide,
//! and something else at the same range is no sighting.

use super::stage::{V3, in_cone, wrapped};
use crate::sources::Kind;

/// Neighbouring points that make a report of the laser's: a single one is noise.
pub(super) const POINTS_MIN: usize = 3;
/// Points of one report are at most this far apart from one to the next [m].
const JUMP_M: f64 = 0.1;
/// A way through is open if something is seen at least this far behind it [m].
const BEHIND_M: f64 = 0.2;
/// From post to post this much is not counted as open on each side [m].
const POST_M: f64 = 0.05;

/// A point of the laser's, as the robot truly stood.
#[derive(Clone, Copy, Debug)]
pub(super) struct LaserPoint {
    pub column: u16,
    pub at: V3,
    /// Where that column's line of sight truly met what was lit.
    pub truth: Option<V3>,
}

/// All points of a capture.
#[derive(Clone, Debug)]
pub(super) struct Slit {
    pub eye: V3,
    pub points: Vec<LaserPoint>,
}

/// A reading of the ring's.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cone {
    pub from: V3,
    /// Unit vector.
    pub axis: V3,
    pub half_rad: f64,
    pub range_m: f64,
    /// Where what it heard truly came from.
    pub truth: Option<V3>,
}

/// That something was seen, and how far off: range [m] and bearing [rad], where the truth of the reading is known.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Seen {
    pub error: Option<[f64; 2]>,
}

/// What counts when something is looked for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Terms {
    pub kind: Kind,
    pub tolerance_m: f64,
    pub clearance_m: f64,
    /// Height of the floor that the robot stands on [m].
    pub floor_m: f64,
}

impl Terms {
    fn near(&self, at: &V3, places: &[V3]) -> bool {
        places.iter().any(|place| (place - at).norm() <= self.tolerance_m)
    }
}

impl Slit {
    /// Whether the slit shows what has these visible places.
    pub fn sees(&self, places: &[V3], line: &[Vec<f64>], terms: &Terms) -> Option<Seen> {
        let near = |at: &V3| terms.near(at, places);
        let shows = |at: &V3| match terms.kind {
            Kind::Obstacle => at.z > terms.floor_m + terms.clearance_m && near(at),
            // A point under the floor: where its line of sight passes the floor's height there is none.
            Kind::Drop => {
                at.z < terms.floor_m - terms.clearance_m
                    && self.at_height(at, terms.floor_m).is_some_and(|at| near(&at))
            }
            Kind::Opening => is_behind(&self.eye, at, line),
        };
        let both = |p: &&LaserPoint| shows(&p.at) && p.truth.is_some_and(|truth| shows(&truth));
        let matched: Vec<&LaserPoint> = self.points.iter().filter(both).collect();
        if matched.len() < POINTS_MIN {
            return None;
        }
        let error = match terms.kind {
            Kind::Obstacle => self.error(&matched),
            _ => None,
        };
        Some(Seen { error })
    }

    /// Medians over the points whose truth is known.
    fn error(&self, matched: &[&LaserPoint]) -> Option<[f64; 2]> {
        let errors = matched.iter().filter_map(|p| Some(errors(&(p.at - self.eye), &(p.truth? - self.eye))));
        let (range, bearing): (Vec<f64>, Vec<f64>) = errors.map(|e| (e[0], e[1])).unzip();
        Some([middle(range)?, middle(bearing)?])
    }

    fn at_height(&self, point: &V3, z: f64) -> Option<V3> {
        let fall = self.eye.z - point.z;
        (fall > 0.0).then(|| self.eye + (point - self.eye) * ((self.eye.z - z) / fall))
    }

    /// What it says of obstacles: runs of neighbouring points over the floor, each the median place and whether most of it
    /// is explained.
    pub fn reports(&self, high_m: f64, explains: impl Fn(&V3) -> bool) -> Vec<(V3, bool)> {
        let high: Vec<&LaserPoint> = self.points.iter().filter(|p| p.at.z > high_m).collect();
        let apart = |a: &LaserPoint, b: &LaserPoint| b.column > a.column + 1 || (b.at - a.at).norm() > JUMP_M;
        high.chunk_by(|a, b| !apart(a, b))
            .filter(|run| run.len() >= POINTS_MIN)
            .map(|run| {
                let explained = run.iter().filter(|p| explains(&p.at)).count();
                (run[run.len() / 2].at, 2 * explained > run.len())
            })
            .collect()
    }
}

impl Cone {
    /// Whether the reading shows what has these visible places.
    pub fn sees(&self, places: &[V3], line: &[Vec<f64>], terms: &Terms) -> Option<Seen> {
        let hit = |at: &V3| in_cone(at, &self.from, &self.axis, self.half_rad, self.range_m, terms.tolerance_m);
        let truth = self.truth?;
        match terms.kind {
            Kind::Obstacle => (places.iter().any(hit) && terms.near(&truth, places))
                .then(|| Seen { error: Some(errors(&(self.axis * self.range_m), &(truth - self.from))) }),
            Kind::Drop => {
                // No range says that there is nothing; but one of the hole's near edge would stop a robot.
                let near = places.iter().map(|at| (at - self.from).norm()).min_by(f64::total_cmp)?;
                let at_edge = |at: &V3| (at - self.from).norm() <= near + terms.tolerance_m;
                (places.iter().any(|at| at_edge(at) && hit(at)) && terms.near(&truth, places)).then(Seen::default)
            }
            Kind::Opening => {
                let end = self.from + self.axis * self.range_m;
                (is_behind(&self.from, &end, line) && is_behind(&self.from, &truth, line)).then(Seen::default)
            }
        }
    }
}

/// How much farther, and how far to the left, a place is said to be than it truly is.
fn errors(said: &V3, truth: &V3) -> [f64; 2] {
    [said.norm() - truth.norm(), wrapped(said.y.atan2(said.x) - truth.y.atan2(truth.x))]
}

/// Whether the way to a place passes between two posts, and ends well behind them.
fn is_behind(from: &V3, to: &V3, line: &[Vec<f64>]) -> bool {
    crossing(from, to, line).is_some_and(|at| (to - at).xy().norm() >= BEHIND_M)
}

/// Where the way from one place to another passes between two posts, seen from above.
fn crossing(from: &V3, to: &V3, line: &[Vec<f64>]) -> Option<V3> {
    let [a, b] = line else { return None };
    let (a, b) = (V3::new(*a.first()?, *a.get(1)?, 0.0), V3::new(*b.first()?, *b.get(1)?, 0.0));
    let (way, posts) = (to - from, b - a);
    let det = way.x * posts.y - way.y * posts.x;
    if det.abs() < 1e-12 {
        return None;
    }
    let off = a - from;
    let (along, between) = ((off.x * posts.y - off.y * posts.x) / det, (off.x * way.y - off.y * way.x) / det);
    let margin = POST_M / posts.norm();
    (along > 0.0 && along < 1.0 && between > margin && between < 1.0 - margin).then(|| from + way * along)
}

/// The lower middle of numbers.
fn middle(mut numbers: Vec<f64>) -> Option<f64> {
    numbers.sort_by(f64::total_cmp);
    numbers.get(numbers.len().saturating_sub(1) / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TERMS: Terms = Terms { kind: Kind::Obstacle, tolerance_m: 0.15, clearance_m: 0.05, floor_m: 0.0 };

    fn slit(points: &[[f64; 3]]) -> Slit {
        let point = |(i, at): (usize, &[f64; 3])| LaserPoint {
            column: i as u16,
            at: V3::from(*at),
            truth: Some(V3::from(*at) - V3::x() * 0.02),
        };
        Slit { eye: V3::new(0.0, 0.0, 1.0), points: points.iter().enumerate().map(point).collect() }
    }

    fn cone(bearing_deg: f64, range_m: f64) -> Cone {
        let (sin, cos) = f64::to_radians(bearing_deg).sin_cos();
        let axis = V3::new(cos, sin, 0.0);
        let truth = Some(V3::new(range_m, 0.0, 0.4));
        Cone { from: V3::new(0.0, 0.0, 0.4), axis, half_rad: 15_f64.to_radians(), range_m, truth }
    }

    #[test]
    fn three_points_near_a_place_are_a_sighting_and_two_are_none() {
        let place = [V3::new(2.0, 0.0, 0.3)];
        let three = slit(&[[2.1, 0.0, 0.3], [2.0, 0.05, 0.3], [2.0, 0.1, 0.3]]);
        let seen = three.sees(&place, &[], &TERMS).unwrap();
        let [range, bearing] = seen.error.unwrap();
        assert!((0.017..0.02).contains(&range) && bearing.abs() < 1e-3, "{range} {bearing}");
        assert_eq!(slit(&[[2.1, 0.0, 0.3], [2.0, 0.05, 0.3]]).sees(&place, &[], &TERMS), None);
        // Light that truly came from elsewhere.
        let mut stray = three.clone();
        stray.points.iter_mut().for_each(|p| p.truth = Some(V3::new(3.0, 0.0, 0.3)));
        assert_eq!(stray.sees(&place, &[], &TERMS), None);
        // Beyond the tolerance, and on the floor.
        assert_eq!(slit(&[[2.2, 0.0, 0.3]; 5]).sees(&place, &[], &TERMS), None);
        assert_eq!(slit(&[[2.0, 0.0, 0.04]; 5]).sees(&[V3::new(2.0, 0.0, 0.0)], &[], &TERMS), None);
    }

    #[test]
    fn a_cone_sees_what_is_in_it_at_its_range_and_its_bearing_is_its_axis() {
        let place = [V3::new(2.0, 0.0, 0.4)];
        let seen = cone(10.0, 2.05).sees(&place, &[], &TERMS).unwrap();
        let [range, bearing] = seen.error.unwrap();
        assert!(range.abs() < 1e-9 && (bearing.to_degrees() - 10.0).abs() < 1e-9);
        // Something else at the same range, or nothing at all, is no sighting.
        let other = Cone { truth: Some(V3::new(1.9, 0.6, 0.4)), ..cone(10.0, 2.05) };
        assert_eq!(other.sees(&place, &[], &TERMS), None);
        assert_eq!(Cone { truth: None, ..cone(10.0, 2.05) }.sees(&place, &[], &TERMS), None);
        assert_eq!(cone(16.0, 2.0).sees(&place, &[], &TERMS), None);
        assert_eq!(cone(0.0, 1.8).sees(&place, &[], &TERMS), None);
        assert!(cone(0.0, 1.86).sees(&place, &[], &TERMS).is_some());
    }

    #[test]
    fn a_drop_is_where_a_line_of_sight_passes_the_floor() {
        let terms = Terms { kind: Kind::Drop, ..TERMS };
        // From 1 m up through (2, 0, 0) to a floor 0.5 m deeper: (3, 0, -0.5).
        let found = slit(&[[3.0, 0.0, -0.5]; 3]);
        assert!(found.sees(&[V3::new(1.9, 0.0, 0.0)], &[], &terms).is_some());
        assert_eq!(found.sees(&[V3::new(1.5, 0.0, 0.0)], &[], &terms), None);
        assert_eq!(slit(&[[2.0, 0.0, 0.0]; 3]).sees(&[V3::new(2.0, 0.0, 0.0)], &[], &terms), None);
    }

    #[test]
    fn a_way_through_is_seen_by_what_is_behind_it() {
        let terms = Terms { kind: Kind::Opening, ..TERMS };
        let posts = vec![vec![2.0, -0.3], vec![2.0, 0.3]];
        assert!(slit(&[[3.0, 0.0, 0.0]; 3]).sees(&[], &posts, &terms).is_some());
        assert_eq!(slit(&[[2.1, 0.0, 0.0]; 3]).sees(&[], &posts, &terms), None);
        assert_eq!(slit(&[[3.0, 0.6, 0.0]; 3]).sees(&[], &posts, &terms), None);
        assert!(cone(3.0, 3.0).sees(&[], &posts, &terms).is_some());
        assert_eq!(cone(3.0, 2.0).sees(&[], &posts, &terms), None);
        assert_eq!(cone(10.0, 3.0).sees(&[], &posts, &terms), None);
        assert_eq!(crossing(&V3::zeros(), &V3::x(), &[]), None);
    }

    #[test]
    fn a_report_is_a_run_of_points_and_is_false_if_most_of_it_is() {
        let mut line: Vec<[f64; 3]> = (0..10).map(|i| [2.0, f64::from(i) * 0.02, 0.3]).collect();
        line.extend((0..4).map(|i| [1.0, f64::from(i) * 0.02, 0.3]));
        line.extend([[3.0, 0.0, 0.3], [3.5, 0.0, 0.3]]);
        let reports = slit(&line).reports(0.05, |at| at.x > 1.5);
        assert_eq!(reports.iter().map(|r| r.1).collect::<Vec<_>>(), [true, false]);
        assert!(slit(&[]).reports(0.05, |_| true).is_empty());
    }
}
