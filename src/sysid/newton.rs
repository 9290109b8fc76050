//! Damped Gauss-Newton at one level of unexplained force.

use nalgebra::{DMatrix, DVector};

use super::SysidError;
use super::arrow::Arrow;
use super::box_qp::solve_in_box;
use super::fit::{Fit, Innovations, Iteration, Status};
use super::linearise::{Evaluated, Point};
use super::parameter::Scale;
use super::problem::Problem;

const FIRST_DAMPING: f64 = 1e-3;
const LEAST_DAMPING: f64 = 1e-9;
const MOST_DAMPING: f64 = 1e8;
/// Largest change of x on a log scale in one step.
const LOG_STEP: f64 = 1.0;

/// The present point of the descent.
pub(super) struct Solver<'a> {
    pub problem: &'a Problem,
    /// (nv) standard deviation of the force that stays unexplained
    pub force_sigma: Vec<f64>,
    /// free parameters
    pub x: Vec<f64>,
    /// per trial (knots × nq)
    pub trajectories: Vec<Vec<f64>>,
    damping: f64,
    /// whether parameters stay as they are
    pub hold: bool,
    pub history: Vec<Iteration>,
}

impl<'a> Solver<'a> {
    pub(super) fn new(problem: &'a Problem, x: Vec<f64>, trajectories: Vec<Vec<f64>>) -> Self {
        Self {
            problem,
            force_sigma: vec![0.0; problem.model.nv()],
            x,
            trajectories,
            damping: FIRST_DAMPING,
            hold: false,
            history: Vec::new(),
        }
    }

    pub(super) fn point<'b>(&'b self, trial: usize, qpos: &'b [f64], x: &'b [f64]) -> Point<'b> {
        Point {
            problem: self.problem,
            trial: &self.problem.trials[trial],
            qpos,
            x,
        }
    }

    /// Gauss-Newton at one level.
    pub(super) fn descend(
        &mut self,
        level: f64,
        limit: usize,
        tolerance: f64,
        watch: &mut dyn FnMut(&Iteration) -> bool,
    ) -> Result<Status, SysidError> {
        let mut cost = self.cost(&self.x, &self.trajectories)?;
        let mut small = 0;
        for _ in 0..limit {
            let mut taken = None;
            while taken.is_none() && self.damping <= MOST_DAMPING {
                let (arrows, dx) = self.step(self.damping)?;
                let x: Vec<f64> = self.x.iter().zip(&dx).map(|(x, d)| x + d).collect();
                let moved = self.moved(&arrows, &dx)?;
                // a trial step may leave what the engine accepts: then it is no step
                let new = self.cost(&x, &moved).unwrap_or(f64::INFINITY);
                if new.is_finite() && new <= cost {
                    taken = Some((x, moved, new, dx));
                } else {
                    self.damping *= if self.damping < 1e-6 { 1e3 } else { 10.0 };
                }
            }
            let Some((x, moved, new, dx)) = taken else {
                self.damping = FIRST_DAMPING;
                return Ok(if small > 0 {
                    Status::Converged
                } else {
                    Status::Stalled
                });
            };
            let decrease = (cost - new) / cost.max(f64::MIN_POSITIVE);
            (self.x, self.trajectories, cost) = (x, moved, new);
            let step = dx.iter().fold(0.0_f64, |m, d| m.max(d.abs()));
            let record = Iteration {
                level,
                cost,
                damping: self.damping,
                step,
                x: self.x.clone(),
            };
            self.damping = (self.damping * 0.1).max(LEAST_DAMPING);
            let go_on = watch(&record);
            self.history.push(record);
            if !go_on {
                return Ok(Status::Interrupted);
            }
            // twice in a row, as one small step may be the damping's doing
            small = if decrease < tolerance { small + 1 } else { 0 };
            if small >= 2 || cost < 1e-20 {
                return Ok(Status::Converged);
            }
        }
        Ok(Status::MaxIterations)
    }

    fn cost(&self, x: &[f64], trajectories: &[Vec<f64>]) -> Result<f64, SysidError> {
        let nv = self.problem.model.nv();
        let n_channels = self.problem.channels.len();
        let free = self.problem.free_values(x);
        let mut sum = 0.0;
        for (i, qpos) in trajectories.iter().enumerate() {
            let Evaluated { force, sensors } = self.point(i, qpos, x).evaluate()?;
            for row in force.chunks_exact(nv) {
                for ((f, sigma), norm) in row
                    .iter()
                    .zip(&self.force_sigma)
                    .zip(&self.problem.force_norm)
                {
                    sum += norm.cost(f / sigma);
                }
            }
            for p in self.placed(i, x) {
                let s = &self.problem.trials[i].samples[p.sample];
                let channel = &self.problem.channels[s.channel];
                let mut z = sensors[p.knot * n_channels + s.channel];
                if p.part > 0.0 {
                    z += p.part * (sensors[(p.knot + 1) * n_channels + s.channel] - z);
                }
                let predicted = channel.gain.value(&free) * z + channel.bias.value(&free);
                sum += channel.norm.cost((predicted - s.value) / channel.sigma);
            }
        }
        for (p, &x) in self.problem.parameters.iter_free().zip(x) {
            if p.prior_sigma.is_finite() {
                sum += 0.5 * ((x - p.to_x(p.prior)) / p.prior_sigma).powi(2);
            }
        }
        Ok(sum)
    }

    /// The step at a damping: eliminated trajectories, and the change of the parameters within their bounds.
    fn step(&self, damping: f64) -> Result<(Vec<Arrow>, Vec<f64>), SysidError> {
        let np = self.x.len();
        let arrows = self.eliminate(damping)?;
        let mut normal = DMatrix::zeros(np, np);
        let mut right = DVector::zeros(np);
        for row in arrows
            .iter()
            .flat_map(|a| a.innovations.chunks_exact(np + 1))
        {
            for i in 0..np {
                right[i] += row[i] * row[np];
                for j in 0..np {
                    normal[(i, j)] += row[i] * row[j];
                }
            }
        }
        let mut low = vec![0.0; np];
        let mut high = vec![0.0; np];
        for (i, p) in self.problem.parameters.iter_free().enumerate() {
            normal[(i, i)] += damping / p.typical.powi(2);
            if p.prior_sigma.is_finite() {
                normal[(i, i)] += p.prior_sigma.powi(-2);
                right[i] -= (self.x[i] - p.to_x(p.prior)) * p.prior_sigma.powi(-2);
            }
            let (lower, upper) = p.bounds();
            let most = if p.scale == Scale::Log {
                LOG_STEP
            } else {
                f64::INFINITY
            };
            if self.hold {
                continue;
            }
            (low[i], high[i]) = (
                (lower - self.x[i]).max(-most),
                (upper - self.x[i]).min(most),
            );
        }
        Ok((arrows, solve_in_box(&normal, &right, &low, &high)))
    }

    fn moved(&self, arrows: &[Arrow], dx: &[f64]) -> Result<Vec<Vec<f64>>, SysidError> {
        let model = &self.problem.model;
        let (nq, nv) = (model.nq(), model.nv());
        let mut out = self.trajectories.clone();
        for (arrow, qpos) in arrows.iter().zip(&mut out) {
            let change = arrow.back_substitute(dx);
            for (q, d) in qpos.chunks_exact_mut(nq).zip(change.chunks_exact(nv)) {
                if d.iter().all(|d| d.is_finite()) {
                    model.integrate_pos(q, d, 1.0)?;
                }
            }
        }
        Ok(out)
    }

    /// The fit at the present point, undamped.
    pub(super) fn conclude(&self, level: f64, status: Status) -> Result<Fit, SysidError> {
        let cost = self.cost(&self.x, &self.trajectories)?;
        let arrows = self.eliminate(LEAST_DAMPING)?;
        let mut innovations = Innovations {
            n_parameters: self.x.len(),
            ..Innovations::default()
        };
        let mut negative_log_evidence = cost;
        let mut weakest = (f64::INFINITY, 0, 0, 0);
        for (trial, arrow) in arrows.iter().enumerate() {
            innovations.rows.extend_from_slice(&arrow.innovations);
            innovations
                .places
                .extend(arrow.innovation_knots.iter().map(|&k| (trial, k)));
            negative_log_evidence += arrow.log_diagonal();
            let n = self.problem.trials[trial].n_knots - 2;
            negative_log_evidence +=
                n as f64 * self.force_sigma.iter().map(|s| s.ln()).sum::<f64>();
            let (ratio, (knot, dof)) = arrow.weakest();
            if ratio < weakest.0 {
                weakest = (ratio, trial, knot, dof);
            }
        }
        Ok(Fit {
            x: self.x.clone(),
            trajectories: self.trajectories.clone(),
            cost,
            negative_log_evidence,
            level,
            force_sigma: self.force_sigma.clone(),
            status,
            history: Vec::new(),
            innovations,
            weakest,
        })
    }
}
