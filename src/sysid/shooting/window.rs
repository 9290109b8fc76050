//! Recordings cut into windows, and which samples belong to which.

use crate::sysid::SysidError;
use crate::sysid::problem::{Problem, Stage};

/// Knots `first ..= last` of a trial. The last knot is the next window's first.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Window {
    pub trial: usize,
    pub first: usize,
    pub last: usize,
    /// whether the motion goes on in the next window
    pub followed: bool,
    /// whether it ends where the next one begins, see [`Window::up_to`]
    pub whole: bool,
}

/// Position (nq) and velocity (nv) at the start of a window.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct State {
    pub qpos: Vec<f64>,
    pub qvel: Vec<f64>,
}

/// A sensor sample on a window's grid: between its knots `knot` and `knot + 1`.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Placed {
    pub knot: usize,
    pub part: f64,
    /// in the trial
    pub sample: usize,
}

/// Stamps are rounded: this close to a knot, in steps, a sample is on it.
const ON_KNOT: f64 = 1e-4;

/// Every trial in windows of equal length, as near as whole windows allow to `window_s`.
pub(crate) fn cut(problem: &Problem, window_s: f64) -> Vec<Window> {
    let h = problem.model.timestep();
    let mut windows = Vec::new();
    for (trial, t) in problem.trials.iter().enumerate() {
        let steps = t.n_knots - 1;
        let n = ((steps as f64 * h / window_s).round() as usize).clamp(1, steps);
        let edge = |i: usize| i * steps / n;
        windows.extend((0..n).map(|i| Window {
            trial,
            first: edge(i),
            last: edge(i + 1),
            followed: i + 1 < n,
            whole: true,
        }));
    }
    windows
}

impl Window {
    /// Its first `steps`.
    pub(crate) fn up_to(&self, steps: usize) -> Self {
        let last = self.last.min(self.first + steps);
        Self {
            last,
            whole: last == self.last,
            ..self.clone()
        }
    }

    /// Number of knots.
    pub(crate) fn len(&self) -> usize {
        self.last - self.first + 1
    }
}

impl State {
    /// The state of a trajectory (knots × nq) at the start of a window.
    pub(crate) fn on(
        problem: &Problem,
        window: &Window,
        trajectory: &[f64],
    ) -> Result<Self, SysidError> {
        let model = &problem.model;
        let (nq, h) = (model.nq(), model.timestep());
        let knot = |k: usize| &trajectory[k * nq..(k + 1) * nq];
        let mut qvel = vec![0.0; model.nv()];
        // the velocity after the knot: before it, the motion may be another window's
        let next = knot(window.first + 1);
        model.differentiate_pos(&mut qvel, h, knot(window.first), next)?;
        if window.first == 0 && window.last > 1 {
            // at rest or not, the first velocity is a step before that
            let mut later = vec![0.0; model.nv()];
            model.differentiate_pos(&mut later, h, next, knot(2))?;
            for (v, later) in qvel.iter_mut().zip(&later) {
                *v = 2.0 * *v - later;
            }
        }
        Ok(Self {
            qpos: knot(window.first).to_vec(),
            qvel,
        })
    }

    /// Moved along a tangent vector: nv of position, then nv of velocity.
    pub(crate) fn moved(&self, problem: &Problem, tangent: &[f64]) -> Result<Self, SysidError> {
        let mut new = self.clone();
        let (position, velocity) = tangent.split_at(self.qvel.len());
        problem.model.integrate_pos(&mut new.qpos, position, 1.0)?;
        for (v, d) in new.qvel.iter_mut().zip(velocity) {
            *v += d;
        }
        Ok(new)
    }

    /// The tangent vector at `from` that leads here: nv of position, then nv of velocity.
    pub(crate) fn minus(&self, from: &Self, problem: &Problem) -> Result<Vec<f64>, SysidError> {
        let nv = self.qvel.len();
        let mut tangent = vec![0.0; 2 * nv];
        let (position, velocity) = tangent.split_at_mut(nv);
        problem
            .model
            .differentiate_pos(position, 1.0, &from.qpos, &self.qpos)?;
        for ((d, a), b) in velocity.iter_mut().zip(&self.qvel).zip(&from.qvel) {
            *d = a - b;
        }
        Ok(tangent)
    }
}

/// Samples of each window, in the order of knots, with the delays that parameters `x` give the channels.
///
/// Samples before the first and after the last knot of the trial are left out.
pub(crate) fn place(problem: &Problem, windows: &[Window], x: &[f64]) -> Vec<Vec<Placed>> {
    let h = problem.model.timestep();
    let free = problem.free_values(x);
    let mut placed: Vec<Vec<Placed>> = vec![Vec::new(); windows.len()];
    let mut first = 0;
    for (trial, t) in problem.trials.iter().enumerate() {
        let n = windows[first..]
            .iter()
            .take_while(|w| w.trial == trial)
            .count();
        let own = &windows[first..first + n];
        for (sample, s) in t.samples.iter().enumerate() {
            let channel = &problem.channels[s.channel];
            let at = (s.time - channel.delay.value(&free)) / h;
            if at < -ON_KNOT || at > (t.n_knots - 1) as f64 + ON_KNOT {
                continue;
            }
            let knot = (at + ON_KNOT).floor() as usize;
            let part = at - knot as f64;
            // forces are held over a step
            let on = part < ON_KNOT || channel.stage == Stage::Acceleration;
            let i = own.partition_point(|w| w.first <= knot) - 1;
            if knot > own[i].last {
                continue; // of a part of a window
            }
            placed[first + i].push(Placed {
                knot: knot - own[i].first,
                part: if on { 0.0 } else { part },
                sample,
            });
        }
        first += n;
    }
    for own in &mut placed {
        own.sort_by_key(|p| p.knot);
    }
    placed
}
