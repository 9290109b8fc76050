//! Simulations of whole recordings that are nudged along the recorded motion.
//!
//! Motion in contact cannot be simulated freely for long, nor in short windows where contacts are stiff: a tenth of a
//! millimetre of a first position is newtons of force, and where parts of the model stand a few millimetres off they touch
//! at other times than the machine's. Here forces pull each simulation along what its readings show, as a spring and a
//! damper of one natural frequency ω would with the inertia felt there:
//!
//! ```text
//! M q̈ = …  +  M' (ω² (q̂ − q) + 2 ω (q̂' − q̇))          r = mean over a bin of  ŝ − s
//! ```
//!
//! It never leaves the recording, contacts are made within milliseconds wherever the geometry allows, and a force that the
//! model lacks shows as a deviation r ≈ (M' ω²)⁻¹ f, beside all that the readings say themselves. Deviations of a series k
//! (one channel in one recording) have a variance of their own, which is estimated with the parameters: of nₖ bins a part
//! w is independent at the pull's bandwidth, and
//!
//! ```text
//! F(x) = Σₖ w nₖ/2 · log(σₖ²/m + mean r²)  +  Σ ((x − x̄)/σₓ)²/2
//! ```
//!
//! is minimised by Gauss-Newton. With contacts made and broken simulations are chaotic in small: a change of 10⁻⁹ comes
//! out like one of 10⁻³. r and its slopes are therefore a regression over an ensemble, in which every parameter is moved
//! at once (module `ensemble`), first widely, then by a few standard deviations of the estimate. Smoothed readings have
//! lost the edges of the motion, so that pulls along them act where nothing is missing; from the second ensemble on
//! simulations are pulled along the last one, corrected by what its smoothed deviations say.
//!
//! | symbol | name |
//! | --- | --- |
//! | q̂ | `Pull::qpos`, by readings with the biases and delays of x |
//! | M' | `Pull::inertia` |
//! | ω | 2π `NudgingSettings::hz` |
//! | σₖ²/m | `Bins::noise`, of the mean of m readings |
//!
//! References: Hoke and Anthes 1976, "The initialization of numerical models by a dynamic-initialization technique", for
//! nudging; Abarbanel, Creveling, Farsian and Kostuk 2009, "Dynamical state and parameter estimation", for parameters.

mod bins;
mod course;
mod ensemble;
mod pull;
mod pulled;
mod search;
mod step;
mod told;

use super::fit::{Fit, Iteration, Start, Status};
use super::norm::Norm;
use super::problem::Problem;
use super::{SysidError, path};
pub(crate) use course::Course;
pub(crate) use ensemble::{Ensemble, Slopes, trembling};
pub(crate) use pulled::Pulled;
use search::Search;
pub(crate) use step::Quadratic;

/// Settings of the method.
#[derive(Debug, Clone, PartialEq)]
pub struct NudgingSettings {
    /// natural frequency of the pull, Hz
    pub hz: f64,
    /// most ensembles
    pub max_iterations: usize,
}

impl Default for NudgingSettings {
    fn default() -> Self {
        Self {
            hz: 5.0,
            max_iterations: 60,
        }
    }
}

impl NudgingSettings {
    /// Looks for what the method cannot use.
    fn check(&self, problem: &Problem) -> Result<(), SysidError> {
        let refuse = |reason| Err(SysidError::Setting { reason });
        if !(self.hz > 0.0 && self.hz * problem.model.timestep() < MOST_HZ) {
            return refuse(format!(
                "a pull of {} Hz, expected a positive number below {} Hz, a tenth of the model's steps",
                self.hz,
                MOST_HZ / problem.model.timestep()
            ));
        }
        match problem.channels.iter().find(|c| c.norm != Norm::Quadratic) {
            Some(channel) => refuse(format!(
                "channel `{}` has a norm, but the noise is estimated here; leave the norm out, or take another --method",
                channel.name
            )),
            None => Ok(()),
        }
    }
}

/// Highest frequency of a pull, in steps of the model.
const MOST_HZ: f64 = 0.1;

/// Estimates parameters. `watch` is told of each ensemble, and stops the search by `false`.
///
/// # Errors
/// A setting out of range, a simulation that diverges at the first parameters, a number the engine refuses.
pub fn solve(
    problem: &Problem,
    settings: &NudgingSettings,
    start: &Start,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Fit, SysidError> {
    settings.check(problem)?;
    let problem = path::remember(problem, &start.x)?;
    let (search, status, history) = descend(&problem, settings, &start.x, watch)?;
    search.conclude(status, history)
}

/// The parameters that [`solve`] ends with, and spreads of ensembles about them.
///
/// # Errors
/// As [`solve`].
pub(crate) fn settle(
    problem: &Problem,
    settings: &NudgingSettings,
    x: &[f64],
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<(Vec<f64>, Vec<f64>), SysidError> {
    settings.check(problem)?;
    let (search, ..) = descend(problem, settings, x, watch)?;
    Ok(search.ended())
}

fn descend<'a>(
    problem: &'a Problem,
    settings: &NudgingSettings,
    x: &[f64],
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<(Search<'a>, Status, Vec<Iteration>), SysidError> {
    let mut search = Search::new(problem, settings.hz, x)?;
    let mut history = Vec::new();
    let mut status = Status::MaxIterations;
    if x.is_empty() {
        status = Status::Converged;
    }
    while status == Status::MaxIterations && history.len() < settings.max_iterations {
        let Some(iteration) = search.advance()? else {
            status = Status::Stalled;
            break;
        };
        if search.is_done() {
            status = Status::Converged;
        }
        if !watch(&iteration) && status == Status::MaxIterations {
            status = Status::Interrupted;
        }
        history.push(iteration);
    }
    Ok((search, status, history))
}

fn broken() -> SysidError {
    SysidError::Setting {
        reason:
            "a simulation diverges from the recorded motion: start nearer, or pull more (--pull)"
                .into(),
    }
}
