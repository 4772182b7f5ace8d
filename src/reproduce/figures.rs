//! Figures 8 to 13 as far as geometry alone gives them.

use std::collections::BTreeMap;

use super::tables::{PULSE_RAD, Sensitivity, TABLE_5};
use super::{Drawn, Row};
use crate::fault::{Fault, Result};
use crate::geometry::{Point, Sensor};
use crate::optics::{PaperGeometry, Rig};
use crate::report::{Plot, Series, Style};

/// R, the nearest slit of Table 4 [m].
pub(super) const NEAREST_M: f64 = 1.504_210;
/// The slits of Figures 8 and 9, from R [mm], and their rows over the centre, recovered from Table 4.
pub(super) const SLITS: [(f64, f64); 3] = [(0.0, -199.0), (600.0, -6.0), (1200.0, 113.0)];

/// θB for a slit on the floor at this distance from R [rad].
pub(super) fn beam_at(slit_mm: f64) -> f64 {
    (PaperGeometry::metro_i().mirror_height_m / (NEAREST_M + slit_mm * 1e-3)).atan() // (39)
}

/// Row of such a slit in the middle column [px], from the top.
pub(super) fn row_at(rig: &Rig, slit_mm: f64) -> Result<f64> {
    let slit = Point::<Sensor>::new(NEAREST_M + slit_mm * 1e-3, 0.0, 0.0);
    let seen = rig.camera.project(&(rig.sensor_from_camera.inverse() * slit).xyz);
    seen.map(|[_, v]| v).ok_or_else(|| Fault::new("slit", format!("{slit_mm} mm"), "one in front of the camera"))
}

pub(super) fn by_geometry(drawn: &mut BTreeMap<&'static str, Drawn>) -> Result<BTreeMap<&'static str, Vec<Row>>> {
    Ok(BTreeMap::from([
        ("8", figure_8()?),
        ("10", figure_10(drawn)?),
        ("11", figure_11(drawn)),
        ("13", figure_13(drawn)?),
    ]))
}

fn figure_8() -> Result<Vec<Row>> {
    let rig = Rig::metro_i();
    let mut rows = Vec::new();
    for (slit, recovered) in SLITS {
        let over_centre = rig.camera.cy - row_at(&rig, slit)?;
        let row = Row::new("row_over_centre_px", over_centre).at("slit_mm", slit).expected(recovered, 0.5);
        rows.push(row.note("expected: the rows that Table 4 was computed from, whole pixels"));
    }
    Ok(rows)
}

fn figure_10(drawn: &mut BTreeMap<&'static str, Drawn>) -> Result<Vec<Row>> {
    let rig = Rig::metro_i();
    let gap = |slit_mm: f64| Ok((row_at(&rig, 0.0)? - row_at(&rig, slit_mm)?).abs());
    let mut rows = Vec::new();
    let mut curve = Vec::new();
    for i in 0..=24 {
        let slit = f64::from(i) * 50.0;
        curve.push((slit, gap(slit)?));
        if i % 6 == 0 {
            let row = Row::new("pixel_gap_px", gap(slit)?).at("slit_mm", slit);
            rows.push(match i {
                12 => row.expected(193.0, 1.0).note("expected: -199 to -6, the rows of Table 4"),
                24 => row
                    .paper(300.0, 20.0)
                    .expected(312.0, 1.0)
                    .note("the figure's curve ends at about 300; expected: -199 to +113"),
                _ => row,
            });
        }
    }
    let table = vec![(0.0, 0.0), (600.0, 193.0), (1200.0, 312.0)];
    let plot = Plot::new("Pixel gap between the slit at 0 and a slit farther out", "slit", "mm", "gap", "px")
        .with(Series::new("ours", Style::Line, curve))
        .with(Series::new("rows of Table 4", Style::Dots, table));
    drawn.entry("10").or_default().plots.push(plot);
    Ok(rows)
}

fn figure_11(drawn: &mut BTreeMap<&'static str, Drawn>) -> Vec<Row> {
    let pulses = |slit_mm: f64| (beam_at(0.0) - beam_at(slit_mm)) / PULSE_RAD;
    let mut rows = Vec::new();
    for (slit, expected) in [(300.0, 46.0), (600.0, 81.0), (900.0, 108.0), (1200.0, 130.0)] {
        let row = Row::new("pulses", pulses(slit).round())
            .at("slit_mm", slit)
            .at("exact", pulses(slit))
            .expected(expected, 0.0);
        rows.push(match expected {
            81.0 => row.paper(81.0, 0.0).note("paper: recovered from Table 4"),
            130.0 => row.paper(130.0, 0.0).note("paper: the end of the figure's curve"),
            _ => row,
        });
    }
    let curve = (0..=24).map(|i| f64::from(i) * 50.0).map(|x| (x, pulses(x))).collect();
    let steps = rows.iter().filter_map(|row| Some((row.at.get("slit_mm")?.as_f64()?, row.ours))).collect();
    let plot = Plot::new("Encoder pulses of the beam from the slit at 0", "slit", "mm", "pulses", "")
        .with(Series::new("angle over 2π/4000", Style::Line, curve))
        .with(Series::new("whole pulses", Style::Dots, steps));
    drawn.entry("11").or_default().plots.push(plot);
    rows
}

fn figure_13(drawn: &mut BTreeMap<&'static str, Drawn>) -> Result<Vec<Row>> {
    let paper = PaperGeometry::metro_i();
    let over_sheet = (paper.camera_height_m - paper.mirror_height_m) * 1e3;
    let cases = [
        ("view and sheet level", Sensitivity::level(over_sheet, 0.0)),
        ("view tilted, sheet level", Sensitivity::level(over_sheet, paper.tilt_rad)),
        ("the finder", Sensitivity::printed()),
    ];
    let mut rows = Vec::new();
    let note = "the three cases are read so [A]: view level and θB = 0; view tilted and θB = 0; view tilted, beam at P";
    let mut plot = Plot::new("Range of one row", "X'", "mm", "range", "mm/px");
    for (case, sensitivity) in &cases {
        for i in 0..=10 {
            let x = 1500.0 + f64::from(i) * 100.0;
            let row = Row::new("mm_per_px", sensitivity.mm_per_px(x)).at("x_mm", x).at("case", *case);
            let printed = TABLE_5.iter().find(|known| known[0] == x && *case == "the finder");
            let row = if i == 0 { row.note(note) } else { row };
            rows.push(if let Some(known) = printed { row.expected(known[4], 5e-3) } else { row });
        }
        let curve = (0..=40).map(|i| 1500.0 + f64::from(i) * 25.0).map(|x| (x, sensitivity.mm_per_px(x))).collect();
        plot = plot.with(Series::new(*case, Style::Line, curve));
    }
    let table = TABLE_5.iter().map(|row| (row[0], row[1])).collect();
    plot = plot.with(Series::new("Table 5", Style::Dots, table));
    drawn.entry("13").or_default().plots.push(plot.from_zero());
    Ok(rows)
}
