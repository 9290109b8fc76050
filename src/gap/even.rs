//! Numbers of effects, with windows weighed by what is left of each.
//!
//! What a model leaves is not the same everywhere: of dry friction that bends before it slides, say, much where a joint turns back and
//! little where it goes on. A few windows then have most of the cost, and decide where numbers end. Once it is known what is
//! missing, numbers are therefore fitted once more, with every window weighed by its own spread,
//!
//! ```text
//! σ_w = σ √max(1, q_w / median q)        q_w = mean (r̃ + J̃ dx)²        dx = −(Σ J̃ᵀJ̃/σ_w² + P)⁻¹ (Σ J̃ᵀr̃/σ_w² + P (x − x̄))
//! ```
//!
//! with r̃ and J̃ of [`super::linear`] at the fit, σ = 1, until dx stays as it is: it is a small part of what parameters are known
//! to. No window weighs more than the median one, as where nothing moves nothing is left, whatever numbers are.
//!
//! Where much is left everywhere, all numbers stand for something else besides, and those of most windows predict the rest worse. So
//! these are taken where held-out recordings cost no more with them. Intervals span those of both fits all the same.
//!
//! Reference: Greene 2012, "Econometric Analysis", section 9.7 (feasible generalised least squares, groups of unlike variance).

use nalgebra::DVector;

use super::GapError;
use super::fit::{gradient, information, solved};
use super::linear::{Linear, Row};
use super::model::Chosen;
use super::score::Normal;
use super::search::Search;

/// Times that windows are weighed, at most.
const ROUNDS: usize = 50;
/// Squared length of a step, in standard deviations, after which there is no other.
const NEAR: f64 = 1e-4;

/// Numbers of a fit with windows weighed by what is left of each.
pub(super) struct Evened {
    /// with the values fitted
    pub chosen: Vec<Chosen>,
    /// sums of products of parameters
    pub normal: Normal,
    /// whether held-out recordings cost no more with these numbers
    pub predicts: bool,
    x: Vec<f64>,
}

impl Search<'_> {
    /// The numbers of the present model, `linear` being at them, with windows weighed by what is left of each.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn evened(&self, linear: &Linear) -> Result<Evened, GapError> {
        let problem = &self.windows.problem;
        let parameters = &problem.parameters;
        let mut x = self.x.clone();
        let mut dx = DVector::zeros(x.len());
        let mut rows = evened(&linear.rows, &dx);
        for _ in 0..ROUNDS {
            let normal = information(&rows, x.len());
            let left = rows.iter().map(|row| &row.residual);
            let right = -gradient(&rows, left, x.len());
            let (step, to) = solved(parameters, &x, &normal, right, &[]);
            let far = step.dot(&(normal * &step));
            x = to;
            dx += step;
            rows = evened(&linear.rows, &dx);
            if far < NEAR {
                break;
            }
        }
        Ok(Evened {
            chosen: self.built.values(problem, &x, &self.chosen),
            normal: self.normal_of(&rows, &x),
            predicts: self.is_less_held_out((&self.built, &self.windows, &x), 0.0)?,
            x,
        })
    }

    /// Takes numbers of the same model if they predict.
    pub(super) fn take_numbers(&mut self, of: Evened) {
        if of.predicts {
            (self.chosen, self.x) = (of.chosen, of.x);
        }
    }
}

/// Rows after a step of the parameters, weighed by what is then left of each window.
fn evened(rows: &[Row], dx: &DVector<f64>) -> Vec<Row> {
    let left: Vec<DVector<f64>> = (rows.iter())
        .map(|row| &row.residual + &row.parameters * dx)
        .collect();
    let square = |left: &DVector<f64>| left.norm_squared() / left.len().max(1) as f64;
    let mut sorted: Vec<f64> = left.iter().map(square).collect();
    sorted.sort_by(f64::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    let each = rows.iter().zip(left).map(|(row, left)| {
        let much = square(&left) / median.max(f64::MIN_POSITIVE);
        let weight = much.max(1.0).sqrt().recip();
        let mut own = row.clone();
        own.parameters *= weight;
        own.residual = left * weight;
        own
    });
    each.collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use crate::gap::masses::{chosen, found, machine, searching};

    /// Damping of "a", and two windows whose readings are off by what no damping does.
    #[test]
    fn numbers_are_not_those_of_a_few_windows() {
        const DAMPING: f64 = 0.4;
        const OFF_M: f64 = 1e-3;
        let base = machine("", r#"damping=".2""#);
        let hidden = machine(&format!(r#"damping="{DAMPING}""#), r#"damping=".2""#);
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &hidden, config, |search, watch| {
            let sound = search.windows.clone();
            for w in [3, 4] {
                for sample in Arc::make_mut(&mut search.windows.problem.trials[w].samples) {
                    sample.value += OFF_M * (30.0 * sample.time).sin();
                }
            }
            let spoilt = search.windows.clone();
            let damping = chosen(&base, "viscous_friction", "a", &[DAMPING]);
            found(search, &[damping], watch);
            search.settle(watch).expect("settled");
            let linear = search.windows.linearise(&search.x).expect("linear");
            let evened = search.evened(&linear).expect("held out");
            let off = |values: &[f64]| (values[0] / DAMPING - 1.0).abs();
            let [alike, even] = [&search.chosen, &evened.chosen].map(|own| off(&own[0].values));
            assert!(even < 0.2 * alike, "{even} {alike}");
            // and are taken unless others predict more of what was held out
            for (held_out, predicts) in [(sound, true), (spoilt, false)] {
                search.held_out = Some(held_out);
                let evened = search.evened(&linear).expect("held out");
                assert_eq!(evened.predicts, predicts);
            }
        });
    }
}
