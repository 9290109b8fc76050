//! All recordings simulated under their pulls, and what that costs.

use std::sync::Arc;

use nalgebra::DVector;
use rayon::prelude::*;

use super::bins::{Bins, Series};
use super::ensemble::Slopes;
use super::pull::Pull;
use super::told::purging;
use crate::mujoco::Data;
use crate::sysid::SysidError;
use crate::sysid::fit::Innovations;
use crate::sysid::problem::Problem;
use crate::sysid::shooting::simulate::{Pool, Simulated, Simulator};
use crate::sysid::shooting::window::{Window, cut};
use crate::sysid::timing::Timings;

/// Bins in a period of the pull.
const BINS: f64 = 16.0;
/// Independent numbers in a period.
const INDEPENDENT: f64 = 2.0;

/// What all simulations share.
pub(crate) struct Course<'a> {
    pub(crate) problem: &'a Problem,
    /// each trial as a whole
    pub(super) windows: Arc<Vec<Window>>,
    pub(super) pulls: Arc<Vec<Pull>>,
    pub(super) bins: Arc<Bins>,
    pub(super) timings: Timings,
    pub(super) pool: Pool,
    /// by how much other readings than those recorded move deviations
    retold: Option<Arc<DVector<f64>>>,
}

/// Simulations of all trials at one point of the search.
pub(crate) struct Here {
    pub(super) simulated: Vec<Simulated>,
    /// mean deviations
    pub(crate) bins: Vec<f64>,
}

impl<'a> Course<'a> {
    pub(crate) fn new(problem: &'a Problem, hz: f64, x: &[f64]) -> Result<Self, SysidError> {
        let windows = cut(problem, f64::INFINITY);
        let pulls = (windows.iter())
            .map(|w| Pull::new(problem, w, x, hz))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            timings: Timings::new(problem, &windows, x),
            problem,
            windows: Arc::new(windows),
            pulls: Arc::new(pulls),
            bins: Arc::new(Bins::new(problem, 1.0 / (BINS * hz))),
            pool: Pool::default(),
            retold: None,
        })
    }

    /// The same pulls for another model or other readings of the same recordings. The first parameters are the same.
    pub(crate) fn beside<'b>(&self, problem: &'b Problem, x: &[f64]) -> Course<'b> {
        Course {
            timings: Timings::new(problem, &self.windows, x),
            problem,
            windows: Arc::clone(&self.windows),
            pulls: Arc::clone(&self.pulls),
            bins: Arc::clone(&self.bins),
            pool: Pool::default(),
            retold: self.retold.clone(),
        }
    }

    /// The same pulls for readings that differ so that all deviations are `more` (by bin).
    pub(crate) fn retold(&self, more: DVector<f64>) -> Self {
        let mut other = self.beside(self.problem, &self.problem.parameters.start());
        other.retold = Some(Arc::new(more));
        other
    }

    /// The simulations at parameters `x`; `None` where one diverges.
    pub(crate) fn at(&self, x: &[f64]) -> Result<Option<Here>, SysidError> {
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
        if let Some(more) = &self.retold {
            bins.iter_mut()
                .zip(more.iter())
                .for_each(|(bin, more)| *bin += more);
        }
        Ok(Some(Here { simulated, bins }))
    }

    /// Leaves pulls less to do than in the simulations `here`, see [`Pull::correct`].
    pub(crate) fn correct(&mut self, x: &[f64], here: &Here) -> Result<(), SysidError> {
        let Self {
            problem,
            windows,
            pulls,
            timings,
            ..
        } = self;
        let timing = timings.at(problem, windows, x);
        (Arc::make_mut(pulls).par_iter_mut().enumerate()).try_for_each(|(i, pull)| {
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
        self.misfit(bins) + self.problem.parameters.prior_cost(x)
    }

    /// F without the priors.
    pub(crate) fn misfit(&self, bins: &[f64]) -> f64 {
        let each = self.bins.series.iter().map(|series| {
            let n = series.bins.len() as f64 * INDEPENDENT / BINS;
            0.5 * n * Self::variance(series, bins).ln()
        });
        each.sum()
    }

    /// Number of bins.
    pub(crate) fn n_bins(&self) -> usize {
        self.bins.all.len()
    }

    /// Independent numbers that all bins are worth.
    pub(crate) fn worth(&self) -> f64 {
        self.bins.all.len() as f64 * INDEPENDENT / BINS
    }

    /// Standard deviation of the readings' noise in each bin.
    pub(crate) fn noise_sigma(&self) -> DVector<f64> {
        let mut sigma = DVector::zeros(self.bins.all.len());
        for series in &self.bins.series {
            sigma
                .rows_range_mut(series.bins.clone())
                .fill(series.noise.sqrt());
        }
        sigma
    }

    /// What whitens each bin.
    pub(crate) fn weights(&self, bins: &[f64]) -> DVector<f64> {
        let mut weights = DVector::zeros(self.bins.all.len());
        for series in &self.bins.series {
            let weight = (INDEPENDENT / BINS / Self::variance(series, bins)).sqrt();
            weights.rows_range_mut(series.bins.clone()).fill(weight);
        }
        weights
    }

    /// Whitened slopes (bins × parameters), without what chaos adds to their squares, and deviations in the order of time.
    pub(crate) fn innovations(&self, mean: &DVector<f64>, slopes: &Slopes) -> Innovations {
        let weights = self.weights(mean.as_slice());
        let mut rows = slopes.whitened(&weights);
        if let Some(by) = purging(&rows.tr_mul(&rows), &slopes.chaos) {
            rows *= by;
        }
        let mut order: Vec<usize> = (0..mean.len()).collect();
        let place = |i: &usize| self.bins.all[*i].place;
        order.sort_by_key(place);
        let mut innovations = Innovations {
            n_parameters: rows.ncols(),
            places: order.iter().map(place).collect(),
            ..Innovations::default()
        };
        for i in order {
            innovations.rows.extend(rows.row(i).iter());
            innovations.rows.push(-mean[i] * weights[i]);
        }
        innovations
    }

    /// What simulations at `points` make of all bins; those that diverge, or have numbers that the engine refuses, are left
    /// out.
    pub(super) fn sample(&self, points: &[Vec<f64>]) -> Vec<(usize, Vec<f64>)> {
        (points.par_iter().enumerate())
            .filter_map(|(i, x)| Some((i, self.at(x).ok()??.bins)))
            .collect()
    }
}
