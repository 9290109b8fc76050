//! Multiple shooting: parameters and the first states of windows, by forward simulation.
//!
//! Each recording is cut into windows. The state (q, v) at the start of each is an unknown, the motion within it is
//! what `mj_step` makes of that under the recorded controls:
//!
//! ```text
//! min   Σ ρ((ŝ − s)/σₛ)  +  Σ ((x − x̄)/σₓ)²/2  +  Σ ‖((q, v) at the end of a window ⊖ (q, v)′) / σⱼ‖²/2
//! P, (q, v)
//! ```
//!
//! with (q, v)′ the first state of the next window and σⱼ the size of a jump, for velocities `jump_sigma` and for
//! positions that times the length of a window. Without it windows know nothing of each other: each asks how well the
//! model predicts over its length, whatever came before. Short windows keep chaos out (an open-loop push, a tumbling
//! cube); long ones see small forces add up.
//!
//! It serves where inverse dynamics is ill-suited: a joint at rest under dry friction, impacts shorter than a sample,
//! actuators with a state. Per iteration and window it costs one simulation an unknown (2 nv + parameters), all in
//! parallel; the states are eliminated as in the joint estimator (module `arrow`).
//!
//! | symbol | name |
//! | --- | --- |
//! | (q, v) | `State`; its tangent space has 2 nv dimensions |
//! | ŝ, s, σₛ, ρ | `predictions`, samples, `Channel::sigma`, norm |
//! | σⱼ | `jump_sigma` |
//!
//! Reference: Bock 1983, "Recent advances in parameter identification techniques for O.D.E.".

mod apart;
pub(crate) mod columns;
mod conclude;
mod descent;
pub(crate) mod loops;
mod measured;
mod motion;
pub mod probe;
mod regression;
pub(crate) mod rows;
pub(crate) mod simulate;
pub(crate) mod window;

use super::SysidError;
pub use super::fit::{Fit, Iteration, Start, Status};
use super::path;
use super::problem::Problem;
use descent::Descent;
use motion::Motion;
use simulate::Pool;

/// Factor by which the parts of windows grow.
const GROWTH: f64 = 1.1;

/// Settings of the solver.
#[derive(Debug, Clone, PartialEq)]
pub struct ShootingSettings {
    /// length of a window, s; infinite: every recording is one window
    pub window_s: f64,
    /// s of each window that are fitted first; more and more follow. Where the motion is chaotic, what the first
    /// part tells brings the next one near enough. None: all at once
    pub first_s: Option<f64>,
    /// velocity by which the motion may jump from window to window, m/s or rad/s; none: by any
    pub jump_sigma: Option<f64>,
    /// whether the first states of windows are estimated; else they are as they start
    pub free_states: bool,
    /// most iterations
    pub max_iterations: usize,
    /// relative decrease of the cost below which it has converged
    pub tolerance: f64,
}

impl Default for ShootingSettings {
    fn default() -> Self {
        Self {
            window_s: 0.5,
            first_s: None,
            jump_sigma: None,
            free_states: true,
            max_iterations: 50,
            tolerance: 1e-7,
        }
    }
}

impl ShootingSettings {
    /// Looks for settings out of range.
    ///
    /// # Errors
    /// The first.
    pub fn check(&self) -> Result<(), SysidError> {
        let positive = [
            ("window_s", Some(self.window_s)),
            ("first_s", self.first_s),
            ("jump_sigma", self.jump_sigma),
            ("tolerance", Some(self.tolerance)),
        ];
        for (key, value) in positive {
            // an endless window is the whole recording
            if value.is_some_and(|v| v.is_nan() || v <= 0.0) {
                return Err(SysidError::Setting {
                    reason: format!(
                        "{key} is {}, expected a positive number",
                        value.unwrap_or(0.0)
                    ),
                });
            }
        }
        Ok(())
    }
}

impl ShootingSettings {
    /// Looks for recordings shorter than a window.
    ///
    /// # Errors
    /// The first.
    pub fn fits(&self, problem: &Problem) -> Result<(), SysidError> {
        let h = problem.model.timestep();
        for trial in &problem.trials {
            let duration = (trial.n_knots - 1) as f64 * h;
            if self.window_s.is_finite() && duration < self.window_s - 1.5 * h {
                return Err(SysidError::Recording {
                    recording: trial.name.clone(),
                    reason: format!(
                        "it lasts {duration:.3} s, less than a window of {} s; take shorter windows (--window), or \
                         whole recordings (--window inf)",
                        self.window_s
                    ),
                });
            }
        }
        Ok(())
    }
}

/// Estimates parameters and the first states of windows. `watch` is told of each iteration, and stops the solver by
/// `false`.
///
/// # Errors
/// A setting out of range, a simulation that diverges from the start, a number the engine refuses.
pub fn solve(
    problem: &Problem,
    settings: &ShootingSettings,
    start: &Start,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Fit, SysidError> {
    settings.check()?;
    settings.fits(problem)?;
    let problem = path::remember(problem, &start.x)?;
    let problem = problem.as_ref();
    let windows = window::cut(problem, settings.window_s);
    let (motion, states) = Motion::of(problem, settings, start, &windows)?;
    let mut reach = settings.first_s.map(|s| steps(problem, s));
    let part = |steps: usize| -> Vec<_> { windows.iter().map(|w| w.up_to(steps)).collect() };
    let longest = windows.iter().map(|w| w.last - w.first).max().unwrap_or(0);
    let first = part(reach.unwrap_or(longest));
    let mut starts = vec![start.x.clone()];
    let pool = Pool::default();
    starts.extend(motion.regressed(problem, &pool, &start.x)?);
    let of = (problem, settings, &pool);
    let mut descent = Descent::best_of(of, &first, &starts, &states)?;
    loop {
        let status = descent.run(watch)?;
        match reach {
            None => return descent.conclude(status),
            Some(steps) if steps < longest && status != Status::Interrupted => {
                let steps = (steps as f64 * GROWTH).ceil() as usize;
                reach = Some(steps);
                descent = descent.over(part(steps))?;
            }
            Some(_) => return descent.over(windows)?.conclude(status),
        }
    }
}

/// Steps of the model in some seconds, at least 1.
fn steps(problem: &Problem, seconds: f64) -> usize {
    ((seconds / problem.model.timestep()).round() as usize).max(1)
}
