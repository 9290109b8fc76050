//! Torques on joints.
//!
//! ```text
//! friction   -level(v, load) · clamp(z + τ v/s, -1, 1)      z' = v/s within [-1, 1]
//! ```
//!
//! Friction is an elastoplastic element: a bristle that bends over s, then slides. It sticks, has no chatter at any
//! step, and slides with exactly its level. τ damps it while it sticks.

use super::{Bound, Effect};
use crate::mujoco::Model;

/// Displacement at which the bristle slides: below the 0.2 mrad of an encoder step (m for slides).
const PRESLIDING: f64 = 1e-4;
/// Damping time of a sticking bristle, s.
const STICK_DAMPING_S: f64 = 1e-3;
/// Damping of a stop: time constant damping / stiffness, s.
const STOP_DAMPING_S: f64 = 0.002;

/// One law at one degree of freedom.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Term {
    dof: usize,
    qpos: usize,
    law: Law,
}

#[derive(Debug, Clone)]
enum Law {
    Viscous {
        damping: f64,
    },
    Friction {
        level: Level,
        bend: f64,
    },
    Drag {
        drag: f64,
    },
    Spring {
        stiffness: f64,
        rest: f64,
    },
    Cubic {
        stiffness: f64,
    },
    Coupling {
        stiffness: f64,
        other: usize,
    },
    Offset {
        torque: f64,
    },
    Cogging {
        amplitude: f64,
        per_turn: f64,
        phase: f64,
    },
    Stop {
        stiffness: f64,
        at: f64,
    },
}

#[derive(Debug, Clone, Copy)]
enum Level {
    Coulomb {
        torque: f64,
    },
    Asymmetric {
        forwards: f64,
        backwards: f64,
    },
    Stribeck {
        torque: f64,
        excess: f64,
        speed: f64,
    },
    Load {
        coefficient: f64,
    },
    Map {
        torque: f64,
        per_turn: f64,
    },
}

impl Level {
    fn at(self, position: f64, velocity: f64, load: f64) -> f64 {
        match self {
            Self::Coulomb { torque } => torque,
            Self::Asymmetric {
                forwards,
                backwards,
            } => {
                if velocity > 0.0 {
                    forwards
                } else {
                    backwards
                }
            }
            Self::Stribeck {
                torque,
                excess,
                speed,
            } => torque + excess * (-(velocity / speed).powi(2)).exp(),
            Self::Load { coefficient } => coefficient * load.abs(),
            Self::Map { torque, per_turn } => torque * (1.0 + (per_turn * position).sin()),
        }
    }
}

/// What a law sees of one inner step.
#[derive(Debug, Clone, Copy)]
pub(in crate::rig) struct Motion<'a> {
    pub(in crate::rig) qpos: &'a [f64],
    pub(in crate::rig) qvel: &'a [f64],
    /// motor torque at each degree of freedom in the last step
    pub(in crate::rig) load: &'a [f64],
    pub(in crate::rig) step_s: f64,
}

impl Term {
    /// Add the torque of this inner step to `torque` (nv).
    pub(in crate::rig) fn apply(&mut self, motion: Motion<'_>, torque: &mut [f64]) {
        let (q, v) = (motion.qpos[self.qpos], motion.qvel[self.dof]);
        torque[self.dof] += match &mut self.law {
            Law::Viscous { damping } => -*damping * v,
            Law::Friction { level, bend } => {
                let damped = *bend + STICK_DAMPING_S * v / PRESLIDING;
                *bend = (*bend + v * motion.step_s / PRESLIDING).clamp(-1.0, 1.0);
                -level.at(q, v, motion.load[self.dof]) * damped.clamp(-1.0, 1.0)
            }
            Law::Drag { drag } => -*drag * v * v.abs(),
            Law::Spring { stiffness, rest } => -*stiffness * (q - *rest),
            Law::Cubic { stiffness } => -*stiffness * q.powi(3),
            Law::Coupling { stiffness, other } => -*stiffness * (q - motion.qpos[*other]),
            Law::Offset { torque } => *torque,
            Law::Cogging {
                amplitude,
                per_turn,
                phase,
            } => *amplitude * (*per_turn * q + *phase).sin(),
            Law::Stop { stiffness, at } if q > *at => {
                // a stop pushes, it does not pull
                -(*stiffness * (q - *at + STOP_DAMPING_S * v)).max(0.0)
            }
            Law::Stop { .. } => 0.0,
        };
    }
}

/// The terms of the effects that are laws of joints.
///
/// # Errors
/// The reason why an effect does not fit a joint.
pub(in crate::rig) fn terms(model: &Model, bound: &Bound) -> Result<Vec<Term>, String> {
    let v = |i: usize| bound.values[i];
    let mut terms = Vec::new();
    for &joint in &bound.elements {
        let law = match bound.effect {
            Effect::ViscousFriction => Law::Viscous { damping: v(0) },
            Effect::CoulombFriction => friction(Level::Coulomb { torque: v(0) }),
            Effect::AsymmetricFriction => friction(Level::Asymmetric {
                // friction never drives
                forwards: (v(1) + v(0)).max(0.0),
                backwards: (v(1) - v(0)).max(0.0),
            }),
            Effect::StribeckFriction => {
                if v(2) <= 0.0 {
                    return Err("`speed_rad_s` must be above 0".to_owned());
                }
                friction(Level::Stribeck {
                    torque: v(1),
                    excess: v(0),
                    speed: v(2),
                })
            }
            Effect::LoadDependentFriction => friction(Level::Load { coefficient: v(0) }),
            Effect::QuadraticDrag => Law::Drag { drag: v(0) },
            Effect::JointSpring => Law::Spring {
                stiffness: v(0),
                rest: v(1),
            },
            Effect::FrictionMap => friction(Level::Map {
                torque: v(0),
                per_turn: v(1),
            }),
            Effect::CubicSpring => Law::Cubic { stiffness: v(0) },
            Effect::TorqueOffset => Law::Offset { torque: v(0) },
            Effect::Cogging => Law::Cogging {
                amplitude: v(0),
                per_turn: v(1),
                phase: v(2),
            },
            Effect::JointStop => Law::Stop {
                stiffness: v(0),
                at: v(1),
            },
            Effect::JointCoupling => {
                let partner = bound.partner.unwrap_or(joint);
                // the reaction on the partner is the same law seen from there
                terms.push(term(
                    model,
                    partner,
                    Law::Coupling {
                        stiffness: v(0),
                        other: model.jnt_qposadr()[joint] as usize,
                    },
                ));
                Law::Coupling {
                    stiffness: v(0),
                    other: model.jnt_qposadr()[partner] as usize,
                }
            }
            _ => return Ok(Vec::new()),
        };
        terms.push(term(model, joint, law));
    }
    Ok(terms)
}

fn friction(level: Level) -> Law {
    Law::Friction { level, bend: 0.0 }
}

fn term(model: &Model, joint: usize, law: Law) -> Term {
    Term {
        dof: model.jnt_dofadr()[joint] as usize,
        qpos: model.jnt_qposadr()[joint] as usize,
        law,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A block on a bristle, pulled: it must stay below its level, and slide with force - level above.
    fn pull(level: f64, force: impl Fn(f64) -> f64) -> (f64, f64) {
        let (mass, step_s) = (1.0, 5e-5);
        let mut term = Term {
            dof: 0,
            qpos: 0,
            law: friction(Level::Coulomb { torque: level }),
        };
        let (mut q, mut v) = (0.0, 0.0);
        for k in 0..20_000 {
            let mut torque = [force(f64::from(k) * step_s)];
            let motion = Motion {
                qpos: &[q],
                qvel: &[v],
                load: &[0.0],
                step_s,
            };
            term.apply(motion, &mut torque);
            v += step_s * torque[0] / mass;
            q += step_s * v;
        }
        (q, v)
    }

    #[test]
    fn friction_sticks_below_its_level_and_slides_above() {
        let (q, v) = pull(1.0, |time| 0.9 * time);
        assert!(q < PRESLIDING && v.abs() < 1e-3, "stuck: {q} {v}");
        // after 1 s: v = (F - level)/m t, less what the presliding took
        let (_, v) = pull(1.0, |_| 1.5);
        assert!((v - 0.5).abs() < 0.01, "slides: {v}");
    }
}
