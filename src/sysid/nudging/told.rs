//! What slopes tell, without what chaos has put into them.
//!
//! A slope from an ensemble is the true one and noise of known variance, so that of the whitened slopes S
//!
//! ```text
//! E SᵀS = A + D        D = diag(d), dⱼ the sum of squares that chaos adds to slope j
//! ```
//!
//! Taken for information, D determines what no recording does: where a machine stands with all that it touches is known by
//! priors alone, and came out three of its standard deviations off. A is what is left of `SᵀS` without D, and nothing in
//! directions in which D is more:
//!
//! ```text
//! SᵀS = L Lᵀ        L⁻¹ D L⁻ᵀ = Q diag(q) Qᵀ        A = L Q diag(max(1 − q, 0)) Qᵀ Lᵀ
//! ```
//!
//! Reference: Fuller 1987, "Measurement Error Models", for regressors with noise of known variance.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

/// Information that is assumed of everything, relative to the largest.
const RIDGE: f64 = 1e-12;

/// What turns whitened slopes S with `SᵀS` = `normal` into such that have A; none where `normal` has no inverse.
pub(super) fn purging(normal: &DMatrix<f64>, chaos: &DVector<f64>) -> Option<DMatrix<f64>> {
    if normal.is_empty() {
        return None;
    }
    let sizes = normal.diagonal().map(|a| a.max(f64::MIN_POSITIVE).sqrt());
    // numbers of all units
    let n = normal.nrows();
    let mut scaled = DMatrix::from_fn(n, n, |i, j| normal[(i, j)] / (sizes[i] * sizes[j]));
    for i in 0..n {
        scaled[(i, i)] += RIDGE;
    }
    let lower = scaled.cholesky()?.unpack();
    let own = DMatrix::from_diagonal(&DVector::from_fn(n, |i, _| chaos[i] / sizes[i].powi(2)));
    let half = lower.solve_lower_triangular(&own)?;
    let both = lower.solve_lower_triangular(&half.transpose())?;
    let eigen = SymmetricEigen::new((&both + both.transpose()) * 0.5);
    let kept = eigen.eigenvalues.map(|q| (1.0 - q).max(0.0).sqrt());
    let q = &eigen.eigenvectors;
    let inner = q * DMatrix::from_diagonal(&kept) * q.transpose();
    let right = inner * lower.transpose();
    let own = lower.transpose().solve_upper_triangular(&right)?;
    Some(DMatrix::from_fn(n, n, |i, j| {
        own[(i, j)] * sizes[j] / sizes[i]
    }))
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::purging;
    use crate::rng::{self, Purpose};

    fn purged(normal: &DMatrix<f64>, chaos: &DVector<f64>) -> DMatrix<f64> {
        let by = purging(normal, chaos).expect("has an inverse");
        by.transpose() * normal * by
    }

    #[test]
    fn noise_in_slopes_is_no_information() {
        let (rows, sigma) = (4000, DVector::from_vec(vec![0.5, 0.05, 20.0]));
        let mut rng = rng::stream(5, Purpose::SensorNoise, 0, 0);
        // the third does what the first does, forty times: their difference is not told
        let truth = DMatrix::from_fn(rows, 3, |i, j| match j {
            0 => (0.01 * i as f64).sin(),
            1 => 0.1 * (0.023 * i as f64).cos(),
            _ => 40.0 * (0.01 * i as f64).sin(),
        });
        let slopes = DMatrix::from_fn(rows, 3, |i, j| {
            truth[(i, j)] + sigma[j] * rng::normal(&mut rng)
        });
        let chaos = sigma.map(|s| s * s * rows as f64);
        let told = purged(&slopes.tr_mul(&slopes), &chaos);
        let real = truth.tr_mul(&truth);
        for j in 0..3 {
            let part = told[(j, j)] / real[(j, j)];
            assert!((part - 1.0).abs() < 0.1, "{j}: {part}");
        }
        let difference = DVector::from_vec(vec![40.0, 0.0, -1.0]);
        let of = |a: &DMatrix<f64>| difference.dot(&(a * &difference));
        assert!(of(&(slopes.tr_mul(&slopes))) > 1e6);
        assert!(of(&told) < 1e5, "{}", of(&told));
        assert_eq!(purging(&DMatrix::zeros(0, 0), &DVector::zeros(0)), None);
        // nothing to take off
        let same = purged(&real, &DVector::zeros(3));
        assert!((same - &real).norm() < 1e-9 * real.norm());
    }
}
