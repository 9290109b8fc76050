//! What is missing where bodies fall, tumble and come to rest.
//!
//! The motion of a body that tumbles is chaotic: windows with a first state of their own follow it whatever the model
//! lacks, and there is no useful slope over more. So where the protocol says where bodies fall (`[drop]`), whole rollouts
//! from there are compared, as by the rollout method of [`crate::sysid::rollouts`], whose cost this is: mean deviations
//! of place and rotation, each in units of its mean over all trials. How large a body is shows better in where it comes to
//! rest, and is a finding of its own.
//!
//! ```text
//! fit       the base model's free parameters                                                   [judge]
//! locate    flight, whole tosses, at rest                                                      [locate, rest]
//! screen    every effect at every place in several sizes, simulated                            [forward]
//! refit     the best one that stands, then all numbers together; what is no longer needed goes [forward]
//! size      of what lies still                                                                 [rest]
//! name      each against its neighbours                                                        [name]
//! verify    held-out rollouts; the repaired model tossed and searched again                    [again]
//! ```
//!
//! Trials are independent, which makes every comparison of two models a t test over trials.

mod again;
mod forward;
mod judge;
mod locate;
mod name;
mod rest;

use serde::{Deserialize, Serialize};

use super::effect::{Place, named};
use super::evidence::Evidence;
use super::inputs::{is_wanted, wanted};
use super::model::Chosen;
use super::repair::{machine, repaired, rules};
use super::result::{Answer, Located, Remaining, Tested, Untestable, Verdict};
use super::run::{Input, Options, Outcome};
use super::stages::{self, Keeper};
use super::untestable::{UNSHOWN, list};
use super::{GapError, Stage, Watch, verify};
use forward::{Tried, candidates, screen};
use judge::{Judge, Point, Polished, Seen, difference};
use rest::Size;

/// What the first look says.
#[derive(Clone, Serialize, Deserialize)]
struct First {
    base: Vec<f64>,
    located: Vec<Located>,
    evidence: Vec<Tested>,
    untestable: Vec<Untestable>,
}

/// The search after a step.
#[derive(Clone, Serialize, Deserialize)]
struct Step {
    effects: Vec<(String, Place, Vec<f64>)>,
    base: Vec<f64>,
    kept: Vec<Evidence>,
    ended: bool,
}

impl Step {
    /// Simulated again; nothing where that does not work.
    fn seen(self, judge: &Judge<'_>) -> Option<(Seen, Self)> {
        let chosen = |(name, place, values): &(String, Place, Vec<f64>)| {
            Some(Chosen {
                effect: named(name)?,
                place: place.clone(),
                values: values.clone(),
            })
        };
        let point = Point {
            chosen: self.effects.iter().map(chosen).collect::<Option<_>>()?,
            base: self.base.clone(),
        };
        Some((judge.see(point).ok()??, self))
    }
}

/// As [`super::run::resume`], for a protocol that says where bodies fall.
pub(super) fn resume(
    input: &Input<'_>,
    options: &Options,
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
) -> Result<Outcome, GapError> {
    watch.stage(Stage::Fit);
    let effects = wanted(&options.effects, &input.model.model)?;
    let judge = Judge::new(input, options.seed)?;
    let broken = || GapError::Input {
        reason: "rollouts of the base model break down: see its time step and contacts".into(),
    };
    let known: Option<First> = stages::load(keeper, "toss");
    let mut screened: Option<Vec<Tried>> = None;
    let (first, mut seen) = if let Some(known) = known {
        let chosen = Vec::new();
        let base = known.base.clone();
        let seen = judge.see(Point { chosen, base })?.ok_or_else(broken)?;
        (known, seen)
    } else {
        let seen = judge.see(judge.first())?.ok_or_else(broken)?;
        let seen = judge.polish(&seen, false, watch)?.ok_or_else(broken)?.seen;
        watch.stage(Stage::Locate);
        let located = locate::locate(&judge, &seen)?;
        let all = candidates(&judge, &[], &effects);
        let tried = screen(&judge, &seen, &all, watch)?;
        let first = First {
            base: seen.point.base.clone(),
            located,
            evidence: tried.iter().map(|t| tested(&seen, t)).collect(),
            untestable: untestable(&tried),
        };
        stages::save(keeper, "toss", &first);
        screened = Some(tried);
        (first, seen)
    };
    let before = seen.point.clone();
    let mut kept: Vec<Evidence> = Vec::new();
    let mut n = 0;
    while seen.point.chosen.len() < options.max_effects {
        n += 1;
        watch.note = format!("effect {n}");
        let stage = format!("toss-{n}");
        let known: Option<Step> = stages::load(keeper, &stage);
        if let Some((there, step)) = known.and_then(|step| step.seen(&judge)) {
            let ended = step.ended;
            (seen, kept, screened) = (there, step.kept, None);
            if ended {
                break;
            }
            continue;
        }
        let tried = if let Some(tried) = screened.take() {
            tried
        } else {
            let all = candidates(&judge, &seen.point.chosen, &effects);
            screen(&judge, &seen, &all, watch)?
        };
        let more = forward::forward(&judge, &options.limits, &seen, tried, watch)?;
        let ended = more.is_none();
        if let Some((found, evidence)) = more {
            kept.push(evidence);
            seen = found;
            while let Some(i) = forward::needless(&judge, &seen, watch)? {
                let mut point = seen.point.clone();
                point.chosen.remove(i);
                kept.remove(i);
                let without = judge.see(point)?.ok_or_else(broken)?;
                seen = judge
                    .polish(&without, false, watch)?
                    .ok_or_else(broken)?
                    .seen;
            }
        }
        let effect = |c: &Chosen| {
            (
                c.effect.about().name.to_owned(),
                c.place.clone(),
                c.values.clone(),
            )
        };
        let step = Step {
            effects: seen.point.chosen.iter().map(effect).collect(),
            base: seen.point.base.clone(),
            kept: kept.clone(),
            ended,
        };
        stages::save(keeper, &stage, &step);
        if ended {
            break;
        }
    }
    watch.note.clear();
    watch.stage(Stage::Name);
    let polished = judge.polish(&seen, true, watch)?.ok_or_else(broken)?;
    conclude(
        input,
        options,
        &judge,
        (first, before),
        (polished, &kept),
        watch,
    )
}

/// Names, held-out recordings, the search of the repaired model, and the files.
fn conclude(
    input: &Input<'_>,
    options: &Options,
    judge: &Judge<'_>,
    (first, before): (First, Point),
    (polished, kept): (Polished, &[Evidence]),
    watch: &mut Watch<'_>,
) -> Result<Outcome, GapError> {
    let mut effects = name::name(judge, &polished, kept, watch)?;
    let mut point = polished.seen.point.clone();
    let mut notes = Vec::new();
    if let Some(size) = size(judge, options, &polished, &mut notes)? {
        effects.extend(name::size(judge, &size));
        point.chosen.extend(size.chosen());
    }
    let model_of = |point: &Point| {
        let (_, problem, x) = judge.build(point, &judge.problem)?;
        Some(machine(&problem, &x))
    };
    let (Some(before), Some(after)) = (model_of(&before), model_of(&point)) else {
        return Err(GapError::Input {
            reason: "the repaired model cannot be built".into(),
        });
    };
    let (before, after) = (before?, after?);
    let round_trip = if effects.is_empty() {
        None
    } else {
        again::again(
            judge,
            (&point, polished.seen.point.chosen.len()),
            &options.limits,
            options.seed,
            watch,
        )?
    };
    watch.stage(Stage::Verify);
    let mut gap = verify::verify(
        &before,
        &after,
        input.holdout,
        input.protocol,
        &|_| None,
        options.seed,
    )?;
    gap.notes.append(&mut notes);
    let Some((built, problem, x)) = judge.build(&point, &judge.problem) else {
        return Err(GapError::Stopped);
    };
    let verdict = match &effects[..] {
        [] => Verdict::None,
        all if all.iter().any(|e| e.class.len() > 1) => Verdict::Ambiguous,
        _ => Verdict::Effect,
    };
    Ok(Outcome {
        model: repaired((input.model, &built), &problem, &x, &point.chosen)?,
        extended: built.file.xml.clone(),
        rules: rules(&built),
        answer: Answer {
            verdict,
            next_experiment: super::name::next_experiment(&effects, &first.untestable),
            effects,
            located: first.located,
            gap,
            untestable: first.untestable,
            model: "model.xml".into(),
            n_candidates: first.evidence.len(),
            evidence: first.evidence,
            left: Vec::new(),
            remaining: Remaining {
                before: None,
                after: None,
            },
            round_trip,
            window_s: judge.longest_s,
            n_windows: polished.seen.rollouts.starts.len(),
        },
        machines: [before.model, after.model],
        missing: [None, None],
    })
}

/// The size of what lies still, if it is off by as much as counts, and rollouts do not become worse by it.
fn size(
    judge: &Judge<'_>,
    options: &Options,
    polished: &Polished,
    notes: &mut Vec<String>,
) -> Result<Option<Size>, GapError> {
    let point = &polished.seen.point;
    let wanted = is_wanted(&options.effects, rest::NAME);
    let wanted = wanted && point.chosen.len() < options.max_effects;
    let found = rest::size(judge, point)?.filter(|s| wanted && s.counts(options.limits.family_p));
    let Some(size) = found else { return Ok(None) };
    let mut with = point.clone();
    with.chosen.extend(size.chosen());
    let worse = judge.see(with)?.is_none_or(|with| {
        let rise = difference(&with.rollouts, &polished.seen.rollouts);
        rise.is_some_and(|rise| rise.p_value() < options.limits.family_p)
    });
    notes.push(format!(
        "at rest {} lies {:.3e} m off its model's height: as if its size were times {:.4} ({:.4} to {:.4}){}",
        size.place,
        size.mean_m,
        1.0 + size.share,
        1.0 + size.ci95[0],
        1.0 + size.ci95[1],
        if worse { "; that makes rollouts worse, so that it is not in the model" } else { "" }
    ));
    Ok((!worse).then_some(size))
}

fn tested(present: &Seen, tried: &Tried) -> Tested {
    let chosen = tried.seen.point.chosen.last();
    let fall = difference(&present.rollouts, &tried.seen.rollouts);
    Tested {
        name: tried.candidate.effect.about().name.to_owned(),
        at: tried.candidate.place.to_string(),
        expected: chosen.map_or(Vec::new(), |c| c.values.clone()),
        gain: 1.0 - forward::fall(present, &tried.seen),
        p_value: fall.map_or(1.0, judge::Difference::p_value),
        visible: f64::from(u8::from(tried.shows)),
        size: None,
    }
}

/// Effects that change nothing in any size.
fn untestable(tried: &[Tried]) -> Vec<Untestable> {
    let mut out = Vec::new();
    for t in tried.iter().filter(|t| !t.shows) {
        list(&mut out, t.candidate.effect, &t.candidate.place, UNSHOWN);
    }
    out
}
