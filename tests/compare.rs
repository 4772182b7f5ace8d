//! `metromap compare` from outside: what it writes, that it goes on after kill -9, what it refuses.

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use serde_json::Value;

const SMALL: &str = "name = 'small'\nseed = 3\nduration_s = 1.5\n[world]\nground = true\n[[world.cylinder]]\nname = 'bin'\n\
    position = [2.0, 0.0]\nradius = 0.15\nheight = 0.5\n[robot]\nstart = { x_m = 0, y_m = 0, yaw_deg = 0 }\n\
    [[mission]]\ngo_to = [1.0, 0.0]\nspeed_m_s = 0.3\n";

fn compare(world: &Path, out: &Path, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_metromap"));
    command.arg("compare").arg(world).arg("--out").arg(out).args(more);
    command.env_remove("RUST_LOG");
    command
}

fn written(dir: &Path, text: &str) -> std::path::PathBuf {
    let world = dir.join("small.toml");
    std::fs::write(&world, text).unwrap();
    world
}

fn done(mut command: Command) -> Output {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output
}

fn refused(mut command: Command) -> String {
    let output = command.output().unwrap();
    assert!(!output.status.success());
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_comparison_killed_and_started_again_writes_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let world = written(dir.path(), SMALL);
    let (once, twice) = (dir.path().join("once"), dir.path().join("twice"));
    let output = done(compare(&world, &once, &["--seeds", "4", "--threads", "2", "--json"]));
    let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(printed["seeds"], serde_json::json!([3, 4, 5, 6]));
    assert!(printed["classes"]["obstacle"]["laser"]["opportunities"].as_u64().unwrap() > 0);
    assert!(printed["verdict"].as_array().unwrap().len() > 3);
    let ring = &printed["classes"]["obstacle"]["ultrasonic"];
    // Four seeds are too few to draw from, and enough for the interval of a rate.
    assert!(ring["range_rmse_m"].is_f64() && ring["range_rmse_m_ci95"].is_null() && ring["ci95"].is_array(), "{ring}");
    assert!(printed["map"]["fused"]["iou"].is_f64() && printed["needs"]["laser"]["power_w"] == 7.0);
    let html = std::fs::read_to_string(once.join("report.html")).unwrap();
    assert!(!html.contains("src=\"http") && !html.contains("<script") && !html.contains("@import"), "needs no network");
    assert!(once.join("view.rrd").exists());

    let mut child = compare(&world, &twice, &["--seeds", "4", "--threads", "1", "--no-recording"])
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    while !twice.join("seeds/seed_3.json").exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let output = done(compare(&world, &twice, &["--seeds", "4", "--threads", "2", "--no-recording", "--json"]));
    let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(printed["kept"].as_u64().unwrap() > 0 && printed["redone"] == 0, "{printed}");
    let bytes = |out: &Path, name: &str| std::fs::read(out.join(name)).unwrap();
    for name in ["compare.csv", "report.html", "seeds/seed_3.json", "seeds/seed_6.json"] {
        assert!(bytes(&once, name) == bytes(&twice, name), "{name}");
    }
}

#[test]
fn a_world_with_nothing_in_it_is_not_measured() {
    let dir = tempfile::tempdir().unwrap();
    let empty =
        SMALL.replace("[[world.cylinder]]\nname = 'bin'\nposition = [2.0, 0.0]\nradius = 0.15\nheight = 0.5\n", "");
    assert!(!empty.contains("cylinder"));
    let world = written(dir.path(), &empty.replace("duration_s = 1.5", "duration_s = 0.5"));
    let output = done(compare(&world, &dir.path().join("out"), &["--seeds", "2", "--json", "--no-recording"]));
    let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(printed["classes"], serde_json::json!({}));
    assert!(printed["verdict"][0].as_str().unwrap().contains("No obstacle came into play"));
    assert!(printed["map"]["laser"]["recall"].is_null(), "{}", printed["map"]);
    // The ring heard nothing, and the laser's map is not its own.
    assert!(
        printed["map"]["laser"]["free_found"].as_f64().unwrap() > 0.0
            && printed["map"]["ultrasonic"]["free_found"] == 0.0
    );
}

#[test]
fn what_cannot_be_compared_is_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let world = written(dir.path(), SMALL);
    let out = dir.path().join("out");
    assert!(refused(compare(&world, &out, &["--seeds", "0"])).contains("--seeds: found 0, expected 1 to 10000"));
    assert!(refused(compare(&world, &out, &["--sensors"])).contains("--sensors: found none"));
    let mut one = Command::new(env!("CARGO_BIN_EXE_metromap"));
    one.args(["compare", "--sensors", "laser", "gone.toml"]);
    assert!(refused(one).contains("gone.toml: file: found"));
    let world =
        written(dir.path(), &format!("{SMALL}[[compare.target]]\nname = 'a'\nclass = 'b'\nbodies = ['gone']\n"));
    let fault = refused(compare(&world, &out, &[]));
    assert!(fault.contains("small.toml") && fault.contains("compare.target `a`: bodies: found `gone`"), "{fault}");
    let world = written(dir.path(), &format!("{SMALL}[compare]\nrange_m = 0\n"));
    assert!(refused(compare(&world, &out, &[])).contains("small.toml:17: compare.range_m: found 0"));
}

/// A ring of four that is carried to and fro before a wall.
const ROOM: &str = "# A wall, and nothing more.\nname = 'wall'\n[world]\nground = true\n[[world.box]]\nname = 'wall'\n\
    position = [2, 0]\nsize = [0.1, 4, 2]\n[sonar]\ncount = 4\n[robot]\nspeed_m_s_max = 0.2\n\
    [[mission]]\ngo_to = [0, 0]\n[[mission]]\ngo_to = [1, 0]\n";

#[test]
fn recorded_readings_stand_beside_simulated_ones() {
    let dir = tempfile::tempdir().unwrap();
    let world = written(dir.path(), &SMALL.replace("duration_s = 1.5", "duration_s = 0.5"));
    let (room, table, out) = (dir.path().join("room.toml"), dir.path().join("ranges.csv"), dir.path().join("out"));
    std::fs::write(&room, ROOM).unwrap();
    std::fs::write(&table, "a,b,c,d,turn\n1,4,5,5,left\n2.5,4,5,3.9,left\n2,3.5,5,4,right\n").unwrap();
    let [table_arg, room_arg] = [&table, &room].map(|path| path.to_str().unwrap());
    let with = ["--seeds", "1", "--no-recording", "--json", "--readings", table_arg, "--readings-world", room_arg];
    let limited = [&with[..], &["--readings-limit", "4"]].concat();
    let output = done(compare(&world, &out, &limited));
    let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
    let readings = &printed["readings"];
    let real = &readings["real"];
    assert_eq!([&real["readings"], &real["dropped"], &real["steps"], &real["jumps"]], [12, 7, 8, 1], "{real}");
    let dropout = &readings["rates"]["dropout"];
    assert!((dropout["real"].as_f64().unwrap() - 7.0 / 12.0).abs() < 1e-12);
    // Of four transducers before one wall, one or two hear it.
    assert!(
        (0.4..0.9).contains(&dropout["simulated"].as_f64().unwrap()) && dropout["within_factor_2"] == true,
        "{dropout}"
    );
    assert_eq!((&readings["world"], &readings["about"][0]), (&"wall".into(), &"A wall, and nothing more.".into()));
    let html = std::fs::read_to_string(out.join("report.html")).unwrap();
    for part in [
        "The ring against real readings",
        "at the limit of 4 m",
        "58.3",
        "A wall, and nothing more.",
        "not a prediction",
    ] {
        assert!(html.contains(part), "{part}");
    }
    let stored: Value = serde_json::from_str(&std::fs::read_to_string(out.join("compare.json")).unwrap()).unwrap();
    assert_eq!(&stored["readings"], readings);

    std::fs::write(&table, "1,4,5,5\n2,4,x,5\n").unwrap();
    let fault = refused(compare(&world, &out, &with));
    assert!(fault.contains("ranges.csv:2: column 3: found `x`, expected a range [m]"), "{fault}");
    std::fs::write(&table, "1,4,5,5\n\n2,4,5\n").unwrap();
    assert!(refused(compare(&world, &out, &with)).contains("ranges.csv:3: row: found 3 columns, expected at least 4"));
    let fault = refused(compare(&world, &out, &["--readings", table_arg, "--readings-world", world.to_str().unwrap()]));
    assert!(fault.contains("small.toml: sonar: found nothing"), "{fault}");
    let fault = refused(compare(&world, &out, &[&with[..], &["--readings-limit", "0"]].concat()));
    assert!(fault.contains("--readings-limit: found 0, expected a number from 0.1 to 100"), "{fault}");
}
