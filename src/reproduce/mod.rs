//! The experiments of Lowrey et al. 2018 again: Table 1 and the figures.
//!
//! Three policies, [`Case`], differ in the object's mass in training; each is trained once for every seed into
//!
//! ```text
//! DIR/policies/CASE-seedS/     run folders, as of `phantom train`          [policies]
//! DIR/results/CASE-seedS.json  rollouts of them, in simulation and on a rig  [table]
//! ```
//!
//! and both are reused as long as they fit what is asked for, so that a study that was killed goes on.
//!
//! In place of the paper's hardware stands a virtual rig: every rollout is one on another machine of the family that the
//! rig file describes, seen through its sensors, with the object's mass put to the paper's 0.34 kg.
//!
//! | quantity | name |
//! | --- | --- |
//! | distance of object and target in the plane, mean over a rollout, cm | `mean_distance_cm` |
//! | mean of that over the rollouts of one policy, then over seeds | [`table::Row`] |
//!
//! Reference: Lowrey, Kolev, Dao, Rajeswaran, Todorov 2018, section VI, Table 1 and figures 3 to 7.

pub mod figures;
pub mod machine;
mod mass;
pub mod policies;
pub mod table;

use std::path::PathBuf;
use std::sync::Arc;

use thiserror::Error;

use crate::compare::CompareError;
use crate::mujoco::{Model, MujocoError};
use crate::randomise::RandomiseError;
use crate::recording::RecordingError;
use crate::report::ReportError;
use crate::rig::{RigConfig, RigError};
use crate::rollout::RolloutError;
use crate::run_dir::RunDirError;
use crate::task::TaskError;
use crate::train::TrainError;
use crate::train::config::TrainConfig;
use crate::train::folder::FolderError;

/// Mass of the object on the machine and in every test, kg.
pub const TRUE_MASS_KG: f64 = 0.34;

/// How a policy was trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Case {
    /// with the right mass
    Correct,
    /// with a wrong one
    Incorrect,
    /// with masses around the wrong one, wide enough to include the right one
    Ensemble,
}

impl Case {
    /// All, in the order of the paper's table.
    pub const ALL: [Self; 3] = [Self::Correct, Self::Incorrect, Self::Ensemble];

    /// Part of file names.
    pub fn name(self) -> &'static str {
        match self {
            Self::Correct => "correct",
            Self::Incorrect => "incorrect",
            Self::Ensemble => "ensemble",
        }
    }

    /// As the paper's table has it.
    pub fn label(self) -> &'static str {
        match self {
            Self::Correct => "0.34 kg (correct)",
            Self::Incorrect => "0.40 kg (incorrect)",
            Self::Ensemble => "0.40 ± 0.03 kg (ensemble)",
        }
    }

    /// Mean and standard deviation of the object's mass in training, kg.
    pub fn mass_kg(self) -> [f64; 2] {
        match self {
            Self::Correct => [TRUE_MASS_KG, 0.0],
            Self::Incorrect => [0.40, 0.0],
            Self::Ensemble => [0.40, 0.03],
        }
    }

    /// The paper's distances in simulation and on hardware, cm.
    pub fn paper_cm(self) -> [f64; 2] {
        match self {
            Self::Correct => [2.1, 2.33],
            Self::Incorrect => [2.65, 3.4],
            Self::Ensemble => [2.15, 2.52],
        }
    }
}

/// What is asked for.
#[derive(Debug, Clone)]
pub struct Study {
    /// folder of everything
    pub out: PathBuf,
    /// model file
    pub model_path: PathBuf,
    /// the same, loaded
    pub model: Arc<Model>,
    /// the machine that stands in for hardware
    pub rig: RigConfig,
    /// settings of training that all cases share
    pub base: TrainConfig,
    /// training seeds
    pub seeds: Vec<u64>,
    /// rollouts of each policy, in simulation and on the rig
    pub n_rollout: usize,
    /// worker threads
    pub threads: usize,
}

/// What can go wrong.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReproduceError {
    /// A run cannot be made or continued.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A file cannot be read or written.
    #[error(transparent)]
    RunDir(#[from] RunDirError),
    /// Training cannot be set up.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// Rolling out failed.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// The rig cannot be built or run.
    #[error("rig: {0}")]
    Rig(#[from] RigError),
    /// A recording cannot be compared with the model.
    #[error(transparent)]
    Compare(#[from] CompareError),
    /// A recording cannot be written.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The page or a figure cannot be made.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// The engine failed.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The model is not one of the pushing task.
    #[error(transparent)]
    Task(#[from] TaskError),
    /// Masses cannot be drawn.
    #[error(transparent)]
    Randomise(#[from] RandomiseError),
    /// A file does not hold what it should.
    #[error("{}: {reason}", file.display())]
    File {
        /// the file
        file: PathBuf,
        /// what is wrong
        reason: String,
    },
    /// The machine broke down where a recording of it is needed.
    #[error("the rig broke down under the {case} policy of seed {seed}: {reason}")]
    Breakdown {
        /// of the policy
        case: &'static str,
        /// of the policy
        seed: u64,
        /// what was seen
        reason: String,
    },
}

impl Study {
    /// Policy updates of each run.
    pub fn iterations(&self) -> u64 {
        self.base.train.iterations
    }

    /// The first seed: the one of which figures show single rollouts.
    pub fn first_seed(&self) -> u64 {
        self.seeds.first().copied().unwrap_or(0)
    }
}
