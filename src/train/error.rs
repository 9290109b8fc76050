use thiserror::Error;

use super::config::SettingError;
use crate::mujoco::MujocoError;
use crate::npg::NpgError;
use crate::policy::PolicyError;
use crate::randomise::RandomiseError;
use crate::rollout::RolloutError;
use crate::task::TaskError;
use crate::team::TeamError;

/// What can go wrong in training.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A setting is out of range.
    #[error(transparent)]
    Setting(#[from] SettingError),
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
    /// The update failed.
    #[error(transparent)]
    Npg(#[from] NpgError),
    /// The processes of the team cannot go on together.
    #[error(transparent)]
    Team(#[from] TeamError),
    /// The checkpoint's policy is unusable.
    #[error("checkpoint: {0}")]
    Policy(#[from] PolicyError),
    /// The checkpoint is unusable.
    #[error("checkpoint: {0}")]
    Checkpoint(String),
}

impl TrainError {
    /// The engine's error at the bottom, if that is what it is.
    pub fn engine(&self) -> Option<&MujocoError> {
        match self {
            Self::Mujoco(engine) => Some(engine),
            Self::Task(error) => error.engine(),
            Self::Randomise(error) => error.engine(),
            Self::Rollout(error) => error.engine(),
            _ => None,
        }
    }
}
