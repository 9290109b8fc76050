//! What models whose encoders are late differently have in common.
//!
//! Encoders that are T late show in the first T of a window what was before it, which no model simulates: it is taken from
//! the recording ([`crate::sysid::path`]), and is right whatever the model. A model that lacks dry friction is lost after T too,
//! in shorter windows: if it deviates by t², a delay of a fifth of the window takes two thirds off its cost. So a model with
//! a delay is rated at what it would cost if the first T were as wrong as the present model has them,
//!
//! ```text
//! C = N + (C′ − N′) (C₀ − N) / (C₀′ − N′)        ′: without encoders' samples of the first T of each window
//! ```
//!
//! with C₀ of the present model, fitted to either, and N what noise explains. Held-out recordings are compared without these
//! samples, which of both models only one simulates.

use std::sync::Arc;

use super::fitted::Fitted;
use super::held_out::{Held, is_noise};
use super::model::Chosen;
use super::search::{FEW_ITERATIONS, Search, sound};
use super::windows::Windows;
use super::{GapError, Watch};
use crate::sysid::problem::{Stage, Trial};

/// s by which the effects make encoders late.
fn late_s(chosen: &[Chosen]) -> f64 {
    let late = chosen
        .iter()
        .filter_map(|c| Some(c.values[c.effect.about().lateness()?]));
    late.sum()
}

impl Windows {
    /// The same without what encoders show in the first `late_s` of each; nothing if that is all they show.
    pub(super) fn without_first(&self, late_s: f64) -> Option<Self> {
        let mut rest = self.clone();
        if late_s == 0.0 {
            return Some(rest);
        }
        let channels = &self.problem.channels;
        for trial in &mut rest.problem.trials {
            Arc::make_mut(&mut trial.samples)
                .retain(|s| s.time >= late_s || channels[s.channel].stage != Stage::Position);
        }
        let left = |t: &Trial| !t.samples.is_empty();
        rest.problem.trials.iter().all(left).then_some(rest)
    }
}

impl Search<'_> {
    /// s at the begin of each window that one of the present model and that with the effects `chosen` takes from the recording,
    /// and the other simulates; 0 where there is no more than a step of these.
    pub(super) fn recorded_s(&self, chosen: &[Chosen]) -> f64 {
        let (own, other) = (late_s(&self.chosen), late_s(chosen));
        if (own - other).abs() < self.windows.problem.model.timestep() {
            return 0.0;
        }
        own.max(other)
    }

    /// What a fit of `windows` with the effects `chosen` at `x`, which costs `cost`, is rated at beside the present model;
    /// infinite where the present model leaves nothing but noise of what both simulate.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn rated(
        &self,
        (windows, x, cost): (&Windows, &[f64], f64),
        chosen: &[Chosen],
        watch: &mut Watch<'_>,
    ) -> Result<f64, GapError> {
        let recorded_s = self.recorded_s(chosen);
        if recorded_s == 0.0 {
            return Ok(cost);
        }
        let is_later = late_s(chosen) > late_s(&self.chosen);
        let (later, other) = if is_later {
            ((windows, x), (&self.windows, &self.x[..]))
        } else {
            ((&self.windows, &self.x[..]), (windows, x))
        };
        let common = |of: &Windows| of.without_first(recorded_s);
        let (Some(later_rest), Some(mut rest)) = (common(later.0), common(other.0)) else {
            return Ok(f64::INFINITY);
        };
        let followed = later_rest.simulate(later.1, &later_rest.states)?;
        let fitted = sound(rest.fit(other.1, FEW_ITERATIONS, &mut watch.fit_nearly()))?;
        let (Some(followed), Some(fitted)) = (followed, fitted) else {
            return Ok(f64::INFINITY);
        };
        let prior = later_rest.problem.parameters.prior_cost(later.1);
        let of_later = followed.iter().map(|f| f.cost).sum::<f64>() + prior;
        if !is_later {
            return Ok(self.cost + fitted.cost - of_later);
        }
        let noise = |of: &Windows| self.noise_cost(of.problem.samples().map(|s| s.channel));
        let (all, part) = (noise(&self.windows), noise(&rest));
        if is_noise(fitted.cost, part) {
            return Ok(f64::INFINITY);
        }
        let times = (self.cost - all) / (fitted.cost - part);
        Ok(all + (of_later - part) * times.max(1.0))
    }

    /// Held-out recordings with the present model and with a fitted one, as far as both simulate them; `present` is what is
    /// known of the present one.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn held_both(
        &self,
        present: Option<&Held>,
        fitted: &Fitted,
    ) -> Result<[Option<Held>; 2], GapError> {
        let recorded_s = self.recorded_s(&fitted.chosen);
        let before = if recorded_s > 0.0 {
            self.held(self.at_hand(), recorded_s)?
        } else {
            present.cloned()
        };
        let after = self.held(fitted.at_hand(), recorded_s)?;
        Ok([before, after])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::effect::{ModelFile, write};
    use crate::gap::masses::{chosen, found, machine, searching_cut};
    use crate::gap::search::ITERATIONS;

    const DELAY_S: f64 = 0.012;

    /// Looks for what `hidden` has in windows of `length_s`.
    fn searching(
        hidden: &ModelFile,
        length_s: f64,
        then: impl FnOnce(&mut Search<'_>, &mut Watch<'_>),
    ) {
        let base = machine("", "");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching_cut(&base, hidden, config, |search, cuts, watch| {
            search.windows = cuts.train(length_s).expect("windows");
            search.settle(watch).expect("fitted");
            search.held_out = Some(search.windows.clone());
            then(search, watch);
        });
    }

    fn delay() -> Chosen {
        chosen(&machine("", ""), "sensor_delay", "world", &[DELAY_S])
    }

    /// The cost by itself.
    fn itself(windows: &Windows, x: &[f64]) -> f64 {
        let followed = windows.simulate(x, &windows.states).expect("simulated");
        followed.expect("whole").iter().map(|f| f.cost).sum()
    }

    /// Parts of the present cost that a delay of the encoders leaves, by itself and as it is rated, and of held-out recordings, as
    /// far as both models simulate them.
    fn left(hidden: &ModelFile, length_s: f64) -> [f64; 3] {
        let mut told = None;
        searching(hidden, length_s, |search, watch| {
            let fitted = search
                .fitted(&[delay()], ITERATIONS, watch)
                .expect("fitted");
            let fitted = fitted.expect("follows");
            let own = itself(&fitted.windows, &fitted.x);
            let [before, after] = search.held_both(None, &fitted).expect("fitted");
            let held = after.expect("follows").cost / before.expect("follows").cost;
            told = Some([own / search.cost, fitted.cost / search.cost, held]);
        });
        told.expect("searched")
    }

    /// Dry friction that nobody modelled: what is taken from the recording is right, and nothing else.
    #[test]
    fn what_is_recorded_is_no_merit() {
        let hidden = machine(r#"frictionloss="2""#, "");
        let [own, rated, _] = left(&hidden, 0.025);
        assert!(own < 0.6 && rated > 1.0, "{own} {rated}");
        let [own, rated, held] = left(&hidden, 0.05);
        assert!(rated > own && held > 1.0, "{own} {rated} {held}");
    }

    #[test]
    fn encoders_that_are_late_are_found_so() {
        let (base, late) = (machine("", ""), delay());
        let written = write(&base, late.effect, &late.place, &late.values).expect("written");
        let [_, rated, held] = left(&written.file, 0.2);
        assert!(rated < 0.05 && held < 0.05, "{rated} {held}");
    }

    /// The other way round: beside a model with the delay, one without is rated by what both simulate.
    #[test]
    fn a_model_in_its_place_is_rated_likewise() {
        searching(&machine(r#"frictionloss="2""#, ""), 0.1, |search, watch| {
            let present = search.cost;
            found(search, &[delay()], watch);
            assert!((search.cost / itself(&search.windows, &search.x) - 1.0).abs() < 0.01);
            let mut rated = |of: &[Chosen]| {
                let fitted = search.fitted(of, ITERATIONS, watch).expect("fitted");
                fitted.expect("follows").cost
            };
            let friction = chosen(&machine("", ""), "coulomb_friction", "a", &[1.5]);
            let (none, friction) = (rated(&[]), rated(&[friction]));
            let with = search.cost;
            assert!(none < 1.1 * with, "{none} {with} {present}");
            assert!(friction < 0.6 * with, "{friction} {with}");
        });
    }
}
