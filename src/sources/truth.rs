//! Judging maps by the truth that a simulation knows.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Vector3;
use serde::Serialize;

use super::plan_truth::{LayerVerdict, LayerVerdicts};
use crate::geometry::{Point, Robot, Transform, World};
use crate::maps::Maps;
use crate::navigation::Rms;
use crate::pipeline::Step;
use crate::scanner::TrueSight;
use crate::world::{Scene, Surfaces};

/// A point farther than this from the truth is an outlier, not an error [m].
const OUTLIER_M: f64 = 0.1;
/// True hits that make a surface voxel count as seen.
const HITS_SEEN: u32 = 3;
/// Voxels below this height are mostly floor, which hides everything else in one figure [m].
const LOW_M: f64 = 0.1;
/// Range up to which the finder is asked to be good [m].
const NEAR_M: f64 = 3.0;
/// Side of a truth cell of the terrain [m].
const TERRAIN_CELL_M: f64 = 0.05;

/// How good a run was. Definitions stand beside the fields.
#[derive(Clone, Debug, Serialize)]
pub struct Verdict {
    /// The instrument alone: 3D distance in the robot's frame from a point to where that column's line of sight truly
    /// met the lit surface, RMS over the distances below 0.1 m.
    pub point_rms_m: f64,
    /// The same for points within 3 m of the robot's axis.
    pub point_rms_m_within_3m: f64,
    /// Share of points farther than 0.1 m from the truth, or with none in their column.
    pub point_outliers: f64,
    /// Share of occupied voxels with a surface within one voxel, also diagonally.
    pub occupancy_precision: f64,
    /// Share of surface voxels with ≥ 3 true hits that have an occupied voxel as near.
    pub occupancy_recall: f64,
    /// Precision of voxels below 0.1 m.
    pub occupancy_precision_low: f64,
    /// Recall of voxels below 0.1 m.
    pub occupancy_recall_low: f64,
    /// Precision of voxels from 0.1 m up.
    pub occupancy_precision_high: f64,
    /// Recall of voxels from 0.1 m up.
    pub occupancy_recall_high: f64,
    /// RMS height difference between mesh and ground, where ground was seen and the mesh covers it.
    pub terrain_rmse_m: f64,
    /// Share of the seen ground that the mesh covers.
    pub terrain_coverage: f64,
    /// RMS distance of the estimated from the true position over captures.
    pub pose_rms_m: f64,
    /// RMS angle between the estimated and the true attitude over captures.
    pub pose_rms_rad: f64,
    /// The plan view, the ultrasonic layer and both together; only where there were ultrasonic ranges.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub map: Option<LayerVerdicts>,
    /// Bodies that the slit fell on where the camera saw it, by name: how many of their seen voxels were found.
    pub objects: BTreeMap<String, Found>,
}

/// What became of one body.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Found {
    /// Surface voxels with ≥ 3 true hits; for what stands on the ground, without voxels that ground passes through.
    pub seen: u64,
    /// Of these, with an occupied voxel as near as one voxel, on the same terms.
    pub found: u64,
    /// Most of it was found.
    pub is_found: bool,
}

/// From one place of the robot's way to the next [m].
const WAY_STEP_M: f64 = 0.25;

type Voxel = [i32; 3];

/// Collects the truth beside every step, and judges at the end.
pub struct Judge {
    voxel_m: f64,
    names: Vec<String>,
    ground: Vec<bool>,
    near: Rms,
    far: Rms,
    outliers: u64,
    position: Rms,
    attitude: Rms,
    /// True hits of each body in each voxel.
    hits: BTreeMap<Voxel, BTreeMap<u32, u32>>,
    /// One true sight of ground in each cell.
    ground_seen: BTreeMap<[i32; 2], Vector3<f64>>,
    way_m: Vec<[f64; 2]>,
}

impl Judge {
    /// Judges maps of a scene with voxels of this size.
    pub fn new(scene: &Scene, voxel_m: f64) -> Self {
        Self {
            voxel_m,
            names: scene.bodies.iter().map(|b| b.name.clone()).collect(),
            ground: scene.bodies.iter().map(|b| b.ground).collect(),
            near: Rms::default(),
            far: Rms::default(),
            outliers: 0,
            position: Rms::default(),
            attitude: Rms::default(),
            hits: BTreeMap::new(),
            ground_seen: BTreeMap::new(),
            way_m: Vec::new(),
        }
    }

    /// Takes the truth of one step; returns the RMS error of its points [m], without outliers.
    pub fn step(
        &mut self,
        step: &Step,
        world_from_robot: &Transform<World, Robot>,
        sights: &[TrueSight],
    ) -> Option<f64> {
        for sight in sights {
            self.see(sight);
        }
        let apart = step.world_from_robot.inverse().iso * world_from_robot.iso;
        self.position.add(apart.translation.vector.norm());
        self.attitude.add(apart.rotation.angle());

        let here = [world_from_robot.xyz().x, world_from_robot.xyz().y];
        if self.way_m.last().is_none_or(|last| (here[0] - last[0]).hypot(here[1] - last[1]) >= WAY_STEP_M) {
            self.way_m.push(here);
        }
        let robot_from_world = world_from_robot.inverse();
        let mut own = Rms::default();
        for seen in &step.seen.points {
            let in_column = sights.iter().filter(|s| s.column == seen.column);
            let v = step.line.columns[usize::from(seen.column)].map_or(0.0, |peak| f64::from(peak.v));
            // Where the stripe is split at an edge, the peak belongs to the nearer part.
            let Some(truth) = in_column.min_by(|a, b| (a.v - v).abs().total_cmp(&(b.v - v).abs())) else {
                self.outliers += 1;
                continue;
            };
            let error = ((robot_from_world * truth.point).xyz - seen.point.xyz).norm();
            if error >= OUTLIER_M {
                self.outliers += 1;
                continue;
            }
            own.add(error);
            let is_near = seen.point.xyz.xy().norm() <= NEAR_M;
            if is_near { self.near.add(error) } else { self.far.add(error) }
        }
        own.value()
    }

    fn see(&mut self, sight: &TrueSight) {
        let voxel = voxel_of(&sight.point, self.voxel_m);
        let hits = self.hits.entry(voxel).or_default().entry(sight.body).or_default();
        *hits = hits.saturating_add(1);
        if self.ground.get(sight.body as usize) == Some(&true) {
            let cell = [sight.point.xyz.x, sight.point.xyz.y].map(|c| (c / TERRAIN_CELL_M).floor() as i32);
            self.ground_seen.entry(cell).or_insert(sight.point.xyz);
        }
    }

    /// The verdict on the maps as they are now.
    pub fn verdict(&self, maps: &Maps, surfaces: &Surfaces) -> Verdict {
        let occupied: BTreeSet<Voxel> = maps.grid().occupied().collect();
        let precision = self.precision(&occupied, surfaces);
        let recall = self.recall(&occupied);
        let (terrain_rmse_m, terrain_coverage) = self.terrain(maps);
        let mut all = self.near;
        all.merge(&self.far);
        let points = all.count() + self.outliers;
        Verdict {
            point_rms_m: all.value().unwrap_or(f64::NAN),
            point_rms_m_within_3m: self.near.value().unwrap_or(f64::NAN),
            point_outliers: self.outliers as f64 / points as f64,
            occupancy_precision: share(precision[0], precision[1]),
            occupancy_recall: share(recall[0], recall[1]),
            occupancy_precision_low: precision[0].share(),
            occupancy_recall_low: recall[0].share(),
            occupancy_precision_high: precision[1].share(),
            occupancy_recall_high: recall[1].share(),
            terrain_rmse_m,
            terrain_coverage,
            pose_rms_m: self.position.value().unwrap_or(f64::NAN),
            pose_rms_rad: self.attitude.value().unwrap_or(f64::NAN),
            map: None,
            objects: self.objects(&occupied),
        }
    }

    /// Where the robot truly was, every so often [m].
    pub fn way_m(&self) -> &[[f64; 2]] {
        &self.way_m
    }

    /// Occupied voxels that are right, [low, high].
    fn precision(&self, occupied: &BTreeSet<Voxel>, surfaces: &Surfaces) -> [Tally; 2] {
        let mut tally = [Tally::default(); 2];
        for voxel in occupied {
            let low = voxel.map(|c| (f64::from(c) - 1.0) * self.voxel_m);
            let high = voxel.map(|c| (f64::from(c) + 2.0) * self.voxel_m);
            tally[self.half(voxel)].add(surfaces.touches(low, high));
        }
        tally
    }

    /// Seen voxels that are found, [low, high].
    fn recall(&self, occupied: &BTreeSet<Voxel>) -> [Tally; 2] {
        let mut tally = [Tally::default(); 2];
        for (voxel, bodies) in &self.hits {
            if bodies.values().sum::<u32>() >= HITS_SEEN {
                tally[self.half(voxel)].add(has_near(occupied, voxel));
            }
        }
        tally
    }

    fn half(&self, voxel: &Voxel) -> usize {
        usize::from((f64::from(voxel[2]) + 0.5) * self.voxel_m >= LOW_M)
    }

    fn objects(&self, occupied: &BTreeSet<Voxel>) -> BTreeMap<String, Found> {
        let is_ground = |body: u32| self.ground.get(body as usize) == Some(&true);
        let with_ground: BTreeSet<Voxel> = self
            .hits
            .iter()
            .filter(|(_, bodies)| bodies.keys().any(|b| is_ground(*b)))
            .map(|(voxel, _)| *voxel)
            .collect();
        // The floor beside a pole's foot is not the pole: for what stands on it, voxels of the ground do not count.
        let standing: BTreeSet<Voxel> = occupied.difference(&with_ground).copied().collect();
        let mut objects: BTreeMap<String, Tally> = BTreeMap::new();
        for (voxel, bodies) in &self.hits {
            for (&body, _) in bodies.iter().filter(|(_, hits)| **hits >= HITS_SEEN) {
                let name = self.names.get(body as usize).cloned().unwrap_or_default();
                if is_ground(body) {
                    objects.entry(name).or_default().add(has_near(occupied, voxel));
                } else if !with_ground.contains(voxel) {
                    objects.entry(name).or_default().add(has_near(&standing, voxel));
                }
            }
        }
        let found = |t: Tally| Found { seen: t.all, found: t.right, is_found: 2 * t.right > t.all };
        objects.into_iter().map(|(name, tally)| (name, found(tally))).collect()
    }

    fn terrain(&self, maps: &Maps) -> (f64, f64) {
        let mut height = Rms::default();
        for truth in self.ground_seen.values() {
            if let Some(z) = maps.height_at(truth.x, truth.y) {
                height.add(z - truth.z);
            }
        }
        (height.value().unwrap_or(f64::NAN), height.count() as f64 / self.ground_seen.len() as f64)
    }
}

impl Verdict {
    /// One paragraph for people.
    pub fn text(&self) -> String {
        if self.point_rms_m.is_nan() {
            return "against the truth: nothing was seen".into();
        }
        let missed: Vec<&str> = self.objects.iter().filter(|(_, o)| !o.is_found).map(|(n, _)| n.as_str()).collect();
        let objects = match missed.is_empty() {
            true => format!("all {} bodies seen are in the map", self.objects.len()),
            false => format!("of {} bodies seen, missing in the map: {}", self.objects.len(), missed.join(", ")),
        };
        format!(
            "against the truth: points {:.1} mm RMS, {:.2} % outliers; occupancy precision {:.3} (above 0.1 m {:.3}), recall {:.3} ({:.3}); \
             terrain {:.1} mm RMS; pose {:.0} mm RMS; {objects}",
            self.point_rms_m * 1e3,
            self.point_outliers * 1e2,
            self.occupancy_precision,
            self.occupancy_precision_high,
            self.occupancy_recall,
            self.occupancy_recall_high,
            self.terrain_rmse_m * 1e3,
            self.pose_rms_m * 1e3,
        )
    }

    /// A line on the layers for people.
    pub fn map_text(&self) -> Option<String> {
        let layer = |name: &str, v: &LayerVerdict| {
            format!(
                "{name} precision {:.3}, recall {:.3}, IoU {:.3}, free space wrong {:.2} %, found {:.0} %",
                v.precision,
                v.recall,
                v.iou,
                v.free_space_error * 1e2,
                v.free_found * 1e2
            )
        };
        let map = self.map.as_ref()?;
        let layers = [("laser", &map.laser), ("ultrasonic", &map.ultrasonic), ("fused", &map.fused)];
        Some(format!("plan view: {}", layers.map(|(name, v)| layer(name, v)).join("; ")))
    }
}

/// How many of how many.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    right: u64,
    all: u64,
}

impl Tally {
    fn add(&mut self, right: bool) {
        self.right += u64::from(right);
        self.all += 1;
    }

    fn share(self) -> f64 {
        self.right as f64 / self.all as f64
    }
}

fn share(a: Tally, b: Tally) -> f64 {
    Tally { right: a.right + b.right, all: a.all + b.all }.share()
}

fn voxel_of(point: &Point<World>, voxel_m: f64) -> Voxel {
    [point.xyz.x, point.xyz.y, point.xyz.z].map(|c| (c / voxel_m).floor() as i32)
}

/// Whether the set holds this voxel or one of its 26 neighbours.
fn has_near(occupied: &BTreeSet<Voxel>, &[x, y, z]: &Voxel) -> bool {
    (-1..=1).any(|dx| (-1..=1).any(|dy| (-1..=1).any(|dz| occupied.contains(&[x + dx, y + dy, z + dz]))))
}
