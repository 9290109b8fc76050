//! Returns and advantages of one trajectory that was cut off at the horizon (none of the tasks here ends by itself).
//!
//! ```text
//! δ_t = r_t + γ V(s_{t+1}) - V(s_t),        s_T: the true state after the last action
//! A_t = δ_t + γ λ A_{t+1},  A_T = 0          (Schulman et al. 2016, equation 16, truncated)
//! R_t = r_t + γ R_{t+1},    R_T = V(s_T)     target of the value fit
//! ```

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
