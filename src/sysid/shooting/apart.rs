//! Unknowns that finite differences change at once.
//!
//! Trees that do not feel each other while a window lasts answer to changes of their own unknowns only: one simulation
//! serves an unknown of each part, as in colouring a sparse Jacobian. What touches differs from window to window, and so
//! do the parts ([`Partition`]).
//!
//! Reference: Curtis, Powell and Reid 1974, "On the estimation of sparse Jacobian matrices".

use std::collections::{BTreeMap, BTreeSet};

use super::columns::Point;
use super::simulate::Simulated;
use crate::sysid::islands::Partition;
use crate::sysid::parameter::{Instrument, Role};

/// Windows with the same parts.
pub(super) struct Class {
    pub partition: Partition,
    /// rising
    pub windows: Vec<usize>,
}

/// An unknown and where it shows; none: anywhere.
pub(super) type Unknown = (usize, Option<BTreeSet<usize>>);

impl Point<'_> {
    /// All windows by their parts, where the simulations are `base`.
    pub(super) fn classes(&self, base: &[Simulated]) -> Vec<Class> {
        let mut known = BTreeMap::new();
        let mut classes: Vec<Class> = Vec::new();
        for (w, simulated) in base.iter().enumerate() {
            let class = *known.entry(&simulated.contacts).or_insert_with(|| {
                let partition = Partition::new(self.problem, &simulated.contacts);
                let same = classes.iter().position(|c| c.partition == partition);
                same.unwrap_or_else(|| {
                    classes.push(Class {
                        partition,
                        windows: Vec::new(),
                    });
                    classes.len() - 1
                })
            });
            classes[class].windows.push(w);
        }
        classes
    }

    /// Groups of parameters, counted after the states, that need a simulation.
    pub(super) fn parameter_groups(&self, class: &Class) -> Vec<Vec<Unknown>> {
        let parameters = &self.problem.parameters;
        let n_state = self.n_state();
        let moving = parameters.free.iter().enumerate().filter(|(_, i)| {
            // what the sensors make of the motion needs none
            !matches!(
                parameters.all[**i].role,
                Role::Instrument(Instrument::Bias | Instrument::Gain | Instrument::Delay, _)
            )
        });
        groups(moving.map(|(j, i)| {
            let reached = &class.partition.parameters[*i];
            (n_state + j, (!reached.is_empty()).then(|| reached.clone()))
        }))
    }

    /// Groups of unknowns of the first state of window `w`.
    pub(super) fn state_groups(&self, class: &Class, w: usize) -> Vec<Vec<Unknown>> {
        let (nv, of_dof) = (self.problem.model.nv(), &class.partition.dofs);
        groups((0..self.n_state()).map(|j| {
            let reached = match self.directions.get(w) {
                Some(directions) => (directions.column(j).iter().enumerate())
                    .filter(|(_, d)| **d != 0.0)
                    .map(|(i, _)| of_dof[i % nv])
                    .collect(),
                None => BTreeSet::from([of_dof[j % nv]]),
            };
            (j, Some(reached))
        }))
    }
}

/// Unknowns in groups that share no part; those that reach none are left out.
fn groups(unknowns: impl Iterator<Item = Unknown>) -> Vec<Vec<Unknown>> {
    let mut out: Vec<Vec<Unknown>> = Vec::new();
    for (j, reached) in unknowns {
        let Some(own) = &reached else {
            out.push(vec![(j, None)]);
            continue;
        };
        if own.is_empty() {
            continue;
        }
        let apart = |u: &Unknown| u.1.as_ref().is_some_and(|other| other.is_disjoint(own));
        match out.iter_mut().find(|group| group.iter().all(apart)) {
            Some(group) => group.push((j, reached)),
            None => out.push(vec![(j, reached)]),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknowns_of_different_parts_share_a_simulation() {
        let set = |parts: &[usize]| Some(parts.iter().copied().collect::<BTreeSet<_>>());
        let unknowns = [
            (0, set(&[0])),
            (1, set(&[0])),
            (2, set(&[1])),
            (3, set(&[])),
            (4, None),
            (5, set(&[1, 2])),
        ];
        let found: Vec<Vec<usize>> = groups(unknowns.into_iter())
            .into_iter()
            .map(|g| g.into_iter().map(|u| u.0).collect())
            .collect();
        assert_eq!(found, [vec![0, 2], vec![1, 5], vec![4]]);
    }
}
