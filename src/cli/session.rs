//! What `run` and `map` share: captures through the pipeline, steps to the sinks on a thread of their own, a progress
//! bar, Ctrl-C, and the summary.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::calibration::finder::drift::DriftState;
use crate::fault::{Fault, Result};
use crate::image::{Capture, Dropped, Image, Reading};
use crate::maps::MapChanges;
use crate::navigation::Travel;
use crate::pipeline::{Pipeline, Step};
use crate::ranges::RangeReading;
use crate::sinks::{Frame, Ranged, Sink, Start, Truth};
use crate::sonar::Ping;
use crate::time::Stamp;

/// Frames that may wait for the sinks before the pipeline waits for them.
const FRAMES_WAITING_MAX: usize = 64;
/// Ranges that may wait for a capture before they are shown without one.
const RANGES_WAITING_MAX: usize = 64;
/// Maps go to the sinks this often [s of run time].
const MAPS_EVERY_S: f64 = 1.0;

/// Set by Ctrl-C: every loop looks at it and finishes its files.
pub fn interrupted() -> &'static AtomicBool {
    static STOP: OnceLock<AtomicBool> = OnceLock::new();
    STOP.get_or_init(|| {
        // A second handler cannot be set; that only happens when a test runs two commands in one process.
        let _ = ctrlc::set_handler(|| interrupted().store(true, Ordering::SeqCst));
        AtomicBool::new(false)
    })
}

/// Whether the user asked to stop.
pub fn stop_requested() -> bool {
    interrupted().load(Ordering::SeqCst)
}

/// Captures in, maps and files out.
pub struct Session {
    /// The pipeline with its maps.
    pub pipeline: Pipeline,
    /// All that was dropped.
    pub dropped: Dropped,
    /// Captures offered.
    pub captures: u64,
    /// Profiles with at least one point.
    pub profiles: u64,
    /// Points placed.
    pub points: u64,
    /// Way of the robot by its own reckoning.
    pub travelled: Travel,
    first_stamp: Option<Stamp>,
    last_stamp: Option<Stamp>,
    last_maps: Option<Stamp>,
    /// The capture at which the floor first did not fit the calibration.
    pub first_alarm: Option<u64>,
    /// What the floor last said of the calibration, in the state that was told.
    told: DriftState,
    log: Vec<(&'static str, String)>,
    /// Ranges that wait for the next frame.
    ranges: Vec<Ranged>,
    /// The newest frame, held back until the next one comes or the session ends: the last one carries the final maps.
    pending: Option<Frame>,
    sinks: SinkThread,
    bar: ProgressBar,
    started: Instant,
}

impl Session {
    /// Opens the sinks. `total` is the end of the progress bar, in captures or in milliseconds of simulated time.
    pub fn begin(pipeline: Pipeline, start: Start, sinks: Vec<Box<dyn Sink>>, total: Option<u64>) -> Result<Self> {
        interrupted();
        Ok(Self {
            pipeline,
            dropped: Dropped::default(),
            captures: 0,
            profiles: 0,
            points: 0,
            travelled: Travel::default(),
            first_stamp: None,
            last_stamp: None,
            last_maps: None,
            first_alarm: None,
            told: DriftState::Unseen,
            log: Vec::new(),
            ranges: Vec::new(),
            pending: None,
            sinks: SinkThread::begin(sinks, start)?,
            bar: progress_bar(total),
            started: Instant::now(),
        })
    }

    /// A line for the log of all sinks.
    pub fn log(&mut self, level: &'static str, text: impl Into<String>) {
        self.log.push((level, text.into()));
    }

    /// One capture through the pipeline; `None` where it was dropped (and counted, and logged).
    pub fn step(&mut self, capture: &Capture) -> Option<Arc<Step>> {
        self.captures += 1;
        match self.pipeline.step(capture) {
            Ok(step) => {
                self.dropped.merge(&step.dropped);
                self.profiles += u64::from(!step.placed.points.is_empty());
                self.points += step.placed.points.len() as u64;
                self.travelled.add(&step.world_from_robot.xyz());
                self.first_stamp.get_or_insert(capture.stamp);
                self.last_stamp = Some(capture.stamp);
                self.tell_drift(capture.id);
                Some(Arc::new(step))
            }
            Err((why, fault)) => {
                self.dropped.add(why);
                self.log.push(("WARN", fault.to_string()));
                None
            }
        }
    }

    /// One ultrasonic range through the pipeline; one that cannot be used is counted and logged.
    pub fn hear(&mut self, reading: &RangeReading, ping: Option<Ping>) {
        match self.pipeline.hear(reading) {
            Ok(step) => {
                self.dropped.merge(&step.dropped);
                self.first_stamp.get_or_insert(reading.stamp);
                self.last_stamp = self.last_stamp.max(Some(reading.stamp));
                self.ranges.push(Ranged { step, ping });
            }
            Err((why, fault)) => {
                self.dropped.add(why);
                self.log.push(("WARN", fault.to_string()));
            }
        }
        // Captures come more often than this, where there are any.
        if self.ranges.len() >= RANGES_WAITING_MAX {
            self.show_ranges();
        }
    }

    /// Hands ranges to the sinks that no capture came after.
    fn show_ranges(&mut self) {
        let Some(last) = self.ranges.last() else { return };
        let at = last.step.reading.stamp;
        self.send(at, None, None, None);
    }

    /// Tells when the floor says something else of the calibration than before.
    fn tell_drift(&mut self, capture: u64) {
        let Some(drift) = self.pipeline.drift().filter(|drift| drift.state != self.told) else { return };
        let (text, alarm) = (drift.to_string(), drift.is_alarm());
        // From one alarm to another is no news; the newest stands in the summary.
        let news = !alarm || self.first_alarm.is_none();
        self.told = drift.state;
        if alarm {
            self.first_alarm.get_or_insert(capture);
        }
        if news {
            if alarm {
                self.bar.suspend(|| eprintln!("metromap: {text}"));
            }
            self.log(if alarm { "WARN" } else { "INFO" }, text);
        }
    }

    /// Hands a step to the sinks, with the maps about once a second.
    pub fn show(&mut self, step: &Arc<Step>, reading: &Reading, truth: Option<Truth>) {
        let image = match reading {
            Reading::Image(image) => Some(Arc::new(image.clone())),
            Reading::Line(_) => None,
        };
        self.send(step.stamp, Some(step.clone()), image, truth);
    }

    /// Makes a frame of all that waits, and hands on the one before it.
    fn send(&mut self, at: Stamp, step: Option<Arc<Step>>, image: Option<Arc<Image>>, truth: Option<Truth>) {
        let due = self.last_maps.is_none_or(|last| (at - last).as_secs() >= MAPS_EVERY_S);
        let maps = due.then(|| {
            self.last_maps = Some(at);
            Arc::new(self.pipeline.maps_mut().changes())
        });
        let frame = Frame {
            ranges: std::mem::take(&mut self.ranges),
            step,
            image,
            truth,
            maps,
            log: std::mem::take(&mut self.log),
            dropped: self.dropped.clone(),
        };
        if let Some(before) = self.pending.replace(frame) {
            self.sinks.send(before);
        }
    }

    /// Moves the progress bar.
    pub fn progress(&self, position: u64, message: &str) {
        self.bar.set_position(position);
        self.bar.set_message(message.to_string());
    }

    /// Takes the progress bar away.
    pub fn hide_progress(&self) {
        self.bar.finish_and_clear();
    }

    /// Closes the sinks; what failed in them comes back.
    pub fn finish(&mut self) -> Vec<Fault> {
        self.show_ranges();
        if let Some(mut frame) = self.pending.take() {
            let mut changes = self.pipeline.maps_mut().changes();
            if let Some(earlier) = frame.maps.take() {
                changes = merged(&earlier, changes);
            }
            frame.maps = Some(Arc::new(changes));
            frame.log.append(&mut self.log);
            frame.dropped = self.dropped.clone();
            self.sinks.send(frame);
        }
        self.bar.set_message("writing files");
        let faults = self.sinks.finish(self.last_stamp.unwrap_or_default());
        self.bar.finish_and_clear();
        faults
    }

    /// Time from the first to the last capture [s].
    pub fn span_s(&self) -> f64 {
        match (self.first_stamp, self.last_stamp) {
            (Some(first), Some(last)) => (last - first).as_secs(),
            _ => 0.0,
        }
    }

    /// Wall time since the session began [s].
    pub fn wall_s(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }
}

/// Changes, and what changed after them.
fn merged(earlier: &MapChanges, later: MapChanges) -> MapChanges {
    let mut both = earlier.clone();
    both.blocks.retain(|(key, _)| later.blocks.iter().all(|(newer, _)| newer != key));
    both.tiles.retain(|(key, _)| later.tiles.iter().all(|(newer, _)| newer != key));
    both.blocks.extend(later.blocks);
    both.tiles.extend(later.tiles);
    both.plan = later.plan.or(both.plan);
    both.layers = later.layers.or(both.layers);
    both
}

/// A progress bar with the time left, on a terminal only.
pub fn progress_bar(total: Option<u64>) -> ProgressBar {
    let bar = match total {
        Some(total) => ProgressBar::new(total),
        None => ProgressBar::new_spinner(),
    };
    bar.set_draw_target(ProgressDrawTarget::stderr_with_hz(8));
    let template = "{bar:30} {percent:>3} %  {elapsed} elapsed, {eta} left  {msg}";
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(250));
    bar
}

/// What the thread gives back: the sinks, to be finished, and why any of them failed.
type Written = (Vec<Box<dyn Sink>>, Vec<Fault>);

/// The sinks on their own thread: they take time, and change no result.
struct SinkThread {
    sender: Option<SyncSender<Box<Frame>>>,
    thread: Option<JoinHandle<Written>>,
    /// The finished sinks: a live viewer is served as long as its sink lives.
    finished: Vec<Box<dyn Sink>>,
}

impl SinkThread {
    fn begin(mut sinks: Vec<Box<dyn Sink>>, start: Start) -> Result<Self> {
        for sink in &mut sinks {
            sink.begin(&start)?;
        }
        let (sender, receiver) = sync_channel::<Box<Frame>>(FRAMES_WAITING_MAX);
        let thread = std::thread::spawn(move || {
            let mut failed = vec![None; sinks.len()];
            for frame in receiver {
                for (sink, failure) in sinks.iter_mut().zip(&mut failed) {
                    // A sink that failed is not asked again: its first reason is the one that counts.
                    if failure.is_none() {
                        *failure = sink.step(&frame).err();
                    }
                }
            }
            (sinks, failed.into_iter().flatten().collect())
        });
        Ok(Self { sender: Some(sender), thread: Some(thread), finished: Vec::new() })
    }

    fn send(&self, frame: Frame) {
        if let Some(sender) = &self.sender {
            // Fails only if the thread is gone, which `finish` reports.
            let _ = sender.send(Box::new(frame));
        }
    }

    fn finish(&mut self, at: Stamp) -> Vec<Fault> {
        self.sender = None;
        let Some(thread) = self.thread.take() else { return Vec::new() };
        let Ok((mut sinks, mut faults)) = thread.join() else {
            return vec![Fault::new("sink", "a panic", "a result: please report this")];
        };
        faults.extend(sinks.iter_mut().filter_map(|sink| sink.finish(at).err()));
        self.finished = sinks;
        faults
    }
}
