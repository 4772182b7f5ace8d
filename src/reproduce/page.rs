//! The report as one HTML page that needs nothing but itself.

use std::fmt::Write;

use serde_json::Value;

use super::{Misprint, Reproduction, Row, Simulated};
use crate::report::escaped;
use crate::report::html::{self, figures, number};

/// What each table and figure is of.
const TITLES: [(&str, &str); 12] = [
    ("1", "Lens pairs of the slit optics"),
    ("2", "Fan angles and width of the sheet at 3 m"),
    ("3", "Camera calibration"),
    ("4", "Finder calibration"),
    ("5", "Range error"),
    ("text", "Numbers of the text"),
    ("8", "Slit images at 0, 600 and 1200 mm"),
    ("9", "The line in them"),
    ("10", "Pixel gap between slits"),
    ("11", "Encoder pulses between slits"),
    ("12", "Object, peaks, after noise removal, range map"),
    ("13", "Range of one row"),
];

/// The whole report.
pub fn page(all: &Reproduction) -> String {
    let mut html = String::from("<h1>A laser-slit range finder: the paper's tables and figures, and ours</h1>");
    html += "<p>Y. Y. Cha and D. G. Gweon, “A calibration and range-data extraction algorithm for an omnidirectional laser \
             range finder of a free-ranging mobile robot”, Mechatronics 6(6), 665–689, 1996.</p>";
    html += &verdict(all);
    html += "<p><b>paper</b>: what is printed. <b>printed form</b>: what the printed formula or constants give, where that \
             differs from ours. <b>ours</b>: what we hold to be right. <b>expected</b>: what an independent computation says \
             that ours must be. <b>agrees</b>: whether paper and printed form (or ours, where there is no printed form), and \
             ours and expected, are the same.</p>";
    html += &misprints(&all.misprints);
    for (kind, parts) in [("Table", &all.tables), ("Figure", &all.figures)] {
        let mut names: Vec<&str> =
            parts.keys().copied().chain(all.drawn.keys().copied().filter(|_| kind == "Figure")).collect();
        names.sort_by_key(|name| (name.parse::<u32>().unwrap_or(u32::MAX), *name));
        names.dedup();
        for name in names {
            let title = TITLES.iter().find(|(known, _)| *known == name).map_or("", |(_, title)| title);
            let head = if name == "text" { title.to_string() } else { format!("{kind} {name}. {title}") };
            let _ = write!(html, "<section id=\"{}-{name}\"><h2>{}</h2>", kind.to_lowercase(), escaped(&head));
            html += &drawn(all, name);
            html += &rows(parts.get(name).map_or(&[], Vec::as_slice));
            html += "</section>";
        }
    }
    html += "<section id=\"points\"><h2>Points of pixels</h2><p>Three pixels of the frame memory (Vf upwards), beam at P, \
             with the printed constants.</p>";
    html += &rows(&all.points);
    html += "</section>";
    html::page("The paper reproduced", &html)
}

fn verdict(all: &Reproduction) -> String {
    let compared = all.rows().filter(|(_, row)| row.agrees.is_some()).count();
    let off: Vec<String> = all
        .rows()
        .filter(|(_, row)| row.agrees == Some(false))
        .map(|(place, row)| escaped(&format!("{place}: {} {}", row.quantity, place_of(row))))
        .collect();
    let effort = format!("{} repeats of each simulated procedure, seed {}.", all.effort.repeats, all.effort.seed);
    if off.is_empty() {
        return format!("<p class=\"good\">All {compared} numbers that can be compared agree. {effort}</p>");
    }
    format!("<p class=\"bad\">{} of {compared} numbers do not agree: {}. {effort}</p>", off.len(), off.join("; "))
}

fn misprints(list: &[Misprint]) -> String {
    let mut html = String::from(
        "<section id=\"misprints\"><h2>Where the print is wrong</h2><div class=\"wide\"><table><thead><tr>\
         <th class=\"t\">where</th><th class=\"t\">what, and why</th><th>printed</th><th>correct</th></tr></thead><tbody>",
    );
    for misprint in list {
        let _ = write!(
            html,
            "<tr><td class=\"t\">{}</td><td class=\"a\">{}<br><small>{}</small></td><td>{}</td><td>{}</td></tr>",
            escaped(misprint.place),
            escaped(misprint.quantity),
            escaped(misprint.why),
            number(misprint.printed),
            number(misprint.correct),
        );
    }
    html + "</tbody></table></div></section>"
}

fn drawn(all: &Reproduction, name: &str) -> String {
    let Some(drawn) = all.drawn.get(name) else { return String::new() };
    let pictures = drawn.pictures.iter().map(|picture| html::picture(&picture.caption, &picture.png, picture.size));
    html::gallery(pictures.chain(drawn.plots.iter().map(html::drawing)))
}

/// The rows of a table or figure; those of one way of calibrating under a head of their own, long lists folded away.
fn rows(rows: &[Row]) -> String {
    let way = |row: &Row| row.at.get("way").and_then(Value::as_str).unwrap_or_default().to_string();
    let mut html = String::new();
    for group in rows.chunk_by(|a, b| way(a) == way(b)) {
        let head = group.first().map(way).unwrap_or_default();
        if !head.is_empty() {
            let _ = write!(html, "<h3>Simulated: {}</h3>", escaped(&head));
        }
        html += &group_of(group);
    }
    html
}

/// A column of a table of rows: its head, its class, and what stands in it.
type Column<'a> = (&'a str, &'a str, Box<dyn Fn(&Row) -> String>);

/// More rows than this are folded away.
const ROWS_OPEN: usize = 30;

fn group_of(rows: &[Row]) -> String {
    let optional = |pick: fn(&Row) -> Option<f64>| Box::new(move |row: &Row| pick(row).map(number).unwrap_or_default());
    let simulated = |show: fn(&Simulated) -> String| {
        Box::new(move |row: &Row| row.simulated.as_ref().map(show).unwrap_or_default())
    };
    let columns: [Column; 10] = [
        ("quantity", "t", Box::new(|row| escaped(&quantity_of(row.quantity)))),
        ("where", "a", Box::new(|row| escaped(&place_of(row)))),
        ("paper", "", optional(|row| row.paper)),
        ("printed form", "", optional(|row| row.printed_form)),
        ("ours", "", Box::new(|row| number(row.ours))),
        ("expected", "", optional(|row| row.expected)),
        ("rms error", "", simulated(|s| figures(s.rms_error, 3))),
        ("σ reported", "", simulated(|s| figures(s.sigma, 3))),
        ("inside 95 %", "", simulated(|s| format!("{:.1} %", s.inside_95 * 100.0))),
        ("agrees", "t", Box::new(|row| row.agrees.map_or(String::new(), mark))),
    ];
    let filled: Vec<&Column> =
        columns.iter().filter(|(.., cell)| rows.iter().any(|row| !cell(row).is_empty())).collect();
    if filled.is_empty() {
        return String::new();
    }
    let mut notes: Vec<&str> = Vec::new();
    for note in rows.iter().filter_map(|row| row.note) {
        if !notes.contains(&note) {
            notes.push(note);
        }
    }
    // A note on every row is one on the table.
    let common = notes.len() == 1 && rows.iter().all(|row| row.note.is_some());
    let mut html = String::new();
    if common {
        html += &notes.iter().map(|note| format!("<p><small>{}</small></p>", escaped(note))).collect::<String>();
    }
    html += "<div class=\"wide\"><table><thead><tr>";
    for (head, class, _) in &filled {
        let _ = write!(html, "<th class=\"{class}\">{head}</th>");
    }
    html += "</tr></thead><tbody>";
    for row in rows {
        html += "<tr>";
        let number = row.note.filter(|_| !common).and_then(|note| notes.iter().position(|n| *n == note));
        for (head, class, cell) in &filled {
            let foot =
                number.filter(|_| *head == "quantity").map(|n| format!(" <sup>{}</sup>", n + 1)).unwrap_or_default();
            let _ = write!(html, "<td class=\"{class}\">{}{foot}</td>", cell(row));
        }
        html += "</tr>";
    }
    html += "</tbody></table></div>";
    if !common && !notes.is_empty() {
        let list: String = notes.iter().map(|note| format!("<li>{}</li>", escaped(note))).collect();
        let _ = write!(html, "<ol>{list}</ol>");
    }
    if rows.len() > ROWS_OPEN {
        return format!("<details><summary>{} numbers</summary>{html}</details>", rows.len());
    }
    html
}

fn mark(agrees: bool) -> String {
    if agrees { "<span class=\"good\">yes</span>".into() } else { "<span class=\"bad\">no</span>".into() }
}

/// What stands at the end of a name for its unit, and how it is written.
const UNITS: [(&str, &str); 7] =
    [("_per_mm2", "1/mm²"), ("_mm", "mm"), ("_px", "px"), ("_deg", "°"), ("_rad", "rad"), ("_m", "m"), ("_s", "s")];

/// A name without its unit, and the unit.
fn split(name: &str) -> (String, &'static str) {
    let unit = UNITS.iter().find_map(|(end, unit)| Some((name.strip_suffix(end)?, *unit)));
    let (name, unit) = unit.unwrap_or((name, ""));
    (name.replace('_', " "), unit)
}

/// A quantity in words, its unit in brackets.
fn quantity_of(name: &str) -> String {
    let named = match name {
        "mm_per_px" => Some("one pixel of range [mm]"),
        "percent_per_px" => Some("one pixel of range [%]"),
        "mm_per_pulse" => Some("one mirror pulse [mm]"),
        "mm_per_mrad" => Some("one mrad of camera tilt [mm]"),
        _ => None,
    };
    let (words, unit) = split(name);
    named.map_or_else(|| if unit.is_empty() { words } else { format!("{words} [{unit}]") }, String::from)
}

/// Where a number holds, in words.
fn place_of(row: &Row) -> String {
    let part = |(name, value): (&&str, &Value)| {
        let (words, unit) = split(name);
        let value = match value {
            Value::String(text) => return text.clone(),
            Value::Number(n) => n.as_f64().map_or_else(|| n.to_string(), number),
            other => other.to_string(),
        };
        format!("{words} {value} {unit}").trim_end().to_string()
    };
    row.at.iter().filter(|(name, _)| **name != "way").map(part).collect::<Vec<_>>().join(", ")
}
