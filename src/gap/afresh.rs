//! The search made afresh where its answer leaves much: in windows of other lengths, and without an effect that was found.
//!
//! Long windows show slow effects, a drive's spring or a weak torque; in short ones, where a model is lost for some of the motion
//! only ([`super::cuts`]), changes of it are better than others. Where the verdict is `unknown` the search is made again: in windows
//! of the length that suits the readings, if the model has been lost in these throughout, and then in windows a quarter and twice
//! as long.
//!
//! Effects are found one at a time, and one that is not there may explain more than any that is: of an arm on a spring whose
//! forearm is longer than said a payload explains more than either, of a crank whose dry friction differs with direction, beside that
//! friction in windows that are short still. What is found beside it makes up for it, and never takes its place. Where
//!
//! ```text
//! some: the least size of an effect, and a twentieth of what remained before ≤ remaining < before
//! ```
//!
//! the search is made without the effect of the largest class, of those as large the first, at any place; and where the verdict is
//! `unknown`, if that does not help, without the one found first: of an arm whose elbow meets a stop and rubs by its load a payload
//! explained a tenth more than the stop. Another answer counts if its verdict is not `unknown` and
//!
//! ```text
//! remaining after ≤ remaining / 5
//! ```
//!
//! ([`super::left`]) of what there was before any effect, in windows of another length, or of what the answer with the effect leaves,
//! held-out rollouts ending no further off either. A search goes on after two effects only if they take as much.

use super::cuts::Cuts;
use super::effect::{CATALOGUE, DRY};
use super::inputs::is_wanted;
use super::result::{Answer, Gap, Named, Remaining, Verdict};
use super::run::{self, Input, Options, Outcome};
use super::stages::{Keeper, Prefixed};
use super::{GapError, Watch, left};
use crate::mujoco::Model;

/// Lengths that are tried, as multiples of the one that suits the readings.
const MULTIPLES: [f64; 2] = [0.25, 2.0];
/// Part of the readings' misfit that a clear answer leaves.
const CLEAR: f64 = 0.2;

/// The search in windows that suit the recordings, then in others and without an effect that was found, where that leaves much.
///
/// # Errors
/// Of the first search; [`GapError::Stopped`].
pub(super) fn search(
    input: &Input<'_>,
    options: &Options,
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
) -> Result<Outcome, GapError> {
    let (first, options) = in_windows(input, options, keeper, watch)?;
    let answer = &first.answer;
    let Some((part, most)) = asks_again(&answer.remaining, options.limits.size) else {
        return Ok(first);
    };
    for was in suspects(answer.verdict, &answer.effects) {
        let Some(effects) = without(&was.name, &options.effects, &input.model.model) else {
            continue;
        };
        let options = Options {
            effects,
            ..options.clone()
        };
        let way = format!("without {}", was.name);
        let other = again((input, &options), keeper, watch, Some(part), &way)?;
        if let Some(mut other) = other.filter(|o| is_clear(&o.answer, most))
            && !is_further_off(&other.answer.gap, &answer.gap)
        {
            other.answer.gap.notes.push(format!(
                "found where {} is not looked for: with {} at {} five times as much is left, or more",
                was.name, was.name, was.at
            ));
            return Ok(other);
        }
    }
    Ok(first)
}

/// The search in windows of the length that suits the recordings, then of others where that explains nothing; with the options
/// that led to the answer.
fn in_windows(
    input: &Input<'_>,
    options: &Options,
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
) -> Result<(Outcome, Options), GapError> {
    let first = run::at_length(input, options, keeper, watch, None)?.ok_or(GapError::Stopped)?;
    let mut first = (first, options.clone());
    if first.0.answer.verdict != Verdict::Unknown || options.window_s.is_some() {
        return Ok(first);
    }
    let suits_s = Cuts::new(input, options)?.length_s;
    let mut at = |length_s: f64, enough| {
        let options = Options {
            window_s: Some(length_s),
            ..options.clone()
        };
        let way = format!("windows of {length_s} s");
        let other = again((input, &options), keeper, watch, enough, &way)?;
        Ok::<_, GapError>(other.map(|other| (other, options)))
    };
    if first.0.answer.window_s < suits_s
        && let Some(other) = at(suits_s, None)?
    {
        first = other;
    }
    let answer = &first.0.answer;
    if answer.verdict != Verdict::Unknown || answer.remaining.after.is_none() {
        return Ok(first);
    }
    for multiple in MULTIPLES {
        if let Some(other) = at(multiple * suits_s, Some(CLEAR))?
            && let Some(before) = other.0.answer.remaining.before
            && is_clear(&other.0.answer, CLEAR * before)
        {
            return Ok(other);
        }
    }
    Ok(first)
}

/// The search made again; nothing if it cannot be, or does not take what is `enough`.
fn again(
    (input, options): (&Input<'_>, &Options),
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
    enough: Option<f64>,
    way: &str,
) -> Result<Option<Outcome>, GapError> {
    let mut own = Prefixed {
        keeper,
        prefix: format!("{}-", way.replace(' ', "-")),
    };
    way.clone_into(&mut watch.way);
    let again = run::at_length(input, options, &mut own, watch, enough);
    watch.way.clear();
    match again {
        Err(GapError::Stopped) => Err(GapError::Stopped),
        other => Ok(other.ok().flatten()),
    }
}

/// The effects that may stand for others: the one that is least told from others, of those that are as little the first; and
/// where the verdict is `unknown` the first that was found, which all others were found beside.
fn suspects(verdict: Verdict, effects: &[Named]) -> Vec<&Named> {
    let least_told = effects.iter().rev().max_by_key(|effect| effect.class.len());
    let mut suspects: Vec<&Named> = least_told.into_iter().collect();
    if verdict == Verdict::Unknown {
        suspects.extend(effects.first());
    }
    suspects.dedup_by_key(|effect| &effect.name);
    suspects
}

/// Whether the verdict is clear, and at most `most` remains.
fn is_clear(answer: &Answer, most: f64) -> bool {
    answer.verdict != Verdict::Unknown && answer.remaining.after.is_some_and(|after| after <= most)
}

/// What a search without an effect has to leave at most, as a part of what there was before and as it is; nothing if too
/// little is left to ask for one, or, in other weights, more than before.
fn asks_again(remaining: &Remaining, size: f64) -> Option<(f64, f64)> {
    let (before, after) = remaining.before.zip(remaining.after)?;
    let most = CLEAR * after;
    (left::some(remaining, size) && after < before).then(|| (most / before, most))
}

/// Names of the effects to look for but this one, of all that the model can carry if none are given; nothing if none are left.
/// Varieties of dry friction are not looked for where that is not.
fn without(name: &str, effects: &[String], model: &Model) -> Option<Vec<String>> {
    let others = CATALOGUE.iter().filter(|effect| {
        let about = effect.about();
        about.name != name
            && !(name == DRY && about.is_variety())
            && is_wanted(effects, about.name)
            && !effect.places(model).is_empty()
    });
    let names: Vec<String> = others.map(|e| e.about().name.to_owned()).collect();
    (!names.is_empty()).then_some(names)
}

/// Whether a held-out rollout of `gap` ends further off than that of the `other`.
fn is_further_off(gap: &Gap, other: &Gap) -> bool {
    let mut both = gap.rollout.iter().zip(&other.rollout);
    both.any(|(own, other)| own.after > other.after)
}

#[cfg(test)]
mod tests {
    use super::{asks_again, suspects, without};
    use crate::gap::masses::machine;
    use crate::gap::result::{Named, Remaining, Verdict};

    /// What an arm's payload and gain leave, which are a spring and a length, and another's gain, which is an offset and a rotor; two
    /// frictions of a finger, those of a carriage, and a drive that gives way.
    #[test]
    fn another_answer_has_to_leave_a_fifth_where_much_is_left() {
        let asks = |before, after| {
            let remaining = Remaining {
                before: Some(before),
                after: Some(after),
            };
            asks_again(&remaining, 0.01)
        };
        let (part, most) = asks(0.31, 0.0232).expect("much is left");
        assert!((part * 0.31 - most).abs() < 1e-15 && (most - 0.00464).abs() < 1e-15);
        assert!(asks(0.0465, 0.0157).is_some() && asks(0.0465, 0.009).is_none());
        assert!(asks(0.83, 0.0135).is_none() && asks(1.40, 0.0226).is_none());
        assert!(asks(0.0038, 0.0175).is_none());
    }

    /// A finger's friction that differs with direction, which a payload stood for; where none has a larger class; and an arm's stop,
    /// which a payload stood for that no class held.
    #[test]
    fn what_is_least_told_from_others_is_left_out() {
        let named = |name: &str, class: &[&str]| Named {
            name: name.into(),
            at: "crank".into(),
            class: class.iter().map(|&c| c.to_owned()).collect(),
            probability: 1.0,
            p_value: 0.0,
            parameters: Vec::new(),
            expressed_as: "mjcf",
            law: String::new(),
            gain: 0.5,
            size: None,
            decoys: None,
            alike: Vec::new(),
        };
        let left_out = |verdict, effects: &[Named]| -> Vec<String> {
            let suspects = suspects(verdict, effects);
            suspects.iter().map(|e| e.name.clone()).collect()
        };
        let friction = named("coulomb_friction", &["coulomb_friction"]);
        let payload = named("payload", &["payload", "torque_offset", "encoder_offset"]);
        let gain = named("torque_gain", &["torque_gain"]);
        let found = [friction.clone(), payload];
        assert_eq!(left_out(Verdict::Ambiguous, &found), ["payload"]);
        assert_eq!(
            left_out(Verdict::Unknown, &found),
            ["payload", "coulomb_friction"]
        );
        let found = [friction, gain];
        for verdict in [Verdict::Effect, Verdict::Unknown] {
            assert_eq!(left_out(verdict, &found), ["coulomb_friction"]);
            assert!(left_out(verdict, &[]).is_empty());
        }
    }

    /// Everything that two masses on slides can carry, but what is left out.
    #[test]
    fn all_but_what_is_left_out_is_looked_for() {
        let model = machine("", "").model;
        let names = |first, effects: &[&str]| {
            let effects: Vec<String> = effects.iter().map(|&e| e.to_owned()).collect();
            without(first, &effects, &model)
        };
        let all = names("payload", &[]).expect("more than one");
        let has = |all: &[String], name: &str| all.iter().any(|n| n == name);
        assert!(has(&all, "torque_gain") && has(&all, "stribeck_friction"));
        assert!(!has(&all, "payload") && !has(&all, "contact_friction"));
        let smooth = names("coulomb_friction", &[]).expect("more than one");
        assert!(has(&smooth, "torque_gain") && !has(&smooth, "stribeck_friction"));
        assert_eq!(
            names("payload", &["payload", "torque_gain"]),
            Some(vec!["torque_gain".into()])
        );
        assert_eq!(names("payload", &["payload"]), None);
    }
}
