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
//! −log p = cost + Σ log |Rᵢᵢ| − Σ log |det ∂ρₖ/∂qₖ₊₁| + Σ log σₛ
//! ```
//!
//! is kept: the likelihood of the samples, the trajectory integrated out. R is the triangular factor of the
//! trajectory; the determinants, of whitened missing forces ρ, turn the density of forces into one of positions.

pub use super::fit::{Fit, Innovations, Iteration, Start, Status};
use super::likelihood::Likelihood;
use super::newton::{Goal, Solver};
use super::problem::Problem;
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
    /// whether to follow the trials by simulation first
    pub tracking: Tracking,
}

/// When trials are followed by simulation before the solver sets in (see `track`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tracking {
    /// where there is contact
    Auto,
    /// anyway
    Always,
    /// not at all
    Never,
}

impl Default for JointSettings {
    fn default() -> Self {
        Self {
            max_iterations: 40,
            tolerance: 1e-7,
            levels: vec![10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4],
            by_evidence: true,
            tracking: Tracking::Auto,
        }
    }
}

/// Levels above this only prepare the next: models are expected to explain forces better.
const COARSE: f64 = 0.5;
/// Most iterations of the trajectory alone, at each of those.
const SETTLING: usize = 15;
/// How many nats of evidence worse a level has to be to end the search.
const WORSE: f64 = 2.0;
/// Nats that a level other than the last need not be exact to.
const SLACK: f64 = 0.05;
/// Part of the knots in contact from which on trials are followed by simulation.
const IN_CONTACT: f64 = 0.01;

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
    if settings.levels.is_empty() {
        let reason = "no level of unexplained force is given".into();
        return Err(SysidError::Setting { reason });
    }
    let trajectories = start::trajectories(problem, start)?;
    let scale = match &start.force_scale {
        Some(given) => given.clone(),
        None => force_scale(problem, &start.x)?,
    };
    let mut history = Vec::new();
    let mut watch = |i: &Iteration| {
        history.push(i.clone());
        watch(i)
    };
    let contact = start::contact(problem, &start.x, &trajectories)?;
    let track = match settings.tracking {
        Tracking::Auto => contact > IN_CONTACT,
        Tracking::Always => true,
        Tracking::Never => false,
    };
    let tracked = if track {
        tracked(
            problem,
            settings,
            &start.x,
            &trajectories,
            &scale,
            &mut watch,
        )?
    } else {
        None
    };
    let mut fit = match tracked {
        Some(fit) => fit,
        None => descended(
            problem,
            settings,
            &start.x,
            trajectories,
            &scale,
            contact > 0.0,
            &mut watch,
        )?,
    };
    fit.history = history;
    Ok(fit)
}

/// By levels of unexplained force, on the trajectories as a whole.
fn descended(
    problem: &Problem,
    settings: &JointSettings,
    x: &[f64],
    trajectories: Vec<Vec<f64>>,
    scale: &[f64],
    is_touching: bool,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Fit, SysidError> {
    let mut solver = Solver::new(problem, x.to_vec(), trajectories);
    let mut best: Option<Fit> = None;
    for (i, &level) in settings.levels.iter().enumerate() {
        let last = i + 1 == settings.levels.len();
        solver.force_sigma = problem.force_sigma_at(level, scale);
        let early = !last && (!settings.by_evidence || level > COARSE);
        if i == 0 || (early && is_touching) {
            // the motion first finds its contacts with the parameters as they are
            solver.hold = true;
            solver.descend(level, rough(SETTLING), watch)?;
            solver.hold = false;
        }
        let goal = if early {
            rough(6)
        } else {
            Goal {
                limit: settings.max_iterations,
                tolerance: settings.tolerance,
                slack: if settings.by_evidence { SLACK } else { 0.0 },
                is_exact: !settings.by_evidence,
            }
        };
        let status = solver.descend(level, goal, watch)?;
        if early && status != Status::Interrupted {
            continue;
        }
        let fit = solver.conclude(level, status)?;
        let evidence = best
            .as_ref()
            .map_or(f64::INFINITY, |b| b.negative_log_evidence);
        let stop = settings.by_evidence && fit.negative_log_evidence > evidence + WORSE;
        if best.is_none() || !settings.by_evidence || fit.negative_log_evidence < evidence {
            best = Some(fit);
        }
        if status == Status::Interrupted {
            return match best {
                Some(fit) => Ok(Fit { status, ..fit }),
                None => solver.conclude(level, status),
            };
        }
        if stop {
            break;
        }
    }
    match best {
        Some(fit) if settings.by_evidence => {
            solver.force_sigma = problem.force_sigma_at(fit.level, scale);
            solver.go(fit.x, fit.trajectories);
            let goal = Goal {
                limit: settings.max_iterations,
                tolerance: settings.tolerance,
                slack: 0.0,
                is_exact: true,
            };
            let status = solver.descend(fit.level, goal, watch)?;
            solver.conclude(fit.level, status)
        }
        Some(fit) => Ok(fit),
        None => solver.conclude(
            settings.levels[settings.levels.len() - 1],
            Status::MaxIterations,
        ),
    }
}

/// A goal on the way to a stricter one.
fn rough(limit: usize) -> Goal {
    Goal {
        limit,
        tolerance: 1e-2,
        slack: SLACK,
        is_exact: false,
    }
}

/// By following the trials; `None` if they are lost.
fn tracked(
    problem: &Problem,
    settings: &JointSettings,
    x: &[f64],
    trajectories: &[Vec<f64>],
    scale: &[f64],
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Option<Fit>, SysidError> {
    let beliefs = (problem.trials.iter().zip(trajectories))
        .map(|(trial, qpos)| start::belief(problem, trial, x, qpos))
        .collect::<Result<Vec<_>, _>>()?;
    let likelihood = Likelihood {
        problem,
        force_scale: scale,
        beliefs: &beliefs,
    };
    let Some(found) = likelihood.search(x, &settings.levels, settings.by_evidence, watch)? else {
        return Ok(None);
    };
    let Some(followed) = likelihood.follow(&found.x, found.level, found.noise, true)? else {
        return Ok(None);
    };
    let mut innovations = Innovations {
        n_parameters: x.len(),
        ..Innovations::default()
    };
    let (mut motion, mut nll) = (Vec::new(), 0.0);
    for (trial, f) in followed.into_iter().enumerate() {
        innovations.rows.extend(f.innovations);
        innovations
            .places
            .extend(f.knots.iter().map(|&k| (trial, k)));
        motion.push(f.qpos);
        nll += f.nll;
    }
    let mut solver = Solver::new(problem, found.x, motion);
    solver.force_sigma = problem.force_sigma_at(found.level, scale);
    let linear = solver.conclude(found.level, found.status)?;
    Ok(Some(Fit {
        cost: nll,
        negative_log_evidence: nll,
        innovations,
        ..linear
    }))
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
