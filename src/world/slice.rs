//! Where a sheet of light cuts the world: straight pieces, and arcs of the exact ellipses and circles.

use std::f64::consts::TAU;

use nalgebra::Vector3;

use super::surfaces::{Flat, Form, Leaf, Set, Solid, Surfaces, Triangle};
use crate::geometry::{Point, World};
use crate::optics::LaserPlane;

type V3 = Vector3<f64>;

/// A piece of a plane curve, followed by a parameter t.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Curve {
    /// a + (b − a)·t, t from 0 to 1.
    Segment {
        /// Start [m].
        a: Vector3<f64>,
        /// End [m].
        b: Vector3<f64>,
    },
    /// centre + e1·cos t + e2·sin t, t from t0 to t1.
    Arc {
        /// Centre [m].
        centre: Vector3<f64>,
        /// Half axis at t = 0 [m]; need not be normal to `e2`.
        e1: Vector3<f64>,
        /// Half axis at t = π/2 [m].
        e2: Vector3<f64>,
        /// First angle [rad].
        t0: f64,
        /// Last angle [rad], at most t0 + 2π.
        t1: f64,
    },
}

/// How the surface stands along a cut.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Facing {
    /// The same normal everywhere.
    Flat(V3),
    /// Away from an axis, or from a point where the axis is zero.
    Round { centre: V3, axis: V3 },
}

/// One piece of the curve in which a plane cuts a body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cut {
    /// Index of the body in the scene.
    pub body: usize,
    /// The curve; world frame.
    pub curve: Curve,
    /// Whether the surface can be seen from behind: meshes can, since nothing says that they are closed.
    pub two_sided: bool,
    facing: Facing,
}

impl Curve {
    /// First and last parameter.
    pub fn span(&self) -> (f64, f64) {
        match *self {
            Self::Segment { .. } => (0.0, 1.0),
            Self::Arc { t0, t1, .. } => (t0, t1),
        }
    }

    /// The point at t [m]. A segment's ends are met bit for bit.
    pub fn at(&self, t: f64) -> Vector3<f64> {
        match *self {
            Self::Segment { a, .. } if t <= 0.0 => a,
            Self::Segment { b, .. } if t >= 1.0 => b,
            Self::Segment { a, b } => a + (b - a) * t,
            Self::Arc { centre, e1, e2, .. } => {
                let (sin, cos) = t.sin_cos();
                centre + e1 * cos + e2 * sin
            }
        }
    }

    /// d(point)/dt [m].
    pub fn tangent(&self, t: f64) -> Vector3<f64> {
        match *self {
            Self::Segment { a, b } => b - a,
            Self::Arc { e1, e2, .. } => {
                let (sin, cos) = t.sin_cos();
                e2 * cos - e1 * sin
            }
        }
    }

    /// Hands over what lies on the side n·x ≥ offset: nothing, or one or two pieces.
    fn clipped(&self, n: &V3, offset: f64, mut keep: impl FnMut(Self)) {
        match *self {
            Self::Segment { a, b } => {
                let (da, db) = (n.dot(&a) - offset, n.dot(&b) - offset);
                let meet = |from: V3, to: V3, d: f64, e: f64| from + (to - from) * (d / (d - e));
                match (da >= 0.0, db >= 0.0) {
                    (true, true) => keep(*self),
                    (true, false) => keep(Self::Segment { a, b: meet(a, b, da, db) }),
                    (false, true) => keep(Self::Segment { a: meet(b, a, db, da), b }),
                    (false, false) => {}
                }
            }
            Self::Arc { centre, e1, e2, t0, t1 } => {
                // n·x − offset = m·cos(t − ψ) − k
                let (a, b) = (n.dot(&e1), n.dot(&e2));
                let (m, psi, k) = (a.hypot(b), b.atan2(a), offset - n.dot(&centre));
                if k <= -m {
                    return keep(*self);
                }
                if k > m || m == 0.0 {
                    return;
                }
                let half = (k / m).acos();
                let mut part = |t0: f64, t1: f64| keep(Self::Arc { centre, e1, e2, t0, t1 });
                if t1 - t0 >= TAU {
                    return part(psi - half, psi + half); // a closed curve has no seam
                }
                let first = ((t0 - psi - half) / TAU).ceil() * TAU; // the first turn whose end is not before t0
                for turn in [first, first + TAU] {
                    let (low, high) = (t0.max(psi - half + turn), t1.min(psi + half + turn));
                    if low < high {
                        part(low, high);
                    }
                }
            }
        }
    }

    /// Some part may be nearer to `origin` than `reach`; a segment is cut to what is.
    fn within(&self, origin: &V3, reach: f64) -> Option<Self> {
        match *self {
            Self::Segment { a, b } => {
                let (way, o) = (b - a, a - origin);
                let (speed, near) = (way.norm_squared(), o.norm() <= reach && (b - origin).norm() <= reach);
                if near || speed == 0.0 {
                    return near.then_some(*self);
                }
                let middle = -o.dot(&way) / speed;
                let half = ((reach * reach - (o + way * middle).norm_squared()) / speed).sqrt(); // NaN where too far
                let (low, high) = ((middle - half).max(0.0), (middle + half).min(1.0));
                (half >= 0.0 && low < high).then(|| Self::Segment { a: self.at(low), b: self.at(high) })
            }
            Self::Arc { centre, e1, e2, .. } => {
                let size = (e1.norm_squared() + e2.norm_squared()).sqrt();
                ((centre - origin).norm() - size <= reach).then_some(*self)
            }
        }
    }
}

impl Cut {
    /// The unit normal of the surface at t: outward for solids, by the order of the corners for meshes; world frame.
    pub fn normal(&self, t: f64) -> Vector3<f64> {
        match self.facing {
            Facing::Flat(normal) => normal,
            Facing::Round { centre, axis } => {
                let out = self.curve.at(t) - centre;
                (out - axis * axis.dot(&out)).try_normalize(0.0).unwrap_or_else(V3::zeros)
            }
        }
    }

    /// The point at t.
    pub fn point(&self, t: f64) -> Point<World> {
        self.curve.at(t).into()
    }

    /// Hands over what lies on the side n·x ≥ offset of a plane: nothing, or one or two pieces.
    pub fn clipped(&self, n: &Vector3<f64>, offset: f64, mut keep: impl FnMut(Self)) {
        self.curve.clipped(n, offset, |curve| keep(Self { curve, ..*self }));
    }

    /// The same cut in the frame that `iso` leads to.
    fn moved(self, iso: &nalgebra::Isometry3<f64>) -> Self {
        let point = |p: V3| iso.transform_point(&p.into()).coords;
        let turn = |v: V3| iso.rotation * v;
        let curve = match self.curve {
            Curve::Segment { a, b } => Curve::Segment { a: point(a), b: point(b) },
            Curve::Arc { centre, e1, e2, t0, t1 } => {
                Curve::Arc { centre: point(centre), e1: turn(e1), e2: turn(e2), t0, t1 }
            }
        };
        let facing = match self.facing {
            Facing::Flat(normal) => Facing::Flat(turn(normal)),
            Facing::Round { centre, axis } => Facing::Round { centre: point(centre), axis: turn(axis) },
        };
        Self { curve, facing, ..self }
    }
}

/// The sheet in the frame of a set.
#[derive(Clone, Copy)]
struct Blade {
    normal: V3,
    offset: f64,
    origin: V3,
    forward: V3,
    reach: f64,
}

impl Surfaces {
    /// The curves in which the sheet cuts all surfaces in front of its origin and within `reach_m` of it, appended to
    /// `out`. An arc is kept whole if any part of it may be within reach. Triangles and faces that lie in the sheet give
    /// nothing: their neighbours do.
    pub fn cut(&self, sheet: &LaserPlane<World>, reach_m: f64, out: &mut Vec<Cut>) {
        let blade = Blade {
            normal: sheet.plane.normal,
            offset: sheet.plane.offset,
            origin: sheet.origin.xyz,
            forward: sheet.forward,
            reach: reach_m,
        };
        self.fixed.cut(&blade, out);
        for m in &self.moving {
            let from_world = m.world_from_body.inverse();
            let origin = from_world.transform_point(&blade.origin.into()).coords;
            let normal = from_world.rotation * blade.normal;
            // n·(R·x + p) = d
            let offset = blade.offset - blade.normal.dot(&m.world_from_body.translation.vector);
            let own = Blade { normal, offset, origin, forward: from_world.rotation * blade.forward, ..blade };
            let first = out.len();
            m.set.cut(&own, out);
            out[first..].iter_mut().for_each(|cut| *cut = cut.moved(&m.world_from_body));
        }
    }
}

impl Set {
    fn cut(&self, blade: &Blade, out: &mut Vec<Cut>) {
        let mut keep = |cut: Cut| {
            let Some(curve) = cut.curve.within(&blade.origin, blade.reach) else { return };
            let cut = Cut { curve, ..cut };
            cut.clipped(&blade.forward, blade.forward.dot(&blade.origin), |part| out.push(part));
        };
        self.flats.iter().for_each(|flat| flat.cut(blade, &mut keep));
        self.find(
            |low, high| blade.comes_near(low, high),
            |leaf| {
                match leaf {
                    Leaf::Triangle(triangle) => triangle.cut(blade, &mut keep),
                    Leaf::Solid(solid) => solid.cut(blade, &mut keep),
                }
                false
            },
        );
    }
}

impl Blade {
    /// Whether the sheet may pass through the box, in front of its origin and within reach.
    fn comes_near(&self, low: &V3, high: &V3) -> bool {
        let (centre, half) = ((low + high) / 2.0, (high - low) / 2.0);
        let from_origin = centre - self.origin;
        let gap = (from_origin.abs() - half).map(|x| x.max(0.0));
        (self.normal.dot(&centre) - self.offset).abs() <= self.normal.abs().dot(&half)
            && gap.norm_squared() <= self.reach * self.reach
            && self.forward.dot(&from_origin) + self.forward.abs().dot(&half) >= 0.0
    }

    /// The segment in which the sheet crosses a convex polygon. A corner in the sheet counts as on its upper side; so an
    /// edge is cut in the same point, to the bit, whichever of its faces is asked, and outlines close.
    fn across<const N: usize>(&self, corners: &[V3; N]) -> Option<Curve> {
        let height = corners.map(|c| self.normal.dot(&c) - self.offset);
        let mut ends = [None, None];
        for i in 0..N {
            let j = (i + 1) % N;
            if (height[i] >= 0.0) == (height[j] >= 0.0) {
                continue;
            }
            let (up, down) = if height[i] >= 0.0 { (i, j) } else { (j, i) };
            let t = height[up] / (height[up] - height[down]);
            let end = corners[up] + (corners[down] - corners[up]) * t;
            ends[usize::from(ends[0].is_some())] = Some(end);
        }
        let (a, b) = (ends[0]?, ends[1]?);
        (a != b).then_some(Curve::Segment { a, b })
    }
}

impl Flat {
    fn cut(&self, blade: &Blade, keep: &mut impl FnMut(Cut)) {
        let along = self.normal.cross(&blade.normal);
        let (length, cosine) = (along.norm_squared(), self.normal.dot(&blade.normal));
        if length < 1e-18 {
            return; // side by side
        }
        // The line's point nearest to the origin: origin + a·n + b·m with both planes' equations.
        let (p, q) = (self.offset - self.normal.dot(&blade.origin), blade.offset - blade.normal.dot(&blade.origin));
        let foot = (self.normal * (p - q * cosine) + blade.normal * (q - p * cosine)) / length;
        let half = blade.reach * blade.reach - foot.norm_squared();
        if half > 0.0 {
            let (middle, way) = (blade.origin + foot, along * (half / length).sqrt());
            let curve = Curve::Segment { a: middle - way, b: middle + way };
            keep(Cut { body: self.body as usize, curve, two_sided: false, facing: Facing::Flat(self.normal) });
        }
    }
}

impl Triangle {
    fn cut(&self, blade: &Blade, keep: &mut impl FnMut(Cut)) {
        if let Some(curve) = blade.across(&self.corners) {
            let facing = Facing::Flat(self.normal());
            keep(Cut { body: self.body as usize, curve, two_sided: true, facing });
        }
    }
}

impl Solid {
    fn cut(&self, blade: &Blade, keep: &mut impl FnMut(Cut)) {
        let mut on = |curve: Curve, facing: Facing| {
            keep(Cut { body: self.body as usize, curve, two_sided: false, facing });
        };
        match self.form {
            Form::Block { half } => {
                for axis in 0..3 {
                    for side in [-1.0, 1.0] {
                        let corners = self.face(&half, axis, side);
                        if let Some(curve) = blade.across(&corners) {
                            on(curve, Facing::Flat(self.axes.column(axis) * side));
                        }
                    }
                }
            }
            Form::Ball { radius } => {
                let height = blade.offset - blade.normal.dot(&self.centre);
                let size = radius * radius - height * height;
                if size > 0.0 {
                    let e1 = blade.forward * size.sqrt();
                    let centre = self.centre + blade.normal * height;
                    let facing = Facing::Round { centre: self.centre, axis: V3::zeros() };
                    on(Curve::Arc { centre, e1, e2: blade.normal.cross(&e1), t0: 0.0, t1: TAU }, facing);
                }
            }
            Form::Cylinder { radius, half } => self.cut_cylinder(blade, radius, half, &mut on),
        }
    }

    /// The corners of a box's face, in order around it.
    fn face(&self, half: &V3, axis: usize, side: f64) -> [V3; 4] {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(a, b)| {
            let mut local = V3::zeros();
            (local[axis], local[u], local[v]) = (side * half[axis], a * half[u], b * half[v]);
            self.centre + self.axes * local
        })
    }

    /// Caps as chords, the side as an ellipse between them, or as two lines where the sheet runs along the axis.
    fn cut_cylinder(&self, blade: &Blade, radius: f64, half: f64, on: &mut impl FnMut(Curve, Facing)) {
        let n = self.axes.tr_mul(&blade.normal);
        let d = blade.offset - blade.normal.dot(&self.centre);
        let world = |local: V3| self.centre + self.axes * local;
        let axis = self.axes.column(2).into_owned();
        let tilt = n.xy().norm();
        let chord = |z: f64| {
            let apart = (d - n.z * z) / tilt;
            let reach = radius * radius - apart * apart;
            (tilt > 1e-12 && reach > 0.0).then(|| {
                let (foot, way) = (n.xy() / tilt * apart, nalgebra::Vector2::new(-n.y, n.x) / tilt * reach.sqrt());
                [foot - way, foot + way].map(|p| world(V3::new(p.x, p.y, z)))
            })
        };
        let (bottom, top) = (chord(-half), chord(half));
        for (ends, side) in [(bottom, -1.0), (top, 1.0)] {
            if let Some([a, b]) = ends {
                on(Curve::Segment { a, b }, Facing::Flat(axis * side));
            }
        }
        let facing = Facing::Round { centre: self.centre, axis };
        if n.z.abs() < 1e-7 {
            if let (Some(low), Some(high)) = (bottom, top) {
                (0..2).for_each(|i| on(Curve::Segment { a: low[i], b: high[i] }, facing));
            }
            return;
        }
        // x = r·cos t, y = r·sin t, z = (d − nx·x − ny·y)/nz: on the cylinder and in the sheet for every t.
        let turn = |local: V3| self.axes * local;
        let ellipse = Curve::Arc {
            centre: world(V3::new(0.0, 0.0, d / n.z)),
            e1: turn(V3::new(radius, 0.0, -n.x * radius / n.z)),
            e2: turn(V3::new(0.0, radius, -n.y * radius / n.z)),
            t0: 0.0,
            t1: TAU,
        };
        let middle = axis.dot(&self.centre);
        ellipse.clipped(&axis, middle - half, |part| part.clipped(&-axis, -middle - half, |part| on(part, facing)));
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{Isometry3, Point3};
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::Plane;
    use crate::world::{Body, Material, Mesh, Motion, Scene, Shape};

    fn world(shape: Shape, pose: Isometry3<f64>, motion: Motion) -> Surfaces {
        let body = Body { name: "thing".into(), shape, pose, material: Material::default(), motion, ground: false };
        Surfaces::new(&Scene { bodies: vec![body], ..Scene::default() }).unwrap()
    }

    fn sheet(origin: V3, forward: V3, hint: V3) -> LaserPlane<World> {
        let forward = forward.normalize();
        let lateral = (hint - forward * forward.dot(&hint)).normalize();
        let plane = Plane::through(origin.into(), forward.cross(&lateral)).unwrap();
        LaserPlane { plane, origin: origin.into(), forward, lateral }
    }

    fn cuts(surfaces: &Surfaces, sheet: &LaserPlane<World>, reach_m: f64) -> Vec<Cut> {
        let mut out = Vec::new();
        surfaces.cut(sheet, reach_m, &mut out);
        out
    }

    fn length(cut: &Cut) -> f64 {
        let (t0, t1) = cut.curve.span();
        let n = 20_000;
        let step = (t1 - t0) / f64::from(n);
        (0..n).map(|i| cut.curve.tangent(t0 + (f64::from(i) + 0.5) * step).norm() * step).sum()
    }

    /// How far a point is from the cuts.
    fn apart(cuts: &[Cut], p: &V3) -> f64 {
        let to = |cut: &Cut| {
            let (t0, t1) = cut.curve.span();
            let far = |t: f64| (cut.curve.at(t) - p).norm();
            let coarse =
                (0..=200).map(|i| t0 + (t1 - t0) * f64::from(i) / 200.0).min_by(|a, b| far(*a).total_cmp(&far(*b)));
            let (mut t, mut step) = (coarse.unwrap(), (t1 - t0) / 200.0);
            while step > 1e-13 {
                t = [t - step, t, t + step]
                    .into_iter()
                    .map(|t| t.clamp(t0, t1))
                    .min_by(|a, b| far(*a).total_cmp(&far(*b)))
                    .unwrap();
                step *= 0.7;
            }
            far(t)
        };
        cuts.iter().map(to).fold(f64::INFINITY, f64::min)
    }

    const STILL: Motion = Motion::Static;

    #[test]
    fn a_cube_across_its_diagonal_is_a_hexagon() {
        let pose = Isometry3::new(V3::new(3.0, 1.0, 2.0), V3::new(0.2, -0.4, 1.0));
        for motion in [STILL, Motion::Dynamic { mass_kg: 1.0 }] {
            let surfaces = world(Shape::Box { size: V3::repeat(1.0) }, pose, motion);
            let normal = pose * V3::new(1.0, 1.0, 1.0).normalize();
            let across = normal.cross(&V3::z()).normalize();
            let light = sheet(pose.translation.vector - across * 2.0, across, normal.cross(&across));
            let cuts = cuts(&surfaces, &light, 9.0);
            assert_eq!(cuts.len(), 6);
            // Each edge joins the middles of two neighbouring edges of the cube: √2/2.
            assert!(cuts.iter().all(|cut| (length(cut) - 0.5f64.sqrt()).abs() < 1e-9));
            let ends: Vec<V3> = cuts.iter().flat_map(|cut| [cut.curve.at(0.0), cut.curve.at(1.0)]).collect();
            // Closed: every corner is the end of exactly two sides, to the bit for a body that stands still.
            let near = if motion == STILL { 0.0 } else { 1e-12 };
            assert!(ends.iter().all(|p| ends.iter().filter(|q| (*q - p).norm() <= near).count() == 2));
        }
    }

    #[test]
    fn a_level_sheet_on_the_top_of_a_box_gives_its_outline_once() {
        let surfaces = world(Shape::Box { size: V3::new(1.0, 2.0, 1.0) }, Isometry3::translation(3.0, 0.0, 0.0), STILL);
        for (height, perimeter) in [(-0.501, 0.0), (-0.5, 0.0), (0.0, 6.0), (0.5, 6.0), (0.501, 0.0)] {
            let light = sheet(V3::new(0.0, 0.0, height), V3::x(), V3::y());
            let total: f64 = cuts(&surfaces, &light, 9.0).iter().map(length).sum();
            assert!((total - perimeter).abs() < 1e-9, "{height}: {total}");
        }
    }

    #[test]
    fn a_tilted_cut_of_a_pipe_is_its_ellipse_between_its_caps() {
        // At 60° from level: half axes r and 2r; a long pipe holds all of it, perimeter by Ramanujan (exact to 1e-5 here).
        let light = sheet(V3::new(0.0, 0.0, 2.0 * 3f64.sqrt()), V3::new(1.0, 0.0, -(3f64.sqrt())), V3::y());
        let pipe =
            |length| world(Shape::Cylinder { radius: 0.25, length }, Isometry3::translation(2.0, 0.0, 0.0), STILL);
        let whole = cuts(&pipe(4.0), &light, 9.0);
        let (a, b) = (0.25f64, 0.5f64);
        let h = ((a - b) / (a + b)).powi(2);
        let ramanujan = std::f64::consts::PI * (a + b) * (1.0 + 3.0 * h / (10.0 + (4.0 - 3.0 * h).sqrt()));
        assert_eq!(whole.len(), 1);
        assert!((length(&whole[0]) - ramanujan).abs() < 1e-5);
        // A short one leaves two arcs and two chords: closed again.
        let short = cuts(&pipe(0.3), &light, 9.0);
        assert_eq!(short.len(), 4);
        let ends: Vec<V3> =
            short.iter().flat_map(|c| [c.curve.at(c.curve.span().0), c.curve.at(c.curve.span().1)]).collect();
        assert!(ends.iter().all(|p| ends.iter().filter(|q| (*q - p).norm() < 1e-9).count() == 2));
        // Along the axis: a rectangle.
        let upright = sheet(V3::new(0.0, 0.1, 0.0), V3::x(), V3::z());
        let total: f64 = cuts(&pipe(0.3), &upright, 9.0).iter().map(length).sum();
        assert!((total - 2.0 * (0.3 + 2.0 * (0.0625f64 - 0.01).sqrt())).abs() < 1e-9);
    }

    #[test]
    fn a_floor_is_cut_from_foot_to_reach() {
        let surfaces = world(Shape::Plane, Isometry3::identity(), STILL);
        let light = sheet(V3::new(0.0, 0.0, 0.8), V3::new(2.7, 0.0, -0.8), V3::y());
        let cuts = cuts(&surfaces, &light, 5.0);
        assert_eq!(cuts.len(), 1);
        let half = (25.0f64 - 2.7 * 2.7 - 0.8 * 0.8).sqrt();
        for t in [0.0, 1.0] {
            let p = cuts[0].curve.at(t);
            assert!((p.x - 2.7).abs() < 1e-12 && (p.y.abs() - half).abs() < 1e-12 && p.z.abs() < 1e-12);
        }
        // Behind the light nothing is lit.
        let up = sheet(V3::new(0.0, 0.0, 0.8), V3::new(2.7, 0.0, 0.8), V3::y());
        let mut none = Vec::new();
        surfaces.cut(&up, 5.0, &mut none);
        assert!(none.is_empty());
    }

    fn pieces() -> impl Strategy<Value = Shape> {
        let size = || 0.1..1.0f64;
        let tetrahedron = Mesh {
            vertices: vec![V3::zeros(), V3::x(), V3::y(), V3::z()],
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
        };
        prop_oneof![
            Just(Shape::Plane),
            prop::array::uniform3(size()).prop_map(|s| Shape::Box { size: V3::from(s) }),
            (size(), size()).prop_map(|(radius, length)| Shape::Cylinder { radius, length }),
            size().prop_map(|radius| Shape::Sphere { radius }),
            Just(Shape::Mesh(Arc::new(tetrahedron))),
        ]
    }

    /// Distance of a point from a surface, and the normal there, in the shape's frame; by formulas of the shape alone.
    fn off(shape: &Shape, p: &V3) -> f64 {
        match shape {
            Shape::Plane => p.z.abs(),
            Shape::Sphere { radius } => (p.norm() - radius).abs(),
            Shape::Cylinder { radius, length } => {
                let (side, end) = (p.xy().norm() - radius, p.z.abs() - length / 2.0);
                if side > 1e-9 || end > 1e-9 { side.max(end) } else { side.abs().min(end.abs()) }
            }
            Shape::Box { size } => {
                let deep = (0..3).map(|i| p[i].abs() - size[i] / 2.0).fold(f64::NEG_INFINITY, f64::max);
                deep.abs()
            }
            Shape::Mesh(_) => {
                let deep = [-p.x, -p.y, -p.z, (p.x + p.y + p.z - 1.0) / 3f64.sqrt()];
                deep.into_iter().fold(f64::NEG_INFINITY, f64::max).abs()
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(500))]

        #[test]
        fn cuts_lie_on_surface_and_sheet_and_miss_nothing(
            shape in pieces(), turn in prop::array::uniform3(-3.0..3.0f64), shift in prop::array::uniform3(-1.0..1.0f64),
            dynamic in any::<bool>(), upright in any::<bool>(),
            from in prop::array::uniform3(-2.5..2.5f64), aim in prop::array::uniform3(-0.5..0.5f64), hint in prop::array::uniform3(-1.0..1.0f64),
        ) {
            let turn = if upright { V3::zeros() } else { V3::from(turn) };
            let pose = Isometry3::new(V3::from(shift), turn);
            let motion = if dynamic { Motion::Dynamic { mass_kg: 1.0 } } else { STILL };
            let surfaces = world(shape.clone(), pose, motion);
            let light = sheet(V3::from(from), V3::from(aim) - V3::from(from), V3::from(hint));
            let reach = 5.0;
            let cuts = cuts(&surfaces, &light, reach);
            for cut in &cuts {
                let (t0, t1) = cut.curve.span();
                prop_assert!(t1 > t0);
                for i in 0..=16 {
                    let t = t0 + (t1 - t0) * f64::from(i) / 16.0;
                    let p = cut.curve.at(t);
                    let local = (pose.inverse() * Point3::from(p)).coords;
                    prop_assert!(light.plane.distance(p.into()).abs() < 1e-9);
                    prop_assert!(light.forward.dot(&(p - light.origin.xyz)) > -1e-9);
                    prop_assert!(off(&shape, &local) < 1e-9, "{} off {shape:?}", off(&shape, &local));
                    let n = cut.normal(t);
                    let out = |s: f64| { let q = pose.inverse() * Point3::from(p + n * s); off(&shape, &q.coords) };
                    prop_assert!((n.norm() - 1.0).abs() < 1e-9);
                    prop_assert!((out(1e-4) - 1e-4).abs() < 1e-6, "the normal points out: {}", out(1e-4));
                }
            }
            // Every ray in the sheet ends on a cut.
            for i in -20..=20 {
                let angle = f64::from(i) * 0.07;
                let way = light.forward * angle.cos() + light.lateral * angle.sin();
                if let Some(hit) = surfaces.cast(light.origin, &way, reach) {
                    let p = light.origin.xyz + way * hit.range_m;
                    prop_assert!(apart(&cuts, &p) < 1e-7, "{} from {} cuts", apart(&cuts, &p), cuts.len());
                }
            }
        }

        #[test]
        fn a_clipped_arc_keeps_exactly_what_is_in_front(
            t0 in -7.0..7.0f64, span in 0.1..6.2f64, angle in -3.0..3.0f64, offset in -1.2..1.2f64,
        ) {
            let arc = Curve::Arc { centre: V3::zeros(), e1: V3::x(), e2: V3::y() * 0.6, t0, t1: t0 + span };
            let n = V3::new(angle.cos(), angle.sin(), 0.0);
            let mut parts = Vec::new();
            arc.clipped(&n, offset, |part| parts.push(part.span()));
            for i in 0..200 {
                let t = t0 + span * (f64::from(i) + 0.5) / 200.0;
                let inside = n.dot(&arc.at(t)) - offset;
                let kept = parts.iter().filter(|(a, b)| (*a..=*b).contains(&t)).count();
                prop_assert!(inside.abs() < 1e-9 || kept == usize::from(inside > 0.0), "{kept} at {t}: {inside}, {parts:?}");
            }
        }
    }
}
