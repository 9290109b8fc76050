//! What rollouts of a model with effects cost.

use std::sync::Arc;

use rayon::prelude::*;

use super::rest;
use crate::compare::start::starts;
use crate::compare::{Settings, States};
use crate::gap::effect::ModelFile;
use crate::gap::inputs::judged;
use crate::gap::model::{Built, Chosen, Measured};
use crate::gap::run::Input;
use crate::gap::score::{mean, two_sided};
use crate::gap::{GapError, Watch};
use crate::recording::Recording;
use crate::sysid::SysidError;
use crate::sysid::fit::{Fit, Start};
use crate::sysid::parameter::ParameterRule;
use crate::sysid::problem::Problem;
use crate::sysid::rollouts::{self, Objective, RolloutSettings, Rollouts};

/// Generations of the search for all free numbers together.
const GENERATIONS: usize = 10;
/// Width of the first of them, as a part of that of a search from nothing.
const NARROW: f64 = 0.2;
/// Points that are simulated between two looks at whether to go on.
const BATCH: usize = 16;

/// Effects with their values, and the free parameters of the base model.
#[derive(Debug, Clone)]
pub(super) struct Point {
    pub chosen: Vec<Chosen>,
    pub base: Vec<f64>,
}

/// A point that was simulated.
#[derive(Clone)]
pub(super) struct Seen {
    pub point: Point,
    pub rollouts: Rollouts,
    /// −log p with that of the priors
    pub cost: f64,
}

/// A point to which all free numbers were fitted, and what the fit says of them.
pub(super) struct Polished {
    pub seen: Seen,
    pub built: Built,
    pub problem: Problem,
    pub fit: Fit,
}

/// How much smaller deviations are, start by start.
///
/// Each start counts by (d − d′)/(d + d′), which no single toss that goes astray decides.
#[derive(Debug, Clone, Copy)]
pub(super) struct Difference {
    /// mean over its standard error
    pub t: f64,
    /// degrees of freedom
    pub dof: f64,
}

impl Difference {
    /// Probability of a fall like this by chance.
    pub(super) fn p_value(self) -> f64 {
        if self.t > 0.0 {
            two_sided(self.t, self.dof)
        } else {
            1.0
        }
    }
}

/// Judges models by rollouts of the training recordings.
pub(super) struct Judge<'a> {
    pub base: &'a ModelFile,
    rules: &'a [ParameterRule],
    pub problem: Problem,
    held: Option<Problem>,
    pub protocol: &'a Settings,
    measured: Measured,
    /// last positions of the trials that end at rest
    pub ends: Vec<Vec<f64>>,
    /// s of the longest rollout
    pub longest_s: f64,
    seed: u64,
}

impl<'a> Judge<'a> {
    pub(super) fn new(input: &Input<'a>, seed: u64) -> Result<Self, GapError> {
        let config = judged(input)?;
        let of = |all: &[(String, Recording)]| {
            Problem::new(Arc::clone(&input.model.model), &config, all)
        };
        let problem = of(input.train)?;
        crate::gap::inputs::same_channels(&problem, &config, input)?;
        let held = (!input.holdout.is_empty()).then(|| of(input.holdout));
        Ok(Self {
            ends: rest::ends(&problem, input.protocol)?,
            longest_s: longest_s(&problem, input.protocol)?,
            base: input.model,
            rules: &input.config.parameter,
            problem,
            held: held.transpose()?,
            protocol: input.protocol,
            measured: Measured::default(),
            seed,
        })
    }

    /// The same, of other recordings of the same kind.
    pub(super) fn of(&self, problem: Problem) -> Result<Self, GapError> {
        Ok(Self {
            ends: rest::ends(&problem, self.protocol)?,
            problem,
            held: None,
            measured: self.measured.clone(),
            ..*self
        })
    }

    /// The base model as it is.
    pub(super) fn first(&self) -> Point {
        Point {
            chosen: Vec::new(),
            base: self.problem.parameters.start(),
        }
    }

    /// The model of a point, the problem of it and its free numbers; nothing where it cannot be.
    pub(super) fn build(&self, point: &Point, of: &Problem) -> Option<(Built, Problem, Vec<f64>)> {
        let built = Built::new(self.base, self.rules, &point.chosen, &self.measured).ok()?;
        let problem = built.problem(of).ok()?;
        let mut x = problem.parameters.start();
        x[..point.base.len()].copy_from_slice(&point.base);
        Some((built, problem, x))
    }

    /// Nothing where the model cannot be, or a rollout breaks down.
    fn simulate(&self, point: &Point, of: &Problem) -> Result<Option<(Rollouts, f64)>, GapError> {
        let Some((_, problem, x)) = self.build(point, of) else {
            return Ok(None);
        };
        let rolled = match Objective::new(&problem, self.protocol).roll_out(&x) {
            Ok(rolled) => rolled,
            Err(SysidError::Mujoco(error)) => return Err(error.into()),
            Err(_) => None,
        };
        let prior = problem.parameters.prior_cost(&x);
        Ok(rolled.map(|r| {
            let cost = r.cost() + prior;
            (r, cost)
        }))
    }

    /// A point simulated.
    pub(super) fn see(&self, point: Point) -> Result<Option<Seen>, GapError> {
        let simulated = self.simulate(&point, &self.problem)?;
        Ok(simulated.map(|(rollouts, cost)| Seen {
            point,
            rollouts,
            cost,
        }))
    }

    /// Points simulated, in their order.
    pub(super) fn see_all(
        &self,
        points: Vec<Point>,
        watch: &mut Watch<'_>,
    ) -> Result<Vec<Option<Seen>>, GapError> {
        let of = points.len();
        let mut out = Vec::with_capacity(of);
        let mut points = points.into_iter();
        while out.len() < of {
            watch.part(out.len(), of);
            watch.go_on()?;
            let batch: Vec<Point> = points.by_ref().take(BATCH).collect();
            let seen: Vec<_> = batch.into_par_iter().map(|p| self.see(p)).collect();
            for one in seen {
                out.push(one?);
            }
        }
        Ok(out)
    }

    /// How much smaller deviations of the held-out recordings are with `b` than with `a`; nothing without any.
    pub(super) fn held_out(&self, a: &Point, b: &Point) -> Result<Option<Difference>, GapError> {
        let Some(held) = &self.held else {
            return Ok(None);
        };
        let both = (self.simulate(a, held)?, self.simulate(b, held)?);
        Ok(match both {
            (Some(a), Some(b)) => difference(&a.0, &b.0),
            _ => Some(Difference { t: 0.0, dof: 1.0 }),
        })
    }

    /// All free numbers of a point fitted together; with what that says of them, if `intervals`.
    pub(super) fn polish(
        &self,
        seen: &Seen,
        intervals: bool,
        watch: &mut Watch<'_>,
    ) -> Result<Option<Polished>, GapError> {
        let Some((built, problem, x)) = self.build(&seen.point, &self.problem) else {
            return Ok(None);
        };
        let settings = RolloutSettings {
            protocol: self.protocol.clone(),
            generations: GENERATIONS,
            spread: NARROW,
            intervals,
            seed: self.seed,
            ..RolloutSettings::default()
        };
        let start = Start {
            x,
            trajectories: None,
            force_scale: None,
        };
        let fit = rollouts::solve(&problem, &settings, &start, &mut |i| watch.fit(i))?;
        watch.go_on()?;
        let point = Point {
            chosen: built.values(&problem, &fit.x, &seen.point.chosen),
            base: fit.x[..seen.point.base.len()].to_vec(),
        };
        let seen = match self.see(point)? {
            Some(found) if found.cost <= seen.cost || intervals => found,
            _ => seen.clone(),
        };
        Ok(Some(Polished {
            seen,
            built,
            problem,
            fit,
        }))
    }
}

/// s of the longest rollout.
fn longest_s(problem: &Problem, protocol: &Settings) -> Result<f64, GapError> {
    let mut longest: Option<f64> = None;
    for trial in &problem.trials {
        let states = States::new(&trial.recording, &problem.model, protocol)?;
        let end = states.time_s[states.len() - 1];
        for start in starts(&problem.model, &states, protocol)?
            .into_iter()
            .flatten()
        {
            let own = end - states.time_s[start.sample];
            longest = Some(longest.map_or(own, |longest| longest.max(own)));
        }
    }
    longest.ok_or_else(|| GapError::Input {
        reason: "no recording has a start: the body of the protocol's `drop` never falls below its height".into(),
    })
}

/// How much smaller the deviations of `b` are than those of `a`.
pub(super) fn difference(a: &Rollouts, b: &Rollouts) -> Option<Difference> {
    let falls = a.falls(b).filter(|f| f.len() > 1)?;
    let (mean, error) = mean(&falls);
    Some(Difference {
        t: mean / error,
        dof: falls.len() as f64 - 1.0,
    })
}
