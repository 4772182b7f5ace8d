//! Ultrasonic ranges out of a recording: `sensor_msgs/msg/Range` with the pose tree around it, of this program or any other.

use std::collections::{BTreeMap, VecDeque};

use crate::fault::Result;
use crate::geometry::{Odom, Robot, Transducer, Transform};
use crate::image::{Drop, Dropped};
use crate::ranges::RangeReading;
use crate::record::bag::{Channel, Message as Recorded};
use crate::record::messages::{Message as _, Odometry, Range, TfMessage, Time};
use crate::record::{build, cdr};
use crate::time::Stamp;

/// Odometry that is kept to look back at.
const POSES_MAX: usize = 4096;
/// Ranges that may wait for odometry.
const WAITING_MAX: usize = 4096;
/// Frames of a pose tree that are kept.
const FRAMES_MAX: usize = 4096;
/// From one frame of a chain to the next, at most so often.
const CHAIN_MAX: usize = 64;
/// Odometry that is farther apart than this says nothing of what was between [s].
const GAP_S: f64 = 1.0;

/// Where the robot was at a time, and which frame is the robot.
#[derive(Clone, Debug)]
struct Placed {
    stamp: Stamp,
    robot: String,
    pose: Transform<Odom, Robot>,
}

/// Puts ranges together with where they were measured.
#[derive(Debug, Default)]
pub(super) struct RecordedRanges {
    /// The newest pose of every frame in its parent, but for those in map and odom.
    edges: BTreeMap<String, (String, Transform<Robot, Transducer>)>,
    /// Odometry, ascending.
    poses: VecDeque<Placed>,
    /// Whether poses come from the tree, and no longer from odometry messages.
    has_tree: bool,
    waiting: VecDeque<(Stamp, Range)>,
    /// Infrared ranges: not ours.
    others: u64,
    pub dropped: Dropped,
}

impl RecordedRanges {
    /// Takes a message, if it is of use.
    pub fn take(&mut self, message: &Recorded) {
        let kind = message.channel.schema.as_ref().map(|schema| schema.name.as_str());
        let taken = match kind {
            Some(TfMessage::TYPE) => cdr::decode(&message.data).map(|tree: TfMessage| self.tree(&tree)),
            Some(Odometry::TYPE) => cdr::decode(&message.data).map(|odometry| self.odometry(&odometry)),
            Some(Range::TYPE) => range(&message.data).map(|range| self.range(range)),
            _ => Ok(()),
        };
        if taken.is_err() {
            self.dropped.add(Drop::Unreadable);
        }
    }

    /// Infrared ranges that were passed over.
    pub fn others(&self) -> u64 {
        self.others
    }

    /// The next range whose place is known; at the `end` of a recording, all that can be had.
    pub fn next(&mut self, end: bool) -> Option<RangeReading> {
        while let Some((stamp, _)) = self.waiting.front() {
            let known = self.poses.back().is_some_and(|newest| newest.stamp >= *stamp);
            if !known && !end && self.waiting.len() < WAITING_MAX {
                return None;
            }
            let (stamp, range) = self.waiting.pop_front()?;
            match self.reading(stamp, &range) {
                Ok(reading) => return Some(reading),
                Err(why) => self.dropped.add(why),
            }
        }
        None
    }

    fn tree(&mut self, tree: &TfMessage) {
        for edge in &tree.transforms {
            let (parent, child) = (plain(&edge.header.frame_id), plain(&edge.child_frame_id));
            match parent {
                "map" => {}
                "odom" => {
                    if !std::mem::replace(&mut self.has_tree, true) {
                        self.poses.clear();
                    }
                    self.placed(&edge.header.stamp, child, edge.transform.transform());
                }
                _ if self.edges.len() < FRAMES_MAX || self.edges.contains_key(child) => {
                    self.edges.insert(child.to_string(), (parent.to_string(), edge.transform.transform()));
                }
                _ => self.dropped.add(Drop::Unreadable),
            }
        }
    }

    fn odometry(&mut self, odometry: &Odometry) {
        if !self.has_tree {
            let robot = plain(&odometry.child_frame_id);
            self.placed(&odometry.header.stamp, robot, odometry.pose.pose.transform());
        }
    }

    fn placed(&mut self, stamp: &Time, robot: &str, pose: Transform<Odom, Robot>) {
        let stamp = instant(stamp);
        // What comes late or twice is no news: other programs repeat it.
        if pose.is_finite() && self.poses.back().is_none_or(|newest| stamp > newest.stamp) {
            self.poses.push_back(Placed { stamp, robot: robot.to_string(), pose });
            if self.poses.len() > POSES_MAX {
                self.poses.pop_front();
            }
        }
    }

    fn range(&mut self, range: Range) {
        if range.radiation_type == build::ULTRASOUND {
            self.waiting.push_back((instant(&range.header.stamp), range));
        } else {
            self.others += 1;
        }
    }

    fn reading(&self, stamp: Stamp, range: &Range) -> Result<RangeReading, Drop> {
        let (odom_from_robot, robot) = self.robot_at(stamp).ok_or(Drop::BadPose)?;
        let frame = plain(&range.header.frame_id);
        let robot_from_transducer = self.mounted(frame, robot).ok_or(Drop::BadPose)?;
        // REP-117: +Inf and what is beyond the limit are no echo; −Inf is too near to tell, NaN is no measurement.
        let silent = range.range > range.max_range;
        Ok(RangeReading {
            stamp,
            frame: frame.to_string(),
            robot_from_transducer,
            field_of_view_rad: range.field_of_view,
            range_m_min: range.min_range,
            range_m_max: range.max_range,
            range_m: (!silent).then_some(range.range),
            odom_from_robot,
        })
    }

    /// The robot at a time: as it was told for that very time, else on the arc between the poses before and after.
    fn robot_at(&self, stamp: Stamp) -> Option<(Transform<Odom, Robot>, &str)> {
        let after = self.poses.partition_point(|placed| placed.stamp < stamp);
        let next = self.poses.get(after)?;
        if next.stamp == stamp {
            return Some((next.pose, &next.robot));
        }
        let before = self.poses.get(after.checked_sub(1)?)?;
        let (gap_s, since_s) = ((next.stamp - before.stamp).as_secs(), (stamp - before.stamp).as_secs());
        let usable = gap_s <= GAP_S && before.robot == next.robot;
        usable.then(|| (before.pose.along_arc(&next.pose, since_s / gap_s), next.robot.as_str()))
    }

    /// The pose of a frame on the robot.
    fn mounted(&self, frame: &str, robot: &str) -> Option<Transform<Robot, Transducer>> {
        let (mut parent, mut pose) = self.edges.get(frame).map(|(parent, pose)| (parent, *pose))?;
        for _ in 0..CHAIN_MAX {
            if parent == robot {
                return Some(pose);
            }
            let (next, step) = self.edges.get(parent)?;
            pose = (step.iso * pose.iso).into();
            parent = next;
        }
        None
    }
}

/// A range message, with or without the variance that older versions of the type do not have.
fn range(payload: &[u8]) -> Result<Range> {
    cdr::decode(payload).or_else(|_| cdr::decode(&[payload, &[0; 4]].concat()))
}

/// The name of a frame without the slash that older programs put before it.
fn plain(frame: &str) -> &str {
    frame.strip_prefix('/').unwrap_or(frame)
}

fn instant(time: &Time) -> Stamp {
    Stamp(i64::from(time.sec) * 1_000_000_000 + i64::from(time.nanosec))
}

/// Whether a channel holds ranges.
pub(super) fn is_range(channel: &Channel) -> bool {
    channel.schema.as_ref().is_some_and(|schema| schema.name == Range::TYPE)
}
