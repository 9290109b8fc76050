//! A quadratic through the costs around a point: where a rough cost is least, how it bends, and what each start says.
//!
//! ```text
//! F(z) ≈ F₀ + g·z + ½ zᵀ H z        fᵢ(z) ≈ fᵢ₀ + gᵢ·z + …        z = (x − centre)/unit
//! ```
//!
//! are least-squares fits to all candidates of a cloud, each weighing 1/(1 + (ΔF/near)²) with ΔF its cost above the least.
//! The roughness, whatever two candidates next to each other differ by, averages out; its size is `rough`.

use nalgebra::{Cholesky, DMatrix, DVector, SymmetricEigen};

use super::SysidError;
use super::box_qp::solve_in_box;

/// Least curvature, as a part of the greatest: beyond, the cloud tells nothing.
const LEAST_CURVATURE: f64 = 1e-6;

/// The quadratic around a centre.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Surface {
    /// H by x, positive definite
    pub curvature: DMatrix<f64>,
    /// g by x, at the centre
    pub slope: DVector<f64>,
    /// (starts) gᵢ by x, at the centre
    pub slopes: Vec<DVector<f64>>,
    /// standard deviation of F around it, points counted as in [`Surface::new`]
    pub rough: f64,
    /// where the cloud reaches to, from the centre (lower, upper)
    reach: (Vec<f64>, Vec<f64>),
}

/// Number of candidates that a quadratic of `n` numbers needs at least.
pub(super) fn needed(n: usize) -> usize {
    1 + n + n * (n + 1) / 2
}

impl Surface {
    /// Through `points` (x; costs, the sum first and then each start's); `unit` is the size of the cloud by x. Points
    /// that cost `near` more than the best count half; infinite: all the same.
    pub(super) fn new(
        centre: &[f64],
        unit: &[f64],
        points: &[(Vec<f64>, Vec<f64>)],
        near: f64,
    ) -> Result<Self, SysidError> {
        let n = centre.len();
        let z = |x: &[f64], i: usize| (x[i] - centre[i]) / unit[i];
        let pairs: Vec<(usize, usize)> =
            (0..n).flat_map(|i| (0..=i).map(move |j| (i, j))).collect();
        let best = points.iter().map(|p| p.1[0]).fold(f64::INFINITY, f64::min);
        let counts: Vec<f64> = (points.iter())
            .map(|p| (1.0 / (1.0 + ((p.1[0] - best) / near).powi(2))).sqrt())
            .collect();
        let design = DMatrix::from_fn(points.len(), needed(n), |row, column| {
            let x = &points[row].0;
            let of = match column.checked_sub(1 + n) {
                None if column == 0 => 1.0,
                None => z(x, column - 1),
                Some(k) => z(x, pairs[k].0) * z(x, pairs[k].1),
            };
            counts[row] * of
        });
        let values = DMatrix::from_fn(points.len(), points[0].1.len(), |row, column| {
            counts[row] * points[row].1[column]
        });
        let svd = design.clone().svd(true, true);
        let tolerance = 1e-10 * svd.singular_values.max();
        let fitted = svd
            .solve(&values, tolerance)
            .map_err(|reason| SysidError::Setting {
                reason: reason.to_owned(),
            })?;
        let mut bent = DMatrix::<f64>::zeros(n, n);
        for (k, &(i, j)) in pairs.iter().enumerate() {
            let value = fitted[(1 + n + k, 0)];
            bent[(i, j)] += value;
            bent[(j, i)] += value;
        }
        let eigen = SymmetricEigen::new(bent);
        let least = (LEAST_CURVATURE * eigen.eigenvalues.amax()).max(f64::MIN_POSITIVE);
        let values_of = eigen.eigenvalues.map(|v| v.max(least));
        let bent = &eigen.eigenvectors
            * DMatrix::from_diagonal(&values_of)
            * eigen.eigenvectors.transpose();
        let by_x = |column: usize| DVector::from_fn(n, |i, _| fitted[(1 + i, column)] / unit[i]);
        let off = &design * fitted.column(0) - values.column(0);
        let spare = points.len().saturating_sub(needed(n)).max(1);
        let ends = |i: usize| {
            let all = points.iter().map(|(x, _)| x[i] - centre[i]);
            all.fold((0.0_f64, 0.0_f64), |(l, h), d| (l.min(d), h.max(d)))
        };
        Ok(Self {
            curvature: DMatrix::from_fn(n, n, |i, j| bent[(i, j)] / (unit[i] * unit[j])),
            slope: by_x(0),
            slopes: (1..points[0].1.len()).map(by_x).collect(),
            rough: (off.norm_squared() / spare as f64).sqrt(),
            reach: (0..n).map(ends).unzip(),
        })
    }

    /// Where a quadratic like it is least, from the centre, within the cloud.
    pub(super) fn least(&self, curvature: &DMatrix<f64>, slope: &DVector<f64>) -> Vec<f64> {
        solve_in_box(curvature, &-slope, &self.reach.0, &self.reach.1)
    }

    /// Rows of sensitivities and value, one block a start, of which the sum of squares bends as F does and whose scores
    /// are the slopes of the starts: what intervals are made of.
    pub(super) fn innovations(&self) -> Vec<f64> {
        let n = self.slope.len();
        let share = &self.curvature / self.slopes.len() as f64;
        let Some(factor) = Cholesky::new(share) else {
            return Vec::new();
        };
        let lower = factor.l(); // rows of its transpose are the sensitivities: Rᵀ R = H/starts
        let mut rows = Vec::with_capacity(self.slopes.len() * n * (n + 1));
        for slope in &self.slopes {
            let values = lower
                .solve_lower_triangular(slope)
                .unwrap_or_else(|| slope.clone());
            for i in 0..n {
                rows.extend(lower.column(i).iter());
                rows.push(values[i]);
            }
        }
        rows
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{self, Purpose};

    #[test]
    fn far_points_that_no_quadratic_holds_for_count_little() {
        let mut rng = rng::stream(3, Purpose::Model, 0, 0);
        let points: Vec<(Vec<f64>, Vec<f64>)> = (0..200)
            .map(|_| {
                let x = 3.0 * rng::normal(&mut rng);
                (vec![x], vec![(x - 0.5).powi(2) + x.exp()])
            })
            .collect();
        // 2 (x − 0.5) + exp x = 0
        let least = |near| {
            let surface = Surface::new(&[0.0], &[3.0], &points, near).expect("fits");
            surface.least(&surface.curvature, &surface.slope)[0]
        };
        assert!(least(0.5).abs() < 0.2, "{}", least(0.5));
        assert!(least(f64::INFINITY).abs() > 0.5, "{}", least(f64::INFINITY));
    }

    #[test]
    fn a_quadratic_is_found_under_roughness() {
        let mut rng = rng::stream(2, Purpose::Model, 0, 0);
        let truth = [0.3, -20.0];
        let unit = [1.0, 100.0];
        let points: Vec<(Vec<f64>, Vec<f64>)> = (0..400)
            .map(|_| {
                let x: Vec<f64> = unit.iter().map(|u| u * rng::normal(&mut rng)).collect();
                let (a, b) = (x[0] - truth[0], 0.01 * (x[1] - truth[1]));
                let parts = [a * a + b * b, a * b + a * a];
                let rough = 0.1 * rng::normal(&mut rng);
                (x, vec![parts[0] + parts[1] + rough, parts[0], parts[1]])
            })
            .collect();
        let surface = Surface::new(&[0.0, 0.0], &unit, &points, f64::INFINITY).expect("fits");
        let least = surface.least(&surface.curvature, &surface.slope);
        assert!((least[0] - truth[0]).abs() < 0.02, "{least:?}");
        assert!((least[1] - truth[1]).abs() < 2.0, "{least:?}");
        assert!((surface.rough - 0.1).abs() < 0.02);
        // what the rows say is what the quadratic says
        let rows = surface.innovations();
        let (mut bent, mut score) = (DMatrix::zeros(2, 2), DVector::zeros(2));
        for row in rows.chunks_exact(3) {
            let s = DVector::from_column_slice(&row[..2]);
            bent.ger(1.0, &s, &s, 1.0);
            score.axpy(row[2], &s, 1.0);
        }
        assert!((&bent - &surface.curvature).norm() < 1e-9 * bent.norm());
        let sum = surface.slopes.iter().fold(DVector::zeros(2), |a, b| a + b);
        assert!((score - sum).norm() < 1e-9);
    }
}
