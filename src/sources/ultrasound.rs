//! The ultrasonic ring of a simulated robot: fires by its schedule between captures, where the robot is at that instant.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};

use crate::fault::Result;
use crate::geometry::{Odom, Robot, Transducer, Transform, World};
use crate::ranges::{RangeReading, transducer_frame};
use crate::sonar::{Ping, Ring, RingParams, Targets};
use crate::time::Stamp;
use crate::world::Scene;

/// A reading of the ring, and what is true beside it.
#[derive(Clone, Debug, PartialEq)]
pub struct Heard {
    /// What the pipeline may see.
    pub reading: RangeReading,
    /// The truth.
    pub truth: HeardTruth,
}

/// What is true of a ping.
#[derive(Clone, Debug, PartialEq)]
pub struct HeardTruth {
    /// Where the robot was when it was fired.
    pub world_from_robot: Transform<World, Robot>,
    /// All echoes, what caused them, and which of them the module took for its reading.
    pub ping: Ping,
}

/// A robot at an instant: true pose, and pose by its own reckoning.
#[derive(Clone, Copy, Debug)]
pub(super) struct Instant {
    pub stamp: Stamp,
    pub world_from_robot: Transform<World, Robot>,
    pub odom_from_robot: Transform<Odom, Robot>,
}

impl Instant {
    /// A time on the arc from here to there.
    fn toward(&self, end: &Self, stamp: Stamp) -> Self {
        let step_s = (end.stamp - self.stamp).as_secs();
        let t = if step_s > 0.0 { ((stamp - self.stamp).as_secs() / step_s).clamp(0.0, 1.0) } else { 1.0 };
        Self {
            stamp,
            world_from_robot: self.world_from_robot.along_arc(&end.world_from_robot, t),
            odom_from_robot: self.odom_from_robot.along_arc(&end.odom_from_robot, t),
        }
    }
}

/// A ring under way.
pub(super) struct Ultrasound {
    ring: Ring,
    targets: Targets,
    /// When the next step of its schedule is fired.
    due: Stamp,
    heard: Vec<Heard>,
}

impl Ultrasound {
    /// A ring in a scene; its first step is fired at time 0.
    pub fn new(params: RingParams, scene: &Scene, seed: u64) -> Result<Self> {
        Ok(Self { ring: Ring::new(params, seed)?, targets: Targets::new(scene)?, due: Stamp(0), heard: Vec::new() })
    }

    /// Frame and place of every transducer.
    pub fn transducers(&self) -> Vec<(String, Transform<Robot, Transducer>)> {
        let params = self.ring.params();
        (0..params.count).map(|number| (transducer_frame(number), mounted(params, number))).collect()
    }

    /// Whether a step of its schedule is due by then.
    pub fn is_due(&self, stamp: Stamp) -> bool {
        self.due <= stamp
    }

    /// Moves a body to where it is now.
    pub fn set_pose(&mut self, body: usize, world_from_body: Isometry3<f64>) -> Result<()> {
        self.targets.set_pose(body, world_from_body)
    }

    /// Fires what is due up to the end of a step of time.
    pub fn advance(&mut self, from: &Instant, to: &Instant) -> Result<()> {
        while self.is_due(to.stamp) {
            let at = from.toward(to, self.due);
            for ping in self.ring.fire(at.stamp, &at.world_from_robot, &self.targets)? {
                let reading = reading(&self.ring, &ping, &at);
                let truth = HeardTruth { world_from_robot: at.world_from_robot, ping };
                self.heard.push(Heard { reading, truth });
            }
            self.due = self.ring.due(self.due);
        }
        Ok(())
    }

    /// All that was heard since this was last asked, in time order.
    pub fn take(&mut self) -> Vec<Heard> {
        std::mem::take(&mut self.heard)
    }
}

/// What the module reports of a ping: its first echo.
fn reading(ring: &Ring, ping: &Ping, at: &Instant) -> RangeReading {
    let [low, high] = ring.range_limits_m().map(|limit| limit as f32);
    let number = ping.reading.transducer;
    RangeReading {
        stamp: ping.reading.stamp,
        frame: transducer_frame(number),
        robot_from_transducer: mounted(ring.params(), number),
        field_of_view_rad: ring.params().field_of_view_deg.to_radians() as f32,
        range_m_min: low,
        range_m_max: high,
        // Its clock runs from the end of the blanking to the end of the listening: noise takes no range beyond.
        range_m: ping.reading.range_m().map(|range| (range as f32).clamp(low, high)),
        odom_from_robot: at.odom_from_robot,
    }
}

/// Where a transducer is on the robot, x along its axis, y to the left.
fn mounted(params: &RingParams, number: usize) -> Transform<Robot, Transducer> {
    let bearing = params.bearing_rad(number);
    let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), bearing);
    let tilted = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -params.tilt_deg.to_radians());
    let at = turned * Vector3::new(params.radius_m, 0.0, 0.0) + Vector3::z() * params.height_m;
    Isometry3::from_parts(at.into(), turned * tilted).into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{Body, Material, Motion, Shape};

    fn room() -> Scene {
        let wall = |name: &str, size: [f64; 3], at: [f64; 3]| Body {
            name: name.into(),
            shape: Shape::Box { size: size.into() },
            pose: Isometry3::translation(at[0], at[1], at[2]),
            material: Material::default(),
            motion: Motion::Static,
            ground: false,
        };
        let bodies = vec![
            wall("east", [0.1, 6.0, 2.0], [2.55, 0.0, 1.0]),
            wall("west", [0.1, 6.0, 2.0], [-2.55, 0.0, 1.0]),
            wall("north", [5.0, 0.1, 2.0], [0.0, 2.05, 1.0]),
            wall("south", [5.0, 0.1, 2.0], [0.0, -2.05, 1.0]),
        ];
        Scene { bodies, ..Scene::default() }
    }

    fn at(ms: i64, x_m: f64) -> Instant {
        let world_from_robot = Transform::planar(x_m, 0.0, 0.0);
        Instant { stamp: Stamp(ms * 1_000_000), world_from_robot, odom_from_robot: world_from_robot.iso.into() }
    }

    #[test]
    fn every_step_is_fired_when_it_is_due_where_the_robot_is_then() {
        let mut ring = Ultrasound::new(RingParams::default().noiseless(), &room(), 1).unwrap();
        let times = [0, 10, 60, 70, 70, 300];
        for pair in times.windows(2) {
            let place = |ms: i64| at(ms, ms as f64 * 1e-3);
            ring.advance(&place(pair[0]), &place(pair[1])).unwrap();
        }
        let heard = ring.take();
        assert!(ring.take().is_empty());
        let stamps: Vec<i64> = heard.iter().map(|h| h.reading.stamp.0 / 1_000_000).collect();
        assert_eq!(stamps, [0, 65, 130, 195, 260]);
        for (number, h) in heard.iter().enumerate() {
            let x_m = h.reading.stamp.as_secs();
            assert!((h.truth.world_from_robot.xyz().x - x_m).abs() < 1e-9 && h.reading.check() == Ok(()));
            assert_eq!(h.reading.frame, format!("sonar_{number:02}"));
            // Where the reading says that the transducer is, there it truly fired.
            let transducer = h.reading.odom_from_robot.iso * h.reading.robot_from_transducer.iso;
            assert!((transducer.translation.vector - h.truth.ping.aim.at.xyz).norm() < 1e-9);
            assert!((transducer.rotation * Vector3::x() - h.truth.ping.aim.axis).norm() < 1e-9);
        }
        let ahead = heard[0].reading.range_m.unwrap();
        assert!((ahead - 2.2).abs() < 0.01, "{ahead}");
    }

    #[test]
    fn a_tilted_ring_looks_where_its_frames_do() {
        let params = RingParams { tilt_deg: 20.0, count: 5, first_deg: 10.0, ..RingParams::default() };
        let ring = Ring::new(params, 0).unwrap();
        for number in 0..5 {
            let pose = mounted(&params, number);
            let aim = ring.aim(number, &Transform::identity());
            assert!((pose.xyz() - aim.at.xyz).norm() < 1e-12);
            assert!((pose.rotate(&Vector3::x()) - aim.axis).norm() < 1e-12);
            assert!(pose.rotate(&Vector3::y()).z.abs() < 1e-12);
        }
    }
}
