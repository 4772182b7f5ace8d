//! The commands as a user types them: results, digests, exit codes, and what bad input is answered with.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

fn metromap(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_metromap"));
    command.current_dir(ROOT).args(args).stdin(Stdio::null());
    command
}

fn done(mut command: Command) -> Output {
    let output = command.output().unwrap();
    assert!(output.status.code().is_some(), "killed by a signal: {command:?}");
    output
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Runs a command that must end with exit code 0, and returns its one line of JSON.
fn json(command: Command) -> Value {
    let output = done(command);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn path(dir: &TempDir, name: &str) -> String {
    dir.path().join(name).to_string_lossy().into_owned()
}

fn data(below: &str) -> Option<PathBuf> {
    let path = Path::new(ROOT).join("../shared/data").join(below);
    if !path.exists() {
        eprintln!("skipped: ../shared/data is absent");
        return None;
    }
    Some(path)
}

fn number(value: &Value, keys: &str) -> f64 {
    let found = keys.split('.').fold(value, |v, key| &v[key]);
    found.as_f64().unwrap_or_else(|| panic!("{keys} is {found} in {value}"))
}

/// What stands in the lab.
const LAB: [&str; 19] = [
    "ball",
    "bin",
    "black_box",
    "carton",
    "coffee_table/top",
    "crate",
    "cube",
    "glossy_box",
    "low_box",
    "parcel",
    "pole_30mm",
    "pole_40mm",
    "pole_60mm",
    "ramp",
    "step",
    "wall_east",
    "wall_north",
    "wall_south",
    "wall_west",
];

#[test]
fn the_lab_is_mapped_well_with_perfect_odometry() {
    let dir = TempDir::new().unwrap();
    let run =
        json(metromap(&["run", "worlds/lab.toml", "--odometry", "perfect", "--json", "--out", &path(&dir, "lab")]));
    assert!(number(&run, "travel_m") >= 10.0, "{run}");
    assert!(number(&run, "points") >= 100_000.0, "{run}");
    assert!(number(&run, "terrain.area_m2") >= 30.0, "{run}");
    assert!(number(&run, "truth.point_rms_m_within_3m") <= 0.010, "{run}");
    assert!(number(&run, "truth.point_outliers") <= 0.005, "{run}");
    for half in ["low", "high"] {
        assert!(number(&run, &format!("truth.occupancy_precision_{half}")) >= 0.95, "{run}");
        assert!(number(&run, &format!("truth.occupancy_recall_{half}")) >= 0.95, "{run}");
    }
    assert!(number(&run, "truth.terrain_rmse_m") <= 0.02, "{run}");
    assert_eq!(number(&run, "collisions"), 0.0, "{run}");
    assert!(number(&run, "truth.terrain_coverage") >= 0.9, "{run}");
    assert_eq!(number(&run, "mission.ended"), number(&run, "mission.steps"), "{run}");
    assert_eq!(number(&run, "mission.given_up"), 0.0, "{run}");
    let objects = run["truth"]["objects"].as_object().unwrap();
    for name in LAB {
        assert!(objects.contains_key(name), "the slit never fell on {name}");
    }
    let missed: Vec<_> = objects.iter().filter(|(_, o)| o["is_found"] != true).map(|(name, _)| name).collect();
    assert!(missed.is_empty(), "not found: {missed:?}");
    for file in run["files"].as_array().unwrap() {
        assert!(fs::metadata(Path::new(ROOT).join(file.as_str().unwrap())).unwrap().len() > 0, "{file}");
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_and_the_recording_maps_to_them() {
    let dir = TempDir::new().unwrap();
    let run = |seed: &str, name: &str, threads: &str| {
        let out = path(&dir, name);
        let mut command =
            metromap(&["run", "worlds/lab.toml", "--seed", seed, "--duration-s", "15", "--json", "--out", &out]);
        command.args(["--images", "all"]).env("RAYON_NUM_THREADS", threads);
        json(command)["digest"].as_str().unwrap().to_string()
    };
    let first = run("1", "a", "0");
    assert_eq!(first, run("1", "b", "1"), "one thread");
    assert_ne!(first, run("2", "c", "0"), "another seed");
    let recording = path(&dir, "a/recording.mcap");
    for from in ["lines", "images"] {
        let map = json(metromap(&["map", &recording, "--from", from, "--json", "--out", &path(&dir, from)]));
        assert_eq!(first, map["digest"].as_str().unwrap(), "from {from}");
    }
}

#[test]
fn a_killed_run_keeps_all_but_the_last_second() {
    let dir = TempDir::new().unwrap();
    let out = path(&dir, "cut");
    let recording = path(&dir, "cut/recording.mcap");
    let mut child = metromap(&["run", "worlds/lab.toml", "--out", &out]).stderr(Stdio::null()).spawn().unwrap();
    // Until the recording has grown for two seconds of wall time: far from done.
    let started = Instant::now();
    let mut growing: Option<Instant> = None;
    while growing.is_none_or(|since| since.elapsed() < Duration::from_secs(2)) {
        assert!(started.elapsed() < Duration::from_secs(120), "no recording");
        if growing.is_none() && fs::metadata(&recording).is_ok_and(|m| m.len() > 50_000) {
            growing = Some(Instant::now());
        }
        assert!(child.try_wait().unwrap().is_none(), "the run was over before it could be killed");
        std::thread::sleep(Duration::from_millis(20));
    }
    // What the file held a second and a half before the end must be in what is recovered.
    let early = path(&dir, "early.mcap");
    fs::copy(&recording, &early).unwrap();
    std::thread::sleep(Duration::from_millis(1500));
    child.kill().unwrap(); // SIGKILL
    child.wait().unwrap();

    let whole = path(&dir, "whole.mcap");
    let recovered = done(metromap(&["recover", &recording, "--out", &whole, "--json"]));
    assert_eq!(recovered.status.code(), Some(3), "{}", stderr(&recovered));
    let count: Value = serde_json::from_slice(&recovered.stdout).unwrap();
    assert!(number(&count, "messages") > 100.0, "{count}");
    let map = json(metromap(&["map", &whole, "--json", "--out", &path(&dir, "map")]));
    let before = done(metromap(&["map", &early, "--json", "--out", &path(&dir, "map_early")]));
    let before: Value = serde_json::from_slice(&before.stdout).unwrap();
    // Ten captures a second are rendered even on a slow machine: what is flushed each second must have grown.
    assert!(number(&map, "captures") >= number(&before, "captures") + 10.0, "{map} after {before}");
    // The cut-off file itself maps too, says so, and gives the same map.
    let cut = done(metromap(&["map", &recording, "--json", "--out", &path(&dir, "map_cut")]));
    assert_eq!(cut.status.code(), Some(3), "{}", stderr(&cut));
    let cut: Value = serde_json::from_slice(&cut.stdout).unwrap();
    assert_eq!(cut["digest"], map["digest"]);
}

#[test]
fn ctrl_c_finishes_the_files() {
    let dir = TempDir::new().unwrap();
    let mut command = metromap(&["run", "worlds/lab.toml", "--out", &path(&dir, "lab"), "--json"]);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    std::thread::sleep(Duration::from_secs(3));
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let run: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(run["interrupted"], true);
    let map = json(metromap(&["map", &path(&dir, "lab/recording.mcap"), "--json", "--out", &path(&dir, "map")]));
    assert_eq!(run["digest"], map["digest"]);
}

/// Runs with a changed lab, and returns what stderr says; the exit code must be 1.
fn refused(dir: &TempDir, scenario: &str, args: &[&str]) -> String {
    let file = path(dir, "bad.toml");
    fs::write(&file, scenario).unwrap();
    let mut all = vec!["run", file.as_str()];
    all.extend(args);
    let output = done(metromap(&all));
    assert_eq!(output.status.code(), Some(1), "{scenario}\n{}", stderr(&output));
    stderr(&output)
}

#[test]
fn bad_scenarios_are_answered_with_file_line_found_and_expected() {
    let dir = TempDir::new().unwrap();
    let head = "name = \"bad\"\nseed = 1\n\n[world]\nground = true\n\n";
    let a_box = |body: &str| format!("{head}[[world.box]]\nname = \"crate\"\n{body}\n");
    fs::write(dir.path().join("empty.obj"), "# nothing\n").unwrap();
    let mesh = |file: &str| format!("{head}[[world.mesh]]\nname = \"m\"\nfile = \"{file}\"\nposition = [3, 0]\n");
    let cases = [
        ("unknown key", format!("{head}[robots]\nx = 1\n"), vec!["bad.toml:7", "robots"]),
        ("negative size", a_box("position = [2, 0]\nsize = [1, -1, 1]"), vec!["bad.toml:", "size", "-1"]),
        ("NaN pose", a_box("position = [nan, 0]\nsize = [1, 1, 1]"), vec!["bad.toml:", "position", "NaN"]),
        ("missing mesh", mesh("nowhere.obj"), vec!["nowhere.obj"]),
        ("empty mesh", mesh("empty.obj"), vec!["empty.obj", "0 triangles"]),
        (
            "beam out of reach",
            format!("{head}[finder.sweep]\nlines = [5000]\n"),
            vec!["bad.toml", "finder.sweep.turn", "5000"],
        ),
        (
            "in a wall",
            a_box("position = [0, 0]\nsize = [1, 1, 1]") + "\n[robot]\nstart = { x_m = 0, y_m = 0, yaw_deg = 0 }\n",
            vec!["crate"],
        ),
        (
            "wrong type",
            format!("{head}duration_s = \"long\"\n").replace("[world]\nground = true\n\n", ""),
            vec!["bad.toml:"],
        ),
        ("cut off", "name = \"bad".to_string(), vec!["bad.toml:1"]),
        ("empty", String::new(), vec!["bad.toml", "name"]),
    ];
    for (what, scenario, words) in cases {
        let text = refused(&dir, &scenario, &[]);
        for word in words {
            assert!(text.contains(word), "{what}: `{word}` is not in: {text}");
        }
        assert!(text.contains("expected"), "{what}: {text}");
    }
}

#[test]
fn an_sdf_world_that_includes_itself_is_refused() {
    let dir = TempDir::new().unwrap();
    let model = dir.path().join("models/loop");
    fs::create_dir_all(&model).unwrap();
    let include = "<include><uri>model://loop</uri></include>";
    fs::write(model.join("model.sdf"), format!("<sdf version='1.6'><model name='loop'>{include}</model></sdf>"))
        .unwrap();
    let world = dir.path().join("loop.world");
    fs::write(&world, format!("<sdf version='1.6'><world name='w'>{include}</world></sdf>")).unwrap();
    let output = done(metromap(&["run", &world.to_string_lossy()]));
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("loop") && stderr(&output).contains("expected"), "{}", stderr(&output));
}

#[test]
fn bad_inputs_of_the_other_commands_are_answered() {
    let dir = TempDir::new().unwrap();
    fs::write(dir.path().join("empty.png"), "").unwrap();
    fs::write(dir.path().join("not.mcap"), "hello").unwrap();
    fs::write(dir.path().join("rig.toml"), "version = 1\nname = \"x\"\n").unwrap();
    let cases: [(&[&str], i32, &str); 8] = [
        (&["extract", &path(&dir, "empty.png")], 1, "empty.png"),
        (&["extract", &path(&dir, "absent.png")], 1, "absent.png"),
        (&["map", &path(&dir, "not.mcap")], 1, "not.mcap"),
        (&["map", &path(&dir, "nowhere")], 1, "nowhere"),
        (&["map", &path(&dir, "")], 1, "rig.toml"),
        (&["recover", &path(&dir, "not.mcap")], 1, "not.mcap"),
        (&["view", &path(&dir, "not.mcap")], 1, "not.mcap"),
        (&["run", &path(&dir, "rig.txt")], 1, "rig.txt"),
    ];
    for (args, code, word) in cases {
        let output = done(metromap(args));
        assert_eq!(output.status.code(), Some(code), "{args:?}: {}", stderr(&output));
        assert!(stderr(&output).contains(word), "{args:?}: {}", stderr(&output));
    }
    for wrong in [
        vec!["fly"],
        vec!["run", "--goto", "1,2,x"],
        vec!["run", "--start=1,2"],
        vec!["run", "--start=1,2,nan"],
        vec!["run", "--duration-s", "-1"],
    ] {
        assert_eq!(done(metromap(&wrong)).status.code(), Some(2), "{wrong:?}");
    }
}

#[test]
fn a_taken_port_is_answered() {
    let dir = TempDir::new().unwrap();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let out = path(&dir, "o");
    let output = done(metromap(&["run", "worlds/lab.toml", "--web", "--port", &port, "--out", &out]));
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains(&port), "{}", stderr(&output));
    assert!(!Path::new(&out).join("recording.mcap").exists(), "a refused command must not touch what is there");
}

#[test]
fn a_mission_that_cannot_be_done_says_so() {
    let dir = TempDir::new().unwrap();
    let out = path(&dir, "o");
    let mut command = metromap(&["run", "worlds/lab.toml", "--start=2,1,0", "--goto", "10,1", "--json", "--out", &out]);
    command.args(["--images", "none"]);
    let run = json(command);
    assert_eq!(number(&run, "mission.given_up"), 1.0, "{run}");
    assert_eq!(number(&run, "collisions"), 0.0, "{run}");
}

#[test]
fn the_live_viewer_is_served_until_ctrl_c() {
    use std::io::{BufRead, BufReader, Read, Write};
    let dir = TempDir::new().unwrap();
    let out = path(&dir, "o");
    let mut child = metromap(&["run", "worlds/lab.toml", "--duration-s", "3", "--web", "--port", "0", "--out", &out])
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
    // The line that is written when the run is over.
    let stays = lines.into_iter().find(|line| line.contains("until Ctrl-C")).expect("the run ended without a viewer");
    let address = stays.split("http://").nth(1).unwrap().split('/').next().unwrap().to_string();
    let mut page = std::net::TcpStream::connect(&address).unwrap();
    write!(page, "GET / HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    page.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 200") && answer.contains("<html"), "{answer}");
    assert!(child.try_wait().unwrap().is_none());
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    assert_eq!(child.wait().unwrap().code(), Some(0));
}

#[test]
fn a_gazebo_house_and_a_warehouse_and_barn_are_mapped_as_they_lie() {
    for (world, args, bodies_min) in [
        ("worlds/turtlebot3/worlds/turtlebot3_house.world", vec![], 10),
        ("worlds/aws_small_warehouse/worlds/no_roof_small_warehouse.world", vec![], 2),
        ("worlds/barn/world_0.world.gz", vec!["--start=-2,3,90", "--goto=-2,4"], 5),
    ] {
        let Some(world) = data(world) else { return };
        let dir = TempDir::new().unwrap();
        let out = path(&dir, "o");
        let mut command =
            metromap(&["run", &world.to_string_lossy(), "--odometry", "perfect", "--json", "--out", &out]);
        command.args(&args);
        let run = json(command);
        for key in ["occupancy_precision", "occupancy_recall"] {
            for half in ["low", "high"] {
                assert!(number(&run, &format!("truth.{key}_{half}")) >= 0.95, "{}: {run}", world.display());
            }
        }
        assert!(run["truth"]["objects"].as_object().unwrap().len() >= bodies_min, "{}: {run}", world.display());
    }
}

#[test]
fn the_recordings_of_the_repository_are_mapped() {
    for (name, points_min) in [("lab_first_turn.mcap", 100_000.0), ("corridor_no_images.mcap", 50_000.0)] {
        let dir = TempDir::new().unwrap();
        let map = json(metromap(&["map", &format!("recordings/{name}"), "--json", "--out", &path(&dir, "map")]));
        assert!(number(&map, "points") >= points_min, "{name}: {map}");
    }
}

/// A folder with two images of one bright line, and the rig of `tests/rigs` with something put wrong.
fn folder_of_lines(dir: &TempDir, from: &str, to: &str) -> (String, String) {
    let folder = dir.path().join("shots");
    fs::create_dir(&folder).unwrap();
    for number in 0..2 {
        let lit = |_, v| image::Luma([if (300..303).contains(&v) { 200u8 } else { 10 }]);
        image::GrayImage::from_fn(640, 480, lit).save(folder.join(format!("img{number}.png"))).unwrap();
    }
    let rig = fs::read_to_string(Path::new(ROOT).join("tests/rigs/robot_floor.toml")).unwrap();
    assert!(rig.contains(from));
    let file = dir.path().join("rig.toml");
    fs::write(&file, rig.replace(from, to).replace("img*.jpg", "img*.png")).unwrap();
    (folder.to_string_lossy().into_owned(), file.to_string_lossy().into_owned())
}

#[test]
fn images_that_give_no_point_are_no_success() {
    for (from, to, why) in [
        ("offset_m = 0.16562456", "offset_m = -0.16562456", "no_point, expected lines of sight that meet the sheet"),
        ("[0.0, 0.0, 0.2235]", "[0.0, 0.0, 223.5]", "out_of_range, expected points within range_m_max"),
        (
            "normal = [0.04493705, -0.93709475, 0.3461706]",
            "normal = [-0.937, 0.045, 0.346]",
            "a line at 88° to the image's rows",
        ),
        ("[laser]\n", "[laser_]\n", "this rig is of a camera alone"),
    ] {
        let dir = TempDir::new().unwrap();
        let (folder, rig) = folder_of_lines(&dir, from, to);
        let output = done(metromap(&["map", &folder, "--rig", &rig, "--out", &path(&dir, "out")]));
        assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
        assert!(stderr(&output).contains(why), "{}", stderr(&output));
    }
    let dir = TempDir::new().unwrap();
    fs::write(dir.path().join("a.png"), "no image").unwrap();
    let output = done(metromap(&["extract", &path(&dir, "a.png")]));
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
}

#[cfg(unix)]
#[test]
fn a_reader_that_left_is_no_error_and_a_full_disk_is_one() {
    let dir = TempDir::new().unwrap();
    let mut child =
        metromap(&["design", "--out", &path(&dir, "a")]).stderr(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    drop((child.stderr.take(), child.stdout.take()));
    assert_eq!(child.wait().unwrap().code(), Some(0));
    assert!(dir.path().join("a/design.html").exists());
    if Path::new("/dev/full").exists() {
        let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
        let output = done({
            let mut command = metromap(&["design", "--json", "--out", &path(&dir, "b")]);
            command.stdout(full);
            command
        });
        assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
        assert!(stderr(&output).contains("standard output"), "{}", stderr(&output));
    }
    // A file where the directory should be is told before anything long is computed.
    fs::write(dir.path().join("file"), "").unwrap();
    for command in ["design", "gallery", "reproduce"] {
        let output = done(metromap(&[command, "--out", &path(&dir, "file")]));
        assert_eq!(output.status.code(), Some(1));
        assert!(stderr(&output).contains("--out: "), "{command}: {}", stderr(&output));
    }
}
