//! `metromap design`: a finder on paper, against numbers from outside and against the renderer.

use std::fs;
use std::process::{Command, Output};

use metromap::design::{DesignParams, Instrument, design, limits_w, safety};
use metromap::geometry::{Robot, Transform, World};
use metromap::optics::{Axis, Laser, Rig, Sheet};
use metromap::scanner::Renderer;
use metromap::world::{Body, Material, Motion, Scene, Shape, Surfaces};
use serde_json::Value;

fn run(args: &[&str]) -> (tempfile::TempDir, Output) {
    let dir = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_metromap"));
    command.current_dir(env!("CARGO_MANIFEST_DIR")).arg("design").args(args).arg("--out").arg(dir.path());
    let output = command.output().unwrap();
    (dir, output)
}

fn designed(args: &[&str]) -> (tempfile::TempDir, Value) {
    let (dir, output) = run(&[args, &["--json"]].concat());
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    (dir, serde_json::from_slice(&output.stdout).unwrap())
}

#[track_caller]
fn is(value: &Value, known: f64, within: f64) {
    let found = value.as_f64().unwrap_or_else(|| panic!("{value}"));
    assert!((found - known).abs() <= within, "{found}, expected {known} ± {within}");
}

fn row(rows: &Value, x: f64) -> &Value {
    let here = |row: &&Value| (row["range_m"].as_f64().unwrap() - x).abs() < 1e-6;
    rows.as_array().unwrap().iter().find(here).unwrap_or_else(|| panic!("no row at {x} m"))
}

#[test]
fn the_papers_finder_sees_what_it_must() {
    let (dir, all) = designed(&[]);
    let view = &all["view"];
    is(&view["floor_m"][0], 1.41, 0.005);
    is(&view["floor_m"][1], 3.82, 0.01);
    is(&view["ceiling_slope"], 0.283, 5e-4);
    is(&view["table_seen_to_m"], 1.16, 0.005);
    is(&view["horizontal_pinhole_deg"], 28.7, 0.05);
    is(&view["vertical_pinhole_deg"], 23.5, 0.05);
    is(&all["optics"]["theta2_deg"], 31.39, 0.005);
    is(&all["optics"]["printed_theta2_deg"], 15.14, 0.01);
    // Through the distorted lens a pixel costs up to 6 % more than by the formulas of instrument.md 3.
    for (x, pulse, px) in [(2.0, 24.0, 14.0), (3.0, 55.0, 30.0), (3.7, 86.0, 45.0)] {
        is(&row(&all["floor"], x)["mm_per_pulse"], pulse, 0.5);
        is(&row(&all["floor"], x)["mm_per_px"], px, 0.06 * px);
        assert_eq!(row(&all["floor"], x)["dominant"], "mirror_stop");
    }
    assert_eq!(all["safety"]["line"]["class"], "2");
    assert_eq!(all["safety"]["bare_beam"]["class"], "3B");
    let html = fs::read_to_string(dir.path().join("design.html")).unwrap();
    assert!(html.starts_with("<!doctype html>") && html.ends_with("</html>") && !html.contains("NaN"));
    assert!(!html.replace("http://www.w3.org/2000/svg", "").contains("http"), "the page must stand alone");
    assert!(!html.contains("<script"));
    for tag in ["section", "table", "svg", "figure", "tr", "td", "div", "p", "ul", "li", "g", "clipPath", "dl"] {
        let open = format!("<{tag}");
        let opened = html.match_indices(&open).filter(|(i, _)| html[i + open.len()..].starts_with([' ', '>'])).count();
        assert_eq!(opened, html.matches(&format!("</{tag}>")).count(), "{tag}");
    }
    let file: Value = serde_json::from_slice(&fs::read(dir.path().join("design.json")).unwrap()).unwrap();
    assert_eq!(file, all);
}

#[test]
fn flags_do_what_they_say() {
    let stop = ["--f-number", "4", "--power-mw", "14", "--exposure-ms", "33.333333333"];
    let (_dir, other) = designed(&stop);
    let (_dir, plain) = designed(&[]);
    // A quarter of the light through the lens, twice the power, twice the time: the same electrons, twice the speckle.
    let (a, b) = (row(&plain["floor"], 2.0), row(&other["floor"], 2.0));
    is(&b["electrons"], a["electrons"].as_f64().unwrap(), 2.0);
    is(&b["speckle_px"], 2.0 * a["speckle_px"].as_f64().unwrap(), 1e-9);
    let (_dir, wide) = designed(&["--gap", "30", "--range", "1.5:2.5", "--pitch-mrad", "1"]);
    is(&wide["optics"]["theta2_deg"], 44.74, 0.005); // Table 2, corrected
    is(&wide["floor"][0]["range_m"], 1.5, 1e-9);
    let at = row(&wide["floor"], 2.0);
    is(&at["range"]["calibration_mm"], at["mm_per_mrad_pitch"].as_f64().unwrap(), 1e-6);
    let (_dir, near) = designed(&["--focal-mm", "22.868"]);
    is(&near["view"]["widths"][3]["width_pinhole_m"], 0.511, 5e-4); // twice the focal length, half the picture
    let (_dir, infrared) = designed(&["--wavelength-nm", "850"]);
    assert!(infrared["safety"]["limits_mw"].is_null() && infrared["safety"]["line"].is_null());
}

#[test]
fn a_scenario_is_a_finder_too() {
    let (_dir, all) = designed(&["worlds/lab.toml", "--volume", "1.5:3,-0.5:0.5,0:0.2", "--resolution-mm", "100"]);
    is(&all["view"]["floor_m"][0], 1.41, 0.005);
    let volume = &all["volume"];
    assert!(volume["seen_turned"].as_f64().unwrap() > 0.99, "{volume}");
    let lines = volume["lines"].as_array().unwrap();
    is(&volume["floor_gap_m"], 0.1, 0.02);
    assert!(volume["floor_gap_m"].as_f64().unwrap() <= 0.1 && volume["wall_gap_m"].as_f64().unwrap() <= 0.1);
    // 1.5 m of floor at 0.1 m, and a few flatter beams.
    assert!((15..=22).contains(&lines.len()), "{}", lines.len());
    assert!(volume["sweep_s"].as_f64().unwrap() > 0.1 * lines.len() as f64);
}

#[test]
fn a_rig_with_a_sheet_that_stands_still_is_a_finder_too() {
    let (_dir, all) = designed(&["tests/rigs/robot_floor.toml", "--pixel-um", "5"]);
    // The slit meets the floor 0.51 m ahead, says the file; the camera is 0.2235 m high.
    is(&all["view"]["floor_m"][0], 0.51, 0.01);
    is(&all["view"]["ceiling_m"], 0.2235, 1e-9);
    assert!(all["floor"].as_array().unwrap().is_empty() && !all["upright"].as_array().unwrap().is_empty());
    assert!(all["volume"]["lines"].as_array().unwrap().is_empty() && all["volume"]["sweep_s"].is_null());
    // 5 um a row, fy 685.9: a lens of 3.43 mm.
    is(&all["given"]["focal_mm"], 3.4296, 1e-3);
}

#[test]
fn what_makes_no_finder_is_refused() {
    for (args, what) in [
        (&["--focal-mm", "-12"] as &[&str], "--focal-mm: found -12"),
        (&["--f-number", "nan"], "--f-number: found NaN"),
        (&["--power-mw", "0"], "--power-mw: found 0"),
        (&["--source-mw", "1"], "--source-mw: found 1 mW, less than the 7 mW"),
        (&["--beam-deg", "-3"], "--beam-deg: found -3, expected an angle below the horizon"),
        (&["--beam-deg", "60"], "beam: found 60.00°, expected an angle within the mirror's travel"),
        (&["--gap", "-5"], "optics.between_mm: found -5"),
        (&["--lens", "-6.35,-6.35,12.7,-19"], "optics.set2.first_mm: found 12.7"),
        (&["--range", "8:12"], "camera: found a view that never meets the sheet between 8 and 12 m"),
        (&["--range", "3:2"], "range: found 3 to 2"),
        (&["--volume", "1:2,0:0,0:1"], "volume y: found 0 to 0"),
        (&["--albedo", "1.5"], "--albedo: found 1.5"),
        (&["nowhere.toml"], "nowhere.toml: file:"),
        (&["Cargo.toml"], "Cargo.toml:"),
    ] {
        let (dir, output) = run(args);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{args:?}: {said}");
        assert!(said.contains(what), "{args:?}: {said}");
        assert!(fs::read_dir(dir.path()).unwrap().next().is_none(), "{args:?} wrote something");
    }
    for args in [&["--range", "2"] as &[&str], &["--lens", "-1,-2"], &["--volume", "1:2,3:4"]] {
        assert_eq!(run(args).1.status.code(), Some(2), "{args:?}");
    }
}

#[test]
fn the_light_is_that_of_the_renderer() {
    let floor = Body {
        name: "floor".into(),
        shape: Shape::Plane,
        pose: nalgebra::Isometry3::identity(),
        material: Material { albedo: 0.5, ..Material::default() },
        motion: Motion::Static,
        ground: true,
    };
    let scene = Scene { bodies: vec![floor], ..Scene::default() };
    // Without lenses the sheet stays the rig's: both look at the same light.
    let instrument = Instrument { optics: None, ..Instrument::metro_i() };
    // Without speckle, and with the three cosines only that a sheet has anyhow: `design` leaves the lens' own out.
    let image = metromap::scanner::ImageParams { speckle_contrast: 0.0, vignetting: 3.0, ..instrument.image };
    let renderer = Renderer::new(&instrument.rig, image, &scene).unwrap();
    let surfaces = Surfaces::new(&scene).unwrap();
    let all = design(instrument, DesignParams::default()).unwrap();
    for x in [1.5, 2.0, 3.0, 3.7] {
        let row = all.floor.iter().find(|row| (row.range_m - x).abs() < 1e-9).unwrap();
        let here = Transform::<World, Robot>::identity();
        let shot = renderer.expose(&surfaces, &here, 0.0, row.beam_deg.to_radians(), 1, 0).unwrap();
        let sight = shot.truth.iter().find(|s| s.column == 256).unwrap();
        assert!((row.row_px - sight.v).abs() < 1e-6, "row {} for {}", row.row_px, sight.v);
        let light = row.electrons / f64::from(sight.electrons);
        assert!((light - 1.0).abs() < 1e-3, "{light} of the light at {x} m");
    }
}

#[test]
fn the_chosen_lines_leave_no_gap_and_none_can_be_spared() {
    let params = DesignParams { resolution_m: 0.08, ..DesignParams::default() };
    let all = design(Instrument::metro_i(), params).unwrap();
    let floor: Vec<f64> = all.volume.lines.iter().filter_map(|line| line.floor_m).collect();
    assert!(floor.first().unwrap() - 1.5 <= 0.08 && 3.0 - floor.last().unwrap() <= 0.08, "{floor:?}");
    assert!(floor.windows(2).all(|w| w[1] - w[0] <= 0.08 + 1e-9 && w[1] > w[0]));
    // No line can be left out: its neighbours are too far apart.
    assert!(floor.windows(3).all(|w| w[2] - w[0] > 0.08));
    // Every flatter line is seen somewhere in the volume, under the top of the picture.
    for line in all.volume.lines.iter().filter(|line| line.floor_m.is_none()) {
        let seen = (0..=1500).map(|i| 1.5 + f64::from(i) * 1e-3).any(|x| {
            let ceiling = all.view.ceiling_m - all.view.ceiling_slope * (x - all.view.camera_m[0]);
            all.view.laser_m[1] - x * line.beam_deg.to_radians().tan() <= ceiling.min(0.5) + 1e-6
        });
        assert!(seen, "{line:?}");
    }
}

#[test]
fn a_mirror_too_coarse_says_so_and_a_fixed_sheet_has_no_lines() {
    let mut coarse = Instrument::metro_i();
    if let Laser::Mirror(mirror) = &mut coarse.rig.laser {
        mirror.beam = Axis { rad_per_pulse: 0.02, pulse_min: -5, pulse_max: 20, ..mirror.beam };
    }
    let all = design(coarse, DesignParams::default()).unwrap();
    assert!(all.volume.limited_by_pulse && all.volume.floor_gap_m > 0.05);

    let mut fixed = Instrument::metro_i();
    let sheet = fixed.rig.laser_plane(0).unwrap();
    let seen = fixed.rig.sensor_from_camera.inverse() * sheet;
    let (n, d) = (seen.plane.normal, seen.plane.offset);
    let origin = seen.origin.xyz;
    fixed.rig.laser = Laser::Plane(metromap::optics::PlaneLaser {
        normal: [n.x, n.y, n.z],
        offset_m: d,
        origin_m: Some([origin.x, origin.y, origin.z]),
    });
    let all = design(fixed, DesignParams::default()).unwrap();
    assert!(all.floor.is_empty() && all.volume.lines.is_empty() && all.volume.sweep_s.is_none());
    // The same sheet as METRO-I's at P: the same upright targets, and its line on the floor at P.
    let metro = design(Instrument::metro_i(), DesignParams::default()).unwrap();
    assert_eq!(all.upright.len(), metro.upright.len());
    assert!((all.upright[10].mm_per_px / metro.upright[10].mm_per_px - 1.0).abs() < 1e-9);
    assert!((all.view.floor_m.unwrap()[0] - 2.704_210).abs() < 1e-6);
    assert!(!metromap::design::page(&all).contains("NaN"));
}

#[test]
fn class_limits_are_those_of_the_exposure_limits() {
    // Directive 2006/25/EC, Annex II: what a pupil of 7 mm takes in, within the rounding of the standard.
    let pupil_m2 = std::f64::consts::PI * 3.5e-3f64.powi(2);
    let [one, two, three_r, three_b] = limits_w(632.8e-9).unwrap();
    assert!((one / (10.0 * pupil_m2) - 1.0).abs() < 0.02);
    assert!((two / (18.0 * 0.25f64.powf(-0.25) * pupil_m2) - 1.0).abs() < 0.03);
    assert_eq!((three_r, three_b), (5e-3, 0.5));
    // Blue light is the stricter below 500 nm: C_B = 1 at 450 nm, 10 at 500 nm.
    assert!((limits_w(445e-9).unwrap()[0] / pupil_m2 - 1.0).abs() < 0.02);
    assert!((limits_w(475e-9).unwrap()[0] / (3.162 * pupil_m2) - 1.0).abs() < 0.02);
    assert_eq!(limits_w(520e-9).unwrap()[0], 0.39e-3);
    assert!(limits_w(399e-9).is_none() && limits_w(780e-9).is_none());
}

#[test]
fn the_line_through_the_pupil_is_its_share_of_the_fan() {
    // 100 mm from the vertex METRO-I's fan is 122 mm wide: P·√(2/π)/(D/2) times the mean chord π/4·7 mm, thickness aside.
    let sheet = Sheet { waist_m: 1e-2, ..Rig::metro_i().sheet };
    let wide = safety(&sheet, 10e-3).line.unwrap();
    let thin = safety(&Rig::metro_i().sheet, 10e-3);
    let per_m = 7e-3 * (2.0 / std::f64::consts::PI).sqrt() / (0.122_05 / 2.0);
    // A thin sheet passes whole: the full 7 mm.
    let line = thin.line.unwrap();
    assert!((line.through_7_mm_mw / (per_m * 7.0) - 1.0).abs() < 0.01, "{line:?}");
    assert!(wide.through_7_mm_mw < 0.6 * line.through_7_mm_mw);
    // The bare beam of 0.8 mm passes whole too.
    let beam = thin.bare_beam.unwrap();
    assert!((beam.through_7_mm_mw - 10.0).abs() < 1e-3 && beam.class == "3B");
    let classes = [0.3e-3, 0.9e-3, 4e-3, 0.4, 0.6].map(|w| safety(&sheet, w).bare_beam.unwrap().power_mw);
    assert_eq!(classes, [0.3, 0.9, 4.0, 400.0, 600.0]);
    let class = |w: f64| safety(&Rig::metro_i().sheet, w).bare_beam.unwrap().class;
    assert_eq!([0.3e-3, 0.9e-3, 4e-3, 0.4, 0.6].map(class), ["1", "2", "3R", "3B", "4"]);
    // A narrow pupil's worth far from a wide beam: harmless to the eye, not through binoculars.
    let broad = Sheet { waist_m: 8e-3, ..Rig::metro_i().sheet };
    assert_eq!(safety(&broad, 3e-3).bare_beam.unwrap().class, "2M");
}
