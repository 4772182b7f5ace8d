//! Images of the paper's block: round dots in rows on a plane, centres to sub-pixel, in the order of the drawing.
//!
//! The centre of a dot's image is not the image of its centre: seen at a slant, the near half is larger. The difference follows
//! from camera and pose, and is taken out between two rounds of calibration ([`calibrate`]).

use std::collections::BTreeMap;

use nalgebra::{Matrix2, Point3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use super::camera::{BlockFit, BlockParams, Sensor, calibrate as calibrate_marks};
use super::points::Mark;
use crate::fault::{Fault, Result, number_within};
use crate::geometry::Point;
use crate::image::Image;

/// Dots on a plane: x runs along the columns, y along the rows, the origin is the centre of the first dot.
///
/// Seen from the front x, y turn as right and down do; of the two ways round x is the one that points to the right of the image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DotGrid {
    /// Dots along x.
    pub columns: usize,
    /// Dots along y.
    pub rows: usize,
    /// Distance of centres along x [m].
    pub column_pitch_m: f64,
    /// Distance of centres along y [m].
    pub row_pitch_m: f64,
    /// Diameter of a dot [m].
    pub diameter_m: f64,
}

impl DotGrid {
    /// One plane of the paper's block: 30 dots of 10 mm on 160 × 100 mm (4.1). Rows and pitches are not given there [A].
    pub fn paper() -> Self {
        Self { columns: 6, rows: 5, column_pitch_m: 0.028, row_pitch_m: 0.020, diameter_m: 0.010 }
    }

    /// Refuses grids that are none, and lengths that look like another unit.
    pub fn validated(self) -> Result<Self> {
        for (name, count) in [("dots.columns", self.columns), ("dots.rows", self.rows)] {
            if !(2..=100).contains(&count) {
                return Err(Fault::new(name, count, "2 to 100 dots"));
            }
        }
        let lengths = [
            ("dots.column_pitch_m", self.column_pitch_m),
            ("dots.row_pitch_m", self.row_pitch_m),
            ("dots.diameter_m", self.diameter_m),
        ];
        for (name, length) in lengths {
            number_within(name, length, 1e-4, 1.0)
                .map_err(|f| Fault { expected: format!("{} (metres: are these millimetres?)", f.expected), ..f })?;
        }
        if self.diameter_m > 0.8 * self.column_pitch_m.min(self.row_pitch_m) {
            return Err(Fault::new(
                "dots.diameter_m",
                self.diameter_m,
                "at most 0.8 of the pitch, so that dots are apart",
            ));
        }
        Ok(self)
    }
}

type Place = (i32, i32);
type Grid = BTreeMap<Place, Vector2<f64>>;

/// Pixels that a dot must have.
const AREA_MIN: usize = 12;
/// Most blobs that are looked at.
const BLOBS_MAX: usize = 20_000;

/// Finds the dots, dark on light or light on dark. Marks are in the order of rows, then columns, numbered from 1 as if all were
/// there, at this height over the plane z = 0 (z points into the target: a raised plane has negative z); `number` is the image's.
///
/// Errors: an image without contrast or mostly saturated, no such grid of dots in it.
pub fn find(image: &Image, grid: &DotGrid, height_m: f64, number: u32) -> Result<Vec<Mark>> {
    let grid = grid.validated()?;
    number_within("height_m", height_m, -10.0, 10.0)?;
    let threshold = contrast(image)?;
    let mut most = 0;
    for dark in [true, false] {
        let dots: Vec<Vector2<f64>> = blobs(image, threshold, dark).iter().map(|b| b.centre(image, dark)).collect();
        most = most.max(dots.len());
        if let Some(laid) = ordered(&dots).and_then(|found| laid(&grid, &found)) {
            return Ok(marks(&grid, &laid, height_m, number));
        }
    }
    let expected = format!("{} x {} dots, all rows and columns in sight", grid.columns, grid.rows);
    Err(Fault::new("image", format!("{most} round blobs that are no such grid"), expected))
}

/// The level between dots and ground (Otsu); refuses images that have no two levels.
fn contrast(image: &Image) -> Result<u8> {
    let mut counts = [0f64; 256];
    image.levels().iter().for_each(|level| counts[usize::from(*level)] += 1.0);
    let total = image.levels().len() as f64;
    let full: f64 = counts[usize::from(image.white())..].iter().sum();
    if full > 0.9 * total {
        return Err(Fault::new("image", format!("{:.0} % saturated", 100.0 * full / total), "a shorter exposure"));
    }
    let sum: f64 = counts.iter().enumerate().map(|(level, count)| level as f64 * count).sum();
    let (mut below, mut below_sum, mut best) = (0.0, 0.0, (0.0, 0u8, 0.0));
    for (level, count) in counts.iter().enumerate() {
        (below, below_sum) = (below + count, below_sum + level as f64 * count);
        if below > 0.0 && below < total {
            let apart = (sum - below_sum) / (total - below) - below_sum / below;
            let between = below * (total - below) * apart * apart;
            if between > best.0 {
                best = (between, level as u8, apart);
            }
        }
    }
    if best.2 < f64::from(image.white()) / 16.0 {
        let found = format!("two levels {:.1} apart of {}", best.2, image.white());
        return Err(Fault::new("image", found, "dots that stand out (is it black, or overexposed?)"));
    }
    Ok(best.1)
}

/// Connected pixels on one side of the threshold.
struct Blob {
    mean: Vector2<f64>,
    spread: Matrix2<f64>,
}

/// The blobs that are round, as an ellipse is, and whole.
fn blobs(image: &Image, threshold: u8, dark: bool) -> Vec<Blob> {
    let (width, height) = (image.width(), image.height());
    let is_in = |at: usize| (image.levels()[at] <= threshold) == dark;
    let mut seen = vec![false; width * height];
    let mut found = Vec::new();
    let mut stack = Vec::new();
    for start in 0..width * height {
        if seen[start] || !is_in(start) || found.len() > BLOBS_MAX {
            continue;
        }
        let (mut count, mut sum, mut squares, mut at_edge) = (0usize, Vector2::zeros(), Matrix2::zeros(), false);
        // Sums from the first pixel: no large numbers to take away from each other.
        let origin = Vector2::new((start % width) as f64, (start / width) as f64);
        seen[start] = true;
        stack.push(start);
        while let Some(at) = stack.pop() {
            let (u, v) = (at % width, at / width);
            let p = Vector2::new(u as f64, v as f64) - origin;
            (count, sum, squares) = (count + 1, sum + p, squares + p * p.transpose());
            at_edge |= u == 0 || v == 0 || u + 1 == width || v + 1 == height;
            let beside = [
                (u > 0).then(|| at - 1),
                (u + 1 < width).then_some(at + 1),
                (v > 0).then(|| at - width),
                (v + 1 < height).then_some(at + width),
            ];
            for next in beside.into_iter().flatten() {
                if !seen[next] && is_in(next) {
                    seen[next] = true;
                    stack.push(next);
                }
            }
        }
        if at_edge || count < AREA_MIN {
            continue;
        }
        let mean = sum / count as f64;
        // 1/12: a pixel's own extent.
        let spread = squares / count as f64 - mean * mean.transpose() + Matrix2::identity() / 12.0;
        let ellipse = 4.0 * std::f64::consts::PI * spread.determinant().max(0.0).sqrt();
        let long = spread.symmetric_eigenvalues();
        if (0.85..1.15).contains(&(count as f64 / ellipse)) && long.max() < 16.0 * long.min() {
            found.push(Blob { mean: mean + origin, spread });
        }
    }
    found
}

impl Blob {
    /// The centre of its light: pixels weighted by how much of them is dot, from the levels of ground and core around it.
    fn centre(&self, image: &Image, dark: bool) -> Vector2<f64> {
        let Some(inverse) = self.spread.try_inverse() else { return self.mean };
        let reach = 2.0 * 1.45 * self.spread.symmetric_eigenvalues().max().sqrt() + 2.0;
        let low = |x: f64| (x - reach).max(0.0) as usize;
        let high = |x: f64, size: usize| ((x + reach) as usize).min(size - 1);
        let mut near = Vec::new();
        for v in low(self.mean.y)..=high(self.mean.y, image.height()) {
            for u in low(self.mean.x)..=high(self.mean.x, image.width()) {
                let d = Vector2::new(u as f64, v as f64) - self.mean;
                // In radii of the ellipse: its edge is at 1.
                let radius = (d.dot(&(inverse * d)) / 4.0).sqrt();
                if radius < 1.45 {
                    near.push((d, radius, f64::from(image.row(v)[u])));
                }
            }
        }
        let middle = |within: &dyn Fn(f64) -> bool| {
            let mut levels: Vec<f64> = near.iter().filter(|n| within(n.1)).map(|n| n.2).collect();
            levels.sort_by(f64::total_cmp);
            levels.get(levels.len() / 2).copied()
        };
        let (Some(core), Some(ground)) = (middle(&|r| r < 0.7), middle(&|r| r > 1.25)) else { return self.mean };
        if (ground > core) != dark {
            return self.mean;
        }
        let (mut light, mut sum) = (0.0, Vector2::zeros());
        for (d, _, level) in &near {
            let part = ((ground - level) / (ground - core)).clamp(0.0, 1.0);
            (light, sum) = (light + part, sum + d * part);
        }
        if light > 0.0 { self.mean + sum / light } else { self.mean }
    }
}

/// The dots as a grid, from the one nearest to the middle outwards.
fn ordered(dots: &[Vector2<f64>]) -> Option<Grid> {
    /// Farther from where it should be than this part of the step, it is another dot.
    const NEAR: f64 = 0.3;
    let middle = dots.iter().sum::<Vector2<f64>>() / dots.len().max(1) as f64;
    let by_distance = |from: Vector2<f64>| {
        let mut order: Vec<usize> = (0..dots.len()).collect();
        order.sort_by(|&a, &b| (dots[a] - from).norm().total_cmp(&(dots[b] - from).norm()));
        order
    };
    // Blobs that are no dots may lie in the middle: then another start finds more.
    let mut best: Option<Grid> = None;
    for start in by_distance(middle).into_iter().take(6) {
        let here = dots[start];
        let near = by_distance(here);
        let Some(a) = near.get(1).map(|&i| dots[i] - here) else { continue };
        let across = |d: &Vector2<f64>| (a.x * d.y - a.y * d.x).abs() > 0.7 * a.norm() * d.norm();
        let Some(b) = near.iter().take(9).map(|&i| dots[i] - here).find(across) else { continue };
        let mut grid: Grid = BTreeMap::from([((0, 0), here)]);
        let mut open = vec![((0, 0), a, b)];
        while let Some(((u, v), a, b)) = open.pop() {
            let here = grid[&(u, v)];
            for (du, dv, step) in [(1, 0, a), (-1, 0, -a), (0, 1, b), (0, -1, -b)] {
                let place = (u + du, v + dv);
                if grid.contains_key(&place) {
                    continue;
                }
                let expected = here + step;
                let next = dots.iter().min_by(|p, q| (*p - expected).norm().total_cmp(&(*q - expected).norm()));
                let Some(next) = next.filter(|next| (*next - expected).norm() < NEAR * step.norm()) else { continue };
                grid.insert(place, *next);
                let found = (next - here) * f64::from(du + dv);
                open.push((place, if du != 0 { found } else { a }, if dv != 0 { found } else { b }));
            }
        }
        if best.as_ref().is_none_or(|known| grid.len() > known.len()) {
            best = Some(grid);
        }
    }
    best
}

/// The grid with (0, 0) at the first dot, if it reaches over all rows and columns.
fn laid(dots: &DotGrid, grid: &Grid) -> Option<Grid> {
    let range = |of: fn(&Place) -> i32| {
        let (low, high) = (grid.keys().map(of).min()?, grid.keys().map(of).max()?);
        Some((low, high - low + 1))
    };
    let ((u0, wide), (v0, high)) = (range(|p| p.0)?, range(|p| p.1)?);
    let mut best: Option<(f64, Grid)> = None;
    for turn in 0..8 {
        let (w, h) = if turn % 2 == 0 { (wide, high) } else { (high, wide) };
        if (w, h) != (dots.columns as i32, dots.rows as i32) {
            continue;
        }
        let place = |&(u, v): &Place| {
            let (x, y) = if turn % 2 == 0 { (u - u0, v - v0) } else { (v - v0, u - u0) };
            (if turn & 2 == 0 { x } else { w - 1 - x }, if turn & 4 == 0 { y } else { h - 1 - y })
        };
        let turned: Grid = grid.iter().map(|(p, q)| (place(p), *q)).collect();
        let step = |du: i32, dv: i32| -> Vector2<f64> {
            turned.iter().filter_map(|((u, v), q)| Some(turned.get(&(u + du, v + dv))? - q)).sum()
        };
        let (a, b) = (step(1, 0), step(0, 1));
        let rightwards = a.x / a.norm().max(f64::MIN_POSITIVE);
        // One of the two ways round that are not mirrored.
        if a.x * b.y - a.y * b.x > 0.0 && best.as_ref().is_none_or(|(known, _)| rightwards > *known) {
            best = Some((rightwards, turned));
        }
    }
    best.map(|(_, grid)| grid).filter(|grid| grid.len() * 10 >= dots.columns * dots.rows * 8)
}

fn marks(dots: &DotGrid, grid: &Grid, height_m: f64, image: u32) -> Vec<Mark> {
    let mut marks: Vec<Mark> = (grid.iter())
        .map(|((x, y), q)| Mark {
            target: Point::new(f64::from(*x) * dots.column_pitch_m, f64::from(*y) * dots.row_pitch_m, -height_m),
            u_px: q.x,
            v_px: q.y,
            image,
            line: (*y as usize) * dots.columns + *x as usize + 1,
        })
        .collect();
    marks.sort_by_key(|mark| mark.line);
    marks
}

/// Calibrates on dots of this diameter [m], parallel to the target's xy plane, as `camera::calibrate` does, and again with the
/// centres corrected for perspective.
///
/// Errors: those of `camera::calibrate`.
pub fn calibrate(marks: &[Mark], diameter_m: f64, sensor: &Sensor, params: &BlockParams) -> Result<BlockFit> {
    const ROUNDS: usize = 2;
    let mut fit = calibrate_marks(marks, sensor, params)?;
    for _ in 0..ROUNDS {
        let mut corrected = marks.to_vec();
        for mark in &mut corrected {
            let [du, dv] = shift(&fit, mark, diameter_m / 2.0).unwrap_or_default();
            (mark.u_px, mark.v_px) = (mark.u_px - du, mark.v_px - dv);
        }
        fit = calibrate_marks(&corrected, sensor, params)?;
    }
    Ok(fit)
}

/// How far the centre of a dot's image is from the image of its centre [px]; `None` out of sight.
fn shift(fit: &BlockFit, mark: &Mark, radius_m: f64) -> Option<[f64; 2]> {
    const CORNERS: usize = 48;
    let pixel = |p: Vector3<f64>| fit.camera.project(&(fit.camera_from_target.iso * Point3::from(p)).coords);
    let middle = pixel(mark.target.xyz)?;
    let mut edge = Vec::with_capacity(CORNERS);
    for k in 0..CORNERS {
        let (sin, cos) = (std::f64::consts::TAU * k as f64 / CORNERS as f64).sin_cos();
        let [u, v] = pixel(mark.target.xyz + Vector3::new(cos, sin, 0.0) * radius_m)?;
        edge.push([u - middle[0], v - middle[1]]);
    }
    // The centre of the polygon.
    let (mut area, mut centre) = (0.0, [0.0; 2]);
    for (a, b) in edge.iter().zip(edge.iter().cycle().skip(1)) {
        let cross = a[0] * b[1] - a[1] * b[0];
        area += cross;
        centre = [centre[0] + (a[0] + b[0]) * cross, centre[1] + (a[1] + b[1]) * cross];
    }
    (area != 0.0).then(|| centre.map(|c| c / (3.0 * area)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::camera::{Unknown, place};
    use crate::optics::Camera;
    use nalgebra::{Isometry3, UnitQuaternion};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha12Rng;

    /// What METRO-I's camera sees of one plane of dots on a block, light on dark or dark on light.
    fn rendered(grid: &DotGrid, pose: &Isometry3<f64>, height_m: f64, dark: bool, seed: u64) -> Image {
        const FINE: usize = 8;
        let camera = Camera::metro_i();
        let mut rng = ChaCha12Rng::seed_from_u64(seed);
        let eye = pose.inverse_transform_point(&Point3::origin()).coords;
        let is_dot = |u: f64, v: f64| {
            let ray = pose.inverse_transform_vector(&camera.ray(u, v).unwrap());
            let p = eye + ray * ((-height_m - eye.z) / ray.z);
            let off = |x: f64, pitch: f64, count: usize| x - (x / pitch).round().clamp(0.0, (count - 1) as f64) * pitch;
            let (dx, dy) = (off(p.x, grid.column_pitch_m, grid.columns), off(p.y, grid.row_pitch_m, grid.rows));
            dx.hypot(dy) < grid.diameter_m / 2.0
        };
        let mut levels = Vec::with_capacity(512 * 480);
        for (v, u) in (0..480).flat_map(|v| (0..512).map(move |u| (v as f64, u as f64))) {
            let corners = [(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)].map(|(x, y)| is_dot(u + x, v + y));
            let part = if corners.iter().all(|c| *c == corners[0]) {
                f64::from(u8::from(corners[0]))
            } else {
                let at = |k: usize| (k as f64 + 0.5) / FINE as f64 - 0.5;
                let count = (0..FINE * FINE).filter(|k| is_dot(u + at(k % FINE), v + at(k / FINE))).count();
                count as f64 / (FINE * FINE) as f64
            };
            // Light that falls off across the block, and noise of a level.
            let light = 0.8 + 0.2 * u / 512.0;
            let level = if dark { 95.0 - 70.0 * part } else { 25.0 + 70.0 * part };
            let noise: f64 = (0..6).map(|_| rng.random_range(-1.0..1.0f64)).sum::<f64>() / 1.41;
            levels.push((level * light + noise).round().clamp(0.0, 127.0) as u8);
        }
        Image::new(512, 480, 127, levels).unwrap()
    }

    fn pose(rpy: [f64; 3], z: f64) -> Isometry3<f64> {
        let rotation = UnitQuaternion::from_euler_angles(rpy[0], rpy[1], rpy[2]);
        let middle = rotation * Vector3::new(0.07, 0.04, 0.0);
        Isometry3::from_parts((Vector3::new(0.002, -0.003, z) - middle).into(), rotation)
    }

    #[test]
    fn dots_are_found_in_order_and_their_centres_to_a_few_hundredths_of_a_pixel() {
        let grid = DotGrid::paper();
        for (rpy, dark) in [([0.0, 0.0, 0.1], true), ([0.5, -0.2, 0.3], false), ([-0.3, 0.4, -0.6], true)] {
            let pose = pose(rpy, 0.42);
            let found = find(&rendered(&grid, &pose, 0.0, dark, 3), &grid, 0.0, 4).unwrap();
            assert_eq!(found.len(), 30);
            let (mut square, camera) = (0.0, Camera::metro_i());
            for (i, mark) in found.iter().enumerate() {
                let truth = Vector3::new((i % 6) as f64 * 0.028, (i / 6) as f64 * 0.020, 0.0);
                assert!((mark.target.xyz - truth).norm() < 1e-12 && mark.line == i + 1 && mark.image == 4);
                let [u, v] = camera.project(&(pose * Point3::from(truth)).coords).unwrap();
                square += ((mark.u_px - u).powi(2) + (mark.v_px - v).powi(2)) / 60.0;
            }
            // Without the correction for perspective.
            assert!(square.sqrt() < 0.15, "{rpy:?}: {}", square.sqrt());
        }
    }

    #[test]
    fn images_of_the_block_give_the_camera_of_the_paper() {
        let grid = DotGrid::paper();
        let pose = pose([0.35, -0.25, 0.1], 0.42);
        let mut marks = Vec::new();
        for (k, height) in [0.0, 0.045].into_iter().enumerate() {
            let image = rendered(&grid, &pose, height, true, 10 + k as u64);
            // One view: the camera has not moved between the two.
            marks.extend(find(&image, &grid, height, 0).unwrap());
        }
        let params = BlockParams { centre_px: Some(Unknown::From([256.0, 239.0])), ..BlockParams::default() };
        let plain = calibrate_marks(&marks, &Sensor::metro_i(), &params).unwrap();
        let fit = calibrate(&marks, grid.diameter_m, &Sensor::metro_i(), &params).unwrap();
        let off = |fit: &BlockFit| (fit.camera_from_target.iso.inverse() * pose).translation.vector.norm();
        assert!(fit.residual().rms < 0.05, "{:?}", fit.residual());
        for (i, truth) in [(place::F, 11.434), (place::K, 0.00335), (place::SCALE_U, 1.095)] {
            let (value, sigma) = (fit.solution.values[i], fit.solution.sigma(i));
            assert!((value - truth).abs() < 3.5 * sigma, "{i}: {value} ± {sigma}");
        }
        assert!(fit.residual().rms < plain.residual().rms || off(&fit) < off(&plain));
    }

    #[test]
    fn images_without_the_dots_are_refused() {
        let grid = DotGrid::paper();
        let flat = |level: u8| Image::new(64, 48, 127, vec![level; 64 * 48]).unwrap();
        let fault = |image: &Image| find(image, &grid, 0.0, 0).unwrap_err().to_string();
        assert!(fault(&flat(0)).contains("black"), "{}", fault(&flat(0)));
        assert!(fault(&flat(127)).contains("saturated"));
        let image = rendered(&grid, &pose([0.0; 3], 0.42), 0.0, true, 1);
        let other = DotGrid { columns: 7, ..grid };
        assert!(find(&image, &other, 0.0, 0).unwrap_err().to_string().contains("7 x 5 dots"));
        let millimetres = DotGrid { column_pitch_m: 28.0, ..grid };
        assert!(find(&image, &millimetres, 0.0, 0).unwrap_err().to_string().contains("are these millimetres?"));
    }
}
