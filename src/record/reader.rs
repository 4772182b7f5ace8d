//! Reads MCAP files, whole, cut off or damaged, in bounded memory.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;
use std::sync::Arc;

use serde::Serialize;

use super::bag::{Attachment, Channel, Item, Message, Metadata, Schema, unpack};
use super::frames::{ChunkHeader, Fields, Found, Frame, Frames, RECORD_BYTES_MAX, op, summary};
use crate::fault::{Fault, Result};

/// Schemas and channels are kept to the end of the file: this many bytes of them, and no more.
const KNOWN_BYTES_MAX: usize = 64 << 20;

/// What of a file could not be read.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Losses {
    /// The end that the format asks for is missing.
    pub cut_off: bool,
    /// Damaged or unfinished chunks.
    pub chunks: u64,
    /// Damaged or contradictory records outside those chunks.
    pub records: u64,
    /// Messages that are missing, by topic: by the summary, else as far as the indexes of damaged chunks say.
    pub messages: BTreeMap<String, u64>,
    /// Bytes of the file in all of these.
    pub bytes: u64,
}

impl Losses {
    /// Whether the file was whole.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

/// How many of each.
#[derive(Clone, Debug, Default)]
struct Counts {
    messages: BTreeMap<u16, u64>,
    /// Attachments and metadata records.
    others: u64,
}

/// Reads a file front to back, one chunk in memory at a time. Cut off, it gives all that is there; damaged, all that is not;
/// what it left out is in [`losses`](Self::losses). Schemas and channels are taken from the summary too, if there is one.
pub struct Reader<R> {
    frames: Frames<R>,
    profile: String,
    schemas: BTreeMap<u16, Arc<Schema>>,
    channels: BTreeMap<u16, Arc<Channel>>,
    /// What the file holds as the summary says, and what was read of it.
    expected: Option<Counts>,
    read: Counts,
    /// Bytes of schemas and channels kept.
    known_bytes: usize,
    /// Records of the open chunk, and how far they were read.
    chunk: Vec<u8>,
    chunk_at: usize,
    /// The chunk before was damaged: the indexes after it tell what it held.
    after_damage: bool,
    with_messages: bool,
    ended: bool,
    chunks: u64,
    losses: Losses,
}

impl Reader<BufReader<File>> {
    /// Opens a file.
    ///
    /// Errors: it cannot be read, or does not start as MCAP.
    pub fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(|error| Fault::io(path, &error))?;
        Self::new(BufReader::new(file)).map_err(|fault| fault.in_file(path))
    }
}

impl<R: Read + Seek> Reader<R> {
    /// Reads from `input`.
    pub fn new(input: R) -> Result<Self> {
        let frames = Frames::new(input).map_err(|error| unreadable(&error))?;
        let mut frames = frames.ok_or_else(|| Fault::new("file", "no MCAP magic at its start", "an MCAP recording"))?;
        let known = summary(&mut frames).map_err(|error| unreadable(&error))?;
        let mut reader = Self {
            frames,
            profile: String::new(),
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            expected: None,
            read: Counts::default(),
            known_bytes: 0,
            chunk: Vec::new(),
            chunk_at: 0,
            after_damage: false,
            with_messages: true,
            ended: false,
            chunks: 0,
            losses: Losses::default(),
        };
        let known = known.unwrap_or_default();
        let mut fields = Fields(&known);
        while let Some((kind, body)) = fields.record() {
            // What is wrong here is found, and counted, in the data too.
            let _ = match kind {
                op::SCHEMA => reader.schema(body),
                op::CHANNEL => reader.channel(body),
                op::STATISTICS => reader.statistics(body),
                _ => Some(()),
            };
        }
        Ok(reader)
    }

    /// Attachments and metadata only: chunks are stepped over.
    pub fn without_messages(mut self) -> Self {
        self.with_messages = false;
        self
    }

    /// The input, wherever it stands.
    pub fn into_inner(self) -> R {
        self.frames.into_inner()
    }

    /// The file's profile, known once the first item was read.
    pub fn profile(&self) -> &str {
        &self.profile
    }

    /// The topics seen so far, those of the summary from the start.
    pub fn channels(&self) -> impl Iterator<Item = &Channel> {
        self.channels.values().map(Arc::as_ref)
    }

    /// How many messages of a topic the file says it has; `None` without a summary.
    pub fn messages_expected(&self, topic: &str) -> Option<u64> {
        let of_topic = |id: &&u16| self.channels.get(id).is_some_and(|channel| channel.topic == topic);
        let counts = &self.expected.as_ref()?.messages;
        let counts = counts.keys().filter(of_topic).filter_map(|id| counts.get(id));
        Some(counts.fold(0, |sum: u64, count| sum.saturating_add(*count)))
    }

    /// Whole chunks read so far.
    pub fn chunks(&self) -> u64 {
        self.chunks
    }

    /// What could not be read up to now.
    pub fn losses(&self) -> &Losses {
        &self.losses
    }

    /// The next item; `None` at the end.
    fn advance(&mut self) -> std::io::Result<Option<Item>> {
        loop {
            while let Some((kind, start, end)) = self.next_in_chunk() {
                let chunk = std::mem::take(&mut self.chunk);
                let item = self.record(kind, chunk.get(start..end).unwrap_or_default(), 0);
                self.chunk = chunk;
                if item.is_some() {
                    return Ok(item);
                }
            }
            if self.ended {
                return Ok(None);
            }
            match self.frames.advance()? {
                Found::Lost(bytes) => {
                    self.losses.records += 1;
                    self.losses.bytes += bytes;
                }
                Found::Cut(frame) => self.open_chunk(&frame, true)?,
                Found::End(whole) => {
                    self.ended = true;
                    self.losses.cut_off = !whole;
                    self.compare_with_summary();
                }
                Found::Record(frame) if frame.op == op::CHUNK => {
                    if self.with_messages {
                        self.open_chunk(&frame, false)?;
                    }
                }
                Found::Record(frame) if !matters(frame.op) => {}
                Found::Record(frame) if frame.len > RECORD_BYTES_MAX => self.refuse(frame.len),
                Found::Record(frame) => {
                    let body = self.frames.body(&frame)?;
                    if let Some(item) = self.record(frame.op, &body, frame.len) {
                        return Ok(Some(item));
                    }
                }
            }
        }
    }

    /// Kind and place of the next record in the open chunk.
    fn next_in_chunk(&mut self) -> Option<(u8, usize, usize)> {
        let rest = self.chunk.get(self.chunk_at..).filter(|rest| !rest.is_empty())?;
        let mut fields = Fields(rest);
        match fields.record() {
            Some((kind, body)) => {
                self.chunk_at = self.chunk.len() - fields.0.len();
                Some((kind, self.chunk_at - body.len(), self.chunk_at))
            }
            None => {
                self.refuse(rest.len() as u64);
                self.chunk.clear();
                None
            }
        }
    }

    /// Takes in a record; gives it back if it is an item. `bytes` is what it takes in the file.
    fn record(&mut self, kind: u8, body: &[u8], bytes: u64) -> Option<Item> {
        self.read.others += u64::from(matches!(kind, op::ATTACHMENT | op::METADATA));
        let read = match kind {
            op::HEADER => Fields(body).string().map(|profile| self.profile = profile),
            op::SCHEMA => self.schema(body),
            op::CHANNEL => self.channel(body),
            op::MESSAGE if self.with_messages => match self.message(body) {
                Some(message) => return Some(Item::Message(message)),
                None => None,
            },
            op::ATTACHMENT | op::METADATA if bytes == 0 => None, // not in a chunk
            op::ATTACHMENT => match attachment(body) {
                Some(attachment) => return Some(Item::Attachment(attachment)),
                None => None,
            },
            op::METADATA => match metadata(body) {
                Some(metadata) => return Some(Item::Metadata(metadata)),
                None => None,
            },
            op::MESSAGE_INDEX => self.index(body),
            _ => Some(()),
        };
        if read.is_none() {
            self.refuse(bytes);
        }
        None
    }

    fn refuse(&mut self, bytes: u64) {
        self.losses.records += 1;
        self.losses.bytes += bytes;
    }

    fn schema(&mut self, body: &[u8]) -> Option<()> {
        let mut fields = Fields(body);
        let (id, name, encoding) = (fields.u16()?, fields.string()?, fields.string()?);
        let length = fields.u32()? as usize;
        let schema = Schema { name, encoding, data: fields.bytes(length)?.to_vec() };
        match self.schemas.get(&id) {
            Some(known) => (**known == schema).then_some(()),
            None => {
                self.keep(body.len()).filter(|()| id != 0)?;
                self.schemas.insert(id, schema.into());
                Some(())
            }
        }
    }

    fn channel(&mut self, body: &[u8]) -> Option<()> {
        let mut fields = Fields(body);
        let (id, schema, topic) = (fields.u16()?, fields.u16()?, fields.string()?);
        let (encoding, metadata) = (fields.string()?, fields.map()?);
        let schema = if schema == 0 { None } else { Some(self.schemas.get(&schema)?.clone()) };
        let channel = Channel { topic, schema, encoding, metadata };
        match self.channels.get(&id) {
            Some(known) => (**known == channel).then_some(()),
            None => {
                self.keep(body.len())?;
                self.channels.insert(id, channel.into());
                Some(())
            }
        }
    }

    /// Room for `bytes` more of schemas or channels.
    fn keep(&mut self, bytes: usize) -> Option<()> {
        let total = self.known_bytes.checked_add(bytes).filter(|total| *total <= KNOWN_BYTES_MAX)?;
        self.known_bytes = total;
        Some(())
    }

    fn statistics(&mut self, body: &[u8]) -> Option<()> {
        let mut fields = Fields(body);
        let (_messages, _schemas, _channels) = (fields.u64()?, fields.u16()?, fields.u32()?);
        let mut counts = Counts { others: u64::from(fields.u32()?) + u64::from(fields.u32()?), ..Counts::default() };
        let (_chunks, _first, _last) = (fields.u32()?, fields.u64()?, fields.u64()?);
        let length = fields.u32()? as usize;
        let mut entries = Fields(fields.bytes(length)?);
        while let Some((channel, count)) = entries.u16().zip(entries.u64()) {
            counts.messages.insert(channel, count);
        }
        self.expected = Some(counts);
        Some(())
    }

    /// Counts what the summary promised and was not found: a record whose kind is damaged looks like one to step over.
    fn compare_with_summary(&mut self) {
        let Some(expected) = self.expected.take() else { return };
        self.losses.records += expected.others.saturating_sub(self.read.others);
        if self.with_messages {
            // More exact than the indexes of damaged chunks.
            self.losses.messages.clear();
            for (id, count) in &expected.messages {
                let missing = count.saturating_sub(self.read.messages.get(id).copied().unwrap_or(0));
                if missing > 0 {
                    *self.losses.messages.entry(self.topic_of(*id)).or_default() += missing;
                }
            }
        }
        self.expected = Some(expected);
    }

    fn topic_of(&self, id: u16) -> String {
        self.channels.get(&id).map_or_else(|| format!("channel {id}"), |channel| channel.topic.clone())
    }

    fn message(&mut self, body: &[u8]) -> Option<Message> {
        let mut fields = Fields(body);
        let id = fields.u16()?;
        let channel = self.channels.get(&id)?.clone();
        *self.read.messages.entry(id).or_default() += 1;
        let (sequence, log_time_ns, publish_time_ns) = (fields.u32()?, fields.u64()?, fields.u64()?);
        Some(Message { channel, sequence, log_time_ns, publish_time_ns, data: fields.0.to_vec() })
    }

    /// An index is needed only to tell what a damaged chunk held.
    fn index(&mut self, body: &[u8]) -> Option<()> {
        const ENTRY_BYTES: u64 = 16;
        if !self.after_damage {
            return Some(());
        }
        let mut fields = Fields(body);
        let (id, bytes) = (fields.u16()?, u64::from(fields.u32()?));
        let topic = self.topic_of(id);
        let count = bytes.min(fields.0.len() as u64) / ENTRY_BYTES;
        *self.losses.messages.entry(topic).or_default() += count;
        Some(())
    }

    /// Makes a chunk the open one: whole if its CRC is right, as far as it goes if the file ends in it, else not at all.
    fn open_chunk(&mut self, frame: &Frame, cut: bool) -> std::io::Result<()> {
        self.chunk.clear();
        self.chunk_at = 0;
        self.after_damage = true;
        let body = if frame.len > RECORD_BYTES_MAX { Vec::new() } else { self.frames.body(frame)? };
        let mut fields = Fields(&body);
        let header = ChunkHeader::read(&mut fields);
        let there = fields.0.len() as u64;
        if let Some(header) = header {
            let whole = header.compressed_bytes <= there;
            let (records, sound) =
                unpack(&header, fields.bytes(header.compressed_bytes.min(there) as usize).unwrap_or_default());
            if whole && sound {
                self.chunk = records;
                self.after_damage = false;
                self.chunks += 1;
                if header.compressed_bytes < there {
                    self.frames.look_inside(frame, header.bytes + header.compressed_bytes)?;
                }
                return Ok(());
            }
            if cut {
                // Only whole records: the one that is cut is lost with the rest, and counted with it.
                let mut fields = Fields(&records);
                let mut used = 0;
                while fields.record().is_some() {
                    used = records.len() - fields.0.len();
                }
                self.chunk = records;
                self.chunk.truncate(used);
            }
        }
        self.losses.chunks += 1;
        self.losses.bytes += frame.len;
        Ok(())
    }
}

impl<R: Read + Seek> Iterator for Reader<R> {
    type Item = Result<Item>;

    fn next(&mut self) -> Option<Result<Item>> {
        let item = self.advance();
        if item.is_err() {
            // A disk that does not answer will not answer next time either.
            self.ended = true;
            self.chunk.clear();
        }
        item.map_err(|error| unreadable(&error)).transpose()
    }
}

/// Records that say something beyond how to find others.
fn matters(kind: u8) -> bool {
    matches!(
        kind,
        op::HEADER | op::SCHEMA | op::CHANNEL | op::MESSAGE | op::MESSAGE_INDEX | op::ATTACHMENT | op::METADATA
    )
}

fn unreadable(error: &std::io::Error) -> Fault {
    Fault::new("recording", error, "a file that can be read")
}

fn attachment(body: &[u8]) -> Option<Attachment> {
    let mut fields = Fields(body);
    let (log_time_ns, create_time_ns) = (fields.u64()?, fields.u64()?);
    let (name, media_type) = (fields.string()?, fields.string()?);
    let length = usize::try_from(fields.u64()?).ok()?;
    let data = fields.bytes(length)?.to_vec();
    let summed = body.len() - fields.0.len();
    let mut sum = flate2::Crc::new();
    sum.update(body.get(..summed)?);
    let crc = fields.u32()?;
    (crc == 0 || crc == sum.sum()).then_some(Attachment { name, media_type, log_time_ns, create_time_ns, data })
}

fn metadata(body: &[u8]) -> Option<Metadata> {
    let mut fields = Fields(body);
    Some(Metadata { name: fields.string()?, entries: fields.map()? })
}
