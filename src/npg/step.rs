//! How far to go along the natural gradient.

use nalgebra::{DMatrix, DVector};

use super::NpgConfig;
use crate::policy::AffineGaussian;

/// After so many halvings the step is below rounding.
const MAX_HALVINGS: usize = 60;

/// The policy one normalised step along `direction`, and KL(old ‖ new). The step is halved while the measured KL is
/// over twice the predicted one, which the change of σ can cause. A σ that was below the floor before the step is
/// raised in any case; that part of the change does not count against the limit, or no step would ever be short enough.
pub(super) fn step(
    policy: &AffineGaussian,
    direction: &[f64],
    gradient_norm2: f64,
    second: &DMatrix<f64>,
    config: &NpgConfig,
) -> (f64, AffineGaussian) {
    let mut origin = policy.clone();
    origin.raise_log_sigma(config.log_sigma_floor);
    let theta = origin.parameters();
    let mut length = (config.step_size_delta / gradient_norm2).sqrt();
    for _ in 0..MAX_HALVINGS {
        let mut next = policy.clone();
        let moved: Vec<f64> = theta
            .iter()
            .zip(direction)
            .map(|(t, d)| t + length * d)
            .collect();
        if next.set_parameters(&moved).is_ok() {
            next.raise_log_sigma(config.log_sigma_floor);
            if kl_divergence(&origin, &next, second) <= config.step_size_delta {
                return (kl_divergence(policy, &next, second), next);
            }
        }
        length *= 0.5;
    }
    (kl_divergence(policy, &origin, second), origin)
}

/// KL(old ‖ new) averaged over steps, where `second` is `E[ψψᵀ]` of the score's features (observation and 1 for white noise;
/// see [`crate::exploration`]).
pub fn kl_divergence(old: &AffineGaussian, new: &AffineGaussian, second: &DMatrix<f64>) -> f64 {
    let width = second.nrows();
    let rows = old
        .weights()
        .chunks_exact(width)
        .zip(new.weights().chunks_exact(width));
    let sigmas = old.log_sigma().iter().zip(new.log_sigma());
    rows.zip(sigmas)
        .map(|((a, b), (l, m))| {
            let change = DVector::from_iterator(width, b.iter().zip(a).map(|(b, a)| b - a));
            let shift = change.dot(&(second * &change)); // E[(μ' - μ)²]
            m - l + ((2.0 * l).exp() + shift) / (2.0 * (2.0 * m).exp()) - 0.5
        })
        .sum()
}
