//! The Gauss-Newton step that an ensemble asks for.

use nalgebra::{DMatrix, DVector};

use super::ensemble::Ensemble;
use crate::sysid::box_qp::solve_in_box;
use crate::sysid::parameter::Parameters;

/// The problem about one point: normal matrix and gradient, priors included.
pub(crate) struct Quadratic {
    /// (parameters × parameters)
    pub normal: DMatrix<f64>,
    pub gradient: DVector<f64>,
}

impl Quadratic {
    /// At `x`, each bin of the ensemble times its weight.
    pub(crate) fn new(
        ensemble: &Ensemble,
        weights: &DVector<f64>,
        parameters: &Parameters,
        x: &[f64],
    ) -> Self {
        let slopes = ensemble.slopes.whitened(weights);
        let mut normal: DMatrix<f64> = slopes.tr_mul(&slopes);
        let mut gradient: DVector<f64> = slopes.tr_mul(&ensemble.mean.component_mul(weights));
        for (i, (precision, slope)) in parameters.prior_slopes(x).enumerate() {
            normal[(i, i)] += precision;
            gradient[i] += slope;
        }
        Self { normal, gradient }
    }

    /// The step from `x` to the least cost within bounds, each parameter going `far` of its spreads at most.
    pub(crate) fn step(
        &self,
        parameters: &Parameters,
        x: &[f64],
        (spreads, far): (&[f64], f64),
    ) -> Vec<f64> {
        let (low, high): (Vec<f64>, Vec<f64>) = (parameters.reach(x).zip(spreads))
            .map(|((low, high), s)| (low.max(-far * s), high.min(far * s)))
            .unzip();
        solve_in_box(&self.normal, &(-&self.gradient), &low, &high)
    }
}
