//! Recordings: through sink and replay bit for bit, cut off anywhere, damaged anywhere, and other programs' files.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use metromap::geometry::{Robot, Transform};
use metromap::image::{Capture, Drop, Dropped, Image, Line, Peak, Reading};
use metromap::maps::{MapChanges, PlanView};
use metromap::optics::Rig;
use metromap::pipeline::Step;
use metromap::points::profile;
use metromap::record::bag::{Item, Reader, Writer, recover};
use metromap::record::messages::{Message, OccupancyGrid, PointCloud2, TfMessage};
use metromap::record::{cdr, topics};
use metromap::sinks::mcap::{Images, McapSink};
use metromap::sinks::{Frame, Sink, Start};
use metromap::sources::replay::Replay;
use metromap::time::Stamp;
use proptest::prelude::*;

/// A number from 0 to 1 that looks random and is always the same.
fn noise(i: u64) -> f64 {
    let mut x = i.wrapping_add(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((x ^ (x >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

/// A capture of a robot that drives and looks round, and what became of it.
fn frame(i: u64) -> Frame {
    let rig = Rig::metro_i();
    let mut line = Line { height: 480, columns: vec![None; 512], dropped: Dropped::default() };
    for (u, column) in line.columns.iter_mut().enumerate() {
        let n = noise(i * 512 + u as u64);
        if n < 0.9 {
            let v = (250.0 + 40.0 * (u as f64 * 0.01 + i as f64).sin() + n) as f32;
            *column = Some(Peak { v, sigma: (0.05 + n * 0.1) as f32, level: (20.0 + 60.0 * n) as f32 });
        } else {
            line.dropped.add(if n < 0.95 { Drop::Dark } else { Drop::Isolated });
        }
    }
    let stamp = Stamp(1_000_000_000 + i as i64 * 166_666_667);
    let (cylinder_pulse, mirror_pulse) = ((i as i32 * 37) % 4000, (i as i32 % 60) - 10);
    let (seen, mut dropped) = profile(&rig, &line, stamp, cylinder_pulse, mirror_pulse).unwrap();
    dropped.merge(&line.dropped);
    let odom = Transform::planar(0.05 * i as f64, 0.01 * noise(i), 0.02 * i as f64);
    let world: Transform<_, Robot> = Transform::planar(0.05 * i as f64 + 0.1, 0.0, 0.02 * i as f64 + 0.001);
    let levels = (0..512 * 480).map(|p| (noise(i ^ p) * 9.0) as u8 + if p % 480 == i % 480 { 90 } else { 0 }).collect();
    let plan =
        PlanView { resolution_m: 0.05, origin_m: [-1.0, 2.0], width: 3, height: 2, cells: vec![-1, 0, 100, 50, -1, 0] };
    Frame {
        image: Some(Arc::new(Image::new(512, 480, 127, levels).unwrap())),
        truth: None,
        maps: i.is_multiple_of(6).then(|| Arc::new(MapChanges { plan: Some(plan), ..MapChanges::default() })),
        log: if i == 3 { vec![("WARN", "the third".to_string())] } else { vec![] },
        dropped: Dropped::default(),
        ranges: vec![],
        step: Some(Arc::new(Step {
            id: i,
            stamp,
            cylinder_pulse,
            mirror_pulse,
            odom_from_robot: odom,
            world_from_robot: world,
            placed: seen.moved(&world),
            seen,
            line,
            dropped,
        })),
    }
}

fn capture(frame: &Frame) -> Capture {
    let step = frame.step.as_ref().unwrap();
    Capture {
        id: step.id,
        stamp: step.stamp,
        cylinder_pulse: step.cylinder_pulse,
        mirror_pulse: step.mirror_pulse,
        odom_from_robot: step.odom_from_robot,
        reading: Reading::Line(step.line.clone()),
    }
}

/// All of a capture as text in which no two different bits look the same (no number here is NaN).
fn bits(capture: &Capture) -> String {
    format!("{capture:?}")
}

/// The bits of the first sixty captures, worked out once.
fn expected() -> &'static [String] {
    static BITS: std::sync::OnceLock<Vec<String>> = std::sync::OnceLock::new();
    BITS.get_or_init(|| (0..60).map(|i| bits(&capture(&frame(i)))).collect())
}

fn start() -> Start {
    Start {
        name: "test".into(),
        rig: Rig::metro_i(),
        has_finder: true,
        transducers: vec![],
        scene: vec![],
        attachments: vec![
            ("rig.toml".into(), "application/toml".into(), b"name = \"METRO-I\"\n".to_vec()),
            ("scenario.toml".into(), "application/toml".into(), (0..9000u32).map(|i| (i % 251) as u8).collect()),
        ],
        metadata: vec![("seed".into(), "7".into()), ("metromap_version".into(), "0.1.0".into())],
    }
}

fn record(path: &Path, images: Images, frames: impl IntoIterator<Item = Frame>) {
    let mut sink = McapSink::create(path, images).unwrap();
    sink.begin(&start()).unwrap();
    for frame in frames {
        sink.step(&frame).unwrap();
    }
    sink.finish(Stamp(0)).unwrap();
}

/// A recording of `count` captures, as bytes.
fn recorded(count: u64, images: Images) -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("recording.mcap");
    record(&path, images, (0..count).map(frame));
    std::fs::read(path).unwrap()
}

/// What can be had of a recording: captures and losses.
fn replayed(bytes: &[u8]) -> (Vec<Capture>, Dropped) {
    match Replay::new(Cursor::new(bytes), false) {
        Ok(mut replay) => {
            let captures = replay.by_ref().map(|capture| capture.unwrap()).collect();
            (captures, replay.dropped())
        }
        Err(_) => (vec![], Dropped::default()),
    }
}

fn shared(folder: &str) -> Option<PathBuf> {
    let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data")).join(folder);
    if !path.is_dir() {
        eprintln!("skipped: ../shared/data is absent");
        return None;
    }
    Some(path)
}

/// All files below a folder with this ending, in order.
fn files(folder: &Path, ending: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![folder.to_path_buf()];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|e| e == ending) {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

#[test]
fn a_recording_replays_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("recording.mcap");
    record(&path, Images::All, (0..20).map(frame));

    let mut lines = Replay::open(&path, false).unwrap();
    assert_eq!(lines.name(), "test");
    assert_eq!(lines.captures_expected(), Some(20));
    assert_eq!(lines.attachments(), start().attachments);
    assert_eq!(lines.attachment("rig.toml"), Some(&b"name = \"METRO-I\"\n"[..]));
    assert_eq!(lines.attachment("absent"), None);
    let mut metadata = lines.metadata();
    metadata.sort_by_key(|(key, _)| key != "seed");
    assert_eq!(metadata, start().metadata);
    for i in 0..20 {
        let read = lines.next_capture().unwrap().unwrap();
        assert_eq!(read, capture(&frame(i)));
        assert_eq!(bits(&read), bits(&capture(&frame(i))));
    }
    assert!(lines.next_capture().unwrap().is_none());
    assert_eq!(lines.dropped(), Dropped::default());

    let images = Replay::open(&path, true).unwrap();
    for (i, read) in images.enumerate() {
        let frame = frame(i as u64);
        let reading = Reading::Image((*frame.image.clone().unwrap()).clone());
        assert_eq!(read.unwrap(), Capture { reading, ..capture(&frame) });
    }
}

#[test]
fn keyframes_are_one_a_second_and_the_others_are_counted() {
    let bytes = recorded(20, Images::Keyframes); // six captures a second
    let mut replay = Replay::new(Cursor::new(&bytes[..]), true).unwrap();
    let ids: Vec<u64> = replay.by_ref().map(|capture| capture.unwrap().id).collect();
    assert_eq!(ids, [0, 6, 12, 18]);
    assert_eq!((replay.without_image(), replay.dropped().lost()), (16, 0));
    let none = recorded(5, Images::None);
    let fault = Replay::new(Cursor::new(&none[..]), true).err().unwrap().to_string();
    assert!(fault.contains("5 captures with lines and no images"), "{fault}");
    assert_eq!(replayed(&none).0.len(), 5);
    let empty = recorded(0, Images::All);
    let fault = Replay::new(Cursor::new(&empty[..]), false).err().unwrap().to_string();
    assert!(fault.contains("recording with no images and no lines"), "{fault}");
}

#[test]
fn other_programs_find_what_they_look_for() {
    let bytes = recorded(8, Images::Keyframes);
    let mut counts = BTreeMap::<String, u64>::new();
    let (mut last_image, mut last_topic) = (None, String::new());
    let mut reader = Reader::new(Cursor::new(&bytes[..])).unwrap();
    for item in reader.by_ref() {
        let Item::Message(message) = item.unwrap() else { continue };
        let channel = &message.channel;
        assert_eq!((channel.encoding.as_str(), message.data[1]), ("cdr", 1));
        let schema = channel.schema.as_ref().unwrap();
        assert_eq!(schema.encoding, "ros2msg");
        assert_eq!(message.sequence as u64, *counts.entry(channel.topic.clone()).and_modify(|n| *n += 1).or_default());
        match channel.topic.as_str() {
            topics::IMAGE => last_image = Some(message.log_time_ns),
            topics::CAPTURE if matches!(message.sequence, 0 | 6) => {
                assert_eq!(last_image, Some(message.log_time_ns), "the image stands before its capture");
                assert_eq!(last_topic, topics::CAMERA_INFO);
            }
            topics::TF => {
                let tree: TfMessage = cdr::decode(&message.data).unwrap();
                let edges: Vec<_> =
                    tree.transforms.iter().map(|t| (t.header.frame_id.as_str(), t.child_frame_id.as_str())).collect();
                let expected = [
                    ("map", "odom"),
                    ("odom", "base_link"),
                    ("base_link", "finder_base"),
                    ("finder_base", "finder_laser"),
                ];
                assert_eq!(edges, expected);
                let step = frame(message.sequence.into()).step.unwrap();
                let world: Transform<metromap::geometry::World, Robot> =
                    (tree.transforms[0].transform.transform::<(), ()>().iso
                        * tree.transforms[1].transform.transform::<(), ()>().iso)
                        .into();
                assert!((world.xyz() - step.world_from_robot.xyz()).norm() < 1e-12);
            }
            topics::POINTS => {
                let cloud: PointCloud2 = cdr::decode(&message.data).unwrap();
                let step = frame(message.sequence.into()).step.unwrap();
                assert_eq!((cloud.width as usize, cloud.header.frame_id.as_str()), (step.placed.points.len(), "map"));
                let x = f32::from_le_bytes(cloud.data.0[..4].try_into().unwrap());
                assert_eq!(x, step.placed.points[0].point.xyz.x as f32);
            }
            topics::MAP => {
                let grid: OccupancyGrid = cdr::decode(&message.data).unwrap();
                assert_eq!(
                    (schema.name.as_str(), grid.data.0.as_slice()),
                    (OccupancyGrid::TYPE, &[255, 0, 100, 50, 255, 0][..])
                );
                assert_eq!((grid.info.width, grid.info.height, grid.info.origin.position.y), (3, 2, 2.0));
            }
            _ => {}
        }
        last_topic = channel.topic.clone();
    }
    assert!(reader.losses().is_none());
    assert_eq!(reader.profile(), "ros2");
    let expected = [
        (topics::TF, 8),
        (topics::TF_STATIC, 1),
        (topics::ODOM, 8),
        (topics::POSE, 8),
        (topics::JOINTS, 8),
        (topics::POINTS, 8),
        (topics::SCAN, 8),
        (topics::CAMERA_INFO, 3),
        (topics::IMAGE, 2),
        (topics::CAPTURE, 8),
        (topics::MAP, 2),
        (topics::ROBOT, 1),
        (topics::LOG, 1),
    ];
    let expected: BTreeMap<String, u64> = expected.iter().map(|(topic, n)| (topic.to_string(), n - 1)).collect();
    assert_eq!(counts, expected, "the last sequence number of every topic");
}

#[test]
fn a_recording_cut_anywhere_loses_only_its_end() {
    let bytes = recorded(60, Images::None);
    let whole = expected();
    let mut before = 0;
    let dir = tempfile::tempdir().unwrap();
    for percent in (0..100).step_by(7) {
        let cut = &bytes[..bytes.len() * percent / 100];
        let (captures, dropped) = replayed(cut);
        let read: Vec<String> = captures.iter().map(bits).collect();
        assert_eq!(read, whole[..read.len()], "{percent} %");
        assert!(read.len() >= before && (read.is_empty() || dropped.lost() > 0), "{percent} %");
        before = read.len();

        let (input, output) = (dir.path().join("cut.mcap"), dir.path().join(format!("{percent}.mcap")));
        std::fs::write(&input, cut).unwrap();
        if cut.is_empty() {
            assert!(recover(&input, &output).is_err());
            continue;
        }
        let recovered = recover(&input, &output).unwrap();
        assert!(recovered.losses.cut_off && !recovered.losses.is_none());
        let saved = std::fs::read(&output).unwrap();
        let (captures, dropped) = replayed(&saved);
        assert_eq!(captures.iter().map(bits).collect::<Vec<_>>(), read, "{percent} %");
        assert_eq!(dropped.lost(), 0, "a recovered recording is whole");
        assert_eq!(std::fs::read(&input).unwrap(), cut, "the input is never changed");
        assert!(recover(&input, &output).unwrap_err().to_string().contains("exists"));
    }
    assert!(before > 50, "only {before} of 60 at 98 %");
}

#[test]
fn the_beginning_of_an_unfinished_chunk_is_saved() {
    // One chunk of some 230 kB, more than one block of zstd, cut just before its end.
    let bytes = recorded(9, Images::None);
    let (mut end, mut whole) = (0, bytes.len());
    while whole - end > 1 {
        let middle = (end + whole) / 2;
        *if replayed(&bytes[..middle]).0.len() < 9 { &mut end } else { &mut whole } = middle;
    }
    let (captures, dropped) = replayed(&bytes[..end]);
    assert!((3..9).contains(&captures.len()), "{} of 9", captures.len());
    assert_eq!(dropped.0[&Drop::Unreadable], 1);
}

#[test]
fn a_whole_recording_is_recovered_without_loss() {
    let dir = tempfile::tempdir().unwrap();
    let (input, output) = (dir.path().join("a.mcap"), dir.path().join("b.mcap"));
    record(&input, Images::Keyframes, (0..12).map(frame));
    let recovered = recover(&input, &output).unwrap();
    assert!(recovered.losses.is_none());
    assert_eq!((recovered.attachments, recovered.metadata), (2, 2));
    let items = |path: &Path| Reader::open(path).unwrap().map(|item| item.unwrap()).collect::<Vec<_>>();
    assert_eq!(items(&input), items(&output));
    let same = recover(&input, &input).unwrap_err().to_string();
    assert!(same.contains("exists"), "{same}");
}

#[test]
fn a_damaged_chunk_loses_only_itself() {
    let bytes = recorded(60, Images::None);
    let whole = expected();
    let mut damaged = bytes.clone();
    let middle = bytes.len() / 2;
    damaged[middle] ^= 0x40;
    let (captures, dropped) = replayed(&damaged);
    assert!(captures.iter().all(|c| bits(c) == whole[c.id as usize]));
    assert!(captures.len() >= 30 && captures.len() < 60, "{}", captures.len());
    assert_eq!(captures.first().map(|c| c.id), Some(0));
    assert_eq!(captures.last().map(|c| c.id), Some(59), "what follows is read");
    assert_eq!(dropped.0[&Drop::Unreadable], 60 - captures.len() as u64, "its index tells how many it held");
}

#[test]
fn a_chunk_that_looks_like_something_else_is_missed() {
    let bytes = recorded(30, Images::None);
    let chunks: Vec<usize> =
        (0..bytes.len() - 60).filter(|at| bytes[*at] == 6 && &bytes[at + 41..at + 45] == b"zstd").collect();
    assert!(chunks.len() >= 3);
    for (i, at) in chunks.iter().enumerate() {
        for kind in [0x07, 0x04, 0x02, 0x0E, 0x16, 0x86, 0x26] {
            let mut damaged = bytes.clone();
            damaged[*at] = kind;
            let (captures, dropped) = replayed(&damaged);
            let missing = 30 - captures.len() as u64;
            assert!(i == 0 || (missing > 0 && dropped.0[&Drop::Unreadable] == missing), "chunk {i} as {kind:#x}");
        }
    }
}

#[test]
fn time_that_stands_or_goes_back_is_counted_and_the_rest_replayed() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("recording.mcap");
    record(&path, Images::None, [0, 1, 2, 2, 1, 3].map(frame));
    let (captures, dropped) = replayed(&std::fs::read(&path).unwrap());
    assert_eq!(captures.iter().map(|c| c.id).collect::<Vec<_>>(), [0, 1, 2, 3]);
    assert_eq!(dropped, Dropped([(Drop::SameTime, 1), (Drop::TimeWentBack, 1)].into()));
}

#[test]
fn what_is_no_recording_of_ours_is_refused_by_name() {
    assert!(Replay::new(Cursor::new(b"no MCAP at all"), false).err().unwrap().to_string().contains("MCAP"));
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = Writer::new(&mut bytes, None, "ros2").unwrap();
    let topic = writer.topic("/other", "std_msgs/msg/String", false).unwrap();
    writer.write(topic, Stamp(5), &[0, 1, 0, 0, 1, 0, 0, 0, 0]).unwrap();
    writer.finish().unwrap();
    let fault = Replay::new(Cursor::new(bytes.get_ref().as_slice()), false).err().unwrap().to_string();
    assert!(fault.contains("/other (std_msgs/msg/String, cdr)") && fault.contains("/finder/capture"), "{fault}");

    let mut bytes = Cursor::new(Vec::new());
    let mut writer = Writer::new(&mut bytes, None, "ros2").unwrap();
    let topic = writer.topic(topics::CAPTURE, "std_msgs/msg/String", false).unwrap();
    writer.write(topic, Stamp(5), &[0, 1, 0, 0, 1, 0, 0, 0, 0]).unwrap();
    writer.finish().unwrap();
    let fault = Replay::new(Cursor::new(bytes.get_ref().as_slice()), false).err().unwrap().to_string();
    assert!(fault.contains("type of /finder/capture: found std_msgs/msg/String"), "{fault}");
}

#[test]
fn a_writer_that_failed_once_refuses_everything_after() {
    struct Full(usize);
    impl std::io::Write for Full {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0 = self.0.checked_sub(bytes.len()).ok_or_else(|| std::io::Error::other("disk full"))?;
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
    impl std::io::Seek for Full {
        fn seek(&mut self, _: std::io::SeekFrom) -> std::io::Result<u64> {
            Ok(0)
        }
    }
    let mut writer = Writer::new(Full(2000), None, "ros2").unwrap();
    let topic = writer.topic("/log", "std_msgs/msg/String", false).unwrap();
    let noise: Vec<u8> = (0..4000).map(|i| (noise(i) * 256.0) as u8).collect();
    writer.write(topic, Stamp(0), &noise).unwrap();
    let first = writer.flush().unwrap_err();
    assert!(first.to_string().contains("disk full"), "{first}");
    assert_eq!(writer.write(topic, Stamp(1), &noise).unwrap_err(), first);
    assert_eq!(writer.flush().unwrap_err(), first);
    assert_eq!(writer.finish().unwrap_err(), first);
    assert!(McapSink::create(Path::new("/absent/folder/x.mcap"), Images::None).is_err());
}

/// Not a test of its own: writes until it is killed, when the test below starts it.
#[test]
fn child_that_is_killed() {
    let Ok(path) = std::env::var("METROMAP_TEST_RECORDING") else { return };
    let mut sink = McapSink::create(Path::new(&path), Images::Keyframes).unwrap();
    sink.begin(&start()).unwrap();
    for i in 0..1_000_000 {
        sink.step(&frame(i)).unwrap();
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
}

#[test]
fn a_killed_process_leaves_a_recording() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("killed.mcap");
    let name = concat!(module_path!(), "::child_that_is_killed").split_once("::").unwrap().1;
    let mut child = std::process::Command::new(std::env::current_exe().unwrap())
        .args([name, "--exact", "--test-threads=1"])
        .env("METROMAP_TEST_RECORDING", &path)
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    // Long enough for one flush by the clock, at least; then kill -9.
    let began = std::time::Instant::now();
    let read = || std::fs::read(&path).map(|bytes| replayed(&bytes).0.len()).unwrap_or(0);
    while read() == 0 && began.elapsed().as_secs() < 60 {
        std::thread::sleep(std::time::Duration::from_millis(200));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let (captures, dropped) = replayed(&std::fs::read(&path).unwrap());
    assert!(captures.len() > 1);
    assert_eq!(dropped.0[&Drop::Unreadable], 1, "the end is missing");
    for (i, read) in captures.iter().enumerate() {
        assert_eq!(*read, capture(&frame(i as u64)));
    }
    let replay = Replay::open(&path, true).unwrap();
    assert_eq!(replay.attachments(), start().attachments);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn cut_at_any_byte_it_is_a_prefix(at in 0.0..1.0f64) {
        thread_local!(static BYTES: Vec<u8> = recorded(30, Images::Keyframes));
        BYTES.with(|bytes| {
            let cut = &bytes[..(bytes.len() as f64 * at) as usize];
            for (i, read) in replayed(cut).0.iter().enumerate() {
                prop_assert_eq!(&bits(read), &expected()[i]);
            }
            Ok(())
        })?;
    }

    #[test]
    fn with_any_bits_flipped_what_is_read_is_right(flips in prop::collection::vec((0.0..1.0f64, 0u8..8), 1..6)) {
        thread_local!(static BYTES: Vec<u8> = recorded(30, Images::None));
        let mut damaged = BYTES.with(Vec::clone);
        for (at, bit) in &flips {
            let at = (damaged.len() as f64 * at) as usize;
            damaged[at] ^= 1 << bit;
        }
        let (captures, _) = replayed(&damaged);
        for read in &captures {
            prop_assert_eq!(&bits(read), &expected()[read.id as usize]);
        }
        // A flip costs at most the chunk it is in; with the first chunk, the topics stand in the summary again.
        prop_assert!(captures.len() + 14 * flips.len() >= 30 || flips.len() > 2, "{} left of 30 after {:?}", captures.len(), flips);
    }

    #[test]
    fn no_loss_goes_uncounted(at in 0.0..1.0f64, bit in 0u8..8) {
        thread_local!(static BYTES: Vec<u8> = recorded(12, Images::None));
        let mut damaged = BYTES.with(Vec::clone);
        let at = (damaged.len() as f64 * at) as usize;
        damaged[at] ^= 1 << bit;
        let (captures, dropped) = replayed(&damaged);
        prop_assert!(captures.len() == 12 || captures.is_empty() || dropped.lost() > 0, "bit {bit} of byte {at}");
    }

    #[test]
    fn no_file_makes_the_reader_panic(body in prop::collection::vec(any::<u8>(), 0..600)) {
        let bytes = [&b"\x89MCAP0\r\n"[..], &body].concat();
        let mut reader = Reader::new(Cursor::new(&bytes[..])).unwrap();
        prop_assert!(reader.by_ref().all(|item| item.is_ok()));
        prop_assert!(reader.losses().cut_off);
    }
}

/// The `fields` of a record in the conformance suite's JSON.
fn field<'a>(record: &'a serde_json::Value, name: &str) -> &'a serde_json::Value {
    let fields = record["fields"].as_array().unwrap();
    &fields.iter().find(|pair| pair[0] == name).unwrap()[1]
}

#[test]
fn the_official_files_are_read_as_their_json_says() {
    let Some(folder) = shared("mcap_conformance") else { return };
    let all = files(&folder, "mcap");
    assert_eq!(all.len(), 416);
    for path in all {
        let json: serde_json::Value =
            serde_json::from_slice(&std::fs::read(path.with_extension("json")).unwrap()).unwrap();
        let number = |value: &serde_json::Value| value.as_str().unwrap().parse::<u64>().unwrap();
        let bytes = |value: &serde_json::Value| -> Vec<u8> {
            value.as_array().unwrap().iter().map(|byte| number(byte) as u8).collect()
        };
        let mut expected = Vec::new();
        for record in json["records"].as_array().unwrap() {
            expected.push(match record["type"].as_str().unwrap() {
                "Message" => format!(
                    "message {} {} {} {:?}",
                    number(field(record, "sequence")),
                    number(field(record, "log_time")),
                    number(field(record, "publish_time")),
                    bytes(field(record, "data"))
                ),
                "Attachment" => format!(
                    "attachment {} {} {:?}",
                    field(record, "name").as_str().unwrap(),
                    number(field(record, "log_time")),
                    bytes(field(record, "data"))
                ),
                "Metadata" => {
                    format!("metadata {} {}", field(record, "name").as_str().unwrap(), field(record, "metadata"))
                }
                _ => continue,
            });
        }
        let mut reader = Reader::open(&path).unwrap();
        let found: Vec<String> = reader
            .by_ref()
            .map(|item| match item.unwrap() {
                Item::Message(m) => {
                    assert_eq!(m.channel.topic, "example", "{}", path.display());
                    format!("message {} {} {} {:?}", m.sequence, m.log_time_ns, m.publish_time_ns, m.data)
                }
                Item::Attachment(a) => format!("attachment {} {} {:?}", a.name, a.log_time_ns, a.data),
                Item::Metadata(m) => format!("metadata {} {}", m.name, serde_json::to_string(&m.entries).unwrap()),
            })
            .collect();
        assert_eq!(found, expected, "{}", path.display());
        assert!(reader.losses().is_none(), "{}: {:?}", path.display(), reader.losses());
        let fault = Replay::open(&path, false).err().unwrap().to_string();
        assert!(fault.contains("topics: found"), "{fault}");
    }
}

#[test]
fn the_bags_of_ros_2_are_read_with_all_their_messages() {
    let Some(folder) = shared("mcap_rosbag2") else { return };
    let mut bags = 0;
    for yaml in files(&folder, "yaml") {
        let text = std::fs::read_to_string(&yaml).unwrap();
        let of_key = |key: &str| -> Vec<String> {
            text.lines()
                .filter_map(|line| line.trim().strip_prefix(key))
                .map(|value| value.trim().to_string())
                .collect()
        };
        let mut counts = of_key("message_count:").into_iter().map(|count| count.parse::<u64>().unwrap());
        // The total of the bag comes with the topics or after them: it is the sum of the others.
        let counts: Vec<u64> = counts.by_ref().collect();
        let total = counts.iter().copied().max().unwrap_or(0);
        let mut read = 0;
        for path in files(yaml.parent().unwrap(), "mcap") {
            let mut reader = Reader::open(&path).unwrap();
            read += reader.by_ref().filter(|item| matches!(item.as_ref().unwrap(), Item::Message(_))).count() as u64;
            assert!(reader.losses().is_none(), "{}: {:?}", path.display(), reader.losses());
        }
        assert_eq!(read, total, "{}", yaml.display());
        bags += 1;
    }
    assert_eq!(bags, 10);
    for path in files(&folder, "mcap") {
        let fault = Replay::open(&path, false).err().unwrap().to_string();
        let wrong = path.display().to_string().contains("wrong_rmw");
        assert_eq!(fault.contains("wrong_format"), wrong, "{fault}");
        assert!(fault.contains("/finder/capture"), "{fault}");
    }
}
