//! A world as sound meets it: every surface as a feature that sends sound back, prepared once.

use nalgebra::Isometry3;

use super::feature::Feature;
use super::group::{Group, Solid};
use crate::fault::{Fault, Result};
use crate::world::{Motion, Scene, Surfaces};

/// A body that moved less than this keeps its features [m], [rad].
const MOVED_M: f64 = 1e-4;

/// All reflectors of a world. Bodies that can be pushed may be moved; corners between two of them are left out.
#[derive(Clone, Debug)]
pub struct Targets {
    pub(super) surfaces: Surfaces,
    /// Bodies that never move, and then each that does.
    pub(super) fixed: Group,
    pub(super) moving: Vec<Moving>,
    /// Solid bodies that never move.
    solids: Vec<Solid>,
    /// Names of the bodies.
    names: Vec<String>,
}

/// A body that can be pushed.
#[derive(Clone, Debug)]
pub(super) struct Moving {
    body: usize,
    world_from_body: Isometry3<f64>,
    /// Its features in its own frame.
    own: Vec<Feature>,
    pub group: Group,
}

impl Targets {
    /// Takes the bodies of a scene where they stand at the start.
    ///
    /// # Errors
    /// What [`Surfaces::new`] refuses.
    pub fn new(scene: &Scene) -> Result<Self> {
        let surfaces = Surfaces::new(scene)?;
        let mut id = 0;
        let mut numbered = |mut features: Vec<Feature>| {
            for feature in &mut features {
                if let Feature::Face(face) = feature {
                    face.id = id;
                    id += 1;
                }
            }
            features
        };
        let (mut fixed, mut solids, mut moving) = (Vec::new(), Vec::new(), Vec::new());
        for (index, body) in scene.bodies.iter().enumerate() {
            let number = u32::try_from(index).map_err(|_| Fault::new("bodies", index, "fewer than 2^32"))?;
            let own = numbered(Feature::all_of(body, number));
            match body.motion {
                Motion::Static => {
                    fixed.extend(own.iter().map(|feature| feature.moved(&body.pose)));
                    solids.extend(Solid::new(body, number, &body.pose));
                }
                Motion::Dynamic { .. } | Motion::Scripted => moving.push((index, body.pose, own)),
            }
        }
        let fixed = Group::new(fixed, &solids, None);
        let moving = moving
            .into_iter()
            .map(|(body, world_from_body, own)| {
                let group = placed(&own, &world_from_body, &solids, &fixed);
                Moving { body, world_from_body, own, group }
            })
            .collect();
        let names = scene.bodies.iter().map(|body| body.name.clone()).collect();
        Ok(Self { surfaces, fixed, moving, solids, names })
    }

    /// Moves a body that can be pushed to a new pose.
    ///
    /// # Errors
    /// A body that cannot move, a pose that is not finite.
    pub fn set_pose(&mut self, body: usize, world_from_body: Isometry3<f64>) -> Result<()> {
        self.surfaces.set_pose(body, world_from_body)?;
        let Some(moving) = self.moving.iter_mut().find(|m| m.body == body) else {
            return Err(Fault::new("body to move", body, "the index of a dynamic body"));
        };
        let step = moving.world_from_body.inverse() * world_from_body;
        if step.translation.vector.norm() > MOVED_M || step.rotation.angle() > MOVED_M {
            moving.world_from_body = world_from_body;
            moving.group = placed(&moving.own, &world_from_body, &self.solids, &self.fixed);
        }
        Ok(())
    }

    /// The name of a body by its index in the scene.
    pub fn name(&self, body: usize) -> Option<&str> {
        self.names.get(body).map(String::as_str)
    }

    /// How many features the world has.
    pub fn feature_count(&self) -> usize {
        self.groups().map(|group| group.features().len()).sum()
    }

    pub(super) fn groups(&self) -> impl Iterator<Item = &Group> {
        std::iter::once(&self.fixed).chain(self.moving.iter().map(|m| &m.group))
    }

    /// Whether two faces enclose a corner.
    pub(super) fn is_corner(&self, a: u32, b: u32) -> bool {
        self.groups().any(|group| group.is_corner(a, b))
    }
}

fn placed(own: &[Feature], pose: &Isometry3<f64>, solids: &[Solid], fixed: &Group) -> Group {
    Group::new(own.iter().map(|feature| feature.moved(pose)).collect(), solids, Some(fixed))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sonar::face::V3;
    use crate::sonar::feature::{Corner, Edge};
    use crate::world::{Body, Material, Shape};

    fn body(name: &str, shape: Shape, at: [f64; 3], motion: Motion) -> Body {
        let pose = Isometry3::translation(at[0], at[1], at[2]);
        Body { name: name.into(), shape, pose, material: Material::default(), motion, ground: false }
    }

    fn block(size: [f64; 3]) -> Shape {
        Shape::Box { size: V3::from(size) }
    }

    fn targets(bodies: Vec<Body>) -> Targets {
        Targets::new(&Scene { bodies, ..Scene::default() }).unwrap()
    }

    fn corners(targets: &Targets) -> Vec<&Corner> {
        let all = targets.groups().flat_map(|g| g.features());
        all.filter_map(|f| if let Feature::Corner(c) = f { Some(c) } else { None }).collect()
    }

    fn edges(targets: &Targets) -> Vec<&Edge> {
        let all = targets.groups().flat_map(|g| g.features());
        all.filter_map(|f| if let Feature::Edge(e) = f { Some(e) } else { None }).collect()
    }

    #[test]
    fn a_box_on_the_floor_has_corners_around_its_foot_and_free_edges_above() {
        let t = targets(vec![
            body("floor", Shape::Plane, [0.0; 3], Motion::Static),
            body("box", block([1.0, 2.0, 0.5]), [3.0, 0.0, 0.25], Motion::Static),
        ]);
        let feet = corners(&t);
        assert_eq!(feet.len(), 4);
        for c in &feet {
            assert!(c.from.z.abs() < 1e-9 && c.body == 1);
            let sides = [c.length, c.reach[0].min(c.reach[1])];
            assert!((sides[0] - 1.0).abs() < 0.01 || (sides[0] - 2.0).abs() < 0.01, "{sides:?}");
            assert!((sides[1] - 0.5).abs() < 1e-6);
        }
        // Eight edges: four upright, four around the top.
        assert_eq!(edges(&t).len(), 8);
        assert!(edges(&t).iter().all(|e| e.from.z > 0.4 || e.length < 0.51));
    }

    #[test]
    fn a_room_of_four_walls_has_four_upright_corners_inside() {
        let t = targets(vec![
            body("east", block([0.1, 6.2, 1.0]), [4.05, 0.0, 0.5], Motion::Static),
            body("north", block([8.0, 0.1, 1.0]), [0.0, 3.05, 0.5], Motion::Static),
            body("west", block([0.1, 6.2, 1.0]), [-4.05, 0.0, 0.5], Motion::Static),
            body("south", block([8.0, 0.1, 1.0]), [0.0, -3.05, 0.5], Motion::Static),
        ]);
        let found = corners(&t);
        let inside: Vec<_> = found
            .iter()
            .filter(|c| (c.from.x.abs() - 4.0).abs() < 1e-6 && (c.from.y.abs() - 3.0).abs() < 1e-6)
            .collect();
        assert_eq!(inside.len(), 4, "{found:#?}");
        for c in inside {
            assert!((c.length - 1.0).abs() < 1e-6 && c.along.z.abs() > 0.999);
            // Free space lies towards the middle of the room.
            assert!((c.into[0] + c.into[1]).dot(&-c.from) > 0.0);
        }
        // No edge is left where two walls touch.
        assert!(edges(&t).iter().all(|e| e.along.z.abs() < 0.9
            || (e.from.x.abs() - 4.0).abs() > 1e-6
            || (e.from.y.abs() - 3.0).abs() > 1e-6));
    }

    #[test]
    fn a_moved_body_takes_its_features_along() {
        let mut t = targets(vec![
            body("floor", Shape::Plane, [0.0; 3], Motion::Static),
            body("box", block([1.0; 3]), [3.0, 0.0, 0.5], Motion::Dynamic { mass_kg: 1.0 }),
        ]);
        assert_eq!(corners(&t).len(), 4);
        t.set_pose(1, Isometry3::translation(5.0, 0.0, 0.5)).unwrap();
        assert!(corners(&t).iter().all(|c| c.from.x > 4.0));
        t.set_pose(1, Isometry3::translation(5.0, 0.0, 2.0)).unwrap();
        assert_eq!((corners(&t).len(), edges(&t).len()), (0, 12));
        assert!(t.set_pose(0, Isometry3::identity()).is_err());
        assert!(t.set_pose(1, Isometry3::translation(f64::NAN, 0.0, 0.0)).is_err());
        assert_eq!((t.name(1), t.name(9)), (Some("box"), None));
    }

    #[test]
    fn the_same_world_gives_the_same_features_in_the_same_order() {
        let world = || {
            targets(
                (0..40)
                    .map(|i| {
                        body(
                            &i.to_string(),
                            block([0.5; 3]),
                            [f64::from(i % 7) * 0.5, f64::from(i / 7) * 0.5, 0.25],
                            Motion::Static,
                        )
                    })
                    .collect(),
            )
        };
        assert_eq!(format!("{:?}", world().fixed.features()), format!("{:?}", world().fixed.features()));
    }
}
