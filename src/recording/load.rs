//! Reading and writing by the ending of the name.

use std::path::Path;

use super::{
    Binding, Recording, RecordingError, binding::read_trials, csv_read, csv_write, mcap_read,
    mcap_write,
};

/// What could be read, and what was in the way.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Loaded {
    /// all before the damage; one but for tables with a column of trials
    pub trials: Vec<Recording>,
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
    let mut trials = read_trials(path, &Binding::default())?;
    // without a column of trials there is one
    Ok(trials.pop().unwrap_or_default())
}

/// As [`read_trials`], but a file that is damaged on the way gives what stands before the damage, and the damage.
///
/// # Errors
/// Not even the beginning can be read.
pub fn salvage(path: &Path, binding: &Binding) -> Result<Loaded, RecordingError> {
    let mut loaded = match format(path)? {
        Format::Mcap => mcap_read::load(path)?,
        Format::Csv | Format::CsvGz => csv_read::load(path, binding.layout())?,
    };
    if loaded.trials.iter().all(|r| r.streams.is_empty()) {
        return Err(loaded.damage.unwrap_or_else(|| RecordingError::Content {
            path: path.to_owned(),
            place: "content".into(),
            reason: match loaded.skipped.as_slice() {
                [] => "there is no data".into(),
                others => format!(
                    "no topic holds rows of numbers in JSON; found {}",
                    others.join(", ")
                ),
            },
        }));
    }
    for recording in &mut loaded.trials {
        binding.apply(recording)?;
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
