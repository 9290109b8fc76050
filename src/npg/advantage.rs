//! Returns and advantages of one trajectory that was cut off at the horizon (none of the tasks here ends by itself).
//!
//! ```text
//! δ_t = r_t + γ V(s_{t+1}) - V(s_t),        s_T: the true state after the last action
//! A_t = δ_t + γ λ A_{t+1},  A_T = 0          (Schulman et al. 2016, equation 16, truncated)
//! R_t = r_t + γ R_{t+1},    R_T = V(s_T)     target of the value fit
//! ```

use crate::team::{Deal, TeamError};

/// Generalised advantages; `values` has one more entry than `rewards`, the value of the state after the last action.
pub fn generalised_advantages(
    rewards: &[f64],
    values: &[f64],
    discount: f64,
    lambda: f64,
    out: &mut Vec<f64>,
) {
    debug_assert_eq!(values.len(), rewards.len() + 1);
    out.clear();
    out.resize(rewards.len(), 0.0);
    let mut advantage = 0.0;
    for t in (0..rewards.len()).rev() {
        let delta = rewards[t] + discount * values[t + 1] - values[t];
        advantage = delta + discount * lambda * advantage;
        out[t] = advantage;
    }
}

/// Discounted returns that end in `last_value`, the value of the state after the last action.
pub fn returns(rewards: &[f64], last_value: f64, discount: f64, out: &mut Vec<f64>) {
    out.clear();
    out.resize(rewards.len(), 0.0);
    let mut value = last_value;
    for t in (0..rewards.len()).rev() {
        value = rewards[t] + discount * value;
        out[t] = value;
    }
}

/// Moments are never taken with values clipped closer than this: with one standard deviation or less they would shrink
/// to nothing.
pub(super) const MIN_CLIP: f64 = 3.0;

/// Mean and standard deviation of all `values` of a batch limited to mean ± `clip` standard deviations.
///
/// An outlier a thousand standard deviations away makes the plain standard deviation so large that it is not even
/// clipped, and everything else vanishes beside it. So the limits are taken from the limited values again, until they
/// stay: as long as the outliers are fewer than one in `clip²` samples, they end up near those of the rest.
pub(super) fn robust_moments(
    deal: &Deal<'_>,
    values: &[Vec<f64>],
    clip: f64,
) -> Result<(f64, f64), TeamError> {
    const PASSES: usize = 200;
    let clip = clip.max(MIN_CLIP);
    let (mut low, mut high) = (f64::NEG_INFINITY, f64::INFINITY);
    let (mut mean, mut sigma) = (0.0, f64::INFINITY);
    for _ in 0..PASSES {
        let limited = |place: usize| values[place].iter().map(|v| v.max(low).min(high));
        let [count, sum] =
            deal.totals(|place| [values[place].len() as f64, limited(place).sum()])?;
        mean = sum / count.max(1.0);
        let [squares] = deal.totals(|place| [limited(place).map(|v| (v - mean).powi(2)).sum()])?;
        let variance: f64 = squares / count.max(1.0);
        let before = std::mem::replace(&mut sigma, variance.sqrt());
        (low, high) = (mean - clip * sigma, mean + clip * sigma);
        if sigma.is_nan() || sigma >= 0.999 * before {
            break;
        }
    }
    Ok((mean, sigma))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The definition: the exponentially weighted average of all k-step advantages.
    fn by_definition(rewards: &[f64], values: &[f64], discount: f64, lambda: f64) -> Vec<f64> {
        let horizon = rewards.len();
        (0..horizon)
            .map(|t| {
                let k_step = |k: usize| {
                    let sum: f64 = (0..k)
                        .map(|i| discount.powi(i as i32) * rewards[t + i])
                        .sum();
                    sum + discount.powi(k as i32) * values[t + k] - values[t]
                };
                let last = horizon - t;
                let weighted: f64 = (1..last)
                    .map(|k| (1.0 - lambda) * lambda.powi(k as i32 - 1) * k_step(k))
                    .sum();
                weighted + lambda.powi(last as i32 - 1) * k_step(last)
            })
            .collect()
    }

    #[test]
    fn robust_moments_are_those_of_the_rest() {
        let rest: Vec<f64> = (0..1000).map(|i| f64::from(i % 10)).collect();
        let moments = |values: &[Vec<f64>]| {
            robust_moments(&Deal::alone(values.len()), values, 5.0).expect("alone")
        };
        let plain = moments(std::slice::from_ref(&rest));
        assert!((plain.0 - 4.5).abs() < 1e-12 && (plain.1 - 8.25_f64.sqrt()).abs() < 1e-12);
        let (mean, sigma) = moments(&[rest, vec![-1e9; 3]]);
        assert!((mean - plain.0).abs() < 0.1, "{mean}");
        assert!((sigma / plain.1 - 1.0).abs() < 0.1, "{sigma}");
        assert_eq!(moments(&[vec![2.0; 9]]), (2.0, 0.0));
    }

    proptest! {
        #[test]
        fn recursion_equals_the_definition(
            rewards in prop::collection::vec(-2.0..2.0_f64, 1..30),
            seed in 0.0..1.0_f64,
            discount in 0.5..1.0_f64,
            lambda in 0.0..1.0_f64,
        ) {
            let values: Vec<f64> = (0..=rewards.len()).map(|i| (seed * 100.0 + i as f64).sin()).collect();
            let mut advantages = Vec::new();
            generalised_advantages(&rewards, &values, discount, lambda, &mut advantages);
            for (a, b) in advantages.iter().zip(by_definition(&rewards, &values, discount, lambda)) {
                prop_assert!((a - b).abs() < 1e-10);
            }
        }

        #[test]
        fn with_lambda_one_it_is_return_minus_value(rewards in prop::collection::vec(-2.0..2.0_f64, 1..30)) {
            let values: Vec<f64> = (0..=rewards.len()).map(|i| (i as f64).cos()).collect();
            let (mut advantages, mut expected) = (Vec::new(), Vec::new());
            generalised_advantages(&rewards, &values, 0.97, 1.0, &mut advantages);
            returns(&rewards, values[rewards.len()], 0.97, &mut expected);
            for ((a, r), v) in advantages.iter().zip(expected).zip(values) {
                prop_assert!((a - (r - v)).abs() < 1e-10);
            }
        }
    }
}
