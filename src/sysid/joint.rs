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
//! −log p = cost + Σ log |Rᵢᵢ| + n log σ
//! ```
//!
//! is kept, with R the triangular factor of the trajectory.

pub use super::fit::{Fit, Innovations, Iteration, Start, Status};
use super::linearise::Point;
use super::newton::Solver;
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
}

impl Default for JointSettings {
    fn default() -> Self {
        Self {
            max_iterations: 40,
            tolerance: 1e-7,
            levels: vec![
                100.0, 30.0, 10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4,
            ],
            by_evidence: true,
        }
    }
}

/// Levels above this only prepare the next: models are expected to explain forces better.
const COARSE: f64 = 0.5;
/// Most iterations of the trajectory alone, at each of those.
const SETTLING: usize = 15;
/// Part of a rejected level's evidence: how many nats worse ends the search.
const WORSE: f64 = 2.0;

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
        None => first_force_scale(problem, &start.x, &trajectories)?,
    };
    let mut solver = Solver::new(problem, start.x.clone(), trajectories);
    let mut best: Option<Fit> = None;
    for (i, &level) in settings.levels.iter().enumerate() {
        let last = i + 1 == settings.levels.len();
        for ((sigma, given), scale) in (solver.force_sigma.iter_mut())
            .zip(&problem.force_sigma)
            .zip(&scale)
        {
            // a given sigma is where its joint ends; until then it is eased like the others
            let ratio = level / settings.levels.last().copied().unwrap_or(1.0);
            *sigma = if *given > 0.0 {
                given * ratio
            } else {
                level * scale
            };
        }
        let early = !last && (!settings.by_evidence || level > COARSE);
        let (limit, tolerance) = if early {
            (6, 1e-2)
        } else {
            (settings.max_iterations, settings.tolerance)
        };
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
        let worse = best
            .as_ref()
            .is_some_and(|b| fit.negative_log_evidence > b.negative_log_evidence + WORSE);
        if best.as_ref().is_none_or(|b| {
            !settings.by_evidence || fit.negative_log_evidence < b.negative_log_evidence
        }) {
            best = Some(fit);
        }
        if status == Status::Interrupted || (settings.by_evidence && worse) {
            break;
        }
    }
    let mut fit = best.ok_or_else(|| SysidError::Setting {
        reason: "no level of unexplained force is given".into(),
    })?;
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

/// As [`force_scale`], at least as large as what the first trajectory leaves unexplained.
fn first_force_scale(
    problem: &Problem,
    x: &[f64],
    trajectories: &[Vec<f64>],
) -> Result<Vec<f64>, SysidError> {
    let mut scale = force_scale(problem, x)?;
    let mut square = vec![0.0; scale.len()];
    let mut n: f64 = 0.0;
    for (trial, qpos) in problem.trials.iter().zip(trajectories) {
        let point = Point {
            problem,
            trial,
            qpos,
            x,
        };
        for row in point.evaluate()?.force.chunks_exact(scale.len()) {
            square.iter_mut().zip(row).for_each(|(s, f)| *s += f * f);
            n += 1.0;
        }
    }
    for (scale, square) in scale.iter_mut().zip(square) {
        *scale = scale.max((square / n.max(1.0)).sqrt());
    }
    Ok(scale)
}
