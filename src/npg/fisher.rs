//! The metric of the natural gradient and its inverse.
//!
//! For an affine Gaussian policy with state-independent σ the Fisher matrix is known but for the second moment of
//! the score's features, `C = E[ψψᵀ]`, where ψ = φ = (s, 1) for white noise (see [`crate::exploration`]):
//!
//! ```text
//! F = diag(1/σ²) ⊗ C  ⊕  2 I          (weights row by row; log σ)
//! ```
//!
//! so that F⁻¹g needs one Cholesky factor of the size of ψ, shared by all actions ([`FisherMode::Exact`]). The paper
//! averages outer products of the score instead; [`FisherMode::Empirical`] does that and factors the full matrix.
//!
//! Both work in standardised coordinates ψ̃ = T ψ = ((s - mean) / scale, 1), where C becomes a correlation matrix and a
//! damping relative to 1 has a meaning. Constant observations get scale 0, that is no step at all; observations tied
//! to each other by the linkages (15 joints, 9 degrees of freedom) leave eigenvalues near 0, which the damping holds.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use serde::{Deserialize, Serialize};

/// Which estimate of the Fisher matrix is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FisherMode {
    /// closed form, from the second moment of the observations
    Exact,
    /// average outer product of the score, as in the paper
    Empirical,
}

/// A factored metric; maps gradients to natural gradients.
pub struct Fisher {
    mean: Vec<f64>,            // (n) of the observations
    inverse_scale: Vec<f64>,   // (n + 1)
    correlation: DMatrix<f64>, // (n + 1 × n + 1) standardised second moment, undamped
    sigma: Vec<f64>,           // (n_action)
    damping: f64,
    factor: Factor,
}

enum Factor {
    Exact(Cholesky<f64, Dyn>),
    Empirical(Cholesky<f64, Dyn>),
}

impl Fisher {
    /// Factor the exact metric.
    ///
    /// `second_moment` is `E[ψψᵀ]`, bias last. Returns `None` when it is not finite.
    pub fn exact(second_moment: &DMatrix<f64>, log_sigma: &[f64], damping: f64) -> Option<Self> {
        let (mean, inverse_scale, correlation) = standardise(second_moment);
        let n = correlation.nrows();
        let mut system = correlation.clone();
        for i in 0..n {
            system[(i, i)] += damping;
        }
        let factor = Factor::Exact(Cholesky::new(system)?);
        let sigma = log_sigma.iter().map(|l| l.exp()).collect();
        Some(Self {
            mean,
            inverse_scale,
            correlation,
            sigma,
            damping,
            factor,
        })
    }

    /// Factor the empirical metric.
    ///
    /// `outer` is the mean of u uᵀ, where u is the score in units of σ: `z_i ψ_j` row by row, then `z_i² - 1`.
    /// Returns `None` when it is not finite.
    pub fn empirical(
        outer: &DMatrix<f64>,
        second_moment: &DMatrix<f64>,
        log_sigma: &[f64],
        damping: f64,
    ) -> Option<Self> {
        let (mean, inverse_scale, correlation) = standardise(second_moment);
        let (width, n_action) = (correlation.nrows(), log_sigma.len());
        let n = outer.nrows();
        // T applied to the columns, then to the rows, of every block of weights
        let mut system = outer.clone();
        for _ in 0..2 {
            for mut column in system.column_iter_mut() {
                for action in 0..n_action {
                    to_standard(
                        &mean,
                        &inverse_scale,
                        &mut column.as_mut_slice()[action * width..][..width],
                    );
                }
            }
            system.transpose_mut();
        }
        // the diagonal of F̃ is 1 for weights and 2 for log σ
        for i in 0..n {
            system[(i, i)] += if i < n_action * width {
                damping
            } else {
                2.0 * damping
            };
        }
        let factor = Factor::Empirical(Cholesky::new(system)?);
        let sigma = log_sigma.iter().map(|l| l.exp()).collect();
        Some(Self {
            mean,
            inverse_scale,
            correlation,
            sigma,
            damping,
            factor,
        })
    }

    /// F⁻¹ g.
    pub fn solve(&self, gradient: &[f64]) -> Vec<f64> {
        let width = self.correlation.nrows();
        let n_weight = width * self.sigma.len();
        let mut x = gradient.to_vec();
        // weights in units of σ, standardised
        for (row, sigma) in x[..n_weight].chunks_exact_mut(width).zip(&self.sigma) {
            scale(row, *sigma);
            to_standard(&self.mean, &self.inverse_scale, row);
        }
        match &self.factor {
            Factor::Exact(factor) => {
                for row in x[..n_weight].chunks_exact_mut(width) {
                    let solved = factor.solve(&DVector::from_column_slice(row));
                    row.copy_from_slice(solved.as_slice());
                }
                x[n_weight..]
                    .iter_mut()
                    .for_each(|value| *value /= 2.0 * (1.0 + self.damping));
            }
            Factor::Empirical(factor) => {
                let solved = factor.solve(&DVector::from_column_slice(&x));
                x.copy_from_slice(solved.as_slice());
            }
        }
        for (row, sigma) in x[..n_weight].chunks_exact_mut(width).zip(&self.sigma) {
            from_standard(&self.mean, &self.inverse_scale, row);
            scale(row, *sigma);
        }
        x
    }

    /// Inner product of two steps in the exact metric, counting the weights of `columns` of the observation only.
    pub fn inner(&self, x: &[f64], y: &[f64], columns: std::ops::Range<usize>) -> f64 {
        let width = self.correlation.nrows();
        let scaled = |row: &[f64], j: usize| {
            if self.inverse_scale[j] > 0.0 {
                row[j] / self.inverse_scale[j]
            } else {
                0.0
            }
        };
        let rows = x
            .chunks_exact(width)
            .zip(y.chunks_exact(width))
            .zip(&self.sigma);
        rows.map(|((x, y), sigma)| {
            let mut sum = 0.0;
            for i in columns.clone() {
                for j in columns.clone() {
                    sum += scaled(x, i) * self.correlation[(i, j)] * scaled(y, j);
                }
            }
            sum / (sigma * sigma)
        })
        .sum()
    }
}

fn scale(row: &mut [f64], factor: f64) {
    for value in row {
        *value *= factor;
    }
}

/// h ↦ T h for `h = E[A z ψ]`: freed of its part along the last feature and scaled; the last feature scaled alone.
fn to_standard(mean: &[f64], inverse_scale: &[f64], row: &mut [f64]) {
    let last = row.len() - 1;
    for j in 0..last {
        row[j] = (row[j] - mean[j] * row[last]) * inverse_scale[j];
    }
    row[last] *= inverse_scale[last];
}

/// x ↦ Tᵀ x, from standardised weights to weights.
fn from_standard(mean: &[f64], inverse_scale: &[f64], row: &mut [f64]) {
    for (value, inverse) in row.iter_mut().zip(inverse_scale) {
        *value *= inverse;
    }
    let last = row.len() - 1;
    let along: f64 = row[..last]
        .iter()
        .zip(mean)
        .map(|(value, mean)| value * mean)
        .sum();
    row[last] -= along;
}

/// `mean` (n), the regression of each feature on the last one (which is 1 for white noise, where this is the mean of
/// the observation); `inverse_scale` (n + 1), of what is left; and T C Tᵀ.
fn standardise(second_moment: &DMatrix<f64>) -> (Vec<f64>, Vec<f64>, DMatrix<f64>) {
    let n = second_moment.nrows() - 1;
    let last = second_moment[(n, n)];
    let mean: Vec<f64> = (0..n).map(|j| second_moment[(n, j)] / last).collect();
    let mut inverse_scale: Vec<f64> = (0..n)
        .map(|j| {
            let variance = second_moment[(j, j)] - mean[j] * mean[j] * last;
            // below the rounding of the sums the observation is a constant
            if variance > 1e-12 * (1.0 + mean[j] * mean[j]) * last {
                variance.sqrt().recip()
            } else {
                0.0
            }
        })
        .collect();
    inverse_scale.push(last.sqrt().recip());
    let mut correlation = DMatrix::zeros(n + 1, n + 1);
    for i in 0..n {
        for j in 0..=i {
            let covariance = second_moment[(i, j)] - mean[i] * mean[j] * last;
            correlation[(i, j)] = covariance * inverse_scale[i] * inverse_scale[j];
            correlation[(j, i)] = correlation[(i, j)];
        }
    }
    correlation[(n, n)] = 1.0;
    (mean, inverse_scale, correlation)
}
