//! What many effects do, of trees that do not feel each other in one simulation.
//!
//! Every effect at every place costs a simulation of all windows. Three fingers that nothing connects answer to an effect
//! at one of them alone: one simulation has an effect at each, and every effect has the readings of its own part
//! ([`Partition`]). What parameters absorb ([`super::absorb`]) moves them all over the model, and is taken together
//! where that stays within a part as well.

use std::collections::BTreeSet;

use super::GapError;
use super::effect::{self, Effect, Place, PlaceKind};
use super::linear::{Column, Linear};
use super::screen::{At, Look};
use crate::mujoco::{Model, ObjectKind};
use crate::sysid::islands::Partition;
use crate::sysid::parameter::Parameters;
use crate::sysid::problem::Problem;

/// An effect of some size to be looked at in every `stride`-th window.
pub(super) struct Ask {
    pub effect: &'static dyn Effect,
    pub place: Place,
    pub values: Vec<f64>,
    pub size: f64,
    pub stride: usize,
}

/// One ask with how far parameters move, and the parts in which all of that shows; none: anywhere.
struct Trial<'a> {
    index: usize,
    ask: &'a Ask,
    dx: Vec<f64>,
    reached: Option<BTreeSet<usize>>,
}

impl Look<'_> {
    /// What each does, per unit of its size, where the parameters absorb what they can of it; none where the model cannot
    /// say it. `watch` is told how many are done and stops it by `false`: then there is no result.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn ask(
        &self,
        asked: &[Ask],
        (linear, absorb): At<'_>,
        watch: &mut dyn FnMut(usize) -> bool,
    ) -> Result<Option<Vec<Option<Column>>>, GapError> {
        let mut columns: Vec<Option<Column>> = asked.iter().map(|_| None).collect();
        let model = &self.windows.problem.model;
        let first = asked.iter().enumerate().map(|(index, ask)| Trial {
            index,
            ask,
            dx: vec![0.0; self.x.len()],
            reached: reached(model, &linear.partition, &ask.place),
        });
        let mut again = Vec::new();
        let mut done = 0;
        for group in groups(first) {
            if !watch(done) {
                return Ok(None);
            }
            done += group.len();
            for (trial, column) in group.iter().zip(self.simulate(&group, linear)?) {
                let Some(column) = column else { continue };
                match absorb.moved(linear, &column, trial.ask.size) {
                    Some(dx) => again.push(Trial {
                        index: trial.index,
                        ask: trial.ask,
                        reached: self.reached_by(&dx, &linear.partition, trial.reached.as_ref()),
                        dx,
                    }),
                    None => columns[trial.index] = Some(column),
                }
            }
        }
        for group in groups(again.into_iter()) {
            if !watch(done) {
                return Ok(None);
            }
            for (trial, column) in group.iter().zip(self.simulate(&group, linear)?) {
                let size = trial.ask.size;
                columns[trial.index] = column.map(|c| c.without(linear, &trial.dx, size));
            }
        }
        Ok(Some(columns))
    }

    /// Where an effect in the parts `own` and a move of the parameters show.
    fn reached_by(
        &self,
        dx: &[f64],
        partition: &Partition,
        own: Option<&BTreeSet<usize>>,
    ) -> Option<BTreeSet<usize>> {
        let mut all = own?.clone();
        let free = &self.windows.problem.parameters.free;
        for (i, _) in free.iter().zip(dx).filter(|(_, d)| **d != 0.0) {
            let parts = &partition.parameters[*i];
            if parts.is_empty() {
                return None;
            }
            all.extend(parts);
        }
        Some(all)
    }

    /// The columns of a group, from one simulation.
    fn simulate(
        &self,
        group: &[Trial<'_>],
        linear: &Linear,
    ) -> Result<Vec<Option<Column>>, GapError> {
        let mut x = self.x.to_vec();
        let mut file = self.built.file.clone();
        let mut said = vec![false; group.len()];
        for (trial, said) in group.iter().zip(&mut said) {
            let ask = trial.ask;
            // what a place cannot carry is no candidate there
            let Ok(written) = effect::write(&file, ask.effect, &ask.place, &ask.values) else {
                continue;
            };
            (file, *said) = (written.file, true);
            for (x, d) in x.iter_mut().zip(&trial.dx) {
                *x += d;
            }
        }
        let problem = &self.windows.problem;
        let names: Vec<String> = problem.channels.iter().map(|c| c.name.clone()).collect();
        let Ok(parameters) = Parameters::new(&file.model, &self.built.rules, &names) else {
            return self.one_by_one(group, linear);
        };
        let with = Problem {
            model: file.model,
            parameters,
            ..problem.clone()
        };
        let some: Vec<usize> = (0..linear.windows.len())
            .step_by(group[0].ask.stride)
            .collect();
        let held = self.windows.held(&with, &x);
        let moved = linear.moved(&held, &some, &mut |point| point.simulate())?;
        if group.len() > 1 && some.iter().any(|w| moved[*w].is_none()) {
            return self.one_by_one(group, linear); // what diverges by one says nothing of the others
        }
        let column = |(trial, said): (&Trial<'_>, &bool)| {
            said.then(|| linear.part_of(&moved, trial.ask.size, trial.reached.as_ref()))
        };
        Ok(group.iter().zip(&said).map(column).collect())
    }

    /// The columns of a group that cannot be simulated as a whole.
    fn one_by_one(
        &self,
        group: &[Trial<'_>],
        linear: &Linear,
    ) -> Result<Vec<Option<Column>>, GapError> {
        let mut columns = Vec::new();
        for trial in group.chunks(1) {
            columns.extend(match group {
                [_] => vec![None],
                _ => self.simulate(trial, linear)?,
            });
        }
        Ok(columns)
    }
}

/// Trials that share a simulation: of the same windows, and of different parts.
fn groups<'a>(trials: impl Iterator<Item = Trial<'a>>) -> Vec<Vec<Trial<'a>>> {
    let mut out: Vec<Vec<Trial<'a>>> = Vec::new();
    for trial in trials {
        let apart = |other: &Trial<'_>| match (&other.reached, &trial.reached) {
            (Some(a), Some(b)) => a.is_disjoint(b) && other.ask.stride == trial.ask.stride,
            _ => false,
        };
        match out.iter_mut().find(|group| group.iter().all(apart)) {
            Some(group) => group.push(trial),
            None => out.push(vec![trial]),
        }
    }
    out
}

/// Parts in which an effect at a place shows; none: anywhere.
fn reached(model: &Model, partition: &Partition, place: &Place) -> Option<BTreeSet<usize>> {
    let joint = |name: &str| {
        let joint = model.id(ObjectKind::Joint, name).ok()?;
        Some(model.jnt_bodyid()[joint] as usize)
    };
    let mut bodies: Vec<usize> = Vec::new();
    match place.kind {
        PlaceKind::World | PlaceKind::Sensor => return None,
        PlaceKind::Pair => {
            let pair = model.id(ObjectKind::Pair, &place.name).ok()?;
            for geom in [model.pair_geom1()[pair], model.pair_geom2()[pair]] {
                bodies.push(model.geom_bodyid()[geom as usize] as usize);
            }
        }
        _ => bodies.push(place.body(model)?),
    }
    if let Some(other) = &place.with {
        bodies.push(joint(other)?);
    }
    let all: BTreeSet<usize> = bodies
        .iter()
        .flat_map(|b| &partition.bodies[*b])
        .copied()
        .collect();
    (!all.is_empty()).then_some(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ask(place: Place, stride: usize) -> Ask {
        Ask {
            effect: effect::named("coulomb_friction").expect("an effect"),
            place,
            values: vec![0.1],
            size: 0.1,
            stride,
        }
    }

    #[test]
    fn what_shows_in_the_same_part_or_anywhere_is_simulated_alone() {
        let asks = [1, 1, 1, 2, 1].map(|stride| ask(Place::world(), stride));
        let parts: [Option<&[usize]>; 5] = [Some(&[0]), Some(&[1]), Some(&[0]), Some(&[2]), None];
        let trials = asks
            .iter()
            .zip(parts)
            .enumerate()
            .map(|(index, (ask, parts))| Trial {
                index,
                ask,
                dx: Vec::new(),
                reached: parts.map(|p| p.iter().copied().collect()),
            });
        let found: Vec<Vec<usize>> = (groups(trials).iter())
            .map(|g| g.iter().map(|t| t.index).collect())
            .collect();
        assert_eq!(found, [vec![0, 1], vec![2], vec![3], vec![4]]);
    }
}
