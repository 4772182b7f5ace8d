//! Recordings: everything a run shows and all that maps it again, as MCAP for Rerun, Foxglove and ROS 2.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use super::{Frame, Sink, Start};
use crate::fault::{Fault, Result};
use crate::geometry::{Odom, Robot, Transducer, Transform};
use crate::image::{Capture, Reading};
use crate::maps::MapChanges;
use crate::optics::Rig;
use crate::pipeline::{RangeStep, Step};
use crate::record::bag::{Attachment, Metadata, Topic, Writer};
use crate::record::messages::{
    CameraInfo, CaptureMessage, CompressedImage, JointState, LaserScan, Log, Message, OccupancyGrid, Odometry,
    PointCloud2, PoseStamped, Range, Text, TfMessage,
};
use crate::record::{METADATA_RECORDING, METADATA_START, build, cdr, png, topics};
use crate::time::{Span, Stamp};

/// Which images are recorded; the line of every capture always is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Images {
    /// None.
    None,
    /// One a second of run time.
    #[default]
    Keyframes,
    /// All: the recording can be mapped from its images too.
    All,
}

/// Run time from one keyframe to the next.
const KEYFRAME_EVERY: Span = Span(1_000_000_000);

/// Writes a recording.
pub struct McapSink {
    path: PathBuf,
    images: Images,
    state: State,
}

enum State {
    /// The file is there, and empty.
    Created(Box<Writer<BufWriter<File>>>),
    Open(Box<Recording>),
    Closed,
}

impl McapSink {
    /// Starts a recording at `path`; one that stands there is replaced.
    ///
    /// Errors: a file that cannot be written.
    pub fn create(path: &Path, images: Images) -> Result<Self> {
        let writer = Writer::create(path)?;
        Ok(Self { path: path.to_path_buf(), images, state: State::Created(Box::new(writer)) })
    }
}

impl Sink for McapSink {
    fn begin(&mut self, start: &Start) -> Result<()> {
        let State::Created(writer) = std::mem::replace(&mut self.state, State::Closed) else {
            return Err(Fault::new("recording", "a second start", "one start").in_file(&self.path));
        };
        let open = Recording::begin(*writer, self.images, start).map_err(|fault| fault.in_file(&self.path))?;
        self.state = State::Open(Box::new(open));
        Ok(())
    }

    fn step(&mut self, frame: &Frame) -> Result<()> {
        let State::Open(open) = &mut self.state else {
            return Err(Fault::new("recording", "a step before its start or after its end", "start, steps, end"));
        };
        open.step(frame).map_err(|fault| fault.in_file(&self.path))
    }

    fn finish(&mut self, _at: Stamp) -> Result<()> {
        let finished = match std::mem::replace(&mut self.state, State::Closed) {
            State::Created(writer) => writer.finish(),
            State::Open(open) => open.writer.finish(),
            State::Closed => Ok(()),
        };
        finished.map_err(|fault| fault.in_file(&self.path))
    }
}

/// The topics of a recording that has begun.
struct Topics {
    tf: Topic,
    tf_static: Topic,
    odom: Topic,
    pose: Topic,
    joints: Topic,
    points: Topic,
    scan: Topic,
    camera_info: Topic,
    image: Topic,
    capture: Topic,
    map: Topic,
    ranges: BTreeMap<String, Topic>,
    /// The ultrasonic layer and the fused one; only where there are transducers.
    layers: Option<[Topic; 2]>,
    robot: Topic,
    log: Topic,
}

impl Topics {
    fn of<M: Message>(writer: &mut Writer<BufWriter<File>>, topic: &str, latched: bool) -> Result<Topic> {
        writer.topic(topic, M::TYPE, latched)
    }

    fn new(writer: &mut Writer<BufWriter<File>>, start: &Start) -> Result<Self> {
        let mut ranges = BTreeMap::new();
        for (frame, _) in &start.transducers {
            ranges.insert(frame.clone(), Self::of::<Range>(writer, &topics::range(frame), false)?);
        }
        let layers = if ranges.is_empty() {
            None
        } else {
            let ultrasonic = Self::of::<OccupancyGrid>(writer, topics::MAP_ULTRASONIC, true)?;
            Some([ultrasonic, Self::of::<OccupancyGrid>(writer, topics::MAP_FUSED, true)?])
        };
        Ok(Self {
            ranges,
            layers,
            tf: Self::of::<TfMessage>(writer, topics::TF, false)?,
            tf_static: Self::of::<TfMessage>(writer, topics::TF_STATIC, true)?,
            odom: Self::of::<Odometry>(writer, topics::ODOM, false)?,
            pose: Self::of::<PoseStamped>(writer, topics::POSE, false)?,
            joints: Self::of::<JointState>(writer, topics::JOINTS, false)?,
            points: Self::of::<PointCloud2>(writer, topics::POINTS, false)?,
            scan: Self::of::<LaserScan>(writer, topics::SCAN, false)?,
            camera_info: Self::of::<CameraInfo>(writer, topics::CAMERA_INFO, false)?,
            image: Self::of::<CompressedImage>(writer, topics::IMAGE, false)?,
            capture: Self::of::<CaptureMessage>(writer, topics::CAPTURE, false)?,
            map: Self::of::<OccupancyGrid>(writer, topics::MAP, true)?,
            robot: Self::of::<Text>(writer, topics::ROBOT, true)?,
            log: Self::of::<Log>(writer, topics::LOG, false)?,
        })
    }
}

/// A recording that has begun.
struct Recording {
    writer: Writer<BufWriter<File>>,
    topics: Topics,
    rig: Rig,
    transducers: Vec<(String, Transform<Robot, Transducer>)>,
    images: Images,
    /// From when on the next image is a keyframe.
    keyframe_from: Option<Stamp>,
    odom_before: Option<(Stamp, Transform<Odom, Robot>)>,
    /// Messages that stand only once were written; they wait for the first stamp.
    introduced: bool,
}

impl Recording {
    fn begin(mut writer: Writer<BufWriter<File>>, images: Images, start: &Start) -> Result<Self> {
        // First of all, so that a file that is cut off anywhere still has them.
        for (name, media_type, data) in &start.attachments {
            let (name, media_type, data) = (name.clone(), media_type.clone(), data.clone());
            writer.attach(&Attachment { name, media_type, log_time_ns: 0, create_time_ns: 0, data })?;
        }
        let mut entries = BTreeMap::new();
        for (key, value) in &start.metadata {
            if entries.insert(key.clone(), value.clone()).is_some() {
                return Err(Fault::new("metadata", format!("{key} twice"), "every key once"));
            }
        }
        writer.metadata(&Metadata { name: METADATA_START.into(), entries })?;
        let entries = [("name".to_string(), start.name.clone())].into();
        writer.metadata(&Metadata { name: METADATA_RECORDING.into(), entries })?;
        let topics = Topics::new(&mut writer, start)?;
        // Schemas and topics get a chunk of their own: damage to the first messages does not take them along.
        writer.flush()?;
        Ok(Self {
            writer,
            topics,
            rig: start.rig.clone(),
            transducers: start.transducers.clone(),
            images,
            keyframe_from: None,
            odom_before: None,
            introduced: false,
        })
    }

    fn put<M: Message>(&mut self, topic: impl Fn(&Topics) -> Topic, at: Stamp, message: &M) -> Result<()> {
        let topic = topic(&self.topics);
        self.writer.write(topic, at, &cdr::encode(message)?)
    }

    fn introduce(&mut self, at: Stamp) -> Result<()> {
        let fixed = build::fixed_poses(&self.rig, &self.transducers, at)?;
        self.put(|topics| topics.tf_static, at, &fixed)?;
        let robot = Text { data: build::robot_description(&self.rig) };
        self.put(|topics| topics.robot, at, &robot)?;
        let camera = build::camera_info(&self.rig, at)?;
        self.put(|topics| topics.camera_info, at, &camera)?;
        self.introduced = true;
        Ok(())
    }

    fn step(&mut self, frame: &Frame) -> Result<()> {
        if !self.introduced {
            let first = frame.ranges.first().map(|range| range.step.reading.stamp);
            self.introduce(first.unwrap_or(frame.stamp()))?;
        }
        for range in &frame.ranges {
            self.range(&range.step)?;
        }
        if let Some(step) = &frame.step {
            self.seen(frame, step)?;
        }
        let at = frame.stamp();
        if let Some(maps) = &frame.maps {
            self.maps(at, maps)?;
        }
        for (level, text) in &frame.log {
            self.put(|topics| topics.log, at, &build::log(at, level, text)?)?;
        }
        Ok(())
    }

    /// A grid without cells is no message: viewers refuse a texture of 0 x 0.
    fn maps(&mut self, at: Stamp, maps: &MapChanges) -> Result<()> {
        if let Some(plan) = maps.plan.as_ref().filter(|plan| !plan.cells.is_empty()) {
            self.put(|topics| topics.map, at, &build::plan(at, plan)?)?;
        }
        if let (Some(layers), Some([ultrasonic, fused])) = (&maps.layers, self.topics.layers) {
            self.put(|_| ultrasonic, at, &build::plan(at, &layers.ultrasonic)?)?;
            self.put(|_| fused, at, &build::plan(at, &layers.fused)?)?;
        }
        Ok(())
    }

    /// A range, and where the robot was then before it: all that maps it again.
    fn range(&mut self, step: &RangeStep) -> Result<()> {
        let (at, frame) = (step.reading.stamp, &step.reading.frame);
        let Some(topic) = self.topics.ranges.get(frame).copied() else {
            return Err(Fault::new("frame of a range", frame, "a transducer that was there from the start"));
        };
        self.put(|topics| topics.tf, at, &build::ranged_pose(step)?)?;
        self.put(|_| topic, at, &build::range(&step.reading)?)
    }

    /// What a capture became.
    fn seen(&mut self, frame: &Frame, step: &Step) -> Result<()> {
        let at = step.stamp;
        let tree = build::pose_tree(&self.rig, step)?;
        self.put(|topics| topics.tf, at, &tree)?;
        let odometry = build::odometry(step, self.odom_before.replace((at, step.odom_from_robot)))?;
        self.put(|topics| topics.odom, at, &odometry)?;
        self.put(|topics| topics.pose, at, &build::pose(step)?)?;
        let joints = build::joints(&self.rig, step)?;
        self.put(|topics| topics.joints, at, &joints)?;
        self.capture(frame, step)?;
        self.put(|topics| topics.points, at, &build::cloud(&step.placed)?)?;
        let scan = build::scan(&self.rig, &step.seen)?;
        self.put(|topics| topics.scan, at, &scan)
    }

    /// The capture, and its image before it.
    fn capture(&mut self, frame: &Frame, step: &Step) -> Result<()> {
        let at = step.stamp;
        let image = frame.image.as_ref().filter(|_| self.keeps_image(at));
        if let Some(image) = image {
            let message = build::image(at, png::encode(image)?)?;
            self.put(|topics| topics.image, at, &message)?;
            let camera = build::camera_info(&self.rig, at)?;
            self.put(|topics| topics.camera_info, at, &camera)?;
        }
        let capture = Capture {
            id: step.id,
            stamp: at,
            cylinder_pulse: step.cylinder_pulse,
            mirror_pulse: step.mirror_pulse,
            odom_from_robot: step.odom_from_robot,
            reading: Reading::Line(step.line.clone()),
        };
        let white = frame.image.as_ref().map(|image| image.white());
        let message = CaptureMessage::new(&capture, &step.line, white, image.is_some())?;
        let has_image = image.is_some();
        self.put(|topics| topics.capture, at, &message)?;
        if has_image {
            self.keyframe_from = Some(at + KEYFRAME_EVERY);
        }
        Ok(())
    }

    fn keeps_image(&self, at: Stamp) -> bool {
        match self.images {
            Images::None => false,
            Images::Keyframes => self.keyframe_from.is_none_or(|from| at >= from),
            Images::All => true,
        }
    }
}
