//! Which places are ground, and how high: the lowest surface of each cell, grown from where the robot has stood.

use std::collections::VecDeque;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::key::{KeyMap, pack};
use crate::fault::{Result, number_within};
use crate::geometry::{Point, Robot, Transform, World};

/// Height of a bin in which points of one cell are counted together [µm].
const BIN_UM: i64 = 10_000;
/// A cell keeps its lowest bins only: what is higher can never be its lowest surface.
const BINS_MAX: usize = 64;
/// A surface is this many bins thick at most: more than the noise of a point (σ ≤ 11 mm).
const SURFACE_BINS: i32 = 3;
/// Fewer points make no surface, so that one low outlier takes over no cell.
const POINTS_MIN: u64 = 3;
/// Nor do fewer than this share of the points of the cell's fullest surface: outliers add up in a long run.
const SHARE_MIN: u64 = 20;
/// How far above its surface a cell is searched for more points, which make it the foot of something upright [µm].
const WALL_UM: i64 = 150_000;

/// How ground is told from what stands on it, and how fine its mesh is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TerrainParams {
    /// Side of a cell [m].
    pub cell_m: f64,
    /// The mesh is nowhere farther (in height) from a cell of ground than this [m].
    pub error_m_max: f64,
    /// Ground is nowhere steeper from a cell to the next [deg].
    pub slope_deg_max: f64,
    /// And rises by this much on top, for noise and rough ground [m].
    pub step_m_max: f64,
    /// Ground goes on behind gaps up to this wide in which nothing was seen [m].
    pub gap_m_max: f64,
    /// What the robot stands on is ground at most this far from it [m].
    pub seed_m_max: f64,
    /// And at most this much above or below the plane that the robot stands on [m].
    pub seed_band_m: f64,
    /// The mesh spans places without observed ground only up to this width [m].
    pub hole_m_max: f64,
    /// The terrain grows to this many cells, then refuses new ones.
    pub cells_max: usize,
}

impl Default for TerrainParams {
    fn default() -> Self {
        Self {
            cell_m: 0.05,
            error_m_max: 0.02,
            slope_deg_max: 12.0,
            step_m_max: 0.02,
            gap_m_max: 0.3,
            seed_m_max: 4.0,
            seed_band_m: 0.05,
            hole_m_max: 0.5,
            cells_max: 1 << 22,
        }
    }
}

impl TerrainParams {
    /// Refuses values that make no terrain.
    pub fn validated(self) -> Result<Self> {
        number_within("terrain.cell_m", self.cell_m, 0.01, 10.0)?;
        number_within("terrain.error_m_max", self.error_m_max, 1e-4, 10.0)?;
        number_within("terrain.slope_deg_max", self.slope_deg_max, 0.0, 60.0)?;
        number_within("terrain.step_m_max", self.step_m_max, 0.0, 1.0)?;
        number_within("terrain.gap_m_max", self.gap_m_max, 0.0, 64.0 * self.cell_m)?;
        number_within("terrain.seed_m_max", self.seed_m_max, self.cell_m, 100.0)?;
        number_within("terrain.seed_band_m", self.seed_band_m, 1e-3, 1.0)?;
        number_within("terrain.hole_m_max", self.hole_m_max, 0.0, 64.0 * self.cell_m)?;
        number_within("terrain.cells_max", self.cells_max as f64, 1.0, f64::from(u32::MAX))?;
        Ok(self)
    }
}

/// Points of one cell within 1 cm of height.
#[derive(Clone, Copy, Debug)]
struct Bin {
    level: i32,
    count: u32,
    /// Sum of heights [µm]: integer, so that the order of points does not matter.
    sum_um: i64,
}

/// All heights seen in one cell.
struct Column {
    key: [i32; 2],
    /// By level, lowest first.
    bins: Vec<Bin>,
    /// Points that lay on the plane the robot stood on, and the sum of their heights [µm].
    seeds: u32,
    seeds_um: i64,
}

/// The lowest surface of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Lowest {
    height_um: i64,
    /// There are points right above it: a wall's foot, a box's edge.
    upright: bool,
    /// The robot stood on its plane, near it.
    seed: bool,
}

impl Column {
    fn add(&mut self, height_um: i64) {
        let level = height_um.div_euclid(BIN_UM) as i32;
        match self.bins.binary_search_by_key(&level, |bin| bin.level) {
            Ok(at) => {
                let bin = &mut self.bins[at];
                if bin.count < u32::MAX {
                    bin.count += 1;
                    bin.sum_um += height_um;
                }
            }
            Err(at) => {
                self.bins.insert(at, Bin { level, count: 1, sum_um: height_um });
                self.bins.truncate(BINS_MAX);
            }
        }
    }

    /// Points, and the sum of their heights [µm], from level `low` to below `high`.
    fn between(&self, low: i32, high: i32) -> (u64, i64) {
        let from = self.bins.partition_point(|bin| bin.level < low);
        let within = self.bins[from..].iter().take_while(|bin| bin.level < high);
        within.fold((0, 0), |(count, sum), bin| (count + u64::from(bin.count), sum + bin.sum_um))
    }

    fn lowest(&self) -> Option<Lowest> {
        let thick = |bin: &Bin| self.between(bin.level, bin.level + SURFACE_BINS).0;
        let fullest = self.bins.iter().map(thick).max()?;
        let enough = POINTS_MIN.max(fullest / SHARE_MIN);
        let foot = self.bins.iter().find(|bin| thick(bin) >= enough)?.level;
        let (count, sum) = self.between(foot, foot + SURFACE_BINS + 1);
        // The foot may be the lower tail of the noise: take the mean again about the first one.
        let middle = sum / count.max(1) as i64;
        let level = |um: i64| um.div_euclid(BIN_UM) as i32;
        let top = level(middle + i64::from(SURFACE_BINS) * BIN_UM) + 1;
        let (count, sum) = self.between(level(middle - i64::from(SURFACE_BINS) * BIN_UM), top);
        let height_um = sum.div_euclid(count.max(1) as i64);
        let above = self.between(top, level(middle + WALL_UM) + 1).0;
        let seed_um = self.seeds_um.div_euclid(i64::from(self.seeds.max(1)));
        Some(Lowest {
            height_um,
            upright: above >= POINTS_MIN.max(count / 4),
            seed: u64::from(self.seeds) >= POINTS_MIN
                && (seed_um - height_um).abs() <= i64::from(SURFACE_BINS) * BIN_UM,
        })
    }
}

/// Side of a tile of the index [cells].
const TILE: i32 = 16;
/// No column is at this place of a tile.
const NONE: u32 = u32::MAX;

/// A direction in which ground goes on.
struct Stride {
    step: [i32; 2],
    /// How much ground may rise or fall in one step, in two, and so on [µm].
    rise_um: Vec<i64>,
}

/// Finds columns by their cells: in tiles, since growing ground asks for neighbours all the time.
#[derive(Default)]
struct Index {
    numbers: KeyMap<usize>,
    tiles: Vec<[u32; (TILE * TILE) as usize]>,
}

/// The tile that was looked at last.
type Cursor = Option<(u64, usize)>;

impl Index {
    fn find(&self, key: [i32; 2], cursor: &mut Cursor) -> Option<usize> {
        let (tile, at) = Self::place(key);
        let number = match *cursor {
            Some((last, number)) if last == tile => number,
            _ => *self.numbers.get(&tile)?,
        };
        *cursor = Some((tile, number));
        Some(self.tiles[number][at]).filter(|column| *column != NONE).map(|column| column as usize)
    }

    fn insert(&mut self, key: [i32; 2], column: u32) {
        let (tile, at) = Self::place(key);
        let number = *self.numbers.entry(tile).or_insert(self.tiles.len());
        if number == self.tiles.len() {
            self.tiles.push([NONE; (TILE * TILE) as usize]);
        }
        self.tiles[number][at] = column;
    }

    /// A cell's tile as one number, and its place in it.
    fn place([x, y]: [i32; 2]) -> (u64, usize) {
        let within = x.rem_euclid(TILE) * TILE + y.rem_euclid(TILE);
        (pack([x.div_euclid(TILE), y.div_euclid(TILE), 0]), within as usize)
    }
}

/// The heights seen in every cell. Cell (i, j) reaches from (i, j) to (i+1, j+1) times `cell_m` in the world.
pub struct Terrain {
    params: TerrainParams,
    index: Index,
    columns: Vec<Column>,
    robot: Option<Transform<World, Robot>>,
    refused: u64,
}

impl Terrain {
    /// An empty terrain; an error where the parameters make none.
    pub fn new(params: TerrainParams) -> Result<Self> {
        let params = params.validated()?;
        Ok(Self { params, index: Index::default(), columns: Vec::new(), robot: None, refused: 0 })
    }

    /// What it was made with.
    pub fn params(&self) -> &TerrainParams {
        &self.params
    }

    /// Where the robot stands from now on: its feet are on the ground. A pose that is not finite is not taken.
    pub fn note_robot(&mut self, world_from_robot: &Transform<World, Robot>) {
        if world_from_robot.is_finite() {
            self.robot = Some(*world_from_robot);
        }
    }

    /// Takes points [m]; those that are not finite or 10 km and more away are passed over.
    pub fn insert_points(&mut self, points: impl IntoIterator<Item = Point<World>>) {
        let robot_from_world = self.robot.map(|robot| robot.inverse());
        for point in points {
            if !point.xyz.iter().all(|c| c.abs() < 1e4) {
                continue;
            }
            let key = [point.xyz.x, point.xyz.y].map(|c| (c / self.params.cell_m).floor() as i32);
            let Some(at) = self.column(key) else { continue };
            let height_um = (point.xyz.z * 1e6).round() as i64;
            let on_its_plane = robot_from_world.is_some_and(|robot_from_world| {
                let seen = (robot_from_world * point).xyz;
                seen.z.abs() <= self.params.seed_band_m && seen.xy().norm() <= self.params.seed_m_max
            });
            let column = &mut self.columns[at];
            column.add(height_um);
            if on_its_plane && column.seeds < u32::MAX {
                column.seeds += 1;
                column.seeds_um += height_um;
            }
        }
    }

    /// How many points were refused because the terrain had `cells_max` cells.
    pub fn refused_count(&self) -> u64 {
        self.refused
    }

    /// What is ground: all cells that can be reached from what the robot stood on without too high a step.
    pub fn ground(&self) -> Ground {
        let seen: Vec<Option<Lowest>> = self.columns.iter().map(Column::lowest).collect();
        let mut reached = vec![false; seen.len()];
        let seeds = (0..seen.len()).filter(|at| seen[*at].is_some_and(|cell| cell.seed && !cell.upright));
        let mut queue: VecDeque<usize> = seeds.collect();
        if queue.is_empty() {
            queue.extend(self.nearest_within_cone(&seen));
        }
        queue.iter().for_each(|at| reached[*at] = true);
        let strides = self.strides();
        let mut cursor = None;
        while let Some(at) = queue.pop_front() {
            for stride in &strides {
                let Some(next) = self.next(at, stride, &seen, &mut cursor) else { continue };
                if !std::mem::replace(&mut reached[next], true) {
                    queue.push_back(next);
                }
            }
        }
        let cells = self.columns.iter().zip(&seen).zip(&reached).filter(|(_, reached)| **reached);
        let cells = cells.filter_map(|((column, cell), _)| Some((column.key, cell.as_ref()?.height_um)));
        Ground::new(self.params.cell_m, cells.collect())
    }

    /// Feeds everything that is known, in an order that does not depend on how it came to be.
    pub fn digest_into(&self, feed: &mut impl FnMut(&[u8])) {
        feed(&self.params.cell_m.to_le_bytes());
        let mut columns: Vec<_> = self.columns.iter().collect();
        columns.sort_unstable_by_key(|column| column.key);
        for column in columns {
            column.key.iter().for_each(|c| feed(&c.to_le_bytes()));
            feed(&column.seeds.to_le_bytes());
            for bin in &column.bins {
                feed(&bin.level.to_le_bytes());
                feed(&bin.count.to_le_bytes());
                feed(&bin.sum_um.to_le_bytes());
            }
        }
    }

    /// Checks what must always hold.
    pub fn check(&self) -> std::result::Result<(), String> {
        let indexed = self.index.tiles.iter().flatten().filter(|column| **column != NONE).count();
        if indexed != self.columns.len() || indexed > self.params.cells_max {
            return Err(format!("{} cells, {indexed} in the index", self.columns.len()));
        }
        for (at, column) in self.columns.iter().enumerate() {
            if self.index.find(column.key, &mut None) != Some(at) {
                return Err(format!("cell {:?} is not in the index", column.key));
            }
            let sorted = column.bins.windows(2).all(|pair| pair[0].level < pair[1].level);
            if column.bins.is_empty() || column.bins.len() > BINS_MAX || !sorted {
                return Err(format!("cell {:?} holds {:?}", column.key, column.bins));
            }
            for bin in &column.bins {
                let lowest = i64::from(bin.level) * BIN_UM * i64::from(bin.count);
                if bin.count == 0 || !(lowest..lowest + BIN_UM * i64::from(bin.count)).contains(&bin.sum_um) {
                    return Err(format!("cell {:?} holds {bin:?}", column.key));
                }
            }
        }
        Ok(())
    }

    fn column(&mut self, key: [i32; 2]) -> Option<usize> {
        if let Some(at) = self.index.find(key, &mut None) {
            return Some(at);
        }
        if self.columns.len() >= self.params.cells_max {
            self.refused += 1;
            return None;
        }
        self.index.insert(key, self.columns.len() as u32);
        self.columns.push(Column { key, bins: Vec::new(), seeds: 0, seeds_um: 0 });
        Some(self.columns.len() - 1)
    }

    /// The eight directions in which ground goes on.
    fn strides(&self) -> [Stride; 8] {
        const AROUND: [[i32; 2]; 8] = [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]];
        let slope = self.params.slope_deg_max.to_radians().tan();
        let gap_m_max = self.params.gap_m_max.max(self.params.cell_m * std::f64::consts::SQRT_2);
        AROUND.map(|step| {
            let stride_m = self.params.cell_m * f64::from(step[0] * step[0] + step[1] * step[1]).sqrt();
            let steps = (gap_m_max / stride_m + 1e-9) as u32;
            let rise_m = |n: u32| slope * f64::from(n) * stride_m + self.params.step_m_max;
            Stride { step, rise_um: (1..=steps).map(|n| (rise_m(n) * 1e6).round() as i64).collect() }
        })
    }

    /// The cell that ground goes on to in one direction: the first that was seen, unless it is too far or too high.
    fn next(&self, at: usize, stride: &Stride, seen: &[Option<Lowest>], cursor: &mut Cursor) -> Option<usize> {
        let [mut x, mut y] = self.columns[at].key;
        let here = seen[at]?;
        for rise_um in &stride.rise_um {
            x += stride.step[0];
            y += stride.step[1];
            let Some(next) = self.index.find([x, y], cursor) else { continue };
            let Some(there) = seen[next] else { continue };
            let reachable = !there.upright && (there.height_um - here.height_um).abs() <= *rise_um;
            return reachable.then_some(next);
        }
        None
    }

    /// Where nothing lies on the plane that the robot stands on, as on a hill: the nearest cell it could drive to.
    fn nearest_within_cone(&self, seen: &[Option<Lowest>]) -> Option<usize> {
        let robot: Vector3<f64> = self.robot?.xyz();
        let slope = self.params.slope_deg_max.to_radians().tan();
        let near = self.columns.iter().zip(seen).enumerate().filter_map(|(at, (column, cell))| {
            let cell = cell.as_ref().filter(|cell| !cell.upright)?;
            let [x, y] = column.key.map(|c| (f64::from(c) + 0.5) * self.params.cell_m);
            let distance_m = (x - robot.x).hypot(y - robot.y);
            let rise_m = (cell.height_um as f64 * 1e-6 - robot.z).abs();
            let within = rise_m <= self.params.seed_band_m + slope * distance_m;
            (distance_m <= self.params.seed_m_max && within).then_some((distance_m, column.key, at))
        });
        near.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))).map(|(_, _, at)| at)
    }
}

/// The cells that are ground, with their heights: a moment of a `Terrain`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ground {
    /// Side of a cell [m].
    pub cell_m: f64,
    /// Key and height [µm] of each cell, in the order of the keys.
    pub cells: Vec<([i32; 2], i64)>,
}

impl Ground {
    fn new(cell_m: f64, mut cells: Vec<([i32; 2], i64)>) -> Self {
        cells.sort_unstable();
        Self { cell_m, cells }
    }

    /// The height of a cell [m], if it is ground.
    pub fn height_m(&self, key: [i32; 2]) -> Option<f64> {
        let at = self.cells.binary_search_by_key(&key, |(key, _)| *key).ok()?;
        Some(self.cells[at].1 as f64 * 1e-6)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn terrain() -> Terrain {
        let mut terrain = Terrain::new(TerrainParams::default()).unwrap();
        terrain.note_robot(&Transform::identity());
        terrain
    }

    /// Noise of 3 mm, the same in every run.
    fn noise(i: usize) -> f64 {
        let mixed = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
        (mixed as f64 / f64::from(1 << 24) - 0.5) * 0.01
    }

    /// Six points in each cell of a field, at the height given by a function of x and y; none where it gives none.
    fn field(x: [i32; 2], y: [i32; 2], height: impl Fn(f64, f64) -> Option<f64>) -> Vec<Point<World>> {
        let mut points = Vec::new();
        for i in x[0] * 3..x[1] * 3 {
            for j in y[0] * 2..y[1] * 2 {
                let (x, y) = ((f64::from(i) + 0.5) * 0.05 / 3.0, (f64::from(j) + 0.5) * 0.025);
                points.extend(height(x, y).map(|z| Point::new(x, y, z + noise(points.len() * 7 + 1))));
            }
        }
        points
    }

    fn covered(ground: &Ground, x: f64, y: f64) -> Option<f64> {
        ground.height_m([x, y].map(|c| (c / 0.05).floor() as i32))
    }

    fn digest(terrain: &Terrain) -> Vec<u8> {
        let mut all = Vec::new();
        terrain.digest_into(&mut |bytes| all.extend_from_slice(bytes));
        all
    }

    #[test]
    fn a_box_is_no_ground_and_a_ramp_is() {
        let mut terrain = terrain();
        let ramp = 8.5f64.to_radians().tan();
        terrain.insert_points(field([28, 76], [-30, 30], |x, y| {
            let on_box = (2.0..2.4).contains(&x) && (-0.9..-0.4).contains(&y);
            let in_shadow = (2.4..2.65).contains(&x) && (-0.9..-0.4).contains(&y);
            let ramp = if x > 2.5 && y > 0.2 { ramp * (x - 2.5) } else { 0.0 };
            (!in_shadow).then_some(if on_box { 0.1 } else { ramp })
        }));
        // The front of the box.
        terrain.insert_points(
            (0..400).map(|i| Point::new(1.999, -0.9 + 0.00125 * f64::from(i), f64::from(i % 20) * 0.005)),
        );
        let ground = terrain.ground();
        assert_eq!(terrain.check(), Ok(()));
        for (x, y) in [(2.02, -0.5), (2.2, -0.6), (2.37, -0.88), (2.37, -0.42)] {
            assert_eq!(covered(&ground, x, y), None, "box at {x}, {y}");
        }
        for (x, y) in [(1.5, 0.0), (2.2, 0.0), (2.9, -0.7), (3.7, -1.0)] {
            assert!(covered(&ground, x, y).unwrap().abs() < 0.005, "floor at {x}, {y}");
        }
        for x in [2.6, 3.0, 3.7] {
            let height = covered(&ground, x, 1.0).unwrap();
            assert!((height - ramp * (x - 2.5)).abs() < 0.012, "ramp at {x}: {height}");
        }
    }

    #[test]
    fn a_table_top_and_a_wall_are_no_ground_but_the_floor_under_a_table_is() {
        let mut terrain = terrain();
        terrain.insert_points(field([30, 60], [-20, 20], |_, _| Some(0.0)));
        terrain.insert_points(field([40, 50], [-10, 10], |_, _| Some(0.75)));
        terrain
            .insert_points((0..4000).map(|i| Point::new(3.02, -1.0 + 0.0005 * f64::from(i), f64::from(i % 80) * 0.01)));
        let ground = terrain.ground();
        assert!(covered(&ground, 2.2, 0.0).unwrap().abs() < 0.005);
        assert_eq!(covered(&ground, 3.02, 0.0), None);
    }

    #[test]
    fn one_low_outlier_takes_over_no_cell_but_three_points_do() {
        let mut column = Column { key: [0, 0], bins: Vec::new(), seeds: 0, seeds_um: 0 };
        (0..20).for_each(|i| column.add(i * 100));
        column.add(-300_000);
        column.add(-250_000);
        assert!((column.lowest().unwrap().height_um - 950).abs() < 100);
        (0..3).for_each(|i| column.add(-100_000 + i * 1000));
        assert_eq!(column.lowest().unwrap().height_um, -99_000);
    }

    #[test]
    fn a_noisy_surface_is_its_mean() {
        let mut column = Column { key: [0, 0], bins: Vec::new(), seeds: 0, seeds_um: 0 };
        // A triangular noise of ±30 mm, with the tail that a lowest bin finds first.
        for i in -30i64..=30 {
            (0..31 - i.abs()).for_each(|_| column.add(42_000 + i * 1000));
        }
        let lowest = column.lowest().unwrap();
        assert!((lowest.height_um - 42_000).abs() < 2_000, "{lowest:?}");
        assert!(!lowest.upright);
    }

    #[test]
    fn the_robots_own_tilt_counts() {
        // On a slope of 10°, seen in the frame of a robot that stands on it and knows it.
        let mut terrain = Terrain::new(TerrainParams::default()).unwrap();
        terrain.note_robot(&Transform::from_xyz_rpy([0.0, 0.0, 1.0], [0.0, -10f64.to_radians(), 0.0]));
        terrain.insert_points(field([30, 60], [-10, 10], |x, _| Some(1.0 + 10f64.to_radians().tan() * x)));
        assert!((covered(&terrain.ground(), 2.02, 0.02).unwrap() - 1.356).abs() < 0.01);
        // The same by a robot that does not know its tilt: no cell is on its plane, the nearest within reach must do.
        terrain.note_robot(&Transform::from_xyz_rpy([0.0, 0.0, 1.0], [0.0; 3]));
        assert_eq!(terrain.ground().cells.len(), 600);
    }

    #[test]
    fn degenerate_points_do_no_harm() {
        let mut terrain = Terrain::new(TerrainParams { cells_max: 5, ..TerrainParams::default() }).unwrap();
        assert!(terrain.ground().cells.is_empty());
        terrain.note_robot(&Transform::from_xyz_rpy([f64::NAN, 0.0, 0.0], [0.0; 3]));
        let bad = [[f64::NAN, 0.0, 0.0], [1e300, 0.0, 0.0], [0.0, 0.0, f64::INFINITY], [0.0, -1e7, 0.0]];
        terrain.insert_points(bad.map(|p| Point::new(p[0], p[1], p[2])));
        assert_eq!((terrain.columns.len(), terrain.check()), (0, Ok(())));
        terrain.note_robot(&Transform::identity());
        terrain.insert_points([Point::new(1.0, 1.0, 0.0); 10]);
        assert_eq!(terrain.ground().cells, [([20, 20], 0)]);
        terrain.insert_points((0..20).map(|i| Point::new(f64::from(i), 0.0, 9999.0)));
        assert_eq!((terrain.columns.len(), terrain.refused_count(), terrain.check()), (5, 16, Ok(())));
        // A chimney: more levels than a cell keeps.
        terrain.insert_points((0..4000).rev().map(|i| Point::new(1.0, 1.0, f64::from(i) * 0.01)));
        assert_eq!(terrain.check(), Ok(()));
        assert_eq!(terrain.columns[0].bins.len(), BINS_MAX);
        assert_eq!(terrain.columns[0].bins[0].level, 0);
    }

    #[test]
    fn parameters_that_make_no_terrain_are_refused() {
        let bad = [
            TerrainParams { cell_m: 0.0, ..TerrainParams::default() },
            TerrainParams { error_m_max: f64::NAN, ..TerrainParams::default() },
            TerrainParams { slope_deg_max: 90.0, ..TerrainParams::default() },
            TerrainParams { gap_m_max: 1e9, ..TerrainParams::default() },
            TerrainParams { cells_max: 0, ..TerrainParams::default() },
        ];
        assert!(bad.into_iter().all(|params| Terrain::new(params).is_err()));
    }

    proptest! {
        #[test]
        fn the_order_of_points_does_not_matter(
            points in prop::collection::vec((-0.2..0.2f64, -0.2..0.2f64, -1.0..1.0f64), 0..400),
        ) {
            let points: Vec<Point<World>> = points.into_iter().map(|(x, y, z)| Point::new(x, y, z * z * z)).collect();
            let (mut there, mut back) = (terrain(), terrain());
            for part in points.chunks(50) {
                there.insert_points(part.iter().copied());
                prop_assert_eq!(there.check(), Ok(()));
            }
            back.insert_points(points.iter().rev().copied());
            prop_assert_eq!(digest(&there), digest(&back));
            prop_assert_eq!(there.ground(), back.ground());
        }

        #[test]
        fn a_cell_is_between_its_points(heights in prop::collection::vec(-2_000_000i64..2_000_000, 1..60)) {
            let mut column = Column { key: [0, 0], bins: Vec::new(), seeds: 0, seeds_um: 0 };
            heights.iter().for_each(|h| column.add(*h));
            if let Some(lowest) = column.lowest() {
                prop_assert!(lowest.height_um >= *heights.iter().min().unwrap());
                prop_assert!(lowest.height_um <= *heights.iter().max().unwrap());
            }
        }
    }
}
