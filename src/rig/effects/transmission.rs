//! Play and stretch between a motor and its joint.
//!
//! ```text
//! J ω' = u - t          t = k d(θ - q) + c (ω - q')  where d leaves out the play, and c acts only where d ≠ 0
//! joint: gets t instead of u; its rotor inertia (armature) J turns with the motor, at θ
//! ```
//!
//! The encoder sits on the motor. The motor is integrated here, with as many substeps as its resonance needs.

use super::{Bound, Effect};
use crate::rig::axes::Axis;

/// Largest compliance of a transmission that only has play, rad/(N m).
const PLAIN_COMPLIANCE: f64 = 2e-4;
/// Part of the play that the greatest torque stretches it by: it is stiff beside anything else.
const PLAIN_STRETCH: f64 = 0.01;
/// Damping ratio of the motor on its spring: wound steel rope.
const DAMPING_RATIO: f64 = 0.3;
/// Largest phase of the resonance a substep, rad.
const PHASE_PER_SUBSTEP: f64 = 0.01;

/// A motor on a spring with play.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Transmission {
    pub(in crate::rig) dof: usize,
    pub(in crate::rig) qpos: usize,
    stiffness: f64,
    half_play: f64,
    inertia: f64,
    damping: f64,
    substeps: u32,
    /// motor angle, rad
    pub(in crate::rig) angle: f64,
    /// motor speed, rad/s
    pub(in crate::rig) speed: f64,
}

impl Transmission {
    /// From the play and compliance of `effects` on one actuator, with the rotor inertia of its joint.
    ///
    /// # Errors
    /// When there is no rotor inertia to put on the motor's side.
    pub(in crate::rig) fn new(
        effects: &[&Bound],
        axis: &Axis,
        step_s: f64,
    ) -> Result<Self, String> {
        let inertia = axis.armature;
        if inertia <= 0.0 {
            return Err("the joint has no armature, so its motor has no inertia".to_owned());
        }
        let sum = |effect| -> f64 {
            let of = effects.iter().filter(|b| b.effect == effect);
            of.map(|b| b.values[0]).sum()
        };
        let play = sum(Effect::Backlash);
        let plain = match axis.full_torque() {
            Some(torque) if play > 0.0 => PLAIN_COMPLIANCE.min(PLAIN_STRETCH * play / torque),
            _ => PLAIN_COMPLIANCE,
        };
        let compliance = sum(Effect::TransmissionCompliance).max(plain);
        let stiffness = 1.0 / compliance;
        let resonance = (stiffness / inertia).sqrt();
        Ok(Self {
            dof: axis.dof,
            qpos: axis.qpos,
            stiffness,
            half_play: 0.5 * play,
            inertia,
            damping: 2.0 * DAMPING_RATIO * (stiffness * inertia).sqrt(),
            substeps: (step_s * resonance / PHASE_PER_SUBSTEP).ceil().max(1.0) as u32,
            angle: 0.0,
            speed: 0.0,
        })
    }

    /// Put the motor where the joint is.
    pub(in crate::rig) fn reset(&mut self, qpos: &[f64]) {
        self.angle = qpos[self.qpos];
        self.speed = 0.0;
    }

    /// Torque on the joint, averaged over an inner step in which the joint moves evenly; `torque` is the motor's.
    pub(in crate::rig) fn step(&mut self, torque: f64, q: f64, v: f64, step_s: f64) -> f64 {
        let h = step_s / f64::from(self.substeps);
        let mut sum = 0.0;
        for k in 0..self.substeps {
            let joint = q + v * h * f64::from(k);
            let stretch = self.angle - joint;
            let wound = stretch - stretch.clamp(-self.half_play, self.half_play);
            let mut passed = 0.0;
            if wound != 0.0 || self.half_play == 0.0 {
                passed = self.stiffness * wound + self.damping * (self.speed - v);
                if self.half_play > 0.0 && passed * wound < 0.0 {
                    passed = 0.0; // gear flanks push, they do not pull
                }
            }
            self.speed += h * (torque - passed) / self.inertia;
            self.angle += h * self.speed;
            sum += passed;
        }
        sum / f64::from(self.substeps)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bound(effect: Effect, amount: f64) -> Bound {
        Bound {
            effect,
            elements: vec![0],
            partner: None,
            values: vec![amount],
        }
    }

    fn settled(effect: Effect, amount: f64) -> (Transmission, f64) {
        let bound = bound(effect, amount);
        let axis = Axis::of_motor(1e-5);
        let mut transmission = Transmission::new(&[&bound], &axis, 5e-5).expect("a rotor");
        let mut passed = 0.0;
        for _ in 0..20_000 {
            passed = transmission.step(0.1, 0.0, 0.0, 5e-5);
        }
        (transmission, passed)
    }

    #[test]
    fn a_held_joint_gets_the_torque_and_the_motor_winds_up() {
        let (transmission, passed) = settled(Effect::TransmissionCompliance, 0.01);
        assert!((passed - 0.1).abs() < 1e-9);
        assert!((transmission.angle - 0.001).abs() < 1e-9);
        let (transmission, passed) = settled(Effect::Backlash, 0.01);
        assert!((passed - 0.1).abs() < 1e-6, "{passed}");
        let stretch = 0.1 * PLAIN_COMPLIANCE;
        assert!((transmission.angle - (0.005 + stretch)).abs() < 1e-6);
    }

    /// A step of 0.1 rad had it a twentieth of its swing ahead.
    #[test]
    fn a_motor_swings_as_its_equation_says() {
        let (compliance, inertia, torque, step_s): (f64, f64, f64, f64) = (0.0137, 1e-5, 2.0, 5e-5);
        let bound = bound(Effect::TransmissionCompliance, compliance);
        let mut motor =
            Transmission::new(&[&bound], &Axis::of_motor(inertia), step_s).expect("a rotor");
        let frequency = (compliance * inertia).sqrt().recip();
        let (decay, turn) = (
            DAMPING_RATIO * frequency,
            frequency * (1.0 - DAMPING_RATIO * DAMPING_RATIO).sqrt(),
        );
        for k in 1..=40 {
            motor.step(torque, 0.0, 0.0, step_s);
            let t = f64::from(k) * step_s;
            let swing = (turn * t).cos() + decay / turn * (turn * t).sin();
            let exact = compliance * torque * (1.0 - (-decay * t).exp() * swing);
            assert!(
                (motor.angle - exact).abs() < 0.006 * compliance * torque,
                "step {k}: {} {exact}",
                motor.angle
            );
        }
    }

    /// Its stretch was 2e-4 rad/(N m) whatever the motor, as much as the play of a strong one.
    #[test]
    fn play_alone_does_not_stretch() {
        let mut axis = Axis::of_motor(0.01);
        axis.ctrl_range = Some([-8.0, 5.0]);
        let play = bound(Effect::Backlash, 0.002);
        let own = Transmission::new(&[&play], &axis, 1e-4).expect("a rotor");
        assert!((8.0 / own.stiffness - 2e-5).abs() < 1e-12);
        let stretch = bound(Effect::TransmissionCompliance, 0.01);
        let both = Transmission::new(&[&play, &stretch], &axis, 1e-4).expect("a rotor");
        assert!((both.stiffness - 100.0).abs() < 1e-9);
    }
}
