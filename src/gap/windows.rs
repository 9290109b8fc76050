//! Recordings in short windows, each simulated from a first state of its own.
//!
//! A missing force shows as a bend of the motion. Over a window of length T, whose first state is free, it moves the
//! readings by about f T²/M; noise of the readings hides that the less, the longer the window. Whatever acts between
//! the joints and the sensors, contact and sticking included, is in the simulation, so that forces and readings are
//! judged by one residual:
//!
//! ```text
//! r = W (ŝ(s₀, x) − s)        r̃ = r − Q Qᵀ r        Q: orthonormal basis of ∂ŝ/∂s₀
//! ```
//!
//! | symbol | name |
//! | --- | --- |
//! | s, ŝ, W | samples, predictions, one over `Channel::sigma` |
//! | s₀, x | first state of the window, parameters |
//! | r̃ | [`super::linear::Row::residual`] |

use std::sync::Arc;

use nalgebra::DMatrix;

use super::coarse;
use super::lying::Lying;
use super::score;
use super::telling::telling;
use crate::mujoco::Model;
use crate::sysid::SysidError;
use crate::sysid::holdout::hold;
use crate::sysid::path::Path;
use crate::sysid::problem::{Problem, Sample, Stage, Trial};
use crate::sysid::shooting::window::{State, Window};
use crate::sysid::start;

/// Lengths to choose from, s.
const LENGTHS_S: [f64; 3] = [0.2, 0.4, 0.8];
/// Noise of a window's acceleration that is small enough, as a part of what the motion has.
const FINE: f64 = 0.02;
/// Least steps of a window.
const LEAST_STEPS: usize = 4;

/// All windows of some recordings.
#[derive(Debug, Clone)]
pub(super) struct Windows {
    /// one trial a window
    pub problem: Problem,
    /// of each window: index of its recording, s from the start of that
    pub origin: Vec<(usize, f64)>,
    /// (knots × nq) of each window
    pub trajectories: Vec<Vec<f64>>,
    /// first state of each window
    pub states: Vec<State>,
    /// the same as they were measured: with the velocity of the first step, with that of the first quarter of the window, and as all of
    /// that quarter has them
    pub measured: [Vec<State>; 3],
    /// of each window: degrees of freedom of which it says nothing, see [`super::lying`]
    pub still: Vec<Vec<usize>>,
    /// s
    pub length_s: f64,
    /// how many were cut, of which some may be left out
    pub n_cut: usize,
    /// of each window: steps of the model that derivatives take at once, see [`super::coarse`]
    pub factors: Vec<usize>,
}

/// The shortest length whose accelerations are not noise.
pub(super) fn length_s(whole: &Problem) -> f64 {
    let fine = |length: f64| {
        let mut ratios: Vec<f64> = Vec::new();
        for (c, channel) in whole.channels.iter().enumerate() {
            if channel.stage != Stage::Position {
                continue;
            }
            let (mut bends, mut n, mut rate) = (0.0, 0.0, 0.0_f64);
            for trial in &whole.trials {
                let own: Vec<&Sample> = trial.samples.iter().filter(|s| s.channel == c).collect();
                let (Some(first), Some(last)) = (own.first(), own.last()) else {
                    continue;
                };
                let interval = (last.time - first.time) / (own.len() as f64 - 1.0).max(1.0);
                let half = (0.5 * length / interval).round() as usize;
                rate = rate.max(interval.recip());
                if half == 0 {
                    continue;
                }
                for k in (half..own.len().saturating_sub(half)).step_by(half) {
                    let bend = own[k + half].value - 2.0 * own[k].value + own[k - half].value;
                    bends += (bend / (half as f64 * interval).powi(2)).powi(2);
                    n += 1.0;
                }
            }
            if n > 0.0 && bends > 0.0 {
                // standard deviation of twice the quadratic coefficient of a parabola through equal samples
                let noise =
                    channel.sigma * (720.0 / (rate * length).max(3.0)).sqrt() / (length * length);
                ratios.push(noise / (bends / n).sqrt());
            }
        }
        ratios.sort_by(f64::total_cmp);
        ratios.get(ratios.len() / 2).is_none_or(|r| *r < FINE)
    };
    let longest = LENGTHS_S[LENGTHS_S.len() - 1];
    LENGTHS_S.into_iter().find(|l| fine(*l)).unwrap_or(longest)
}

impl Windows {
    /// Cuts every trial of `whole` into windows of `length_s`, of which at most about `most` are kept, evenly. The
    /// motion is estimated with parameters `x`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn cut(
        whole: &Problem,
        x: &[f64],
        length_s: f64,
        most: usize,
    ) -> Result<Self, SysidError> {
        let (h, nq) = (whole.model.timestep(), whole.model.nq());
        let count = |t: &Trial| {
            let steps = t.n_knots - 1;
            let n = (steps as f64 * h / length_s).round() as usize;
            n.clamp(1, (steps / LEAST_STEPS).max(1))
        };
        let total: usize = whole.trials.iter().map(count).sum();
        let align = coarse::aligned((length_s / h).round() as usize);
        let stride = total.div_ceil(most.max(1));
        let mut problem = Problem {
            trials: Vec::new(),
            ..whole.clone()
        };
        let (mut origin, mut trajectories, mut still) = (Vec::new(), Vec::new(), Vec::new());
        let mut lying = Lying::new(whole, x)?;
        let mut seen = 0;
        for (i, trial) in whole.trials.iter().enumerate() {
            let path = Path::new(start::trajectory(whole, trial, x)?, nq, h);
            let (n, steps) = (count(trial), trial.n_knots - 1);
            for w in 0..n {
                let edge = |w: usize| w * steps / n / align * align;
                let (first, last) = (edge(w), edge(w + 1));
                seen += 1;
                if seen % stride != 0 {
                    continue;
                }
                let mut part = part(whole, trial, first, last);
                part.path = Some(path.from(first as f64 * h));
                let own = &path.rows()[first * nq..(last + 1) * nq];
                let lies = lying.of(&part, own)?;
                Arc::make_mut(&mut part.samples).retain(|s| !lies.channels.contains(&s.channel));
                if part.samples.is_empty() {
                    continue;
                }
                problem.trials.push(part);
                origin.push((i, trial.start_s + first as f64 * h));
                trajectories.push(own.to_vec());
                still.push(lies.dofs);
            }
        }
        let mut cut = Self {
            n_cut: problem.trials.len(),
            factors: vec![1; problem.trials.len()],
            problem,
            origin,
            trajectories,
            states: Vec::new(),
            measured: Default::default(),
            still,
            length_s,
        };
        let each = cut.windows().into_iter().zip(&cut.trajectories);
        let states: Vec<[State; 3]> = each
            .map(|(w, t)| {
                let first = State::on(&cut.problem, &w, t)?;
                let calm = calm(&whole.model, t, &first)?;
                let mean = mean(&whole.model, t, &first)?;
                Ok([first, calm, mean])
            })
            .collect::<Result<_, SysidError>>()?;
        cut.measured = [0, 1, 2].map(|way| states.iter().map(|s| s[way].clone()).collect());
        cut.states.clone_from(&cut.measured[0]);
        Ok(cut)
    }

    /// Only the windows `kept`.
    pub(super) fn only(&self, kept: &[usize]) -> Self {
        Self {
            problem: Problem {
                trials: kept
                    .iter()
                    .map(|&i| self.problem.trials[i].clone())
                    .collect(),
                ..self.problem.clone()
            },
            origin: kept.iter().map(|&i| self.origin[i]).collect(),
            trajectories: kept.iter().map(|&i| self.trajectories[i].clone()).collect(),
            states: kept.iter().map(|&i| self.states[i].clone()).collect(),
            measured: (self.measured.each_ref())
                .map(|way| kept.iter().map(|&i| way[i].clone()).collect()),
            still: kept.iter().map(|&i| self.still[i].clone()).collect(),
            length_s: self.length_s,
            n_cut: self.n_cut,
            factors: kept.iter().map(|&i| self.factors[i]).collect(),
        }
    }

    /// So many of the windows at most, evenly.
    pub(super) fn at_most(&self, n: usize) -> Self {
        let stride = self.len().div_ceil(n).max(1);
        let some: Vec<usize> = (0..self.len()).step_by(stride).collect();
        self.only(&some)
    }

    /// Number of windows.
    pub(super) fn len(&self) -> usize {
        self.problem.trials.len()
    }

    /// What to say of those that were cut and are left out, if some are.
    pub(super) fn left_out(&self) -> Option<String> {
        let (n, all) = (self.n_cut - self.len(), self.n_cut);
        (n > 0).then(|| {
            format!(
                "{n} of {all} windows are left out of the search: a joint meets its limit in them, or the simulation diverges"
            )
        })
    }

    /// The index of each.
    pub(super) fn all(&self) -> Vec<usize> {
        (0..self.len()).collect()
    }

    /// The stretch of time that each is of.
    pub(super) fn stretches(&self) -> Vec<usize> {
        let recording: Vec<usize> = self.origin.iter().map(|o| o.0).collect();
        score::stretches(&recording, score::STRETCHES)
    }

    /// The window that ends where window `w` begins, if there is one.
    pub(super) fn preceding(&self, w: usize) -> Option<usize> {
        let before = w.checked_sub(1)?;
        let ((own, begin_s), (recording, from_s)) = (self.origin[w], self.origin[before]);
        let h = self.problem.model.timestep();
        let end_s = from_s + (self.problem.trials[before].n_knots - 1) as f64 * h;
        (own == recording && (begin_s - end_s).abs() < 0.5 * h).then_some(before)
    }

    pub(super) fn windows(&self) -> Vec<Window> {
        let window = |(trial, t): (usize, &Trial)| Window {
            trial,
            first: 0,
            last: t.n_knots - 1,
            followed: false,
            whole: true,
        };
        self.problem.trials.iter().enumerate().map(window).collect()
    }

    /// Another problem with its parameters held at what those of the same name are here at `x`.
    pub(super) fn held(&self, problem: &Problem, x: &[f64]) -> Problem {
        let values = self.problem.parameters.values(x);
        let names = &self.problem.parameters.all;
        let own = |name: &str| names.iter().position(|p| p.name == name).map(|i| values[i]);
        hold(problem, |p| own(&p.name).unwrap_or(p.start))
    }

    /// The same with parameters held at `x`: first states alone are free.
    pub(super) fn holding(&self, x: &[f64]) -> Self {
        Self {
            problem: self.held(&self.problem, x),
            ..self.clone()
        }
    }
}

/// The `first` state of a window with the velocity of a parabola through a quarter of its `trajectory` (knots × nq): what rattles
/// in its play has another in every step.
fn calm(model: &Model, trajectory: &[f64], first: &State) -> Result<State, SysidError> {
    let (nq, h) = (model.nq(), model.timestep());
    let steps = (trajectory.len() / nq).saturating_sub(1);
    if steps < 2 {
        return Ok(first.clone());
    }
    let eighth = (steps / 8).max(1);
    let knot = |k: usize| &trajectory[k * nq..(k + 1) * nq];
    let (mut qvel, mut later) = (vec![0.0; model.nv()], vec![0.0; model.nv()]);
    let span = eighth as f64 * h;
    model.differentiate_pos(&mut qvel, span, knot(0), knot(eighth))?;
    model.differentiate_pos(&mut later, span, knot(0), knot(2 * eighth))?;
    for (v, later) in qvel.iter_mut().zip(&later) {
        *v = 2.0 * *v - 0.5 * later;
    }
    Ok(State {
        qpos: first.qpos.clone(),
        qvel,
    })
}

/// Position and velocity at the beginning of a parabola through all knots of a quarter of the `trajectory`, by least squares: a motor
/// that shakes on a soft drive is nowhere where its joint is. Of what does not shake, and where there are too few, that of the `first`
/// state.
fn mean(model: &Model, trajectory: &[f64], first: &State) -> Result<State, SysidError> {
    let (nq, nv) = (model.nq(), model.nv());
    let steps = (trajectory.len() / nq).saturating_sub(1) / 4;
    if steps < 3 {
        return Ok(first.clone());
    }
    let n = steps + 1;
    let mut far = DMatrix::zeros(n, nv);
    let mut change = vec![0.0; nv];
    for (k, knot) in trajectory.chunks(nq).take(n).enumerate() {
        model.differentiate_pos(&mut change, 1.0, &first.qpos, knot)?;
        far.row_mut(k).copy_from_slice(&change);
    }
    // time in quarters: powers of about the same size
    let span = steps as f64 * model.timestep();
    let powers = DMatrix::from_fn(n, 3, |k, power| {
        (k as f64 / steps as f64).powi(power as i32)
    });
    let Some(normal) = powers.tr_mul(&powers).cholesky() else {
        return Ok(first.clone());
    };
    let parabola = normal.solve(&powers.tr_mul(&far));
    let left = &far - &powers * &parabola;
    // what one reading says of the next is not what shakes
    let shakes = |dof: usize| {
        let own = left.column(dof);
        let turns = own.rows(1, steps) - own.rows(0, steps);
        turns.norm_squared() > own.norm_squared()
    };
    let mut state = first.clone();
    change.fill(0.0);
    for dof in (0..nv).filter(|dof| shakes(*dof)) {
        (change[dof], state.qvel[dof]) = (parabola[(0, dof)], parabola[(1, dof)] / span);
    }
    if change.iter().any(|c| *c != 0.0) {
        model.integrate_pos(&mut state.qpos, &change, 1.0)?;
    }
    Ok(state)
}

/// Knots `first ..= last` of a trial as one of its own.
fn part(whole: &Problem, trial: &Trial, first: usize, last: usize) -> Trial {
    const SLACK: f64 = 1e-9;
    let h = whole.model.timestep();
    let (from, to) = (first as f64 * h, last as f64 * h);
    let inside = |s: &&Sample| s.time >= from - SLACK && s.time <= to + SLACK;
    let own: Vec<Sample> = (trial.samples.iter().filter(inside))
        .map(|s| Sample {
            time: s.time - from,
            ..*s
        })
        .collect();
    let samples = telling(&own, whole.channels.len());
    let controls = trial.controls.iter().map(|series| {
        // some before the window: commands may act late
        let begin = series.partition_point(|(t, _)| *t <= from - crate::supplement::MEMORY_S);
        let end = series.partition_point(|(t, _)| *t <= to);
        let own = &series[begin.saturating_sub(1)..end.max(begin).max(1)];
        own.iter().map(|(t, u)| (t - from, *u)).collect()
    });
    Trial {
        name: name(trial, trial.start_s + from),
        n_knots: last - first + 1,
        start_s: trial.start_s + from,
        controls: Arc::new(controls.collect()),
        samples: Arc::new(samples),
        recording: Arc::clone(&trial.recording),
        path: None,
    }
}

/// What a part of a recording from a time on, s, is called.
pub(super) fn name(trial: &Trial, from_s: f64) -> String {
    format!("{} from {from_s:.3} s", trial.name)
}

/// Whether a channel is the velocity of a hinge or slide.
pub(super) fn is_velocity(model: &Model, source: usize) -> bool {
    use crate::mujoco::Measures;
    if source >= model.nsensordata() {
        return source >= model.nsensordata() + model.nq();
    }
    (0..model.nsensor()).any(|s| {
        model.sensor_adr()[s] as usize == source
            && matches!(model.measures(s), Measures::Velocity(_))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::masses::{machine, searching};

    #[test]
    fn windows_follow_one_another_unless_one_is_left_out() {
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&machine("", ""), &machine("", ""), config, |search, _| {
            let all = &search.windows;
            let before = |windows: &Windows| -> Vec<Option<usize>> {
                (0..3).map(|w| windows.preceding(w)).collect()
            };
            assert_eq!(before(all), [None, Some(0), Some(1)]);
            assert_eq!(before(&all.only(&[0, 2, 3])), [None, None, Some(1)]);
        });
    }

    #[test]
    fn windows_that_are_left_out_are_counted() {
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&machine("", ""), &machine("", ""), config, |search, _| {
            let windows = &search.windows;
            let n = windows.len();
            assert_eq!(windows.left_out(), None);
            let few = windows.only(&(3..n).collect::<Vec<_>>());
            let begin = format!("3 of {n} windows");
            assert!(few.left_out().is_some_and(|note| note.starts_with(&begin)));
        });
    }

    /// A mass that moves on at 0.3 m/s and 2 m/s², read a tenth of a millimetre off in its second step.
    #[test]
    fn a_rattle_in_the_first_steps_is_no_velocity() {
        const H_S: f64 = 0.002;
        let model = &machine("", "").model;
        let mut trajectory: Vec<f64> = (0..101)
            .map(|k| f64::from(k) * H_S)
            .flat_map(|t| [0.3 * t + t * t, 0.0])
            .collect();
        trajectory[2] += 1e-4;
        let first = State {
            qpos: trajectory[..2].to_vec(),
            qvel: vec![14.0, 14.0],
        };
        let calm = calm(model, &trajectory, &first).expect("a state");
        assert!((calm.qvel[0] - 0.3).abs() < 1e-9 && calm.qvel[1].abs() < 1e-9);
        assert_eq!(calm.qpos, first.qpos);
        // and where there are hardly any steps
        let short = super::calm(model, &trajectory[..6], &first).expect("a state");
        assert!(short.qvel[0].is_finite());
        let one = super::calm(model, &trajectory[..4], &first).expect("a state");
        assert_eq!(one, first);
    }

    /// The same mass, read on a motor that swings by 3 cm in four steps on its drive.
    #[test]
    fn a_motor_that_shakes_hides_no_joint() {
        const H_S: f64 = 0.002;
        const SHAKES_M: [f64; 4] = [0.03, 0.03, -0.03, -0.03];
        let model = &machine("", "").model;
        let trajectory: Vec<f64> = (0..401)
            .map(|k| (f64::from(k) * H_S, SHAKES_M[k as usize % 4]))
            .flat_map(|(t, shake)| [0.3 * t + t * t + shake, 0.0])
            .collect();
        let first = State {
            qpos: trajectory[..2].to_vec(),
            qvel: vec![0.0; 2],
        };
        let mean = mean(model, &trajectory, &first).expect("a state");
        assert!(mean.qpos[0].abs() < 0.1 * SHAKES_M[0], "{mean:?}");
        assert!((mean.qvel[0] - 0.3).abs() < 0.1, "{mean:?}");
        let calm = calm(model, &trajectory, &first).expect("a state");
        assert!((calm.qvel[0] - 0.3).abs() > 0.3, "{calm:?}");
        let one = super::mean(model, &trajectory[..6], &first).expect("a state");
        assert_eq!(one, first);
    }
}
