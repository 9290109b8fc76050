//! What many effects do, of trees that do not feel each other in one simulation.
//!
//! Every effect at every place costs a simulation of all windows. Three fingers that nothing connects answer to an effect
//! at one of them alone: one simulation has an effect at each, and every effect has the readings of its own part
//! ([`Partition`]). What parameters absorb ([`super::absorb`]) moves them all over the model, and is taken together
//! where that stays within a part as well.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::GapError;
use super::effect::{self, Effect, Place, PlaceKind};
use super::linear::{Column, Linear};
use super::screen::{At, Look};
use crate::mujoco::{Model, ObjectKind};
use crate::sysid::islands::{Partition, Shows, colours};
use crate::sysid::problem::Problem;

/// An effect of some size to be looked at.
pub(super) struct Ask {
    pub effect: &'static dyn Effect,
    pub place: Place,
    pub values: Vec<f64>,
    pub size: f64,
}

/// One ask with how far parameters move.
struct Asked<'a> {
    index: usize,
    ask: &'a Ask,
    dx: Vec<f64>,
}

/// With the parts in which all of that shows.
type Trial<'a> = (Asked<'a>, Shows);

impl Look<'_> {
    /// What each does in the windows `some`, per unit of its size, where the parameters absorb what they can of it;
    /// none where the model cannot say it. `watch` is told how many are done and stops it by `false`: then there is no
    /// result.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn ask(
        &self,
        asked: &[Ask],
        (linear, absorb): At<'_>,
        some: &[usize],
        watch: &mut dyn FnMut(usize) -> bool,
    ) -> Result<Option<Vec<Option<Column>>>, GapError> {
        let mut columns: Vec<Option<Column>> = asked.iter().map(|_| None).collect();
        let model = &self.windows.problem.model;
        let first = asked.iter().enumerate().map(|(index, ask)| {
            let dx = vec![0.0; self.x.len()];
            let shows = reached(model, &linear.partition, &ask.place);
            (Asked { index, ask, dx }, shows)
        });
        let mut again: Vec<Trial<'_>> = Vec::new();
        let mut done = 0;
        for groups in colours(first).chunks(at_once()) {
            if !watch(done) {
                return Ok(None);
            }
            done += groups.iter().map(Vec::len).sum::<usize>();
            for ((Asked { index, ask, .. }, shows), column) in
                self.simulate_all(groups, linear, some)?
            {
                let Some(column) = column else { continue };
                match absorb.moved(linear, &column, ask.size) {
                    Some(dx) => {
                        let shows = self.reached_by(&dx, &linear.partition, shows.clone());
                        let index = *index;
                        again.push((Asked { index, ask, dx }, shows));
                    }
                    None => columns[*index] = Some(column),
                }
            }
        }
        for groups in colours(again.into_iter()).chunks(at_once()) {
            if !watch(done) {
                return Ok(None);
            }
            for ((moved, _), column) in self.simulate_all(groups, linear, some)? {
                let size = moved.ask.size;
                columns[moved.index] = column.map(|c| c.without(linear, &moved.dx, size));
            }
        }
        Ok(Some(columns))
    }

    /// Each of these groups with its column, simulated side by side: what is done once a simulation, as writing the model, takes one
    /// core alone.
    fn simulate_all<'g, 'a>(
        &self,
        groups: &'g [Vec<Trial<'a>>],
        linear: &Linear,
        some: &[usize],
    ) -> Result<Vec<(&'g Trial<'a>, Option<Column>)>, GapError> {
        let found = groups
            .par_iter()
            .map(|group| self.simulate(group, linear, some));
        let found: Vec<_> = found.collect::<Result<_, _>>()?;
        Ok(groups
            .iter()
            .flatten()
            .zip(found.into_iter().flatten())
            .collect())
    }

    /// Where an effect in the parts `own` and a move of the parameters show.
    fn reached_by(&self, dx: &[f64], partition: &Partition, own: Shows) -> Shows {
        let mut all = own?;
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
        some: &[usize],
    ) -> Result<Vec<Option<Column>>, GapError> {
        let mut x = self.x.to_vec();
        let mut file = self.built.file.clone();
        let mut said = vec![false; group.len()];
        for ((Asked { ask, dx, .. }, _), said) in group.iter().zip(&mut said) {
            // what a place cannot carry is no candidate there
            let Ok(written) = effect::write(&file, ask.effect, &ask.place, &ask.values) else {
                continue;
            };
            (file, *said) = (written.file, true);
            for (x, d) in x.iter_mut().zip(dx) {
                *x += d;
            }
        }
        if !said.contains(&true) {
            return Ok(vec![None; group.len()]);
        }
        let problem = &self.windows.problem;
        let Ok(parameters) = problem.parameters_of(&file.model, &self.built.rules) else {
            return self.one_by_one(group, linear, some);
        };
        let with = Problem {
            model: file.model,
            parameters,
            ..problem.clone()
        };
        let held = self.windows.held(&with, &x);
        let quick = group.iter().any(|(own, _)| own.ask.effect.is_quick());
        let moved = linear.moved(&held, some, quick, &mut |point| point.simulate())?;
        if group.len() > 1 && some.iter().any(|w| moved[*w].is_none()) {
            return self.one_by_one(group, linear, some); // what diverges by one says nothing of the others
        }
        let column = |((own, shows), said): (&Trial<'_>, &bool)| {
            said.then(|| linear.part_of(&moved, own.ask.size, shows.as_ref()))
        };
        Ok(group.iter().zip(&said).map(column).collect())
    }

    /// The columns of a group that cannot be simulated as a whole.
    fn one_by_one(
        &self,
        group: &[Trial<'_>],
        linear: &Linear,
        some: &[usize],
    ) -> Result<Vec<Option<Column>>, GapError> {
        if group.len() == 1 {
            return Ok(vec![None]);
        }
        let mut columns = Vec::with_capacity(group.len());
        for trial in group.chunks(1) {
            columns.append(&mut self.simulate(trial, linear, some)?);
        }
        Ok(columns)
    }
}

/// Groups that are simulated side by side.
fn at_once() -> usize {
    4 * rayon::current_num_threads()
}

/// Parts in which an effect at a place shows; none: anywhere.
fn reached(model: &Model, partition: &Partition, place: &Place) -> Shows {
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
        let other = match place.kind {
            PlaceKind::Geom => Place::at(PlaceKind::Geom, other),
            _ => Place::at(PlaceKind::Joint, other),
        };
        bodies.push(other.body(model)?);
    }
    let all: BTreeSet<usize> = (bodies.iter())
        .flat_map(|b| &partition.bodies[*b])
        .copied()
        .collect();
    (!all.is_empty()).then_some(all)
}

#[cfg(test)]
mod tests {
    use super::Ask;
    use crate::gap::absorb::Absorb;
    use crate::gap::effect::write;
    use crate::gap::fit::information;
    use crate::gap::masses::{chosen, machine, searching_hammered};

    /// A motor on a spring, hammered by a command of which nothing is left in longer steps. How it swings when a window begins is
    /// not known.
    #[test]
    fn what_single_steps_show_is_asked_in_them() {
        let base = machine(r#"damping=".2" armature=".01""#, "");
        let law = chosen(&base, "transmission_compliance", "ma", &[4e-4, 0.3]);
        let hidden = write(&base, law.effect, &law.place, &law.values).expect("written");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching_hammered(&base, (&hidden.file, 3.0), config, |search, _| {
            assert!(search.windows.factors.iter().all(|f| *f > 1));
            let linear = search.windows.linearise(&search.x).expect("linear");
            let normal = information(&linear.rows, search.x.len());
            let absorb = Absorb::new(&normal, &search.windows.problem.parameters, &search.x);
            let ask = Ask {
                effect: law.effect,
                place: law.place.clone(),
                values: law.values.clone(),
                size: 1.0,
            };
            let look = search.look();
            let answer = look.ask(&[ask], (&linear, &absorb), &linear.all(), &mut |_| true);
            let columns = answer.expect("asked").expect("whole");
            let column = columns[0].as_ref().expect("can be said");
            let (mut before, mut after) = (0.0, 0.0);
            for (row, part) in linear.rows.iter().zip(&column.parts) {
                before += row.residual.norm_squared();
                after += (&row.residual + part).norm_squared();
            }
            assert!(after < 0.7 * before, "{after} of {before}");
        });
    }
}
