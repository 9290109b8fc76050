//! What could stand in the place of an effect, seen from where the effect stands.
//!
//! A screen of a model that lacks something is taken far from where the model would be with it: a coupling of two joints may
//! pull the wrong way there while a spring, whose rest is free, does not. With the effect in the model columns are taken at
//! its own fit. A candidate j does the most like one of its surest size k, which is t of its standard errors from 0, at the
//! price d² of [`super::name`],
//!
//! ```text
//! φⱼ β ≈ φₖ x        d² = t² (1 − ρ²)        ρ: cosine between what is their own of φⱼ β and φₖ
//! ```
//!
//! The surest effects are known to parts of a thousand, columns are not, and d² is then large whatever ρ. What looks like the
//! effect, ρ² ≥ 0.9 or what the catalogue says of it, is fitted in its place ([`super::alike`]).

use super::alike::Rival;
use super::candidate::Candidate;
use super::effect::{Sign, are_neighbours};
use super::name::APART;
use super::score::Normal;
use super::screen::Screen;
use super::search::{Search, Size};

/// How many times the largest size to be expected another explanation may need.
const ABSURD: f64 = 2.0;
/// ρ² from which a candidate looks like an effect.
const LIKE: f64 = 0.9;
/// The same of what the catalogue says it may be mistaken for: where joints stick columns say little.
const LIKE_NEIGHBOUR: f64 = 0.2;
/// Candidates that are fitted in the place of an effect.
const MOST: usize = 3;

/// The place of an effect in a fitted model.
pub(super) struct InPlace<'a> {
    search: &'a Search<'a>,
    /// the shapes of the effect held
    normal: Normal,
    size: Size,
    t: f64,
}

/// A candidate in the place of an effect.
pub(super) struct Instead {
    /// ρ²
    pub likeness: f64,
    /// d²
    pub separation: f64,
    /// one a parameter
    pub values: Vec<f64>,
}

impl<'a> InPlace<'a> {
    /// Of effect `effect` of `search`, whose model `screen` is of; none if it has no size.
    pub(super) fn of(search: &'a Search<'_>, screen: &Screen, effect: usize) -> Option<Self> {
        let (normal, sizes) = search.sizes(&screen.normal, effect);
        let sure = |size: &Size| size.x.abs() / normal.fitted(size.at).0;
        let each = sizes.into_iter().map(|size| (sure(&size), size));
        let (t, size) = each.max_by(|a, b| a.0.total_cmp(&b.0))?;
        Some(Self {
            search,
            normal,
            size,
            t,
        })
    }

    /// A candidate there; none if it would have to have the wrong sign, or be absurdly large.
    pub(super) fn instead(&self, candidate: &Candidate) -> Option<Instead> {
        let (likeness, per_one) = (self.normal).likeness(self.size.at, &candidate.columns);
        let model = &self.search.built.file.model;
        let scales = self.search.measured.scales(model, &candidate.place);
        let parameters = candidate.effect.about().parameters;
        let mut values = candidate.values.clone();
        for (&i, per_one) in candidate.parameters.iter().zip(&per_one) {
            let (p, value) = (&parameters[i], per_one * self.size.x);
            if p.is_whole() {
                continue;
            }
            let wrong = p.sign == Sign::Positive && value < 0.0;
            if wrong || value.abs() > ABSURD * p.high * p.scale(&scales) {
                return None;
            }
            values[i] = value;
        }
        Some(Instead {
            likeness,
            separation: self.t * self.t * (1.0 - likeness),
            values,
        })
    }
}

impl Search<'_> {
    /// What looks like effect `effect`, most alike first, though its price says that it is another; `screen` is of the
    /// present model.
    pub(super) fn look_alikes(&self, screen: &Screen, effect: usize) -> Vec<Rival> {
        let Some(place) = InPlace::of(self, screen, effect) else {
            return Vec::new();
        };
        let looks = |c: &Candidate| {
            let instead = place.instead(c)?;
            let neighbour = are_neighbours(c.effect, self.chosen[effect].effect);
            let like = if neighbour { LIKE_NEIGHBOUR } else { LIKE };
            let asks = instead.likeness >= like && instead.separation >= APART;
            asks.then(|| {
                (
                    instead.likeness,
                    Rival::of(&c.with(instead.values), instead.separation),
                )
            })
        };
        let mut all: Vec<(f64, Rival)> = screen.candidates.iter().filter_map(looks).collect();
        all.sort_by(|a, b| b.0.total_cmp(&a.0));
        all.into_iter().take(MOST).map(|a| a.1).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::masses::{chosen, found, machine, searching};

    /// Drag goes with the square of the speed, which looks like damping until it is fitted.
    #[test]
    fn what_looks_alike_is_fitted() {
        let (base, hidden) = (machine("", ""), machine(r#"damping="2""#, ""));
        searching(&base, &hidden, "", |search, watch| {
            let damping = [chosen(&base, "viscous_friction", "a", &[1.0])];
            found(search, &damping, watch);
            let screen = search.screen(watch).expect("screened").expect("whole");
            let all = search.look_alikes(&screen, 0);
            let names: Vec<_> = (all.iter().map(Rival::said))
                .map(|w| (w.name, w.at))
                .collect();
            assert!(
                names.contains(&("quadratic_drag".to_owned(), "a".to_owned())),
                "{names:?}"
            );
            assert!(
                names.iter().all(|n| n.1 != "b" && n.0 != "joint_spring"),
                "{names:?}"
            );
            search
                .tell_apart(&screen, (None, false), watch)
                .expect("told");
            assert_eq!(search.chosen[0].effect.about().name, "viscous_friction");
            assert!(search.evidence[0].alike.is_empty());
        });
    }
}
