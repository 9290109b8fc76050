//! Every effect at every place: what it would take off the cost, the other numbers following.
//!
//! A column c is what an effect of the usual size does to all bins, over that size. With slopes B of the model's numbers,
//! priors P and weights W,
//!
//! ```text
//! c⊥ = c − B (BᵀWB + P)⁻¹ BᵀWc        expected size = −c⊥ᵀWr / cᵀWc⊥        gain = F(r) − F(r + size · c⊥)
//! ```

use std::sync::Arc;

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use rayon::prelude::*;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::judge::Judge;
use super::refit::Fitted;
use crate::gap::effect::{self, Effect, Place};
use crate::gap::inputs::is_wanted;
use crate::gap::model::{Chosen, Variant, variants};
use crate::gap::{GapError, Stage, Watch};
use crate::sysid::nudging::Ensemble;

/// Candidates that are simulated between two looks at whether to go on.
const BATCH: usize = 8;
/// Simulations of a column: of all candidates, and of those that promise most.
const ROUGH: usize = 1;
const FINE: usize = 4;
/// How many these are.
const AGAIN: usize = 24;
/// Variants of a candidate, at most.
const FEW: usize = 3;
/// Part of a column that the model's numbers must leave.
pub(super) const LEAST_VISIBLE: f64 = 0.005;
/// How often weights follow what an effect takes off.
const WEIGHINGS: usize = 3;

/// An effect at a place with what it would do.
pub(super) struct Candidate {
    /// as it was looked at
    asked: Asked,
    /// what each of its sizes does to all bins, over the size
    columns: Arc<[DVector<f64>]>,
    /// expected values
    pub values: Vec<f64>,
    /// expected fall of the cost
    pub gain: f64,
    /// that by chance, alone
    pub p_value: f64,
    /// part of the column that the model's numbers leave
    pub visible: f64,
    /// whether the expected values make sense
    pub sensible: bool,
}

impl Candidate {
    pub(super) fn chosen(&self) -> Chosen {
        self.asked.with(self.values.clone())
    }

    pub(super) fn effect(&self) -> &'static dyn Effect {
        self.asked.effect
    }

    pub(super) fn place(&self) -> &Place {
        &self.asked.place
    }
}

/// Chance that a fall of the cost by `fall` comes of `numbers` numbers that do nothing.
pub(super) fn chance(fall: f64, numbers: usize) -> f64 {
    ChiSquared::new(numbers.max(1) as f64).map_or(1.0, |d| d.sf(2.0 * fall.max(0.0)))
}

/// The numbers that follow.
struct Follow<'j> {
    weights: DVector<f64>,
    /// whitened
    r: DVector<f64>,
    slopes: DMatrix<f64>,
    factor: Cholesky<f64, Dyn>,
    judge: &'j Judge<'j>,
    mean: &'j DVector<f64>,
}

/// What is expected of columns.
struct Expected {
    sizes: Vec<f64>,
    gain: f64,
    visible: f64,
}

impl<'j> Follow<'j> {
    fn new(judge: &'j Judge<'j>, present: &'j Fitted) -> Option<Self> {
        let mean = &present.ensemble.mean;
        let normal = present.quadratic(judge).normal;
        let slopes = present.ensemble.slopes.whitened(&present.weights(judge));
        let weights = judge.course.weights(mean.as_slice());
        Some(Self {
            r: mean.component_mul(&weights),
            weights,
            slopes,
            factor: normal.cholesky()?,
            judge,
            mean,
        })
    }

    /// What the model's numbers leave of a whitened column.
    fn left(&self, column: &DVector<f64>) -> DVector<f64> {
        column - &self.slopes * self.factor.solve(&self.slopes.tr_mul(column))
    }

    fn expected(&self, columns: &[DVector<f64>]) -> Option<Expected> {
        let whole: Vec<DVector<f64>> = columns
            .iter()
            .map(|c| c.component_mul(&self.weights))
            .collect();
        let left: Vec<DVector<f64>> = whole.iter().map(|c| self.left(c)).collect();
        let n = columns.len();
        let total: f64 = whole.iter().map(DVector::norm_squared).sum();
        let seen: f64 = (0..n).map(|i| whole[i].dot(&left[i])).sum();
        if total.is_nan() || total <= 0.0 {
            return None;
        }
        let cost = |r: &DVector<f64>| self.judge.course.misfit(r.as_slice());
        let mut sizes = DVector::zeros(n);
        // weights by what is left, from the second time on
        let mut more = DVector::from_element(self.r.len(), 1.0);
        for _ in 0..WEIGHINGS {
            let normal = DMatrix::from_fn(n, n, |i, j| whole[i].component_mul(&more).dot(&left[j]));
            let right = DVector::from_fn(n, |i, _| -left[i].component_mul(&more).dot(&self.r));
            sizes = normal.lu().solve(&right)?;
            let after = self.after(&left, &sizes);
            let weights = self.judge.course.weights(after.as_slice());
            more = weights
                .component_div(&self.weights)
                .map(|ratio| ratio * ratio);
        }
        let gain = cost(self.mean) - cost(&self.after(&left, &sizes));
        Some(Expected {
            sizes: sizes.as_slice().to_vec(),
            gain,
            visible: seen / total,
        })
    }

    /// Mean deviations with effects of these sizes.
    fn after(&self, left: &[DVector<f64>], sizes: &DVector<f64>) -> DVector<f64> {
        let mut after = self.mean.clone();
        for (c, size) in left.iter().zip(sizes.iter()) {
            after += c.component_div(&self.weights) * *size;
        }
        after
    }
}

/// Every candidate beside the base model, the most promising first, by its best variant; `only` names those to look for, or
/// is empty.
///
/// # Errors
/// [`GapError::Stopped`].
pub(super) fn screen(
    judge: &Judge<'_>,
    base: &Fitted,
    only: &[String],
    watch: &mut Watch<'_>,
) -> Result<Vec<Candidate>, GapError> {
    watch.stage(Stage::Screen);
    let looked = columns(judge, base, &asked(judge, only), ROUGH, watch)?;
    let all = rate(judge, base, looked);
    best_again(judge, base, all, watch)
}

/// Candidates beside a model with effects, by the columns that they had before.
///
/// # Errors
/// [`GapError::Stopped`].
pub(super) fn beside(
    judge: &Judge<'_>,
    present: &Fitted,
    known: &[Candidate],
    watch: &mut Watch<'_>,
) -> Result<Vec<Candidate>, GapError> {
    watch.stage(Stage::Screen);
    let taken = |c: &Candidate| {
        let mut written = present.point.written.iter();
        written.any(|w| c.asked.is(w.effect, &w.place))
    };
    let left: Vec<&Candidate> = known.iter().filter(|c| !taken(c)).collect();
    let all = again(judge, present, &left);
    best_again(judge, present, all, watch)
}

/// The same, with those that promise most simulated again in the size that is expected of them.
fn best_again(
    judge: &Judge<'_>,
    present: &Fitted,
    mut all: Vec<Candidate>,
    watch: &mut Watch<'_>,
) -> Result<Vec<Candidate>, GapError> {
    let n = all.len().min(AGAIN);
    let asked: Vec<Asked> = (all.drain(..n))
        .map(|c| Asked {
            variant: as_expected(judge, &c),
            ..c.asked
        })
        .collect();
    let looked = columns(judge, present, &asked, FINE, watch)?;
    all.extend(rate(judge, present, looked));
    sort(&mut all);
    Ok(all)
}

/// A variant of an effect at a place.
#[derive(Clone)]
struct Asked {
    effect: &'static dyn Effect,
    place: Place,
    variant: Variant,
}

impl Asked {
    fn is(&self, effect: &dyn Effect, place: &Place) -> bool {
        self.effect.about().name == effect.about().name && self.place == *place
    }

    fn with(&self, values: Vec<f64>) -> Chosen {
        Chosen {
            effect: self.effect,
            place: self.place.clone(),
            values,
        }
    }
}

/// With its columns.
type Looked = (Asked, Arc<[DVector<f64>]>);

/// All variants of all candidates, of long grids a few.
fn asked(judge: &Judge<'_>, only: &[String]) -> Vec<Asked> {
    let wanted = |effect: &dyn Effect| {
        let about = effect.about();
        is_wanted(only, about.name) && !about.is_variety() && effect.periodic().is_none()
    };
    let mut out = Vec::new();
    for (effect, place) in effect::candidates(&judge.base.model) {
        if !wanted(effect) {
            continue;
        }
        let scales = judge.measured.scales(&judge.base.model, &place);
        let all = variants(effect.about().parameters, &scales);
        let stride = all.len().div_ceil(FEW);
        out.extend(all.into_iter().step_by(stride).map(|variant| Asked {
            effect,
            place: place.clone(),
            variant,
        }));
    }
    out
}

/// The variant of a candidate, each size as it is expected if that makes sense.
fn as_expected(judge: &Judge<'_>, c: &Candidate) -> Variant {
    let parameters = c.effect().about().parameters;
    let scales = judge.measured.scales(&judge.base.model, c.place());
    let mut variant = c.asked.variant.clone();
    for (&p, (size, values)) in variant.parameters.iter().zip(&mut variant.columns) {
        let (parameter, expected) = (&parameters[p], c.values[p]);
        if parameter.is_whole() || expected == 0.0 || !parameter.makes_sense(expected, &scales) {
            continue;
        }
        values[p] = expected;
        *size = expected;
    }
    variant
}

/// Candidates by columns that are known, beside other models or for other readings.
pub(super) fn again(
    judge: &Judge<'_>,
    present: &Fitted,
    screened: &[&Candidate],
) -> Vec<Candidate> {
    let looked = (screened.iter()).map(|c| (c.asked.clone(), Arc::clone(&c.columns)));
    rate(judge, present, looked.collect())
}

fn rate(judge: &Judge<'_>, present: &Fitted, looked: Vec<Looked>) -> Vec<Candidate> {
    let mut best: Vec<Candidate> = Vec::new();
    let Some(follow) = Follow::new(judge, present) else {
        return best;
    };
    for (asked, columns) in looked {
        let Some(expected) = follow.expected(&columns) else {
            continue;
        };
        let (about, variant) = (asked.effect.about(), &asked.variant);
        let parameters = about.parameters;
        let scales = judge.measured.scales(&judge.base.model, &asked.place);
        let mut values = variant.columns[0].1.clone();
        for ((&i, (_, own)), size) in
            (variant.parameters.iter().zip(&variant.columns)).zip(&expected.sizes)
        {
            values[i] = if parameters[i].is_whole() {
                own[i]
            } else {
                *size
            };
        }
        let candidate = Candidate {
            sensible: variant.makes_sense(parameters, &expected.sizes, &scales),
            p_value: chance(expected.gain, columns.len()) * about.shapes() as f64,
            gain: expected.gain,
            visible: expected.visible,
            asked,
            values,
            columns,
        };
        let rank = |c: &Candidate| (c.sensible, c.gain);
        let same = (best.iter_mut()).find(|b| b.asked.is(candidate.effect(), candidate.place()));
        match same {
            Some(known) if rank(known) >= rank(&candidate) => {}
            Some(known) => *known = candidate,
            None => best.push(candidate),
        }
    }
    sort(&mut best);
    best
}

/// The most promising first.
fn sort(all: &mut [Candidate]) {
    let order = |a: &Candidate, b: &Candidate| {
        (b.sensible.cmp(&a.sensible)).then(b.gain.total_cmp(&a.gain))
    };
    all.sort_by(order);
}

/// What each size of variants does to all bins, over the size, as the mean of so many simulations; without variants that the
/// model cannot say, or that break down.
///
/// # Errors
/// [`GapError::Stopped`].
fn columns(
    judge: &Judge<'_>,
    present: &Fitted,
    asked: &[Asked],
    simulations: usize,
    watch: &mut Watch<'_>,
) -> Result<Vec<Looked>, GapError> {
    let mut out = Vec::with_capacity(asked.len());
    for (i, batch) in asked.chunks(BATCH).enumerate() {
        watch.part(i * BATCH, asked.len());
        watch.go_on()?;
        let found: Vec<_> = (batch.par_iter())
            .map(|own| {
                let variant = &own.variant;
                let each = variant.columns.iter().map(|(size, values)| {
                    column(judge, present, own.with(values.clone()), *size, simulations)
                });
                Some((own.clone(), each.collect::<Option<_>>()?))
            })
            .collect();
        out.extend(found.into_iter().flatten());
    }
    Ok(out)
}

fn column(
    judge: &Judge<'_>,
    present: &Fitted,
    chosen: Chosen,
    size: f64,
    simulations: usize,
) -> Option<DVector<f64>> {
    let (machine, point) = judge.with(&present.point, &[chosen])?;
    let course = judge.course.beside(&machine.problem, &point.x);
    let mut spreads = judge.spreads(&machine, &point);
    spreads[present.point.x.len()..].fill(0.0);
    let known = present.ensemble.slopes.widened(point.x.len());
    let seen = Ensemble::still(&course, &point.x, &spreads, &known, simulations).ok()?;
    Some((seen.mean - &present.ensemble.mean) / size)
}
