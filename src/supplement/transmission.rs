//! Play and stretch between a motor and its joint.
//!
//! With q the joint, q + s the motor, J the joint's `armature` (the rotor's inertia) and τ the motor's torque,
//!
//! ```text
//! J (q'' + s'') = τ − t        joint: t        so the joint gets τ − J q'' − J s''
//! stretch    t = s/c + damping           play    t = 0 while |s| < p/2, s' = −0.45 s' at its ends
//! ```
//!
//! The engine has τ and J q''; the law adds −J s'', as its mean over the step. s is integrated exactly over a step in which
//! τ and q'' (as it was in the last one) are constant, so neither a stiff spring nor a light rotor makes it unstable.
//! Encoders sit on motors: they show q + s. Without rotor inertia s follows τ at once.
//!
//! The engine's own way, a second joint for the motor, would change the states of the model, and with them recordings,
//! policies and keyframes.
//!
//! A flank that gives way a little, with a relative damping of 0.3, and only pushes gives back exp(−(ζ/√(1−ζ²)) (π − φ)) of the speed,
//! tan φ = 2 ζ √(1−ζ²)/(1−2ζ²): 0.45. A motor under feedback rattles from flank to flank, and every flight begins with that speed.
//!
//! Where readings are at hand, of a recording, that rattling is in them: their quick part, without the joint's motion, swings by
//! the play. An error of a few percent in one flight is all of the next but two, so the motor is put where they show it,
//! at every step, and the law says where it is one step later:
//!
//! ```text
//! s ← ŝ = clamp(quick part),   s' ← s' + (ŝ − s)/h        while they swing by p/2 or more
//! ```
//!
//! as an observer does. Where it is foretold is what is compared with the next reading; what the joint gets is the motor's momentum
//! all the same.
//! Where a recorded motion is filtered, so that no rattling is left, the motor stays in the middle and passes on what it gets, as it does
//! in the mean.
//!
//! Memory: whether it has begun, or has just met a flank, s, s', and the joint's velocity one step ago, which says how it accelerates; not
//! where a flank had it jump. Where the motion of the motor θ = q + s was
//! measured it says how the transmission was loaded then, t = τ − J θ''.

use super::command::limited;
use super::law::{At, Built, Law};
use super::parse;
use crate::mujoco::{Data, Forces, Model, N_PRM, Swing};

/// Part of the speed that a flank gives back.
const REBOUND: f64 = 0.45;
/// Flights in a step.
const FLIGHTS: usize = 16;
/// Part of a step in which a motor that leaves a flank and is pushed back to it does not leave it at all.
const BRIEF: f64 = 0.01;
/// What the first number of memory is once the law has begun, where a flank was met in the last step, and where all that is known of a
/// motor is its mean.
const BEGUN: f64 = 1.0;
const MET: f64 = 2.0;
const RATTLES: f64 = -1.0;
/// Part of a play by which readings swing that show where a motor is.
const SHOWS: f64 = 0.5;

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

    /// Between stops at ±`half`, accelerated for `time`; and whether it met one.
    fn free(mut self, half: f64, acceleration: f64, mut time: f64) -> (Self, bool) {
        if half == 0.0 {
            return (Self { s: 0.0, speed: 0.0 }, false);
        }
        let (brief, mut met) = (BRIEF * time, false);
        for _ in 0..FLIGHTS {
            let (s, v, a) = (self.s, self.speed, acceleration);
            if v == 0.0 && s.abs() >= half && s * a >= 0.0 {
                let s = half.copysign(s);
                return (Self { s, speed: 0.0 }, met);
            }
            let meeting = first_meeting(s, v, a, half).filter(|(t, _)| *t < time);
            let Some((t, side)) = meeting else {
                let s = (s + (v + 0.5 * a * time) * time).clamp(-half, half);
                let speed = v + a * time;
                return (Self { s, speed }, met);
            };
            let speed = -REBOUND * (v + a * t);
            let flight = 2.0 * speed.abs() / (side * a).max(0.0);
            self = Self {
                s: side * half,
                speed: if flight < brief { 0.0 } else { speed },
            };
            time -= t;
            met = true;
        }
        (self, met)
    }

    /// Put to where readings show it, between stops at ±`half`, after it was foretold for a step of `time`.
    fn put(self, offset: f64, half: f64, time: f64) -> Self {
        let s = offset.clamp(-half, half);
        Self {
            s,
            speed: self.speed + (s - self.s) / time,
        }
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
        // the form that does not cancel; what moves away comes back if it is pushed
        let t = if u >= 0.0 {
            2.0 * gap / (u + root.sqrt())
        } else if b > 0.0 {
            (root.sqrt() - u) / b
        } else {
            continue;
        };
        // at rest on a flank: 0/0
        if t >= 0.0 && first.is_none_or(|(earlier, _)| t < earlier) {
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

    /// Where readings show the motor, if they do.
    fn shown(&self, data: &Data, play: f64) -> Option<Swing> {
        data.shown(self.joint).filter(|s| s.range >= SHOWS * play)
    }

    /// The motor at the beginning and at the end of the step, and what the first number of memory is then.
    fn step(&self, at: &At<'_>) -> ([Motor; 2], f64) {
        if at.memory[0] == RATTLES {
            return ([motor(at.memory); 2], RATTLES);
        }
        let (model, data) = (at.data.model(), at.data);
        let torque = self.torque(data);
        let inertia = model.dof_armature()[self.dof];
        let begun = at.memory[0] != 0.0;
        // a flank that was met had the joint jump
        let acceleration = if at.memory[0] == BEGUN {
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
                let after = before.stretched(n[0], n[1], inertia, drive, at.timestep);
                ([before, after], BEGUN)
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
                let shown = self.shown(data, n[0]).and_then(|swing| swing.offset);
                let from = shown.map_or(before, |offset| before.put(offset, half, at.timestep));
                let (after, met) = if inertia > 0.0 {
                    from.free(half, drive / inertia, at.timestep)
                } else {
                    let s = if torque == 0.0 { before.s } else { end };
                    (Motor { s, speed: 0.0 }, false)
                };
                ([before, after], if met { MET } else { BEGUN })
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
        let ([before, after], begun) = self.step(at);
        let inertia = at.data.model().dof_armature()[self.dof];
        forces.passive[self.dof] -= inertia * (after.speed - before.speed) / at.timestep;
        next.copy_from_slice(&[begun, after.s, after.speed, at.data.qvel()[self.dof]]);
    }

    fn load(
        &self,
        at: &At<'_>,
        acceleration: &dyn Fn(usize) -> f64,
        since_s: Option<f64>,
        next: &mut [f64],
    ) {
        let (numbers, before) = (at.numbers, at.memory[1]);
        let now = at.data.qvel()[self.dof];
        if self.joining == Joining::Play
            && let Some(swing) = self.shown(at.data, numbers[0])
        {
            let half = 0.5 * numbers[0];
            let shown = |offset: f64| (BEGUN, offset.clamp(-half, half));
            let (begun, s) = swing.offset.map_or((RATTLES, 0.0), shown);
            next.copy_from_slice(&[begun, s, 0.0, now]);
            return;
        }
        let inertia = at.data.model().dof_armature()[self.dof];
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
        next.copy_from_slice(&[BEGUN, s, speed, now]);
    }

    fn follows(&self, joint: usize) -> bool {
        self.joining == Joining::Play && joint == self.joint
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
    use super::{Motor, REBOUND};

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
                        speed: -REBOUND * fine.speed,
                    };
                }
            }
            let (exact, _) = start.free(half, torque / inertia, time);
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
        assert_eq!(on.free(0.01, 5.0, 1.0), (on, false));
        let (off, met) = on.free(0.01, -5.0, 0.02);
        assert!(!met);
        assert!((off.s - (0.01 - 0.001)).abs() < 1e-15 && (off.speed + 0.1).abs() < 1e-15);
        assert_eq!(
            on.free(0.01, -5.0, 1.0),
            (
                Motor {
                    s: -0.01,
                    speed: 0.0
                },
                true
            )
        );
    }
}
