//! What the camera can see at all: angles, floor, ceiling, the blind zone.

use serde::Serialize;

use super::bench::{Bench, V3};
use super::params::DesignParams;
use crate::fault::{Fault, Result};

/// Width of the picture at one distance along the view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Width {
    /// Distance along the viewing axis [m].
    pub distance_m: f64,
    /// Width that the camera sees there, through its lens [m].
    pub width_m: f64,
    /// The same without the lens' distortion, as the paper has it [m].
    pub width_pinhole_m: f64,
    /// A column there, without distortion [mm].
    pub mm_per_column: f64,
    /// A row there, without distortion [mm].
    pub mm_per_row: f64,
    /// Width of the sheet, 1/e² [m].
    pub sheet_width_m: f64,
    /// Thickness of the sheet, 1/e² half width [mm].
    pub sheet_thickness_mm: f64,
    /// Share of the line's power that falls into the picture.
    pub power_share: f64,
}

/// What the camera sees, cylinder straight ahead, in the column of its axis.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct View {
    /// From the left to the right edge, through the lens [°].
    pub horizontal_deg: f64,
    /// From the top to the bottom edge [°].
    pub vertical_deg: f64,
    /// The same without distortion [°].
    pub horizontal_pinhole_deg: f64,
    /// The same without distortion [°].
    pub vertical_pinhole_deg: f64,
    /// Depression of the lines of sight of the top and the bottom row [°].
    pub depression_deg: [f64; 2],
    /// X of the camera's centre and its height over the floor [m].
    pub camera_m: [f64; 2],
    /// X of where the light comes from and its height [m].
    pub laser_m: [f64; 2],
    /// Beam angles that the mirror can make, flattest and steepest [°]; one angle twice where it stands still.
    pub beam_deg: [f64; 2],
    /// X between which camera and beam meet the floor [m]; null where they do not.
    pub floor_m: Option<[f64; 2]>,
    /// Blind on the floor, from the robot's edge to where its floor begins [m]; null where there is none.
    pub blind_m: Option<[f64; 2]>,
    /// Nothing is seen above Z = ceiling_m − ceiling_slope·(X − camera_m[0]): the height [m].
    pub ceiling_m: f64,
    /// Its slope.
    pub ceiling_slope: f64,
    /// A table top of the example's height is seen only nearer than this X [m]; null: nowhere, or everywhere.
    pub table_seen_to_m: Option<f64>,
    /// How high the camera sees at the ends and in the middle of the floor it sees, or of the asked range: X, Z [m].
    pub sees_up_to_m: Vec<[f64; 2]>,
    /// What a thing of 0.1 m hides of the floor behind it from the laser: X, length [m].
    pub shadow_m: Vec<[f64; 2]>,
    /// Widths over distance.
    pub widths: Vec<Width>,
}

/// Height of the thing whose shadow is told [m].
pub(super) const SHADOW_OF_M: f64 = 0.1;

/// Looks through the camera.
///
/// Errors: a lens that cannot be undone at the edges of its middle column.
pub(super) fn view(bench: &Bench, params: &DesignParams) -> Result<View> {
    let camera = &bench.rig.camera;
    let (u, v) = (bench.middle_column(), (camera.height as f64 - 1.0) / 2.0);
    let (right, bottom) = (camera.width as f64 - 0.5, camera.height as f64 - 0.5);
    let blind = || Fault::new("camera", "a lens that cannot be undone at its edge", "a lens model that can");
    let [top_ray, bottom_ray] = bench.edges().ok_or_else(blind)?;
    let ray = |u: f64, v: f64| bench.ray(u, v).ok_or_else(blind);
    let angle = |a: V3, b: V3| a.angle(&b).to_degrees();
    let depression = |ray: V3| (-ray.z).atan2(ray.x.hypot(ray.y)).to_degrees();
    let sides = [ray(-0.5, v)?, ray(right, v)?];
    let normalised = |u: f64| camera.ray(u, v).map_or(f64::NAN, |r| r.x);
    let across = normalised(right) - normalised(-0.5);
    let pinhole = |size: usize, focal: f64| (2.0 * (size as f64 / 2.0 / focal).atan()).to_degrees();
    let sheet = &bench.rig.sheet;
    let width = |distance_m: f64| {
        let width_m = across * distance_m;
        let sheet_width_m = sheet.width_m(distance_m);
        Width {
            distance_m,
            width_m,
            width_pinhole_m: camera.width as f64 / camera.fx * distance_m,
            mm_per_column: distance_m / camera.fx * 1e3,
            mm_per_row: distance_m / camera.fy * 1e3,
            sheet_width_m,
            sheet_thickness_mm: sheet.thickness_m(distance_m) * 1e3,
            power_share: 2.0 * super::detector::normal(2.0 * width_m / sheet_width_m) - 1.0,
        }
    };
    let floor_m = floor(bench, [top_ray, bottom_ray]);
    let ceiling_slope = if top_ray.x > 1e-9 { -top_ray.z / top_ray.x } else { f64::INFINITY };
    let ceiling = |x: f64| bench.eye.z - ceiling_slope * (x - bench.eye.x);
    let table_at = bench.eye.x + (bench.eye.z - params.table_m) / ceiling_slope;
    let beam_deg = match bench.beam() {
        Some(axis) => {
            let ends = [axis.pulse_min, axis.pulse_max].map(|p| axis.zero_rad + f64::from(p) * axis.rad_per_pulse);
            [ends[0].min(ends[1]).to_degrees(), ends[0].max(ends[1]).to_degrees()]
        }
        None => [bench.sheet(0.0).map_or(f64::NAN, |s| depression(s.forward)); 2],
    };
    let [near, far] = floor_m.unwrap_or(params.range_m);
    let over = bench.source.z - SHADOW_OF_M;
    let shadow = |x: f64| [x, (x - bench.source.x) * SHADOW_OF_M / over];
    // A finder of short range is looked at nearer.
    let scale = if bench.rig.range_m_max >= 2.0 { 1.0 } else { bench.rig.range_m_max / 4.0 };
    let distances = [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0].map(|d| d * scale);
    Ok(View {
        horizontal_deg: angle(sides[0], sides[1]),
        vertical_deg: angle(ray(u, -0.5)?, ray(u, bottom)?),
        horizontal_pinhole_deg: pinhole(camera.width, camera.fx),
        vertical_pinhole_deg: pinhole(camera.height, camera.fy),
        depression_deg: [depression(top_ray), depression(bottom_ray)],
        camera_m: [bench.eye.x, bench.eye.z],
        laser_m: [bench.source.x, bench.source.z],
        beam_deg,
        floor_m,
        blind_m: floor_m.map(|[near, _]| [params.robot_radius_m, near]).filter(|[edge, near]| near > edge),
        ceiling_m: bench.eye.z,
        ceiling_slope,
        table_seen_to_m: (ceiling_slope > 0.0 && table_at.is_finite() && table_at > 0.0).then_some(table_at),
        sees_up_to_m: [near, (near + far) / 2.0, far].map(|x| [x, ceiling(x).max(0.0)]).to_vec(),
        shadow_m: if over > 0.0 { [near, (near + far) / 2.0, far].map(shadow).to_vec() } else { Vec::new() },
        widths: distances.map(width).to_vec(),
    })
}

/// X between which the camera sees the floor lit: by its rows, the beam's travel and the farthest range.
fn floor(bench: &Bench, [top, bottom]: [V3; 2]) -> Option<[f64; 2]> {
    let meets = |ray: V3| if ray.z < 0.0 { bench.eye.x - bench.eye.z / ray.z * ray.x } else { f64::INFINITY };
    let far = meets(top).min(bench.rig.range_m_max);
    let near = meets(bottom);
    if !(bench.eye.z > 0.0 && near.is_finite() && far.is_finite()) {
        return None;
    }
    if bench.beam().is_none() {
        // A sheet that stands still meets the floor at one X, if at all.
        let sheet = bench.sheet(0.0)?;
        let x = (sheet.plane.offset - sheet.plane.normal.y * bench.eye.y) / sheet.plane.normal.x;
        return (x >= near && x <= far).then_some([x, x]);
    }
    let reached = |x: f64| bench.floor_at(x).and_then(|p| bench.beam_to(&p)).is_some_and(|b| bench.in_travel(b));
    let steps = 2000;
    let at = |i: i32| near + (far - near) * f64::from(i) / f64::from(steps);
    let first = (0..=steps).find(|i| reached(at(*i)))?;
    let last = (first..=steps).rev().find(|i| reached(at(*i)))?;
    Some([at(first), at(last)])
}
