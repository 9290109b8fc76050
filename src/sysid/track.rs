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

use super::SysidError;
use super::backward::{Kept, backward, regular, square_root};
use super::expansion::{Expansion, Outcome, Spread};
use super::problem::{Problem, Setting, Stage};
use super::start::Belief;

/// How a trial is followed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Following<'a> {
    /// (nv) standard deviation of unexplained forces
    pub force_sigma: &'a [f64],
    /// (channels) standard deviation of samples
    pub channel_sigma: &'a [f64],
    /// whether the motion is wanted, too
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
    n_knots: usize,
    timestep: f64,
    readings: Vec<Vec<Reading>>,
    engine: Expansion<'a>,
}

impl<'a> Filter<'a> {
    fn new(
        problem: &'a Problem,
        trial: usize,
        x: &[f64],
        following: Following<'a>,
    ) -> Result<Self, SysidError> {
        let mut filter = Self {
            problem,
            following,
            free: problem.free_values(x),
            n_knots: problem.trials[trial].n_knots,
            timestep: problem.model.timestep(),
            readings: Vec::new(),
            engine: Expansion::new(problem, trial, x)?,
        };
        filter.readings = filter.read(&problem.trials[trial]);
        Ok(filter)
    }

    /// Samples sorted to the knots nearest to them.
    fn read(&self, trial: &super::problem::Trial) -> Vec<Vec<Reading>> {
        let mut out: Vec<Vec<Reading>> = vec![Vec::new(); self.n_knots];
        for s in trial.samples.iter() {
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
        let (nq, nv, np) = (model.nq(), model.nv(), self.free.len());
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
            let Some(spread) = self.engine.expand(k, &qpos, &qvel, &root, &acceleration)? else {
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
            let here = (&*qpos, &*qvel, &*acceleration);
            self.engine
                .add_noise(&mut ahead, here, self.following.force_sigma)?;
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
                    out.knots.push(k);
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
}
