//! Deviations and their slopes by regression over an ensemble of simulations.
//!
//! In simulation i of N every parameter j is moved by ± its spread sⱼ at once. Signs are a Plackett-Burman design with each
//! row's opposite added: columns are orthogonal to each other, to the mean and to all products of two, so that each slope
//! is told by all N simulations. Of chaos with variance v in a simulation, v/N remains in the mean and v/(N sⱼ²) in a
//! slope; central differences with as many simulations would leave v/(2 sⱼ²).
//!
//! Reference: Plackett and Burman 1946, "The design of optimum multifactorial experiments".

use nalgebra::{DMatrix, DVector};

use super::course::Course;
use crate::sysid::SysidError;
use crate::sysid::parameter::Parameter;

/// Relative size of a singular value of the design below which it is none.
const RANK: f64 = 1e-9;
/// Least number of simulations in half an ensemble, less one.
const LEAST: usize = 23;

/// The problem linearised.
#[derive(Debug, Clone)]
pub(super) struct Ensemble {
    /// mean deviations of all bins at the centre
    pub mean: DVector<f64>,
    /// (bins × parameters)
    pub slopes: DMatrix<f64>,
    /// sum of squares, whitened, by which a simulation differs from the linear
    pub rough: f64,
    /// simulations
    pub n: usize,
}

impl Ensemble {
    /// About `x`, within the parameters' bounds.
    ///
    /// # Errors
    /// Too many simulations diverge to tell slopes.
    pub(super) fn new(course: &Course<'_>, x: &[f64], spreads: &[f64]) -> Result<Self, SysidError> {
        let bounds = course.problem.parameters.iter_free().map(Parameter::bounds);
        let bounds: Vec<(f64, f64)> = bounds.collect();
        let move_by = |signs: Vec<f64>| -> Vec<f64> {
            (0..x.len())
                .map(|j| (x[j] + signs[j] * spreads[j]).clamp(bounds[j].0, bounds[j].1))
                .collect()
        };
        let points: Vec<Vec<f64>> = design(x.len()).into_iter().map(move_by).collect();
        let found = course.sample(&points);
        if found.len() <= x.len() + 1 {
            return Err(super::broken());
        }
        let moves = DMatrix::from_fn(found.len(), x.len() + 1, |i, j| match j.checked_sub(1) {
            Some(j) => (points[found[i].0][j] - x[j]) / spreads[j],
            None => 1.0,
        });
        let bins = DMatrix::from_fn(found.len(), course.bins.all.len(), |i, b| found[i].1[b]);
        let back = (moves.clone().pseudo_inverse(RANK)).unwrap_or_else(|_| moves.transpose());
        let fitted = back * &bins;
        let mean = fitted.row(0).transpose();
        let weights = course.weights(mean.as_slice());
        let left = bins - &moves * &fitted;
        let squares = left.column_iter().map(|bin| bin.norm_squared());
        let square: f64 = squares.zip(&weights).map(|(s, w)| s * w * w).sum();
        let rough = square / (found.len() - moves.ncols()) as f64;
        let mut slopes = fitted.rows_range(1..).transpose();
        for (mut column, spread) in slopes.column_iter_mut().zip(spreads) {
            column /= *spread;
        }
        Ok(Self {
            mean,
            slopes,
            rough,
            n: found.len(),
        })
    }

    /// Slopes, each bin times its weight.
    pub(super) fn whitened(&self, weights: &DVector<f64>) -> DMatrix<f64> {
        let mut slopes = self.slopes.clone();
        for mut column in slopes.column_iter_mut() {
            column.component_mul_assign(weights);
        }
        slopes
    }
}

/// Signs of `n` parameters in each simulation.
fn design(n: usize) -> Vec<Vec<f64>> {
    let is_prime = |q: usize| (2..q).all(|d| !q.is_multiple_of(d));
    let mut q = n.max(LEAST);
    while q % 4 != 3 || !is_prime(q) {
        q += 1;
    }
    // squares modulo q, 0 among them
    let mut is_square = vec![false; q];
    (0..q).for_each(|k| is_square[k * k % q] = true);
    let sign = |i: usize, j: usize| {
        if is_square[(q + j - i) % q] {
            1.0
        } else {
            -1.0
        }
    };
    let mut rows: Vec<Vec<f64>> = (0..q)
        .map(|i| (0..n).map(|j| sign(i, j)).collect())
        .collect();
    rows.push(vec![-1.0; n]);
    let opposite: Vec<Vec<f64>> = (rows.iter())
        .map(|row| row.iter().map(|s| -s).collect())
        .collect();
    rows.extend(opposite);
    rows
}

#[cfg(test)]
mod tests {
    use super::design;

    #[test]
    fn every_parameter_is_moved_apart_from_every_other_and_from_products() {
        for n in [1, 3, 4, 11, 12, 43, 80] {
            let rows = design(n);
            assert!((2 * (n + 1)..=2 * (n + 24)).contains(&rows.len()));
            let sum = |f: &dyn Fn(&[f64]) -> f64| rows.iter().map(|r| f(r)).sum::<f64>();
            for a in 0..n {
                assert_eq!(sum(&|r| r[a]), 0.0);
                for b in 0..a {
                    assert_eq!(sum(&|r| r[a] * r[b]), 0.0, "{n}: {a} {b}");
                    assert_eq!(sum(&|r| r[0] * r[a] * r[b]), 0.0);
                }
            }
        }
    }
}
