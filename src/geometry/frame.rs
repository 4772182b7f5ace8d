//! Frames in types: a point belongs to one, a transform leads from one to another, and mixing them does not compile.
//!
//! ```compile_fail
//! use metromap::geometry::{Camera, Point, Robot, Transform, World};
//! let world_from_robot = Transform::<World, Robot>::identity();
//! let seen = Point::<Camera>::new(0.0, 0.0, 1.0);
//! let _ = world_from_robot * seen; // a camera point is not in the robot's frame
//! ```

use std::fmt;
use std::marker::PhantomData;
use std::ops::Mul;

use nalgebra::{Isometry3, Point3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3};

/// A coordinate frame.
pub trait Frame: Copy + fmt::Debug + 'static {
    /// The frame's ROS name (REP-105).
    const NAME: &'static str;
}

macro_rules! frames {
    ($($(#[$doc:meta])* $name:ident = $ros:literal;)*) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub struct $name;
        impl Frame for $name { const NAME: &'static str = $ros; }
    )*};
}

frames! {
    /// The map: fixed, z up.
    World = "map";
    /// Where dead reckoning thinks it started: continuous, drifting.
    Odom = "odom";
    /// The robot: origin on the floor under its centre, x forward, y left, z up (the paper's [X, Y, Z]).
    Robot = "base_link";
    /// The finder's cylinder: the robot's frame turned by θR about z (the paper's [X', Y', Z'], but with the
    /// origin under the mirror for X too, so that eq. 42 is already applied).
    Sensor = "finder_base";
    /// The camera, optical: x right, y down, z along the view (the paper's U, −V, W).
    Camera = "finder_camera";
    /// An ultrasonic transducer: x along its axis. In ROS with its number behind, `sonar_07`.
    Transducer = "sonar";
}

/// A position [m] in frame `F`.
pub struct Point<F> {
    /// Coordinates [m].
    pub xyz: Vector3<f64>,
    frame: PhantomData<F>,
}

impl<F> Point<F> {
    /// The point at (x, y, z) [m].
    pub fn new(x: f64, y: f64, z: f64) -> Self {
        Vector3::new(x, y, z).into()
    }
}

impl<F> From<Vector3<f64>> for Point<F> {
    fn from(xyz: Vector3<f64>) -> Self {
        Self { xyz, frame: PhantomData }
    }
}

impl<F> Clone for Point<F> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<F> Copy for Point<F> {}
impl<F> PartialEq for Point<F> {
    fn eq(&self, other: &Self) -> bool {
        self.xyz == other.xyz
    }
}
impl<F> fmt::Debug for Point<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}({}, {}, {})", short_name::<F>(), self.xyz.x, self.xyz.y, self.xyz.z)
    }
}

/// The rigid motion that takes coordinates of frame `From` to frame `To`; equally, the pose of `From` in `To`.
pub struct Transform<To, From> {
    /// Rotation and translation [m].
    pub iso: Isometry3<f64>,
    frames: PhantomData<(To, From)>,
}

impl<To, From> Transform<To, From> {
    /// The frames coincide.
    pub fn identity() -> Self {
        Isometry3::identity().into()
    }

    /// From x, y [m] and yaw [rad]: a pose on the floor.
    pub fn planar(x: f64, y: f64, yaw: f64) -> Self {
        Isometry3::new(Vector3::new(x, y, 0.0), Vector3::new(0.0, 0.0, yaw)).into()
    }

    /// From a position [m] and roll, pitch, yaw [rad] about the fixed x, y, z axes (URDF and SDF order).
    pub fn from_xyz_rpy(xyz: [f64; 3], rpy: [f64; 3]) -> Self {
        let rotation = Rotation3::from_euler_angles(rpy[0], rpy[1], rpy[2]);
        Isometry3::from_parts(Translation3::new(xyz[0], xyz[1], xyz[2]), rotation.into()).into()
    }

    /// From a position [m] and a quaternion (x, y, z, w) taken as it is, bit for bit: for what was stored normalised.
    pub fn from_stored(xyz: [f64; 3], q: [f64; 4]) -> Self {
        let rotation = UnitQuaternion::new_unchecked(Quaternion::new(q[3], q[0], q[1], q[2]));
        Isometry3::from_parts(Translation3::new(xyz[0], xyz[1], xyz[2]), rotation).into()
    }

    /// Position [m].
    pub fn xyz(&self) -> Vector3<f64> {
        self.iso.translation.vector
    }

    /// Rotation as a quaternion (x, y, z, w).
    pub fn quaternion(&self) -> [f64; 4] {
        let q = self.iso.rotation.quaternion();
        [q.i, q.j, q.k, q.w]
    }

    /// Heading: the angle of the turned x axis in the xy plane [rad].
    pub fn yaw(&self) -> f64 {
        let x = self.iso.rotation * Vector3::x();
        x.y.atan2(x.x)
    }

    /// Turns a direction without moving it.
    pub fn rotate(&self, v: &Vector3<f64>) -> Vector3<f64> {
        self.iso.rotation * v
    }

    /// The opposite motion.
    pub fn inverse(&self) -> Transform<From, To> {
        self.iso.inverse().into()
    }

    /// Every component is a finite number.
    pub fn is_finite(&self) -> bool {
        self.iso.translation.vector.iter().chain(self.iso.rotation.coords.iter()).all(|v| v.is_finite())
    }

    /// The pose a fraction `t` in [0, 1] of the way to `end`, along the arc that a vehicle with constant speed and
    /// turn rate drives (SE(2) exponential in x, y, yaw; linear in z, spherical in tilt).
    pub fn along_arc(&self, end: &Self, t: f64) -> Self {
        let step = self.iso.inverse() * end.iso;
        let turn = { step.rotation * Vector3::x() };
        let yaw = turn.y.atan2(turn.x);
        // V(φ) = [sinφ, −(1−cosφ); 1−cosφ, sinφ]/φ maps the body's velocity to the chord; its inverse maps back.
        let (a, b) = chord(yaw);
        let det = a * a + b * b;
        let p = step.translation.vector;
        let velocity = Vector3::new((a * p.x + b * p.y) / det, (a * p.y - b * p.x) / det, p.z);
        let (at, bt) = chord(yaw * t);
        let moved = Vector3::new(at * velocity.x - bt * velocity.y, bt * velocity.x + at * velocity.y, velocity.z) * t;
        let turned = UnitQuaternion::identity().slerp(&step.rotation, t);
        (self.iso * Isometry3::from_parts(moved.into(), turned)).into()
    }
}

/// The frame's type without its path.
fn short_name<F>() -> &'static str {
    std::any::type_name::<F>().rsplit("::").next().unwrap_or_default()
}

/// sinφ/φ and (1−cosφ)/φ, also at φ = 0.
fn chord(phi: f64) -> (f64, f64) {
    if phi.abs() < 1e-6 { (1.0 - phi * phi / 6.0, phi / 2.0) } else { (phi.sin() / phi, (1.0 - phi.cos()) / phi) }
}

impl<A, B> From<Isometry3<f64>> for Transform<A, B> {
    fn from(iso: Isometry3<f64>) -> Self {
        Self { iso, frames: PhantomData }
    }
}

impl<To, From> Clone for Transform<To, From> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<To, From> Copy for Transform<To, From> {}
impl<To, From> PartialEq for Transform<To, From> {
    fn eq(&self, other: &Self) -> bool {
        self.iso == other.iso
    }
}
impl<To, From> fmt::Debug for Transform<To, From> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let p = self.xyz();
        write!(
            f,
            "{}_from_{}([{}, {}, {}], {:?})",
            short_name::<To>(),
            short_name::<From>(),
            p.x,
            p.y,
            p.z,
            self.quaternion()
        )
    }
}

impl<A, B, C> Mul<Transform<B, C>> for Transform<A, B> {
    type Output = Transform<A, C>;
    fn mul(self, inner: Transform<B, C>) -> Transform<A, C> {
        (self.iso * inner.iso).into()
    }
}

impl<A, B> Mul<Point<B>> for Transform<A, B> {
    type Output = Point<A>;
    fn mul(self, point: Point<B>) -> Point<A> {
        (self.iso * Point3::from(point.xyz)).coords.into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn pose() -> impl Strategy<Value = Transform<World, Robot>> {
        (prop::array::uniform3(-10.0..10.0f64), prop::array::uniform3(-3.0..3.0f64))
            .prop_map(|(xyz, rpy)| Transform::from_xyz_rpy(xyz, rpy))
    }

    proptest! {
        #[test]
        fn a_pose_and_its_inverse_cancel(a in pose(), p in prop::array::uniform3(-5.0..5.0f64)) {
            let p = Point::<Robot>::new(p[0], p[1], p[2]);
            let back = a.inverse() * (a * p);
            prop_assert!((back.xyz - p.xyz).norm() < 1e-12);
        }

        #[test]
        fn composing_is_applying_twice(a in pose(), b in pose(), p in prop::array::uniform3(-5.0..5.0f64)) {
            let b: Transform<Robot, Sensor> = b.iso.into();
            let p = Point::<Sensor>::new(p[0], p[1], p[2]);
            prop_assert!((((a * b) * p).xyz - (a * (b * p)).xyz).norm() < 1e-12);
        }

        #[test]
        fn the_arc_starts_and_ends_where_it_must(a in pose(), b in pose()) {
            prop_assert!((a.along_arc(&b, 0.0).iso.to_homogeneous() - a.iso.to_homogeneous()).norm() < 1e-9);
            prop_assert!((a.along_arc(&b, 1.0).iso.to_homogeneous() - b.iso.to_homogeneous()).norm() < 1e-6);
        }
    }

    #[test]
    fn half_of_a_quarter_circle_lies_on_the_circle() {
        // A vehicle on a circle of radius 1 about (0, 1), from (0, 0) heading x to (1, 1) heading y.
        let start = Transform::<World, Robot>::identity();
        let end = Transform::planar(1.0, 1.0, std::f64::consts::FRAC_PI_2);
        let half = start.along_arc(&end, 0.5);
        let s = std::f64::consts::FRAC_PI_4.sin();
        assert!((half.xyz() - Vector3::new(s, 1.0 - s, 0.0)).norm() < 1e-12);
        assert!((half.yaw() - std::f64::consts::FRAC_PI_4).abs() < 1e-12);
    }

    #[test]
    fn a_stored_pose_comes_back_bit_for_bit() {
        let pose = Transform::<World, Robot>::from_xyz_rpy([0.1, 0.2, 0.3], [0.01, -0.02, 2.5]);
        let xyz = pose.xyz();
        let back = Transform::<World, Robot>::from_stored([xyz.x, xyz.y, xyz.z], pose.quaternion());
        assert_eq!(pose, back);
    }
}
