//! All recordings simulated under their pulls, and what that costs.

use nalgebra::DVector;
use rayon::prelude::*;

use super::bins::{Bins, Series};
use super::pull::Pull;
use crate::mujoco::Data;
use crate::sysid::SysidError;
use crate::sysid::problem::Problem;
use crate::sysid::shooting::simulate::{Pool, Simulated, Simulator};
use crate::sysid::shooting::window::{Window, cut};
use crate::sysid::timing::Timings;

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
    timings: Timings,
    pool: Pool,
}

/// Simulations of all trials at one point of the search.
pub(super) struct Here {
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
            timings: Timings::new(problem, &windows, x),
            problem,
            windows,
            pulls,
            bins: Bins::new(problem, 1.0 / (BINS * hz)),
            pool: Pool::default(),
        })
    }

    /// The simulations at parameters `x`; `None` where one diverges.
    pub(super) fn at(&self, x: &[f64]) -> Result<Option<Here>, SysidError> {
        let timing = self.timings.at(self.problem, &self.windows, x);
        let all: Vec<Result<Option<Simulated>, SysidError>> = (0..self.windows.len())
            .into_par_iter()
            .map(|trial| self.simulate(trial, x, &timing.controls[trial]))
            .collect();
        let mut simulated = Vec::new();
        for one in all {
            let Some(one) = one? else { return Ok(None) };
            simulated.push(one);
        }
        let free = self.problem.free_values(x);
        let mut bins = vec![0.0; self.bins.all.len()];
        for ((window, placed), simulated) in self.windows.iter().zip(&timing.placed).zip(&simulated)
        {
            let on = (window, placed.as_slice());
            (self.bins).add(self.problem, on, simulated, &free, &mut bins);
        }
        Ok(Some(Here { simulated, bins }))
    }

    /// Leaves pulls less to do than in the simulations `here`, see [`Pull::correct`].
    pub(super) fn correct(&mut self, x: &[f64], here: &Here) -> Result<(), SysidError> {
        let Self {
            problem,
            windows,
            pulls,
            timings,
            ..
        } = self;
        let timing = timings.at(problem, windows, x);
        (pulls.par_iter_mut().enumerate()).try_for_each(|(i, pull)| {
            let on = (&windows[i], timing.placed[i].as_slice());
            pull.correct(problem, on, &here.simulated[i], x)
        })
    }

    fn simulate(
        &self,
        trial: usize,
        x: &[f64],
        controls: &[f64],
    ) -> Result<Option<Simulated>, SysidError> {
        let problem = self.problem;
        let free = problem.free_values(x);
        let pull = &self.pulls[trial];
        let first = pull.first(problem, &free)?;
        Simulator::with(problem, &self.pool, x, |simulator| {
            let push = &mut |knot: usize, data: &mut Data| pull.apply(knot, &free, data);
            simulator.run_with(&self.windows[trial], &first, controls, push)
        })
    }

    /// Mean square of a series and the noise in it.
    fn variance(series: &Series, bins: &[f64]) -> f64 {
        let own = &bins[series.bins.clone()];
        let square: f64 = own.iter().map(|r| r * r).sum();
        series.noise + square / own.len() as f64
    }

    /// F.
    pub(super) fn cost(&self, x: &[f64], bins: &[f64]) -> f64 {
        let each = self.bins.series.iter().map(|series| {
            let n = series.bins.len() as f64 * INDEPENDENT / BINS;
            0.5 * n * Self::variance(series, bins).ln()
        });
        each.sum::<f64>() + self.problem.parameters.prior_cost(x)
    }

    /// What whitens each bin.
    pub(super) fn weights(&self, bins: &[f64]) -> DVector<f64> {
        let mut weights = DVector::zeros(self.bins.all.len());
        for series in &self.bins.series {
            let weight = (INDEPENDENT / BINS / Self::variance(series, bins)).sqrt();
            weights.rows_range_mut(series.bins.clone()).fill(weight);
        }
        weights
    }

    /// What simulations at `points` make of all bins; those that diverge, or have numbers that the engine refuses, are left
    /// out.
    pub(super) fn sample(&self, points: &[Vec<f64>]) -> Vec<(usize, Vec<f64>)> {
        (points.par_iter().enumerate())
            .filter_map(|(i, x)| Some((i, self.at(x).ok()??.bins)))
            .collect()
    }
}
