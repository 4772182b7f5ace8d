//! Writes MCAP files, and unpacks their chunks. The only file that names the `mcap` crate.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Seek, Write};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mcap::records::{MessageHeader, Metadata as MetadataRecord};
use mcap::sans_io::LinearReader;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReaderOptions};

use super::frames::{ChunkHeader, RECORD_BYTES_MAX, op};
pub use super::reader::{Losses, Reader};
pub use super::recover::{Recovered, recover};
use super::schemas::{MESSAGE_ENCODING, SCHEMA_ENCODING, definition};
use crate::fault::{Fault, Result};
use crate::time::Stamp;

/// The profile of what this crate writes.
pub const PROFILE: &str = "ros2";
/// Uncompressed size at which a chunk is closed [bytes].
const CHUNK_BYTES: u64 = 256 << 10;
/// How often everything so far is put on the disk, in time as people have it.
const FLUSH_EVERY: Duration = Duration::from_secs(1);
/// The quality of service of topics that late listeners must see too, as rosbag2 stores it: the last message, reliable,
/// transient local.
const LATCHED: &str = "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 9223372036\n    nsec: \
                       854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n  \
                       liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  \
                       avoid_ros_namespace_conventions: false\n";

/// The type of a topic's messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Schema {
    /// Its name, such as `nav_msgs/msg/Odometry`.
    pub name: String,
    /// How `data` is written, such as `ros2msg`.
    pub encoding: String,
    /// The definition.
    pub data: Vec<u8>,
}

/// A topic in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    /// Its name.
    pub topic: String,
    /// The type of its messages, where there is one.
    pub schema: Option<Arc<Schema>>,
    /// How its messages are written, such as `cdr`.
    pub encoding: String,
    /// What else is said of it.
    pub metadata: BTreeMap<String, String>,
}

/// A message in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    /// Its topic.
    pub channel: Arc<Channel>,
    /// Its number in the topic.
    pub sequence: u32,
    /// When it was recorded [ns].
    pub log_time_ns: u64,
    /// When it was sent [ns].
    pub publish_time_ns: u64,
    /// Its bytes.
    pub data: Vec<u8>,
}

/// A file within the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attachment {
    /// Its name.
    pub name: String,
    /// Its media type.
    pub media_type: String,
    /// When it was recorded [ns].
    pub log_time_ns: u64,
    /// When it was made [ns].
    pub create_time_ns: u64,
    /// Its bytes.
    pub data: Vec<u8>,
}

/// A named map of keys and values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Metadata {
    /// Its name.
    pub name: String,
    /// Keys and values.
    pub entries: BTreeMap<String, String>,
}

/// One thing that was recorded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Item {
    /// A file within the file.
    Attachment(Attachment),
    /// Keys and values.
    Metadata(Metadata),
    /// A message.
    Message(Message),
}

/// A topic of a [`Writer`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Topic(u16);

/// Writes a file that can be read up to the last second, whatever happens to this process: chunks are small, and about
/// every second all of them are put on the disk. Once a write failed, it refuses all others with the same fault.
pub struct Writer<W: Write + Seek> {
    inner: mcap::Writer<W>,
    /// The same file once more, for syncing.
    disk: Option<File>,
    flushed: Instant,
    failed: Option<Fault>,
    sequences: BTreeMap<u16, u32>,
}

impl Writer<BufWriter<File>> {
    /// Starts a file of our own; one that stands there is replaced.
    pub fn create(path: &Path) -> Result<Self> {
        let file = File::create(path).map_err(|error| Fault::io(path, &error))?;
        Self::on_file(file, PROFILE).map_err(|fault| fault.in_file(path))
    }

    /// Starts a file with another profile; one that stands there is an error.
    pub fn create_new(path: &Path, profile: &str) -> Result<Self> {
        let file = File::create_new(path).map_err(|error| match error.kind() {
            std::io::ErrorKind::AlreadyExists => {
                Fault::new("output", "a file that exists", "a name that is not taken").in_file(path)
            }
            _ => Fault::io(path, &error),
        })?;
        Self::on_file(file, profile).map_err(|fault| fault.in_file(path))
    }

    fn on_file(file: File, profile: &str) -> Result<Self> {
        let disk = file.try_clone().map_err(|error| not_written(&error.into()))?;
        Self::new(BufWriter::new(file), Some(disk), profile)
    }
}

impl<W: Write + Seek> Writer<W> {
    /// Writes to `output`, which is synced through `disk` where there is one. Nothing is ever written twice, so a file that
    /// is cut off anywhere holds all that came before.
    pub fn new(output: W, disk: Option<File>, profile: &str) -> Result<Self> {
        let options = mcap::WriteOptions::new()
            .profile(profile)
            .library(concat!("metromap/", env!("CARGO_PKG_VERSION")))
            .compression(Some(mcap::Compression::Zstd))
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES))
            .disable_seeking(true);
        let inner = options.create(output).map_err(|error| not_written(&error))?;
        Ok(Self { inner, disk, flushed: Instant::now(), failed: None, sequences: BTreeMap::new() })
    }

    /// A file within the file.
    pub fn attach(&mut self, attachment: &Attachment) -> Result<()> {
        let Attachment { name, media_type, log_time_ns, create_time_ns, data } = attachment;
        let (log_time, create_time) = (*log_time_ns, *create_time_ns);
        let (name, media_type) = (name.clone(), media_type.clone());
        let record = mcap::Attachment { log_time, create_time, name, media_type, data: data.into() };
        self.guarded(|inner| inner.attach(&record))
    }

    /// Keys and values.
    pub fn metadata(&mut self, metadata: &Metadata) -> Result<()> {
        let record = MetadataRecord { name: metadata.name.clone(), metadata: metadata.entries.clone() };
        self.guarded(|inner| inner.write_metadata(&record))
    }

    /// A topic for messages of one of our types; `latched` where a listener that comes late must still see the last one.
    ///
    /// Errors: a type without a schema.
    pub fn topic(&mut self, topic: &str, ros_type: &str, latched: bool) -> Result<Topic> {
        let text = definition(ros_type).ok_or_else(|| Fault::new("message type", ros_type, "a type with a schema"))?;
        let schema = Schema { name: ros_type.into(), encoding: SCHEMA_ENCODING.into(), data: text.into_bytes() };
        let qos = latched.then(|| ("offered_qos_profiles".to_string(), LATCHED.to_string()));
        let metadata = qos.into_iter().collect();
        self.channel(&Channel {
            topic: topic.into(),
            schema: Some(schema.into()),
            encoding: MESSAGE_ENCODING.into(),
            metadata,
        })
    }

    /// A topic as another file has it; the same topic for the same content.
    pub fn channel(&mut self, channel: &Channel) -> Result<Topic> {
        let id = self.guarded(|inner| {
            let schema = match &channel.schema {
                Some(schema) => inner.add_schema(&schema.name, &schema.encoding, &schema.data)?,
                None => 0,
            };
            inner.add_channel(schema, &channel.topic, &channel.encoding, &channel.metadata)
        })?;
        Ok(Topic(id))
    }

    /// A message at a time.
    ///
    /// Errors: a time before 0, which the format cannot hold, and a disk that does not take it.
    pub fn write(&mut self, topic: Topic, at: Stamp, payload: &[u8]) -> Result<()> {
        let time = u64::try_from(at.0).map_err(|_| Fault::new("time", at.0, "a time of at least 0 ns"))?;
        let sequence = self.sequences.get(&topic.0).copied().unwrap_or(0);
        self.sequences.insert(topic.0, sequence.wrapping_add(1));
        self.write_as(topic, sequence, (time, time), payload)
    }

    /// A message as another file has it: number, and log and publish time [ns].
    pub(super) fn write_as(
        &mut self,
        topic: Topic,
        sequence: u32,
        (log_time, publish_time): (u64, u64),
        payload: &[u8],
    ) -> Result<()> {
        let header = MessageHeader { channel_id: topic.0, sequence, log_time, publish_time };
        self.guarded(|inner| inner.write_to_known_channel(&header, payload))?;
        if self.flushed.elapsed() >= FLUSH_EVERY { self.flush() } else { Ok(()) }
    }

    /// Puts everything so far on the disk: it can be read even if this process is killed next.
    pub fn flush(&mut self) -> Result<()> {
        self.guarded(mcap::Writer::flush)?;
        let synced = self.disk.as_ref().map_or(Ok(()), File::sync_data);
        self.flushed = Instant::now();
        self.guarded(|_| Ok(synced?))
    }

    /// Writes the summary and puts everything on the disk.
    pub fn finish(mut self) -> Result<()> {
        self.guarded(|inner| inner.finish().map(|_| ()))?;
        let synced = self.disk.as_ref().map_or(Ok(()), File::sync_all);
        self.guarded(|_| Ok(synced?))
    }

    fn guarded<T>(&mut self, write: impl FnOnce(&mut mcap::Writer<W>) -> mcap::McapResult<T>) -> Result<T> {
        if let Some(fault) = &self.failed {
            return Err(fault.clone());
        }
        write(&mut self.inner).map_err(|error| self.failed.insert(not_written(&error)).clone())
    }
}

fn not_written(error: &mcap::McapError) -> Fault {
    let found = match error {
        mcap::McapError::Io(error) => error.to_string(),
        other => other.to_string(),
    };
    Fault::new("recording", found, "a disk and a recording that take what is written")
}

/// The records of a chunk as far as they can be had, and whether they are all there and their CRC is right.
pub(super) fn unpack(header: &ChunkHeader, packed: &[u8]) -> (Vec<u8>, bool) {
    let (records, complete) = match header.compression.as_str() {
        "" => (packed.to_vec(), true),
        _ => decompress(header, packed),
    };
    let mut sum = flate2::Crc::new();
    sum.update(&records);
    let sound =
        complete && records.len() as u64 == header.uncompressed_bytes && (header.crc == 0 || header.crc == sum.sum());
    (records, sound)
}

/// The records in compressed bytes, up to where these end or are damaged. A few bytes that claim to be many do not get the
/// memory for it: zstd's densest block holds 128 KiB in four bytes.
fn decompress(header: &ChunkHeader, packed: &[u8]) -> (Vec<u8>, bool) {
    const DENSEST: u64 = 1 << 15;
    let there = packed.len() as u64;
    let limit = header.uncompressed_bytes.min(RECORD_BYTES_MAX).min(there.saturating_mul(DENSEST)).max(there + 1024);
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_record_length_limit(limit as usize);
    let mut reader = LinearReader::new_with_options(options);
    // The reader is given a file of this one chunk, without its CRC, which is checked here for every kind of chunk.
    let mut file = vec![op::CHUNK];
    file.extend((40 + header.compression.len() as u64 + there).to_le_bytes());
    file.extend([0; 16]);
    file.extend(header.uncompressed_bytes.to_le_bytes());
    file.extend([0; 4]);
    file.extend((header.compression.len() as u32).to_le_bytes());
    file.extend(header.compression.as_bytes());
    file.extend(there.to_le_bytes());
    file.extend(packed);
    let mut records = Vec::new();
    let mut rest = file.as_slice();
    loop {
        match reader.next_event() {
            None => return (records, true),
            Some(Err(_)) => return (records, false),
            Some(Ok(LinearReadEvent::ReadRequest(need))) => {
                let (now, later) = rest.split_at(need.min(rest.len()));
                reader.insert(now.len()).copy_from_slice(now);
                reader.notify_read(now.len());
                rest = later;
            }
            Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                if (records.len() + data.len()) as u64 > limit {
                    return (records, false);
                }
                records.push(opcode);
                records.extend((data.len() as u64).to_le_bytes());
                records.extend(data);
            }
        }
    }
}
