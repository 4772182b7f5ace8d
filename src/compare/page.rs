//! The report: one page that needs no network.

use super::layers::{Picture, Shown};
use super::ledger::BIN_M;
use super::plan;
use super::statistics::{Rate, Value};
use super::summary::{ClassResult, Comparison};
use super::trial::Sensors;
use super::verdict::verdict;
use crate::fault::Result;
use crate::maps::PlanView;
use crate::report::html;
use crate::report::{Plot, Series, Style, escaped};

/// What the models leave out, said to whoever reads the report.
const LIMITS: [&str; 10] = [
    "Both sensors are models. The ring's echoes come from closed forms for pistons, mirrors, edges and round bodies; edges that \
     sound meets twice, draughts and the fading of rough echoes are left out.",
    "The laser's images leave out light between matt surfaces and lines seen in a mirror; direct sun lies on a part of the floor \
     as bright whichever way a surface faces.",
    "Glass lets light through as if it were not there; of its mirror images only the first bounce is drawn.",
    "A person is three cylinders that glide along: no legs that swing, no clothes that hang.",
    "The robot drives blind to its maps, so that both sensors are asked about the same way; it does not avoid anything.",
    "Seeds change noise, odometry, the air's temperature, when the robot starts, and the way by some centimetres; not the world. The intervals are for \
     this world, not for all rooms.",
    "Only what lies ahead counts, where the finder looks while driving. The ring sees all around, which the maps show and the \
     detection rates do not.",
    "A report is false only where no surface at all, seen or hidden, is within the tolerance: a wide cone finds one by chance more \
     often than a point does, which favours the ring.",
    "Power is the data sheets' for the ring's modules and an estimate for the finder; computers are left out.",
    "The laser's maps are made while driving, from a few lines in each view; standing still for a scan it would see more.",
];

/// The page. `shown`: one seed's way, and the maps of it. `extra`: one more part, as HTML.
///
/// # Errors
/// A picture that is damaged.
pub fn page(found: &Comparison, shown: Option<&Shown>, extra: &str) -> Result<String> {
    let mut body = format!("<h1>{}</h1>", escaped(&format!("Laser against ultrasonic: {}", found.name)));
    let time = found.sim_s.map_or("–".into(), |v| format!("{:.0}", v.value));
    let way = found.travel_m.map_or("–".into(), |v| format!("{:.1}", v.value));
    let who = if found.sensors == Sensors::BOTH { "both sensors" } else { "one sensor" };
    let lead = format!(
        "One robot with {who} drove through a simulated world: {} of {time} s and {way} m. What was said was held against \
         what truly was there.",
        match found.seeds.len() {
            1 => "one seed".to_string(),
            seeds => format!("the same way in the same seconds, {seeds} seeds"),
        }
    );
    body += &format!("<p>{}</p><ul class=\"verdict\">", escaped(&lead));
    for sentence in verdict(found) {
        let (head, rest) = sentence.split_once(": ").unwrap_or(("", &sentence));
        let head = if head.is_empty() { String::new() } else { format!("<b class=\"note\">{}:</b> ", escaped(head)) };
        body += &format!("<li>{head}{}</li>", escaped(rest));
    }
    body += "</ul>";
    let views = shown.map_or(&[][..], |shown| &shown.maps).iter().map(Picture::view).collect::<Result<Vec<_>>>()?;
    if let (Some(truth), Some(shown)) = (views.first(), shown) {
        body += &plan::world(truth, shown, &found.order)?;
    }
    body += &detection_table(found);
    body += &errors_table(found);
    body += &by_distance(found);
    body += &error_plots(found);
    body += &false_obstacles(found);
    body += &maps(found, &views)?;
    body += &needs(found);
    body += extra;
    body += &definitions(found);
    Ok(html::page(&format!("Laser against ultrasonic: {}", found.name), &body))
}

fn percent(rate: Option<f64>, ci95: Option<[f64; 2]>) -> String {
    let Some(rate) = rate else { return "not measured".into() };
    let ends = ci95.map_or(String::new(), |[low, high]| format!(" ({:.0}–{:.0})", low * 100.0, high * 100.0));
    format!("{:.0}{ends}", rate * 100.0)
}

fn share(rate: Option<Rate>) -> String {
    percent(rate.map(|r| r.rate), rate.and_then(|r| r.ci95))
}

fn measured(value: Option<Value>, unit: f64, decimals: usize, none: &str) -> String {
    let Some(Value { value, ci95 }) = value else { return none.into() };
    let ends =
        ci95.map_or(String::new(), |[low, high]| format!(" ({:.decimals$}–{:.decimals$})", low * unit, high * unit));
    format!("{:.decimals$}{ends}", value * unit)
}

fn result<'a>(found: &'a Comparison, class: &str, sensor: &str) -> Option<&'a ClassResult> {
    found.classes.get(class)?.get(sensor)
}

fn detection_table(found: &Comparison) -> String {
    let rows = found.order.iter().zip(1..).map(|(class, number)| {
        let rate = |sensor| result(found, class, sensor).map_or("–".into(), |r| percent(r.rate, r.ci95));
        let tries = found.classes.get(class).and_then(|by| by.values().next()).map_or(0, |r| r.opportunities);
        let difference = found.differences.iter().find(|d| d.what == *class && d.measure == "detection rate");
        let p = difference
            .and_then(|d| d.p_holm)
            .map_or("–".into(), |p| if p < 0.001 { "<0.001".into() } else { format!("{p:.3}") });
        let winner = match difference.and_then(|d| d.winner) {
            Some(winner) => winner.to_string(),
            None => "–".into(),
        };
        let either = share(found.either.get(class).copied().flatten());
        [format!("{number} {class}"), tries.to_string(), rate("laser"), rate("ultrasonic"), winner, p, either]
    });
    String::from("<h2>Detection</h2>")
        + "<p>Share of opportunities in which the obstacle was seen, in per cent, with 95 % intervals over seeds.</p>"
        + &html::table(
            ["class", "opportunities", "laser [%]", "ultrasonic [%]", "better", "p (Holm)", "either of them [%]"],
            rows,
        )
}

fn errors_table(found: &Comparison) -> String {
    let rows = found.order.iter().zip(1..).flat_map(|(class, number)| {
        let by = found.classes.get(class).into_iter().flatten();
        by.map(move |(sensor, r)| {
            let never = if r.opportunities == 0 { "not measured" } else { "mostly never" };
            [
                format!("{number} {class}, {sensor}"),
                measured(r.range_rmse_m, 1e3, 0, "–"),
                measured(r.bearing_rmse_rad, 180.0 / std::f64::consts::PI, 2, "–"),
                measured(r.first_detection_m, 1.0, 1, never),
                measured(r.first_detection_s, 1.0, 1, never),
                share(r.false_share),
            ]
        })
    });
    String::from("<h2>How well, how early, and how often false</h2>")
        + "<p>RMS errors over sightings; distance and time of the first sighting are medians over encounters; false are reports \
           in the obstacle's direction that no surface explains.</p>"
        + &html::table(
            ["class, sensor", "range error [mm]", "bearing error [°]", "first seen at [m]", "after [s]", "false [%]"],
            rows,
        )
}

fn false_obstacles(found: &Comparison) -> String {
    let rows = found.false_obstacles.iter().map(|(sensor, f)| {
        let reports = f.of_reports.map_or(0, |rate| rate.of);
        [(*sensor).to_string(), reports.to_string(), share(f.of_reports), share(f.of_seconds)]
    });
    String::from("<h2>False obstacles over the whole way</h2>")
        + "<p>Reports, all around the robot, where no obstacle has a surface within the tolerance.</p>"
        + &html::table(["sensor", "reports", "false [%]", "seconds with a false one [%]"], rows)
}

fn by_distance(found: &Comparison) -> String {
    let plots = found.order.iter().zip(1..).filter_map(|(class, number)| {
        let mut plot =
            Plot::new(&format!("{number} {}", capital(class)), "distance", "m", "detection rate", "%").from_zero();
        let mut any = false;
        for (colour, sensor) in ["laser", "ultrasonic"].into_iter().enumerate() {
            let Some(r) = result(found, class, sensor).filter(|r| !r.by_distance.is_empty()) else { continue };
            any = true;
            let off = 0.04 * colour as f64 - 0.02;
            let middle = |bin: &super::DistanceRate| (bin.from_m + bin.to_m) / 2.0 + off;
            let bars = r.by_distance.iter().filter_map(|bin| {
                let [low, high] = bin.rate.ci95?;
                Some([(middle(bin), low * 100.0), (middle(bin), high * 100.0)])
            });
            let dots = r.by_distance.iter().map(|bin| (middle(bin), bin.rate.rate * 100.0)).collect();
            plot = plot.with(Series::new(sensor, Style::Dots, dots).coloured(colour));
            // Lines end where bins are missing.
            for run in r.by_distance.chunk_by(|a, b| b.from_m - a.to_m < BIN_M / 2.0) {
                let line = run.iter().map(|bin| (middle(bin), bin.rate.rate * 100.0)).collect();
                plot = plot.with(Series::new("", Style::Line, line).coloured(colour));
            }
            plot = plot.with(Series::new("", Style::Segments, bars.flatten().collect()).coloured(colour));
        }
        // An invisible point keeps every plot's height at 100 %.
        plot = plot.with(
            Series::new("", Style::Segments, vec![(1.0, 0.0), (1.0, 0.0), (4.0, 100.0), (4.0, 100.0)]).coloured(5),
        );
        any.then(|| html::drawing(&plot))
    });
    String::from("<h2>Detection by distance</h2>")
        + "<p>Bins of half a metre; bars are 95 % intervals. Where a line is missing, the obstacle was never in play at that \
           distance.</p>"
        + &html::even_gallery(plots)
}

fn error_plots(found: &Comparison) -> String {
    let plot = |title: &str, unit: &str, scale: f64, pick: fn(&ClassResult) -> Option<Value>| {
        let mut plot = Plot::new(title, "number of the class in the tables above", "", "RMS error", unit).log_y();
        for (colour, sensor) in ["laser", "ultrasonic"].into_iter().enumerate() {
            let off = 0.2 * colour as f64 - 0.1;
            let numbered = found.order.iter().enumerate();
            let values: Vec<(f64, Value)> = numbered
                .filter_map(|(i, class)| Some((i as f64 + 1.0 + off, pick(result(found, class, sensor)?)?)))
                .collect();
            let dots = values.iter().map(|(x, v)| (*x, v.value * scale)).collect();
            let bars = values.iter().filter_map(|(x, v)| v.ci95.map(|[l, h]| [(*x, l * scale), (*x, h * scale)]));
            plot = plot.with(Series::new(sensor, Style::Dots, dots).coloured(colour));
            plot = plot.with(Series::new("", Style::Segments, bars.flatten().collect()).coloured(colour));
        }
        html::drawing(&plot)
    };
    let key: Vec<String> = found.order.iter().enumerate().map(|(i, class)| format!("{} {class}", i + 1)).collect();
    String::from("<h2>Errors of range and bearing</h2>")
        + &html::even_gallery([
            plot("Range", "mm", 1e3, |r| r.range_rmse_m),
            plot("Bearing", "°", 180.0 / std::f64::consts::PI, |r| r.bearing_rmse_rad),
        ])
        + &format!("<p><small>{}</small></p>", escaped(&key.join(" · ")))
}

fn maps(found: &Comparison, views: &[PlanView]) -> Result<String> {
    let rows = super::MAPS.iter().filter_map(|name| {
        let r = found.map.get(name)?;
        let percent = |value: Option<Value>| measured(value, 100.0, 1, "not measured");
        Some([
            (*name).to_string(),
            measured(r.iou, 1.0, 2, "not measured"),
            percent(r.precision),
            percent(r.recall),
            percent(r.free_space_error),
            percent(r.free_blocked),
            percent(r.free_found),
        ])
    });
    let mut out = String::from("<h2>Maps</h2>")
        + "<p>Against what was within reach of the robot's way: cells of 5 cm, right within one cell; means over seeds with 95 % \
           intervals. “Free, but not so” is the share of a map's free cells to which the robot cannot roll (surfaces, holes, behind walls), “blocked, but free” the share of free cells where it would not dare to go.</p>"
        + &html::table(
            [
                "map",
                "IoU",
                "precision [%]",
                "recall [%]",
                "free, but not so [%]",
                "blocked, but free [%]",
                "free found [%]",
            ],
            rows,
        );
    let used = [true, found.sensors.laser, found.sensors.ultrasonic, found.sensors == Sensors::BOTH];
    let names = ["Truth: what the robot could have known", "Laser", "Ultrasonic", "Fused"].into_iter().zip(used);
    let names = names.filter(|(_, used)| *used).map(|(name, _)| name);
    let Some(truth) = views.first() else { return Ok(out) };
    let drawn = views.iter().zip(names).map(|(view, name)| plan::map(view, truth, name)).collect::<Result<Vec<_>>>()?;
    out += &html::even_gallery(drawn);
    out += "<p><small>Black: occupied. White: free. Grey: unknown. One seed; x to the right, y up, the same part of the world in \
            each.</small></p>";
    Ok(out)
}

fn needs(found: &Comparison) -> String {
    let rows = found.needs.iter().map(|(sensor, n)| {
        [
            (*sensor).to_string(),
            measured(n.power_w, 1.0, 1, "–"),
            measured(n.kb_per_s, 1.0, 1, "–"),
            measured(n.line_kb_per_s, 1.0, 1, "–"),
            measured(n.per_s, 1.0, 1, "–"),
        ]
    });
    String::from("<h2>What they need</h2>")
        + &html::table(
            ["sensor", "power [W]", "as sent [kB/s]", "as extracted lines [kB/s]", "images or pings [1/s]"],
            rows,
        )
}

fn definitions(found: &Comparison) -> String {
    let t = &found.terms;
    let said = [
        format!("In play: some part of the obstacle is within {} m and {}° of the robot's heading, and not hidden.", t.range_m, t.sector_deg),
        format!("Opportunity: an encounter while the obstacle's nearest visible place was within one bin of half a metre, for {} s at least, and not farther than {} m, the nominal range of both; the plots by distance and the first sightings reach farther.", t.bin_s_min, t.nominal_m),
        format!(
            "Detected: a reading says that there is something within {} m of a visible place of the obstacle, and its light or sound truly came from there. A reading is, for the laser, \
             a point more than {} m over the floor (three of one capture are asked for), for the ring the arc of a cone at the range of the first \
             echo. A drop-off is detected where a line of sight passes the floor's height there; a narrow gap by a reading from behind it.",
            t.tolerance_m, t.clearance_m
        ),
        format!(
            "False obstacle: a report where no obstacle has a surface within the tolerance (of the laser's a cube about each point; of the ring's \
             a shell all across the cone). A report is a run of three or more neighbouring points of the laser's, or a range of the ring's, up to {} m away.",
            t.range_m
        ),
        "Errors of range and bearing: of a sighting against the place where its light or sound truly came from, seen from the sensor. Where the \
         sensors are compared, only encounters in which both saw something count, each as much as any other. The robot's true pose and the \
         finder's true calibration are used: what odometry and calibration add comes on top."
            .into(),
        format!("“Robot fast”: faster than {} m/s.", t.fast_m_s),
        "Intervals: 95 %, over seeds. Rates: Wilson's with as many independent tries as the spread between seeds leaves. All else: percentiles \
         of a bootstrap over seeds."
            .into(),
        "Better: the differences, paired over seeds, are tested by flipping their signs, and the probabilities corrected for the number of \
         comparisons by Holm's method."
            .into(),
        "Not measured: there was no opportunity. It never means 0.".into(),
    ];
    let list = |items: &mut dyn Iterator<Item = String>| {
        format!("<ol>{}</ol>", items.map(|item| format!("<li>{}</li>", escaped(&item))).collect::<String>())
    };
    format!(
        "<h2>What the words mean</h2>{}<h2>What the models leave out</h2>{}<p><small>metromap {}, {}</small></p>",
        list(&mut said.into_iter()),
        list(&mut LIMITS.iter().map(|text| (*text).to_string())),
        escaped(found.version),
        escaped(&found.fingerprint[..found.fingerprint.len().min(12)])
    )
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compare::summary::tests::{scenario, trial};
    use crate::compare::{Trial, sum_up};

    #[test]
    fn it_has_the_verdict_first_needs_no_network_and_zero_is_not_what_was_not_measured() {
        let mut trials: Vec<Trial> = (0..12).map(|seed| trial(seed, [2, 0])).collect();
        for trial in &mut trials {
            trial.classes.insert("never met".into(), Vec::new());
        }
        let found = sum_up(&scenario(), "f", Sensors::BOTH, &trials).unwrap();
        let html = page(&found, None, "<p>one more part</p>").unwrap();
        let order = [
            "The laser detects more often",
            "<h2>Detection</h2>",
            "<h2>Maps</h2>",
            "one more part",
            "What the words mean",
        ];
        let at: Vec<usize> = order.iter().map(|part| html.find(part).unwrap_or_else(|| panic!("{part}"))).collect();
        assert!(at.is_sorted(), "{at:?}");
        assert!(!html.contains("src=\"http") && !html.contains("<script") && !html.contains("@import"));
        let row = |class: &str| html.split("<tr>").find(|row| row.contains(class)).unwrap().to_string();
        assert!(row("1 box").contains("<td>100 (") && row("1 box").contains("<td>0 ("), "{}", row("1 box"));
        assert_eq!(row("2 never met").matches("not measured").count(), 3);
    }
}
