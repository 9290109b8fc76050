//! What a policy is trained on: start states, observations, rewards.
//!
//! A [`Task`] is stateless and shared by all threads; everything that changes lives in the [`Data`] it is handed.
//! [`push::PushTask`] is the paper's task; tests bring smaller ones.

mod goal;
pub mod push;
pub mod spiral;
pub mod symmetry;
mod turns;

use thiserror::Error;

use crate::mujoco::{Data, MujocoError};
use crate::rng::Stream;

/// What can be wrong with a task or with the model it is to run on.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TaskError {
    /// The engine refused.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The model is not one this task can run on.
    #[error("the model does not fit the task: {reason}")]
    Model {
        /// what is missing or has the wrong size
        reason: String,
    },
    /// A setting is out of range.
    #[error("`{key}` is {value}, expected {expected}")]
    Setting {
        /// configuration key
        key: &'static str,
        /// found
        value: String,
        /// accepted range
        expected: &'static str,
    },
    /// No start state without contact was found.
    #[error(
        "no start state clear of the object in {tries} draws; are the start ranges of the model right?"
    )]
    Start {
        /// number of draws
        tries: usize,
    },
}

impl TaskError {
    /// The engine's error at the bottom, if that is what it is.
    pub fn engine(&self) -> Option<&MujocoError> {
        match self {
            Self::Mujoco(engine) => Some(engine),
            _ => None,
        }
    }
}

/// Neighbouring observations of one meaning, for diagnostics and plots.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ObservationGroup {
    /// short name, such as `goal`
    pub name: &'static str,
    /// columns of the observation
    pub columns: std::ops::Range<usize>,
}

/// A control problem on a `MuJoCo` model.
pub trait Task: Send + Sync {
    /// Number of observations.
    fn n_observation(&self) -> usize;

    /// Number of actions.
    fn n_action(&self) -> usize;

    /// Names of the observations, in order.
    fn observation_names(&self) -> Vec<String>;

    /// Names of the actions, in order.
    fn action_names(&self) -> Vec<String>;

    /// The groups that cover the observation.
    fn observation_groups(&self) -> Vec<ObservationGroup>;

    /// Put freshly reset `data` into a random start state, goal included, positions and velocities evaluated.
    ///
    /// # Errors
    /// When the engine fails or no admissible start is found.
    fn start(&self, data: &mut Data, rng: &mut Stream) -> Result<(), TaskError>;

    /// Draw a new goal for `data`, which already is in some state.
    ///
    /// # Errors
    /// When the engine fails.
    fn new_goal(&self, data: &mut Data, rng: &mut Stream) -> Result<(), TaskError>;

    /// Let what is no physics, such as a goal that moves, go on for `seconds`: after every control step, before its reward.
    fn pass(&self, data: &mut Data, seconds: f64) {
        let _ = (data, seconds);
    }

    /// Write the observation of the current state.
    fn observe(&self, data: &Data, observation: &mut [f64]);

    /// Number of inputs of the value function.
    fn n_value_input(&self) -> usize {
        self.n_observation()
    }

    /// Write what the value function sees of the current state. It exists in simulation only, so it may see more than
    /// the policy: any function of the state leaves the gradient unbiased, and a better one makes it less noisy.
    fn observe_value(&self, data: &Data, input: &mut [f64]) {
        self.observe(data, input);
    }

    /// The reward of the step that led to the current state.
    fn reward(&self, data: &Data) -> f64;

    /// The error the task is about, in m; reported, never optimised directly.
    fn distance_m(&self, data: &Data) -> f64;
}
