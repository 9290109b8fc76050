//! What was known of the parameters before, as a cost.

use super::parameter::Parameters;

impl Parameters {
    /// Σ ((x − x̄)/σₓ)²/2 over the free parameters that have a prior.
    pub(crate) fn prior_cost(&self, x: &[f64]) -> f64 {
        (self.iter_free().zip(x))
            .filter(|(p, _)| p.prior_sigma.is_finite())
            .map(|(p, x)| 0.5 * ((x - p.to_x(p.prior)) / p.prior_sigma).powi(2))
            .sum()
    }
}
