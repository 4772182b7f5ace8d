//! The plan view: what a robot that drives on the ground can hit, and where it can go.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::PlanView;
use super::grid::{BLOCK, Block, Grid, State, UNSEEN};
use super::ground::Ground;
use crate::fault::{Result, number_within};

/// Which part of the map a robot can hit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlanParams {
    /// What is no higher over the ground than this is driven over [m].
    pub clearance_m: f64,
    /// What is higher over the ground than this is driven under: the robot's height [m].
    pub height_m: f64,
    /// The view is no wider and no deeper than this, about the robot [m].
    pub side_m_max: f64,
}

impl Default for PlanParams {
    fn default() -> Self {
        Self { clearance_m: 0.05, height_m: 1.1, side_m_max: 200.0 }
    }
}

impl PlanParams {
    /// Refuses values that make no view.
    pub fn validated(self) -> Result<Self> {
        number_within("plan.clearance_m", self.clearance_m, 0.0, 10.0)?;
        number_within("plan.height_m", self.height_m, self.clearance_m, 100.0)?;
        number_within("plan.side_m_max", self.side_m_max, 1.0, 1000.0)?;
        Ok(self)
    }
}

const UNKNOWN: i8 = -1;
const FREE: i8 = 0;
const OCCUPIED: i8 = 100;

/// A window of columns of voxels: keys from `low`, `width` by `height`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Window {
    pub low: [i32; 2],
    pub width: usize,
    pub height: usize,
}

impl Window {
    /// The index of a column, row by row from the lowest y.
    pub fn index(&self, [x, y]: [i32; 2]) -> Option<usize> {
        let (x, y) = (usize::try_from(x - self.low[0]).ok()?, usize::try_from(y - self.low[1]).ok()?);
        (x < self.width && y < self.height).then(|| y * self.width + x)
    }
}

/// What is known of columns: log-odds in thousandths, `UNSEEN` where nothing is. A column with an occupied voxel is as likely
/// occupied as the likeliest of them; one without as likely free as the likeliest of its voxels; where only its ground was
/// seen, as after one line of sight.
pub(super) struct Columns {
    pub window: Window,
    pub log_odds: Vec<i16>,
}

/// The view from above. A column is occupied if a voxel whose middle is more than the clearance over the ground and not
/// over the robot's height is; free if its ground or free space at that height was seen; otherwise unknown. Where the
/// ground was not seen, that of the nearest column counts, and 0 where there is none at all. The view is just large
/// enough for what is known, and never larger than `side_m_max` about `centre_m`.
pub(super) fn plan_view(grid: &Grid, ground: &Ground, centre_m: [f64; 2], params: &PlanParams) -> PlanView {
    match columns(grid, ground, centre_m, params, None) {
        Some(Columns { window, log_odds }) => {
            tight(window, log_odds.into_iter().map(shown).collect(), grid.params().voxel_m)
        }
        None => empty(grid.params().voxel_m),
    }
}

/// A view in which nothing is known.
pub(super) fn empty(resolution_m: f64) -> PlanView {
    PlanView { resolution_m, origin_m: [0.0; 2], width: 0, height: 0, cells: Vec::new() }
}

/// What a view shows of a column's log-odds.
pub(super) fn shown(log_odds: i16) -> i8 {
    match State::of(log_odds) {
        State::Unknown => UNKNOWN,
        State::Free => FREE,
        State::Occupied => OCCUPIED,
    }
}

/// The columns of the view, and those between `also` two corners. `None` where there are none.
pub(super) fn columns(
    grid: &Grid,
    ground: &Ground,
    centre_m: [f64; 2],
    params: &PlanParams,
    also: Option<[[i32; 2]; 2]>,
) -> Option<Columns> {
    let voxel_m = grid.params().voxel_m;
    // A cell of the terrain may span several columns, or share one with others.
    let span = |c: i32| {
        let edge = |c: i32| f64::from(c) * ground.cell_m / voxel_m + 1e-9;
        edge(c).floor() as i32..=(edge(c + 1) - 2e-9).floor() as i32
    };
    let blocks = grid.blocks();
    let block_keys = blocks.iter().flat_map(|block| {
        let low = [block.key[0] * BLOCK as i32, block.key[1] * BLOCK as i32];
        [low, low.map(|c| c + BLOCK as i32 - 1)]
    });
    let ground_bounds = bounds(ground.cells.iter().map(|(key, _)| *key));
    let ground_keys =
        ground_bounds.iter().flat_map(|[low, high]| [low.map(|c| *span(c).start()), high.map(|c| *span(c).end())]);
    let keys = bounds(block_keys.chain(ground_keys).chain(also.into_iter().flatten()));
    let window = keys.and_then(|keys| window(keys, centre_m.map(|c| c / voxel_m), params.side_m_max / voxel_m))?;
    let mut log_odds = vec![UNSEEN; window.width * window.height];
    let mut heights = vec![f32::NAN; log_odds.len()];
    let mut bare = Vec::new();
    for ([x, y], um) in &ground.cells {
        for at in span(*x).flat_map(|x| span(*y).map(move |y| [x, y])).filter_map(|key| window.index(key)) {
            heights[at] = *um as f32 * 1e-6;
            bare.push(at);
        }
    }
    spread(&mut heights, window.width);
    for block in blocks {
        look_at(block, voxel_m, &window, params, &heights, &mut log_odds);
    }
    for at in bare {
        if log_odds[at] == UNSEEN {
            log_odds[at] = grid.miss();
        }
    }
    Some(Columns { window, log_odds })
}

/// The lowest and the highest coordinates of keys.
fn bounds(keys: impl Iterator<Item = [i32; 2]>) -> Option<[[i32; 2]; 2]> {
    keys.fold(None, |bounds: Option<[[i32; 2]; 2]>, key| {
        let [low, high] = bounds.unwrap_or([key, key]);
        Some([[low[0].min(key[0]), low[1].min(key[1])], [high[0].max(key[0]), high[1].max(key[1])]])
    })
}

/// The window between two corners, cut to `side_max` columns about `centre` (in columns); `None` if nothing is left.
fn window(bounds: [[i32; 2]; 2], centre: [f64; 2], side_max: f64) -> Option<Window> {
    let cut = |axis: usize| {
        let reach = side_max / 2.0;
        let low = bounds[0][axis].max((centre[axis] - reach).ceil() as i32);
        let high = bounds[1][axis].min((centre[axis] + reach).floor() as i32);
        let count = usize::try_from(i64::from(high) - i64::from(low) + 1).ok().filter(|count| *count > 0)?;
        Some((low, count))
    };
    let ((x, width), (y, height)) = (cut(0)?, cut(1)?);
    Some(Window { low: [x, y], width, height })
}

/// Gives every column without a height that of the nearest one with a height (by steps along rows and columns).
fn spread(heights: &mut [f32], width: usize) {
    let mut queue: VecDeque<usize> = (0..heights.len()).filter(|at| !heights[*at].is_nan()).collect();
    while let Some(at) = queue.pop_front() {
        let x = at % width;
        let beside = [
            (x > 0).then(|| at.wrapping_sub(1)),
            (x + 1 < width).then_some(at + 1),
            at.checked_sub(width),
            Some(at + width).filter(|next| *next < heights.len()),
        ];
        for next in beside.into_iter().flatten() {
            if heights[next].is_nan() {
                heights[next] = heights[at];
                queue.push_back(next);
            }
        }
    }
}

/// Enters what a block says about its columns.
fn look_at(block: &Block, voxel_m: f64, window: &Window, params: &PlanParams, heights: &[f32], log_odds: &mut [i16]) {
    let side = BLOCK as i32;
    for (x, y) in (0..BLOCK).flat_map(|x| (0..BLOCK).map(move |y| (x, y))) {
        let Some(at) = window.index([block.key[0] * side + x as i32, block.key[1] * side + y as i32]) else { continue };
        let ground = if heights[at].is_nan() { 0.0 } else { f64::from(heights[at]) };
        // Voxel k has its middle at (k + ½) voxels.
        let level = |height_m: f64| (ground + height_m) / voxel_m - 0.5 - f64::from(block.key[2] * side);
        let low = (level(params.clearance_m) - 1e-6).ceil().clamp(0.0, BLOCK as f64) as usize;
        let high = ((level(params.height_m) + 1e-6).floor() + 1.0).clamp(0.0, BLOCK as f64) as usize;
        if low >= high {
            continue;
        }
        let seen = block.log_odds(x, y)[low..high].iter();
        log_odds[at] = seen.fold(log_odds[at], |surest, voxel| match (surest, *voxel) {
            (UNSEEN, other) | (other, UNSEEN) => other,
            (a, b) if a <= 0 && b <= 0 => a.min(b),
            (a, b) => a.max(b),
        });
    }
}

/// Without the rows and columns at the edges of which nothing is known.
fn tight(window: Window, cells: Vec<i8>, voxel_m: f64) -> PlanView {
    match known(&window, &cells) {
        Some(part) => cut(&window, &cells, part, voxel_m),
        None => empty(voxel_m),
    }
}

/// The first and last columns and rows of what is known: left, right, bottom, top.
pub(super) fn known(window: &Window, cells: &[i8]) -> Option<[usize; 4]> {
    let known = cells.iter().enumerate().filter(|(_, cell)| **cell != UNKNOWN);
    known.fold(None, |bounds: Option<[usize; 4]>, (at, _)| {
        let (x, y) = (at % window.width, at / window.width);
        let [left, right, bottom, top] = bounds.unwrap_or([x, x, y, y]);
        Some([left.min(x), right.max(x), bottom.min(y), top.max(y)])
    })
}

/// A part of the window, from column `left` to `right` and row `bottom` to `top`.
pub(super) fn cut(window: &Window, cells: &[i8], [left, right, bottom, top]: [usize; 4], voxel_m: f64) -> PlanView {
    let rows = cells.chunks_exact(window.width).skip(bottom).take(top - bottom + 1);
    let origin = [window.low[0] as f64 + left as f64, window.low[1] as f64 + bottom as f64];
    PlanView {
        resolution_m: voxel_m,
        origin_m: origin.map(|c| c * voxel_m),
        width: right - left + 1,
        height: top - bottom + 1,
        cells: rows.flat_map(|row| row[left..=right].iter().copied()).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Point, World};
    use crate::maps::GridParams;
    use nalgebra::Vector3;

    fn cell(plan: &PlanView, x: f64, y: f64) -> i8 {
        let [i, j] = [(x - plan.origin_m[0]) / plan.resolution_m, (y - plan.origin_m[1]) / plan.resolution_m];
        if i < 0.0 || j < 0.0 || i >= plan.width as f64 || j >= plan.height as f64 {
            return UNKNOWN;
        }
        plan.cells[j as usize * plan.width + i as usize]
    }

    fn hit(grid: &mut Grid, points: &[[f64; 3]]) {
        for point in points {
            grid.insert_points(&[], [Vector3::from(*point)]);
        }
    }

    fn view(grid: &Grid, ground: &Ground) -> PlanView {
        plan_view(grid, ground, [0.0; 2], &PlanParams::default())
    }

    fn floor(height: impl Fn(f64) -> f64) -> Ground {
        let cells = (-20..40).flat_map(|x| (-20..20).map(move |y| [x, y]));
        let cells = cells.map(|key| (key, (height(f64::from(key[0]) * 0.05 + 0.025) * 1e6) as i64));
        Ground { cell_m: 0.05, cells: cells.collect() }
    }

    #[test]
    fn low_things_are_driven_over_high_ones_under_and_the_rest_is_hit() {
        let mut grid = Grid::new(GridParams::default()).unwrap();
        let (low, step, top, high) = (0.04, 0.06, 1.09, 1.16);
        hit(&mut grid, &[[0.01, 0.01, low], [0.31, 0.01, step], [0.61, 0.01, top], [0.91, 0.01, high]]);
        let plan = view(&grid, &floor(|_| 0.0));
        assert_eq!((plan.width, plan.height), (60, 40));
        assert!((plan.origin_m[0] + 1.0).abs() < 1e-12 && (plan.origin_m[1] + 1.0).abs() < 1e-12);
        let row: Vec<i8> = [0.01, 0.31, 0.61, 0.91].into_iter().map(|x| cell(&plan, x, 0.01)).collect();
        assert_eq!(row, [FREE, OCCUPIED, OCCUPIED, FREE]);
        assert_eq!(plan.cells.iter().filter(|c| **c == OCCUPIED).count(), 2);
    }

    #[test]
    fn heights_count_from_the_ground_below() {
        let mut grid = Grid::new(GridParams::default()).unwrap();
        // A ramp of 15 % that is itself no obstacle, a thing on it, and a thing beside where no ground was seen.
        let ramp = |x: f64| 0.15 * x.max(0.0);
        let points: Vec<[f64; 3]> = (0..40).map(|i| 0.025 + 0.05 * f64::from(i)).map(|x| [x, 0.01, ramp(x)]).collect();
        hit(&mut grid, &points);
        hit(&mut grid, &[[1.51, 0.51, ramp(1.51) + 0.1], [2.01, 0.51, 0.31], [2.01, 0.81, 0.51]]);
        let plan = view(&grid, &floor(ramp));
        assert!(points.iter().all(|p| cell(&plan, p[0], p[1]) == FREE));
        assert_eq!(cell(&plan, 1.51, 0.51), OCCUPIED);
        assert_eq!(cell(&plan, 2.01, 0.51), UNKNOWN); // as high as the ground beside it
        assert_eq!(cell(&plan, 2.01, 0.81), OCCUPIED);
    }

    #[test]
    fn seen_space_is_free_and_unseen_is_unknown() {
        let mut grid = Grid::new(GridParams::default()).unwrap();
        grid.insert_points(&[Vector3::new(0.0, 0.0, 1.0)], [Vector3::new(2.0, 0.0, 0.4)]);
        let plan = view(&grid, &Ground { cell_m: 0.05, cells: Vec::new() });
        assert_eq!(cell(&plan, 1.0, 0.01), FREE);
        assert_eq!(cell(&plan, 2.01, 0.01), OCCUPIED);
        assert_eq!(cell(&plan, 1.0, 0.5), UNKNOWN);
        assert_eq!(plan.height, 1, "tight");
        assert_eq!(grid.state(Point::<World>::new(1.0, 0.01, 0.01)), State::Unknown);
    }

    #[test]
    fn nothing_known_is_an_empty_view_and_a_far_outlier_makes_no_huge_one() {
        let mut grid = Grid::new(GridParams::default()).unwrap();
        let none = Ground { cell_m: 0.05, cells: Vec::new() };
        assert_eq!(view(&grid, &none).cells, Vec::<i8>::new());
        hit(&mut grid, &[[0.0, 0.0, 0.3], [900.0, -900.0, 0.3], [-900.0, 900.0, 0.3]]);
        let plan = view(&grid, &none);
        assert_eq!((plan.width, plan.height), (1, 1));
        let away = plan_view(&grid, &none, [1e12, f64::MAX], &PlanParams::default());
        assert_eq!((away.width, away.height), (0, 0));
    }

    #[test]
    fn a_coarser_terrain_covers_all_its_columns() {
        let grid = Grid::new(GridParams::default()).unwrap();
        let plan = view(&grid, &Ground { cell_m: 0.1, cells: vec![([0, 0], 0), ([-1, 0], 0)] });
        assert_eq!((plan.width, plan.height, plan.cells), (4, 2, vec![FREE; 8]));
        let plan = view(&grid, &Ground { cell_m: 0.025, cells: vec![([0, 0], 0), ([1, 1], 0)] });
        assert_eq!((plan.width, plan.height), (1, 1));
    }

    #[test]
    fn parameters_that_make_no_view_are_refused() {
        assert!(PlanParams::default().validated().is_ok());
        assert!(PlanParams { height_m: 0.01, ..PlanParams::default() }.validated().is_err());
        assert!(PlanParams { clearance_m: f64::NAN, ..PlanParams::default() }.validated().is_err());
        assert!(PlanParams { side_m_max: 1e9, ..PlanParams::default() }.validated().is_err());
    }
}
