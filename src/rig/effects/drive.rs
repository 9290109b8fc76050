//! From the commanded control to the one the actuator gets: delay, lag, gain, ripple, saturation, in this order.
//!
//! The range of the control is one of commands: what a motor makes of the greatest may be more, or less, than the model says.
//!
//! Of a command that is held over an inner step h, what is late by d is a mean over two steps, and a lag T has as its mean
//! over one
//!
//! ```text
//! u + (y - u) T/h (1 - exp(-h/T))        y: at its beginning
//! ```
//!
//! Euler's steps show what a force does [`EARLY`] h early, which a delay makes up for: what is hidden is what acts.

use super::{Bound, Effect};
use crate::rig::axes::Axis;

/// Inner steps by which positions are ahead of those of a machine that moves in no steps: the velocity that a step ends with
/// is that of all of it.
pub(in crate::rig) const EARLY: f64 = 0.5;

/// What stands between the command and one actuator.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Drive {
    qpos: usize,
    /// of commands
    range: Option<[f64; 2]>,
    /// the last commands, one an inner step; empty: no delay
    queue: Vec<f64>,
    next: usize,
    /// share of an inner step that the delay is longer than the queue
    more: f64,
    /// what the queue gave an inner step ago
    before: f64,
    /// shares of the old value that a lag keeps at the end of an inner step, and in the mean over it; 0: no lag
    keep: f64,
    keep_mean: f64,
    lagged: f64,
    factor: f64,
    ripples: Vec<[f64; 3]>, // amplitude, per turn, phase
    limit: f64,
}

impl Drive {
    /// A drive that passes commands on.
    pub(in crate::rig) fn new(axis: &Axis) -> Self {
        Self {
            qpos: axis.qpos,
            range: axis.ctrl_range,
            queue: Vec::new(),
            next: 0,
            more: 0.0,
            before: 0.0,
            keep: 0.0,
            keep_mean: 0.0,
            lagged: 0.0,
            factor: 1.0,
            ripples: Vec::new(),
            limit: f64::INFINITY,
        }
    }

    /// Put an effect into it.
    pub(in crate::rig) fn add(&mut self, bound: &Bound, step_s: f64) {
        let v = &bound.values;
        let is_late = matches!(bound.effect, Effect::ActuatorDelay | Effect::ActuatorLag);
        if is_late && v[0] > 0.0 && self.queue.is_empty() && self.more == 0.0 {
            self.delay(EARLY * step_s, step_s);
        }
        match bound.effect {
            Effect::ActuatorDelay if v[0] > 0.0 => self.delay(v[0], step_s),
            Effect::ActuatorLag if v[0] > 0.0 => self.lag(v[0], step_s),
            Effect::TorqueGain => self.factor *= 1.0 + v[0],
            Effect::TorqueRipple => self.ripples.push([v[0], v[1], v[2]]),
            Effect::TorqueSaturation => {
                let largest = self
                    .range
                    .map_or(0.0, |[low, high]| low.abs().max(high.abs()));
                // without a range there is nothing to cut
                if largest > 0.0 {
                    self.limit = self.limit.min(largest * (1.0 - v[0]));
                }
            }
            _ => {}
        }
    }

    /// Makes it later, and late if it was not.
    fn delay(&mut self, delay_s: f64, step_s: f64) {
        let steps = self.more + delay_s / step_s;
        let whole = self.queue.len() + steps as usize;
        self.queue.resize(whole, 0.0);
        self.more = steps.fract();
    }

    fn lag(&mut self, lag_s: f64, step_s: f64) {
        self.keep = (-step_s / lag_s).exp();
        self.keep_mean = lag_s / step_s * (1.0 - self.keep);
    }

    /// The control of this inner step.
    pub(in crate::rig) fn output(&mut self, command: f64, qpos: &[f64]) -> f64 {
        let mut u = self
            .range
            .map_or(command, |[low, high]| command.clamp(low, high));
        if !self.queue.is_empty() {
            std::mem::swap(&mut u, &mut self.queue[self.next]);
            self.next = (self.next + 1) % self.queue.len();
        }
        let now = u;
        u += self.more * (self.before - now);
        self.before = now;
        if self.keep_mean > 0.0 {
            let off = self.lagged - u;
            self.lagged = u + self.keep * off;
            u += self.keep_mean * off;
        }
        u *= self.factor;
        for [amplitude, per_turn, phase] in &self.ripples {
            u *= 1.0 + amplitude * (per_turn * qpos[self.qpos] + phase).sin();
        }
        u.clamp(-self.limit, self.limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lag_reaches_its_share_after_its_time() {
        let mut drive = Drive::new(&Axis::of_motor(0.01));
        drive.lag(0.01, 1e-4);
        for _ in 0..100 {
            drive.output(1.0, &[0.0]);
        }
        let u = drive.lagged;
        assert!((u - (1.0 - (-1.0_f64).exp())).abs() < 1e-12, "{u}");
    }

    #[test]
    fn delay_returns_the_command_of_then() {
        let mut drive = Drive::new(&Axis::of_motor(0.01));
        drive.queue = vec![0.0; 3];
        let out: Vec<f64> = (1..=5)
            .map(|k| drive.output(f64::from(k), &[0.0]))
            .collect();
        assert_eq!(out, [0.0, 0.0, 0.0, 1.0, 2.0]);
    }

    /// A motor stronger than its model was held at what the model allows.
    #[test]
    fn a_range_is_one_of_commands() {
        let mut axis = Axis::of_motor(0.01);
        axis.ctrl_range = Some([-2.0, 1.0]);
        let mut drive = Drive::new(&axis);
        let bound = |effect, values: Vec<f64>| Bound {
            effect,
            elements: vec![0],
            partner: None,
            values,
        };
        drive.add(&bound(Effect::TorqueGain, vec![0.25]), 1e-4);
        assert_eq!(drive.output(3.0, &[0.0]), 1.25);
        assert_eq!(drive.output(-3.0, &[0.0]), -2.5);
        // and torque is cut as a part of the greatest that the model allows
        drive.add(&bound(Effect::TorqueSaturation, vec![0.5]), 1e-4);
        assert_eq!(drive.output(3.0, &[0.0]), 1.0);
    }

    /// With one effect, in inner steps of `h`.
    fn late(effect: Effect, amount: f64, h: f64) -> Drive {
        let bound = Bound {
            effect,
            elements: vec![0],
            partner: None,
            values: vec![amount],
        };
        let mut drive = Drive::new(&Axis::of_motor(0.01));
        drive.add(&bound, h);
        drive
    }

    /// Impulse (N m s) that a command of 1, from the first of n steps of h on, has lost by their end.
    fn lost(effect: Effect, amount: f64, h: f64, n: usize) -> f64 {
        let mut drive = late(effect, amount, h);
        (0..n).map(|_| (1.0 - drive.output(1.0, &[0.0])) * h).sum()
    }

    /// ∫ 1 − u dt is the delay, or the lag, exactly, with half a step for Euler's; of a third of a step too.
    #[test]
    fn what_is_hidden_is_what_acts() {
        let h = 1e-4;
        for delay in [0.3e-4, 1e-4, 2.34e-4, 50e-4] {
            let own = lost(Effect::ActuatorDelay, delay, h, 100);
            assert!((own - delay - 0.5 * h).abs() < 1e-12, "{delay} {own}");
        }
        for lag in [0.3e-4, 5e-4] {
            let own = lost(Effect::ActuatorLag, lag, h, 1000);
            assert!((own - lag - 0.5 * h).abs() < 1e-12, "{lag} {own}");
        }
    }

    /// A body pushed after a delay is where a machine without steps has it.
    #[test]
    fn euler_is_early_by_half_a_step() {
        let (h, delay, n) = (1e-3, 5e-3, 200);
        let mut drive = late(Effect::ActuatorDelay, delay, h);
        let (mut q, mut v) = (0.0, 0.0);
        for _ in 0..n {
            v += h * drive.output(1.0, &[0.0]);
            q += h * v;
        }
        let exact = 0.5 * (f64::from(n) * h - delay).powi(2);
        assert!((q / exact - 1.0).abs() < 1e-5, "{q} {exact}");
    }
}
