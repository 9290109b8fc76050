//! Friction against spinning about the normal of a contact.
//!
//! ```text
//! torque on the second geom's body = −c N tanh(ω/s) n        ω spin about the normal n, relative to the first
//! ```
//!
//! N is the normal force of a pair, or of all contacts of a geom, in the step before, shared evenly among the contacts. The engine's own torsional friction
//! (`condim` 4) adds edges to the friction pyramid, each of which also carries normal force: the contact gets stiffer by
//! half. With elliptic cones it has no such side effect and needs no supplement.
//!
//! Memory: N.

use super::law::{At, Built, Law};
use crate::mujoco::{Data, Forces, Model};

#[derive(Debug)]
struct Torsion {
    geom: usize,
    other: Option<usize>,
}

/// Of a contact pair, or of a geom: geoms are counted on behind the pairs.
pub(super) fn torsion(model: &Model, contact: usize) -> Built {
    let law = match contact.checked_sub(model.npair()) {
        Some(geom) => Torsion { geom, other: None },
        None => Torsion {
            geom: model.pair_geom1()[contact] as usize,
            other: Some(model.pair_geom2()[contact] as usize),
        },
    };
    Ok(Box::new(law))
}

impl Torsion {
    /// The contacts that make forces: indices.
    fn contacts<'a>(&'a self, data: &'a Data) -> impl Iterator<Item = usize> + 'a {
        let ours = move |[a, b]: [usize; 2]| {
            let with = |geom: usize| self.other.is_none_or(|other| other == geom);
            (a == self.geom && with(b)) || (b == self.geom && with(a))
        };
        let all = data.contacts().iter().enumerate();
        all.filter(move |(_, c)| ours(c.geoms()) && c.efc_address().is_some())
            .map(|(i, _)| i)
    }
}

impl Law for Torsion {
    fn memory_len(&self, _timestep: f64) -> usize {
        1
    }

    fn force(&self, at: &At<'_>, forces: &mut Forces, _next: &mut [f64]) {
        let (coefficient, speed, data) = (at.numbers[0], at.numbers[1], at.data);
        let share = at.memory[0] / self.contacts(data).count().max(1) as f64;
        if coefficient == 0.0 || share == 0.0 {
            return;
        }
        for i in self.contacts(data) {
            let contact = &data.contacts()[i];
            let normal = contact.frame();
            let [first, second] = contact
                .geoms()
                .map(|geom| data.model().geom_bodyid()[geom] as usize);
            let turn = |body: usize, k: usize| data.cvel()[6 * body + k];
            let spin: f64 = (0..3)
                .map(|k| normal[k] * (turn(second, k) - turn(first, k)))
                .sum();
            let torque = -coefficient * share * (spin / speed).tanh();
            for (k, n) in normal[..3].iter().enumerate() {
                forces.torque[3 * second + k] += torque * n;
                forces.torque[3 * first + k] -= torque * n;
            }
        }
    }

    fn settle(&self, data: &Data, next: &mut [f64]) {
        let normal = |i: usize| data.contact_force(i).map_or(0.0, |force| force[0]);
        next[0] = self.contacts(data).map(normal).sum();
    }
}
