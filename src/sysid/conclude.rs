//! What a descent comes to: evidence, innovations, and where the state is known least.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::SysidError;
use super::arrow::Arrow;
use super::fit::{Fit, Innovations, Status};
use super::linearise::Blocks;
use super::newton::{LEAST_DAMPING, Solver};

impl Solver<'_> {
    /// The fit at the present point, undamped.
    pub(super) fn conclude(&mut self, level: f64, status: Status) -> Result<Fit, SysidError> {
        let state = self.state()?;
        let linear = &state.linear;
        let cost = self.cost(&self.x, &state.here, linear);
        let arrows = self.eliminate_all(linear, LEAST_DAMPING, None);
        let mut negative_log_evidence = cost;
        let mut weakest = (f64::INFINITY, 0, 0, 0);
        for (trial, parts) in arrows.iter().enumerate() {
            for (part, arrow) in parts.iter().enumerate() {
                let volume = self.log_volume(trial, part, &linear[trial][part]);
                negative_log_evidence += arrow.log_diagonal() - volume;
                let (ratio, (knot, dof)) = arrow.weakest();
                if ratio < weakest.0 {
                    weakest = (
                        ratio,
                        trial,
                        knot,
                        self.islands[trial].parts[part].dofs[dof],
                    );
                }
            }
        }
        // of what is idle everywhere nothing is said
        let is_idle = |d: usize| self.islands.iter().all(|i| i.idle.contains(&d));
        let force_sigma = (self.force_sigma.iter().enumerate())
            .map(|(d, s)| if is_idle(d) { 0.0 } else { *s })
            .collect();
        let fit = Fit {
            x: self.x.clone(),
            trajectories: self.trajectories.clone(),
            cost,
            negative_log_evidence,
            level,
            force_sigma,
            horizon_s: None,
            status,
            history: Vec::new(),
            innovations: self.innovations(&arrows),
            weakest,
        };
        self.state = Some(state);
        Ok(fit)
    }

    /// Innovations of all parts, in the order of knots.
    fn innovations(&self, arrows: &[Vec<Arrow>]) -> Innovations {
        let np = self.x.len();
        let mut out = Innovations {
            n_parameters: np,
            ..Innovations::default()
        };
        for (trial, parts) in arrows.iter().enumerate() {
            let mut places: Vec<(usize, usize, usize)> = (parts.iter().enumerate())
                .flat_map(|(part, a)| {
                    let rows = a.innovation_knots.iter().enumerate();
                    rows.map(move |(row, knot)| (*knot, part, row))
                })
                .collect();
            places.sort_unstable();
            for (knot, part, row) in places {
                let own = &self.islands[trial].parts[part].parameters;
                let width = own.len() + 1;
                let from = &parts[part].innovations[row * width..(row + 1) * width];
                let first = out.rows.len();
                out.rows.resize(first + np + 1, 0.0);
                for (j, v) in own.iter().zip(from) {
                    out.rows[first + j] = *v;
                }
                out.rows[first + np] = from[own.len()];
                out.places.push((trial, knot));
            }
        }
        out
    }

    /// Σ log |det ∂ρ/∂q₊| − Σ log σ of samples.
    fn log_volume(&self, trial: usize, part: usize, linear: &Blocks) -> f64 {
        let island = &self.islands[trial].parts[part];
        let n = island.dofs.len();
        let whitening: f64 = island.dofs.iter().map(|d| self.force_sigma[*d].ln()).sum();
        let knots = 1..self.problem.trials[trial].n_knots - 1;
        let forces: f64 = (knots.into_par_iter())
            .map(|k| {
                let block = DMatrix::from_fn(n, n, |i, j| linear.row(k, i)[2 * n + j]);
                let u = block.lu().u();
                u.diagonal()
                    .iter()
                    .map(|d| d.abs().max(f64::MIN_POSITIVE).ln())
                    .sum::<f64>()
                    - whitening
            })
            .collect::<Vec<f64>>()
            .iter()
            .sum();
        let samples = &self.problem.trials[trial].samples;
        let placed = self.placed(trial, &self.x);
        let sensors = (placed.iter().map(|p| &samples[p.sample]))
            .filter(|s| island.channels.contains(&s.channel))
            .map(|s| self.problem.channels[s.channel].sigma_of(s).ln());
        forces - sensors.sum::<f64>()
    }
}
