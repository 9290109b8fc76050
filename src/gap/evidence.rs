//! What speaks for effects that were fitted, all asked at the same point.
//!
//! - significance, from the model with the effect, where what is left is no longer the effect itself; what the model's
//!   own step makes of its number ([`super::step`]) is taken off first;
//! - size: its response, as a part of that of the motors.

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

use super::GapError;
use super::alike::Rival;
use super::candidate::{Candidate, largest_part};
use super::linear::{Column, Linear};
use super::score::Normal;
use super::search::{Search, doubt};
use crate::sysid::problem::Problem;

/// Why an effect was chosen.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Evidence {
    /// probability by chance, times the number of candidates
    pub p_value: f64,
    /// fall of the cost, as a part of it
    pub gain: f64,
    /// response, as a part of the motors'
    pub size: Option<f64>,
    /// others that fitted as well in its place
    pub alike: Vec<Rival>,
}

/// A fitted model where it stands.
pub(super) struct Standing<'s> {
    search: &'s Search<'s>,
    linear: Linear,
    normal: Normal,
    /// what the model's own step makes of every free parameter
    step: Option<DVector<f64>>,
    motors: Option<Column>,
}

impl<'s> Standing<'s> {
    /// Of the present model of `search`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn of(search: &'s Search<'s>) -> Result<Self, GapError> {
        let (windows, x) = (&search.windows, &search.x);
        let linear = windows.linearise(x)?;
        let normal = search.normal(&linear);
        let without = windows.without_steps(x, &linear)?;
        let step = without.map(|own| own.error(&normal));
        Ok(Self {
            search,
            motors: linear.motors(windows, x)?,
            linear,
            normal,
            step,
        })
    }

    /// What speaks for effect `own` of the model, which was `c` of so many `tests` and took the part `gain` off the cost.
    pub(super) fn evidence(&self, own: usize, c: &Candidate, tests: usize, gain: f64) -> Evidence {
        let sizes = (self.search).sureness(&self.normal, own, self.step.as_ref());
        let p = match (&sizes[..], &c.score) {
            ([], Some(score)) => score.p_value,
            // as many chances as sizes, and shapes tried
            _ => doubt(&sizes) * (sizes.len() * c.effect.about().shapes()) as f64,
        };
        Evidence {
            p_value: (p * tests as f64).min(1.0),
            gain,
            size: self.size(own),
            alike: Vec::new(),
        }
    }

    /// Response of effect `own`, as a part of the motors'.
    fn size(&self, own: usize) -> Option<f64> {
        let (search, linear) = (self.search, &self.linear);
        let response = search.response(own, (&search.windows.problem, linear));
        let motors = self.motors.as_ref()?;
        let (own, whole) = (linear.by_channel(&response), &motors.parts);
        largest_part(&own, &linear.by_channel(whole))
    }
}

impl Search<'_> {
    /// What the sizes of effect `own` do to the rows of every window of a `problem` with the effects, as linearised.
    pub(super) fn response(
        &self,
        own: usize,
        (problem, linear): (&Problem, &Linear),
    ) -> Vec<DVector<f64>> {
        let mut response: Vec<DVector<f64>> = (linear.rows.iter())
            .map(|row| DVector::zeros(row.residual.len()))
            .collect();
        let chosen = &self.chosen[own];
        let parameters = chosen.effect.about().parameters;
        for (j, i, p, slope) in self.built.free(problem) {
            if i == own && parameters[p].is_size() {
                let change = chosen.values[p] / slope;
                for (sum, row) in response.iter_mut().zip(&linear.rows) {
                    sum.axpy(change, &row.parameters.column(j), 1.0);
                }
            }
        }
        response
    }
}
