//! The same policy in simulation and on the machine: how far the object is from its target.

use std::sync::Arc;

use serde::Serialize;

use super::{CompareError, States};
use crate::mujoco::{Data, Model};
use crate::policy::AffineGaussian;
use crate::rollout::hold;
use crate::task::Task;
use crate::task::push::{PushConfig, PushTask};

/// Distance between object and target, in the plane.
#[derive(Debug, Clone, Serialize)]
pub struct Tracking {
    /// trial or source
    pub recording: String,
    /// `recorded` or `simulated`
    pub origin: &'static str,
    /// mean over the samples, m
    pub mean_m: f64,
    /// largest, m
    pub worst_m: f64,
    /// (n) s
    #[serde(skip)]
    pub time_s: Vec<f64>,
    /// (n) m
    #[serde(skip)]
    pub distance_m: Vec<f64>,
}

/// The distance as recorded; nothing without target or object.
pub fn recorded_tracking(states: &States) -> Option<Tracking> {
    let (goal, body) = (states.goal.as_ref()?, states.free_body?);
    let nq = states.qpos.len() / states.len();
    let distance = |k: usize| {
        let place = &states.qpos[k * nq + body..];
        (place[0] - goal[2 * k]).hypot(place[1] - goal[2 * k + 1])
    };
    let all = (0..states.len()).map(|k| (states.time_s[k], distance(k)));
    Some(tracking(
        states,
        "recorded",
        all.filter(|(_, d)| d.is_finite()),
    ))
}

/// The distance when `policy` moves the model from the first recorded state towards the recorded target.
///
/// # Errors
/// There is no target, or policy or model do not fit the task.
pub fn simulated_tracking(
    model: &Arc<Model>,
    states: &States,
    policy: &AffineGaussian,
) -> Result<Tracking, CompareError> {
    let task = PushTask::new(model, PushConfig::default())?;
    policy.check(task.n_observation(), task.n_action())?;
    let Some(goal) = &states.goal else {
        return Err(CompareError::NoGoal {
            recording: states.name.clone(),
        });
    };
    let mut data = Data::new(Arc::clone(model))?;
    data.set_time(states.time_s[0]);
    data.qpos_mut().copy_from_slice(&states.qpos[..model.nq()]);
    data.qvel_mut().copy_from_slice(&states.qvel[..model.nv()]);
    let (mut observation, mut action) =
        (vec![0.0; task.n_observation()], vec![0.0; task.n_action()]);
    let mut path = Vec::with_capacity(states.len());
    let aim = |data: &mut Data, k: usize| {
        let (x, y) = (goal[2 * k], goal[2 * k + 1]);
        // before its first sample the target is where the model has it
        if x.is_finite() && y.is_finite() {
            task.set_goal(data, x, y);
        }
    };
    aim(&mut data, 0);
    data.step1()?;
    for k in 0..states.len() {
        while data.time() + 0.5 * model.timestep() <= states.time_s[k] {
            task.observe(&data, &mut observation);
            policy.mean(&observation, &mut action);
            hold(&mut data, &action, 1)?;
        }
        if data.warnings().diverged() {
            break;
        }
        aim(&mut data, k);
        path.push((states.time_s[k], task.distance_m(&data)));
    }
    Ok(tracking(states, "simulated", path.into_iter()))
}

fn tracking(
    states: &States,
    origin: &'static str,
    path: impl Iterator<Item = (f64, f64)>,
) -> Tracking {
    let (time_s, distance_m): (Vec<f64>, Vec<f64>) = path.unzip();
    Tracking {
        recording: states.name.clone(),
        origin,
        mean_m: distance_m.iter().sum::<f64>() / distance_m.len().max(1) as f64,
        worst_m: distance_m.iter().copied().fold(0.0, f64::max),
        time_s,
        distance_m,
    }
}
