//! Maps: 3D occupancy, terrain mesh, plan view and ultrasonic layer, behind one small interface.

mod cone;
mod grid;
mod ground;
mod key;
mod layers;
mod mask;
mod plan_view;
mod ray;
mod surface;
mod terrain;
mod ultrasonic;

use std::collections::BTreeMap;
use std::sync::OnceLock;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::fault::{Fault, Result};
use crate::geometry::{Robot, Transducer, Transform, World};
use crate::image::{Drop, Dropped};
use crate::points::Profile;
use crate::ranges::RangeReading;

pub use cone::{Cone, ConeParams, Evidence, evidence};
pub use grid::{BLOCK, Block, Grid, GridParams, State};
pub use ground::{Ground, Terrain, TerrainParams};
pub use layers::Layers;
pub use plan_view::PlanParams;
pub use surface::Surface;
pub use terrain::{Face, Sample, Tin};
pub use ultrasonic::Ultrasonic;

/// The plan view: a 2D occupancy grid as ROS has it.
#[derive(Clone, Debug, PartialEq)]
pub struct PlanView {
    /// Side of a cell [m].
    pub resolution_m: f64,
    /// Lower left corner of cell (0, 0) in the world [m].
    pub origin_m: [f64; 2],
    /// Cells along x.
    pub width: usize,
    /// Cells along y.
    pub height: usize,
    /// −1 unknown, 0 free, 100 occupied; row by row from the lowest y.
    pub cells: Vec<i8>,
}

/// A piece of the terrain mesh in the world frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TerrainMesh {
    /// Vertices [m].
    pub vertices: Vec<[f32; 3]>,
    /// Indices of triangles, counter-clockwise from above.
    pub triangles: Vec<[u32; 3]>,
}

/// What changed in the maps since it was last asked, owned, so that a sink on another thread can draw it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MapChanges {
    /// Side of a voxel [m].
    pub voxel_m: f64,
    /// Changed blocks of voxels: their key, and the centres of all voxels now occupied in each (empty: none is left).
    pub blocks: Vec<([i32; 3], Vec<[f32; 3]>)>,
    /// Changed tiles of the terrain: their key, and the mesh of each now.
    pub tiles: Vec<([i32; 2], TerrainMesh)>,
    /// The plan view, if it changed.
    pub plan: Option<PlanView>,
    /// Laser, ultrasonic and both, if any of them changed; never without ultrasonic ranges.
    pub layers: Option<Layers>,
}

/// How the maps are kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapParams {
    /// The 3D occupancy grid.
    pub grid: GridParams,
    /// Ground and its mesh.
    pub terrain: TerrainParams,
    /// The plan view.
    pub plan: PlanParams,
    /// What ultrasonic ranges say of the plan view's cells.
    #[serde(skip_serializing_if = "is_default")]
    pub cone: ConeParams,
}

/// What is as it always is need not be written down.
fn is_default(cone: &ConeParams) -> bool {
    *cone == ConeParams::default()
}

impl MapParams {
    /// Refuses values that make no maps.
    pub fn validated(self) -> Result<Self> {
        Ok(Self {
            grid: self.grid.validated()?,
            terrain: self.terrain.validated()?,
            plan: self.plan.validated()?,
            cone: self.cone.validated()?,
        })
    }
}

/// The numbers of the occupancy grid, named as the commands print them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct OccupancySummary {
    /// Side of a voxel [m].
    pub resolution_m: f64,
    /// Occupied voxels.
    pub occupied: u64,
    /// Free voxels.
    pub free: u64,
    /// Memory [bytes].
    pub bytes: usize,
}

/// The numbers of the terrain mesh, named as the commands print them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TerrainSummary {
    /// Vertices.
    pub vertices: usize,
    /// Triangles.
    pub triangles: usize,
    /// Largest distance in height between a cell of ground and the mesh over it [m].
    pub max_error_m: f64,
}

/// What the maps hold, in numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct MapSummary {
    /// The occupancy grid.
    pub occupancy: OccupancySummary,
    /// The terrain mesh.
    pub terrain: TerrainSummary,
}

/// What follows from the maps: made when it is asked for, and kept until the next capture.
#[derive(Default)]
struct Derived {
    ground: OnceLock<Ground>,
    surface: OnceLock<Surface>,
    plan: OnceLock<PlanView>,
    layers: OnceLock<Option<Layers>>,
}

/// What was last handed out by `changes`.
#[derive(Default)]
struct Shown {
    tiles: BTreeMap<[i32; 2], TerrainMesh>,
    plan: Option<PlanView>,
    layers: Option<Layers>,
}

/// All maps of a run.
pub struct Maps {
    params: MapParams,
    grid: Grid,
    terrain: Terrain,
    ultrasonic: Ultrasonic,
    robot_m: [f64; 2],
    derived: Derived,
    shown: Shown,
}

impl Maps {
    /// Empty maps; an error where the parameters make none.
    pub fn new(params: MapParams) -> Result<Self> {
        let params = params.validated()?;
        let grid = Grid::new(params.grid)?;
        Ok(Self {
            params,
            ultrasonic: Ultrasonic::new(params.cone, &grid),
            grid,
            terrain: Terrain::new(params.terrain)?,
            robot_m: [0.0; 2],
            derived: Derived::default(),
            shown: Shown::default(),
        })
    }

    /// Takes the points of one capture, and where the robot stood then. Returns what was not used: all of it where the
    /// pose is not finite (`BadPose`, counted once), points that are not (`NoPoint`) or are too far away (`OutOfRange`).
    pub fn insert(&mut self, profile: &Profile<World>, world_from_robot: &Transform<World, Robot>) -> Dropped {
        if !world_from_robot.is_finite() {
            let mut dropped = Dropped::default();
            dropped.add(Drop::BadPose);
            return dropped;
        }
        let refused_before = self.refused_count();
        let mut dropped = self.grid.insert(profile);
        self.terrain.note_robot(world_from_robot);
        let grid = &self.grid;
        let usable = profile.points.iter().map(|p| p.point).filter(|point| grid.takes(profile, *point));
        self.terrain.insert_points(usable);
        dropped.add_many(Drop::MapFull, self.refused_count() - refused_before);
        self.robot_m = [world_from_robot.xyz().x, world_from_robot.xyz().y];
        self.derived = Derived::default();
        dropped
    }

    /// Takes one ultrasonic range, and where its transducer was then.
    ///
    /// # Errors
    /// A pose that is not finite (`BadPose`), or too far away (`OutOfRange`): nothing has changed then.
    pub fn hear(
        &mut self,
        reading: &RangeReading,
        world_from_transducer: &Transform<World, Transducer>,
    ) -> Result<Dropped, (Drop, Fault)> {
        let refused_before = self.ultrasonic.refused_count();
        self.ultrasonic.insert(reading, world_from_transducer)?;
        self.derived.layers = OnceLock::new();
        let mut dropped = Dropped::default();
        dropped.add_many(Drop::MapFull, self.ultrasonic.refused_count() - refused_before);
        Ok(dropped)
    }

    /// The ultrasonic layer.
    pub fn ultrasonic(&self) -> &Ultrasonic {
        &self.ultrasonic
    }

    /// What laser and ultrasound say of the same cells, apart and together; `None` where there was no ultrasonic range, or
    /// nothing is known. Made anew after a capture or a range: some milliseconds for 10 x 10 m.
    pub fn layers(&self) -> Option<Layers> {
        let make = || {
            let bounds = self.ultrasonic.bounds()?;
            let (plan, cell_m) = (&self.params.plan, self.params.grid.voxel_m);
            let columns = plan_view::columns(&self.grid, self.ground(), self.robot_m, plan, Some(bounds))?;
            layers::layers(&columns, &self.ultrasonic, cell_m)
        };
        self.derived.layers.get_or_init(make).clone()
    }

    /// The 3D occupancy grid.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The heights seen in every cell.
    pub fn terrain(&self) -> &Terrain {
        &self.terrain
    }

    /// What is ground. Made anew after a capture: some milliseconds for 10 x 10 m.
    pub fn ground(&self) -> &Ground {
        self.derived.ground.get_or_init(|| self.terrain.ground())
    }

    /// The terrain mesh. Made anew after a capture: some tens of milliseconds for 10 x 10 m.
    pub fn surface(&self) -> &Surface {
        self.derived.surface.get_or_init(|| {
            // Cells are whole numbers below 2^20 and their heights are finite: no triangulation refuses them.
            Surface::new(self.ground(), &self.params.terrain).unwrap_or_else(|_| Surface::empty(&self.params.terrain))
        })
    }

    /// The height of the terrain mesh at (x, y) in the world [m]; `None` where no ground was seen.
    pub fn height_at(&self, x_m: f64, y_m: f64) -> Option<f64> {
        self.surface().height_at(x_m, y_m)
    }

    /// The plan view. Made anew after a capture: some milliseconds for 10 x 10 m.
    pub fn plan_view(&self) -> PlanView {
        let plan = self
            .derived
            .plan
            .get_or_init(|| plan_view::plan_view(&self.grid, self.ground(), self.robot_m, &self.params.plan));
        plan.clone()
    }

    /// What changed since this was last asked.
    pub fn changes(&mut self) -> MapChanges {
        let tiles = self.surface().tiles();
        let plan = self.plan_view();
        let gone = self.shown.tiles.keys().filter(|key| !tiles.contains_key(*key));
        let mut changed: Vec<_> = gone.map(|key| (*key, TerrainMesh::default())).collect();
        let new = tiles.iter().filter(|(key, tile)| self.shown.tiles.get(*key) != Some(*tile));
        changed.extend(new.map(|(key, tile)| (*key, tile.clone())));
        changed.sort_by_key(|(key, _)| *key);
        let plan = (self.shown.plan.as_ref() != Some(&plan)).then_some(plan);
        let layers = self.layers().filter(|layers| self.shown.layers.as_ref() != Some(layers));
        self.shown.tiles = tiles;
        if layers.is_some() {
            self.shown.layers.clone_from(&layers);
        }
        if let Some(plan) = &plan {
            self.shown.plan = Some(plan.clone());
        }
        MapChanges { voxel_m: self.params.grid.voxel_m, blocks: self.grid.take_changes(), tiles: changed, plan, layers }
    }

    /// The SHA-256 of all that the maps hold: log-odds, heights, the mesh, and the ultrasonic layer where there is one. Equal
    /// maps have equal digests.
    pub fn digest(&self) -> String {
        let mut hasher = Sha256::new();
        let feed = &mut |bytes: &[u8]| hasher.update(bytes);
        self.grid.digest_into(feed);
        self.terrain.digest_into(feed);
        let mesh = self.surface().mesh();
        mesh.vertices.iter().flatten().for_each(|c| feed(&c.to_le_bytes()));
        mesh.triangles.iter().flatten().for_each(|c| feed(&c.to_le_bytes()));
        self.ultrasonic.digest_into(feed);
        hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// The maps in numbers.
    pub fn summary(&self) -> MapSummary {
        let mesh = self.surface().mesh();
        MapSummary {
            occupancy: OccupancySummary {
                resolution_m: self.params.grid.voxel_m,
                occupied: self.grid.occupied_count(),
                free: self.grid.free_count(),
                bytes: self.grid.bytes(),
            },
            terrain: TerrainSummary {
                vertices: mesh.vertices.len(),
                triangles: mesh.triangles.len(),
                max_error_m: self.surface().max_error_m(),
            },
        }
    }

    /// How many updates were refused because a map had reached its cap.
    pub fn refused_count(&self) -> u64 {
        self.grid.refused_count() + self.terrain.refused_count() + self.ultrasonic.refused_count()
    }

    /// Checks what must always hold.
    pub fn check(&self) -> std::result::Result<(), String> {
        self.grid.check()?;
        self.terrain.check()?;
        self.ultrasonic.check()?;
        self.layers().map_or(Ok(()), |layers| layers.check())?;
        self.surface().check(self.ground()).map(|_| ())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::geometry::{Plane, Point};
    use crate::optics::LaserPlane;
    use crate::points::ProfilePoint;
    use crate::time::Stamp;
    use nalgebra::{Matrix3, Vector3};
    use proptest::prelude::*;

    fn maps() -> Maps {
        Maps::new(MapParams::default()).unwrap()
    }

    /// A profile of points for tests.
    pub(crate) fn profile(eye: [f64; 3], laser: [f64; 3], points: &[[f64; 3]]) -> Profile<World> {
        let point = |(column, p): (usize, &[f64; 3])| ProfilePoint {
            column: column as u16,
            point: Point::new(p[0], p[1], p[2]),
            covariance: Matrix3::identity() * 1e-6,
            level: 50.0,
        };
        Profile {
            stamp: Stamp(0),
            sheet: LaserPlane {
                plane: Plane::new(Vector3::z(), 0.0).unwrap(),
                origin: Point::from(Vector3::from(laser)),
                forward: Vector3::x(),
                lateral: Vector3::y(),
            },
            knows_laser_origin: true,
            eye: Point::from(Vector3::from(eye)),
            points: points.iter().enumerate().map(point).collect(),
        }
    }

    /// What METRO-I sees of a flat floor and a wall at x = 3.2 m from a pose: one line a mirror pulse step.
    fn sweep(maps: &mut Maps, pose: &Transform<World, Robot>) {
        let world = |p: Vector3<f64>| (*pose * Point::<Robot>::from(p)).xyz.into();
        let (eye, laser) = (Vector3::new(0.165, 0.0, 1.032), Vector3::new(0.0, 0.0, 0.770));
        for line in 0..70u32 {
            let beam = 0.205 + f64::from(line) * 0.0045;
            let seen = |column: u32| {
                let bearing = (f64::from(column) - 255.5) / 512.0 * 0.48;
                let mut range = laser.z / beam.tan();
                let ahead = pose.iso.rotation * Vector3::new(1.0, bearing.tan(), 0.0);
                let to_wall = (3.2 - pose.xyz().x) / ahead.x;
                if to_wall > 0.0 {
                    range = range.min(to_wall);
                }
                let noise = f64::from((column * 7919 + line * 104_729) % 1000) * 6e-6 - 3e-3;
                world(Vector3::new(range, range * bearing.tan(), laser.z - range * beam.tan() + noise))
            };
            let points: Vec<[f64; 3]> = (0..512).map(seen).collect();
            assert_eq!(maps.insert(&profile(world(eye), world(laser), &points), pose), Dropped::default());
        }
    }

    fn room() -> Maps {
        let mut maps = maps();
        for view in 0..16 {
            sweep(&mut maps, &Transform::planar(0.0, 0.0, f64::from(view) * 22.5f64.to_radians()));
        }
        maps
    }

    #[test]
    fn a_turn_in_a_room_maps_its_floor_and_its_wall() {
        let maps = room();
        assert_eq!(maps.check(), Ok(()));
        let plan = maps.plan_view();
        let summary = maps.summary();
        let cell = |x: f64, y: f64| {
            let [i, j] = [(x - plan.origin_m[0]) / 0.05, (y - plan.origin_m[1]) / 0.05].map(|c| c.floor() as usize);
            plan.cells[j * plan.width + i]
        };
        for angle in (0..360).step_by(5) {
            let (sin, cos) = f64::from(angle).to_radians().sin_cos();
            if 2.0 * cos < 3.1 {
                assert_eq!(cell(2.0 * cos, 2.0 * sin), 0, "floor at {angle}°");
                assert!(maps.height_at(2.0 * cos, 2.0 * sin).unwrap().abs() < 0.02, "terrain at {angle}°");
            }
        }
        assert!((-10..=10).all(|y| cell(3.21, f64::from(y) * 0.1) == 100), "the wall");
        assert_eq!(maps.height_at(0.0, 0.0), None, "under the robot nothing was seen");
        assert!(summary.terrain.max_error_m <= 0.02 && summary.terrain.triangles > 20);
        let json = serde_json::to_value(summary).unwrap();
        let keys = |part: &str| json[part].as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        assert_eq!(keys("occupancy"), ["bytes", "free", "occupied", "resolution_m"]);
        assert_eq!(keys("terrain"), ["max_error_m", "triangles", "vertices"]);
    }

    /// One line of a scan of a floor with a box (0.1 m high), a pole (r 15 mm) and a table top, by marching along the light.
    fn line_of_things(beam_rad: f64) -> Vec<[f64; 3]> {
        let solid = |p: Vector3<f64>| {
            let boxed = (2.0..2.3).contains(&p.x) && (0.2..0.5).contains(&p.y) && p.z < 0.1;
            let pole = (p.x - 2.213).hypot(p.y + 0.317) < 0.015 && p.z < 1.5;
            p.z < 0.0 || boxed || pole
        };
        let (eye, laser) = (Vector3::new(0.165, 0.0, 1.032), Vector3::new(0.0, 0.0, 0.770));
        let mut points = Vec::new();
        for column in 0..512u32 {
            let bearing = (f64::from(column) - 255.5) / 512.0 * 0.48;
            let ahead = Vector3::new(1.0, bearing.tan(), -beam_rad.tan());
            let lit = (1000..4200).map(|mm| laser + ahead * (f64::from(mm) * 1e-3)).find(|p| solid(*p));
            let Some(lit) = lit else { continue };
            let sight = lit - eye;
            let depression = -(sight.z / sight.xy().norm()).atan().to_degrees();
            let hidden = (50..970).any(|i| solid(eye + sight * (f64::from(i) * 1e-3)));
            if (15.8..39.7).contains(&depression) && !hidden {
                // A noise of 4 mm along the line of sight.
                let noise = (0..4)
                    .map(|i| f64::from((column * 7919 + i * 31 + (beam_rad * 1e6) as u32 * 104_729) % 997))
                    .sum::<f64>();
                let at = lit + sight.normalize() * ((noise / 997.0 - 2.0) * 0.007);
                points.push([at.x, at.y, at.z]);
            }
        }
        points
    }

    #[test]
    fn a_thin_pole_and_a_low_box_are_hit_and_the_floor_is_not() {
        let mut maps = maps();
        for line in 0..110 {
            let points = line_of_things(0.2 + f64::from(line) * 0.003_14);
            maps.insert(&profile([0.165, 0.0, 1.032], [0.0, 0.0, 0.770], &points), &Transform::identity());
        }
        assert_eq!(maps.check(), Ok(()));
        let plan = maps.plan_view();
        let (mut boxed, mut pole, mut floor, mut false_hits) = (0, 0, 0, 0);
        for (at, cell) in plan.cells.iter().enumerate() {
            let x = plan.origin_m[0] + ((at % plan.width) as f64 + 0.5) * 0.05;
            let y = plan.origin_m[1] + ((at / plan.width) as f64 + 0.5) * 0.05;
            let at_box = (1.93..2.37).contains(&x) && (0.13..0.57).contains(&y);
            let at_pole = (x - 2.213).abs() < 0.08 && (y + 0.317).abs() < 0.08;
            if *cell == 100 {
                boxed += usize::from(at_box);
                pole += usize::from(at_pole);
                false_hits += usize::from(!at_box && !at_pole);
            }
            floor += usize::from(*cell == 0);
            if (2.03..2.27).contains(&x) && (0.23..0.47).contains(&y) {
                assert_eq!(
                    maps.ground().height_m([(x / 0.05) as i32, (y / 0.05) as i32]),
                    None,
                    "the box is ground at {x}, {y}"
                );
            }
        }
        eprintln!("box {boxed}, pole {pole}, floor {floor}, false {false_hits}, {:?}", maps.summary());
        assert!(boxed >= 30 && pole >= 1 && false_hits == 0);
        assert!(floor > 1000);
    }

    #[test]
    fn the_same_captures_give_the_same_digest_and_others_another() {
        let [mut one, mut same] = [maps(), maps()];
        let empty = one.digest();
        assert_eq!(empty.len(), 64);
        sweep(&mut one, &Transform::identity());
        let digest = one.digest();
        sweep(&mut same, &Transform::identity());
        assert_eq!(digest, same.digest());
        assert_ne!(digest, empty);
        assert_eq!(one.plan_view(), same.plan_view());
        same.insert(&profile([0.0, 0.0, 1.0], [0.0, 0.0, 0.8], &[[2.0, 0.0, 0.5]]), &Transform::identity());
        assert_ne!(digest, same.digest());
    }

    #[test]
    fn changes_are_told_once_and_add_up_to_the_maps() {
        let mut maps = maps();
        assert_eq!(maps.changes().blocks, []);
        let (mut blocks, mut tiles, mut plan) = (BTreeMap::new(), BTreeMap::new(), None);
        for view in 0..3 {
            sweep(&mut maps, &Transform::planar(0.2 * f64::from(view), 0.0, f64::from(view)));
            let changes = maps.changes();
            blocks.extend(changes.blocks);
            tiles.extend(changes.tiles);
            plan = changes.plan.or(plan);
            let nothing = maps.changes();
            assert_eq!(nothing, MapChanges { voxel_m: 0.05, ..MapChanges::default() });
        }
        assert_eq!(plan, Some(maps.plan_view()));
        tiles.retain(|_, tile| *tile != TerrainMesh::default());
        assert_eq!(tiles, maps.surface().tiles());
        assert_eq!(blocks.values().map(Vec::len).sum::<usize>() as u64, maps.grid().occupied_count());
    }

    #[test]
    fn bad_captures_are_counted_and_change_nothing() {
        let mut maps = maps();
        let before = maps.digest();
        let bad_pose = Transform::from_xyz_rpy([f64::NAN, 0.0, 0.0], [0.0; 3]);
        let good = profile([0.0, 0.0, 1.0], [0.0, 0.0, 0.8], &[[2.0, 0.0, 0.0]]);
        assert_eq!(maps.insert(&good, &bad_pose).0, BTreeMap::from([(Drop::BadPose, 1)]));
        let far = profile([0.0, 0.0, 1.0], [0.0, 0.0, 0.8], &[[f64::NAN; 3], [1e9, 0.0, 0.0], [500.0, 0.0, 0.0]]);
        let dropped = maps.insert(&far, &Transform::identity());
        assert_eq!(dropped.0, BTreeMap::from([(Drop::NoPoint, 1), (Drop::OutOfRange, 2)]));
        assert_eq!(maps.insert(&profile([0.0; 3], [0.0; 3], &[]), &Transform::identity()), Dropped::default());
        assert_eq!(maps.digest(), before);
        assert_eq!(maps.changes(), MapChanges { voxel_m: 0.05, plan: Some(maps.plan_view()), ..MapChanges::default() });
        assert_eq!((maps.plan_view().width, maps.summary().occupancy.occupied), (0, 0));
    }

    #[test]
    fn parameters_are_read_and_unknown_or_bad_ones_refused() {
        let params: MapParams = toml::from_str("[grid]\nvoxel_m = 0.1\n[terrain]\nerror_m_max = 0.05").unwrap();
        assert_eq!((params.grid.voxel_m, params.terrain.error_m_max, params.grid.hit), (0.1, 0.05, 0.85));
        assert!(toml::from_str::<MapParams>("[grid]\nvoxel = 0.1").is_err());
        let bad: MapParams = toml::from_str("[plan]\nheight_m = -1.0").unwrap();
        let fault = Maps::new(bad).err().unwrap().to_string();
        assert!(fault.starts_with("plan.height_m: found -1"), "{fault}");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        #[test]
        fn what_must_hold_holds_after_each_capture(
            captures in prop::collection::vec(
                (prop::array::uniform3(-1.0..1.0f64), prop::collection::vec(prop::array::uniform3(-3.0..3.0f64), 0..120)), 1..5,
            ),
        ) {
            let mut maps = maps();
            for (at, points) in &captures {
                // Most points near the floor, so that there is ground.
                let points: Vec<[f64; 3]> = points.iter().map(|p| [p[0], p[1], 0.03 * p[2] * p[2] * p[2]]).collect();
                maps.insert(&profile([at[0], at[1], 1.0], [at[0], at[1], 0.8], &points), &Transform::planar(at[0], at[1], at[2]));
                prop_assert_eq!(maps.check(), Ok(()));
                let plan = maps.plan_view();
                prop_assert_eq!(plan.cells.len(), plan.width * plan.height);
                prop_assert!(plan.cells.iter().all(|cell| [-1, 0, 100].contains(cell)));
            }
        }
    }
}
