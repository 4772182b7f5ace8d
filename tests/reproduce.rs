//! `metromap reproduce`: the numbers of the paper, as a program reads them.

use std::process::Command;
use std::sync::LazyLock;

use serde_json::Value;

/// All of it, once for all tests.
static ALL: LazyLock<Value> = LazyLock::new(reproduced);

fn reproduced() -> Value {
    let dir = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_metromap"));
    command.current_dir(env!("CARGO_MANIFEST_DIR")).args(["reproduce", "--json", "--out"]).arg(dir.path());
    let output = command.output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let html = std::fs::read_to_string(dir.path().join("reproduce.html")).unwrap();
    assert!(html.contains("data:image/png;base64,") && html.contains("<svg") && html.ends_with("</html>"));
    let file: Value = serde_json::from_slice(&std::fs::read(dir.path().join("reproduce.json")).unwrap()).unwrap();
    let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(file, printed);
    printed
}

/// The first row of this quantity at this place.
fn row<'a>(rows: &'a Value, quantity: &str, at: &[(&str, f64)]) -> &'a Value {
    let here = |row: &&Value| row["quantity"] == quantity && at.iter().all(|(key, value)| row["at"][key] == *value);
    rows.as_array().unwrap().iter().find(here).unwrap_or_else(|| panic!("{quantity} {at:?}"))
}

#[track_caller]
fn is(value: &Value, known: f64, within: f64) {
    let found = value.as_f64().unwrap_or_else(|| panic!("{value}"));
    assert!((found - known).abs() <= within, "{found}, expected {known} ± {within}");
}

#[test]
fn the_paper_is_reproduced() {
    let all = &*ALL;
    assert_eq!(all["agrees"], true);
    let (tables, figures) = (&all["tables"], &all["figures"]);
    is(&row(&tables["1"], "feq1_mm", &[])["ours"], -2.355, 5e-4);
    is(&row(&tables["1"], "feq2_mm", &[])["ours"], -6.693, 5e-4);
    for (lm, theta2, width, right_theta2) in
        [(15.0, 15.14, 2648.45, 31.39), (20.0, 21.68, 3411.47, 36.40), (50.0, 49.20, 7989.60, 56.28)]
    {
        let at = [("lm_mm", lm)];
        is(&row(&tables["2"], "theta1_deg", &at)["printed_form"], 7.18, 0.01);
        is(&row(&tables["2"], "theta2_deg", &at)["printed_form"], theta2, 0.01);
        is(&row(&tables["2"], "theta2_deg", &at)["ours"], right_theta2, 5e-3);
        is(&row(&tables["2"], "width_mm", &at)["printed_form"], width, 0.0101);
    }
    for (quantity, known, within) in [
        ("mirror_height_mm", 817.244, 5e-4),
        ("nearest_slit_mm", 1504.209, 5e-4),
        ("camera_distance_mm", 2197.878, 5e-4),
        ("camera_depression_rad", 0.489647, 5e-7),
        ("x0_mm", -164.585, 5e-4),
    ] {
        is(&row(&tables["4"], quantity, &[])["ours"], known, within);
    }
    for (x, recovered, printed) in
        [(1500.0, 8.99, 9.02), (1800.0, 12.6, 12.67), (2100.0, 16.9, 16.94), (2400.0, 21.7, 21.83)]
    {
        let row = row(&tables["5"], "mm_per_px", &[("x_mm", x)]);
        is(&row["ours"], recovered, 0.05);
        is(&row["printed_form"], printed, 5e-3);
    }
    let pulses: Vec<f64> = figures["11"].as_array().unwrap().iter().map(|row| row["ours"].as_f64().unwrap()).collect();
    assert_eq!(pulses, [46.0, 81.0, 108.0, 130.0]);
    is(&row(&all["points"], "x_mm", &[("uf_px", 400.0)])["ours"], 971.2675, 1e-3);
    assert!(["8", "9", "10", "12", "13"].iter().all(|figure| !figures[figure].as_array().unwrap().is_empty()));
}

#[test]
fn the_truth_lies_where_the_error_bars_say() {
    let tables = &ALL["tables"];
    let mut counted = 0;
    for row in ["3", "4"].iter().flat_map(|table| tables[table].as_array().unwrap()) {
        let simulated = &row["simulated"];
        let way = row["at"]["way"].as_str().unwrap_or("camera");
        if simulated.is_object() && !way.starts_with("closed form") {
            let inside = simulated["inside_95"].as_f64().unwrap();
            // A true 95 % interval leaves 92 to 98 % once in twenty at 200 repeats, once in five hundred at 500.
            assert!(simulated["repeats"].as_u64().unwrap() >= 200);
            assert!((0.92..=0.98).contains(&inside), "{way}, {}: {inside}", row["quantity"]);
            counted += 1;
        }
        if row["quantity"] == "mirror_height_mm" && way.starts_with("bundle, 21 slits") {
            let most = if way.contains("zero known") { 1.0 } else { 4.0 };
            is(&simulated["rms_error"], 0.0, most);
        }
    }
    assert!(counted > 20, "{counted}");
}
