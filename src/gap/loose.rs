//! What is known of dry friction, where the recordings deny it.
//!
//! A prior of a joint's friction is of a joint that rubs as the model says. A law by which it rubs otherwise brings a level of its own,
//! three to five times that friction on machines that hide one. While what is left weighs little the prior holds the friction where it
//! was, and an offset, a drag or friction by load stands for the rest of the level. Without the prior friction makes up for what it
//! is not, a motor too weak to move its joint. At each step forward the present model is therefore fitted with priors of friction that
//! are ten times as wide too, and taken, once, if by price
//!
//! ```text
//! cost/unit + 2 n
//! ```
//!
//! it is ahead of all candidates that were fitted ([`super::forward`]), and held-out recordings cost less. Friction then stays free; it is
//! no effect by itself, as a parameter that is fitted anyway explains it.

use std::borrow::Cow;

use super::alike::price;
use super::search::{FEW_ITERATIONS, Search};
use super::{GapError, Watch};
use crate::sysid::parameter::ParameterRule;

/// Factor by which what was known may be wrong.
const LOOSELY: f64 = 10.0;

/// What the priors of dry friction are part of, these wider.
fn rules(known: &[ParameterRule]) -> Vec<ParameterRule> {
    let wider = |rule: &ParameterRule| {
        let mut rule = rule.clone();
        if is_friction(&rule) {
            rule.prior_sigma = rule.prior_sigma.map(|sigma| LOOSELY * sigma);
        }
        rule
    };
    known.iter().map(wider).collect()
}

fn is_friction(rule: &ParameterRule) -> bool {
    rule.attribute == "frictionloss"
}

impl<'a> Search<'a> {
    /// Whether what is known of friction counts little.
    pub(super) fn is_loose(&self) -> bool {
        matches!(self.rules, Cow::Owned(_))
    }

    /// The rules by which it does: those of a search that is so already.
    pub(super) fn loose_rules(&self) -> Cow<'a, [ParameterRule]> {
        match &self.rules {
            Cow::Borrowed(known) => Cow::Owned(rules(known)),
            loose @ Cow::Owned(_) => loose.clone(),
        }
    }

    /// The present model with friction that what is known of it does not hold, settled, if its price in `unit` is below
    /// `least`; nothing where it is that already.
    ///
    /// # Errors
    /// The engine refuses a number; [`GapError::Stopped`].
    pub(super) fn loosened(
        &self,
        (least, unit): (f64, f64),
        watch: &mut Watch<'_>,
    ) -> Result<Option<Self>, GapError> {
        let holds = |rule: &ParameterRule| is_friction(rule) && rule.prior_sigma.is_some();
        if self.is_loose() || !self.rules.iter().any(holds) {
            return Ok(None);
        }
        let mut then = self.clone();
        then.rules = self.loose_rules();
        let bound = unit * (least - price(0.0, &self.x));
        let effort = (FEW_ITERATIONS, bound);
        let Some(mut fitted) = then.fitted_after(None, &self.chosen, effort, watch)? else {
            return Ok(None);
        };
        if fitted.cost < bound {
            fitted.improve(&then, watch)?;
        }
        let recorded_s = self.recorded_s(&fitted.chosen);
        if fitted.cost >= bound || !self.is_less_held_out(fitted.at_hand(), recorded_s)? {
            return Ok(None);
        }
        then.settled_with(fitted, watch).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::masses::{machine, searching_cut};
    use crate::gap::repair;
    use crate::gap::stages::Step;

    /// What is known of friction counts less, what nobody knows stays so, and all else counts as it did.
    #[test]
    fn what_was_known_of_friction_may_be_wrong() {
        let rule = |(attribute, prior_sigma): (&str, Option<f64>)| ParameterRule {
            prior_sigma,
            ..ParameterRule::new("joint/*", attribute)
        };
        let known = [
            ("frictionloss", Some(0.3)),
            ("damping", Some(0.3)),
            ("frictionloss", None),
        ];
        let sigma = rules(&known.map(rule))
            .iter()
            .map(|r| r.prior_sigma)
            .collect::<Vec<_>>();
        assert_eq!(sigma, [Some(3.0), Some(0.3), None]);
    }

    /// Four times the friction that is known, with a spring: held near the prior until it is let go, if nothing else does better.
    #[test]
    fn friction_is_let_go_once_where_that_is_ahead() {
        let base = machine(r#"frictionloss=".03""#, "");
        let hidden = machine(r#"frictionloss=".12" stiffness=".5""#, "");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"frictionloss\"\nprior_sigma = 0.1\n";
        searching_cut(&base, &hidden, config, |search, cuts, watch| {
            let friction = |search: &Search<'_>| {
                let fitted = repair::machine(&search.windows.problem, &search.x);
                fitted.expect("a model").model.dof_frictionloss()[0]
            };
            let held = friction(search);
            assert!(held < 0.05, "{held}");
            let ahead = 0.5 * search.cost;
            let none = search.loosened((ahead, 1.0), watch).expect("fitted");
            assert!(none.is_none());
            let loose = search
                .loosened((f64::INFINITY, 1.0), watch)
                .expect("fitted");
            let loose = loose.expect("ahead");
            assert!(loose.is_loose() && !search.is_loose());
            let free = friction(&loose);
            assert!((free - 0.12).abs() < 0.02, "{free}");
            let again = loose.loosened((f64::INFINITY, 1.0), watch).expect("fitted");
            assert!(again.is_none());
            // and counts no less where a search goes on from one stage after the other
            let sigma = |search: &Search<'_>| search.rules[0].prior_sigma;
            for _ in 0..2 {
                assert!(Step::of(&loose, false).restore(search, cuts).expect("fits"));
                assert_eq!(sigma(search), sigma(&loose));
            }
        });
    }
}
