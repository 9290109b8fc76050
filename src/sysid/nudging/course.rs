//! All recordings simulated under their pulls, and what that costs.

use nalgebra::DVector;
use rayon::prelude::*;

use super::bins::Bins;
use super::pull::Pull;
use crate::sysid::SysidError;
use crate::sysid::problem::Problem;
use crate::sysid::shooting::simulate::{Pool, Simulated, Simulator};
use crate::sysid::shooting::window::{Placed, Window, cut, place};

/// Bins in a period of the pull.
const BINS: f64 = 16.0;
/// Independent numbers in a period.
const INDEPENDENT: f64 = 2.0;

/// What all simulations share.
pub(super) struct Course<'a> {
    pub(super) problem: &'a Problem,
    /// each trial as a whole
    windows: Vec<Window>,
    pulls: Vec<Pull>,
    pub(super) bins: Bins,
    pool: Pool,
}

/// Simulations of all trials at one point of the search.
pub(super) struct Here {
    placed: Vec<Vec<Placed>>,
    pub(super) simulated: Vec<Simulated>,
    /// mean deviations
    pub(super) bins: Vec<f64>,
}

impl<'a> Course<'a> {
    pub(super) fn new(problem: &'a Problem, hz: f64, x: &[f64]) -> Result<Self, SysidError> {
        let windows = cut(problem, f64::INFINITY);
        let pulls = (windows.iter())
            .map(|w| Pull::new(problem, w, x, hz))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            problem,
            windows,
            pulls,
            bins: Bins::new(problem, 1.0 / (BINS * hz)),
            pool: Pool::default(),
        })
    }

    /// The simulations at parameters `x`; `None` where one diverges.
    pub(super) fn at(&self, x: &[f64]) -> Result<Option<Here>, SysidError> {
        let all: Vec<Result<Option<Simulated>, SysidError>> = (0..self.windows.len())
            .into_par_iter()
            .map(|trial| self.simulate(trial, x))
            .collect();
        let mut simulated = Vec::new();
        for one in all {
            let Some(one) = one? else { return Ok(None) };
            simulated.push(one);
        }
        let placed = place(self.problem, &self.windows, x);
        let free = self.problem.free_values(x);
        let mut bins = vec![0.0; self.bins.all.len()];
        for ((window, placed), simulated) in self.windows.iter().zip(&placed).zip(&simulated) {
            let on = (window, placed.as_slice());
            (self.bins).add(self.problem, on, simulated, &free, &mut bins);
        }
        Ok(Some(Here {
            placed,
            simulated,
            bins,
        }))
    }

    /// Pulls that have less to do in the simulations `here`, see [`Pull::again`].
    pub(super) fn pull_again(&mut self, x: &[f64], here: &Here) -> Result<(), SysidError> {
        let again = |i: usize| {
            let on = (&self.windows[i], here.placed[i].as_slice());
            self.pulls[i].again(self.problem, on, &here.simulated[i], x)
        };
        let pulls: Vec<Result<Pull, SysidError>> =
            (0..self.windows.len()).into_par_iter().map(again).collect();
        self.pulls = pulls.into_iter().collect::<Result<_, _>>()?;
        Ok(())
    }

    fn simulate(&self, trial: usize, x: &[f64]) -> Result<Option<Simulated>, SysidError> {
        let problem = self.problem;
        let free = problem.free_values(x);
        let pull = &self.pulls[trial];
        let controls = problem.controls(&problem.trials[trial], x);
        let first = pull.first(problem, &free)?;
        Simulator::with(problem, &self.pool, x, |simulator| {
            let push = &mut |knot: usize, state: (&[f64], &[f64]), force: &mut [f64]| {
                pull.set(&problem.model, knot, state, &free, force);
            };
            simulator.run_with(&self.windows[trial], &first, &controls, push)
        })
    }

    /// Mean square of a series and the noise in it.
    fn variance(&self, series: usize, bins: &[f64]) -> f64 {
        let own = &bins[self.bins.series[series].bins.clone()];
        let square: f64 = own.iter().map(|r| r * r).sum();
        self.bins.noise(self.problem, series) + square / own.len() as f64
    }

    /// F.
    pub(super) fn cost(&self, x: &[f64], bins: &[f64]) -> f64 {
        let each = (self.bins.series.iter().enumerate()).map(|(k, series)| {
            let n = series.bins.len() as f64 * INDEPENDENT / BINS;
            0.5 * n * self.variance(k, bins).ln()
        });
        each.sum::<f64>() + self.problem.parameters.prior_cost(x)
    }

    /// What whitens each bin.
    pub(super) fn weights(&self, bins: &[f64]) -> DVector<f64> {
        let mut weights = DVector::zeros(self.bins.all.len());
        for (k, series) in self.bins.series.iter().enumerate() {
            let weight = (INDEPENDENT / BINS / self.variance(k, bins)).sqrt();
            weights.rows_range_mut(series.bins.clone()).fill(weight);
        }
        weights
    }

    /// What simulations at `points` make of all bins; those that diverge are left out.
    pub(super) fn sample(&self, points: &[Vec<f64>]) -> Result<Vec<(usize, Vec<f64>)>, SysidError> {
        let all: Vec<Result<Option<Here>, SysidError>> =
            points.par_iter().map(|x| self.at(x)).collect();
        let mut found = Vec::new();
        for (i, here) in all.into_iter().enumerate() {
            if let Some(here) = here? {
                found.push((i, here.bins));
            }
        }
        Ok(found)
    }
}
