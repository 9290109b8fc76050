//! The folder of a run: what made it, its numbers, its results.
//!
//! ```text
//! provenance.json   build, start time, threads, command line     Provenance
//! metrics.csv       one row an iteration                         Metrics
//! tensorboard/      the same numbers as event files              Metrics
//! *.json            whatever its owner writes                    RunDir::write_json
//! ```
//!
//! All files but the two that grow are replaced as a whole, so a kill at any moment leaves each of them
//! readable.

mod atomic;
mod error;
mod metrics;
mod provenance;
mod tensorboard;

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use serde::{Serialize, de::DeserializeOwned};

pub use atomic::{write_atomic, write_atomic_with};
pub use error::RunDirError;
pub use metrics::Metrics;
pub use provenance::Provenance;

/// Name of the [`Provenance`] file.
pub const PROVENANCE_FILE: &str = "provenance.json";
/// Name of the [`Metrics`] table.
pub const METRICS_FILE: &str = "metrics.csv";

/// The folder of one run.
#[derive(Debug, Clone)]
pub struct RunDir {
    path: PathBuf,
}

impl RunDir {
    /// Makes the folder, with its parents, for a new run; one that exists may be used if it holds no run.
    ///
    /// # Errors
    /// The folder cannot be made, holds a run, or cannot be written.
    pub fn create(path: impl Into<PathBuf>) -> Result<Self, RunDirError> {
        let run = Self { path: path.into() };
        if let Some(marker) = run.marker() {
            return Err(RunDirError::Occupied {
                path: run.path,
                marker,
            });
        }
        run.prepare()
    }

    /// As [`RunDir::create`], but takes a folder that holds a run, whose files are then overwritten one by one.
    ///
    /// # Errors
    /// The folder cannot be made or written.
    pub fn create_or_overwrite(path: impl Into<PathBuf>) -> Result<Self, RunDirError> {
        Self { path: path.into() }.prepare()
    }

    /// Opens the folder of an existing run, to read it or to go on with it.
    ///
    /// # Errors
    /// The folder is missing, no folder, or holds no run.
    pub fn open(path: impl Into<PathBuf>) -> Result<Self, RunDirError> {
        let run = Self { path: path.into() };
        let read = |reason| RunDirError::Read {
            path: run.path.clone(),
            reason,
        };
        if !fs::metadata(&run.path).map_err(read)?.is_dir() {
            return Err(read(io::ErrorKind::NotADirectory.into()));
        }
        match run.marker() {
            Some(_) => Ok(run),
            None => Err(RunDirError::NotARun { path: run.path }),
        }
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The path of a file in it.
    pub fn file(&self, name: impl AsRef<Path>) -> PathBuf {
        self.path.join(name)
    }

    /// Replaces a file by indented JSON; see [`write_atomic`].
    ///
    /// JSON has no NaN or infinity: they are written as `null`, which does not read back as a number, so
    /// check before writing.
    ///
    /// # Errors
    /// The value has no JSON form, or the file cannot be written.
    pub fn write_json(
        &self,
        name: impl AsRef<Path>,
        value: &impl Serialize,
    ) -> Result<(), RunDirError> {
        let path = self.file(name);
        let mut bytes = match serde_json::to_vec_pretty(value) {
            Ok(bytes) => bytes,
            Err(reason) => return Err(RunDirError::Encode { path, reason }),
        };
        bytes.push(b'\n');
        write_atomic(&path, &bytes)
    }

    /// Reads a JSON file of this folder; see [`read_json`].
    ///
    /// # Errors
    /// As [`read_json`].
    pub fn read_json<T: DeserializeOwned>(&self, name: impl AsRef<Path>) -> Result<T, RunDirError> {
        read_json(&self.file(name))
    }

    fn marker(&self) -> Option<&'static str> {
        [PROVENANCE_FILE, METRICS_FILE]
            .into_iter()
            .find(|name| self.file(name).exists())
    }

    fn prepare(self) -> Result<Self, RunDirError> {
        let path = &self.path;
        fs::create_dir_all(path).map_err(|reason| RunDirError::CreateFolder {
            path: path.clone(),
            reason,
        })?;
        // permission bits do not tell about read-only mounts, full disks and the superuser: try it
        atomic::temporary_in(path).map_err(|reason| RunDirError::Write {
            path: path.clone(),
            reason,
        })?;
        Ok(self)
    }
}

/// Reads a JSON file, every number to the bits that were written.
///
/// # Errors
/// The file cannot be read; or it is not what was expected, and the message names the key, line and column.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, RunDirError> {
    let bytes = fs::read(path).map_err(|reason| RunDirError::Read {
        path: path.to_owned(),
        reason,
    })?;
    let malformed = |key: String, reason: serde_json::Error| RunDirError::Json {
        path: path.to_owned(),
        key,
        reason,
    };
    let mut json = serde_json::Deserializer::from_slice(&bytes);
    let value = serde_path_to_error::deserialize(&mut json)
        .map_err(|error| malformed(error.path().to_string(), error.into_inner()))?;
    json.end()
        .map_err(|reason| malformed(".".to_owned(), reason))?;
    Ok(value)
}
