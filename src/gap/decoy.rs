//! Decoys: what columns that are none of an effect's, but of its size, take off the held-out recordings.
//!
//! What an effect does to the readings of one window is put into another one, k windows on. There it has nothing to say of
//! what is measured, but all that an effect with so many numbers could fit by luck:
//!
//! ```text
//! g(k) = (Σ r°ᵀ c)² / (2 Σ cᵀc)        c = (1 − QᵥQᵥᵀ) c of window v + k,  r° = r̃ − c of window v
//! ```
//!
//! k = 0 is the effect itself. r° is what is left without it, and all sums are over the windows v with the same samples; one number,
//! a size, is fitted for each k. By chance a decoy is better with n in n + 1. Motion that comes again makes decoys of the effect
//! itself: the best of a spring's in two sines takes four fifths of what it takes. Where there are no held-out recordings the
//! fitted ones are asked.
//!
//! | symbol | name |
//! | --- | --- |
//! | g(0) | [`Decoys::own`] |
//! | max g(k), k > 0 | [`Decoys::best`] |
//! | r̃, Q | [`super::linear::Row`] |

use nalgebra::DVector;
use serde::Serialize;

use super::GapError;
use super::linear::Row;
use super::search::{Search, sound};
use super::windows::Windows;

/// What an effect and its decoys take off the cost, fitted one by one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Decoys {
    /// number of decoys
    pub n: usize,
    /// fall of the cost by the effect
    pub own: f64,
    /// the same of the best decoy
    pub best: f64,
}

impl Search<'_> {
    /// What every effect of the model and its decoys take; none where windows are too few or not followed.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn decoys(&self) -> Result<Vec<Option<Decoys>>, GapError> {
        let nothing = vec![None; self.chosen.len()];
        if self.chosen.is_empty() {
            return Ok(nothing);
        }
        let windows = match self.held_at(self.at_hand(), 0.0)? {
            // its numbers were held
            Some((held, _)) => Windows {
                problem: self.built.problem(&held.problem)?,
                ..held
            },
            None => self.windows.clone(),
        };
        let Some(linear) = sound(windows.linearise(&self.x))? else {
            return Ok(nothing);
        };
        let each = (0..self.chosen.len()).map(|i| {
            let response = self.response(i, (&windows.problem, &linear));
            decoys(&linear.rows, &response)
        });
        Ok(each.collect())
    }
}

/// Of one effect that does `response` to the `rows` of each window.
fn decoys(rows: &[Row], response: &[DVector<f64>]) -> Option<Decoys> {
    let like = |row: &Row| -> Vec<usize> {
        let own = |v: &usize| rows[*v].channel == row.channel;
        (0..rows.len()).filter(own).collect()
    };
    let alike = rows.iter().map(like).max_by_key(Vec::len)?;
    let without: Vec<DVector<f64>> = (alike.iter())
        .map(|&w| &rows[w].residual - &response[w])
        .collect();
    let part = |k: usize| {
        let (mut dot, mut square) = (0.0, 0.0);
        for (v, (&w, rest)) in alike.iter().zip(&without).enumerate() {
            let other = &response[alike[(v + k) % alike.len()]];
            let basis = &rows[w].basis;
            let column = other - basis * basis.tr_mul(other);
            dot += rest.dot(&column);
            square += column.norm_squared();
        }
        (square > 0.0).then(|| 0.5 * dot * dot / square)
    };
    let n = alike.len() - 1;
    let best = (1..=n).filter_map(part).reduce(f64::max)?;
    Some(Decoys {
        n,
        own: part(0)?,
        best,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::masses::{chosen, found, machine, searching};

    /// What an effect takes beside its decoys, where a spring is hidden.
    fn taken(name: &str, values: &[f64]) -> Decoys {
        let base = machine("", "");
        let hidden = machine(r#"stiffness="1""#, "");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        let mut told = None;
        searching(&base, &hidden, config, |search, watch| {
            search.held_out = Some(search.windows.clone());
            found(search, &[chosen(&base, name, "a", values)], watch);
            told = search.decoys().expect("simulated")[0];
        });
        told.expect("windows alike")
    }

    #[test]
    fn an_effect_that_is_there_takes_more_than_its_decoys() {
        let spring = taken("joint_spring", &[0.5, 0.0]);
        assert!(
            spring.own > 400.0 && spring.best < 0.9 * spring.own,
            "{spring:?}"
        );
        assert_eq!(spring.n, 18);
    }

    #[test]
    fn one_that_is_not_there_does_not() {
        let ripple = taken("cogging", &[0.1, 0.1, 40.0]);
        assert!(ripple.own < 2.0 * ripple.best, "{ripple:?}");
    }
}
