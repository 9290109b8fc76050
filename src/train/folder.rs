//! What a run leaves on disk: settings, a copy of the model, metrics, policies, and the checkpoint it goes on from.
//!
//! In a team, process 0 alone has a folder.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::columns::{columns, row};
use super::config::TrainConfig;
use super::{Checkpoint, IterationRecord, TrainError, Trainer};
use crate::policy::AffineGaussian;
use crate::rollout::Diverged;
use crate::run_dir::{self, Metrics, PROVENANCE_FILE, Provenance, RunDir, RunDirError};

/// Resolved settings of a run (TOML).
pub const CONFIG_FILE: &str = "config.toml";
/// Copy of the model.
pub const MODEL_FILE: &str = "model.xml";
/// Where the model was.
pub const MODEL_PATH_FILE: &str = "model_path.json";
/// State to go on from.
pub const CHECKPOINT_FILE: &str = "checkpoint.json";
/// Policy after the latest checkpoint.
pub const POLICY_LAST: &str = "policy_last.json";
/// Policy of the best evaluation.
pub const POLICY_BEST: &str = "policy_best.json";
/// Breakdowns written a run; more of them say nothing new.
const DUMP_LIMIT: u64 = 100;

/// Why a run cannot be made or continued in a folder.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FolderError {
    /// A file cannot be read or written.
    #[error(transparent)]
    RunDir(#[from] RunDirError),
    /// Training failed.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A file does not hold what it should.
    #[error("{}: {reason}", file.display())]
    File {
        /// the file
        file: PathBuf,
        /// what is wrong
        reason: String,
    },
}

/// A dumped breakdown, all that `phantom replay` needs.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dump {
    /// model file
    pub model: PathBuf,
    /// settings of the run
    pub config: TrainConfig,
    /// the breakdown
    pub diverged: Diverged,
}

/// A run folder with its metrics open.
pub struct RunFolder {
    dir: RunDir,
    model: PathBuf,
    metrics: Metrics,
}

impl RunFolder {
    /// A new folder for the run that `trainer` begins on the file `model`.
    ///
    /// # Errors
    /// The folder holds a run, or a file cannot be read or written.
    pub fn create(
        out: impl Into<PathBuf>,
        model: &Path,
        trainer: &Trainer,
        provenance: &Provenance,
    ) -> Result<Self, FolderError> {
        let dir = RunDir::create(out)?;
        dir.write_json(PROVENANCE_FILE, provenance)?;
        let text = toml::to_string(trainer.config()).map_err(|error| FolderError::File {
            file: dir.file(CONFIG_FILE),
            reason: error.to_string(),
        })?;
        let header = format!(
            "# resolved settings of this run\n# model: {}\n",
            model.display()
        );
        run_dir::write_atomic(&dir.file(CONFIG_FILE), (header + &text).as_bytes())?;
        run_dir::write_atomic(&dir.file(MODEL_FILE), &read(model)?)?;
        dir.write_json(MODEL_PATH_FILE, &model)?;
        let columns = columns(trainer);
        let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
        let metrics = Metrics::create(dir.path(), &columns)?;
        Ok(Self {
            dir,
            model: model.to_owned(),
            metrics,
        })
    }

    /// The folder of the run that `trainer` was restored to.
    ///
    /// # Errors
    /// The folder holds no run, or its metrics do not fit.
    pub fn resume(
        folder: impl Into<PathBuf>,
        model: &Path,
        trainer: &Trainer,
    ) -> Result<Self, FolderError> {
        let dir = RunDir::open(folder)?;
        let columns = columns(trainer);
        let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
        let iteration = trainer.checkpoint().iteration;
        let metrics = Metrics::resume(dir.path(), &columns, iteration)?;
        Ok(Self {
            dir,
            model: model.to_owned(),
            metrics,
        })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        self.dir.path()
    }

    /// Write what an iteration left: metrics, policies, breakdowns, and last the checkpoint that vouches for them.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn save(
        &mut self,
        trainer: &Trainer,
        record: &IterationRecord,
        last: bool,
    ) -> Result<(), FolderError> {
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
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn dump_unreported(&self, trainer: &Trainer) -> Result<(), FolderError> {
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
    ) -> Result<(), FolderError> {
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

/// Train `trainer`, which has not begun, to its last iteration in `folder`; a run that was killed there goes on, to the
/// same bits. `watch` sees every iteration and says whether to go on. Returns the policy of the last iteration, or
/// nothing when stopped before.
///
/// # Errors
/// The folder holds a run of other settings or of another model, a file cannot be read or written, or training fails.
pub fn train_in(
    folder: &Path,
    model: &Path,
    mut trainer: Trainer,
    watch: &mut dyn FnMut(&IterationRecord, &Checkpoint) -> bool,
) -> Result<Option<AffineGaussian>, FolderError> {
    let checkpoint_file = folder.join(CHECKPOINT_FILE);
    let mut run = if checkpoint_file.exists() {
        same_run(folder, model, trainer.config())?;
        let checkpoint: Checkpoint = run_dir::read_json(&checkpoint_file)?;
        if checkpoint.iteration >= trainer.config().train.iterations {
            return Ok(Some(checkpoint.policy));
        }
        trainer.restore(checkpoint)?;
        RunFolder::resume(folder, model, &trainer)?
    } else {
        // killed before its first iteration: nothing to keep
        if folder.join(PROVENANCE_FILE).exists() {
            std::fs::remove_dir_all(folder).map_err(|reason| RunDirError::Write {
                path: folder.to_owned(),
                reason,
            })?;
        }
        let threads = trainer.sampler().threads().current_num_threads();
        let provenance = Provenance::capture(threads, std::env::args());
        RunFolder::create(folder, model, &trainer, &provenance)?
    };
    let total = trainer.config().train.iterations;
    while trainer.checkpoint().iteration < total {
        let record = match trainer.advance() {
            Ok(record) => record,
            Err(error) => {
                run.dump_unreported(&trainer)?;
                return Err(error.into());
            }
        };
        let go_on = watch(&record, trainer.checkpoint());
        run.save(&trainer, &record, record.iteration == total || !go_on)?;
        if !go_on && record.iteration < total {
            return Ok(None);
        }
    }
    Ok(Some(trainer.checkpoint().policy.clone()))
}

/// The run in `folder` has the settings `config`, but for the number of iterations, and the model `model`.
fn same_run(folder: &Path, model: &Path, config: &TrainConfig) -> Result<(), FolderError> {
    let refuse = |name: &str, reason: String| {
        Err(FolderError::File {
            file: folder.join(name),
            reason,
        })
    };
    let text = String::from_utf8_lossy(&read(&folder.join(CONFIG_FILE))?).into_owned();
    let mut found: TrainConfig = match toml::from_str(&text) {
        Ok(found) => found,
        Err(error) => return refuse(CONFIG_FILE, error.message().replace('\n', ", ")),
    };
    found.train.iterations = config.train.iterations;
    if found != *config {
        return refuse(
            CONFIG_FILE,
            "the run in this folder has other settings: choose another folder".to_owned(),
        );
    }
    if read(&folder.join(MODEL_FILE))? != read(model)? {
        return refuse(
            MODEL_FILE,
            format!(
                "the model {} has changed since the run began",
                model.display()
            ),
        );
    }
    Ok(())
}

fn read(path: &Path) -> Result<Vec<u8>, RunDirError> {
    std::fs::read(path).map_err(|reason| RunDirError::Read {
        path: path.to_owned(),
        reason,
    })
}
