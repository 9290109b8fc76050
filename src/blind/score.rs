//! One answer against the sealed truth.
//!
//! | word | meaning |
//! | --- | --- |
//! | detected | anything was named, or `unknown` said |
//! | class | every hidden effect is in the class of one that was named at its place |
//! | exact | and is its first name |
//! | closed | (before − after)/(before − oracle) of the held-out error, where the oracle fits the true structure |
//! | detectability | how far the recordings are from what a model without one of the effects can do, see [`Oracle`] |

use serde::{Deserialize, Serialize};

use super::suite::{Arm, Case, Expect, SuiteConfig};
use crate::gap::result::{Answer, Named, Verdict};
use crate::gap::{Oracle, effect, is_place};
use crate::rig::Truth;

/// A number that was hidden, and its interval.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Covered {
    /// effect
    pub effect: String,
    /// hidden
    pub truth: f64,
    /// found
    pub value: f64,
    /// 95 % interval
    pub ci95: [f64; 2],
}

impl Covered {
    /// Whether the truth is inside.
    pub fn inside(&self) -> bool {
        (self.ci95[0]..=self.ci95[1]).contains(&self.truth)
    }
}

/// An effect at a place.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct At {
    /// effect
    pub name: String,
    /// place, without its kind
    #[serde(rename = "where")]
    pub place: String,
}

/// What came of one case.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[allow(
    clippy::struct_excessive_bools,
    reason = "independent yes-or-no questions, a column of the table each"
)]
pub struct Scored {
    /// see [`Case::key`]
    pub case: String,
    /// arm
    pub arm: String,
    /// factor on amplitudes
    pub severity: f64,
    /// factor on noise
    pub noise: f64,
    /// hidden
    pub truth: Vec<At>,
    /// see [`Oracle`]; none where the effects cannot be fitted
    pub detectability: Option<f64>,
    /// in one word
    pub verdict: Verdict,
    /// found, first names
    pub found: Vec<At>,
    /// sizes of their classes
    pub class_sizes: Vec<usize>,
    /// something was said to be missing
    pub detected: bool,
    /// hidden effects are in the classes found, nothing else was found
    pub class: bool,
    /// and have the first names
    pub exact: bool,
    /// the answer is the one expected
    pub right: bool,
    /// numbers of those with the right first name
    pub covered: Vec<Covered>,
    /// see the module
    pub closed: Option<f64>,
    /// readings that nothing explains, of what motors do to them: before and after
    pub remaining: [Option<f64>; 2],
    /// seconds of the search
    pub seconds: f64,
}

/// Scores an answer.
pub(super) fn score(
    suite: &SuiteConfig,
    case: &Case,
    truth: &Truth,
    answer: &Answer,
    oracle: Option<&Oracle>,
) -> Scored {
    let arm: &Arm = &suite.arm[case.arm];
    let hidden = hidden(truth);
    let at = |n: &Named| At {
        name: n.name.clone(),
        place: n.at.clone(),
    };
    let found: Vec<At> = answer.effects.iter().map(at).collect();
    let detected = !found.is_empty() || answer.verdict == Verdict::Unknown;
    let meant = |h: &At, n: &Named| in_class(h, n);
    let all = |f: &dyn Fn(&At, &Named) -> bool| {
        hidden
            .iter()
            .all(|h| answer.effects.iter().any(|n| f(h, n)))
            && answer.effects.iter().all(|n| {
                let is_hidden = |h: &At| f(h, n) || is_under(h, &n.name, &n.at);
                hidden.iter().any(is_hidden)
            })
    };
    let class = !hidden.is_empty() && all(&meant);
    let exact = class && all(&|h: &At, n: &Named| h.name == n.name && is_place(&h.place, &n.at));
    let untestable = |h: &At| {
        (answer.untestable.iter())
            .any(|u| u.name == h.name && u.at.iter().any(|at| is_place(&h.place, at)))
    };
    let right = match arm.expect {
        Expect::Truth if hidden.is_empty() => answer.verdict == Verdict::None,
        Expect::Truth => class,
        Expect::Unknown => answer.verdict == Verdict::Unknown,
        Expect::CannotTell => {
            class || (answer.verdict == Verdict::None && hidden.iter().all(untestable))
        }
    };
    let least = oracle.and_then(|o| Some(o.gap.holdout.as_ref()?.after));
    let closed = match (&answer.gap.holdout, least) {
        (Some(gap), Some(least)) if gap.before > least => {
            Some((gap.before - gap.after) / (gap.before - least))
        }
        _ => None,
    };
    Scored {
        case: case.key(suite),
        arm: arm.name.clone(),
        severity: case.severity,
        noise: case.noise,
        detectability: oracle.and_then(|o| o.detectability),
        verdict: answer.verdict,
        class_sizes: answer.effects.iter().map(|n| n.class.len()).collect(),
        detected,
        class,
        exact,
        right,
        covered: answer
            .effects
            .iter()
            .filter_map(|n| covered(truth, n))
            .collect(),
        closed,
        remaining: [answer.remaining.before, answer.remaining.after],
        seconds: 0.0,
        truth: hidden,
        found,
    }
}

/// Hidden effects by the names of the places that the search uses.
pub(super) fn hidden(truth: &Truth) -> Vec<At> {
    let name = |element: &str| element.split_once('/').map_or(element, |e| e.1).to_owned();
    (truth.effect.iter())
        .map(|e| At {
            name: e.name.clone(),
            place: match &e.with {
                Some(with) => format!("{}+{}", name(&e.element), name(with)),
                None => name(&e.element),
            },
        })
        .collect()
}

/// Whether dry friction was named that a variety of it is hidden with.
fn is_under(hidden: &At, name: &str, at: &str) -> bool {
    let variety = effect::named(&hidden.name).is_some_and(|e| e.about().is_variety());
    variety && name == effect::DRY && is_place(&hidden.place, at)
}

fn in_class(hidden: &At, named: &Named) -> bool {
    let first = named.class.contains(&hidden.name) && is_place(&hidden.place, &named.at);
    // what looks alike may act elsewhere
    first || (named.alike.iter()).any(|w| w.name == hidden.name && is_place(&hidden.place, &w.at))
}

/// The asymmetry that is left of one larger than the level of friction: friction never drives.
fn acting(asymmetry: f64, level: f64) -> f64 {
    0.5 * ((level + asymmetry).max(0.0) - (level - asymmetry).max(0.0))
}

/// The interval of the size of an effect that has one number, where its name and place are right.
fn covered(truth: &Truth, named: &Named) -> Option<Covered> {
    let about = effect::named(&named.name)?.about();
    let sizes = about.parameters.iter().filter(|p| p.is_size()).count();
    let value = named.parameters.first().filter(|_| sizes == 1)?;
    let rows: Vec<f64> = (truth.parameter.iter())
        .filter(|p| {
            let place = p.element.split_once('/').map_or(&*p.element, |e| e.1);
            let effect = p.attribute.split_once('.').map(|a| a.0);
            effect == Some(&*named.name) && place == named.at
        })
        .map(|p| p.value)
        .collect();
    let hidden = match (&*named.name, &rows[..]) {
        ("asymmetric_friction", [asymmetry, level, ..]) => acting(*asymmetry, *level),
        (_, [first, ..]) => *first,
        _ => return None,
    };
    Some(Covered {
        effect: named.name.clone(),
        truth: hidden,
        value: value.value,
        ci95: value.ci95?,
    })
}

#[cfg(test)]
mod tests {
    use super::{At, acting, is_under};

    #[test]
    fn friction_that_varies_is_friction_too() {
        let at = |name: &str| At {
            name: name.into(),
            place: "elbow".into(),
        };
        let under = |hidden, name, place| is_under(&at(hidden), name, place);
        assert!(under("stribeck_friction", "coulomb_friction", "elbow"));
        assert!(!under("stribeck_friction", "coulomb_friction", "shoulder"));
        assert!(!under("stribeck_friction", "torque_offset", "elbow"));
        assert!(!under("quadratic_drag", "coulomb_friction", "elbow"));
    }

    #[test]
    fn friction_never_drives() {
        // forwards 0.0425, backwards nothing: as 0.02125 on a level of 0.02125
        assert!((acting(0.0306, 0.0119) - 0.02125).abs() < 1e-12);
        assert!((acting(-0.0306, 0.0119) + 0.02125).abs() < 1e-12);
        assert!((acting(0.003, 0.0119) - 0.003).abs() < 1e-12);
    }
}
