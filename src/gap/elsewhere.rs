//! The same effect elsewhere: an arm whose elbow has dry friction has it in the other joints too.
//!
//! Of the candidates that one screen finds worth a place in the model, the one is picked again and again that explains most
//! beside those picked before, all columns as the screen has them:
//!
//! ```text
//! next = argmax held_gain(picked ∪ c) − held_gain(picked)
//! ```
//!
//! While that is the effect that was found last, at another place, it is more of the same. All are then fitted in one step,
//! and judged one by one as any other effect ([`super::forward`]); what does not stand is left out. What was found at
//! several places is one effect in the count of those that are looked for.

use super::candidate::Candidate;
use super::evidence::{Evidence, Standing};
use super::forward::{of_use, tests};
use super::held_out::{Held, falls};
use super::screen::Screen;
use super::search::{ITERATIONS, Search};
use super::{GapError, Stage, Watch};

impl Search<'_> {
    /// Adds the effect found last at other places that ask for it, and takes out what is no longer needed then. What comes back
    /// is the screen of the present model, where one was made.
    ///
    /// # Errors
    /// The engine refuses a number; [`GapError::Stopped`].
    pub(super) fn elsewhere(&mut self, watch: &mut Watch<'_>) -> Result<Option<Screen>, GapError> {
        let Some(found) = self.chosen.last() else {
            return Ok(None);
        };
        let effect = found.effect;
        if effect.places(&self.base.model).len() < 2 {
            return Ok(None);
        }
        let screen = self.screened(watch)?;
        let mut more = self.more(&screen, effect.about().name);
        if more.is_empty() {
            return Ok(Some(screen));
        }
        watch.stage(Stage::Refit);
        let held = self.held(self.at_hand(), 0.0)?;
        while !more.is_empty() {
            let Some((then, evidence)) = self.with_all(&more, (&screen, held.as_ref()), watch)?
            else {
                break;
            };
            let stands =
                |e: &Evidence| self.limits.significant(e.p_value) && self.limits.large(e.size);
            if evidence.iter().all(stands) {
                *self = then;
                self.evidence.extend(evidence);
                // what stood for the effect where it had not been found yet
                self.delete(watch)?;
                return Ok(None);
            }
            let each = more.into_iter().zip(&evidence);
            more = each.filter_map(|(c, e)| stands(e).then_some(c)).collect();
        }
        Ok(Some(screen))
    }

    /// Candidates that are more of `name`.
    fn more<'s>(&self, screen: &'s Screen, name: &str) -> Vec<&'s Candidate> {
        let mut left = self.worthy(screen);
        let least = self.limits.gain * self.unexplained(screen);
        let (mut picked, mut columns) = (Vec::new(), Vec::new());
        let (mut gain, mut held_gain) = (0.0, 0.0);
        loop {
            let scores = left.iter().enumerate().filter_map(|(i, c)| {
                let score = (screen.normal).score(&[&columns[..], &c.columns].concat())?;
                (score.gain - gain >= least).then_some((i, score))
            });
            let best = scores.max_by(|a, b| a.1.held_gain.total_cmp(&b.1.held_gain));
            let Some((i, score)) = best.filter(|b| b.1.held_gain > held_gain) else {
                break;
            };
            let next = left.remove(i);
            if next.effect.about().name != name {
                break;
            }
            (gain, held_gain) = (score.gain, score.held_gain);
            columns.extend(&next.columns);
            picked.push(next);
        }
        picked
    }

    /// With all of these, and what speaks for each; nothing where they cannot be fitted, or are of no use to held-out
    /// recordings, which cost `held` without them.
    fn with_all(
        &self,
        more: &[&Candidate],
        (screen, held): (&Screen, Option<&Held>),
        watch: &mut Watch<'_>,
    ) -> Result<Option<(Self, Vec<Evidence>)>, GapError> {
        let Some(fitted) = self.fitted_with(more, screen, (ITERATIONS, f64::INFINITY), watch)?
        else {
            return Ok(None);
        };
        if self.absurd(&fitted.built, &fitted.chosen) {
            return Ok(None);
        }
        let [held, after] = self.held_both(held, &fitted)?;
        if !falls(held.as_ref(), after.as_ref(), of_use) {
            return Ok(None);
        }
        let then = self.settled_with(fitted, watch)?;
        let standing = Standing::of(&then)?;
        let first = self.chosen.len();
        let each = more.iter().enumerate().map(|(k, c)| {
            let gain = c.score.as_ref().map_or(0.0, |s| s.gain) / self.cost;
            standing.evidence(first + k, c, tests(screen), gain)
        });
        let evidence = each.collect();
        Ok(Some((then, evidence)))
    }
}
