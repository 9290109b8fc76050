//! What a run leaves on disk. In a team, process 0 alone has a folder.

use std::path::{Path, PathBuf};

use super::columns::{columns, row};
use super::plan::Plan;
use super::{Dump, TrainArgs};
use crate::cli::CliError;
use crate::rollout::Diverged;
use crate::run_dir::{self, Metrics, PROVENANCE_FILE, Provenance, RunDir};
use crate::train::{IterationRecord, Trainer};

pub(super) const CONFIG_FILE: &str = "config.toml";
pub(super) const MODEL_FILE: &str = "model.xml";
pub(super) const MODEL_PATH_FILE: &str = "model_path.json";
pub(super) const CHECKPOINT_FILE: &str = "checkpoint.json";
pub(super) const POLICY_LAST: &str = "policy_last.json";
pub(super) const POLICY_BEST: &str = "policy_best.json";
/// Breakdowns written a run; more of them say nothing new.
const DUMP_LIMIT: u64 = 100;

/// A run folder with its metrics open.
pub(super) struct Folder {
    dir: RunDir,
    model: PathBuf,
    metrics: Metrics,
}

impl Folder {
    /// Open a new folder, or that of the run to be resumed.
    pub(super) fn open(
        arguments: &TrainArgs,
        plan: &Plan,
        trainer: &Trainer,
    ) -> Result<Self, CliError> {
        let columns = columns(trainer);
        let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
        let (dir, metrics) = if let Some(folder) = &arguments.resume {
            let dir = RunDir::open(folder)?;
            let iteration = trainer.checkpoint().iteration;
            let metrics = Metrics::resume(dir.path(), &columns, iteration)?;
            (dir, metrics)
        } else {
            let dir = create(arguments, plan, trainer)?;
            let metrics = Metrics::create(dir.path(), &columns)?;
            (dir, metrics)
        };
        Ok(Self {
            dir,
            model: plan.model.clone(),
            metrics,
        })
    }

    /// The folder.
    pub(super) fn path(&self) -> &Path {
        self.dir.path()
    }

    /// Write what an iteration left: metrics, policies, breakdowns, and last the checkpoint that vouches for them.
    pub(super) fn save(
        &mut self,
        trainer: &Trainer,
        record: &IterationRecord,
        last: bool,
    ) -> Result<(), CliError> {
        let state = trainer.checkpoint();
        let row = row(record, state);
        let row: Vec<(&str, f64)> = row
            .iter()
            .map(|(name, value)| (name.as_str(), *value))
            .collect();
        self.metrics.row(record.iteration, &row)?;
        let before = state.n_diverged - record.n_diverged;
        let left = DUMP_LIMIT.saturating_sub(before) as usize;
        self.dump(trainer, record.iteration, record.diverged.iter().take(left))?;
        if record.is_best {
            self.dir.write_json(POLICY_BEST, &state.policy)?;
        }
        let every = trainer.config().train.checkpoint_every;
        if last || record.iteration.is_multiple_of(every) {
            self.dir.write_json(POLICY_LAST, &state.policy)?;
            self.dir.write_json(CHECKPOINT_FILE, state)?;
        }
        Ok(())
    }

    /// Write the breakdowns of an iteration that left nothing to learn from.
    pub(super) fn dump_unreported(&self, trainer: &Trainer) -> Result<(), CliError> {
        let state = trainer.checkpoint();
        let left = DUMP_LIMIT.saturating_sub(state.n_diverged) as usize;
        let breakdowns = trainer.unreported_breakdowns().take(left);
        self.dump(trainer, state.iteration + 1, breakdowns)
    }

    /// Write breakdowns, so that `phantom replay` can show them.
    fn dump<'a>(
        &self,
        trainer: &Trainer,
        iteration: u64,
        breakdowns: impl Iterator<Item = &'a Diverged>,
    ) -> Result<(), CliError> {
        for (number, diverged) in breakdowns.enumerate() {
            let dump = Dump {
                model: self.model.clone(),
                config: trainer.config().clone(),
                diverged: diverged.clone(),
            };
            self.dir
                .write_json(format!("diverged-{iteration:05}-{number:03}.json"), &dump)?;
        }
        Ok(())
    }
}

/// A new folder with all but the metrics.
fn create(arguments: &TrainArgs, plan: &Plan, trainer: &Trainer) -> Result<RunDir, CliError> {
    let threads = trainer.sampler().threads().current_num_threads();
    let provenance = Provenance::capture(threads, std::env::args());
    let provenance = provenance.in_team(trainer.team().size());
    let out = arguments.out.clone().unwrap_or_else(|| {
        let date: String = provenance
            .started
            .chars()
            .filter(char::is_ascii_digit)
            .take(14)
            .collect();
        PathBuf::from(format!("runs/{date}-seed{}", trainer.config().train.seed))
    });
    let dir = RunDir::create(out)?;
    dir.write_json(PROVENANCE_FILE, &provenance)?;
    let text = toml::to_string(trainer.config()).map_err(|error| CliError::File {
        file: dir.file(CONFIG_FILE),
        reason: error.to_string(),
    })?;
    let header = format!(
        "# resolved settings of this run\n# model: {}\n",
        plan.model.display()
    );
    run_dir::write_atomic(&dir.file(CONFIG_FILE), (header + &text).as_bytes())?;
    run_dir::write_atomic(&dir.file(MODEL_FILE), &super::read(&plan.model)?)?;
    dir.write_json(MODEL_PATH_FILE, &plan.model)?;
    Ok(dir)
}
