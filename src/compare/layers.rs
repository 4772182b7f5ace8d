//! The maps that each sensor made, and both together, against what the robot could have seen.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};

use super::stage::{Stage, V3};
use crate::fault::{Fault, Result};
use crate::geometry::{Robot, Transform, World};
use crate::maps::PlanView;

/// Rays from each place the robot was at.
const RAYS: usize = 240;
/// At these heights over the floor [m]: a low step, a bin, the ring, and what is higher.
const HEIGHTS_M: [f64; 4] = [0.08, 0.25, 0.4, 0.7];
/// Most cells along a side of what was seen.
const SIDE_MAX: usize = 4000;
/// Cells of a plan view from here on are occupied.
const OCCUPIED: i8 = 50;

/// The cells that rays from the robot's way reach: what any sensor there could have known.
pub(super) struct Reach {
    cell_m: f64,
    low: [i32; 2],
    size: [usize; 2],
    /// 0 not reached, 1 crossed, 2 ends on a surface.
    cells: Vec<u8>,
    height_m: f64,
}

impl Reach {
    /// Nothing reached yet in the part of the world about the robot's way.
    pub fn new(cell_m: f64, from_m: [f64; 2], to_m: [f64; 2], height_m: f64) -> Self {
        let low = from_m.map(|v| (v / cell_m).floor() as i32);
        let side = |axis: usize| (((to_m[axis] - from_m[axis]) / cell_m).ceil().max(1.0) as usize + 1).min(SIDE_MAX);
        let size = [side(0), side(1)];
        Self { cell_m, low, size, cells: vec![0; size[0] * size[1]], height_m }
    }

    fn index(&self, at: &V3) -> Option<usize> {
        let cell = |axis: usize| {
            let key = (at[axis] / self.cell_m).floor() as i64 - i64::from(self.low[axis]);
            usize::try_from(key).ok().filter(|k| *k < self.size[axis])
        };
        Some(cell(1)? * self.size[0] + cell(0)?)
    }

    /// Looks around from where the robot is.
    pub fn look(&mut self, stage: &Stage, world_from_robot: &Transform<World, Robot>) {
        let foot = world_from_robot.xyz();
        let range_m = stage.params.range_m;
        for height in HEIGHTS_M {
            let from = V3::new(foot.x, foot.y, foot.z + height);
            for ray in 0..RAYS {
                let (sin, cos) = (std::f64::consts::TAU * ray as f64 / RAYS as f64).sin_cos();
                let way = V3::new(cos, sin, 0.0);
                let hit = stage.obstacles.cast(from.into(), &way, range_m).map(|hit| hit.range_m);
                let end = hit.unwrap_or(range_m);
                for step in 0..(end / self.cell_m) as usize {
                    if let Some(at) = self.index(&(from + way * (step as f64 * self.cell_m))) {
                        self.cells[at] = self.cells[at].max(1);
                    }
                }
                if let Some(at) = hit.and_then(|range| self.index(&(from + way * range))) {
                    self.cells[at] = 2;
                }
            }
        }
    }

    /// The truth of what was reached: 100 occupied, 0 free, −1 not reached.
    pub fn truth(&self, stage: &Stage) -> PlanView {
        let corner = |i: usize| {
            [(i % self.size[0]) as i32 + self.low[0], (i / self.size[0]) as i32 + self.low[1]]
                .map(|k| f64::from(k) * self.cell_m)
        };
        let state = |i: usize| {
            let [x, y] = corner(i);
            match self.cells[i] {
                0 => -1,
                2 => 100,
                _ if stage.occupied([x, y], [x + self.cell_m, y + self.cell_m], self.height_m) => 100,
                _ => 0,
            }
        };
        PlanView {
            resolution_m: self.cell_m,
            origin_m: self.low.map(|k| f64::from(k) * self.cell_m),
            width: self.size[0],
            height: self.size[1],
            cells: (0..self.cells.len()).map(state).collect(),
        }
    }
}

/// A map against the truth; shares are `None` where there was nothing to share.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapScore {
    /// Occupied cells found, over these, occupied cells missed and cells wrongly called occupied; a cell is right where the
    /// other map has one as near as a neighbour, also diagonally.
    pub iou: Option<f64>,
    /// Share of cells called occupied that are.
    pub precision: Option<f64>,
    /// Share of occupied cells that are called so.
    pub recall: Option<f64>,
    /// Share of occupied cells that are called free: what the robot would run into.
    pub called_free: Option<f64>,
    /// Share of free cells that are called occupied: where it would not dare to go.
    pub called_occupied: Option<f64>,
    /// Share of free cells that are called free.
    pub free_found: Option<f64>,
}

/// How well a map fits the truth, over the cells that were reached.
pub(super) fn score(map: &PlanView, truth: &PlanView) -> MapScore {
    let at = |view: &PlanView, [x, y]: [i64; 2]| -> i8 {
        let inside = |k: i64, size: usize| usize::try_from(k).ok().filter(|k| *k < size);
        match (inside(x, view.width), inside(y, view.height)) {
            (Some(x), Some(y)) => view.cells.get(y * view.width + x).copied().unwrap_or(-1),
            _ => -1,
        }
    };
    // Both have cells of one grid: whole cells lie between their origins.
    let shift: [i64; 2] =
        std::array::from_fn(|axis| ((truth.origin_m[axis] - map.origin_m[axis]) / truth.resolution_m).round() as i64);
    let [mut found, mut missed, mut wrong, mut right] = [0_u64; 4];
    let [mut run_into, mut free, mut blocked, mut open] = [0_u64; 4];
    for y in 0..truth.height as i64 {
        for x in 0..truth.width as i64 {
            let true_state = at(truth, [x, y]);
            if true_state < 0 {
                continue;
            }
            let here = [x + shift[0], y + shift[1]];
            let said = at(map, here);
            let beside = |view: &PlanView, [x, y]: [i64; 2]| {
                (-1..=1).any(|dx| (-1..=1).any(|dy| at(view, [x + dx, y + dy]) >= OCCUPIED))
            };
            if true_state >= OCCUPIED {
                if beside(map, here) {
                    found += 1
                } else {
                    missed += 1
                }
                run_into += u64::from((0..OCCUPIED).contains(&said) && !beside(map, here));
            } else {
                free += 1;
                open += u64::from((0..OCCUPIED).contains(&said));
            }
            if said >= OCCUPIED {
                let near = beside(truth, [x, y]);
                if near {
                    right += 1
                } else {
                    wrong += 1
                }
                blocked += u64::from(!near);
            }
        }
    }
    let share = |part: u64, of: u64| (of > 0).then(|| part as f64 / of as f64);
    MapScore {
        iou: share(found, found + missed + wrong),
        precision: share(right, right + wrong),
        recall: share(found, found + missed),
        called_free: share(run_into, found + missed),
        called_occupied: share(blocked, free),
        free_found: share(open, free),
    }
}

/// A plan view that fits in a file of text.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Picture {
    /// Side of a cell [m].
    pub cell_m: f64,
    /// The corner of the first cell [m].
    pub origin_m: [f64; 2],
    /// Cells along x and y.
    pub size: [usize; 2],
    /// −1 unknown, 0 free, 100 occupied, a byte each, row by row from the lowest y, in base 64.
    pub cells: String,
}

impl Picture {
    pub(super) fn of(view: &PlanView) -> Self {
        let bytes: Vec<u8> = view.cells.iter().map(|cell| cell.to_le_bytes()[0]).collect();
        let cells = STANDARD.encode(bytes);
        Self { cell_m: view.resolution_m, origin_m: view.origin_m, size: [view.width, view.height], cells }
    }

    pub(super) fn view(&self) -> Result<PlanView> {
        let bytes = STANDARD.decode(&self.cells).map_err(|e| Fault::new("cells of a map", e, "base 64"))?;
        if self.size[0].checked_mul(self.size[1]) != Some(bytes.len()) {
            let found = format!("{} cells", bytes.len());
            return Err(Fault::new("cells of a map", found, format!("{} x {}", self.size[0], self.size[1])));
        }
        Ok(PlanView {
            resolution_m: self.cell_m,
            origin_m: self.origin_m,
            width: self.size[0],
            height: self.size[1],
            cells: bytes.into_iter().map(|byte| i8::from_le_bytes([byte])).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(rows: &[&str]) -> PlanView {
        let cell = |c: u8| match c {
            b'#' => 100,
            b'.' => 0,
            _ => -1,
        };
        PlanView {
            resolution_m: 0.05,
            origin_m: [0.0; 2],
            width: rows[0].len(),
            height: rows.len(),
            cells: rows.iter().flat_map(|row| row.bytes().map(cell)).collect(),
        }
    }

    #[test]
    fn a_map_is_right_within_a_cell() {
        let truth = view(&["......", "..#...", "......", "     #"]);
        let same = score(&truth, &truth);
        assert_eq!((same.iou, same.precision, same.recall), (Some(1.0), Some(1.0), Some(1.0)));
        assert_eq!((same.called_free, same.called_occupied, same.free_found), (Some(0.0), Some(0.0), Some(1.0)));
        // One beside the truth, one in the open, one missed and called free.
        let map = view(&["#....#", "......", "......", "     ."]);
        let found = score(&map, &truth);
        assert_eq!((found.recall, found.precision, found.iou), (Some(0.0), Some(0.0), Some(0.0)));
        assert_eq!((found.called_free, found.called_occupied), (Some(1.0), Some(2.0 / 17.0)));
        let map = view(&["...#..", "      ", "      ", "      "]);
        let found = score(&map, &truth);
        assert_eq!((found.recall, found.precision, found.iou), (Some(0.5), Some(1.0), Some(0.5)));
        assert_eq!((found.called_free, found.free_found), (Some(0.0), Some(5.0 / 17.0)));
        let unknown = score(&view(&["    "]), &view(&["    "]));
        assert_eq!(unknown, MapScore::default());
    }

    #[test]
    fn maps_with_other_origins_are_laid_over_each_other() {
        let truth = PlanView { origin_m: [1.0, -0.5], ..view(&["...", ".#.", "..."]) };
        let map = PlanView { origin_m: [0.95, -0.55], ..view(&["    ", " ...", " .#.", " ..."]) };
        assert_eq!(score(&map, &truth).iou, Some(1.0));
    }

    #[test]
    fn a_picture_holds_its_map() {
        let map = view(&["# .", "..#"]);
        assert_eq!(Picture::of(&map).view().unwrap(), map);
        let bad = |cells: &str| Picture { cells: cells.into(), ..Picture::of(&map) }.view().is_err();
        assert!(bad("!") && bad("AAAA"));
        assert!(Picture { size: [usize::MAX, 2], ..Picture::of(&map) }.view().is_err());
    }
}
