//! A first plane that stray stripes cannot pull: a reflection, an edge, a board that moved.
//!
//! Each stripe on a posed board is a line in space, and two such lines that are not one give a plane. Of the planes through pairs
//! of stripes the one is taken that the larger half of all stripes fits best (least median of squares, Rousseeuw 1984); then the
//! half that fits is fitted and chosen in turn until it stays the same. One plane through all would be pulled so far by a single
//! stray stripe among eight that the stray one no longer shows.

use nalgebra::Vector3;

use super::bundle::Member;
use super::cut::{crossing, from_crossing_ray};
use super::met;
use crate::calibration::tsai::Shape;
use crate::fault::{Fault, Result};
use crate::geometry::{Camera as CameraFrame, Plane, Point, fit_plane};
use crate::optics::Camera;

/// Points of a stripe that are looked at here.
const POINTS: usize = 16;
/// Pairs that are tried.
const PAIRS_MAX: usize = 600;
/// Turns of choosing and fitting.
const TURNS_MAX: usize = 20;
/// Half of the stripes must be nearer to the plane than this part of the image's diagonal: farther off they are on none.
const OFF_PART_MAX: f64 = 0.01;
/// Stripes are not asked to be closer than this [px].
const OFF_PX_MIN: f64 = 0.05;

/// A stripe on its board.
struct Line {
    /// Which member's.
    member: usize,
    /// Lines of sight (x, y, 1).
    rays: Vec<Vector3<f64>>,
    /// Where they meet the board.
    places: Vec<Point<CameraFrame>>,
}

/// The plane that most stripes lie on, with n·x = d, d > 0; and the members whose stripes do.
///
/// Errors: a stripe on one board only, or on boards that leave all its points on one line; a plane through the camera's centre;
/// stripes of which no half is on one plane.
pub(super) fn first_plane(
    camera: &Camera,
    members: &[Member],
    outlier_sigmas: f64,
) -> Result<(Plane<CameraFrame>, Vec<usize>)> {
    let lines: Vec<Line> = members.iter().enumerate().filter_map(|(i, m)| line_of(camera, i, m)).collect();
    if lines.len() < 2 {
        let expected =
            "on at least 2 boards, better 10 at different distances and tilts: one line does not give a plane";
        return Err(Fault::new("stripe", format!("on {} boards", lines.len()), expected));
    }
    let half = (lines.len() + 3) / 2;
    let off =
        |plane: &Plane<CameraFrame>| -> Vec<f64> { lines.iter().map(|l| off_px(camera, members, l, plane)).collect() };
    let mut best: Option<(f64, Plane<CameraFrame>)> = None;
    for (i, j) in pairs(lines.len()) {
        let Ok(plane) = through(&[&lines[i], &lines[j]]) else { continue };
        let cost = nth(&off(&plane), half);
        if best.as_ref().is_none_or(|(known, _)| cost < *known) {
            best = Some((cost, plane));
        }
    }
    // Why no pair gives a plane, all together tell.
    let Some((_, mut plane)) = best else {
        return through(&lines.iter().collect::<Vec<_>>()).map(|p| (p, all(&lines)));
    };
    let mut chosen: Vec<usize> = Vec::new();
    for _ in 0..TURNS_MAX {
        let off = off(&plane);
        let mut order: Vec<usize> = (0..lines.len()).collect();
        order.sort_by(|a, b| off[*a].total_cmp(&off[*b]));
        order.truncate(half);
        order.sort_unstable();
        if order == chosen {
            break;
        }
        plane = through(&order.iter().map(|i| &lines[*i]).collect::<Vec<_>>())?;
        chosen = order;
    }
    let off = off(&plane);
    let middle = nth(&off, half);
    let most = OFF_PART_MAX * (camera.width as f64).hypot(camera.height as f64);
    if middle.is_nan() || middle > most {
        let found = format!("on no common plane: the better half of {} is {middle:.1} px off any", lines.len());
        let expected =
            "one plane of light on all boards; without the laser, pieces of the board's own edges look like this";
        return Err(Fault::new("stripes", found, expected));
    }
    let limit = limit_px(middle, outlier_sigmas);
    let near: Vec<&Line> = lines.iter().zip(&off).filter(|(_, off)| **off <= limit).map(|(line, _)| line).collect();
    let plane = through(&near)?;
    Ok((plane, near.iter().map(|line| line.member).collect()))
}

/// The plane of least squared distances through all stripes, and the members that have one.
pub(super) fn first_of_all(camera: &Camera, members: &[Member]) -> Result<(Plane<CameraFrame>, Vec<usize>)> {
    let lines: Vec<Line> = members.iter().enumerate().filter_map(|(i, m)| line_of(camera, i, m)).collect();
    through(&lines.iter().collect::<Vec<_>>()).map(|plane| (plane, all(&lines)))
}

/// Stripes farther off than this in the image [px] are stray where the middle one is off by `middle_px`.
pub(super) fn limit_px(middle_px: f64, outlier_sigmas: f64) -> f64 {
    outlier_sigmas * middle_px.max(OFF_PX_MIN)
}

fn all(lines: &[Line]) -> Vec<usize> {
    lines.iter().map(|line| line.member).collect()
}

fn line_of(camera: &Camera, member: usize, of: &Member) -> Option<Line> {
    let every = of.points.len().div_ceil(POINTS).max(1);
    let mut line = Line { member, rays: Vec::new(), places: Vec::new() };
    for [u, v] in of.points.iter().step_by(every) {
        let Some(ray) = camera.ray(*u, *v) else { continue };
        let Some(place) = met(&of.camera_from_board, &ray) else { continue };
        line.rays.push(ray);
        line.places.push(place.into());
    }
    (line.rays.len() >= 2).then_some(line)
}

/// RMS distance of a stripe from where plane and board cross in the image [px]; infinite where they do not.
fn off_px(camera: &Camera, members: &[Member], line: &Line, plane: &Plane<CameraFrame>) -> f64 {
    let m = plane.normal / plane.offset;
    let Some(crossing) = crossing(&members[line.member].camera_from_board, &m) else { return f64::INFINITY };
    let square: f64 = line.rays.iter().map(|ray| from_crossing_ray(camera, &crossing, ray).powi(2)).sum();
    (square / line.rays.len() as f64).sqrt()
}

/// The `n`th smallest, from 1.
fn nth(values: &[f64], n: usize) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(n.clamp(1, sorted.len().max(1)) - 1).copied().unwrap_or(f64::INFINITY)
}

/// All pairs, or evenly some of them where they are many.
fn pairs(count: usize) -> impl Iterator<Item = (usize, usize)> {
    let every = (count * (count - 1) / 2).div_ceil(PAIRS_MAX).max(1);
    (0..count).flat_map(move |j| (0..j).map(move |i| (i, j))).step_by(every)
}

/// The plane of least squared distances through stripes on their boards.
fn through(lines: &[&Line]) -> Result<Plane<CameraFrame>> {
    let points: Vec<Point<CameraFrame>> = lines.iter().flat_map(|line| line.places.iter().copied()).collect();
    let places: Vec<Vector3<f64>> = points.iter().map(|p| p.xyz).collect();
    let [length, width, _] = Shape::of(&places).extents_m;
    let fit = fit_plane(&points).filter(|_| width > 0.02 * length).ok_or_else(|| {
        let found = format!("on one line in space ({:.2} mm across {:.1} mm)", width * 1e3, length * 1e3);
        Fault::new("stripes", found, "boards at different distances: move or tilt the board along the line of sight")
    })?;
    let plane = if fit.plane.offset < 0.0 { Plane::new(-fit.plane.normal, -fit.plane.offset) } else { Some(fit.plane) };
    plane.filter(|plane| plane.offset > 1e-3).ok_or_else(|| {
        let found = format!("a plane {:.3} mm from the camera's centre", fit.plane.offset.abs() * 1e3);
        Fault::new("stripes", found, "at least 1 mm: nothing can be triangulated otherwise")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_are_all_or_evenly_some() {
        assert_eq!(pairs(3).collect::<Vec<_>>(), [(0, 1), (0, 2), (1, 2)]);
        assert_eq!(pairs(2).count(), 1);
        let many: Vec<_> = pairs(200).collect();
        assert!((300..=PAIRS_MAX).contains(&many.len()) && many.iter().all(|(i, j)| i < j && *j < 200));
    }

    #[test]
    fn the_nth_smallest_is_found_among_whatever_there_is() {
        assert_eq!((nth(&[3.0, 1.0, 2.0], 2), nth(&[3.0], 5)), (2.0, 3.0));
        assert_eq!((nth(&[], 1), nth(&[f64::NAN, 1.0], 1)), (f64::INFINITY, 1.0));
    }
}
