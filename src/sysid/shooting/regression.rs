//! Where the search for parameters begins: regression of forces by inverse dynamics.
//!
//! Along known states the force that nothing explains is linear in most parameters, or nearly so: masses, friction,
//! armatures, springs. A few knots then tell where to begin, without a simulation:
//!
//! ```text
//! min  Σ (rᵢ(P) / rms rᵢ)²  +  Σ ((x − x̄)/σₓ)²        r = mj_inverse(q, v, qacc) − qfrc_actuator
//!  P
//! ```
//!
//! It is no estimate: noise of the states biases it, and so does friction at rest. Who calls it compares the costs of
//! simulations from both starts.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::simulate::Pool;
use super::window::State;
use crate::sysid::SysidError;
use crate::sysid::box_qp::solve_in_box;
use crate::sysid::inverse::{Changed, Inverse};
use crate::sysid::parameter::Scale;
use crate::sysid::problem::Problem;

/// Change of a parameter in a finite difference, relative to its typical change.
const STEP: f64 = 1e-6;
/// Most iterations: the forces are nearly linear.
const ITERATIONS: usize = 4;
/// Fall of the cost, as a part of what it was, below which it ends.
const TOLERANCE: f64 = 1e-3;
/// Added to the diagonal, relative to it: a parameter without effect stays where it is.
const DAMPING: f64 = 1e-9;
/// Part of its value below which a positive number does not fall in an iteration.
const LEAST_PART: f64 = 0.05;
/// Sum of squares of forces, (N m)² or N², below which they are rounding.
const LEAST_SQUARE: f64 = 1e-24;

/// A knot at which the motion is known.
#[derive(Debug, Clone)]
pub(super) struct Instant {
    pub state: State,
    /// (nv) finite-difference acceleration to the next knot
    pub acceleration: Vec<f64>,
    /// (nu)
    pub ctrl: Vec<f64>,
}

/// Parameters under which the forces at `instants` agree better with the controls than at `start`; `None`: none found.
pub(super) fn regress(
    problem: &Problem,
    pool: &Pool,
    start: &[f64],
    instants: &[Instant],
) -> Result<Option<Vec<f64>>, SysidError> {
    let regression = Regression {
        problem,
        pool,
        instants,
    };
    let free: Vec<usize> = (0..start.len())
        .filter(|&j| problem.parameters.changes_model(j))
        .collect();
    let mut x = start.to_vec();
    let mut better = false;
    let mut residual = regression.forces(&x)?;
    for _ in 0..ITERATIONS {
        let step = regression.step(&x, &residual, &free)?;
        let moved: Vec<f64> = x.iter().zip(&step).map(|(x, d)| x + d).collect();
        // numbers that the engine refuses are no start
        let Ok(new) = regression.forces(&moved) else {
            break;
        };
        let ratio = regression.ratio(&new, &residual);
        if ratio.is_nan() || ratio >= 1.0 {
            break;
        }
        (x, residual, better) = (moved, new, true);
        // what is left is noise, or nothing
        if ratio > 1.0 - TOLERANCE || ratio < TOLERANCE.powi(2) {
            break;
        }
    }
    Ok(better.then_some(x))
}

struct Regression<'a> {
    problem: &'a Problem,
    pool: &'a Pool,
    instants: &'a [Instant],
}

impl Regression<'_> {
    /// (instants × nv) unexplained forces at parameters `x`.
    fn forces(&self, x: &[f64]) -> Result<Vec<f64>, SysidError> {
        let size = self.instants.len().div_ceil(rayon::current_num_threads());
        let parts: Vec<Result<Vec<f64>, SysidError>> = (self.instants.par_chunks(size.max(16)))
            .map(|part| self.forces_at(part, x))
            .collect();
        let mut all = Vec::with_capacity(self.instants.len() * self.problem.model.nv());
        for part in parts {
            all.extend(part?);
        }
        Ok(all)
    }

    fn forces_at(&self, instants: &[Instant], x: &[f64]) -> Result<Vec<f64>, SysidError> {
        let model = &self.problem.model;
        let mut inverse = Inverse::with(self.pool.take(self.problem)?, false);
        inverse.set_parameters(&self.problem.parameters, model, x)?;
        let mut forces = Vec::with_capacity(instants.len() * model.nv());
        for i in instants {
            inverse.set_ctrl(&i.ctrl);
            let State { qpos, qvel } = &i.state;
            inverse.evaluate(qpos, qvel, &i.acceleration, Changed::Position)?;
            forces.extend_from_slice(inverse.residual());
        }
        self.pool.put(inverse.into_data());
        Ok(forces)
    }

    /// Change of x, where forces are `residual`, of the parameters `free`. It is the values that forces are linear in.
    fn step(&self, x: &[f64], residual: &[f64], free: &[usize]) -> Result<Vec<f64>, SysidError> {
        let parameters: Vec<_> = self.problem.parameters.iter_free().collect();
        let columns: Vec<Result<Vec<f64>, SysidError>> = (free.par_iter())
            .map(|&j| {
                let step = STEP * parameters[j].typical;
                let mut moved = x.to_vec();
                moved[j] += step;
                let forces = self.forces(&moved)?;
                let slope = self
                    .problem
                    .parameters
                    .slope(j, parameters[j].to_value(x[j]));
                Ok((forces.iter().zip(residual))
                    .map(|(f, r)| (f - r) / (step * slope))
                    .collect())
            })
            .collect();
        let columns: Vec<Vec<f64>> = columns.into_iter().collect::<Result<_, _>>()?;
        let weights = self.weights(residual);
        let nv = weights.len();
        let dot = |a: &[f64], b: &[f64]| -> f64 {
            let products = a.iter().zip(b).enumerate();
            products.map(|(i, (a, b))| a * b * weights[i % nv]).sum()
        };
        let n = free.len();
        let mut normal = DMatrix::from_fn(n, n, |i, j| dot(&columns[i], &columns[j]));
        let mut right = DVector::from_fn(n, |i, _| -dot(&columns[i], residual));
        let (mut low, mut high) = (vec![0.0; n], vec![0.0; n]);
        for (i, &j) in free.iter().enumerate() {
            let p = parameters[j];
            let value = p.to_value(x[j]);
            if p.has_prior() {
                let sigma = p.prior_sigma * self.problem.parameters.slope(j, value);
                normal[(i, i)] += sigma.powi(-2);
                right[i] -= (value - p.prior) * sigma.powi(-2);
            }
            normal[(i, i)] += DAMPING * normal[(i, i)] + f64::MIN_POSITIVE;
            let lower = match p.scale {
                Scale::Log => p.lower.max(LEAST_PART * value),
                Scale::Linear => p.lower,
            };
            (low[i], high[i]) = (lower - value, p.upper - value);
        }
        let mut step = vec![0.0; x.len()];
        for (&j, change) in free.iter().zip(solve_in_box(&normal, &right, &low, &high)) {
            let p = parameters[j];
            step[j] = p.to_x(p.to_value(x[j]) + change) - x[j];
        }
        Ok(step)
    }

    /// (nv) 1 over the mean square of the forces at each degree of freedom.
    fn weights(&self, forces: &[f64]) -> Vec<f64> {
        let nv = self.problem.model.nv();
        (0..nv)
            .map(|i| {
                let sum: f64 = forces.iter().skip(i).step_by(nv).map(|f| f * f).sum();
                forces.len() as f64 / nv as f64 / sum.max(LEAST_SQUARE)
            })
            .collect()
    }

    /// Mean square of `new` forces, each degree of freedom relative to that of the `old` ones.
    fn ratio(&self, new: &[f64], old: &[f64]) -> f64 {
        let (new, old) = (self.weights(new), self.weights(old));
        old.iter().zip(&new).map(|(o, n)| o / n).sum::<f64>() / old.len() as f64
    }
}
