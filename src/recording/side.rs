//! `NAME.json` beside `NAME.csv`: what a table of numbers has no place for.

use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{Channel, Meta, Recording, RecordingError, Stream};
use crate::run_dir::write_atomic;

/// Tells a side file from any other JSON.
const FORMAT: &str = "phantom recording 1";

/// The content of the file.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Side {
    format: String,
    pub(super) meta: Meta,
    pub(super) streams: Vec<SideStream>,
}

/// A stream without its samples.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SideStream {
    name: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    rate_hz: Option<f64>,
    pub(super) channels: Vec<Channel>,
}

impl SideStream {
    /// The stream, empty.
    pub(super) fn stream(&self) -> Stream {
        Stream::new(&self.name, self.rate_hz, self.channels.clone())
    }
}

/// `a/b.csv.gz` → `a/b.json`.
pub(super) fn side_path(table: &Path) -> PathBuf {
    let name = table.file_name().unwrap_or_default().to_string_lossy();
    let lower = name.to_lowercase();
    let ending = if lower.ends_with(".csv.gz") { 7 } else { 4 };
    let stem = name
        .get(..name.len().saturating_sub(ending))
        .unwrap_or(&name);
    table.with_file_name(format!("{stem}.json"))
}

/// The side file of a table; `None` if there is none, or the JSON of that name is something else.
pub(super) fn read(table: &Path) -> Result<Option<Side>, RecordingError> {
    let path = side_path(table);
    if !path.exists() {
        return Ok(None);
    }
    let text = fs::read_to_string(&path).map_err(|error| RecordingError::read(&path, &error))?;
    let ours = serde_json::from_str::<serde_json::Value>(&text)
        .is_ok_and(|value| value.get("format").is_some_and(|f| f == FORMAT));
    if !ours {
        return Ok(None);
    }
    serde_json::from_str(&text)
        .map(Some)
        .map_err(|error| RecordingError::Content {
            path,
            place: format!("line {}", error.line()),
            reason: error.to_string(),
        })
}

/// Write the side file of a table, unless another program's file has its name.
pub(super) fn write(table: &Path, recording: &Recording) -> Result<(), RecordingError> {
    let path = side_path(table);
    let refuse = |reason: String| RecordingError::Write {
        path: path.clone(),
        reason,
    };
    if path.exists() && read(table)?.is_none() {
        return Err(refuse("it is not the side file of a recording".into()));
    }
    let side = Side {
        format: FORMAT.to_owned(),
        meta: recording.meta.clone(),
        streams: recording
            .streams
            .iter()
            .map(|s| SideStream {
                name: s.name.clone(),
                rate_hz: s.rate_hz,
                channels: s.channels.clone(),
            })
            .collect(),
    };
    let text = serde_json::to_string_pretty(&side).map_err(|e| refuse(e.to_string()))?;
    write_atomic(&path, (text + "\n").as_bytes()).map_err(|e| RecordingError::write(&path, &e))
}
