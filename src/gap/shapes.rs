//! Candidates in the model, in the shape that suits them.
//!
//! A size is found from anywhere, a shape is not: how dry friction changes with speed is linear in nothing, and a speed of Stribeck's
//! fall that is a fifth of the true one fits better than all near it. A candidate that leads is therefore fitted from every shape of
//! its grid, and one that falls short of what the screen foretold from the next.

use super::candidate::Candidate;
use super::fitted::Fitted;
use super::forward::{LEADING, WORSE};
use super::screen::Screen;
use super::search::{FEW_ITERATIONS, Search};
use super::{GapError, Watch};

impl Search<'_> {
    /// A candidate in the model, the fit begun. Where that falls short of what the screen expects, other shapes are tried: how
    /// dry friction changes with speed is not linear in anything.
    pub(super) fn begun<'s>(
        &self,
        candidate: &'s Candidate,
        screen: &Screen,
        watch: &mut Watch<'_>,
    ) -> Result<Option<(Fitted, &'s Candidate)>, GapError> {
        self.begun_below(f64::INFINITY, candidate, screen, watch)
    }

    /// The same, given up where no cost below `bound` is foretold.
    pub(super) fn begun_below<'s>(
        &self,
        bound: f64,
        candidate: &'s Candidate,
        screen: &Screen,
        watch: &mut Watch<'_>,
    ) -> Result<Option<(Fitted, &'s Candidate)>, GapError> {
        let mut best: Option<(Fitted, &Candidate)> = None;
        for c in candidate.shapes() {
            let Some(score) = &c.score else { continue };
            let own = self.fitted_with(&[c], screen, (FEW_ITERATIONS, bound), watch)?;
            best = (best.into_iter().chain(own.map(|own| (own, c))))
                .min_by(|a, b| a.0.cost.total_cmp(&b.0.cost));
            let enough = self.cost - LEADING * score.gain;
            if best.as_ref().is_some_and(|b| b.0.cost <= enough) {
                break;
            }
        }
        Ok(best)
    }

    /// Takes another shape of a fitted candidate where that fits better: a speed of Stribeck's fall that is well below the true one
    /// is no way from it.
    pub(super) fn other_shapes<'s>(
        &self,
        (own, candidate): (&mut Fitted, &mut &'s Candidate),
        screen: &'s Screen,
        watch: &mut Watch<'_>,
    ) -> Result<(), GapError> {
        let present = *candidate;
        let is_present = |c: &Candidate| std::ptr::eq(c, present);
        let mut all = screen.candidates.iter();
        let Some(own_shapes) = all.find(|c| c.shapes().any(is_present)) else {
            return Ok(());
        };
        let others = own_shapes.shapes().filter(|c| !is_present(c));
        for other in others.filter(|c| c.score.is_some()) {
            let bound = WORSE * own.cost;
            let begun = self.fitted_with(&[other], screen, (FEW_ITERATIONS, bound), watch)?;
            let Some(mut fit) = begun else { continue };
            fit.improve_below(bound, self, watch)?;
            if fit.cost < own.cost {
                (*own, *candidate) = (fit, other);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use crate::gap::candidate::Candidate;
    use crate::gap::effect::write;
    use crate::gap::masses::{chosen, machine, searching};
    use crate::gap::score::Score;

    /// Dry friction that falls with speed, taken first to do so within a crawl.
    #[test]
    fn what_one_shape_does_not_fit_another_may() {
        let base = machine(r#"frictionloss=".15""#, "");
        let hidden = [0.2, 0.0, 0.3];
        let law = chosen(&base, "stribeck_friction", "a", &hidden);
        let machine = write(&base, law.effect, &law.place, &hidden).expect("written");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"frictionloss\"\n";
        searching(&base, &machine.file, config, |search, watch| {
            let mut screen = search.screen(watch).expect("screened").expect("whole");
            let is_law = |c: &&Candidate| {
                c.effect.about().name == "stribeck_friction" && c.place == law.place
            };
            let at = screen.candidates.iter().position(|c| is_law(&c));
            let at = at.expect("a candidate");
            let expected = screen.candidates[at].clone();
            assert!(!expected.others.is_empty());
            // more is expected than anything could bring
            let score = expected.score.clone().map(|own| Score {
                gain: 3.0 * search.cost,
                ..own
            });
            let crawl = Candidate {
                score,
                values: vec![0.2, 0.0, 1e-5],
                others: vec![expected.clone()],
                ..expected.clone()
            };
            let begun = search.begun(&crawl, &screen, watch).expect("fitted");
            let (fitted, of) = begun.expect("follows");
            assert_eq!(of.values, expected.values);
            assert!(fitted.cost < search.cost);
            let begun = search.begun_below(0.0, &expected, &screen, watch);
            let (given_up, _) = begun.expect("fitted").expect("follows");
            assert!(given_up.cost > fitted.cost);
            // what is as good as expected gives way all the same
            let crawl = Candidate {
                score: expected.score.clone().map(|own| Score {
                    gain: -9.0 * search.cost,
                    ..own
                }),
                ..crawl
            };
            screen.candidates[at] = crawl;
            let crawl = &screen.candidates[at];
            let begun = search.begun(crawl, &screen, watch).expect("fitted");
            let (mut fitted, mut of) = begun.expect("follows");
            assert_eq!(of.values, crawl.values);
            let (before, held) = (fitted.cost, (&mut fitted, &mut of));
            search.other_shapes(held, &screen, watch).expect("fitted");
            assert!(of.values == crawl.others[0].values && fitted.cost < before);
        });
    }
}
