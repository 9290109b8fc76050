//! A first trajectory: smoothed measurements, turned into positions.
//!
//! Each measured position signal is smoothed by local quadratics over as many samples as its noise allows: the widest
//! window whose residual is not above the noise. Then each knot's position is the least-squares fit to the smoothed
//! values and to the model's equality constraints, close to the knot before.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::SysidError;
use super::problem::{Problem, Stage, Trial};
use crate::mujoco::{Data, Model};

/// Half widths tried, in samples.
const HALF_WIDTHS: [usize; 9] = [256, 128, 64, 32, 16, 8, 4, 2, 1];
/// Residual of smoothing over noise up to which a window is accepted.
const ACCEPTED: f64 = 1.15;
/// Weight of staying at the knot before, relative to the finest measurement's.
const STAY: f64 = 1e-4;
/// How exactly equality constraints hold, m or rad.
const EQUALITY_SIGMA: f64 = 1e-5;
const STEP: f64 = 1e-6;

/// Positions of all knots (`n_knots` × nq).
pub(super) fn trajectory(
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
            (!series.is_empty()).then(|| (c, smooth(&series, sigma, trial.n_knots, h)))
        })
        .collect();
    let size = trial
        .n_knots
        .div_ceil(2 * rayon::current_num_threads())
        .max(64);
    let starts: Vec<usize> = (0..trial.n_knots).step_by(size).collect();
    let parts: Vec<Result<Vec<f64>, SysidError>> = starts
        .into_par_iter()
        .map(|from| {
            let mut pose = Pose::new(problem, x)?;
            let mut out = Vec::new();
            for k in from..(from + size).min(trial.n_knots) {
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

/// Values of a noisy signal at knots 0, h, 2h …
fn smooth(series: &[(f64, f64)], sigma: f64, n_knots: usize, h: f64) -> Vec<f64> {
    let n = series.len();
    let width = HALF_WIDTHS.into_iter().filter(|m| 4 * m < n).find(|&m| {
        let stride = (n / 400).max(1);
        let errors: Vec<f64> = (m..n - m)
            .step_by(stride)
            .map(|i| local(&series[i - m..=i + m], series[i].0).0 - series[i].1)
            .collect();
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        rms <= ACCEPTED * sigma
    });
    let mut at = 0;
    (0..n_knots)
        .map(|k| {
            let time = k as f64 * h;
            while at + 1 < n && series[at + 1].0 <= time {
                at += 1;
            }
            if let Some(m) = width {
                let from = at.saturating_sub(m).min(n - (2 * m + 1).min(n));
                return local(&series[from..(from + 2 * m + 1).min(n)], time).0;
            }
            let (a, b) = (series[at], series[(at + 1).min(n - 1)]);
            let part = if b.0 > a.0 {
                ((time - a.0) / (b.0 - a.0)).clamp(0.0, 1.0)
            } else {
                0.0
            };
            a.1 + part * (b.1 - a.1)
        })
        .collect()
}

/// Value and slope at `time` of the least-squares quadratic through samples.
fn local(samples: &[(f64, f64)], time: f64) -> (f64, f64) {
    let span = (samples[samples.len() - 1].0 - samples[0].0).max(1e-12);
    let mut moments = [0.0; 5];
    let mut right = [0.0; 3];
    for (t, y) in samples {
        let s = (t - time) / span;
        let mut power = 1.0;
        for (i, moment) in moments.iter_mut().enumerate() {
            *moment += power;
            if i < 3 {
                right[i] += power * y;
            }
            power *= s;
        }
    }
    let a = nalgebra::Matrix3::from_fn(|i, j| moments[i + j]);
    let b = nalgebra::Vector3::from(right);
    let c = a
        .lu()
        .solve(&b)
        .unwrap_or_else(|| nalgebra::Vector3::new(right[0] / moments[0], 0.0, 0.0));
    (c[0], c[1] / span)
}

/// A position being fitted to sensor values.
struct Pose<'a> {
    problem: &'a Problem,
    data: Data,
}

impl<'a> Pose<'a> {
    fn new(problem: &'a Problem, x: &[f64]) -> Result<Self, SysidError> {
        let mut data = Data::new(Arc::clone(&problem.model))?;
        problem.parameters.apply(&problem.model, x, &mut data)?;
        data.reset();
        Ok(Self { problem, data })
    }

    /// Whitened residuals of goals and equality constraints.
    fn residual(&mut self, goals: &[(usize, f64)]) -> Result<Vec<f64>, SysidError> {
        self.data.position_stage()?;
        self.data.position_sensors()?;
        let model = self.data.model();
        let n_sensordata = model.nsensordata();
        let mut out: Vec<f64> = (goals.iter())
            .map(|&(c, goal)| {
                let channel = &self.problem.channels[c];
                let i = channel.source;
                let value = if i < n_sensordata {
                    self.data.sensordata()[i]
                } else {
                    self.data.qpos()[i - n_sensordata]
                };
                (value - goal) / channel.sigma
            })
            .collect();
        let n_equality = equality_rows(&self.data);
        out.extend(
            self.data.efc_pos()[..n_equality]
                .iter()
                .map(|e| e / EQUALITY_SIGMA),
        );
        Ok(out)
    }

    fn fit(&mut self, goals: &[(usize, f64)], n_iterations: usize) -> Result<(), SysidError> {
        let nv = self.data.model().nv();
        let finest = goals
            .iter()
            .map(|&(c, _)| self.problem.channels[c].sigma)
            .fold(1.0, f64::min);
        let stay = STAY / finest;
        for _ in 0..n_iterations {
            let base = self.residual(goals)?;
            let qpos = self.data.qpos().to_vec();
            let mut jacobian = DMatrix::zeros(base.len() + nv, nv);
            for j in 0..nv {
                let mut tangent = vec![0.0; nv];
                tangent[j] = STEP;
                let mut moved = qpos.clone();
                self.data.model().integrate_pos(&mut moved, &tangent, 1.0)?;
                self.data.qpos_mut().copy_from_slice(&moved);
                for (i, (m, b)) in self.residual(goals)?.iter().zip(&base).enumerate() {
                    jacobian[(i, j)] = (m - b) / STEP;
                }
                jacobian[(base.len() + j, j)] = stay;
            }
            let mut right = DVector::zeros(base.len() + nv);
            for (r, b) in right.iter_mut().zip(&base) {
                *r = -b;
            }
            let step = jacobian
                .svd(true, true)
                .solve(&right, 1e-12)
                .unwrap_or_else(|_| DVector::zeros(nv));
            // a wrong turn of a far start must not leave the neighbourhood in which it is linear
            let length = step.amax();
            let factor = if length > 0.5 { 0.5 / length } else { 1.0 };
            let mut moved = qpos;
            let step: Vec<f64> = step.iter().map(|s| s * factor).collect();
            self.data.model().integrate_pos(&mut moved, &step, 1.0)?;
            self.data.qpos_mut().copy_from_slice(&moved);
            if length < 1e-9 {
                break;
            }
        }
        Ok(())
    }
}

/// Constraint rows that are equalities: they come first.
fn equality_rows(data: &Data) -> usize {
    const EQUALITY: i32 = 0; // mjCNSTR_EQUALITY
    data.efc_type()[..data.nefc()]
        .iter()
        .take_while(|&&t| t == EQUALITY)
        .count()
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

#[cfg(test)]
mod tests {
    use super::smooth;

    #[test]
    fn smoothing_takes_what_the_noise_allows() {
        let h = 0.001;
        let truth = |t: f64| (3.0 * t).sin();
        let noise =
            |i: i32| 1e-2 * ((f64::from(i) * 12.9898).sin() * 43758.5453).rem_euclid(1.0) - 5e-3;
        let series: Vec<(f64, f64)> = (0..2000)
            .map(|i| (f64::from(i) * h, truth(f64::from(i) * h) + noise(i)))
            .collect();
        let error = |values: &[f64]| {
            let square: f64 = values
                .iter()
                .enumerate()
                .map(|(k, v)| (v - truth(k as f64 * h)).powi(2))
                .sum();
            (square / values.len() as f64).sqrt()
        };
        let raw: Vec<f64> = series.iter().map(|s| s.1).collect();
        assert!(error(&smooth(&series, 2.9e-3, 2000, h)) < 0.3 * error(&raw));
        // and nothing from a signal without noise
        let exact: Vec<(f64, f64)> = (0..2000)
            .map(|i| f64::from(i) * h)
            .map(|t| (t, truth(t)))
            .collect();
        assert!(error(&smooth(&exact, 1e-9, 2000, h)) < 1e-9);
    }
}
