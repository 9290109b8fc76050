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
//! rest, and then expects the wrong sign: the next size is one that would do all that is left. Beside effects that are in the model
//! there are those that they may be mistaken for ([`super::lookalike`]): of these little is expected, and a small size gives the
//! derivative.

use nalgebra::DVector;

use super::GapError;
use super::effect::{self, Effect, Place, Sign};
use super::linear::Column;
use super::model::Variant;
use super::score::Normal;
use super::screen::{At, Look};
use super::together::Ask;

/// Candidates that explain most.
const MOST: usize = 16;
/// Part of a size that would do all that is left, below which there is nothing to look at; and of the size tried first, beside
/// effects in the model.
const LEAST: f64 = 0.02;

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
            if rank >= MOST && !beside {
                continue;
            }
            let scales = self.measured.scales(&self.built.file.model, place);
            let parameters = effect.about().parameters;
            for (((c, (size, values)), &p), beta) in own
                .iter()
                .zip(&variant.columns)
                .zip(&variant.parameters)
                .zip(&expected)
            {
                let parameter = &parameters[p];
                let most = parameter.high * parameter.scale(&scales);
                let beta = beta.clamp(-most, most);
                let length: f64 = columns[*c].parts.iter().map(DVector::norm_squared).sum();
                let whole = (2.0 * normal.cost() / length).sqrt().min(size.abs());
                let wrong = parameter.sign == Sign::Positive && beta <= 0.0;
                let least = LEAST * if beside { size.abs() } else { whole };
                let little = beta.abs() < least;
                if parameter.is_whole() || (little && !wrong && !beside) {
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
    use crate::gap::effect::write;
    use crate::gap::masses::{chosen, machine, searching};

    /// Of the drag that is tried first, a mass would come to rest.
    #[test]
    fn drag_is_expected_as_it_is_whatever_is_tried_first() {
        const DRAG: f64 = 0.025;
        let base = machine(r#"damping=".2""#, "");
        let law = chosen(&base, "quadratic_drag", "a", &[DRAG]);
        let hidden = write(&base, law.effect, &law.place, &law.values).expect("written");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &hidden.file, config, |search, watch| {
            let screen = search.screen(watch).expect("screened").expect("whole");
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
}
