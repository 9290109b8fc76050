//! Damped Gauss-Newton at one level of unexplained force.
//!
//! Parts of a model that nothing connects (see [`super::islands`]) are eliminated apart and meet in the parameters.
//! Where a step ends, forces are not what their linearisation said: a linkage is so stiff that the second order of a
//! small turn outweighs all else. Such a step is corrected before it is given up: the same linearisation is solved
//! again with the forces that were found there in place of those that were foreseen,
//!
//! ```text
//! r + J δ'  →  r(z + δ) + J (δ' − δ)
//! ```
//!
//! Reference: Nocedal and Wright 2006, "Numerical Optimization", 18.3 (second-order correction).

use super::SysidError;
use super::fit::{Iteration, Status};
use super::islands::Islands;
use super::linearise::Blocks;
use super::point::{Evaluated, Point};
use super::problem::Problem;
use super::step::Forces;
use crate::mjcf::attribute::Target;

const FIRST_DAMPING: f64 = 1e-3;
pub(super) const LEAST_DAMPING: f64 = 1e-9;
const MOST_DAMPING: f64 = 1e8;
/// Cost by the forces where a step ends, over that where it began, up to which it is taken where there is dry friction.
const GROWTH: f64 = 1.5;
/// Fall of the cost over the one foreseen below which a step is corrected.
const POOR: f64 = 0.5;
/// Most corrections of a step.
const CORRECTIONS: usize = 3;

/// Standard deviations of a parameter, the motion marginalised, that a step at a kink may be long.
const KINK: f64 = 0.5;

/// Every part of every trial.
pub(super) type Linear = Vec<Vec<Blocks>>;

/// The present point of the descent.
pub(super) struct Solver<'a> {
    pub problem: &'a Problem,
    /// (nv) standard deviation of the force that stays unexplained
    pub force_sigma: Vec<f64>,
    /// free parameters
    pub x: Vec<f64>,
    /// per trial (knots × nq)
    pub trajectories: Vec<Vec<f64>>,
    /// per trial
    pub(super) islands: Vec<Islands>,
    damping: f64,
    /// whether parameters stay as they are
    pub hold: bool,
    pub(super) state: Option<State>,
}

/// A point with its linearisation.
pub(super) struct State {
    pub here: Vec<Evaluated>,
    pub linear: Linear,
    /// whether forces are measured as at an earlier point
    is_metric_old: bool,
}

/// When a descent ends.
#[derive(Debug, Clone, Copy)]
pub(super) struct Goal {
    /// most iterations
    pub limit: usize,
    /// fall of the cost, relative to it, that is not worth a step
    pub tolerance: f64,
    /// the same in nats
    pub slack: f64,
    /// whether forces have to be measured as they are where it ends
    pub is_exact: bool,
}

/// Where a step leads.
struct Step {
    x: Vec<f64>,
    dx: Vec<f64>,
    trajectories: Vec<Vec<f64>>,
    evaluated: Vec<Evaluated>,
    cost: f64,
}

enum Attempt {
    /// no step is worth taking
    Settled,
    /// one that lowers the cost
    Step(Box<Step>),
    /// none was found
    Failed,
}

impl<'a> Solver<'a> {
    pub(super) fn new(problem: &'a Problem, x: Vec<f64>, trajectories: Vec<Vec<f64>>) -> Self {
        Self {
            problem,
            force_sigma: vec![0.0; problem.model.nv()],
            x,
            islands: vec![Islands::default(); trajectories.len()],
            trajectories,
            damping: FIRST_DAMPING,
            hold: false,
            state: None,
        }
    }

    pub(super) fn point<'b>(&'b self, trial: usize, qpos: &'b [f64], x: &'b [f64]) -> Point<'b> {
        Point {
            problem: self.problem,
            trial: &self.problem.trials[trial],
            qpos,
            x,
        }
    }

    /// Goes to another point.
    pub(super) fn go(&mut self, x: Vec<f64>, trajectories: Vec<Vec<f64>>) {
        if x != self.x || trajectories != self.trajectories {
            (self.x, self.trajectories, self.state) = (x, trajectories, None);
        }
    }

    /// Gauss-Newton at one level.
    pub(super) fn descend(
        &mut self,
        level: f64,
        goal: Goal,
        watch: &mut dyn FnMut(&Iteration) -> bool,
    ) -> Result<Status, SysidError> {
        let mut state = self.state()?;
        let status = self.run(&mut state, level, goal, watch);
        self.state = Some(state);
        status
    }

    fn run(
        &mut self,
        state: &mut State,
        level: f64,
        goal: Goal,
        watch: &mut dyn FnMut(&Iteration) -> bool,
    ) -> Result<Status, SysidError> {
        let mut before = self.cost(&self.x, &state.here, &state.linear);
        let keeps = !self.is_dry();
        let (mut small, mut n) = (0, 0);
        while n < goal.limit {
            let slack = goal.tolerance * before + goal.slack;
            let mut attempt = self.attempt(&state.linear, before, slack)?;
            while matches!(attempt, Attempt::Failed) && self.damping <= MOST_DAMPING {
                self.raise_damping();
                attempt = self.attempt(&state.linear, before, slack)?;
            }
            let step = match attempt {
                Attempt::Step(step) => step,
                Attempt::Settled | Attempt::Failed if goal.is_exact && state.is_metric_old => {
                    before = self.measure(state);
                    n += 1;
                    continue;
                }
                Attempt::Settled => return Ok(Status::Converged),
                Attempt::Failed => return Ok(self.ended(small > 0, &state.linear)),
            };
            let largest = step.dx.iter().fold(0.0_f64, |m, d| m.max(d.abs()));
            let mut cost = step.cost;
            let x = std::mem::replace(&mut self.x, step.x);
            let trajectories = std::mem::replace(&mut self.trajectories, step.trajectories);
            let here = std::mem::replace(&mut state.here, step.evaluated);
            let is_joined = self.join(&state.here);
            if !keeps {
                // where things stick and slip, what a force is changes along the way
                let linear = std::mem::take(&mut state.linear);
                match self.renew(state) {
                    Ok(there) if is_joined || there <= GROWTH * before => cost = there,
                    _ => {
                        (self.x, self.trajectories, state.here) = (x, trajectories, here);
                        state.linear = linear;
                        if self.damping > MOST_DAMPING {
                            return Ok(self.ended(small > 0, &state.linear));
                        }
                        self.raise_damping();
                        continue;
                    }
                }
            }
            n += 1;
            let record = Iteration {
                level,
                cost,
                damping: self.damping,
                horizon_s: None,
                step: largest,
                x: self.x.clone(),
            };
            // twice in a row, as one small step may be the damping's doing
            small = if before - cost < slack { small + 1 } else { 0 };
            let is_done = small >= 2 || cost < 1e-20;
            self.damping = (self.damping * 0.1).max(LEAST_DAMPING);
            let go_on = watch(&record);
            before = cost;
            if keeps {
                if is_joined || (is_done && goal.is_exact && state.is_metric_old) {
                    before = self.renew(state)?;
                    small = small.min(1);
                } else {
                    state.linear = self.linearise(&state.here, Some(&state.linear))?;
                    state.is_metric_old = true;
                }
            }
            if !go_on {
                return Ok(Status::Interrupted);
            }
            if is_done && !(goal.is_exact && keeps && !state.is_metric_old) {
                return Ok(Status::Converged);
            }
        }
        Ok(Status::MaxIterations)
    }

    fn raise_damping(&mut self) {
        self.damping *= if self.damping < 1e-6 { 1e3 } else { 10.0 };
    }

    /// Whether there is dry friction. Its A is that of sticking or of slipping, and cannot be kept.
    fn is_dry(&self) -> bool {
        let model = &self.problem.model;
        let losses = (model.dof_frictionloss().iter()).chain(model.tendon_frictionloss());
        let is_loss = |t: &Target| t.attribute.name == "frictionloss";
        losses.copied().any(|f| f > 0.0)
            || self.problem.parameters.targets().iter().any(|t| is_loss(t))
    }

    /// Why a descent ends where no step lowers the cost.
    fn ended(&mut self, was_small: bool, linear: &Linear) -> Status {
        self.damping = FIRST_DAMPING;
        if was_small {
            Status::Converged
        } else {
            self.at_a_kink(linear)
        }
    }

    /// The linearisation of the present point, forces measured as they are there.
    pub(super) fn state(&mut self) -> Result<State, SysidError> {
        if let Some(mut state) = self.state.take() {
            self.measure(&mut state);
            return Ok(state);
        }
        let here = self.here()?;
        Ok(State {
            linear: self.linearise(&here, None)?,
            here,
            is_metric_old: false,
        })
    }

    /// Linearises at the present point, and gives the cost by forces as they are there.
    fn renew(&self, state: &mut State) -> Result<f64, SysidError> {
        state.linear = self.linearise(&state.here, None)?;
        state.is_metric_old = false;
        Ok(self.cost(&self.x, &state.here, &state.linear))
    }

    /// Measures forces as they are where they were linearised last, and gives the cost.
    fn measure(&self, state: &mut State) -> f64 {
        if state.is_metric_old {
            for (islands, blocks) in self.islands.iter().zip(&mut state.linear) {
                for (island, blocks) in islands.parts.iter().zip(blocks) {
                    blocks.measure_by_own(island);
                }
            }
            state.is_metric_old = false;
        }
        self.cost(&self.x, &state.here, &state.linear)
    }

    /// Why no step lowers the cost.
    fn at_a_kink(&self, linear: &Linear) -> Status {
        let (normal, dx) = self.undamped(linear);
        let Some(covariance) = normal.try_inverse() else {
            return Status::Stalled;
        };
        let far = (dx.iter().enumerate())
            .map(|(i, d)| d.abs() / covariance[(i, i)].max(0.0).sqrt())
            .fold(0.0, f64::max);
        if far < KINK {
            Status::ConvergedAtKink
        } else {
            Status::Stalled
        }
    }

    /// A step at the present damping that lowers the cost by more than `slack`, corrected if need be.
    fn attempt(&self, linear: &Linear, before: f64, slack: f64) -> Result<Attempt, SysidError> {
        let mut best: Option<Box<Step>> = None;
        let mut found: Option<Forces> = None;
        for round in 0..=CORRECTIONS {
            let (arrows, dx, foreseen) = self.step(linear, self.damping, found.as_ref());
            if round == 0 && self.damping <= FIRST_DAMPING && before - foreseen < slack {
                return Ok(Attempt::Settled);
            }
            let x: Vec<f64> = self.x.iter().zip(&dx).map(|(x, d)| x + d).collect();
            let changes = self.changes(&arrows, &dx);
            let trajectories = self.moved(&changes)?;
            // a trial step may leave what the engine accepts: then it is no step
            let Ok(Some(evaluated)) = self.evaluate(&x, &trajectories) else {
                break;
            };
            let cost = self.cost(&x, &evaluated, linear);
            if cost.is_nan() {
                break;
            }
            let is_better = cost <= best.as_ref().map_or(before, |b| b.cost);
            let is_good = before - cost >= POOR * (before - foreseen);
            let give_up = is_good || (!is_better && best.is_some());
            if !give_up {
                found = Some(self.corrected(linear, &changes, &dx, &evaluated));
            }
            if is_better {
                best = Some(Box::new(Step {
                    x,
                    dx,
                    trajectories,
                    evaluated,
                    cost,
                }));
            }
            if give_up {
                break;
            }
        }
        Ok(best.map_or(Attempt::Failed, Attempt::Step))
    }

    /// What the model says of the present point, and islands that hold it.
    fn here(&mut self) -> Result<Vec<Evaluated>, SysidError> {
        let here = self.evaluate(&self.x, &self.trajectories)?;
        let here = here.ok_or_else(|| SysidError::NoStep {
            recording: (self.problem.trials.iter())
                .map(|t| t.name.as_str())
                .collect::<Vec<_>>()
                .join(", "),
            time_s: 0.0,
        })?;
        self.join(&here);
        Ok(here)
    }

    /// Joins islands between which there are contacts; whether there were any that had not been known.
    fn join(&mut self, here: &[Evaluated]) -> bool {
        let mut any = false;
        for (islands, evaluated) in self.islands.iter_mut().zip(here) {
            if islands.parts.is_empty() || !evaluated.contacts.is_subset(&islands.contacts) {
                let mut contacts = std::mem::take(&mut islands.contacts);
                contacts.extend(&evaluated.contacts);
                let new = Islands::new(self.problem, contacts);
                any |= new.parts != islands.parts;
                *islands = new;
            }
        }
        any
    }

    /// What the model says of every trial; `None` where the engine takes no step.
    fn evaluate(
        &self,
        x: &[f64],
        trajectories: &[Vec<f64>],
    ) -> Result<Option<Vec<Evaluated>>, SysidError> {
        (trajectories.iter().enumerate())
            .map(|(i, qpos)| self.point(i, qpos, x).evaluate(false))
            .collect()
    }

    fn linearise(&self, here: &[Evaluated], kept: Option<&Linear>) -> Result<Linear, SysidError> {
        (self.trajectories.iter().enumerate())
            .map(|(i, qpos)| {
                let point = self.point(i, qpos, &self.x);
                let kept = kept.map(|k| k[i].as_slice());
                point.linearise(&here[i], &self.islands[i], kept)
            })
            .collect()
    }
}
