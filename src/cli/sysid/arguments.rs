//! Arguments of `phantom sysid`.

use std::path::{Path, PathBuf};

use clap::Args;

use super::super::{CliError, count};
use crate::recording::{Binding, Recording, read_trials};
use crate::sysid::joint::JointSettings;

#[derive(Debug, Args)]
pub(super) struct FitArgs {
    /// Recordings to identify from: .mcap, .csv or .csv.gz
    #[arg(value_name = "FILE", required = true)]
    pub(super) files: Vec<PathBuf>,
    /// Model (MJCF) [default: xml/phantom.xml]
    #[arg(long, value_name = "FILE.xml")]
    pub(super) model: Option<PathBuf>,
    /// What to estimate, with priors, noise and norms (TOML)
    #[arg(long, value_name = "FILE.toml", required = true)]
    parameters: Option<PathBuf>,
    /// Folder for the results; made if need be
    #[arg(long, value_name = "DIR", default_value = "sysid")]
    pub(super) out: PathBuf,
    /// Recordings that are not used, to see whether the identified model is better
    #[arg(long, value_name = "FILE", num_args = 1..)]
    pub(super) holdout: Vec<PathBuf>,
    /// Names, scales and units of the recordings' channels (TOML)
    #[arg(long, value_name = "FILE.toml")]
    binding: Option<PathBuf>,
    /// How to roll out held-out recordings, as in `phantom compare` (TOML)
    #[arg(long, value_name = "FILE.toml")]
    pub(super) protocol: Option<PathBuf>,
    /// Models to draw from the posterior
    #[arg(long, value_name = "N", default_value = "32", value_parser = count)]
    pub(super) ensemble: usize,
    /// Seed of the draws
    #[arg(long, value_name = "S", default_value = "0")]
    pub(super) seed: u64,
    /// Most iterations at a level of unexplained force
    #[arg(long, value_name = "N", value_parser = count)]
    max_iterations: Option<usize>,
    /// Also fit without each sensor, and predict it
    #[arg(long)]
    pub(super) leave_one_sensor_out: bool,
    /// Print sysid.json
    #[arg(long)]
    pub(super) json: bool,
}

impl FitArgs {
    pub(super) fn parameters(&self) -> &Path {
        // clap has made sure of it
        self.parameters.as_deref().unwrap_or(Path::new(""))
    }

    pub(super) fn settings(&self) -> JointSettings {
        let default = JointSettings::default();
        JointSettings {
            max_iterations: self.max_iterations.unwrap_or(default.max_iterations),
            ..default
        }
    }

    pub(super) fn recordings(
        &self,
        files: &[PathBuf],
    ) -> Result<Vec<(String, Recording)>, CliError> {
        read_all(files, self.binding.as_deref())
    }
}

/// Recordings with names: the file's, and the trial's where a file has several.
pub(super) fn read_all(
    files: &[PathBuf],
    binding: Option<&Path>,
) -> Result<Vec<(String, Recording)>, CliError> {
    let binding = match binding {
        Some(file) => Binding::from_file(file)?,
        None => Binding::default(),
    };
    let mut all = Vec::new();
    for file in files {
        let trials = read_trials(file, &binding)?;
        let several = trials.len() > 1;
        let name = file
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        for recording in trials {
            let name = if several {
                format!("{name}, trial {}", recording.meta.trial)
            } else {
                name.clone()
            };
            all.push((name, recording));
        }
    }
    Ok(all)
}
