//! What to call what was found: every effect against its neighbours of the catalogue.
//!
//! Each neighbour takes the place of an effect, in its own best size, everything else as it is. With t of the fall of
//! deviations from the neighbour to the effect, trial by trial, it belongs to the class if t² < 9, and
//!
//! ```text
//! P = (1 − p) / (1 + Σⱼ e^(−tⱼ²/2))
//! ```

use super::forward::{Candidate, candidates, screen, zoom};
use super::judge::{Judge, Polished, difference};
use super::rest::Size;
use crate::gap::effect::{Form, Role, Scales, Sign, are_neighbours};
use crate::gap::evidence::Evidence;
use crate::gap::model::Chosen;
use crate::gap::name::{APART, called};
use crate::gap::result::{Named, Value, Where};
use crate::gap::{GapError, Stage, Watch};
use crate::sysid::interval::Posterior;

/// Names of all effects of the model.
pub(super) fn name(
    judge: &Judge<'_>,
    polished: &Polished,
    kept: &[Evidence],
    watch: &mut Watch<'_>,
) -> Result<Vec<Named>, GapError> {
    let chosen = &polished.seen.point.chosen;
    let intervals = intervals(polished);
    let mut out = Vec::new();
    for (i, (own, kept)) in chosen.iter().zip(kept).enumerate() {
        let about = own.effect.about();
        about.name.clone_into(&mut watch.note);
        let alike = alike(judge, polished, i, watch)?;
        let parameters = values(judge, own, &intervals[i]);
        let said = (own, polished.built.forms[i]);
        out.push(called(said, parameters, kept, alike));
    }
    watch.note.clear();
    Ok(out)
}

/// The name of a size that is off.
pub(super) fn size(judge: &Judge<'_>, size: &Size) -> Option<Named> {
    let chosen = size.chosen()?;
    let parameters = values(judge, &chosen, &[(0, size.ci95)]);
    let evidence = Evidence {
        p_value: size.p_value,
        gain: 0.0,
        size: None,
        alike: Vec::new(),
    };
    Some(called(
        (&chosen, Form::Mjcf),
        parameters,
        &evidence,
        Vec::new(),
    ))
}

fn values(judge: &Judge<'_>, chosen: &Chosen, intervals: &[(usize, [f64; 2])]) -> Vec<Value> {
    let scales = Scales::of(&judge.base.model, &chosen.place);
    let parameters = chosen.effect.about().parameters.iter().enumerate();
    parameters
        .filter(|(_, p)| p.role != Role::Companion)
        .map(|(i, p)| Value {
            name: p.name.to_owned(),
            value: chosen.values[i],
            ci95: intervals
                .iter()
                .find(|own| own.0 == i)
                .map(|own| match p.sign {
                    Sign::Positive => own.1.map(|end| end.max(0.0)),
                    Sign::Either => own.1,
                }),
            unit: p.unit(&scales).to_owned(),
        })
        .collect()
}

/// 95 % intervals of the parameters of every effect, by their index, as far as they are estimated.
pub(super) fn intervals(polished: &Polished) -> Vec<Vec<(usize, [f64; 2])>> {
    let Polished {
        problem,
        fit,
        built,
        seen,
    } = polished;
    let lengths: Vec<usize> = problem.trials.iter().map(|t| t.n_knots).collect();
    let posterior = Posterior::new(&problem.parameters, &fit.x, &fit.innovations, &lengths);
    let mut out = vec![Vec::new(); seen.point.chosen.len()];
    let first = posterior.estimates.len() - built.estimated.len();
    for ((effect, e), estimate) in built.estimated.iter().zip(&posterior.estimates[first..]) {
        if let Some(ends) = estimate.interval {
            let [a, b] = ends.map(|end| e.value_of(end));
            out[*effect].push((e.parameter, [a.min(b), a.max(b)]));
        }
    }
    out
}

/// Neighbours that could stand in the place of effect `i`.
fn alike(
    judge: &Judge<'_>,
    polished: &Polished,
    i: usize,
    watch: &mut Watch<'_>,
) -> Result<Vec<Where>, GapError> {
    let own = &polished.seen.point.chosen[i];
    let mut point = polished.seen.point.clone();
    point.chosen.remove(i);
    let Some(without) = judge.see(point)? else {
        return Ok(Vec::new());
    };
    let others: Vec<Candidate> = candidates(judge, &polished.seen.point.chosen, &[])
        .into_iter()
        .filter(|c| are_neighbours(c.effect, own.effect))
        .collect();
    let tried = screen(judge, &without, &others, watch)?;
    watch.stage(Stage::Name);
    let mut out = Vec::new();
    for tried in tried.into_iter().filter(|t| t.shows) {
        let tried = zoom(judge, tried, watch)?;
        let fall = difference(&tried.seen.rollouts, &polished.seen.rollouts);
        let separation = fall.map_or(0.0, |f| f.t.max(0.0).powi(2));
        if separation < APART {
            let (effect, place) = (tried.candidate.effect, &tried.candidate.place);
            out.push(Where::of(effect, place, separation));
        }
    }
    Ok(out)
}
