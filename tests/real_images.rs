//! Images of a real slit, with the figures asked of them. The data is not in the repository: without it these are skipped.

use std::path::{Path, PathBuf};

use metromap::geometry::{Point, Robot, World, fit_line, fit_plane};
use metromap::image::{Capture, Image, Line, Reading};
use metromap::line::{Extractor, LineParams};
use metromap::optics::Camera;
use metromap::points::profile;
use metromap::sources::images::{Channel, ImageFolder, read_image};
use metromap::sources::rig_file::{self, RigFile};

/// Frames of flat floor; in 69 to 76 a block at the left edge lifts the slit.
const FLOOR: std::ops::RangeInclusive<u64> = 65..=86;
/// A peak farther than this from the fitted line is no inlier [px].
const INLIER_PX: f64 = 3.0;

fn data() -> Option<PathBuf> {
    let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data/slit_robot_floor"));
    if folder.is_dir() {
        return Some(folder.to_path_buf());
    }
    eprintln!("skipped: ../shared/data is absent");
    None
}

fn rig() -> RigFile {
    rig_file::load(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/rigs/robot_floor.toml"))).unwrap()
}

fn frame(folder: &Path, number: u64) -> Image {
    read_image(&folder.join(format!("img{number:04}.jpg")), Channel::default(), 255).unwrap()
}

/// How straight the line of one frame is.
struct Straightness {
    /// Columns with a peak, over all columns.
    found: f64,
    /// Columns with a peak within `INLIER_PX` of the line, over all columns.
    inliers: f64,
    /// RMS of the inliers' distances [px].
    rms_px: f64,
    /// Column and distance [px, down] of the peaks that are none.
    outliers: Vec<(usize, f64)>,
}

/// Each peak's line of sight, without the distortion, is put back on the pixel grid by fx and fy alone:
/// X = fx·x/z, Y = fy·y/z. Through all (X, Y) within `INLIER_PX` goes the line of least squared distances in Y, found
/// by fitting again until nothing changes. No column is left out before, nothing is smoothed along the line.
fn straightness(camera: &Camera, line: &Line) -> Straightness {
    let seen: Vec<(usize, (f64, f64))> = line
        .columns
        .iter()
        .enumerate()
        .filter_map(|(u, peak)| {
            let ray = camera.ray(u as f64, f64::from((*peak)?.v)).unwrap();
            Some((u, (camera.fx * ray.x, camera.fy * ray.y)))
        })
        .collect();
    let mut kept: Vec<(f64, f64)> = seen.iter().map(|(_, p)| *p).collect();
    let mut fit = fit_line(&kept).unwrap();
    let off = |fit: &metromap::geometry::LineFit, p: &(f64, f64)| p.1 - fit.slope * p.0 - fit.intercept;
    for limit in [20.0, 10.0, 5.0].into_iter().chain([INLIER_PX; 20]) {
        kept = seen.iter().map(|(_, p)| *p).filter(|p| off(&fit, p).abs() < limit).collect();
        fit = fit_line(&kept).unwrap();
    }
    let width = line.width() as f64;
    Straightness {
        found: line.count() as f64 / width,
        inliers: kept.len() as f64 / width,
        rms_px: fit.rms,
        outliers: seen.iter().map(|(u, p)| (*u, off(&fit, p))).filter(|(_, e)| e.abs() >= INLIER_PX).collect(),
    }
}

#[test]
fn the_line_on_a_real_floor_is_found_and_straight() {
    let Some(folder) = data() else { return };
    let camera = rig().rig.camera;
    let mut extractor = Extractor::new(LineParams::default()).unwrap();
    let (mut rms, mut found) = (Vec::new(), 0.0);
    for number in FLOOR {
        let result = straightness(&camera, &extractor.extract(&frame(&folder, number)));
        assert!(result.found >= 0.99, "frame {number}: {} of the columns found", result.found);
        assert!(result.inliers >= 0.97, "frame {number}: {} of the columns on the line", result.inliers);
        // No background may win a column: what is off the line is the block, at the left edge, above the line.
        for (u, off) in &result.outliers {
            assert!((69..=76).contains(&number) && *u < 20 && (-25.0..0.0).contains(off), "frame {number}: {u} {off}");
        }
        rms.push(result.rms_px);
        found += result.found / 22.0;
    }
    rms.sort_by(f64::total_cmp);
    let (median, worst) = ((rms[10] + rms[11]) / 2.0, rms[21]);
    eprintln!("frames 65-86: {found:.5} found, RMS {median:.3} px in the median frame, {worst:.3} px in the worst");
    assert!(found >= 0.999, "{found}");
    assert!(median <= 0.45, "{median}");
    assert!(worst <= 0.55, "{worst}");
}

#[test]
fn every_frame_has_a_line_and_the_blocks_lift_it() {
    let Some(folder) = data() else { return };
    let mut extractor = Extractor::new(LineParams::default()).unwrap();
    for number in (2..=29).chain(FLOOR) {
        let line = extractor.extract(&frame(&folder, number));
        assert!(line.count() > 540, "frame {number}: {} columns", line.count());
    }
    // Frame 6: the slit lies across the first block, columns 282 to 345 by eye at row 249, beside it at 275.
    let line = extractor.extract(&frame(&folder, 6));
    let row = |u: usize| line.columns[u].unwrap().v;
    assert!((row(310) - 249.0).abs() < 4.0 && (row(500) - 277.0).abs() < 4.0, "{} {}", row(310), row(500));
}

/// Every point of the frames in `numbers`, where the poses of the rig file put it.
fn mapped(folder: &Path, rig: &RigFile, numbers: std::ops::RangeInclusive<u64>) -> Vec<Point<World>> {
    let mut extractor = Extractor::new(rig.line).unwrap();
    let mut points = Vec::new();
    for capture in ImageFolder::open(folder, rig).unwrap() {
        let Capture { stamp, odom_from_robot, reading, .. } = capture.unwrap();
        let number = (stamp.as_secs() / 0.1).round() as u64;
        let Reading::Image(image) = reading else { panic!("a folder gives images") };
        if numbers.contains(&number) {
            let (seen, _) = profile(&rig.rig, &extractor.extract(&image), stamp, 0, 0).unwrap();
            let world_from_robot = metromap::geometry::Transform::<World, Robot>::from(odom_from_robot.iso);
            points.extend(seen.points.iter().map(|p| world_from_robot * p.point));
        }
    }
    points
}

#[test]
fn the_mapped_floor_is_flat_to_3_mm() {
    let Some(folder) = data() else { return };
    let rig = rig();
    let points = mapped(&folder, &rig, FLOOR);
    // The block is more than 25 mm high there.
    let floor: Vec<Point<World>> = points.iter().copied().filter(|p| p.xyz.z < 0.025).collect();
    assert!(floor.len() as f64 > 0.98 * points.len() as f64 && points.len() > 13_900, "{}", floor.len());
    let fit = fit_plane(&floor).unwrap();
    let normal = fit.plane.normal * fit.plane.normal.z.signum();
    eprintln!(
        "floor of frames 65-86: flat to {:.2} mm RMS, tilted by {:.4} along x and {:.4} along y",
        fit.rms * 1e3,
        -normal.x,
        -normal.y
    );
    assert!(fit.rms <= 0.003, "{}", fit.rms);
    assert!(fit.centre.xyz.z.abs() < 0.001 && normal.y.abs() < 0.002, "{:?}", fit);
}

/// Heights over the floor within a rectangle of the map [m].
fn heights(points: &[Point<World>], x: [f64; 2], y: [f64; 2]) -> (f64, f64, usize) {
    let inside = |p: &&Point<World>| (x[0]..x[1]).contains(&p.xyz.x) && (y[0]..y[1]).contains(&p.xyz.y);
    let mut z: Vec<f64> = points.iter().filter(inside).map(|p| p.xyz.z).collect();
    z.sort_by(f64::total_cmp);
    let median = z[z.len() / 2];
    let near: Vec<f64> = z.iter().copied().filter(|z| (z - median).abs() < 0.02).collect();
    let rms = (near.iter().map(|z| (z - median).powi(2)).sum::<f64>() / near.len() as f64).sqrt();
    (median, rms, z.len())
}

#[test]
fn the_blocks_stand_on_the_floor_with_flat_tops() {
    let Some(folder) = data() else { return };
    let points = mapped(&folder, &rig(), 2..=29);
    let (floor, floor_rms, _) = heights(&points, [0.55, 0.95], [-0.30, -0.10]);
    assert!(floor.abs() < 0.005 && floor_rms < 0.003, "{floor} {floor_rms}");
    // Two blocks lie on their broad side, two stand on their narrow side: pieces of one board, 38 mm by 89 mm by name.
    for (name, x, y, expected) in [
        ("light block, lying", [0.56, 0.64], [-0.01, 0.05], 0.036),
        ("dark block, lying", [0.62, 0.70], [0.07, 0.13], 0.036),
        ("white block, standing", [0.79, 0.86], [-0.04, -0.01], 0.085),
        ("brown block, standing", [0.82, 0.88], [0.15, 0.18], 0.085),
    ] {
        let (height, rms, count) = heights(&points, x, y);
        eprintln!(
            "{name}: {:.1} mm over the floor, flat to {:.1} mm, {count} points",
            (height - floor) * 1e3,
            rms * 1e3
        );
        assert!(count > 50, "{name}: {count}");
        assert!((height - floor - expected).abs() < 0.006, "{name}: {height}");
        assert!(rms < 0.005, "{name}: {rms}");
    }
}
