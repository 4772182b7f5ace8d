//! The surfaces of a world as light and sound meet them: rays. (Cuts are in `slice`, boxes in `touch`.)
//!
//! Own f64 geometry, since a ray that ends on a surface must not be stopped by the rounding of that surface: planes, boxes,
//! cylinders and balls are exact, meshes are their triangles. parry's bounding volume tree (f32) only finds the candidates;
//! its boxes are rounded outward. Bodies that never move share one tree in the world's frame; each body that can be pushed
//! has its own in its own frame, so that moving it costs nothing.

use std::cell::Cell;

use nalgebra::{Isometry3, Matrix3, Vector3};
use parry3d::bounding_volume::Aabb;
use parry3d::partitioning::{Bvh, BvhBuildStrategy, BvhNode, TraversalAction};

use super::body::{Body, Motion, Scene, Shape};
use crate::fault::{Fault, Result, positive};
use crate::geometry::{Point, World};

type V3 = Vector3<f64>;

/// What both ends of a line of sight are kept clear by, so that the surfaces it starts and ends on do not block it [m].
const CLEARANCE_M: f64 = 5e-4;
/// How far beyond its edges a triangle still stops a ray, in barycentric coordinates: neighbours leave no gap.
const EDGE: f64 = 1e-9;
/// Bodies that let through this share of the light stop none of it.
const CLEAR_FROM: f64 = 0.5;
/// What the boxes of the tree are larger than what they hold, for `EDGE` and rounding [m].
const MARGIN_M: f64 = 1e-6;

/// One triangle of a mesh.
#[derive(Clone, Copy, Debug)]
pub(super) struct Triangle {
    pub body: u32,
    pub corners: [V3; 3],
}

/// A convex solid; the columns of `axes` are its frame's axes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Solid {
    pub body: u32,
    pub centre: V3,
    pub axes: Matrix3<f64>,
    pub form: Form,
}

/// The form of a solid in its own frame.
#[derive(Clone, Copy, Debug)]
pub(super) enum Form {
    Block { half: V3 },
    Cylinder { radius: f64, half: f64 },
    Ball { radius: f64 },
}

/// An endless plane n·x = d, solid on the side away from n.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flat {
    pub body: u32,
    pub normal: V3,
    pub offset: f64,
}

/// Surfaces that share a frame. Leaves of the tree: first the triangles, then the solids.
#[derive(Clone, Debug)]
pub(super) struct Set {
    pub flats: Vec<Flat>,
    pub triangles: Vec<Triangle>,
    pub solids: Vec<Solid>,
    pub bvh: Bvh,
}

/// A body that can be pushed: its surfaces in its own frame.
#[derive(Clone, Debug)]
pub(super) struct Moving {
    pub body: usize,
    pub world_from_body: Isometry3<f64>,
    pub set: Set,
}

/// Where a ray met a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance from the ray's start [m].
    pub range_m: f64,
    /// Index of the body in the scene.
    pub body: usize,
    /// Unit normal of the surface, on the side that the ray came from; world frame.
    pub normal: Vector3<f64>,
}

/// All surfaces of a scene, for rays, cuts and boxes.
#[derive(Clone, Debug)]
pub struct Surfaces {
    pub(super) fixed: Set,
    pub(super) moving: Vec<Moving>,
    /// Which bodies light passes.
    clear: Vec<bool>,
}

/// A ray origin + t·direction; t is in metres where the direction is a unit vector.
#[derive(Clone, Copy, Debug)]
struct Ray {
    origin: V3,
    direction: V3,
}

impl Surfaces {
    /// Takes the bodies of a scene where they stand at the start.
    ///
    /// Errors: a pose or vertex that is not finite, a size that is not positive, a triangle without its vertices.
    pub fn new(scene: &Scene) -> Result<Self> {
        let mut fixed = Parts::default();
        let mut moving = Vec::new();
        for (index, body) in scene.bodies.iter().enumerate() {
            let number = u32::try_from(index).map_err(|_| Fault::new("bodies", index, "fewer than 2^32"))?;
            let named = |fault: Fault| Fault { what: format!("body {}: {}", body.name, fault.what), ..fault };
            match body.motion {
                Motion::Static => fixed.add(number, body, &body.pose).map_err(named)?,
                Motion::Dynamic { .. } | Motion::Scripted => {
                    let mut own = Parts::default();
                    own.add(number, body, &Isometry3::identity()).map_err(named)?;
                    finite_pose(&body.pose).map_err(named)?;
                    moving.push(Moving { body: index, world_from_body: body.pose, set: own.build()? });
                }
            }
        }
        let clear = scene.bodies.iter().map(|body| body.material.transmission >= CLEAR_FROM).collect();
        Ok(Self { fixed: fixed.build()?, moving, clear })
    }

    /// Moves a body that is not static to a new pose. Errors: a body that cannot move, a pose that is not finite.
    pub fn set_pose(&mut self, body: usize, world_from_body: Isometry3<f64>) -> Result<()> {
        finite_pose(&world_from_body)?;
        let Some(moving) = self.moving.iter_mut().find(|m| m.body == body) else {
            return Err(Fault::new("body to move", body, "the index of a dynamic body"));
        };
        moving.world_from_body = world_from_body;
        Ok(())
    }

    /// Whether any surface stands between two points. Half a millimetre at both ends is left out: what the points lie on
    /// does not block them. Meshes are tight: no ray slips between two triangles that share an edge.
    pub fn blocked(&self, from: Point<World>, to: Point<World>) -> bool {
        self.blocked_but_for(&[], from, to)
    }

    /// The same for light, which passes what lets through half of it or more.
    pub fn blocked_to_light(&self, from: Point<World>, to: Point<World>) -> bool {
        self.blocked_but_for(&self.clear, from, to)
    }

    fn blocked_but_for(&self, clear: &[bool], from: Point<World>, to: Point<World>) -> bool {
        let way = to.xyz - from.xyz;
        let length = way.norm();
        let (near, far) = (CLEARANCE_M, length - CLEARANCE_M);
        if !(length.is_finite() && far > near) {
            return false;
        }
        let ray = Ray { origin: from.xyz, direction: way / length };
        self.fixed.any_between(&ray, near, far, clear)
            || self.moving.iter().any(|m| m.set.any_between(&ray.seen_from(&m.world_from_body), near, far, clear))
    }

    /// The first surface along a ray, at most `range_m_max` away; `direction` may have any length but zero.
    pub fn cast(&self, from: Point<World>, direction: &Vector3<f64>, range_m_max: f64) -> Option<Hit> {
        let unit = direction.try_normalize(1e-300).filter(|d| d.iter().all(|v| v.is_finite()))?;
        let ray = Ray { origin: from.xyz, direction: unit };
        let mut best = self.fixed.nearest(&ray, range_m_max);
        for m in &self.moving {
            let limit = best.map_or(range_m_max, |(t, ..)| t);
            if let Some((t, body, normal)) = m.set.nearest(&ray.seen_from(&m.world_from_body), limit) {
                best = Some((t, body, m.world_from_body.rotation * normal));
            }
        }
        let (range_m, body, normal) = best?;
        let normal = if normal.dot(&unit) > 0.0 { -normal } else { normal };
        Some(Hit { range_m, body: body as usize, normal })
    }
}

/// A set before its tree is built.
#[derive(Default)]
struct Parts {
    flats: Vec<Flat>,
    triangles: Vec<Triangle>,
    solids: Vec<Solid>,
}

impl Parts {
    fn add(&mut self, number: u32, body: &Body, pose: &Isometry3<f64>) -> Result<()> {
        finite_pose(pose)?;
        let axes = pose.rotation.to_rotation_matrix().into_inner();
        let centre = pose.translation.vector;
        let mut solid = |form| self.solids.push(Solid { body: number, centre, axes, form });
        match &body.shape {
            Shape::Plane => {
                let normal = axes.column(2).into_owned();
                self.flats.push(Flat { body: number, normal, offset: normal.dot(&centre) });
            }
            Shape::Box { size } => {
                size.iter().try_for_each(|side| positive("size", *side).map(|_| ()))?;
                solid(Form::Block { half: size / 2.0 });
            }
            Shape::Cylinder { radius, length } => {
                solid(Form::Cylinder {
                    radius: positive("radius", *radius)?,
                    half: positive("length", *length)? / 2.0,
                });
            }
            Shape::Sphere { radius } => solid(Form::Ball { radius: positive("radius", *radius)? }),
            Shape::Mesh(mesh) => {
                let place = |index: u32| {
                    let vertex = mesh.vertices.get(index as usize).filter(|v| v.iter().all(|x| x.abs() < 1e9));
                    let expected = || format!("one of {} finite vertices", mesh.vertices.len());
                    vertex.map(|v| axes * v + centre).ok_or_else(|| Fault::new("mesh vertex", index, expected()))
                };
                for [a, b, c] in &mesh.triangles {
                    self.triangles.push(Triangle { body: number, corners: [place(*a)?, place(*b)?, place(*c)?] });
                }
            }
        }
        Ok(())
    }

    fn build(self) -> Result<Set> {
        let Self { flats, triangles, solids } = self;
        if triangles.len() + solids.len() > 1 << 30 {
            return Err(Fault::new("surfaces", triangles.len() + solids.len(), "at most 2^30"));
        }
        let boxes: Vec<Aabb> = triangles.iter().map(Triangle::bounds).chain(solids.iter().map(Solid::bounds)).collect();
        let bvh = Bvh::from_leaves(BvhBuildStrategy::Binned, &boxes);
        Ok(Set { flats, triangles, solids, bvh })
    }
}

fn finite_pose(pose: &Isometry3<f64>) -> Result<()> {
    let finite = pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|v| v.abs() < 1e9);
    if finite { Ok(()) } else { Err(Fault::new("pose", "a number that is not finite or beyond 1e9", "finite numbers")) }
}

/// The f32 box around `low`…`high`, rounded outward.
fn outward(low: V3, high: V3) -> Aabb {
    let down = |x: f64| ((x - MARGIN_M) as f32).next_down();
    let up = |x: f64| ((x + MARGIN_M) as f32).next_up();
    let vector = parry3d::math::Vector::new;
    Aabb::new(vector(down(low.x), down(low.y), down(low.z)), vector(up(high.x), up(high.y), up(high.z)))
}

impl Triangle {
    fn bounds(&self) -> Aabb {
        let [a, b, c] = &self.corners;
        outward(a.inf(b).inf(c), a.sup(b).sup(c))
    }

    /// The unit normal by the order of the corners; zero for a triangle without area.
    pub fn normal(&self) -> V3 {
        let [a, b, c] = &self.corners;
        (b - a).cross(&(c - a)).try_normalize(0.0).unwrap_or_else(V3::zeros)
    }

    /// Where the ray passes through, edges included (Möller and Trumbore).
    fn meet(&self, ray: &Ray) -> Option<f64> {
        let [a, b, c] = &self.corners;
        let (ab, ac) = (b - a, c - a);
        let p = ray.direction.cross(&ac);
        let det = ab.dot(&p);
        if det.abs() <= 1e-14 * ab.norm() * ac.norm() {
            return None; // along the triangle: its neighbours stop the ray
        }
        let s = ray.origin - a;
        let q = s.cross(&ab);
        let (u, v) = (s.dot(&p) / det, ray.direction.dot(&q) / det);
        (u >= -EDGE && v >= -EDGE && u + v <= 1.0 + EDGE).then(|| ac.dot(&q) / det)
    }
}

impl Solid {
    fn bounds(&self) -> Aabb {
        let half = match self.form {
            Form::Block { half } => self.axes.abs() * half,
            Form::Ball { radius } => V3::repeat(radius),
            Form::Cylinder { radius, half } => {
                let axis = self.axes.column(2);
                axis.map(|a| a.abs() * half + radius * (1.0 - a * a).max(0.0).sqrt())
            }
        };
        outward(self.centre - half, self.centre + half)
    }

    /// Where the ray enters and leaves; also behind its start.
    fn pierce(&self, ray: &Ray) -> Option<(f64, f64)> {
        let o = self.axes.tr_mul(&(ray.origin - self.centre));
        let d = self.axes.tr_mul(&ray.direction);
        let slab = |(enter, leave): (f64, f64), axis: usize, half: f64| {
            if d[axis] == 0.0 {
                return if o[axis].abs() <= half { (enter, leave) } else { (f64::INFINITY, f64::NEG_INFINITY) };
            }
            let (a, b) = ((-half - o[axis]) / d[axis], (half - o[axis]) / d[axis]);
            (enter.max(a.min(b)), leave.min(a.max(b)))
        };
        let endless = (f64::NEG_INFINITY, f64::INFINITY);
        let (enter, leave) = match self.form {
            Form::Block { half } => (0..3).fold(endless, |span, axis| slab(span, axis, half[axis])),
            Form::Ball { radius } => round(&o, &d, radius)?,
            Form::Cylinder { radius, half } => {
                let side = round(&V3::new(o.x, o.y, 0.0), &V3::new(d.x, d.y, 0.0), radius)?;
                slab(side, 2, half)
            }
        };
        (enter <= leave).then_some((enter, leave))
    }

    /// The outward unit normal at a point on the surface.
    fn normal(&self, at: &V3) -> V3 {
        let p = self.axes.tr_mul(&(at - self.centre));
        let local = match self.form {
            Form::Ball { .. } => p,
            Form::Block { half } => {
                let axis = p.component_div(&half).iamax();
                V3::ith(axis, p[axis].signum())
            }
            Form::Cylinder { radius, half } => {
                let side = p.xy().norm();
                if half - p.z.abs() < radius - side { V3::z() * p.z.signum() } else { V3::new(p.x, p.y, 0.0) }
            }
        };
        (self.axes * local).try_normalize(0.0).unwrap_or_else(V3::z)
    }
}

/// Where a ray enters and leaves the ball |x| ≤ radius, or with z = 0 the endless cylinder. Worked from the point of
/// closest approach, which keeps all digits where b² − ac would lose half of them.
fn round(o: &V3, d: &V3, radius: f64) -> Option<(f64, f64)> {
    let speed = d.norm_squared();
    if speed < 1e-30 {
        return (o.norm_squared() <= radius * radius).then_some((f64::NEG_INFINITY, f64::INFINITY));
    }
    let middle = -o.dot(d) / speed;
    let depth = radius * radius - (o + d * middle).norm_squared();
    (depth >= 0.0).then(|| {
        let half = (depth / speed).sqrt();
        (middle - half, middle + half)
    })
}

impl Ray {
    /// The same ray in the frame of a body.
    fn seen_from(&self, world_from_body: &Isometry3<f64>) -> Self {
        let origin = world_from_body.inverse_transform_point(&self.origin.into()).coords;
        Self { origin, direction: world_from_body.inverse_transform_vector(&self.direction) }
    }
}

/// Lower and upper corner of a node.
pub(super) fn corners(node: &BvhNode) -> (V3, V3) {
    let (low, high) = (node.mins(), node.maxs());
    (V3::new(low.x.into(), low.y.into(), low.z.into()), V3::new(high.x.into(), high.y.into(), high.z.into()))
}

/// One surface of the tree.
pub(super) enum Leaf<'a> {
    Triangle(&'a Triangle),
    Solid(&'a Solid),
}

impl Set {
    /// Calls `leaf` for each surface whose box, and all boxes around it, pass `near`, until `leaf` returns true.
    pub fn find(&self, near: impl Fn(&V3, &V3) -> bool, mut leaf: impl FnMut(Leaf<'_>) -> bool) {
        self.bvh.traverse(|node| {
            let (low, high) = corners(node);
            if !near(&low, &high) {
                return TraversalAction::Prune;
            }
            let Some(index) = node.leaf_data().map(|index| index as usize) else { return TraversalAction::Continue };
            let found = match self.triangles.get(index) {
                Some(triangle) => leaf(Leaf::Triangle(triangle)),
                None => self.solids.get(index - self.triangles.len()).is_some_and(|solid| leaf(Leaf::Solid(solid))),
            };
            if found { TraversalAction::EarlyExit } else { TraversalAction::Continue }
        });
    }

    fn any_between(&self, ray: &Ray, near: f64, far: f64, clear: &[bool]) -> bool {
        let within = |t: f64| t > near && t < far;
        let stops = |body: u32| clear.get(body as usize) != Some(&true);
        if self.flats.iter().any(|flat| stops(flat.body) && flat.meet(ray).is_some_and(within)) {
            return true;
        }
        let inverse = ray.direction.map(|d| 1.0 / d);
        let mut found = false;
        self.find(
            |low, high| crosses(ray, &inverse, low, high, near, far),
            |leaf| {
                found = match leaf {
                    Leaf::Triangle(triangle) => stops(triangle.body) && triangle.meet(ray).is_some_and(within),
                    Leaf::Solid(solid) => {
                        stops(solid.body) && solid.pierce(ray).is_some_and(|(a, b)| within(a) || within(b))
                    }
                };
                found
            },
        );
        found
    }

    /// The nearest surface in front of the ray's start and not beyond `limit`: distance, body, its own normal.
    fn nearest(&self, ray: &Ray, limit: f64) -> Option<(f64, u32, V3)> {
        let best = Cell::new(None::<(f64, u32, V3)>);
        let limit = Cell::new(limit);
        let offer = |t: f64, body: u32, normal: &dyn Fn() -> V3| {
            if t > 0.0 && t <= limit.get() {
                limit.set(t);
                best.set(Some((t, body, normal())));
            }
        };
        for flat in &self.flats {
            if let Some(t) = flat.meet(ray) {
                offer(t, flat.body, &|| flat.normal);
            }
        }
        let inverse = ray.direction.map(|d| 1.0 / d);
        self.find(
            |low, high| crosses(ray, &inverse, low, high, 0.0, limit.get()),
            |leaf| {
                match leaf {
                    Leaf::Triangle(triangle) => {
                        if let Some(t) = triangle.meet(ray) {
                            offer(t, triangle.body, &|| triangle.normal());
                        }
                    }
                    Leaf::Solid(solid) => {
                        if let Some((enter, leave)) = solid.pierce(ray) {
                            let t = if enter > 0.0 { enter } else { leave };
                            offer(t, solid.body, &|| solid.normal(&(ray.origin + ray.direction * t)));
                        }
                    }
                }
                false
            },
        );
        best.get()
    }
}

impl Flat {
    fn meet(&self, ray: &Ray) -> Option<f64> {
        let closing = self.normal.dot(&ray.direction);
        (closing != 0.0).then(|| (self.offset - self.normal.dot(&ray.origin)) / closing)
    }
}

/// Whether the ray passes through the box between `near` and `far`. A component of 0 gives ±∞, and NaN on the very
/// face, which min and max leave out.
fn crosses(ray: &Ray, inverse: &V3, low: &V3, high: &V3, near: f64, far: f64) -> bool {
    let (mut enter, mut leave) = (near, far);
    for i in 0..3 {
        let (a, b) = ((low[i] - ray.origin[i]) * inverse[i], (high[i] - ray.origin[i]) * inverse[i]);
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    enter <= leave
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::Point3;
    use parry3d::math::{Pose, Rotation, Vector};
    use parry3d::query::RayCast;
    use parry3d::shape::{Ball, Cuboid, Cylinder};
    use proptest::prelude::*;

    use super::*;
    use crate::world::{Material, Mesh};

    fn body(shape: Shape, pose: Isometry3<f64>, motion: Motion) -> Body {
        Body { name: "thing".into(), shape, pose, material: Material::default(), motion, ground: false }
    }

    fn world(bodies: Vec<Body>) -> Surfaces {
        Surfaces::new(&Scene { bodies, ..Scene::default() }).unwrap()
    }

    fn at(x: f64, y: f64, z: f64) -> Isometry3<f64> {
        Isometry3::translation(x, y, z)
    }

    /// A ball of triangles: an octahedron whose faces are split four times.
    fn ball_mesh(radius: f64) -> Mesh {
        let mut faces: Vec<[V3; 3]> = Vec::new();
        for (x, y, z) in
            (0..8).map(|i| (1.0 - 2.0 * f64::from(i & 1), 1.0 - f64::from(i & 2), 1.0 - f64::from(i & 4) / 2.0))
        {
            let (a, b, c) = (V3::x() * x, V3::y() * y, V3::z() * z);
            faces.push(if x * y * z > 0.0 { [a, b, c] } else { [a, c, b] });
        }
        for _ in 0..4 {
            let halved = |[a, b, c]: [V3; 3]| {
                let (ab, bc, ca) = ((a + b).normalize(), (b + c).normalize(), (c + a).normalize());
                [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            };
            faces = faces.into_iter().flat_map(halved).collect();
        }
        let vertices: Vec<V3> = faces.iter().flatten().map(|v| v * radius).collect();
        let triangles = (0..faces.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        Mesh { vertices, triangles }
    }

    fn poses() -> impl Strategy<Value = Isometry3<f64>> {
        (prop::array::uniform3(-1.0..1.0f64), prop::array::uniform3(-3.0..3.0f64))
            .prop_map(|(p, r)| Isometry3::new(V3::from(p), V3::from(r)))
    }

    fn motions() -> impl Strategy<Value = Motion> {
        prop_oneof![Just(Motion::Static), Just(Motion::Dynamic { mass_kg: 1.0 })]
    }

    fn shapes() -> impl Strategy<Value = Shape> {
        let size = || 0.1..1.0f64;
        prop_oneof![
            Just(Shape::Plane),
            prop::array::uniform3(size()).prop_map(|s| Shape::Box { size: V3::from(s) }),
            (size(), size()).prop_map(|(radius, length)| Shape::Cylinder { radius, length }),
            size().prop_map(|radius| Shape::Sphere { radius }),
            size().prop_map(|radius| Shape::Mesh(Arc::new(ball_mesh(radius)))),
        ]
    }

    /// Points all over a shape's surface, at most about `step` apart; own frame, of a plane only 8 m.
    fn dots(shape: &Shape, step: f64) -> Vec<V3> {
        let steps = |length: f64| (length / step).ceil() as i32;
        let mut out = Vec::new();
        let mut patch = |corner: V3, u: V3, v: V3| {
            let (m, n) = (steps(u.norm()).max(1), steps(v.norm()).max(1));
            for i in 0..=m {
                out.extend((0..=n).map(|j| corner + u * f64::from(i) / f64::from(m) + v * f64::from(j) / f64::from(n)));
            }
        };
        match shape {
            Shape::Plane => patch(V3::new(-4.0, -4.0, 0.0), V3::x() * 8.0, V3::y() * 8.0),
            Shape::Box { size } => {
                for axis in 0..3 {
                    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                    for side in [-0.5, 0.5] {
                        let mut corner = -size / 2.0;
                        corner[axis] = side * size[axis];
                        patch(corner, V3::ith(u, size[u]), V3::ith(v, size[v]));
                    }
                }
            }
            Shape::Cylinder { radius, length } => {
                let ring = |r: f64, z: f64, out: &mut Vec<V3>| {
                    let n = steps(std::f64::consts::TAU * r).max(1);
                    out.extend((0..n).map(|i| {
                        let t = std::f64::consts::TAU * f64::from(i) / f64::from(n);
                        V3::new(r * t.cos(), r * t.sin(), z)
                    }));
                };
                let (m, n) = (steps(*length).max(1), steps(*radius).max(1));
                (0..=m).for_each(|i| ring(*radius, length * (f64::from(i) / f64::from(m) - 0.5), &mut out));
                for z in [-length / 2.0, length / 2.0] {
                    (0..=n).for_each(|i| ring(radius * f64::from(i) / f64::from(n), z, &mut out));
                }
            }
            Shape::Sphere { radius } => {
                let n = (12.6 * radius * radius / (step * step) * 3.0).ceil();
                out.extend((0..n as i32).map(|i| {
                    let z = 1.0 - (2.0 * f64::from(i) + 1.0) / n;
                    let t = 2.399_963_229_728_653 * f64::from(i);
                    let r = (1.0 - z * z).sqrt();
                    V3::new(r * t.cos(), r * t.sin(), z) * *radius
                }));
            }
            Shape::Mesh(mesh) => {
                for t in &mesh.triangles {
                    let [a, b, c] = t.map(|i| mesh.vertices[i as usize]);
                    let n = steps((b - a).norm().max((c - a).norm()).max((c - b).norm())).max(1);
                    for i in 0..=n {
                        let at =
                            |j: i32| a + (b - a) * f64::from(i) / f64::from(n) + (c - a) * f64::from(j) / f64::from(n);
                        out.extend((0..=n - i).map(at));
                    }
                }
            }
        }
        out
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(400))]

        #[test]
        fn a_box_is_touched_where_the_surface_has_points_in_it(
            shape in shapes(), pose in poses(), motion in motions(),
            centre in prop::array::uniform3(-1.2..1.2f64), half in prop::array::uniform3(0.02..0.4f64),
        ) {
            let step = 0.02;
            let surfaces = world(vec![body(shape.clone(), pose, motion)]);
            let (c, h) = (V3::from(centre), V3::from(half));
            let touched = surfaces.touches((c - h).into(), (c + h).into());
            let dots: Vec<V3> = dots(&shape, step).iter().map(|p| (pose * Point3::from(*p)).coords - c).collect();
            let within = |grow: f64| dots.iter().any(|p| (0..3).all(|i| p[i].abs() <= h[i] + grow));
            prop_assert!(touched || !within(-1e-9), "a surface point lies in the box");
            prop_assert!(!touched || within(step), "no surface point is near the box");
        }

        #[test]
        fn rays_meet_what_parry_says(
            kind in 0..3, pose in poses(), sizes in prop::array::uniform3(0.1..1.0f64), motion in motions(),
            from in prop::array::uniform3(-3.0..3.0f64), aim in prop::array::uniform3(-0.8..0.8f64),
        ) {
            let [a, b, c] = sizes;
            let (shape, theirs): (_, Box<dyn RayCast>) = match kind {
                0 => (Shape::Box { size: V3::from(sizes) * 2.0 }, Box::new(Cuboid::new(Vector::new(a as f32, b as f32, c as f32)))),
                1 => (Shape::Sphere { radius: a }, Box::new(Ball::new(a as f32))),
                _ => (Shape::Cylinder { radius: a, length: 2.0 * b }, Box::new(Cylinder::new(b as f32, a as f32))),
            };
            let surfaces = world(vec![body(shape, pose, motion)]);
            let (from, aim) = (V3::from(from), V3::from(aim));
            let direction = (aim - from).normalize();
            let ours = surfaces.cast(from.into(), &direction, 20.0);
            // parry's cylinder stands on y: turn the ray, not the shape.
            let local = pose.inverse();
            let turn = |v: V3| if kind == 2 { Vector::new(v.y as f32, v.z as f32, v.x as f32) } else { Vector::new(v.x as f32, v.y as f32, v.z as f32) };
            let ray = parry3d::query::Ray::new(turn((local * Point3::from(from)).coords), turn(local * direction));
            let still = Pose::from_parts(Vector::ZERO, Rotation::IDENTITY);
            let theirs = theirs.cast_ray(&still, &ray, 20.0, false);
            match (ours, theirs) {
                (Some(ours), Some(theirs)) => {
                    // Parry finds its cylinder by iteration, with rims half a millimetre wide: a ray that passes one so near is
                    // right to miss it, if one a millimetre beside meets it where parry says.
                    let theirs = f64::from(theirs);
                    let across = direction.cross(&V3::x()).try_normalize(0.1).unwrap_or_else(|| direction.cross(&V3::y()).normalize());
                    let beside = (0..8).map(|k| nalgebra::UnitQuaternion::from_scaled_axis(direction * (f64::from(k) * 0.785)) * across * 1e-3);
                    let mut grazed = beside.filter_map(|off| surfaces.cast((from + off).into(), &direction, 20.0));
                    let agree = |hit: &Hit, off_m: f64| (hit.range_m - theirs).abs() < off_m;
                    prop_assert!(agree(&ours, 2e-3) || grazed.any(|hit| agree(&hit, 5e-3)), "{ours:?} {theirs}");
                    prop_assert!(ours.normal.dot(&direction) <= 0.0 && (ours.normal.norm() - 1.0).abs() < 1e-9);
                }
                (None, None) => {}
                (Some(hit), None) => prop_assert!(hit.normal.dot(&direction).abs() < 0.05, "{hit:?}"),
                (None, Some(t)) => {
                    let near = from + direction * f64::from(t);
                    let half = V3::repeat(2e-4);
                    prop_assert!(surfaces.touches((near - half).into(), (near + half).into()), "missed at {t}");
                }
            }
        }

        #[test]
        fn a_hit_lies_on_the_surface_and_blocks(
            shape in shapes(), pose in poses(), motion in motions(),
            from in prop::array::uniform3(-3.0..3.0f64), aim in prop::array::uniform3(-0.5..0.5f64),
        ) {
            let surfaces = world(vec![body(shape, pose, motion)]);
            let (from, aim) = (V3::from(from), V3::from(aim));
            if let Some(hit) = surfaces.cast(from.into(), &(aim - from), 20.0) {
                let way = (aim - from).normalize();
                let at = from + way * hit.range_m;
                let tiny = V3::repeat(1e-9);
                prop_assert!(surfaces.touches((at - tiny).into(), (at + tiny).into()));
                prop_assert!(!surfaces.blocked(from.into(), at.into()));
                prop_assert_eq!(surfaces.blocked(from.into(), (at + way * 2e-3).into()), hit.range_m > 5e-4);
            }
        }
    }

    #[test]
    fn a_closed_mesh_lets_no_ray_out() {
        let mesh = ball_mesh(1.0);
        let surfaces = world(vec![body(Shape::Mesh(Arc::new(mesh.clone())), at(0.3, 0.1, -0.2), Motion::Static)]);
        let eye = Point::new(0.3, 0.1, -0.2);
        let mut rays = 0;
        for triangle in &mesh.triangles {
            let [a, b, c] = triangle.map(|i| mesh.vertices[i as usize]);
            for aim in [a, b, c, (a + b) / 2.0, (b + c) / 2.0, (a + c) / 2.0, a * 0.3 + b * 0.7, (a + b + c) / 3.0] {
                assert!(surfaces.blocked(eye, (eye.xyz + aim * 3.0).into()), "{aim}");
                assert!(surfaces.cast(eye, &aim, 5.0).is_some());
                rays += 1;
            }
        }
        assert!(rays > 16_000);
    }

    #[test]
    fn a_floor_is_seen_at_grazing_incidence() {
        let floor = body(Shape::Plane, at(0.0, 0.0, 0.0), Motion::Static);
        let slab = body(Shape::Box { size: V3::new(2000.0, 2000.0, 1.0) }, at(0.0, 0.0, -0.5), Motion::Static);
        for thing in [floor, slab] {
            let surfaces = world(vec![thing]);
            for height in [1e-6, 1e-3, 1.0] {
                for range in [1.0, 30.0, 900.0] {
                    let (eye, foot) = (Point::new(0.0, 0.0, height), Point::new(range, 0.3, 0.0));
                    assert!(!surfaces.blocked(eye, foot), "{height} {range}");
                    assert!(surfaces.blocked(eye, Point::new(range, 0.3, -height)), "{height} {range}");
                }
            }
        }
    }

    #[test]
    fn a_ball_is_met_to_a_nanometre_from_afar() {
        let surfaces = world(vec![body(Shape::Sphere { radius: 0.25 }, at(40.0, 0.0, 0.0), Motion::Static)]);
        for y in [0.0, 0.1, 0.2, 0.249] {
            let hit = surfaces.cast(Point::new(0.0, y, 0.0), &V3::x(), 100.0).unwrap();
            assert!((hit.range_m - (40.0 - (0.0625f64 - y * y).sqrt())).abs() < 1e-9);
        }
    }

    #[test]
    fn a_pushed_body_is_where_it_was_put() {
        let thing = body(Shape::Box { size: V3::repeat(1.0) }, at(5.0, 0.0, 0.0), Motion::Dynamic { mass_kg: 1.0 });
        let wall = body(Shape::Box { size: V3::repeat(1.0) }, at(9.0, 0.0, 0.0), Motion::Static);
        let mut surfaces = world(vec![wall, thing]);
        let cast = |s: &Surfaces| s.cast(Point::new(0.0, 0.0, 0.0), &V3::x(), 20.0).unwrap();
        assert_eq!((cast(&surfaces).range_m, cast(&surfaces).body), (4.5, 1));
        surfaces.set_pose(1, at(0.0, 3.0, 0.0)).unwrap();
        assert_eq!((cast(&surfaces).range_m, cast(&surfaces).body), (8.5, 0));
        assert!(
            surfaces.touches([0.0, 2.4, 0.0], [0.1, 2.6, 0.1]) && !surfaces.touches([5.4, 0.0, 0.0], [5.6, 0.1, 0.1])
        );
        assert!(surfaces.set_pose(0, at(0.0, 0.0, 0.0)).is_err());
        assert!(surfaces.set_pose(1, at(f64::NAN, 0.0, 0.0)).is_err());
    }

    #[test]
    fn impossible_bodies_are_refused() {
        let refused = |shape: Shape, pose| {
            let bodies = vec![body(shape, pose, Motion::Static)];
            Surfaces::new(&Scene { bodies, ..Scene::default() }).unwrap_err().to_string()
        };
        assert!(refused(Shape::Sphere { radius: -1.0 }, at(0.0, 0.0, 0.0)).starts_with("body thing: radius: found -1"));
        assert!(refused(Shape::Plane, at(0.0, f64::INFINITY, 0.0)).contains("pose"));
        let mesh = Mesh { vertices: vec![V3::zeros()], triangles: vec![[0, 0, 7]] };
        assert!(refused(Shape::Mesh(Arc::new(mesh)), at(0.0, 0.0, 0.0)).contains("mesh vertex: found 7"));
        let mesh = Mesh { vertices: vec![V3::repeat(f64::NAN)], triangles: vec![[0, 0, 0]] };
        assert!(refused(Shape::Mesh(Arc::new(mesh)), at(0.0, 0.0, 0.0)).contains("mesh vertex"));
    }

    #[test]
    fn an_empty_world_has_nothing_in_it() {
        let surfaces = world(vec![]);
        assert!(!surfaces.blocked(Point::new(0.0, 0.0, 0.0), Point::new(9.0, 0.0, 0.0)));
        assert!(surfaces.cast(Point::new(0.0, 0.0, 0.0), &V3::x(), 9.0).is_none());
        assert!(surfaces.cast(Point::new(0.0, 0.0, 0.0), &V3::zeros(), 9.0).is_none());
        assert!(!surfaces.touches([-1.0; 3], [1.0; 3]));
    }
}
