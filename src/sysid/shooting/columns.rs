//! Simulations of all windows, and their derivatives by finite differences, on all cores.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::simulate::{Pool, Simulated, Simulator};
use super::window::{Placed, State, Window};
use crate::sysid::SysidError;
use crate::sysid::parameter::{Instrument, Role};
use crate::sysid::problem::Problem;

/// Change of a first position, rad or m, in a finite difference.
const STEP_POSITION: f64 = 1e-6;
/// Of a first velocity, rad/s or m/s.
const STEP_VELOCITY: f64 = 1e-6;
/// Of a parameter, relative to its typical change.
const STEP_PARAMETER: f64 = 1e-6;

/// All windows at one point of the search.
#[derive(Clone, Copy)]
pub(crate) struct Point<'a> {
    pub problem: &'a Problem,
    pub windows: &'a [Window],
    /// samples of each window
    pub placed: &'a [Vec<Placed>],
    /// free parameters
    pub x: &'a [f64],
    /// of each window
    pub states: &'a [State],
    /// whether they are unknowns
    pub free_states: bool,
    /// of each window (2 nv × n): what its first state may change along; none: everything
    pub directions: &'a [DMatrix<f64>],
    pub pool: &'a Pool,
}

/// Derivatives of one window by every unknown: those of its first state if that is free, then the parameters.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Columns {
    /// per unknown (samples)
    pub samples: Vec<Vec<f64>>,
    /// per unknown (2 nv) of the last state
    pub end: Vec<Vec<f64>>,
}

/// Index among a window's unknowns and the change of it.
type Change = (usize, f64);

impl Point<'_> {
    /// Every window simulated; `None` for those that diverge.
    pub(crate) fn simulate(&self) -> Result<Vec<Option<Simulated>>, SysidError> {
        let all: Vec<usize> = (0..self.windows.len()).collect();
        self.simulate_some(&all)
    }

    /// Some of the windows, likewise.
    pub(crate) fn simulate_some(
        &self,
        which: &[usize],
    ) -> Result<Vec<Option<Simulated>>, SysidError> {
        self.simulate_pushed(which, &|_, _, _| ())
    }

    /// The same, with forces at the degrees of freedom that `push` sets: of (window, knot in it, forces (nv)).
    pub(crate) fn simulate_pushed(
        &self,
        which: &[usize],
        push: &(dyn Fn(usize, usize, &mut [f64]) + Sync),
    ) -> Result<Vec<Option<Simulated>>, SysidError> {
        let controls = self.controls(self.x);
        let size = which.len().div_ceil(8 * rayon::current_num_threads());
        let parts: Vec<Result<Vec<Option<Simulated>>, SysidError>> = (which
            .par_chunks(size.max(1)))
        .map(|part| {
            Simulator::with(self.problem, self.pool, self.x, |simulator| {
                (part.iter())
                    .map(|&w| {
                        let window = &self.windows[w];
                        let controls = &controls[window.trial];
                        simulator.run_with(window, &self.states[w], controls, &mut |k, force| {
                            push(w, k, force);
                        })
                    })
                    .collect()
            })
        })
        .collect();
        let mut all = Vec::with_capacity(which.len());
        for part in parts {
            all.extend(part?);
        }
        Ok(all)
    }

    /// Unknowns of a window's first state.
    pub(crate) fn n_state(&self) -> usize {
        match self.directions.first() {
            _ if !self.free_states => 0,
            Some(directions) => directions.ncols(),
            None => 2 * self.problem.model.nv(),
        }
    }

    /// Derivatives where the simulations are `base`.
    pub(crate) fn columns(&self, base: &[Simulated]) -> Result<Vec<Columns>, SysidError> {
        let n_state = self.n_state();
        let step = |j| {
            if j < n_state / 2 {
                STEP_POSITION
            } else {
                STEP_VELOCITY
            }
        };
        let mut changes: Vec<Change> = (0..n_state).map(|j| (j, step(j))).collect();
        for (j, parameter) in self.problem.parameters.iter_free().enumerate() {
            // what the sensors make of the motion needs no simulation
            let moves = !matches!(
                parameter.role,
                Role::Instrument(Instrument::Bias | Instrument::Gain | Instrument::Delay, _)
            );
            if moves {
                changes.push((n_state + j, STEP_PARAMETER * parameter.typical));
            }
        }
        let tasks: Vec<(Change, (usize, usize))> = (changes.iter())
            .flat_map(|&change| {
                let chunks = self.chunks(changes.len());
                chunks.into_iter().map(move |chunk| (change, chunk))
            })
            .collect();
        let controls = self.controls(self.x);
        let parts: Vec<Result<Vec<Slope>, SysidError>> = (tasks.par_iter())
            .map(|&(change, chunk)| self.slopes(change, chunk, base, &controls))
            .collect();
        let n = n_state + self.x.len();
        let mut all: Vec<Columns> = (self.placed.iter())
            .map(|placed| Columns {
                samples: vec![vec![0.0; placed.len()]; n],
                end: vec![vec![0.0; 2 * self.problem.model.nv()]; n],
            })
            .collect();
        for (((j, _), (from, _)), part) in tasks.into_iter().zip(parts) {
            for (columns, (samples, end)) in all[from..].iter_mut().zip(part?) {
                (columns.samples[j], columns.end[j]) = (samples, end);
            }
        }
        Ok(all)
    }

    /// Slopes of windows `from .. to` with one unknown changed.
    fn slopes(
        &self,
        (j, step): Change,
        (from, to): (usize, usize),
        base: &[Simulated],
        controls: &[Vec<f64>],
    ) -> Result<Vec<Slope>, SysidError> {
        let n_state = self.n_state();
        let mut x = self.x.to_vec();
        let mut moved_controls = Vec::new();
        if j >= n_state {
            x[j - n_state] += step;
            if !self.problem.parameters.changes_model(j - n_state) {
                moved_controls = self.controls(&x);
            }
        }
        let controls = if moved_controls.is_empty() {
            controls
        } else {
            &moved_controls
        };
        let slope = |simulator: &mut Simulator<'_>, w: usize| {
            let (window, placed, base) = (&self.windows[w], &self.placed[w], &base[w]);
            let state = if j < n_state {
                self.states[w].moved(self.problem, &self.tangent(w, j, step))?
            } else {
                self.states[w].clone()
            };
            let moved = simulator.run(window, &state, &controls[window.trial])?;
            // what diverges this close to what does not has no slope
            let moved = moved.as_ref().unwrap_or(base);
            let samples = (moved.samples(self.problem, window, placed))
                .zip(base.samples(self.problem, window, placed))
                .map(|(m, b)| (m.0 - b.0) / step)
                .collect();
            let mut end = moved.end.minus(&base.end, self.problem)?;
            for e in &mut end {
                *e /= step;
            }
            Ok((samples, end))
        };
        Simulator::with(self.problem, self.pool, &x, |simulator| {
            (from..to).map(|w| slope(simulator, w)).collect()
        })
    }

    /// (2 nv) along direction `j` of window `w`.
    fn tangent(&self, w: usize, j: usize, step: f64) -> Vec<f64> {
        if let Some(directions) = self.directions.get(w) {
            let own = directions.column(j);
            return own.iter().map(|d| d * step).collect();
        }
        let mut tangent = vec![0.0; 2 * self.problem.model.nv()];
        tangent[j] = step;
        tangent
    }

    /// Of every trial (knots × nu).
    fn controls(&self, x: &[f64]) -> Vec<Vec<f64>> {
        let trials = self.problem.trials.iter();
        trials
            .map(|trial| self.problem.controls(trial, x))
            .collect()
    }

    /// Windows in runs that keep all cores busy with `n` tasks each.
    fn chunks(&self, n: usize) -> Vec<(usize, usize)> {
        let windows = self.windows.len();
        let size = (n * windows)
            .div_ceil(8 * rayon::current_num_threads())
            .clamp(1, windows);
        (0..windows)
            .step_by(size)
            .map(|from| (from, (from + size).min(windows)))
            .collect()
    }
}

/// Of a window's samples and of its last state.
type Slope = (Vec<f64>, Vec<f64>);
