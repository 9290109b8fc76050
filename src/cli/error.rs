//! What the user is told when a command cannot do its work.

use std::path::PathBuf;
use std::process::ExitCode;

use thiserror::Error;

use crate::compare::CompareError;
use crate::mujoco::MujocoError;
use crate::policy::PolicyError;
use crate::randomise::RandomiseError;
use crate::recording::RecordingError;
use crate::report::ReportError;
use crate::rig::RigError;
use crate::rollout::RolloutError;
use crate::run_dir::RunDirError;
use crate::sysid::SysidError;
use crate::task::TaskError;
use crate::train::TrainError;
use crate::train::config::SettingError;

/// A command's failure: one sentence that names file, key and reason.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CliError {
    /// A file cannot be read or written.
    #[error(transparent)]
    RunDir(#[from] RunDirError),
    /// A configuration file is not valid.
    #[error("{}:{line}: {reason}", file.display())]
    Config {
        /// the file
        file: PathBuf,
        /// line of the mistake, from 1
        line: usize,
        /// what is wrong
        reason: String,
    },
    /// A setting of a configuration file is out of range.
    #[error("{}: {source}", file.display())]
    Setting {
        /// the file
        file: PathBuf,
        /// key, value, range
        source: SettingError,
    },
    /// A policy file is not usable.
    #[error("{}: {source}", file.display())]
    Policy {
        /// the file
        file: PathBuf,
        /// what is wrong
        source: PolicyError,
    },
    /// A checkpoint or dump does not fit.
    #[error("{}: {reason}", file.display())]
    File {
        /// the file
        file: PathBuf,
        /// what is wrong
        reason: String,
    },
    /// A recording or its binding table is not usable.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A rig cannot be built or run.
    #[error("{}: {source}", file.display())]
    Rig {
        /// the rig file
        file: PathBuf,
        /// what is wrong
        source: RigError,
    },
    /// The engine failed.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The model does not fit the task.
    #[error(transparent)]
    Task(#[from] TaskError),
    /// A randomisation rule is wrong.
    #[error(transparent)]
    Randomise(#[from] RandomiseError),
    /// Rolling out failed.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// Training failed.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// Model and recordings cannot be compared.
    #[error(transparent)]
    Compare(#[from] CompareError),
    /// A model cannot be identified.
    #[error(transparent)]
    Sysid(#[from] SysidError),
    /// A report cannot be made.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// A change of the model is impossible.
    #[error("cannot set `{change}`: {reason}")]
    Change {
        /// array, with index
        change: String,
        /// what is wrong
        reason: String,
    },
}

impl CliError {
    /// Print the sentence to standard error and return the exit code: 3 for a fatal error of the engine, else 2.
    pub fn report(&self) -> ExitCode {
        eprintln!("phantom: {self}");
        ExitCode::from(if self.engine().is_some_and(MujocoError::is_fatal) {
            3
        } else {
            2
        })
    }

    /// The engine's error at the bottom, if that is what it is.
    fn engine(&self) -> Option<&MujocoError> {
        match self {
            Self::Mujoco(engine)
            | Self::Train(TrainError::Mujoco(engine))
            | Self::Compare(CompareError::Mujoco(engine))
            | Self::Sysid(SysidError::Mujoco(engine)) => Some(engine),
            Self::Rig { source, .. } => match source {
                RigError::Mujoco(engine) => Some(engine),
                RigError::Task(error) => of_task(error),
                RigError::Randomise(error) => of_randomise(error),
                _ => None,
            },
            Self::Task(error) | Self::Train(TrainError::Task(error)) => of_task(error),
            Self::Randomise(error) | Self::Train(TrainError::Randomise(error)) => {
                of_randomise(error)
            }
            Self::Rollout(error) | Self::Train(TrainError::Rollout(error)) => match error {
                RolloutError::Mujoco(engine) => Some(engine),
                RolloutError::Task(error) => of_task(error),
                RolloutError::Randomise(error) => of_randomise(error),
                _ => None,
            },
            _ => None,
        }
    }
}

fn of_task(error: &TaskError) -> Option<&MujocoError> {
    match error {
        TaskError::Mujoco(engine) => Some(engine),
        _ => None,
    }
}

fn of_randomise(error: &RandomiseError) -> Option<&MujocoError> {
    match error {
        RandomiseError::Mujoco(engine) => Some(engine),
        RandomiseError::Rule { .. } | RandomiseError::Ensemble { .. } => None,
    }
}
