//! Dry friction whose level changes with speed, direction or load.
//!
//! ```text
//! stribeck         level = c + e exp(−(v/s)²)
//! load dependent   level = c + μ |τ|          τ = qfrc_actuator of the joint
//! asymmetric       −(c + a) forwards, c − a backwards, anything between at rest
//! ```
//!
//! c is the joint's `frictionloss`, which must be above 0: the engine then has a constraint row for the joint, and it is
//! the bound of this row that the law moves, down to 0 at most. So sticking and stability at any level are the engine's,
//! and forward and inverse dynamics agree. A law of several terms on one joint is their sum.
//!
//! Friction that differs with direction is what an interval of forces around another middle than 0 is: with f± = max(c ± a, 0) a
//! level of (f₊ + f₋)/2 beside a force of −(f₊ − f₋)/2.

use super::law::{At, Built, Law};
use crate::mujoco::{Forces, Model};

#[derive(Debug, Clone, Copy)]
enum Level {
    Asymmetric,
    Stribeck,
    Load,
}

#[derive(Debug)]
struct Friction {
    dof: usize,
    level: Level,
}

fn friction(model: &Model, joint: usize, level: Level) -> Built {
    let dof = model.jnt_dofadr()[joint] as usize;
    if model.dof_frictionloss()[dof] > 0.0 {
        Ok(Box::new(Friction { dof, level }))
    } else {
        Err(
            "the joint has no frictionloss, whose level this changes; give it one above 0"
                .to_owned(),
        )
    }
}

pub(super) fn asymmetric(model: &Model, joint: usize) -> Built {
    friction(model, joint, Level::Asymmetric)
}

pub(super) fn stribeck(model: &Model, joint: usize) -> Built {
    friction(model, joint, Level::Stribeck)
}

pub(super) fn load_dependent(model: &Model, joint: usize) -> Built {
    friction(model, joint, Level::Load)
}

impl Law for Friction {
    fn force(&self, at: &At<'_>, forces: &mut Forces, _next: &mut [f64]) {
        let v = at.data.qvel()[self.dof];
        forces.friction[self.dof] += match (self.level, at.numbers) {
            (Level::Asymmetric, [a, ..]) => {
                let c = at.data.model().dof_frictionloss()[self.dof];
                let (forwards, backwards) = ((c + a).max(0.0), (c - a).max(0.0));
                forces.passive[self.dof] -= 0.5 * (forwards - backwards);
                0.5 * (forwards + backwards) - c
            }
            (Level::Stribeck, [e, s, ..]) => e * (-(v / s).powi(2)).exp(),
            (_, numbers) => numbers[0] * at.data.qfrc_actuator()[self.dof].abs(),
        };
    }
}
