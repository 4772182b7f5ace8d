//! The design as one HTML page: the verdict first, then drawings, plots and tables.

use std::fmt::Write;

use super::budget::Row;
use super::view::SHADOW_OF_M;
use super::words::{Kind, mm, name_of, short};
use super::{Design, Emission, pictures};
use crate::report::html::{captioned, drawing, even_gallery, gallery, page as whole, table, tiles};
use crate::report::{Drawing, escaped};

/// The whole page.
pub fn page(all: &Design) -> String {
    let mut html = format!("<h1>What {} will see</h1>", escaped(&all.name));
    html += &format!("<p>{}</p>", escaped(&given(all)));
    html += &tiles(figures(all));
    html += "<section id=\"verdict\"><h2>In short</h2><ul class=\"verdict\">";
    for finding in &all.findings {
        let mark = match finding.kind {
            Kind::Good => "good",
            Kind::Note => "note",
            Kind::Warning => "bad",
        };
        // Writing to a string cannot fail.
        let _ = write!(
            html,
            "<li><b class=\"{mark}\">{}</b> {}</li>",
            escaped(&capital(finding.topic)),
            escaped(&finding.text)
        );
    }
    html += "</ul></section>";
    for (id, title, body) in [
        ("view", "Field of view and blind zone", view(all)),
        ("error", "Error budget", errors(all)),
        ("light", "Light", light(all)),
        ("laser", "Laser power and class: a hint", laser(all)),
        ("volume", "The wanted volume", volume(all)),
        ("assumed", "What this stands on", assumed(all)),
    ] {
        let _ = write!(html, "<section id=\"{id}\"><h2>{title}</h2>{body}</section>");
    }
    whole(&format!("Design of {}", all.name), &html)
}

/// The numbers that say most.
fn figures(all: &Design) -> Vec<(String, String)> {
    let v = &all.view;
    let mut list = vec![(
        "field of view".to_string(),
        format!("{:.1}° x {:.1}°", v.horizontal_pinhole_deg, v.vertical_pinhole_deg),
    )];
    let mut add = |name: &str, value: String| list.push((name.to_string(), value));
    match v.floor_m {
        Some([near, far]) if far > near => add("floor seen", format!("{near:.2}–{far:.2} m")),
        Some([near, _]) => add("floor seen", format!("at {near:.2} m")),
        None => add("floor seen", "none".into()),
    }
    if let Some([edge, near]) = v.blind_m {
        add("blind on the floor", format!("{edge:.2}–{near:.2} m"));
    }
    let rows = if all.floor.is_empty() { &all.upright } else { &all.floor };
    if let (Some(a), Some(b)) = (rows.first(), rows.last()) {
        let place = if all.floor.is_empty() { "upright targets" } else { "the floor" };
        let value = format!("{}–{} mm", mm(a.range.instrument_mm), mm(b.range.instrument_mm));
        add(&format!("error of range on {place}, 1 σ"), value);
        add("dominated by", name_of(b.dominant).to_string());
    }
    if let (Some(line), Some(beam)) = (&all.safety.line, &all.safety.bare_beam) {
        add("hint at laser class", format!("{} (bare: {})", line.class, beam.class));
    } else {
        add("hint at laser class", "none".into());
    }
    add("of the wanted volume seen", format!("{:.0} %", all.volume.seen_turned * 100.0));
    if let Some(seconds) = all.volume.sweep_s {
        let lines = all.volume.lines.len() * all.volume.views;
        add("a sweep of it", format!("{lines} lines, {} s", short(seconds, if seconds < 10.0 { 1 } else { 0 })));
    }
    list
}

fn capital(word: &str) -> String {
    let mut letters = word.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().collect::<String>() + letters.as_str() + ".")
}

fn given(all: &Design) -> String {
    let g = &all.given;
    format!(
        "A laser-slit range finder on paper: camera of {} x {} pixels, {} mm at f/{}, {} ms; line of {} mW at {} nm from {}, camera at \
         height {:.3} m. All in the robot's frame, floor at Z = 0, the cylinder straight ahead.",
        g.image_px[0],
        g.image_px[1],
        short(g.focal_mm, 2),
        short(g.f_number, 2),
        short(g.exposure_ms, 1),
        short(g.power_mw, 2),
        short(g.wavelength_nm, 1),
        format_args!("height {:.3} m", all.view.laser_m[1]),
        all.view.camera_m[1],
    )
}

fn figure(drawing: &Drawing, caption: &str) -> String {
    captioned(&drawing.svg(), caption)
}

fn paragraph(text: &str) -> String {
    format!("<p>{}</p>", escaped(text))
}

fn view(all: &Design) -> String {
    let v = &all.view;
    let still = v.beam_deg[0] == v.beam_deg[1];
    let side = figure(
        &pictures::side(all),
        if still {
            "To scale. The camera (blue square) sees the blue wedge; the sheet (orange) stands still."
        } else {
            "To scale. The camera (blue square) looks down; the beam (orange) tilts up and down from the mirror. Only what lies in the \
             blue wedge is ever seen."
        },
    );
    let above = pictures::footprint(all).map(|drawing| {
        figure(&drawing, "To scale. The picture widens with range; the cylinder turns it all the way round.")
    });
    let mut html = gallery([side].into_iter().chain(above));
    html += &paragraph(&format!(
        "Angles: {:.1}° x {:.1}° (horizontal x vertical; through the lens with its distortion {:.1}° x {:.1}°). Lines of sight in the \
         middle column fall {:.1}° to {:.1}° below the horizontal; {}. Nothing is seen above \
         Z = {:.3} − {:.3}·(X − {:.3}) m.",
        v.horizontal_pinhole_deg,
        v.vertical_pinhole_deg,
        v.horizontal_deg,
        v.vertical_deg,
        v.depression_deg[0],
        v.depression_deg[1],
        if still {
            format!("the sheet falls {:.1}°", v.beam_deg[0])
        } else {
            format!("the mirror can tilt the beam from {:.1}° to {:.1}°", v.beam_deg[0], v.beam_deg[1])
        },
        v.ceiling_m,
        v.ceiling_slope,
        v.camera_m[0]
    ).replace("− -", "+ ").replace("-", "−"));
    let mut shadows: Vec<String> =
        v.shadow_m.iter().map(|[x, length]| format!("{} m at {x:.2} m", short(*length, 2))).collect();
    shadows.dedup();
    if !shadows.is_empty() {
        html += &paragraph(&format!(
            "Behind every obstacle there is a shadow of the laser. A thing {SHADOW_OF_M} m high hides this much floor behind it: {}.",
            shadows.join(", ")
        ));
    }
    let rows = v.widths.iter().map(|w| {
        [
            format!("{} m", short(w.distance_m, 3)),
            format!("{:.3}", w.width_pinhole_m),
            format!("{:.3}", w.width_m),
            format!("{:.2} x {:.2}", w.mm_per_column, w.mm_per_row),
            format!("{:.3}", w.sheet_width_m),
            format!("{:.2}", w.sheet_thickness_mm),
            format!("{:.0} %", w.power_share * 100.0),
        ]
    });
    html + &table(
        [
            "distance along the view",
            "picture's width [m]",
            "with distortion [m]",
            "a pixel [mm]",
            "sheet's width, 1/e² [m]",
            "half thickness, 1/e² [mm]",
            "light in the picture",
        ],
        rows,
    )
}

fn budget_table(rows: &[Row]) -> String {
    // Every quarter of a metre, or a dozen rows where that would be too few.
    let round = |row: &&Row| (row.range_m * 4.0 - (row.range_m * 4.0).round()).abs() < 1e-6;
    let ends = rows.first().into_iter().chain(rows.last());
    let mut chosen: Vec<&Row> = rows.iter().filter(round).chain(ends).collect();
    if chosen.len() < 6 {
        chosen = rows.iter().step_by(rows.len().div_ceil(12).max(1)).chain(rows.last()).collect();
    }
    chosen.sort_by(|a, b| a.range_m.total_cmp(&b.range_m));
    chosen.dedup_by(|a, b| (a.range_m - b.range_m).abs() < 0.005);
    let cells = chosen.into_iter().map(|row| {
        let r = &row.range;
        [
            format!("{:.2} m", row.range_m),
            row.pulse.map_or("–".into(), |p| format!("{p:.1}").replace('-', "−")),
            mm(row.mm_per_px),
            if row.pulse.is_some() { mm(row.mm_per_pulse) } else { "–".into() },
            mm(row.mm_per_mrad_pitch),
            mm(row.mm_per_column),
            if row.saturated { "full".into() } else { format!("{:.1}", row.peak_level) },
            mm(r.pixel_noise_mm),
            mm(r.speckle_mm),
            if row.pulse.is_some() { mm(r.mirror_stop_mm.hypot(r.encoder_mm)) } else { "–".into() },
            if r.calibration_mm > 0.0 { mm(r.calibration_mm) } else { "–".into() },
            mm(r.instrument_mm),
            format!("{} {:.0} %", name_of(row.dominant), row.dominant_share * 100.0),
            mm(row.height.instrument_mm),
            mm(r.total_mm),
        ]
    });
    table(
        [
            "X",
            "encoder",
            "a pixel",
            "a pulse",
            "a mrad",
            "a column",
            "peak",
            "noise",
            "speckle",
            "mirror",
            "calibr.",
            "σX",
            "dominates",
            "σZ",
            "σX, map",
        ],
        cells,
    )
}

fn errors(all: &Design) -> String {
    let mut html = String::new();
    let params = &all.params;
    if !all.floor.is_empty() {
        html += "<h3>On the floor</h3>";
        html += &paragraph(
            "For each X the mirror points the beam there. Errors are one standard deviation of a single point; those that come \
                            from the pixel lie along the sheet, those from the mirror along the line of sight.",
        );
        html += &even_gallery([
            drawing(&pictures::errors(
                "Error of X on the floor, by source",
                &all.floor,
                |row| &row.range,
                "error of X",
            )),
            drawing(&pictures::shares("What the error of X on the floor is made of", &all.floor)),
            drawing(&pictures::errors(
                "Error of Z on the floor, by source",
                &all.floor,
                |row| &row.height,
                "error of Z",
            )),
            drawing(&pictures::errors(
                "Error of Y on the floor, by source",
                &all.floor,
                |row| &row.lateral,
                "error of Y",
            )),
            drawing(&pictures::sensitivity("What each costs on the floor", &all.floor)),
            drawing(&pictures::sampling(&all.floor)),
        ]);
        html += &budget_table(&all.floor);
    }
    if !all.upright.is_empty() {
        html += &format!("<h3>On upright targets, beam {:.2}° down</h3>", all.upright_beam_deg);
        html += &paragraph(
            "A wall across the heading, cut by one beam that stays where it is: as in the paper's Table 5, where X counts from the \
                            camera's foot.",
        );
        html += &even_gallery([
            drawing(&pictures::errors(
                "Error of X on upright targets, by source",
                &all.upright,
                |row| &row.range,
                "error of X",
            )),
            drawing(&pictures::sensitivity("What each costs on upright targets", &all.upright)),
        ]);
        html += &budget_table(&all.upright);
    }
    html + &paragraph(&format!(
        "All in mm but encoder [pulses], peak [levels over the background]. What one pixel, one pulse of the mirror and one mrad of camera \
         pitch cost in X; a column's width sideways; then the terms of the error of X, σX and σZ of the instrument alone, and σX in the \
         map. Noise: shot, read and quantisation noise, the Cramér–Rao bound of the stripe's row (a good extraction needs 1.1 to 1.8 times \
         that); speckle: λN/π on the sensor; mirror: where its servo stops ({} mrad) and its encoder; calibration: {}; in the map: with \
         ± {} mm and {} mrad of the robot's pose and {} ms of timing at {} m/s besides.",
        short(all.given.mirror_stop_mrad, 3),
        if params.pitch_sigma_rad == 0.0 && params.beam_zero_sigma_rad == 0.0 {
            "taken as perfect, but see what a mrad of pitch costs".to_string()
        } else {
            format!(
                "{} mrad of pitch, {} mrad of beam zero",
                short(params.pitch_sigma_rad * 1e3, 3),
                short(params.beam_zero_sigma_rad * 1e3, 3)
            )
        },
        short(params.position_sigma_m * 1e3, 1),
        short(params.heading_sigma_rad * 1e3, 1),
        short(params.timing_sigma_s * 1e3, 1),
        short(params.speed_m_s, 2)
    ))
}

fn light(all: &Design) -> String {
    let mut plots = Vec::new();
    if !all.floor.is_empty() {
        plots.push(drawing(&pictures::floor_levels(all)));
    }
    plots.push(drawing(&pictures::facing_levels(all)));
    plots.push(drawing(&pictures::line_power(all)));
    plots.push(drawing(&pictures::stripe(all)));
    let mut html = even_gallery(plots);
    let metres = |m: Option<f64>| m.map_or("nowhere".into(), |m| format!("{m:.2}"));
    let rows = all.light.reach.iter().map(|r| {
        [
            format!("{} ({:.0} %), {}", r.target, r.albedo * 100.0, r.ambient),
            short(r.exposure_ms, 2),
            r.saturated_to_m.map_or("–".into(), |m| format!("{m:.2}")),
            metres(r.found_to_m),
            metres(r.floor_found_to_m),
        ]
    });
    html += &table(
        [
            "target and light",
            "exposure [ms]",
            "full nearer than [m]",
            "found to, facing [m]",
            "found to, on the floor [m]",
        ],
        rows,
    );
    html += &paragraph(&format!(
        "Found: the peak is 4 times the noise of a pixel and at least 0.75 level. Without the laser a pixel is at level {} indoors and would be at \
         {} in direct sun, of {:.0}; where the background would fill more than half of the sensor, the exposure is cut until it does not. A \
         greater reach than the field of view is of no use: on the floor the camera's edge may come first.",
        short(all.light.background_level, 2),
        short(all.light.background_level_sun, 0),
        all.light.white_level
    ));
    if let Some(o) = &all.optics {
        html += "<h3>Slit optics</h3>";
        html += &table(
            ["", "correct", "as the paper prints it"],
            [
                ["half angle θ2 [°]".into(), format!("{:.2}", o.theta2_deg), format!("{:.2}", o.printed_theta2_deg)],
                [
                    "width at 3 m [m]".into(),
                    format!("{:.3}", o.width_at_3_m_m),
                    format!("{:.3}", o.printed_width_at_3_m_m),
                ],
            ],
        );
        html += &paragraph(&format!(
            "Two pairs of cylindrical lenses, {} and {} mm, then {} and {} mm (pairs of {:.3} and {:.3} mm), {} mm apart, behind a beam of {} mm. \
             The paper's Table 2 has θ2 with a sign that a diverging lens does not have; all else here uses the correct form. Both are \
             paraxial: beyond some 45° a real cylinder lens bends its edge rays otherwise.",
            short(o.lens_mm[0], 2),
            short(o.lens_mm[1], 2),
            short(o.lens_mm[2], 2),
            short(o.lens_mm[3], 2),
            o.pair_mm[0],
            o.pair_mm[1],
            short(o.gap_mm, 2),
            short(o.laser_mm, 2)
        ).replace("-", "−"));
    }
    html
}

fn laser(all: &Design) -> String {
    let s = &all.safety;
    let mut html = String::new();
    if let (Some(line), Some(beam), Some(limits)) = (&s.line, &s.bare_beam, s.limits_mw) {
        let row = |name: &str, e: &Emission| {
            [
                name.to_string(),
                short(e.power_mw, 2),
                short(e.through_7_mm_mw, 3),
                short(e.through_50_mm_mw, 3),
                e.class.to_string(),
                short(e.power_for_class_2_mw, 2),
            ]
        };
        html += &table(
            [
                "",
                "power [mW]",
                "through 7 mm at 100 mm [mW]",
                "through 50 mm at 2 m [mW]",
                "hint at class",
                "class 2 up to [mW]",
            ],
            [row("the line, mirror at rest", line), row("the bare beam", beam)],
        );
        html += &paragraph(&format!(
            "Limits at {} nm: class 1 to {} mW, class 2 to {} mW, class 3R to {} mW, class 3B to {} mW, for a continuous point source through the \
             eye's 7 mm, 100 mm from where the fan begins (IEC 60825-1:2014, condition 3); an M is added if binoculars (50 mm at 2 m) would gather \
             more than the class allows.",
            short(s.wavelength_nm, 1),
            short(limits[0], 3),
            short(limits[1], 2),
            short(limits[2], 2),
            short(limits[3], 0)
        ));
    } else {
        html += &paragraph(&format!(
            "{} nm: no hint. Only continuous visible light, 400 to 700 nm, is covered.",
            short(s.wavelength_nm, 1)
        ));
    }
    html += "<p>What this hint leaves out:</p><ul class=\"verdict\">";
    for text in &s.leaves_out {
        let _ = write!(html, "<li>{}</li>", escaped(text));
    }
    html + "</ul>"
}

fn volume(all: &Design) -> String {
    let w = &all.volume;
    let mut html = String::new();
    if let Some(beams) = pictures::beams(all) {
        html += &gallery([figure(
            &beams,
            "To scale. The fewest lines that leave no gap wider than asked, on the floor and up a wall.",
        )]);
        let pulses: Vec<String> = w.lines.iter().map(|line| line.pulse.to_string().replace('-', "−")).collect();
        html += &paragraph(&format!(
            "Mirror pulses: {}. Asked for: no gap over {} mm; widest on the floor {} mm, up a wall {} mm.",
            pulses.join(", "),
            mm(w.resolution_m * 1e3),
            mm(w.floor_gap_m * 1e3),
            mm(w.wall_gap_m * 1e3)
        ));
        let views: Vec<String> = w.view_deg.iter().map(|deg| short(*deg, 1)).collect();
        html += &paragraph(&format!("Cylinder at {}°.", views.join("°, ")));
    } else {
        html += &paragraph(
            "No line of this finder samples the volume: nothing of it is seen, or the sheet stands still and the robot must move it.",
        );
    }
    html += "<h3>What a change of the rig would do</h3>";
    let rows = all.changes.iter().map(|change| {
        [
            change.what.to_string(),
            change.seen.map_or("no finder".into(), |s| format!("{:.0} %", s * 100.0)),
            change.floor_m.map_or("–".into(), |[near, far]| format!("{near:.2} to {far:.2}")),
            change.range_mm.map_or("–".into(), mm),
        ]
    });
    let middle = (w.volume.x_m[0] + w.volume.x_m[1]) / 2.0;
    html += &table(["", "of the volume seen", "floor seen [m]", "instrument σX on its floor [mm]"], rows);
    html + &paragraph(&format!(
        "One change at a time, everything else as it is; the error is that on the floor at {} m.",
        short(middle, 2)
    ))
}

fn assumed(all: &Design) -> String {
    let mut html = String::from("<ul class=\"verdict\">");
    for text in &all.assumed {
        let _ = write!(html, "<li>{}</li>", escaped(text));
    }
    html + "</ul>"
        + &paragraph(
            "Left out: shadows of the robot's own body, blooming, second bounces, vignetting, steps of the floor itself, and what \
             the errors of a calibration do together.",
        )
}
