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
use crate::sysid::islands::{Partition, Shows, colours};

/// Windows with the same parts.
pub(super) struct Class {
    pub partition: Partition,
    /// rising
    pub windows: Vec<usize>,
}

/// An unknown and where it shows.
pub(super) type Unknown = (usize, Shows);

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
        let acting =
            (parameters.free.iter().enumerate()).filter(|(_, i)| parameters.all[**i].role.acts());
        colours(acting.map(|(j, i)| {
            let reached = &class.partition.parameters[*i];
            (n_state + j, (!reached.is_empty()).then(|| reached.clone()))
        }))
    }

    /// Groups of unknowns of the first state of window `w`.
    pub(super) fn state_groups(&self, class: &Class, w: usize) -> Vec<Vec<Unknown>> {
        let (nv, of_dof) = (self.problem.model.nv(), &class.partition.dofs);
        colours((0..self.n_state()).map(|j| {
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
