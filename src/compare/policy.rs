//! The same policy in simulation and on the machine: how far the object is from its target.

use std::sync::Arc;

use serde::Serialize;

use super::{CompareError, States};
use crate::mujoco::{Data, Model};
use crate::policy::AffineGaussian;
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

/// A policy bound to the model, and the target of a recording.
pub(super) struct Follower<'a> {
    task: PushTask,
    policy: &'a AffineGaussian,
    time_s: &'a [f64],
    goal: &'a [f64], // (n × 2)
}

impl<'a> Follower<'a> {
    /// Bind; there must be a target, and policy and model must fit the task.
    pub(super) fn new(
        model: &Model,
        states: &'a States,
        policy: &'a AffineGaussian,
    ) -> Result<Self, CompareError> {
        let task = PushTask::new(model, PushConfig::default())?;
        policy.check(task.n_observation(), task.n_action())?;
        let Some(goal) = &states.goal else {
            return Err(CompareError::NoGoal {
                recording: states.name.clone(),
            });
        };
        Ok(Self {
            task,
            policy,
            time_s: &states.time_s,
            goal,
        })
    }

    /// Put the target where it was at a time, and the policy's mean action into `ctrl`.
    pub(super) fn act(&self, data: &mut Data, time: f64) {
        let last = self.time_s.partition_point(|t| *t <= time + 0.5e-9);
        let k = last.saturating_sub(1);
        let (x, y) = (self.goal[2 * k], self.goal[2 * k + 1]);
        // before its first sample the target is where the model has it
        if x.is_finite() && y.is_finite() {
            self.task.set_goal(data, x, y);
        }
        let mut observation = vec![0.0; self.task.n_observation()];
        let mut action = vec![0.0; self.task.n_action()];
        self.task.observe(data, &mut observation);
        self.policy.mean(&observation, &mut action);
        data.ctrl_mut().copy_from_slice(&action);
    }
}

/// The distance when `follower` moves the model from the first recorded state towards the recorded target.
pub(super) fn simulated_tracking(
    model: &Arc<Model>,
    states: &States,
    follower: &Follower<'_>,
) -> Result<Tracking, CompareError> {
    let mut data = Data::new(Arc::clone(model))?;
    data.set_memory(states.memory(0))?;
    data.set_time(states.time_s[0]);
    data.qpos_mut().copy_from_slice(&states.qpos[..model.nq()]);
    data.qvel_mut().copy_from_slice(&states.qvel[..model.nv()]);
    let mut path = Vec::with_capacity(states.len());
    for time in &states.time_s {
        while data.time() + 0.5 * model.timestep() <= *time {
            let now = data.time();
            follower.act(&mut data, now);
            data.step()?;
        }
        if data.warnings().diverged() {
            break;
        }
        // the target of this sample, for its distance
        follower.act(&mut data, *time);
        path.push((*time, follower.task.distance_m(&data)));
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
