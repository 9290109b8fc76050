//! What these recordings cannot speak of.
//!
//! An effect is testable at a place if one of the usual size (the geometric mean of its range) would stand out there: from
//! what is left, as surely as a finding must, and above the least size of one, both as the last screen has them. What
//! fitted parameters absorb, or no recording excites, does not.

use super::candidate::Candidate;
use super::effect::{self, Effect, Place};
use super::forward::tests;
use super::model::variants;
use super::name;
use super::result::Untestable;
use super::score::two_sided;
use super::screen::{HARDLY_VISIBLE, Screen};
use super::search::Search;

/// Why: no recording shows it.
pub(super) const UNSHOWN: &str = "nothing that was recorded depends on it";

/// Why: the parameters that are estimated in any case say it.
const FITTED: &str = "the fitted parameters explain all of it";

/// Effects with the places where they are not testable; `screen` is of the model that the search ended with.
pub(super) fn untestable(search: &Search<'_>, screen: &Screen) -> Vec<Untestable> {
    let mut out = Vec::new();
    let n_tests = tests(screen);
    for (effect, place) in effect::candidates(&search.base.model) {
        let about = effect.about();
        let found = (screen.candidates.iter())
            .find(|c| c.effect.about().name == about.name && c.place == place);
        let reason = match found {
            _ if search.has(about.name, &place) => continue,
            None if about.is_variety() => continue, // looked at once there is dry friction
            None if is_fitted(search, effect, &place) => FITTED,
            None => UNSHOWN,
            Some(c) => match &c.score {
                None => FITTED,
                Some(s) if s.visible < HARDLY_VISIBLE => {
                    "the fitted parameters explain nearly all of it"
                }
                Some(_) if is_lost(search, c, n_tests) => {
                    "one of the usual size would not stand out"
                }
                Some(_) => continue,
            },
        };
        list(&mut out, effect, &place, reason);
    }
    out
}

/// Adds a place to a list of one line an effect and reason.
pub(super) fn list(out: &mut Vec<Untestable>, effect: &dyn Effect, place: &Place, reason: &str) {
    let name = effect.about().name;
    match (out.iter_mut()).find(|u| u.name == name && u.reason == reason) {
        Some(u) => u.at.push(place.to_string()),
        None => out.push(Untestable {
            name: name.to_owned(),
            at: vec![place.to_string()],
            reason: reason.to_owned(),
            behaviours: name::behaviours(name),
        }),
    }
}

/// Whether an effect would change a number that is estimated in any case, so that it does nothing.
fn is_fitted(search: &Search<'_>, effect: &dyn Effect, place: &Place) -> bool {
    let (built, problem) = (&search.built, &search.windows.problem);
    let scales = search.measured.scales(&built.file.model, place);
    let all = variants(effect.about().parameters, &scales);
    let own = problem.parameters.nominal();
    let mut each = all.iter().flat_map(|v| &v.columns);
    each.any(|(_, values)| {
        let written = effect::write(&built.file, effect, place, values).ok();
        let with = written.and_then(|w| problem.parameters_of(&w.file.model, &built.rules).ok());
        with.is_some_and(|with| with.nominal() != own)
    })
}

/// Whether an effect of the usual size would be overlooked, whichever of its parameters it shows in.
fn is_lost(search: &Search<'_>, candidate: &Candidate, n_tests: usize) -> bool {
    let Some(score) = &candidate.score else {
        return true;
    };
    let scales = (search.measured).scales(&search.built.file.model, &candidate.place);
    let parameters = candidate.effect.about().parameters;
    let strength: f64 = score.expected.iter().map(|e| e * e).sum::<f64>().sqrt();
    let numbers = candidate.parameters.iter().zip(&score.sigma);
    numbers.into_iter().all(|(&i, sigma)| {
        let usual = parameters[i].unit_size(&scales);
        let p = two_sided(usual / sigma, score.dof) * n_tests as f64;
        // a response grows with the effect
        let small = (candidate.size).is_some_and(|size| {
            score.expected.len() == 1 && size * usual < search.limits.size * strength
        });
        p > search.limits.family_p || small
    })
}

#[cfg(test)]
mod tests {
    use super::{FITTED, UNSHOWN, untestable};
    use crate::gap::masses::{machine, searching};

    /// Where an encoder begins to count, no motion of the two masses tells; a damping that is fitted is not of that kind.
    #[test]
    fn what_is_fitted_in_any_case_is_said_to_be() {
        let base = machine(r#"damping=".2""#, r#"damping=".2""#);
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &base, config, |search, _| {
            let screen = search.look().screen(&mut |_, _| true).expect("screened");
            let all = untestable(search, &screen.expect("not stopped"));
            let reason = |name: &str, at: &str| {
                let own = all
                    .iter()
                    .find(|u| u.name == name && u.at.contains(&at.to_owned()));
                own.map(|u| u.reason.as_str())
            };
            assert_eq!(reason("viscous_friction", "b"), Some(FITTED));
            assert_eq!(reason("viscous_friction", "a"), None);
            assert_eq!(reason("encoder_offset", "b"), Some(UNSHOWN));
        });
    }
}
