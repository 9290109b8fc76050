//! What the user is told when a command cannot do its work.

use std::path::PathBuf;
use std::process::ExitCode;

use thiserror::Error;

use crate::adapt::AdaptError;
use crate::blind::BlindError;
use crate::compare::CompareError;
use crate::gap::GapError;
use crate::mujoco::MujocoError;
use crate::npg::NpgError;
use crate::policy::PolicyError;
use crate::randomise::RandomiseError;
use crate::recording::RecordingError;
use crate::report::ReportError;
use crate::reproduce::ReproduceError;
use crate::rig::RigError;
use crate::rollout::RolloutError;
use crate::run_dir::RunDirError;
use crate::supplement::SupplementError;
use crate::sysid::SysidError;
use crate::task::TaskError;
use crate::team::TeamError;
use crate::train::TrainError;
use crate::train::config::SettingError;
use crate::train::folder::FolderError;

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
    /// A suite of blind tests cannot be run.
    #[error("{}: {source}", file.display())]
    Blind {
        /// the suite, or the case
        file: PathBuf,
        /// what is wrong
        source: Box<BlindError>,
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
    /// A custom element of a model cannot be used.
    #[error("{}: {source}", file.display())]
    Supplement {
        /// the model file
        file: PathBuf,
        /// what is wrong
        source: SupplementError,
    },
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
    /// What the model lacks cannot be looked for.
    #[error(transparent)]
    Gap(#[from] GapError),
    /// The processes of the team cannot go on together.
    #[error(transparent)]
    Team(#[from] TeamError),
    /// A report cannot be made.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// A policy cannot be adapted.
    #[error(transparent)]
    Adapt(Box<AdaptError>),
    /// An experiment cannot be repeated.
    #[error(transparent)]
    Reproduce(Box<ReproduceError>),
    /// A change of the model is impossible.
    #[error("cannot set `{change}`: {reason}")]
    Change {
        /// array, with index
        change: String,
        /// what is wrong
        reason: String,
    },
}

impl From<FolderError> for CliError {
    fn from(error: FolderError) -> Self {
        match error {
            FolderError::RunDir(error) => error.into(),
            FolderError::Train(error) => error.into(),
            FolderError::File { file, reason } => Self::File { file, reason },
        }
    }
}

impl From<ReproduceError> for CliError {
    fn from(error: ReproduceError) -> Self {
        match error {
            ReproduceError::Folder(error) => error.into(),
            ReproduceError::Train(error) => error.into(),
            ReproduceError::Rollout(error) => error.into(),
            ReproduceError::Mujoco(error) => error.into(),
            other => Self::Reproduce(Box::new(other)),
        }
    }
}

impl CliError {
    /// Print the sentence to standard error and return the exit code.
    pub fn report(&self) -> ExitCode {
        eprintln!("phantom: {self}");
        self.exit_code()
    }

    /// 3 for a fatal error of the engine, else 2.
    pub(super) fn exit_code(&self) -> ExitCode {
        ExitCode::from(if self.is_fatal() { 3 } else { 2 })
    }

    /// Whether it is a fatal error of the engine, here or in another process.
    pub(super) fn is_fatal(&self) -> bool {
        self.engine().is_some_and(MujocoError::is_fatal)
            || self.team().is_some_and(
                |error| matches!(error, TeamError::Elsewhere { is_fatal, .. } if *is_fatal),
            )
    }

    /// Whether other processes of the team cannot know of it.
    pub(super) fn is_lonely(&self) -> bool {
        self.team().is_some_and(TeamError::is_lonely)
    }

    /// The team's error at the bottom, if that is what it is.
    fn team(&self) -> Option<&TeamError> {
        match self {
            Self::Team(error)
            | Self::Train(TrainError::Team(error) | TrainError::Npg(NpgError::Team(error))) => {
                Some(error)
            }
            _ => None,
        }
    }

    /// The engine's error at the bottom, if that is what it is.
    fn engine(&self) -> Option<&MujocoError> {
        match self {
            Self::Mujoco(engine)
            | Self::Compare(CompareError::Mujoco(engine))
            | Self::Sysid(SysidError::Mujoco(engine))
            | Self::Gap(
                GapError::Mujoco(engine)
                | GapError::Sysid(SysidError::Mujoco(engine))
                | GapError::Compare(CompareError::Mujoco(engine)),
            ) => Some(engine),
            Self::Rig { source, .. } => match source {
                RigError::Mujoco(engine) => Some(engine),
                RigError::Task(error) => error.engine(),
                RigError::Randomise(error) => error.engine(),
                _ => None,
            },
            Self::Task(error) => error.engine(),
            Self::Randomise(error) => error.engine(),
            Self::Rollout(error) => error.engine(),
            Self::Train(error) => error.engine(),
            _ => None,
        }
    }
}
