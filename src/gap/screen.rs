//! Every effect at every place: what it would explain.
//!
//! The motion is linearised once ([`super::linear`]); a candidate then costs one simulation of all windows for each
//! of its sizes, with the effect in the model and the first states as they are, shared with candidates of other parts
//! where it can be ([`super::together`]). Shapes that mean nothing without the effect are tried on their grid, those with
//! many values first on a part of the windows unless a size bends, periods by [`super::pulse`].

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};

use super::GapError;
use super::absorb::Absorb;
use super::candidate::{Candidate, Table, best_shape};
use super::effect::{self, Effect, ModelFile, Parameter, Place};
use super::fit::{gradient, information};
use super::inputs::is_wanted;
use super::linear::{Column, Linear, squares};
use super::model::{Built, Measured, Variant, variants};
use super::pulse::{self, Pulses};
use super::score::Normal;
use super::together::Ask;
use super::windows::Windows;
use nalgebra::{DMatrix, DVector};

/// More variants than this are first tried on a part of the windows.
const FEW: usize = 4;
/// That part: one window of so many in a row.
const PART: usize = 4;
/// An effect of whose columns others leave less cannot be seen: columns are linear to about a hundredth of their length.
pub(super) const LEAST_VISIBLE: f64 = 2e-4;
/// And of which they leave less is hardly seen, however much it does.
pub(super) const HARDLY_VISIBLE: f64 = 0.005;
/// Part of a column's squared length that first states must leave: less is rounding.
const LEFT: f64 = 1e-8;
/// How often columns are looked at again.
const LOOKS: usize = 2;

/// The table of all candidates.
pub(super) struct Screen {
    pub candidates: Vec<Candidate>,
    pub columns: Vec<Column>,
    pub normal: Normal,
    pub linear: Linear,
    /// squared length of what the motors do to each channel; none without motors
    pub motors: Option<Vec<f64>>,
}

/// The point that columns are taken at.
pub(super) type At<'a> = (&'a Linear, &'a Absorb);

/// A candidate's index with a variant and its columns.
type Looked = (usize, Variant, Vec<Column>);

/// What a screen looks at.
pub(super) struct Look<'a> {
    pub base: &'a ModelFile,
    pub built: &'a Built,
    pub windows: &'a Windows,
    pub x: &'a [f64],
    pub measured: &'a Measured,
    pub stretch_of: &'a [usize],
    /// names of the effects to look at; none: all
    pub only: &'a [String],
    /// effects and places that are in the model
    pub taken: Vec<(&'static str, Place)>,
}

impl Look<'_> {
    /// Tests every candidate; `watch` is told (done, of) and stops it by `false`: then there is no result.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn screen(
        &self,
        watch: &mut dyn FnMut(usize, usize) -> bool,
    ) -> Result<Option<Screen>, GapError> {
        let linear = self.windows.linearise(self.x)?;
        let parameters = &self.windows.problem.parameters;
        let prior: Vec<(f64, f64)> = parameters.prior_slopes(self.x).collect();
        let all: Vec<(&'static dyn Effect, Place)> = effect::candidates(&self.base.model)
            .into_iter()
            .filter(|(e, p)| self.may_act(*e, p) && p.may_touch(&self.base.model, &linear.contacts))
            .collect();
        let normal = with_priors(&linear, &prior);
        let absorb = Absorb::new(&normal.0, parameters, self.x);
        let at = (&linear, &absorb);
        let mut pulses: BTreeMap<usize, Pulses> = BTreeMap::new();
        let mut tried: Vec<(usize, Variant)> = Vec::new();
        let mut many: Vec<(usize, Variant)> = Vec::new();
        for (i, (effect, place)) in all.iter().enumerate() {
            if !watch(0, all.len()) {
                return Ok(None);
            }
            let scales = self.measured.scales(&self.built.file.model, place);
            let parameters = effect.about().parameters;
            let mut own = variants(parameters, &scales);
            if effect.periodic().is_some() {
                own = self.best_period(*effect, place, own, &linear, &mut pulses, &normal)?;
            }
            let list = if all_at_once(parameters, own.len()) {
                &mut tried
            } else {
                &mut many
            };
            list.extend(own.into_iter().map(|variant| (i, variant)));
        }
        let grids: BTreeSet<usize> = many.iter().map(|(i, _)| *i).collect();
        let n_many = many.len();
        let of = n_many + tried.len() + grids.len();
        let some = linear.telling(PART);
        let Some(looked) = self.columns(&all, many, at, &some, &mut |n| watch(n, of))? else {
            return Ok(None);
        };
        let rate = |i: usize, variant: &Variant, (gain, expected): (f64, &[f64])| {
            let (effect, place) = &all[i];
            let scales = self.measured.scales(&self.built.file.model, place);
            let parameters = effect.about().parameters;
            let sensible = variant.makes_sense(parameters, expected, &scales);
            (sensible, variant.worth(parameters, (gain, expected)))
        };
        tried.extend(best(looked, (&linear, &some), &prior, rate));
        tried.sort_by_key(|(i, _)| *i);
        let whole = linear.all();
        let Some(looked) = self.columns(&all, tried, at, &whole, &mut |n| watch(n_many + n, of))?
        else {
            return Ok(None);
        };
        let mut columns: Vec<Column> = Vec::new();
        let mut found: Vec<(usize, Variant, Vec<usize>)> = Vec::new();
        for (i, variant, own) in looked {
            let from = columns.len();
            columns.extend(own);
            found.push((i, variant, (from..columns.len()).collect()));
        }
        let mut normal = Normal::new(&linear.rows, &columns, self.stretch_of, &prior);
        let mut taken: Vec<f64> = (found.iter())
            .flat_map(|(_, variant, _)| variant.columns.iter().map(|c| c.0))
            .collect();
        for _ in 0..LOOKS {
            self.look_again(&all, &found, at, &normal, (&mut columns, &mut taken))?;
            normal = Normal::new(&linear.rows, &columns, self.stretch_of, &prior);
        }
        let motors = linear.motors(self.windows, self.x)?;
        let motors = motors.map(|m| linear.by_channel(&m.parts));
        let table = Table {
            model: &self.built.file.model,
            measured: self.measured,
            columns: &columns,
            normal: &normal,
            linear: &linear,
            motors: motors.as_deref(),
        };
        let mut shaped: BTreeMap<usize, Vec<Candidate>> = BTreeMap::new();
        for (i, variant, own) in found {
            let (effect, place) = &all[i];
            let candidate = table.candidate(*effect, place, variant, own);
            shaped.entry(i).or_default().push(candidate);
        }
        Ok(Some(Screen {
            candidates: shaped.into_values().filter_map(best_shape).collect(),
            columns,
            normal,
            linear,
            motors,
        }))
    }

    /// Whether an effect is worth a look: not there yet, and not a variety of friction where there is none.
    fn may_act(&self, effect: &dyn Effect, place: &Place) -> bool {
        let about = effect.about();
        // constant torques say where something is missing
        let wanted = is_wanted(self.only, about.name);
        if !wanted && about.name != "torque_offset" {
            return false;
        }
        if self
            .taken
            .iter()
            .any(|(n, p)| *n == about.name && p == place)
        {
            return false;
        }
        !about.is_variety() || place.is_dry(&self.built.file.model)
    }

    /// Columns of variants of which anything is left, in the windows `some`, and the parameters that they stand
    /// for; without variants that the model cannot say or of which nothing shows. `watch` is told how many are done;
    /// nothing if it stops.
    fn columns(
        &self,
        all: &[(&'static dyn Effect, Place)],
        tried: Vec<(usize, Variant)>,
        at: At<'_>,
        some: &[usize],
        watch: &mut dyn FnMut(usize) -> bool,
    ) -> Result<Option<Vec<Looked>>, GapError> {
        let (mut asked, mut variant_of) = (Vec::new(), Vec::new());
        for (v, (i, variant)) in tried.iter().enumerate() {
            let (effect, place) = &all[*i];
            for (size, values) in &variant.columns {
                variant_of.push(v);
                asked.push(Ask {
                    effect: *effect,
                    place: place.clone(),
                    values: values.clone(),
                    size: *size,
                });
            }
        }
        let mut done = |n: usize| watch(variant_of.get(n).map_or(tried.len(), |v| *v));
        let Some(answers) = self.ask(&asked, at, some, &mut done)? else {
            return Ok(None);
        };
        let mut answers = answers.into_iter();
        let mut out = Vec::new();
        for (i, variant) in tried {
            let own: Vec<Option<Column>> = answers.by_ref().take(variant.columns.len()).collect();
            if own.iter().any(Option::is_none) {
                continue;
            }
            let mut seen = Variant {
                columns: Vec::new(),
                parameters: Vec::new(),
            };
            let mut columns = Vec::new();
            let each = variant.columns.into_iter().zip(variant.parameters);
            for ((said, parameter), column) in each.zip(own.into_iter().flatten()) {
                let left = squares(&column.parts);
                if left > LEFT * column.raw && column.raw > 0.0 {
                    columns.push(column);
                    seen.columns.push(said);
                    seen.parameters.push(parameter);
                }
            }
            if !columns.is_empty() {
                out.push((i, seen, columns));
            }
        }
        Ok(Some(out))
    }

    /// The best period of many.
    fn best_period(
        &self,
        effect: &'static dyn Effect,
        place: &Place,
        tried: Vec<Variant>,
        linear: &Linear,
        pulses: &mut BTreeMap<usize, Pulses>,
        normal: &(DMatrix<f64>, DVector<f64>),
    ) -> Result<Vec<Variant>, GapError> {
        let model = &self.windows.problem.model;
        let (Some(kind), Some((joint, motor))) = (effect.periodic(), pulse::site(model, place))
        else {
            return Ok(tried);
        };
        if let Entry::Vacant(new) = pulses.entry(joint) {
            let held = self.windows.held(&self.windows.problem, self.x);
            let size = self.measured.scales(model, place).force;
            new.insert(Pulses::new(linear, &held, joint, size)?);
        }
        let period = |v: &Variant| v.columns[0].1.last().copied().unwrap_or_default();
        let grid: Vec<f64> = tried.iter().map(period).collect();
        let best = pulses[&joint].best(self.windows, self.x, kind, motor, &grid, normal);
        Ok(tried
            .into_iter()
            .filter(|v| best == Some(period(v)))
            .collect())
    }
}

/// The best variant of each candidate by the windows `some`, with all that it consists of, as `rate` does by what they
/// gain and the sizes that are expected of them.
fn best(
    looked: Vec<Looked>,
    (linear, some): (&Linear, &[usize]),
    prior: &[(f64, f64)],
    rate: impl Fn(usize, &Variant, (f64, &[f64])) -> (bool, f64),
) -> Vec<(usize, Variant)> {
    let rows: Vec<_> = some.iter().map(|w| linear.rows[*w].clone()).collect();
    let mut best: BTreeMap<usize, ((bool, f64), Variant)> = BTreeMap::new();
    for (i, variant, own) in looked {
        let parts: Vec<Column> = (own.iter())
            .map(|c| Column {
                parts: some.iter().map(|w| c.parts[*w].clone()).collect(),
                raw: c.raw,
            })
            .collect();
        let normal = Normal::new(&rows, &parts, &vec![0; rows.len()], prior);
        let rated = normal
            .gain(&(0..parts.len()).collect::<Vec<_>>())
            .map_or((false, 0.0), |(gain, expected)| {
                rate(i, &variant, (gain, &expected))
            });
        if best.get(&i).is_none_or(|(most, _)| rated > *most) {
            best.insert(i, (rated, variant));
        }
    }
    let each = best.into_iter();
    each.map(|(i, (_, variant))| (i, variant)).collect()
}

/// Σ J̃ᵀJ̃ of the parameters with their priors, and the gradient of the cost.
fn with_priors(linear: &Linear, prior: &[(f64, f64)]) -> (DMatrix<f64>, DVector<f64>) {
    let np = prior.len();
    let mut normal = information(&linear.rows, np);
    let residuals = linear.rows.iter().map(|row| &row.residual);
    let mut gradient = gradient(&linear.rows, residuals, np);
    for (j, (precision, own)) in prior.iter().enumerate() {
        normal[(j, j)] += precision;
        gradient[j] += own;
    }
    (normal, gradient)
}

/// Whether all `n` variants are tried in all windows: those of a size that bends swing otherwise each, which some windows
/// tell apart wrongly.
fn all_at_once(parameters: &[Parameter], n: usize) -> bool {
    n <= FEW || parameters.iter().any(Parameter::bends)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A drive of 0.0124 rad/(N m) was not found: of a quarter of the windows another value was best.
    #[test]
    fn drives_that_give_way_are_tried_in_all_windows() {
        let parameters_of = |name| {
            let effect = effect::named(name).expect("in the catalogue");
            effect.about().parameters
        };
        assert!(all_at_once(
            parameters_of("transmission_compliance"),
            2 * FEW
        ));
        assert!(!all_at_once(parameters_of("payload"), 2 * FEW));
        assert!(all_at_once(parameters_of("payload"), FEW));
    }
}
