//! The follower: leads the robot through a mission by what it knows itself, its estimated pose and its map. It turns towards
//! a goal and drives there, and stops before what the map shows in its way.

use std::f64::consts::PI;

use serde::Serialize;

use super::{DriveStep, Mission, ScanKind, Step};
use crate::fault::{Result, number_within, positive};
use crate::geometry::{Robot, Transform, World};
use crate::maps::PlanView;
use crate::time::{Span, Stamp};

/// What the follower knows of its robot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FollowParams {
    /// Radius of the robot [m].
    pub radius_m: f64,
    /// Distance to keep from what the map shows [m].
    pub margin_m: f64,
    /// Usual speed [m/s].
    pub speed_m_s: f64,
    /// Braking [m/s²].
    pub accel_m_s2: f64,
    /// Highest turn rate [rad/s].
    pub turn_rad_s: f64,
    /// Angular braking [rad/s²].
    pub turn_rad_s2: f64,
    /// A point is reached this near to it [m].
    pub goal_m: f64,
    /// A heading is reached this near to it [rad].
    pub goal_rad: f64,
    /// How long to wait before what is in the way [s].
    pub patience_s: f64,
}

impl Default for FollowParams {
    fn default() -> Self {
        Self {
            radius_m: 0.3,
            margin_m: 0.1,
            speed_m_s: 0.3,
            accel_m_s2: 0.5,
            turn_rad_s: 0.6,
            turn_rad_s2: 1.5,
            goal_m: 0.03,
            goal_rad: 0.01,
            patience_s: 5.0,
        }
    }
}

impl FollowParams {
    /// Refuses numbers that are not positive.
    pub fn validated(self) -> Result<Self> {
        for (what, value) in [
            ("follow.radius_m", self.radius_m),
            ("follow.speed_m_s", self.speed_m_s),
            ("follow.accel_m_s2", self.accel_m_s2),
            ("follow.turn_rad_s", self.turn_rad_s),
            ("follow.turn_rad_s2", self.turn_rad_s2),
            ("follow.goal_m", self.goal_m),
            ("follow.goal_rad", self.goal_rad),
        ] {
            number_within(what, positive(what, value)?, 0.0, 100.0)?;
        }
        number_within("follow.margin_m", self.margin_m, 0.0, 10.0)?;
        number_within("follow.patience_s", self.patience_s, 0.0, 1e5)?;
        Ok(self)
    }
}

/// What the finder is to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScanRequest {
    /// Repeat the schedule for driving.
    Driving,
    /// Make one scan. A new number asks for a new scan.
    Once {
        /// Which.
        kind: ScanKind,
        /// Number of the scan, from 1.
        number: u64,
    },
}

/// What robot and finder are to do now.
#[derive(Clone, Debug, PartialEq)]
pub struct Command {
    /// Speed [m/s].
    pub v_m_s: f64,
    /// Turn rate [rad/s].
    pub omega_rad_s: f64,
    /// The finder.
    pub scan: ScanRequest,
    /// Whether the mission is over.
    pub done: bool,
    /// Something for the log: a step ended, or was given up.
    pub note: Option<String>,
}

impl Command {
    fn drive(v_m_s: f64, omega_rad_s: f64) -> Self {
        Self { v_m_s, omega_rad_s, scan: ScanRequest::Driving, done: false, note: None }
    }

    fn halt() -> Self {
        Self::drive(0.0, 0.0)
    }
}

/// How far a mission has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct MissionProgress {
    /// Steps of the mission.
    pub steps: usize,
    /// Steps that are over, also those given up.
    pub ended: usize,
    /// Steps given up because the way was blocked.
    pub given_up: usize,
}

/// Before a scan the robot stands still for so long [s].
const STAND_S: f64 = 0.5;
/// It turns on the spot until it heads for the goal within this [rad] ...
const ALIGNED_RAD: f64 = 0.03;
/// ... and again when it is off by more [rad].
const ASTRAY_RAD: f64 = 0.5;
/// A goal this near and no longer ahead has been passed [m].
const PASSED_M: f64 = 0.1;
/// Obstacles are looked for this much farther than it takes to stop [m].
const NOTICE_M: f64 = 0.5;
/// Share of its braking that the follower counts on.
const BRAKING: f64 = 0.7;
/// Slower than this it is stopped [m/s].
const CREEP_M_S: f64 = 0.02;
/// The way is free again when what is in it is farther than this [m].
const FREE_M: f64 = 0.05;
/// Cells from here on are occupied (ROS: 0 to 100).
const OCCUPIED: i8 = 50;

/// Carries out a mission.
#[derive(Clone, Debug)]
pub struct Follower {
    steps: Vec<Step>,
    params: FollowParams,
    at: usize,
    /// When the present step began.
    began: Option<Stamp>,
    /// When the way was found blocked.
    blocked: Option<Stamp>,
    /// When the robot was last told to move.
    moved: Option<Stamp>,
    /// Whether it heads for its goal.
    aligned: bool,
    scans: u64,
    /// Whether the present step's scan was asked for.
    scanning: bool,
    given_up: usize,
}

/// What is in the way.
#[derive(Clone, Copy, Debug)]
struct Obstacle {
    /// How far the robot may go before its margin touches it [m].
    gap_m: f64,
    at_m: [f64; 2],
}

impl Follower {
    /// At the first step of a mission.
    ///
    /// Errors: a mission or parameters with impossible numbers.
    pub fn new(mission: &Mission, params: FollowParams) -> Result<Self> {
        let steps = mission.clone().validated()?.steps;
        let params = params.validated()?;
        Ok(Self {
            steps,
            params,
            at: 0,
            began: None,
            blocked: None,
            moved: None,
            aligned: false,
            scans: 0,
            scanning: false,
            given_up: 0,
        })
    }

    /// How the mission goes.
    pub fn progress(&self) -> MissionProgress {
        MissionProgress { steps: self.steps.len(), ended: self.at.min(self.steps.len()), given_up: self.given_up }
    }

    /// What to do now. `scan_done`: the scan that the last command asked for is complete.
    ///
    /// A pose that is not finite ends the mission where it is.
    pub fn command(
        &mut self,
        now: Stamp,
        world_from_robot: &Transform<World, Robot>,
        plan: &PlanView,
        scan_done: bool,
    ) -> Command {
        let Some(&step) = self.steps.get(self.at) else {
            return Command { done: true, ..Command::halt() };
        };
        if !world_from_robot.is_finite() {
            self.at = self.steps.len();
            return Command { done: true, note: Some("mission ended: the robot is lost".into()), ..Command::halt() };
        }
        let began = *self.began.get_or_insert(now);
        let elapsed_s = (now - began).as_secs();
        let command = match step {
            Step::GoTo { to_m, speed_m_s } => {
                self.go_to(now, world_from_robot, plan, to_m, speed_m_s.unwrap_or(self.params.speed_m_s))
            }
            Step::TurnTo { yaw_rad } => self.turn_to(world_from_robot, yaw_rad),
            Step::Drive(drive) => self.drive(now, elapsed_s, world_from_robot, plan, drive),
            Step::Scan(kind) => self.scan(now, kind, scan_done),
            Step::Wait { seconds } if elapsed_s >= seconds => self.next(format!("waited {seconds} s")),
            Step::Wait { .. } => Command::halt(),
        };
        if command.v_m_s != 0.0 || command.omega_rad_s != 0.0 {
            self.moved = Some(now);
        }
        command
    }

    /// Ends the present step.
    fn next(&mut self, note: String) -> Command {
        self.at += 1;
        (self.began, self.blocked, self.aligned, self.scanning) = (None, None, false, false);
        Command { done: self.at >= self.steps.len(), note: Some(note), ..Command::halt() }
    }

    fn go_to(
        &mut self,
        now: Stamp,
        pose: &Transform<World, Robot>,
        plan: &PlanView,
        [x, y]: [f64; 2],
        speed_m_s: f64,
    ) -> Command {
        let here = pose.xyz();
        let (dx, dy) = (x - here.x, y - here.y);
        let distance = dx.hypot(dy);
        let off = wrapped(dy.atan2(dx) - pose.yaw());
        let passed = self.aligned && distance < PASSED_M && off.abs() > PI / 3.0;
        if distance < self.params.goal_m || passed {
            return self.next(format!("reached ({x}, {y})"));
        }
        self.aligned = off.abs() < if self.aligned { ASTRAY_RAD } else { ALIGNED_RAD };
        if !self.aligned && distance > PASSED_M {
            return Command::drive(0.0, self.turn_rate(off));
        }
        let obstacle = self.obstacle(pose, plan, speed_m_s, distance);
        if let Some(refused) = self.held(now, obstacle, &format!("waypoint ({x}, {y})")) {
            return refused;
        }
        let v = speed_m_s.min(self.braking(distance)).max(CREEP_M_S);
        let v = obstacle.map_or(v, |o| v.min(self.braking(o.gap_m)));
        // Pure pursuit of the goal itself: the arc through it has the curvature 2·sin(off)/distance.
        let omega =
            (2.0 * v * off.sin() / distance.max(PASSED_M) + off).clamp(-self.params.turn_rad_s, self.params.turn_rad_s);
        Command::drive(v * off.cos().max(0.0), omega)
    }

    fn turn_to(&mut self, pose: &Transform<World, Robot>, yaw_rad: f64) -> Command {
        let off = wrapped(yaw_rad - pose.yaw());
        if off.abs() < self.params.goal_rad {
            return self.next(format!("turned to {:.1}°", yaw_rad.to_degrees()));
        }
        Command::drive(0.0, self.turn_rate(off))
    }

    fn drive(
        &mut self,
        now: Stamp,
        elapsed_s: f64,
        pose: &Transform<World, Robot>,
        plan: &PlanView,
        drive: DriveStep,
    ) -> Command {
        if elapsed_s >= drive.seconds {
            return self.next(format!("drove for {} s", drive.seconds));
        }
        let mut v = drive.v_m_s;
        if !drive.blind && v != 0.0 {
            let obstacle = self.obstacle(pose, plan, v, f64::INFINITY);
            if let Some(refused) = self.held(now, obstacle, "drive") {
                return refused;
            }
            if let Some(obstacle) = obstacle {
                v = v.abs().min(self.braking(obstacle.gap_m)).copysign(v);
            }
        }
        Command::drive(v, drive.omega_rad_s)
    }

    fn scan(&mut self, now: Stamp, kind: ScanKind, scan_done: bool) -> Command {
        if self.scanning && scan_done {
            return self.next(match kind {
                ScanKind::Turn => "scanned a turn".into(),
                ScanKind::View => "scanned a view".into(),
            });
        }
        if !self.scanning {
            if self.moved.is_some_and(|moved| (now - moved) < Span::from_secs(STAND_S)) {
                return Command::halt();
            }
            self.scanning = true;
            self.scans += 1;
        }
        Command { scan: ScanRequest::Once { kind, number: self.scans }, ..Command::halt() }
    }

    /// Stands before an obstacle, and gives the step up when patience ends; `None` if there is room to move.
    fn held(&mut self, now: Stamp, obstacle: Option<Obstacle>, what: &str) -> Option<Command> {
        let Some(obstacle) = obstacle.filter(|o| o.gap_m < FREE_M) else {
            self.blocked = None;
            return None;
        };
        let since = *self.blocked.get_or_insert(now);
        if (now - since).as_secs() > self.params.patience_s {
            let [x, y] = obstacle.at_m;
            let patience_s = self.params.patience_s;
            self.given_up += 1;
            return Some(self.next(format!("{what} given up: blocked for {patience_s} s at ({x:.2}, {y:.2})")));
        }
        (self.braking(obstacle.gap_m) < CREEP_M_S).then(Command::halt)
    }

    /// The nearest occupied cell ahead (behind, if `v_m_s` is negative), in a corridor as wide as the robot and its margins and
    /// as long as it needs to stop, but no longer than `reach_m`.
    fn obstacle(&self, pose: &Transform<World, Robot>, plan: &PlanView, v_m_s: f64, reach_m: f64) -> Option<Obstacle> {
        let side = plan.resolution_m;
        if !(side.is_finite() && side > 0.0) {
            return None;
        }
        let p = &self.params;
        let wide = p.radius_m + p.margin_m;
        let stop_m = v_m_s * v_m_s / (2.0 * BRAKING * p.accel_m_s2) + NOTICE_M;
        let reach_m = reach_m.min(stop_m);
        let here = pose.xyz();
        let (sin, cos) = pose.yaw().sin_cos();
        let (ahead_x, ahead_y) = if v_m_s < 0.0 { (-cos, -sin) } else { (cos, sin) };
        let span = wide + reach_m + side;
        let cells = |centre: f64, origin: f64, count: usize| {
            let first = ((centre - span - origin) / side).floor().clamp(0.0, count as f64) as usize;
            let last = ((centre + span - origin) / side).ceil().clamp(0.0, count as f64) as usize;
            first..last
        };
        let mut nearest: Option<Obstacle> = None;
        for row in cells(here.y, plan.origin_m[1], plan.height) {
            for column in cells(here.x, plan.origin_m[0], plan.width) {
                if plan.cells.get(row * plan.width + column).is_none_or(|cell| *cell < OCCUPIED) {
                    continue;
                }
                let x = plan.origin_m[0] + (column as f64 + 0.5) * side;
                let y = plan.origin_m[1] + (row as f64 + 0.5) * side;
                let (dx, dy) = (x - here.x, y - here.y);
                let (ahead, aside) = (dx * ahead_x + dy * ahead_y, dy * ahead_x - dx * ahead_y);
                let away = ahead.hypot(aside);
                // What the map has where the robot stands is not there; what is abreast is passed, not met.
                let abreast = away < wide && ahead < away / 2.0;
                if ahead <= 0.0 || aside.abs() >= wide || away < p.radius_m - side || abreast {
                    continue;
                }
                let gap_m = ahead - (wide * wide - aside * aside).sqrt();
                if gap_m < reach_m && nearest.is_none_or(|o| gap_m < o.gap_m) {
                    nearest = Some(Obstacle { gap_m, at_m: [x, y] });
                }
            }
        }
        nearest
    }

    /// The speed from which the robot stops within `distance` [m/s].
    fn braking(&self, distance: f64) -> f64 {
        (2.0 * BRAKING * self.params.accel_m_s2 * distance.max(0.0)).sqrt()
    }

    /// The turn rate on the spot for a heading that is off by `off` [rad/s].
    fn turn_rate(&self, off: f64) -> f64 {
        let braking = (2.0 * BRAKING * self.params.turn_rad_s2 * off.abs()).sqrt();
        self.params.turn_rad_s.min(braking).min(3.0 * off.abs()).copysign(off)
    }
}

/// The same angle within ±π.
fn wrapped(angle: f64) -> f64 {
    angle.sin().atan2(angle.cos())
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f64 = 1.0 / 60.0;

    /// A free map of 12 × 12 m about the origin with these cells occupied.
    fn map(occupied: &[[f64; 2]]) -> PlanView {
        let (side, count) = (0.05, 240);
        let mut plan = PlanView {
            resolution_m: side,
            origin_m: [-6.0, -6.0],
            width: count,
            height: count,
            cells: vec![0; count * count],
        };
        for [x, y] in occupied {
            plan.cells[((y + 6.0) / side) as usize * count + ((x + 6.0) / side) as usize] = 100;
        }
        plan
    }

    /// A wall across the way at x, from y = −1 to 1.
    fn wall(x: f64) -> PlanView {
        map(&(-20..=20).map(|k| [x, f64::from(k) * 0.05]).collect::<Vec<_>>())
    }

    struct Run {
        pose: Transform<World, Robot>,
        /// The way it went.
        way: Vec<[f64; 3]>,
        notes: Vec<String>,
        scans: Vec<(ScanKind, u64)>,
        seconds: f64,
        /// Largest speed during a scan.
        scan_speed: f64,
    }

    /// A robot with METRO-I's accelerations, exactly on its odometry; a scan takes 2 s.
    fn run(steps: Vec<Step>, plan: &PlanView) -> Run {
        let mut follower = Follower::new(&Mission { steps }, FollowParams::default()).unwrap();
        let (mut v, mut omega, mut yaw, mut xy) = (0.0f64, 0.0f64, 0.0f64, [0.0f64; 2]);
        let mut run = Run {
            pose: Transform::identity(),
            way: vec![],
            notes: vec![],
            scans: vec![],
            seconds: 0.0,
            scan_speed: 0.0,
        };
        let mut scan_end = f64::INFINITY;
        for k in 0..60 * 300 {
            run.seconds = f64::from(k) * DT;
            run.pose = Transform::planar(xy[0], xy[1], yaw);
            run.way.push([xy[0], xy[1], yaw]);
            let command = follower.command(Stamp::from_secs(run.seconds), &run.pose, plan, run.seconds > scan_end);
            run.notes.extend(command.note);
            if let ScanRequest::Once { kind, number } = command.scan {
                if run.scans.last() != Some(&(kind, number)) {
                    run.scans.push((kind, number));
                    scan_end = run.seconds + 2.0;
                }
                run.scan_speed = run.scan_speed.max(v.abs() + omega.abs());
            }
            if command.done {
                return run;
            }
            v += (command.v_m_s - v).clamp(-0.5 * DT, 0.5 * DT);
            omega += (command.omega_rad_s - omega).clamp(-1.5 * DT, 1.5 * DT);
            yaw += omega * DT;
            xy = [xy[0] + v * yaw.cos() * DT, xy[1] + v * yaw.sin() * DT];
        }
        panic!("the mission does not end: {:?}", run.notes);
    }

    fn to(x: f64, y: f64) -> Step {
        Step::GoTo { to_m: [x, y], speed_m_s: None }
    }

    fn near(run: &Run, x: f64, y: f64) -> bool {
        run.way.iter().any(|p| (p[0] - x).hypot(p[1] - y) < 0.035)
    }

    #[test]
    fn it_drives_a_square_and_turns_to_a_heading() {
        let corners = [(2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (0.0, 0.0)];
        let steps = corners.iter().map(|c| to(c.0, c.1)).chain([Step::TurnTo { yaw_rad: 3.0 }]).collect();
        let run = run(steps, &map(&[]));
        assert!(corners.iter().all(|c| near(&run, c.0, c.1)), "{:?}", run.notes);
        assert_eq!(run.notes.len(), 5);
        assert!((run.pose.yaw() - 3.0).abs() < 0.02, "{:?}", run.pose);
        assert!(run.pose.xyz().norm() < 0.05, "{:?}", run.pose);
        // Along the sides, never far off them; 8 m at 0.3 m/s, and the turns.
        let off = |p: &[f64; 3]| {
            [p[0].abs(), p[1].abs(), (p[0] - 2.0).abs(), (p[1] - 2.0).abs()].into_iter().fold(9.0, f64::min)
        };
        assert!(run.way.iter().all(|p| off(p) < 0.05));
        assert!((35.0..60.0).contains(&run.seconds), "{}", run.seconds);
    }

    #[test]
    fn it_stops_before_what_the_map_shows_gives_up_and_goes_on() {
        let run = run(vec![to(3.0, 0.0), to(0.0, 1.0)], &wall(2.0));
        let farthest = run.way.iter().map(|p| p[0]).fold(0.0, f64::max);
        assert!((1.55..1.64).contains(&farthest), "{farthest}"); // 0.3 m of robot, 0.1 m of margin before x = 2
        assert!(run.notes[0].starts_with("waypoint (3, 0) given up: blocked for 5 s at (2.0"), "{:?}", run.notes);
        assert_eq!(run.notes[1], "reached (0, 1)");
        assert!(near(&run, 0.0, 1.0));
    }

    #[test]
    fn it_stops_at_full_speed_too() {
        let fast = Step::GoTo { to_m: [3.0, 0.0], speed_m_s: Some(0.8) };
        let run = run(vec![fast], &wall(2.0));
        let farthest = run.way.iter().map(|p| p[0]).fold(0.0, f64::max);
        assert!((1.55..1.65).contains(&farthest), "{farthest}");
    }

    #[test]
    fn what_is_beside_behind_or_beyond_the_goal_is_not_in_the_way() {
        let clear = map(&[[1.0, 0.45], [1.0, -0.45], [-0.5, 0.0], [2.6, 0.0], [0.1, 0.1], [0.0, 0.35]]);
        let drive_to = |plan: &PlanView| run(vec![to(2.0, 0.0)], plan);
        assert_eq!(drive_to(&clear).notes, ["reached (2, 0)"]);
        // But just inside the corridor it is.
        let blocked = drive_to(&map(&[[1.0, 0.37]]));
        assert!(blocked.notes[0].contains("given up"), "{:?}", blocked.notes);
    }

    #[test]
    fn scans_are_made_standing_one_after_the_other() {
        let steps =
            vec![Step::Scan(ScanKind::Turn), Step::Scan(ScanKind::Turn), to(1.0, 0.0), Step::Scan(ScanKind::View)];
        let run = run(steps, &map(&[]));
        assert_eq!(run.scans, [(ScanKind::Turn, 1), (ScanKind::Turn, 2), (ScanKind::View, 3)]);
        assert_eq!(run.notes, ["scanned a turn", "scanned a turn", "reached (1, 0)", "scanned a view"]);
        assert!(run.scan_speed < 1e-9, "{}", run.scan_speed);
    }

    #[test]
    fn it_drives_without_a_goal_and_waits() {
        let drive = |v_m_s, blind| Step::Drive(DriveStep { v_m_s, omega_rad_s: 0.0, seconds: 10.0, blind });
        let ahead = run(vec![drive(0.2, false), Step::Wait { seconds: 2.0 }], &map(&[]));
        assert!((ahead.pose.xyz().x - 2.0).abs() < 0.06, "{:?}", ahead.pose);
        assert!((ahead.seconds - 12.0).abs() < 0.1);
        let back = run(vec![drive(-0.2, false)], &wall(-1.0));
        assert!(
            back.pose.xyz().x > -0.65 && back.notes[0].starts_with("drive given up"),
            "{:?} {:?}",
            back.pose,
            back.notes
        );
        let blind = run(vec![drive(0.2, true)], &wall(1.0));
        assert!(blind.pose.xyz().x > 1.9, "{:?}", blind.pose);
    }

    #[test]
    fn broken_maps_poses_and_missions_do_no_harm() {
        let pose = Transform::planar(0.0, 0.0, 0.0);
        for plan in [
            PlanView { resolution_m: f64::NAN, ..map(&[]) },
            PlanView { resolution_m: 0.0, ..map(&[]) },
            PlanView { origin_m: [f64::NAN, f64::INFINITY], ..map(&[]) },
            PlanView { cells: vec![], ..map(&[]) },
            PlanView { width: 0, height: 0, cells: vec![], ..map(&[]) },
        ] {
            let mut follower = Follower::new(&Mission { steps: vec![to(1.0, 0.0)] }, FollowParams::default()).unwrap();
            assert!(follower.command(Stamp(0), &pose, &plan, false).v_m_s > 0.0);
        }
        let mut follower = Follower::new(&Mission { steps: vec![to(1.0, 0.0)] }, FollowParams::default()).unwrap();
        let lost = follower.command(Stamp(0), &Transform::planar(f64::NAN, 0.0, 0.0), &map(&[]), false);
        assert!(lost.done && lost.v_m_s == 0.0 && lost.note.is_some());
        let nowhere = Mission { steps: vec![to(f64::NAN, 0.0)] };
        assert!(Follower::new(&nowhere, FollowParams::default()).is_err());
        assert!(Follower::new(&Mission::default(), FollowParams { radius_m: 0.0, ..FollowParams::default() }).is_err());
        let empty = Mission { steps: vec![] };
        assert!(
            Follower::new(&empty, FollowParams::default()).unwrap().command(Stamp(0), &pose, &map(&[]), false).done
        );
    }
}
