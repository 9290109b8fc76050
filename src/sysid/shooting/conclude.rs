//! From the point where the search ends to a fit: motion, innovations, what is known least.

use super::descent::{Descent, LEAST_DAMPING, changes};
use super::rows::Rows;
use super::window::place;
use crate::sysid::SysidError;
use crate::sysid::arrow::Arrow;
use crate::sysid::fit::{Fit, Innovations, Status};

impl Descent<'_> {
    /// The fit at the present point.
    pub(super) fn conclude(mut self, status: Status) -> Result<Fit, SysidError> {
        self.placed = place(self.problem, &self.windows, &self.x);
        let cost = self.cost()?;
        let rows = self.rows()?;
        let arrows = self.eliminate(&rows, LEAST_DAMPING);
        let n_trials = self.problem.trials.len();
        let mut trajectories = vec![Vec::new(); n_trials];
        let nq = self.problem.model.nq();
        for (window, simulated) in self.windows.iter().zip(&self.simulated) {
            // the last knot is the next window's
            let end = simulated.qpos.len() - if window.followed { nq } else { 0 };
            trajectories[window.trial].extend_from_slice(&simulated.qpos[..end]);
        }
        // states that are given are known
        let mut weakest = (1.0, 0, 0, 0);
        for (trial, arrow) in arrows.iter().enumerate() {
            let (ratio, (k, i)) = arrow.weakest();
            if ratio < weakest.0 {
                let mut windows = self.windows.iter().filter(|w| w.trial == trial);
                let knot = windows.nth(k).map_or(0, |w| w.first);
                weakest = (ratio, trial, knot, i % self.problem.model.nv());
            }
        }
        Ok(Fit {
            x: self.x.clone(),
            trajectories,
            cost,
            negative_log_evidence: cost + arrows.iter().map(Arrow::log_diagonal).sum::<f64>(),
            level: 0.0,
            force_sigma: vec![0.0; self.problem.model.nv()],
            horizon_s: None,
            status,
            innovations: self.innovations(&rows, &arrows),
            history: std::mem::take(&mut self.history),
            weakest,
        })
    }

    /// Every row with its states where they are best for the parameters: sensitivities are total derivatives.
    ///
    /// The elimination's own innovations mix all samples of a window; these stay at their time, which robust intervals
    /// need. Their information is the same.
    fn innovations(&self, rows: &[Rows], arrows: &[Arrow]) -> Innovations {
        let (n_state, np) = (self.n_state(), self.x.len());
        let origin = changes(arrows, &vec![0.0; np]);
        let by_x: Vec<Vec<f64>> = (0..np)
            .map(|j| {
                let mut unit = vec![0.0; np];
                unit[j] = 1.0;
                changes(arrows, &unit)
                    .iter()
                    .zip(&origin)
                    .map(|(c, o)| c - o)
                    .collect()
            })
            .collect();
        let mut innovations = Innovations {
            n_parameters: np,
            ..Innovations::default()
        };
        for (w, (window, rows)) in self.windows.iter().zip(rows).enumerate() {
            // this window's state and the next one's
            let from = w * n_state;
            let to = (from + 2 * n_state).min(origin.len());
            let through = |row: &[f64], states: &[f64]| -> f64 {
                row.iter().zip(&states[from..to]).map(|(a, b)| a * b).sum()
            };
            for (knot, row) in rows.iter() {
                let (state, rest) = row.split_at(2 * n_state);
                let own = (0..np).map(|j| rest[j] + through(state, &by_x[j]));
                innovations.rows.extend(own);
                innovations.rows.push(-rest[np] - through(state, &origin));
                innovations.places.push((window.trial, knot));
            }
        }
        innovations
    }
}
