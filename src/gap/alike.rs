//! Effects that fit as well in the place of one that was found.
//!
//! When an effect is chosen its rivals were fitted too. A model with rival j instead of effect k costs C(j), 2 more for each
//! number, with channels weighed by what k leaves of them:
//!
//! ```text
//! d² = 2 (C(j) − C(k))        alike: d² < 9
//! ```
//!
//! While they are fitted channels are weighed by what the model before them leaves, which is more: there costs are less, for
//! all by the factor by which that of k is.
//!
//! Laws of dry friction differ most at rest, where none is known: a few stretches that stick decide, by an offset or by friction
//! that differs with direction, which are one law while something moves. Of neighbours in the catalogue of which one is a variety
//! of dry friction the difference has therefore to be sure from stretch to stretch too (Vuong 1989, "Likelihood ratio tests for
//! model selection and non-nested hypotheses"):
//!
//! ```text
//! d² = min(2 (C(j) − C(k)),  (Σ Δ)² / (S var Δ))        Δ: C(j) − C(k) of each of S stretches
//! ```
//!
//! A machine moves on in no steps, a model in steps of h, which do what a late or early command does. There is therefore
//! also a cost without steps ([`super::step`]), which orders the rivals where it is clearly less for the best fit of all. It
//! is not for what was itself simulated in steps, nor where joints stick, of which half the step says little. What is
//! alike by one of both costs is alike: nobody knows the machine's steps.
//!
//! Effects found later may tell them apart, as may longer windows: what was alike before, or nearly so, is fitted once more beside
//! them, as is what looks alike only now ([`super::lookalike`]); what fits better there by as much as tells two effects apart, and
//! held-out recordings besides, is exchanged for the one that was chosen.

use serde::{Deserialize, Serialize};

use super::candidate::Candidate;
use super::effect::{Effect, Place, are_neighbours, named};
use super::fitted::{AtHand, Fitted};
use super::held_out::falls;
use super::model::{Built, Chosen};
use super::name::APART;
use super::result::Where;
use super::score::by_stretch;
use super::screen::Screen;
use super::search::{FEW_ITERATIONS, Search};
use super::step::WithoutSteps;
use super::windows::Windows;
use super::{GapError, Stage, Watch};
use crate::sysid::problem::Problem;

/// Fall of the cost that a number more has to bring, to be the better of two.
const NUMBER: f64 = 2.0;
/// Part of the least cost that is left without steps where they matter.
const CLEARLY: f64 = 0.8;
/// Separation up to which what is not alike is remembered, and how many of these: effects found later may turn it round.
const NEARLY: f64 = 50.0;
const RUNNERS_UP: usize = 3;
/// Times the present cost that another effect may leave when its fit falls no more by much, and that one which was alike may.
const HOPELESS: f64 = 2.0;
const LOST: f64 = 10.0;
/// Times that cost which derivatives may foretell at the best, where joints stick: what is reached is several times less.
const ASTRAY: f64 = 4.0;
/// Places of costs with and without steps.
pub(super) const WITH: usize = 0;
const WITHOUT: usize = 1;

/// Another effect, fitted in the place of one.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Rival {
    name: String,
    place: Place,
    values: Vec<f64>,
    /// d²
    pub separation: f64,
}

impl Rival {
    pub(super) fn of(chosen: &Chosen, separation: f64) -> Self {
        Self {
            name: chosen.effect.about().name.to_owned(),
            place: chosen.place.clone(),
            values: chosen.values.clone(),
            separation,
        }
    }

    /// As a result has it.
    pub(super) fn said(&self) -> Where {
        Where {
            name: self.name.clone(),
            at: self.place.to_string(),
            separation: self.separation,
        }
    }

    fn is_alike(&self) -> bool {
        self.separation < APART
    }

    /// To be fitted; none where the catalogue has no such name.
    pub(super) fn chosen(&self) -> Option<Chosen> {
        Some(Chosen {
            effect: named(&self.name)?,
            place: self.place.clone(),
            values: self.values.clone(),
        })
    }

    /// Whether it is this effect there.
    pub(super) fn is(&self, chosen: &Chosen) -> bool {
        self.name == chosen.effect.about().name && self.place == chosen.place
    }
}

/// What a fit with a cost in units of what it leaves is rated at, its numbers `x` included.
pub(super) fn price(cost: f64, x: &[f64]) -> f64 {
    cost + NUMBER * (x.len() as f64)
}

/// C of fits, with steps and without, and which of the two orders them.
///
/// # Errors
/// The engine refuses a number.
pub(super) fn costs(fits: &[&Fitted]) -> Result<(Vec<[f64; 2]>, usize), GapError> {
    let with: Vec<[f64; 2]> = fits.iter().map(|fit| [fit.cost; 2]).collect();
    if fits.len() < 2 {
        return Ok((with, WITH));
    }
    let mut both = with.clone();
    for (fit, own) in fits.iter().zip(&mut both) {
        let Some(change) = fit.cost_without_steps()? else {
            return Ok((with, WITH));
        };
        own[WITHOUT] += change;
    }
    let least = |k: usize| both.iter().map(|c| c[k]).fold(f64::INFINITY, f64::min);
    let clearly = least(WITHOUT) < CLEARLY * least(WITH);
    Ok((both, if clearly { WITHOUT } else { WITH }))
}

impl Fitted {
    /// As [`change`].
    fn cost_without_steps(&self) -> Result<Option<f64>, GapError> {
        let linear = self.windows.linearise(&self.x)?;
        let without = self.windows.without_steps(&self.x, &linear)?;
        let (problem, of) = (&self.windows.problem, (&self.built, &self.chosen[..]));
        Ok(without.map(|own| change(&own, problem, of, &self.x)))
    }
}

/// What C is more without steps than with them, shapes of effects held.
fn change(
    without: &WithoutSteps<'_>,
    problem: &Problem,
    (built, chosen): (&Built, &[Chosen]),
    x: &[f64],
) -> f64 {
    let shapes: Vec<usize> = built.shapes(problem, chosen).map(|s| s.0).collect();
    without.cost(&problem.parameters, x, &shapes)
}

/// d² of a rival from what is chosen, which leaves `left`: the smaller of that with steps and that without.
fn separation(rival: (&[f64; 2], &[f64]), chosen: (&[f64; 2], &[f64]), left: f64) -> f64 {
    let own = price(left, chosen.1);
    let each = (rival.0.iter().zip(chosen.0))
        .map(|(cost, chosen)| apart(price(left / chosen * cost, rival.1), own));
    each.fold(f64::INFINITY, f64::min)
}

/// d² of the fit of a `rival` from that of the `chosen` effect by how much their costs differ from stretch to stretch; infinite
/// where more than what a joint does at rest tells the effects apart, or one cannot be followed.
fn separation_by_stretch(
    rival: FitOf<'_>,
    chosen: FitOf<'_>,
    stretch_of: &[usize],
) -> Result<f64, GapError> {
    if !differ_at_rest(rival.0, chosen.0) {
        return Ok(f64::INFINITY);
    }
    let follow = |(_, windows, x): FitOf<'_>| windows.simulate(x, &windows.states);
    let (Some(rival), Some(chosen)) = (follow(rival)?, follow(chosen)?) else {
        return Ok(f64::INFINITY);
    };
    let each = rival.iter().zip(&chosen).map(|(r, c)| r.cost - c.cost);
    Ok(squared_t(&by_stretch(each, stretch_of)))
}

/// Whether effects may be mistaken for each other but for what a joint that sticks does.
fn differ_at_rest(one: &dyn Effect, other: &dyn Effect) -> bool {
    are_neighbours(one, other) && (one.about().is_variety() || other.about().is_variety())
}

/// Square of the sum of `parts` over its variance; 0 for a sum below 0.
fn squared_t(parts: &[f64]) -> f64 {
    let n = parts.len() as f64;
    let sum: f64 = parts.iter().sum();
    let squares: f64 = parts.iter().map(|own| (own - sum / n).powi(2)).sum();
    if sum <= 0.0 {
        return 0.0;
    }
    sum * sum * (n - 1.0) / (n * squares)
}

/// d² of what costs `price` from what costs `chosen`.
pub(super) fn apart(price: f64, chosen: f64) -> f64 {
    (2.0 * (price - chosen)).max(0.0)
}

/// An effect, and windows fitted with it at their parameters.
type FitOf<'a> = (&'a dyn Effect, &'a Windows, &'a [f64]);

/// A candidate in the model, fitted.
pub(super) struct Tried<'s> {
    pub fit: Fitted,
    pub candidate: &'s Candidate,
    /// C with steps and without
    pub costs: [f64; 2],
}

impl Tried<'_> {
    fn fit(&self) -> FitOf<'_> {
        (self.candidate.effect, &self.fit.windows, &self.fit.x)
    }

    /// By the cost `which`, divided by `unit`.
    pub(super) fn price(&self, which: usize, unit: f64) -> f64 {
        price(self.costs[which] / unit, &self.fit.x)
    }
}

/// Rivals of the fit `chosen` of all that are alike or nearly so, the added effect of each being the last, where that is known
/// to leave `cost`.
///
/// # Errors
/// The engine refuses a number.
pub(super) fn rivals(
    tried: &[Tried<'_>],
    chosen: usize,
    (cost, stretch_of): (f64, &[usize]),
) -> Result<Vec<Rival>, GapError> {
    let own = &tried[chosen];
    let mut all: Vec<Rival> = Vec::new();
    for (i, t) in tried.iter().enumerate() {
        let Some(added) = t.fit.chosen.last().filter(|_| i != chosen) else {
            continue;
        };
        let d2 = separation((&t.costs, &t.fit.x), (&own.costs, &own.fit.x), cost);
        let surely = separation_by_stretch(t.fit(), own.fit(), stretch_of)?;
        all.push(Rival::of(added, d2.min(surely)));
    }
    all.sort_by(|a, b| a.separation.total_cmp(&b.separation));
    let alike = all.iter().take_while(|r| r.is_alike()).count();
    all.truncate(alike + RUNNERS_UP);
    all.retain(|r| r.separation < NEARLY);
    Ok(all)
}

impl Search<'_> {
    /// What C is more without steps than with them, shapes of effects held.
    pub(super) fn cost_without_steps(&self, without: &WithoutSteps<'_>) -> f64 {
        let of = (&self.built, &self.chosen[..]);
        change(without, &self.windows.problem, of, &self.x)
    }

    /// Part of what is left that is the work of the model's own steps, where that is much; `change` is what the cost is more
    /// without them.
    pub(super) fn part_of_steps(&self, change: f64) -> Option<f64> {
        let part = (-change / self.cost).min(1.0);
        (part > 1.0 - CLEARLY).then_some(part)
    }

    /// Whether another model, or other numbers, cost less than the present ones where neither were fitted; `recorded_s` as of
    /// [`Search::held`].
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn is_less_held_out(
        &self,
        other: AtHand<'_>,
        recorded_s: f64,
    ) -> Result<bool, GapError> {
        let before = self.held(self.at_hand(), recorded_s)?;
        let after = self.held(other, recorded_s)?;
        Ok(falls(before.as_ref(), after.as_ref(), |_| 0.0))
    }

    /// The present model with another effect in the place of its effect `i`, the fit begun; given up where it will not end below
    /// `hopeless` times the present cost.
    pub(super) fn fitted_instead(
        &self,
        i: usize,
        instead: Chosen,
        hopeless: f64,
        watch: &mut Watch<'_>,
    ) -> Result<Option<Fitted>, GapError> {
        let mut chosen = self.chosen.clone();
        chosen[i] = instead;
        let effort = (FEW_ITERATIONS, ASTRAY * hopeless * self.cost);
        self.fitted_after(None, &chosen, effort, watch)
    }

    /// Fits what was alike once more, beside all that was found since, and what looks alike now that all is found; keeps what
    /// is alike, what is the same by another name ([`super::one_law`]) without a fit, or exchanges what was chosen for it.
    /// `screen` is of the present model, `own_steps` what the cost is more without steps; whether windows are `longer` than those
    /// that effects were looked for in at first. Whether anything was exchanged.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn tell_apart(
        &mut self,
        screen: &Screen,
        (mut own_steps, longer): (Option<f64>, bool),
        watch: &mut Watch<'_>,
    ) -> Result<bool, GapError> {
        let effects = 0..self.chosen.len();
        let look: Vec<Vec<Rival>> = effects.map(|i| self.look_alikes(screen, i)).collect();
        // nothing was found since
        let stays = self.chosen.len() < 2 && !longer;
        let mut exchanged = false;
        for (i, mut asked) in look.into_iter().enumerate() {
            let known = std::mem::take(&mut self.evidence[i].alike);
            asked.retain(|a| {
                !known
                    .iter()
                    .any(|k| (&k.name, &k.place) == (&a.name, &a.place))
            });
            let other = self.by_other_name(i)?;
            let (mut left, again) = if stays {
                (known, Vec::new())
            } else {
                (Vec::new(), known)
            };
            asked.extend(again);
            if !asked.is_empty() {
                watch.stage(Stage::Refit);
            }
            for rival in asked {
                let Some(instead) = rival.chosen() else {
                    continue;
                };
                if self.chosen.iter().chain(&other).any(|c| rival.is(c)) {
                    continue; // it stands beside it, or is the same
                }
                let effect = instead.effect;
                let most = if rival.is_alike() { LOST } else { HOPELESS };
                let Some(mut fitted) = self.fitted_instead(i, instead, most, watch)? else {
                    continue;
                };
                if fitted.cost > most * self.cost {
                    continue;
                }
                fitted.improve(self, watch)?;
                let (mut own, mut costs) = ([self.cost; 2], [fitted.cost; 2]);
                if let (Some(own_change), Some(change)) = (own_steps, fitted.cost_without_steps()?)
                {
                    own[WITHOUT] += own_change;
                    costs[WITHOUT] += change;
                }
                let (own, other) = ((&own, &self.x[..]), (&costs, &fitted.x[..]));
                let back = separation(own, other, fitted.cost);
                // what held-out recordings do not tell apart is alike
                let is_less =
                    || self.is_less_held_out(fitted.at_hand(), self.recorded_s(&fitted.chosen));
                if back >= APART && !self.absurd(&fitted.built, &fitted.chosen) && is_less()? {
                    *self = self.settled_with(fitted, watch)?;
                    (own_steps, exchanged) = (None, true);
                } else {
                    let d2 = separation(other, own, self.cost);
                    let other: FitOf<'_> = (effect, &fitted.windows, &fitted.x);
                    let own: FitOf<'_> = (self.chosen[i].effect, &self.windows, &self.x);
                    let surely = separation_by_stretch(other, own, &self.stretch_of)?;
                    left.push(Rival {
                        separation: d2.min(surely),
                        ..rival
                    });
                }
            }
            left.retain(|r| r.is_alike() && !other.iter().any(|own| r.is(own)));
            if let Some(other) = self.by_other_name(i)? {
                let own = self.chosen[i].clone();
                let one = self.one_cause(i, &other, watch)?;
                if one {
                    (own_steps, exchanged) = (None, true);
                }
                left.push(Rival::of(if one { &own } else { &other }, 0.0));
            }
            self.evidence[i].alike = left;
        }
        Ok(exchanged)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::masses::{chosen, found, machine, searching};

    /// Damping was chosen where a spring is; beside what was found later the spring fits better.
    #[test]
    fn what_fits_better_beside_the_others_is_exchanged() {
        let base = machine("", "");
        let hidden = machine(r#"stiffness="8""#, r#"damping="2""#);
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"armature\"\nscale = \"linear\"\n\
                      prior_sigma = 0.1\nlower = -0.1\n";
        searching(&base, &hidden, config, |search, watch| {
            let wrong = [
                chosen(&base, "viscous_friction", "a", &[0.1]),
                chosen(&base, "viscous_friction", "b", &[1.0]),
            ];
            found(search, &wrong, watch);
            let spring = chosen(&base, "joint_spring", "a", &[1.0, 0.0]);
            search.evidence[0].alike = vec![Rival::of(&spring, 20.0)];
            let told = |search: &mut Search<'_>, watch: &mut Watch<'_>| {
                let screen = search.screen(watch).expect("screened").expect("whole");
                search
                    .tell_apart(&screen, (None, false), watch)
                    .expect("told")
            };
            assert!(told(search, watch));
            let spring = &search.chosen[0];
            assert_eq!(spring.effect.about().name, "joint_spring");
            assert!((spring.values[0] / 8.0 - 1.0).abs() < 0.01, "{spring:?}");
            assert!(search.evidence[0].alike.is_empty());
            // and stays
            search.evidence[0].alike = vec![Rival::of(&wrong[0], 20.0)];
            assert!(!told(search, watch));
            assert_eq!(search.chosen[0].effect.about().name, "joint_spring");
            assert!(search.evidence[0].alike.is_empty());
        });
    }

    /// Damping was as good as the spring in windows too short to tell; in longer ones it is not.
    #[test]
    fn longer_windows_tell_apart_what_short_ones_did_not() {
        let (base, hidden) = (machine("", ""), machine(r#"stiffness="8""#, ""));
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &hidden, config, |search, watch| {
            found(
                search,
                &[chosen(&base, "joint_spring", "a", &[1.0, 0.0])],
                watch,
            );
            let damping = chosen(&base, "viscous_friction", "a", &[0.1]);
            let mut left = |longer| {
                search.evidence[0].alike = vec![Rival::of(&damping, 1.0)];
                let screen = search.screen(watch).expect("screened").expect("whole");
                let told = search.tell_apart(&screen, (None, longer), watch);
                assert!(!told.expect("told"));
                search.evidence[0].alike.iter().any(|r| r.is(&damping))
            };
            assert!(left(false) && !left(true));
        });
    }

    /// What a few stretches say of two laws is not enough, however loud; nor what one half of them says and the other denies.
    #[test]
    fn what_few_stretches_tell_apart_is_alike() {
        let by = |each: [f64; 8]| squared_t(&each);
        assert!(by([100.0, 60.0, 0.1, 0.2, 0.0, 0.1, 0.3, 0.1]) < APART);
        assert!(by([5.0, -4.0, 5.0, -4.0, 5.0, -4.0, 5.0, -4.0]) < APART);
        assert!(by([3.0, 2.0, 4.0, 3.0, 2.0, 4.0, 3.0, 3.0]) > APART);
        assert!(by([-3.0, -2.0, -4.0, -3.0, -2.0, -4.0, -3.0, -3.0]) == 0.0);
        // windows of one stretch speak once: sum 8, two of them apart by 2
        let two = squared_t(&by_stretch([5.0, 0.0, 3.0, 0.0].into_iter(), &[0, 0, 1, 1]));
        assert!((two - 16.0).abs() < 1e-9, "{two}");
    }

    /// A drive's delay that followed a lag better in steps, and worse without, is told from it by neither alone.
    #[test]
    fn what_is_alike_by_one_cost_is_alike() {
        let x = [0.0; 3];
        let (lag, left) = ([7.67, 4.29], 248.0);
        let of = |rival: [f64; 2]| separation((&rival, &x), (&lag, &x), left);
        assert!(of([5.82, 23.94]) < APART);
        assert!(of([23.0, 4.30]) < APART);
        assert!(of([7.67, 4.29]) < 1e-9);
        let apart = of([9.0, 23.94]);
        assert!((apart - 2.0 * 248.0 * (9.0 / 7.67 - 1.0)).abs() < 1e-6 && apart > APART);
    }
}
