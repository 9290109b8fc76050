//! What to call what was found, and how surely its numbers are known.
//!
//! A number's variance is that of the linearised problem, with all other numbers free, and on top of it that of fits that
//! are made again, by other simulations and under pulls that other steps led: simulations in contact are chaotic in small,
//! and so are estimates by them, and a friction under which a joint sticks throughout is told from below alone.

use super::judge::{Judge, Point};
use super::refit::Fitted;
use crate::gap::GapError;
use crate::gap::alike::Rival;
use crate::gap::effect::{Role, Sign};
use crate::gap::evidence::Evidence;
use crate::gap::name::called;
use crate::gap::result::{Named, Value};

/// Standard deviations of half a 95 % interval.
pub(super) const HALF: f64 = 1.96;
/// Fits that are made again.
const AGAIN: usize = 4;

/// Effects with names, and the model with their last numbers.
pub(super) struct Names {
    pub effects: Vec<Named>,
    pub fitted: Fitted,
}

/// Names of all effects of a model that has all its slopes; `tries` are numbers of other fits.
///
/// # Errors
/// The engine fails.
pub(super) fn name(
    judge: &Judge<'_>,
    present: &Fitted,
    tries: &[Vec<f64>],
    kept: &[Evidence],
) -> Result<Names, GapError> {
    let n = present.point.x.len();
    let mut all: Vec<Vec<f64>> = Vec::new();
    for draw in 0..AGAIN {
        let known = (&present.ensemble.slopes, draw);
        let seen = judge.at(present.point.clone(), known)?;
        all.push(judge.step(&seen));
    }
    let mean = |j: usize| all.iter().map(|x| x[j]).sum::<f64>() / AGAIN as f64;
    let x: Vec<f64> = (0..n).map(mean).collect();
    all.extend_from_slice(tries);
    let scatter =
        |j: usize| all.iter().map(|own| (own[j] - x[j]).powi(2)).sum::<f64>() / all.len() as f64;
    let scatter: Vec<f64> = (0..n).map(scatter).collect();
    let point = Point {
        written: present.point.written.clone(),
        x,
    };
    let fitted = judge.at(point, (&present.ensemble.slopes, 0))?;
    let covariance = fitted.covariance(judge);
    let free = fitted.machine.built.free(&fitted.machine.problem);
    let mut effects = Vec::new();
    for (i, own) in fitted.chosen().iter().enumerate() {
        let scales = judge.measured.scales(&judge.base.model, &own.place);
        let parameters = own.effect.about().parameters.iter().enumerate();
        let values = parameters
            .filter(|(_, p)| p.role != Role::Companion)
            .map(|(p, parameter)| {
                let number = free.iter().find(|f| f.1 == i && f.2 == p);
                let ci95 = number.map(|(j, _, _, slope)| {
                    let sigma = (covariance[(*j, *j)] + scatter[*j]).sqrt() * slope.abs();
                    let low = own.values[p] - HALF * sigma;
                    let low = match parameter.sign {
                        Sign::Positive => low.max(0.0),
                        Sign::Either => low,
                    };
                    [low, own.values[p] + HALF * sigma]
                });
                Value {
                    name: parameter.name.to_owned(),
                    value: own.values[p],
                    ci95,
                    unit: parameter.unit(&scales).to_owned(),
                }
            });
        let others = kept[i].alike.iter().map(Rival::said).collect();
        let said = (own, fitted.machine.built.forms[i]);
        effects.push(called(said, values.collect(), &kept[i], others));
    }
    Ok(Names { effects, fitted })
}
