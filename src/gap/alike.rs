//! Effects that fit as well in the place of one that was found.
//!
//! When an effect is chosen its rivals were fitted too. A model with rival j instead of effect k costs C(j), 2 more for each
//! number, with channels weighed by what k leaves of them:
//!
//! ```text
//! d² = 2 (C(j) − C(k))        alike: d² < 9
//! ```
//!
//! While they are fitted channels are weighed by what the model before them leaves, which is more: there costs are less, for
//! all by the factor by which that of k is.
//!
//! Effects found later may tell them apart: what was alike before is fitted once more beside them.

use serde::{Deserialize, Serialize};

use super::effect::{Place, named};
use super::model::Chosen;
use super::name::APART;
use super::result::Where;
use super::screen::Candidate;
use super::search::{Fitted, ITERATIONS, Search};
use super::{GapError, Stage, Watch};

/// Fall of the cost that a number more has to bring, to be the better of two.
const NUMBER: f64 = 2.0;

/// Another effect, fitted in the place of one.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Rival {
    name: String,
    place: Place,
    values: Vec<f64>,
    /// d²
    separation: f64,
}

impl Rival {
    /// As a result has it.
    pub(super) fn said(&self) -> Where {
        Where {
            name: self.name.clone(),
            at: self.place.to_string(),
            separation: self.separation,
        }
    }

    /// Whether it is this effect there.
    fn is(&self, chosen: &Chosen) -> bool {
        self.name == chosen.effect.about().name && self.place == chosen.place
    }
}

/// What a fit with a cost in units of what it leaves is rated at, its numbers `x` included.
pub(super) fn price(cost: f64, x: &[f64]) -> f64 {
    cost + NUMBER * (x.len() as f64)
}

fn apart(price: f64, chosen: f64) -> f64 {
    (2.0 * (price - chosen)).max(0.0)
}

/// Rivals of the fit `chosen` of all, the added effect of each being the last; costs are to be multiplied by `scale`.
pub(super) fn rivals(fitted: &[(Fitted, &Candidate)], chosen: usize, scale: f64) -> Vec<Rival> {
    let price = |fit: &Fitted| price(scale * fit.cost, &fit.x);
    let own = price(&fitted[chosen].0);
    let others = fitted.iter().enumerate().filter(|(i, _)| *i != chosen);
    others
        .filter_map(|(_, (fit, c))| {
            let rival = Rival {
                name: c.effect.about().name.to_owned(),
                place: c.place.clone(),
                values: fit.chosen.last()?.values.clone(),
                separation: apart(price(fit), own),
            };
            (rival.separation < APART).then_some(rival)
        })
        .collect()
}

impl Search<'_> {
    /// Fits what was alike once more, beside all that was found since.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn tell_apart(&mut self, watch: &mut Watch<'_>) -> Result<(), GapError> {
        if self.chosen.len() < 2 {
            return Ok(());
        }
        watch.stage(Stage::Refit);
        let own = price(self.cost, &self.x);
        for i in 0..self.evidence.len() {
            let mut left = Vec::new();
            for rival in std::mem::take(&mut self.evidence[i].alike) {
                let Some(effect) = named(&rival.name) else {
                    continue;
                };
                if self.chosen.iter().any(|c| rival.is(c)) {
                    continue; // it stands beside it
                }
                let mut chosen = self.chosen.clone();
                chosen[i] = Chosen {
                    effect,
                    place: rival.place.clone(),
                    values: rival.values.clone(),
                };
                let Some(fitted) = self.fitted(&chosen, ITERATIONS, watch)? else {
                    continue;
                };
                let separation = apart(price(fitted.cost, &fitted.x), own);
                if separation < APART {
                    left.push(Rival {
                        separation,
                        ..rival
                    });
                }
            }
            self.evidence[i].alike = left;
        }
        Ok(())
    }
}
