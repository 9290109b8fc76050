//! One step of the engine around a belief about the state, by divided differences along the columns of its root.
//!
//! See `track` for the equations: D and E there are `first` and `second` here. Every column costs two steps of the
//! engine, every parameter one; they are shared among the threads.

use std::sync::Arc;

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::SysidError;
use super::inverse::{Changed, Inverse};
use super::point::read_channels;
use super::problem::Problem;

/// c² of the module `track`: differences reach as far as the fourth moment of a Gaussian wants.
const REACH_SQUARE: f64 = 3.0;
/// Change of x in a sensitivity, relative to its typical change.
const STEP_PARAMETER: f64 = 1e-4;
/// Of an acceleration in A.
const STEP_ACCELERATION: f64 = 1e-3;
/// Workspaces at the parameters themselves; more than that many threads would wait for each other.
const N_WORKSPACES: usize = 8;

/// What the engine makes of a state: next position and velocity, and channels.
#[derive(Debug, Clone, Default)]
pub(super) struct Outcome {
    pub qpos: Vec<f64>,
    pub qvel: Vec<f64>,
    pub channels: Vec<f64>,
}

/// The engine at the parameters, and at each of them changed.
pub(super) struct Expansion<'a> {
    problem: &'a Problem,
    controls: Vec<f64>,
    workspaces: Vec<Inverse>,
    perturbed: Vec<Perturbed>,
}

/// The engine at a changed parameter.
struct Perturbed {
    inverse: Inverse,
    controls: Option<Vec<f64>>,
    step: f64,
}

impl<'a> Expansion<'a> {
    /// Of trial `trial` at free parameters `x`.
    pub(super) fn new(problem: &'a Problem, trial: usize, x: &[f64]) -> Result<Self, SysidError> {
        let workspace = |x: &[f64]| -> Result<Inverse, SysidError> {
            let mut inverse =
                Inverse::new(Arc::clone(&problem.model), !problem.channels.is_empty())?;
            inverse.set_parameters(&problem.parameters, &problem.model, x)?;
            Ok(inverse)
        };
        let n = rayon::current_num_threads().min(N_WORKSPACES);
        let workspaces = (0..n).map(|_| workspace(x)).collect::<Result<_, _>>()?;
        let trial = &problem.trials[trial];
        let mut perturbed = Vec::new();
        for (j, p) in problem.parameters.iter_free().enumerate() {
            let step = STEP_PARAMETER * p.typical;
            let mut x = x.to_vec();
            x[j] += step;
            let moved = problem.moves_controls(j);
            perturbed.push(Perturbed {
                inverse: workspace(&x)?,
                controls: moved.then(|| problem.controls(trial, &x)),
                step,
            });
        }
        Ok(Self {
            problem,
            controls: problem.controls(trial, x),
            workspaces,
            perturbed,
        })
    }

    /// First and second divided differences of (z', y) along the columns of `root`, and derivatives by x.
    pub(super) fn expand(
        &mut self,
        k: usize,
        qpos: &[f64],
        qvel: &[f64],
        root: &DMatrix<f64>,
        guess: &[f64],
    ) -> Result<Option<Spread>, SysidError> {
        let nv = qvel.len();
        let nu = self.problem.model.nu();
        let ctrl = &self.controls[k * nu..(k + 1) * nu];
        let problem = self.problem;
        let step = |inverse: &mut Inverse, ctrl: &[f64], qpos: &[f64], qvel: &[f64]| {
            advance(problem, inverse, ctrl, qpos, qvel, guess)
        };
        let Some(centre) = step(&mut self.workspaces[0], ctrl, qpos, qvel)? else {
            return Ok(None);
        };
        let n = 2 * nv + problem.channels.len();
        let reach = REACH_SQUARE.sqrt();
        let columns: Vec<usize> = (0..2 * nv).collect();
        let size = columns.len().div_ceil(self.workspaces.len());
        let differences = |outcome: &Outcome| difference(problem, &centre, outcome);
        // a column each: forth, back
        let parts: Vec<Result<Option<Vec<Pair>>, SysidError>> = (self.workspaces.par_iter_mut())
            .zip(columns.par_chunks(size))
            .map(|(inverse, columns)| {
                let mut done = Vec::with_capacity(columns.len());
                for &j in columns {
                    let mut pair = [Vec::new(), Vec::new()];
                    for (sign, out) in [reach, -reach].into_iter().zip(&mut pair) {
                        let delta: Vec<f64> = root.column(j).iter().map(|r| sign * r).collect();
                        let mut q = qpos.to_vec();
                        problem.model.integrate_pos(&mut q, &delta[..nv], 1.0)?;
                        let v: Vec<f64> =
                            qvel.iter().zip(&delta[nv..]).map(|(v, d)| v + d).collect();
                        let Some(outcome) = step(inverse, ctrl, &q, &v)? else {
                            return Ok(None);
                        };
                        *out = differences(&outcome)?;
                    }
                    done.push(pair);
                }
                Ok(Some(done))
            })
            .collect();
        let mut first = DMatrix::zeros(n, 2 * nv);
        let mut second = DMatrix::zeros(n, 2 * nv);
        let mut j = 0;
        for part in parts {
            let Some(part) = part? else { return Ok(None) };
            for [forth, back] in part {
                for i in 0..n {
                    first[(i, j)] = (forth[i] - back[i]) / (2.0 * reach);
                    second[(i, j)] = (forth[i] + back[i]) / (2.0 * REACH_SQUARE);
                }
                j += 1;
            }
        }
        let derivatives: Vec<Result<Option<Vec<f64>>, SysidError>> =
            (self.perturbed.par_iter_mut())
                .map(|p| {
                    let ctrl = p
                        .controls
                        .as_ref()
                        .map_or(ctrl, |c| &c[k * nu..(k + 1) * nu]);
                    let Some(outcome) = step(&mut p.inverse, ctrl, qpos, qvel)? else {
                        return Ok(None);
                    };
                    let mut column = differences(&outcome)?;
                    for c in &mut column {
                        *c /= p.step;
                    }
                    Ok(Some(column))
                })
                .collect();
        let mut by_x = DMatrix::zeros(n, derivatives.len());
        for (j, column) in derivatives.into_iter().enumerate() {
            let Some(column) = column? else {
                return Ok(None);
            };
            by_x.column_mut(j).copy_from_slice(&column);
        }
        Ok(Some(Spread {
            centre,
            first,
            second,
            by_x,
        }))
    }
    /// Adds to the covariance of the next state what unexplained forces of `force_sigma` do to it.
    pub(super) fn add_noise(
        &mut self,
        covariance: &mut DMatrix<f64>,
        (qpos, qvel, acceleration): (&[f64], &[f64], &[f64]),
        force_sigma: &[f64],
    ) -> Result<(), SysidError> {
        let (nv, h) = (qvel.len(), self.problem.model.timestep());
        let inverse = &mut self.workspaces[0];
        inverse.evaluate(qpos, qvel, acceleration, Changed::Position)?;
        let base = inverse.residual().to_vec();
        let mut mass = DMatrix::zeros(nv, nv);
        let mut moved = acceleration.to_vec();
        for j in 0..nv {
            moved[j] += STEP_ACCELERATION;
            inverse.evaluate(qpos, qvel, &moved, Changed::Acceleration)?;
            moved[j] = acceleration[j];
            for (i, (r, b)) in inverse.residual().iter().zip(&base).enumerate() {
                mass[(i, j)] = (r - b) / STEP_ACCELERATION;
            }
        }
        let Some(mut response) = mass.try_inverse() else {
            return Ok(());
        };
        for (mut column, sigma) in response.column_iter_mut().zip(force_sigma) {
            column *= h * *sigma;
        }
        let noise = &response * response.transpose();
        for i in 0..nv {
            for j in 0..nv {
                let e = noise[(i, j)];
                covariance[(i, j)] += h * h * e;
                covariance[(i, nv + j)] += h * e;
                covariance[(nv + i, j)] += h * e;
                covariance[(nv + i, nv + j)] += e;
            }
        }
        Ok(())
    }
}

/// Differences to a state's centre, forth and back.
type Pair = [Vec<f64>; 2];

/// Differences of one step.
pub(super) struct Spread {
    pub centre: Outcome,
    /// D, (2 nv + channels) × 2 nv
    pub first: DMatrix<f64>,
    /// E, the same
    pub second: DMatrix<f64>,
    /// (2 nv + channels) × np
    pub by_x: DMatrix<f64>,
}

/// One step of the engine from a state.
fn advance(
    problem: &Problem,
    inverse: &mut Inverse,
    ctrl: &[f64],
    qpos: &[f64],
    qvel: &[f64],
    guess: &[f64],
) -> Result<Option<Outcome>, SysidError> {
    let h = inverse.model().timestep();
    let mut acceleration = vec![0.0; qvel.len()];
    inverse.set_ctrl(ctrl);
    if qpos.iter().chain(qvel).any(|v| v.is_nan() || v.abs() > 1e6)
        || !inverse.predict(qpos, qvel, guess, &mut acceleration)?
    {
        return Ok(None);
    }
    let mut out = Outcome {
        qpos: qpos.to_vec(),
        qvel: qvel.to_vec(),
        channels: vec![0.0; problem.channels.len()],
    };
    for (v, a) in out.qvel.iter_mut().zip(&acceleration) {
        *v += h * a;
    }
    problem.model.integrate_pos(&mut out.qpos, &out.qvel, h)?;
    read_channels(problem, inverse, &mut out.channels);
    Ok(Some(out))
}

/// (δq, δv, δy) from `centre` to `outcome`.
fn difference(
    problem: &Problem,
    centre: &Outcome,
    outcome: &Outcome,
) -> Result<Vec<f64>, SysidError> {
    let nv = centre.qvel.len();
    let mut out = vec![0.0; nv];
    problem
        .model
        .differentiate_pos(&mut out, 1.0, &centre.qpos, &outcome.qpos)?;
    out.extend(outcome.qvel.iter().zip(&centre.qvel).map(|(a, b)| a - b));
    out.extend(
        outcome
            .channels
            .iter()
            .zip(&centre.channels)
            .map(|(a, b)| a - b),
    );
    Ok(out)
}
