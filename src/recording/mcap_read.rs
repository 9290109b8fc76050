//! Reading MCAP one record at a time, so that memory holds the numbers and one chunk.
//!
//! Nothing is taken from a chunk before its checksum is right. Sizes that a file claims are checked before memory is
//! asked for: a chunk has at most [`CHUNK_LIMIT`] bytes and [`EXPANSION_LIMIT`] times its compressed size.

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::Path;

use mcap::records::{ChunkHeader, Record, op};

use super::RecordingError;
use super::load::Loaded;
use super::mcap_lengths;
use super::mcap_streams::Streams;

/// Name of the metadata record.
pub(super) const RECORDING: &str = "recording";
/// Key of a topic's channels.
pub(super) const CHANNELS: &str = "channels";
/// Key of a topic's nominal rate.
pub(super) const RATE: &str = "rate_hz";
/// Key of the log time of stamp 0.
pub(super) const ZERO: &str = "zero_ns";
/// Key of the noise levels.
pub(super) const NOISE: &str = "noise_sigma";

/// Largest chunk or record in bytes; writers make chunks of about 1 MB.
const CHUNK_LIMIT: u64 = 256 << 20;
/// Largest ratio of a chunk to its compressed bytes; recordings reach some hundred when nothing moves.
const EXPANSION_LIMIT: u64 = 2_000;
/// Opcode and length.
const PREFIX: u64 = 9;

/// Read all there is before the first damage.
pub(super) fn load(path: &Path) -> Result<Loaded, RecordingError> {
    let file = File::open(path).map_err(|error| RecordingError::read(path, &error))?;
    let mut reader = Reader {
        input: BufReader::with_capacity(1 << 18, file),
        offset: 0,
        crc: crc32fast::Hasher::new(),
        compressed: Vec::new(),
        chunk: Vec::new(),
        streams: Streams::default(),
    };
    let damage = reader.run().err().map(|stop| match stop {
        Stop::Io(error) if error.kind() != io::ErrorKind::UnexpectedEof => {
            RecordingError::read(path, &error)
        }
        Stop::Io(_) => damaged(path, reader.offset, "the file ends here".into()),
        Stop::Damage(reason) => damaged(path, reader.offset, reason),
        Stop::Content { place, reason } => RecordingError::Content {
            path: path.to_owned(),
            place,
            reason,
        },
    });
    reader.streams.finish(path, damage)
}

fn damaged(path: &Path, offset: u64, reason: String) -> RecordingError {
    RecordingError::Damaged {
        path: path.to_owned(),
        offset,
        reason,
    }
}

/// Why reading ended early.
pub(super) enum Stop {
    Io(io::Error),
    Damage(String),
    Content { place: String, reason: String },
}

impl From<io::Error> for Stop {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<mcap::McapError> for Stop {
    fn from(error: mcap::McapError) -> Self {
        Self::Damage(error.to_string())
    }
}

struct Reader<R> {
    input: R,
    /// begin of the record at hand, from the start of the file
    offset: u64,
    /// of all bytes before the record at hand
    crc: crc32fast::Hasher,
    compressed: Vec<u8>,
    chunk: Vec<u8>,
    streams: Streams,
}

impl<R: Read> Reader<R> {
    fn run(&mut self) -> Result<(), Stop> {
        self.magic()?;
        self.crc.update(mcap::MAGIC);
        self.offset = mcap::MAGIC.len() as u64;
        loop {
            let mut prefix = [0; PREFIX as usize];
            self.input.read_exact(&mut prefix)?;
            let (opcode, length) = split_prefix(prefix);
            match opcode {
                op::DATA_END => return self.end(length),
                op::CHUNK | op::CHANNEL | op::METADATA | op::MESSAGE => {
                    self.crc.update(&prefix);
                    let mut body = std::mem::take(&mut self.compressed);
                    read_body(&mut self.input, length, &mut body)?;
                    self.crc.update(&body);
                    self.record(opcode, &body)?;
                    self.compressed = body;
                }
                op::FOOTER => return Err(Stop::Damage("a footer before the end of data".into())),
                _ => {
                    self.crc.update(&prefix);
                    self.skip(length)?;
                }
            }
            self.offset = self.offset.saturating_add(PREFIX + length);
        }
    }

    fn magic(&mut self) -> Result<(), Stop> {
        let mut magic = [0; 8];
        self.input.read_exact(&mut magic)?;
        if magic == mcap::MAGIC {
            return Ok(());
        }
        Err(Stop::Damage("these are not MCAP's magic bytes".into()))
    }

    fn record(&mut self, opcode: u8, body: &[u8]) -> Result<(), Stop> {
        if opcode != op::CHUNK {
            return self.streams.record(opcode, body);
        }
        let Record::Chunk { header, data } = mcap_lengths::parse(opcode, body)? else {
            return Ok(());
        };
        let mut chunk = std::mem::take(&mut self.chunk);
        unpack(&header, &data, &mut chunk)?;
        let mut rest = chunk.as_slice();
        while let Some((prefix, after)) = rest.split_first_chunk() {
            let (opcode, length) = split_prefix(*prefix);
            let inner = usize::try_from(length)
                .ok()
                .and_then(|n| after.split_at_checked(n));
            let (body, after) =
                inner.ok_or_else(|| Stop::Damage("a record is longer than its chunk".into()))?;
            self.streams.record(opcode, body)?;
            rest = after;
        }
        if !rest.is_empty() {
            return Err(Stop::Damage("a chunk ends within a record".into()));
        }
        self.chunk = chunk;
        Ok(())
    }

    /// The checksum of the data, and the end of the file.
    fn end(&mut self, length: u64) -> Result<(), Stop> {
        let mut body = Vec::new();
        read_body(&mut self.input, length, &mut body)?;
        let Record::DataEnd(end) = mcap_lengths::parse(op::DATA_END, &body)? else {
            return Ok(());
        };
        let found = std::mem::take(&mut self.crc).finalize();
        if end.data_section_crc != 0 && end.data_section_crc != found {
            return Err(Stop::Damage("the checksum of the file is wrong".into()));
        }
        // the summary repeats what was read; only whether it is there matters
        loop {
            self.offset = self.offset.saturating_add(PREFIX + length);
            let mut prefix = [0; PREFIX as usize];
            self.input.read_exact(&mut prefix)?;
            let (opcode, length) = split_prefix(prefix);
            self.skip(length)?;
            if opcode == op::FOOTER {
                return self.magic();
            }
        }
    }

    fn skip(&mut self, length: u64) -> Result<(), Stop> {
        let mut left = length;
        let mut block = [0; 4096];
        while left > 0 {
            let n = left.min(block.len() as u64) as usize;
            self.input.read_exact(&mut block[..n])?;
            self.crc.update(&block[..n]);
            left -= n as u64;
        }
        Ok(())
    }
}

fn split_prefix(prefix: [u8; PREFIX as usize]) -> (u8, u64) {
    let [opcode, length @ ..] = prefix;
    (opcode, u64::from_le_bytes(length))
}

/// The next `length` bytes; memory grows with what is there, not with what is claimed.
fn read_body(input: &mut impl Read, length: u64, body: &mut Vec<u8>) -> Result<(), Stop> {
    if length > CHUNK_LIMIT {
        return Err(Stop::Damage(format!(
            "a record of {length} bytes, more than the limit of {CHUNK_LIMIT}"
        )));
    }
    body.clear();
    if input.take(length).read_to_end(body)? as u64 == length {
        return Ok(());
    }
    Err(Stop::Io(io::ErrorKind::UnexpectedEof.into()))
}

/// The records of a chunk, once they are known to be right.
fn unpack(header: &ChunkHeader, data: &[u8], chunk: &mut Vec<u8>) -> Result<(), Stop> {
    let size = header.uncompressed_size;
    let expansion = (data.len() as u64).saturating_mul(EXPANSION_LIMIT);
    if size > CHUNK_LIMIT.min(expansion.max(1 << 16)) {
        return Err(Stop::Damage(format!("a chunk claims {size} bytes")));
    }
    chunk.clear();
    match header.compression.as_str() {
        "" => chunk.extend_from_slice(data),
        "zstd" => {
            chunk.reserve(size as usize);
            zstd::bulk::Decompressor::new()?
                .decompress_to_buffer(data, chunk)
                .map_err(|error| Stop::Damage(format!("a chunk does not unpack: {error}")))?;
        }
        other => {
            return Err(Stop::Content {
                place: "a chunk".into(),
                reason: format!("packed by `{other}`, expected zstd or nothing"),
            });
        }
    }
    if chunk.len() as u64 != size {
        return Err(Stop::Damage(format!(
            "a chunk has {} bytes, not {size}",
            chunk.len()
        )));
    }
    if header.uncompressed_crc != 0 && header.uncompressed_crc != crc32fast::hash(chunk) {
        return Err(Stop::Damage("the checksum of a chunk is wrong".into()));
    }
    Ok(())
}
