//! Parts of a model that nothing connects in a trial.
//!
//! Trees that no contact, tendon, equality, actuator or sensor joins have residuals of their own: the trajectory's
//! band falls into blocks, each with the parameters that reach it. Each is eliminated apart, which costs (Σ nᵢ)³ less
//! than one of n = Σ nᵢ; and in finite differences columns of different parts are changed at once, as in colouring a
//! sparse Jacobian. Parts that no parameter reaches are idle: an object at rest beside the machine tells nothing, and is
//! left where it was measured.
//!
//! Reference: Curtis, Powell and Reid 1974, "On the estimation of sparse Jacobian matrices".

use std::collections::BTreeSet;

use super::manifold;
use super::parameter::{Instrument, Role};
use super::problem::Problem;
use super::reach::{Contacts, Reach, Trees};
use crate::mjcf::glob;
use crate::mujoco::{Model, ObjectKind};

/// One part.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Island {
    /// degrees of freedom, rising
    pub dofs: Vec<usize>,
    /// channels that depend on them
    pub channels: Vec<usize>,
    /// free parameters that reach them
    pub parameters: Vec<usize>,
    /// places in `dofs` at which the rotation of a ball or free joint begins
    pub rotations: Vec<usize>,
}

impl Island {
    /// Columns of a row: q₋, q, q₊, x, value.
    pub(super) fn width(&self) -> usize {
        3 * self.dofs.len() + self.parameters.len() + 1
    }

    /// Forces, then channels.
    pub(super) fn n_rows(&self) -> usize {
        self.dofs.len() + self.channels.len()
    }
}

/// The parts of one trial.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Islands {
    /// those that parameters reach; all, if none is
    pub parts: Vec<Island>,
    /// degrees of freedom of the others
    pub idle: Vec<usize>,
    /// free parameters in groups that no part shares
    pub colours: Vec<Vec<usize>>,
    /// pairs of geoms that touch somewhere
    pub contacts: Contacts,
}

/// What belongs together, by the name of its part: the first of its trees.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Partition {
    /// of each degree of freedom
    pub dofs: Vec<usize>,
    /// of each channel; none: it depends on no tree
    pub channels: Vec<Option<usize>>,
    /// parts that each parameter, free or not, reaches
    pub parameters: Vec<BTreeSet<usize>>,
    /// parts that have an actuator
    pub driven: BTreeSet<usize>,
    /// parts that feel a change of each body
    pub bodies: Vec<BTreeSet<usize>>,
}

impl Partition {
    /// Where `contacts` are all pairs of geoms that touch.
    pub(crate) fn new(problem: &Problem, contacts: &Contacts) -> Self {
        let model = &*problem.model;
        let reach = Reach::new(model, contacts);
        let channels: Vec<Trees> = (problem.channels.iter())
            .map(|c| channel(model, &reach, c.source))
            .collect();
        let part_of = joined(reach.len(), reach.tied().iter().chain(&channels));
        let parameters = problem.parameters.all.iter().map(|p| {
            let trees = reached(problem, &reach, &channels, &p.role);
            trees.iter().map(|t| part_of[*t]).collect()
        });
        Self {
            bodies: (0..model.nbody())
                .map(|b| reach.changed(b).iter().map(|t| part_of[*t]).collect())
                .collect(),
            driven: (0..model.nu())
                .flat_map(|a| reach.actuator(a))
                .map(|tree| part_of[tree])
                .collect(),
            dofs: (0..model.nv()).map(|d| part_of[reach.of_dof(d)]).collect(),
            parameters: parameters.collect(),
            channels: (channels.iter())
                .map(|trees| trees.first().map(|t| part_of[*t]))
                .collect(),
        }
    }
}

impl Islands {
    /// Where `contacts` are all pairs of geoms that touch.
    pub(super) fn new(problem: &Problem, contacts: Contacts) -> Self {
        let partition = Partition::new(problem, &contacts);
        let names: BTreeSet<usize> = partition.dofs.iter().copied().collect();
        let some: BTreeSet<usize> = partition.parameters.iter().flatten().copied().collect();
        let is_idle = |island: usize| !some.is_empty() && !some.contains(&island);
        let rotations = manifold::rotations(&problem.model);
        let mut parts = Vec::new();
        let mut idle = Vec::new();
        for name in names {
            let dofs: Vec<usize> = (0..partition.dofs.len())
                .filter(|d| partition.dofs[*d] == name)
                .collect();
            if is_idle(name) {
                idle.extend(dofs);
                continue;
            }
            let free = problem.parameters.free.iter().enumerate();
            parts.push(Island {
                channels: (0..partition.channels.len())
                    .filter(|c| partition.channels[*c] == Some(name))
                    .collect(),
                parameters: free
                    .filter(|(_, i)| partition.parameters[**i].contains(&name))
                    .map(|(j, _)| j)
                    .collect(),
                rotations: (rotations.iter())
                    .filter_map(|r| dofs.iter().position(|d| d == r))
                    .collect(),
                dofs,
            });
        }
        idle.sort_unstable();
        let acting = (problem.parameters.free.iter().enumerate())
            .filter(|(_, i)| problem.parameters.all[**i].role.acts())
            .map(|(j, i)| (j, Some(partition.parameters[*i].clone())));
        let names = |group: Vec<(usize, Shows)>| group.into_iter().map(|(j, _)| j).collect();
        Self {
            colours: colours(acting).into_iter().map(names).collect(),
            parts,
            idle,
            contacts,
        }
    }

    /// Whether there are contacts of which parameters say something.
    pub(super) fn is_touching(&self, model: &Model) -> bool {
        (self.contacts.iter()).any(|geoms| self.matters(model, *geoms))
    }

    /// Whether bodies of which parameters say something touch.
    pub(super) fn matters(&self, model: &Model, geoms: [usize; 2]) -> bool {
        geoms.iter().any(|g| {
            let body = model.geom_bodyid()[*g] as usize;
            let mut at = body;
            while at > 0 && model.body_dofnum()[at] == 0 {
                at = model.body_parentid()[at] as usize;
            }
            at > 0 && !self.idle.contains(&(model.body_dofadr()[at] as usize))
        })
    }
}

/// Which island each of `n` trees, or whatever is tied, belongs to, where each set of `ties` joins its members.
pub(super) fn joined<'a>(n: usize, ties: impl Iterator<Item = &'a Trees>) -> Vec<usize> {
    let mut of: Vec<usize> = (0..n).collect();
    for tie in ties {
        let Some(into) = tie.iter().map(|t| of[*t]).min() else {
            continue;
        };
        let from: BTreeSet<usize> = tie.iter().map(|t| of[*t]).collect();
        for island in &mut of {
            if from.contains(island) {
                *island = into;
            }
        }
    }
    of
}

/// Trees on which number `source` of (sensordata, qpos, qvel) depends.
fn channel(model: &Model, reach: &Reach, source: usize) -> Trees {
    let (n_sensordata, nq) = (model.nsensordata(), model.nq());
    // the last element that begins at or before a number
    let owner = |starts: &[i32], at: usize| {
        starts
            .iter()
            .rposition(|s| *s as usize <= at)
            .unwrap_or_default()
    };
    let dof = if source < n_sensordata {
        return reach.sensor(owner(model.sensor_adr(), source));
    } else if source < n_sensordata + nq {
        let joint = owner(model.jnt_qposadr(), source - n_sensordata);
        model.jnt_dofadr()[joint] as usize
    } else {
        source - n_sensordata - nq
    };
    Trees::from([reach.of_dof(dof)])
}

/// Trees that a parameter acts upon.
fn reached(problem: &Problem, reach: &Reach, channels: &[Trees], role: &Role) -> Trees {
    match role {
        Role::Model(targets) => targets.iter().flat_map(|(t, _)| reach.target(t)).collect(),
        Role::Instrument(Instrument::CommandDelay, pattern) => (0..problem.model.nu())
            .filter(|a| {
                let name = problem.model.name(ObjectKind::Actuator, *a);
                glob::matches(pattern, name.unwrap_or_default())
            })
            .flat_map(|a| reach.actuator(a))
            .collect(),
        Role::Instrument(_, pattern) => (problem.channels.iter().zip(channels))
            .filter(|(c, _)| glob::matches(pattern, &c.name))
            .flat_map(|(_, trees)| trees.iter().copied())
            .collect(),
    }
}

/// Parts in which something shows; none: anywhere.
pub(crate) type Shows = Option<BTreeSet<usize>>;

/// Whether what shows in the parts `shows` shows in `part`, if that is one.
pub(crate) fn is_shown(shows: Option<&BTreeSet<usize>>, part: Option<usize>) -> bool {
    shows.is_none_or(|parts| part.is_some_and(|p| parts.contains(&p)))
}

/// Groups of which no part has two members, so that these can be changed at once; what shows nowhere is in none.
pub(crate) fn colours<T>(all: impl Iterator<Item = (T, Shows)>) -> Vec<Vec<(T, Shows)>> {
    let mut groups: Vec<Vec<(T, Shows)>> = Vec::new();
    for (own, shows) in all.filter(|(_, shows)| shows.as_ref().is_none_or(|s| !s.is_empty())) {
        let apart = |(_, other): &(T, Shows)| match (other, &shows) {
            (Some(a), Some(b)) => a.is_disjoint(b),
            _ => false,
        };
        match groups.iter_mut().find(|group| group.iter().all(apart)) {
            Some(group) => group.push((own, shows)),
            None => groups.push(vec![(own, shows)]),
        }
    }
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_shows_in_different_parts_is_changed_at_once() {
        let set = |parts: &[usize]| Some(parts.iter().copied().collect::<BTreeSet<_>>());
        let all = [
            (0, set(&[0])),
            (1, set(&[0])),
            (2, set(&[1])),
            (3, set(&[])),
            (4, None),
            (5, set(&[1, 2])),
        ];
        let found: Vec<Vec<usize>> = colours(all.into_iter())
            .into_iter()
            .map(|g| g.into_iter().map(|u| u.0).collect())
            .collect();
        assert_eq!(found, [vec![0, 2], vec![1, 5], vec![4]]);
    }
}
