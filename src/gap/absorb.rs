//! What a missing effect looks like once the fitted parameters have made up for as much of it as they can.
//!
//! A column is the difference of two simulations. Taken with the parameters where they are, it says what the effect
//! does to a model that has just been fitted without it: a constant torque, say, moves a joint that sticks only because
//! a wrong mass held it up in the torque's place. A few such windows outweigh all others, and the effect seems small.
//! The difference is therefore taken again where the parameters would be with the effect,
//!
//! ```text
//! dx = −(J̃ᵀJ̃ + P)⁻¹ J̃ᵀ φ β        φ′ = (r(x + dx, β) − r(x) − J̃ dx)/β
//! ```
//!
//! with φ the first column, β its size and P the parameters' priors. Where everything is linear φ′ = φ.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

use super::linear::{Column, Linear};
use crate::sysid::parameter::{Parameters, Role};

/// Part of a column's squared length that parameters must absorb for it to be taken again.
const MUCH: f64 = 0.5;
/// Most that a parameter on a log scale is moved.
const LOG_STEP: f64 = 0.5;

/// The fitted parameters, as what may absorb a column.
pub(super) struct Absorb {
    factor: Option<Cholesky<f64, Dyn>>,
    /// dx of each must stay within
    room: Vec<(f64, f64)>,
}

impl Absorb {
    /// `normal` is `J̃ᵀJ̃ + P` of `parameters` at `x`.
    pub(super) fn new(normal: &DMatrix<f64>, parameters: &Parameters, x: &[f64]) -> Self {
        let room = parameters.iter_free().zip(x).map(|(p, x)| match p.role {
            // readings are linear in these
            Role::Instrument(..) => (0.0, 0.0),
            Role::Model(_) => p.reach(*x, LOG_STEP),
        });
        Self {
            factor: (!x.is_empty()).then(|| normal.clone().cholesky()).flatten(),
            room: room.collect(),
        }
    }

    /// dx of the parameters with `size` of a column; none where they absorb little of it.
    pub(super) fn moved(&self, linear: &Linear, column: &Column, size: f64) -> Option<Vec<f64>> {
        let factor = self.factor.as_ref()?;
        let mut along = DVector::zeros(self.room.len());
        let mut square = 0.0;
        for (row, part) in linear.rows.iter().zip(&column.parts) {
            along.gemv_tr(1.0, &row.parameters, part, 1.0);
            square += part.norm_squared();
        }
        let instead = factor.solve(&along);
        if along.dot(&instead) < MUCH * square {
            return None;
        }
        let clamp = |(d, (low, high)): (&f64, &(f64, f64))| (-d * size).max(*low).min(*high);
        Some(instead.iter().zip(&self.room).map(clamp).collect())
    }
}

impl Column {
    /// Without what `dx` of the parameters does by itself.
    pub(super) fn without(mut self, linear: &Linear, dx: &[f64], size: f64) -> Self {
        let dx = DVector::from_column_slice(dx) / size;
        for (row, part) in linear.rows.iter().zip(&mut self.parts) {
            // windows that were not simulated
            if part.norm_squared() > 0.0 {
                *part -= &row.parameters * &dx;
            }
        }
        self
    }
}
