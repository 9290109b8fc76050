//! Columns taken again where their effect would be.
//!
//! Dry friction, delays or play do not act in proportion to their size: a column is the effect of one size, and is worth what
//! that is worth. Once a screen expects a size β of a candidate, the column is taken again with it,
//!
//! ```text
//! φ = (r(x, β) − r(x, 0))/β
//! ```
//!
//! for the candidates that explain most. A size tried first may be a hundred times too large, as drag that brings a joint to
//! rest, and then expects the wrong sign, or to explain nothing: drag of 0.0026 N m s²/rad² that explained a quarter of a finger's
//! cost was expected to explain a thousandth. It is therefore taken again of all of one sign, which are those that bend, whose first
//! size is far larger than one that would do all that is left; where the sign is wrong or hardly any size is expected, with that
//! one. Beside effects that are in the model there are those that they may be mistaken for ([`super::lookalike`]): of these little
//! is expected, and a small size gives the derivative.

use super::GapError;
use super::effect::{self, Effect, Place, Sign};
use super::linear::{Column, squares};
use super::model::Variant;
use super::score::Normal;
use super::screen::{At, Look};
use super::together::Ask;

/// Candidates that explain most.
const MOST: usize = 16;
/// Part of a size that would do all that is left, below which there is nothing to look at; and of the size tried first, beside
/// effects in the model.
const LEAST: f64 = 0.02;
/// Times a size that would do all that is left from which on one says nothing of it.
const FAR: f64 = 10.0;
/// Part by which a size may differ from that which a column was taken with.
const NEAR: f64 = 0.1;

impl Look<'_> {
    /// Makes the `columns` of `found`, `taken` with these sizes, whose sums are `normal`, anew where that is worth it.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn look_again(
        &self,
        all: &[(&'static dyn Effect, Place)],
        found: &[(usize, Variant, Vec<usize>)],
        at: At<'_>,
        normal: &Normal,
        (columns, taken): (&mut [Column], &mut [f64]),
    ) -> Result<(), GapError> {
        let mut best: Vec<(f64, usize, Vec<f64>)> = (found.iter().enumerate())
            .filter_map(|(k, (_, _, own))| {
                let (gain, expected) = normal.gain(own)?;
                Some((gain, k, expected))
            })
            .collect();
        best.sort_by(|a, b| b.0.total_cmp(&a.0));
        let (mut asked, mut which) = (Vec::new(), Vec::new());
        for (rank, (_, k, expected)) in best.into_iter().enumerate() {
            let (i, variant, own) = &found[k];
            let (effect, place) = &all[*i];
            let beside = self.is_beside(*effect);
            let scales = self.measured.scales(&self.built.file.model, place);
            let parameters = effect.about().parameters;
            for (((c, (size, values)), &p), beta) in own
                .iter()
                .zip(&variant.columns)
                .zip(&variant.parameters)
                .zip(&expected)
            {
                let parameter = &parameters[p];
                if parameter.is_whole() {
                    continue;
                }
                let most = parameter.most(&scales);
                let beta = beta.clamp(-most, most);
                let length = squares(&columns[*c].parts);
                let whole = (2.0 * normal.cost() / length).sqrt().min(size.abs());
                let one_sided = parameter.sign == Sign::Positive;
                let far = one_sided && taken[*c].abs() > FAR * whole;
                if rank >= MOST && !beside && !far {
                    continue;
                }
                let wrong = one_sided && beta <= 0.0;
                let least = LEAST * if beside { size.abs() } else { whole };
                let little = beta.abs() < least;
                if little && !(wrong || far || beside) {
                    continue;
                }
                let beta = match (wrong || little, beside) {
                    (false, _) => beta,
                    (true, true) => least,
                    (true, false) => whole,
                };
                if (beta / taken[*c] - 1.0).abs() < NEAR {
                    continue;
                }
                let mut values = values.clone();
                values[p] = beta;
                taken[*c] = beta;
                which.push(*c);
                asked.push(Ask {
                    effect: *effect,
                    place: place.clone(),
                    values,
                    size: beta,
                });
            }
        }
        let answers = self
            .ask(&asked, at, &at.0.all(), &mut |_| true)?
            .unwrap_or_default();
        for (c, column) in which.into_iter().zip(answers) {
            if let Some(column) = column {
                columns[c] = column;
            }
        }
        Ok(())
    }

    /// Whether an effect may be mistaken for one in the model.
    fn is_beside(&self, effect: &dyn Effect) -> bool {
        let mut present = self
            .taken
            .iter()
            .filter_map(|(name, _)| effect::named(name));
        let name = effect.about().name;
        present.any(|own| own.about().name == name || effect::are_neighbours(own, effect))
    }
}

#[cfg(test)]
mod tests {
    use super::{Ask, Normal, Variant};
    use crate::gap::absorb::Absorb;
    use crate::gap::effect::write;
    use crate::gap::fit::information;
    use crate::gap::masses::{chosen, machine, searching};
    use crate::gap::model::Chosen;
    use crate::gap::screen::Screen;
    use crate::gap::search::Search;

    /// What a screen says where a mass has a drag that its model lacks.
    fn dragged(drag: f64, then: impl FnOnce(&Chosen, &Search<'_>, Screen)) {
        let base = machine(r#"damping=".2""#, "");
        let law = chosen(&base, "quadratic_drag", "a", &[drag]);
        let hidden = write(&base, law.effect, &law.place, &law.values).expect("written");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &hidden.file, config, |search, watch| {
            let screen = search.screen(watch).expect("screened").expect("whole");
            then(&law, search, screen);
        });
    }

    /// Of the drag that is tried first, a mass would come to rest.
    #[test]
    fn drag_is_expected_as_it_is_whatever_is_tried_first() {
        const DRAG: f64 = 0.025;
        dragged(DRAG, |law, _, screen| {
            let drag = (screen.candidates.iter())
                .find(|c| c.effect.about().name == "quadratic_drag" && c.place == law.place)
                .expect("a candidate");
            assert!(
                (drag.values[0] / DRAG - 1.0).abs() < 0.1,
                "{:?}",
                drag.values
            );
        });
    }

    /// Drag tried first in a size that brings a mass to rest, behind sixteen candidates that explain what there is.
    #[test]
    fn a_size_that_says_nothing_is_tried_again_however_little_it_explains() {
        const DRAG: f64 = 0.01;
        const FIRST: f64 = 20.0;
        dragged(DRAG, |law, search, Screen { linear, .. }| {
            let (look, parameters) = (search.look(), &search.windows.problem.parameters);
            let prior: Vec<_> = parameters.prior_slopes(&search.x).collect();
            let absorb = Absorb::new(&information(&linear.rows, 1), parameters, &search.x);
            let (at, all) = ((&linear, &absorb), [(law.effect, law.place.clone())]);
            let mut taken = vec![DRAG; 16];
            taken.push(FIRST);
            let ask = |&size: &f64| Ask {
                effect: law.effect,
                place: law.place.clone(),
                values: vec![size],
                size,
            };
            let asked: Vec<Ask> = taken.iter().map(ask).collect();
            let columns = look.ask(&asked, at, &linear.all(), &mut |_| true);
            let columns = columns.expect("simulated").expect("whole");
            let mut columns: Vec<_> = columns.into_iter().flatten().collect();
            let found: Vec<_> = (taken.iter().enumerate())
                .map(|(k, &size)| {
                    let variant = Variant {
                        columns: vec![(size, vec![size])],
                        parameters: vec![0],
                    };
                    (0, variant, vec![k])
                })
                .collect();
            let mut expected = Vec::new();
            for _ in 0..4 {
                let normal = Normal::new(&linear.rows, &columns, look.stretch_of, &prior);
                expected.push(normal.gain(&[16]).expect("seen").1[0]);
                let again = look.look_again(&all, &found, at, &normal, (&mut columns, &mut taken));
                again.expect("simulated");
            }
            assert!((expected[0] / DRAG - 1.0).abs() > 0.5, "{expected:?}");
            assert!((expected[3] / DRAG - 1.0).abs() < 0.1, "{expected:?}");
        });
    }
}
