//! From the command to the control that an actuator gets: delay, lag, ripple, in this order.
//!
//! ```text
//! delay    u(t − T): with T = (n + f) h the mean over the step, (1 − f) uₖ₋ₙ + f uₖ₋ₙ₋₁
//! lag      T u' + u = command: mean over the step u + (x − u)(T/h)(1 − e^(−h/T)), afterwards x = u + (x − u) e^(−h/T)
//! ripple   u (1 + a sin(n q) + b cos(n q)), q of the actuator's joint
//! ```
//!
//! The command is limited to the actuator's control range first. Before the first step the first command had been there
//! for long. Memory: of a delay the number of commands remembered, where the next goes, and the commands; of a lag
//! whether it has begun, and x.

use super::law::{At, Built, Law};
use super::{MAX_DELAY_S, parse};
use crate::mujoco::Model;

#[derive(Debug)]
struct Delay(usize);

#[derive(Debug)]
struct Lag(usize);

#[derive(Debug)]
struct Ripple {
    actuator: usize,
    qpos: usize,
}

pub(super) fn delay(_: &Model, actuator: usize) -> Built {
    Ok(Box::new(Delay(actuator)))
}

pub(super) fn lag(_: &Model, actuator: usize) -> Built {
    Ok(Box::new(Lag(actuator)))
}

pub(super) fn ripple(model: &Model, actuator: usize) -> Built {
    let joint =
        parse::joint_of(model, actuator).ok_or("the actuator does not drive a hinge or slide")?;
    let qpos = model.jnt_qposadr()[joint] as usize;
    Ok(Box::new(Ripple { actuator, qpos }))
}

/// The command as the actuator's range lets it pass.
pub(super) fn limited(model: &Model, actuator: usize, command: f64) -> f64 {
    let [low, high] = model.ctrl_limits(actuator);
    command.max(low).min(high)
}

/// A line of past values: how many there are, where the next goes, the values.
pub(super) struct Line<'a> {
    filled: usize,
    head: usize,
    values: &'a [f64],
}

/// Memory of a line of as many values of `width` numbers as the longest delay needs.
pub(super) fn line_len(timestep: f64, width: usize) -> usize {
    2 + width * ((MAX_DELAY_S / timestep).ceil() as usize + 2)
}

impl<'a> Line<'a> {
    pub(super) fn new(memory: &'a [f64]) -> Self {
        Self {
            filled: memory[0] as usize,
            head: memory[1] as usize,
            values: &memory[2..],
        }
    }

    /// Number `i` of those of `width`, `steps` (not whole) before `now`, by a straight line between steps.
    pub(super) fn before(&self, now: f64, steps: f64, width: usize, i: usize) -> f64 {
        let n = self.values.len() / width;
        let past = |back: usize| match back.min(self.filled) {
            0 => now,
            back => self.values[width * ((self.head + n - back) % n) + i],
        };
        let whole = steps.floor();
        let part = steps - whole;
        let recent = past(whole as usize);
        if part > 0.0 {
            (1.0 - part) * recent + part * past(whole as usize + 1)
        } else {
            recent
        }
    }

    /// Puts a value behind the others of a line in `next`.
    pub(super) fn push(next: &mut [f64], width: usize, value: impl Fn(usize) -> f64) {
        let n = (next.len() - 2) / width;
        let head = next[1] as usize;
        for i in 0..width {
            next[2 + width * head + i] = value(i);
        }
        next[0] = (next[0] as usize + 1).min(n) as f64;
        next[1] = ((head + 1) % n) as f64;
    }
}

impl Law for Delay {
    fn changes_command(&self, actuator: usize) -> bool {
        self.0 == actuator
    }

    fn memory_len(&self, timestep: f64) -> usize {
        line_len(timestep, 1)
    }

    fn command(&self, at: &At<'_>, ctrl: &mut [f64], next: &mut [f64]) {
        let command = limited(at.data.model(), self.0, ctrl[self.0]);
        if at.numbers[0] > 0.0 {
            let steps = at.numbers[0].min(MAX_DELAY_S) / at.timestep;
            ctrl[self.0] = Line::new(at.memory).before(command, steps, 1, 0);
        }
        Line::push(next, 1, |_| command);
    }
}

impl Law for Lag {
    fn changes_command(&self, actuator: usize) -> bool {
        self.0 == actuator
    }

    fn memory_len(&self, _timestep: f64) -> usize {
        2
    }

    fn command(&self, at: &At<'_>, ctrl: &mut [f64], next: &mut [f64]) {
        let command = limited(at.data.model(), self.0, ctrl[self.0]);
        let begun = at.memory[0] != 0.0;
        let (time, x) = (at.numbers[0], if begun { at.memory[1] } else { command });
        let steps = at.timestep / time; // infinite without a lag
        let kept = (-steps).exp();
        if time > 0.0 {
            ctrl[self.0] = command + (x - command) * (1.0 - kept) / steps;
        }
        next.copy_from_slice(&[1.0, command + (x - command) * kept]);
    }
}

impl Law for Ripple {
    fn changes_command(&self, actuator: usize) -> bool {
        self.actuator == actuator
    }

    fn command(&self, at: &At<'_>, ctrl: &mut [f64], _next: &mut [f64]) {
        let (n, q) = (at.numbers, at.data.qpos()[self.qpos]);
        let ripple = n[0] * (n[2] * q).sin() + n[1] * (n[2] * q).cos();
        ctrl[self.actuator] =
            limited(at.data.model(), self.actuator, ctrl[self.actuator]) * (1.0 + ripple);
    }
}
