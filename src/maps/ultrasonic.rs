//! The ultrasonic layer: log-odds of cells in the plane, by the cones of ranges. Its cells are the columns of the grid.

use std::collections::{BTreeMap, BTreeSet};

use super::cone::{Cone, ConeParams, evidence};
use super::grid::{Grid, State, UNSEEN};
use crate::fault::Fault;
use crate::geometry::{Transducer, Transform, World};
use crate::image::Drop;
use crate::ranges::RangeReading;

/// Cells along the side of a tile.
const TILE: usize = 16;
/// Cells of a tile.
const CELLS: usize = TILE * TILE;
/// A transducer that looks up or down more than this says nothing of the plane: sine and cosine of 45°.
const STEEP_COS: f64 = std::f64::consts::FRAC_1_SQRT_2;

/// Tiles of 16 x 16 cells, at least one of which is known, by their key: log-odds in thousandths at y·16 + x.
type Tiles = BTreeMap<[i32; 2], Box<[i16; CELLS]>>;

/// What ultrasonic ranges say of the plane.
#[derive(Clone, Debug)]
pub struct Ultrasonic {
    params: ConeParams,
    cell_m: f64,
    range: (i16, i16),
    extent_m_max: f64,
    tiles_max: usize,
    tiles: Tiles,
    frames: BTreeSet<String>,
    readings: u64,
    silent: u64,
    refused: u64,
}

impl Ultrasonic {
    /// A layer in which nothing is known, over a grid: with its cells, clamps and limits.
    pub(super) fn new(params: ConeParams, grid: &Grid) -> Self {
        let limits = grid.params();
        Self {
            params,
            cell_m: limits.voxel_m,
            range: grid.log_odds_range(),
            extent_m_max: limits.extent_m_max,
            tiles_max: limits.blocks_max,
            tiles: Tiles::new(),
            frames: BTreeSet::new(),
            readings: 0,
            silent: 0,
            refused: 0,
        }
    }

    /// Takes a reading of a transducer at a pose.
    ///
    /// # Errors
    /// A pose that is not finite (`BadPose`), or beyond what the grid takes (`OutOfRange`): nothing has changed then.
    pub(super) fn insert(
        &mut self,
        reading: &RangeReading,
        pose: &Transform<World, Transducer>,
    ) -> Result<(), (Drop, Fault)> {
        let at = |what: &str| format!("{}: {what}", reading.frame);
        if !pose.is_finite() {
            return Err((Drop::BadPose, Fault::new(at("pose"), format!("{pose:?}"), "finite numbers")));
        }
        let (place, axis) = (pose.xyz(), pose.rotate(&nalgebra::Vector3::x()));
        if !place.iter().all(|c| c.abs() <= self.extent_m_max) {
            let expected = format!("within {} m of the origin", self.extent_m_max);
            return Err((Drop::OutOfRange, Fault::new(at("place"), format!("{place:?}"), expected)));
        }
        let level = axis.x.hypot(axis.y);
        let said = match reading.range_m {
            Some(range_m) if level >= STEEP_COS => {
                let cone = Cone {
                    origin_m: [place.x, place.y],
                    bearing_rad: axis.y.atan2(axis.x),
                    view_rad: f64::from(reading.field_of_view_rad).min(std::f64::consts::PI),
                    range_m_min: f64::from(reading.range_m_min) * level,
                };
                evidence(&self.params, self.cell_m, &cone, f64::from(range_m) * level)
                    .map_err(|fault| (Drop::OutOfRange, fault))?
            }
            _ => Vec::new(),
        };
        self.frames.insert(reading.frame.clone());
        self.readings += 1;
        self.silent += u64::from(reading.range_m.is_none());
        for one in said {
            self.add(one.cell, one.log_odds);
        }
        Ok(())
    }

    fn add(&mut self, cell: [i32; 2], log_odds: i16) {
        let (key, at) = split(cell);
        let room = self.tiles.len() < self.tiles_max;
        let tile = match self.tiles.entry(key) {
            std::collections::btree_map::Entry::Occupied(tile) => tile.into_mut(),
            std::collections::btree_map::Entry::Vacant(place) if room => place.insert(Box::new([UNSEEN; CELLS])),
            std::collections::btree_map::Entry::Vacant(_) => {
                self.refused += 1;
                return;
            }
        };
        let before = if tile[at] == UNSEEN { 0 } else { tile[at] };
        tile[at] = before.saturating_add(log_odds).clamp(self.range.0, self.range.1);
    }

    /// Readings taken.
    pub fn readings(&self) -> u64 {
        self.readings
    }

    /// Readings without an echo: they say nothing.
    pub fn silent(&self) -> u64 {
        self.silent
    }

    /// Transducers that gave a reading.
    pub fn transducers(&self) -> usize {
        self.frames.len()
    }

    /// Updates of cells refused because the layer had as many tiles as the grid may have blocks.
    pub fn refused_count(&self) -> u64 {
        self.refused
    }

    /// The log-odds of a cell [thousandths], `UNSEEN` where nothing is known; cell (i, j) is column (i, j) of the grid.
    pub(super) fn log_odds(&self, cell: [i32; 2]) -> i16 {
        let (key, at) = split(cell);
        self.tiles.get(&key).map_or(UNSEEN, |tile| tile[at])
    }

    /// What is known of the cell over (x, y) in the world [m].
    pub fn state(&self, x_m: f64, y_m: f64) -> State {
        if !(x_m.abs() <= 2.0 * self.extent_m_max && y_m.abs() <= 2.0 * self.extent_m_max) {
            return State::Unknown;
        }
        State::of(self.log_odds([x_m, y_m].map(|c| (c / self.cell_m).floor() as i32)))
    }

    /// The lowest and the highest cell of all tiles.
    pub(super) fn bounds(&self) -> Option<[[i32; 2]; 2]> {
        let side = TILE as i32;
        let corners = self.tiles.keys().map(|key| [key.map(|c| c * side), key.map(|c| c * side + side - 1)]);
        corners.reduce(|[low, high], [l, h]| {
            [[low[0].min(l[0]), low[1].min(l[1])], [high[0].max(h[0]), high[1].max(h[1])]]
        })
    }

    /// Feeds everything that is known, in an order that does not depend on how it came to be.
    pub(super) fn digest_into(&self, feed: &mut impl FnMut(&[u8])) {
        for (key, tile) in &self.tiles {
            key.iter().for_each(|c| feed(&c.to_le_bytes()));
            let bytes: Vec<u8> = tile.iter().flat_map(|c| c.to_le_bytes()).collect();
            feed(&bytes);
        }
    }

    /// Checks what must always hold.
    pub fn check(&self) -> Result<(), String> {
        for (key, tile) in &self.tiles {
            if tile.iter().all(|c| *c == UNSEEN) {
                return Err(format!("tile {key:?} is empty"));
            }
            let (low, high) = self.range;
            if let Some(beyond) = tile.iter().find(|c| **c != UNSEEN && !(low..=high).contains(*c)) {
                return Err(format!("log-odds {beyond} in tile {key:?} are beyond the clamp"));
            }
        }
        if self.silent > self.readings || self.tiles.len() > self.tiles_max {
            return Err(format!("{} readings, {} silent, {} tiles", self.readings, self.silent, self.tiles.len()));
        }
        Ok(())
    }
}

/// The tile of a cell, and its index there.
fn split([x, y]: [i32; 2]) -> ([i32; 2], usize) {
    let side = TILE as i32;
    let within = |c: i32| c.rem_euclid(side) as usize;
    ([x.div_euclid(side), y.div_euclid(side)], within(y) * TILE + within(x))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::maps::GridParams;
    use crate::ranges::transducer_frame;
    use crate::time::Stamp;
    use proptest::prelude::*;

    /// A reading of a transducer for tests.
    pub(in crate::maps) fn reading(range_m: Option<f32>) -> RangeReading {
        RangeReading {
            stamp: Stamp(0),
            frame: transducer_frame(0),
            robot_from_transducer: Transform::identity(),
            field_of_view_rad: 30f32.to_radians(),
            range_m_min: 0.41,
            range_m_max: 10.7,
            range_m,
            odom_from_robot: Transform::identity(),
        }
    }

    fn layer(params: GridParams) -> Ultrasonic {
        Ultrasonic::new(ConeParams::default(), &Grid::new(params).unwrap())
    }

    #[test]
    fn a_range_frees_what_is_before_it_and_fills_its_arc() {
        let mut layer = layer(GridParams::default());
        assert_eq!((layer.bounds(), layer.state(1.0, 0.0)), (None, State::Unknown));
        layer.insert(&reading(Some(2.0)), &Transform::planar(0.0, 0.0, 0.0)).unwrap();
        assert_eq!(layer.state(1.0, 0.01), State::Free);
        assert_eq!(layer.state(2.01, 0.01), State::Occupied);
        assert_eq!(layer.state(2.2, 0.01), State::Unknown);
        assert_eq!(layer.state(0.3, 0.01), State::Unknown, "nearer than the module hears");
        assert_eq!(layer.state(1.0, 0.5), State::Unknown, "beside the cone");
        assert_eq!((layer.readings(), layer.silent(), layer.transducers()), (1, 0, 1));
        assert_eq!(layer.check(), Ok(()));
    }

    #[test]
    fn no_echo_and_a_look_at_the_floor_say_nothing() {
        let mut layer = layer(GridParams::default());
        layer.insert(&reading(None), &Transform::identity()).unwrap();
        layer.insert(&reading(Some(0.5)), &Transform::from_xyz_rpy([0.0; 3], [0.0, 1.2, 0.0])).unwrap();
        assert_eq!((layer.bounds(), layer.readings(), layer.silent()), (None, 2, 1));
        // 30° up: the range counts as it lies in the plane.
        layer.insert(&reading(Some(2.0)), &Transform::from_xyz_rpy([0.0; 3], [0.0, -30f64.to_radians(), 0.0])).unwrap();
        assert_eq!(layer.state(2.0 * 30f64.to_radians().cos(), 0.01), State::Occupied);
    }

    #[test]
    fn what_cannot_be_placed_changes_nothing() {
        let mut layer = layer(GridParams::default());
        for (pose, why) in [
            (Transform::planar(f64::NAN, 0.0, 0.0), Drop::BadPose),
            (Transform::planar(1e6, 0.0, 0.0), Drop::OutOfRange),
        ] {
            assert_eq!(layer.insert(&reading(Some(1.0)), &pose).unwrap_err().0, why);
        }
        assert_eq!((layer.readings(), layer.bounds(), layer.transducers()), (0, None, 0));
        assert_eq!(layer.state(f64::NAN, 1e300), State::Unknown);
    }

    #[test]
    fn a_full_layer_refuses_and_counts() {
        let mut layer = layer(GridParams { blocks_max: 2, ..GridParams::default() });
        layer.insert(&reading(Some(4.0)), &Transform::identity()).unwrap();
        assert!(layer.refused_count() > 10 && layer.check() == Ok(()));
        assert_eq!(layer.tiles.len(), 2);
    }

    proptest! {
        #[test]
        fn what_must_hold_holds_and_the_clamp_is_never_passed(
            shots in prop::collection::vec((-3.0..3.0f64, -3.0..3.0f64, -4.0..4.0f64, 0.41f32..4.0), 0..40),
        ) {
            let mut layer = layer(GridParams { voxel_m: 0.1, ..GridParams::default() });
            for (x, y, yaw, range) in &shots {
                layer.insert(&reading(Some(*range)), &Transform::planar(*x, *y, *yaw)).unwrap();
                prop_assert_eq!(layer.check(), Ok(()));
            }
            prop_assert_eq!(layer.readings(), shots.len() as u64);
        }
    }
}
