//! What no sample shows: joints and parameters that can change without any reading changing.
//!
//! Stretches of the recordings are simulated from the measured states, once as they are and once with one thing
//! changed. First a few short ones; what they do not show is tried on long ones, up to the whole recordings.

use rayon::prelude::*;

use super::columns::Point;
use super::simulate::{Pool, Simulated, Simulator};
use super::window::{Placed, State, Window, cut, place};
use crate::mjcf::attribute::dofs;
use crate::sysid::SysidError;
use crate::sysid::pose::Pose;
use crate::sysid::problem::{Problem, Stage};

/// Length of a stretch, s.
const STRETCH_S: f64 = 0.25;
/// Number of stretches, and steps of each, of either search.
const SEARCHES: [(usize, usize); 2] = [(8, 20), (64, 1_000_000)];
/// Steps over which a first velocity is measured.
const VELOCITY_STEPS: usize = 10;
/// Iterations for the position of a knot.
const POSE_ITERATIONS: usize = 10;
/// Changes: of positions, rad or m, of velocities, rad/s or m/s, and of parameters, in parts of a typical change.
const POSITION: f64 = 1e-3;
const VELOCITY: f64 = 1e-2;
const PARAMETER: f64 = 0.1;
/// Least change of a reading that counts, in standard deviations of its noise: more than rounding, less than anything
/// that could be estimated.
const LEAST: f64 = 1e-6;

/// What nothing shows.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Unseen {
    /// indices of joints
    pub joints: Vec<usize>,
    /// indices among the free parameters; those of instruments are not looked at
    pub parameters: Vec<usize>,
}

/// Something to change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Subject {
    Joint(usize),
    Parameter(usize),
}

/// Looks for joints and parameters that no reading depends on, with parameters at `x`.
///
/// # Errors
/// The engine fails.
pub fn unseen(problem: &Problem, x: &[f64]) -> Result<Unseen, SysidError> {
    let joints = (0..problem.model.njnt()).map(Subject::Joint);
    let parameters = (0..x.len())
        .filter(|&j| problem.parameters.changes_model(j))
        .map(Subject::Parameter);
    let mut left: Vec<Subject> = joints.chain(parameters).collect();
    let pool = Pool::default();
    for (most, steps) in SEARCHES {
        let stretches = Stretches::new(problem, x, most, steps)?;
        let point = stretches.point(problem, x, &pool);
        let base: Option<Vec<Simulated>> = point.simulate()?.into_iter().collect();
        // from where the simulation breaks down, nothing can be said
        let Some(base) = base else {
            return Ok(Unseen::default());
        };
        let shown: Vec<bool> = (left.par_iter())
            .map(|&subject| shows(&point, &base, subject))
            .collect();
        let mut shown = shown.into_iter();
        left.retain(|_| shown.next() == Some(false));
        if left.is_empty() {
            break;
        }
    }
    let mut unseen = Unseen::default();
    for subject in left {
        match subject {
            Subject::Joint(joint) => unseen.joints.push(joint),
            Subject::Parameter(j) => unseen.parameters.push(j),
        }
    }
    Ok(unseen)
}

/// Parts of the recordings, with the states in which they begin.
struct Stretches {
    windows: Vec<Window>,
    placed: Vec<Vec<Placed>>,
    states: Vec<State>,
}

impl Stretches {
    fn new(problem: &Problem, x: &[f64], most: usize, steps: usize) -> Result<Self, SysidError> {
        let all = cut(problem, STRETCH_S);
        let placed = place(problem, &all, x);
        let every = all.len().div_ceil(most);
        let mut chosen = Self {
            windows: Vec::new(),
            placed: Vec::new(),
            states: Vec::new(),
        };
        let mut pose = Pose::new(problem, x)?;
        for (window, samples) in all.iter().zip(placed).step_by(every) {
            let window = window.up_to(steps);
            let inside = |p: &Placed| p.knot < window.len();
            chosen
                .placed
                .push(samples.into_iter().filter(inside).collect());
            chosen.states.push(state(problem, &mut pose, &window)?);
            chosen.windows.push(window);
        }
        Ok(chosen)
    }

    fn point<'a>(&'a self, problem: &'a Problem, x: &'a [f64], pool: &'a Pool) -> Point<'a> {
        Point {
            problem,
            windows: &self.windows,
            placed: &self.placed,
            x,
            states: &self.states,
            free_states: true,
            directions: &[],
            pool,
        }
    }
}

/// The measured state at the start of a window, roughly.
fn state(problem: &Problem, pose: &mut Pose<'_>, window: &Window) -> Result<State, SysidError> {
    let model = &problem.model;
    let h = model.timestep();
    let trial = &problem.trials[window.trial];
    let mut at = |knot: usize| -> Result<Vec<f64>, SysidError> {
        let time = knot as f64 * h;
        let mut nearest: Vec<Option<(f64, f64)>> = vec![None; problem.channels.len()];
        for s in trial.samples.iter() {
            let distance = (s.time - time).abs();
            let best = &mut nearest[s.channel];
            if best.is_none_or(|b| distance < b.0) {
                *best = Some((distance, s.value));
            }
        }
        let goals: Vec<(usize, f64)> = (nearest.into_iter().enumerate())
            .filter(|(c, _)| problem.channels[*c].stage == Stage::Position)
            .filter_map(|(c, found)| Some((c, found?.1)))
            .collect();
        pose.fit(&goals, POSE_ITERATIONS)?;
        Ok(pose.data.qpos().to_vec())
    };
    let last = (window.first + VELOCITY_STEPS).min(trial.n_knots - 1);
    let (qpos, next) = (at(window.first)?, at(last)?);
    let mut qvel = vec![0.0; model.nv()];
    let duration = (last - window.first) as f64 * h;
    model.differentiate_pos(&mut qvel, duration, &qpos, &next)?;
    Ok(State { qpos, qvel })
}

/// Whether some reading depends on `subject`.
fn shows(point: &Point<'_>, base: &[Simulated], subject: Subject) -> bool {
    let nv = point.problem.model.nv();
    match subject {
        Subject::Joint(joint) => dofs(&point.problem.model, joint).any(|dof| {
            [(dof, POSITION), (nv + dof, VELOCITY)]
                .iter()
                .any(|change| {
                    let mut tangent = vec![0.0; 2 * nv];
                    tangent[change.0] = change.1;
                    changes(point, base, point.x, &tangent)
                })
        }),
        Subject::Parameter(j) => {
            let reach = point.problem.parameters.reach(point.x).nth(j);
            let step = (point.problem.parameters.iter_free().nth(j))
                .map_or(0.0, |p| PARAMETER * p.typical);
            let mut x = point.x.to_vec();
            // away from a bound
            let up = reach.is_none_or(|(down, up)| up >= step || up >= -down);
            x[j] += if up { step } else { -step };
            changes(point, base, &x, &vec![0.0; 2 * nv])
        }
    }
}

/// Whether a reading changes with parameters `x` and first states moved by `tangent`; what cannot be simulated counts.
fn changes(point: &Point<'_>, base: &[Simulated], x: &[f64], tangent: &[f64]) -> bool {
    let problem = point.problem;
    let controls: Vec<Vec<f64>> = (problem.trials.iter())
        .map(|trial| problem.controls(trial, point.x))
        .collect();
    let differs = |simulator: &mut Simulator<'_>, w: usize| -> Result<bool, SysidError> {
        let (window, placed) = (&point.windows[w], &point.placed[w]);
        let state = point.states[w].moved(problem, tangent)?;
        let Some(moved) = simulator.run(window, &state, &controls[window.trial])? else {
            return Ok(true);
        };
        let pairs = (moved.samples(problem, window, placed))
            .zip(base[w].samples(problem, window, placed))
            .zip(placed);
        let samples = &problem.trials[window.trial].samples;
        Ok(pairs.into_iter().any(|((m, b), p)| {
            let sigma = problem.channels[samples[p.sample].channel].sigma;
            let change = (m.0 - b.0).abs();
            change.is_nan() || change > LEAST * sigma
        }))
    };
    let found = Simulator::with(problem, point.pool, x, |simulator| {
        for w in 0..point.windows.len() {
            if differs(simulator, w)? {
                return Ok(true);
            }
        }
        Ok(false)
    });
    found.unwrap_or(true)
}
