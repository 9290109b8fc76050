//! Dry friction rated by what its varieties leave.
//!
//! Friction that falls with speed, or differs with direction or load, is found in two steps: a constant level first, which alone
//! explains a part of it, then how it varies. A payload with four numbers may explain more than the level, and takes its place.
//! So where dry friction of a joint is not what fits best, each of its varieties is fitted beside it, and what fits best once
//! more, channels weighed by what the level leaves. With d² of [`super::alike`] between both and that,
//!
//! ```text
//! C(level, variety) + 2 numbers < C(best) + 2 numbers − 9/2
//! ```
//!
//! the level comes first.

use super::alike::{self, Tried};
use super::effect::{CATALOGUE, DRY};
use super::inputs::is_wanted;
use super::name::APART;
use super::search::Search;
use super::{GapError, Watch};

impl Search<'_> {
    /// Which of `tried`, the best first, is dry friction that has to come first.
    ///
    /// # Errors
    /// The engine refuses a number; [`GapError::Stopped`].
    pub(super) fn varied(
        &self,
        tried: &[Tried<'_>],
        watch: &mut Watch<'_>,
    ) -> Result<Option<usize>, GapError> {
        let is_level = |own: &Tried<'_>| own.candidate.effect.about().name == DRY;
        let is_dry = |own: &Tried<'_>| is_level(own) || own.candidate.effect.about().is_variety();
        let Some(best) = tried.first().filter(|best| !is_dry(best)) else {
            return Ok(None);
        };
        let all = CATALOGUE.iter().map(|e| e.about());
        let varieties: Vec<String> = (all.filter(|about| about.is_variety()))
            .map(|about| about.name.to_owned())
            .filter(|name| is_wanted(&self.effects, name))
            .collect();
        if varieties.is_empty() {
            return Ok(None);
        }
        for (i, dry) in tried.iter().enumerate().filter(|own| is_level(own.1)) {
            let mut there = self.settled_with(dry.fit.clone(), watch)?;
            there.effects.clone_from(&varieties);
            let mut other = best.fit.clone();
            other
                .windows
                .problem
                .take_sigma(&there.windows.problem.sigma());
            other.improve(&there, watch)?;
            let price = alike::price(other.cost, &other.x);
            let screen = there.screened(watch)?;
            let place = &dry.candidate.place;
            for rival in there
                .rivals(&screen)
                .into_iter()
                .filter(|c| c.place == *place)
            {
                let Some((both, _)) = there.begun(rival, &screen, watch)? else {
                    continue;
                };
                let own = alike::price(both.cost, &both.x);
                if own < price && alike::apart(price, own) >= APART {
                    return Ok(Some(i));
                }
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::effect::{ModelFile, write};
    use crate::gap::masses::{chosen, machine, searching};

    /// Which of drag and the dry friction of one mass has to come first, where `hidden` is the machine.
    fn first(hidden: &ModelFile) -> Option<usize> {
        let base = machine("", "");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        let mut told = None;
        searching(&base, hidden, config, |search, watch| {
            let screen = search.screen(watch).expect("screened").expect("whole");
            let mut of = |name: &str| {
                let mut all = screen.candidates.iter();
                let own = all.find(|c| c.effect.about().name == name && c.place.to_string() == "a");
                let candidate = own.expect("a candidate");
                let begun = search.begun(candidate, &screen, watch).expect("fitted");
                let (mut fit, _) = begun.expect("follows");
                fit.improve(search, watch).expect("fitted");
                let costs = [fit.cost; 2];
                Tried {
                    fit,
                    candidate,
                    costs,
                }
            };
            let tried = [of("quadratic_drag"), of(DRY)];
            told = Some(search.varied(&tried, watch).expect("fitted"));
        });
        told.expect("searched")
    }

    #[test]
    fn a_level_is_rated_by_its_varieties() {
        let dry = machine(r#"frictionloss=".15""#, "");
        let law = chosen(&dry, "stribeck_friction", "a", &[0.2, 0.0, 0.3]);
        let written = write(&dry, law.effect, &law.place, &law.values).expect("written");
        assert_eq!(first(&written.file), Some(1));
        let law = chosen(&machine("", ""), "quadratic_drag", "a", &[0.3]);
        let drag = write(&machine("", ""), law.effect, &law.place, &law.values).expect("written");
        assert_eq!(first(&drag.file), None);
    }
}
