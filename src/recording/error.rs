use std::fmt::Display;
use std::path::{Path, PathBuf};

use crate::run_dir::RunDirError;

/// Why a recording, or the table that binds it to a model, cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The name does not tell the format.
    #[error("{}: a recording ends in .mcap, .csv or .csv.gz", path.display())]
    Format {
        /// the file
        path: PathBuf,
    },
    /// The file cannot be opened or read.
    #[error("cannot read {}: {reason}", path.display())]
    Read {
        /// the file
        path: PathBuf,
        /// the system's answer
        reason: String,
    },
    /// The file cannot be written.
    #[error("cannot write {}: {reason}", path.display())]
    Write {
        /// the file
        path: PathBuf,
        /// the system's answer, or the channel that has no place in this format
        reason: String,
    },
    /// The bytes are cut off or changed.
    #[error("{}: damaged at byte {offset}: {reason}", path.display())]
    Damaged {
        /// the file
        path: PathBuf,
        /// where reading stopped
        offset: u64,
        /// what was found there
        reason: String,
    },
    /// The file is whole, and what it says cannot be understood.
    #[error("{}: {place}: {reason}", path.display())]
    Content {
        /// the file
        path: PathBuf,
        /// topic and time, or line and column
        place: String,
        /// what was found, and what was expected
        reason: String,
    },
    /// A binding table is not valid.
    #[error("{}:{line}: {reason}", path.display())]
    Table {
        /// the table
        path: PathBuf,
        /// line of the mistake, from 1
        line: usize,
        /// what is wrong
        reason: String,
    },
    /// A binding table and a recording do not fit.
    #[error("binding: {reason}")]
    Binding {
        /// the entry, and what was expected
        reason: String,
    },
}

impl RecordingError {
    pub(super) fn read(path: &Path, reason: &impl Display) -> Self {
        Self::Read {
            path: path.to_owned(),
            reason: reason.to_string(),
        }
    }

    /// The reason of a failed write, with the file only once.
    pub(super) fn write(path: &Path, error: &RunDirError) -> Self {
        Self::Write {
            path: path.to_owned(),
            reason: match error {
                RunDirError::Write { reason, .. } => reason.to_string(),
                other => other.to_string(),
            },
        }
    }
}
