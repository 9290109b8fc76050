use std::{io, path::PathBuf};

/// What can go wrong with the files of a run.
///
/// Each message is a whole sentence with file and reason, so nothing is chained behind it.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunDirError {
    /// A folder could not be made.
    #[error("cannot create folder {}: {reason}", path.display())]
    CreateFolder {
        /// The folder.
        path: PathBuf,
        /// The system's answer.
        reason: io::Error,
    },
    /// A file, or a file in this folder, could not be written.
    #[error("cannot write {}: {reason}", path.display())]
    Write {
        /// File or folder.
        path: PathBuf,
        /// The system's answer.
        reason: io::Error,
    },
    /// A file or folder could not be read.
    #[error("cannot read {}: {reason}", path.display())]
    Read {
        /// File or folder.
        path: PathBuf,
        /// The system's answer.
        reason: io::Error,
    },
    /// The folder for a new run has one already.
    #[error("{} already holds a run (it has {marker}): choose another folder, or resume that run", path.display())]
    Occupied {
        /// The folder.
        path: PathBuf,
        /// The file that gave it away.
        marker: &'static str,
    },
    /// The folder to open has no run.
    #[error("{} holds no run: neither {} nor {} is there", path.display(), super::PROVENANCE_FILE, super::METRICS_FILE)]
    NotARun {
        /// The folder.
        path: PathBuf,
    },
    /// A JSON file is malformed, or not what was expected.
    #[error("{}: at key `{key}`: {reason}", path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// Dotted path of the offending key, `.` for the whole document.
        key: String,
        /// The parser's reason, with line and column.
        reason: serde_json::Error,
    },
    /// A value has no JSON form.
    #[error("cannot write {}: {reason}", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// The serialiser's reason.
        reason: serde_json::Error,
    },
    /// The metrics on disk have other columns than this program writes.
    #[error("{}: columns are `{found}`, expected `{expected}`", path.display())]
    Columns {
        /// The metrics file.
        path: PathBuf,
        /// Columns of this program, with commas.
        expected: String,
        /// Columns on disk, with commas.
        found: String,
    },
    /// A row of the metrics cannot be used.
    #[error("{}: line {line}: {reason}", path.display())]
    Row {
        /// The metrics file.
        path: PathBuf,
        /// Line number from 1.
        line: u64,
        /// What is wrong with it.
        reason: String,
    },
    /// A value was given for a column that does not exist.
    #[error("{} has no column `{name}`", path.display())]
    UnknownColumn {
        /// The metrics file.
        path: PathBuf,
        /// The column asked for.
        name: String,
    },
    /// Rows must come in order of iteration.
    #[error("{}: iteration {iteration} comes after iteration {last}", path.display())]
    OutOfOrder {
        /// The metrics file.
        path: PathBuf,
        /// The iteration of the refused row.
        iteration: u64,
        /// The iteration of the row before.
        last: u64,
    },
}
