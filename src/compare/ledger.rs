//! What happened in one run, obstacle by obstacle: when each was in play, and when each sensor said so.

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use super::matching::{Cone, Seen, Slit, Terms};
use super::stage::{Stage, V3, View, wrapped};
use crate::fault::Result;
use crate::geometry::{Robot, Transform, World};
use crate::time::Stamp;

/// The two sensors, in this order wherever there is one of each.
pub const SENSORS: [&str; 2] = ["laser", "ultrasonic"];
/// Index of the laser.
pub const LASER: usize = 0;
/// Index of the ring.
pub const ULTRASONIC: usize = 1;
/// Width of a bin of distance [m].
pub const BIN_M: f64 = 0.5;

/// What is in play is looked up this often [s].
const LOOK_S: f64 = 0.2;
/// What was out of play for this long has left [s].
const LEFT_S: f64 = 1.5;
/// A report belongs to an obstacle whose bearings it is this near to [rad].
const BESIDE_RAD: f64 = 0.09;

/// One approach of the robot to one obstacle: from when it comes into play to when it leaves.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Encounter {
    /// The obstacle.
    pub target: String,
    /// When it came into play [s].
    pub from_s: f64,
    /// How long it was in play [s].
    pub seconds: f64,
    /// Time in each bin of distance [s], by the bin's number.
    pub bins: BTreeMap<u32, f64>,
    /// What each sensor made of it.
    pub by: [Account; 2],
}

/// What one sensor made of one encounter.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Account {
    /// Sightings in each bin of distance.
    pub seen: BTreeMap<u32, u64>,
    /// Distance at the first sighting [m].
    pub first_m: Option<f64>,
    /// Time from coming into play to the first sighting [s].
    pub first_s: Option<f64>,
    /// Sum of squared errors of range [m²], of bearing [rad²], and how many.
    pub range_m2: f64,
    /// Sum of squared errors of bearing [rad²].
    pub bearing_rad2: f64,
    /// How many errors are in the sums.
    pub errors: u64,
    /// Obstacles reported in its direction while it was in play.
    pub reports: u64,
    /// Of these, explained by no surface.
    pub false_reports: u64,
}

/// What one sensor reported over a whole run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reports {
    /// Obstacles reported.
    pub reports: u64,
    /// Of these, explained by no surface.
    pub false_reports: u64,
    /// Seconds with a report.
    pub seconds: u64,
    /// Seconds with a false one.
    pub false_seconds: u64,
}

/// An encounter under way.
struct Open {
    class: String,
    encounter: Encounter,
    /// When it was last in play.
    last_s: f64,
    view: View,
    /// Whether it is in play now.
    in_play: bool,
}

/// The book of one run.
pub(super) struct Ledger {
    pub stage: Stage,
    open: Vec<Option<Open>>,
    looked_s: Option<f64>,
    foot: V3,
    /// Encounters by class.
    pub classes: BTreeMap<String, Vec<Encounter>>,
    pub reports: [Reports; 2],
    /// The second of the last report, and of the last false one.
    counted: [[Option<i64>; 2]; 2],
}

impl Ledger {
    pub fn new(stage: Stage) -> Self {
        Self {
            open: stage.sites.iter().map(|_| None).collect(),
            stage,
            looked_s: None,
            foot: V3::zeros(),
            classes: BTreeMap::new(),
            reports: Default::default(),
            counted: Default::default(),
        }
    }

    /// Looks at the world as it is at a time.
    pub fn look(
        &mut self,
        stamp: Stamp,
        world_from_robot: &Transform<World, Robot>,
        moved: &[(usize, Isometry3<f64>)],
    ) -> Result<()> {
        let now_s = stamp.as_secs();
        let since = self.looked_s.map_or(f64::INFINITY, |last| now_s - last);
        self.stage.set(now_s, moved)?;
        if since < LOOK_S {
            for (site, open) in self.stage.sites.iter().zip(&mut self.open) {
                let Some(open) = open.as_mut().filter(|open| open.in_play && self.stage.moves(site)) else { continue };
                if let Some(view) = self.stage.view(site, world_from_robot) {
                    open.view = view;
                }
            }
            return Ok(());
        }
        let speed = if since.is_finite() { (world_from_robot.xyz() - self.foot).norm() / since } else { 0.0 };
        let fast = speed > self.stage.params.fast_m_s;
        (self.looked_s, self.foot) = (Some(now_s), world_from_robot.xyz());
        for index in 0..self.stage.sites.len() {
            let site = &self.stage.sites[index];
            let class = if fast { site.params.fast_class.as_ref() } else { Some(&site.params.class) }.cloned();
            let view = class.and_then(|class| Some((class, self.stage.view(site, world_from_robot)?)));
            self.enter(index, now_s, since, view);
        }
        Ok(())
    }

    fn enter(&mut self, index: usize, now_s: f64, since: f64, view: Option<(String, View)>) {
        let stays = |open: &Open| view.as_ref().is_none_or(|(class, _)| *class == open.class);
        if self.open[index].as_ref().is_some_and(|open| !stays(open) || now_s - open.last_s > LEFT_S) {
            self.close(index);
        }
        let Some((class, view)) = view else {
            if let Some(open) = &mut self.open[index] {
                open.in_play = false;
            }
            return;
        };
        let bin = (view.distance_m / BIN_M) as u32;
        match &mut self.open[index] {
            Some(open) => {
                if open.in_play {
                    open.encounter.seconds += since;
                    *open.encounter.bins.entry(bin).or_default() += since;
                }
                (open.last_s, open.view, open.in_play) = (now_s, view, true);
            }
            empty => {
                let target = self.stage.sites[index].params.name.clone();
                let encounter = Encounter { target, from_s: now_s, ..Encounter::default() };
                *empty = Some(Open { class, encounter, last_s: now_s, view, in_play: true });
            }
        }
    }

    fn close(&mut self, index: usize) {
        if let Some(open) = self.open[index].take()
            && open.encounter.seconds >= self.stage.params.bin_s_min
        {
            self.classes.entry(open.class).or_default().push(open.encounter);
        }
    }

    /// Takes a capture.
    pub fn slit(&mut self, stamp: Stamp, slit: &Slit) {
        self.sighted(LASER, stamp, |line, places, terms| slit.sees(places, line, terms));
        let high_m = self.foot.z + self.stage.params.clearance_m;
        let reports = slit.reports(high_m, |at| self.stage.explains_place(at));
        for (at, explained) in reports {
            self.reported(LASER, stamp, &at, explained);
        }
    }

    /// Takes a reading.
    pub fn cone(&mut self, stamp: Stamp, cone: &Cone) {
        self.sighted(ULTRASONIC, stamp, |line, places, terms| cone.sees(places, line, terms));
        let explained = self.stage.explains_range(&cone.from, &cone.axis, cone.half_rad, cone.range_m);
        self.reported(ULTRASONIC, stamp, &(cone.from + cone.axis * cone.range_m), explained);
    }

    fn sighted(&mut self, sensor: usize, stamp: Stamp, sees: impl Fn(&[Vec<f64>], &[V3], &Terms) -> Option<Seen>) {
        let params = &self.stage.params;
        for (site, open) in self.stage.sites.iter().zip(&mut self.open) {
            let Some(open) = open.as_mut().filter(|open| open.in_play) else { continue };
            let terms = Terms {
                kind: site.params.kind,
                tolerance_m: params.tolerance_m,
                clearance_m: params.clearance_m,
                floor_m: self.foot.z,
            };
            let Some(seen) = sees(&site.params.line, &open.view.places, &terms) else { continue };
            let account = &mut open.encounter.by[sensor];
            *account.seen.entry((open.view.distance_m / BIN_M) as u32).or_default() += 1;
            account.first_m.get_or_insert(open.view.distance_m);
            account.first_s.get_or_insert((stamp.as_secs() - open.encounter.from_s).max(0.0));
            if let Some([range, bearing]) = seen.error {
                account.range_m2 += range * range;
                account.bearing_rad2 += bearing * bearing;
                account.errors += 1;
            }
        }
    }

    /// A report of something at a place; what is said to be farther than anything is looked for is not judged.
    fn reported(&mut self, sensor: usize, stamp: Stamp, at: &V3, explained: bool) {
        let way = at - self.foot;
        let bearing = way.y.atan2(way.x);
        if way.xy().norm() > self.stage.params.range_m {
            return;
        }
        let all = &mut self.reports[sensor];
        let second = stamp.as_secs() as i64;
        all.reports += 1;
        all.false_reports += u64::from(!explained);
        if self.counted[sensor][0].replace(second) != Some(second) {
            all.seconds += 1;
        }
        if !explained && self.counted[sensor][1].replace(second) != Some(second) {
            all.false_seconds += 1;
        }
        for open in self.open.iter_mut().flatten().filter(|open| open.in_play) {
            let [from, to] = open.view.span_rad;
            let (middle, half) = ((from + to) / 2.0, (to - from) / 2.0);
            if wrapped(bearing - middle).abs() <= half + BESIDE_RAD {
                let account = &mut open.encounter.by[sensor];
                account.reports += 1;
                account.false_reports += u64::from(!explained);
            }
        }
    }

    /// Closes the book.
    pub fn finish(&mut self) {
        (0..self.open.len()).for_each(|index| self.close(index));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compare::matching::LaserPoint;
    use crate::compare::stage::tests::stage;

    /// A second at the origin, with something said in the middle of it.
    fn book(bodies: &str, compare: &str, z: f64, say: impl FnOnce(&mut Ledger, Stamp)) -> Ledger {
        let mut ledger = Ledger::new(stage(bodies, compare));
        let here: Transform<World, Robot> = Isometry3::translation(0.0, 0.0, z).into();
        (0..=2).for_each(|k| ledger.look(Stamp::from_secs(0.25 * f64::from(k)), &here, &[]).unwrap());
        say(&mut ledger, Stamp::from_secs(0.5));
        (2..=4).for_each(|k| ledger.look(Stamp::from_secs(0.25 * f64::from(k)), &here, &[]).unwrap());
        ledger.finish();
        ledger
    }

    fn ahead(range_m: f64) -> Cone {
        let from = V3::new(0.3, 0.0, 0.4);
        Cone { from, axis: V3::x(), half_rad: 0.26, range_m, truth: Some(from + V3::x() * range_m) }
    }

    const WALL: &str = "[[world.box]]\nname = 'wall'\nposition = [5.05, 0.0]\nsize = [0.1, 4.0, 1.0]\n";
    const GAP: &str = "[[compare.target]]\nname = 'gap'\nclass = 'gap'\nkind = 'opening'\nline = [[1.5, -0.4], [1.5, 0.4]]\nz = [0.0, 0.5]\n";

    #[test]
    fn a_far_range_shows_a_way_through_and_is_not_judged_itself() {
        let ledger = book(WALL, GAP, 0.0, |ledger, stamp| ledger.cone(stamp, &ahead(4.7)));
        let met = &ledger.classes["gap"][0];
        assert_eq!((met.by[ULTRASONIC].seen.get(&3), met.by[LASER].seen.len()), (Some(&1), 0), "{met:?}");
        assert!((met.by[ULTRASONIC].first_s.unwrap() - 0.5).abs() < 1e-9 && (0.7..1.1).contains(&met.seconds));
        assert_eq!(ledger.reports[ULTRASONIC], Reports::default());
        // From before the gap it is no way through, and where nothing is it is false.
        let ledger = book(WALL, GAP, 0.0, |ledger, stamp| ledger.cone(stamp, &ahead(1.3)));
        assert!(ledger.classes["gap"][0].by[ULTRASONIC].seen.is_empty());
        assert_eq!((ledger.reports[ULTRASONIC].reports, ledger.reports[ULTRASONIC].false_reports), (1, 1));
    }

    #[test]
    fn heights_count_from_the_floor_that_the_robot_stands_on() {
        let line = |z: f64| -> Slit {
            let point = |column: u16| {
                let at = V3::new(2.0, f64::from(column) * 0.02, z);
                LaserPoint { column, at, truth: Some(at) }
            };
            Slit { eye: V3::new(0.0, 0.0, 1.3), points: (0..5).map(point).collect() }
        };
        for (z, reports) in [(0.31, 0), (0.5, 1)] {
            let ledger = book("", "", 0.3, |ledger, stamp| ledger.slit(stamp, &line(z)));
            assert_eq!(ledger.reports[LASER].reports, reports, "{z}");
        }
    }
}
