//! The part of the report where the ring's model is held against recorded readings.

use super::readings::Readings;
use crate::report::html;
use crate::report::{Plot, Series, Style, escaped};
use crate::sonar::{BIN_M, JUMP_M, RangeStatistics};

/// The ring's model against a real robot's recorded readings: rates, histograms, what they say, and what they do not.
pub fn ring_against_readings(found: &Readings) -> String {
    let Readings { real, simulated, .. } = found;
    let percent = |rate: Option<f64>| rate.map_or("not measured".into(), |rate| format!("{:.1}", rate * 100.0));
    let row = |name: &str, s: &RangeStatistics| {
        [name.to_string(), s.readings.to_string(), percent(s.dropout_rate()), percent(s.jump_rate())]
    };
    let limit = format!("at the limit of {} m [%]", real.limit_m);
    let jumps = format!("steps of more than {JUMP_M} m [%]");
    let lead = format!(
        "How like a real ring is the model? Ranges of a real robot's ring ({}) beside those that the model reads when a robot \
         carries it once around the goals of “{}” ({}), with the ring as that file has it, not as this comparison does. A range of \
         {} m or more, or no echo, is at the limit; a step is from a transducer's range to its next one.",
        name(&found.file),
        found.world,
        name(&found.world_file),
        real.limit_m
    );
    let caveat = format!(
        "The simulated room is not the real one, and its robot goes exactly from goal to goal: what is always equally far \
         stands out more. As far as the room was laid out with the recording in view, agreement is a fit, not a prediction: \
         it shows that the model can read like a real ring, not that it foretells one. A row of readings takes the model {:.2} s; \
         where a recording's takes more or less, so do its steps.",
        found.row_s
    );
    let said = found.sentences().map(|sentence| format!("<li>{}</li>", escaped(&sentence))).concat();
    String::from("<h2>The ring against real readings</h2>")
        + &format!("<p style=\"overflow-wrap:anywhere\">{}</p>", escaped(&lead))
        + &html::table(
            ["ranges of", "count", &limit, &jumps],
            [row("the real ring", real), row("the model", simulated)],
        )
        + &html::even_gallery([ranges(found), changes(found)])
        + &format!("<ul class=\"verdict\">{said}</ul><p>{}</p>", escaped(&caveat))
        + &about(found)
}

fn share(count: u64, of: u64) -> f64 {
    100.0 * count as f64 / of.max(1) as f64
}

/// The outline of a histogram from its bins' shares [%], from this bin on, down to 0 at both ends.
fn outline(bins: &[u64], of: u64, from: usize) -> Vec<(f64, f64)> {
    let edge = |i: usize| i as f64 * BIN_M;
    let steps = bins.iter().enumerate().skip(from);
    let top = steps.flat_map(|(i, count)| [i, i + 1].map(|end| (edge(end), share(*count, of))));
    std::iter::once((edge(from), 0.0)).chain(top).chain([(edge(bins.len()), 0.0)]).collect()
}

fn ranges(found: &Readings) -> String {
    let mut plot = Plot::new("Ranges", "range", "m", "share of ranges", "%").from_zero();
    for (name, s) in [("real ring", &found.real), ("model", &found.simulated)] {
        plot = plot.with(Series::new(name, Style::Line, outline(&s.ranges, s.readings, 0)));
    }
    let caption =
        format!("Bins of {BIN_M} m. All ranges at the limit of {} m are in the last bin.", found.real.limit_m);
    html::captioned(&plot.svg(), &caption)
}

fn changes(found: &Readings) -> String {
    let mut plot =
        Plot::new("Steps from a range to the next", "size of the step", "m", "share of steps", "%").from_zero();
    let both = [("real ring", &found.real), ("model", &found.simulated)];
    let mut high = 0f64;
    for (name, s) in both {
        let outline = outline(&s.changes, s.steps, 1);
        high = outline.iter().fold(high, |high, point| high.max(point.1));
        plot = plot.with(Series::new(name, Style::Line, outline));
    }
    let limit = vec![(JUMP_M, 0.0), (JUMP_M, high)];
    plot = plot.with(Series::new("larger ones: jumps", Style::Dashed, limit).coloured(5));
    let [real, model] = both.map(|(_, s)| share(s.changes.first().copied().unwrap_or(0), s.steps));
    let caption = format!(
        "Bins of {BIN_M} m. Left out is the first one, steps of less than {BIN_M} m: {real:.1} % of the real ring's, {model:.1} % of \
         the model's."
    );
    html::captioned(&plot.svg(), &caption)
}

/// What the file of the simulated room says of itself.
fn about(found: &Readings) -> String {
    if found.about.is_empty() {
        return String::new();
    }
    let shown = |text: &String| escaped(&text.strip_prefix("- ").map_or(text.clone(), |point| format!("• {point}")));
    let paragraphs: String = found.about.iter().map(|text| format!("<p><small>{}</small></p>", shown(text))).collect();
    let file = escaped(name(&found.world_file));
    format!("<details><summary>How the room was chosen, in the words of {file}</summary>{paragraphs}</details>")
}

/// A file without its directories: paths are too long for a telephone.
fn name(path: &str) -> &str {
    path.rsplit(['/', '\\']).next().unwrap_or(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_outline_begins_and_ends_at_zero() {
        let points = outline(&[8, 1, 1], 10, 1);
        let expected = [(0.1, 0.0), (0.1, 10.0), (0.2, 10.0), (0.2, 10.0), (0.3, 10.0), (0.3, 0.0)];
        assert_eq!(points.len(), expected.len());
        for (found, expected) in points.iter().zip(&expected) {
            assert!((found.0 - expected.0).abs() < 1e-12 && (found.1 - expected.1).abs() < 1e-12, "{points:?}");
        }
    }
}
