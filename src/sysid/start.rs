//! Where an estimator starts: smoothed measurements turned into positions, and how well the first state is known.
//!
//! Each measured position signal is smoothed by itself (see `smooth`). Then each knot's position is the least-squares fit to the smoothed
//! values and to the model's equality constraints, close to the knot before.

use std::sync::Arc;

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::SysidError;
use super::fit::Start;
use super::islands::Islands;
use super::pose::Pose;
use super::problem::{Problem, Stage, Trial};
use super::smooth::smooth;
use crate::mujoco::{Contact, Data, Model};

/// Knots fitted one from the other: a fixed number, so that the start is the same on any number of cores.
const PART: usize = 256;

/// Positions of all knots (`n_knots` × nq).
pub(crate) fn trajectory(
    problem: &Problem,
    trial: &Trial,
    x: &[f64],
) -> Result<Vec<f64>, SysidError> {
    let h = problem.model.timestep();
    let free = problem.free_values(x);
    // (channel, value at each knot)
    let signals: Vec<(usize, Vec<f64>)> = (0..problem.channels.len())
        .into_par_iter()
        .filter(|&c| problem.channels[c].stage == Stage::Position)
        .filter_map(|c| {
            let channel = &problem.channels[c];
            let (gain, bias) = (channel.gain.value(&free), channel.bias.value(&free));
            let delay = channel.delay.value(&free);
            let series: Vec<(f64, f64)> = (trial.samples.iter())
                .filter(|s| s.channel == c)
                .map(|s| (s.time - delay, (s.value - bias) / gain))
                .collect();
            let sigma = channel.sigma / gain.abs();
            (!series.is_empty()).then(|| {
                (
                    c,
                    smooth(&series, sigma, (0..trial.n_knots).map(|k| k as f64 * h)),
                )
            })
        })
        .collect();
    let starts: Vec<usize> = (0..trial.n_knots).step_by(PART).collect();
    let parts: Vec<Result<Vec<f64>, SysidError>> = starts
        .into_par_iter()
        .map(|from| {
            let mut pose = Pose::new(problem, x)?;
            let mut out = Vec::new();
            for k in from..(from + PART).min(trial.n_knots) {
                let goals: Vec<(usize, f64)> = signals.iter().map(|(c, s)| (*c, s[k])).collect();
                pose.fit(&goals, if k == from { 30 } else { 2 })?;
                out.extend_from_slice(pose.data.qpos());
            }
            Ok(out)
        })
        .collect();
    let mut all = Vec::with_capacity(trial.n_knots * problem.model.nq());
    for part in parts {
        all.extend_from_slice(&part?);
    }
    Ok(all)
}

/// Positions of every trial, as far as a start does not know them.
pub(super) fn trajectories(problem: &Problem, start: &Start) -> Result<Vec<Vec<f64>>, SysidError> {
    if let Some(given) = &start.trajectories {
        return Ok(given.clone());
    }
    (problem.trials.iter())
        .map(|trial| trajectory(problem, trial, &start.x))
        .collect()
}

/// Channels that show positions in a trial.
pub(super) fn measured(problem: &Problem, trial: &Trial) -> Vec<usize> {
    (0..problem.channels.len())
        .filter(|&c| problem.channels[c].stage == Stage::Position)
        .filter(|&c| trial.samples.iter().any(|s| s.channel == c))
        .collect()
}

/// Part of the knots of all trials at which bodies touch on which parameters act.
pub(super) fn contact(
    problem: &Problem,
    x: &[f64],
    trajectories: &[Vec<f64>],
) -> Result<f64, SysidError> {
    let model = &problem.model;
    let mut data = Data::new(Arc::clone(model))?;
    problem.parameters.apply(model, x, &mut data)?;
    let (mut touching, mut n) = (0, 0);
    for trajectory in trajectories {
        let mut found: Vec<Vec<[usize; 2]>> = Vec::new();
        for qpos in trajectory.chunks_exact(model.nq()) {
            data.qpos_mut().copy_from_slice(qpos);
            data.position_stage()?;
            found.push(data.contacts().iter().map(Contact::geoms).collect());
        }
        let islands = Islands::new(problem, found.iter().flatten().copied().collect());
        let matter = |pairs: &&Vec<[usize; 2]>| pairs.iter().any(|p| islands.matters(model, *p));
        touching += found.iter().filter(matter).count();
        n += found.len();
    }
    Ok(touching as f64 / n.max(1) as f64)
}

/// How fast errors of a first position may change, 1/s: what its velocity is not known by.
pub(super) const RATE: f64 = 30.0;

/// What is known of the state at the beginning of a trial.
#[derive(Debug, Clone)]
pub(super) struct Belief {
    /// (nq)
    pub qpos: Vec<f64>,
    /// (nv)
    pub qvel: Vec<f64>,
    /// (2 nv × 2 nv) of position and velocity
    pub covariance: DMatrix<f64>,
}

/// What measurements and equality constraints tell of the first state of a trial whose motion is about `qpos`.
pub(super) fn belief(
    problem: &Problem,
    trial: &Trial,
    x: &[f64],
    qpos: &[f64],
) -> Result<Belief, SysidError> {
    let model = &problem.model;
    let (nq, nv) = (model.nq(), model.nv());
    let mut qvel = vec![0.0; nv];
    model.differentiate_pos(&mut qvel, model.timestep(), &qpos[..nq], &qpos[nq..2 * nq])?;
    let position = Pose::new(problem, x)?.covariance(&qpos[..nq], &measured(problem, trial))?;
    let mut covariance = DMatrix::zeros(2 * nv, 2 * nv);
    covariance.view_mut((0, 0), (nv, nv)).copy_from(&position);
    covariance
        .view_mut((nv, nv), (nv, nv))
        .copy_from(&(position * (RATE * RATE)));
    Ok(Belief {
        qpos: qpos[..nq].to_vec(),
        qvel,
        covariance,
    })
}

/// Size of the forces at each degree of freedom, N m or N: what weight, motors and motion make of it.
pub(super) fn force_scale(
    model: &Model,
    force: impl Iterator<Item = Vec<f64>>,
) -> Result<Vec<f64>, SysidError> {
    let nv = model.nv();
    let mut data = Data::new(Arc::new(model.clone()))?;
    data.position_stage()?;
    let mut mass = vec![0.0; nv * nv];
    data.full_mass_matrix(&mut mass)?;
    let mut square = vec![0.0; nv];
    let mut n: f64 = 0.0;
    for row in force {
        for (s, f) in square.iter_mut().zip(&row) {
            *s += f * f;
        }
        n += 1.0;
    }
    Ok((0..nv)
        .map(|i| {
            let inertia = mass[i * nv + i];
            let body = model.dof_bodyid()[i] as usize;
            // a tenth of the weight, on a lever as long as the body's radius of gyration
            let weight = 0.981 * (inertia * model.body_subtreemass()[body]).sqrt();
            (square[i] / n.max(1.0)).sqrt().max(weight).max(1e-6)
        })
        .collect())
}
