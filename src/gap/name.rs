//! What to call what was found, and how sure.
//!
//! Two effects look alike on given recordings if their columns point the same way. An effect j takes the place of k
//! (t of k, ρ the cosine between what is their own) at the price of
//!
//! ```text
//! d² = t² (1 − ρ²)        class of k: every j with d² < 9        P(k) = (1 − p) / (1 + Σⱼ e^(−dⱼ²/2))
//! ```
//!
//! in units of the noise that the recordings show ([`super::score`]), the shapes of k held: where on a body a payload sits
//! may be anybody's guess though something is plainly there, and then nothing would be told from it.

use nalgebra::DVector;

use super::alike::Rival;
use super::effect::{Form, Role, Sign, named};
use super::even::Evened;
use super::evidence::Evidence;
use super::lookalike::InPlace;
use super::model::Chosen;
use super::result::{Experiment, Named, Untestable, Value, Where};
use super::score::Normal;
use super::screen::Screen;
use super::search::Search;
use super::untestable::UNSHOWN;
use crate::sysid::student::two_sided_t;

/// Squared separation below which two effects are one class.
pub(super) const APART: f64 = 9.0;

/// Names every effect in the model of `search`. `screen` is of that model, `step` what its own step makes of every free
/// parameter. Numbers are those of `evened` if these predict, with intervals that span what both fits say.
pub(super) fn name(
    search: &Search<'_>,
    evened: Option<&Evened>,
    screen: &Screen,
    step: Option<&DVector<f64>>,
) -> Vec<Named> {
    let free = search.built.free(&search.windows.problem);
    let numbers = match evened {
        Some(own) if own.predicts => &own.chosen,
        _ => &search.chosen,
    };
    let mut out = Vec::new();
    for (i, chosen) in search.chosen.iter().enumerate() {
        let about = chosen.effect.about();
        let scales = search
            .measured
            .scales(&search.built.file.model, &chosen.place);
        let even = evened.map(|own| (&own.chosen[i], &own.normal));
        let mut parameters = Vec::new();
        for (p, parameter) in about.parameters.iter().enumerate() {
            let value = numbers[i].values[p];
            let number = free.iter().find(|f| f.1 == i && f.2 == p);
            let ci95 = number.map(|(j, _, _, slope)| {
                let by_step = step.map_or(0.0, |dx| dx[*j] * slope);
                let span = |own: &Chosen, normal: &Normal| {
                    let (sigma, dof) = normal.fitted(*j);
                    let half =
                        two_sided_t(0.95, dof.max(1.0)) * sigma * slope.abs() + by_step.abs();
                    let (with, without) = (own.values[p], own.values[p] + by_step);
                    [with.min(without) - half, with.max(without) + half]
                };
                let [mut low, mut high] = span(chosen, &screen.normal);
                if let Some((own, normal)) = even {
                    let other = span(own, normal);
                    (low, high) = (low.min(other[0]), high.max(other[1]));
                }
                let [least, most] = match (parameter.role, parameter.sign) {
                    // nothing beyond was looked at: wider, it is not determined
                    (Role::Shape(_), _) => parameter.sensible(&scales),
                    (_, Sign::Positive) => [0.0, f64::INFINITY],
                    _ => [f64::NEG_INFINITY, f64::INFINITY],
                };
                [low.max(least), high.min(most)]
            });
            if parameter.role == Role::Companion {
                continue;
            }
            parameters.push(Value {
                name: parameter.name.to_owned(),
                value,
                ci95,
                unit: parameter.unit(&scales).to_owned(),
            });
        }
        let others = class(search, screen, i).iter().map(Rival::said).collect();
        let said = (chosen, search.built.forms[i]);
        out.push(called(said, parameters, &search.evidence[i], others));
    }
    out
}

/// What could stand in the place of effect `i` of `search`, `screen` being of its model, most alike first.
pub(super) fn class(search: &Search<'_>, screen: &Screen, i: usize) -> Vec<Rival> {
    let mut all = search.evidence[i].alike.clone();
    let Some(place) = InPlace::of(search, screen, i) else {
        return all;
    };
    for c in &screen.candidates {
        let Some(instead) = place.instead(c).filter(|own| own.separation < APART) else {
            continue;
        };
        let own = c.with(instead.values);
        if !all.iter().any(|rival| rival.is(&own)) {
            all.push(Rival::of(&own, instead.separation));
        }
    }
    all.sort_by(|a, b| a.separation.total_cmp(&b.separation));
    all
}

/// An effect with its class: itself, and those `alike` that could stand in its place.
pub(super) fn called(
    (chosen, form): (&Chosen, Form),
    parameters: Vec<Value>,
    evidence: &Evidence,
    alike: Vec<Where>,
) -> Named {
    let about = chosen.effect.about();
    let mut class = vec![about.name.to_owned()];
    for other in &alike {
        if !class.contains(&other.name) {
            class.push(other.name.clone());
        }
    }
    let rest: f64 = alike.iter().map(|a| f64::exp(-0.5 * a.separation)).sum();
    Named {
        name: about.name.to_owned(),
        at: chosen.place.to_string(),
        class,
        probability: (1.0 - evidence.p_value).max(0.0) / (1.0 + rest),
        p_value: evidence.p_value,
        parameters,
        expressed_as: match form {
            Form::Mjcf => "mjcf",
            Form::Supplement => "supplement",
        },
        law: about.law.to_owned(),
        gain: evidence.gain,
        size: evidence.size,
        decoys: None,
        alike,
    }
}

/// Behaviours that show any of these effects.
pub(super) fn behaviours_of(names: &[String]) -> Vec<String> {
    let mut all: Vec<String> = Vec::new();
    for shown in names.iter().flat_map(|name| behaviours(name)) {
        if !all.contains(&shown) {
            all.push(shown);
        }
    }
    all
}

/// Behaviours that show an effect.
pub(super) fn behaviours(name: &str) -> Vec<String> {
    named(name).map_or_else(Vec::new, |e| {
        e.about()
            .behaviours
            .iter()
            .map(|b| (*b).to_owned())
            .collect()
    })
}

/// What splits the first two of a class that the catalogue knows how to tell apart.
pub(super) fn splitting(class: &[String]) -> Option<Experiment> {
    let of = |x: &str, y: &str| {
        let mut neighbours = named(x)?.about().neighbours.iter();
        neighbours.find(|n| n.name == y).map(|n| n.split)
    };
    let mut pairs = (class.iter().enumerate())
        .flat_map(|(i, a)| class[i + 1..].iter().map(move |b| [a.clone(), b.clone()]));
    let (split, pair) =
        pairs.find_map(|[a, b]| Some((of(&a, &b).or_else(|| of(&b, &a))?, [a, b])))?;
    Some(Experiment {
        behaviours: behaviours_of(&pair),
        effects: pair.to_vec(),
        motion: split.to_owned(),
        expected: Vec::new(),
    })
}

/// What splits the first class that the catalogue knows how to; else what shows most of what could not be tested.
pub(super) fn next_experiment(effects: &[Named], untestable: &[Untestable]) -> Option<Experiment> {
    let mut classes = effects.iter().filter(|e| e.class.len() > 1);
    let split = classes.find_map(|e| splitting(&e.class));
    split.or_else(|| showing(untestable))
}

/// What shows most of what could not be tested.
fn showing(untestable: &[Untestable]) -> Option<Experiment> {
    let hidden: Vec<&Untestable> = untestable.iter().filter(|u| u.reason == UNSHOWN).collect();
    let mut counts: Vec<(String, usize)> = Vec::new();
    for b in hidden.iter().flat_map(|u| &u.behaviours) {
        match counts.iter_mut().find(|c| c.0 == *b) {
            Some(c) => c.1 += 1,
            None => counts.push((b.clone(), 1)),
        }
    }
    let (behaviour, _) = counts.into_iter().rev().max_by_key(|c| c.1)?;
    let shown = hidden.iter().filter(|u| u.behaviours.contains(&behaviour));
    Some(Experiment {
        effects: shown.map(|u| u.name.clone()).collect(),
        motion: format!("behaviour `{behaviour}`, in which these effects would show"),
        behaviours: vec![behaviour],
        expected: Vec::new(),
    })
}
