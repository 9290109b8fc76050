//! Short simulations of a policy that begin in recorded states: their paths.

use std::sync::Arc;

use rayon::prelude::*;

use super::policy::Follower;
use super::{CompareError, States};
use crate::mujoco::{Data, Model, MujocoError};
use crate::policy::AffineGaussian;

/// A simulation from one recorded state.
#[derive(Debug, Clone, PartialEq)]
pub struct Seeded {
    /// (steps + 1) s, on the clock of the recording
    pub time_s: Vec<f64>,
    /// (steps + 1 × nq)
    pub qpos: Vec<f64>,
}

/// Begin every `every_s` and simulate `policy` for `steps` steps of the model, towards the recorded target; a simulation
/// that breaks down ends there.
///
/// # Errors
/// Policy or recording do not fit the task, or the engine fails.
pub fn seeded(
    model: &Arc<Model>,
    states: &States,
    policy: &AffineGaussian,
    every_s: f64,
    steps: usize,
) -> Result<Vec<Seeded>, CompareError> {
    let follower = Follower::new(model, states, policy)?;
    let mut starts: Vec<usize> = Vec::new();
    for (k, time) in states.time_s.iter().enumerate() {
        if *time >= states.time_s[0] + starts.len() as f64 * every_s {
            starts.push(k);
        }
    }
    let all: Vec<Result<Seeded, MujocoError>> = starts
        .into_par_iter()
        .map(|k| from(model, states, &follower, k, steps))
        .collect();
    Ok(all.into_iter().collect::<Result<_, _>>()?)
}

fn from(
    model: &Arc<Model>,
    states: &States,
    follower: &Follower<'_>,
    k: usize,
    steps: usize,
) -> Result<Seeded, MujocoError> {
    let (nq, nv) = (model.nq(), model.nv());
    let mut data = Data::new(Arc::clone(model))?;
    data.set_memory(states.memory(k))?;
    data.set_time(states.time_s[k]);
    data.qpos_mut()
        .copy_from_slice(&states.qpos[k * nq..(k + 1) * nq]);
    data.qvel_mut()
        .copy_from_slice(&states.qvel[k * nv..(k + 1) * nv]);
    // the policy sees positions, not what follows from them
    let mut path = Seeded {
        time_s: vec![states.time_s[k]],
        qpos: data.qpos().to_vec(),
    };
    for step in 0..steps {
        follower.act(&mut data, states.time_s[k] + step as f64 * model.timestep());
        data.step()?;
        if data.warnings().diverged() {
            break;
        }
        path.time_s
            .push(states.time_s[k] + (step + 1) as f64 * model.timestep());
        path.qpos.extend_from_slice(data.qpos());
    }
    Ok(path)
}
