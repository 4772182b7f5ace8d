//! Captures from a simulated METRO-I: the mission drives, physics moves, servos turn, the camera takes slit images, and the
//! ultrasonic ring, if there is one, fires in between.
//! The only source that sees both sides of the truth barrier: truth leaves it beside a capture, never in it.

use std::sync::Arc;

use nalgebra::{Isometry3, Point3};

use super::scenario::Scenario;
use super::ultrasound::{Heard, Instant, Ultrasound};
use crate::fault::{Fault, Result};
use crate::geometry::{Odom, Robot, Transducer, Transform, World};
use crate::image::{Capture, Drop, Dropped, Reading};
use crate::maps::{Maps, PlanView};
use crate::navigation::{FollowParams, Follower, MissionProgress, ScanKind, ScanRequest};
use crate::optics::{Laser, Rig};
use crate::robot::{BodyCommand, Drive, Odometry, RobotParams};
use crate::scanner::{Head, Moment, Movement, Renderer, Schedule, Shot as Trigger, Sweep, SweepParams, TrueSight};
use crate::time::Stamp;
use crate::world::{Body, Mesh, Motion, Physics, Scene, Shape, Surfaces};

/// The follower's plan view is made anew this often [s].
const PLAN_EVERY_S: f64 = 0.5;
/// In pictures an endless plane reaches this far beyond everything else [m] ...
const PICTURE_MARGIN_M: f64 = 0.5;
/// ... but in an empty world or around far-away things it has this half side at least and at most [m].
const PICTURE_HALF_M: [f64; 2] = [4.0, 30.0];
/// How far around the origin a free start is looked for where none was given [m].
const START_SEARCH_M: f64 = 5.0;
/// A robot that leans more than this has tipped over: the run ends [rad].
const TIPPED_RAD: f64 = 1.0;

/// A capture, and what is true beside it.
pub struct Shot {
    /// The capture.
    pub capture: Capture,
    /// The truth.
    pub truth: ShotTruth,
    /// What the ultrasonic ring heard since the shot before, in time order; nothing of it is later than the capture.
    pub heard: Vec<Heard>,
    /// What the mission said meanwhile.
    pub notes: Vec<String>,
}

/// What is true in the middle of the exposure.
pub struct ShotTruth {
    /// Where the robot was.
    pub world_from_robot: Transform<World, Robot>,
    /// Where each column's line of sight met the lit surface.
    pub sights: Vec<TrueSight>,
    /// Bodies that have moved: index in the scene, and how far since the start (world from world).
    pub moved: Vec<(usize, Isometry3<f64>)>,
}

/// A run under way.
pub struct Simulation {
    scene: Scene,
    /// The finder as the robot believes it to be, by which it aims.
    rig: Rig,
    /// The finder as it is.
    true_rig: Rig,
    sweep_params: SweepParams,
    duration_s: f64,
    seed: u64,
    physics: Physics,
    /// Where the robot was a step of time ago.
    world_from_robot_before: Transform<World, Robot>,
    drive: Box<dyn Drive>,
    odometry: Odometry,
    head: Head,
    sweep: Sweep,
    /// What the sweep was made for.
    scanning: ScanRequest,
    renderer: Renderer,
    surfaces: Surfaces,
    ultrasound: Option<Ultrasound>,
    follower: Follower,
    plan: PlanView,
    plan_made_s: f64,
    world_from_odom: Transform<World, Odom>,
    frame: u64,
    dropped: Dropped,
    notes: Vec<String>,
    finished: bool,
}

impl Simulation {
    /// Puts everything in its place; an error names what does not fit, such as a robot inside a wall.
    pub fn new(scenario: &Scenario) -> Result<Self> {
        let mut notes = Vec::new();
        let (physics, start) = place(scenario, &mut notes)?;
        let robot = &scenario.robot;
        let world_from_robot = physics.robot_pose();
        let exposure_s = scenario.image.exposure_s;
        let sweep_params = scenario.sweep.clone();
        let stops = sweep_params.stops(&sweep_params.driving, &scenario.rig)?;
        let ring = |params| Ultrasound::new(params, &scenario.scene, mix(scenario.seed, 3));
        for absent in &scenario.scene.absent {
            notes.push(format!("not simulated: {absent}"));
        }
        notes.push(format!("start at x {:.2} m, y {:.2} m, {:.0}°", start.0, start.1, start.2.to_degrees()));
        Ok(Self {
            sweep: Sweep::new(stops, &sweep_params, exposure_s)?,
            head: Head::new(&sweep_params, mix(scenario.seed, 1)),
            odometry: Odometry::new(robot.odometry, &world_from_robot, mix(scenario.seed, 2))?,
            drive: robot.new_drive()?,
            renderer: Renderer::new(&scenario.true_rig, scenario.image, &scenario.scene)?,
            surfaces: Surfaces::new(&scenario.scene)?,
            ultrasound: scenario.sonar.map(ring).transpose()?,
            follower: Follower::new(&scenario.mission, follower_params(robot))?,
            scene: scenario.scene.clone(),
            rig: scenario.rig.clone(),
            true_rig: scenario.true_rig.clone(),
            duration_s: scenario.duration_s,
            seed: scenario.seed,
            sweep_params,
            world_from_robot_before: world_from_robot,
            physics,
            scanning: ScanRequest::Driving,
            plan: PlanView { resolution_m: 1.0, origin_m: [0.0; 2], width: 0, height: 0, cells: Vec::new() },
            plan_made_s: f64::NEG_INFINITY,
            world_from_odom: Transform::identity(),
            frame: 0,
            dropped: Dropped::default(),
            notes,
            finished: false,
        })
    }

    /// Shows the follower what the maps hold now.
    pub fn look_at(&mut self, maps: &Maps, world_from_odom: Transform<World, Odom>) {
        self.world_from_odom = world_from_odom;
        if self.physics.elapsed_s() - self.plan_made_s >= PLAN_EVERY_S {
            self.plan_made_s = self.physics.elapsed_s();
            self.plan = maps.plan_view();
        }
    }

    /// Runs to the next exposure; `None` when the mission is done or the time is over.
    pub fn next_shot(&mut self) -> Result<Option<Shot>> {
        while !self.finished && self.physics.elapsed_s() < self.duration_s {
            if let Some(trigger) = self.tick()? {
                if !trigger.settled {
                    self.dropped.add(Drop::Unsettled);
                    continue;
                }
                return self.expose(&trigger).map(Some);
            }
        }
        Ok(None)
    }

    /// One step of time: mission, motors, bodies, servos.
    fn tick(&mut self) -> Result<Option<Trigger>> {
        let dt_s = self.physics.dt_s();
        let world_from_robot = self.world_from_odom * self.odometry.pose();
        let command = self.follower.command(self.now(), &world_from_robot, &self.plan, self.sweep.done());
        self.notes.extend(command.note);
        if command.done {
            self.finished = true;
            return Ok(None);
        }
        if command.scan != self.scanning {
            self.scanning = command.scan;
            let stops = self.sweep_params.stops(self.schedule(), &self.rig)?;
            self.sweep = Sweep::new(stops, &self.sweep_params, self.renderer.params().exposure_s)?;
        }
        self.drive.command(BodyCommand::travel(command.v_m_s, command.omega_rad_s))?;
        let motion = self.drive.advance(dt_s);
        let before = self.instant();
        self.world_from_robot_before = before.world_from_robot;
        self.physics.step(self.drive.rolling())?;
        self.odometry.advance(self.drive.as_ref(), &motion, &self.physics.robot_pose())?;
        if self.physics.tilt_rad() > TIPPED_RAD {
            let found =
                format!("a lean of {:.0}° at {:.1} s", self.physics.tilt_rad().to_degrees(), self.physics.elapsed_s());
            return Err(Fault::new("robot", found, "a robot that stands: it has tipped over"));
        }
        self.listen(&before)?;
        Ok(self.sweep.advance(&mut self.head, dt_s))
    }

    /// The robot now.
    fn instant(&self) -> Instant {
        let (world_from_robot, odom_from_robot) = (self.physics.robot_pose(), self.odometry.pose());
        Instant { stamp: self.now(), world_from_robot, odom_from_robot }
    }

    /// What the ring has to fire in the step of time since then.
    fn listen(&mut self, before: &Instant) -> Result<()> {
        let now = self.instant();
        let Some(ultrasound) = self.ultrasound.as_mut().filter(|ring| ring.is_due(now.stamp)) else { return Ok(()) };
        for (index, body) in self.scene.bodies.iter().enumerate() {
            if let (true, Some(pose)) = (body.motion != Motion::Static, self.physics.body_pose(index)) {
                ultrasound.set_pose(index, pose)?;
            }
        }
        ultrasound.advance(before, &now)
    }

    /// The ring's transducers: frame, and where on the robot.
    pub fn transducers(&self) -> Vec<(String, Transform<Robot, Transducer>)> {
        self.ultrasound.as_ref().map(Ultrasound::transducers).unwrap_or_default()
    }

    /// What the ring heard since it was last asked: after the last shot, what came after that.
    pub fn take_heard(&mut self) -> Vec<Heard> {
        self.ultrasound.as_mut().map(Ultrasound::take).unwrap_or_default()
    }

    /// The exposure whose middle is now: the image, and what is true.
    fn expose(&mut self, trigger: &Trigger) -> Result<Shot> {
        let mut moved = Vec::new();
        for (index, body) in self.scene.bodies.iter().enumerate() {
            if let (true, Some(pose)) = (body.motion != Motion::Static, self.physics.body_pose(index)) {
                self.surfaces.set_pose(index, pose)?;
                moved.push((index, pose * body.pose.inverse()));
            }
        }
        let world_from_robot = self.physics.robot_pose();
        let (cylinder_rad, beam_rad) = self.true_angles(trigger.angles);
        let middle = Moment { world_from_robot, cylinder_rad, beam_rad };
        let exposure = self.renderer.expose_moving(&self.surfaces, &middle, &self.movement(), self.seed, self.frame)?;
        let capture = Capture {
            id: self.frame,
            stamp: self.now(),
            cylinder_pulse: trigger.encoders.0,
            mirror_pulse: trigger.encoders.1,
            odom_from_robot: self.odometry.pose(),
            reading: Reading::Image(exposure.image),
        };
        self.frame += 1;
        let truth = ShotTruth { world_from_robot, sights: exposure.truth, moved };
        Ok(Shot { capture, truth, heard: self.take_heard(), notes: std::mem::take(&mut self.notes) })
    }

    /// How far the robot gets during an exposure at the speed of this step of time; the head stands still then.
    fn movement(&self) -> Movement {
        let step = self.world_from_robot_before.inverse() * self.physics.robot_pose();
        let steps = self.renderer.params().exposure_s / self.physics.dt_s();
        Movement { robot: Transform::identity().along_arc(&step, steps), ..Movement::default() }
    }

    /// θR and θB [rad] where the axes truly are, between whole pulses.
    fn true_angles(&self, (cylinder, mirror): (f64, f64)) -> (f64, f64) {
        let beam = match self.true_rig.laser {
            Laser::Mirror(laser) => laser.beam.zero_rad + mirror * laser.beam.rad_per_pulse,
            Laser::Plane(_) => 0.0,
        };
        (self.true_rig.cylinder.zero_rad + cylinder * self.true_rig.cylinder.rad_per_pulse, beam)
    }

    fn schedule(&self) -> &Schedule {
        match self.scanning {
            ScanRequest::Driving => &self.sweep_params.driving,
            ScanRequest::Once { kind: ScanKind::Turn, .. } => &self.sweep_params.turn,
            ScanRequest::Once { kind: ScanKind::View, .. } => &self.sweep_params.view,
        }
    }

    /// Simulated time.
    pub fn now(&self) -> Stamp {
        Stamp::from_secs(self.physics.elapsed_s())
    }

    /// How the mission goes.
    pub fn mission(&self) -> MissionProgress {
        self.follower.progress()
    }

    /// How much of the run is over, in thousandths: by the mission's steps, or by its time if that is nearer to its end.
    pub fn thousandths(&self) -> u64 {
        let mission = self.mission();
        let within = if self.scanning == ScanRequest::Driving { 0.5 } else { self.sweep.progress() };
        let by_steps = (mission.ended as f64 + within) / mission.steps.max(1) as f64;
        let by_time = self.physics.elapsed_s() / self.duration_s;
        (by_steps.max(by_time).min(1.0) * 1e3) as u64
    }

    /// What the mission is doing, for the progress bar.
    pub fn doing(&self) -> &'static str {
        match self.scanning {
            ScanRequest::Driving => "driving",
            ScanRequest::Once { kind: ScanKind::Turn, .. } => "scanning all around",
            ScanRequest::Once { kind: ScanKind::View, .. } => "scanning ahead",
        }
    }

    /// Times the robot's body touched something.
    pub fn collisions(&self) -> u64 {
        self.physics.collisions()
    }

    /// Exposures that were not taken, by reason.
    pub fn dropped(&self) -> &Dropped {
        &self.dropped
    }

    /// The surfaces as they stand now.
    pub fn surfaces(&self) -> &Surfaces {
        &self.surfaces
    }

    /// What the mission and the set-up still have to say.
    pub fn take_notes(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notes)
    }

    /// All bodies as meshes in the world, for pictures.
    pub fn pictures(&self) -> Vec<(String, [u8; 3], Arc<Mesh>)> {
        let placed = |body: &Body, plane_half_m: f64| {
            let mut mesh = body.shape.tessellate(plane_half_m);
            for vertex in &mut mesh.vertices {
                *vertex = (body.pose * Point3::from(*vertex)).coords;
            }
            mesh
        };
        let bounded = self.scene.bodies.iter().filter(|body| body.shape != Shape::Plane);
        let corners = bounded.flat_map(|body| placed(body, 0.0).vertices);
        let reach_m = corners.fold(0.0, |reach: f64, v| reach.max(v.x.abs()).max(v.y.abs())) + PICTURE_MARGIN_M;
        let plane_half_m = reach_m.clamp(PICTURE_HALF_M[0], PICTURE_HALF_M[1]);
        let picture = |body: &Body| (body.name.clone(), body.material.colour, Arc::new(placed(body, plane_half_m)));
        self.scene.bodies.iter().map(picture).collect()
    }
}

/// Physics with the robot at its start; where none was given, at the free place nearest to the origin.
fn place(scenario: &Scenario, notes: &mut Vec<String>) -> Result<(Physics, (f64, f64, f64))> {
    let body = scenario.robot.body();
    let [x, y] = scenario.robot.start_xy();
    let yaw = scenario.robot.start_yaw();
    let at = |x: f64, y: f64| Physics::new(&scenario.scene, &body, [x, y], yaw, Physics::DT_S);
    match at(x, y) {
        Ok(physics) => Ok((physics, (x, y, yaw))),
        Err(fault) if scenario.start_given => Err(fault),
        Err(fault) => {
            for (x, y) in spiral() {
                if let Ok(physics) = at(x, y) {
                    notes.push(format!(
                        "no start was given, and the origin is not free ({fault}): use --start to choose one"
                    ));
                    return Ok((physics, (x, y, yaw)));
                }
            }
            Err(fault)
        }
    }
}

/// What the follower knows of its robot; it leaves some of the motors' power for corrections.
fn follower_params(robot: &RobotParams) -> FollowParams {
    FollowParams {
        radius_m: robot.radius_m,
        speed_m_s: 0.75 * robot.speed_m_s_max,
        accel_m_s2: robot.accel_m_s2_max,
        turn_rad_s: 0.75 * robot.turn_rad_s_max,
        turn_rad_s2: robot.turn_rad_s2_max,
        ..FollowParams::default()
    }
}

/// Places around the origin, from near to far, half a metre apart.
fn spiral() -> impl Iterator<Item = (f64, f64)> {
    let rings = (START_SEARCH_M / 0.5) as u32;
    (1..=rings).flat_map(|ring| {
        let count = 6 * ring;
        (0..count).map(move |k| {
            let angle = f64::from(k) / f64::from(count) * std::f64::consts::TAU;
            let radius = 0.5 * f64::from(ring);
            (radius * angle.cos(), radius * angle.sin())
        })
    })
}

/// A seed of its own for every part of the run.
fn mix(seed: u64, part: u64) -> u64 {
    (seed ^ part.wrapping_mul(0x9E37_79B9_7F4A_7C15)).wrapping_mul(0xD6E8_FEB8_6659_FD93).rotate_left(31)
}
