//! The value function: quadratic in all terms of what it sees, plus powers of time, fitted by ridge regression.
//!
//! ```text
//! x = clip((s - mean) / scale, ±CLIP)                      s: the task's value inputs; mean and scale of the batch it was fitted on
//! ψ = (1, x_i, x_i x_j for i ≥ j, τ, τ², τ³, τ⁴),  τ = t / horizon
//! w = argmin Σ (w·ψ - y)² / n + ridge Σ' w²                (the constant is not shrunk)
//! ```
//!
//! An input takes part when at least a hundredth of its variance in the batch is no linear function of the inputs
//! before it. The hinges of a parallel linkage and their velocities are such functions of each other: 26 of the pushing
//! task's 40 inputs take part while the goal stands still, which makes 382 features in place of 784.
//!
//! The fit follows the paper's quadratic function approximator. Clipping keeps one object flung across the table from
//! deciding about all other states. For advantages without the bias of a function fitted to the very same samples,
//! [`fit`] returns two more functions, fitted to the trajectories of even and odd index ([`Fit::crossed`]).

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use serde::{Deserialize, Serialize};

use super::Known;
use super::gram::{self, Gram};
use crate::task::symmetry;
use crate::team::{Deal, TeamError};

const CLIP: f64 = 4.0;
/// Share of an input's variance that the inputs before it must leave unexplained. The loops of the model close to a few
/// percent of a joint's standard deviation.
const INDEPENDENT: f64 = 0.01;
const N_TIME: usize = 4;

/// A value function.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Baseline {
    mean: Vec<f64>,
    /// 0 marks an input that takes no part: a constant, or a linear function of those before it
    inverse_scale: Vec<f64>,
    /// in the order of the features; empty: no fit yet, the value is 0
    weights: Vec<f64>,
}

/// Quality of a fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitReport {
    /// 1 - variance of the residual / variance of the target
    pub explained_variance: f64,
    /// condition number of the regularised system, estimated from its Cholesky factor
    pub condition: f64,
    /// samples used
    pub n_sample: usize,
}

/// One trajectory as the fit sees it.
#[derive(Debug, Clone, Copy)]
pub struct Target<'a> {
    /// (T or more × `n_input`)
    pub inputs: &'a [f64],
    /// (T)
    pub returns: &'a [f64],
}

/// The outcome of [`fit`].
#[derive(Debug, Clone)]
pub struct Fit {
    /// fitted to all trajectories
    pub all: Baseline,
    /// `[i]`: fitted to the trajectories of parity `1 - i`, to be used on those of parity `i`
    pub crossed: [Baseline; 2],
    /// of `all`
    pub report: FitReport,
}

impl Baseline {
    /// A function that is zero everywhere.
    pub fn zero(n_input: usize) -> Self {
        Self {
            mean: vec![0.0; n_input],
            inverse_scale: vec![0.0; n_input],
            weights: Vec::new(),
        }
    }

    /// Number of inputs.
    pub fn n_input(&self) -> usize {
        self.mean.len()
    }

    fn n_feature(&self) -> usize {
        let n = self.inverse_scale.iter().filter(|x| **x != 0.0).count();
        1 + n + n * (n + 1) / 2 + N_TIME
    }

    /// Append ψ of one sample, `time` = t / horizon.
    fn features(&self, observation: &[f64], time: f64, out: &mut Vec<f64>) {
        let start = out.len();
        out.push(1.0);
        out.extend(
            observation
                .iter()
                .zip(&self.mean)
                .zip(&self.inverse_scale)
                .filter(|(_, inverse)| **inverse != 0.0)
                .map(|((s, mean), inverse)| ((s - mean) * inverse).clamp(-CLIP, CLIP)),
        );
        let products = out.len();
        let n = products - start - 1;
        out.resize(products + n * (n + 1) / 2, 0.0);
        let (linear, mut rest) = out[start + 1..].split_at_mut(n);
        for i in 0..n {
            let (row, after) = rest.split_at_mut(i + 1);
            for (product, x) in row.iter_mut().zip(&*linear) {
                *product = linear[i] * x;
            }
            rest = after;
        }
        let mut power = 1.0;
        for _ in 0..N_TIME {
            power *= time;
            out.push(power);
        }
    }

    /// Values of consecutive observations (rows), the first at step `first` of `horizon`.
    pub fn values(&self, observations: &[f64], first: usize, horizon: usize, out: &mut Vec<f64>) {
        let n = self.mean.len();
        let mut features = Vec::with_capacity(self.n_feature());
        for (t, observation) in observations.chunks_exact(n).enumerate() {
            if self.weights.is_empty() {
                out.push(0.0);
                continue;
            }
            features.clear();
            self.features(
                observation,
                (first + t) as f64 / horizon as f64,
                &mut features,
            );
            out.push(dot(&features, &self.weights));
        }
    }

    /// Whether every number is finite and the lengths belong together.
    pub fn is_sound(&self, n_input: usize) -> bool {
        self.mean.len() == n_input
            && self.inverse_scale.len() == n_input
            && (self.weights.is_empty() || self.weights.len() == self.n_feature())
            && [&self.mean, &self.inverse_scale, &self.weights]
                .iter()
                .all(|v| v.iter().all(|x| x.is_finite()))
    }
}

/// A dot product in four fixed partial sums.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 4];
    let (a4, a_rest) = a.as_chunks::<4>();
    let (b4, b_rest) = b.as_chunks::<4>();
    for (x, y) in a4.iter().zip(b4) {
        for lane in 0..4 {
            sums[lane] += x[lane] * y[lane];
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum();
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// Fit to every `stride`-th sample of `targets` (neighbouring samples say nearly the same), this process's of the batch
/// that `deal` deals; a trajectory that is to take no part has a target without samples.
///
/// Returns `None` when there are fewer samples than features or the system cannot be factored, which happens only with
/// non-finite input.
///
/// # Errors
/// When the processes of the team cannot reach each other.
pub fn fit(
    deal: &Deal<'_>,
    targets: &[Target<'_>],
    n_input: usize,
    known: &Known<'_>,
    stride: usize,
    ridge: f64,
) -> Result<Option<Fit>, TeamError> {
    let stride = stride.max(1);
    let shape = standardise(deal, targets, n_input, known)?;
    let n = shape.n_feature();

    // Σ (ψ, y)(ψ, y)ᵀ, the target as one more column
    let halves = deal.halves(|lane| {
        let mut gram = Gram::new(n + 1);
        for &place in lane {
            let target = &targets[place];
            let rows = target
                .inputs
                .chunks_exact(n_input)
                .zip(target.returns)
                .enumerate();
            // the phase moves along with pairs of trajectories, so that both parities visit every time
            let phase = deal.mine()[place] / 2 % stride;
            for (t, (observation, y)) in rows.skip(phase).step_by(stride) {
                let time = t as f64 / known.horizon as f64;
                let mut add = |seen: &[f64]| {
                    gram.push(|panel| {
                        shape.features(seen, time, panel);
                        panel.push(*y);
                    });
                };
                add(observation);
                for turn in known.symmetries {
                    add(symmetry::apply(&turn.value_input, observation).as_slice());
                }
            }
        }
        gram.packed()
    })?;
    let [(even, n_even), (odd, n_odd)] = halves.map(|half| gram::unpack(n + 1, &half));
    let all = &even + &odd;

    let solve = |sum: &DMatrix<f64>, count: usize| -> Option<(Baseline, FitReport)> {
        let mut system = sum.view((0, 0), (n, n)).into_owned();
        let right = sum.view((n, 0), (1, n)).transpose();
        for i in 1..n {
            system[(i, i)] += ridge * count as f64;
        }
        let factor = Cholesky::<f64, Dyn>::new(system)?;
        let weights: DVector<f64> = factor.solve(&DVector::from_column_slice(right.as_slice()));
        let diagonal = factor.l_dirty().diagonal();
        let condition = (diagonal.max() / diagonal.min()).powi(2);
        let count = count as f64;
        // Σ (y - w·ψ)² / n from the sums alone, since (A + ridge n I') w = b
        let (mean, square) = (right[0] / count, sum[(n, n)] / count);
        let shrunk: f64 = weights.iter().skip(1).map(|w| w * w).sum();
        let residual = square - dot(weights.as_slice(), right.as_slice()) / count - ridge * shrunk;
        let variance = square - mean * mean;
        let explained_variance = if variance > 1e-12 * square {
            1.0 - residual / variance
        } else {
            0.0
        };
        let report = FitReport {
            explained_variance,
            condition,
            n_sample: count as usize,
        };
        let baseline = Baseline {
            weights: weights.as_slice().to_vec(),
            ..shape.clone()
        };
        baseline.is_sound(n_input).then_some((baseline, report))
    };
    if n_even.min(n_odd) < n {
        return Ok(None);
    }
    let (whole, halves) = rayon::join(
        || solve(&all, n_even + n_odd),
        || (solve(&even, n_even), solve(&odd, n_odd)),
    );
    let (Some((all, report)), (Some((from_even, _)), Some((from_odd, _)))) = (whole, halves) else {
        return Ok(None);
    };
    Ok(Some(Fit {
        all,
        crossed: [from_odd, from_even],
        report,
    }))
}

/// A weightless function that standardises as `targets` ask for.
fn standardise(
    deal: &Deal<'_>,
    targets: &[Target<'_>],
    n_input: usize,
    known: &Known<'_>,
) -> Result<Baseline, TeamError> {
    // Σ (s, 1)(s, 1)ᵀ
    let total = deal.total(|lane| {
        let mut gram = Gram::new(n_input + 1);
        for &place in lane {
            for observation in targets[place].inputs.chunks_exact(n_input) {
                gram.push(|panel| {
                    panel.extend_from_slice(observation);
                    panel.push(1.0);
                });
            }
        }
        gram.packed()
    })?;
    let (total, count) = gram::unpack(n_input + 1, &total);
    let turns = known.symmetries.iter();
    let turns = turns.map(|s| symmetry::with_constant(&s.value_input));
    let total = symmetry::mean_of_moments(turns, &total);
    let mut covariance = total.view((0, 0), (n_input, n_input)).into_owned();
    let mut mean = total.view((0, n_input), (n_input, 1)).into_owned();
    covariance /= count.max(1) as f64;
    mean /= count.max(1) as f64;
    covariance -= &mean * mean.transpose();

    // Cholesky, leaving out each row that the ones before it explain
    let mut inverse_scale = vec![0.0; n_input];
    let mut factor = DMatrix::<f64>::zeros(n_input, n_input);
    for i in 0..n_input {
        let variance: f64 = covariance[(i, i)];
        // below the rounding of the sums the input is a constant
        if variance <= 1e-12 * (1.0 + mean[i] * mean[i]) {
            continue;
        }
        for j in (0..i).filter(|j| inverse_scale[*j] != 0.0) {
            let explained = factor.row(i).dot(&factor.row(j));
            factor[(i, j)] = (covariance[(i, j)] - explained) / factor[(j, j)];
        }
        let unexplained = variance - factor.row(i).norm_squared();
        if unexplained < INDEPENDENT * variance {
            factor.row_mut(i).fill(0.0);
        } else {
            factor[(i, i)] = unexplained.sqrt();
            inverse_scale[i] = variance.sqrt().recip();
        }
    }
    Ok(Baseline {
        mean: mean.as_slice().to_vec(),
        inverse_scale,
        weights: Vec::new(),
    })
}
