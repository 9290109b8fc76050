//! Whitened rows of the linearised problem: samples of a window, then its jump to the next.

use super::columns::{Columns, Point};
use super::simulate::Simulated;
use super::window::Window;
use crate::sysid::SysidError;
use crate::sysid::parameter::Scale;
use crate::sysid::problem::Setting;

/// Change of a state in the finite difference of a jump, rad, m and per second.
const STEP: f64 = 1e-7;

/// Rows of one window, each times the root of its norm's weight.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Rows {
    /// knot in the trial, of each row
    pub knots: Vec<usize>,
    /// numbers a row
    pub width: usize,
    /// by the window's first state (2 nv, if it is free), by the next window's (likewise), by parameters; the residual
    /// itself
    pub values: Vec<f64>,
}

impl Rows {
    fn add(&mut self, knot: usize) -> &mut [f64] {
        self.knots.push(knot);
        let from = self.values.len();
        self.values.resize(from + self.width, 0.0);
        &mut self.values[from..]
    }

    /// The rows, each with its knot.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (usize, &[f64])> {
        self.knots
            .iter()
            .copied()
            .zip(self.values.chunks_exact(self.width))
    }
}

impl Point<'_> {
    /// Spread of the jump at the end of a window (2 nv): of positions, then of velocities.
    fn jump_sigma(&self, window: &Window, jump_sigma: f64) -> Vec<f64> {
        let nv = self.problem.model.nv();
        let duration = (window.last - window.first) as f64 * self.problem.model.timestep();
        let mut sigma = vec![jump_sigma * duration; nv];
        sigma.resize(2 * nv, jump_sigma);
        sigma
    }

    /// The jump from the end of window `w` to the next window's first state, whitened.
    fn jump(&self, w: usize, simulated: &Simulated, sigma: &[f64]) -> Result<Vec<f64>, SysidError> {
        let mut jump = simulated.end.minus(&self.states[w + 1], self.problem)?;
        jump.iter_mut().zip(sigma).for_each(|(j, s)| *j /= s);
        Ok(jump)
    }

    /// Cost of the residuals of window `w` and of the jump at its end.
    pub(crate) fn window_cost(
        &self,
        w: usize,
        simulated: &Simulated,
        jump_sigma: Option<f64>,
    ) -> Result<f64, SysidError> {
        let free = self.problem.free_values(self.x);
        let window = &self.windows[w];
        let samples = &self.problem.trials[window.trial].samples;
        let predicted = simulated.samples(self.problem, window, &self.placed[w]);
        let mut sum = 0.0;
        for (p, (z, _)) in self.placed[w].iter().zip(predicted) {
            let s = &samples[p.sample];
            let channel = &self.problem.channels[s.channel];
            let predicted = channel.reading(&free, z);
            sum += channel
                .norm
                .cost((predicted - s.value) / channel.sigma_of(s));
        }
        if let (Some(sigma), true) = (jump_sigma, window.followed && window.whole) {
            let sigma = self.jump_sigma(window, sigma);
            let jump = self.jump(w, simulated, &sigma)?;
            sum += 0.5 * jump.iter().map(|j| j * j).sum::<f64>();
        }
        Ok(sum)
    }

    /// Rows of window `w`.
    pub(crate) fn rows(
        &self,
        w: usize,
        simulated: &Simulated,
        columns: &Columns,
        jump_sigma: Option<f64>,
    ) -> Result<Rows, SysidError> {
        let window = &self.windows[w];
        let (n_state, np) = (self.n_state(), self.x.len());
        let width = 2 * n_state + np + 1;
        let h = self.problem.model.timestep();
        let free = self.problem.free_values(self.x);
        let parameters = &self.problem.parameters;
        let samples = &self.problem.trials[window.trial].samples;
        let mut rows = Rows {
            width,
            ..Rows::default()
        };
        let predicted = simulated.samples(self.problem, window, &self.placed[w]);
        for (i, (p, (z, slope))) in self.placed[w].iter().zip(predicted).enumerate() {
            let s = &samples[p.sample];
            let channel = &self.problem.channels[s.channel];
            let (gain, bias) = (channel.gain.value(&free), channel.bias.value(&free));
            let sigma = channel.sigma_of(s);
            let r = (gain * z + bias - s.value) / sigma;
            let weight = channel.norm.weight(r).sqrt();
            let factor = weight / sigma;
            let row = rows.add(window.first + p.knot);
            let (own, rest) = row.split_at_mut(n_state);
            let unknowns = own.iter_mut().chain(&mut rest[n_state..n_state + np]);
            for (out, column) in unknowns.zip(&columns.samples) {
                *out = factor * gain * column[i];
            }
            for (setting, derivative) in [
                (channel.bias, 1.0),
                (channel.gain, z),
                (channel.delay, -gain * slope / h),
            ] {
                if let Setting::Free(j) = setting {
                    // a value on a log scale changes by itself
                    let log = parameters.all[parameters.free[j]].scale == Scale::Log;
                    row[2 * n_state + j] += factor * derivative * if log { free[j] } else { 1.0 };
                }
            }
            row[width - 1] = weight * r;
        }
        if let (Some(sigma), true) = (jump_sigma, window.followed && window.whole) {
            let sigma = self.jump_sigma(window, sigma);
            let jump = self.jump(w, simulated, &sigma)?;
            let by_next = self.by_next(w, simulated, &sigma, &jump)?;
            for i in 0..jump.len() {
                let row = rows.add(window.last);
                for j in 0..n_state {
                    row[j] = columns.end[j][i] / sigma[i];
                    row[n_state + j] = by_next[j][i];
                }
                for j in 0..np {
                    row[2 * n_state + j] = columns.end[n_state + j][i] / sigma[i];
                }
                row[width - 1] = jump[i];
            }
        }
        Ok(rows)
    }

    /// Derivatives of a jump by the state that it leads to, one column each.
    fn by_next(
        &self,
        w: usize,
        simulated: &Simulated,
        sigma: &[f64],
        jump: &[f64],
    ) -> Result<Vec<Vec<f64>>, SysidError> {
        (0..sigma.len())
            .map(|j| {
                let mut tangent = vec![0.0; sigma.len()];
                tangent[j] = STEP;
                let next = self.states[w + 1].moved(self.problem, &tangent)?;
                let moved = simulated.end.minus(&next, self.problem)?;
                let slopes = moved.iter().zip(sigma).zip(jump);
                Ok(slopes.map(|((m, s), j)| (m / s - j) / STEP).collect())
            })
            .collect()
    }
}
