//! What was known of the parameters before, as a cost.

use super::parameter::Parameters;

impl Parameters {
    /// Σ ((x − x̄)/σₓ)²/2 over the free parameters that have a prior.
    pub(crate) fn prior_cost(&self, x: &[f64]) -> f64 {
        self.offsets(x).map(|z| 0.5 * z.powi(2)).sum()
    }

    /// How far the parameter is from its prior that is farthest, in standard deviations; 0 without priors.
    pub(crate) fn farthest(&self, x: &[f64]) -> f64 {
        self.offsets(x).map(f64::abs).fold(0.0, f64::max)
    }

    /// (x − x̄)/σₓ of the free parameters that have a prior.
    fn offsets(&self, x: &[f64]) -> impl Iterator<Item = f64> {
        let known = (self.iter_free().zip(x)).filter(|(p, _)| p.has_prior());
        known.map(|(p, x)| (x - p.to_x(p.prior)) / p.prior_sigma)
    }

    /// Its curvature and slope by each free parameter; 0 without a prior.
    pub(crate) fn prior_slopes(&self, x: &[f64]) -> impl Iterator<Item = (f64, f64)> {
        self.iter_free().zip(x).map(|(p, x)| {
            if !p.has_prior() {
                return (0.0, 0.0);
            }
            let precision = p.prior_sigma.powi(-2);
            (precision, precision * (x - p.to_x(p.prior)))
        })
    }
}
