//! Torsional friction: a moment about the contact's normal against spin.
//!
//! ```text
//! moment on body 2 = -c F_n clamp(ω_n/ω_0) n          body 1 gets the opposite
//! ```

use super::{Bound, kind};
use crate::mujoco::{Data, Model, MujocoError, ObjectKind};

/// Spin at which the moment is full, rad/s.
const FULL_SPIN: f64 = 0.1;

/// Torsional friction of some contacts.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Torsion {
    coefficient: f64,
    /// geoms whose contact has it; a second of `None`: with any other
    geoms: Vec<(usize, Option<usize>)>,
}

impl Torsion {
    pub(in crate::rig) fn new(model: &Model, bound: &Bound) -> Self {
        let pairs = kind(model, bound.effect.entry().place) == ObjectKind::Pair;
        let geoms = bound.elements.iter().map(|&id| {
            if pairs {
                let of = |geoms: &[i32]| geoms[id] as usize;
                (of(model.pair_geom1()), Some(of(model.pair_geom2())))
            } else {
                (id, None)
            }
        });
        Self {
            coefficient: bound.values[0],
            geoms: geoms.collect(),
        }
    }

    /// Add the moments that follow from the contacts of the last step to `xfrc_applied`.
    ///
    /// # Errors
    /// When the engine refuses.
    pub(in crate::rig) fn apply(&self, data: &mut Data) -> Result<(), MujocoError> {
        for i in 0..data.contacts().len() {
            let contact = &data.contacts()[i];
            let [a, b] = contact.geoms();
            if contact.efc_address().is_none() || !self.has(a, b) {
                continue;
            }
            let frame = contact.frame();
            let normal_force = data.contact_force(i)?[0];
            let body = |geom: usize| data.model().geom_bodyid()[geom] as usize;
            let (body_a, body_b) = (body(a), body(b));
            let spin: f64 = (0..3)
                .map(|k| frame[k] * (data.cvel()[6 * body_b + k] - data.cvel()[6 * body_a + k]))
                .sum();
            let moment = -self.coefficient * normal_force * (spin / FULL_SPIN).clamp(-1.0, 1.0);
            let xfrc = data.xfrc_applied_mut();
            for k in 0..3 {
                xfrc[6 * body_b + 3 + k] += moment * frame[k];
                xfrc[6 * body_a + 3 + k] -= moment * frame[k];
            }
        }
        Ok(())
    }

    fn has(&self, a: usize, b: usize) -> bool {
        self.geoms.iter().any(|&(first, second)| match second {
            Some(second) => (a, b) == (first, second) || (b, a) == (first, second),
            None => a == first || b == first,
        })
    }
}
