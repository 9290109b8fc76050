//! Effects one at a time: every candidate in several sizes, the best of them as it fits best.
//!
//! Deviations of rollouts are no linear function of anything, so that candidates are simulated: each size of each
//! effect at each place, from the least that can be seen to the largest that is to be expected. The best few are looked
//! at between their sizes, the best of these with all numbers fitted. One is kept if
//!
//! - trial by trial, deviations are smaller than without it (t test, times the number of candidates),
//! - they are by a twentieth, in the geometric mean over their kinds,
//! - and held-out trials say so too.

use super::judge::{Difference, Judge, Point, Seen, difference};
use super::rest;
use crate::gap::effect::{self, Effect, Place, Scales, Sign};
use crate::gap::evidence::Evidence;
use crate::gap::inputs::is_wanted;
use crate::gap::model::{Chosen, variants};
use crate::gap::search::Limits;
use crate::gap::{GapError, Stage, Watch};

/// Sizes of a candidate between the least and the largest.
const SIZES: usize = 5;
/// Candidates that are looked at between their sizes.
const RIVALS: usize = 5;
/// Of these, so many are fitted with all numbers of the model.
const FITTED: usize = 3;
/// How often, and how many points each time on either side.
const ZOOMS: usize = 2;
const BESIDE: i32 = 2;
/// Part by which deviations have to fall.
const LEAST: f64 = 0.05;
/// t of the fall on held-out trials.
const HELD_T: f64 = 2.0;
/// Fall of the cost that a number more has to bring.
const NUMBER: f64 = 2.0;
/// Chance that a kept effect does nothing, above which it goes.
const LEAVES: f64 = 0.01;
/// Part of its deviations by which the rollouts of a trial have to change for an effect to be testable.
const SHOWS: f64 = 0.005;

/// An effect at a place.
#[derive(Debug, Clone)]
pub(super) struct Candidate {
    pub effect: &'static dyn Effect,
    pub place: Place,
}

/// A candidate as good as its sizes make it.
pub(super) struct Tried {
    pub candidate: Candidate,
    /// index of the parameter that was varied, and the factor between its sizes
    size: (usize, f64),
    /// with the effect as the last
    pub seen: Seen,
    /// whether any size of it changes anything
    pub shows: bool,
}

/// Candidates beside what is chosen; `only` names those to look for, or is empty. The size of a body is left to what lies
/// still, if anything does.
pub(super) fn candidates(judge: &Judge<'_>, chosen: &[Chosen], only: &[String]) -> Vec<Candidate> {
    let wanted = |effect: &dyn Effect, place: &Place| {
        let about = effect.about();
        let taken = |c: &Chosen| c.effect.about().name == about.name && c.place == *place;
        let known = about.name == rest::NAME && judge.ends.len() > 1;
        is_wanted(only, about.name) && !about.is_variety() && !known && !chosen.iter().any(taken)
    };
    (effect::candidates(&judge.base.model).into_iter())
        .filter(|(e, p)| wanted(*e, p))
        .map(|(effect, place)| Candidate { effect, place })
        .collect()
}

/// Values to try: index of the parameter that is varied, factor between its sizes, all values.
fn sizes(candidate: &Candidate, scales: &Scales) -> Vec<(usize, f64, Vec<f64>)> {
    let parameters = candidate.effect.about().parameters;
    let mut out = Vec::new();
    for variant in variants(parameters, scales) {
        for (&i, (_, values)) in variant.parameters.iter().zip(&variant.columns) {
            let p = &parameters[i];
            if p.is_whole() {
                out.push((i, 1.0, values.clone()));
                continue;
            }
            let factor = (p.high / p.low).powf(1.0 / (SIZES - 1) as f64);
            let signs: &[f64] = match p.sign {
                Sign::Positive => &[1.0],
                Sign::Either => &[1.0, -1.0],
            };
            for k in 0..SIZES {
                for sign in signs {
                    let mut own = values.clone();
                    own[i] = sign * p.low * p.scale(scales) * factor.powi(k as i32);
                    out.push((i, factor, own));
                }
            }
        }
    }
    out
}

/// Every candidate beside `present` in its best size, best first.
pub(super) fn screen(
    judge: &Judge<'_>,
    present: &Seen,
    candidates: &[Candidate],
    watch: &mut Watch<'_>,
) -> Result<Vec<Tried>, GapError> {
    watch.stage(Stage::Screen);
    let mut of = Vec::new();
    let mut points = Vec::new();
    for (c, candidate) in candidates.iter().enumerate() {
        let scales = Scales::of(&judge.base.model, &candidate.place);
        for (i, factor, values) in sizes(candidate, &scales) {
            of.push((c, i, factor));
            points.push(with(&present.point, candidate, values));
        }
    }
    let seen = judge.see_all(points, watch)?;
    let mut best: Vec<Option<Tried>> = candidates.iter().map(|_| None).collect();
    for ((c, i, factor), seen) in of.into_iter().zip(seen) {
        let Some(seen) = seen else { continue };
        let shows = differs(present, &seen);
        match &mut best[c] {
            Some(known) if known.seen.cost <= seen.cost => known.shows |= shows,
            slot => {
                let before = slot.as_ref().is_some_and(|t| t.shows);
                *slot = Some(Tried {
                    candidate: candidates[c].clone(),
                    size: (i, factor),
                    seen,
                    shows: shows || before,
                });
            }
        }
    }
    let mut best: Vec<Tried> = best.into_iter().flatten().collect();
    best.sort_by(|a, b| a.seen.cost.total_cmp(&b.seen.cost));
    Ok(best)
}

fn with(point: &Point, candidate: &Candidate, values: Vec<f64>) -> Point {
    let mut out = point.clone();
    out.chosen.push(Chosen {
        effect: candidate.effect,
        place: candidate.place.clone(),
        values,
    });
    out
}

/// Whether the rollouts of a trial are others, by more than rounding makes of them.
fn differs(a: &Seen, b: &Seen) -> bool {
    let scales = a.rollouts.scales();
    let (before, after) = (a.rollouts.costs(&scales), b.rollouts.costs(&scales));
    let moved: f64 = before.iter().zip(&after).map(|(a, b)| (a - b).abs()).sum();
    moved > SHOWS * before.iter().sum::<f64>()
}

/// The candidate between its sizes.
pub(super) fn zoom(
    judge: &Judge<'_>,
    mut tried: Tried,
    watch: &mut Watch<'_>,
) -> Result<Tried, GapError> {
    let (i, mut factor) = tried.size;
    for _ in 0..ZOOMS {
        if factor <= 1.0 {
            break;
        }
        factor = factor.powf(1.0 / f64::from(BESIDE + 1));
        let at = |k: i32| {
            let mut point = tried.seen.point.clone();
            if let Some(last) = point.chosen.last_mut() {
                last.values[i] *= factor.powi(k);
            }
            point
        };
        let points = (-BESIDE..=BESIDE).filter(|k| *k != 0).map(at).collect();
        for seen in judge.see_all(points, watch)?.into_iter().flatten() {
            if seen.cost < tried.seen.cost {
                tried.seen = seen;
            }
        }
    }
    Ok(tried)
}

/// The best candidate of a screen that stands, all numbers fitted; nothing if none does.
pub(super) fn forward(
    judge: &Judge<'_>,
    limits: &Limits,
    present: &Seen,
    screened: Vec<Tried>,
    watch: &mut Watch<'_>,
) -> Result<Option<(Seen, Evidence)>, GapError> {
    let tests = screened.iter().filter(|t| t.shows).count().max(1) as f64;
    watch.stage(Stage::Refit);
    let mut rivals = Vec::new();
    for tried in (screened.into_iter())
        .filter(|t| t.seen.cost + NUMBER < present.cost)
        .take(RIVALS)
    {
        rivals.push(zoom(judge, tried, watch)?);
    }
    let by_cost = |a: &Tried, b: &Tried| a.seen.cost.total_cmp(&b.seen.cost);
    rivals.sort_by(by_cost);
    rivals.truncate(FITTED);
    for rival in &mut rivals {
        if let Some(polished) = judge.polish(&rival.seen, false, watch)? {
            rival.seen = polished.seen;
        }
    }
    rivals.sort_by(by_cost);
    for rival in rivals {
        let gain = 1.0 - fall(present, &rival.seen);
        let fall = difference(&present.rollouts, &rival.seen.rollouts);
        let p_value = (fall.map_or(1.0, Difference::p_value) * tests).min(1.0);
        if p_value > limits.family_p || gain < LEAST {
            continue;
        }
        let held = judge.held_out(&present.point, &rival.seen.point)?;
        if held.is_none_or(|held| held.t >= HELD_T) {
            let evidence = Evidence {
                p_value,
                gain,
                size: None,
                alike: Vec::new(),
            };
            return Ok(Some((rival.seen, evidence)));
        }
    }
    Ok(None)
}

/// Deviations of `b` over those of `a`, geometric mean over their kinds.
pub(super) fn fall(a: &Seen, b: &Seen) -> f64 {
    f64::exp((b.rollouts.cost() - a.rollouts.cost()) / a.rollouts.weight())
}

/// Index of an effect that is no longer needed, if there is one.
pub(super) fn needless(
    judge: &Judge<'_>,
    present: &Seen,
    watch: &mut Watch<'_>,
) -> Result<Option<usize>, GapError> {
    let n = present.point.chosen.len();
    if n < 2 {
        return Ok(None);
    }
    let without = |i: usize| {
        let mut point = present.point.clone();
        point.chosen.remove(i);
        point
    };
    let all = judge.see_all((0..n).map(without).collect(), watch)?;
    let mut worst: Option<(f64, usize)> = None;
    for (i, seen) in all.iter().enumerate() {
        let Some(seen) = seen else { continue };
        let p = difference(&seen.rollouts, &present.rollouts).map_or(1.0, Difference::p_value);
        if p > LEAVES && worst.is_none_or(|w| p > w.0) {
            worst = Some((p, i));
        }
    }
    Ok(worst.map(|w| w.1))
}
