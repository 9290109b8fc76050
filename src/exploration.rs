//! Exploration noise that lasts longer than one control step, and its exact score.
//!
//! White torque noise hardly moves an object that rests on the table: its effect averages out before static friction
//! gives way. The deviation from the mean action is therefore an autoregressive process with the same spread at all
//! times,
//!
//! ```text
//! a_t = μ(s_t) + ε_t,   ε_0 = σ z_0,   ε_t = ρ ε_{t-1} + σ sqrt(1 - ρ²) z_t,   z_t ~ N(0, 1)
//! ```
//!
//! so that given the past, `a_t` is Gaussian with mean `μ(s_t) + ρ (a_{t-1} - μ(s_{t-1}))` and standard
//! deviation `σ sqrt(1 - ρ²)`. For an affine mean the score of the weights is then exactly
//!
//! ```text
//! ∂ log π(a_t | past) / ∂ (W b)_ij = z_i ψ_j / σ_i,    ψ_t = (φ_t - ρ φ_{t-1}) / sqrt(1 - ρ²),   ψ_0 = φ_0
//! ```
//!
//! with φ = (s, 1): everything else of the natural gradient stays as it is, with ψ in the place of φ. ρ = 0 is white
//! noise, the paper's policy. An action now works for about (1 + ρ) / (1 - ρ) steps, and the variance of the gradient
//! falls by that factor in directions where the observation changes slowly. Autoregressive policies: Korenkevych et al.
//! 2019 (arXiv 1903.11524), first order.

use crate::rng::{self, Stream};

/// The deviation ε of one trajectory.
#[derive(Debug, Clone)]
pub struct Exploration {
    correlation: f64,    // ρ
    deviation: Vec<f64>, // (n_action) ε / σ
    started: bool,
}

impl Exploration {
    /// Noise of `n_action` actions with correlation ρ, 0 ≤ ρ < 1, between neighbouring steps.
    pub fn new(n_action: usize, correlation: f64) -> Self {
        Self {
            correlation,
            deviation: vec![0.0; n_action],
            started: false,
        }
    }

    /// Draw z of the next step into `noise` and add ε to `action`.
    pub fn perturb(
        &mut self,
        log_sigma: &[f64],
        rng: &mut Stream,
        action: &mut [f64],
        noise: &mut [f64],
    ) {
        let (keep, fresh) = if self.started {
            (self.correlation, (1.0 - self.correlation.powi(2)).sqrt())
        } else {
            (0.0, 1.0)
        };
        self.started = true;
        for (((a, z), l), deviation) in action
            .iter_mut()
            .zip(noise)
            .zip(log_sigma)
            .zip(&mut self.deviation)
        {
            *z = rng::normal(rng);
            *deviation = keep * *deviation + fresh * *z;
            *a += l.exp() * *deviation;
        }
    }
}

/// Append ψ of an observation that follows `previous` (`None` at the start of a trajectory).
pub fn score_features(
    observation: &[f64],
    previous: Option<&[f64]>,
    correlation: f64,
    features: &mut Vec<f64>,
) {
    match previous {
        None => {
            features.extend_from_slice(observation);
            features.push(1.0);
        }
        Some(previous) => {
            let scale = 1.0 / (1.0 - correlation * correlation).sqrt();
            features.extend(
                observation
                    .iter()
                    .zip(previous)
                    .map(|(s, p)| scale * (s - correlation * p)),
            );
            features.push(scale * (1.0 - correlation));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::AffineGaussian;
    use crate::rng::{Purpose, stream};

    #[test]
    fn spread_and_correlation_are_as_asked() {
        let (rho, n) = (0.6, 40_000);
        let mut exploration = Exploration::new(1, rho);
        let mut rng = stream(1, Purpose::Exploration, 0, 0);
        let (mut square, mut product, mut last) = (0.0, 0.0, 0.0);
        for _ in 0..n {
            let mut action = [0.0];
            exploration.perturb(&[0.5_f64.ln()], &mut rng, &mut action, &mut [0.0]);
            square += action[0] * action[0];
            product += action[0] * last;
            last = action[0];
        }
        assert!((square / f64::from(n) - 0.25).abs() < 0.01);
        assert!((product / square - rho).abs() < 0.02);
    }

    /// The density of a whole trajectory of actions, from its definition, differentiated numerically.
    #[test]
    fn score_equals_differences_of_the_log_density() {
        let (rho, horizon, n, m) = (0.7, 5, 3, 2);
        let mut rng = stream(3, Purpose::Exploration, 0, 0);
        let mut policy = AffineGaussian::zeros(n, m, -0.4);
        let theta: Vec<f64> = policy
            .parameters()
            .iter()
            .map(|l| l + 0.3 * rng::normal(&mut rng))
            .collect();
        policy.set_parameters(&theta).expect("finite");
        let states: Vec<Vec<f64>> = (0..horizon)
            .map(|_| (0..n).map(|_| rng::normal(&mut rng)).collect())
            .collect();
        let mut exploration = Exploration::new(m, rho);
        let mut actions = vec![vec![0.0; m]; horizon];
        let mut noise = vec![vec![0.0; m]; horizon];
        for t in 0..horizon {
            policy.mean(&states[t], &mut actions[t]);
            exploration.perturb(policy.log_sigma(), &mut rng, &mut actions[t], &mut noise[t]);
        }
        let log_density = |theta: &[f64]| {
            let mut policy = policy.clone();
            policy.set_parameters(theta).expect("finite");
            let deviation = |t: usize, i: usize| {
                let mut mean = vec![0.0; m];
                policy.mean(&states[t], &mut mean);
                actions[t][i] - mean[i]
            };
            let mut sum = 0.0;
            for t in 0..horizon {
                for i in 0..m {
                    let sigma = policy.log_sigma()[i].exp();
                    let (mean, spread) = if t == 0 {
                        (0.0, sigma)
                    } else {
                        (rho * deviation(t - 1, i), sigma * (1.0 - rho * rho).sqrt())
                    };
                    sum += -0.5 * ((deviation(t, i) - mean) / spread).powi(2) - spread.ln();
                }
            }
            sum
        };
        let mut score = vec![0.0; theta.len()];
        for t in 0..horizon {
            let mut features = Vec::new();
            score_features(
                &states[t],
                t.checked_sub(1).map(|p| states[p].as_slice()),
                rho,
                &mut features,
            );
            for i in 0..m {
                for (j, feature) in features.iter().enumerate() {
                    score[i * (n + 1) + j] += noise[t][i] * feature / policy.log_sigma()[i].exp();
                }
                score[m * (n + 1) + i] += noise[t][i].powi(2) - 1.0;
            }
        }
        for (k, expected) in score.iter().enumerate() {
            let step = 1e-5;
            let (mut up, mut down) = (theta.clone(), theta.clone());
            up[k] += step;
            down[k] -= step;
            let difference = (log_density(&up) - log_density(&down)) / (2.0 * step);
            assert!(
                (difference - expected).abs() < 1e-6 * (1.0 + expected.abs()),
                "{k}: {difference} {expected}"
            );
        }
    }
}
