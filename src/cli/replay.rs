//! `phantom replay`: look at a breakdown again.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use super::{CliError, load_model};
use crate::run_dir;
use crate::train::Trainer;
use crate::train::folder::Dump;

/// Run a trajectory again that broke down in training
///
/// Takes a `diverged-*.json` of a run folder. Exit code 0: it broke down again in the same way; 1: it did not.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom replay runs/seed3/diverged-00012-000.json
  phantom replay dump.json --model edited.xml       does the edited model still break down?")]
pub(super) struct ReplayArgs {
    /// The dump
    #[arg(value_name = "FILE.json")]
    dump: PathBuf,
    /// Model (MJCF) [default: the one of the run]
    #[arg(long, value_name = "FILE.xml")]
    model: Option<PathBuf>,
}

impl ReplayArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        let dump: Dump = run_dir::read_json(&self.dump)?;
        let seed = dump.config.train.seed;
        let model = load_model(self.model.as_deref().unwrap_or(&dump.model))?;
        let trainer = Trainer::new(model, dump.config, 1).map_err(|error| CliError::File {
            file: self.dump.clone(),
            reason: error.to_string(),
        })?;
        let seen = trainer
            .sampler()
            .replay(seed, &dump.diverged)
            .map_err(|error| CliError::File {
                file: self.dump.clone(),
                reason: error.to_string(),
            })?;
        println!(
            "recorded: control step {}: {}",
            dump.diverged.step, dump.diverged.reason
        );
        let Some((step, reason)) = seen else {
            println!("replayed: did not break down");
            return Ok(ExitCode::FAILURE);
        };
        println!("replayed: control step {step}: {reason}");
        let same = step == dump.diverged.step && reason == dump.diverged.reason;
        Ok(ExitCode::from(u8::from(!same)))
    }
}
