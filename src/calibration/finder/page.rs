//! The report of a finder's calibration, as one page: verdict, parameters, what is left slit by slit, what is weak, what to do.

use std::fmt::Write;

use super::bundle::{FinderFit, Held};
use super::trust::{Limits, Verdict};
use crate::fault::Result;
use crate::optics::Rig;
use crate::report::html::{self, figures};
use crate::report::{Plot, Series, Style, escaped};

impl Held {
    fn words(self) -> &'static str {
        match self {
            Self::Data => "the slits",
            Self::Prior => "what was known, sharpened by the slits",
            Self::Weak => "nothing: see below",
            Self::Known => "taken as known",
        }
    }
}

/// The whole report as HTML. `nominal` is the finder that the calibration started from.
///
/// Errors: a `nominal` without a mirror.
pub fn page(fit: &FinderFit, verdict: &Verdict, limits: &Limits, nominal: &Rig) -> Result<String> {
    let mut body = format!("<h1>Calibration of the finder {}</h1>", escaped(&fit.rig.name));
    body += &judged(fit, verdict, limits);
    body += "<h2>Parameters</h2><p>σ is one standard deviation; a value is good to ± 2 σ in 95 of 100 calibrations like this \
             one. <b>held by</b>: what the value comes from.</p>";
    let before = fit.numbers_of(nominal)?;
    let rows = fit.report.parameters.iter().enumerate().map(|(i, p)| {
        let held = fit.held.get(&p.name).copied().unwrap_or(Held::Known);
        let [value, sigma] = html::with_sigma(p.value, p.sigma);
        let start = before.get(i).map_or(String::new(), |b| html::with_sigma(*b, p.sigma)[0].clone());
        [format!("{} [{}]", p.name, p.unit), start, value, sigma, held.words().to_string()]
    });
    body += &html::table(["parameter", "before", "calibrated", "σ", "held by"], rows);
    body += &weak(fit);
    body += "<h2>What is left of the readings</h2>";
    body += &html::gallery(plots(fit).iter().map(html::drawing));
    body += "<h2>Slit by slit</h2><p>rms: the readings of a slit over their standard deviations, 1 on average where those are \
             right. pulse off: the most likely error of the mirror's reading. mark off: predicted minus read, on tape or \
             ruler. row off: the rms of its rows in the image.</p>";
    let rows = fit.slits.iter().map(|slit| {
        let rows_px = slit.rows_off_px.iter().map(|[_, off]| off * off).sum::<f64>();
        let row_off = (rows_px / slit.rows_off_px.len() as f64).sqrt();
        [
            slit.what.clone(),
            slit.readings.to_string(),
            figures(slit.rms, 3),
            figures(slit.pulse_off, 2),
            slit.mark_off_m.map_or("–".into(), |off| figures(off * 1e3, 2)),
            figures(row_off, 2),
        ]
    });
    body += &html::table(["slit", "readings", "rms", "pulse off", "mark off [mm]", "row off [px]"], rows);
    if !fit.report.rejected.is_empty() {
        body += "<h2>Left out</h2><p>These do not fit the others. Look at them again before you trust the rest.</p>";
        let rows = fit.report.rejected.iter().map(|r| [r.what.clone(), r.why.clone()]);
        body += &html::table(["reading", "why"], rows);
    }
    Ok(html::page(&format!("Calibration of {}", fit.rig.name), &body))
}

fn judged(fit: &FinderFit, verdict: &Verdict, limits: &Limits) -> String {
    let left_out = match fit.report.rejected.len() {
        0 => String::new(),
        count => format!(", {count} readings or slits left out"),
    };
    let about = format!(
        "{} slits{left_out}. The readings are off by {:.2} of their standard deviations rms (at most {} is accepted). The \
         calibration itself leaves {:.1} mm (σ) in the range of the floor {} m ahead (at most {} mm).",
        fit.report.used,
        fit.report.residual.rms,
        figures(limits.rms_max, 3),
        verdict.range_sigma_m * 1e3,
        figures(limits.floor_m, 3),
        figures(limits.range_sigma_m_max * 1e3, 3)
    );
    if verdict.accepted {
        return format!("<p class=\"good\">Accepted.</p><p>{about}</p>");
    }
    let reasons: String = verdict.reasons.iter().map(|reason| format!("<li>{}</li>", escaped(reason))).collect();
    format!("<p class=\"bad\">Not accepted:</p><ul class=\"bad\">{reasons}</ul><p>{about}</p>")
}

/// What the data do not tell apart, and what to measure next.
fn weak(fit: &FinderFit) -> String {
    if fit.weak.is_empty() {
        return String::new();
    }
    let mut html = String::from(
        "<h2>What the slits do not tell apart</h2><p>All parameters of a line may change together by as much, and hardly a \
         reading would change. They are kept near what was known before.</p><ul>",
    );
    for weak in &fit.weak {
        let changes: Vec<String> = (weak.changes.iter())
            .map(|(name, by)| format!("{} by {}{}", escaped(name), if *by > 0.0 { "+" } else { "" }, figures(*by, 2)))
            .collect();
        let _ =
            write!(html, "<li>{} ({:.0} % of what was unknown is left)</li>", changes.join(", "), weak.left * 100.0);
    }
    html += "</ul>";
    if fit.advice.is_empty() {
        return html + "<p>No measurement that this program knows would settle it: hold what you know of them.</p>";
    }
    html += "<h2>What to measure next</h2><p>Each on top of those before it.</p><ol>";
    for advice in &fit.advice {
        let settles: Vec<String> = (advice.settles.iter())
            .map(|(name, [now, then])| format!("{}: σ {} → {}", escaped(name), figures(*now, 2), figures(*then, 2)))
            .collect();
        let _ = write!(html, "<li>{}<br><small>{}</small></li>", escaped(advice.measure), settles.join("; "));
    }
    html + "</ol>"
}

fn plots(fit: &FinderFit) -> Vec<Plot> {
    let over_pulses = |pick: &dyn Fn(&super::SlitResidual) -> Option<f64>| -> Vec<(f64, f64)> {
        fit.slits.iter().filter_map(|slit| Some((slit.mirror_pulse, pick(slit)?))).collect()
    };
    let rows = fit.slits.iter().flat_map(|slit| slit.rows_off_px.iter().map(|[u, off]| (*u, *off))).collect();
    let by_slit = fit.slits.iter().flat_map(|slit| slit.rows_off_px.iter().map(|[_, off]| (slit.mirror_pulse, *off)));
    let reach = |(x_m, sigma): (f64, f64)| (x_m, sigma * 1e3);
    vec![
        Plot::new("Rows over the image", "column", "px", "row off", "px").with(Series::new("", Style::Points, rows)),
        Plot::new("Rows over the mirror", "mirror", "pulses", "row off", "px").with(Series::new(
            "",
            Style::Points,
            by_slit.collect(),
        )),
        Plot::new("Marks over the mirror", "mirror", "pulses", "mark off", "mm").with(Series::new(
            "",
            Style::Dots,
            over_pulses(&|slit| slit.mark_off_m.map(|off| off * 1e3)),
        )),
        Plot::new("The mirror's own readings", "mirror", "pulses", "most likely off by", "pulses").with(Series::new(
            "",
            Style::Dots,
            over_pulses(&|slit| Some(slit.pulse_off)),
        )),
        Plot::new("Range error that the calibration leaves on the floor", "ahead", "m", "σ", "mm")
            .with(Series::new("", Style::Line, fit.range_sigmas().into_iter().map(reach).collect()))
            .from_zero(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::finder::{Assumptions, CameraPrior, Procedure, calibrate};
    use rand::SeedableRng;
    use rand_chacha::ChaCha12Rng;

    fn report(marks: Vec<f64>, assumptions: Assumptions) -> String {
        let camera = Some(CameraPrior::two_planes([11.434, 1.095, 0.00335, 256.0, 239.0]));
        let rig = Rig::metro_i();
        let mut seen =
            Procedure::on_marks(rig.clone(), 0.9, marks).measure(&mut ChaCha12Rng::seed_from_u64(2)).unwrap();
        seen.slits[2].name = "<third>".into();
        let fit = calibrate(&rig, &seen, &Assumptions { camera, ..assumptions }).unwrap();
        let verdict = fit.verdict(&Limits::default()).unwrap();
        page(&fit, &verdict, &Limits::default(), &rig).unwrap()
    }

    #[test]
    fn a_good_calibration_says_so_and_a_weak_one_what_to_do() {
        let good = report(Procedure::marks(21, 2.0), Assumptions::paper());
        assert!(good.contains(">Accepted.<") && !good.contains("do not tell apart"));
        assert!(good.contains("&lt;third&gt;") && good.matches("<svg").count() == 5 && !good.contains("NaN"));
        let weak = report(Procedure::marks(21, 2.0), Assumptions::free());
        assert!(weak.contains("What the slits do not tell apart") && weak.contains("What to measure next"));
        let poor = report(vec![0.6, 1.2, 1.8], Assumptions::paper());
        assert!(poor.contains("Not accepted") && poor.contains("range error"));
    }
}
