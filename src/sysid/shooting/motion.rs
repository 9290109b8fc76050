//! The motion that windows start from: read from the sensors, or smoothed from them.

use super::ShootingSettings;
use super::measured::Readings;
use super::regression::{Instant, regress};
use super::simulate::Pool;
use super::window::{State, Window};
use crate::sysid::fit::Start;
use crate::sysid::problem::{Problem, Trial};
use crate::sysid::{SysidError, start};

/// Knots of all recordings that the regression of forces takes.
const INSTANTS: usize = 200;
/// Least number of a recording.
const LEAST_INSTANTS: usize = 4;

pub(super) enum Motion<'a> {
    /// states as measured
    Read(Readings<'a>),
    /// per trial (knots × nq)
    Smoothed(Vec<Vec<f64>>),
}

impl<'a> Motion<'a> {
    /// The motion, and the states in which `windows` start.
    pub(super) fn of(
        problem: &'a Problem,
        settings: &ShootingSettings,
        start: &Start,
        windows: &[Window],
    ) -> Result<(Self, Vec<State>), SysidError> {
        // states that are estimated start from what all samples together say
        if start.trajectories.is_none()
            && !settings.free_states
            && let Some(found) = Self::read(problem, &start.x, windows)
        {
            return Ok(found);
        }
        let trajectories = match &start.trajectories {
            Some(given) => given.clone(),
            None => (problem.trials.iter())
                .map(|trial| match &trial.path {
                    Some(path) => Ok(path.rows().to_vec()),
                    None => start::trajectory(problem, trial, &start.x),
                })
                .collect::<Result<_, _>>()?,
        };
        let states = (windows.iter())
            .map(|w| State::on(problem, w, &trajectories[w.trial]))
            .collect::<Result<_, _>>()?;
        Ok((Self::Smoothed(trajectories), states))
    }

    fn read(problem: &'a Problem, x: &[f64], windows: &[Window]) -> Option<(Self, Vec<State>)> {
        let readings = Readings::of(problem)?;
        let mut states = Vec::with_capacity(windows.len());
        for (i, trial) in problem.trials.iter().enumerate() {
            let own = windows.iter().filter(|w| w.trial == i);
            let firsts: Vec<usize> = own.map(|w| w.first).collect();
            states.extend(readings.states(trial, x, &firsts)?);
        }
        Some((Self::Read(readings), states))
    }

    /// Where the forces say that parameters are, from `x`; `None` where they say nothing.
    pub(super) fn regressed(
        &self,
        problem: &Problem,
        pool: &Pool,
        x: &[f64],
    ) -> Result<Option<Vec<f64>>, SysidError> {
        if !(0..x.len()).any(|j| problem.parameters.changes_model(j)) {
            return Ok(None);
        }
        let most = (INSTANTS / problem.trials.len()).max(LEAST_INSTANTS);
        let nu = problem.model.nu();
        let mut instants = Vec::new();
        for (i, trial) in problem.trials.iter().enumerate() {
            let inner = trial.n_knots - 2;
            let n = most.min(inner);
            let knots: Vec<usize> = (0..n).map(|k| 1 + k * inner / n).collect();
            let controls = problem.controls(trial, x);
            let found = match self {
                Self::Read(readings) => between(problem, readings, trial, x, &knots),
                Self::Smoothed(all) => Some(along(problem, &all[i], &knots)?),
            };
            let Some(found) = found else { return Ok(None) };
            for (k, (state, acceleration)) in knots.into_iter().zip(found) {
                instants.push(Instant {
                    state,
                    acceleration,
                    ctrl: controls[k * nu..(k + 1) * nu].to_vec(),
                });
            }
        }
        regress(problem, pool, x, &instants)
    }
}

/// States that are read at `knots`, and accelerations to the knots after.
fn between(
    problem: &Problem,
    readings: &Readings<'_>,
    trial: &Trial,
    x: &[f64],
    knots: &[usize],
) -> Option<Vec<(State, Vec<f64>)>> {
    let h = problem.model.timestep();
    let pairs: Vec<usize> = knots.iter().flat_map(|&k| [k, k + 1]).collect();
    let states = readings.states(trial, x, &pairs)?;
    let accelerate = |pair: &[State]| {
        let changes = pair[1].qvel.iter().zip(&pair[0].qvel);
        (pair[0].clone(), changes.map(|(b, a)| (b - a) / h).collect())
    };
    Some(states.chunks_exact(2).map(accelerate).collect())
}

/// States of a trajectory (knots × nq) at `knots`, and accelerations, as the engine's step relates them.
fn along(
    problem: &Problem,
    qpos: &[f64],
    knots: &[usize],
) -> Result<Vec<(State, Vec<f64>)>, SysidError> {
    let model = &problem.model;
    let (nq, h) = (model.nq(), model.timestep());
    let knot = |k: usize| &qpos[k * nq..(k + 1) * nq];
    let velocity = |k: usize| -> Result<Vec<f64>, SysidError> {
        let mut v = vec![0.0; model.nv()];
        model.differentiate_pos(&mut v, h, knot(k), knot(k + 1))?;
        Ok(v)
    };
    (knots.iter())
        .map(|&k| {
            let (before, after) = (velocity(k - 1)?, velocity(k)?);
            let changes = after.iter().zip(&before);
            let acceleration = changes.map(|(b, a)| (b - a) / h).collect();
            let state = State {
                qpos: knot(k).to_vec(),
                qvel: before,
            };
            Ok((state, acceleration))
        })
        .collect()
}
