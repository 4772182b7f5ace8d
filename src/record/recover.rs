//! Makes a whole file of one that was cut off or damaged.

use std::io::{Read, Seek, Write};
use std::path::Path;
use std::sync::Arc;

use serde::Serialize;

use super::bag::{Channel, Item, Topic, Writer};
use super::reader::{Losses, Reader};
use crate::fault::Result;

/// What was saved of a recording, and what was not.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Recovered {
    /// Messages written.
    pub messages: u64,
    /// Whole chunks read.
    pub chunks: u64,
    /// Attachments written.
    pub attachments: u64,
    /// Metadata records written.
    pub metadata: u64,
    /// What could not be read.
    pub losses: Losses,
}

/// Writes all that can be read of `input` to `output` as a whole file: messages, attachments, metadata, in their order.
///
/// Errors: an input that is no MCAP, an output that exists (so the input is never overwritten), or a disk that fails; then
/// there is no output.
pub fn recover(input: &Path, output: &Path) -> Result<Recovered> {
    let mut reader = Reader::open(input)?;
    let first = reader.next().transpose().map_err(|fault| fault.in_file(input))?;
    let writer = Writer::create_new(output, reader.profile())?;
    let copied = copy(&mut reader, first, writer, input, output);
    if copied.is_err() {
        // The fault that is reported is the one that matters; a file that cannot be removed either adds nothing to it.
        let _ = std::fs::remove_file(output);
    }
    let counts = copied?;
    Ok(Recovered { chunks: reader.chunks(), losses: reader.losses().clone(), ..counts })
}

fn copy<R: Read + Seek, W: Write + Seek>(
    reader: &mut Reader<R>,
    first: Option<Item>,
    mut writer: Writer<W>,
    input: &Path,
    output: &Path,
) -> Result<Recovered> {
    let mut counts = Recovered::default();
    let mut topics = Vec::new();
    let rest = reader.map(|item| item.map_err(|fault| fault.in_file(input)));
    for item in first.map(Ok).into_iter().chain(rest) {
        let written = match item? {
            Item::Attachment(attachment) => {
                counts.attachments += 1;
                writer.attach(&attachment)
            }
            Item::Metadata(metadata) => {
                counts.metadata += 1;
                writer.metadata(&metadata)
            }
            Item::Message(message) => {
                counts.messages += 1;
                let times = (message.log_time_ns, message.publish_time_ns);
                topic(&mut writer, &mut topics, &message.channel)
                    .and_then(|topic| writer.write_as(topic, message.sequence, times, &message.data))
            }
        };
        written.map_err(|fault| fault.in_file(output))?;
    }
    writer.finish().map_err(|fault| fault.in_file(output))?;
    Ok(counts)
}

/// The topic of a channel; asked for once.
fn topic<W: Write + Seek>(
    writer: &mut Writer<W>,
    topics: &mut Vec<(Arc<Channel>, Topic)>,
    channel: &Arc<Channel>,
) -> Result<Topic> {
    if let Some((_, topic)) = topics.iter().find(|(known, _)| Arc::ptr_eq(known, channel)) {
        return Ok(*topic);
    }
    let topic = writer.channel(channel)?;
    topics.push((channel.clone(), topic));
    Ok(topic)
}
