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
//! does not follow the recordings. What lies behind is followed from there by simulations that small forces push
//! (`follow`), which find the neighbourhood of the estimate; which point of it is likeliest, simulations tell that all have
//! its parameters (`held`). Intervals are those of the swarm at its horizon: what lies behind makes the estimate better
//! by more than they say.
//!
//! | symbol | name |
//! | --- | --- |
//! | x; u | free parameters; unknowns of first states (`first`) |
//! | τ | `horizon`, in steps |
//! | −log Π p | `Course::costs` |
//!
//! Reference: Chopin 2002, "A sequential particle filter method for static models".

mod behind;
mod conclude;
mod course;
mod first;
mod follow;
mod held;
mod kernel;
mod swarm;

use super::fit::{Fit, Iteration, Start, Status};
use super::parameter::Parameter;
use super::problem::Problem;
use super::shooting::window;
use super::{SysidError, joint, path, start};
use behind::Behind;
use course::Course;
use first::First;
use follow::Follower;
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
    /// over what is behind the last horizon; half of them where points are weighed afterwards (`held`)
    pub passes: usize,
    /// of the draws
    pub seed: u64,
}

impl Default for SequentialSettings {
    fn default() -> Self {
        Self {
            n_chains: 100,
            at_rest: false,
            max_iterations: 300,
            passes: 10,
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
const STUCK: f64 = 0.2;
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

/// Estimates parameters and first states. `watch` is told of each horizon and pass, and stops the search by `false`.
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
    let problem = &*path::remember(problem, &start.x)?;
    let smoothed = start::trajectories(problem, start)?;
    let windows = window::cut(problem, f64::INFINITY);
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
    let course = Course::new(problem, &start.x, ranges, (windows, firsts));
    let mut history = Vec::new();
    let mut record = |iteration: Iteration| {
        history.push(iteration);
        watch(&history[history.len() - 1])
    };
    let (swarm, mut status) = grow(&course, settings, start, &mut record)?;
    let (mean, sigma) = swarm.moments();
    let np = course.ranges.len();
    let mut found = Found {
        x: mean[..np].to_vec(),
        ..Found::default()
    };
    // nothing is to be found behind the horizon where all parameters are known as well as they have to be, and samples
    // whose delay is unknown belong to no block
    let is_open =
        swarm.horizon < course.end() as f64 && widest(problem, &sigma) >= FINE && !course.is_late();
    if status != Status::Interrupted && is_open && settings.passes > 0 {
        let scale = match &start.force_scale {
            Some(given) => given.clone(),
            None => joint::force_scale(problem, &start.x)?,
        };
        let behind = Behind {
            follower: Follower::new(&course, &swarm, &start.x, &scale),
            settings,
            sigma: &sigma[..np],
        };
        if !behind.find(&mut found, &mut record)? {
            status = Status::Interrupted;
        }
    }
    conclude::conclude(&swarm, &course, found, smoothed, (status, history))
}

/// What is estimated.
#[derive(Default)]
struct Found {
    x: Vec<f64>,
    /// unexplained force, as a part of the forces
    level: f64,
}

/// Largest spread of a parameter, in its size.
fn widest(problem: &Problem, sigma: &[f64]) -> f64 {
    let each = problem.parameters.iter_free().zip(sigma);
    each.fold(0.0_f64, |m, (p, s)| m.max(s / p.typical))
}

/// The swarm at its farthest horizon.
fn grow<'a>(
    course: &'a Course<'a>,
    settings: &SequentialSettings,
    start: &Start,
    record: &mut dyn FnMut(Iteration) -> bool,
) -> Result<(Swarm<'a>, Status), SysidError> {
    let problem = course.problem;
    let mut swarm = Swarm::new(course, settings.n_chains, settings.seed);
    let look = |horizon: f64| {
        let ahead = AHEAD.max((PART_AHEAD * horizon) as usize);
        (horizon.ceil() as usize + ahead).min(course.end())
    };
    for _ in 0..settings.max_iterations {
        let steps = look(swarm.horizon);
        swarm.extend(steps)?;
        let before = swarm.clone();
        let next = swarm.farthest(steps);
        let stirred = swarm.advance(next, look(next))?;
        let n = course.n_samples(&start.x, swarm.horizon.ceil() as usize) as f64;
        let unlikely = swarm.least() > 0.5 * n + UNLIKELY * (0.5 * n).sqrt();
        if stirred < STUCK && !before.is_longest() {
            // once more, with longer chains
            swarm.go_back(before);
            continue;
        }
        if stirred < STUCK || unlikely {
            // fewer samples than unknowns tell nothing
            if course.n_samples(&start.x, before.horizon.ceil() as usize) <= course.len() {
                return Err(nothing(unlikely, course.len()));
            }
            return Ok((before, Status::Converged));
        }
        let (mean, sigma) = swarm.moments();
        let widest = widest(problem, &sigma);
        let goes_on = record(Iteration {
            level: 0.0,
            cost: swarm.best().1,
            damping: 0.0,
            horizon_s: Some(swarm.horizon * problem.model.timestep()),
            step: widest,
            x: mean[..course.ranges.len()].to_vec(),
        });
        if !goes_on {
            return Ok((swarm, Status::Interrupted));
        }
        if swarm.horizon >= course.end() as f64 || widest < FINE {
            return Ok((swarm, Status::Converged));
        }
    }
    Ok((swarm, Status::MaxIterations))
}

/// Why there is no horizon.
fn nothing(unlikely: bool, unknowns: usize) -> SysidError {
    let reason = if unlikely {
        "no simulation follows even the first samples: look at units and noise of channels, at bounds, and at whether the \
         recordings begin at rest (--at-rest)"
            .into()
    } else {
        format!(
            "a swarm does not find its way among {unknowns} unknowns, of parameters and of first states: estimate fewer, say \
             that recordings begin at rest (--at-rest) if they do, or take another method"
        )
    };
    SysidError::Setting { reason }
}
