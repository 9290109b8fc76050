//! A trial followed by simulation, step by step: a filter whose innovations give the likelihood of the parameters.
//!
//! The belief about the state z = (q, v) is Gaussian, mean ẑ and covariance P = S Sᵀ. One step of the engine takes z to
//! z' and gives the sensors y. Both are expanded by divided differences along the columns of S, as far out as the
//! belief reaches:
//!
//! ```text
//! D  = [f(ẑ + c Sⱼ) − f(ẑ − c Sⱼ)]/2c       E = [f(ẑ + c Sⱼ) − 2 f(ẑ) + f(ẑ − c Sⱼ)]/2c²       c² = 3
//! f̂  = f(ẑ) + Σⱼ Eⱼ                         cov f = D Dᵀ + 2 E Eᵀ + noise                      f = (z', y)
//! ```
//!
//! Where contacts are made or broken within the belief, E is what a linearisation does not know, and the belief widens by
//! it. Unexplained forces act at the step as they would on the machine, through A⁻¹ (see `linearise`). The samples
//! of the step then correct z'. Innovations e ~ N(0, Y) give
//!
//! ```text
//! −log p = Σ ½ eᵀ Y⁻¹ e + ½ log |Y|
//! ```
//!
//! and their sensitivities ∂e/∂x, which follow the filter with its gains as they are, a Gauss-Newton step. The motion
//! is always one the engine makes, corrected by little, so that nothing is asked of a contact that it cannot do, and the
//! corrections keep together what by itself is chaotic.
//!
//! Reference: Nørgaard, Poulsen and Ravn 2000, "New developments in state estimation for nonlinear systems"; Ljung
//! 1999, "System Identification", chapter 7 (prediction error methods).

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::SysidError;
use super::backward::{Kept, backward, regular, square_root};
use super::inverse::{Changed, Inverse};
use super::point::read_channels;
use super::problem::{Problem, Setting, Stage};
use super::start::Belief;

/// c² of the module: differences reach as far as the fourth moment of a Gaussian wants.
const REACH_SQUARE: f64 = 3.0;
/// Change of x in a sensitivity, relative to its typical change.
const STEP_PARAMETER: f64 = 1e-4;
/// Of an acceleration in A.
const STEP_ACCELERATION: f64 = 1e-3;
/// Workspaces at the parameters themselves; more than that many threads would wait for each other.
const N_WORKSPACES: usize = 8;

/// How a trial is followed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Following<'a> {
    /// (nv) standard deviation of unexplained forces
    pub force_sigma: &'a [f64],
    /// (channels) standard deviation of samples
    pub channel_sigma: &'a [f64],
    /// steps of the model taken as one
    pub stride: usize,
    /// whether the motion is wanted, too, at a stride of 1
    pub smooth: bool,
}

/// What following gives.
#[derive(Debug, Clone, Default)]
pub(super) struct Followed {
    /// −log p
    pub nll: f64,
    /// whitened innovations: rows of (np sensitivities, value)
    pub innovations: Vec<f64>,
    /// knot of each
    pub knots: Vec<usize>,
    /// (knots × nq) if wanted
    pub qpos: Vec<f64>,
}

/// What the engine makes of a state: next position and velocity, and channels.
#[derive(Debug, Clone, Default)]
struct Outcome {
    qpos: Vec<f64>,
    qvel: Vec<f64>,
    channels: Vec<f64>,
}

/// The samples of one channel at one knot, as one.
#[derive(Debug, Clone, Copy)]
struct Reading {
    channel: usize,
    value: f64,
    n: f64,
    /// mean time from the knot to the samples, s
    late_s: f64,
}

/// Follows trial `trial` at free parameters `x`. `None` if the simulation is lost.
pub(super) fn follow(
    problem: &Problem,
    trial: usize,
    x: &[f64],
    belief: &Belief,
    following: Following<'_>,
) -> Result<Option<Followed>, SysidError> {
    Filter::new(problem, trial, x, following)?.run(belief)
}

struct Filter<'a> {
    problem: &'a Problem,
    following: Following<'a>,
    free: Vec<f64>,
    n_knots: usize, // of the coarse grid
    timestep: f64,  // of the coarse grid
    controls: Vec<f64>,
    readings: Vec<Vec<Reading>>,
    workspaces: Vec<Inverse>,
    perturbed: Vec<Perturbed>,
}

/// The engine at a changed parameter.
struct Perturbed {
    inverse: Inverse,
    controls: Option<Vec<f64>>,
    step: f64,
}

impl<'a> Filter<'a> {
    fn new(
        problem: &'a Problem,
        trial: usize,
        x: &[f64],
        following: Following<'a>,
    ) -> Result<Self, SysidError> {
        let timestep = problem.model.timestep() * following.stride as f64;
        let mut model = problem.model.try_clone()?;
        model.edit().set_timestep(timestep)?;
        let model = Arc::new(model);
        let workspace = |x: &[f64]| -> Result<Inverse, SysidError> {
            let mut inverse = Inverse::new(Arc::clone(&model), !problem.channels.is_empty())?;
            inverse.set_parameters(&problem.parameters, &model, x)?;
            Ok(inverse)
        };
        let n = rayon::current_num_threads().min(N_WORKSPACES);
        let workspaces = (0..n).map(|_| workspace(x)).collect::<Result<_, _>>()?;
        let trial = &problem.trials[trial];
        let n_knots = (trial.n_knots - 1) / following.stride + 1;
        let coarse = |x: &[f64]| {
            coarsen(
                &problem.controls(trial, x),
                problem.model.nu(),
                following.stride,
                n_knots,
            )
        };
        let controls = coarse(x);
        let mut perturbed = Vec::new();
        for (j, p) in problem.parameters.iter_free().enumerate() {
            let step = STEP_PARAMETER * p.typical;
            let mut x = x.to_vec();
            x[j] += step;
            let moved = (!problem.parameters.changes_model(j)).then(|| coarse(&x));
            perturbed.push(Perturbed {
                inverse: workspace(&x)?,
                controls: moved,
                step,
            });
        }
        let mut filter = Self {
            problem,
            following,
            free: problem.free_values(x),
            n_knots,
            timestep,
            controls,
            readings: Vec::new(),
            workspaces,
            perturbed,
        };
        filter.readings = filter.read(trial);
        Ok(filter)
    }

    /// Samples sorted to the knots nearest to them.
    fn read(&self, trial: &super::problem::Trial) -> Vec<Vec<Reading>> {
        let mut out: Vec<Vec<Reading>> = vec![Vec::new(); self.n_knots];
        for s in &trial.samples {
            let channel = &self.problem.channels[s.channel];
            let time = s.time - channel.delay.value(&self.free);
            // what depends on forces holds from a knot to the next
            let ahead = if channel.stage == Stage::Acceleration {
                0.0
            } else {
                0.5
            };
            let k = (time / self.timestep + ahead).floor();
            if k < 0.0 || k >= self.n_knots as f64 {
                continue;
            }
            let late_s = time - k * self.timestep;
            let at = &mut out[k as usize];
            match at.iter_mut().find(|r| r.channel == s.channel) {
                Some(r) => {
                    r.value += (s.value - r.value) / (r.n + 1.0);
                    r.late_s += (late_s - r.late_s) / (r.n + 1.0);
                    r.n += 1.0;
                }
                None => at.push(Reading {
                    channel: s.channel,
                    value: s.value,
                    n: 1.0,
                    late_s,
                }),
            }
        }
        out
    }

    fn run(mut self, belief: &Belief) -> Result<Option<Followed>, SysidError> {
        let model = Arc::clone(&self.problem.model);
        let (nq, nv, np) = (model.nq(), model.nv(), self.perturbed.len());
        let (mut qpos, mut qvel) = (belief.qpos.clone(), belief.qvel.clone());
        let mut covariance = belief.covariance.clone();
        let mut sensitivity = DMatrix::zeros(2 * nv, np);
        let mut acceleration = vec![0.0; nv];
        let mut before: Option<Vec<f64>> = None; // channels at the knot before
        let mut out = Followed::default();
        let mut kept: Vec<Kept> = Vec::new();
        for k in 0..self.n_knots {
            let Some(root) = square_root(&covariance) else {
                return Ok(None);
            };
            let Some(spread) = self.expand(k, &qpos, &qvel, &root, &acceleration)? else {
                return Ok(None);
            };
            let Spread {
                centre,
                first,
                second,
                by_x,
            } = spread;
            for ((a, after), before) in acceleration.iter_mut().zip(&centre.qvel).zip(&qvel) {
                *a = (after - before) / self.timestep;
            }
            let n_state = 2 * nv;
            let states = |m: &DMatrix<f64>| m.rows(0, n_state).into_owned();
            let (first_z, second_z) = (states(&first), states(&second));
            let mut ahead = &first_z * first_z.transpose() + &second_z * second_z.transpose() * 2.0;
            self.add_noise(&mut ahead, &qpos, &qvel, &acceleration)?;
            let mut shift = DVector::from_fn(n_state, |i, _| second_z.row(i).sum());
            // sensitivities: through the state, whose columns are differences, and directly
            let through =
                |m: &DMatrix<f64>| root.solve_lower_triangular(&sensitivity).map(|y| m * y);
            let Some(through) = through(&first) else {
                return Ok(None);
            };
            let total = through + by_x;
            let mut next_sensitivity = total.rows(0, n_state).into_owned();
            let readings = std::mem::take(&mut self.readings[k]);
            let mut cross = &root * first_z.transpose(); // Cov(z, z')
            let mut moved = DVector::zeros(n_state); // correction of z
            if !readings.is_empty() {
                let n = readings.len();
                let pick = |m: &DMatrix<f64>| {
                    DMatrix::from_fn(n, m.ncols(), |i, j| m[(n_state + readings[i].channel, j)])
                };
                let gains: Vec<f64> = readings
                    .iter()
                    .map(|r| self.problem.channels[r.channel].gain.value(&self.free))
                    .collect();
                let scaled = |mut m: DMatrix<f64>| {
                    for (mut row, gain) in m.row_iter_mut().zip(&gains) {
                        row *= *gain;
                    }
                    m
                };
                let (first_y, second_y) = (scaled(pick(&first)), scaled(pick(&second)));
                let mut by_x = scaled(pick(&total));
                let mut error = DVector::zeros(n);
                let mut variance =
                    &first_y * first_y.transpose() + &second_y * second_y.transpose() * 2.0;
                for (i, r) in readings.iter().enumerate() {
                    let expected = self.expected(*r, &centre, before.as_ref(), &mut by_x, i);
                    error[i] = r.value - expected - second_y.row(i).sum();
                    let channel = &self.problem.channels[r.channel];
                    let noise = self.following.channel_sigma[r.channel].powi(2) / r.n;
                    let whitened = error[i] / (variance[(i, i)] + noise).sqrt();
                    variance[(i, i)] += noise / channel.norm.weight(whitened).max(1e-6);
                }
                let Some(factor) = variance.cholesky() else {
                    return Ok(None);
                };
                let lower = factor.l();
                let whitened = lower
                    .solve_lower_triangular(&error)
                    .unwrap_or_else(|| error.clone());
                let rows = lower
                    .solve_lower_triangular(&by_x)
                    .unwrap_or_else(|| by_x.clone());
                out.nll += 0.5 * whitened.norm_squared()
                    + lower.diagonal().iter().map(|d| d.ln()).sum::<f64>();
                for i in 0..n {
                    out.innovations.extend(rows.row(i).iter());
                    out.innovations.push(whitened[i]);
                    out.knots.push(k * self.following.stride);
                }
                let both = &first_z * first_y.transpose() + &second_z * second_y.transpose() * 2.0;
                let gain = factor.solve(&both.transpose()).transpose();
                shift += &gain * &error;
                next_sensitivity -= &gain * &by_x;
                ahead -= &gain * both.transpose();
                let own = &root * first_y.transpose(); // Cov(z, y)
                let weighed = factor.solve(&own.transpose()).transpose();
                moved = &weighed * &error;
                cross -= &weighed * both.transpose();
            }
            if ahead.iter().any(|v| !v.is_finite()) {
                return Ok(None);
            }
            ahead = (&ahead + ahead.transpose()) * 0.5;
            let mut next = (centre.qpos, centre.qvel);
            model.integrate_pos(&mut next.0, &shift.as_slice()[..nv], 1.0)?;
            for (v, d) in next.1.iter_mut().zip(&shift.as_slice()[nv..]) {
                *v += d;
            }
            if self.following.smooth {
                let mut corrected = (qpos.clone(), qvel.clone());
                model.integrate_pos(&mut corrected.0, &moved.as_slice()[..nv], 1.0)?;
                for (v, d) in corrected.1.iter_mut().zip(&moved.as_slice()[nv..]) {
                    *v += d;
                }
                let Some(factor) = regular(&ahead) else {
                    return Ok(None);
                };
                let gain = factor.solve(&cross.transpose()).transpose();
                kept.push(Kept {
                    corrected,
                    ahead: next.clone(),
                    gain,
                });
            }
            before = Some(centre.channels);
            (qpos, qvel) = next;
            (covariance, sensitivity) = (ahead, next_sensitivity);
        }
        if self.following.smooth {
            out.qpos = backward(&model, &kept, nq)?;
        }
        Ok(out.nll.is_finite().then_some(out))
    }

    /// Expected value of a reading at the centre, and its derivatives by the numbers of its instrument.
    fn expected(
        &self,
        r: Reading,
        centre: &Outcome,
        before: Option<&Vec<f64>>,
        by_x: &mut DMatrix<f64>,
        row: usize,
    ) -> f64 {
        let channel = &self.problem.channels[r.channel];
        let (gain, bias) = (
            channel.gain.value(&self.free),
            channel.bias.value(&self.free),
        );
        let rate = match before {
            Some(before) if channel.stage != Stage::Acceleration => {
                (centre.channels[r.channel] - before[r.channel]) / self.timestep
            }
            _ => 0.0,
        };
        let z = centre.channels[r.channel] + rate * r.late_s;
        for (setting, derivative) in [
            (channel.bias, 1.0),
            (channel.gain, z),
            (channel.delay, -gain * rate),
        ] {
            if let Setting::Free(j) = setting {
                by_x[(row, j)] += derivative * self.problem.parameters.slope(j, self.free[j]);
            }
        }
        gain * z + bias
    }

    /// First and second divided differences of (z', y) along the columns of `root`, and derivatives by x.
    fn expand(
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

    /// Adds what unexplained forces do to the next state.
    fn add_noise(
        &mut self,
        covariance: &mut DMatrix<f64>,
        qpos: &[f64],
        qvel: &[f64],
        acceleration: &[f64],
    ) -> Result<(), SysidError> {
        let (nv, h) = (qvel.len(), self.timestep);
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
        for (mut column, sigma) in response.column_iter_mut().zip(self.following.force_sigma) {
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
struct Spread {
    centre: Outcome,
    first: DMatrix<f64>,  // (2 nv + channels) × 2 nv
    second: DMatrix<f64>, // the same
    by_x: DMatrix<f64>,   // (2 nv + channels) × np
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

/// Means of `stride` controls each.
fn coarsen(controls: &[f64], nu: usize, stride: usize, n_knots: usize) -> Vec<f64> {
    let mut out = vec![0.0; n_knots * nu];
    for k in 0..n_knots {
        let rows: Vec<&[f64]> = controls
            .chunks_exact(nu.max(1))
            .skip(k * stride)
            .take(stride)
            .collect();
        for i in 0..nu {
            out[k * nu + i] = rows.iter().map(|r| r[i]).sum::<f64>() / rows.len() as f64;
        }
    }
    out
}
