//! The truth that sensors are held against: where every obstacle is at every moment, and what of it the robot could see.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Isometry3, Point3, Vector3};

use super::layers::Place;
use crate::fault::Result;
use crate::geometry::{Point, Robot, Transform, World};
use crate::sources::{CompareParams, Kind, Scenario, TargetParams};
use crate::world::{Body, Mover, Scene, Shape, Surfaces};

pub(super) type V3 = Vector3<f64>;

/// Distance between samples of a surface [m].
const SAMPLE_M: f64 = 0.05;
/// Larger targets have samples farther apart, for up to so many of them ...
const SAMPLES: f64 = 300.0;
/// ... but never farther than this share of the tolerance, or right readings would find no sample near them ...
const SAMPLE_SHARE: f64 = 0.7;
/// ... unless they would be more than this.
const SAMPLES_MAX: f64 = 3e5;
/// Samples of all obstacles are kept by squares of the ground with this side [m].
const SQUARE_M: f64 = 1.0;
/// From these heights over the robot's foot a place is seen: about where the ring and the finder's camera are [m].
const EYES_M: [f64; 2] = [0.4, 1.0];
/// A robot stands on the highest thing under it that is lower than this [m].
const FLOOR_M_MAX: f64 = 0.5;
/// Samples are taken so far in front of their surface [m].
const OFF_M: f64 = 0.005;

/// A place on a body, in its frame, or in the world.
#[derive(Clone, Copy, Debug)]
struct Sample {
    body: Option<usize>,
    at: V3,
}

/// Something to be seen.
#[derive(Clone, Debug)]
pub(super) struct Site {
    pub params: TargetParams,
    samples: Vec<Sample>,
}

/// What the robot could see of a site.
#[derive(Clone, Debug)]
pub(super) struct View {
    /// Distance on the ground from the robot's axis to the nearest visible place [m].
    pub distance_m: f64,
    /// Least and greatest bearing of visible places, seen from the robot's axis [rad].
    pub span_rad: [f64; 2],
    /// Visible places.
    pub places: Vec<V3>,
}

/// A world and its targets at one moment.
pub(super) struct Stage {
    pub params: CompareParams,
    pub sites: Vec<Site>,
    /// All surfaces.
    pub surfaces: Surfaces,
    /// Those of bodies that are higher than the floor, and which body of the scene each of its bodies is.
    obstacles: Surfaces,
    obstacle_of: Vec<usize>,
    /// Samples of all obstacles: of those at rest in the world's frame, by squares of the ground; of each that moves in its own.
    still: BTreeMap<[i64; 2], Vec<V3>>,
    moving: Vec<(usize, Vec<V3>)>,
    start: Vec<Isometry3<f64>>,
    poses: Vec<Isometry3<f64>>,
    movers: Vec<Mover>,
}

impl Stage {
    /// The world of a scenario at the start.
    pub fn new(scenario: &Scenario) -> Result<Self> {
        let (scene, params) = (&scenario.scene, scenario.compare.clone());
        let surfaces = Surfaces::new(scene)?;
        let (floor_m, floor) = floor_under(scenario, &surfaces);
        let obstacle_of: Vec<usize> =
            (0..scene.bodies.len()).filter(|i| is_obstacle(&scene.bodies[*i], floor_m + params.clearance_m)).collect();
        let bodies: Vec<Body> = obstacle_of.iter().map(|i| scene.bodies[*i].clone()).collect();
        let spacing_m = spread(bodies.iter().map(|body| area(&body.shape)).sum(), 3.0 * SAMPLES_MAX).max(SAMPLE_M);
        let (mut still, mut moving) = (BTreeMap::<_, Vec<V3>>::new(), Vec::new());
        for &index in &obstacle_of {
            let body = &scene.bodies[index];
            let own = sampled(&body.shape, spacing_m);
            match body.motion {
                crate::world::Motion::Static => {
                    for at in own.iter().map(|at| (body.pose * Point3::from(*at)).coords) {
                        still.entry(square(&at)).or_default().push(at);
                    }
                }
                _ => moving.push((index, own)),
            }
        }
        let start: Vec<_> = scene.bodies.iter().map(|body| body.pose).collect();
        Ok(Self {
            sites: sites(scene, &params, obstacle_of.iter().filter(|body| Some(**body) != floor)),
            surfaces,
            obstacles: Surfaces::new(&Scene { bodies, ..Scene::default() })?,
            obstacle_of,
            still,
            moving,
            poses: start.clone(),
            start,
            movers: scene.movers.clone(),
            params,
        })
    }

    /// Moves all to where it is at a time [s]; `moved`: what was pushed and how far since the start (world from world).
    pub fn set(&mut self, time_s: f64, moved: &[(usize, Isometry3<f64>)]) -> Result<()> {
        for (index, by) in moved {
            if let (Some(pose), Some(start)) = (self.poses.get_mut(*index), self.start.get(*index)) {
                *pose = by * start;
            }
        }
        for mover in &self.movers {
            let by = mover.moved(time_s);
            for index in &mover.bodies {
                self.poses[*index] = by * self.start[*index];
            }
        }
        for (index, _) in &self.moving {
            self.surfaces.set_pose(*index, self.poses[*index])?;
            if let Some(own) = self.obstacle_of.iter().position(|body| body == index) {
                self.obstacles.set_pose(own, self.poses[*index])?;
            }
        }
        Ok(())
    }

    /// Where the sites are now.
    pub fn places(&self) -> Vec<Place> {
        let place = |site: &Site| {
            let at = |sample: &Sample| match sample.body {
                Some(body) => (self.poses[body] * Point3::from(sample.at)).coords,
                None => sample.at,
            };
            let middle = site.samples.iter().map(at).sum::<V3>() / site.samples.len().max(1) as f64;
            let classes = std::iter::once(&site.params.class).chain(&site.params.fast_class).cloned().collect();
            Place { classes, at_m: [middle.x, middle.y] }
        };
        self.sites.iter().map(place).collect()
    }

    /// What the robot could see of a site within range and sector; `None`: nothing.
    pub fn view(&self, site: &Site, world_from_robot: &Transform<World, Robot>) -> Option<View> {
        let (foot, heading) = (world_from_robot.xyz(), world_from_robot.yaw());
        let sector = self.params.sector_deg.to_radians();
        let mut near: Vec<(f64, f64, V3)> = Vec::new();
        for sample in &site.samples {
            let at = match sample.body {
                Some(body) => (self.poses[body] * Point3::from(sample.at)).coords,
                None => sample.at,
            };
            let way = at - foot;
            let (distance, bearing) = (way.x.hypot(way.y), wrapped(way.y.atan2(way.x) - heading));
            if distance <= self.params.range_m && bearing.abs() <= sector {
                near.push((distance, way.y.atan2(way.x), at));
            }
        }
        near.retain(|(_, _, at)| EYES_M.iter().any(|height| self.is_visible(&(foot + V3::z() * *height), at)));
        let distance_m = near.iter().map(|n| n.0).min_by(f64::total_cmp)?;
        let bearings = near.iter().map(|n| heading + wrapped(n.1 - heading));
        let span_rad = bearings.fold([f64::INFINITY, f64::NEG_INFINITY], |[l, h], b| [l.min(b), h.max(b)]);
        Some(View { distance_m, span_rad, places: near.into_iter().map(|n| n.2).collect() })
    }

    fn is_visible(&self, eye: &V3, at: &V3) -> bool {
        let back = (eye - at).try_normalize(0.0).unwrap_or_else(V3::z) * OFF_M;
        !self.surfaces.blocked((*eye).into(), Point::from(at + back))
    }

    /// Whether a surface of any obstacle passes within the tolerance of a place (a cube of twice that side).
    pub fn explains_place(&self, at: &V3) -> bool {
        let reach = self.params.tolerance_m;
        self.obstacles.touches([at.x - reach, at.y - reach, at.z - reach], [at.x + reach, at.y + reach, at.z + reach])
    }

    /// Whether any obstacle has a surface in the cone at this range, within the tolerance.
    pub fn explains_range(&self, from: &V3, axis: &V3, half_rad: f64, range_m: f64) -> bool {
        let within = |at: &V3| in_cone(at, from, axis, half_rad, range_m, self.params.tolerance_m);
        let moved = |(body, own): &(usize, Vec<V3>)| {
            own.iter().any(|at| within(&(self.poses[*body] * Point3::from(*at)).coords))
        };
        let far_m = range_m + self.params.tolerance_m;
        let (low, high) = (square(&from.add_scalar(-far_m)), square(&from.add_scalar(far_m)));
        let rows = (low[0]..=high[0]).map(|x| self.still.range([x, low[1]]..=[x, high[1]]));
        rows.flatten().any(|(_, samples)| samples.iter().any(within)) || self.moving.iter().any(moved)
    }

    /// Whether a site moves.
    pub fn moves(&self, site: &Site) -> bool {
        let body = site.samples.first().and_then(|sample| sample.body);
        self.moving.iter().any(|(index, _)| Some(*index) == body)
    }
}

/// Whether a place lies in the cone at this range.
pub(super) fn in_cone(at: &V3, from: &V3, axis: &V3, half_rad: f64, range_m: f64, tolerance_m: f64) -> bool {
    let way = at - from;
    let distance = way.norm();
    (distance - range_m).abs() <= tolerance_m && way.dot(axis) >= distance * half_rad.cos()
}

/// An angle within ±π.
pub(super) fn wrapped(angle: f64) -> f64 {
    angle.sin().atan2(angle.cos())
}

/// The square of the ground under a place.
fn square(at: &V3) -> [i64; 2] {
    [at.x, at.y].map(|c| (c / SQUARE_M).floor() as i64)
}

/// Height of the floor under the robot's start [m], and which body it is; 0 where there is none.
fn floor_under(scenario: &Scenario, surfaces: &Surfaces) -> (f64, Option<usize>) {
    let start = scenario.robot.start;
    let above = V3::new(start.x_m, start.y_m, FLOOR_M_MAX);
    surfaces.cast(above.into(), &-V3::z(), 100.0).map_or((0.0, None), |hit| (FLOOR_M_MAX - hit.range_m, Some(hit.body)))
}

/// Whether a body is higher than this [m].
fn is_obstacle(body: &Body, high_m: f64) -> bool {
    let top = |shape: &Shape| {
        let vertices = shape.tessellate(0.0).vertices.into_iter();
        vertices.map(|v| (body.pose * Point3::from(v)).z).fold(f64::NEG_INFINITY, f64::max)
    };
    body.shape != Shape::Plane && top(&body.shape) > high_m
}

/// Area of a surface [m²].
fn area(shape: &Shape) -> f64 {
    let mesh = shape.tessellate(0.0);
    let corner = |i: u32| mesh.vertices.get(i as usize).copied().unwrap_or_default();
    mesh.triangles
        .iter()
        .map(|[a, b, c]| (corner(*b) - corner(*a)).cross(&(corner(*c) - corner(*a))).norm() / 2.0)
        .sum()
}

/// How far apart so many samples of an area are [m].
fn spread(area_m2: f64, samples: f64) -> f64 {
    (area_m2 / samples).sqrt()
}

/// How far apart samples of a target of this area are [m].
fn spacing(area_m2: f64, tolerance_m: f64) -> f64 {
    let sparse = spread(area_m2, SAMPLES).max(SAMPLE_M);
    sparse.min(SAMPLE_SHARE * tolerance_m).max(spread(area_m2, SAMPLES_MAX))
}

/// The targets; without any, all of these bodies.
fn sites<'a>(scene: &Scene, params: &CompareParams, bodies: impl Iterator<Item = &'a usize>) -> Vec<Site> {
    if !params.target.is_empty() {
        return params.target.iter().map(|target| site(scene, target, params.tolerance_m)).collect();
    }
    let all = bodies.map(|index| {
        let name = scene.bodies[*index].name.clone();
        let target = TargetParams {
            bodies: vec![name.clone()],
            name,
            class: "obstacle".into(),
            fast_class: None,
            kind: Kind::Obstacle,
            line: Vec::new(),
            z: Vec::new(),
        };
        site(scene, &target, params.tolerance_m)
    });
    all.collect()
}

fn site(scene: &Scene, params: &TargetParams, tolerance_m: f64) -> Site {
    let samples = match (params.line.as_slice(), params.z.as_slice()) {
        ([from, to], [low, high]) => {
            let point = |end: &[f64], z: f64| V3::new(end[0], end[1], z);
            let (from, to) = (point(from, *low), point(to, *low));
            if params.kind == Kind::Drop {
                let across = to - from;
                hole(&from, &to, spacing((across.x * across.y).abs(), tolerance_m))
            } else {
                strip(&from, &to, high - low, tolerance_m)
            }
        }
        _ => {
            let indices = (0..scene.bodies.len()).filter(|i| params.bodies.contains(&scene.bodies[*i].name));
            let spacing = spacing(indices.clone().map(|i| area(&scene.bodies[i].shape)).sum(), tolerance_m);
            let of = |i: usize| sampled(&scene.bodies[i].shape, spacing).into_iter().map(move |at| (i, at));
            indices.flat_map(of).map(|(body, at)| Sample { body: Some(body), at }).collect()
        }
    };
    Site { params: params.clone(), samples }
}

/// Places all over an upright strip.
fn strip(from: &V3, to: &V3, height: f64, tolerance_m: f64) -> Vec<Sample> {
    let length = (to - from).norm();
    let spacing = spacing(length * height, tolerance_m).max(length.max(height) / SAMPLES_MAX);
    let steps = |length: f64| (length / spacing).ceil() as usize;
    let (along, up) = (steps(length), steps(height));
    let share = |i: usize, of: usize| if of == 0 { 0.0 } else { i as f64 / of as f64 };
    let at = |i, j| from + (to - from) * share(i, along) + V3::z() * (height * share(j, up));
    let places = (0..=along).flat_map(|i| (0..=up).map(move |j| (i, j)));
    places.map(|(i, j)| Sample { body: None, at: at(i, j) }).collect()
}

/// Places all over a hole, at the height of the floor.
fn hole(from: &V3, to: &V3, spacing: f64) -> Vec<Sample> {
    let across = to - from;
    let steps = [across.x, across.y].map(|side| (side.abs() / spacing).ceil().clamp(1.0, 1e4) as usize);
    let place = move |i: usize, j: usize| {
        let share = |k: usize, of: usize| k as f64 / of as f64;
        from + V3::new(across.x * share(i, steps[0]), across.y * share(j, steps[1]), 0.0)
    };
    let cells = (0..=steps[0]).flat_map(|i| (0..=steps[1]).map(move |j| (i, j)));
    cells.map(|(i, j)| Sample { body: None, at: place(i, j) }).collect()
}

/// Places all over a surface, about this far apart.
fn sampled(shape: &Shape, spacing: f64) -> Vec<V3> {
    let mesh = shape.tessellate(0.0);
    let mut taken = BTreeSet::new();
    let mut out = Vec::new();
    for [a, b, c] in &mesh.triangles {
        let corner = |i: u32| mesh.vertices.get(i as usize).copied().unwrap_or_default();
        let (a, b, c) = (corner(*a), corner(*b), corner(*c));
        // Both sides of a thin plate are sampled: of each only its own can be seen.
        let normal = (b - a).cross(&(c - a)).try_normalize(0.0).unwrap_or_default();
        let facing: [i64; 3] = std::array::from_fn(|axis| normal[axis].round() as i64);
        let [along, across] = [b - a, c - a].map(|side| (side.norm() / spacing).ceil().clamp(1.0, 1e5) as usize);
        for i in 0..=along {
            let most = across - across * i / along;
            for j in 0..=most {
                let at = a + (b - a) * (i as f64 / along as f64) + (c - a) * (j as f64 / across as f64);
                let key: [i64; 3] = std::array::from_fn(|axis| (at[axis] / spacing).round() as i64);
                if taken.insert((facing, key)) {
                    out.push(at);
                }
            }
        }
    }
    out
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub fn stage(bodies: &str, compare: &str) -> Stage {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("s.toml");
        std::fs::write(&path, format!("name = 's'\n[world]\nground = true\n{bodies}\n[compare]\n{compare}")).unwrap();
        Stage::new(&Scenario::load(&path, &[]).unwrap()).unwrap()
    }

    const BIN: &str = "[[world.cylinder]]\nname = 'bin'\nposition = [2.0, 0.0]\nradius = 0.2\nheight = 0.5\n";
    const SCREEN: &str = "[[world.box]]\nname = 'screen'\nposition = [1.0, 0.0]\nsize = [0.1, 2.0, 1.5]\n";

    #[test]
    fn what_is_ahead_in_the_open_is_in_play_from_its_nearest_place() {
        let stage = stage(BIN, "");
        assert_eq!(stage.sites.len(), 1, "without targets, each body on the floor");
        let here = Transform::planar(0.0, 0.0, 0.0);
        let view = stage.view(&stage.sites[0], &here).unwrap();
        assert!((view.distance_m - 1.8).abs() < 0.01, "{}", view.distance_m);
        let half = (0.2_f64 / 2.0).asin();
        assert!((view.span_rad[1] - half).abs() < 0.01 && (view.span_rad[0] + half).abs() < 0.01);
        // Of its far side only the lid is visible, and behind the robot or far away there is nothing.
        assert!(view.places.iter().all(|at| at.x < 2.06 || at.z > 0.49));
        for (x, yaw) in [(0.0, 2.0), (0.0, -2.0), (-2.5, 0.0), (3.0, 0.0)] {
            assert!(stage.view(&stage.sites[0], &Transform::planar(x, 0.0, yaw)).is_none(), "{x} {yaw}");
        }
    }

    #[test]
    fn a_thin_pane_is_seen_all_over_from_either_side() {
        let stage = stage("[[world.box]]\nname = 'pane'\nposition = [2.0, 0.0]\nsize = [0.01, 1.4, 0.9]\n", "");
        for (x, yaw, face) in [(0.0, 0.0, 1.995), (4.0, std::f64::consts::PI, 2.005)] {
            let view = stage.view(&stage.sites[0], &Transform::planar(x, 0.0, yaw)).unwrap();
            let middle = V3::new(face, 0.0, 0.4);
            assert!(view.places.iter().any(|at| (at - middle).norm() < 0.1), "from {x}: {:?}", view.places);
        }
    }

    #[test]
    fn the_floor_is_no_obstacle_but_a_step_on_it_is() {
        let slab = |name: &str, x: f64, side: f64, high: f64| {
            format!("[[world.step]]\nname = '{name}'\nposition = [{x}, 0.0]\nsize = [{side}, {side}, {high}]\n")
        };
        let stage = stage(&(slab("floor", 0.0, 6.0, 0.3) + &slab("step", 2.0, 0.5, 0.4)), "");
        assert_eq!(stage.sites.iter().map(|site| site.params.name.as_str()).collect::<Vec<_>>(), ["step"]);
        assert!(stage.explains_place(&V3::new(1.75, 0.0, 0.35)));
    }

    #[test]
    fn every_place_of_a_long_wall_has_a_sample_near_it() {
        let stage = stage("[[world.box]]\nname = 'wall'\nposition = [2.0, 0.0]\nsize = [0.1, 12.8, 1.0]\n", "");
        let tolerance_m = stage.params.tolerance_m;
        for k in 0..=250 {
            let place = V3::new(1.95, f64::from(k) * 0.05 - 6.25, 0.4);
            let pose = stage.poses[stage.sites[0].samples[0].body.unwrap()];
            let near_m = stage.sites[0].samples.iter().map(|s| ((pose * Point3::from(s.at)).coords - place).norm());
            assert!(near_m.fold(f64::INFINITY, f64::min) < tolerance_m, "{place:?}");
        }
    }

    #[test]
    fn targets_without_end_are_sampled_within_reason() {
        let long = "[[compare.target]]\nname = 'a'\nclass = 'a'\nline = [[-1e5, -1e5], [1e5, 1e5]]\nz = [0.0, 99.0]\n\
            [[compare.target]]\nname = 'b'\nclass = 'b'\nkind = 'drop'\nline = [[-1e5, -1e5], [1e5, 1e5]]\nz = [0.0, 0.0]\n\
            [[compare.target]]\nname = 'c'\nclass = 'c'\nbodies = ['slab']\n";
        let stage = stage("[[world.box]]\nname = 'slab'\nposition = [0.0, 0.0]\nsize = [1000.0, 1000.0, 0.2]\n", long);
        for site in &stage.sites {
            assert!((1000..2_000_000).contains(&site.samples.len()), "{} {}", site.params.name, site.samples.len());
        }
    }

    #[test]
    fn what_stands_behind_something_is_not_in_play() {
        let stage = stage(&format!("{BIN}{SCREEN}"), "");
        let bin = stage.sites.iter().find(|site| site.params.name == "bin").unwrap();
        assert!(stage.view(bin, &Transform::planar(0.0, 0.0, 0.0)).is_none());
        assert!(stage.view(bin, &Transform::planar(2.0, -2.0, 1.57)).is_some());
    }

    #[test]
    fn a_strip_over_a_line_is_a_target_and_what_moves_takes_its_places_along() {
        let walker = "[[world.mover]]\nname = 'w'\npath = [[2.0, 0.0], [2.0, 3.0]]\nspeed_m_s = 1.0\n\
            [[world.cylinder]]\nname = 'leg'\nposition = [0.0, 0.0]\nradius = 0.1\nheight = 0.8\nmover = 'w'\n";
        let compare = "[[compare.target]]\nname = 'a'\nclass = 'corner'\nline = [[1.5, 0.5], [1.5, 0.5]]\nz = [0.0, 1.0]\n\
            [[compare.target]]\nname = 'b'\nclass = 'person'\nbodies = ['leg']\n";
        let mut stage = stage(walker, compare);
        let here = Transform::planar(0.0, 0.0, 0.0);
        let strip = stage.view(&stage.sites[0], &here).unwrap();
        assert!((strip.distance_m - 1.5_f64.hypot(0.5)).abs() < 1e-9 && strip.places.len() == 21);
        assert!((stage.view(&stage.sites[1], &here).unwrap().distance_m - 1.9).abs() < 0.01);
        stage.set(1.0, &[]).unwrap();
        let moved = stage.view(&stage.sites[1], &here).unwrap();
        // Of round bodies the nearest sample is not quite the nearest place.
        assert!((moved.distance_m - (2.0_f64.hypot(1.0) - 0.1)).abs() < 1.5 * SAMPLE_M, "{}", moved.distance_m);
        assert!(stage.explains_place(&V3::new(2.0, 0.85, 0.4)) && !stage.explains_place(&V3::new(2.0, 0.0, 0.4)));
        let axis = V3::new(2.0, 1.0, 0.0).normalize();
        let from = V3::new(0.0, 0.0, 0.4);
        assert!(stage.explains_range(&from, &axis, 0.2, 2.136) && !stage.explains_range(&from, &axis, 0.2, 1.5));
        assert!(!stage.explains_range(&from, &V3::x(), 0.2, 2.136));
    }
}
