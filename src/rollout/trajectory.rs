//! What a rollout leaves behind.

use serde::{Deserialize, Serialize};

/// The stream a rollout's model was drawn from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelDraw {
    /// iteration of the draw
    pub iteration: u64,
    /// trajectory index within it
    pub index: u64,
}

/// A state worth starting from again, with the model it occurred in.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Start {
    /// the model: a state with contacts is only sound in the model it came from
    pub model: ModelDraw,
    /// (nq)
    pub qpos: Vec<f64>,
    /// (nv)
    pub qvel: Vec<f64>,
}

/// One rollout. Rows are control steps; `T` of them.
#[derive(Debug, Clone, Default)]
pub struct Trajectory {
    /// (T × `n_observation`)
    pub observations: Vec<f64>,
    /// (T × `n_action`) standard normal numbers behind the actions
    pub noise: Vec<f64>,
    /// (T × `n_action`)
    pub actions: Vec<f64>,
    /// (T)
    pub rewards: Vec<f64>,
    /// (T + 1 × `n_value_input`) what the value function sees; the last row is the true next state
    /// of the truncated trajectory
    pub value_inputs: Vec<f64>,
    /// (T) task error after each step, m
    pub distances_m: Vec<f64>,
    /// a state on the way, drawn uniformly over time
    pub visited: Option<Start>,
    /// set when the simulation broke down; such a trajectory takes no part in learning
    pub diverged: Option<Diverged>,
}

/// What is needed to replay a simulation that broke down.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Diverged {
    /// which warning or non-finite quantity
    pub reason: String,
    /// control step at which it was seen
    pub step: usize,
    /// state and model at the beginning
    pub start: Start,
    /// (nmocap × 3)
    pub mocap_pos: Vec<f64>,
    /// (nmocap × 4)
    pub mocap_quat: Vec<f64>,
    /// (steps × `n_action`) actions up to and including the fatal one
    pub actions: Vec<f64>,
}

impl Trajectory {
    /// Number of control steps.
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// Mean reward a step.
    pub fn mean_reward(&self) -> f64 {
        self.rewards.iter().sum::<f64>() / self.rewards.len().max(1) as f64
    }
}

impl Trajectory {
    pub(super) fn clear(&mut self) {
        self.observations.clear();
        self.noise.clear();
        self.rewards.clear();
        self.value_inputs.clear();
        self.actions.clear();
        self.distances_m.clear();
        self.visited = None;
        self.diverged = None;
    }
}
