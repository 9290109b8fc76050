//! Effects one at a time: the best that stands, and what is no longer needed.

use super::judge::{Judge, Point};
use super::refit::Fitted;
use super::screen::{Candidate, LEAST_VISIBLE, chance};
use crate::gap::alike::{Rival, apart};
use crate::gap::evidence::Evidence;
use crate::gap::model::Chosen;
use crate::gap::name::APART;
use crate::gap::run::Options;
use crate::gap::score::mean;
use crate::gap::{GapError, Watch};

/// Candidates that are fitted.
const RIVALS: usize = 8;
/// Part by which mean squares of deviations have to fall, over all channels, and those of held-out recordings.
const LEAST: f64 = 0.01;
const LEAST_HELD: f64 = 0.005;
/// Standard errors that a fall of the cost is more than chaos, which is another in each draw of simulations.
const SURE: f64 = 3.0;
/// Chance that a kept effect does nothing, above which it goes.
const LEAVES: f64 = 0.01;

/// Fall of mean squares of `worth` numbers where the cost falls by `fall`.
pub(super) fn part(fall: f64, worth: f64) -> f64 {
    1.0 - f64::exp(-2.0 * fall / worth)
}

/// Fall of the cost of deviations that are worth so many numbers, below which an effect does not count.
pub(super) fn least_fall(worth: f64) -> f64 {
    -0.5 * worth * f64::ln(1.0 - LEAST)
}

/// Number of candidates that could be found.
pub(super) fn tests(all: &[Candidate]) -> usize {
    all.iter().filter(|c| c.visible >= LEAST_VISIBLE).count()
}

/// By how much costs fall at least, all but surely, of two models in several draws of simulations each.
fn surely(before: &[f64], after: &[f64]) -> f64 {
    let ((before, own), (after, other)) = (mean(before), mean(after));
    before - after - SURE * own.hypot(other)
}

fn numbers(effect: &dyn crate::gap::effect::Effect) -> usize {
    effect
        .about()
        .parameters
        .iter()
        .filter(|p| p.is_size())
        .count()
}

/// Whether an effect with this fall of the cost, and this chance, is one.
fn stands(judge: &Judge<'_>, options: &Options, chosen: &Chosen, fall: f64, p_value: f64) -> bool {
    let scales = judge.measured.scales(&judge.base.model, &chosen.place);
    p_value <= options.limits.family_p
        && part(fall, judge.worth()) >= LEAST
        && chosen.counts(&scales)
        && !chosen.absurd(&scales)
}

/// The same of a candidate that is expected to be.
fn promises(judge: &Judge<'_>, options: &Options, c: &Candidate, n_tests: f64) -> bool {
    c.sensible
        && c.visible >= LEAST_VISIBLE
        && stands(judge, options, &c.chosen(), c.gain, c.p_value * n_tests)
}

/// The best candidate that stands, all numbers fitted; nothing if none does.
///
/// # Errors
/// The engine fails.
pub(super) fn forward(
    judge: &Judge<'_>,
    options: &Options,
    present: &Fitted,
    all: &[Candidate],
    watch: &mut Watch<'_>,
) -> Result<Option<(Fitted, Evidence)>, GapError> {
    let mut names: Vec<&str> = present
        .point
        .written
        .iter()
        .map(|c| c.effect.about().name)
        .collect();
    names.sort_unstable();
    names.dedup();
    let n_tests = tests(all) as f64;
    let may = |c: &&Candidate| {
        let name = c.effect().about().name;
        (names.len() < options.max_effects || names.contains(&name))
            && promises(judge, options, c, n_tests)
    };
    let rivals: Vec<&Candidate> = all.iter().filter(may).take(RIVALS).collect();
    let points = rivals
        .iter()
        .filter_map(|c| judge.with(&present.point, &[c.chosen()]));
    let points = points.collect();
    let fitted = judge.refit_all(points, &present.ensemble.slopes)?;
    watch.go_on()?;
    let mut fitted: Vec<Fitted> = fitted.into_iter().flatten().collect();
    fitted.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let held = judge.held(&present.machine, &present.point)?;
    let before = if fitted.is_empty() {
        Vec::new()
    } else {
        judge.costs(present)?
    };
    for i in 0..fitted.len() {
        let own = &fitted[i];
        let chosen = own.chosen();
        let Some(last) = chosen.last() else { continue };
        if !stands(judge, options, last, present.cost - own.cost, 0.0) {
            continue;
        }
        let fall = surely(&before, &judge.costs(own)?);
        let shapes = last.effect.about().shapes() as f64;
        let p_value = (chance(fall, numbers(last.effect)) * n_tests * shapes).min(1.0);
        if !stands(judge, options, last, fall, p_value) {
            continue;
        }
        if let Some(before) = held {
            let after = judge
                .held(&own.machine, &own.point)?
                .unwrap_or(f64::INFINITY);
            if part(before - after, judge.worth_held()) < LEAST_HELD {
                continue;
            }
        }
        let others = (fitted.iter().enumerate()).filter(|(j, _)| *j != i);
        let alike = others
            .map(|(_, other)| (other, apart(other.cost, own.cost)))
            .filter(|(_, separation)| *separation < APART)
            .filter_map(|(other, separation)| Some(Rival::of(other.chosen().last()?, separation)));
        let evidence = Evidence {
            p_value,
            gain: part(fall, judge.worth()),
            size: None,
            alike: alike.collect(),
        };
        let found = fitted.swap_remove(i);
        return Ok(Some((found, evidence)));
    }
    Ok(None)
}

/// The present model without effect `i`, fitted.
///
/// # Errors
/// The engine fails.
pub(super) fn without(
    judge: &Judge<'_>,
    present: &Fitted,
    i: usize,
) -> Result<Option<Fitted>, GapError> {
    let free = present.machine.built.free(&present.machine.problem);
    let gone: Vec<usize> = free.iter().filter(|f| f.1 == i).map(|f| f.0).collect();
    let mut written = present.point.written.clone();
    written.remove(i);
    let stays = |j: &usize| !gone.contains(j);
    let order: Vec<usize> = (0..present.point.x.len()).filter(stays).collect();
    let x = order.iter().map(|&j| present.point.x[j]).collect();
    let known = present.ensemble.slopes.only(&order);
    match judge.build(&written) {
        Some(machine) => judge.refit((machine, Point { written, x }), &known),
        None => Ok(None),
    }
}

/// Index of an effect that is no longer needed, if there is one, and the model without it.
///
/// # Errors
/// The engine fails.
pub(super) fn needless(
    judge: &Judge<'_>,
    present: &Fitted,
) -> Result<Option<(usize, Fitted)>, GapError> {
    let n = present.point.written.len();
    if n < 2 {
        return Ok(None);
    }
    let with = judge.costs(present)?;
    let mut worst: Option<(f64, usize, Fitted)> = None;
    for i in 0..n {
        let Some(fitted) = without(judge, present, i)? else {
            continue;
        };
        let fall = surely(&judge.costs(&fitted)?, &with);
        let p = chance(fall, numbers(present.point.written[i].effect));
        if p > LEAVES && worst.as_ref().is_none_or(|w| p > w.0) {
            worst = Some((p, i, fitted));
        }
    }
    Ok(worst.map(|(_, i, fitted)| (i, fitted)))
}
