//! What the recordings say about the parameters, and how surely.
//!
//! The innovations of a fit (rows sᵢ of sensitivities and values eᵢ, the trajectory marginalised) carry the information
//! A = Σ sᵢ sᵢᵀ. The covariance of the estimates is
//!
//! ```text
//! C = H⁻¹ (L + P) H⁻¹        H = A + P        L = Var Σ sᵢ eᵢ        P = diag(1/σ_prior²)
//! ```
//!
//! L = A only if every channel's noise is white and of the size that was assumed. It is not: quantised encoders,
//! filters and forces that nothing explains are correlated over many samples. How much more each estimate scatters is
//! taken from the recordings themselves (see `long_run`), each parameter's factor with as many degrees of freedom as the
//! data allow; 95 % intervals take Student's t. Correlations are those of H⁻¹.
//!
//! Parameters at a bound are held there; the intervals of the others are given that.

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use rayon::prelude::*;
use serde::Serialize;

use super::fit::Innovations;
use super::long_run::Rows;
use super::parameter::{Parameter, Parameters, Scale};
use super::separate::{self, Combination};
use super::student::two_sided_t;

/// Posterior spread over prior spread from which a parameter counts as the prior's: its variance is half of it.
const PRIOR_SHARE: f64 = 0.7;
/// Spread in units of the parameter's size from which it counts as not determined.
const UNDETERMINED: f64 = 3.0;
/// Information that is assumed of everything, a spread of ten thousand sizes: keeps what nothing determines finite.
const LEAST_INFORMATION: f64 = 1e-8;
/// Least ratio of a variance to that of white noise: derivatives of no effect leave scores of no size.
const LEAST_INFLATION: f64 = 1e-2;

/// What an estimate is worth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Label {
    /// determined by the recordings
    Identified,
    /// mostly what was known before
    Prior,
    /// on its lower or upper bound
    AtBound,
    /// neither recordings nor prior determine it
    Undetermined,
    /// held as configured
    Frozen,
}

/// A parameter's result.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Estimate {
    /// address
    pub name: String,
    /// of the values
    pub unit: String,
    /// whether x is the logarithm
    pub scale: Scale,
    /// the model's value
    pub nominal: f64,
    /// estimate
    pub value: f64,
    /// 95 % interval; none at a bound, where frozen or not determined
    pub interval: Option<[f64; 2]>,
    /// standard deviation of x
    pub x_sigma: Option<f64>,
    /// degrees of freedom behind it
    pub dof: Option<f64>,
    /// of x; none: nothing was known
    pub prior_sigma: Option<f64>,
    /// variance over that of white noise of the assumed size
    pub inflation: Option<f64>,
    /// worth
    pub label: Label,
}

/// The parameters' distribution.
#[derive(Debug, Clone, PartialEq)]
pub struct Posterior {
    /// all parameters, frozen ones included, in the order of the rules
    pub estimates: Vec<Estimate>,
    /// (free × free) covariance of x; rows of parameters at a bound are 0
    pub covariance: DMatrix<f64>,
    /// what cannot be told apart
    pub inseparable: Vec<Combination>,
}

impl Posterior {
    /// From the innovations of a fit at free parameters `x`; `lengths` has the knots of each trial.
    pub fn new(
        parameters: &Parameters,
        x: &[f64],
        innovations: &Innovations,
        lengths: &[usize],
    ) -> Self {
        let n = x.len();
        let free: Vec<&Parameter> = parameters.iter_free().collect();
        let at_bound: Vec<bool> = free.iter().zip(x).map(|(p, &x)| on_bound(p, x)).collect();
        let open: Vec<usize> = (0..n).filter(|&i| !at_bound[i]).collect();
        let spread = Spread::new(&free, &open, innovations, lengths);

        let mut covariance = DMatrix::zeros(n, n);
        for (r, &i) in open.iter().enumerate() {
            for (c, &j) in open.iter().enumerate() {
                covariance[(i, j)] = spread.covariance[(r, c)] * free[i].typical * free[j].typical;
            }
        }
        let mut estimates: Vec<Estimate> = parameters.all.iter().map(held).collect();
        for (k, (&index, p)) in parameters.free.iter().zip(&free).enumerate() {
            let out = &mut estimates[index];
            out.value = p.to_value(x[k]);
            let Some(at) = open.iter().position(|&i| i == k) else {
                out.label = Label::AtBound;
                continue;
            };
            let sigma = covariance[(k, k)].sqrt();
            let determined = sigma < UNDETERMINED * p.typical;
            out.label = if !determined {
                Label::Undetermined
            } else if sigma > PRIOR_SHARE * p.prior_sigma {
                Label::Prior
            } else {
                Label::Identified
            };
            out.dof = Some(spread.dof[at]);
            out.inflation = Some(spread.inflation[at]);
            out.x_sigma = Some(sigma);
            if determined {
                let half = two_sided_t(0.95, spread.dof[at]) * sigma;
                let (lower, upper) = p.bounds();
                let ends = [(x[k] - half).max(lower), (x[k] + half).min(upper)];
                out.interval = Some(ends.map(|x| p.to_value(x)));
            }
        }
        let weak: Vec<&Parameter> = open.iter().map(|&i| free[i]).collect();
        let inseparable = separate::combinations(&weak, &spread.information);
        Self {
            estimates,
            covariance,
            inseparable,
        }
    }

    /// Correlations of the free parameters (free × free); 0 where one is at a bound.
    pub fn correlation(&self) -> DMatrix<f64> {
        let c = &self.covariance;
        DMatrix::from_fn(c.nrows(), c.ncols(), |i, j| {
            let size = (c[(i, i)] * c[(j, j)]).sqrt();
            if size > 0.0 { c[(i, j)] / size } else { 0.0 }
        })
    }
}

fn held(p: &Parameter) -> Estimate {
    Estimate {
        name: p.name.clone(),
        unit: p.unit.to_owned(),
        scale: p.scale,
        nominal: p.nominal,
        value: p.start,
        interval: None,
        x_sigma: None,
        dof: None,
        prior_sigma: p.has_prior().then_some(p.prior_sigma),
        inflation: None,
        label: Label::Frozen,
    }
}

fn on_bound(p: &Parameter, x: f64) -> bool {
    let (lower, upper) = p.bounds();
    let near = 1e-9 * p.typical;
    (lower.is_finite() && x - lower <= near) || (upper.is_finite() && upper - x <= near)
}

/// Covariance of the parameters that are on no bound, in units of their sizes.
struct Spread {
    covariance: DMatrix<f64>,
    dof: Vec<f64>,
    inflation: Vec<f64>,
    /// information of the recordings as their noise really is
    information: DMatrix<f64>,
}

impl Spread {
    fn new(
        free: &[&Parameter],
        open: &[usize],
        innovations: &Innovations,
        lengths: &[usize],
    ) -> Self {
        let m = open.len();
        let size = |k: usize| free[open[k]].typical;
        let rows = Rows {
            values: &innovations.rows,
            width: free.len() + 1,
            places: &innovations.places,
            lengths,
            columns: (0..m).map(|i| (open[i], size(i))).collect(),
        };
        let a = rows.information();
        let prior = DVector::from_fn(m, |i, _| {
            (size(i) / free[open[i]].prior_sigma).powi(2) + LEAST_INFORMATION
        });
        let inverse = inverse(&(&a + DMatrix::from_diagonal(&prior)));
        let by_prior = &inverse * DMatrix::from_diagonal(&prior) * &inverse;
        let white = &inverse * &a * &inverse;
        let (mut scale, mut dof, mut inflation) = (Vec::new(), Vec::new(), Vec::new());
        let spectra: Vec<_> = (0..m)
            .into_par_iter()
            .map(|i| rows.inflation(&inverse.column(i).into(), &inverse))
            .collect();
        for (i, found) in spectra.into_iter().enumerate() {
            let factor = found.factor.max(LEAST_INFLATION);
            let by_data = factor * white[(i, i)];
            let variance = by_data + by_prior[(i, i)];
            scale.push((variance / inverse[(i, i)]).sqrt());
            // the prior's part is known (Welch and Satterthwaite)
            dof.push(found.dof * (variance / by_data.max(f64::MIN_POSITIVE)).powi(2));
            inflation.push(factor);
        }
        // of single scores, as estimates mix what is known well with what is not known at all
        let own: Vec<f64> = (0..m)
            .into_par_iter()
            .map(|i| {
                let unit = DVector::from_fn(m, |j, _| f64::from(u8::from(i == j)));
                rows.inflation(&unit, &inverse)
                    .factor
                    .max(LEAST_INFLATION)
                    .sqrt()
            })
            .collect();
        Self {
            covariance: DMatrix::from_fn(m, m, |i, j| inverse[(i, j)] * scale[i] * scale[j]),
            dof,
            inflation,
            information: DMatrix::from_fn(m, m, |i, j| a[(i, j)] / (own[i] * own[j])),
        }
    }
}

/// Inverse of a positive definite matrix.
fn inverse(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    if matrix.is_empty() {
        return matrix.clone(); // which has no eigenvalues to ask for
    }
    let eigen = SymmetricEigen::new(matrix.clone());
    let inverse = eigen.eigenvalues.map(|v| 1.0 / v.max(LEAST_INFORMATION));
    &eigen.eigenvectors * DMatrix::from_diagonal(&inverse) * eigen.eigenvectors.transpose()
}
