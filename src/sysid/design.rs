//! Which motions would tell most about the parameters.
//!
//! Of a motion, simulated or recorded, the information on the parameters is that of its innovations: the motion itself is
//! unknown and marginalised. With what is known already (priors, recordings made) information adds up:
//!
//! ```text
//! A = P + Σ A_recorded + Σ A_chosen        D: max log det A        E: max of the least eigenvalue of A
//! ```
//!
//! all in units of the parameters' sizes. Motions are chosen one after the other, each the best next to those before;
//! the same may come twice. Noise counts as white here: intervals of an identification will be wider, by factors that
//! are much alike between motions.

use std::cmp::Ordering;

use nalgebra::{DMatrix, SymmetricEigen};
use serde::Serialize;

use super::SysidError;
use super::fit::{Iteration, Start, Status};
use super::holdout::hold;
use super::joint::{self, JointSettings};
use super::newton::Solver;
use super::problem::Problem;

/// Information assumed of everything, so that what nothing excites has a finite spread: ten sizes.
const LEAST_INFORMATION: f64 = 1e-2;

/// What makes a motion good.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Criterion {
    /// volume of the confidence ellipsoid
    D,
    /// its longest axis
    E,
}

/// A motion and its information (parameters × parameters, in sizes).
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// behaviour or recording
    pub name: String,
    /// s
    pub duration_s: f64,
    /// of the recording alone
    pub information: DMatrix<f64>,
}

/// A motion's worth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Score {
    /// behaviour or recording
    pub name: String,
    /// s
    pub duration_s: f64,
    /// log det with it less without, nats
    pub d_gain: f64,
    /// least eigenvalue with it over without
    pub e_ratio: f64,
    /// standard deviation of each parameter's x with it
    pub sigma: Vec<f64>,
}

/// What to record.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Plan {
    /// criterion
    pub criterion: Criterion,
    /// estimated parameters, in the order of every `sigma`
    pub parameters: Vec<String>,
    /// size of each, in x: a factor e on log scales
    pub sizes: Vec<f64>,
    /// before anything is recorded
    pub sigma: Vec<f64>,
    /// each motion on its own, best first
    pub scores: Vec<Score>,
    /// one after the other
    pub next: Vec<Score>,
}

/// The information of the recordings of a problem on its free parameters, at the start values.
///
/// # Errors
/// The engine refuses a number.
pub fn information(
    problem: &Problem,
    settings: &JointSettings,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<DMatrix<f64>, SysidError> {
    let x = problem.parameters.start();
    let scale = joint::force_scale(problem, &x)?;
    let level = problem.force_sigma_relative;
    let mut held = hold(problem, |p| p.start);
    for (sigma, scale) in held.force_sigma.iter_mut().zip(&scale) {
        if *sigma <= 0.0 {
            *sigma = level * scale;
        }
    }
    let mut levels: Vec<f64> = settings
        .levels
        .iter()
        .copied()
        .filter(|l| *l > level)
        .collect();
    levels.push(level);
    let settings = JointSettings {
        levels,
        by_evidence: false,
        ..settings.clone()
    };
    let start = Start {
        x: Vec::new(),
        trajectories: None,
        force_scale: None,
    };
    let motion = joint::solve(&held, &settings, &start, watch)?;
    let mut solver = Solver::new(problem, x, motion.trajectories);
    solver.force_sigma = held.force_sigma_at(level, &scale);
    let fit = solver.conclude(level, Status::Converged)?;
    let sizes: Vec<f64> = problem.parameters.iter_free().map(|p| p.typical).collect();
    let n = sizes.len();
    let mut out = DMatrix::zeros(n, n);
    for row in fit.innovations.rows.chunks_exact(n + 1) {
        for i in 0..n {
            for j in 0..n {
                out[(i, j)] += row[i] * row[j] * sizes[i] * sizes[j];
            }
        }
    }
    Ok(out)
}

/// Scores every candidate and chooses `n` of them. `problem` has the parameters; `known` is the information of the
/// recordings that exist.
pub fn plan(
    problem: &Problem,
    known: &DMatrix<f64>,
    candidates: &[Candidate],
    criterion: Criterion,
    n: usize,
) -> Plan {
    let parameters = || problem.parameters.iter_free();
    let sizes: Vec<f64> = parameters().map(|p| p.typical).collect();
    let mut now = known.clone();
    for (i, p) in parameters().enumerate() {
        now[(i, i)] += (p.typical / p.prior_sigma).powi(2) + LEAST_INFORMATION;
    }
    let mut scores: Vec<Score> = candidates.iter().map(|c| score(&now, c, &sizes)).collect();
    scores.sort_by(|a, b| better(criterion, b, a));
    let before = spread(&now, &sizes);
    let mut next = Vec::new();
    for _ in 0..n {
        let all = candidates.iter().map(|c| (score(&now, c, &sizes), c));
        let Some((best, chosen)) = all.max_by(|a, b| better(criterion, &a.0, &b.0)) else {
            break;
        };
        now += &chosen.information;
        next.push(best);
    }
    Plan {
        criterion,
        parameters: parameters().map(|p| p.name.clone()).collect(),
        sigma: before,
        sizes,
        scores,
        next,
    }
}

fn better(criterion: Criterion, a: &Score, b: &Score) -> Ordering {
    match criterion {
        Criterion::D => a.d_gain.total_cmp(&b.d_gain),
        // what no candidate excites must not decide
        Criterion::E if (a.e_ratio / b.e_ratio - 1.0).abs() < 1e-3 => a.d_gain.total_cmp(&b.d_gain),
        Criterion::E => a.e_ratio.total_cmp(&b.e_ratio),
    }
}

fn score(now: &DMatrix<f64>, candidate: &Candidate, sizes: &[f64]) -> Score {
    let with = now + &candidate.information;
    let eigenvalues = |a: &DMatrix<f64>| SymmetricEigen::new(a.clone()).eigenvalues;
    let (a, b) = (eigenvalues(now), eigenvalues(&with));
    let log_det = |values: &nalgebra::DVector<f64>| -> f64 {
        values.iter().map(|v| v.max(LEAST_INFORMATION).ln()).sum()
    };
    Score {
        name: candidate.name.clone(),
        duration_s: candidate.duration_s,
        d_gain: log_det(&b) - log_det(&a),
        e_ratio: b.min().max(LEAST_INFORMATION) / a.min().max(LEAST_INFORMATION),
        sigma: spread(&with, sizes),
    }
}

/// Standard deviations of x.
fn spread(information: &DMatrix<f64>, sizes: &[f64]) -> Vec<f64> {
    let eigen = SymmetricEigen::new(information.clone());
    (0..sizes.len())
        .map(|i| {
            let variance: f64 = (eigen.eigenvalues.iter().enumerate())
                .map(|(k, v)| eigen.eigenvectors[(i, k)].powi(2) / v.max(LEAST_INFORMATION))
                .sum();
            variance.sqrt() * sizes[i]
        })
        .collect()
}
