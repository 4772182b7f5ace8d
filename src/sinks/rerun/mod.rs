//! The sink that draws: Rerun, as a file, to a viewer that runs already, or to the embedded web viewer.
//!
//! Files hold no wall-clock time: every row is on `sim_time` and `scan`. What is drawn where:
//!
//! ```text
//! /world/scene/NAME          the true bodies (simulation only)
//! /world/robot/...           body, finder with camera frustum, sheet of laser light
//! /world/profile             the points of this capture
//! /world/points              the points up to now, thinned, coloured by height
//! /world/occupancy/I_J_K     occupied voxels of a block, coloured by height
//! /world/terrain/I_J         a tile of the terrain mesh, coloured by height
//! /path/{estimated,true}     where the robot went
//! /world/sonar/FRAME         the last range of each ultrasonic transducer
//! /world/echoes              where each echo truly came from (simulation), else where it seems to
//! /plan                      the plan view
//! /plan_ultrasonic, /plan_fused  the ultrasonic layer, and both together
//! /camera/image, image/line  the capture and the line found in it
//! /metrics/..., /log, /about
//! ```

mod blueprint;
mod draw;
mod maps;
mod scene;
mod serve;
mod sonar;

use std::path::{Path, PathBuf};
use std::time::Duration;

use nalgebra::Vector3;
use rerun::external::re_uri::ProxyUri;
use rerun::log::ChunkBatcherConfig;
use rerun::sink::{FileSink, FileSinkError, GrpcSink, LogSink};
use rerun::{AsComponents, EntityPath, EntityPathPart, RecordingStream, RecordingStreamBuilder, TimeCell};
use sha2::{Digest, Sha256};

use self::draw::{Drawing, HeightColours};
use self::serve::Web;
use super::{Frame, Sink, Start};
use crate::fault::{Fault, Result};
use crate::time::Stamp;

pub use self::serve::{FileServer, check_file};

/// The name under which viewers keep the layout.
const APPLICATION: &str = "metromap";

/// Stamps beyond this are since the Unix epoch (2001), not since the start of a run.
const EPOCH_NS_MIN: i64 = 1_000_000_000_000_000_000;

/// How long to wait for a viewer to take what is left.
const FLUSH_S_MAX: u64 = 60;

/// A file gets what was drawn at least this often, so that a killed run loses no more.
const FILE_FLUSH_S: u64 = 5;

/// A file gets what was drawn whenever it is this much.
const FILE_FLUSH_BYTES: u64 = 8 << 20;

/// Where the drawing goes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Target {
    /// To an `.rrd` file.
    Save(PathBuf),
    /// To a viewer or server that listens at `rerun+http://HOST:PORT/proxy`.
    Connect(String),
    /// To the embedded web viewer, served on 127.0.0.1.
    Web {
        /// Port of the page; 0 takes a free one.
        port: u16,
    },
}

/// Draws every step for Rerun.
pub struct RerunSink {
    sinks: Vec<Box<dyn LogSink>>,
    files: Vec<PathBuf>,
    live: bool,
    web: Option<Web>,
    run: Option<Run>,
}

/// What exists between `begin` and `finish`.
struct Run {
    out: Out,
    drawing: Drawing,
    begun: bool,
}

/// A recording stream whose errors name the entity.
struct Out(RecordingStream);

impl Out {
    fn log(&self, entity: impl Into<EntityPath>, what: &dyn AsComponents) -> Result<()> {
        let entity = entity.into();
        self.0.log(entity.clone(), what).map_err(|e| refused(&entity, &e))
    }

    fn log_static(&self, entity: impl Into<EntityPath>, what: &dyn AsComponents) -> Result<()> {
        let entity = entity.into();
        self.0.log_static(entity.clone(), what).map_err(|e| refused(&entity, &e))
    }
}

fn refused(entity: &EntityPath, error: &dyn std::fmt::Display) -> Fault {
    Fault::new(format!("drawing {entity}"), error, "data the viewer takes")
}

/// An entity path of parts that may hold any character.
fn entity(parts: &[&str]) -> EntityPath {
    EntityPath::new(parts.iter().map(|part| EntityPathPart::new(*part)).collect())
}

/// The viewer works in single precision.
fn f32s(v: &Vector3<f64>) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

impl RerunSink {
    /// Opens the targets; several at once are fine, and all get the same.
    ///
    /// Errors: a file that cannot be created, a malformed or silent URL, a port that is taken.
    pub fn new(targets: &[Target]) -> Result<Self> {
        let mut this = Self { sinks: vec![], files: vec![], live: false, web: None, run: None };
        for target in targets {
            match target {
                Target::Save(file) => {
                    this.sinks.push(Box::new(FileSink::new(file).map_err(|e| cannot_create(file, e))?));
                    this.files.push(file.clone());
                }
                Target::Connect(url) => {
                    this.sinks.push(Box::new(connect(url)?));
                    this.live = true;
                }
                Target::Web { port } => {
                    let (web, sink) = Web::start(*port)?;
                    this.sinks.push(Box::new(sink));
                    this.web = Some(web);
                    this.live = true;
                }
            }
        }
        Ok(this)
    }

    /// Where to point a browser, if there is a web target. The page is served until the sink is dropped.
    pub fn url(&self) -> Option<&str> {
        self.web.as_ref().map(Web::url)
    }
}

impl Sink for RerunSink {
    fn begin(&mut self, start: &Start) -> Result<()> {
        let rejected = |e: rerun::RecordingStreamError| Fault::new("viewer", e, "a working Rerun stream");
        let mut builder = RecordingStreamBuilder::new(APPLICATION).enabled(true);
        if !self.live {
            // A live viewer would mix two runs under one id; a file of the same run is always the same recording.
            // Few large chunks load far faster than many small ones, and nobody is waiting for them.
            let config = ChunkBatcherConfig {
                flush_tick: Duration::from_secs(FILE_FLUSH_S),
                flush_num_bytes: FILE_FLUSH_BYTES,
                ..ChunkBatcherConfig::DEFAULT
            };
            builder = builder.recording_id(recording_id(start)).batcher_config(config);
        }
        let stream = builder.send_properties(false).set_sinks(std::mem::take(&mut self.sinks)).map_err(rejected)?;
        stream.set_log_tick_enabled(false);
        stream.set_log_time_enabled(false);
        stream.send_recording_name(start.name.clone()).map_err(rejected)?;
        let out = Out(stream);
        let colours = HeightColours::new(start.rig.range_m_max);
        scene::draw_start(&out, start, &colours)?;
        self.run = Some(Run { out, drawing: Drawing::new(start, colours), begun: false });
        Ok(())
    }

    fn step(&mut self, frame: &Frame) -> Result<()> {
        let Some(run) = self.run.as_mut() else {
            return Err(Fault::new("drawing a step", "no begin before it", "begin, step, finish"));
        };
        for ranged in &frame.ranges {
            run.out.0.set_time("sim_time", time_cell(ranged.step.reading.stamp.0));
            sonar::draw(&run.out, ranged)?;
        }
        run.out.0.set_time("sim_time", time_cell(frame.stamp().0));
        if let Some(step) = &frame.step {
            run.out.0.set_time("scan", TimeCell::from_sequence(i64::try_from(step.id).unwrap_or(i64::MAX)));
        }
        let new_sensor = run.drawing.note_sensors(frame);
        if !run.begun || new_sensor {
            run.begun = true;
            run.drawing.send_blueprint(&run.out)?;
        }
        run.drawing.step(&run.out, frame)
    }

    fn finish(&mut self, _at: Stamp) -> Result<()> {
        let Some(run) = self.run.as_mut() else { return Ok(()) };
        if !self.live {
            // Now it is known what there is to frame; a live viewer keeps the eye its user has turned by then.
            run.drawing.send_blueprint(&run.out)?;
        }
        let unfinished = |e: rerun::sink::SinkFlushError| {
            let what = self.files.first().map_or("viewer".into(), |file| file.display().to_string());
            Fault::new(what, e, "room on the disk, and a viewer that still listens")
        };
        run.out.0.flush_with_timeout(Duration::from_secs(FLUSH_S_MAX)).map_err(unfinished)?;
        run.out.0.finalize_deferred_sinks();
        self.files.iter().try_for_each(|file| check_file(file))
    }
}

/// A stamp in the viewer: of a run, or of the world's clock.
fn time_cell(at_ns: i64) -> TimeCell {
    if at_ns < EPOCH_NS_MIN {
        TimeCell::from_duration_nanos(at_ns)
    } else {
        TimeCell::from_timestamp_nanos_since_epoch(at_ns)
    }
}

/// The same run has the same id, whenever and wherever it is drawn.
fn recording_id(start: &Start) -> String {
    let mut hash = Sha256::new();
    hash.update(start.name.as_bytes());
    for (key, value) in &start.metadata {
        hash.update(format!("\n{key}={value}"));
    }
    for (name, _, bytes) in &start.attachments {
        hash.update(format!("\n{name}:{}:", bytes.len()));
        hash.update(bytes);
    }
    hash.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect()
}

fn cannot_create(file: &Path, error: FileSinkError) -> Fault {
    match error {
        FileSinkError::CreateFile { source, .. } => Fault::io(file, &source),
        other => Fault::new("file", other, "a file that can be written").in_file(file),
    }
}

/// A sink to a running viewer. It is asked once whether it is there, since Rerun itself would go on trying for ever.
fn connect(url: &str) -> Result<GrpcSink> {
    let expected = "rerun+http://HOST:PORT/proxy";
    let uri: ProxyUri = url.parse().map_err(|_| Fault::new("--connect", url, expected))?;
    let (host, port) = (uri.origin.host.to_string(), uri.origin.port);
    let host = host.trim_start_matches('[').trim_end_matches(']');
    let addresses = std::net::ToSocketAddrs::to_socket_addrs(&(host, port));
    let addresses = addresses.map_err(|e| Fault::new("--connect", format!("{url} ({e})"), expected))?;
    let mut error = "no address".to_string();
    for address in addresses {
        match std::net::TcpStream::connect_timeout(&address, Duration::from_secs(3)) {
            Ok(_) => return Ok(GrpcSink::new(uri)),
            Err(e) => error = e.to_string(),
        }
    }
    Err(Fault::new("--connect", format!("{url} ({error})"), "a viewer that listens there"))
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};
    use std::io::BufReader;
    use std::sync::Arc;

    use rerun::StoreKind;
    use rerun::external::re_log_encoding::rrd::DecoderApp;
    use rerun::log::{Chunk, LogMsg};

    use super::*;
    use crate::geometry::{Robot, Transform, World};
    use crate::image::{Dropped, Image, Line, Peak};
    use crate::maps::{MapChanges, PlanView, TerrainMesh};
    use crate::optics::{Laser, PlaneLaser, Rig};
    use crate::pipeline::Step;
    use crate::points::profile;
    use crate::sinks::Truth;
    use crate::world::Mesh;

    fn start() -> Start {
        let corner = |x: f64, y: f64| Vector3::new(x, y, 0.0);
        let vertices = vec![corner(-2.0, -2.0), corner(2.0, -2.0), corner(0.0, 2.0)];
        let mesh = Arc::new(Mesh { vertices, triangles: vec![[0, 1, 2], [0, 1, 77]] });
        Start {
            name: "a name / with marks".into(),
            rig: Rig::metro_i(),
            has_finder: true,
            transducers: vec![],
            scene: vec![
                ("box/1 \u{fc}".into(), [200, 100, 50], mesh),
                ("empty".into(), [0; 3], Arc::new(Mesh::default())),
            ],
            attachments: vec![],
            metadata: vec![("seed".into(), "1".into())],
        }
    }

    fn frame(start: &Start, id: u64) -> Frame {
        let peak = Peak { v: 250.0, sigma: 0.1, level: 50.0 };
        let line = Line { height: 480, columns: vec![Some(peak); 512], dropped: Dropped::default() };
        let stamp = Stamp(id as i64 * 100_000_000);
        let (seen, dropped) = profile(&start.rig, &line, stamp, 0, 0).unwrap();
        let world_from_robot = Transform::<World, Robot>::planar(0.1 * id as f64, 0.0, 0.2);
        let tile =
            TerrainMesh { vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.1]], triangles: vec![[0, 1, 2]] };
        let plan =
            PlanView { resolution_m: 0.1, origin_m: [0.0; 2], width: 2, height: 3, cells: vec![-1, 0, 100, 0, 0, -1] };
        let maps = MapChanges {
            voxel_m: 0.05,
            blocks: vec![([0, -1, 2], vec![[0.1, 0.2, 0.3]]), ([5, 5, 5], vec![])],
            tiles: vec![([0, -3], tile), ([1, 1], TerrainMesh::default())],
            plan: Some(plan),
            layers: None,
        };
        let moved = vec![(0, nalgebra::Isometry3::translation(0.1, 0.0, 0.0)), (99, nalgebra::Isometry3::identity())];
        let step = Step {
            id,
            stamp,
            cylinder_pulse: 0,
            mirror_pulse: 0,
            odom_from_robot: world_from_robot.iso.into(),
            world_from_robot,
            placed: seen.moved(&world_from_robot),
            line,
            seen,
            dropped,
        };
        Frame {
            ranges: vec![],
            step: Some(Arc::new(step)),
            image: (id != 1).then(|| Arc::new(Image::new(512, 480, 127, vec![3; 512 * 480]).unwrap())),
            truth: Some(Truth { world_from_robot, moved, point_rms_m: Some(0.004) }),
            maps: (id == 2).then(|| Arc::new(maps)),
            log: vec![("WARN", "something".into())],
            dropped: Dropped::default(),
        }
    }

    fn record(start: &Start, file: &Path) {
        let mut sink = RerunSink::new(&[Target::Save(file.into())]).unwrap();
        sink.begin(start).unwrap();
        for id in 0..3 {
            sink.step(&frame(start, id)).unwrap();
        }
        sink.finish(Stamp(0)).unwrap();
    }

    /// Rows of every entity, the timelines used, and the name of the recording.
    fn read(file: &Path) -> (BTreeMap<String, usize>, BTreeSet<String>, String) {
        let (mut rows, mut timelines, mut id) = (BTreeMap::new(), BTreeSet::new(), String::new());
        for message in DecoderApp::decode_lazy(BufReader::new(std::fs::File::open(file).unwrap())) {
            let LogMsg::ArrowMsg(store, arrow) = message.unwrap() else { continue };
            let chunk = Chunk::from_arrow_msg(&arrow).unwrap();
            let layout = if store.kind() == StoreKind::Blueprint { "layout:" } else { "" };
            *rows.entry(format!("{layout}{}", chunk.entity_path())).or_insert(0) += chunk.num_rows();
            timelines.extend(chunk.timelines().keys().map(|name| format!("{layout}{name}")));
            id = store.recording_id().to_string();
        }
        (rows, timelines, id)
    }

    #[test]
    fn a_file_holds_every_entity_on_the_runs_own_time() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("view.rrd");
        record(&start(), &file);
        assert_eq!(check_file(&file), Ok(()));
        let (rows, timelines, _) = read(&file);
        assert_eq!(timelines.iter().map(String::as_str).collect::<Vec<_>>(), ["layout:blueprint", "scan", "sim_time"]);
        let expected = [
            ("/world/robot", 3),
            ("/world/robot/body", 1),
            ("/world/robot/finder", 3),
            ("/world/robot/laser", 3),
            ("/world/profile", 3),
            ("/world/points", 3),
            ("/world/occupancy/0_-1_2", 1),
            ("/world/occupancy/5_5_5", 1),
            ("/world/terrain/0_-3", 1),
            ("/path/estimated", 2),
            ("/path/true", 2),
            ("/plan", 1),
            ("/camera/image", 3), // two images, and one cleared in between
            ("/camera/image/line", 3),
            ("/log", 3),
            ("/about", 1),
            ("layout:/viewport", 2),
        ];
        for (entity, count) in expected {
            assert_eq!(rows.get(entity), Some(&count), "{entity} in {rows:?}");
        }
        for name in ["point_rms_mm", "pose_error_mm", "points", "dropped", "lost"] {
            assert_eq!(rows.get(&format!("/metrics/{name}")), Some(&4), "{name}: its label and three values");
        }
        let body = entity(&["world", "scene", "box/1 \u{fc}"]).to_string();
        assert_eq!(rows.get(&body), Some(&2), "{body}: the mesh, and one move: the next is the same");
        let views = rows.keys().filter(|key| key.starts_with("layout:/view/") && key.ends_with("/ViewContents"));
        assert_eq!(views.count(), 9, "{rows:?}");
    }

    /// A frame with ranges alone: one by a straight echo, one by a ghost, one silent, one without truth.
    fn ranges(at_ms: i64) -> Frame {
        use crate::ranges::{RangeReading, transducer_frame};
        use crate::sonar::{Aim, Echo, EchoKind, Ping, Reading};
        let ranged = |number: usize, range_m: Option<f32>, surfaces: Option<u8>| {
            let stamp = Stamp(at_ms * 1_000_000 + number as i64);
            let reading = RangeReading {
                stamp,
                frame: transducer_frame(number),
                robot_from_transducer: Transform::identity(),
                field_of_view_rad: 0.5,
                range_m_min: 0.4,
                range_m_max: 10.0,
                range_m,
                odom_from_robot: Transform::identity(),
            };
            let aim = Aim { at: crate::geometry::Point::new(0.0, 0.0, 0.4), axis: Vector3::x() };
            let echo = |surfaces| Echo {
                range_m: 2.0,
                way_m: 4.0,
                level_db: -10.0,
                margin_db: 20.0,
                kind: EchoKind::Wall,
                body: 0,
                place: crate::geometry::Point::new(2.0, 0.1, 0.4),
                surfaces,
                source: number,
                late: false,
            };
            let ping = surfaces.map(|surfaces| Ping {
                reading: Reading { stamp, transducer: number, ranges_m: vec![2.0] },
                echoes: vec![echo(surfaces)],
                causes: vec![0],
                aim,
            });
            let step = crate::pipeline::RangeStep {
                reading,
                world_from_robot: Transform::identity(),
                world_from_transducer: Transform::identity(),
                dropped: Dropped::default(),
            };
            crate::sinks::Ranged { step, ping }
        };
        let ranges = vec![
            ranged(0, Some(2.0), Some(1)),
            ranged(1, Some(2.0), Some(3)),
            ranged(2, None, None),
            ranged(3, Some(1.0), None),
        ];
        let plan = PlanView { resolution_m: 0.1, origin_m: [0.0; 2], width: 2, height: 1, cells: vec![0, 100] };
        let layers = crate::maps::Layers { laser: plan.clone(), ultrasonic: plan.clone(), fused: plan };
        let maps = MapChanges { layers: Some(layers), ..MapChanges::default() };
        let (log, dropped) = (vec![], Dropped::default());
        Frame { ranges, step: None, image: None, truth: None, maps: Some(Arc::new(maps)), log, dropped }
    }

    #[test]
    fn both_sensors_stand_side_by_side() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("view.rrd");
        let start = start();
        let mut sink = RerunSink::new(&[Target::Save(file.clone())]).unwrap();
        sink.begin(&start).unwrap();
        sink.step(&frame(&start, 0)).unwrap();
        sink.step(&ranges(150)).unwrap();
        sink.step(&frame(&start, 2)).unwrap();
        sink.finish(Stamp(0)).unwrap();
        let (rows, _, _) = read(&file);
        for number in 0..4 {
            assert_eq!(rows.get(&format!("/world/sonar/sonar_0{number}")), Some(&1), "{rows:?}");
        }
        for (entity, count) in
            [("/world/echoes", 3), ("/plan_ultrasonic", 1), ("/plan_fused", 1), ("/world/profile", 2)]
        {
            assert_eq!(rows.get(entity), Some(&count), "{entity} in {rows:?}");
        }
    }

    #[test]
    fn the_same_run_is_the_same_recording_and_another_seed_is_another() {
        let folder = tempfile::tempdir().unwrap();
        let [a, b, c] = ["a", "b", "c"].map(|name| folder.path().join(format!("{name}.rrd")));
        record(&start(), &a);
        record(&start(), &b);
        record(&Start { metadata: vec![("seed".into(), "2".into())], ..start() }, &c);
        let [a, b, c] = [a, b, c].map(|file| read(&file).2);
        assert_eq!(a, b);
        assert_ne!(a, c);
    }

    #[test]
    fn a_finder_with_a_fixed_plane_and_no_scene_is_drawn_without_a_robot() {
        let laser = Laser::Plane(PlaneLaser { normal: [0.0, 1.0, 0.2], offset_m: 0.2, origin_m: None });
        let start = Start { rig: Rig { laser, ..Rig::metro_i() }, scene: vec![], ..start() };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("view.rrd");
        record(&start, &file);
        let (rows, _, _) = read(&file);
        assert!(!rows.contains_key("/world/robot/body"), "{rows:?}");
        assert!(rows.contains_key("/world/robot/finder/camera"), "{rows:?}");
    }

    #[test]
    fn a_cut_or_damaged_file_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("view.rrd");
        record(&start(), &file);
        let whole = std::fs::read(&file).unwrap();
        for cut in [10, whole.len() / 2, whole.len() - 1] {
            std::fs::write(&file, &whole[..cut]).unwrap();
            assert!(check_file(&file).unwrap_err().to_string().contains("cut off"), "{cut}");
        }
        let mut damaged = whole.clone();
        damaged[60..100].fill(0xff);
        std::fs::write(&file, &damaged).unwrap();
        assert!(check_file(&file).is_err());
    }

    #[test]
    fn targets_that_do_not_work_are_named() {
        let fault = RerunSink::new(&[Target::Save("/nowhere/at/all.rrd".into())]).err().unwrap();
        assert_eq!(fault.file.as_deref(), Some("/nowhere/at/all.rrd"));
        let fault = RerunSink::new(&[Target::Connect("http:/nonsense".into())]).err().unwrap();
        assert!(fault.found.contains("http:/nonsense"), "{fault}");
        let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let url = format!("rerun+http://{free}/proxy");
        let fault = RerunSink::new(&[Target::Connect(url.clone())]).err().unwrap();
        assert!(fault.found.contains(&url) && fault.expected.contains("listens"), "{fault}");
        let mut unbegun = RerunSink::new(&[]).unwrap();
        assert!(unbegun.step(&frame(&start(), 0)).is_err());
        assert_eq!(unbegun.finish(Stamp(0)), Ok(()));
    }

    #[test]
    fn a_live_viewer_and_a_file_get_the_same_run() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("view.rrd");
        let mut sink = RerunSink::new(&[Target::Save(file.clone()), Target::Web { port: 0 }]).unwrap();
        let url = sink.url().unwrap().to_string();
        assert!(
            url.starts_with("http://127.0.0.1:") && url.contains("?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A"),
            "{url}"
        );
        let start = start();
        sink.begin(&start).unwrap();
        sink.step(&frame(&start, 0)).unwrap();
        sink.finish(Stamp(0)).unwrap();
        assert_eq!(read(&file).0.get("/world/robot"), Some(&1));
        // The page outlives the run, for as long as the sink is there.
        let page = url.split("/?").next().unwrap().trim_start_matches("http://");
        assert!(std::net::TcpStream::connect(page).is_ok());
    }
}
