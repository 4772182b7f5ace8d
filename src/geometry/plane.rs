//! Planes n·x = d.

use std::marker::PhantomData;

use nalgebra::Vector3;

use super::frame::{Point, Transform};

/// The plane of points with n·x = d in frame `F`; n is a unit vector, d in metres.
#[derive(Debug)]
pub struct Plane<F> {
    /// Unit normal n.
    pub normal: Vector3<f64>,
    /// Offset d [m].
    pub offset: f64,
    frame: PhantomData<F>,
}

impl<F> Clone for Plane<F> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<F> Copy for Plane<F> {}

impl<F> Plane<F> {
    /// From a normal of any length and the matching offset; `None` if the normal is zero or not finite.
    pub fn new(normal: Vector3<f64>, offset: f64) -> Option<Self> {
        let length = normal.norm();
        if !(length.is_finite() && length > 0.0 && offset.is_finite()) {
            return None;
        }
        Some(Self { normal: normal / length, offset: offset / length, frame: PhantomData })
    }

    /// Through a point with a normal.
    pub fn through(point: Point<F>, normal: Vector3<f64>) -> Option<Self> {
        Self::new(normal, normal.dot(&point.xyz))
    }

    /// How far in front of the plane (on the normal's side) a point lies [m].
    pub fn distance(&self, point: Point<F>) -> f64 {
        self.normal.dot(&point.xyz) - self.offset
    }

    /// Where the ray origin + t·direction meets the plane; `None` if it runs along it.
    pub fn meet(&self, origin: Point<F>, direction: &Vector3<f64>) -> Option<f64> {
        let closing = self.normal.dot(direction);
        if closing.abs() < 1e-12 * direction.norm() {
            return None;
        }
        Some((self.offset - self.normal.dot(&origin.xyz)) / closing)
    }
}

impl<A, B> std::ops::Mul<Plane<B>> for Transform<A, B> {
    type Output = Plane<A>;
    fn mul(self, plane: Plane<B>) -> Plane<A> {
        let normal = self.rotate(&plane.normal);
        // A point of the plane, moved with it.
        let foot = self.iso * nalgebra::Point3::from(plane.normal * plane.offset);
        Plane { normal, offset: normal.dot(&foot.coords), frame: PhantomData }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Robot, World};

    #[test]
    fn a_moved_plane_keeps_its_points() {
        let plane = Plane::<Robot>::new(Vector3::new(1.0, 2.0, -3.0), 0.7).unwrap();
        let on_it = Point::<Robot>::from(plane.normal * plane.offset + plane.normal.cross(&Vector3::x()) * 4.0);
        let move_it = Transform::<World, Robot>::from_xyz_rpy([1.0, -2.0, 3.0], [0.3, 0.2, 0.1]);
        assert!(plane.distance(on_it).abs() < 1e-12);
        assert!((move_it * plane).distance(move_it * on_it).abs() < 1e-12);
    }

    #[test]
    fn a_zero_normal_is_no_plane() {
        assert!(Plane::<World>::new(Vector3::zeros(), 1.0).is_none());
        assert!(Plane::<World>::new(Vector3::new(f64::NAN, 0.0, 0.0), 1.0).is_none());
    }
}
