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
