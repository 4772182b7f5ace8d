//! Rigid bodies: the scene and the robot, moved by rapier. The only file that names rapier.
//!
//! The robot is one rigid body on small balls. A ball does not turn; instead its patch on the floor is a conveyor belt
//! with the speed of the rolling wheel, so the solver itself finds the traction, never more than friction × load. A wheel
//! that is held slips, one at rest holds, and nothing outside the contacts keeps the robot upright.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use rapier3d::dynamics::{CoefficientCombineRule, MassProperties, RigidBodyBuilder, RigidBodyHandle};
use rapier3d::geometry::{Collider, ColliderBuilder, ColliderHandle, Ray, SharedShape, TriMeshFlags};
use rapier3d::math::{Pose, Rotation, Vector};
use rapier3d::pipeline::{ActiveHooks, ContactModificationContext, PhysicsHooks, PhysicsWorld, QueryFilter};

use super::body::{Body, Mesh, Motion, Scene, Shape};
use super::movers::Mover;
use crate::fault::{Fault, Result, number_within};
use crate::geometry::{Robot, Transform, World};

/// Gravity [m/s²].
const GRAVITY: f64 = 9.81;
/// A robot starts on the highest surface below this height [m].
const START_HEIGHT_M: f64 = 0.5;
/// Nothing may lie farther out than this [m]: single precision is 8 mm there.
const REACH_M: f64 = 1e5;
/// Contacts with the same body less than this apart are one collision [s].
const COLLISION_GAP_S: f64 = 0.5;
/// Friction of the chassis' hull [A].
const HULL_FRICTION: f32 = 0.3;
/// Overlaps smaller than this are not refused at the start [m].
const START_SLACK_M: f64 = 0.003;

/// The robot as a rigid body: a cylinder on wheels, its frame on the floor between their contact points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RobotBody {
    /// Radius of the chassis [m].
    pub radius_m: f64,
    /// Height of its top over the floor [m].
    pub height_m: f64,
    /// Height of its underside over the floor [m].
    pub clearance_m: f64,
    /// Mass of everything [kg].
    pub mass_kg: f64,
    /// Height of the centre of mass over the floor [m].
    pub mass_height_m: f64,
    /// Number of wheels, evenly on a circle: 3 to 8.
    pub wheels: usize,
    /// Radius of that circle [m].
    pub wheel_circle_m: f64,
    /// Radius of a wheel [m].
    pub wheel_radius_m: f64,
    /// Coulomb friction of the wheels; on slippier ground the ground's counts.
    pub friction: f64,
}

/// METRO-I: 0.6 m across; all else is [A].
impl Default for RobotBody {
    fn default() -> Self {
        Self {
            radius_m: 0.3,
            height_m: 1.0,
            clearance_m: 0.03,
            mass_kg: 60.0,
            mass_height_m: 0.25,
            wheels: 4,
            wheel_circle_m: 0.22,
            wheel_radius_m: 0.07,
            friction: 0.8,
        }
    }
}

impl RobotBody {
    /// Refuses a body that is not one, or whose wheels stick out of it.
    pub fn validated(self) -> Result<Self> {
        number_within("radius_m", self.radius_m, 0.01, 10.0)?;
        number_within("clearance_m", self.clearance_m, 0.001, 1.0)?;
        number_within("height_m", self.height_m, self.clearance_m + 0.01, 10.0)?;
        number_within("mass_kg", self.mass_kg, 0.1, 1e5)?;
        number_within("mass_height_m", self.mass_height_m, 0.0, self.height_m)?;
        number_within("wheels", self.wheels as f64, 3.0, 8.0)?;
        number_within("wheel_radius_m", self.wheel_radius_m, self.clearance_m / 2.0, self.radius_m)?;
        number_within("wheel_circle_m", self.wheel_circle_m, 0.001, self.radius_m - self.wheel_radius_m + 1e-9)?;
        number_within("friction", self.friction, 0.0, 10.0)?;
        Ok(self)
    }

    /// Where the wheels stand on the floor, in the robot's frame [m]; the first two straddle the heading.
    fn wheel_feet(&self) -> Vec<[f64; 2]> {
        let angle = |k: usize| (k as f64 + 0.5) * TAU / self.wheels as f64;
        (0..self.wheels).map(|k| [self.wheel_circle_m * angle(k).cos(), self.wheel_circle_m * angle(k).sin()]).collect()
    }

    fn chassis(&self, shrink_m: f64) -> (SharedShape, f64) {
        let half = (self.height_m - self.clearance_m) / 2.0;
        let shape = SharedShape::cylinder((half - shrink_m) as f32, (self.radius_m - shrink_m) as f32);
        (shape, self.clearance_m + half)
    }
}

/// How the wheels roll, seen from the robot: the motion the floor would show under a robot that does not slip.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rolling {
    /// Speed forward [m/s].
    pub forward_m_s: f64,
    /// Speed to the left [m/s].
    pub left_m_s: f64,
    /// Turn rate, counter-clockwise [rad/s].
    pub turn_rad_s: f64,
}

/// How the robot moves, in the world frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RobotVelocity {
    /// Velocity of the origin of the robot's frame [m/s].
    pub linear: Vector3<f64>,
    /// Angular velocity [rad/s].
    pub angular: Vector3<f64>,
}

/// A body of the scene in the simulation.
struct Placed {
    name: String,
    start: Isometry3<f64>,
    handle: Option<RigidBodyHandle>,
}

/// The scene and the robot, moved in fixed steps. The same calls give the same bits.
pub struct Physics {
    world: PhysicsWorld,
    bodies: Vec<Placed>,
    movers: Vec<Mover>,
    colliders: Vec<(ColliderHandle, usize)>,
    robot: RigidBodyHandle,
    chassis: ColliderHandle,
    wheels: Vec<(ColliderHandle, [f64; 2])>,
    dt_s: f64,
    steps: u64,
    collisions: u64,
    /// What the chassis touched, and in which step last.
    touched: Vec<(ColliderHandle, u64)>,
}

impl Physics {
    /// Default length of a step [s].
    pub const DT_S: f64 = 1.0 / 240.0;

    /// Places the scene, and the robot at x, y [m] and yaw [rad] on the highest ground below 0.5 m, level with it.
    ///
    /// Errors: a body, mesh or robot with impossible numbers; no ground under a wheel; a robot inside a body.
    pub fn new(scene: &Scene, robot: &RobotBody, [x, y]: [f64; 2], yaw: f64, dt_s: f64) -> Result<Self> {
        let robot = robot.validated()?;
        number_within("physics step", dt_s, 1e-5, 0.02)?;
        for (what, value) in [("start.x", x), ("start.y", y), ("start.yaw", yaw)] {
            number_within(what, value, -REACH_M, REACH_M)?;
        }
        let mut world = PhysicsWorld { gravity: Vector::new(0.0, 0.0, -GRAVITY as f32), ..PhysicsWorld::default() };
        let mut bodies = Vec::with_capacity(scene.bodies.len());
        let mut colliders = Vec::with_capacity(scene.bodies.len());
        for (index, body) in scene.bodies.iter().enumerate() {
            let (handle, collider) = place(&mut world, body)?;
            bodies.push(Placed { name: body.name.clone(), start: body.pose, handle });
            colliders.push((collider, index));
        }
        // Rays read the tree that a step builds; in none of no length does anything move.
        world.integration_parameters.dt = 0.0;
        world.step();
        world.integration_parameters.dt = dt_s as f32;
        let pose = start_pose(&world, &robot, Transform::planar(x, y, yaw))?;
        if let Some(hit) = overlap(&world, &robot, &pose) {
            let name = colliders.iter().find(|c| c.0 == hit).and_then(|c| bodies.get(c.1)).map_or("?", |b| &b.name);
            let expected = "a place where it touches nothing but the ground";
            return Err(Fault::new("robot start", format!("({x}, {y}), inside \"{name}\""), expected));
        }
        let (robot_handle, chassis, wheels) = place_robot(&mut world, &robot, &pose);
        Ok(Self {
            world,
            bodies,
            movers: scene.movers.clone(),
            colliders,
            robot: robot_handle,
            chassis,
            wheels,
            dt_s,
            steps: 0,
            collisions: 0,
            touched: Vec::new(),
        })
    }

    /// Length of a step [s].
    pub fn dt_s(&self) -> f64 {
        self.dt_s
    }

    /// Simulated time [s].
    pub fn elapsed_s(&self) -> f64 {
        self.steps as f64 * self.dt_s
    }

    /// Moves everything by one step while the wheels roll as told.
    ///
    /// Errors: a command that is not finite; a robot that the simulation has lost.
    pub fn step(&mut self, rolling: Rolling) -> Result<()> {
        let Rolling { forward_m_s, left_m_s, turn_rad_s } = rolling;
        for (what, value) in [("forward_m_s", forward_m_s), ("left_m_s", left_m_s), ("turn_rad_s", turn_rad_s)] {
            number_within(what, value, -100.0, 100.0)?;
        }
        let turn = *self.world.bodies[self.robot].rotation();
        let belts = self.wheels.iter().map(|&(wheel, [x, y])| {
            let velocity = Vector::new((forward_m_s - turn_rad_s * y) as f32, (left_m_s + turn_rad_s * x) as f32, 0.0);
            (wheel, turn * Vector::Z.cross(velocity))
        });
        let hooks = Belts(belts.collect());
        self.move_by_script()?;
        self.world.step_with_events(&hooks, &());
        self.steps += 1;
        self.count_collisions();
        if !self.robot_pose().is_finite() || !self.world.quarantine().bodies().is_empty() {
            let found = format!("a body at infinity after {} s", self.elapsed_s());
            return Err(Fault::new("physics", found, "bodies that stay in the world"));
        }
        Ok(())
    }

    /// Where the robot is.
    pub fn robot_pose(&self) -> Transform<World, Robot> {
        isometry(self.world.bodies[self.robot].position()).into()
    }

    /// How the robot moves.
    pub fn robot_velocity(&self) -> RobotVelocity {
        let body = &self.world.bodies[self.robot];
        let linear = body.velocity_at_point(body.translation());
        RobotVelocity { linear: vector(linear), angular: vector(body.angvel()) }
    }

    /// Angle between the robot's upright and the vertical [rad].
    pub fn tilt_rad(&self) -> f64 {
        (self.robot_pose().rotate(&Vector3::z())).z.clamp(-1.0, 1.0).acos()
    }

    /// Where the frame of body `index` of the scene is now; `None` if there is no such body.
    pub fn body_pose(&self, index: usize) -> Option<Isometry3<f64>> {
        let body = self.bodies.get(index)?;
        let moved = body.handle.and_then(|handle| self.world.bodies.get(handle));
        Some(moved.map_or(body.start, |moved| isometry(moved.position())))
    }

    /// How often the chassis has hit something; a touch within 0.5 s of the last with the same body is the same hit.
    pub fn collisions(&self) -> u64 {
        self.collisions
    }

    /// The bodies of the scene (index and name) that the chassis touches now.
    pub fn touching(&self) -> Vec<(usize, &str)> {
        let now = self.touched.iter().filter(|t| t.1 == self.steps);
        let index = |hit: &ColliderHandle| self.colliders.iter().find(|c| c.0 == *hit).map(|c| c.1);
        now.filter_map(|(hit, _)| index(hit)).filter_map(|i| Some((i, self.bodies.get(i)?.name.as_str()))).collect()
    }

    /// Tells what moves by script where to be after the step.
    fn move_by_script(&mut self) -> Result<()> {
        let then_s = (self.steps + 1) as f64 * self.dt_s;
        for mover in &self.movers {
            let moved = mover.moved(then_s);
            for placed in mover.bodies.iter().filter_map(|index| self.bodies.get(*index)) {
                if let Some(body) = placed.handle.and_then(|handle| self.world.bodies.get_mut(handle)) {
                    body.set_next_kinematic_position(pose(&(moved * placed.start))?);
                }
            }
        }
        Ok(())
    }

    fn count_collisions(&mut self) {
        let pressing = self.world.contact_pairs_with(self.chassis).filter_map(|pair| {
            let manifolds = pair.rigid()?.solver_manifolds();
            let pressed = manifolds.iter().any(|m| m.points.iter().any(|point| point.data.impulse > 0.0));
            pressed.then_some(if pair.collider1 == self.chassis { pair.collider2 } else { pair.collider1 })
        });
        let gap = (COLLISION_GAP_S / self.dt_s) as u64;
        for other in pressing {
            match self.touched.iter_mut().find(|t| t.0 == other) {
                Some(touch) => {
                    self.collisions += u64::from(self.steps - touch.1 > gap);
                    touch.1 = self.steps;
                }
                None => {
                    self.collisions += 1;
                    self.touched.push((other, self.steps));
                }
            }
        }
    }
}

/// The belts of the wheels: for each, the axle × speed it rolls with, in the world frame [m/s].
struct Belts(Vec<(ColliderHandle, Vector)>);

impl PhysicsHooks for Belts {
    fn modify_solver_contacts(&self, context: &mut ContactModificationContext) {
        let (first, second) = (context.collider1, context.collider2);
        let Some(&(_, axle)) = self.0.iter().find(|belt| belt.0 == first || belt.0 == second) else { return };
        let Some(contact) = context.rigid_mut() else { return };
        // The solver seeks v1 + belt − v2 = 0 along the contact; the normal leads from body 1 to body 2. With the wheel
        // as body 1 the normal points down and the belt runs backwards: two signs turn, and cancel.
        let belt = axle.cross(*contact.normal);
        for point in contact.solver_contacts.iter_mut() {
            point.tangent_velocity = belt;
        }
    }
}

fn place(world: &mut PhysicsWorld, body: &Body) -> Result<(Option<RigidBodyHandle>, ColliderHandle)> {
    let named = |fault: Fault| Fault { what: format!("body \"{}\": {}", body.name, fault.what), ..fault };
    let at = pose(&body.pose).map_err(named)?;
    let (shape, turned) = shape(body).map_err(named)?;
    let friction = number_within("friction", body.material.friction, 0.0, 10.0).map_err(named)?;
    let collider = ColliderBuilder::new(shape)
        .friction(friction as f32)
        .friction_combine_rule(CoefficientCombineRule::Min)
        .restitution(0.0);
    match body.motion {
        Motion::Static => Ok((None, world.insert_collider(collider.position(at * turned), None))),
        Motion::Scripted => {
            let body = RigidBodyBuilder::kinematic_position_based().pose(at);
            let (handle, collider) = world.insert(body, collider.position(turned));
            Ok((Some(handle), collider))
        }
        Motion::Dynamic { mass_kg } => {
            let mass_kg = number_within("mass_kg", mass_kg, 1e-3, 1e6).map_err(named)?;
            let collider = collider.mass(mass_kg as f32).position(turned);
            let (handle, collider) = world.insert(RigidBodyBuilder::dynamic().pose(at), collider);
            Ok((Some(handle), collider))
        }
    }
}

/// The shape of a body, and how it is turned: our cylinders stand along z, parry's along y.
fn shape(body: &Body) -> Result<(SharedShape, Pose)> {
    let size = |what: &str, value: f64| number_within(what, value, 1e-4, REACH_M).map(|v| v as f32);
    let shape = match &body.shape {
        Shape::Plane if body.motion != Motion::Static => {
            return Err(Fault::new("shape", "a plane that moves", "a static plane"));
        }
        Shape::Plane => SharedShape::halfspace(Vector::Z),
        Shape::Box { size: full } => SharedShape::cuboid(
            size("size.x", full.x)? / 2.0,
            size("size.y", full.y)? / 2.0,
            size("size.z", full.z)? / 2.0,
        ),
        Shape::Cylinder { radius, length } => {
            let upright = Pose::from_rotation(Rotation::from_rotation_x(std::f32::consts::FRAC_PI_2));
            return Ok((SharedShape::cylinder(size("length", *length)? / 2.0, size("radius", *radius)?), upright));
        }
        Shape::Sphere { radius } => SharedShape::ball(size("radius", *radius)?),
        Shape::Mesh(mesh) => mesh_shape(mesh, body.motion)?,
    };
    Ok((shape, Pose::IDENTITY))
}

fn mesh_shape(mesh: &Mesh, motion: Motion) -> Result<SharedShape> {
    let far = mesh.vertices.iter().flat_map(|v| v.iter()).find(|c| !c.is_finite() || c.abs() > REACH_M);
    if let Some(far) = far {
        return Err(Fault::new("mesh vertex", far, format!("coordinates within {REACH_M} m")));
    }
    let count = mesh.vertices.len();
    if let Some(bad) = mesh.triangles.iter().flatten().find(|i| **i as usize >= count) {
        return Err(Fault::new("mesh triangle", format!("vertex {bad}"), format!("one of its {count} vertices")));
    }
    let vertices: Vec<_> = mesh.vertices.iter().map(glam).collect();
    match motion {
        Motion::Static | Motion::Scripted => {
            // Without it a wheel trips over the edges between the triangles of flat ground.
            let flags = TriMeshFlags::FIX_INTERNAL_EDGES_TWO_SIDED;
            SharedShape::trimesh_with_flags(vertices, mesh.triangles.clone(), flags)
                .map_err(|error| Fault::new("mesh", error, "triangles that form a surface"))
        }
        // Only a solid can be pushed: its convex hull.
        Motion::Dynamic { .. } => SharedShape::convex_hull(&vertices)
            .filter(|hull| hull.mass_properties(1.0).mass() > 1e-9)
            .ok_or_else(|| Fault::new("mesh", "no volume", "a mesh with a convex hull, since it moves")),
    }
}

/// The pose in which all wheels stand on the ground under them, as well as one plane can.
fn start_pose(
    world: &PhysicsWorld,
    robot: &RobotBody,
    planar: Transform<World, Robot>,
) -> Result<Transform<World, Robot>> {
    let feet = robot.wheel_feet();
    let mut heights = Vec::with_capacity(feet.len());
    for foot in &feet {
        let over = planar.iso * nalgebra::Point3::new(foot[0], foot[1], START_HEIGHT_M);
        let ray = Ray::new(glam(&over.coords), -Vector::Z);
        // Not solid: a start inside a wall finds the floor below, and is then refused with the wall's name.
        let hit = world.cast_ray(&ray, 1e4, false, QueryFilter::default()).ok_or_else(|| {
            Fault::new("robot start", format!("no ground under ({:.2}, {:.2})", over.x, over.y), "ground below 0.5 m")
        })?;
        heights.push(START_HEIGHT_M - f64::from(hit.1));
    }
    // Least squares z = a·x + b·y + c; on an even circle the sums separate: Σx² = Σy² = n·r²/2, Σxy = Σx = Σy = 0.
    let n = feet.len() as f64;
    let spread = n * robot.wheel_circle_m.powi(2) / 2.0;
    let (mut a, mut b, mut c) = (0.0, 0.0, 0.0);
    for (foot, z) in feet.iter().zip(&heights) {
        a += foot[0] * z / spread;
        b += foot[1] * z / spread;
        c += z / n;
    }
    let over = feet.iter().zip(&heights).map(|(foot, z)| z - (a * foot[0] + b * foot[1] + c));
    let lift = over.fold(0.0, f64::max);
    let level = UnitQuaternion::rotation_between(&Vector3::z(), &Vector3::new(-a, -b, 1.0)).unwrap_or_default();
    let on_ground = Isometry3::from_parts(Translation3::new(0.0, 0.0, c + lift), level);
    Ok((planar.iso * on_ground).into())
}

/// What a robot in this pose would be inside of.
fn overlap(world: &PhysicsWorld, robot: &RobotBody, at: &Transform<World, Robot>) -> Option<ColliderHandle> {
    let at = glam_pose(&at.iso);
    let (chassis, height) = robot.chassis(START_SLACK_M);
    let upright =
        Pose::from_parts(Vector::new(0.0, 0.0, height as f32), Rotation::from_rotation_x(std::f32::consts::FRAC_PI_2));
    let wheel = SharedShape::ball((robot.wheel_radius_m - START_SLACK_M).max(1e-4) as f32);
    let wheels = robot
        .wheel_feet()
        .into_iter()
        .map(|[x, y]| (&wheel, Pose::from_translation(Vector::new(x as f32, y as f32, robot.wheel_radius_m as f32))));
    std::iter::once((&chassis, upright)).chain(wheels).find_map(|(shape, local)| {
        let mut hits: Vec<_> =
            world.intersect_shape(at * local, &**shape, QueryFilter::default()).map(|hit| hit.0).collect();
        hits.sort_by_key(|hit| hit.into_raw_parts());
        hits.first().copied()
    })
}

type RobotHandles = (RigidBodyHandle, ColliderHandle, Vec<(ColliderHandle, [f64; 2])>);

fn place_robot(world: &mut PhysicsWorld, robot: &RobotBody, at: &Transform<World, Robot>) -> RobotHandles {
    let (m, r, h) = (robot.mass_kg, robot.radius_m, robot.height_m);
    let across = m * (3.0 * r * r + h * h) / 12.0; // a solid cylinder
    let mass = MassProperties::new(
        Vector::new(0.0, 0.0, robot.mass_height_m as f32),
        m as f32,
        Vector::new(across as f32, across as f32, (m * r * r / 2.0) as f32),
    );
    let body = RigidBodyBuilder::dynamic().pose(glam_pose(&at.iso)).additional_mass_properties(mass).can_sleep(false);
    let (shape, height) = robot.chassis(0.0);
    let hull = |shape: SharedShape, friction: f32| -> ColliderBuilder {
        ColliderBuilder::new(shape)
            .density(0.0)
            .friction(friction)
            .friction_combine_rule(CoefficientCombineRule::Min)
            .restitution(0.0)
    };
    let chassis: Collider = hull(shape, HULL_FRICTION)
        .translation(Vector::new(0.0, 0.0, height as f32))
        .rotation(Vector::new(std::f32::consts::FRAC_PI_2, 0.0, 0.0))
        .build();
    let (handle, chassis) = world.insert(body, chassis);
    let mut wheels = Vec::with_capacity(robot.wheels);
    for foot in robot.wheel_feet() {
        let wheel = hull(SharedShape::ball(robot.wheel_radius_m as f32), robot.friction as f32)
            .translation(Vector::new(foot[0] as f32, foot[1] as f32, robot.wheel_radius_m as f32))
            .active_hooks(ActiveHooks::MODIFY_SOLVER_CONTACTS);
        wheels.push((world.insert_collider(wheel, Some(handle)), foot));
    }
    (handle, chassis, wheels)
}

fn pose(iso: &Isometry3<f64>) -> Result<Pose> {
    let p = iso.translation.vector;
    if !p.iter().all(|c| c.abs() <= REACH_M) || !iso.rotation.coords.iter().all(|c| c.is_finite()) {
        return Err(Fault::new("pose", format!("({}, {}, {})", p.x, p.y, p.z), format!("within {REACH_M} m")));
    }
    Ok(glam_pose(iso))
}

fn glam(v: &Vector3<f64>) -> Vector {
    Vector::new(v.x as f32, v.y as f32, v.z as f32)
}

fn glam_pose(iso: &Isometry3<f64>) -> Pose {
    let q = iso.rotation.quaternion();
    let turn = Rotation::from_xyzw(q.i as f32, q.j as f32, q.k as f32, q.w as f32).normalize();
    Pose::from_parts(glam(&iso.translation.vector), turn)
}

fn vector(v: Vector) -> Vector3<f64> {
    Vector3::new(f64::from(v.x), f64::from(v.y), f64::from(v.z))
}

fn isometry(pose: &Pose) -> Isometry3<f64> {
    let q = pose.rotation;
    let turn = Quaternion::new(f64::from(q.w), f64::from(q.x), f64::from(q.y), f64::from(q.z));
    Isometry3::from_parts(vector(pose.translation).into(), UnitQuaternion::from_quaternion(turn))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::world::Material;

    fn body(name: &str, shape: Shape, at: [f64; 3], motion: Motion) -> Body {
        let pose = Isometry3::translation(at[0], at[1], at[2]);
        Body { name: name.into(), shape, pose, material: Material::default(), motion, ground: false }
    }

    fn block(name: &str, size: [f64; 3], at: [f64; 3]) -> Body {
        body(name, Shape::Box { size: size.into() }, at, Motion::Static)
    }

    /// A floor and these bodies.
    fn scene(bodies: Vec<Body>) -> Scene {
        let floor = body("floor", Shape::Plane, [0.0; 3], Motion::Static);
        Scene { bodies: std::iter::once(floor).chain(bodies).collect(), ..Scene::default() }
    }

    fn physics(scene: &Scene) -> Physics {
        Physics::new(scene, &RobotBody::default(), [0.0, 0.0], 0.0, Physics::DT_S).unwrap()
    }

    /// Rolls for some seconds, with the speed raised over the first half second.
    fn drive(physics: &mut Physics, forward_m_s: f64, turn_rad_s: f64, seconds: f64) {
        for k in 0..(seconds / physics.dt_s()).round() as u64 {
            let share = (k as f64 * physics.dt_s() / 0.5).min(1.0);
            let rolling = Rolling { forward_m_s: forward_m_s * share, left_m_s: 0.0, turn_rad_s: turn_rad_s * share };
            physics.step(rolling).unwrap();
        }
    }

    #[test]
    fn what_moves_by_script_is_where_it_should_be_and_nothing_stops_it() {
        let floor = body("floor", Shape::Plane, [0.0; 3], Motion::Static);
        let walker = body("walker", Shape::Cylinder { radius: 0.1, length: 1.0 }, [2.0, 0.0, 0.55], Motion::Scripted);
        let crate_ =
            body("crate", Shape::Box { size: [0.2; 3].into() }, [2.0, 0.5, 0.1], Motion::Dynamic { mass_kg: 5.0 });
        let track = crate::world::Track::steady(&[[0.0; 3], [0.0, 2.0, 0.0]], 1.0, 0.0, false).unwrap();
        let movers = vec![Mover { name: "m".into(), bodies: vec![1], track }];
        let scene = Scene { bodies: vec![floor, walker, crate_], movers, ..Scene::default() };
        let mut physics = Physics::new(&scene, &RobotBody::default(), [0.0; 2], 0.0, Physics::DT_S).unwrap();
        for _ in 0..240 {
            physics.step(Rolling::default()).unwrap();
        }
        let at = |index| physics.body_pose(index).unwrap().translation.vector;
        assert!((at(1) - Vector3::new(2.0, 1.0, 0.55)).norm() < 1e-4, "{}", at(1));
        assert!(at(2).y > 1.0, "pushed along: {}", at(2));
    }

    #[test]
    fn two_metres_straight_end_within_two_centimetres() {
        let mut physics = physics(&scene(vec![]));
        drive(&mut physics, 0.4, 0.0, 5.25); // 0.1 m while it speeds up, 1.9 m at speed
        let end = physics.robot_pose();
        assert!((end.xyz() - Vector3::new(2.0, 0.0, 0.0)).norm() < 0.02, "{end:?}");
        assert!(end.yaw().abs() < 1e-3, "{end:?}");
        assert!((physics.robot_velocity().linear - Vector3::new(0.4, 0.0, 0.0)).norm() < 1e-3);
        assert_eq!(physics.collisions(), 0);
    }

    #[test]
    fn it_turns_about_itself_at_the_rate_of_its_wheels() {
        let mut physics = physics(&scene(vec![]));
        drive(&mut physics, 0.0, 0.5, 0.25 + std::f64::consts::PI);
        let end = physics.robot_pose();
        assert!((end.yaw() - std::f64::consts::FRAC_PI_2).abs() < 0.01, "{end:?}");
        assert!(end.xyz().norm() < 0.002, "{end:?}");
    }

    #[test]
    fn it_rolls_sideways_without_turning() {
        let mut physics = physics(&scene(vec![]));
        for _ in 0..240 {
            physics.step(Rolling { left_m_s: 0.2, ..Rolling::default() }).unwrap();
        }
        let end = physics.robot_pose();
        assert!((end.xyz() - Vector3::new(0.0, 0.2, 0.0)).norm() < 0.01 && end.yaw().abs() < 1e-3, "{end:?}");
    }

    #[test]
    fn standing_still_it_does_not_drift() {
        let level = physics(&scene(vec![])).robot_pose();
        let mut level_run = physics(&scene(vec![]));
        drive(&mut level_run, 0.0, 0.0, 20.0);
        assert!((level_run.robot_pose().xyz() - level.xyz()).norm() < 1e-4, "{:?}", level_run.robot_pose());
        // Nor on a slope of 8°, where the wheels' friction holds it.
        let mut tilted = block("slope", [8.0, 8.0, 0.2], [0.0, 0.0, 0.0]);
        tilted.pose.rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -8f64.to_radians());
        let mut physics = physics(&Scene { bodies: vec![tilted], ..Scene::default() });
        let start = physics.robot_pose();
        assert!((physics.tilt_rad() - 8f64.to_radians()).abs() < 1e-3);
        drive(&mut physics, 0.0, 0.0, 20.0);
        assert!((physics.robot_pose().xyz() - start.xyz()).norm() < 2e-3, "{:?} {start:?}", physics.robot_pose());
    }

    #[test]
    fn it_climbs_a_ramp_of_ten_degrees() {
        let (s, c) = 10f64.to_radians().sin_cos();
        let vertices =
            [[1.0, -1.0, 0.0], [1.0 + 3.0 * c, -1.0, 3.0 * s], [1.0 + 3.0 * c, 1.0, 3.0 * s], [1.0, 1.0, 0.0]];
        let mesh = Mesh { vertices: vertices.map(Vector3::from).to_vec(), triangles: vec![[0, 1, 2], [0, 2, 3]] };
        let ramp = body("ramp", Shape::Mesh(Arc::new(mesh)), [0.0; 3], Motion::Static);
        let mut physics = physics(&scene(vec![ramp]));
        drive(&mut physics, 0.4, 0.0, 8.0);
        let end = physics.robot_pose();
        let along = (end.xyz().x - 1.0) / c;
        assert!(along > 1.9 && (end.xyz().z - along * s).abs() < 0.01, "{end:?}");
        assert!((physics.tilt_rad() - 10f64.to_radians()).abs() < 0.01, "{}", physics.tilt_rad());
        assert!(end.xyz().y.abs() < 0.02 && end.yaw().abs() < 0.01, "{end:?}");
    }

    #[test]
    fn a_wall_stops_it_while_its_wheels_slip() {
        let mut physics = physics(&scene(vec![block("wall", [0.2, 4.0, 2.0], [1.1, 0.0, 1.0])]));
        drive(&mut physics, 0.4, 0.0, 10.0);
        let end = physics.robot_pose();
        assert!((end.xyz().x - 0.7).abs() < 0.005, "{end:?}"); // its front at the wall's face, x = 1
        assert_eq!(physics.collisions(), 1);
        assert_eq!(physics.touching(), [(1, "wall")]);
        assert!(physics.tilt_rad() < 0.02, "{}", physics.tilt_rad());
    }

    #[test]
    fn it_pushes_a_light_box() {
        let light =
            body("box", Shape::Box { size: [0.3; 3].into() }, [0.8, 0.0, 0.15], Motion::Dynamic { mass_kg: 2.0 });
        let mut physics = physics(&scene(vec![light]));
        drive(&mut physics, 0.3, 0.0, 6.0);
        let moved = physics.body_pose(1).unwrap().translation.vector;
        let robot = physics.robot_pose().xyz();
        assert!((robot.x - 1.725).abs() < 0.02, "{robot}");
        assert!(moved.x > robot.x + 0.4 && moved.z > 0.1, "{moved}");
        assert!(physics.collisions() >= 1);
    }

    #[test]
    fn it_falls_over_the_edge_of_a_drop() {
        let mut physics = physics(&scene(vec![block("stage", [4.0, 4.0, 0.4], [-1.0, 0.0, 0.2])]));
        assert!((physics.robot_pose().xyz().z - 0.4).abs() < 1e-3);
        drive(&mut physics, 0.4, 0.0, 2.0);
        assert!(physics.tilt_rad() < 0.02);
        drive(&mut physics, 0.4, 0.0, 3.0);
        assert!(physics.tilt_rad() > 0.5, "{}", physics.tilt_rad());
        assert!(physics.collisions() > 0);
    }

    #[test]
    fn a_start_inside_something_names_it() {
        let walled = scene(vec![
            block("north wall", [6.0, 0.2, 2.0], [0.0, 1.0, 1.0]),
            body("post", Shape::Cylinder { radius: 0.1, length: 1.0 }, [2.0, 0.0, 0.5], Motion::Static),
            block("table top", [1.0, 1.0, 0.05], [-2.0, 0.0, 0.75]),
        ]);
        for (at, name) in
            [([0.0, 1.0], "north wall"), ([0.0, 0.8], "north wall"), ([2.3, 0.2], "post"), ([-2.0, 0.0], "table top")]
        {
            let fault = Physics::new(&walled, &RobotBody::default(), at, 0.3, Physics::DT_S).err().unwrap();
            assert!(fault.to_string().contains(&format!("inside \"{name}\"")), "{fault}");
        }
        assert!(Physics::new(&walled, &RobotBody::default(), [0.0, 0.55], 0.0, Physics::DT_S).is_ok());
        let fault = Physics::new(&Scene::default(), &RobotBody::default(), [0.0; 2], 0.0, Physics::DT_S).err().unwrap();
        assert!(fault.to_string().contains("no ground"), "{fault}");
    }

    #[test]
    fn the_same_run_gives_the_same_bits() {
        let run = || {
            let light = |name: &str, y: f64| {
                body(name, Shape::Sphere { radius: 0.15 }, [0.6, y, 0.2], Motion::Dynamic { mass_kg: 1.0 })
            };
            let mut physics = physics(&scene(vec![
                light("a", 0.1),
                light("b", -0.12),
                block("wall", [0.1, 4.0, 1.0], [2.0, 0.3, 0.5]),
            ]));
            drive(&mut physics, 0.4, 0.1, 6.0);
            let numbers = |iso: Isometry3<f64>| {
                let q = iso.rotation.coords;
                iso.translation.vector.iter().chain(q.iter()).map(|v| v.to_bits()).collect::<Vec<_>>()
            };
            (
                numbers(physics.robot_pose().iso),
                numbers(physics.body_pose(1).unwrap()),
                numbers(physics.body_pose(2).unwrap()),
            )
        };
        assert_eq!(run(), run());
    }

    #[test]
    fn impossible_numbers_are_refused() {
        let mut on_floor = physics(&scene(vec![]));
        let fault = on_floor.step(Rolling { forward_m_s: f64::NAN, ..Rolling::default() }).unwrap_err();
        assert_eq!(fault.what, "forward_m_s");
        let refused = |body: Body| {
            let fault = Physics::new(&scene(vec![body]), &RobotBody::default(), [0.0; 2], 0.0, Physics::DT_S).err();
            fault.unwrap().to_string()
        };
        assert!(refused(block("flat", [1.0, 0.0, 1.0], [5.0, 0.0, 0.0])).starts_with("body \"flat\": size.y"));
        assert!(refused(block("lost", [1.0; 3], [f64::NAN, 0.0, 0.0])).starts_with("body \"lost\": pose"));
        let mesh = |mesh: Mesh, motion| body("m", Shape::Mesh(Arc::new(mesh)), [5.0, 0.0, 0.0], motion);
        assert!(refused(mesh(mesh_of(vec![[0, 1, 3]]), Motion::Static)).contains("vertex 3"));
        assert!(refused(mesh(mesh_of(vec![]), Motion::Static)).starts_with("body \"m\": mesh"));
        assert!(refused(mesh(mesh_of(vec![[0, 1, 2]]), Motion::Dynamic { mass_kg: 1.0 })).contains("no volume"));
        assert!(refused(body("p", Shape::Plane, [0.0; 3], Motion::Dynamic { mass_kg: 1.0 })).contains("static plane"));
        assert!(
            refused(body("n", Shape::Sphere { radius: 1.0 }, [5.0, 0.0, 0.0], Motion::Dynamic { mass_kg: f64::NAN }))
                .contains("mass_kg")
        );
        assert!(RobotBody { wheels: 2, ..RobotBody::default() }.validated().is_err());
        assert!(RobotBody { wheel_circle_m: 0.3, ..RobotBody::default() }.validated().is_err());
        assert!(RobotBody { mass_kg: f64::INFINITY, ..RobotBody::default() }.validated().is_err());
    }

    #[test]
    fn bad_meshes_do_no_harm() {
        let strange: [Vec<Vector3<f64>>; 6] = [
            vec![],
            vec![Vector3::zeros()],
            vec![Vector3::x(); 5],
            (0..5).map(|k| Vector3::x() * f64::from(k)).collect(),
            vec![Vector3::zeros(), Vector3::x(), Vector3::y(), Vector3::new(1.0, 1.0, 0.0)],
            (0..40).map(|k| Vector3::new((f64::from(k) * 0.7).sin() * 1e-7, f64::from(k % 3), 1e4)).collect(),
        ];
        for vertices in strange {
            for motion in [Motion::Static, Motion::Dynamic { mass_kg: 1.0 }] {
                // Triangles without area, twice the same, three on one edge.
                let n = vertices.len() as u32;
                let all = [[0, 0, 0], [0, 1, 2], [0, 1, 2], [2, 1, 0], [0, 1, 3], [0, 1, 4]];
                let triangles = all.into_iter().filter(|t| t.iter().all(|i| *i < n)).collect();
                let mesh = Mesh { vertices: vertices.clone(), triangles };
                let mesh = body("mesh", Shape::Mesh(Arc::new(mesh)), [5.0, 0.0, 3.0], motion);
                let placed = Physics::new(&scene(vec![mesh]), &RobotBody::default(), [0.0; 2], 0.0, Physics::DT_S);
                if let Ok(mut physics) = placed {
                    drive(&mut physics, 0.2, 0.0, 0.2);
                }
            }
        }
    }

    #[test]
    fn a_rough_mesh_is_driven_over_without_tripping() {
        // Bumps of ±1 cm on a grid of 0.2 m, as a height field gives them.
        let at = |k: u32| -2.0 + 0.2 * f64::from(k);
        let height = |i: u32, k: u32| 0.01 * (f64::from(i * 7 + k * 13)).sin();
        let vertices = (0..41 * 41).map(|n| Vector3::new(at(n % 41), at(n / 41), height(n % 41, n / 41))).collect();
        let cell = |n: u32| {
            let a = n % 40 + n / 40 * 41;
            [[a, a + 1, a + 42], [a, a + 42, a + 41]]
        };
        let mesh = Mesh { vertices, triangles: (0..1600).flat_map(cell).collect() };
        let ground = body("ground", Shape::Mesh(Arc::new(mesh)), [0.0; 3], Motion::Static);
        let mut physics = physics(&Scene { bodies: vec![ground], ..Scene::default() });
        drive(&mut physics, 0.4, 0.0, 8.0);
        let end = physics.robot_pose();
        assert!(end.xyz().x > 3.0 && end.xyz().z.abs() < 0.05 && physics.tilt_rad() < 0.15, "{end:?}");
    }

    fn mesh_of(triangles: Vec<[u32; 3]>) -> Mesh {
        Mesh { vertices: vec![Vector3::zeros(), Vector3::x(), Vector3::y()], triangles }
    }
}
