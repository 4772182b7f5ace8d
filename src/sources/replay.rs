//! Replays a recording that `sinks::mcap` wrote: the same captures and ultrasonic ranges, bit for bit, as the run that made it.
//! Of other programs' recordings, the ultrasonic ranges.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

use super::recorded_ranges::{RecordedRanges, is_range};
use crate::fault::{Fault, Result};
use crate::image::{Capture, Drop, Dropped, Reading};
use crate::ranges::RangeReading;
use crate::record::bag::{Attachment, Channel, Item, Message, Reader};
use crate::record::messages::{CaptureMessage, CompressedImage, ImageNote};
use crate::record::schemas::{CAPTURE_TYPE, MESSAGE_ENCODING, definition, same_fields};
use crate::record::{METADATA_RECORDING, METADATA_START, cdr, png, topics};
use crate::time::Stamp;

/// Ranges that are read ahead to see whether a capture comes.
const AHEAD_MAX: usize = 4096;

/// What comes next out of a recording.
#[derive(Clone, Debug, PartialEq)]
pub enum Input {
    /// A capture.
    Capture(Box<Capture>),
    /// An ultrasonic range.
    Range(Box<RangeReading>),
}

/// The captures and ranges of a recording, in its order. What cannot be read is counted, and the rest goes on.
pub struct Replay<R = BufReader<File>> {
    reader: Reader<R>,
    from_images: bool,
    attachments: Vec<(String, String, Vec<u8>)>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    /// What was read to see that there is something.
    ahead: VecDeque<Input>,
    ranges: RecordedRanges,
    /// The last image message and its log time.
    image: Option<(u64, Vec<u8>)>,
    last: Option<Stamp>,
    dropped: Dropped,
    /// Losses that stand in `dropped` already.
    counted: u64,
    without_image: u64,
    ended: bool,
}

impl Replay {
    /// Opens a recording; the captures hold the line that was found when it was made, or with `from_images` the image (those
    /// without one are left out).
    ///
    /// Errors: no MCAP; not a recording of ours, then its topics are named; or nothing in it of what is asked for.
    pub fn open(path: &Path, from_images: bool) -> Result<Self> {
        let file = File::open(path).map_err(|error| Fault::io(path, &error))?;
        Self::new(BufReader::new(file), from_images).map_err(|fault| fault.in_file(path))
    }
}

impl<R: Read + Seek> Replay<R> {
    /// Replays `input`; errors as [`Replay::open`].
    pub fn new(input: R, from_images: bool) -> Result<Self> {
        // Other programs may have moved attachments to the end: first a look at those alone.
        let mut look = Reader::new(input)?.without_messages();
        let (mut attachments, mut metadata) = (Vec::new(), BTreeMap::new());
        for item in look.by_ref() {
            match item? {
                Item::Attachment(Attachment { name, media_type, data, .. }) => {
                    attachments.push((name, media_type, data))
                }
                Item::Metadata(found) => drop(metadata.insert(found.name, found.entries)),
                Item::Message(_) => {}
            }
        }
        let mut replay = Self {
            reader: Reader::new(look.into_inner())?,
            from_images,
            attachments,
            metadata,
            ahead: VecDeque::new(),
            ranges: RecordedRanges::default(),
            image: None,
            last: None,
            dropped: Dropped::default(),
            counted: 0,
            without_image: 0,
            ended: false,
        };
        while replay.ahead.len() < AHEAD_MAX {
            let Some(next) = replay.advance()? else { break };
            let is_capture = matches!(next, Input::Capture(_));
            replay.ahead.push_back(next);
            if is_capture {
                return Ok(replay);
            }
        }
        // Ranges alone are a recording too, but images were asked for.
        if replay.ahead.is_empty() || from_images { Err(replay.nothing()) } else { Ok(replay) }
    }

    /// Name of the run that was recorded; empty if it is not given.
    pub fn name(&self) -> &str {
        self.metadata.get(METADATA_RECORDING).and_then(|entries| entries.get("name")).map_or("", String::as_str)
    }

    /// The files that ride along: name (such as `rig.toml`), media type, bytes.
    pub fn attachments(&self) -> &[(String, String, Vec<u8>)] {
        &self.attachments
    }

    /// The bytes of an attachment; `None` if there is none of that name.
    pub fn attachment(&self, name: &str) -> Option<&[u8]> {
        self.attachments.iter().find(|(known, ..)| known == name).map(|(.., bytes)| bytes.as_slice())
    }

    /// Keys and values that the recorder was given: seed, version.
    pub fn metadata(&self) -> Vec<(String, String)> {
        self.metadata
            .get(METADATA_START)
            .into_iter()
            .flatten()
            .map(|(key, value)| (key.clone(), value.clone()))
            .collect()
    }

    /// What was not given out up to now, complete after the last capture: unreadable records and messages, and captures
    /// not later than the one before.
    pub fn dropped(&self) -> Dropped {
        let mut dropped = self.dropped.clone();
        dropped.merge(&self.ranges.dropped);
        dropped
    }

    /// Whether there is a topic of captures at all.
    pub fn has_captures(&self) -> bool {
        self.reader.channels().any(|channel| channel.topic == topics::CAPTURE)
    }

    /// Infrared ranges that were passed over.
    pub fn other_ranges(&self) -> u64 {
        self.ranges.others()
    }

    /// Captures left out because their image was not recorded; always 0 for lines.
    pub fn without_image(&self) -> u64 {
        self.without_image
    }

    /// How many captures the recording says it has; `None` if it was cut off.
    pub fn captures_expected(&self) -> Option<u64> {
        self.reader.messages_expected(topics::CAPTURE)
    }

    /// The next capture, past all ranges; `None` at the end. Errors as [`Replay::next_input`].
    pub fn next_capture(&mut self) -> Result<Option<Capture>> {
        while let Some(input) = self.next_input()? {
            if let Input::Capture(capture) = input {
                return Ok(Some(*capture));
            }
        }
        Ok(None)
    }

    /// The next capture or range; `None` at the end.
    ///
    /// Errors: a disk that fails, or captures written by another version; nothing follows them.
    pub fn next_input(&mut self) -> Result<Option<Input>> {
        if let Some(first) = self.ahead.pop_front() {
            return Ok(Some(first));
        }
        let next = self.advance();
        self.ended |= next.is_err();
        next
    }

    /// The next capture that is as asked for, or range.
    fn advance(&mut self) -> Result<Option<Input>> {
        loop {
            if let Some(reading) = self.ranges.next(self.ended) {
                return Ok(Some(Input::Range(Box::new(reading))));
            }
            if self.ended {
                return Ok(None);
            }
            let item = self.reader.next().transpose();
            self.count_losses();
            let message = match item? {
                Some(Item::Message(message)) => message,
                Some(_) => continue,
                None => {
                    self.ended = true;
                    continue;
                }
            };
            if message.channel.topic == topics::IMAGE && self.from_images {
                self.image = Some((message.log_time_ns, message.data));
            } else if message.channel.topic == topics::CAPTURE {
                check_schema(&message.channel)?;
                if let Some(capture) = self.capture(&message) {
                    return Ok(Some(Input::Capture(Box::new(capture))));
                }
            } else {
                self.ranges.take(&message);
            }
        }
    }

    /// The capture in a message; `None` and counted if it is not to be given out.
    fn capture(&mut self, message: &Message) -> Option<Capture> {
        let read = cdr::decode::<CaptureMessage>(&message.data).and_then(|message| message.capture());
        let Ok((mut capture, note)) = read else {
            self.dropped.add(Drop::Unreadable);
            return None;
        };
        if let Some(last) = self.last
            && capture.stamp <= last
        {
            self.dropped.add(if capture.stamp == last { Drop::SameTime } else { Drop::TimeWentBack });
            return None;
        }
        if self.from_images {
            if !note.recorded {
                self.without_image += 1;
                return None;
            }
            let Some(reading) = self.image(message.log_time_ns, &note) else {
                self.dropped.add(Drop::Unreadable);
                return None;
            };
            capture.reading = reading;
        }
        self.last = Some(capture.stamp);
        Some(capture)
    }

    /// The image that stands before a capture, with the same log time.
    fn image(&mut self, log_time_ns: u64, note: &ImageNote) -> Option<Reading> {
        let (at, payload) = self.image.take()?;
        let message: CompressedImage = cdr::decode(&payload).ok().filter(|_| at == log_time_ns)?;
        png::decode(&message.data.0, note.width, note.height, note.white?).ok().map(Reading::Image)
    }

    /// Counts what the reader could not read since the last time: the captures in damaged chunks where their index tells,
    /// else one for each damaged place; and one for an end that is missing.
    fn count_losses(&mut self) {
        let losses = self.reader.losses();
        let captures = losses.messages.get(topics::CAPTURE).copied().unwrap_or(0);
        let places = losses.chunks + losses.records;
        let total = captures.max(places) + u64::from(losses.cut_off && places == 0);
        self.dropped.add_many(Drop::Unreadable, total.saturating_sub(self.counted));
        self.counted = self.counted.max(total);
    }

    /// Why there is no capture at all.
    fn nothing(&self) -> Fault {
        let list = |channel: &Channel| {
            let kind = channel.schema.as_ref().map_or("no type", |schema| schema.name.as_str());
            format!("{} ({kind}, {})", channel.topic, channel.encoding)
        };
        let mut found: Vec<String> = self.reader.channels().map(list).collect();
        found.sort();
        found.dedup();
        let dropped = self.dropped();
        let lost = dropped.0.get(&Drop::BadPose).copied().unwrap_or(0);
        if lost > 0 && !self.from_images && self.reader.channels().any(is_range) {
            let found = format!("{lost} ultrasonic ranges, and none of them can be placed");
            let expected = "odometry (odom → robot in /tf, or nav_msgs/msg/Odometry) and the transducers in /tf_static";
            return Fault::new("recording", found, expected);
        }
        if !self.has_captures() {
            let found = if found.is_empty() { "no topic at all".to_string() } else { found.join(", ") };
            let expected = format!(
                "{} ({CAPTURE_TYPE}, {MESSAGE_ENCODING}): a recording of metromap; or sensor_msgs/msg/Range",
                topics::CAPTURE
            );
            return Fault::new("topics", found, expected);
        }
        let dropped = dropped.0.iter().map(|(why, count)| format!(", {count} {why}")).collect::<String>();
        if self.without_image > 0 {
            let found = format!("{} captures with lines and no images{dropped}", self.without_image);
            return Fault::new("recording", found, "images, as recorded with --images all, or mapping from the lines");
        }
        Fault::new("recording", format!("a recording with no images and no lines{dropped}"), "at least one capture")
    }
}

/// Refuses captures that are not written as this version has them.
fn check_schema(channel: &Channel) -> Result<()> {
    if channel.encoding != MESSAGE_ENCODING {
        return Err(Fault::new(format!("encoding of {}", topics::CAPTURE), &channel.encoding, MESSAGE_ENCODING));
    }
    let ours = definition(CAPTURE_TYPE).unwrap_or_default();
    let (name, text) = match &channel.schema {
        Some(schema) => (schema.name.as_str(), String::from_utf8_lossy(&schema.data)),
        None => ("no type", "".into()),
    };
    if name == CAPTURE_TYPE && same_fields(&text, &ours) {
        return Ok(());
    }
    let found = if name == CAPTURE_TYPE { "other fields than this version has" } else { name };
    Err(Fault::new(format!("type of {}", topics::CAPTURE), found, CAPTURE_TYPE))
}

impl<R: Read + Seek> Iterator for Replay<R> {
    type Item = Result<Capture>;

    fn next(&mut self) -> Option<Result<Capture>> {
        self.next_capture().transpose()
    }
}
