//! What one simulation costs, sample by sample.

use std::borrow::Cow;

use super::first::First;
use crate::sysid::SysidError;
use crate::sysid::problem::Problem;
use crate::sysid::shooting::simulate::{Pool, Simulated, Simulator};
use crate::sysid::shooting::window::{Placed, Window};
use crate::sysid::timing::{Timing, Timings};

/// Recordings, and where their simulations begin. Unknowns z are the free parameters, then those of each trial's first
/// state.
pub(super) struct Course<'a> {
    pub problem: &'a Problem,
    /// one a trial, all of it
    pub windows: Vec<Window>,
    /// one a trial
    pub firsts: Vec<First>,
    /// where x (free) are looked for
    pub ranges: Vec<(f64, f64)>,
    timings: Timings,
    pool: Pool,
}

impl<'a> Course<'a> {
    pub(super) fn new(
        problem: &'a Problem,
        x: &[f64],
        ranges: Vec<(f64, f64)>,
        (windows, firsts): (Vec<Window>, Vec<First>),
    ) -> Self {
        Self {
            timings: Timings::new(problem, &windows, x),
            problem,
            windows,
            firsts,
            ranges,
            pool: Pool::default(),
        }
    }

    fn timing(&self, x: &[f64]) -> Cow<'_, Timing> {
        self.timings.at(self.problem, &self.windows, x)
    }

    /// Whether a delay is among the parameters.
    pub(super) fn is_late(&self) -> bool {
        self.timings.is_late()
    }

    /// Number of unknowns.
    pub(super) fn len(&self) -> usize {
        self.ranges.len() + self.firsts.iter().map(First::len).sum::<usize>()
    }

    /// Steps of the longest trial, the sample at its end included.
    pub(super) fn end(&self) -> usize {
        self.windows.iter().map(Window::len).max().unwrap_or(0)
    }

    /// −log p of unknowns before any sample; infinite where they cannot be.
    pub(super) fn prior(&self, z: &[f64]) -> f64 {
        let (x, u) = z.split_at(self.ranges.len());
        let inside = (x.iter().zip(&self.ranges)).all(|(x, r)| (r.0..=r.1).contains(x));
        if !inside {
            return f64::INFINITY;
        }
        self.problem.parameters.prior_cost(x) + 0.5 * u.iter().map(|u| u * u).sum::<f64>()
    }

    /// Every trial simulated over its first `steps`; `None` where one diverges.
    pub(super) fn simulate(
        &self,
        z: &[f64],
        steps: usize,
    ) -> Result<Option<Vec<Simulated>>, SysidError> {
        let (x, mut u) = z.split_at(self.ranges.len());
        let timing = self.timing(x);
        let mut all = Vec::with_capacity(self.windows.len());
        Simulator::with(self.problem, &self.pool, x, |simulator| {
            for (i, (window, first)) in self.windows.iter().zip(&self.firsts).enumerate() {
                let (mine, rest) = u.split_at(first.len());
                u = rest;
                let state = first.at(self.problem, x, mine)?;
                let window = window.up_to(steps);
                let Some(simulated) = simulator.run(&window, &state, &timing.controls[i])? else {
                    return Ok(None);
                };
                all.push(simulated);
            }
            Ok(Some(all))
        })
    }

    /// Calls `each` with every sample of the first `steps`: trial, place, and the reading as the simulation has it.
    pub(super) fn readings(
        &self,
        z: &[f64],
        simulated: &[Simulated],
        steps: usize,
        each: &mut dyn FnMut(usize, &Placed, f64),
    ) {
        let x = &z[..self.ranges.len()];
        let timing = self.timing(x);
        let free = self.problem.free_values(x);
        for (trial, (window, simulated)) in self.windows.iter().zip(simulated).enumerate() {
            let placed = &timing.placed[trial];
            let placed = &placed[..placed.partition_point(|p| p.knot < steps)];
            let window = window.up_to(steps);
            let samples = &self.problem.trials[trial].samples;
            for (p, (z, _)) in (placed.iter()).zip(simulated.samples(self.problem, &window, placed))
            {
                let channel = &self.problem.channels[samples[p.sample].channel];
                each(trial, p, channel.reading(&free, z));
            }
        }
    }

    /// −log p of a sample that is simulated as `reading`, less a constant.
    pub(super) fn cost(&self, trial: usize, placed: &Placed, reading: f64) -> f64 {
        let s = &self.problem.trials[trial].samples[placed.sample];
        let channel = &self.problem.channels[s.channel];
        (channel.norm).cost((reading - s.value) / channel.sigma_of(s))
    }

    /// −log p of the samples before each step up to `steps` (one more than that many numbers), less a constant; `None`
    /// where the simulation diverges.
    pub(super) fn costs(&self, z: &[f64], steps: usize) -> Result<Option<Vec<f64>>, SysidError> {
        let Some(simulated) = self.simulate(z, steps)? else {
            return Ok(None);
        };
        let mut costs = vec![0.0; steps + 1];
        self.readings(z, &simulated, steps, &mut |trial, p, reading| {
            costs[p.knot + 1] += self.cost(trial, p, reading);
        });
        for k in 1..costs.len() {
            costs[k] += costs[k - 1];
        }
        Ok(costs[steps].is_finite().then_some(costs))
    }

    /// Samples of all trials before `steps`, at parameters `x`.
    pub(super) fn n_samples(&self, x: &[f64], steps: usize) -> usize {
        let timing = self.timing(x);
        let own = timing.placed.iter();
        own.map(|p| p.partition_point(|p| p.knot < steps)).sum()
    }
}
