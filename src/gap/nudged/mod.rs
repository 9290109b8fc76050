//! What is missing where machines touch and push: simulations of whole recordings, pulled along the motion.
//!
//! In contact windows with first states of their own do not follow stiff machines, see [`crate::sysid::nudging`]. There
//! simulations are pulled along the recordings instead, and what a model lacks shows as deviation:
//!
//! ```text
//! fit       the base model's parameters, by ensembles                                              [sysid::nudging]
//! locate    the forces of the pulls: joint or free body, contact, direction, speed                  [missing]
//! screen    what each effect at each place does to the deviations, by a few simulations             [screen]
//! refit     the best few, with slopes of the other numbers held; the best that stands; all slopes anew [refit, forward]
//! name      what fits nearly as well in its place; intervals from slopes and from how fits scatter   [name]
//! verify    held-out recordings: pulls and rollouts; the repaired model simulated and searched again
//! ```
//!
//! Pulls are the base model's throughout, so that costs of two models compare like with like:
//!
//! ```text
//! F(x) = Σₖ nₖ/2 · log(σₖ² + mean r²) + priors       2 (F − F′) ~ χ² of as many numbers as the effect has
//! ```
//!
//! where F − F′ is what several draws of simulations agree on, for in contact each is chaotic in small.

mod forward;
mod given;
mod judge;
mod missing;
mod name;
mod refit;
mod round_trip;
mod screen;
mod suits;

use serde::{Deserialize, Serialize};

use super::effect::{Place, named};
use super::evidence::Evidence;
use super::inputs::wanted;
use super::locate::Missing;
use super::model::Chosen;
use super::result::{Answer, Holdout, Located, Remaining, Tested, Untestable, Verdict};
use super::run::{Input, MissingSeries, Options, Outcome};
use super::stages::{self, Keeper};
use super::untestable::list;
use super::{GapError, Stage, Watch, left, repair, verify};
use crate::compare::Settings;
use crate::sysid::nudging::{self, NudgingSettings};
pub(super) use given::with_effects;
use judge::{Judge, Known, Point, Problems};
use refit::Fitted;
use screen::{Candidate, LEAST_VISIBLE};
pub(super) use suits::{USUAL_HZ, is_pushing, longer_steps};

/// s of the stretches that missing forces are means over, in periods of the pull.
const STRETCH: f64 = 0.5;

/// Steps once an effect is put in, at most, and those of them whose scatter belongs to intervals.
const MOST: usize = 10;
const LAST: usize = 3;

/// The base model's numbers.
#[derive(Clone, Serialize, Deserialize)]
struct Fit {
    x: Vec<f64>,
    spreads: Vec<f64>,
}

/// The search after a step.
#[derive(Clone, Serialize, Deserialize)]
struct Step {
    effects: Vec<(String, Place, Vec<f64>)>,
    x: Vec<f64>,
    /// of the effects
    known: Vec<Known>,
    /// all numbers in the steps of [`settled`]
    tries: Vec<Vec<f64>>,
    kept: Vec<Evidence>,
    ended: bool,
}

impl Step {
    fn point(&self) -> Option<Point> {
        let written = |(name, place, values): &(String, Place, Vec<f64>)| {
            Some(Chosen {
                effect: named(name)?,
                place: place.clone(),
                values: values.clone(),
            })
        };
        Some(Point {
            written: self.effects.iter().map(written).collect::<Option<_>>()?,
            x: self.x.clone(),
        })
    }
}

pub(super) fn broken() -> GapError {
    GapError::Input {
        reason: "simulations of the base model leave the recorded motion: see its time step and contacts, or pull more \
                 (--pull)"
            .into(),
    }
}

/// As [`super::run::resume`], by simulations that are pulled at `hz`.
pub(super) fn resume(
    input: &Input<'_>,
    options: &Options,
    hz: f64,
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
) -> Result<Outcome, GapError> {
    let effects = wanted(&options.effects, &input.model.model)?;
    let problems = Problems::new(input)?;
    let (mut judge, base) = begin(input, &problems, hz, keeper, watch)?;
    watch.stage(Stage::Locate);
    let length_s = STRETCH / hz;
    let before = lacks(&judge, &base, length_s)?;
    let held_before = held(&judge, &base, length_s)?;
    let before_machine = repair::machine(&base.machine.problem, &base.point.x)?;
    // its columns serve for all models: what they make of them is looked at again where it matters
    let screened = screen::screen(&judge, &base, &effects, watch)?;
    let mut found: Option<Fitted> = None;
    let mut kept: Vec<Evidence> = Vec::new();
    let mut tries: Vec<Vec<f64>> = Vec::new();
    let mut last: Option<Vec<Candidate>> = None;
    for n in 1.. {
        watch.note = format!("effect {n}");
        let stage = format!("nudged-{n}");
        let known: Option<Step> = stages::load(keeper, &stage);
        if let Some((point, step)) = known.and_then(|step| Some((step.point()?, step))) {
            judge.known.clone_from(&step.known);
            if step.ended {
                break;
            }
            found = Some(linearised(&mut judge, point)?);
            (kept, tries) = (step.kept, step.tries);
            continue;
        }
        let present = found.as_ref().unwrap_or(&base);
        let beside = match &found {
            None => None,
            Some(present) => Some(screen::beside(&judge, present, &screened, watch)?),
        };
        let all = beside.as_ref().unwrap_or(&screened);
        watch.stage(Stage::Refit);
        let more = forward::forward(&judge, options, present, all, watch)?;
        let ended = more.is_none();
        if let Some((fitted, evidence)) = more {
            kept.push(evidence);
            let mut next;
            (next, tries) = settled(&mut judge, fitted, watch)?;
            while let Some((i, fitted)) = forward::needless(&judge, &next)? {
                kept.remove(i);
                (next, tries) = settled(&mut judge, fitted, watch)?;
            }
            found = Some(next);
        }
        let effect = |c: &Chosen| {
            (
                c.effect.about().name.to_owned(),
                c.place.clone(),
                c.values.clone(),
            )
        };
        let present = found.as_ref().unwrap_or(&base);
        let step = Step {
            effects: present.point.written.iter().map(effect).collect(),
            x: present.point.x.clone(),
            known: judge.known.clone(),
            tries: tries.clone(),
            kept: kept.clone(),
            ended,
        };
        stages::save(keeper, &stage, &step);
        if ended {
            last = beside;
            break;
        }
    }
    let present = found.as_ref().unwrap_or(&base);
    watch.note.clear();
    watch.stage(Stage::Name);
    let named = name::name(&judge, present, &tries, &kept)?;
    watch.stage(Stage::Verify);
    let round_trip = if named.effects.is_empty() {
        None
    } else {
        let last = match last {
            Some(last) => last,
            None => screen::beside(&judge, present, &screened, watch)?,
        };
        round_trip::round_trip(&judge, options, &named.fitted, &last, watch)?
    };
    let fitted = &named.fitted;
    let last = lacks(&judge, fitted, length_s)?;
    let remaining = Remaining {
        before: missing::share(&before),
        after: missing::share(&last),
    };
    let rest = left::left(&last, false);
    let (problem, x) = (&fitted.machine.problem, &fitted.point.x);
    let after_machine = repair::machine(problem, x)?;
    let mut gap = verify::verify(
        &before_machine,
        &after_machine,
        input.holdout,
        &Settings {
            // of touching bodies inverse dynamics makes newtons of micrometres
            forces: false,
            ..verify::protocol(input, &problems.train, length_s, &after_machine.model)
        },
        &|channel| verify::noise(&problems.train, channel),
        options.seed,
    )?;
    let held_after = held(&judge, fitted, length_s)?;
    gap.holdout = (held_before.zip(held_after))
        .map(|parts| pulls(hz, parts))
        .or(gap.holdout);
    gap.notes.push(format!(
        "whole recordings are simulated, pulled along their motion at {hz} Hz (--pull): windows do not follow what a machine \
         pushes (--window)"
    ));
    let untestable = untestable(&screened);
    let located: Vec<Located> = before.located(None);
    let law = left::law(&rest);
    let verdict = match &named.effects[..] {
        _ if law => Verdict::Unknown,
        [] => Verdict::None,
        all if all.iter().any(|e| e.class.len() > 1) => Verdict::Ambiguous,
        _ => Verdict::Effect,
    };
    let chosen = fitted.chosen();
    Ok(Outcome {
        model: repair::repaired((input.model, &fitted.machine.built), problem, x, &chosen)?,
        extended: fitted.machine.built.file.xml.clone(),
        rules: repair::rules(&fitted.machine.built),
        answer: Answer {
            verdict,
            next_experiment: super::name::next_experiment(&named.effects, &untestable),
            effects: named.effects,
            located,
            gap,
            untestable,
            model: "model.xml".into(),
            n_candidates: forward::tests(&screened),
            evidence: screened.iter().map(|c| tested(&judge, c)).collect(),
            left: rest,
            remaining,
            round_trip,
            window_s: length_s,
            n_windows: before.origin.len(),
        },
        machines: [before_machine.model, after_machine.model],
        missing: [
            Some(MissingSeries::new(&before)),
            Some(MissingSeries::new(&last)),
        ],
    })
}

/// The base model, fitted.
fn begin<'a>(
    input: &Input<'a>,
    problems: &'a Problems,
    hz: f64,
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
) -> Result<(Judge<'a>, Fitted), GapError> {
    watch.way = format!("pulled at {hz} Hz");
    watch.stage(Stage::Fit);
    let known: Option<Fit> = stages::load(keeper, "nudged");
    let fit = if let Some(known) = known {
        known
    } else {
        let settings = NudgingSettings {
            hz,
            ..NudgingSettings::default()
        };
        let start = problems.train.parameters.start();
        let (x, spreads) =
            nudging::settle(&problems.train, &settings, &start, &mut |i| watch.fit(i))?;
        watch.go_on()?;
        let fit = Fit { x, spreads };
        stages::save(keeper, "nudged", &fit);
        fit
    };
    let mut judge = Judge::new(input, problems, hz, (&fit.x, &fit.spreads))?;
    let base = Point {
        written: Vec::new(),
        x: fit.x,
    };
    let base = linearised(&mut judge, base)?;
    Ok((judge, base))
}

/// A point with pulls of its own, and all its slopes.
fn linearised(judge: &mut Judge<'_>, point: Point) -> Result<Fitted, GapError> {
    let machine = judge.build(&point.written).ok_or_else(broken)?;
    judge.lead(&machine, &point.x)?;
    let ensemble = judge.linearise(&machine, &point)?;
    Ok(judge.fitted(machine, point, ensemble))
}

/// The same with all numbers of a fitted model fitted again, by slopes and pulls of each step's own, until an effect could
/// not count for what more steps take off; and the numbers of the last steps. With slopes of the model without the effect a
/// length that had stood for it stays where it was, and looks like an effect itself.
///
/// # Errors
/// The engine fails; the search is stopped.
fn settled(
    judge: &mut Judge<'_>,
    fitted: Fitted,
    watch: &mut Watch<'_>,
) -> Result<(Fitted, Vec<Vec<f64>>), GapError> {
    let little = forward::least_fall(judge.worth());
    judge.known.clear();
    let mut now = linearised(judge, fitted.point)?;
    judge.known = judge.known(&now);
    let mut tries = vec![now.point.x.clone()];
    for step in 0..MOST {
        watch.part(step, MOST);
        watch.go_on()?;
        let point = Point {
            x: judge.step(&now),
            written: now.point.written.clone(),
        };
        let fall = match linearised(judge, point) {
            Ok(next) if next.cost < now.cost + little => {
                let fall = now.cost - next.cost;
                tries.push(next.point.x.clone());
                now = next;
                fall
            }
            // pulls are led anew
            Ok(_) | Err(GapError::Sysid(_) | GapError::Input { .. }) => {
                now = linearised(judge, now.point)?;
                0.0
            }
            Err(error) => return Err(error),
        };
        if fall < little {
            break;
        }
    }
    let early = tries.len().saturating_sub(LAST);
    Ok((now, tries.split_off(early)))
}

/// Missing forces of the training recordings.
fn lacks(judge: &Judge<'_>, at: &Fitted, length_s: f64) -> Result<Missing, GapError> {
    missing::trained(judge, (&at.machine, &at.point), length_s)?.ok_or_else(broken)
}

/// Missing force of the held-out recordings, as a part of the motors'; none without any.
fn held(judge: &Judge<'_>, at: &Fitted, length_s: f64) -> Result<Option<f64>, GapError> {
    if judge.worth_held() == 0.0 {
        return Ok(None);
    }
    let missing: Option<Missing> = missing::missing(judge, (&at.machine, &at.point), length_s)?;
    Ok(missing.as_ref().and_then(missing::share))
}

/// Missing force of the held-out recordings by two models, as parts of the motors'.
fn pulls(hz: f64, (before, after): (f64, f64)) -> Holdout {
    Holdout {
        quantity: format!("force that pulls simulations along at {hz} Hz, of the motors'"),
        before: 100.0 * before,
        after: 100.0 * after,
        noise_floor: None,
        unit: "%".into(),
    }
}

fn tested(judge: &Judge<'_>, c: &Candidate) -> Tested {
    Tested {
        name: c.effect().about().name.to_owned(),
        at: c.place().to_string(),
        expected: c.values.clone(),
        gain: forward::part(c.gain, judge.worth()),
        p_value: c.p_value,
        visible: c.visible,
        size: None,
    }
}

fn untestable(all: &[Candidate]) -> Vec<Untestable> {
    let mut out = Vec::new();
    for c in all.iter().filter(|c| c.visible < LEAST_VISIBLE) {
        let reason = "the fitted parameters explain nearly all of it";
        list(&mut out, c.effect(), c.place(), reason);
    }
    out
}
