//! Dead reckoning: where the robot believes it is, from what its wheels did. It starts at the true pose (odom = map at
//! t = 0) and drifts from there; a wheel that slips moves it all the same.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::drive::{Drive, WheelMotion};
use crate::fault::{Fault, Result, number_within};
use crate::geometry::{Odom, Robot, Transform, World};

/// What the odometry gets wrong (`instrument.md` 5; all [A]).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OdometryParams {
    /// Nothing at all: the odometry is the true pose, in all six degrees of freedom.
    pub perfect: bool,
    /// Variance of the distance over the distance, k_ss [m²/m].
    pub k_ss_m: f64,
    /// Variance of the heading over the turn, k_ψψ [rad²/rad].
    pub k_psipsi_rad: f64,
    /// Variance of the heading over the distance, k_ψs [rad²/m].
    pub k_psis_rad2_per_m: f64,
    /// Systematic: distance believed over distance rolled.
    pub drive_scale: f64,
    /// Systematic: turn believed over turn made.
    pub steer_scale: f64,
    /// Systematic: distance believed for a turn of the wheels [m/rad].
    pub coupling_m_per_rad: f64,
    /// Whether an inclinometer gives roll and pitch. Without it the robot believes in a level floor.
    pub tilt_sensor: bool,
    /// Noise of the inclinometer, each reading [rad].
    pub tilt_sigma_rad: f64,
}

impl Default for OdometryParams {
    fn default() -> Self {
        Self {
            perfect: false,
            k_ss_m: 1e-5,
            k_psipsi_rad: 1e-5,
            k_psis_rad2_per_m: 1e-6,
            drive_scale: 1.0,
            steer_scale: 1.0,
            coupling_m_per_rad: 0.0,
            tilt_sensor: false,
            tilt_sigma_rad: 5e-4,
        }
    }
}

impl OdometryParams {
    /// An odometry that is the truth.
    pub fn perfect() -> Self {
        Self { perfect: true, ..Self::default() }
    }

    /// Refuses negative variances and impossible scales; faults are named `odometry.…`.
    pub fn validated(self) -> Result<Self> {
        for (what, value, low, high) in [
            ("k_ss_m", self.k_ss_m, 0.0, 1.0),
            ("k_psipsi_rad", self.k_psipsi_rad, 0.0, 1.0),
            ("k_psis_rad2_per_m", self.k_psis_rad2_per_m, 0.0, 1.0),
            ("drive_scale", self.drive_scale, 0.5, 2.0),
            ("steer_scale", self.steer_scale, 0.5, 2.0),
            ("coupling_m_per_rad", self.coupling_m_per_rad, -1.0, 1.0),
            ("tilt_sigma_rad", self.tilt_sigma_rad, 0.0, 0.5),
        ] {
            number_within(&format!("odometry.{what}"), value, low, high)?;
        }
        Ok(self)
    }
}

/// A draw from N(0, 1), by Box and Muller.
pub fn normal(rng: &mut impl Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt(); // 1 − u is never 0
    radius * (TAU * rng.random::<f64>()).cos()
}

/// The odometry of one robot.
#[derive(Clone, Debug)]
pub struct Odometry {
    params: OdometryParams,
    rng: ChaCha8Rng,
    position: Vector3<f64>,
    /// Heading of the body, θ [rad].
    yaw: f64,
    /// Steering of the wheels against the body, ψ − θ [rad], as believed.
    lead: f64,
    /// Roll and pitch [rad], as believed.
    tilt: [f64; 2],
    pose: Transform<Odom, Robot>,
}

impl Odometry {
    /// Starts at the true pose; on a slope without an inclinometer, at its place and heading but level.
    ///
    /// Errors: bad parameters, a pose that is not finite.
    pub fn new(params: OdometryParams, world_from_robot: &Transform<World, Robot>, seed: u64) -> Result<Self> {
        let params = params.validated()?;
        if !world_from_robot.is_finite() {
            return Err(Fault::new("odometry start", format!("{world_from_robot:?}"), "a finite pose"));
        }
        let (roll, pitch, yaw) = world_from_robot.iso.rotation.euler_angles();
        let mut odometry = Self {
            params,
            rng: ChaCha8Rng::seed_from_u64(seed),
            position: world_from_robot.xyz(),
            yaw,
            lead: 0.0,
            tilt: if params.tilt_sensor { [roll, pitch] } else { [0.0; 2] },
            pose: world_from_robot.iso.into(),
        };
        if !params.perfect {
            odometry.pose = odometry.dead_reckoned();
        }
        Ok(odometry)
    }

    /// The robot, as it believes.
    pub fn pose(&self) -> Transform<Odom, Robot> {
        self.pose
    }

    /// Adds what the wheels did since the last call. `world_from_robot` is the truth after it, of which only the
    /// inclinometer sees roll and pitch, and all of it only a perfect odometry.
    ///
    /// Errors: a motion or a pose that is not finite.
    pub fn advance(
        &mut self,
        drive: &dyn Drive,
        motion: &WheelMotion,
        world_from_robot: &Transform<World, Robot>,
    ) -> Result<Transform<Odom, Robot>> {
        let any = f64::INFINITY;
        number_within("wheel distance", motion.distance_m, -any, any)?;
        number_within("wheel steering", motion.steer_rad, -any, any)?;
        number_within("body turn", motion.turn_rad, -any, any)?;
        if !world_from_robot.is_finite() {
            return Err(Fault::new("true pose", format!("{world_from_robot:?}"), "a finite pose"));
        }
        if self.params.perfect {
            self.pose = world_from_robot.iso.into();
            return Ok(self.pose);
        }
        let believed = self.believed(motion);
        let before = self.tilt;
        if self.params.tilt_sensor {
            let (roll, pitch, _) = world_from_robot.iso.rotation.euler_angles();
            let sigma = self.params.tilt_sigma_rad;
            self.tilt = [roll + sigma * normal(&mut self.rng), pitch + sigma * normal(&mut self.rng)];
        }
        let [x, y, turn] = drive.body_motion(self.lead, &believed);
        self.lead += believed.steer_rad - believed.turn_rad;
        // The wheels turn the body about its own upright: of it, ψ̇ = r·cos(roll)/cos(pitch) is a change of heading.
        let [roll, pitch] = [0.5 * (before[0] + self.tilt[0]), 0.5 * (before[1] + self.tilt[1])];
        let yaw_change = turn * roll.cos() / pitch.cos().max(0.1);
        let leaning = UnitQuaternion::from_euler_angles(roll, pitch, self.yaw);
        self.position += leaning * Vector3::new(x, y, 0.0);
        self.yaw += yaw_change;
        self.pose = self.dead_reckoned();
        Ok(self.pose)
    }

    /// The motion with its errors: σ_s² = k_ss·|Δs|, σ_ψ² = k_ψψ·|Δψ| + k_ψs·|Δs|.
    fn believed(&mut self, motion: &WheelMotion) -> WheelMotion {
        let p = self.params;
        let (ds, dpsi) = (motion.distance_m, motion.steer_rad);
        let sigma_s = (p.k_ss_m * ds.abs()).sqrt();
        let sigma_psi = (p.k_psipsi_rad * dpsi.abs() + p.k_psis_rad2_per_m * ds.abs()).sqrt();
        let slip = (p.steer_scale - 1.0) * dpsi + sigma_psi * normal(&mut self.rng);
        WheelMotion {
            distance_m: p.drive_scale * ds + p.coupling_m_per_rad * dpsi + sigma_s * normal(&mut self.rng),
            steer_rad: dpsi + slip,
            // The whole robot stands on the wheels: what turns them unnoticed turns the body with them.
            turn_rad: motion.turn_rad + slip,
        }
    }

    fn dead_reckoned(&self) -> Transform<Odom, Robot> {
        let rotation = UnitQuaternion::from_euler_angles(self.tilt[0], self.tilt[1], self.yaw);
        Isometry3::from_parts(Translation3::from(self.position), rotation).into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::{BodyCommand, RobotParams};
    use crate::world::{Body, Material, Motion, Physics, Scene, Shape};

    fn exact() -> OdometryParams {
        let still =
            OdometryParams { k_ss_m: 0.0, k_psipsi_rad: 0.0, k_psis_rad2_per_m: 0.0, ..OdometryParams::default() };
        OdometryParams { tilt_sensor: true, tilt_sigma_rad: 0.0, ..still }
    }

    fn synchro() -> Box<dyn Drive> {
        RobotParams::default().new_drive().unwrap()
    }

    fn body(name: &str, shape: Shape, at: [f64; 3]) -> Body {
        let pose = Isometry3::translation(at[0], at[1], at[2]);
        Body { name: name.into(), shape, pose, material: Material::default(), motion: Motion::Static, ground: false }
    }

    fn floor() -> Body {
        body("floor", Shape::Plane, [0.0; 3])
    }

    /// Drives a robot through a scene by (v, ω, seconds); gives the true and the believed pose at the end.
    fn run(
        bodies: Vec<Body>,
        params: OdometryParams,
        legs: &[(f64, f64, f64)],
    ) -> (Transform<World, Robot>, Transform<Odom, Robot>) {
        let scene = Scene { bodies, ..Scene::default() };
        let robot = RobotParams { odometry: params, ..RobotParams::default() };
        let mut physics = Physics::new(&scene, &robot.body(), [0.0; 2], 0.3, Physics::DT_S).unwrap();
        let mut odometry = Odometry::new(params, &physics.robot_pose(), 7).unwrap();
        let mut drive = robot.new_drive().unwrap();
        for &(v, omega, seconds) in legs {
            drive.command(BodyCommand::travel(v, omega)).unwrap();
            for _ in 0..(seconds * 240.0) as usize {
                let motion = drive.advance(physics.dt_s());
                physics.step(drive.rolling()).unwrap();
                odometry.advance(drive.as_ref(), &motion, &physics.robot_pose()).unwrap();
            }
        }
        (physics.robot_pose(), odometry.pose())
    }

    fn apart(a: &Transform<World, Robot>, b: &Transform<Odom, Robot>) -> (f64, f64) {
        ((a.xyz() - b.xyz()).norm(), a.iso.rotation.angle_to(&b.iso.rotation))
    }

    /// Four sides of 1 m and four left turns of a quarter, each from rest to rest.
    fn square() -> Vec<(f64, f64, f64)> {
        // 0.4 m/s for t plus the same ramp up and down: distance = speed × (time until the stop is commanded).
        let side = [(0.4, 0.0, 2.5), (0.0, 0.0, 1.0)];
        let turn = [(0.0, 0.5, std::f64::consts::PI), (0.0, 0.0, 0.5)];
        side.into_iter().chain(turn).cycle().take(16).collect()
    }

    #[test]
    fn a_square_ends_where_it_began_and_the_wheels_know() {
        let (truth, believed) = run(vec![floor()], exact(), &square());
        assert!(truth.xyz().norm() < 0.02, "{truth:?}");
        assert!((truth.yaw() - 0.3).abs() < 0.02, "{truth:?}");
        let (metres, radians) = apart(&truth, &believed);
        assert!(metres < 0.01 && radians < 0.01, "{metres} {radians}");
    }

    #[test]
    fn a_perfect_odometry_is_the_true_pose() {
        let mut slope = body("slope", Shape::Box { size: Vector3::new(9.0, 9.0, 0.2) }, [0.0; 3]);
        slope.pose.rotation = UnitQuaternion::from_euler_angles(0.05, -0.08, 0.2);
        let wall = body("wall", Shape::Box { size: Vector3::new(0.2, 8.0, 3.0) }, [1.2, 0.0, 0.0]);
        let (truth, believed) = run(vec![slope, wall], OdometryParams::perfect(), &[(0.4, 0.1, 6.0), (0.0, 0.7, 2.0)]);
        assert_eq!(truth.iso, believed.iso);
    }

    #[test]
    fn wheels_that_slip_at_a_wall_run_on() {
        let wall = || body("wall", Shape::Box { size: Vector3::new(0.2, 8.0, 2.0) }, [1.1, 0.0, 1.0]);
        let (truth, believed) = run(vec![floor(), wall()], OdometryParams::default(), &[(0.4, 0.0, 10.0)]);
        assert!(believed.xyz().norm() > 3.8, "{believed:?}");
        assert!(truth.xyz().x < 0.72, "{truth:?}");
    }

    #[test]
    fn on_a_slope_the_inclinometer_gives_the_height() {
        let slope = || {
            let mut slope = body("slope", Shape::Box { size: Vector3::new(20.0, 20.0, 0.2) }, [0.0; 3]);
            slope.pose.rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -0.12);
            slope
        };
        let legs = [(0.4, 0.1, 8.0), (0.0, 0.0, 1.0)];
        let (truth, believed) = run(vec![slope()], exact(), &legs);
        let climbed = truth.xyz().z - 0.1;
        assert!(climbed > 0.15, "{climbed}");
        let (metres, radians) = apart(&truth, &believed);
        assert!(metres < 0.02 && radians < 0.01, "{metres} {radians} {truth:?} {believed:?}");
        let (truth, believed) = run(vec![slope()], OdometryParams { tilt_sensor: false, ..exact() }, &legs);
        let (roll, pitch, _) = believed.iso.rotation.euler_angles();
        assert_eq!((roll, pitch), (0.0, 0.0));
        assert!((believed.xyz().z - 0.1).abs() < 0.01 && truth.xyz().z > 0.25, "{believed:?}");
    }

    /// Mean and variance of the error in distance along x and in heading, over 200 seeds.
    fn statistics(params: OdometryParams, motion: WheelMotion, steps: usize) -> [(f64, f64); 2] {
        let truth = Transform::identity();
        let drive = synchro();
        let mut sums = [(0.0, 0.0); 2];
        for seed in 0..200 {
            let mut odometry = Odometry::new(params, &truth, seed).unwrap();
            for _ in 0..steps {
                odometry.advance(drive.as_ref(), &motion, &truth).unwrap();
            }
            let ideal = [motion.distance_m * steps as f64, motion.steer_rad * steps as f64];
            for (sum, error) in sums.iter_mut().zip([odometry.position.x - ideal[0], odometry.yaw - ideal[1]]) {
                sum.0 += error / 200.0;
                sum.1 += error * error / 200.0;
            }
        }
        sums.map(|(mean, square)| (mean, square - mean * mean))
    }

    #[test]
    fn errors_grow_as_the_formulas_say() {
        // The variance of 200 draws is known to √(2/200) = 10 %, the mean to σ/√200.
        let params = OdometryParams::default();
        let agrees = |(mean, variance): (f64, f64), expected: f64| {
            assert!((variance / expected - 1.0).abs() < 0.35, "{variance} {expected}");
            assert!(mean.abs() < 4.0 * (expected / 200.0).sqrt(), "{mean} {expected}");
        };
        let straight = WheelMotion { distance_m: 0.01, ..WheelMotion::default() };
        let [distance, heading] = statistics(params, straight, 1000); // 10 m
        agrees(distance, 1e-5 * 10.0);
        agrees(heading, 1e-6 * 10.0);
        let turn = WheelMotion { steer_rad: 0.01, turn_rad: 0.01, ..WheelMotion::default() };
        let [_, heading] = statistics(params, turn, 628); // a turn: 0.45°
        agrees(heading, 1e-5 * TAU);
        assert!((heading.1.sqrt().to_degrees() - 0.45).abs() < 0.1);
        // Finer steps give the same.
        let fine = WheelMotion { distance_m: 0.001, ..WheelMotion::default() };
        agrees(statistics(params, fine, 10_000)[0], 1e-5 * 10.0);
    }

    #[test]
    fn systematic_errors_are_just_those() {
        let params = OdometryParams { drive_scale: 1.02, steer_scale: 0.99, coupling_m_per_rad: 0.05, ..exact() };
        let drive = synchro();
        let mut odometry = Odometry::new(params, &Transform::identity(), 0).unwrap();
        let straight = WheelMotion { distance_m: 1.0, ..WheelMotion::default() };
        let pose = odometry.advance(drive.as_ref(), &straight, &Transform::identity()).unwrap();
        assert!((pose.xyz().x - 1.02).abs() < 1e-12);
        let turn = WheelMotion { steer_rad: 1.0, turn_rad: 1.0, ..WheelMotion::default() };
        let pose = odometry.advance(drive.as_ref(), &turn, &Transform::identity()).unwrap();
        assert!((pose.yaw() - 0.99).abs() < 1e-12);
        let chord = 0.05 * 0.495f64.sin() / 0.495;
        assert!(((pose.xyz() - Vector3::new(1.02, 0.0, 0.0)).norm() - chord).abs() < 1e-12);
    }

    #[test]
    fn the_same_seed_gives_the_same_bits_and_another_does_not() {
        let end = |seed| {
            let mut odometry =
                Odometry::new(OdometryParams::default(), &Transform::planar(1.0, 2.0, 3.0), seed).unwrap();
            let motion = WheelMotion { distance_m: 0.01, steer_rad: 0.01, turn_rad: 0.01 };
            (0..50).for_each(|_| {
                odometry.advance(synchro().as_ref(), &motion, &Transform::identity()).unwrap();
            });
            odometry.pose()
        };
        assert_eq!(end(1), end(1));
        assert_ne!(end(1), end(2));
    }

    #[test]
    fn what_is_no_number_is_refused() {
        let nan = Transform::planar(f64::NAN, 0.0, 0.0);
        assert!(Odometry::new(OdometryParams::default(), &nan, 0).is_err());
        let mut odometry = Odometry::new(OdometryParams::default(), &Transform::identity(), 0).unwrap();
        let motion = WheelMotion { distance_m: f64::NAN, ..WheelMotion::default() };
        assert!(odometry.advance(synchro().as_ref(), &motion, &Transform::identity()).is_err());
        assert!(odometry.advance(synchro().as_ref(), &WheelMotion::default(), &nan).is_err());
        assert!(OdometryParams { k_ss_m: -1.0, ..OdometryParams::default() }.validated().is_err());
    }
}
