//! Whether the fall of the cost that an effect owes its place to is owed to the effect, or to its fit.
//!
//! Joints that stick bend the cost: a fit of the present model may end where one that takes a way round, through numbers of an
//! effect, goes on, and whatever is fitted then seems to take much off the cost. A screen is linear, and foretells none of
//! that. Where more falls than it foretold, the model without the effect is therefore fitted once more from where the fit with
//! it ended,
//!
//! ```text
//! C₁ without, C₀ without from there, C with        fall: C₀ − C of C₀, for C₀ < C₁
//! ```
//!
//! and if that is not much, the better fit takes the place of the present one, and the effect has to be found anew beside it.

use super::fitted::Fitted;
use super::forward::is_much;
use super::held_out::{Held, falls, unexplained};
use super::search::{FEW_ITERATIONS, Search};
use super::{GapError, Watch};

/// Times the fall that a screen foretells, above which it is asked whose it is.
const FORETOLD: f64 = 2.0;

/// What the fall of the cost is owed to.
pub(super) enum Owed {
    /// the effect, which takes this part off the cost
    Effect(f64),
    /// the fit: here is one without the effect
    Fit(Box<Fitted>),
}

impl Search<'_> {
    /// What `own`, a fit of the present model with one more effect that leaves `held` of the held-out recordings, owes its fall
    /// to, of which a screen foretold `foretold`; noise does not explain `left` of the present cost.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn owed(
        &self,
        (own, held): (&Fitted, Option<&Held>),
        (foretold, left): (f64, f64),
        watch: &mut Watch<'_>,
    ) -> Result<Owed, GapError> {
        let fall = self.cost - own.cost;
        let the_effect = Owed::Effect(fall / self.cost);
        if fall <= FORETOLD * foretold {
            return Ok(the_effect);
        }
        let there = self.with(own.clone());
        let present = &own.chosen[..self.chosen.len()];
        let Some(mut without) = there.fitted(present, FEW_ITERATIONS, watch)? else {
            return Ok(the_effect);
        };
        without.improve(self, watch)?;
        if without.cost >= self.cost {
            return Ok(the_effect);
        }
        let (fall, cost) = (without.cost - own.cost, without.cost);
        let left = unexplained(cost, self.cost - left);
        let before = self.held(without.at_hand(), self.recorded_s(&own.chosen))?;
        if is_much((fall, cost, left), |least| {
            falls(before.as_ref(), held, least)
        }) {
            return Ok(Owed::Effect(fall / cost));
        }
        Ok(Owed::Fit(Box::new(without)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::masses::{chosen, machine, searching};

    /// What is found of the fall that a spring brings where damping was left off its best; and the cost there and at its best,
    /// which is less than half.
    fn owed_beside_damping(stiffness: &str, foretold: f64) -> (Owed, f64, f64) {
        let base = machine(r#"damping=".2""#, "");
        let hidden = machine(&format!(r#"damping=".2" stiffness="{stiffness}""#), "");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"damping\"\n";
        let mut told = None;
        searching(&base, &hidden, config, |search, watch| {
            let best = search.cost;
            search.x[0] += 0.05;
            let windows = &search.windows;
            let followed = windows.simulate(&search.x, &windows.states);
            let followed = followed.expect("simulated").expect("whole");
            search.cost = followed.iter().map(|own| own.cost).sum();
            let spring = chosen(&base, "joint_spring", "a", &[0.01, 0.0]);
            let fitted = search.fitted(&[spring], 12, watch).expect("fitted");
            let own = fitted.expect("follows");
            let owed = search.owed((&own, None), (foretold, 0.5 * search.cost), watch);
            assert!(search.cost > 2.0 * best, "{} {best}", search.cost);
            told = Some((owed.expect("fitted"), search.cost, best));
        });
        told.expect("searched")
    }

    #[test]
    fn a_better_fit_is_no_effect() {
        let (owed, _, best) = owed_beside_damping("0", 1.0);
        let Owed::Fit(without) = owed else {
            panic!("a spring that is not there");
        };
        assert!(without.chosen.is_empty() && without.cost < 1.01 * best);
    }

    #[test]
    fn an_effect_has_what_no_fit_brings() {
        let (owed, off, _) = owed_beside_damping("0.02", 1.0);
        let Owed::Effect(part) = owed else {
            panic!("a spring that is there");
        };
        assert!(part > 0.3 && part < 0.6, "{part}");
        // as foretold: nobody asks
        let (owed, ..) = owed_beside_damping("0.02", off);
        assert!(matches!(owed, Owed::Effect(part) if part > 0.7));
    }
}
