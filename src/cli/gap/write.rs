//! Files of a search.

use std::fmt::Display;
use std::fs;
use std::path::{Path, PathBuf};

use crate::cli::CliError;
use crate::gap::effect::ModelFile;
use crate::gap::{Outcome, figures};
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
        let diff = figures::diff(&base.xml, &outcome.model, &name);
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

fn refuse(file: &Path, reason: &dyn Display) -> CliError {
    CliError::File {
        file: file.to_owned(),
        reason: reason.to_string(),
    }
}
