//! Least squares inside bounds.

use nalgebra::{DMatrix, DVector};

/// argmin ½ xᵀ N x − bᵀ x within bounds, by active sets: components that hit a bound are held there.
pub(crate) fn solve_in_box(
    normal: &DMatrix<f64>,
    right: &DVector<f64>,
    low: &[f64],
    high: &[f64],
) -> Vec<f64> {
    let n = low.len();
    let mut held: Vec<Option<f64>> = vec![None; n];
    loop {
        let free: Vec<usize> = (0..n).filter(|&i| held[i].is_none()).collect();
        let mut x: Vec<f64> = held.iter().map(|h| h.unwrap_or(0.0)).collect();
        if free.is_empty() {
            return x;
        }
        // scaled to a unit diagonal, for parameters of very different units
        let scale: Vec<f64> = free
            .iter()
            .map(|&i| normal[(i, i)].max(f64::MIN_POSITIVE).sqrt().recip())
            .collect();
        let a = DMatrix::from_fn(free.len(), free.len(), |r, c| {
            normal[(free[r], free[c])] * scale[r] * scale[c]
        });
        let b = DVector::from_fn(free.len(), |r, _| {
            let fixed: f64 = (0..n)
                .filter_map(|j| held[j].map(|v| normal[(free[r], j)] * v))
                .sum();
            (right[free[r]] - fixed) * scale[r]
        });
        let solution = match a.clone().cholesky() {
            Some(factor) => factor.solve(&b),
            None => a
                .svd(true, true)
                .solve(&b, 1e-12)
                .unwrap_or_else(|_| DVector::zeros(free.len())),
        };
        let mut changed = false;
        for (r, &i) in free.iter().enumerate() {
            x[i] = solution[r] * scale[r];
            if x[i] < low[i] || x[i] > high[i] {
                held[i] = Some(x[i].clamp(low[i], high[i]));
                changed = true;
            }
        }
        if !changed {
            return x;
        }
    }
}
