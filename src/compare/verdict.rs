//! The result in plain words.

use super::statistics::Value;
use super::summary::{Comparison, Difference};

/// Sentences, most important first: where each wins, where there is no difference to be seen, what the maps are worth.
pub fn verdict(found: &Comparison) -> Vec<String> {
    let mut out = Vec::new();
    let seeds = found.seeds.len();
    if found.differences.is_empty() {
        out.push("Only one sensor was at work: there is nothing to compare it with.".to_string());
        return out;
    }
    let classes: Vec<&Difference> = found.differences.iter().filter(|d| d.measure == "detection rate").collect();
    let measured: Vec<&&Difference> = classes.iter().filter(|d| d.difference.is_some()).collect();
    if measured.is_empty() {
        out.push("No obstacle came into play: no detection rate was measured.".to_string());
    }
    let count = found.differences.iter().filter(|d| d.p.is_some()).count();
    let least = 2.0_f64.powi(1 - seeds.min(60) as i32).min(1.0);
    let is_hopeless = least * count as f64 > super::ALPHA;
    if is_hopeless && !measured.is_empty() {
        out.push(format!(
            "Too few seeds: with {seeds} no difference can be significant, however large (flipped signs give a probability of {least:.2} \
             at least, for each of {count} comparisons)."
        ));
    }
    for (winner, name) in [("laser", "The laser"), ("ultrasonic", "The ultrasonic ring")] {
        let won: Vec<String> =
            measured.iter().filter(|d| d.winner == Some(winner)).map(|d| with_rates(found, d)).collect();
        if won.is_empty() {
            if is_hopeless || measured.is_empty() {
                continue;
            }
            out.push(format!("{name} is not significantly better at detecting anything here."));
        } else {
            out.push(format!("{name} detects more often: {}.", won.join("; ")));
        }
    }
    let even: Vec<String> = measured.iter().filter(|d| d.winner.is_none()).map(|d| with_rates(found, d)).collect();
    if !even.is_empty() {
        out.push(format!("No significant difference in detection: {}.", even.join("; ")));
    }
    let unmet: Vec<&str> = classes.iter().filter(|d| d.difference.is_none()).map(|d| d.what.as_str()).collect();
    if !unmet.is_empty() {
        out.push(format!("Not measured, since it never came into play: {}.", unmet.join(", ")));
    }
    out.extend(found.differences.iter().filter(|d| d.measure != "detection rate").filter_map(other));
    out.push(format!(
        "“Significant” means: over {seeds} seeds, paired, at 5 % after Holm's correction for all {count} comparisons on this page."
    ));
    out
}

/// A class with both rates.
fn with_rates(found: &Comparison, difference: &Difference) -> String {
    let rate = |sensor: &str| {
        let result = found.classes.get(&difference.what).and_then(|by| by.get(sensor));
        result.and_then(|result| result.rate).map_or("–".to_string(), |rate| format!("{:.0}", rate * 100.0))
    };
    format!("{} ({} against {} %)", difference.what, rate("laser"), rate("ultrasonic"))
}

fn other(difference: &Difference) -> Option<String> {
    let Value { value, .. } = difference.difference?;
    let (amount, what) = match difference.measure {
        "RMS range error [m]" => (format!("{:.0} mm", value.abs() * 1e3), "error of range, RMS"),
        "RMS bearing error [rad]" => (format!("{:.1}°", value.abs().to_degrees()), "error of bearing, RMS"),
        "share of false obstacles" => {
            (format!("{:.1} points of per cent", value.abs() * 1e2), "share of false obstacles")
        }
        "IoU" => (format!("{:.2}", value.abs()), "map, intersection over union with the truth"),
        _ => (format!("{:.1} points of per cent", value.abs() * 1e2), "map, free cells that are not"),
    };
    let (first, second) = if value > 0.0 { ("laser", "ultrasonic ring") } else { ("ultrasonic ring", "laser") };
    Some(match difference.winner {
        Some(winner) => {
            let better = if winner == "laser" { "the laser is better" } else { "the ultrasonic ring is better" };
            format!("{}: {better}; the {first}'s is {amount} above the {second}'s.", capital(what))
        }
        None => {
            format!("{}: no significant difference (the {first}'s is {amount} above the {second}'s).", capital(what))
        }
    })
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}
