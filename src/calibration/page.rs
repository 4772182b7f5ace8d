//! The report of a calibration as one page: verdict, parameters, what is left, image by image.

use super::report::{Rejected, Report, Verdict, Weak};
use crate::report::html::{self, figures, number};
use crate::report::{Plot, Series, Style, escaped};

/// What the pages of camera and plane have in common.
pub(super) struct Page<'a> {
    pub title: String,
    /// What was done, in a sentence or two.
    pub about: String,
    pub verdict: &'a Verdict,
    /// The limits that were asked for, in words.
    pub limits: String,
    pub report: &'a Report,
    pub weak: &'a [Weak],
    pub plots: Vec<Plot>,
    /// The table of images, with a heading and what its columns mean.
    pub images: String,
}

impl Page<'_> {
    /// The whole page as HTML.
    pub fn html(&self) -> String {
        let mut body = format!("<h1>{}</h1>", escaped(&self.title));
        if self.verdict.accepted {
            body += "<p class=\"good\">Accepted.</p>";
        } else {
            body += &format!("<p class=\"bad\">NOT accepted: {}.</p>", escaped(&self.verdict.reasons.join("; ")));
        }
        body += &format!("<p>{}</p><p>Limits: {}.</p>", escaped(&self.about), escaped(&self.limits));
        body += "<h2>Parameters</h2><p>σ is one standard deviation; a value is good to ± 2 σ in 95 of 100 calibrations like this one. \
                 A dash: it was held.</p>";
        let rows = self.report.parameters.iter().map(|p| {
            let sigma = if p.sigma == 0.0 { "–".to_string() } else { figures(p.sigma, 2) };
            [p.name.clone(), number(p.value), sigma, p.unit.to_string()]
        });
        body += &html::table(["parameter", "value", "σ", "unit"], rows);
        if !self.weak.is_empty() {
            body += "<h2>What the data hardly tell apart</h2><p>These change together: both may be off by what stands there, and \
                     the images would look the same.</p>";
            let rows = self.weak.iter().map(|w| [said(w), figures(w.correlation, 4)]);
            body += &html::table(["together", "correlation"], rows);
        }
        body += "<h2>What is left</h2>";
        body += &html::gallery(self.plots.iter().map(html::drawing));
        body += &self.images;
        if !self.report.rejected.is_empty() {
            body += "<h2>Left out</h2><p>These do not fit the others.</p>";
            let row = |r: &Rejected| [r.what.clone(), r.why.clone()];
            body += &html::table(["what", "why"], self.report.rejected.iter().map(row));
        }
        html::page(&self.title, &body)
    }
}

/// `f_mm by 0.1 with tz_m by -0.01`.
pub fn said(weak: &Weak) -> String {
    let one = |(name, by): &(String, f64)| format!("{name} by {}", figures(*by, 2));
    weak.changes.iter().map(one).collect::<Vec<_>>().join(" with ")
}

/// Vectors from places in the image [px], drawn longer so that they can be seen.
pub(super) fn vectors(title: &str, size: [usize; 2], all: &[([f64; 2], [f64; 2])]) -> Plot {
    let rms = (all.iter().map(|(_, d)| d[0] * d[0] + d[1] * d[1]).sum::<f64>() / all.len().max(1) as f64).sqrt();
    let width = size[0] as f64;
    // One of 1, 2, 5, 10 … so that the usual one is about a fiftieth of the image.
    let wanted = (width / 50.0 / rms.max(1e-9)).clamp(1.0, 1e6);
    let power = 10f64.powf(wanted.log10().floor());
    let longer = [5.0, 2.0, 1.0].into_iter().map(|m| m * power).find(|m| *m <= wanted).unwrap_or(1.0);
    let ends = |(at, d): &([f64; 2], [f64; 2])| [(at[0], at[1]), (at[0] + longer * d[0], at[1] + longer * d[1])];
    let (right, bottom) = (width - 1.0, size[1] as f64 - 1.0);
    let frame = vec![(0.0, 0.0), (right, 0.0), (right, bottom), (0.0, bottom), (0.0, 0.0)];
    Plot::new(&format!("{title}, {longer} x longer"), "column", "px", "row", "px")
        .with(Series::new("the image", Style::Line, frame))
        .with(Series::new("seen minus predicted", Style::Segments, all.iter().flat_map(ends).collect()))
        .downwards()
}

/// How often residuals of each size occur.
pub(super) fn histogram(title: &str, unit: &str, values: &[f64]) -> Plot {
    const BARS: usize = 30;
    let mut sizes: Vec<f64> = values.iter().map(|v| v.abs()).filter(|v| v.is_finite()).collect();
    sizes.sort_by(f64::total_cmp);
    // The few largest would make all others one bar.
    let most =
        sizes.get((sizes.len() * 995 / 1000).min(sizes.len().saturating_sub(1))).copied().unwrap_or(1.0).max(1e-12);
    let mut counts = [0.0; BARS];
    for value in values.iter().filter(|v| v.abs() <= most) {
        let bar = ((value / most + 1.0) / 2.0 * BARS as f64) as usize;
        counts[bar.min(BARS - 1)] += 1.0;
    }
    let at = |bar: usize| most * (2.0 * bar as f64 / BARS as f64 - 1.0);
    let steps = counts.iter().enumerate().flat_map(|(bar, count)| [(at(bar), *count), (at(bar + 1), *count)]);
    Plot::new(title, "residual", unit, "how many", "").with(Series::new("", Style::Line, steps.collect())).from_zero()
}
