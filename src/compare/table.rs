//! The figures for programs: as JSON, and as CSV with a line a class, sensor and measure.

use std::fmt::Write;

use serde_json::{Map, Value as Json};

use super::statistics::{Rate, Value};
use super::summary::Comparison;
use super::verdict::verdict;
use crate::fault::{Fault, Result};

/// The comparison and its verdict as one JSON object: a figure under its name, its 95 % interval under the name with `_ci95`.
/// What was not measured is null.
///
/// # Errors
/// Numbers that JSON cannot hold.
pub fn json(found: &Comparison) -> Result<Json> {
    let plain = serde_json::to_value(found);
    let mut value = flat(plain.map_err(|e| Fault::new("comparison", e, "numbers that JSON can hold"))?);
    value["verdict"] = verdict(found).into();
    Ok(value)
}

/// Takes figures out of their boxes: `x: {value, ci95}` becomes `x` and `x_ci95`.
fn flat(value: Json) -> Json {
    match value {
        Json::Array(items) => items.into_iter().map(flat).collect(),
        Json::Object(fields) => {
            let mut out = Map::new();
            for (name, field) in fields {
                match field {
                    Json::Object(mut figure)
                        if figure.len() == 2 && figure.contains_key("value") && figure.contains_key("ci95") =>
                    {
                        out.insert(format!("{name}_ci95"), figure.remove("ci95").unwrap_or_default());
                        out.insert(name, figure.remove("value").unwrap_or_default());
                    }
                    other => {
                        out.insert(name, flat(other));
                    }
                }
            }
            Json::Object(out)
        }
        plain => plain,
    }
}

/// All figures: `what,sensor,measure,value,low95,high95,hits,of`. What was not measured has no value.
pub fn csv(found: &Comparison) -> String {
    let mut out = String::from("what,sensor,measure,value,low95,high95,hits,of\n");
    for class in &found.order {
        for (sensor, result) in found.classes.get(class).into_iter().flatten() {
            let overall = result.rate.map(|rate| Rate {
                hits: result.detected,
                of: result.opportunities,
                rate,
                ci95: result.ci95,
            });
            rate(&mut out, class, sensor, "detection_rate", overall);
            rate(&mut out, class, sensor, "encounters_detected", result.encounters);
            rate(&mut out, class, sensor, "false_share", result.false_share);
            value(&mut out, class, sensor, "range_rmse_m", result.range_rmse_m);
            value(&mut out, class, sensor, "bearing_rmse_rad", result.bearing_rmse_rad);
            value(&mut out, class, sensor, "first_detection_m", result.first_detection_m);
            value(&mut out, class, sensor, "first_detection_s", result.first_detection_s);
            for bin in &result.by_distance {
                let measure = format!("detection_rate_{:.1}_to_{:.1}_m", bin.from_m, bin.to_m);
                rate(&mut out, class, sensor, &measure, Some(bin.rate));
            }
        }
    }
    for (class, seen) in &found.either {
        rate(&mut out, class, "either", "detection_rate", *seen);
    }
    for difference in &found.differences {
        value(&mut out, &difference.what, "laser less ultrasonic", difference.measure, difference.difference);
        let p = difference.p_holm.map(|p| Value { value: p, ci95: None });
        value(&mut out, &difference.what, "laser less ultrasonic", &format!("{}: p_holm", difference.measure), p);
    }
    for (sensor, reports) in &found.false_obstacles {
        rate(&mut out, "all reports", sensor, "false_share", reports.of_reports);
        rate(&mut out, "all reports", sensor, "seconds_with_a_false_one", reports.of_seconds);
    }
    for (map, result) in &found.map {
        for (measure, found) in [
            ("iou", result.iou),
            ("precision", result.precision),
            ("recall", result.recall),
            ("free_space_error", result.free_space_error),
            ("free_blocked", result.free_blocked),
            ("free_found", result.free_found),
        ] {
            value(&mut out, "map", map, measure, found);
        }
    }
    for (sensor, needs) in &found.needs {
        for (measure, found) in [
            ("power_w", needs.power_w),
            ("kb_per_s", needs.kb_per_s),
            ("line_kb_per_s", needs.line_kb_per_s),
            ("per_s", needs.per_s),
        ] {
            value(&mut out, "needs", sensor, measure, found);
        }
    }
    out
}

fn rate(out: &mut String, what: &str, sensor: &str, measure: &str, found: Option<Rate>) {
    let counts = found.map_or([String::new(), String::new()], |rate| [rate.hits.to_string(), rate.of.to_string()]);
    let value = found.map(|rate| Value { value: rate.rate, ci95: rate.ci95 });
    line(out, [what, sensor, measure], value, &counts);
}

fn value(out: &mut String, what: &str, sensor: &str, measure: &str, found: Option<Value>) {
    line(out, [what, sensor, measure], found, &[String::new(), String::new()]);
}

fn line(out: &mut String, names: [&str; 3], found: Option<Value>, counts: &[String; 2]) {
    let number = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value}"));
    let ends = found.and_then(|value| value.ci95);
    let numbers = [number(found.map(|v| v.value)), number(ends.map(|e| e[0])), number(ends.map(|e| e[1]))];
    let names = names.map(quoted);
    // Writing to a string cannot fail.
    let _ = writeln!(out, "{},{},{},{},{}", names[0], names[1], names[2], numbers.join(","), counts.join(","));
}

/// A field as CSV has it (RFC 4180).
fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_stand_under_their_names_and_their_intervals_beside_them() {
        let boxed = serde_json::json!({
            "a": {"x_m": {"value": 1.5, "ci95": [1.0, 2.0]}, "y_m": {"value": 2.0, "ci95": null}, "z": null},
            "b": [{"rate": 0.5, "ci95": [0.4, 0.6]}],
        });
        let plain = serde_json::json!({
            "a": {"x_m": 1.5, "x_m_ci95": [1.0, 2.0], "y_m": 2.0, "y_m_ci95": null, "z": null},
            "b": [{"rate": 0.5, "ci95": [0.4, 0.6]}],
        });
        assert_eq!(flat(boxed), plain);
    }

    #[test]
    fn a_line_has_eight_fields_and_names_with_commas_are_quoted() {
        let mut out = String::new();
        let found = Rate { hits: 3, of: 4, rate: 0.75, ci95: Some([0.3, 0.95]) };
        rate(&mut out, "wall, \"oblique\"", "laser", "detection_rate", Some(found));
        value(&mut out, "box", "laser", "range_rmse_m", None);
        assert_eq!(
            out,
            "\"wall, \"\"oblique\"\"\",laser,detection_rate,0.75,0.3,0.95,3,4\nbox,laser,range_rmse_m,,,,,\n"
        );
    }
}
