//! A recording as MCAP: one topic a stream, rows as JSON; layout in [`super`].

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Error, Write};
use std::path::Path;

use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, McapError, WriteOptions};

use super::mcap_read::{CHANNELS, NOISE, RATE, RECORDING, ZERO};
use super::merge::by_time;
use super::{Recording, RecordingError, Stream, row};
use crate::run_dir::write_atomic_with;

/// Describes a row to other programs.
const SCHEMA: &str = r#"{
  "title": "phantom.Row",
  "type": "object",
  "properties": {
    "values": {"type": "array", "items": {"type": ["number", "null"]}}
  },
  "required": ["values"]
}"#;

/// Write, replacing the file as a whole.
pub(super) fn write(path: &Path, recording: &Recording) -> Result<(), RecordingError> {
    let refuse = |reason: String| RecordingError::Write {
        path: path.to_owned(),
        reason,
    };
    check(recording).map_err(refuse)?;
    let zero = zero_ns(recording).map_err(refuse)?;
    write_atomic_with(path, |file| {
        fill(file, recording, zero).map_err(|error| match error {
            McapError::Io(error) => error,
            other => Error::other(other.to_string()),
        })
    })
    .map_err(|error| RecordingError::write(path, &error))
}

/// Topics are unique and numbers have a JSON form.
fn check(recording: &Recording) -> Result<(), String> {
    for (i, stream) in recording.streams.iter().enumerate() {
        let name = &stream.name;
        if recording.streams[..i].iter().any(|s| s.name == *name) {
            return Err(format!("two streams are called `{name}`"));
        }
        if let Some(at) = stream.values.iter().position(|v| v.is_infinite()) {
            let (sample, column) = (at / stream.channels.len(), at % stream.channels.len());
            return Err(format!(
                "channel `{}` is infinite at {} s, which JSON cannot say",
                stream.channels[column].name,
                stream.time(sample)
            ));
        }
    }
    Ok(())
}

/// Log time of stamp 0: the start, or later where stamps before it would be negative in MCAP.
fn zero_ns(recording: &Recording) -> Result<u64, String> {
    let stamps = || recording.streams.iter().flat_map(|s| &s.stamps_ns).copied();
    let (first, last) = (stamps().min().unwrap_or(0), stamps().max().unwrap_or(0));
    let zero = recording.meta.start_ns.max(first.min(0).unsigned_abs());
    match zero.checked_add_signed(last) {
        Some(_) => Ok(zero),
        None => Err(format!(
            "stamp {last} ns after {zero} ns is beyond MCAP's range"
        )),
    }
}

fn fill(file: &mut File, recording: &Recording, zero: u64) -> Result<(), McapError> {
    let mut writer = WriteOptions::new()
        .compression(Some(Compression::Zstd))
        .compression_threads(0)
        .create(BufWriter::new(file))?;
    writer.write_metadata(&metadata(recording, zero)?)?;
    let schema = writer.add_schema("phantom.Row", "jsonschema", SCHEMA.as_bytes())?;
    let topics = recording
        .streams
        .iter()
        .map(|s| writer.add_channel(schema, &s.name, "json", &description(s)?))
        .collect::<Result<Vec<_>, _>>()?;
    let mut sequence = vec![0; topics.len()];
    let mut text = Vec::new();
    for (index, sample) in by_time(&recording.streams) {
        let stream = &recording.streams[index];
        let log_time = zero.wrapping_add_signed(stream.stamps_ns[sample]);
        row::encode(stream.row(sample), &mut text);
        let header = MessageHeader {
            channel_id: topics[index],
            sequence: sequence[index],
            log_time,
            publish_time: log_time,
        };
        writer.write_to_known_channel(&header, &text)?;
        sequence[index] = sequence[index].wrapping_add(1);
    }
    writer.finish()?;
    writer.into_inner().flush()?;
    Ok(())
}

/// The record of the whole. The noise is a copy for readers that do not look at topics.
fn metadata(recording: &Recording, zero: u64) -> Result<Metadata, McapError> {
    let noise: BTreeMap<&str, f64> = recording
        .streams
        .iter()
        .flat_map(|s| &s.channels)
        .filter_map(|c| Some((c.name.as_str(), c.noise_sigma?)))
        .collect();
    let meta = &recording.meta;
    let entries = [
        ("model_hash", meta.model_hash.clone()),
        ("start_ns", meta.start_ns.to_string()),
        ("source", meta.source.clone()),
        ("trial", meta.trial.clone()),
        ("notes", meta.notes.clone()),
        (ZERO, zero.to_string()),
        (NOISE, json(&noise)?),
    ];
    Ok(Metadata {
        name: RECORDING.to_owned(),
        metadata: entries.map(|(k, v)| (k.to_owned(), v)).into(),
    })
}

/// What a topic says of its stream.
fn description(stream: &Stream) -> Result<BTreeMap<String, String>, McapError> {
    let mut entries = BTreeMap::from([(CHANNELS.to_owned(), json(&stream.channels)?)]);
    if let Some(rate) = stream.rate_hz {
        entries.insert(RATE.to_owned(), json(&rate)?);
    }
    Ok(entries)
}

fn json(value: &impl serde::Serialize) -> Result<String, McapError> {
    serde_json::to_string(value).map_err(|e| McapError::Io(e.into()))
}
