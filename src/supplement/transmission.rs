//! Play and stretch between a motor and its joint.
//!
//! With q the joint, q + s the motor, J the joint's `armature` (the rotor's inertia) and τ the motor's torque,
//!
//! ```text
//! J (q'' + s'') = τ − t        joint: t        so the joint gets τ − J q'' − J s''
//! stretch    t = s/c + damping           play    t = 0 while |s| < p/2, no rebound at its ends
//! ```
//!
//! The engine has τ and J q''; the law adds −J s'', as its mean over the step. s is integrated exactly over a step in which
//! τ and q'' (as it was in the last one) are constant, so neither a stiff spring nor a light rotor makes it unstable.
//! Encoders sit on motors: they show q + s. Without rotor inertia s follows τ at once.
//!
//! The engine's own way, a second joint for the motor, would change the states of the model, and with them recordings,
//! policies and keyframes.
//!
//! Memory: whether it has begun, s, s', and the joint's velocity one step ago. Where the motion of the motor θ = q + s was
//! measured it says how the transmission was loaded then, t = τ − J θ''.

use super::command::limited;
use super::law::{At, Built, Law};
use super::parse;
use crate::mujoco::{Data, Forces, Model, N_PRM};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Joining {
    Play,
    Stretch,
}

#[derive(Debug)]
struct Transmission {
    actuator: usize,
    joint: usize,
    dof: usize,
    joining: Joining,
}

fn transmission(model: &Model, actuator: usize, joining: Joining) -> Built {
    let joint =
        parse::joint_of(model, actuator).ok_or("the actuator does not drive a hinge or slide")?;
    let dof = model.jnt_dofadr()[joint] as usize;
    Ok(Box::new(Transmission {
        actuator,
        joint,
        dof,
        joining,
    }))
}

pub(super) fn backlash(model: &Model, actuator: usize) -> Built {
    transmission(model, actuator, Joining::Play)
}

pub(super) fn compliance(model: &Model, actuator: usize) -> Built {
    transmission(model, actuator, Joining::Stretch)
}

/// s and s'.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Motor {
    s: f64,
    speed: f64,
}

impl Motor {
    /// On a spring of `compliance` with a relative damping below 1, driven by `torque` for `time`.
    fn stretched(
        self,
        compliance: f64,
        damping: f64,
        inertia: f64,
        torque: f64,
        time: f64,
    ) -> Self {
        if compliance == 0.0 {
            return Self { s: 0.0, speed: 0.0 };
        }
        let rest = compliance * torque;
        if inertia <= 0.0 {
            return Self {
                s: rest,
                speed: (rest - self.s) / time,
            };
        }
        let frequency = (compliance * inertia).sqrt().recip();
        let (decay, turn) = (
            damping * frequency,
            frequency * (1.0 - damping * damping).sqrt(),
        );
        let (sin, cos) = (turn * time).sin_cos();
        let shrink = (-decay * time).exp();
        let (x, v) = (self.s - rest, self.speed);
        Self {
            s: rest + shrink * (x * cos + (v + decay * x) / turn * sin),
            speed: shrink * (v * cos - (decay * v + frequency * frequency * x) / turn * sin),
        }
    }

    /// Between stops at ±`half`, accelerated for `time`.
    fn free(mut self, half: f64, acceleration: f64, mut time: f64) -> Self {
        if half == 0.0 {
            return Self { s: 0.0, speed: 0.0 };
        }
        // leaving a stop, crossing, meeting the other: two flights at most
        for _ in 0..2 {
            let (s, v, a) = (self.s, self.speed, acceleration);
            if v == 0.0 && s.abs() >= half && s * a >= 0.0 {
                return Self {
                    s: half.copysign(s),
                    speed: 0.0,
                };
            }
            let meeting = first_meeting(s, v, a, half).filter(|(t, _)| *t < time);
            let Some((t, side)) = meeting else {
                let s = (s + (v + 0.5 * a * time) * time).clamp(-half, half);
                return Self {
                    s,
                    speed: v + a * time,
                };
            };
            self = Self {
                s: side * half,
                speed: 0.0,
            };
            time -= t;
        }
        self
    }
}

/// When and at which end a motion s + v t + a t²/2 that starts inside meets ±`half`.
fn first_meeting(s: f64, v: f64, a: f64, half: f64) -> Option<(f64, f64)> {
    let mut first: Option<(f64, f64)> = None;
    for side in [1.0, -1.0] {
        // towards this end: gap = u t + b t²/2
        let (gap, u, b) = (half - side * s, side * v, side * a);
        let root = u * u + 2.0 * b * gap;
        if root < 0.0 {
            continue;
        }
        // the earlier of both times, in the form that does not cancel
        let t = if u + root.sqrt() > 0.0 {
            2.0 * gap / (u + root.sqrt())
        } else {
            continue;
        };
        // one that has just left does not meet the end it left
        let leaves = gap <= 0.0 && (u < 0.0 || (u == 0.0 && b < 0.0));
        if !leaves && t >= 0.0 && first.is_none_or(|(earlier, _)| t < earlier) {
            first = Some((t, side));
        }
    }
    first
}

impl Transmission {
    /// The motor's in the step to come.
    fn torque(&self, data: &Data) -> f64 {
        let (model, actuator) = (data.model(), self.actuator);
        let moment = data.actuator_moment()[actuator * model.nv() + self.dof];
        let mut force = data.actuator_force()[actuator];
        let late = data.late(actuator);
        if late != 0.0 && model.na() == 0 {
            let (ctrl, gain) = (
                data.ctrl()[actuator],
                model.actuator_gainprm()[N_PRM * actuator],
            );
            force +=
                gain * (limited(model, actuator, ctrl + late) - limited(model, actuator, ctrl));
        }
        force * moment
    }

    /// The motor at the beginning and at the end of the step.
    fn step(&self, at: &At<'_>) -> [Motor; 2] {
        let (model, data) = (at.data.model(), at.data);
        let torque = self.torque(data);
        let inertia = model.dof_armature()[self.dof];
        let begun = at.memory[0] != 0.0;
        let acceleration = if begun {
            (data.qvel()[self.dof] - at.memory[3]) / at.timestep
        } else {
            0.0
        };
        let drive = torque - inertia * acceleration;
        let n = at.numbers;
        match self.joining {
            Joining::Stretch => {
                let rest = Motor {
                    s: n[0] * torque,
                    speed: 0.0,
                };
                let before = if begun { motor(at.memory) } else { rest };
                [
                    before,
                    before.stretched(n[0], n[1], inertia, drive, at.timestep),
                ]
            }
            Joining::Play => {
                let half = 0.5 * n[0];
                let end = if torque == 0.0 {
                    0.0
                } else {
                    half.copysign(torque)
                };
                let before = if begun {
                    motor(at.memory)
                } else {
                    Motor { s: end, speed: 0.0 }
                };
                let after = if inertia > 0.0 {
                    before.free(half, drive / inertia, at.timestep)
                } else {
                    Motor {
                        s: if torque == 0.0 { before.s } else { end },
                        speed: 0.0,
                    }
                };
                [before, after]
            }
        }
    }
}

fn motor(memory: &[f64]) -> Motor {
    Motor {
        s: memory[1],
        speed: memory[2],
    }
}

impl Law for Transmission {
    fn memory_len(&self, _timestep: f64) -> usize {
        4
    }

    fn force(&self, at: &At<'_>, forces: &mut Forces, next: &mut [f64]) {
        let [before, after] = self.step(at);
        let inertia = at.data.model().dof_armature()[self.dof];
        forces.passive[self.dof] -= inertia * (after.speed - before.speed) / at.timestep;
        next.copy_from_slice(&[1.0, after.s, after.speed, at.data.qvel()[self.dof]]);
    }

    fn load(
        &self,
        at: &At<'_>,
        acceleration: &dyn Fn(usize) -> f64,
        since_s: Option<f64>,
        next: &mut [f64],
    ) {
        let inertia = at.data.model().dof_armature()[self.dof];
        let (numbers, before) = (at.numbers, at.memory[1]);
        let through = self.torque(at.data) - inertia * acceleration(self.joint);
        let mut s = match self.joining {
            Joining::Stretch => numbers[0] * through,
            Joining::Play => 0.5 * numbers[0] * through.signum(),
        };
        let mut speed = 0.0;
        if let Some(since_s) = since_s {
            (s, speed) = (0.5 * (s + before), (s - before) / since_s);
            if self.joining == Joining::Stretch {
                // what damping has of the torque: 2 d √(J/c) s'
                s -= 2.0 * numbers[1] * (inertia * numbers[0]).sqrt() * speed;
            }
        }
        next.copy_from_slice(&[1.0, s, speed, at.data.qvel()[self.dof]]);
    }

    fn reads(&self, joint: usize) -> bool {
        joint == self.joint
    }

    fn encode(&self, at: &At<'_>, joint: usize, reading: &mut [f64; 2]) {
        if joint == self.joint {
            reading[0] += at.memory[1];
            reading[1] += at.memory[2];
        }
    }

    fn decode(&self, at: &At<'_>, joint: usize, reading: &mut [f64; 2]) {
        if joint == self.joint {
            reading[0] -= at.memory[1];
            reading[1] -= at.memory[2];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Motor;

    /// The closed forms against small steps of the equations themselves.
    #[test]
    fn closed_forms_solve_the_equations() {
        let (inertia, time, n) = (1e-3_f64, 0.02, 200_000);
        let dt = time / f64::from(n);
        for torque in [0.3, -0.1, 0.0] {
            let start = Motor {
                s: 0.002,
                speed: -0.4,
            };
            let (compliance, damping) = (0.01, 0.3);
            let mut fine = start;
            for _ in 0..n {
                let friction = 2.0 * damping * (inertia / compliance).sqrt() * fine.speed;
                fine.speed += dt * (torque - fine.s / compliance - friction) / inertia;
                fine.s += dt * fine.speed;
            }
            let exact = start.stretched(compliance, damping, inertia, torque, time);
            assert!(
                (exact.s - fine.s).abs() < 1e-6 && (exact.speed - fine.speed).abs() < 1e-4,
                "{exact:?} {fine:?}"
            );

            let half = 0.005;
            let mut fine = start;
            for _ in 0..n {
                fine.speed += dt * torque / inertia;
                fine.s += dt * fine.speed;
                if fine.s.abs() > half {
                    fine = Motor {
                        s: half.copysign(fine.s),
                        speed: 0.0,
                    };
                }
            }
            let exact = start.free(half, torque / inertia, time);
            assert!(
                (exact.s - fine.s).abs() < 1e-5 && (exact.speed - fine.speed).abs() < 2e-3,
                "{exact:?} {fine:?}"
            );
        }
    }

    #[test]
    fn a_motor_on_its_stop_leaves_it_and_lands_on_the_other() {
        let on = Motor {
            s: 0.01,
            speed: 0.0,
        };
        assert_eq!(on.free(0.01, 5.0, 1.0), on);
        let off = on.free(0.01, -5.0, 0.02);
        assert!((off.s - (0.01 - 0.001)).abs() < 1e-15 && (off.speed + 0.1).abs() < 1e-15);
        assert_eq!(
            on.free(0.01, -5.0, 1.0),
            Motor {
                s: -0.01,
                speed: 0.0
            }
        );
    }
}
