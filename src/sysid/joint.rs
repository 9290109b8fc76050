//! The joint estimator: damped Gauss-Newton over parameters and trajectories at once.
//!
//! Each iteration linearises all residuals along the trajectory, eliminates the trajectory (see `arrow`), solves for
//! the parameters inside their bounds, and goes back for the trajectory. A step is taken if the true cost falls;
//! otherwise the damping grows (Levenberg).
//!
//! Contact is approached gradually: the force that may stay unexplained starts as large as the forces themselves and
//! shrinks by tens. At first the motion is nearly what was measured and parameters follow from it; in the end the
//! motion obeys the model. Where to stop is a question of how well the model can explain the forces, and the data
//! answers it: the level of greatest evidence
//!
//! ```text
//! −log p = cost + Σ log |R_ii| + n log σ_τ
//! ```
//!
//! is kept, with R the triangular factor of the trajectory.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use serde::Serialize;

use super::arrow::Arrow;
use super::linearise::{Evaluated, Point};
use super::problem::{Problem, Stage};
use super::{SysidError, start};

/// Settings of the solver.
#[derive(Debug, Clone, PartialEq)]
pub struct JointSettings {
    /// most iterations at the last level of unexplained force
    pub max_iterations: usize,
    /// relative decrease of the cost below which it has converged
    pub tolerance: f64,
    /// levels of unexplained force, as parts of the force at each joint, falling
    pub levels: Vec<f64>,
    /// whether to stop at the level of greatest evidence; else the last level is used
    pub by_evidence: bool,
}

impl Default for JointSettings {
    fn default() -> Self {
        Self {
            max_iterations: 40,
            tolerance: 1e-7,
            levels: std::env::var("LV").map(|v| v.split(',').map(|x| x.parse().unwrap()).collect()).unwrap_or(vec![100.0, 30.0, 10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4]),
            by_evidence: true,
        }
    }
}

/// Why the solver stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// the cost no longer falls
    Converged,
    /// no damping gives a lower cost, though the gradient says there is one
    Stalled,
    /// the iterations ran out
    MaxIterations,
    /// asked to stop
    Interrupted,
}

/// One iteration.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Iteration {
    /// unexplained force, as a part of the forces
    pub level: f64,
    /// true cost after it
    pub cost: f64,
    /// damping it was taken with
    pub damping: f64,
    /// largest change of a parameter's x
    pub step: f64,
    /// free parameters after it
    pub x: Vec<f64>,
}

/// The innovations: what carries the information on the parameters; see `arrow`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Innovations {
    /// free parameters
    pub n_parameters: usize,
    /// rows of sensitivities and value
    pub rows: Vec<f64>,
    /// trial and knot of each row, in order
    pub places: Vec<(usize, usize)>,
}

/// A solution.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// free parameters
    pub x: Vec<f64>,
    /// per trial (knots × nq)
    pub trajectories: Vec<Vec<f64>>,
    /// of residuals and priors
    pub cost: f64,
    /// of evidence, see the module
    pub negative_log_evidence: f64,
    /// unexplained force, as a part of the forces
    pub level: f64,
    /// (nv) its standard deviation
    pub force_sigma: Vec<f64>,
    /// why it stopped
    pub status: Status,
    /// what happened
    pub history: Vec<Iteration>,
    /// for intervals
    pub innovations: Innovations,
    /// least observable state: (diagonal ratio, trial, knot, dof)
    pub weakest: (f64, usize, usize, usize),
}

/// Knots linearised at a time, which bounds the memory.
const BLOCK: usize = 512;
/// Change of a position that the damping resists like one of the parameters' typical changes, rad or m.
const TYPICAL_POSITION: f64 = 0.01;
const FIRST_DAMPING: f64 = 1e-3;
const LEAST_DAMPING: f64 = 1e-9;
const MOST_DAMPING: f64 = 1e8;
/// Largest change of x on a log scale in one step.
const LOG_STEP: f64 = 1.0;
/// Levels above this only prepare the next: models are expected to explain forces better.
const COARSE: f64 = 0.5;
/// Most iterations of the trajectory alone, at each of those.
const SETTLING: usize = 15;
/// Part of a rejected level's evidence: how many nats worse ends the search.
const WORSE: f64 = 2.0;

/// Where a solver starts: parameters, and trajectories if they are known.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    /// free parameters
    pub x: Vec<f64>,
    /// per trial (knots × nq)
    pub trajectories: Option<Vec<Vec<f64>>>,
    /// (nv) size of the forces, which unexplained forces are parts of
    pub force_scale: Option<Vec<f64>>,
}

/// Estimates parameters and trajectories. `watch` is told of each iteration, and stops the solver by `false`.
///
/// # Errors
/// The engine refuses a number.
pub fn solve(
    problem: &Problem,
    settings: &JointSettings,
    start: &Start,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Fit, SysidError> {
    let trajectories = match &start.trajectories {
        Some(given) => given.clone(),
        None => (problem.trials.iter())
            .map(|trial| start::trajectory(problem, trial, &start.x))
            .collect::<Result<_, _>>()?,
    };
    let scale = match &start.force_scale {
        Some(given) => given.clone(),
        None => {
            let mut scale = force_scale(problem, &start.x)?;
            let nv = scale.len();
            let mut square = vec![0.0; nv];
            let mut n = 0.0;
            for (trial, qpos) in problem.trials.iter().zip(&trajectories) {
                let point = Point { problem, trial, qpos, x: &start.x };
                for row in point.evaluate()?.force.chunks_exact(nv) {
                    square.iter_mut().zip(row).for_each(|(s, f)| *s += f * f);
                    n += 1.0;
                }
            }
            if std::env::var_os("DBG").is_some() { eprintln!("scale {scale:.4?} first {:.4?}", square.iter().map(|s| (s / n).sqrt()).collect::<Vec<_>>()); }
            for (scale, square) in scale.iter_mut().zip(square) {
                *scale = scale.max((square / n).sqrt());
            }
            scale
        }
    };
    let mut solver = Solver {
        problem,

        force_sigma: vec![0.0; problem.model.nv()],
        x: start.x.clone(),
        trajectories,
        damping: FIRST_DAMPING,
        hold: false,
        history: Vec::new(),
    };
    let mut best: Option<Fit> = None;
    for (i, &level) in settings.levels.iter().enumerate() {
        let last = i + 1 == settings.levels.len();
        for ((sigma, given), scale) in (solver.force_sigma.iter_mut()).zip(&problem.force_sigma).zip(&scale) {
            // a given sigma is where its joint ends; until then it is eased like the others
            let ratio = level / settings.levels.last().copied().unwrap_or(1.0);
            *sigma = if *given > 0.0 { given * ratio } else { level * scale };
        }
        let early = !last && (!settings.by_evidence || level > COARSE);
        let (limit, tolerance) = if early { (6, 1e-2) } else { (settings.max_iterations, settings.tolerance) };
        if early || i == 0 {
            // the motion first finds its contacts with the parameters as they are
            solver.hold = true;
            solver.descend(level, SETTLING, 1e-2, watch)?;
            solver.hold = false;
        }
        let status = solver.descend(level, limit, tolerance, watch)?;
        if early && status != Status::Interrupted {
            continue;
        }
        let fit = solver.conclude(level, status)?;
        let worse = best.as_ref().is_some_and(|b| fit.negative_log_evidence > b.negative_log_evidence + WORSE);
        if best.as_ref().is_none_or(|b| !settings.by_evidence || fit.negative_log_evidence < b.negative_log_evidence) {
            best = Some(fit);
        }
        if status == Status::Interrupted || (settings.by_evidence && worse) {
            break;
        }
    }
    let mut fit = best.ok_or_else(|| SysidError::Setting { reason: "no level of unexplained force is given".into() })?;
    fit.history = solver.history;
    Ok(fit)
}

/// Size of the forces at each degree of freedom, N m or N.
///
/// # Errors
/// The engine refuses a number.
pub fn force_scale(problem: &Problem, x: &[f64]) -> Result<Vec<f64>, SysidError> {
    let mut data = crate::mujoco::Data::new(std::sync::Arc::clone(&problem.model))?;
    problem.parameters.apply(&problem.model, x, &mut data)?;
    let mut rows = Vec::new();
    for trial in &problem.trials {
        let controls = problem.controls(trial, x);
        for ctrl in controls.chunks_exact(problem.model.nu().max(1)) {
            data.ctrl_mut().copy_from_slice(ctrl);
            data.position_stage()?;
            data.velocity_stage()?;
            data.actuation()?;
            rows.push(data.qfrc_actuator().to_vec());
        }
    }
    start::force_scale(&problem.model, rows.into_iter())
}

struct Solver<'a> {
    problem: &'a Problem,
    force_sigma: Vec<f64>,
    x: Vec<f64>,
    trajectories: Vec<Vec<f64>>,
    damping: f64,
    /// whether parameters stay as they are
    hold: bool,
    history: Vec<Iteration>,
}

/// A sensor sample on the grid: between knots k and k + 1.
struct Placed {
    knot: usize,
    part: f64,
    sample: usize,
}

impl Solver<'_> {
    fn point<'b>(&'b self, trial: usize, qpos: &'b [f64], x: &'b [f64]) -> Point<'b> {
        Point { problem: self.problem, trial: &self.problem.trials[trial], qpos, x }
    }

    /// Gauss-Newton at one level.
    fn descend(
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
                return Ok(if small > 0 { Status::Converged } else { Status::Stalled });
            };
            let decrease = (cost - new) / cost.max(f64::MIN_POSITIVE);
            (self.x, self.trajectories, cost) = (x, moved, new);
            let step = dx.iter().fold(0.0_f64, |m, d| m.max(d.abs()));
            let record = Iteration { level, cost, damping: self.damping, step, x: self.x.clone() };
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

    /// Samples of a trial on the grid, in the order of knots.
    fn placed(&self, trial: usize, x: &[f64]) -> Vec<Placed> {
        let h = self.problem.model.timestep();
        let free = self.problem.free_values(x);
        let trial = &self.problem.trials[trial];
        let last = trial.n_knots - 1;
        let mut placed: Vec<Placed> = (trial.samples.iter().enumerate())
            .filter_map(|(sample, s)| {
                let channel = &self.problem.channels[s.channel];
                let (low, high) = match channel.stage {
                    Stage::Position => (0, last),
                    Stage::Velocity => (1, last),
                    Stage::Acceleration => (1, last - 1),
                };
                let at = s.time / h;
                if at < low as f64 - 1e-4 || at > high as f64 + 1e-4 {
                    return None;
                }
                let at = ((s.time - channel.delay.value(&free)) / h).clamp(low as f64, high as f64);
                let mut knot = (at + 1e-4).floor() as usize;
                let mut part = at - knot as f64;
                if channel.stage == Stage::Acceleration || part < 1e-4 || knot == high {
                    // forces are held over a step; stamps are rounded
                    (knot, part) = (knot.min(high), 0.0);
                }
                Some(Placed { knot, part, sample })
            })
            .collect();
        placed.sort_by_key(|p| p.knot);
        placed
    }

    fn cost(&self, x: &[f64], trajectories: &[Vec<f64>]) -> Result<f64, SysidError> {
        let nv = self.problem.model.nv();
        let n_channels = self.problem.channels.len();
        let free = self.problem.free_values(x);
        let mut sum = 0.0;
        for (i, qpos) in trajectories.iter().enumerate() {
            let Evaluated { force, sensors } = self.point(i, qpos, x).evaluate()?;
            for row in force.chunks_exact(nv) {
                for ((f, sigma), norm) in row.iter().zip(&self.force_sigma).zip(&self.problem.force_norm) {
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

    /// All trajectories eliminated.
    fn eliminate(&self, damping: f64) -> Result<Vec<Arrow>, SysidError> {
        let (nv, np) = (self.problem.model.nv(), self.x.len());
        let mut arrows = Vec::new();
        for (i, trial) in self.problem.trials.iter().enumerate() {
            let point = self.point(i, &self.trajectories[i], &self.x);
            let placed = self.placed(i, &self.x);
            let mut next = 0;
            let mut arrow = Arrow::new(nv, np);
            for from in (0..trial.n_knots).step_by(BLOCK) {
                let range = from..(from + BLOCK).min(trial.n_knots);
                next = self.feed(&mut arrow, &point, i, range, &placed, next, damping)?;
            }
            arrow.finish(trial.n_knots);
            arrows.push(arrow);
        }
        Ok(arrows)
    }

    #[allow(clippy::too_many_arguments)] // all of one loop, cut for the memory's sake
    fn feed(
        &self,
        arrow: &mut Arrow,
        point: &Point<'_>,
        trial: usize,
        range: Range<usize>,
        placed: &[Placed],
        mut next: usize,
        damping: f64,
    ) -> Result<usize, SysidError> {
        let (nv, np) = (self.problem.model.nv(), self.x.len());
        let free = self.problem.free_values(&self.x);
        let trial = &self.problem.trials[trial];
        let h = self.problem.model.timestep();
        let width = 3 * nv + np + 1;
        let blocks = point.linearise(range.start..(range.end + 1).min(trial.n_knots))?;
        let resist = damping.sqrt() / TYPICAL_POSITION;
        for k in range {
            if k > 0 && k + 1 < trial.n_knots {
                for i in 0..nv {
                    let source = blocks.row(k, i);
                    let r = source[width - 1] / self.force_sigma[i];
                    let factor = self.problem.force_norm[i].weight(r).sqrt() / self.force_sigma[i];
                    let row = arrow.row();
                    for (row, s) in row.iter_mut().zip(source) {
                        *row = factor * s;
                    }
                    row[width - 1] = -row[width - 1];
                }
            }
            while next < placed.len() && placed[next].knot == k {
                let Placed { part, sample, .. } = placed[next];
                next += 1;
                let s = &trial.samples[sample];
                let channel = &self.problem.channels[s.channel];
                let (gain, bias) = (channel.gain.value(&free), channel.bias.value(&free));
                let here = blocks.row(k, nv + s.channel);
                let row = arrow.row();
                row.copy_from_slice(here);
                let mut slope = 0.0;
                if part > 0.0 {
                    let there = blocks.row(k + 1, nv + s.channel);
                    slope = (there[width - 1] - here[width - 1]) / h;
                    row.iter_mut().for_each(|v| *v *= 1.0 - part);
                    // the window of knot k + 1 stands one block to the right
                    for (v, t) in row[nv..3 * nv].iter_mut().zip(&there[..2 * nv]) {
                        *v += part * t;
                    }
                    for (v, t) in row[3 * nv..].iter_mut().zip(&there[3 * nv..]) {
                        *v += part * t;
                    }
                } else if k + 1 < trial.n_knots && channel.stage != Stage::Acceleration {
                    slope = (blocks.row(k + 1, nv + s.channel)[width - 1] - here[width - 1]) / h;
                }
                let z = row[width - 1];
                let r = (gain * z + bias - s.value) / channel.sigma;
                let factor = channel.norm.weight(r).sqrt() / channel.sigma;
                row.iter_mut().for_each(|v| *v *= factor * gain);
                for (setting, derivative) in
                    [(channel.bias, 1.0), (channel.gain, z), (channel.delay, -gain * slope)]
                {
                    if let super::problem::Setting::Free(j) = setting {
                        let p = &self.problem.parameters.all[self.problem.parameters.free[j]];
                        // a value on a log scale changes by itself
                        let by_x = if p.scale == super::parameter::Scale::Log { free[j] } else { 1.0 };
                        row[3 * nv + j] += factor * derivative * by_x;
                    }
                }
                row[width - 1] = -factor * (gain * z + bias - s.value);
            }
            for i in 0..nv {
                let row = arrow.row();
                row[nv + i] = resist;
            }
            arrow.close(k);
        }
        Ok(next)
    }

    /// The step at a damping: eliminated trajectories, and the change of the parameters within their bounds.
    fn step(&self, damping: f64) -> Result<(Vec<Arrow>, Vec<f64>), SysidError> {
        let np = self.x.len();
        let arrows = self.eliminate(damping)?;
        let mut normal = DMatrix::zeros(np, np);
        let mut right = DVector::zeros(np);
        for row in arrows.iter().flat_map(|a| a.innovations.chunks_exact(np + 1)) {
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
            let most = if p.scale == super::parameter::Scale::Log { LOG_STEP } else { f64::INFINITY };
            if self.hold {
                continue;
            }
            (low[i], high[i]) = ((lower - self.x[i]).max(-most), (upper - self.x[i]).min(most));
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
    fn conclude(&self, level: f64, status: Status) -> Result<Fit, SysidError> {
        let cost = self.cost(&self.x, &self.trajectories)?;
        let arrows = self.eliminate(LEAST_DAMPING)?;
        let mut innovations = Innovations { n_parameters: self.x.len(), ..Innovations::default() };
        let mut negative_log_evidence = cost;
        let mut weakest = (f64::INFINITY, 0, 0, 0);
        for (trial, arrow) in arrows.iter().enumerate() {
            innovations.rows.extend_from_slice(&arrow.innovations);
            innovations.places.extend(arrow.innovation_knots.iter().map(|&k| (trial, k)));
            negative_log_evidence += arrow.log_diagonal();
            let n = self.problem.trials[trial].n_knots - 2;
            negative_log_evidence += n as f64 * self.force_sigma.iter().map(|s| s.ln()).sum::<f64>();
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

/// argmin ½ xᵀ N x − bᵀ x within bounds, by active sets: components that hit a bound are held there.
fn solve_in_box(normal: &DMatrix<f64>, right: &DVector<f64>, low: &[f64], high: &[f64]) -> Vec<f64> {
    let n = low.len();
    let mut held: Vec<Option<f64>> = vec![None; n];
    loop {
        let free: Vec<usize> = (0..n).filter(|&i| held[i].is_none()).collect();
        let mut x: Vec<f64> = held.iter().map(|h| h.unwrap_or(0.0)).collect();
        if free.is_empty() {
            return x;
        }
        // scaled to a unit diagonal, for parameters of very different units
        let scale: Vec<f64> = free.iter().map(|&i| normal[(i, i)].max(f64::MIN_POSITIVE).sqrt().recip()).collect();
        let a = DMatrix::from_fn(free.len(), free.len(), |r, c| normal[(free[r], free[c])] * scale[r] * scale[c]);
        let b = DVector::from_fn(free.len(), |r, _| {
            let fixed: f64 = (0..n).filter_map(|j| held[j].map(|v| normal[(free[r], j)] * v)).sum();
            (right[free[r]] - fixed) * scale[r]
        });
        let solution = match a.clone().cholesky() {
            Some(factor) => factor.solve(&b),
            None => a.svd(true, true).solve(&b, 1e-12).unwrap_or_else(|_| DVector::zeros(free.len())),
        };
        let mut changed = false;
        for (r, &i) in free.iter().enumerate() {
            x[i] = solution[r] * scale[r];
            if x[i] < low[i] || x[i] > high[i] {
                held[i] = Some(x[i].clamp(low[i], high[i]));
                changed = true;
            }
        }
        if !changed {
            return x;
        }
    }
}
