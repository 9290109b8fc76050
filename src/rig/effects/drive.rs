//! From the commanded control to the one the actuator gets: delay, lag, gain, ripple, saturation, in this order.

use super::{Bound, Effect};
use crate::mujoco::Model;

/// What stands between the command and one actuator.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Drive {
    qpos: usize,
    /// the last commands, one an inner step; empty: no delay
    queue: Vec<f64>,
    next: usize,
    /// share of the old value that a lag keeps an inner step; 0: no lag
    keep: f64,
    lagged: f64,
    factor: f64,
    ripples: Vec<[f64; 3]>, // amplitude, per turn, phase
    limit: f64,
}

impl Drive {
    /// A drive that passes commands on; `qpos` is the address of its joint.
    pub(in crate::rig) fn new(qpos: usize) -> Self {
        Self {
            qpos,
            queue: Vec::new(),
            next: 0,
            keep: 0.0,
            lagged: 0.0,
            factor: 1.0,
            ripples: Vec::new(),
            limit: f64::INFINITY,
        }
    }

    /// Put an effect into it.
    pub(in crate::rig) fn add(
        &mut self,
        model: &Model,
        actuator: usize,
        bound: &Bound,
        step_s: f64,
    ) {
        let v = &bound.values;
        match bound.effect {
            Effect::ActuatorDelay => {
                let n = (v[0] / step_s).round() as usize;
                self.queue.resize(self.queue.len() + n, 0.0);
            }
            Effect::ActuatorLag if v[0] > 0.0 => self.keep = (-step_s / v[0]).exp(),
            Effect::TorqueGain => self.factor *= 1.0 + v[0],
            Effect::TorqueRipple => self.ripples.push([v[0], v[1], v[2]]),
            Effect::TorqueSaturation => {
                let range = &model.actuator_ctrlrange()[2 * actuator..2 * actuator + 2];
                let largest = range[0].abs().max(range[1].abs());
                // without a range there is nothing to cut
                if model.actuator_ctrllimited()[actuator] != 0 && largest > 0.0 {
                    self.limit = self.limit.min(largest * (1.0 - v[0]));
                }
            }
            _ => {}
        }
    }

    /// The control of this inner step.
    pub(in crate::rig) fn output(&mut self, command: f64, qpos: &[f64]) -> f64 {
        let mut u = command;
        if !self.queue.is_empty() {
            std::mem::swap(&mut u, &mut self.queue[self.next]);
            self.next = (self.next + 1) % self.queue.len();
        }
        if self.keep > 0.0 {
            self.lagged = self.keep * self.lagged + (1.0 - self.keep) * u;
            u = self.lagged;
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
        let mut drive = Drive::new(0);
        drive.keep = (-1e-4_f64 / 0.01).exp();
        let mut u = 0.0;
        for _ in 0..100 {
            u = drive.output(1.0, &[0.0]);
        }
        assert!((u - (1.0 - (-1.0_f64).exp())).abs() < 1e-12, "{u}");
    }

    #[test]
    fn delay_returns_the_command_of_then() {
        let mut drive = Drive::new(0);
        drive.queue = vec![0.0; 3];
        let out: Vec<f64> = (1..=5)
            .map(|k| drive.output(f64::from(k), &[0.0]))
            .collect();
        assert_eq!(out, [0.0, 0.0, 0.0, 1.0, 2.0]);
    }
}
