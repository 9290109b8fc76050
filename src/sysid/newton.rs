//! Damped Gauss-Newton at one level of unexplained force.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::SysidError;
use super::arrow::Arrow;
use super::box_qp::solve_in_box;
use super::fit::{Fit, Innovations, Iteration, Status};
use super::linearise::Blocks;
use super::point::{Evaluated, Point};
use super::problem::Problem;

const FIRST_DAMPING: f64 = 1e-3;
const LEAST_DAMPING: f64 = 1e-9;
const MOST_DAMPING: f64 = 1e8;
/// Cost by the forces where a step ends, over that where it began, up to which it is taken.
const GROWTH: f64 = 1.5;

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
        let mut small = 0;
        let mut linear = self.linearise()?;
        for _ in 0..limit {
            let mut before = f64::INFINITY;
            let mut taken = None;
            while taken.is_none() && self.damping <= MOST_DAMPING {
                let (arrows, dx, present) = self.step(&linear, self.damping);
                before = present;
                let x: Vec<f64> = self.x.iter().zip(&dx).map(|(x, d)| x + d).collect();
                let moved = self.moved(&arrows, &dx)?;
                // a trial step may leave what the engine accepts: then it is no step
                let new = self.cost(&x, &moved, &linear).unwrap_or(f64::INFINITY);
                if new.is_finite() && new <= before {
                    // what a force is in motion changes along the way: where the step ends, it may be a little more
                    let old = (
                        std::mem::replace(&mut self.x, x),
                        std::mem::replace(&mut self.trajectories, moved),
                    );
                    if let Some((there, cost)) =
                        self.linearised()?.filter(|t| t.1 <= GROWTH * before)
                    {
                        taken = Some((there, cost, dx));
                        continue;
                    }
                    (self.x, self.trajectories) = old;
                }
                self.damping *= if self.damping < 1e-6 { 1e3 } else { 10.0 };
            }
            let Some((there, cost, dx)) = taken else {
                self.damping = FIRST_DAMPING;
                return Ok(if small > 0 {
                    Status::Converged
                } else {
                    Status::Stalled
                });
            };
            linear = there;
            let decrease = (before - cost) / before.max(f64::MIN_POSITIVE);
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

    /// The present point linearised, and its cost; `None` where the engine does not accept it.
    fn linearised(&self) -> Result<Option<(Vec<Blocks>, f64)>, SysidError> {
        let Ok(linear) = self.linearise() else {
            return Ok(None);
        };
        let cost = self.cost(&self.x, &self.trajectories, &linear)?;
        Ok(cost.is_finite().then_some((linear, cost)))
    }

    fn linearise(&self) -> Result<Vec<Blocks>, SysidError> {
        (self.trajectories.iter().enumerate())
            .map(|(i, qpos)| self.point(i, qpos, &self.x).linearise())
            .collect()
    }

    /// Cost of a trial step; missing forces by the A of the present linearisation.
    fn cost(
        &self,
        x: &[f64],
        trajectories: &[Vec<f64>],
        linear: &[Blocks],
    ) -> Result<f64, SysidError> {
        let nv = self.problem.model.nv();
        let n_channels = self.problem.channels.len();
        let free = self.problem.free_values(x);
        let mut force = vec![0.0; nv];
        let mut sum = self.prior_cost(x);
        for (i, qpos) in trajectories.iter().enumerate() {
            let Some(Evaluated {
                defect, sensors, ..
            }) = self.point(i, qpos, x).evaluate(false)?
            else {
                return Ok(f64::INFINITY);
            };
            for (k, defect) in defect.chunks_exact(nv).enumerate() {
                linear[i].force(k, defect, &mut force);
                for ((f, sigma), norm) in force
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
        Ok(sum)
    }

    fn prior_cost(&self, x: &[f64]) -> f64 {
        (self.problem.parameters.iter_free().zip(x))
            .filter(|(p, _)| p.prior_sigma.is_finite())
            .map(|(p, x)| 0.5 * ((x - p.to_x(p.prior)) / p.prior_sigma).powi(2))
            .sum()
    }

    /// All trajectories eliminated, and their cost.
    fn eliminate_all(&self, linear: &[Blocks], damping: f64) -> (Vec<Arrow>, f64) {
        let (arrows, costs): (Vec<_>, Vec<f64>) = (linear.par_iter().enumerate())
            .map(|(i, blocks)| self.eliminate(i, blocks, damping))
            .unzip();
        (arrows, costs.iter().sum::<f64>() + self.prior_cost(&self.x))
    }

    /// The step at a damping: eliminated trajectories, and the change of the parameters within their bounds.
    fn step(&self, linear: &[Blocks], damping: f64) -> (Vec<Arrow>, Vec<f64>, f64) {
        let np = self.x.len();
        let (arrows, cost) = self.eliminate_all(linear, damping);
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
        for (i, p) in self.problem.parameters.iter_free().enumerate() {
            normal[(i, i)] += damping / p.typical.powi(2);
            if p.prior_sigma.is_finite() {
                normal[(i, i)] += p.prior_sigma.powi(-2);
                right[i] -= (self.x[i] - p.to_x(p.prior)) * p.prior_sigma.powi(-2);
            }
        }
        let reach = self.problem.parameters.reach(&self.x);
        let (low, high): (Vec<f64>, Vec<f64>) = reach
            .map(|(l, h)| if self.hold { (0.0, 0.0) } else { (l, h) })
            .unzip();
        let dx = solve_in_box(&normal, &right, &low, &high);
        (arrows, dx, cost)
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
        let linear = self.linearise()?;
        let (arrows, cost) = self.eliminate_all(&linear, LEAST_DAMPING);
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
            negative_log_evidence += arrow.log_diagonal() - self.log_volume(trial, &linear[trial]);
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

    /// Σ log |det ∂ρ/∂q₊| − Σ log σ of samples.
    fn log_volume(&self, trial: usize, linear: &Blocks) -> f64 {
        let nv = self.problem.model.nv();
        let whitening: f64 = self.force_sigma.iter().map(|s| s.ln()).sum();
        let knots = 1..self.problem.trials[trial].n_knots - 1;
        let forces: f64 = (knots.into_par_iter())
            .map(|k| {
                let block = DMatrix::from_fn(nv, nv, |i, j| linear.row(k, i)[2 * nv + j]);
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
        let sensors = placed
            .iter()
            .map(|p| self.problem.channels[samples[p.sample].channel].sigma.ln());
        forces - sensors.sum::<f64>()
    }
}
