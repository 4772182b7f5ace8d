//! The result in plain words.

use super::summary::{Comparison, Difference};

/// Sentences, most important first: where each wins, where there is no difference to be seen, what the maps are worth.
pub fn verdict(found: &Comparison) -> Vec<String> {
    let mut out = Vec::new();
    let seeds = found.seeds.len();
    if found.differences.is_empty() {
        return alone(found);
    }
    let classes: Vec<&Difference> = found.differences.iter().filter(|d| d.measure == "detection rate").collect();
    let measured: Vec<&&Difference> = classes.iter().filter(|d| d.difference.is_some()).collect();
    if measured.is_empty() {
        out.push("No obstacle came into play near enough: no detection rate was measured.".to_string());
    }
    let count = found.differences.iter().filter(|d| d.p.is_some()).count();
    let least = 2.0_f64.powi(1 - seeds.min(60) as i32).min(1.0);
    // Flipped signs of n seeds give 2^(1 - n) at least, and Holm asks ALPHA/count of the first.
    let enough = (count as f64 / super::ALPHA).log2().ceil().max(0.0) as u64 + 1;
    let is_hopeless = seeds < 2 || least * count as f64 > super::ALPHA;
    if seeds < 2 {
        out.push("A single seed has no spread: no interval, and no difference that could be significant.".to_string());
    } else if is_hopeless && !measured.is_empty() {
        out.push(format!(
            "Too few seeds: with {seeds} no difference can be significant, however large; {enough} or more can show one."
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
        let what = if is_hopeless { "Not decided" } else { "No significant difference in detection" };
        out.push(format!("{what}: {}.", even.join("; ")));
    }
    let unmet: Vec<&str> = classes.iter().filter(|d| d.difference.is_none()).map(|d| d.what.as_str()).collect();
    if !unmet.is_empty() {
        out.push(format!("Not measured, since it was never in play near enough: {}.", unmet.join(", ")));
    }
    out.extend(
        found.differences.iter().filter(|d| d.measure != "detection rate").filter_map(|d| other(d, is_hopeless)),
    );
    if seeds > 1 {
        out.push(format!(
            "“Significant” means: over {seeds} seeds, paired, at 5 % after Holm's correction for all {count} comparisons on this page."
        ));
    }
    out
}

/// Where one sensor was at work there is no verdict, but what it detected.
fn alone(found: &Comparison) -> Vec<String> {
    let name = if found.sensors.laser { "laser" } else { "ultrasonic" };
    let rate = |class: &String| {
        let rate = found.classes.get(class)?.get(name)?.rate?;
        Some(format!("{class} {:.0} %", rate * 100.0))
    };
    let rates: Vec<String> = found.order.iter().filter_map(rate).collect();
    let rates = if rates.is_empty() { "no obstacle was in play near enough".to_string() } else { rates.join("; ") };
    vec![format!("Only one sensor was at work, there is nothing to compare it with. Detected, {name}: {rates}.")]
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
fn other(difference: &Difference, is_hopeless: bool) -> Option<String> {
    let Difference { laser: Some(laser), ultrasonic: Some(ultrasonic), winner, .. } = *difference else { return None };
    let percent = |share: f64| format!("{:.1} %", share * 100.0);
    let (what, show): (&str, &dyn Fn(f64) -> String) = match difference.measure {
        "RMS range error [m]" => ("Error of range, RMS, of what both saw", &|m| format!("{:.0} mm", m * 1e3)),
        "RMS bearing error [rad]" => {
            ("Error of bearing, RMS, of what both saw", &|rad| format!("{:.2}°", rad.to_degrees()))
        }
        "share of false obstacles" => ("Share of false obstacles", &percent),
        "IoU" => ("Map, intersection over union with the truth", &|iou| format!("{iou:.2}")),
        _ => ("Map, share of its free cells that are not free", &percent),
    };
    let judged = match winner {
        Some("laser") => "the laser is better",
        Some(_) => "the ultrasonic ring is better",
        None if is_hopeless => "not decided",
        None => "no significant difference",
    };
    Some(format!("{what}: laser {}, ultrasonic ring {}: {judged}.", show(laser), show(ultrasonic)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compare::summary::tests::{scenario, trial};
    use crate::compare::{Sensors, Trial, sum_up};

    fn said(seeds: u64, seen: [usize; 2], sensors: Sensors) -> Vec<String> {
        let trials: Vec<Trial> = (0..seeds).map(|seed| trial(seed, seen)).collect();
        verdict(&sum_up(&scenario(), "f", sensors, &trials).unwrap())
    }

    #[test]
    fn it_says_who_wins_and_where_nobody_does() {
        let found = said(12, [2, 1], Sensors::BOTH);
        assert_eq!(found[0], "The laser detects more often: box (100 against 50 %).");
        assert_eq!(found[1], "The ultrasonic ring is not significantly better at detecting anything here.");
        assert!(
            found
                .iter()
                .any(|s| s == "Error of range, RMS, of what both saw: laser 20 mm, ultrasonic ring 20 mm: no significant difference.")
        );
        assert_eq!(
            said(12, [0, 2], Sensors::BOTH)[1],
            "The ultrasonic ring detects more often: box (0 against 100 %)."
        );
        assert!(
            said(12, [1, 1], Sensors::BOTH)[2]
                .starts_with("No significant difference in detection: box (50 against 50 %)")
        );
    }

    #[test]
    fn too_few_seeds_and_single_sensors_have_no_winner() {
        assert!(said(1, [2, 0], Sensors::BOTH)[0].starts_with("A single seed has no spread"));
        let few = said(4, [2, 0], Sensors::BOTH);
        assert!(few[0].starts_with("Too few seeds: with 4 "), "{few:?}");
        assert!(few.iter().all(|s| !s.contains("detects more often") && !s.contains("not significantly better")));
        let alone = said(4, [2, 0], Sensors { laser: true, ultrasonic: false });
        assert_eq!(
            alone,
            ["Only one sensor was at work, there is nothing to compare it with. Detected, laser: box 100 %."]
        );
    }
}
