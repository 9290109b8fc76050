//! The kernel that moves simulations which were drawn more than once: it keeps mean and covariance of all.

use nalgebra::{DMatrix, DVector};

use crate::rng;

/// Least variance, as a part of the greatest, of a correlation that is factored.
const REGULAR: f64 = 1e-9;

/// z ← z̄ + √(1 − h²) (z − z̄) + h Σ^½ ξ
pub(super) struct Kernel {
    pub mean: DVector<f64>,
    /// Σ^½
    pub root: DMatrix<f64>,
}

impl Kernel {
    /// Of tangent vectors.
    pub(super) fn of(all: &[DVector<f64>]) -> Self {
        let (n, dim) = (all.len() as f64, all[0].len());
        let mut mean = DVector::zeros(dim);
        for z in all {
            mean += z;
        }
        mean /= n;
        let mut covariance = DMatrix::zeros(dim, dim);
        for z in all {
            let d = z - &mean;
            covariance.ger(1.0 / n, &d, &d, 1.0);
        }
        // directions of very different units
        let scale = covariance.diagonal().map(|v: f64| v.sqrt());
        let correlation = DMatrix::from_fn(dim, dim, |i, j| {
            let size = scale[i] * scale[j];
            let own = if size > 0.0 {
                covariance[(i, j)] / size
            } else {
                0.0
            };
            own + if i == j { REGULAR } else { 0.0 }
        });
        let mut root = (correlation.cholesky()).map_or_else(|| DMatrix::zeros(dim, dim), |c| c.l());
        for (mut row, s) in root.row_iter_mut().zip(scale.iter()) {
            row *= *s;
        }
        Self { mean, root }
    }

    /// Σ⁻¹; 0 along what does not vary.
    pub(super) fn precision(&self) -> DMatrix<f64> {
        let n = self.mean.len();
        let inverse = (&self.root * self.root.transpose()).pseudo_inverse(0.0);
        inverse.unwrap_or_else(|_| DMatrix::zeros(n, n))
    }

    /// One of them, moved by the part `h`.
    pub(super) fn moved(&self, z: &DVector<f64>, h: f64, rng: &mut rng::Stream) -> DVector<f64> {
        let xi = DVector::from_fn(z.len(), |_, _| rng::normal(rng));
        let near = (1.0 - h * h).sqrt();
        &self.mean + (z - &self.mean) * near + &self.root * xi * h
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Purpose, normal, stream};

    #[test]
    fn moves_keep_mean_and_covariance() {
        let mut rng = stream(1, Purpose::Swarm, 0, 0);
        // a line in the plane, in very different units, beside a number of its own
        let all: Vec<DVector<f64>> = (0..20_000)
            .map(|_| {
                let (a, b) = (normal(&mut rng), normal(&mut rng));
                DVector::from_vec(vec![1.0 + 1e-6 * a, 2000.0 * a, 3.0 + b])
            })
            .collect();
        let before = Kernel::of(&all);
        let moved: Vec<DVector<f64>> = all.iter().map(|z| before.moved(z, 0.5, &mut rng)).collect();
        let after = Kernel::of(&moved);
        for i in 0..3 {
            let sigma = before.root.row(i).norm();
            assert!((after.mean[i] - before.mean[i]).abs() < 0.02 * sigma);
            assert!((after.root.row(i).norm() / sigma - 1.0).abs() < 0.03);
        }
        // and the line: what rests on the ground stays there
        for z in &moved {
            let off = (z[0] - 1.0) / 1e-6 - z[1] / 2000.0;
            assert!(off.abs() < 1e-3, "{off}");
        }
    }
}
