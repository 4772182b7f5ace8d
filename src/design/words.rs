//! The verdict in words: what somebody who never built one must know first.

use serde::Serialize;

use super::budget::{Row, TERMS};
use super::light::Reach;
use super::{Design, SUN_W_PER_M2};
use crate::optics::Laser;

/// What a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// As one would wish it.
    Good,
    /// To be known.
    Note,
    /// To be dealt with.
    Warning,
}

/// One sentence or two.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// What it is about.
    pub topic: &'static str,
    /// How much it matters.
    pub kind: Kind,
    /// The finding.
    pub text: String,
}

/// The number with a sensible number of places, at most `places`.
pub(super) fn short(value: f64, places: usize) -> String {
    if !value.is_finite() {
        return "–".into();
    }
    let text = format!("{value:.places$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    text.replace('-', "−")
}

/// Millimetres to two figures or so.
pub(super) fn mm(value: f64) -> String {
    if !value.is_finite() {
        return "–".into();
    }
    let places = if value < 0.995 {
        2
    } else if value < 9.95 {
        1
    } else {
        0
    };
    format!("{value:.places$}")
}

fn percent(share: f64) -> String {
    let text = short(share * 100.0, 0);
    let rounded = match () {
        () if share > 0.0 && share < 0.005 => "under 1".into(),
        () if share < 1.0 && share > 0.995 => "over 99".into(),
        () => text,
    };
    format!("{rounded} %")
}

pub(super) fn findings(all: &Design) -> Vec<Finding> {
    let mut list = vec![field(all)];
    list.extend(budget(all));
    list.push(steps(all));
    list.extend(light(all));
    list.extend(waste(all));
    list.push(laser(all));
    list.push(volume(all));
    list.extend(change(all));
    list.retain(|finding| !finding.text.is_empty());
    list
}

fn finding(topic: &'static str, kind: Kind, text: String) -> Finding {
    Finding { topic, kind, text }
}

fn field(all: &Design) -> Finding {
    let view = &all.view;
    let mut text = match view.floor_m {
        Some([near, far]) if far > near => {
            format!("It sees the floor from {near:.2} to {far:.2} m ahead of the robot's centre")
        }
        Some([near, _]) => format!("Its one line meets the floor at {near:.2} m"),
        None => "It sees no floor".to_string(),
    };
    if let Some([edge, near]) = view.blind_m {
        text += &format!(
            "; between the robot's edge at {edge:.2} m and {near:.2} m it is blind, and what lies there is known only \
                          from the map"
        );
    }
    text += ".";
    if view.ceiling_slope > 0.0 {
        let at = |x: f64| short((view.ceiling_m - view.ceiling_slope * (x - view.camera_m[0])).max(0.0), 2);
        let reach = all.instrument.rig.range_m_max;
        let [a, b] = if reach >= 3.0 { [2.0, 3.0] } else { [reach / 2.0, reach] };
        text += &format!(
            " It looks down: nothing above {} m is seen at {} m, nothing above {} m at {} m.",
            at(a),
            short(a, 2),
            at(b),
            short(b, 2)
        );
        let table = all.params.table_m;
        text += &match view.table_seen_to_m {
            Some(x) => format!(" A table top {table} m high shows only nearer than {x:.2} m."),
            None => format!(" A table top {table} m high never shows."),
        };
    }
    finding("view", if view.blind_m.is_some() { Kind::Warning } else { Kind::Note }, text)
}

/// Rows of the budget, and where they lie.
fn rows(all: &Design) -> (&[Row], &'static str) {
    if all.floor.is_empty() { (&all.upright, "on an upright target") } else { (&all.floor, "on the floor") }
}

/// Stretches of X in which the same term dominates: name, from, to, least and most share of the variance.
pub(super) fn stretches(rows: &[Row]) -> Vec<(&'static str, f64, f64, f64, f64)> {
    let mut list: Vec<(&str, f64, f64, f64, f64)> = Vec::new();
    for row in rows.iter().filter(|row| row.found && row.range.instrument_mm > 0.0) {
        match list.last_mut().filter(|last| last.0 == row.dominant) {
            Some(last) => {
                let share = row.dominant_share;
                (last.2, last.3, last.4) = (row.range_m, last.3.min(share), last.4.max(share));
            }
            None => list.push((row.dominant, row.range_m, row.range_m, row.dominant_share, row.dominant_share)),
        }
    }
    list
}

pub(super) fn name_of(term: &str) -> &'static str {
    TERMS.iter().find(|(key, _)| *key == term).map_or("nothing", |(_, name)| name)
}

fn budget(all: &Design) -> Vec<Finding> {
    let (rows, place) = rows(all);
    let seen: Vec<&Row> = rows.iter().filter(|row| row.found && row.range.instrument_mm.is_finite()).collect();
    let (Some(first), Some(last)) = (seen.first(), seen.last()) else {
        let text = "No stripe stands out of the noise anywhere: more light, or a wider aperture.".to_string();
        return vec![finding("error", Kind::Warning, text)];
    };
    let mut text = format!(
        "Range {place} is good to {} mm at {:.1} m and {} mm at {:.1} m (one standard deviation of one point, the instrument alone).",
        mm(first.range.instrument_mm),
        first.range_m,
        mm(last.range.instrument_mm),
        last.range_m
    );
    let parts: Vec<String> = stretches(rows)
        .iter()
        .map(|(term, from, to, least, most)| {
            let shares = if (most - least) < 0.015 {
                percent(*most)
            } else {
                format!("{} to {}", short(least * 100.0, 0), percent(*most))
            };
            format!("{} from {from:.1} to {to:.1} m ({shares} of the variance)", name_of(term))
        })
        .collect();
    text += &format!(" What dominates: {}.", parts.join(", "));
    let half = last.range.instrument_mm * (1.0 - 0.75 * last.dominant_share).sqrt();
    text += &format!(
        " With half of that error ({}) the {} mm would be {} at {:.1} m.",
        name_of(last.dominant),
        mm(last.range.instrument_mm),
        mm(half),
        last.range_m
    );
    let mut list = vec![finding("error", Kind::Note, text)];
    let moved = format!(
        "In the map, at {} m/s and with the robot's pose as given, it is {} and {} mm.",
        short(all.params.speed_m_s, 2),
        mm(first.range.total_mm),
        mm(last.range.total_mm)
    );
    list.push(finding("error in the map", Kind::Note, moved));
    list
}

fn steps(all: &Design) -> Finding {
    let near = |x: f64| {
        let by = |row: &&Row| (row.range_m - x).abs();
        all.floor.iter().filter(|row| row.found).min_by(|a, b| by(a).total_cmp(&by(b)))
    };
    let (Some(a), Some(b)) = (near(2.0), near(3.0)) else { return finding("obstacles", Kind::Note, String::new()) };
    let text = format!(
        "The lowest step that stands out of the floor's noise (5 σ) is {} mm at {:.1} m and {} mm at {:.1} m; between neighbours in one \
         line, which share the mirror's error, {} and {} mm. One column is {} and {} mm wide there.",
        mm(a.smallest_step_mm),
        a.range_m,
        mm(b.smallest_step_mm),
        b.range_m,
        mm(a.smallest_step_in_line_mm),
        mm(b.smallest_step_in_line_mm),
        mm(a.mm_per_column),
        mm(b.mm_per_column)
    );
    finding("obstacles", Kind::Note, text)
}

fn light(all: &Design) -> Vec<Finding> {
    let (rows, place) = rows(all);
    let mut list = Vec::new();
    if let (Some(first), Some(last)) = (rows.first(), rows.last()) {
        let full: Vec<&Row> = rows.iter().filter(|row| row.saturated).collect();
        let white = all.light.white_level;
        let mut text = format!(
            "The stripe {place} (albedo {}) peaks at {} of {white:.0} levels at {:.1} m and {} at {:.1} m; {} are needed to be found.",
            all.params.albedo,
            short(first.peak_level.min(white), if first.peak_level < 10.0 { 1 } else { 0 }),
            first.range_m,
            short(last.peak_level.min(white), if last.peak_level < 10.0 { 1 } else { 0 }),
            last.range_m,
            short(all.light.found_level, 1)
        );
        let kind = match (full.last(), rows.iter().rev().take_while(|row| !row.found).last()) {
            (Some(row), _) => {
                text += &format!(
                    " The sensor is full up to {:.1} m: a smaller aperture or a shorter exposure.",
                    row.range_m
                );
                Kind::Warning
            }
            (None, Some(row)) => {
                text += &format!(" From {:.1} m on it drowns.", row.range_m);
                Kind::Warning
            }
            _ => Kind::Good,
        };
        list.push(finding("light", kind, text));
    }
    let reach = |ambient: &str| {
        let part = |r: &Reach| {
            let far = r.found_to_m.map_or("nowhere".into(), |d| format!("to {d:.1} m"));
            format!("{} ({} %) {far}", r.target, short(r.albedo * 100.0, 0))
        };
        all.light.reach.iter().filter(|r| r.ambient == ambient).map(part).collect::<Vec<_>>().join(", ")
    };
    let dark = all.light.reach.iter().find(|r| r.ambient == "indoors" && r.target == "black");
    // What the farthest floor lacks: power, aperture or time, as one likes.
    let short_of = |row: &Row| {
        let peak = row.peak_level * dark.map_or(0.0, |r| r.albedo) / all.params.albedo;
        let times = all.light.found_level / peak;
        format!(" To find it at {:.1} m takes {} times the light.", row.range_m, mm(times))
    };
    let more = all.floor.last().map(short_of).unwrap_or_default();
    let lost = match (dark.and_then(|r| r.floor_found_to_m), all.view.floor_m) {
        (None, Some(_)) => format!(" A black floor is not seen at all.{more}"),
        (Some(x), Some([_, far])) if x < far - 0.02 => format!(" A black floor is lost beyond {x:.1} m.{more}"),
        _ => String::new(),
    };
    list.push(finding(
        "reach",
        Kind::Note,
        format!("By light alone, targets that face it are found indoors: {}.{lost}", reach("indoors")),
    ));
    let over = all.light.background_level_sun > all.light.white_level;
    let text = format!(
        "In direct sun ({SUN_W_PER_M2} W/m² within the filter) {}: {}.",
        if over {
            "the background alone fills the sensor; with the exposure cut until it is half full"
        } else {
            "they are found"
        },
        reach("sun")
    );
    list.push(finding("sun", if over { Kind::Warning } else { Kind::Note }, text));
    list
}

/// Light that falls beside the picture.
fn waste(all: &Design) -> Option<Finding> {
    let at = all.view.widths.get(3)?;
    let lost = 1.0 - at.power_share;
    let narrow = at.sheet_width_m < at.width_m;
    let text = if narrow {
        format!(
            "At {} m the sheet is {:.2} m wide and the picture {:.2} m: columns at its sides get little light or none.",
            short(at.distance_m, 2),
            at.sheet_width_m,
            at.width_m
        )
    } else {
        format!(
            "At {} m the sheet is {:.2} m wide and the picture {:.2} m: {} of the laser's light falls beside it. A fan just as wide as the \
             picture would make the line {:.1} times as bright in its middle.",
            short(at.distance_m, 2),
            at.sheet_width_m,
            at.width_m,
            percent(lost),
            at.sheet_width_m / at.width_m
        )
    };
    Some(finding("sheet", if narrow || lost > 0.3 { Kind::Warning } else { Kind::Note }, text))
}

fn laser(all: &Design) -> Finding {
    let safety = &all.safety;
    let (Some(line), Some(beam)) = (&safety.line, &safety.bare_beam) else {
        let text = format!(
            "No hint at a laser class for {} nm: only continuous visible light, 400 to 700 nm, is covered.",
            short(safety.wavelength_nm, 1)
        );
        return finding("laser class", Kind::Warning, text);
    };
    let text = format!(
        "A hint, no classification (IEC 60825-1, point source, mirror at rest): of the line's {} mW the naked eye's 7 mm at 100 mm take {} mW, \
         so class {}. The bare beam of {} mW, if the fan lens fell off, is class {}.",
        short(line.power_mw, 2),
        short(line.through_7_mm_mw, 2),
        line.class,
        short(beam.power_mw, 2),
        beam.class
    );
    let harmless = |class: &str| matches!(class, "1" | "2");
    finding("laser class", if harmless(line.class) && harmless(beam.class) { Kind::Good } else { Kind::Warning }, text)
}

fn volume(all: &Design) -> Finding {
    let watch = &all.volume;
    let span = |[a, b]: [f64; 2]| format!("{} to {}", short(a, 2), short(b, 2));
    let v = &watch.volume;
    let mut text = format!("Of the volume X {}, Y {}, Z {} m", span(v.x_m), span(v.y_m), span(v.z_m));
    let rig = &all.instrument.rig;
    let still = matches!(rig.laser, Laser::Plane(_));
    let (ahead, turned) = (percent(watch.seen_ahead), percent(watch.seen_turned));
    text += &match (still, rig.cylinder.rad_per_pulse == 0.0) {
        (true, _) => format!(
            " the camera covers {turned}, but the sheet stands still: it lights one slice, and the robot must carry it through the rest."
        ),
        (false, true) => format!(" it sees {ahead}."),
        (false, false) => format!(" it sees {ahead} with the cylinder straight ahead and {turned} with it turned."),
    };
    let u = watch.unseen;
    let parts = [
        (u.above_picture, "above the picture"),
        (u.below_picture, "too near, under the picture"),
        (u.beside, "beside it"),
        (u.no_beam, "where no beam gets"),
        (u.too_far, "too far"),
    ];
    let never: Vec<String> =
        parts.iter().filter(|(s, _)| *s > 0.0).map(|(s, why)| format!("{} {why}", percent(*s))).collect();
    if !never.is_empty() {
        text += &format!(" Never seen: {}.", never.join(", "));
    }
    if let (Some(first), Some(last), Some(seconds)) = (watch.lines.first(), watch.lines.last(), watch.sweep_s) {
        text += &format!(
            " {} lines from pulse {} to {}, in {} view{}, leave no gap over {} mm; a sweep takes {} s.",
            watch.lines.len(),
            short(f64::from(first.pulse), 0),
            short(f64::from(last.pulse), 0),
            watch.views,
            if watch.views == 1 { "" } else { "s" },
            mm(watch.floor_gap_m.max(watch.wall_gap_m) * 1e3),
            short(seconds, 1)
        );
        if watch.limited_by_pulse {
            text += " One pulse of the mirror is coarser than asked in its far part.";
        }
    }
    let kind = if watch.seen_turned > 0.95 && !still { Kind::Good } else { Kind::Warning };
    finding("volume", kind, text)
}

/// The change that would see most of the volume.
fn change(all: &Design) -> Option<Finding> {
    let now = all.changes.first()?.seen?;
    let seen = |c: &&super::Change| c.seen.unwrap_or(0.0);
    let best = all.changes.iter().max_by(|a, b| seen(a).total_cmp(&seen(b)))?;
    let gain = best.seen? - now;
    (gain > 0.02).then(|| {
        let text = format!(
            "More of the volume would be seen with the {}: {} instead of {}.",
            best.what,
            percent(best.seen.unwrap_or(now)),
            percent(now)
        );
        finding("change", Kind::Note, text)
    })
}
