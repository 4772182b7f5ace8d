//! Corners of a chessboard in an image, to sub-pixel, each with its place on the board.
//!
//! `calib-targets` finds X-junctions and orders those it is sure of; here the grid is completed from its own neighbours, every
//! corner is refined on the gradients around it, and the grid is laid onto the board that was announced.

use std::collections::BTreeMap;

use calib_targets_chessboard::{
    ChessboardDetector, ChessboardParams, GrayImageView, default_chess_config, detect_corners,
};
use nalgebra::{Matrix2, Vector2};
use serde::{Deserialize, Serialize};

use super::points::Mark;
use crate::fault::{Fault, Result, number_within};
use crate::geometry::Point;
use crate::image::Image;

/// A chessboard: x runs along its columns of corners, y along its rows, z into the board; the origin is its first corner.
///
/// Seen from the front x, y turn as right and down do. Where the pattern tells, the square beyond the origin is dark; a board
/// that looks the same upside-down is taken the way its x points to the right of the image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Chessboard {
    /// Inner corners along x.
    pub columns: usize,
    /// Inner corners along y.
    pub rows: usize,
    /// Distance of corners along x [m].
    pub column_pitch_m: f64,
    /// Distance of corners along y [m].
    pub row_pitch_m: f64,
}

impl Chessboard {
    /// Refuses boards that are none, and pitches that look like another unit.
    pub fn validated(self) -> Result<Self> {
        for (name, count) in [("board.columns", self.columns), ("board.rows", self.rows)] {
            if !(3..=100).contains(&count) {
                return Err(Fault::new(name, count, "3 to 100 inner corners"));
            }
        }
        for (name, pitch) in [("board.column_pitch_m", self.column_pitch_m), ("board.row_pitch_m", self.row_pitch_m)] {
            number_within(name, pitch, 1e-4, 1.0)
                .map_err(|f| Fault { expected: format!("{} (metres: are these millimetres?)", f.expected), ..f })?;
        }
        Ok(self)
    }
}

type Place = (i32, i32);
type Grid = BTreeMap<Place, Vector2<f64>>;

/// Finds the board. Marks are in the order of rows, then columns, numbered from 1 as if all were there; `number` is the
/// image's. Corners that are hidden are left out.
///
/// Errors: an image without contrast or mostly saturated, no board in it, only a part of it (then it is not known which).
pub fn find(image: &Image, board: &Chessboard, number: u32) -> Result<Vec<Mark>> {
    let board = board.validated()?;
    exposed(image)?;
    let mut part: Option<(i32, i32, usize)> = None;
    for mut grid in candidates(image) {
        complete(image, &board, &mut grid);
        let (wide, high) = extent(&grid);
        if let Some(grid) = laid(image, &board, &grid) {
            return Ok(marks(&board, &grid, number));
        }
        let (small, large) = (board.columns.min(board.rows) as i32, board.columns.max(board.rows) as i32);
        let fits = wide.min(high) <= small && wide.max(high) <= large;
        if fits && part.is_none_or(|(_, _, count)| grid.len() > count) {
            part = Some((wide, high, grid.len()));
        }
    }
    let expected = format!("a board of {} x {} inner corners", board.columns, board.rows);
    match part {
        Some((wide, high, _)) => {
            Err(Fault::new("image", format!("a part of a board, {wide} x {high} corners"), expected))
        }
        None => Err(Fault::new("image", "no board", expected)),
    }
}

/// Refuses black and white images: a corner needs both.
fn exposed(image: &Image) -> Result<()> {
    let mut counts = [0usize; 256];
    image.levels().iter().for_each(|level| counts[usize::from(*level)] += 1);
    let total = image.levels().len();
    let share = |share: f64| {
        let mut left = (share * total as f64) as usize;
        counts.iter().position(|count| left.checked_sub(*count).map(|rest| left = rest).is_none()).unwrap_or(255)
    };
    let (dark, bright) = (share(0.01), share(0.99));
    if bright < dark + usize::from(image.white()) / 25 {
        let found = format!("levels from {dark} to {bright} of {}", image.white());
        return Err(Fault::new("image", found, "light and dark squares (is it black, or overexposed?)"));
    }
    let full = counts[usize::from(image.white())..].iter().sum::<usize>();
    if full * 2 > total {
        let found = format!("{:.0} % saturated", 100.0 * full as f64 / total as f64);
        return Err(Fault::new("image", found, "a shorter exposure"));
    }
    Ok(())
}

/// Grids of corners that the detector is sure of; where one was found, the rest of the image is searched again for another.
fn candidates(image: &Image) -> Vec<Grid> {
    const BOARDS_MAX: usize = 5;
    let view = GrayImageView { width: image.width(), height: image.height(), data: image.levels() };
    let mut corners = detect_corners(&view, &default_chess_config());
    let Ok(detector) = ChessboardDetector::new(ChessboardParams::default()) else { return Vec::new() };
    let mut grids = Vec::new();
    while grids.len() < BOARDS_MAX {
        let Some(found) = detector.detect(&corners) else { break };
        let pixel = |x: f32, y: f32| Vector2::new(f64::from(x), f64::from(y));
        let grid: Grid =
            (found.corners.iter()).map(|c| ((c.grid.u, c.grid.v), pixel(c.position.x, c.position.y))).collect();
        // Its own corners go, and what lies within its squares: patterns printed there.
        let before = corners.len();
        let used: std::collections::BTreeSet<usize> = found.corners.iter().map(|c| c.input_index).collect();
        let reach = f64::from(found.cell_size.unwrap_or(20.0)) * 0.75;
        let mut index = 0;
        corners.retain(|c| {
            index += 1;
            let at = pixel(c.position.x, c.position.y);
            !used.contains(&(index - 1)) && grid.values().all(|q| (q - at).norm() > reach)
        });
        grids.push(grid);
        if corners.len() == before {
            break;
        }
    }
    grids
}

/// Columns and rows that the grid reaches over.
fn extent(grid: &Grid) -> (i32, i32) {
    let range = |of: fn(&Place) -> i32| {
        let (low, high) = grid.keys().map(of).fold((i32::MAX, i32::MIN), |(l, h), x| (l.min(x), h.max(x)));
        high.saturating_sub(low).saturating_add(1)
    };
    if grid.is_empty() { (0, 0) } else { (range(|p| p.0), range(|p| p.1)) }
}

/// Refines what is there, and adds corners beside known ones until none is found.
fn complete(image: &Image, board: &Chessboard, grid: &mut Grid) {
    /// A new corner has at least this part of the contrast of the known ones: shadows along the edge of a sheet have less.
    const CONTRAST_MIN: f64 = 0.35;
    let known = std::mem::take(grid);
    // Contrast, positive where the dark square lies beyond an even place.
    let mut contrasts = Vec::with_capacity(known.len());
    for (place, seen) in &known {
        let Some((a, b)) = axes(&known, *place) else { continue };
        let near = |q: &Vector2<f64>| (q - seen).norm() < 0.15 * a.norm().min(b.norm());
        let Some(q) = refine(image, *seen, half_window(&a, &b)).filter(near) else { continue };
        if let Some(contrast) = junction(image, &q, &a, &b) {
            grid.insert(*place, q);
            contrasts.push(contrast * parity(*place));
        }
    }
    contrasts.sort_by(f64::total_cmp);
    let Some(usual) = contrasts.get(contrasts.len() / 2).copied() else { return };
    let reach = board.columns.max(board.rows) as i32;
    loop {
        let missing: std::collections::BTreeSet<Place> = (grid.keys())
            .flat_map(|&(u, v)| [(u - 1, v), (u + 1, v), (u, v - 1), (u, v + 1)])
            .filter(|place| !grid.contains_key(place))
            .collect();
        let mut added = Vec::new();
        for place in missing {
            let Some((expected, a, b)) = predicted(grid, place) else { continue };
            let near = |q: &Vector2<f64>| (q - expected).norm() < 0.25 * a.norm().min(b.norm());
            // Near the edge of the image only a smaller window is whole.
            let half = half_window(&a, &b);
            let refined = [half, half / 2].into_iter().filter(|h| *h >= 2).find_map(|h| refine(image, expected, h));
            let Some(q) = refined.filter(near) else { continue };
            let contrast = junction(image, &q, &a, &b).unwrap_or(0.0) * parity(place);
            if contrast * usual.signum() > CONTRAST_MIN * usual.abs() {
                added.push((place, q));
            }
        }
        grid.extend(added.iter().copied());
        let (wide, high) = extent(grid);
        if added.is_empty() || wide.max(high) > reach + 2 {
            return; // all found, or a larger pattern than the one announced
        }
    }
}

/// 1 at even places, −1 at odd ones.
fn parity((u, v): Place) -> f64 {
    if (u + v) % 2 == 0 { 1.0 } else { -1.0 }
}

/// The steps to the next corner along x and along y, from the neighbours that are there.
fn axes(grid: &Grid, (u, v): Place) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let step = |du: i32, dv: i32| -> Option<Vector2<f64>> {
        let (here, ahead, behind) = (grid.get(&(u, v)), grid.get(&(u + du, v + dv)), grid.get(&(u - du, v - dv)));
        match (here, ahead, behind) {
            (_, Some(a), Some(b)) => Some((a - b) / 2.0),
            (Some(h), Some(a), None) => Some(a - h),
            (Some(h), None, Some(b)) => Some(h - b),
            _ => None,
        }
    };
    Some((step(1, 0)?, step(0, 1)?))
}

/// Where a missing corner should be, from rows and columns of known ones, with the steps there.
fn predicted(grid: &Grid, (u, v): Place) -> Option<(Vector2<f64>, Vector2<f64>, Vector2<f64>)> {
    let at = |du: i32, dv: i32| grid.get(&(u + du, v + dv)).copied();
    let mut guesses = Vec::new();
    let mut steps = [None; 2];
    for (axis, (du, dv)) in [(1, 0), (0, 1)].into_iter().enumerate() {
        if let (Some(a), Some(b)) = (at(du, dv), at(-du, -dv)) {
            guesses.push((a + b) / 2.0);
            steps[axis] = Some((a - b) / 2.0);
            continue;
        }
        for sign in [1, -1] {
            let next = |k: i32| at(sign * k * du, sign * k * dv);
            if let (Some(a), Some(b)) = (next(1), next(2)) {
                // With a third corner the change of the step (perspective, distortion) goes on too.
                let guess = next(3).map_or(2.0 * a - b, |c| 3.0 * a - 3.0 * b + c);
                guesses.push(guess);
                steps[axis] = Some((a - guess) * f64::from(sign));
            }
        }
    }
    if guesses.is_empty() {
        return None;
    }
    // Along an axis without two neighbours the step of the next row or column will do.
    for (axis, (du, dv)) in [(1, 0), (0, 1)].into_iter().enumerate() {
        if steps[axis].is_none() {
            steps[axis] =
                [1, -1].into_iter().find_map(|s| axes(grid, (u + s * dv, v + s * du)).map(|(a, b)| [a, b][axis]));
        }
    }
    Some((guesses.iter().sum::<Vector2<f64>>() / guesses.len() as f64, steps[0]?, steps[1]?))
}

/// Half the side of the window for a corner: well inside its four squares.
fn half_window(a: &Vector2<f64>, b: &Vector2<f64>) -> i32 {
    let height = (a.x * b.y - a.y * b.x).abs() / a.norm().max(b.norm()).max(1.0);
    ((0.3 * height) as i32).clamp(2, 10)
}

/// The level at a place between pixels; `None` outside the image.
fn level(image: &Image, p: &Vector2<f64>) -> Option<f64> {
    let (x, y) = (p.x.floor(), p.y.floor());
    let inside = x >= 0.0 && y >= 0.0 && x + 1.0 < image.width() as f64 && y + 1.0 < image.height() as f64;
    if !inside {
        return None;
    }
    let (fx, fy, left) = (p.x - x, p.y - y, x as usize);
    let row = |v: usize| {
        let levels = image.row(v);
        f64::from(levels[left]) * (1.0 - fx) + f64::from(levels[left + 1]) * fx
    };
    Some(row(y as usize) * (1.0 - fy) + row(y as usize + 1) * fy)
}

/// Förstner: the point that all edges around it run through, Σ w·(gᵀ(p − q))² least.
fn refine(image: &Image, start: Vector2<f64>, half: i32) -> Option<Vector2<f64>> {
    let mut q = start;
    for _ in 0..40 {
        let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
        for dy in -half..=half {
            for dx in -half..=half {
                let d = Vector2::new(f64::from(dx), f64::from(dy));
                let side = |x: f64, y: f64| level(image, &(q + d + Vector2::new(x, y)));
                let g = Vector2::new(side(1.0, 0.0)? - side(-1.0, 0.0)?, side(0.0, 1.0)? - side(0.0, -1.0)?);
                let weight = (-d.norm_squared() / f64::from(half * half)).exp();
                let outer = g * g.transpose() * weight;
                normal += outer;
                right += outer * d;
            }
        }
        let step: Vector2<f64> = normal.try_inverse()? * right;
        let length = step.norm();
        if length.is_nan() || length >= f64::from(half) {
            return None;
        }
        q += step;
        if length < 1e-3 {
            return Some(q);
        }
    }
    None
}

/// The contrast [levels] if four squares meet at `q`, dark and light in turn: positive if the one towards +a +b is dark.
fn junction(image: &Image, q: &Vector2<f64>, a: &Vector2<f64>, b: &Vector2<f64>) -> Option<f64> {
    let mut means = [0.0; 4];
    for (mean, (s, t)) in means.iter_mut().zip([(1.0, 1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0)]) {
        for (i, j) in [(0.25, 0.25), (0.4, 0.25), (0.25, 0.4), (0.15, 0.3), (0.3, 0.15)] {
            *mean += level(image, &(q + a * (s * i) + b * (t * j)))? / 5.0;
        }
    }
    let [one, two, three, four] = means;
    let least = 0.02 * f64::from(image.white());
    let (dark, light) = (three.min(four) - one.max(two), one.min(two) - three.max(four));
    if dark > least { Some(dark) } else { (light > least).then_some(-light) }
}

/// The grid with (0, 0) at the board's origin, if it reaches over the whole board.
fn laid(image: &Image, board: &Chessboard, grid: &Grid) -> Option<Grid> {
    let (columns, rows) = (board.columns as i32, board.rows as i32);
    let low = |of: fn(&Place) -> i32| grid.keys().map(of).min().unwrap_or(0);
    let (u0, v0) = (low(|p| p.0), low(|p| p.1));
    let (wide, high) = extent(grid);
    let mut best: Option<(bool, f64, Grid)> = None;
    for turn in 0..8 {
        // Four turns, each also mirrored.
        let (w, h) = if turn % 2 == 0 { (wide, high) } else { (high, wide) };
        if (w, h) != (columns, rows) {
            continue;
        }
        let place = |&(u, v): &Place| {
            let (u, v) = (u - u0, v - v0);
            let (x, y) = if turn % 2 == 0 { (u, v) } else { (v, u) };
            (if turn & 2 == 0 { x } else { w - 1 - x }, if turn & 4 == 0 { y } else { h - 1 - y })
        };
        let turned: Grid = grid.iter().map(|(p, q)| (place(p), *q)).collect();
        let (mut sum_a, mut sum_b, mut dark) = (Vector2::zeros(), Vector2::zeros(), 0.0);
        for (p, q) in &turned {
            let Some((a, b)) = axes(&turned, *p) else { continue };
            (sum_a, sum_b) = (sum_a + a, sum_b + b);
            dark += junction(image, q, &a, &b).unwrap_or(0.0) * parity(*p);
        }
        if sum_a.x * sum_b.y - sum_a.y * sum_b.x <= 0.0 {
            continue; // mirrored
        }
        let rightwards = sum_a.x / sum_a.norm().max(f64::MIN_POSITIVE);
        let better =
            |(other_dark, other_right, _): &(bool, f64, Grid)| (dark > 0.0, rightwards) > (*other_dark, *other_right);
        if best.as_ref().is_none_or(better) {
            best = Some((dark > 0.0, rightwards, turned));
        }
    }
    // Half of the corners at least, or it may be chance.
    best.map(|(_, _, grid)| grid).filter(|grid| grid.len() * 2 > board.columns * board.rows)
}

fn marks(board: &Chessboard, grid: &Grid, image: u32) -> Vec<Mark> {
    let mut marks: Vec<Mark> = (grid.iter())
        .map(|((x, y), q)| Mark {
            target: Point::new(f64::from(*x) * board.column_pitch_m, f64::from(*y) * board.row_pitch_m, 0.0),
            u_px: q.x,
            v_px: q.y,
            image,
            line: (*y as usize) * board.columns + *x as usize + 1,
        })
        .collect();
    marks.sort_by_key(|mark| mark.line);
    marks
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::views::{BoardParams, View, calibrate};
    use std::path::{Path, PathBuf};

    fn loaded(path: &Path) -> Image {
        let picture = image::open(path).unwrap().to_luma8();
        let (width, height) = (picture.width() as usize, picture.height() as usize);
        Image::new(width, height, 255, picture.into_raw()).unwrap()
    }

    fn data(folder: &str) -> Option<Vec<PathBuf>> {
        let folder = format!("{}/../shared/data/{folder}", env!("CARGO_MANIFEST_DIR"));
        let Ok(entries) = std::fs::read_dir(folder) else {
            eprintln!("skipped: ../shared/data is absent");
            return None;
        };
        let mut paths: Vec<PathBuf> =
            entries.map(|e| e.unwrap().path()).filter(|p| p.extension().is_some_and(|e| e == "png")).collect();
        paths.sort();
        Some(paths)
    }

    fn boards(paths: &[PathBuf], board: &Chessboard) -> Vec<View> {
        let mut views = Vec::new();
        for (i, path) in paths.iter().enumerate() {
            let name = path.file_name().unwrap().to_string_lossy().to_string();
            match find(&loaded(path), board, i as u32) {
                Ok(marks) => views.push(View { name, marks }),
                // A board that is only partly in the image is no mistake of the search.
                Err(fault) => {
                    assert!(fault.found.contains("no board") || fault.found.contains("a part"), "{name}: {fault}")
                }
            }
        }
        views
    }

    #[test]
    fn the_turntable_s_boards_agree_to_a_fifth_of_a_pixel() {
        let Some(paths) = data("slit_turntable/gray") else { return };
        let board = Chessboard { columns: 11, rows: 7, column_pitch_m: 21.167e-3, row_pitch_m: 21.125e-3 };
        let views = boards(&paths, &board);
        assert_eq!(views.len(), 7);
        assert!(views.iter().all(|v| v.marks.len() == 77));
        let fit = calibrate(&views, 1152, 768, &BoardParams::default()).unwrap();
        assert!(fit.residual().rms <= 0.20 && fit.drawn_residual().rms <= 0.25, "{:?}", fit.residual());
        assert!(fit.rejected.len() <= 3, "{:?}", fit.rejected);
    }

    #[test]
    fn the_hand_eye_boards_are_found_in_thirteen_frames() {
        let Some(paths) = data("slit_hand_eye") else { return };
        let board = Chessboard { columns: 9, rows: 6, column_pitch_m: 5e-3, row_pitch_m: 5e-3 };
        let views = boards(&paths, &board);
        assert!(views.len() >= 13, "{}", views.len());
        let fit = calibrate(&views, 640, 480, &BoardParams::default()).unwrap();
        assert!(fit.views.len() >= 13 && fit.drawn_residual().rms <= 0.48, "{:?}", fit.drawn_residual());
    }
}
