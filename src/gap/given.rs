//! Effects that are given instead of searched for: what a search could reach at best.

use super::candidate::Candidate;
use super::effect::{self, Place};
use super::result::Gap;
use super::run::{self, Input, Options};
use super::search::{ITERATIONS, Search};
use super::stages::Keeper;
use super::{GapError, Report, Watch, nudged, repair, verify};
use crate::mujoco::Model;

/// What a search could reach at best.
#[derive(Debug, Clone)]
pub struct Oracle {
    /// before and after
    pub gap: Gap,
    /// How far the training recordings are from what a model without one of the effects can do, in standard deviations of
    /// what the true structure leaves of them: `d² = 2 (C − C′)`, C of the model with all effects but that one, C′ of the
    /// true structure, both fitted with channels weighed by what the latter leaves. The least of all effects; none where a
    /// model without one cannot be simulated.
    pub detectability: Option<f64>,
}

/// `effects` (name, place) fitted to the training recordings; none where one of them cannot act or be seen. What `keeper` has
/// of a search with the same input is not done again.
///
/// # Errors
/// As [`run::run`].
pub fn with_effects(
    input: &Input<'_>,
    options: &Options,
    effects: &[(String, String)],
    keeper: &mut dyn Keeper,
    report: Report<'_>,
) -> Result<Option<Oracle>, GapError> {
    let mut watch = Watch::new(report);
    let (hz, paced) = run::way(input, options)?;
    let input = &Input {
        model: paced.as_ref().unwrap_or(input.model),
        ..*input
    };
    match hz {
        Some(hz) => nudged::with_effects(input, hz, effects, keeper, &mut watch),
        None => in_windows(input, options, effects, keeper, &mut watch),
    }
}

fn in_windows(
    input: &Input<'_>,
    options: &Options,
    effects: &[(String, String)],
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
) -> Result<Option<Oracle>, GapError> {
    let (cuts, mut search) = run::begin(input, options, keeper, watch)?;
    let before = repair::machine(&search.windows.problem, &search.x)?;
    let levels = levels(effects, &search.built.file.model);
    add(&mut search, &levels, watch)?;
    let first = search.chosen.len();
    if add(&mut search, effects, watch)? < effects.len() {
        return Ok(None);
    }
    if !search.lengthen(&cuts, watch)? {
        search.settle(watch)?;
    }
    let mut costs = Vec::new();
    for i in first..search.chosen.len() {
        let mut others = search.chosen.clone();
        others.remove(i);
        costs.push(search.fitted(&others, ITERATIONS, watch)?.map(|f| f.cost));
    }
    let after = repair::machine(&search.windows.problem, &search.x)?;
    let sigma = |_: &str| None;
    let (holdout, seed) = (input.holdout, options.seed);
    let protocol = verify::protocol(input, &cuts.whole, search.windows.length_s, &after.model);
    let gap = verify::verify(&before, &after, holdout, &protocol, &sigma, seed)?;
    Ok(Some(Oracle {
        gap,
        detectability: least(search.cost, costs),
    }))
}

/// The dry friction that varieties of it among `effects` vary, where `model` has none.
fn levels(effects: &[(String, String)], model: &Model) -> Vec<(String, String)> {
    let asked = |name: &str, place: &Place| {
        let own = place.to_string();
        (effects.iter()).any(|(effect, at)| effect == name && is_place(&own, at))
    };
    (effect::candidates(model).into_iter())
        .filter(|(e, p)| e.about().is_variety() && asked(e.about().name, p) && !p.is_dry(model))
        .map(|(_, place)| (effect::DRY.to_owned(), place.to_string()))
        .collect()
}

/// Fits the model with those of `effects` beside what it has that a screen has; how many.
fn add(
    search: &mut Search<'_>,
    effects: &[(String, String)],
    watch: &mut Watch<'_>,
) -> Result<usize, GapError> {
    if effects.is_empty() {
        return Ok(0);
    }
    let screen = search.screened(watch)?;
    let is = |c: &&Candidate, (name, place): &(String, String)| {
        c.effect.about().name == name && is_place(&c.place.to_string(), place) && c.score.is_some()
    };
    let given: Vec<&Candidate> = (effects.iter())
        .filter_map(|asked| screen.candidates.iter().find(|c| is(c, asked)))
        .collect();
    let fitted = search.fitted_with(&given, &screen, (ITERATIONS, f64::INFINITY), watch)?;
    Ok(fitted.map_or(0, |fitted| {
        search.take(fitted);
        given.len()
    }))
}

/// The least detectability, of a true structure that leaves `cost`, where models without one effect leave `without`.
pub(super) fn least(cost: f64, without: Vec<Option<f64>>) -> Option<f64> {
    let of = |own: f64| (2.0 * (own - cost)).max(0.0).sqrt();
    let each: Option<Vec<f64>> = without.into_iter().collect();
    each?.into_iter().map(of).reduce(f64::min)
}

/// Places by name; the two joints of a coupling in either order, and a contact of two geoms by one of them.
pub fn is_place(a: &str, b: &str) -> bool {
    a == b
        || match (a.split_once('+'), b.split_once('+')) {
            (Some((a, b)), Some((c, d))) => (a, b) == (d, c),
            (Some((c, d)), None) => b == c || b == d,
            (None, Some((c, d))) => a == c || a == d,
            (None, None) => false,
        }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::effect::write;
    use crate::gap::masses::{chosen, machine, searching};

    /// Friction that falls with speed, at a joint that has none in the model.
    #[test]
    fn a_variety_of_friction_is_fitted_beside_friction() {
        let hidden = [0.2, 0.0, 0.05];
        let dry = machine(r#"damping=".2" frictionloss=".15""#, "");
        let law = chosen(&dry, "stribeck_friction", "a", &hidden);
        let machine_with = write(&dry, law.effect, &law.place, &hidden).expect("written");
        let base = machine(r#"damping=".2""#, "");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"damping\"\n";
        searching(&base, &machine_with.file, config, |search, watch| {
            let asked = [("stribeck_friction".to_owned(), "a".to_owned())];
            assert_eq!(add(search, &asked, watch).expect("looked for"), 0);
            let levels = levels(&asked, &base.model);
            assert_eq!(add(search, &levels, watch).expect("fitted"), 1);
            assert!(super::levels(&asked, &dry.model).is_empty());
            assert_eq!(add(search, &asked, watch).expect("fitted"), 1);
            let excess = search.chosen[1].values[0];
            assert!((excess / hidden[0] - 1.0).abs() < 0.2, "{excess}");
        });
    }
}
