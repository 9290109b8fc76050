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
/// Least number of simulations in half an ensemble, less one; of one with few parameters open.
const LEAST: usize = 23;
const FEW: usize = 3;
/// How far parameters tremble that are not open, in their spreads.
const TREMBLE: f64 = 0.05;

/// Slopes of deviations.
#[derive(Debug, Clone)]
pub(crate) struct Slopes {
    /// (bins × parameters)
    pub by: DMatrix<f64>,
    /// of each parameter's, whitened: sum of squares that chaos adds to it
    pub chaos: DVector<f64>,
}

impl Slopes {
    pub(crate) fn zeros(bins: usize, parameters: usize) -> Self {
        Self {
            by: DMatrix::zeros(bins, parameters),
            chaos: DVector::zeros(parameters),
        }
    }

    /// The first of them, and nothing for others up to so many.
    pub(crate) fn widened(&self, parameters: usize) -> Self {
        let mut wide = Self::zeros(self.by.nrows(), parameters);
        let n = self.by.ncols().min(parameters);
        (wide.by.columns_mut(0, n)).copy_from(&self.by.columns(0, n));
        (wide.chaos.rows_mut(0, n)).copy_from(&self.chaos.rows(0, n));
        wide
    }

    /// Those of some parameters.
    pub(crate) fn only(&self, parameters: &[usize]) -> Self {
        Self {
            by: self.by.select_columns(parameters),
            chaos: self.chaos.select_rows(parameters),
        }
    }

    /// Each bin times its weight.
    pub(crate) fn whitened(&self, weights: &DVector<f64>) -> DMatrix<f64> {
        let mut whitened = self.by.clone();
        for mut column in whitened.column_iter_mut() {
            column.component_mul_assign(weights);
        }
        whitened
    }
}

/// The problem linearised.
#[derive(Debug, Clone)]
pub(crate) struct Ensemble {
    /// mean deviations of all bins at the centre
    pub mean: DVector<f64>,
    pub slopes: Slopes,
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
    pub(crate) fn new(course: &Course<'_>, x: &[f64], spreads: &[f64]) -> Result<Self, SysidError> {
        let all: Vec<usize> = (0..x.len()).collect();
        Self::regress(course, x, spreads, &all, design(x.len(), LEAST), |_, _| ())
    }

    /// The same of the parameters `open` alone, by few simulations. The others tremble, so that chaos is another in each
    /// simulation and in each `draw`, and what `known` slopes (bins × parameters) make of that is taken off. All slopes are
    /// of the result.
    ///
    /// # Errors
    /// Too many simulations diverge to tell slopes.
    pub(crate) fn few(
        course: &Course<'_>,
        x: &[f64],
        spreads: &[f64],
        open: &[usize],
        (known, draw): (&Slopes, usize),
    ) -> Result<Self, SysidError> {
        let own = design(open.len(), FEW);
        let mut signs = trembling(x.len(), own.len(), draw);
        for (all, own) in signs.iter_mut().zip(own) {
            open.iter().zip(own).for_each(|(&j, s)| all[j] = s);
        }
        Self::beside_known(course, (x, spreads), open, signs, known)
    }

    /// The mean of so many simulations, all parameters trembling.
    ///
    /// # Errors
    /// Most simulations diverge.
    pub(crate) fn still(
        course: &Course<'_>,
        x: &[f64],
        spreads: &[f64],
        known: &Slopes,
        n: usize,
    ) -> Result<Self, SysidError> {
        Self::beside_known(course, (x, spreads), &[], trembling(x.len(), n, 0), known)
    }

    fn beside_known(
        course: &Course<'_>,
        (x, spreads): (&[f64], &[f64]),
        open: &[usize],
        signs: Vec<Vec<f64>>,
        known: &Slopes,
    ) -> Result<Self, SysidError> {
        let off = |moved: &[f64], bins: &mut DVector<f64>| {
            let mut by = DVector::from_column_slice(moved);
            for &j in open {
                by[j] = 0.0;
            }
            bins.gemv(-1.0, &known.by, &by, 1.0);
        };
        let found = Self::regress(course, x, spreads, open, signs, off)?;
        let mut slopes = known.clone();
        for (k, &j) in open.iter().enumerate() {
            slopes.by.set_column(j, &found.slopes.by.column(k));
            slopes.chaos[j] = found.slopes.chaos[k];
        }
        Ok(Self { slopes, ..found })
    }

    /// Regression on the parameters `open`, where all are moved by `signs` times spreads; `off` takes off deviations what
    /// the others do.
    fn regress(
        course: &Course<'_>,
        x: &[f64],
        spreads: &[f64],
        open: &[usize],
        signs: Vec<Vec<f64>>,
        off: impl Fn(&[f64], &mut DVector<f64>),
    ) -> Result<Self, SysidError> {
        let bounds = course.problem.parameters.iter_free().map(Parameter::bounds);
        let bounds: Vec<(f64, f64)> = bounds.collect();
        let move_by = |signs: Vec<f64>| -> Vec<f64> {
            (0..x.len())
                .map(|j| (x[j] + signs[j] * spreads[j]).clamp(bounds[j].0, bounds[j].1))
                .collect()
        };
        let points: Vec<Vec<f64>> = signs.into_iter().map(move_by).collect();
        let found = course.sample(&points);
        // of slopes, one more than there are unknowns
        if found.len() < open.len() + 1 + usize::from(!open.is_empty()) {
            return Err(super::broken());
        }
        let mut moves = DMatrix::from_element(found.len(), open.len() + 1, 1.0);
        let mut bins = DMatrix::zeros(found.len(), course.bins.all.len());
        for (i, (point, own)) in found.into_iter().enumerate() {
            let moved: Vec<f64> = points[point].iter().zip(x).map(|(p, x)| p - x).collect();
            for (k, &j) in open.iter().enumerate() {
                moves[(i, k + 1)] = moved[j] / spreads[j];
            }
            let mut own = DVector::from_vec(own);
            off(&moved, &mut own);
            bins.set_row(i, &own.transpose());
        }
        let back = (moves.clone().pseudo_inverse(RANK)).unwrap_or_else(|_| moves.transpose());
        let fitted = back * &bins;
        let mean = fitted.row(0).transpose();
        let weights = course.weights(mean.as_slice());
        let n = moves.nrows();
        let left = bins - &moves * &fitted;
        let squares = left.column_iter().map(|bin| bin.norm_squared());
        let square: f64 = squares.zip(&weights).map(|(s, w)| s * w * w).sum();
        let rough = square / (n - moves.ncols()).max(1) as f64;
        let mut by = fitted.rows_range(1..).transpose();
        for (mut column, &j) in by.column_iter_mut().zip(open) {
            column /= spreads[j];
        }
        let chaos = DVector::from_fn(open.len(), |k, _| {
            rough / (moves.column(k + 1).norm_squared() * spreads[open[k]].powi(2))
        });
        Ok(Self {
            mean,
            slopes: Slopes { by, chaos },
            rough,
            n,
        })
    }
}

/// Signs of `n` parameters in each of 2 (`least` + 1) simulations or more, the second half the first's opposites.
fn design(n: usize, least: usize) -> Vec<Vec<f64>> {
    let is_prime = |q: usize| (2..q).all(|d| !q.is_multiple_of(d));
    let mut q = n.max(least);
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

/// Where `n` parameters are in so many simulations that differ by chaos, in spreads; the second half are opposites. Another
/// `draw` has others, up to a number of draws.
pub(crate) fn trembling(n: usize, simulations: usize, draw: usize) -> Vec<Vec<f64>> {
    let all = design(n, LEAST.max(simulations));
    let (half, back) = (simulations.div_ceil(2), all.len() / 2);
    let rows = (0..half).chain(back..back + simulations - half);
    let moved = |i: usize| (i % back + draw * half) % back + back * (i / back);
    rows.map(|i| all[moved(i)].iter().map(|s| TREMBLE * s).collect())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::design;

    #[test]
    fn every_parameter_is_moved_apart_from_every_other_and_from_products() {
        for n in [1, 3, 4, 11, 12, 43, 80] {
            let rows = design(n, super::LEAST);
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
