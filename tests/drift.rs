//! The drift alarm as a user meets it: a run with a bumped finder says so, a run with a good one does not.

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

/// Runs a command that must end well: its JSON, and what it told people meanwhile.
fn metromap(args: &[&str], out: &Path) -> (Value, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_metromap"));
    let output = command
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(args)
        .arg("--json")
        .arg("--out")
        .arg(out)
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{told}");
    (serde_json::from_slice(&output.stdout).unwrap(), told)
}

#[test]
fn a_good_calibration_fits_and_the_watch_changes_no_map() {
    let dir = TempDir::new().unwrap();
    let short = |seed: &'static str| ["run", "worlds/lab.toml", "--duration-s", "20", "--seed", seed];
    for seed in ["1", "2", "3"] {
        let (run, told) = metromap(&short(seed), &dir.path().join(seed));
        let drift = &run["drift"];
        assert_eq!(drift["state"], "fits", "{drift}");
        assert!(drift["misfit_m"].as_f64().unwrap() < 0.002 && drift.get("moved").is_none(), "{drift}");
        assert!(drift.get("first_alarm_capture").is_none() && !told.contains("does not fit"), "{told}");
    }
    // The same world, not watched.
    let lab = Path::new(env!("CARGO_MANIFEST_DIR")).join("worlds/lab.toml");
    let blind = dir.path().join("blind.toml");
    fs::write(&blind, fs::read_to_string(lab).unwrap() + "\n[drift]\nflat_floor = false\n").unwrap();
    let (unwatched, _) =
        metromap(&["run", blind.to_str().unwrap(), "--duration-s", "20", "--seed", "1"], &dir.path().join("blind"));
    assert!(unwatched.get("drift").is_none());
    let summary: Value = serde_json::from_slice(&fs::read(dir.path().join("1/summary.json")).unwrap()).unwrap();
    assert_eq!(summary["digest"], unwatched["digest"]);
    // No floor is known to be flat there.
    let (terrain, _) = metromap(&["run", "worlds/terrain.toml", "--duration-s", "2"], &dir.path().join("terrain"));
    assert!(terrain.get("drift").is_none());
}

#[test]
fn a_bump_is_told_named_and_told_again_from_the_recording() {
    let dir = TempDir::new().unwrap();
    for (name, by) in [("roll_rad", 0.02), ("mirror_height_m", 0.01), ("tilt_rad", 0.006)] {
        let out = dir.path().join(name);
        let bump = format!("{name}={by}");
        let (run, told) = metromap(&["run", "worlds/lab.toml", "--duration-s", "20", "--bump", &bump], &out);
        let drift = &run["drift"];
        assert_eq!(drift["state"], "moved", "{drift}");
        let named = drift["moved"].as_array().unwrap().iter().find(|moved| moved["parameter"] == name);
        let named = named.unwrap_or_else(|| panic!("{name} is not named: {drift}"));
        let (found, sigma) = (named["by"].as_f64().unwrap(), named["sigma"].as_f64().unwrap());
        assert!((found - by).abs() < 3.0 * sigma + 0.02 * f64::abs(by), "{name}: {named}");
        assert!(drift["first_alarm_capture"].as_u64().unwrap() < 100, "{drift}");
        assert!(told.contains("calibration does not fit") && told.contains(name), "{told}");
        let recording = out.join("recording.mcap");
        let (map, told) = metromap(&["map", recording.to_str().unwrap()], &dir.path().join("again"));
        assert_eq!(&map["drift"], drift);
        assert_eq!(map["digest"], run["digest"]);
        assert!(told.contains("calibration does not fit"), "{told}");
    }
}

#[test]
fn a_hard_knock_is_told() {
    let dir = TempDir::new().unwrap();
    for (name, by) in [("roll_rad", 0.08), ("tilt_rad", 0.1), ("slit_roll_rad", 0.05), ("pan_rad", 0.2)] {
        let bump = format!("{name}={by}");
        let (run, told) =
            metromap(&["run", "worlds/lab.toml", "--duration-s", "40", "--bump", &bump], &dir.path().join(name));
        let drift = &run["drift"];
        assert_eq!(drift["state"], "moved", "{name}: {drift}");
        let named = drift["moved"].as_array().unwrap().iter().find(|moved| moved["parameter"] == name);
        let found = named.unwrap_or_else(|| panic!("{name} is not named: {drift}"))["by"].as_f64().unwrap();
        assert!((found - by).abs() < 0.02 * by, "{name}: {drift}");
        assert!(told.contains("calibration does not fit") && told.contains(name), "{told}");
    }
}

#[test]
fn a_line_at_the_edge_of_the_image_cancels_no_alarm() {
    let dir = TempDir::new().unwrap();
    let bare = dir.path().join("bare.toml");
    let world = "name = \"bare\"\n[world]\nground = { material = \"linoleum\" }\n[world.material.linoleum]\nalbedo = 0.5\n\
                 [finder.sweep]\nlines = [-51, -50, -40, 0, 40, 80, 120, 145]\n";
    fs::write(&bare, world).unwrap();
    let args = ["run", bare.to_str().unwrap(), "--duration-s", "20", "--bump", "roll_rad=0.02"];
    let (run, _) = metromap(&args, &dir.path().join("run"));
    assert_eq!(run["drift"]["state"], "moved", "{}", run["drift"]);
    assert_eq!(run["drift"]["moved"][0]["parameter"], "roll_rad", "{}", run["drift"]);
}

#[test]
fn what_was_not_checked_is_told_with_how_much_was_seen() {
    let dir = TempDir::new().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_metromap"));
    command.current_dir(env!("CARGO_MANIFEST_DIR")).args(["run", "worlds/corridor.toml", "--duration-s", "3", "--out"]);
    let output = command.arg(dir.path()).output().unwrap();
    let told = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    assert!(told.contains("calibration not checked: 0 of the last"), "{told}");
    assert!(told.contains("and 40 must"), "{told}");
}

#[test]
fn a_bump_of_nothing_is_refused() {
    for (bump, code, words) in [
        ("tlit_rad=0.1", 1, "tlit_rad"),
        ("tilt_rad", 2, "expected NAME=BY"),
        ("tilt_rad=much", 2, "expected a number"),
        ("camera_height_m=-0.3", 1, "laser"),
    ] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_metromap"));
        command.current_dir(env!("CARGO_MANIFEST_DIR")).args(["run", "worlds/lab.toml", "--bump", bump]);
        let output = command.output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(code) && told.contains(words), "{bump}: {told}");
    }
}
