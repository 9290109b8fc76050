//! Reading and writing by the ending of the name.

use std::path::Path;

use super::csv_read::{self, Layout};
use super::{Recording, RecordingError, csv_write, mcap_read, mcap_write};

/// What could be read, and what was in the way.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Loaded {
    /// all before the damage
    pub recording: Recording,
    /// topics of other encodings, left out
    pub skipped: Vec<String>,
    /// what ended reading early
    pub damage: Option<RecordingError>,
}

/// The formats.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Format {
    Mcap,
    Csv,
    CsvGz,
}

/// The format of a file by its name.
pub(super) fn format(path: &Path) -> Result<Format, RecordingError> {
    let name = path.file_name().map(|n| n.to_string_lossy().to_lowercase());
    let name = name.unwrap_or_default();
    [
        (".mcap", Format::Mcap),
        (".csv", Format::Csv),
        (".csv.gz", Format::CsvGz),
    ]
    .into_iter()
    .find_map(|(ending, format)| name.ends_with(ending).then_some(format))
    .ok_or_else(|| RecordingError::Format {
        path: path.to_owned(),
    })
}

/// Read a recording: `.mcap`, `.csv` or `.csv.gz`.
///
/// # Errors
/// The file is missing, damaged in any place, has no numbers, or says what cannot be understood.
pub fn read(path: &Path) -> Result<Recording, RecordingError> {
    let loaded = salvage(path)?;
    match loaded.damage {
        None => Ok(loaded.recording),
        Some(damage) => Err(damage),
    }
}

/// As [`read`], but a file that is damaged on the way gives what stands before the damage, and the damage.
///
/// # Errors
/// Not even the beginning can be read.
pub fn salvage(path: &Path) -> Result<Loaded, RecordingError> {
    let loaded = match format(path)? {
        Format::Mcap => mcap_read::load(path)?,
        Format::Csv | Format::CsvGz => {
            let table = csv_read::load(path, &Layout::default())?;
            Loaded {
                recording: table.trials.into_iter().next().unwrap_or_default(),
                damage: table.damage,
                skipped: Vec::new(),
            }
        }
    };
    if loaded.recording.streams.is_empty() {
        return Err(loaded.damage.unwrap_or_else(|| RecordingError::Content {
            path: path.to_owned(),
            place: "topics".into(),
            reason: match loaded.skipped.as_slice() {
                [] => "there are none".into(),
                others => format!(
                    "none holds rows of numbers in JSON; found {}",
                    others.join(", ")
                ),
            },
        }));
    }
    Ok(loaded)
}

/// Write a recording as `.mcap`, `.csv` or `.csv.gz`, replacing the file as a whole. Beside a table, `NAME.json`
/// carries what has no place in it.
///
/// # Errors
/// The file cannot be written, or the format cannot hold this recording.
pub fn write(path: &Path, recording: &Recording) -> Result<(), RecordingError> {
    match format(path)? {
        Format::Mcap => mcap_write::write(path, recording),
        format => csv_write::write(path, recording, format == Format::CsvGz),
    }
}
