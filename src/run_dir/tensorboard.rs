//! Scalars for `TensorBoard`.
//!
//! An event file is a sequence of records,
//!
//! ```text
//! length: u64 | mask(crc(length)): u32 | event: [u8; length] | mask(crc(event)): u32     (little endian)
//! mask(c) = rotate_right(c, 15) + 0xa282ead8,  crc = CRC-32C (Castagnoli)
//! ```
//!
//! and an event is a protobuf message of few fields:
//!
//! ```text
//! Event      1 wall_time: double   2 step: int64   3 file_version: string   5 summary   7 session_log
//! Summary    1 value (repeated)         Value  1 tag: string   2 simple_value: float
//! SessionLog 1 status: enum, 1 = START
//! ```
//!
//! References: the `TFRecord` guide of `TensorFlow`; `event.proto` and `summary.proto` of `TensorBoard`.

use std::{
    fs::{self, File, OpenOptions},
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use super::RunDirError;

/// Folder of the event files inside a run folder.
pub(super) const FOLDER: &str = "tensorboard";

/// Writes one event file.
#[derive(Debug)]
pub(super) struct EventWriter {
    path: PathBuf,
    out: BufWriter<File>,
}

impl EventWriter {
    /// Begins a new event file in `<dir>/tensorboard/`.
    ///
    /// With `restart_at`, viewers drop what earlier files of the folder say about that step and later ones.
    pub(super) fn create(dir: &Path, restart_at: Option<u64>) -> Result<Self, RunDirError> {
        let folder = dir.join(FOLDER);
        fs::create_dir_all(&folder).map_err(|reason| RunDirError::CreateFolder {
            path: folder.clone(),
            reason,
        })?;
        let (path, file) = new_file(&folder)?;
        let mut writer = Self {
            path,
            out: BufWriter::new(file),
        };
        let mut version = Message::event(now(), None);
        version.bytes(3, b"brain.Event:2");
        writer.write(&version)?;
        if let Some(step) = restart_at {
            let mut start = Message::default();
            start.integer(1, 1);
            let mut restart = Message::event(now(), Some(step));
            restart.bytes(7, &start.0);
            writer.write(&restart)?;
        }
        writer.flush()?;
        Ok(writer)
    }

    /// Appends one event that carries all these scalars; what is not finite is left out.
    pub(super) fn scalars(&mut self, step: u64, values: &[(&str, f64)]) -> Result<(), RunDirError> {
        let mut summary = Message::default();
        for (tag, value) in values.iter().filter(|(_, value)| value.is_finite()) {
            let mut entry = Message::default();
            entry.bytes(1, tag.as_bytes());
            entry.float(2, *value as f32);
            summary.bytes(1, &entry.0);
        }
        let mut event = Message::event(now(), Some(step));
        event.bytes(5, &summary.0);
        self.write(&event)?;
        self.flush()
    }

    fn write(&mut self, event: &Message) -> Result<(), RunDirError> {
        write_record(&mut self.out, &event.0).map_err(|reason| self.failed(reason))
    }

    fn flush(&mut self) -> Result<(), RunDirError> {
        self.out.flush().map_err(|reason| self.failed(reason))
    }

    fn failed(&self, reason: io::Error) -> RunDirError {
        RunDirError::Write {
            path: self.path.clone(),
            reason,
        }
    }
}

/// A new file named after the current second, or the next free one: runs may be resumed within a second.
fn new_file(folder: &Path) -> Result<(PathBuf, File), RunDirError> {
    let mut seconds = now().as_secs();
    loop {
        let path = folder.join(format!("events.out.tfevents.{seconds}.phantom"));
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(file) => return Ok((path, file)),
            Err(reason) if reason.kind() == io::ErrorKind::AlreadyExists => seconds += 1,
            Err(reason) => return Err(RunDirError::Write { path, reason }),
        }
    }
}

fn now() -> Duration {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default()
}

fn write_record(out: &mut impl Write, event: &[u8]) -> io::Result<()> {
    let length = (event.len() as u64).to_le_bytes();
    out.write_all(&length)?;
    out.write_all(&masked_crc(&length).to_le_bytes())?;
    out.write_all(event)?;
    out.write_all(&masked_crc(event).to_le_bytes())
}

fn masked_crc(bytes: &[u8]) -> u32 {
    crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// CRC-32C bit by bit: a few hundred bytes an iteration need no table.
fn crc32c(bytes: &[u8]) -> u32 {
    const POLYNOMIAL: u32 = 0x82f6_3b78; // Castagnoli's, bits reversed
    let mut crc = u32::MAX;
    for &byte in bytes {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            let carry = crc & 1;
            crc >>= 1;
            if carry == 1 {
                crc ^= POLYNOMIAL;
            }
        }
    }
    !crc
}

/// A protobuf message under construction: each field is (number << 3 | wire type), then its value.
#[derive(Debug, Default)]
struct Message(Vec<u8>);

impl Message {
    fn event(wall_time: Duration, step: Option<u64>) -> Self {
        let mut event = Self::default();
        event.varint(1 << 3 | 1);
        event.0.extend(wall_time.as_secs_f64().to_le_bytes());
        if let Some(step) = step {
            event.integer(2, step);
        }
        event
    }

    fn integer(&mut self, field: u64, value: u64) {
        self.varint(field << 3);
        self.varint(value);
    }

    fn bytes(&mut self, field: u64, value: &[u8]) {
        self.varint(field << 3 | 2);
        self.varint(value.len() as u64);
        self.0.extend(value);
    }

    fn float(&mut self, field: u64, value: f32) {
        self.varint(field << 3 | 5);
        self.0.extend(value.to_le_bytes());
    }

    /// Seven bits a byte, lowest first; the high bit says that more follow.
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }
}

#[cfg(test)]
mod tests;
