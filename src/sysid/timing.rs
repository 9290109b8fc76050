//! Which samples and commands belong to which step, where each recording is one window.

use std::borrow::Cow;

use super::parameter::{Instrument, Role};
use super::problem::Problem;
use super::shooting::window::{Placed, Window, place};

/// Samples and commands on the grid of the model's steps.
#[derive(Clone)]
pub(super) struct Timing {
    /// one a trial
    pub placed: Vec<Vec<Placed>>,
    /// one a trial (knots × nu)
    pub controls: Vec<Vec<f64>>,
}

impl Timing {
    fn new(problem: &Problem, windows: &[Window], x: &[f64]) -> Self {
        Self {
            placed: place(problem, windows, x),
            controls: (problem.trials.iter())
                .map(|t| problem.controls(t, x))
                .collect(),
        }
    }
}

/// The timing at any parameters, found once if no delay is among them.
pub(super) struct Timings(Option<Timing>);

impl Timings {
    pub(super) fn new(problem: &Problem, windows: &[Window], x: &[f64]) -> Self {
        let late = |role: &Role| {
            matches!(
                role,
                Role::Instrument(Instrument::Delay | Instrument::CommandDelay, _)
            )
        };
        let is_late = problem.parameters.iter_free().any(|p| late(&p.role));
        Self((!is_late).then(|| Timing::new(problem, windows, x)))
    }

    /// At parameters `x`.
    pub(super) fn at(&self, problem: &Problem, windows: &[Window], x: &[f64]) -> Cow<'_, Timing> {
        match &self.0 {
            Some(timing) => Cow::Borrowed(timing),
            None => Cow::Owned(Timing::new(problem, windows, x)),
        }
    }

    /// Whether a delay is among the parameters.
    pub(super) fn is_late(&self) -> bool {
        self.0.is_none()
    }
}
