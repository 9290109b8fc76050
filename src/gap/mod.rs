//! What the simulation is missing: where it and recorded data disagree, and which physics would mend it.
//!
//! ```text
//! fit       parameters of the base model, from windows of the training recordings          [windows, fit, weigh]
//! locate    where more is left than noise explains: joint, phase, direction, speed          [locate]
//! screen    every effect of the catalogue at every place: would it explain what is left?    [linear, screen, score]
//! refit     the best few in full; forward, delete, swap                                     [search]
//! name      how sure, and what these recordings cannot tell apart                           [name]
//! add       the effects in the model file                                                   [effect]
//! verify    held-out recordings, before and after; the repaired model, searched again        [verify, round_trip]
//! ```
//!
//! [`run()`] does all of it in memory; nothing is printed, and nothing read but the model's own assets.

mod absorb;
mod afresh;
mod again;
mod alike;
mod band;
mod base;
mod candidate;
mod coarse;
mod cuts;
mod decoy;
pub mod diff;
pub mod effect;
mod elsewhere;
mod even;
mod evidence;
pub mod figures;
mod fit;
mod fitted;
mod followed;
mod forward;
mod given;
mod held_out;
mod home;
mod inputs;
mod late;
mod left;
mod limits;
mod linear;
mod locate;
mod lookalike;
mod loose;
mod lying;
#[cfg(test)]
mod masses;
mod model;
mod name;
mod next;
mod nudged;
mod null;
mod one_law;
mod one_sided;
mod owed;
mod predict;
mod pulse;
mod repair;
pub mod result;
mod round_trip;
mod run;
mod score;
mod screen;
mod search;
mod settle;
mod shapes;
mod stages;
mod step;
mod telling;
mod together;
mod toss;
mod untestable;
mod varied;
mod verify;
mod weigh;
mod windows;

use thiserror::Error;

use crate::compare::CompareError;
use crate::mujoco::MujocoError;
use crate::sysid::SysidError;
use crate::sysid::fit::Iteration;
pub use given::{Oracle, is_place, with_effects};
pub use model::Chosen;
pub use run::{Input, MissingSeries, Options, Outcome, resume, run};
pub use search::Limits;
pub use stages::{Keeper, Kept, Nowhere, key};

/// Why there is no answer.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum GapError {
    /// Recordings do not fit the model, or the engine failed.
    #[error(transparent)]
    Sysid(#[from] SysidError),
    /// The engine failed.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The model cannot be changed.
    #[error(transparent)]
    Effect(#[from] effect::EffectError),
    /// Model and recordings cannot be compared.
    #[error(transparent)]
    Compare(#[from] CompareError),
    /// An input that makes no sense.
    #[error("{reason}")]
    Input {
        /// what, and what is expected
        reason: String,
    },
    /// Asked to stop.
    #[error("stopped")]
    Stopped,
}

/// A part of the work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// base model
    Fit,
    /// residual by place and phase
    Locate,
    /// all candidates
    Screen,
    /// the best of them
    Refit,
    /// classes
    Name,
    /// held-out recordings
    Verify,
}

impl Stage {
    /// As shown.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fit => "fit",
            Self::Locate => "locate",
            Self::Screen => "screen",
            Self::Refit => "refit",
            Self::Name => "name",
            Self::Verify => "verify",
        }
    }
}

/// What happens: the stage, a note on it, and the part that is done if known. `false` stops the work.
pub type Report<'a> = &'a mut dyn FnMut(Stage, &str, Option<f64>) -> bool;

/// Fall of the cost in an iteration, as a part of it, that is hardly one.
const HARDLY: f64 = 1e-3;
/// Part of the cost before a step that a fit which still falls leaves at most.
const FALLING: f64 = 0.8;

/// Tells whoever watches.
struct Watch<'a> {
    report: Report<'a>,
    stage: Stage,
    note: String,
    /// how it is done, where that is not the first way
    way: String,
    /// whether it was asked to stop
    stopped: bool,
}

impl<'a> Watch<'a> {
    fn new(report: Report<'a>) -> Self {
        Self {
            report,
            stage: Stage::Fit,
            note: String::new(),
            way: String::new(),
            stopped: false,
        }
    }

    /// An error once it was asked to stop: what was cut short must not pass for finished.
    fn go_on(&self) -> Result<(), GapError> {
        if self.stopped {
            Err(GapError::Stopped)
        } else {
            Ok(())
        }
    }

    fn stage(&mut self, stage: Stage) {
        self.stage = stage;
        self.tell("", None);
    }

    fn fit(&mut self, i: &Iteration) -> bool {
        self.tell(&format!("cost {:.6e}", i.cost), None)
    }

    fn tell(&mut self, more: &str, part: Option<f64>) -> bool {
        let words = [&*self.way, &*self.note, more];
        let said: Vec<&str> = words.into_iter().filter(|w| !w.is_empty()).collect();
        let go_on = (self.report)(self.stage, &said.join(" "), part);
        self.stopped |= !go_on;
        go_on
    }

    /// The same, to stop where the cost hardly falls any more, twice in a row: no choice hangs on what is left.
    fn fit_nearly(&mut self) -> impl FnMut(&Iteration) -> bool {
        let (mut before, mut slow) = (f64::INFINITY, 0);
        move |i| {
            slow = if before - i.cost < HARDLY * i.cost {
                slow + 1
            } else {
                0
            };
            before = i.cost;
            self.fit(i) && slow < 2
        }
    }

    /// The same, to stop after so many iterations too, unless the last of them still took much off the cost: where joints stick a
    /// fit may begin a hundred times off, and be half way after these.
    fn fit_while_falling(&mut self, iterations: usize) -> impl FnMut(&Iteration) -> bool {
        let (mut done, mut before) = (0, f64::INFINITY);
        let mut nearly = self.fit_nearly();
        move |i| {
            done += 1;
            let falls = i.cost < FALLING * before;
            before = i.cost;
            nearly(i) && (done < iterations || falls)
        }
    }

    fn part(&mut self, done: usize, of: usize) -> bool {
        self.tell("", Some(done as f64 / of.max(1) as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::Watch;
    use crate::sysid::fit::Iteration;

    /// Costs of fits of a finger's dry friction, of 136 before it, and of an encoder's scale that does not help.
    #[test]
    fn what_still_falls_is_not_given_up() {
        let iterations = |costs: &[f64]| {
            let mut report = |_, _: &str, _| true;
            let mut watch = Watch::new(&mut report);
            let mut going = watch.fit_while_falling(3);
            let goes = |cost: &f64| {
                going(&Iteration {
                    level: 0.0,
                    cost: *cost,
                    damping: 0.0,
                    horizon_s: None,
                    step: 0.0,
                    x: Vec::new(),
                })
            };
            1 + costs.iter().map(goes).take_while(|going| *going).count()
        };
        assert_eq!(iterations(&[538.9, 243.2, 123.3, 71.0, 64.0, 60.0]), 5);
        assert_eq!(iterations(&[171.4, 130.2, 115.0, 114.2]), 3);
    }
}
