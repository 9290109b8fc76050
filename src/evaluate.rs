//! The paper's test of a policy: follow a target on a spiral, at the model's own time step, without exploration noise.
//!
//! Reported is the mean over all steps of the distance between object and target in the plane (its Table 1). Rollouts
//! differ in the start state of the fingers and in the drawn model.

use std::sync::Arc;

use rayon::prelude::*;
use serde::Serialize;

use crate::mujoco::{Data, Model};
use crate::policy::AffineGaussian;
use crate::randomise::Randomiser;
use crate::rng::{self, Purpose};
use crate::rollout::{RolloutError, breakdown, hold};
use crate::task::push::PushTask;
use crate::task::{Task, spiral};

/// Which rollouts to make.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EvaluationRequest {
    /// number of rollouts
    pub n_rollout: usize,
    /// seed of start states and models
    pub seed: u64,
}

/// One step of an evaluation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Step {
    /// time since the start, s
    pub time_s: f64,
    /// target x, y, m
    pub target_m: [f64; 2],
    /// object x, y, m
    pub object_m: [f64; 2],
    /// distance between them, cm
    pub distance_cm: f64,
}

/// One rollout of an evaluation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rollout {
    /// mean over the whole path, cm
    pub mean_distance_cm: f64,
    /// mean of the root-mean-square torque over motors, N m
    pub rms_torque_nm: f64,
    /// set when the simulation broke down; for the rest of the path the object counts as staying where it was last
    /// seen, so that an early breakdown is no way to a good figure
    #[serde(skip_serializing_if = "Option::is_none")]
    pub diverged: Option<String>,
    /// every physics step, up to a breakdown
    #[serde(skip)]
    pub steps: Vec<Step>,
}

/// All rollouts of an evaluation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// mean over rollouts, cm; not a number when there are none
    pub mean_distance_cm: f64,
    /// standard deviation between rollouts, cm
    pub std_cm: f64,
    /// rollouts in order
    pub rollouts: Vec<Rollout>,
}

/// Evaluate the mean action of `policy` on the spiral.
///
/// # Errors
/// When the policy does not fit the task or the engine fails; a simulation that breaks down is reported in its rollout.
pub fn evaluate(
    model: &Arc<Model>,
    task: &PushTask,
    randomiser: &Randomiser,
    policy: &AffineGaussian,
    request: EvaluationRequest,
) -> Result<Evaluation, RolloutError> {
    let all: Vec<usize> = (0..request.n_rollout).collect();
    let rollouts = rollouts(model, task, randomiser, policy, request.seed, &all)?;
    Ok(Evaluation::of(rollouts))
}

/// The rollouts `indices` of an evaluation.
///
/// # Errors
/// As [`evaluate`].
pub fn rollouts(
    model: &Arc<Model>,
    task: &PushTask,
    randomiser: &Randomiser,
    policy: &AffineGaussian,
    seed: u64,
    indices: &[usize],
) -> Result<Vec<Rollout>, RolloutError> {
    policy.check(task.n_observation(), task.n_action())?;
    let results: Vec<Result<Rollout, RolloutError>> = indices
        .par_iter()
        .with_max_len(1)
        .map(|&index| follow(model, task, randomiser, policy, seed, index as u64))
        .collect();
    results.into_iter().collect()
}

impl Evaluation {
    /// The summary of `rollouts`.
    pub fn of(rollouts: Vec<Rollout>) -> Self {
        let n = rollouts.len() as f64;
        let mean = rollouts.iter().map(|r| r.mean_distance_cm).sum::<f64>() / n;
        let variance = rollouts
            .iter()
            .map(|r| (r.mean_distance_cm - mean).powi(2))
            .sum::<f64>()
            / (n - 1.0).max(1.0);
        Self {
            mean_distance_cm: mean,
            std_cm: variance.sqrt(),
            rollouts,
        }
    }
}

fn follow(
    model: &Arc<Model>,
    task: &PushTask,
    randomiser: &Randomiser,
    policy: &AffineGaussian,
    seed: u64,
    index: u64,
) -> Result<Rollout, RolloutError> {
    let mut data = Data::new(Arc::clone(model))?;
    randomiser.draw(&mut data, &mut rng::stream(seed, Purpose::Model, 0, index))?;
    data.reset();
    task.start(
        &mut data,
        &mut rng::stream(seed, Purpose::Evaluation, 0, index),
    )?;
    let first_object = [task.object(&data)[0], task.object(&data)[1]];
    let timestep = data.model().timestep();
    let n_step = (spiral::DURATION_S / timestep).round() as usize;
    let (mut observation, mut action) =
        (vec![0.0; task.n_observation()], vec![0.0; task.n_action()]);
    let mut steps = Vec::with_capacity(n_step);
    let (mut torque, mut diverged) = (0.0, None);
    for k in 0..n_step {
        let [x, y] = spiral::target(k as f64 * timestep);
        task.set_goal(&mut data, x, y);
        task.observe(&data, &mut observation);
        policy.mean(&observation, &mut action);
        hold(&mut data, &action, 1)?;
        if let Some(reason) = breakdown(&data, task.reward(&data)) {
            diverged = Some(reason);
            break;
        }
        torque += (action.iter().map(|a| a * a).sum::<f64>() / action.len() as f64).sqrt();
        let object = task.object(&data);
        steps.push(Step {
            time_s: (k + 1) as f64 * timestep,
            target_m: [x, y],
            object_m: [object[0], object[1]],
            distance_cm: 100.0 * task.distance_m(&data),
        });
    }
    let object = steps.last().map_or(first_object, |step| step.object_m);
    let missed: f64 = (steps.len()..n_step)
        .map(|k| {
            let [x, y] = spiral::target(k as f64 * timestep);
            100.0 * (object[0] - x).hypot(object[1] - y)
        })
        .sum();
    let seen: f64 = steps.iter().map(|s| s.distance_cm).sum();
    Ok(Rollout {
        mean_distance_cm: (seen + missed) / n_step.max(1) as f64,
        rms_torque_nm: torque / steps.len().max(1) as f64,
        diverged,
        steps,
    })
}
