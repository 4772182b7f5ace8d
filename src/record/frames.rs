//! Walks the records of an MCAP file that may be cut off or damaged (mcap.dev/spec): one at a time, never more in memory
//! than one, and from a damaged place on to the next chunk that is whole.

use std::collections::BTreeMap;
use std::io::{self, Read, Seek, SeekFrom};

/// The first and the last bytes of a file.
pub(super) const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n'];
/// The largest record taken into memory [bytes].
pub(super) const RECORD_BYTES_MAX: u64 = 256 << 20;

/// Kinds of records.
pub(super) mod op {
    pub(in crate::record) const HEADER: u8 = 0x01;
    pub(in crate::record) const FOOTER: u8 = 0x02;
    pub(in crate::record) const SCHEMA: u8 = 0x03;
    pub(in crate::record) const CHANNEL: u8 = 0x04;
    pub(in crate::record) const MESSAGE: u8 = 0x05;
    pub(in crate::record) const CHUNK: u8 = 0x06;
    pub(in crate::record) const MESSAGE_INDEX: u8 = 0x07;
    pub(in crate::record) const ATTACHMENT: u8 = 0x09;
    pub(in crate::record) const STATISTICS: u8 = 0x0B;
    pub(in crate::record) const METADATA: u8 = 0x0C;
}

/// Opcode and length before every record.
const PREFIX: u64 = 9;

/// A record in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Frame {
    /// Its kind.
    pub op: u8,
    /// Where its body starts.
    pub body: u64,
    /// Length of the body [bytes].
    pub len: u64,
}

/// What stands next in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Found {
    /// A whole record.
    Record(Frame),
    /// A chunk that says it is longer than the file: its beginning is all there is.
    Cut(Frame),
    /// Bytes that are no record; after them stands one, or the end.
    Lost(u64),
    /// The end of the file; whether it is the one that the format asks for.
    End(bool),
}

/// The records of a file, front to back.
pub(super) struct Frames<R> {
    input: R,
    /// Where `input` stands.
    place: u64,
    /// Length of the file.
    end: u64,
    /// Where the next record starts.
    at: u64,
    /// Whether footer and magic were the last things read.
    ended: bool,
}

impl<R: Read + Seek> Frames<R> {
    /// After the magic; `None` if the file does not start with it.
    pub fn new(mut input: R) -> io::Result<Option<Self>> {
        let end = input.seek(SeekFrom::End(0))?;
        input.seek(SeekFrom::Start(0))?;
        let mut magic = [0; MAGIC.len()];
        if end < magic.len() as u64 {
            return Ok(None);
        }
        input.read_exact(&mut magic)?;
        let start = MAGIC.len() as u64;
        Ok((magic == MAGIC).then_some(Self { input, place: start, end, at: start, ended: false }))
    }

    /// The input, wherever it stands.
    pub fn into_inner(self) -> R {
        self.input
    }

    /// What stands next.
    pub fn advance(&mut self) -> io::Result<Found> {
        let left = self.end - self.at;
        if self.ended || left == 0 {
            self.at = self.end;
            return Ok(Found::End(self.ended));
        }
        let Some((op, len)) = self.prefix(left)? else { return self.skip_to_chunk(None) };
        if op == 0 || len > left - PREFIX {
            let cut = Frame { op, body: self.at + PREFIX, len: left - PREFIX };
            return self.skip_to_chunk((op == op::CHUNK).then_some(cut));
        }
        let frame = Frame { op, body: self.at + PREFIX, len };
        self.at = frame.body + len;
        if op == op::FOOTER {
            self.ended = self.read(self.at, MAGIC.len() as u64)? == MAGIC;
        }
        Ok(Found::Record(frame))
    }

    /// The body of a record, no longer than the file is.
    pub fn body(&mut self, frame: &Frame) -> io::Result<Vec<u8>> {
        self.read(frame.body, frame.len)
    }

    /// Up to `len` bytes from `from`: fewer at the end of the file.
    fn read(&mut self, from: u64, len: u64) -> io::Result<Vec<u8>> {
        const STEP: u64 = 4096;
        // A short way forward is read, not jumped: a jump empties the buffer of a buffered input.
        if (1..STEP).contains(&from.wrapping_sub(self.place)) {
            let skipped = io::copy(&mut (&mut self.input).take(from - self.place), &mut io::sink())?;
            self.place += skipped;
        } else if from != self.place {
            self.place = self.input.seek(SeekFrom::Start(from))?;
        }
        let mut bytes = Vec::new();
        self.place += (&mut self.input).take(len).read_to_end(&mut bytes)? as u64;
        Ok(bytes)
    }

    /// A chunk whose record is longer than what it holds may have swallowed others, if its length is damaged: goes to the
    /// next whole chunk between `from` and the record's end, if there is one.
    pub fn look_inside(&mut self, frame: &Frame, from: u64) -> io::Result<()> {
        if let Some(found) = self.scan(frame.body + from, frame.body + frame.len)? {
            self.at = found;
        }
        Ok(())
    }

    /// Opcode and length at the current place.
    fn prefix(&mut self, left: u64) -> io::Result<Option<(u8, u64)>> {
        if left < PREFIX {
            return Ok(None);
        }
        let bytes = self.read(self.at, PREFIX)?;
        let mut fields = Fields(&bytes);
        Ok(fields.u8().zip(fields.u64()))
    }

    fn skip_to_chunk(&mut self, cut: Option<Frame>) -> io::Result<Found> {
        let from = self.at;
        let next = self.scan(from + 1, self.end)?;
        self.at = next.unwrap_or(self.end);
        Ok(match (next, cut) {
            (None, Some(cut)) => Found::Cut(cut),
            _ => Found::Lost(self.at - from),
        })
    }

    /// The first place from `from` to before `to` where a chunk stands whose header agrees with itself and the file.
    fn scan(&mut self, from: u64, to: u64) -> io::Result<Option<u64>> {
        const WINDOW: u64 = 1 << 16;
        const HEADER: u64 = 64;
        let mut at = from;
        while at < to {
            let window = self.read(at, WINDOW + HEADER)?;
            for offset in 0..WINDOW.min(to - at) {
                let Some(candidate) = window.get(offset as usize..) else { break };
                if candidate.first() == Some(&op::CHUNK) && is_chunk(candidate, self.end - at - offset) {
                    return Ok(Some(at + offset));
                }
            }
            at += WINDOW;
        }
        Ok(None)
    }
}

/// Whether these bytes, of which the file has `left`, begin a chunk: its lengths agree, and its compression is known.
fn is_chunk(bytes: &[u8], left: u64) -> bool {
    let mut fields = Fields(bytes.get(1..).unwrap_or_default());
    let Some(len) = fields.u64() else { return false };
    let Some(header) = ChunkHeader::read(&mut fields) else { return false };
    let exact = len.checked_sub(header.bytes) == Some(header.compressed_bytes);
    let known = match header.compression.as_str() {
        "" => header.compressed_bytes == header.uncompressed_bytes,
        "zstd" | "lz4" => true,
        _ => false,
    };
    exact && known && PREFIX.checked_add(len).is_some_and(|all| all <= left)
}

/// The head of a chunk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ChunkHeader {
    /// Length of the records [bytes].
    pub uncompressed_bytes: u64,
    /// CRC-32 of the records; 0 if not given.
    pub crc: u32,
    /// `zstd`, `lz4`, or empty.
    pub compression: String,
    /// Length of the compressed records [bytes].
    pub compressed_bytes: u64,
    /// Length of this head [bytes].
    pub bytes: u64,
}

impl ChunkHeader {
    pub fn read(fields: &mut Fields<'_>) -> Option<Self> {
        let before = fields.0.len();
        let (_start, _end) = (fields.u64()?, fields.u64()?);
        let (uncompressed_bytes, crc) = (fields.u64()?, fields.u32()?);
        let compression = fields.string()?;
        let compressed_bytes = fields.u64()?;
        let bytes = (before - fields.0.len()) as u64;
        Some(Self { uncompressed_bytes, crc, compression, compressed_bytes, bytes })
    }
}

/// Reads the fields of a record: little-endian numbers, strings and maps with their lengths before them. `None` where the
/// bytes end too early or text is no UTF-8.
pub(super) struct Fields<'a>(pub &'a [u8]);

impl<'a> Fields<'a> {
    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*head)
    }

    pub fn bytes(&mut self, count: usize) -> Option<&'a [u8]> {
        let (head, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(head)
    }

    pub fn u8(&mut self) -> Option<u8> {
        self.array().map(u8::from_le_bytes)
    }

    pub fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    pub fn string(&mut self) -> Option<String> {
        let length = self.u32()? as usize;
        String::from_utf8(self.bytes(length)?.to_vec()).ok()
    }

    pub fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let length = self.u32()? as usize;
        let mut entries = Fields(self.bytes(length)?);
        let mut map = BTreeMap::new();
        while !entries.0.is_empty() {
            let (key, value) = (entries.string()?, entries.string()?);
            map.insert(key, value);
        }
        Some(map)
    }

    /// The next record of a chunk: kind and body.
    pub fn record(&mut self) -> Option<(u8, &'a [u8])> {
        let op = self.u8()?;
        let length = usize::try_from(self.u64()?).ok()?;
        Some((op, self.bytes(length)?))
    }
}

/// The bytes of the summary: schemas and channels stand in it once more. `None` if there is none, or it is damaged.
pub(super) fn summary<R: Read + Seek>(frames: &mut Frames<R>) -> io::Result<Option<Vec<u8>>> {
    const FOOTER: u64 = PREFIX + 20;
    let magic = MAGIC.len() as u64;
    let Some(footer) = frames.end.checked_sub(FOOTER + magic).filter(|at| *at >= magic) else { return Ok(None) };
    let tail = frames.body(&Frame { op: op::FOOTER, body: footer, len: FOOTER + magic })?;
    let mut fields = Fields(&tail);
    let start = match fields.record() {
        Some((op::FOOTER, body)) if fields.0 == MAGIC => Fields(body).u64().unwrap_or(0),
        _ => 0,
    };
    if start < magic || start > footer || footer - start > RECORD_BYTES_MAX {
        return Ok(None);
    }
    let mut bytes = frames.body(&Frame { op: 0, body: start, len: footer - start })?;
    // The CRC is over the summary and the footer up to the CRC itself.
    let Some((crc, before)) =
        tail.get(..FOOTER as usize).and_then(|footer| footer.split_last_chunk::<4>()).map(|(b, c)| (c, b))
    else {
        return Ok(None);
    };
    let mut sum = flate2::Crc::new();
    sum.update(&bytes);
    sum.update(before);
    let saved = u32::from_le_bytes(*crc);
    if saved != 0 && saved != sum.sum() {
        bytes.clear();
    }
    Ok(Some(bytes).filter(|bytes| !bytes.is_empty()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::io::Cursor;

    /// A chunk record with `body` as its uncompressed content.
    fn chunk(body: &[u8]) -> Vec<u8> {
        let mut record = vec![op::CHUNK];
        record.extend((40 + body.len() as u64).to_le_bytes());
        record.extend([0; 16]);
        record.extend((body.len() as u64).to_le_bytes());
        record.extend([0; 8]); // no CRC, no compression
        record.extend((body.len() as u64).to_le_bytes());
        record.extend(body);
        record
    }

    fn walk(bytes: Vec<u8>) -> Vec<Found> {
        let mut frames = Frames::new(Cursor::new(bytes)).unwrap().unwrap();
        let mut found = Vec::new();
        while !matches!(found.last(), Some(Found::End(_))) {
            found.push(frames.advance().unwrap());
        }
        found
    }

    #[test]
    fn what_is_no_mcap_is_not_walked() {
        for bytes in [&b""[..], b"\x89MCAP", b"PK\x03\x04 and more"] {
            assert!(Frames::new(Cursor::new(bytes)).unwrap().is_none());
        }
    }

    #[test]
    fn a_walk_goes_on_after_a_damaged_length() {
        let (a, b) = (chunk(b"aaaa"), chunk(&vec![7; 70_000]));
        let mut bytes = [&MAGIC[..], &a, &b].concat();
        bytes[9 + 6] = 0xFF; // a high byte of the first length
        let start = (8 + a.len() + 9) as u64;
        let whole = Frame { op: op::CHUNK, body: start, len: 40 + 70_000 };
        assert_eq!(walk(bytes), [Found::Lost(a.len() as u64), Found::Record(whole), Found::End(false)]);
    }

    #[test]
    fn a_chunk_across_a_window_is_found() {
        for gap in [65_530usize, 65_535, 65_536, 65_537, 131_000] {
            let bytes = [&MAGIC[..], &vec![0; gap], &chunk(b"x")].concat();
            let found = walk(bytes);
            assert_eq!(found[0], Found::Lost(gap as u64));
            assert!(matches!(found[1], Found::Record(_)), "{gap}");
        }
    }

    #[test]
    fn the_beginning_of_a_cut_chunk_is_kept() {
        let bytes = [&MAGIC[..], &chunk(b"abcdef")].concat();
        let cut = bytes[..bytes.len() - 2].to_vec();
        let frame = Frame { op: op::CHUNK, body: 17, len: 44 };
        assert_eq!(walk(cut), [Found::Cut(frame), Found::End(false)]);
    }

    proptest! {
        #[test]
        fn every_byte_is_a_record_or_counted_as_lost(body in prop::collection::vec(any::<u8>(), 0..400)) {
            let total = body.len() as u64;
            let mut seen = 0;
            for found in walk([&MAGIC[..], &body].concat()) {
                seen += match found {
                    Found::Record(frame) | Found::Cut(frame) => PREFIX + frame.len,
                    Found::Lost(bytes) => bytes,
                    Found::End(_) => 0,
                };
            }
            prop_assert_eq!(seen, total);
        }

        #[test]
        fn fields_of_any_bytes_do_not_panic(bytes in prop::collection::vec(any::<u8>(), 0..80)) {
            let _ = Fields(&bytes).map();
            let _ = Fields(&bytes).record();
            let _ = ChunkHeader::read(&mut Fields(&bytes));
            let _ = is_chunk(&bytes, 80);
        }
    }
}
