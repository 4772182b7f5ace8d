//! 3D occupancy: integer log-odds in hashed blocks; what no line of sight has touched is unknown, not free.

use std::collections::BTreeSet;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::key::{HALF, KeyMap, pack};
use super::ray::{Marks, traverse};
use crate::fault::{Result, number_within};
use crate::geometry::{Point, World};
use crate::image::{Drop, Dropped};
use crate::points::Profile;

/// Voxels along the side of a block.
pub const BLOCK: usize = 8;
/// Voxels of a block.
const CELLS: usize = BLOCK * BLOCK * BLOCK;
/// The log-odds of a voxel that was never seen.
pub(super) const UNSEEN: i16 = i16::MIN;
/// A free ray ends at most this many voxels before its point, however flat it comes in.
const GAP_VOXELS_MAX: f64 = 8.0;

/// How the occupancy grid is kept. The sensor model is OctoMap's default.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GridParams {
    /// Side of a voxel [m].
    pub voxel_m: f64,
    /// Log-odds that a hit adds.
    pub hit: f64,
    /// Log-odds that a line of sight through the voxel adds (negative).
    pub miss: f64,
    /// Log-odds are never less.
    pub log_odds_min: f64,
    /// Log-odds are never more.
    pub log_odds_max: f64,
    /// A line of sight claims free space only down to this many voxels above (or below) the point it ends on: rays that
    /// graze a floor would otherwise wipe out the floor just before their point. 0 frees all up to the point's voxel.
    pub free_gap_voxels: f64,
    /// Points farther than this from the camera or the laser are not used [m].
    pub ray_m_max: f64,
    /// Points with a coordinate beyond this are not used [m].
    pub extent_m_max: f64,
    /// The map grows to this many blocks of 8 x 8 x 8 voxels (1 KiB each), then refuses new ones.
    pub blocks_max: usize,
}

impl Default for GridParams {
    fn default() -> Self {
        Self {
            voxel_m: 0.05,
            hit: 0.85,
            miss: -0.4,
            log_odds_min: -2.0,
            log_odds_max: 3.5,
            free_gap_voxels: 1.5,
            ray_m_max: 20.0,
            extent_m_max: 1000.0,
            blocks_max: 1 << 20,
        }
    }
}

impl GridParams {
    /// Refuses values that make no map.
    pub fn validated(self) -> Result<Self> {
        number_within("grid.voxel_m", self.voxel_m, 0.005, 10.0)?;
        number_within("grid.hit", self.hit, 0.001, 10.0)?;
        number_within("grid.miss", self.miss, -10.0, -0.001)?;
        number_within("grid.log_odds_min", self.log_odds_min, -20.0, -0.001)?;
        number_within("grid.log_odds_max", self.log_odds_max, 0.001, 20.0)?;
        number_within("grid.free_gap_voxels", self.free_gap_voxels, 0.0, GAP_VOXELS_MAX)?;
        number_within("grid.ray_m_max", self.ray_m_max, self.voxel_m, 1000.0)?;
        // Keys of blocks must fit in 21 bits.
        let extent_m_max = (f64::from(HALF - 1) * BLOCK as f64 * self.voxel_m).min(1e5);
        number_within("grid.extent_m_max", self.extent_m_max, 1.0, extent_m_max)?;
        number_within("grid.blocks_max", self.blocks_max as f64, 1.0, f64::from(u32::MAX))?;
        Ok(self)
    }
}

/// What is known of a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum State {
    /// No line of sight came here.
    Unknown,
    /// More likely empty.
    Free,
    /// More likely a surface: log-odds above 0.
    Occupied,
}

impl State {
    pub(super) fn of(log_odds: i16) -> Self {
        match log_odds {
            UNSEEN => Self::Unknown,
            1.. => Self::Occupied,
            _ => Self::Free,
        }
    }
}

/// 8 x 8 x 8 voxels, at least one of which is known.
#[derive(Clone)]
pub struct Block {
    /// Its place: voxel (0, 0, 0) of the block has the key 8·`key`.
    pub key: [i32; 3],
    /// Log-odds in thousandths at x·64 + y·8 + z.
    cells: Box<[i16; CELLS]>,
}

impl Block {
    /// The states of the eight voxels of column (x, y) of the block, from the lowest; x and y are taken modulo 8.
    pub fn column(&self, x: usize, y: usize) -> [State; BLOCK] {
        let at = (x % BLOCK * BLOCK + y % BLOCK) * BLOCK;
        std::array::from_fn(|z| State::of(self.cells[at + z]))
    }

    /// The log-odds of the same voxels in thousandths, `UNSEEN` where they are unknown.
    pub(super) fn log_odds(&self, x: usize, y: usize) -> &[i16] {
        let at = (x % BLOCK * BLOCK + y % BLOCK) * BLOCK;
        &self.cells[at..at + BLOCK]
    }

    /// The key of a voxel from its index in `cells`.
    fn voxel(&self, at: usize) -> [i32; 3] {
        let within = [at / (BLOCK * BLOCK), at / BLOCK % BLOCK, at % BLOCK];
        std::array::from_fn(|axis| self.key[axis] * BLOCK as i32 + within[axis] as i32)
    }
}

/// The occupancy grid. Voxel (i, j, k) reaches from (i, j, k) to (i+1, j+1, k+1) times `voxel_m` in the world.
pub struct Grid {
    params: GridParams,
    hit: i16,
    miss: i16,
    range: (i16, i16),
    index: KeyMap<u32>,
    blocks: Vec<Block>,
    marks: Marks,
    /// Groups of 2 x 2 x 2 blocks in which a voxel became or ceased to be occupied: what a viewer must draw again.
    dirty: BTreeSet<[i32; 3]>,
    occupied: u64,
    free: u64,
    refused: u64,
}

impl Grid {
    /// An empty grid; an error where the parameters make none.
    pub fn new(params: GridParams) -> Result<Self> {
        let params = params.validated()?;
        let thousandths = |log_odds: f64| (log_odds * 1000.0).round() as i16;
        Ok(Self {
            hit: thousandths(params.hit),
            miss: thousandths(params.miss),
            range: (thousandths(params.log_odds_min), thousandths(params.log_odds_max)),
            params,
            index: KeyMap::default(),
            blocks: Vec::new(),
            marks: Marks::default(),
            dirty: BTreeSet::new(),
            occupied: 0,
            free: 0,
            refused: 0,
        })
    }

    /// What it was made with.
    pub fn params(&self) -> &GridParams {
        &self.params
    }

    /// What one line of sight adds to a log-odds [thousandths].
    pub(super) fn miss(&self) -> i16 {
        self.miss
    }

    /// Between which log-odds stay [thousandths].
    pub(super) fn log_odds_range(&self) -> (i16, i16) {
        self.range
    }

    /// Takes one capture: each point's voxel is hit, the lines from the camera and (where it is known) from the laser
    /// are free. A voxel is updated at most once a capture, and a hit wins.
    ///
    /// Returns what was not used: points that are not finite (`NoPoint`), and points too far away (`OutOfRange`).
    pub fn insert(&mut self, profile: &Profile<World>) -> Dropped {
        let both = [profile.eye.xyz, profile.sheet.origin.xyz];
        self.insert_points(Self::origins(profile, &both), profile.points.iter().map(|p| p.point.xyz))
    }

    /// Takes the points of one capture [m], each seen along a free line from every one of `origins` [m].
    pub fn insert_points(
        &mut self,
        origins: &[Vector3<f64>],
        points: impl IntoIterator<Item = Vector3<f64>>,
    ) -> Dropped {
        let mut dropped = Dropped::default();
        self.marks.clear();
        for point in points {
            if let Err(why) = self.usable(origins, &point) {
                dropped.add(why);
                continue;
            }
            let end = self.voxels_of(&point);
            self.marks.hit(end.map(|c| c.floor() as i32));
            for origin in origins {
                if let Some(free_to) = self.free_end(origin, &point) {
                    let (from, to) = (self.voxels_of(origin), self.voxels_of(&free_to));
                    traverse(from, to, |voxel| self.marks.free(voxel));
                }
            }
        }
        self.apply_marks();
        dropped
    }

    /// What is known at a point.
    pub fn state(&self, point: Point<World>) -> State {
        if !point.xyz.iter().all(|c| c.abs() <= self.params.extent_m_max) {
            return State::Unknown;
        }
        self.state_of(self.voxels_of(&point.xyz).map(|c| c.floor() as i32))
    }

    /// What is known of a voxel.
    pub fn state_of(&self, voxel: [i32; 3]) -> State {
        let key = voxel.map(|c| c.div_euclid(BLOCK as i32));
        if !key.iter().all(|c| (-HALF..HALF).contains(c)) {
            return State::Unknown;
        }
        let Some(at) = self.index.get(&pack(key)) else { return State::Unknown };
        let [x, y, z] = voxel.map(|c| c as usize % BLOCK);
        State::of(self.blocks[*at as usize].cells[(x * BLOCK + y) * BLOCK + z])
    }

    /// The middle of a voxel [m].
    pub fn centre(&self, voxel: [i32; 3]) -> Point<World> {
        let [x, y, z] = voxel.map(|c| (f64::from(c) + 0.5) * self.params.voxel_m);
        Point::new(x, y, z)
    }

    /// All blocks in the order of their keys.
    pub fn blocks(&self) -> Vec<&Block> {
        let mut blocks: Vec<_> = self.blocks.iter().collect();
        blocks.sort_unstable_by_key(|block| block.key);
        blocks
    }

    /// The keys of all occupied voxels: blocks in order, and voxels in order within each.
    pub fn occupied(&self) -> impl Iterator<Item = [i32; 3]> {
        self.voxels(State::Occupied)
    }

    /// The keys of all free voxels: blocks in order, and voxels in order within each.
    pub fn free(&self) -> impl Iterator<Item = [i32; 3]> {
        self.voxels(State::Free)
    }

    /// How many voxels are occupied.
    pub fn occupied_count(&self) -> u64 {
        self.occupied
    }

    /// How many voxels are free.
    pub fn free_count(&self) -> u64 {
        self.free
    }

    /// How many updates of voxels were refused because the map had `blocks_max` blocks.
    pub fn refused_count(&self) -> u64 {
        self.refused
    }

    /// Memory of the map [bytes].
    pub fn bytes(&self) -> usize {
        let block = size_of::<Block>() + size_of::<[i16; CELLS]>();
        self.blocks.len() * block + self.index.capacity() * (size_of::<(u64, u32)>() + 1)
    }

    /// Feeds everything that is known, in an order that does not depend on how it came to be.
    pub fn digest_into(&self, feed: &mut impl FnMut(&[u8])) {
        feed(&self.params.voxel_m.to_le_bytes());
        for block in self.blocks() {
            block.key.iter().for_each(|c| feed(&c.to_le_bytes()));
            let bytes: Vec<u8> = block.cells.iter().flat_map(|c| c.to_le_bytes()).collect();
            feed(&bytes);
        }
    }

    /// The groups of blocks whose occupied voxels changed since this was last asked: their key (a group is 16 voxels
    /// wide), and the centres of all voxels now occupied in each [m].
    pub fn take_changes(&mut self) -> Vec<([i32; 3], Vec<[f32; 3]>)> {
        std::mem::take(&mut self.dirty).into_iter().map(|group| (group, self.occupied_in(group))).collect()
    }

    /// Checks what must always hold.
    pub fn check(&self) -> std::result::Result<(), String> {
        let (mut occupied, mut free) = (0, 0);
        for (at, block) in self.blocks.iter().enumerate() {
            if self.index.get(&pack(block.key)).copied() != Some(at as u32) {
                return Err(format!("block {:?} is not in the index", block.key));
            }
            let before = occupied + free;
            for log_odds in block.cells.iter().copied() {
                match State::of(log_odds) {
                    State::Unknown => continue,
                    State::Free => free += 1,
                    State::Occupied => occupied += 1,
                }
                if !(self.range.0..=self.range.1).contains(&log_odds) {
                    return Err(format!("log-odds {log_odds} in block {:?} are beyond the clamp", block.key));
                }
            }
            if occupied + free == before {
                return Err(format!("block {:?} is empty", block.key));
            }
        }
        if (occupied, free) != (self.occupied, self.free) {
            let counted = (self.occupied, self.free);
            return Err(format!("{occupied} occupied and {free} free, but counted {counted:?}"));
        }
        if self.index.len() != self.blocks.len() || self.blocks.len() > self.params.blocks_max {
            return Err(format!("{} blocks, {} in the index", self.blocks.len(), self.index.len()));
        }
        Ok(())
    }

    fn voxels_of(&self, point: &Vector3<f64>) -> [f64; 3] {
        [point.x / self.params.voxel_m, point.y / self.params.voxel_m, point.z / self.params.voxel_m]
    }

    /// Whether `insert` uses a point of a profile.
    pub(super) fn takes(&self, profile: &Profile<World>, point: Point<World>) -> bool {
        self.usable(Self::origins(profile, &[profile.eye.xyz, profile.sheet.origin.xyz]), &point.xyz).is_ok()
    }

    /// Where the known lines of sight of a profile start, of camera and laser.
    fn origins<'a>(profile: &Profile<World>, both: &'a [Vector3<f64>; 2]) -> &'a [Vector3<f64>] {
        if profile.knows_laser_origin { both } else { &both[..1] }
    }

    fn usable(&self, origins: &[Vector3<f64>], point: &Vector3<f64>) -> Result<(), Drop> {
        if !origins.iter().chain([point]).all(|p| p.iter().all(|c| c.is_finite())) {
            return Err(Drop::NoPoint);
        }
        let far = |p: &Vector3<f64>| p.amax() > self.params.extent_m_max;
        if far(point) || origins.iter().any(|o| far(o) || (point - o).norm() > self.params.ray_m_max) {
            return Err(Drop::OutOfRange);
        }
        Ok(())
    }

    /// Where the free part of a line of sight ends; `None` if nothing of it is left.
    fn free_end(&self, origin: &Vector3<f64>, point: &Vector3<f64>) -> Option<Vector3<f64>> {
        let ray = point - origin;
        let length = ray.norm();
        let gap = self.params.free_gap_voxels * self.params.voxel_m;
        let climb = ray.z.abs() / length;
        let back = (gap / climb).clamp(gap, GAP_VOXELS_MAX * self.params.voxel_m);
        // `back` is NaN for a ray of no length.
        (back <= length).then(|| point - ray * (back / length))
    }

    fn apply_marks(&mut self) {
        let mut marks = std::mem::take(&mut self.marks);
        for marked in marks.sorted() {
            let at = match self.index.get(&marked.packed) {
                Some(at) => *at as usize,
                None if self.blocks.len() < self.params.blocks_max => {
                    self.index.insert(marked.packed, self.blocks.len() as u32);
                    self.blocks.push(Block { key: marked.key, cells: Box::new([UNSEEN; CELLS]) });
                    self.blocks.len() - 1
                }
                None => {
                    let updates = marked.free.iter().zip(&marked.hit).map(|(free, hit)| (free | hit).count_ones());
                    self.refused += u64::from(updates.sum::<u32>());
                    continue;
                }
            };
            for x in 0..BLOCK {
                self.update(at, x, marked.hit[x], self.hit);
                self.update(at, x, marked.free[x] & !marked.hit[x], self.miss);
            }
        }
        self.marks = marks;
    }

    /// Adds `change` to every voxel of slice `x` of a block whose bit is set.
    fn update(&mut self, block: usize, x: usize, mut bits: u64, change: i16) {
        let block = &mut self.blocks[block];
        while bits != 0 {
            let at = x * BLOCK * BLOCK + bits.trailing_zeros() as usize;
            bits &= bits - 1;
            let before = block.cells[at];
            let after = (if before == UNSEEN { 0 } else { before } + change).clamp(self.range.0, self.range.1);
            block.cells[at] = after;
            let (was, is) = (State::of(before), State::of(after));
            if was != is {
                let counts = |state| (u64::from(state == State::Occupied), u64::from(state == State::Free));
                self.occupied = self.occupied + counts(is).0 - counts(was).0;
                self.free = self.free + counts(is).1 - counts(was).1;
                if was == State::Occupied || is == State::Occupied {
                    self.dirty.insert(block.key.map(|c| c >> 1));
                }
            }
        }
    }

    fn voxels(&self, state: State) -> impl Iterator<Item = [i32; 3]> {
        self.blocks().into_iter().flat_map(move |block| {
            let known = block.cells.iter().enumerate().filter(move |(_, c)| State::of(**c) == state);
            known.map(move |(at, _)| block.voxel(at))
        })
    }

    fn occupied_in(&self, group: [i32; 3]) -> Vec<[f32; 3]> {
        let mut centres = Vec::new();
        for part in 0..8 {
            let key = std::array::from_fn(|axis| group[axis] * 2 + (part >> (2 - axis) & 1));
            let Some(at) = self.index.get(&pack(key)) else { continue };
            let block = &self.blocks[*at as usize];
            for (at, _) in block.cells.iter().enumerate().filter(|(_, c)| State::of(**c) == State::Occupied) {
                let centre = self.centre(block.voxel(at)).xyz;
                centres.push([centre.x as f32, centre.y as f32, centre.z as f32]);
            }
        }
        centres
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand_like::Noise;

    /// A small seeded generator: tests need noise, not a dependency.
    mod rand_like {
        pub struct Noise(pub u64);
        impl Noise {
            pub fn unit(&mut self) -> f64 {
                self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (self.0 >> 11) as f64 / (1u64 << 53) as f64
            }
            pub fn gauss(&mut self) -> f64 {
                (0..12).map(|_| self.unit()).sum::<f64>() - 6.0
            }
        }
    }

    fn grid() -> Grid {
        Grid::new(GridParams::default()).unwrap()
    }

    fn digest(grid: &Grid) -> Vec<u8> {
        let mut all = Vec::new();
        grid.digest_into(&mut |bytes| all.extend_from_slice(bytes));
        all
    }

    fn vectors(points: &[[f64; 3]]) -> Vec<Vector3<f64>> {
        points.iter().map(|p| Vector3::from(*p)).collect()
    }

    type Capture = ([f64; 3], Vec<[f64; 3]>);

    fn captures() -> impl Strategy<Value = Vec<Capture>> {
        let point = || prop::array::uniform3(-2.0..2.0f64);
        prop::collection::vec((point(), prop::collection::vec(point(), 0..20)), 0..6)
    }

    proptest! {
        #[test]
        fn what_must_hold_holds_after_each_capture(captures in captures()) {
            let mut grid = Grid::new(GridParams { blocks_max: 40, ..GridParams::default() }).unwrap();
            for (origin, points) in &captures {
                grid.insert_points(&vectors(&[*origin]), vectors(points));
                prop_assert_eq!(grid.check(), Ok(()));
            }
            prop_assert_eq!(grid.occupied().count() as u64, grid.occupied_count());
            prop_assert_eq!(grid.free().count() as u64, grid.free_count());
            for voxel in grid.occupied() {
                prop_assert_eq!(grid.state(grid.centre(voxel)), State::Occupied);
            }
        }

        #[test]
        fn the_order_of_points_and_of_captures_does_not_matter_short_of_the_clamp(captures in captures()) {
            let wide = GridParams { log_odds_min: -20.0, log_odds_max: 20.0, ..GridParams::default() };
            let (mut there, mut back) = (Grid::new(wide).unwrap(), Grid::new(wide).unwrap());
            for (origin, points) in &captures {
                there.insert_points(&vectors(&[*origin]), vectors(points));
            }
            for (origin, points) in captures.iter().rev() {
                back.insert_points(&vectors(&[*origin]), vectors(points).into_iter().rev());
            }
            prop_assert_eq!(digest(&there), digest(&back));
        }

        #[test]
        fn a_hit_wins_and_counts_once(origin in prop::array::uniform3(-2.0..2.0f64), point in prop::array::uniform3(-2.0..2.0f64)) {
            let mut grid = Grid::new(GridParams { free_gap_voxels: 0.0, ..GridParams::default() }).unwrap();
            grid.insert_points(&vectors(&[origin]), vectors(&[point; 5]));
            prop_assert_eq!(grid.state(Point::new(point[0], point[1], point[2])), State::Occupied);
            let logs: BTreeSet<i16> = grid.blocks.iter().flat_map(|b| b.cells.iter().copied()).collect();
            prop_assert!(logs.iter().all(|l| [UNSEEN, 850, -400].contains(l)), "{logs:?}");
            prop_assert_eq!(grid.occupied_count(), 1);
        }
    }

    #[test]
    fn both_lines_of_sight_are_free_and_all_else_is_unknown() {
        let mut grid = grid();
        let (eye, laser) = (Vector3::new(0.025, 0.025, 1.025), Vector3::new(0.025, 0.025, 0.525));
        grid.insert_points(&[eye, laser], [Vector3::new(1.025, 0.025, 0.025)]);
        assert_eq!(grid.state(Point::new(1.025, 0.025, 0.025)), State::Occupied);
        for origin in [eye, laser] {
            let half = (origin + Vector3::new(1.025, 0.025, 0.025)) / 2.0;
            assert_eq!(grid.state(half.into()), State::Free);
            assert_eq!(grid.state(origin.into()), State::Free);
        }
        assert_eq!(grid.state(Point::new(1.125, 0.025, 0.025)), State::Unknown); // behind the point
        assert_eq!(grid.state(Point::new(0.5, 0.225, 0.5)), State::Unknown); // beside the rays
    }

    #[test]
    fn what_went_away_is_free_again() {
        let mut grid = grid();
        let eye = [Vector3::new(0.0, 0.0, 1.0)];
        let near = Vector3::new(1.0, 0.01, 0.5);
        for _ in 0..20 {
            grid.insert_points(&eye, [near]);
        }
        assert_eq!(grid.state(near.into()), State::Occupied);
        for _ in 0..20 {
            grid.insert_points(&eye, [eye[0] + (near - eye[0]) * 1.9]);
        }
        assert_eq!(grid.state(near.into()), State::Free);
        assert_eq!(grid.check(), Ok(()));
    }

    #[test]
    fn bad_points_are_counted_and_change_nothing() {
        let mut grid = grid();
        let eye = [Vector3::new(0.0, 0.0, 1.0)];
        let bad = [[f64::NAN, 0.0, 0.0], [0.0, f64::INFINITY, 0.0], [1e300, 0.0, 0.0], [0.0, 0.0, -25.0]];
        let dropped = grid.insert_points(&eye, vectors(&bad));
        assert_eq!(dropped.0[&Drop::NoPoint], 2);
        assert_eq!(dropped.0[&Drop::OutOfRange], 2);
        let dropped = grid.insert_points(&vectors(&[[f64::NAN; 3]]), vectors(&[[1.0, 0.0, 0.0]]));
        assert_eq!(dropped.0[&Drop::NoPoint], 1);
        let far_away = vectors(&[[1e6, 0.0, 0.0]]);
        assert_eq!(grid.insert_points(&far_away, far_away.clone()).0[&Drop::OutOfRange], 1);
        assert_eq!(grid.insert_points(&eye, []), Dropped::default());
        assert_eq!((grid.blocks().len(), grid.occupied_count(), grid.free_count()), (0, 0, 0));
        assert_eq!(grid.state(Point::new(f64::NAN, 1e300, 0.0)), State::Unknown);
        assert_eq!(grid.state_of([i32::MAX, i32::MIN, 0]), State::Unknown);
        // A point at the camera itself: a hit, no line of sight.
        grid.insert_points(&eye, eye);
        assert_eq!((grid.occupied_count(), grid.free_count(), grid.check()), (1, 0, Ok(())));
    }

    #[test]
    fn a_full_map_refuses_and_counts() {
        let mut grid = Grid::new(GridParams { blocks_max: 3, ..GridParams::default() }).unwrap();
        grid.insert_points(&[Vector3::zeros()], [Vector3::new(10.0, 0.0, 0.0)]);
        assert_eq!(grid.blocks().len(), 3);
        assert!(grid.refused_count() > 100);
        assert_eq!(grid.check(), Ok(()));
    }

    #[test]
    fn parameters_that_make_no_map_are_refused() {
        let bad = [
            GridParams { voxel_m: 0.0, ..GridParams::default() },
            GridParams { voxel_m: f64::NAN, ..GridParams::default() },
            GridParams { hit: -1.0, ..GridParams::default() },
            GridParams { miss: 0.4, ..GridParams::default() },
            GridParams { log_odds_max: 1e9, ..GridParams::default() },
            GridParams { blocks_max: 0, ..GridParams::default() },
            GridParams { extent_m_max: 1e9, ..GridParams::default() },
        ];
        assert!(bad.into_iter().all(|params| Grid::new(params).is_err()));
    }

    #[test]
    fn changes_name_each_group_once_with_all_it_holds() {
        let mut grid = grid();
        let eye = [Vector3::new(0.0, 0.0, 1.0)];
        grid.insert_points(&eye, vectors(&[[0.1, 0.1, 0.1], [0.5, 0.1, 0.1], [-0.1, 0.1, 0.1]]));
        let changes = grid.take_changes();
        assert_eq!(
            changes.iter().map(|(key, centres)| (*key, centres.len())).collect::<Vec<_>>(),
            [([-1, 0, 0], 1), ([0, 0, 0], 2),]
        );
        assert!(grid.take_changes().is_empty());
        grid.insert_points(&eye, vectors(&[[0.1, 0.1, 0.1]])); // more certain, but nothing to draw again
        assert!(grid.take_changes().is_empty());
    }

    /// Sweeps a floor at `floor_m` and a thin pole like METRO-I does: mirror at 0.77 m, camera at 1.03 m and 0.16 m ahead.
    /// Returns the grid, and all true points that were hit.
    fn sweep(
        params: GridParams,
        floor_m: f64,
        pole: Option<([f64; 2], f64)>,
        pulses: usize,
    ) -> (Grid, Vec<Vector3<f64>>) {
        let mut grid = Grid::new(params).unwrap();
        let mut noise = Noise(7);
        let (eye, laser) = (Vector3::new(0.165, 0.0, 1.032), Vector3::new(0.0, 0.0, 0.770));
        let mut truth = Vec::new();
        for pulse in (0..230).step_by(pulses) {
            let beam = 0.197 + f64::from(pulse as u32) * std::f64::consts::TAU / 4000.0;
            let mut points = Vec::new();
            for column in 0..512 {
                let bearing = (f64::from(column) - 255.5) / 512.0 * 0.48;
                let slope = beam.tan() * bearing.cos(); // the sheet is a plane that holds the robot's y axis
                let mut range = (laser.z - floor_m) / slope;
                if let Some(([x, y], radius)) = pole {
                    let along = x * bearing.cos() + y * bearing.sin();
                    let aside = (y * bearing.cos() - x * bearing.sin()).abs();
                    if aside < radius && along - radius < range {
                        range = along - (radius * radius - aside * aside).sqrt();
                    }
                }
                let at = Vector3::new(range * bearing.cos(), range * bearing.sin(), laser.z - range * slope);
                let down = (eye.z - at.z) / (at - eye).norm();
                if !(0.273..=0.639).contains(&down) {
                    continue; // depression 15.8° to 39.7°
                }
                truth.push(at);
                points.push(at + (at - eye).normalize() * noise.gauss() * 3e-3);
            }
            grid.insert_points(&[eye, laser], points);
        }
        assert_eq!(grid.check(), Ok(()));
        (grid, truth)
    }

    /// The share of voxels with at least 3 true points that have an occupied one as near as a diagonal.
    fn recall(grid: &Grid, truth: &[Vector3<f64>], reach: i32) -> f64 {
        let mut seen = std::collections::BTreeMap::<[i32; 3], u32>::new();
        for point in truth {
            *seen.entry(grid.voxels_of(point).map(|c| c.floor() as i32)).or_default() += 1;
        }
        seen.retain(|_, count| *count >= 3);
        let near = |v: &[i32; 3]| {
            let side = -reach..=reach;
            side.clone().any(|x| {
                side.clone()
                    .any(|y| side.clone().any(|z| grid.state_of([v[0] + x, v[1] + y, v[2] + z]) == State::Occupied))
            })
        };
        seen.keys().filter(|v| near(v)).count() as f64 / seen.len() as f64
    }

    #[test]
    fn grazing_rays_do_not_wipe_out_the_floor() {
        for floor_mm in [-40, -20, 0, 10, 25, 45] {
            for pulses in [1, 3] {
                let floor_m = f64::from(floor_mm) * 1e-3;
                let (grid, truth) = sweep(GridParams::default(), floor_m, None, pulses);
                let (exact, near) = (recall(&grid, &truth, 0), recall(&grid, &truth, 1));
                let bare = sweep(GridParams { free_gap_voxels: 0.0, ..GridParams::default() }, floor_m, None, pulses).0;
                eprintln!(
                    "floor {floor_mm} mm, every {pulses}: {exact:.4} {near:.4}, bare {:.4} {:.4}",
                    recall(&bare, &truth, 0),
                    recall(&bare, &truth, 1)
                );
                assert!(near > 0.999 && exact > 0.9, "floor at {floor_mm} mm: {near}, {exact}");
            }
        }
    }

    #[test]
    fn a_thin_pole_stands() {
        for x_mm in [1500, 2000, 2525, 2990] {
            let at = [f64::from(x_mm) * 1e-3, 0.1];
            let (grid, truth) = sweep(GridParams::default(), 0.0, Some((at, 0.015)), 3);
            let on_pole: Vec<_> = truth.iter().copied().filter(|p| p.z > 0.05).collect();
            let near = recall(&grid, &on_pole, 1);
            eprintln!("pole at {x_mm} mm: {} points, {:.4} {near:.4}", on_pole.len(), recall(&grid, &on_pole, 0));
            assert!(near > 0.99, "pole at {x_mm} mm: {near}");
        }
    }
}
