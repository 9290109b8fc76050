//! The loop closed: a policy makes recordings, they make a better model, and that a better policy.
//!
//! ```text
//!        πₖ ── machine ──> recordings ──> gap: physics the model lacks ──> sysid: posterior p(θ)      [identify]
//!        ↑                                                                       │
//!        └────────── natural policy gradient on models θ ~ p, from πₖ ───────────┘                    [round]
//! ```
//!
//! Each round adds recordings; the posterior is that of all of them. Training goes on from the policy of the round before,
//! for the mean over the models or for the worst share ε of the trajectories ([`Objective`]). What any further training
//! would give is told by two references that begin with the same policy and train as long: on the nominal model, and on
//! the truth of the rig, which no real machine tells.
//!
//! | symbol | name |
//! | --- | --- |
//! | π₀ | `policy`, trained on the nominal model |
//! | ε | [`Objective::Epopt`] |
//! | models drawn from the posterior | `models` |
//!
//! Reference: Rajeswaran, Ghotra, Ravindran, Levine 2017, "`EPOpt`: learning robust neural network policies using model
//! ensembles", algorithm 2, with the particle filter replaced by identification.

mod figures;
mod identify;
mod round;

pub use figures::report;
pub use identify::{Found, Identified, Known, Missing, Named};
pub use round::{FindMissing, Reference, Round, Search, Tracking, Watch};

use std::path::PathBuf;
use std::sync::Arc;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;
use thiserror::Error;

use crate::compare::CompareError;
use crate::mujoco::{Model, MujocoError};
use crate::policy::{AffineGaussian, PolicyError};
use crate::recording::RecordingError;
use crate::report::ReportError;
use crate::rig::{Rig, RigError, behaviour};
use crate::run_dir::RunDirError;
use crate::supplement::SupplementError;
use crate::sysid::SysidError;
use crate::sysid::problem::ProblemConfig;
use crate::train::TrainError;
use crate::train::config::TrainConfig;
use crate::train::folder::FolderError;

/// What training on several models is for.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Objective {
    /// the mean over the models
    Mean,
    /// the worst share of the trajectories, above 0 and below 1
    Epopt(f64),
}

/// How the posterior is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IdentifyMethod {
    /// by inverse dynamics along an estimated motion
    Joint,
    /// by simulations of windows; for joints that stick
    Shooting,
}

/// How the loop runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AdaptConfig {
    /// times round the loop
    pub rounds: usize,
    /// what the machine does to be identified, beside the policy; see `phantom record --list`
    pub behaviours: Vec<String>,
    /// duration of each of those recordings, s
    pub seconds: f64,
    /// most effects that are looked for in a round; 0: physics that the model lacks is not looked for
    pub max_effects: usize,
    /// identify from the policy's own recordings too
    pub identify_policy: bool,
    /// how to identify
    pub identify_method: IdentifyMethod,
    /// length of a window of shooting, s
    pub identify_window_s: f64,
    /// time step of identification, s; the model's when absent
    pub identify_timestep_s: Option<f64>,
    /// most iterations of identification (joint: at a level of unexplained force)
    pub identify_iterations: Option<usize>,
    /// models drawn from the posterior
    pub models: usize,
    /// mean over models, or `EPOpt`
    pub objective: Objective,
    /// spirals on the machine after each round
    pub rollouts: usize,
    /// train each round from a policy that does nothing, not from that of the round before
    pub from_scratch: bool,
    /// settings of the training of each round; `training.train.seed` is that of everything drawn
    #[serde(deserialize_with = "over_own")]
    pub training: TrainConfig,
}

/// Settings of training of which what is not given is this loop's own, not that of a first training.
fn over_own<'de, D: Deserializer<'de>>(given: D) -> Result<TrainConfig, D::Error> {
    fn put(into: &mut Value, given: Value) {
        match (into, given) {
            (Value::Object(into), Value::Object(given)) => {
                for (key, value) in given {
                    put(into.entry(key).or_insert(Value::Null), value);
                }
            }
            (into, given) => *into = given,
        }
    }
    let given = Value::deserialize(given)?;
    let own = AdaptConfig::default().training;
    let mut all = serde_json::to_value(own).map_err(D::Error::custom)?;
    put(&mut all, given);
    serde_json::from_value(all).map_err(D::Error::custom)
}

impl Default for AdaptConfig {
    fn default() -> Self {
        let mut training = TrainConfig::default();
        training.train.iterations = 15;
        // machines of the posterior have no turns, and the references are to differ from them in the model alone
        training.train.symmetric = false;
        training.train.trajectories = 600;
        // explore as at the end of a first training, not as at its beginning
        training.npg.initial_log_sigma = -2.0;
        training.npg.step_size_delta = 0.06;
        training.npg.advantage_clip = 5.0;
        training.npg.anneal_iterations = 15;
        training.train.evaluate_every = 0;
        Self {
            rounds: 2,
            behaviours: vec!["multi_sine".to_owned()],
            seconds: 2.0,
            max_effects: 4,
            identify_policy: false,
            identify_method: IdentifyMethod::Shooting,
            identify_window_s: 0.2,
            identify_timestep_s: None,
            identify_iterations: None,
            models: 16,
            objective: Objective::Mean,
            rollouts: 5,
            from_scratch: false,
            training,
        }
    }
}

/// A loop and where it writes.
#[derive(Debug)]
pub struct Adaptation {
    /// folder of everything
    pub out: PathBuf,
    /// nominal model file
    pub model_path: PathBuf,
    /// the same, loaded
    pub model: Arc<Model>,
    /// the machine
    pub rig: Rig,
    /// π₀
    pub policy: AffineGaussian,
    /// what to identify
    pub parameters: ProblemConfig,
    /// settings
    pub config: AdaptConfig,
    /// worker threads
    pub threads: usize,
}

/// What can go wrong.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum AdaptError {
    /// A run cannot be made or continued.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A file cannot be read or written.
    #[error(transparent)]
    RunDir(#[from] RunDirError),
    /// Training cannot be set up.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// The machine cannot do what it should.
    #[error("rig: {0}")]
    Rig(#[from] RigError),
    /// A recording cannot be read or written.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A recording does not fit the model.
    #[error(transparent)]
    Compare(#[from] CompareError),
    /// The model cannot be identified.
    #[error(transparent)]
    Sysid(#[from] SysidError),
    /// The engine failed.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The policy is not one of the pushing task.
    #[error("policy: {0}")]
    Policy(#[from] PolicyError),
    /// The page cannot be made.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// A custom element of a model cannot be used.
    #[error("{}: {source}", file.display())]
    Supplement {
        /// the model file
        file: PathBuf,
        /// what is wrong
        source: SupplementError,
    },
    /// A setting is out of range.
    #[error("`{key}` is {value}, expected {expected}")]
    Setting {
        /// key
        key: &'static str,
        /// found
        value: String,
        /// accepted
        expected: &'static str,
    },
    /// The machine broke down where a recording of it is needed.
    #[error("round {round}: the rig broke down during `{behaviour}`: {reason}")]
    Breakdown {
        /// from 1
        round: usize,
        /// what it did
        behaviour: String,
        /// what was seen
        reason: String,
    },
    /// Missing physics cannot be looked for.
    #[error("round {round}: missing physics: {reason}")]
    Gap {
        /// from 1
        round: usize,
        /// why
        reason: String,
    },
    /// A file does not hold what it should.
    #[error("{}: {reason}", file.display())]
    File {
        /// the file
        file: PathBuf,
        /// what is wrong
        reason: String,
    },
}

impl AdaptConfig {
    /// Check every range.
    ///
    /// # Errors
    /// The first that is wrong.
    pub fn validate(&self) -> Result<(), AdaptError> {
        let refuse = |key, value: String, expected| {
            Err(AdaptError::Setting {
                key,
                value,
                expected,
            })
        };
        for (key, value, most) in [
            ("rounds", self.rounds, 1000),
            ("models", self.models, 100_000),
            ("rollouts", self.rollouts, 100_000),
        ] {
            if !(1..=most).contains(&value) {
                return refuse(key, value.to_string(), "a whole number of at least 1");
            }
        }
        if self.behaviours.is_empty() && !self.identify_policy {
            return refuse(
                "behaviours",
                "empty".to_owned(),
                "a behaviour, or identify_policy = true",
            );
        }
        for name in &self.behaviours {
            behaviour::entry(name)?;
        }
        let keys = ["seconds", "identify_window_s", "identify_timestep_s"];
        let seconds = [
            Some(self.seconds),
            Some(self.identify_window_s),
            self.identify_timestep_s,
        ];
        for (key, value) in keys.into_iter().zip(seconds) {
            if let Some(value) = value
                && !(value.is_finite() && value > 0.0)
            {
                return refuse(key, value.to_string(), "a positive number");
            }
        }
        if let Objective::Epopt(share) = self.objective
            && !(share > 0.0 && share < 1.0)
        {
            return refuse("objective.epopt", share.to_string(), "above 0 and below 1");
        }
        self.training.validate().map_err(TrainError::from)?;
        Ok(())
    }

    /// Settings of the training of a round.
    pub(crate) fn training(&self) -> TrainConfig {
        let mut config = self.training.clone();
        config.npg.epopt_epsilon = match self.objective {
            Objective::Mean => 1.0,
            Objective::Epopt(share) => share,
        };
        config
    }
}
