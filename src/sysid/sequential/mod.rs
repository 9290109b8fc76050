//! Identification by simulations that see more and more of the recordings, for motion in contact that is chaotic.
//!
//! Where bodies are pushed, rock and slide, a simulation of all that was recorded has no useful slope, and its cost has
//! a thousand minima. Over the first tenths of a second it has few. A swarm of simulations, each with parameters and
//! first states of its own, is drawn from what the samples up to a horizon τ leave possible,
//!
//! ```text
//! p(x, u | τ) ∝ π(x) π(u) Π p(sₖ | ŝₖ(x, u))        over the samples before τ
//! ```
//!
//! and τ grows by as much as leaves half of the swarm in place (sequential Monte Carlo over parameters). No derivative
//! is asked for, no force is left unexplained, and where the search begins does not matter within the bounds. It ends
//! where simulations no longer find each other's neighbourhood: there the motion has become chaotic, or the model
//! does not follow the recordings, and what lies behind tells nothing that a swarm of this size can read.
//!
//! | symbol | name |
//! | --- | --- |
//! | x; u | free parameters; unknowns of first states (`first`) |
//! | τ | `horizon`, in steps |
//! | −log Π p | `Course::costs` |
//!
//! Reference: Chopin 2002, "A sequential particle filter method for static models".

mod conclude;
mod course;
mod first;
mod swarm;

use super::SysidError;
use super::fit::{Fit, Iteration, Start, Status};
use super::parameter::Parameter;
use super::problem::Problem;
use course::Course;
use first::First;
use swarm::Swarm;

/// Settings of the method.
#[derive(Debug, Clone, PartialEq)]
pub struct SequentialSettings {
    /// chains of simulations of the swarm
    pub n_chains: usize,
    /// whether every recording begins at rest: velocities are 0, and what no sensor shows is where the model has it
    pub at_rest: bool,
    /// most horizons
    pub max_iterations: usize,
    /// of the draws
    pub seed: u64,
}

impl Default for SequentialSettings {
    fn default() -> Self {
        Self {
            n_chains: 100,
            at_rest: false,
            max_iterations: 300,
            seed: 0,
        }
    }
}

/// Fewest chains that say how simulations spread.
const FEWEST: usize = 20;
/// Steps, and part of the horizon, by which simulations go farther.
const AHEAD: usize = 8;
const PART_AHEAD: f64 = 0.06;
/// Stirring below which the swarm has come to its end.
const STUCK: f64 = 0.02;
/// Standard deviations of its noise by which the cost of the best simulation may be too large.
const UNLIKELY: f64 = 5.0;
/// Standard deviation of parameters, in their sizes, that is fine enough.
const FINE: f64 = 1e-3;

/// How far a parameter is looked for where it has no bound, in its sizes.
const REACH: f64 = 3.0;

impl SequentialSettings {
    /// Looks for settings out of range.
    ///
    /// # Errors
    /// The first.
    pub fn check(&self) -> Result<(), SysidError> {
        if self.n_chains < FEWEST {
            let reason = format!(
                "{} chains are too few to say how simulations spread; take {FEWEST} at least, a hundred as a rule",
                self.n_chains
            );
            return Err(SysidError::Setting { reason });
        }
        Ok(())
    }
}

/// Where a parameter that starts at `x` is looked for: between its bounds.
fn range(parameter: &Parameter, x: f64) -> (f64, f64) {
    let (lower, upper) = parameter.bounds();
    let reach = REACH * parameter.typical;
    let or = |bound: f64, otherwise: f64| if bound.is_finite() { bound } else { otherwise };
    (or(lower, x - reach), or(upper, x + reach))
}

/// Estimates parameters and first states. `watch` is told of each horizon, and stops the search by `false`.
///
/// # Errors
/// No simulation follows a recording at all, a number the engine refuses.
pub fn solve(
    problem: &Problem,
    settings: &SequentialSettings,
    start: &Start,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Fit, SysidError> {
    settings.check()?;
    let problem = &*super::path::remember(problem, &start.x)?;
    let smoothed = match &start.trajectories {
        Some(given) => given.clone(),
        None => first::smoothed(problem, &start.x)?,
    };
    let windows = super::shooting::window::cut(problem, f64::INFINITY);
    let firsts = (problem.trials.iter().zip(&windows).zip(&smoothed))
        .map(|((trial, window), qpos)| {
            if settings.at_rest {
                First::at_rest(problem, trial, &start.x)
            } else {
                First::moving(problem, (window, trial), &start.x, qpos)
            }
        })
        .collect::<Result<Vec<_>, _>>()?;
    let ranges = (problem.parameters.iter_free().zip(&start.x))
        .map(|(p, x)| range(p, *x))
        .collect();
    let course = Course::new(problem, &start.x, ranges, firsts);
    let mut swarm = Swarm::new(&course, settings.n_chains, settings.seed);
    let look = |horizon: f64| {
        let ahead = AHEAD.max((PART_AHEAD * horizon) as usize);
        (horizon.ceil() as usize + ahead).min(course.end())
    };
    let mut history = Vec::new();
    let status = loop {
        if history.len() >= settings.max_iterations {
            break Status::MaxIterations;
        }
        let steps = look(swarm.horizon);
        swarm.extend(steps)?;
        let before = swarm.clone();
        let next = swarm.farthest(steps);
        let stirred = swarm.advance(next, look(next))?;
        let n = course.n_samples(&start.x, swarm.horizon.ceil() as usize) as f64;
        let unlikely = swarm.least() > 0.5 * n + UNLIKELY * (0.5 * n).sqrt();
        if stirred < STUCK || unlikely {
            swarm = before;
            break Status::Converged;
        }
        let (mean, sigma) = swarm.moments();
        let parameters = problem.parameters.iter_free().zip(&sigma);
        let widest = parameters.fold(0.0_f64, |m, (p, s)| m.max(s / p.typical));
        let iteration = Iteration {
            level: 0.0,
            cost: swarm.best().1,
            damping: 0.0,
            horizon_s: Some(swarm.horizon * problem.model.timestep()),
            step: widest,
            x: mean[..course.ranges.len()].to_vec(),
        };
        history.push(iteration.clone());
        if !watch(&iteration) {
            break Status::Interrupted;
        }
        if swarm.horizon >= course.end() as f64 || widest < FINE {
            break Status::Converged;
        }
    };
    if history.is_empty() {
        let reason = "no simulation follows even the first samples: look at units and noise of channels, at bounds, and at \
                      whether the recordings begin at rest (--at-rest)";
        return Err(SysidError::Setting {
            reason: reason.into(),
        });
    }
    conclude::conclude(&swarm, &course, smoothed, status, history)
}
