//! The whole workflow, in memory.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::cuts::Cuts;
use super::effect::ModelFile;
use super::inputs::{excited, wanted};
use super::locate::Missing;
use super::null::Null;
use super::result::{Answer, Remaining, Tested, Verdict};
use super::screen::Screen;
use super::search::{Limits, Search};
use super::stages::{self, Fit, Keeper, Nowhere, Screened, Step};
use super::verify;
use super::{
    GapError, Report, Stage, Watch, afresh, left, name, next, nudged, repair, round_trip, toss,
    untestable,
};
use crate::compare::Settings;
use crate::recording::Recording;
use crate::sysid::parameter::ParameterRule;
use crate::sysid::problem::ProblemConfig;

/// Effects after which a search that explains little is given up, where there is another: the second may show that the
/// first stood for it.
const GLANCE: usize = 2;

/// What to look at.
#[derive(Debug, Clone, Copy)]
pub struct Input<'a> {
    /// base model
    pub model: &'a ModelFile,
    /// what is fitted anyway, noise, norms
    pub config: &'a ProblemConfig,
    /// to find and fit, with names
    pub train: &'a [(String, Recording)],
    /// to verify, with names
    pub holdout: &'a [(String, Recording)],
    /// how held-out recordings are compared
    pub protocol: &'a Settings,
}

/// How to look.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// most effects, the same at several places counted once
    pub max_effects: usize,
    /// of draws
    pub seed: u64,
    /// what an effect has to reach
    pub limits: Limits,
    /// most windows of the training recordings
    pub most_windows: usize,
    /// s of a window; none: from the data
    pub window_s: Option<f64>,
    /// Hz at which simulations are pulled along the recordings; none: those of machines that push or press a body, if no
    /// window is asked for
    pub pull_hz: Option<f64>,
    /// s of the steps of simulations; none: the model's, of pulled ones longer ones where contacts allow
    pub timestep_s: Option<f64>,
    /// names of the effects to look for; none: all
    pub effects: Vec<String>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            max_effects: 4,
            seed: 0,
            limits: Limits::default(),
            most_windows: 240,
            window_s: None,
            pull_hz: None,
            timestep_s: None,
            effects: Vec::new(),
        }
    }
}

/// The answer, and what it was made from.
#[derive(Debug)]
pub struct Outcome {
    /// to be written
    pub answer: Answer,
    /// text of the repaired model
    pub model: String,
    /// text of the base model with the effects alone: its own numbers are as they were
    pub extended: String,
    /// what is estimated of both by [`crate::sysid`], numbers of the effects beginning where they are
    pub rules: Vec<ParameterRule>,
    /// the model before and after, with fitted numbers
    pub machines: [Arc<crate::mujoco::Model>; 2],
    /// missing forces before and after, for figures
    pub missing: [Option<MissingSeries>; 2],
}

/// Missing force at every joint over the windows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MissingSeries {
    /// joints
    pub joints: Vec<String>,
    /// of the forces
    pub units: Vec<String>,
    /// per joint (windows)
    pub force: Vec<Vec<f64>>,
    /// per joint (windows)
    pub velocity: Vec<Vec<f64>>,
}

impl MissingSeries {
    pub(super) fn new(missing: &Missing) -> Self {
        let column = |m: &nalgebra::DMatrix<f64>, j: usize| m.column(j).iter().copied().collect();
        let n = missing.joints.len();
        Self {
            joints: missing.joints.clone(),
            units: missing.units.iter().map(|u| (*u).to_owned()).collect(),
            force: (0..n).map(|j| column(&missing.force, j)).collect(),
            velocity: (0..n).map(|j| column(&missing.velocity, j)).collect(),
        }
    }
}

/// Finds, names, adds and verifies what the model lacks. `report` is told what happens and stops the work by `false`.
///
/// # Errors
/// Input that does not fit together; [`GapError::Stopped`].
pub fn run(input: &Input<'_>, options: &Options, report: Report<'_>) -> Result<Outcome, GapError> {
    resume(input, options, &mut Nowhere, report)
}

/// As [`run()`], from the stages that `keeper` has; finished ones are given to it.
///
/// # Errors
/// As [`run()`].
pub fn resume(
    input: &Input<'_>,
    options: &Options,
    keeper: &mut dyn Keeper,
    report: Report<'_>,
) -> Result<Outcome, GapError> {
    let mut watch = Watch::new(report);
    let (hz, paced) = way(input, options)?;
    let Some(paced) = paced else {
        return by_method(input, options, hz, keeper, &mut watch);
    };
    let own = Input {
        model: &paced,
        ..*input
    };
    let mut outcome = by_method(&own, options, hz, keeper, &mut watch)?;
    let own_s = input.model.model.timestep();
    outcome.answer.gap.notes.push(format!(
        "simulated in steps of {} s, the model's own being {own_s} s (--timestep)",
        paced.model.timestep()
    ));
    // files keep their own
    for text in [&mut outcome.model, &mut outcome.extended] {
        let found = ModelFile::of_text(std::mem::take(text), &input.model.path)?;
        *text = found.paced(own_s)?.xml;
    }
    Ok(outcome)
}

/// Hz at which simulations are pulled along the recordings, if they are, and the model in other steps than its own, if it is
/// simulated in such.
///
/// # Errors
/// Input that does not fit together.
pub(super) fn way(
    input: &Input<'_>,
    options: &Options,
) -> Result<(Option<f64>, Option<ModelFile>), GapError> {
    let hz = match (options.pull_hz, options.window_s) {
        _ if input.protocol.drop.is_some() => None,
        (None, None) => nudged::is_pushing(input)?.then_some(nudged::USUAL_HZ),
        (hz, _) => hz,
    };
    let pulled = hz.and_then(|_| nudged::longer_steps(&input.model.model));
    let timestep_s = options.timestep_s.or(pulled);
    let paced = timestep_s.map(|step| input.model.paced(step)).transpose()?;
    Ok((hz, paced))
}

/// By whole rollouts, by simulations that are pulled at `hz`, or in windows.
fn by_method(
    input: &Input<'_>,
    options: &Options,
    hz: Option<f64>,
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
) -> Result<Outcome, GapError> {
    if input.protocol.drop.is_some() {
        toss::resume(input, options, keeper, watch)
    } else if let Some(hz) = hz {
        nudged::resume(input, options, hz, keeper, watch)
    } else {
        afresh::search(input, options, keeper, watch)
    }
}

/// The search in windows of one length; nothing if its first effects leave more than the part `enough` of what was
/// missing.
///
/// # Errors
/// As [`run()`].
pub(super) fn at_length(
    input: &Input<'_>,
    options: &Options,
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
    enough: Option<f64>,
) -> Result<Option<Outcome>, GapError> {
    watch.note.clear();
    let (cuts, mut search) = begin(input, options, keeper, watch)?;
    let first_s = search.windows.length_s;
    search.held_out = cuts.held_out(first_s)?;
    let before = repair::machine(&search.windows.problem, &search.x)?;
    let mut screen: Option<Screen> = None;
    let known: Option<Screened> = stages::load(keeper, "screen");
    let first = if let Some(known) = known {
        known
    } else {
        let found = search.screened(watch)?;
        watch.stage(Stage::Locate);
        let missing = Missing::new(&search.windows, &search.x, &found, &search.stretch_of)?;
        let without = search.windows.without_steps(&search.x, &found.linear)?;
        let null = Null::new(&search, &found, without.as_ref(), options.seed);
        let first = Screened {
            located: missing.located(Some(&null)),
            evidence: tested(&found),
            n_candidates: super::forward::tests(&found),
            remaining: search.remaining(&found.linear, found.motors.as_deref()),
            missing: MissingSeries::new(&missing),
        };
        stages::save(keeper, "screen", &first);
        screen = Some(found);
        first
    };
    for n in 1..=options.max_effects {
        watch.note = format!("effect {n}");
        let name = format!("effect-{n}");
        let mut known = None;
        if let Some(step) = stages::load::<Step>(keeper, &name) {
            let more = !step.ended;
            if step.restore(&mut search, &cuts)? {
                (screen, known) = (None, Some(more));
            }
        }
        let more = if let Some(more) = known {
            more
        } else {
            screen = search.forward(screen.take(), watch)?;
            if screen.is_none() {
                search.at_home(watch)?;
            }
            // what short windows do not show may show in longer ones
            let longer = !search.chosen.is_empty() && search.lengthen(&cuts, watch)?;
            if longer && screen.is_some() {
                screen = search.forward(None, watch)?;
            }
            let more = screen.is_none();
            if more {
                search.delete(watch)?;
                screen = search.elsewhere(watch)?;
            }
            watch.go_on()?;
            stages::save(keeper, &name, &Step::of(&search, !more));
            more
        };
        if let Some(part) = enough
            && (!more || n == GLANCE)
            && !search.takes(part, first.remaining)?
        {
            return Ok(None);
        }
        if !more {
            break;
        }
    }
    watch.note.clear();
    let screen = match screen {
        Some(present) => present,
        None => search.screened(watch)?,
    };
    let without = search.windows.without_steps(&search.x, &screen.linear)?;
    let by_steps = (without.as_ref()).map(|own| search.cost_without_steps(own));
    let longer = search.windows.length_s > first_s;
    let exchanged = search.tell_apart(&screen, (by_steps, longer), watch)?;
    // what was found later may do the work of what was found before
    let again = if search.delete(watch)? || exchanged {
        Some(search.screened(watch)?)
    } else {
        None
    };
    watch.go_on()?;
    let (screen, without, by_steps) = match &again {
        Some(again) => {
            let without = search.windows.without_steps(&search.x, &again.linear)?;
            let by_steps = (without.as_ref()).map(|own| search.cost_without_steps(own));
            (again, without, by_steps)
        }
        None => (&screen, without, by_steps),
    };
    watch.stage(Stage::Name);
    let step = without.map(|own| own.error(&screen.normal));
    let evened = if search.chosen.is_empty() {
        None
    } else {
        Some(search.evened(&screen.linear)?)
    };
    let mut effects = name::name(&search, evened.as_ref(), screen, step.as_ref());
    for (effect, decoys) in effects.iter_mut().zip(search.decoys()?) {
        effect.decoys = decoys;
    }
    let last = Missing::new(&search.windows, &search.x, screen, &search.stretch_of)?;
    let remaining = Remaining {
        before: first.remaining,
        after: search.remaining(&screen.linear, screen.motors.as_deref()),
    };
    let untestable = untestable::untestable(&search, screen);
    let much = left::much(&remaining);
    let rest = left::left(&last, much);
    if let Some(evened) = evened {
        search.take_numbers(evened);
    }
    watch.stage(Stage::Verify);
    let round_trip = if effects.is_empty() {
        None
    } else {
        round_trip::round_trip(&search, options.seed, watch)?
    };
    watch.stage(Stage::Verify);
    let after = repair::machine(&search.windows.problem, &search.x)?;
    let mut gap = verify::verify(
        &before,
        &after,
        input.holdout,
        &verify::protocol(input, &cuts.whole, search.windows.length_s, &after.model),
        &|channel| verify::noise(&cuts.whole, channel),
        options.seed,
    )?;
    if let Some(part) = by_steps.and_then(|change| search.part_of_steps(change)) {
        gap.notes.push(format!(
            "steps of {} s make {:.0} % of what is left: a shorter timestep of the model would show more",
            search.windows.problem.model.timestep(),
            100.0 * part
        ));
    }
    gap.notes.extend(search.windows.left_out());
    for effect in &effects {
        if effect
            .decoys
            .is_some_and(|decoys| decoys.best >= decoys.own)
        {
            gap.notes.push(format!(
                "{} at {} takes no more off than a decoy of its size",
                effect.name, effect.at
            ));
        }
    }
    let lost = search.windows.length_s < cuts.length_s;
    let misled = left::misled(&gap, &remaining, options.limits.size);
    let absurd = search.absurd(&search.built, &search.chosen);
    let more = lost || much || misled || absurd || left::law(&rest);
    let structure = !rest.is_empty() || left::most(&gap);
    let verdict = verdict(&effects, structure, more);
    let found = (&*effects, &*untestable);
    let next_experiment = next::experiment(&search, screen, found, watch)?;
    let (built, problem) = (&search.built, &search.windows.problem);
    let model = repair::repaired((input.model, built), problem, &search.x, &search.chosen)?;
    let mut rules = repair::rules(built);
    // what is estimated next has what is known, whether it was held against effects or not
    for (rule, own) in rules.iter_mut().zip(&input.config.parameter) {
        rule.prior_sigma = own.prior_sigma;
    }
    Ok(Some(Outcome {
        rules,
        extended: search.built.file.xml.clone(),
        answer: Answer {
            verdict,
            effects,
            located: first.located,
            gap,
            untestable,
            next_experiment,
            model: "model.xml".into(),
            evidence: first.evidence,
            left: rest,
            remaining,
            round_trip,
            window_s: search.windows.length_s,
            n_windows: search.windows.len(),
            n_candidates: first.n_candidates,
        },
        model,
        machines: [before.model, after.model],
        missing: [Some(first.missing), Some(MissingSeries::new(&last))],
    }))
}

/// The recordings, and the search with the base model fitted to their windows.
///
/// # Errors
/// Input that does not fit together.
pub(super) fn begin<'a>(
    input: &Input<'a>,
    options: &Options,
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
) -> Result<(Cuts, Search<'a>), GapError> {
    watch.stage(Stage::Fit);
    let effects = wanted(&options.effects, &input.model.model)?;
    let cuts = Cuts::new(input, options)?;
    let of = (input.model, input.config.parameter.as_slice());
    let limits = (options.limits, effects);
    if let Some(known) = stages::load::<Fit>(keeper, "fit") {
        let mut cut = cuts.train(known.length_s)?;
        let noise = cut.problem.sigma();
        if let Some(at) = known.restore(&mut cut) {
            return Ok((cuts, Search::at(of, cut, limits, noise, at)?));
        }
    }
    let mut search = Search::new(of, cuts.followed()?, &limits, watch)?;
    search.lengthen(&cuts, watch)?;
    watch.go_on()?;
    excited(&search)?;
    let fit = Fit::of(&search.windows, &search.x, search.cost);
    stages::save(keeper, "fit", &fit);
    Ok((cuts, search))
}

/// `structure` is left, which effects may have left, or `more` than was found is missing.
fn verdict(effects: &[super::result::Named], structure: bool, more: bool) -> Verdict {
    match effects {
        _ if more => Verdict::Unknown,
        [] if structure => Verdict::Unknown,
        [] => Verdict::None,
        _ if effects.iter().any(|e| e.class.len() > 1) => Verdict::Ambiguous,
        _ => Verdict::Effect,
    }
}

/// The first screen, best first.
fn tested(screen: &Screen) -> Vec<Tested> {
    let cost = screen.normal.cost().max(f64::MIN_POSITIVE);
    let mut out: Vec<(f64, Tested)> = (screen.candidates.iter())
        .filter_map(|c| {
            let s = c.score.as_ref()?;
            let line = Tested {
                name: c.effect.about().name.to_owned(),
                at: c.place.to_string(),
                expected: c.values.clone(),
                gain: s.gain / cost,
                p_value: s.p_value,
                visible: s.visible,
                size: c.size,
            };
            Some((
                if c.sensible {
                    s.held_gain
                } else {
                    f64::NEG_INFINITY
                },
                line,
            ))
        })
        .collect();
    out.sort_by(|a, b| b.0.total_cmp(&a.0));
    out.into_iter().map(|(_, t)| t).collect()
}
