//! Drawings to scale and plots of a design.

use super::bench::{Bench, V3};
use super::budget::{Row, TERMS};
use super::{Design, TARGETS};
use crate::report::{Drawing, Ink, Plot, Series, Style};

/// Colours of the drawings, as numbers of the report's palette.
const SEEN: usize = 0;
const BEAM: usize = 1;
const FLOOR: usize = 2;
const BODY: usize = 5;
const WANTED: usize = 6;
const BLIND: usize = 3;

/// Colours of the terms.
const INK: [usize; 8] = [0, 1, 2, 6, 4, 7, 3, 5];

fn rectangle(x: [f64; 2], y: [f64; 2]) -> Vec<(f64, f64)> {
    vec![(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
}

/// A mark, as large in every drawing; `span` is what the drawing shows of x.
fn square(x: f64, y: f64, span: [f64; 2]) -> Vec<(f64, f64)> {
    let half = (span[1] - span[0]) * 0.007;
    rectangle([x - half, x + half], [y - half, y + half])
}

/// Robot, camera, beam, floor and blind zone from the side.
pub(super) fn side(all: &Design) -> Drawing {
    let bench = Bench::new(&all.instrument.rig, &all.instrument.image);
    let (view, params) = (&all.view, &all.params);
    let far = view.floor_m.map_or(params.range_m[1], |floor| floor[1]).max(params.range_m[1]).min(12.0);
    let x_range = [-params.robot_radius_m - 0.2, far + 0.2];
    let table = if view.table_seen_to_m.is_some() { params.table_m } else { 0.0 };
    let top = bench.eye.z.max(bench.source.z).max(table).max(params.volume.z_m[1]) * 1.1;
    // Depth of the bars that mark the floor.
    let under = (x_range[1] - x_range[0]) * 0.011;
    let mut drawing = Drawing::new("From the side", ("X ahead", x_range), ("Z", [-1.6 * under, top]));
    let rays = bench.edges().unwrap_or([V3::x(), V3::x()]);
    let end = |ray: V3| {
        let to_floor = if ray.z < 0.0 { -bench.eye.z / ray.z } else { f64::INFINITY };
        bench.eye + ray * to_floor.min((x_range[1] - bench.eye.x) / ray.x.max(1e-9))
    };
    let (upper, lower) = (end(rays[0]), end(rays[1]));
    let mut wedge = vec![(bench.eye.x, bench.eye.z), (upper.x, upper.z)];
    if upper.z > 0.0 && lower.z <= 1e-6 {
        wedge.push((upper.x, 0.0));
    }
    wedge.push((lower.x, lower.z));
    drawing = drawing.with("the camera sees", Ink::Fill(SEEN), wedge);
    if let Some([near, far]) = view.floor_m {
        drawing = drawing.with(
            "floor it sees",
            Ink::Solid(FLOOR),
            rectangle([near, far.max(near + under / 2.0)], [-under, 0.0]),
        );
    }
    if let Some([edge, near]) = view.blind_m {
        drawing = drawing.with("blind on the floor", Ink::Solid(BLIND), rectangle([edge, near], [-under, 0.0]));
    }
    let (eye, source) = (bench.eye, bench.source);
    let deck = (eye.z.min(source.z) - 0.1).max(0.1);
    let body = rectangle([-params.robot_radius_m, params.robot_radius_m], [0.05, deck]);
    drawing = drawing.with("robot", Ink::Solid(BODY), body);
    let head = [eye.x.min(source.x).min(0.0) - 0.08, eye.x.max(source.x).max(0.0) + 0.06];
    let cylinder = rectangle(head, [deck, eye.z.max(source.z) + 0.06]);
    drawing = drawing.with("", Ink::Fill(BODY), cylinder);
    let beam = all.upright_beam_deg.to_radians();
    if let Some(sheet) = bench.sheet(beam) {
        let along = sheet.forward;
        let down = if along.z < 0.0 { -source.z / along.z } else { f64::INFINITY };
        let to = source + along * down.min((x_range[1] - source.x) / along.x.max(1e-9));
        let name = format!("beam {:.1}° down", (-along.z).asin().to_degrees());
        drawing = drawing.with(&name, Ink::Line(BEAM), vec![(source.x, source.z), (to.x, to.z)]);
    }
    drawing = drawing.with("", Ink::Solid(SEEN), square(eye.x, eye.z, x_range)).with(
        "",
        Ink::Solid(BEAM),
        square(source.x, source.z, x_range),
    );
    let v = params.volume;
    drawing = drawing.with("wanted volume", Ink::Fill(WANTED), rectangle(v.x_m, v.z_m));
    if let Some(seen_to) = view.table_seen_to_m.filter(|x| *x < x_range[1]) {
        let z = params.table_m;
        drawing = drawing
            .with("table top, seen", Ink::Line(4), vec![(params.robot_radius_m + 0.1, z), (seen_to, z)])
            .with("table top, not seen", Ink::Dashed(BODY), vec![(seen_to, z), (seen_to + 1.0, z)]);
    }
    drawing
}

/// The picture's footprint on the floor, from above.
pub(super) fn footprint(all: &Design) -> Option<Drawing> {
    let [near, far] = all.view.floor_m.filter(|[near, far]| far > near)?;
    let bench = Bench::new(&all.instrument.rig, &all.instrument.image);
    let camera = &bench.rig.camera;
    let params = &all.params;
    let on_floor = |u: f64, v: f64| {
        let ray = bench.ray(u, v)?;
        let point = bench.eye - ray * (bench.eye.z / ray.z);
        (ray.z < 0.0 && point.x <= far * 1.2 && point.x > 0.0).then_some((point.x, point.y))
    };
    let (right, bottom) = (camera.width as f64 - 1.0, camera.height as f64 - 1.0);
    let part = |i: i32| f64::from(i) / 40.0;
    let along = |f: &dyn Fn(f64) -> (f64, f64)| {
        (0..=40)
            .filter_map(|i| {
                let (u, v) = f(part(i));
                on_floor(u, v)
            })
            .collect::<Vec<_>>()
    };
    let mut edge = along(&|t| (right * t, bottom));
    edge.extend(along(&|t| (right, bottom * (1.0 - t))));
    edge.extend(along(&|t| (right * (1.0 - t), 0.0)));
    edge.extend(along(&|t| (0.0, bottom * t)));
    let half =
        edge.iter().map(|p| p.1.abs()).fold(params.volume.y_m[1].abs().max(params.volume.y_m[0].abs()), f64::max);
    let half = half.max(params.robot_radius_m) * 1.4 + 0.2;
    let mut drawing = Drawing::new(
        "From above",
        ("X ahead", [-params.robot_radius_m - 0.2, far + 0.3]),
        ("Y to the left", [-half, half]),
    );
    drawing = drawing.with("floor in the picture", Ink::Fill(FLOOR), edge);
    let round = |radius: f64, from: f64, to: f64| -> Vec<(f64, f64)> {
        (0..=72)
            .map(|i| from + (to - from) * f64::from(i) / 72.0)
            .map(|a| (radius * a.cos(), radius * a.sin()))
            .collect()
    };
    let turns = bench.rig.cylinder.rad_per_pulse != 0.0;
    if turns {
        drawing = drawing.with("floor seen, cylinder turned", Ink::Dashed(FLOOR), round(near, -1.6, 1.6)).with(
            "",
            Ink::Dashed(FLOOR),
            round(far, -1.6, 1.6),
        );
    }
    let fan = |side: f64| -> Vec<(f64, f64)> {
        let spot = |x: f64| {
            let point = bench.floor_at(x)?;
            let sheet = bench.sheet(bench.beam_to(&point)?)?;
            let ahead = (point - sheet.origin.xyz).dot(&sheet.forward);
            let at = point + sheet.lateral * (side * bench.rig.sheet.width_m(ahead) / 2.0);
            Some((at.x, at.y))
        };
        (0..=20).filter_map(|i| spot(near + (far - near) * f64::from(i) / 20.0)).collect()
    };
    drawing = drawing.with("edge of the sheet (1/e²)", Ink::Line(BEAM), fan(1.0)).with("", Ink::Line(BEAM), fan(-1.0));
    drawing = drawing.with("robot", Ink::Solid(BODY), round(params.robot_radius_m, 0.0, std::f64::consts::TAU));
    Some(drawing.with("wanted volume", Ink::Fill(WANTED), rectangle(params.volume.x_m, params.volume.y_m)))
}

/// The chosen lines in the wanted volume.
pub(super) fn beams(all: &Design) -> Option<Drawing> {
    let watch = &all.volume;
    if watch.lines.is_empty() {
        return None;
    }
    let bench = Bench::new(&all.instrument.rig, &all.instrument.image);
    let v = watch.volume;
    let (source, eye) = (bench.source, bench.eye);
    let x_range = [-0.1, v.x_m[1] + 0.3];
    let top = source.z.max(eye.z).max(v.z_m[1]) + 0.1;
    let mut drawing =
        Drawing::new("Lines for the wanted volume", ("X ahead", x_range), ("Z", [v.z_m[0].min(0.0) - 0.05, top]));
    drawing = drawing.with("wanted volume", Ink::Fill(WANTED), rectangle(v.x_m, v.z_m));
    for (i, ray) in bench.edges()?.into_iter().enumerate() {
        let to = eye + ray * ((x_range[1] - eye.x) / ray.x);
        drawing = drawing.with(
            if i == 0 { "edges of the picture" } else { "" },
            Ink::Dashed(SEEN),
            vec![(eye.x, eye.z), (to.x, to.z)],
        );
    }
    let name = format!("{} lines", watch.lines.len());
    for line in &watch.lines {
        let slope = line.beam_deg.to_radians().tan();
        let x1 = line.floor_m.unwrap_or(x_range[1]);
        let z1 = source.z - (x1 - source.x) * slope;
        drawing = drawing.with(&name, Ink::Thin(BEAM), vec![(source.x, source.z), (x1, z1)]);
    }
    let floor = watch.lines.iter().filter_map(|line| line.floor_m);
    for x in floor {
        drawing = drawing.with(
            "where they meet the floor",
            Ink::Solid(BEAM),
            rectangle([x - 0.006, x + 0.006], [v.z_m[0] - 0.025, v.z_m[0] + 0.025]),
        );
    }
    Some(drawing.with("", Ink::Solid(SEEN), square(eye.x, eye.z, x_range)).with(
        "",
        Ink::Solid(BEAM),
        square(source.x, source.z, x_range),
    ))
}

/// Terms that are anything anywhere.
fn present(rows: &[Row], pick: fn(&Row) -> &super::Terms) -> Vec<usize> {
    (0..TERMS.len()).filter(|i| rows.iter().any(|row| pick(row).list()[*i] > 1e-3)).collect()
}

/// Error by source, by factors.
pub(super) fn errors(title: &str, rows: &[Row], pick: fn(&Row) -> &super::Terms, axis: &str) -> Plot {
    let mut plot = Plot::new(title, "X from the robot's centre", "m", axis, "mm, 1 σ").log_y();
    // What never reaches a thousandth of the whole would only press the rest together.
    let most = rows.iter().map(|row| pick(row).total_mm).fold(0.0, f64::max);
    for i in present(rows, pick) {
        let points: Vec<_> = rows.iter().map(|row| (row.range_m, pick(row).list()[i])).collect();
        if points.iter().any(|p| p.1 > most * 1e-3) {
            plot = plot.with(Series::new(TERMS[i].1, Style::Line, points).coloured(INK[i]));
        }
    }
    let whole = rows.iter().map(|row| (row.range_m, pick(row).instrument_mm)).collect();
    plot.with(Series::new("the instrument", Style::Dashed, whole).coloured(BODY))
}

/// Shares of the instrument's variance, one upon the other.
pub(super) fn shares(title: &str, rows: &[Row]) -> Plot {
    let mut plot =
        Plot::new(title, "X from the robot's centre", "m", "share of the instrument's variance", "%").from_zero();
    let pick: fn(&Row) -> &super::Terms = |row| &row.range;
    let rows: Vec<&Row> =
        rows.iter().filter(|row| row.range.instrument_mm.is_finite() && row.range.instrument_mm > 0.0).collect();
    let mut under = vec![0.0; rows.len()];
    for (i, (_, name)) in TERMS.iter().enumerate().take(6) {
        let share = |row: &Row| 100.0 * (pick(row).list()[i] / row.range.instrument_mm).powi(2);
        if rows.iter().all(|row| share(row) < 0.3) {
            continue;
        }
        let over: Vec<f64> = rows.iter().zip(&under).map(|(row, below)| below + share(row)).collect();
        let up = rows.iter().zip(&over).map(|(row, y)| (row.range_m, *y));
        let back = rows.iter().zip(&under).rev().map(|(row, y)| (row.range_m, *y));
        plot = plot.with(Series::new(*name, Style::Area, up.chain(back).collect()).coloured(INK[i]));
        under = over;
    }
    plot
}

type Pick = fn(&Row) -> f64;

fn several(plot: Plot, rows: &[Row], what: &[(&str, Pick)]) -> Plot {
    what.iter().fold(plot, |plot, (name, pick)| {
        let points: Vec<_> = rows.iter().map(|row| (row.range_m, pick(row))).collect();
        if points.iter().any(|p| p.1 > 0.0) { plot.with(Series::new(*name, Style::Line, points)) } else { plot }
    })
}

/// What a pixel, a pulse and a milliradian cost.
pub(super) fn sensitivity(title: &str, rows: &[Row]) -> Plot {
    let plot = Plot::new(title, "X from the robot's centre", "m", "range", "mm").from_zero();
    several(
        plot,
        rows,
        &[
            ("a pixel", |row| row.mm_per_px),
            ("a pulse of the mirror", |row| row.mm_per_pulse),
            ("a mrad of camera pitch", |row| row.mm_per_mrad_pitch),
        ],
    )
}

/// What can be told apart on the floor.
pub(super) fn sampling(rows: &[Row]) -> Plot {
    let plot = Plot::new("What can be told apart on the floor", "X from the robot's centre", "m", "size", "mm").log_y();
    several(
        plot,
        rows,
        &[
            ("lines of neighbouring pulses", |row| row.floor_mm_per_pulse.unwrap_or(f64::NAN)),
            ("lowest step, between lines", |row| row.smallest_step_mm),
            ("lowest step, within a line", |row| row.smallest_step_in_line_mm),
            ("a column", |row| row.mm_per_column),
        ],
    )
}

/// Peak levels of floors of several albedos.
pub(super) fn floor_levels(all: &Design) -> Plot {
    let mut plot =
        Plot::new("Peak of the stripe on the floor, indoors", "X from the robot's centre", "m", "level", "").log_y();
    let albedo = all.params.albedo;
    for (name, target) in TARGETS {
        let points = all.floor.iter().map(|row| (row.range_m, row.peak_level * target / albedo)).collect();
        plot = plot.with(Series::new(format!("{name} floor ({:.0} %)", target * 100.0), Style::Line, points));
    }
    let ends: Vec<f64> = all.floor.first().into_iter().chain(all.floor.last()).map(|row| row.range_m).collect();
    limits(plot, all, &ends)
}

/// Peak levels of targets that face the instrument.
pub(super) fn facing_levels(all: &Design) -> Plot {
    let title = "Peak of the stripe on a target that faces it, indoors";
    let mut plot = Plot::new(title, "distance", "m", "level", "").log_y();
    let rows: Vec<_> = all.light.facing.iter().filter(|row| row.distance_m >= 0.5).collect();
    for (name, target) in TARGETS {
        let points = rows.iter().map(|row| (row.distance_m, row.peak_level * target / 0.5)).collect();
        plot = plot.with(Series::new(format!("{name} ({:.0} %)", target * 100.0), Style::Line, points));
    }
    limits(plot, all, &[0.5, 8.0])
}

fn limits(plot: Plot, all: &Design, ends: &[f64]) -> Plot {
    let flat = |y: f64| ends.iter().map(|x| (*x, y)).collect::<Vec<_>>();
    plot.with(
        Series::new("full pixel", Style::Dashed, flat(all.light.white_level - all.light.background_level))
            .coloured(BODY),
    )
    .with(Series::new("needed to be found", Style::Dashed, flat(all.light.found_level)).coloured(6))
}

/// Power along the line, as far as the picture reaches.
pub(super) fn line_power(all: &Design) -> Plot {
    let mut plot =
        Plot::new("Power along the line, within the picture", "from its middle", "m", "power", "mW/m").from_zero();
    let sheet = &all.instrument.rig.sheet;
    for row in [1, 3, 5].iter().filter_map(|i| all.view.widths.get(*i)) {
        let at = |i: i32| row.width_m * f64::from(i) / 80.0;
        let points = (-40..=40).map(|i| (at(i), sheet.line_power_w_per_m(row.distance_m, at(i)) * 1e3)).collect();
        plot = plot.with(Series::new(format!("at {} m", super::words::short(row.distance_m, 3)), Style::Line, points));
    }
    plot
}

/// Width of the stripe in the image and thickness of the sheet.
pub(super) fn stripe(all: &Design) -> Plot {
    let rows = if all.floor.is_empty() { &all.upright } else { &all.floor };
    let plot =
        Plot::new("Width of the stripe in the image", "X from the robot's centre", "m", "RMS width, noise", "px")
            .log_y();
    several(
        plot,
        rows,
        &[
            ("stripe, before the pixel's own", |row| row.stripe_px),
            ("row, by noise", |row| row.pixel_noise_px),
            ("row, by speckle", |row| row.speckle_px),
        ],
    )
}
