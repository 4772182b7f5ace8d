//! `metromap calibrate finder`: a file of slits in, a rig that maps out; and what bad input is answered with.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;
use tempfile::TempDir;

fn metromap(args: &[&str], paths: &[&Path]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_metromap"));
    command.current_dir(env!("CARGO_MANIFEST_DIR")).args(args).args(paths).output().unwrap()
}

fn calibrated(slits: &Path, out: &Path) -> Value {
    let output = metromap(&["calibrate", "finder", "--json", "--out"], &[out, slits]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn example(dir: &TempDir) -> std::path::PathBuf {
    let folder = dir.path().join("example");
    assert!(metromap(&["calibrate", "finder", "--example"], &[&folder]).status.success());
    folder.join("slits.toml")
}

#[test]
fn the_example_is_calibrated_and_its_rig_maps() {
    let dir = TempDir::new().unwrap();
    let slits = example(&dir);
    let out = dir.path().join("out");
    let json = calibrated(&slits, &out);
    // What the example's finder was built with, beside METRO-I's drawing (cli/calibrate/finder.rs).
    for (name, truth) in [
        ("mirror_height_m", 0.817230 + 0.012),
        ("tilt_rad", 0.484 + 0.007),
        ("x0_m", -0.164630 + 0.010),
        ("roll_rad", 0.006),
        ("slit_roll_rad", -0.004),
        ("camera_y_m", 0.003),
    ] {
        let found = &json["parameters"][name];
        let (value, sigma) = (found["value"].as_f64().unwrap(), found["sigma"].as_f64().unwrap());
        assert!((value - truth).abs() < 3.5 * sigma && sigma < 0.01, "{name}: {value} ± {sigma}, truth {truth}");
        assert_eq!(json["held"][name], "data", "{name}");
    }
    assert_eq!(json["verdict"]["accepted"], true, "{}", json["verdict"]);
    assert_eq!((json["used"].as_u64(), json["rejected"].as_array().map(Vec::len)), (Some(47), Some(0)));
    let rms = json["residual"]["rms"].as_f64().unwrap();
    assert!((0.8..1.2).contains(&rms), "{rms}");
    let names = json["covariance"]["names"].as_array().unwrap();
    assert_eq!(json["covariance"]["rows"].as_array().unwrap().len(), names.len());
    let saved: Value = serde_json::from_slice(&fs::read(out.join("calibration.json")).unwrap()).unwrap();
    assert_eq!(saved, json);
    let html = fs::read_to_string(out.join("report.html")).unwrap();
    assert!(html.contains("Accepted") && html.matches("<svg").count() >= 4 && html.ends_with("</html>"));

    // Another program reads the rig: a scenario with it runs.
    let scenario = dir.path().join("rig.scenario.toml");
    let ground = "name = \"rig\"\nduration_s = 3\n[world]\nground = true\n[finder]\nrig = \"out/rig.toml\"\n";
    fs::write(&scenario, ground).unwrap();
    let run = metromap(&["run", "--json", "--out"], &[&dir.path().join("run"), &scenario]);
    assert_eq!(run.status.code(), Some(0), "{}", String::from_utf8_lossy(&run.stderr));
    let run: Value = serde_json::from_slice(&run.stdout).unwrap();
    assert!(run["points"].as_u64().unwrap() > 1000, "{run}");
}

#[test]
fn the_papers_table_of_slits_names_what_is_weak() {
    // Three rows of Table 4 (paper.md 5.4), as a table alone: nothing is known of roll, pan and axis.
    let dir = TempDir::new().unwrap();
    let slits = dir.path().join("slits.csv");
    let mut table = String::from("name,mirror_pulse,mark_m,u,v # the paper's five slits, with the columns of a line\n");
    for (pulse, mark, row) in
        [(130, 0.0, 437.85), (84, 0.3, 329.0), (49, 0.6, 244.94), (22, 0.9, 178.88), (0, 1.2, 126.03)]
    {
        table += &format!("s{pulse},{pulse},{mark},256,{row}\n");
    }
    fs::write(&slits, &table).unwrap();
    let output = metromap(&["calibrate", "finder", "--out"], &[&dir.path().join("out"), &slits]);
    assert_eq!(output.status.code(), Some(1));
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(told.contains("10 readings on 5 slits, expected at least"), "{told}");
    // With the paper's assumptions it is calibrated, but not well: three to five slits hold lA to 27 mm.
    let file = dir.path().join("slits.toml");
    let camera = "[camera]\nf_mm = [11.434, 0.019]\nscale_u = [1.095, 2e-4]\nk_per_mm2 = [0.00335, 6e-5]\n\
                  cu_px = [256, 2.5]\ncv_px = [239, 2.5]\n";
    fs::write(&file, format!("version = 1\nassume = \"paper\"\ntable = \"slits.csv\"\n{camera}")).unwrap();
    let json = calibrated(&file, &dir.path().join("out"));
    let sigma = json["parameters"]["mirror_height_m"]["sigma"].as_f64().unwrap();
    assert!((0.024..0.032).contains(&sigma), "{sigma}");
    assert_eq!(json["verdict"]["accepted"], false);
    assert!(json["verdict"]["reasons"][0].as_str().unwrap().contains("range error"), "{}", json["verdict"]);
}

#[test]
fn slits_of_a_recording_are_calibrated_on() {
    // A run on bare floor: its captures are slits without marks, which hold the beam but for what a tape tells.
    let dir = TempDir::new().unwrap();
    let scenario = dir.path().join("floor.toml");
    let sweep = "[finder.sweep]\nlines = [-40, -20, 0, 20, 40, 60, 80, 100, 120, 140]\n";
    fs::write(&scenario, format!("name = \"floor\"\nduration_s = 12\n[world]\nground = true\n{sweep}")).unwrap();
    let run = metromap(&["run", "--json", "--out"], &[&dir.path().join("run"), &scenario]);
    assert_eq!(run.status.code(), Some(0), "{}", String::from_utf8_lossy(&run.stderr));
    let mut text = String::from(
        "version = 1\nassume = \"paper\"\nrecording = \"run/recording.mcap\"\npulse_sigma = 0.1\n\
         known = { mirror_height_m = 0.001, x0_m = 0.001 }\n",
    );
    for capture in 0..10 {
        text += &format!("[[slits]]\ncapture = {capture}\non = \"floor\"\n");
    }
    let file = dir.path().join("slits.toml");
    fs::write(&file, &text).unwrap();
    let json = calibrated(&file, &dir.path().join("out"));
    assert_eq!(json["slits"][0]["readings"], 16);
    let tilt = &json["parameters"]["tilt_rad"];
    let (value, sigma) = (tilt["value"].as_f64().unwrap(), tilt["sigma"].as_f64().unwrap());
    assert!((value - 0.484).abs() < 4.0 * sigma, "{tilt}");
    fs::write(&file, text.replace("capture = 1\n", "capture = 9999\n")).unwrap();
    let output = metromap(&["calibrate", "finder"], &[&file]);
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && told.contains("slit 2: capture: found 9999"), "{told}");
}

#[test]
fn bad_files_are_refused_with_their_line() {
    let dir = TempDir::new().unwrap();
    let slits = example(&dir);
    let good = fs::read_to_string(&slits).unwrap();
    let first = good.find("[[slits]]").unwrap();
    let line = |at: usize| good[..at].matches('\n').count() + 1;
    let mark = &good[first..][good[first..].find("mark_m = ").unwrap()..];
    let mark = mark.lines().next().unwrap();
    for (from, to, at, words) in [
        ("version = 1", "version = 2", None, "a newer metromap"),
        ("rig = \"nominal.toml\"", "rgi = \"nominal.toml\"", Some(3), "rgi"),
        ("rig = \"nominal.toml\"", "rig = \"none.toml\"", None, "none.toml"),
        (mark, "mark_m = 1500.0", Some(line(first)), "is this millimetres?"),
        (mark, "mark_m = nan", Some(line(first)), "mark_m"),
        ("mark_sigma_m = 0.0005", "mark_sigma_m = 0.5", None, "metres, not millimetres"),
        ("on = \"floor\"", "on = \"ceiling\"", None, "ceiling"),
        ("on = { wall = 0 }", "on = { wall = 7 }", None, "one of 3 walls"),
        ("mirror_pulse = ", "mirror_puls = ", None, "mirror_puls"),
        ("beam_rad_per_pulse = \"exactly\"", "tlit_rad = 0.1", None, "tlit_rad"),
        ("beam_rad_per_pulse = \"exactly\"", "tilt_rad = -0.1", None, "known.tilt_rad"),
        ("beam_rad_per_pulse = \"exactly\"", "tilt_rad = \"roughly\"", None, "exactly"),
        ("f_mm = [11.434, 0.019]", "f_mm = [11.434, 0.0]", None, "camera.f_mm"),
        ("[camera]", "[camera", None, "slits.toml"),
    ] {
        assert!(good.contains(from), "{from}");
        fs::write(&slits, good.replacen(from, to, 1)).unwrap();
        let output = metromap(&["calibrate", "finder"], &[&slits]);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{from} -> {to}: {told}");
        assert!(told.contains(words), "{from} -> {to}: {told}");
        if let Some(at) = at {
            assert!(told.contains(&format!("slits.toml:{at}:")), "{from} -> {to}: {told}");
        }
    }
    // Everything the other way round.
    let turned = |key: &str, by: &dyn Fn(f64) -> f64| {
        let swap = |l: &str| match l.strip_prefix(key) {
            Some(number) if !number.contains('#') => format!("{key}{}", by(number.parse().unwrap())),
            _ => l.to_string(),
        };
        good.lines().map(swap).collect::<Vec<_>>().join("\n")
    };
    for (text, words) in [
        (turned("mirror_pulse = ", &|p| -p), "count the other way"),
        (turned("mark_m = ", &|m| 2.0 - m), "read outwards"),
        (turned("mirror_pulse = ", &|_| 40.0), "at one place they say nothing"),
        (good[..first].to_string(), "found none"),
        (good[..first].to_string() + "[[slits]]\nmirror_pulse = 40\non = \"floor\"\n", "at least 3"),
        (good.replace("v = ", "v = 9"), "a row of the rig's image"),
    ] {
        fs::write(&slits, text).unwrap();
        let output = metromap(&["calibrate", "finder"], &[&slits]);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(1) && told.contains(words), "{words}: {told}");
    }
    let table = dir.path().join("t.csv");
    for (text, words) in [
        ("", "t.csv: table: found nothing"),
        ("mirror_pulse,v\n1,2\n", "t.csv:2: u, v: found one of them"),
        ("mirror_pulse,mark\n", "t.csv:1: column: found `mark`"),
        ("mirror_pulse,mark_m\n1,2,3\n", "t.csv:2: row: found 3 cells"),
        ("mirror_pulse,mark_m\n1,x\n", "t.csv:2: mark_m: found `x`"),
        ("mirror_pulse,mark_m\n1,nan\n", "t.csv:2: mark_m: found `nan`"),
        ("mirror_pulse,mark_m\n,0.1\n", "t.csv:2: mirror_pulse: found nothing"),
        ("mirror_pulse,on\n1,wall 0\n", "walls stand in the .toml file"),
        ("mirror_pulse,mark_m\n1,900\n", "is this millimetres?"),
    ] {
        fs::write(&table, text).unwrap();
        let output = metromap(&["calibrate", "finder"], &[&table]);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(1) && told.contains(words), "{text:?}: {told}");
    }
    assert_eq!(metromap(&["calibrate", "finder"], &[]).status.code(), Some(2));
}
