//! The ultrasonic ring from the scenario file to the maps: tables, runs, recordings, and other programs' recordings.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use metromap::geometry::Transform;
use metromap::image::Drop;
use metromap::maps::State;
use metromap::optics::Rig;
use metromap::pipeline::{Pipeline, PipelineParams};
use metromap::ranges::RangeReading;
use metromap::record::bag::{Item, Reader, Writer};
use metromap::record::messages::{
    Header, Message, OccupancyGrid, Odometry, Pose, PoseWithCovariance, Range, TfMessage, TransformStamped,
};
use metromap::record::{cdr, topics};
use metromap::sonar::{Ring, Targets};
use metromap::sources::replay::{Input, Replay};
use metromap::sources::{Scenario, Simulation};
use metromap::time::Stamp;
use serde_json::Value;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// A room with a box, a robot that drives 2 m, and a table.
fn world(dir: &Path, sonar: &str) -> PathBuf {
    let text = format!(
        "name = \"room\"\nseed = 3\nduration_s = 12\n\n[world]\nground = {{}}\n\n\
         [[world.box]]\nname = \"north\"\nposition = [0, 1.55]\nsize = [6, 0.1, 1]\n\n\
         [[world.box]]\nname = \"south\"\nposition = [0, -1.55]\nsize = [6, 0.1, 1]\n\n\
         [[world.box]]\nname = \"east\"\nposition = [3.05, 0]\nsize = [0.1, 3.2, 1]\n\n\
         [[world.box]]\nname = \"west\"\nposition = [-3.05, 0]\nsize = [0.1, 3.2, 1]\n\n\
         [[world.box]]\nname = \"parcel\"\nposition = [1.5, 0.9]\nsize = [0.3, 0.3, 0.5]\nmass_kg = 2\n\n\
         [robot]\nstart = {{ x_m = -1, y_m = 0, yaw_deg = 0 }}\n\n[[mission]]\ngo_to = [1, 0]\n\n{sonar}"
    );
    let path = dir.join("room.toml");
    std::fs::write(&path, text).unwrap();
    path
}

fn heard(scenario: &Scenario) -> Vec<RangeReading> {
    let mut simulation = Simulation::new(scenario).unwrap();
    let mut all = Vec::new();
    let mut last = Stamp(i64::MIN);
    while let Some(shot) = simulation.next_shot().unwrap() {
        for heard in shot.heard {
            assert!(heard.reading.stamp >= last && heard.reading.stamp <= shot.capture.stamp, "in time order");
            assert_eq!(heard.truth.ping.reading.stamp, heard.reading.stamp);
            last = heard.reading.stamp;
            all.push(heard.reading);
        }
    }
    all.extend(simulation.take_heard().into_iter().map(|heard| heard.reading));
    all
}

#[test]
fn a_table_that_makes_no_ring_is_refused_with_its_line() {
    let dir = tempfile::tempdir().unwrap();
    let fault = |sonar: &str| {
        let path = world(dir.path(), sonar);
        let line = |mark: &str| {
            let text = std::fs::read_to_string(&path).unwrap();
            text.lines().position(|line| line.contains(mark)).map(|at| at + 1)
        };
        let mark = sonar.lines().last().unwrap_or_default();
        let fault = Scenario::load(&path, &[]).unwrap_err();
        assert_eq!(fault.file.as_deref(), path.to_str(), "{fault}");
        assert_eq!(fault.line, line(mark), "{fault}");
        format!("{}: found {}, expected {}", fault.what, fault.found, fault.expected)
    };
    assert_eq!(fault("[sonar]\ncount = 0"), "sonar.count: found 0, expected 1 to 72 transducers");
    assert_eq!(fault("[sonar]\ncount = 1000"), "sonar.count: found 1000, expected 1 to 72 transducers");
    assert!(
        fault("[sonar.air]\ntemperature_k = -5").starts_with("sonar.air.temperature_k: found -5, expected a number")
    );
    assert!(fault("[sonar]\norder = 1\ninterval_s = 0.002").contains("more than the 0.00238 s of the blanking"));
    assert!(fault("[sonar]\ncolour = \"red\"").starts_with("key `colour`"));
    assert!(fault("[sonar.transducer]\ncount = 1").starts_with("key `count`"));
    assert!(fault("[sonar]\ncount = -1").contains("count"));
    assert!(fault("[sonar]\nradius_m = nan").starts_with("sonar.radius_m"));
    assert!(fault("[sonar]\nschedule = { groups = { groups = 30 } }").contains("1 to 24"));
}

#[test]
fn a_run_hears_the_same_with_the_same_seed_and_drives_the_same_with_and_without_a_ring() {
    let dir = tempfile::tempdir().unwrap();
    let with = Scenario::load(&world(dir.path(), "[sonar]\n"), &[]).unwrap();
    let without = Scenario::load(&world(dir.path(), ""), &[]).unwrap();
    assert!(without.sonar.is_none());
    let first = heard(&with);
    assert_eq!(first, heard(&with));
    assert_ne!(first, heard(&Scenario { seed: 4, ..with.clone() }));
    assert!(heard(&without).is_empty());
    // 65 ms apart, each transducer once in 24, all within limits.
    let seconds = first.last().unwrap().stamp.as_secs();
    assert!(seconds > 5.0 && (first.len() as f64 - seconds / 0.065).abs() < 2.0, "{} in {seconds} s", first.len());
    for (number, reading) in first.iter().enumerate() {
        assert_eq!((reading.frame.clone(), reading.check()), (format!("sonar_{:02}", number % 24), Ok(())));
    }
    let echoes = first.iter().filter(|reading| reading.range_m.is_some()).count();
    assert!(echoes * 2 > first.len(), "{echoes} of {}", first.len());
    let captures = |scenario: &Scenario| {
        let mut simulation = Simulation::new(scenario).unwrap();
        let mut shots = Vec::new();
        while let Some(shot) = simulation.next_shot().unwrap() {
            shots.push(shot.capture);
        }
        shots
    };
    assert_eq!(captures(&with), captures(&without));
}

fn metromap(args: &[&str]) -> Value {
    let mut command = Command::new(env!("CARGO_BIN_EXE_metromap"));
    let output = command.current_dir(ROOT).args(args).stdin(Stdio::null()).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn both_sensors_come_back_out_of_the_recording() {
    let dir = tempfile::tempdir().unwrap();
    let file = world(dir.path(), "");
    let out = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let [with, without, again] = [out("with"), out("without"), out("again")];
    let file = file.to_str().unwrap();
    let run = metromap(&["run", file, "--sonar", "--json", "--images", "none", "--out", &with]);
    let alone = metromap(&["run", file, "--json", "--images", "none", "--out", &without]);
    let map = metromap(&["map", &format!("{with}/recording.mcap"), "--json", "--out", &again]);
    assert_eq!(map["digest"], run["digest"]);
    assert_eq!((&map["ranges"], &map["occupancy"]), (&run["ranges"], &run["occupancy"]));
    assert_ne!(run["digest"], alone["digest"], "the ultrasonic layer is part of it");
    for same in ["captures", "points", "occupancy", "terrain", "travel_m"] {
        assert_eq!(run[same], alone[same], "{same}");
    }
    assert!(run["ranges"]["readings"].as_u64().unwrap() > 80 && run["ranges"]["transducers"] == 24, "{run}");
    assert!(alone.get("ranges").is_none() && alone["truth"].get("map").is_none());
    for layer in ["laser", "ultrasonic", "fused"] {
        for key in ["precision", "recall", "iou", "free_space_error", "free_found", "free_blocked"] {
            let value = run["truth"]["map"][layer][key].as_f64().unwrap();
            assert!((0.0..=1.0).contains(&value), "{layer} {key}: {value}");
        }
    }
    let mut types = std::collections::BTreeMap::new();
    let mut edges = 0;
    for item in Reader::open(&Path::new(&with).join("recording.mcap")).unwrap() {
        let Item::Message(message) = item.unwrap() else { continue };
        let kind = message.channel.schema.as_ref().unwrap().name.clone();
        if message.channel.topic == topics::TF_STATIC {
            edges = cdr::decode::<TfMessage>(&message.data).unwrap().transforms.len();
        } else if kind == Range::TYPE {
            let range: Range = cdr::decode(&message.data).unwrap();
            assert_eq!(message.channel.topic, format!("/{}/range", range.header.frame_id));
            assert_eq!(range.radiation_type, 0);
            let limits = range.min_range..=range.max_range;
            assert!(limits.contains(&range.range) || range.range == f32::INFINITY, "{range:?}");
        }
        *types.entry((message.channel.topic.clone(), kind)).or_insert(0) += 1;
    }
    assert_eq!(edges, 25, "the camera and every transducer");
    let of = |topic: &str, kind: &str| types.get(&(topic.to_string(), kind.to_string())).copied().unwrap_or(0);
    assert!(of("/sonar_00/range", Range::TYPE) >= 3 && of("/sonar_23/range", Range::TYPE) >= 3, "{types:?}");
    assert!(of(topics::MAP_ULTRASONIC, OccupancyGrid::TYPE) > 1 && of(topics::MAP_FUSED, OccupancyGrid::TYPE) > 1);
    // The three maps lie on the same cells, and the replay writes the same bytes.
    let read = |folder: &str, name: &str| std::fs::read(Path::new(folder).join(name)).unwrap();
    let yaml = |name: &str| {
        String::from_utf8(read(&with, name)).unwrap().lines().skip(1).map(String::from).collect::<Vec<_>>()
    };
    assert_eq!((yaml("sonar.yaml"), yaml("fused.yaml")), (yaml("map.yaml"), yaml("map.yaml")));
    for name in ["map.pgm", "sonar.pgm", "fused.pgm", "sonar.yaml"] {
        assert_eq!(read(&with, name), read(&again, name), "{name}");
    }
    assert!(read(&with, "layers.png").starts_with(b"\x89PNG") && read(&again, "layers.png").starts_with(b"\x89PNG"));
    assert!(!Path::new(&without).join("sonar.pgm").exists());
}

/// Writes messages of another robot: its own names, odometry as messages, ranges of an older version of the type.
struct Foreign {
    writer: Writer<std::io::BufWriter<std::fs::File>>,
    topics: std::collections::BTreeMap<String, metromap::record::bag::Topic>,
}

impl Foreign {
    fn put<M: Message>(&mut self, topic: &str, at_ms: i64, message: &M, cut: usize) {
        let known = self.topics.get(topic).copied();
        let id = known.unwrap_or_else(|| self.writer.topic(topic, M::TYPE, false).unwrap());
        self.topics.insert(topic.into(), id);
        let bytes = cdr::encode(message).unwrap();
        self.writer.write(id, Stamp(at_ms * 1_000_000), &bytes[..bytes.len() - cut]).unwrap();
    }

    fn range(&mut self, at_ms: i64, frame: &str, range: f32, radiation_type: u8) {
        let header = Header::new(Stamp(at_ms * 1_000_000), frame).unwrap();
        let message =
            Range { header, radiation_type, field_of_view: 0.5, min_range: 0.2, max_range: 5.0, range, variance: 0.0 };
        self.put(&format!("/{}", frame.trim_start_matches('/')), at_ms, &message, 4); // no variance then
    }

    fn odometry(&mut self, at_ms: i64) {
        let pose = Pose::from(&Transform::<(), ()>::planar(at_ms as f64 * 2e-4, 0.0, 0.0));
        let message = Odometry {
            header: Header::new(Stamp(at_ms * 1_000_000), "odom").unwrap(),
            child_frame_id: "base_footprint".into(),
            pose: PoseWithCovariance { pose, ..Default::default() },
            ..Default::default()
        };
        self.put("/robot/odometry", at_ms, &message, 0);
    }
}

/// A robot that drives at 0.2 m/s towards a wall at x = 4 m, with a wall at y = 1.5 m on its left.
fn foreign(path: &Path, with_odometry: bool) {
    let mut bag = Foreign { writer: Writer::create(path).unwrap(), topics: Default::default() };
    let edge = |parent: &str, child: &str, xyz: [f64; 3], yaw: f64| TransformStamped {
        header: Header::new(Stamp(0), parent).unwrap(),
        child_frame_id: child.into(),
        transform: Pose::from(&Transform::<(), ()>::from_xyz_rpy(xyz, [0.0, 0.0, yaw])),
    };
    let transforms = vec![
        edge("base_footprint", "base_link", [0.0, 0.0, 0.1], 0.0),
        edge("base_link", "us_front", [0.2, 0.0, 0.3], 0.0),
        edge("base_link", "us_left", [0.0, 0.2, 0.3], std::f64::consts::FRAC_PI_2),
    ];
    bag.put(topics::TF_STATIC, 0, &TfMessage { transforms }, 0);
    for at_ms in (0..5000).step_by(10) {
        if with_odometry && at_ms % 50 == 0 {
            bag.odometry(at_ms);
        }
        let x = at_ms as f32 * 2e-4;
        match at_ms % 100 {
            30 => bag.range(at_ms, "us_front", 4.0 - 0.2 - x, 0),
            70 => bag.range(at_ms, "/us_left", 1.5 - 0.2, 0),
            _ => {}
        }
        match at_ms {
            1000 => bag.range(at_ms, "us_front", f32::INFINITY, 0),
            1010 => bag.range(at_ms, "us_front", 6.0, 0),
            1020 => bag.range(at_ms, "us_front", f32::NAN, 0),
            1040 => bag.range(at_ms, "us_front", f32::NEG_INFINITY, 0),
            1050 => bag.range(at_ms, "us_front", 1.0, 1),
            1060 => bag.range(at_ms, "nobody_knows", 1.0, 0),
            _ => {}
        }
    }
    bag.writer.finish().unwrap();
}

#[test]
fn the_ranges_of_another_robot_are_mapped() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("foreign.mcap");
    foreign(&path, true);
    let mut replay = Replay::open(&path, false).unwrap();
    let mut pipeline = Pipeline::new(Rig::metro_i(), PipelineParams::default()).unwrap();
    let mut refused = Vec::new();
    while let Some(next) = replay.next_input().unwrap() {
        let Input::Range(reading) = next else { panic!("{next:?}") };
        let x = reading.stamp.as_secs() * 0.2;
        assert!((reading.odom_from_robot.xyz().x - x).abs() < 1e-9, "on the way between two poses");
        refused.extend(pipeline.hear(&reading).err().map(|(why, _)| why));
    }
    assert_eq!(refused, [Drop::OutOfRange; 2], "NaN and −Inf");
    let layer = pipeline.maps().ultrasonic();
    // The last range at 4970 ms has no odometry after it.
    assert_eq!((layer.readings(), layer.silent(), layer.transducers()), (50 + 49 + 2, 2, 2));
    assert_eq!((replay.other_ranges(), replay.dropped().0[&Drop::BadPose]), (1, 2));
    assert_eq!([layer.state(4.01, 0.01), layer.state(0.5, 1.51)], [State::Occupied; 2]);
    assert_eq!([layer.state(2.5, 0.01), layer.state(0.5, 0.9)], [State::Free; 2]);

    let out = dir.path().join("out");
    let map = metromap_any(&["map", path.to_str().unwrap(), "--json", "--out", out.to_str().unwrap()]);
    assert_eq!((map["captures"].as_u64(), map["ranges"]["readings"].as_u64()), (Some(0), Some(101)), "{map}");
    assert_eq!(map["digest"].as_str().unwrap(), pipeline.maps().digest());
    assert!(out.join("sonar.pgm").exists() && out.join("view.rrd").exists());
}

/// As `metromap`, but exit code 3, since two ranges had no place.
fn metromap_any(args: &[&str]) -> Value {
    let mut command = Command::new(env!("CARGO_BIN_EXE_metromap"));
    let output = command.current_dir(ROOT).args(args).stdin(Stdio::null()).output().unwrap();
    assert_eq!(output.status.code(), Some(3), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn ranges_without_odometry_are_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("lost.mcap");
    foreign(&path, false);
    let fault = Replay::open(&path, false).err().unwrap().to_string();
    assert!(fault.contains("none of them can be placed") && fault.contains("odometry"), "{fault}");
    let fault = Replay::open(&path, true).err().unwrap().to_string();
    assert!(fault.contains("/finder/capture"), "{fault}");
}

#[test]
fn a_pane_of_glass_square_to_the_beam_is_heard() {
    let scenario = Scenario::load(&Path::new(ROOT).join("worlds/compare.toml"), &[]).unwrap();
    let targets = Targets::new(&scenario.scene).unwrap();
    for (distance, yaw_deg) in [(1.0, 0.0), (1.5, 3.0), (2.0, -3.0), (2.5, 0.0), (3.0, 2.0)] {
        let mut ring = Ring::new(scenario.sonar.unwrap().noiseless(), 0).unwrap();
        let pose = Transform::planar(-5.0, -2.945 + distance, (-90.0_f64 + yaw_deg).to_radians());
        let ping = ring.fire(Stamp(0), &pose, &targets).unwrap().remove(0);
        let cause = ping.causes.first().map(|cause| targets.name(ping.echoes[*cause].body).unwrap());
        assert_eq!(cause, Some("pane"), "{distance} {:?} {:#?}", ping.reading, ping.echoes);
    }
}
