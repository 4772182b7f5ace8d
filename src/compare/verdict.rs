//! The result in plain words.

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

/// What is asked of all classes together, with both sensors' means.
fn other(difference: &Difference) -> Option<String> {
    let Difference { laser: Some(laser), ultrasonic: Some(ultrasonic), winner, .. } = *difference else { return None };
    let percent = |share: f64| format!("{:.1} %", share * 100.0);
    let (what, show): (&str, &dyn Fn(f64) -> String) = match difference.measure {
        "RMS range error [m]" => ("Error of range, RMS", &|m| format!("{:.0} mm", m * 1e3)),
        "RMS bearing error [rad]" => ("Error of bearing, RMS", &|rad| format!("{:.2}°", rad.to_degrees())),
        "share of false obstacles" => ("Share of false obstacles", &percent),
        "IoU" => ("Map, intersection over union with the truth", &|iou| format!("{iou:.2}")),
        _ => ("Map, share of its free cells that are not free", &percent),
    };
    let judged = match winner {
        Some("laser") => "the laser is better",
        Some(_) => "the ultrasonic ring is better",
        None => "no significant difference",
    };
    Some(format!("{what}: laser {}, ultrasonic ring {}: {judged}.", show(laser), show(ultrasonic)))
}
