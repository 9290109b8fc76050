//! Files of a search.

use std::fmt::Display;
use std::fs;
use std::path::{Path, PathBuf};

use crate::cli::CliError;
use crate::gap::effect::ModelFile;
use crate::gap::{Keeper, Outcome, diff, figures};
use crate::run_dir;

/// Where results go; made before the work begins.
pub(in crate::cli) struct Folder {
    path: PathBuf,
}

/// What was written.
pub(in crate::cli) struct Written {
    pub model: PathBuf,
    pub report: PathBuf,
    pub json: String,
}

impl Folder {
    pub(in crate::cli) fn new(path: &Path) -> Result<Self, CliError> {
        fs::create_dir_all(path).map_err(|error| refuse(path, &error))?;
        Ok(Self {
            path: path.to_owned(),
        })
    }

    pub(in crate::cli) fn write(
        &self,
        title: &str,
        base: &ModelFile,
        outcome: &Outcome,
    ) -> Result<Written, CliError> {
        let name = base.path.file_name().unwrap_or_default().to_string_lossy();
        let diff = diff::diff(&base.xml, &outcome.model, &name);
        let model = self.path.join("model.xml");
        run_dir::write_atomic(&model, outcome.model.as_bytes())?;
        run_dir::write_atomic(&self.path.join("model.diff"), diff.as_bytes())?;
        let report = self.path.join("report.html");
        let page = figures::report(title, outcome, &diff);
        run_dir::write_atomic(&report, page.html()?.as_bytes())?;
        let file = self.path.join("gap.json");
        let json =
            serde_json::to_string_pretty(&outcome.answer).map_err(|error| refuse(&file, &error))?;
        run_dir::write_atomic(&file, (json.clone() + "\n").as_bytes())?;
        Ok(Written {
            model,
            report,
            json,
        })
    }
}

/// Finished stages, in the folder `stages` of the results.
pub(super) struct Stages {
    path: PathBuf,
}

impl Stages {
    /// Those of an earlier run of the same `key`; others are thrown away.
    pub(super) fn new(folder: &Folder, key: &str) -> Result<Self, CliError> {
        let path = folder.path.join("stages");
        let file = path.join("key");
        if fs::read_to_string(&file).is_ok_and(|found| found == key) {
            return Ok(Self { path });
        }
        if path.exists() {
            fs::remove_dir_all(&path).map_err(|error| refuse(&path, &error))?;
        }
        fs::create_dir_all(&path).map_err(|error| refuse(&path, &error))?;
        run_dir::write_atomic(&file, key.as_bytes())?;
        Ok(Self { path })
    }

    /// Throws them away: the results are written.
    pub(super) fn finish(self) -> Result<(), CliError> {
        fs::remove_dir_all(&self.path).map_err(|error| refuse(&self.path, &error))
    }
}

impl Keeper for Stages {
    fn load(&mut self, stage: &str) -> Option<Vec<u8>> {
        fs::read(self.path.join(stage)).ok()
    }

    fn save(&mut self, stage: &str, bytes: &[u8]) {
        // what cannot be kept is done again
        let _ = run_dir::write_atomic(&self.path.join(stage), bytes);
    }
}

fn refuse(file: &Path, reason: &dyn Display) -> CliError {
    CliError::File {
        file: file.to_owned(),
        reason: reason.to_string(),
    }
}
