//! Identification by whole rollouts: parameters under which simulations from recorded states deviate least.
//!
//! Where motion is chaotic, as of a body that tumbles, a single long rollout has no useful slope, and windows short
//! enough to have one ask for something else than what is wanted in the end. The mean over many rollouts is rough, but it
//! has a shape. With dᵢₜ the mean deviation of rollout i in term t (a channel up to a horizon, as `phantom compare`
//! prints them) of mₜ dimensions, each a Laplace variable in its length,
//!
//! ```text
//! −log p = Σᵢₜ wₜ (dᵢₜ/bₜ + log bₜ)        wₜ = mₜ / horizons        bₜ = mean of dᵢₜ over i
//! F(x)   = Σᵢₜ wₜ log bₜ(x)  +  Σ ((x − x̄)/σₓ)²/2
//! ```
//!
//! the first with its own best scales bₜ. F is searched by evolution (see `evolution`), from `x` on and inside the
//! bounds. A quadratic through a cloud of candidates around the best then averages over the roughness: its minimum is the
//! estimate, and its curvature with the scatter of the starts' own slopes makes intervals (`surface`, `interval`), which
//! a bootstrap over the starts would give, too.
//!
//! | symbol | name |
//! | --- | --- |
//! | i, t | `Rollouts::starts`, `Term` |
//! | dᵢₜ, wₜ, bₜ | `deviations`, `Term::weight`, `scales` |
//!
//! Reference: Acosta, Yang and Posa 2022, "Validating robotics simulators on real-world impacts", for the protocol.

mod motion;
mod objective;

use std::iter;

use rayon::prelude::*;

use super::SysidError;
use super::evolution::{self, Candidate, Evolution};
use super::fit::{Fit, Innovations, Iteration, Start, Status};
use super::parameter::Parameters;
use super::problem::Problem;
use super::surface::{Surface, needed};
use crate::compare::Settings;
use crate::rng::{self, Purpose};
pub(crate) use objective::{Objective, Rollouts};

/// Settings of the method.
#[derive(Debug, Clone, PartialEq)]
pub struct RolloutSettings {
    /// where rollouts start and how far they go
    pub protocol: Settings,
    /// most generations of the search
    pub generations: usize,
    /// width of the first generation, as a part of the usual
    pub spread: f64,
    /// whether to go on to the minimum of a surface, which intervals follow from
    pub intervals: bool,
    /// candidates a generation; none: by the number of parameters
    pub population: Option<usize>,
    /// fall of −log p over many generations below which it has converged
    pub tolerance: f64,
    /// of the search
    pub seed: u64,
}

impl Default for RolloutSettings {
    fn default() -> Self {
        Self {
            protocol: Settings::default(),
            spread: 1.0,
            intervals: true,
            generations: 60,
            population: None,
            tolerance: 0.1,
            seed: 0,
        }
    }
}

/// Candidates of a cloud for each number of the quadratic.
const CLOUD: usize = 4;
/// Size of the last cloud in standard deviations of the estimate: wide enough that the cost rises above its roughness.
const WIDTH: f64 = 2.0;
/// Part of all candidates from which the first cloud takes its size.
const ELITE: usize = 4;
/// Least size of a cloud, as a part of the first generation's.
const LEAST: f64 = 0.02;

/// Estimates parameters. `watch` is told of each generation, and stops the search by `false`.
///
/// # Errors
/// No recording has a start, or rollouts break down at the first parameters.
pub fn solve(
    problem: &Problem,
    settings: &RolloutSettings,
    start: &Start,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Fit, SysidError> {
    let objective = Objective::new(problem, &settings.protocol);
    let broken =
        "a rollout breaks down at the first parameters: start nearer, or take shorter horizons";
    let first = objective
        .roll_out(&start.x)?
        .ok_or_else(|| SysidError::Setting {
            reason: broken.into(),
        })?;
    if first.starts.is_empty() {
        return Err(SysidError::Setting {
            reason: "no recording has a start of a rollout: see the protocol".into(),
        });
    }
    let parameters = &problem.parameters;
    let mut fit = Fit {
        x: start.x.clone(),
        trajectories: Vec::new(),
        cost: first.cost(),
        negative_log_evidence: first.cost(),
        level: 0.0,
        force_sigma: vec![0.0; problem.model.nv()],
        horizon_s: None,
        status: Status::Converged,
        history: Vec::new(),
        innovations: Innovations::default(),
        weakest: (1.0, 0, 0, 0),
    };
    if !start.x.is_empty() {
        let cost = |x: &[f64]| {
            let rollouts = objective.roll_out(x).ok().flatten()?;
            Some(rollouts.cost() + parameters.prior_cost(x))
        };
        let mut ranges = evolution::ranges(parameters, &start.x);
        for range in &mut ranges {
            range.2 *= settings.spread;
        }
        let evolution = Evolution {
            generations: settings.generations,
            population: settings.population,
            tolerance: settings.tolerance,
            seed: settings.seed,
        };
        let (all, status) =
            evolution::search(evolution, &start.x, &ranges, &cost, &mut |best, step| {
                let iteration = Iteration {
                    level: 0.0,
                    cost: best.cost.unwrap_or(f64::INFINITY),
                    damping: 0.0,
                    horizon_s: None,
                    step,
                    x: best.x.clone(),
                };
                fit.history.push(iteration.clone());
                watch(&iteration)
            })?;
        (fit.x, fit.cost) = least(&all);
        fit.status = status;
        if settings.intervals && status != Status::Interrupted {
            settle(&objective, settings.seed, &ranges, &all, &mut fit)?;
        }
        fit.negative_log_evidence = fit.cost;
    }
    fit.trajectories = motion::of(&objective, &fit.x)?;
    Ok(fit)
}

/// Costs of every start of every trial, in units of `scales`, or of their own mean.
pub(super) struct Costs {
    /// trial by trial
    pub of_starts: Vec<Vec<f64>>,
    /// that were used
    pub scales: Vec<f64>,
}

/// Costs at the first parameters of a problem.
///
/// # Errors
/// A rollout breaks down.
pub(super) fn costs(
    problem: &Problem,
    settings: &RolloutSettings,
    scales: Option<&[f64]>,
) -> Result<Costs, SysidError> {
    let objective = Objective::new(problem, &settings.protocol);
    let rollouts = objective
        .roll_out(&problem.parameters.start())?
        .ok_or_else(|| SysidError::Setting {
            reason: "a rollout of a held-out recording breaks down".into(),
        })?;
    let scales = scales.map_or_else(|| rollouts.scales(), <[f64]>::to_vec);
    let mut of_starts = vec![Vec::new(); problem.trials.len()];
    for ((trial, _), cost) in rollouts.starts.iter().zip(rollouts.costs(&scales)) {
        of_starts[*trial].push(cost);
    }
    Ok(Costs { of_starts, scales })
}

fn least(all: &[Candidate]) -> (Vec<f64>, f64) {
    let cost = |c: &Candidate| c.cost.unwrap_or(f64::INFINITY);
    let best = all.iter().min_by(|a, b| cost(a).total_cmp(&cost(b)));
    best.map_or((Vec::new(), f64::INFINITY), |b| (b.x.clone(), cost(b)))
}

/// From the best candidate to the minimum of what the costs around it are on average.
fn settle(
    objective: &Objective<'_>,
    seed: u64,
    ranges: &[(f64, f64, f64)],
    all: &[Candidate],
    fit: &mut Fit,
) -> Result<(), SysidError> {
    let n = fit.x.len();
    let parameters = &objective.problem.parameters;
    let mut spread = elite_spread(all, ranges);
    for round in 0..2 {
        let Some(here) = objective.roll_out(&fit.x)? else {
            return Ok(());
        };
        let points = cloud(objective, (seed, round), &fit.x, &spread, ranges, &here);
        if points.len() <= needed(n) {
            return Ok(());
        }
        let surface = Surface::new(&fit.x, &spread, &points, f64::INFINITY)?;
        let (curvature, slope) = with_prior(&surface, parameters, &fit.x);
        let dx = surface.least(&curvature, &slope);
        let there: Vec<f64> = fit.x.iter().zip(&dx).map(|(x, d)| x + d).collect();
        let rollouts = objective.roll_out(&there)?;
        let cost = rollouts.map_or(f64::INFINITY, |r| r.cost() + parameters.prior_cost(&there));
        // the best of many candidates is best partly by luck, as much as the cost is rough
        if cost < fit.cost + 3.0 * surface.rough {
            (fit.x, fit.cost) = (there, cost);
        }
        fit.innovations = Innovations {
            n_parameters: n,
            rows: surface.innovations(),
            places: places(objective.problem, &here, n),
        };
        let covariance = curvature.try_inverse();
        spread = (0..n)
            .map(|i| {
                let sigma = covariance
                    .as_ref()
                    .map_or(0.0, |c| c[(i, i)].max(0.0).sqrt());
                (WIDTH * sigma).clamp(LEAST * ranges[i].2, ranges[i].2)
            })
            .collect();
    }
    Ok(())
}

/// Root mean square distance of the better candidates from their best, x by x.
fn elite_spread(all: &[Candidate], ranges: &[(f64, f64, f64)]) -> Vec<f64> {
    let mut sorted: Vec<&Candidate> = all.iter().filter(|c| c.cost.is_some()).collect();
    sorted.sort_by(|a, b| a.cost.unwrap_or(0.0).total_cmp(&b.cost.unwrap_or(0.0)));
    let elite = &sorted[..sorted.len().div_ceil(ELITE)];
    (ranges.iter().enumerate())
        .map(|(i, range)| {
            let square = |c: &&Candidate| (c.x[i] - elite[0].x[i]).powi(2);
            let mean = elite.iter().map(square).sum::<f64>() / elite.len() as f64;
            mean.sqrt().clamp(LEAST * range.2, range.2)
        })
        .collect()
}

/// Costs at points around `centre`: of all starts together, and of each with the scales of `here`.
fn cloud(
    objective: &Objective<'_>,
    (seed, round): (u64, u64),
    centre: &[f64],
    spread: &[f64],
    ranges: &[(f64, f64, f64)],
    here: &Rollouts,
) -> Vec<(Vec<f64>, Vec<f64>)> {
    let scales = here.scales();
    let n = CLOUD * needed(centre.len());
    let points: Vec<Option<(Vec<f64>, Vec<f64>)>> = (0..n as u64)
        .into_par_iter()
        .map(|k| {
            let mut rng = rng::stream(seed, Purpose::Posterior, 1 + round, k);
            let x: Vec<f64> = (centre.iter().zip(spread).zip(ranges))
                .map(|((c, s), range)| (c + s * rng::normal(&mut rng)).clamp(range.0, range.1))
                .collect();
            let rollouts = objective.roll_out(&x).ok().flatten()?;
            if rollouts.starts.len() != here.starts.len() {
                return None;
            }
            let costs = iter::once(rollouts.cost()).chain(rollouts.costs(&scales));
            Some((x, costs.collect()))
        })
        .collect();
    points.into_iter().flatten().collect()
}

/// Curvature and slope of the whole cost.
fn with_prior(
    surface: &Surface,
    parameters: &Parameters,
    x: &[f64],
) -> (nalgebra::DMatrix<f64>, nalgebra::DVector<f64>) {
    let (mut curvature, mut slope) = (surface.curvature.clone(), surface.slope.clone());
    for (i, (precision, own)) in parameters.prior_slopes(x).enumerate() {
        curvature[(i, i)] += precision;
        slope[i] += own;
    }
    (curvature, slope)
}

/// Trial and knot of each row of innovations, `n` a start.
fn places(problem: &Problem, rollouts: &Rollouts, n: usize) -> Vec<(usize, usize)> {
    let h = problem.model.timestep();
    let place = |&(trial, time): &(usize, f64)| {
        let last = problem.trials[trial].n_knots - 1;
        (trial, ((time / h).round() as usize).min(last))
    };
    (rollouts.starts.iter())
        .flat_map(|start| iter::repeat_n(place(start), n))
        .collect()
}
