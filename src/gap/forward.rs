//! One step forward: the candidates that promise most are fitted, those that lead in every shape, and the best that stands is kept.
//!
//! A screen is linear and judges from a model that lacks what it looks for; it says who is worth a fit, no more. What
//! decides is taken from the fits: the cost, 2 more for each number; friction that is free may be ahead of all ([`super::loose`]); then
//! for the best first
//!
//! - the cost of the held-out recordings, which has to fall by a twentieth, or where it is hardly more than noise make them a
//!   thousand times likelier, and of the priors, which belongs to both; a twentieth of what noise does not explain of it will do
//!   where the fit with the effect leaves hardly anything but noise: a bound that the held-out motion meets in few samples;
//! - significance ([`super::evidence`]), in which held-out recordings have a say ([`super::held_out`]);
//! - or, where noise explains all but a tenth of what the fit with it leaves, and that is less by a fifth, significance by that
//!   noise, which needs no stretches that agree: a motor's ripple or bound may show in one;
//! - size; a small one, and one of which fitted parameters explain nearly all, is kept where it is most of what is left, or
//!   of what noise does not explain of that. The fall has to be owed to the effect ([`super::owed`]), and what no fitted parameter
//!   could have explained of it is a thousandth of the motors' at least: less is the work of steps, of how friction is rounded off and
//!   of whatever else no model has exactly.

use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::alike::{self, Tried};
use super::candidate::{Candidate, largest_part};
use super::effect::are_neighbours;
use super::evidence::Standing;
use super::fitted::Fitted;
use super::held_out::{Held, both, falls, is_noise, unexplained};
use super::inputs::is_wanted;
use super::name::APART;
use super::owed::Owed;
use super::score::Score;
use super::screen::{HARDLY_VISIBLE, LEAST_VISIBLE, Screen};
use super::search::Search;
use super::{GapError, Stage, Watch};

/// Candidates that are fitted before one is kept: a spring with a rest that no screen expects may be the tenth of them.
const RIVALS: usize = 12;
/// And of what the best may be mistaken for.
const NEIGHBOURS: usize = 2;
/// And of what takes most off where one stretch of time has it all, so that no other foretells that.
const LONE: usize = 2;
/// So many candidates would look as good by chance, of one that is worth a fit; or it explains much of what is left: dry
/// friction and stops show in few stretches, which a jackknife believes little.
const LIKELY: f64 = 3.0;
/// Part of the least size that such a one promises.
const LARGE: f64 = 0.1;
/// Part of the best one's gain that a rival has.
const NEAR: f64 = 0.2;
/// Part of the best one's fall that rivals have after few iterations; of what is left, it is most.
pub(super) const LEADING: f64 = 0.5;
/// Times the cost of one fit that another has to be foretold to end below.
pub(super) const WORSE: f64 = 1.25;
/// Part of the held-out recordings' cost, or of what noise does not explain of it, that an effect takes off it at least.
const OF_USE: f64 = 0.05;
/// Part of the cost, and of what noise does not explain of the held-out recordings', that a small effect takes off at least.
const MUCH: f64 = 0.2;
/// Part of what noise does not explain of either cost that will do as well.
const MOST: f64 = 0.5;
/// Part of the least size that fitted parameters do not explain.
const OWN: f64 = 0.1;
/// Chance in the recordings that are fitted, times the number of candidates, above which held-out ones do not count.
const LIKELY_STILL: f64 = 0.05;
/// Times after which a present model that is fitted better, instead of with an effect more, is looked at again.
const REFITTED: usize = 3;

/// What a step forward came to.
enum Forward {
    /// one effect more
    Kept,
    /// the present model, fitted better
    Refitted,
    Nothing,
}

impl Search<'_> {
    /// Candidates that are worth a place in the model by the screen alone, best first.
    pub(super) fn worthy<'s>(&self, screen: &'s Screen) -> Vec<&'s Candidate> {
        let (least, tests) = (self.limits.gain * self.unexplained(screen), tests(screen));
        let found = self.best_first(screen, |c, s| {
            self.limits.significant(s.p_value * tests as f64)
                && s.gain >= least
                && s.held_gain > s.held_sigma
                && s.visible >= HARDLY_VISIBLE
                && self.limits.large(c.size)
        });
        found.into_iter().map(|(c, _)| c).collect()
    }

    /// Candidates that make sense, can be seen and that `keep` keeps, with their scores, by what they gain where they were
    /// not estimated.
    fn best_first<'s>(
        &self,
        screen: &'s Screen,
        keep: impl Fn(&Candidate, &Score) -> bool,
    ) -> Vec<(&'s Candidate, &'s Score)> {
        let wanted = |c: &Candidate| is_wanted(&self.effects, c.effect.about().name);
        let mut found: Vec<(&Candidate, &Score)> = (screen.candidates.iter())
            .filter_map(|c| Some((c, c.score.as_ref()?)))
            .filter(|(c, s)| wanted(c) && c.sensible && s.visible >= LEAST_VISIBLE && keep(c, s))
            .collect();
        found.sort_by(|a, b| b.1.held_gain.total_cmp(&a.1.held_gain));
        found
    }

    /// Cost that the noise of the sensors does not explain.
    pub(super) fn unexplained(&self, screen: &Screen) -> f64 {
        let rows = screen.linear.rows.iter().flat_map(|row| &row.channel);
        unexplained(screen.normal.cost(), self.noise_cost(rows.copied()))
    }

    /// Steps forward from the present model, of which `screen` is, if there is one; what comes back is the screen of the model
    /// if nothing was found.
    ///
    /// # Errors
    /// The engine refuses a number; [`GapError::Stopped`].
    pub(super) fn forward(
        &mut self,
        mut screen: Option<Screen>,
        watch: &mut Watch<'_>,
    ) -> Result<Option<Screen>, GapError> {
        for _ in 0..=REFITTED {
            let present = match screen.take() {
                Some(present) => present,
                None => self.screened(watch)?,
            };
            match self.forward_once(&present, watch)? {
                Forward::Kept => return Ok(None),
                Forward::Nothing => return Ok(Some(present)),
                Forward::Refitted => {}
            }
        }
        self.screened(watch).map(Some)
    }

    /// Fits the candidates that promise most, and keeps the best that stands.
    fn forward_once(
        &mut self,
        screen: &Screen,
        watch: &mut Watch<'_>,
    ) -> Result<Forward, GapError> {
        let rivals = self.rivals(screen);
        if rivals.is_empty() {
            return Ok(Forward::Nothing);
        }
        watch.stage(Stage::Refit);
        let unexplained = self.unexplained(screen);
        let least = self.limits.gain * unexplained;
        let mut fitted: Vec<(Fitted, &Candidate)> = Vec::new();
        let fall = |f: &Fitted| self.cost - f.cost;
        let mut most = 0.0_f64;
        for c in rivals {
            // what will not lead is not fitted to the end
            let bound = self.cost - LEADING * most;
            let begun = self.begun_below(bound, c, screen, watch)?;
            most = begun.iter().map(|f| fall(&f.0)).fold(most, f64::max);
            fitted.extend(begun);
        }
        fitted.retain(|f| fall(&f.0) >= LEADING * most);
        fitted.sort_by(|a, b| a.0.cost.total_cmp(&b.0.cost));
        let mut best = f64::INFINITY;
        for (own, candidate) in &mut fitted {
            own.improve_below(WORSE * best, self, watch)?;
            self.other_shapes((own, candidate), screen, watch)?;
            best = best.min(own.cost);
        }
        fitted.retain(|f| fall(&f.0) >= least);
        if fitted.is_empty() {
            return Ok(Forward::Nothing);
        }
        let fits: Vec<&Fitted> = fitted.iter().map(|f| &f.0).collect();
        let (costs, which) = alike::costs(&fits)?;
        let mut tried: Vec<Tried<'_>> = (fitted.into_iter().zip(costs))
            .map(|((fit, candidate), costs)| Tried {
                fit,
                candidate,
                costs,
            })
            .collect();
        let unit = self.unit(&tried, which)?;
        let prices = tried.iter().map(|t| t.price(alike::WITH, unit));
        let least = prices.fold(f64::INFINITY, f64::min);
        if let Some(loose) = self.loosened((least, unit), watch)? {
            *self = loose;
            return Ok(Forward::Refitted);
        }
        tried.sort_by(|a, b| a.price(which, unit).total_cmp(&b.price(which, unit)));
        if let Some(i) = self.varied(&tried, watch)? {
            tried[..=i].rotate_right(1);
        }
        let rows = screen.linear.rows.iter();
        let left = screen.linear.by_channel(rows.map(|row| &row.residual));
        let left = (screen.motors.as_ref()).and_then(|motors| largest_part(&left, motors));
        let present = self.held(self.at_hand(), 0.0)?;
        let noise = self.cost - unexplained;
        // what fits in absurd numbers alone is something that the catalogue has not, and no worse fit is it
        let mut absurd: Option<f64> = None;
        for (i, of) in tried.iter().enumerate() {
            let own = &of.fit;
            let gain = fall(own) / self.cost;
            let own_size = left.map(|part| part * gain.sqrt());
            if own_size.is_some_and(|size| size < OWN * self.limits.size) {
                continue;
            }
            // a number more has to be worth it beside what nothing explains
            let price = of.price(which, 1.0);
            if absurd.is_some_and(|best| alike::apart(price, best) >= APART) {
                break;
            }
            if self.absurd(&own.built, &own.chosen) {
                absurd = absurd.or(Some(price));
                continue;
            }
            let [held_before, held] = self.held_both(present.as_ref(), own)?;
            let falls = |least: fn(&Held) -> f64| falls(held_before.as_ref(), held.as_ref(), least);
            let only_noise = leaves_noise(gain, (own.cost, noise));
            let plainly = if only_noise {
                by_noise(of.candidate, fall(own)) * tests(screen) as f64
            } else {
                1.0
            };
            let plain = self.limits.significant(plainly);
            // motions that were held out may show little of what leaves nothing but noise
            if !falls(if only_noise { of_rest } else { of_use }) {
                continue;
            }
            let mut then = self.settled_with(own.clone(), watch)?;
            if self.absurd(&then.built, &then.chosen) {
                absurd = absurd.or(Some(price));
                continue;
            }
            let standing = Standing::of(&then)?;
            let mut evidence =
                standing.evidence(self.chosen.len(), of.candidate, tests(screen), gain);
            if let (Some(before), Some(held)) = (&held_before, &held)
                && evidence.p_value <= LIKELY_STILL
            {
                let chance = (tried.len() as f64 * held.chance(before)).min(1.0);
                // few blocks say little: they take nothing away
                evidence.p_value = both(evidence.p_value, chance).min(evidence.p_value);
            }
            let much = is_much((fall(own), self.cost, unexplained), falls);
            let visible = of.candidate.score.as_ref().map_or(0.0, |s| s.visible);
            let large = self.limits.large(evidence.size) && visible >= HARDLY_VISIBLE;
            let sure = self.limits.significant(evidence.p_value);
            if (sure && (large || much)) || plain {
                evidence.p_value = evidence.p_value.min(plainly);
                let foretold = of.candidate.score.as_ref().map_or(0.0, |s| s.gain);
                match self.owed((own, held.as_ref()), (foretold, unexplained), watch)? {
                    Owed::Effect(part) => evidence.gain = part,
                    Owed::Fit(better) => {
                        *self = self.settled_with(*better, watch)?;
                        return Ok(Forward::Refitted);
                    }
                }
                evidence.alike = alike::rivals(&tried, i, (then.cost, &self.stretch_of))?;
                then.evidence.push(evidence);
                *self = then;
                return Ok(Forward::Kept);
            }
        }
        Ok(Forward::Nothing)
    }

    /// What costs are divided by so that they are in units of what the best of all leaves: in those of what was left before,
    /// fits that leave little all look alike, and the one with the fewest numbers wins.
    fn unit(&self, tried: &[Tried<'_>], which: usize) -> Result<f64, GapError> {
        let best = (tried.iter()).min_by(|a, b| a.costs[which].total_cmp(&b.costs[which]));
        let Some(Tried { fit, .. }) = best else {
            return Ok(1.0);
        };
        let own = fit.windows.weights(&fit.x, &self.noise)?.cost;
        Ok(fit.itself / own.max(fit.itself))
    }

    /// Candidates to be fitted, best first; then what the catalogue says may be mistaken for the best: a screen is linear, and
    /// what turns gravity by much is not.
    pub(super) fn rivals<'s>(&self, screen: &'s Screen) -> Vec<&'s Candidate> {
        let (unexplained, tests) = (self.unexplained(screen), tests(screen));
        let (least, much) = (self.limits.gain * unexplained, MUCH * unexplained);
        let likely =
            |s: &Score| (s.p_value * tests as f64 <= LIKELY || s.gain >= much) && s.held_gain > 0.0;
        let large = |c: &Candidate| c.size.is_none_or(|size| size >= LARGE * self.limits.size);
        let found = self.best_first(screen, |c, s| large(c) && s.gain >= least && likely(s));
        let most = found.first().map_or(0.0, |f| f.1.held_gain);
        let near = found.into_iter().filter(|f| f.1.held_gain >= NEAR * most);
        let mut rivals: Vec<&Candidate> = near.map(|f| f.0).take(RIVALS).collect();
        let more = |rivals: &[&Candidate], found: Vec<(&'s Candidate, &Score)>, most| {
            let new = found.into_iter().map(|f| f.0);
            let new = new.filter(|c| !rivals.iter().any(|own| std::ptr::eq(*own, *c)));
            new.take(most).collect::<Vec<_>>()
        };
        let lone = |c: &Candidate, s: &Score| {
            large(c) && s.gain >= MOST * unexplained && s.held_gain < NEAR * s.gain
        };
        let mut alone = self.best_first(screen, lone);
        alone.sort_by(|a, b| b.1.gain.total_cmp(&a.1.gain));
        rivals.extend(more(&rivals, alone, LONE));
        if let Some(&best) = rivals.first() {
            let alike =
                |c: &Candidate, s: &Score| are_neighbours(c.effect, best.effect) && s.gain >= least;
            let others = self.best_first(screen, alike);
            rivals.extend(more(&rivals, others, NEIGHBOURS));
        }
        rivals
    }
}

/// Whether an effect that takes the part `gain` off the cost leaves `cost`, all but a tenth of which is noise. How likely that is by
/// chance is another matter: while channels are weighed by what was left before, falls look small.
fn leaves_noise(gain: f64, (cost, noise): (f64, f64)) -> bool {
    gain >= MUCH && is_noise(cost, noise)
}

/// Whether a fall of the cost is much of it, or most of what noise does not explain of it, and held-out recordings agree: costs
/// of these fall, `falls` says, by more than what is given to it.
pub(super) fn is_much(
    (fall, cost, unexplained): (f64, f64, f64),
    falls: impl Fn(fn(&Held) -> f64) -> bool,
) -> bool {
    (fall >= MUCH * cost && falls(|held| MUCH * held.unexplained()))
        || (fall >= MOST * unexplained && falls(|held| MOST * held.unexplained()))
}

/// Chance that noise alone makes the cost fall so with a candidate, as if all of its numbers and shapes were fitted: where hardly
/// anything but noise is left the cost is χ²/2, however few the stretches are that tell.
fn by_noise(candidate: &Candidate, fall: f64) -> f64 {
    let about = candidate.effect.about();
    let chance = ChiSquared::new(about.parameters.len() as f64);
    chance.map_or(1.0, |chance| {
        chance.sf(2.0 * fall.max(0.0)) * about.shapes() as f64
    })
}

/// What an effect takes off the held-out recordings' cost at least.
pub(super) fn of_use(held: &Held) -> f64 {
    at_least(held, held.cost)
}

/// The same of one that leaves nothing but noise of what is fitted.
fn of_rest(held: &Held) -> f64 {
    at_least(held, held.unexplained())
}

/// A part of `cost`, or what makes noise much likelier where that is all.
fn at_least(held: &Held, cost: f64) -> f64 {
    let part = OF_USE * cost;
    if held.is_noise() {
        part.min(held.likelier())
    } else {
        part
    }
}

/// Candidates that anything can be seen of: so many tests.
pub(super) fn tests(screen: &Screen) -> usize {
    let seen = |c: &&Candidate| c.score.as_ref().is_some_and(|s| s.visible >= LEAST_VISIBLE);
    screen.candidates.iter().filter(seen).count().max(1)
}

#[cfg(test)]
mod tests {
    use super::{Held, Tried, is_much, leaves_noise, of_rest, of_use};
    use crate::gap::effect::{ModelFile, write};
    use crate::gap::masses::{chosen, machine, searching};

    /// A motor stronger than said, of which a rotor has stood for all but what damping shows.
    #[test]
    fn a_fit_starts_where_the_screen_expects_parameters_to_be() {
        let base = machine(r#"damping=".2""#, "");
        // all of the base over 1.25, as if forces were 1.25 times as large
        let hidden = machine(r#"damping=".16" armature="-.1""#, "");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"armature\"\nscale = \"linear\"\n\
                      prior_sigma = 0.1\nlower = -0.4\n";
        searching(&base, &hidden, config, |search, watch| {
            let screen = search.screen(watch).expect("screened").expect("whole");
            let all = screen.candidates.iter();
            let mut gains = all
                .filter(|c| c.place.to_string() == "ma" && c.effect.about().name == "torque_gain");
            let gain = gains.next().expect("a candidate");
            let step = screen.normal.step(&gain.columns);
            let mut cost = |step: &[f64]| {
                let from = Some((step, &screen.linear));
                let fitted = search.fitted_after(from, &[gain.chosen()], (0, f64::INFINITY), watch);
                fitted.expect("fitted").expect("follows").cost
            };
            let (there, here) = (cost(&step), cost(&[]));
            assert!(there < 0.01 * here, "{there} {here}");
        });
    }

    /// A motor that is at its bound for a few samples of two windows.
    #[test]
    fn what_few_samples_show_is_found() {
        const CUT: f64 = 0.803;
        let base = machine("", "").xml.replace(
            r#"name="ma""#,
            r#"name="ma" ctrllimited="true" ctrlrange="-9.2 9.2""#,
        );
        let base = ModelFile::of_text(base, "bounded.xml").expect("loads");
        let law = chosen(&base, "torque_saturation", "ma", &[CUT]);
        let hidden = write(&base, law.effect, &law.place, &law.values).expect("written");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"armature\"\n";
        searching(&base, &hidden.file, config, |search, watch| {
            let left = search.forward(None, watch).expect("searched");
            let names: Vec<_> = search
                .chosen
                .iter()
                .map(|c| c.effect.about().name)
                .collect();
            assert!(
                left.is_none() && names == ["torque_saturation"],
                "{names:?}"
            );
            let cut = search.chosen[0].values[0];
            assert!((cut - CUT).abs() < 0.002, "{cut}");
        });
    }

    /// Falls of fits on fingers: a scale of an encoder, which masses explain nearly all of, and a delay that nobody hid.
    #[test]
    fn what_is_most_of_what_noise_does_not_explain_is_much() {
        let (scale, delay) = ((60.4, 1080.5, 107.2), (26.7, 7371.0, 737.1));
        assert!(is_much(scale, |_| true) && !is_much(delay, |_| true));
        // held-out recordings agree with half of it
        let held = Held::of(1000.0, 950.0);
        let fallen = |least: fn(&Held) -> f64| least(&held) < 60.0;
        assert!(is_much(scale, fallen) && !is_much(scale, |least| least(&held) < 40.0));
        assert!(is_much((250.0, 1000.0, 900.0), |_| true));
    }

    /// Costs of a finger whose drive gives way, which one held-out motion hardly shows: 224 of it is noise.
    #[test]
    fn held_out_noise_need_not_be_explained() {
        let falls = |noise: f64, after: f64| 237.0 - after > of_use(&Held::of(237.0, noise));
        assert!(falls(224.0, 226.0) && !falls(224.0, 231.0));
        assert!(!falls(200.0, 226.0) && falls(200.0, 225.0));
    }

    /// Costs of a finger whose motor meets its bound, in few samples of the held-out motion: 10.88 of it is noise.
    #[test]
    fn what_leaves_nothing_but_noise_need_not_show_in_held_out_noise() {
        let (held, fall) = (Held::of(12.33, 10.88), 12.33 - 12.17);
        assert!(fall < of_use(&held) && fall > of_rest(&held));
        assert!(of_rest(&held) > 0.07);
    }

    /// Costs of a finger whose motor has a twentieth of its range, met in one window of 75 and in no held-out motion: in weights by what
    /// the rest leaves chance is 0.2 %, in its own 10^-17.
    #[test]
    fn what_leaves_noise_in_coarse_weights_need_not_show_held_out_either() {
        assert!(leaves_noise(0.515, (8.28, 12.6)) && !leaves_noise(0.1, (8.28, 12.6)));
        assert!(!leaves_noise(0.515, (14.1, 12.6)));
        let (held, fall) = (Held::of(4.600, 3.951), 4.600 - 4.530);
        assert!(fall < of_use(&held) && fall > of_rest(&held));
    }

    /// However little channels weigh, what is left is worth the same.
    #[test]
    fn costs_are_by_what_the_best_leaves() {
        let base = machine(r#"damping=".2""#, "");
        let hidden = machine(r#"damping=".2" stiffness=".5""#, "");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &hidden, config, |search, watch| {
            let screen = search.screen(watch).expect("screened").expect("whole");
            let mut worth = |factor: f64| {
                for channel in &mut search.windows.problem.channels {
                    channel.sigma *= factor;
                }
                let fit = search.fitted(&[], 3, watch).expect("fitted");
                let fit = fit.expect("follows");
                let cost = fit.cost;
                let candidate = &screen.candidates[0];
                let costs = [cost; 2];
                let tried = [Tried {
                    fit,
                    candidate,
                    costs,
                }];
                cost / search.unit(&tried, 0).expect("weighed")
            };
            let (before, after) = (worth(100.0), worth(10.0));
            assert!((after / before - 1.0).abs() < 1e-3, "{before} {after}");
        });
    }
}
