//! Turns and mirror images, *turns* for short, that leave a task unchanged and make one sample worth several.
//!
//! Three equal robots around a round object are the same machine after a turn by 120°, and in a mirror. Where observations turn by an
//! orthogonal O and actions by a signed permutation A,
//!
//! ```text
//! W̃ → A W̃ Õᵀ,   log σ → |A| log σ,   E[ψψᵀ] → Õ E[ψψᵀ] Õᵀ,      W̃ = (W, b),  Õ = diag(O, 1)
//! ```
//!
//! is what the turn does to an affine policy, to a gradient with respect to it, and to the moments of its samples. Where
//! policy, model and starts are the same after every turn, so is the expected gradient. The mean of one estimate over all
//! turns is then as much without bias as the estimate, and up to as many times less noisy; and the policy stays the same
//! after every turn. Zinkevich and Balch 2001, *Symmetry in Markov decision processes and its implications for single
//! agent and multiagent learning*.
//!
//! | symbol | name |
//! | --- | --- |
//! | A, O | `action`, `observation` |
//! | ψ | features of the score, a constant last |

use nalgebra::{DMatrix, DVector};

use crate::policy::AffineGaussian;

/// Parameters differ after a turn by more than rounding, relative to the largest.
const ASYMMETRIC: f64 = 1e-9;

/// One turn.
#[derive(Debug, Clone, PartialEq)]
pub struct Symmetry {
    /// A, a signed permutation (`n_action × n_action`)
    pub action: DMatrix<f64>,
    /// O, orthogonal (`n_observation × n_observation`)
    pub observation: DMatrix<f64>,
    /// the same for what the value function sees (`n_value_input × n_value_input`)
    pub value_input: DMatrix<f64>,
}

impl Symmetry {
    /// This one, and `next` after it.
    #[must_use]
    pub fn then(&self, next: &Self) -> Self {
        Self {
            action: &next.action * &self.action,
            observation: &next.observation * &self.observation,
            value_input: &next.value_input * &self.value_input,
        }
    }

    /// What the turn makes of parameters or a gradient, in the order of [`AffineGaussian::parameters`].
    pub fn turn(&self, parameters: &[f64]) -> Vec<f64> {
        let features = with_constant(&self.observation);
        let (n_action, width) = (self.action.nrows(), features.nrows());
        let (weights, log_sigma) = parameters.split_at(n_action * width);
        let weights = DMatrix::from_column_slice(width, n_action, weights); // W̃ᵀ
        let log_sigma = DMatrix::from_column_slice(n_action, 1, log_sigma);
        let weights = features * weights * self.action.transpose();
        let log_sigma = self.action.abs() * log_sigma;
        [weights.as_slice(), log_sigma.as_slice()].concat()
    }

    /// [`Self::turn`] as a matrix.
    pub fn of_parameters(&self) -> DMatrix<f64> {
        let n = self.action.nrows() * (self.observation.nrows() + 2);
        let mut all = DMatrix::zeros(n, n);
        for (i, mut column) in all.column_iter_mut().enumerate() {
            let mut unit = vec![0.0; n];
            unit[i] = 1.0;
            column.copy_from_slice(&self.turn(&unit));
        }
        all
    }
}

/// M x.
pub fn apply(turn: &DMatrix<f64>, x: &[f64]) -> DVector<f64> {
    turn * DVector::from_column_slice(x)
}

/// diag(O, 1).
pub fn with_constant(turn: &DMatrix<f64>) -> DMatrix<f64> {
    let n = turn.nrows();
    let mut all = turn.clone().resize(n + 1, n + 1, 0.0);
    all[(n, n)] = 1.0;
    all
}

/// The mean of parameters or of a gradient over all turns and none.
pub fn mean_of_parameters(turns: &[Symmetry], parameters: &[f64]) -> Vec<f64> {
    let mut mean = parameters.to_vec();
    for turn in turns {
        for (sum, turned) in mean.iter_mut().zip(turn.turn(parameters)) {
            *sum += turned;
        }
    }
    let scale = 1.0 / (1 + turns.len()) as f64;
    for value in &mut mean {
        *value *= scale;
    }
    mean
}

/// The mean of `E[ψψᵀ]` over turns of ψ and none.
pub fn mean_of_moments(
    turns: impl Iterator<Item = DMatrix<f64>>,
    moments: &DMatrix<f64>,
) -> DMatrix<f64> {
    let (mut sum, mut count) = (moments.clone(), 1.0);
    for turn in turns {
        sum += &turn * moments * turn.transpose();
        count += 1.0;
    }
    sum / count
}

/// Whether a policy is the same after every turn.
pub fn has_all(turns: &[Symmetry], policy: &AffineGaussian) -> bool {
    let parameters = policy.parameters();
    let mean = mean_of_parameters(turns, &parameters);
    let largest = parameters.iter().fold(0.0_f64, |max, p| max.max(p.abs()));
    let same = |(p, m): (&f64, &f64)| (p - m).abs() <= ASYMMETRIC * largest;
    parameters.iter().zip(&mean).all(same)
}
