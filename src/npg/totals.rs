//! Everything an update sums over the samples of a batch.

use nalgebra::DMatrix;

use super::NpgConfig;
use super::fisher::FisherMode;
use super::gram::{self, Gram};
use crate::exploration::score_features;
use crate::policy::AffineGaussian;
use crate::rollout::Trajectory;

/// Means over all samples of a batch.
pub(super) struct Totals {
    /// number of samples
    pub(super) n_sample: usize,
    /// gradient from the trajectories of even and of odd index; their sum is the gradient
    pub(super) halves: [Vec<f64>; 2],
    /// `E[ψψᵀ]`
    pub(super) second: DMatrix<f64>,
    /// `E[u uᵀ]`, where u is the score in units of σ; with the empirical Fisher matrix only
    pub(super) outer: Option<DMatrix<f64>>,
}

/// Sums over one lane of trajectories.
struct Sums {
    gradient: Vec<f64>,            // Σ A u, in units of σ
    second: (DMatrix<f64>, usize), // Σ ψψᵀ
    outer: Option<DMatrix<f64>>,   // Σ u uᵀ
}

impl Totals {
    /// Sum over `samples`: trajectories with their advantages.
    pub(super) fn of(
        policy: &AffineGaussian,
        samples: &[(&Trajectory, &[f64])],
        config: &NpgConfig,
    ) -> Self {
        let sums = gram::lanes(samples, |lane| sum_lane(policy, lane, config));
        let n_sample: usize = sums.iter().map(|s| s.second.1).sum();
        let scale = 1.0 / n_sample as f64;
        let mut second = DMatrix::zeros(policy.n_observation() + 1, policy.n_observation() + 1);
        let mut outer: Option<DMatrix<f64>> = None;
        let mut halves = [
            vec![0.0; policy.n_parameter()],
            vec![0.0; policy.n_parameter()],
        ];
        for (lane, sum) in sums.into_iter().enumerate() {
            second += sum.second.0 * scale;
            for (total, value) in halves[lane % 2].iter_mut().zip(&sum.gradient) {
                *total += value * scale;
            }
            if let Some(lane_outer) = sum.outer {
                match &mut outer {
                    Some(total) => *total += lane_outer * scale,
                    None => outer = Some(lane_outer * scale),
                }
            }
        }
        gram::symmetrise(&mut second);
        if let Some(outer) = &mut outer {
            gram::symmetrise(outer);
        }
        // from units of σ to weights
        let sigma: Vec<f64> = policy.log_sigma().iter().map(|l| l.exp()).collect();
        for half in &mut halves {
            for (row, sigma) in half[..policy.weights().len()]
                .chunks_exact_mut(policy.n_observation() + 1)
                .zip(&sigma)
            {
                for value in row {
                    *value /= sigma;
                }
            }
        }
        Self {
            n_sample,
            halves,
            second,
            outer,
        }
    }
}

fn sum_lane(
    policy: &AffineGaussian,
    lane: &mut dyn Iterator<Item = &(&Trajectory, &[f64])>,
    config: &NpgConfig,
) -> Sums {
    let (n, n_action) = (policy.n_observation(), policy.n_action());
    let width = n + 1;
    let n_weight = width * n_action;
    let mut gradient = vec![0.0; policy.n_parameter()];
    let mut second = Gram::new(width);
    let mut outer =
        (config.fisher == FisherMode::Empirical).then(|| Gram::new(policy.n_parameter()));
    let mut features = Vec::with_capacity(width); // ψ
    for (trajectory, advantages) in lane {
        let observations: Vec<&[f64]> = trajectory.observations.chunks_exact(n).collect();
        let noise = trajectory.noise.chunks_exact(n_action);
        for (t, (noise, advantage)) in noise.zip(*advantages).enumerate() {
            features.clear();
            let previous = t.checked_sub(1).map(|p| observations[p]);
            score_features(
                observations[t],
                previous,
                config.noise_correlation,
                &mut features,
            );
            for (row, z) in gradient[..n_weight].chunks_exact_mut(width).zip(noise) {
                let factor = advantage * z;
                for (sum, feature) in row.iter_mut().zip(&features) {
                    *sum += factor * feature;
                }
            }
            for (sum, z) in gradient[n_weight..].iter_mut().zip(noise) {
                *sum += advantage * (z * z - 1.0);
            }
            second.push(|panel| panel.extend_from_slice(&features));
            if let Some(outer) = &mut outer {
                outer.push(|panel| {
                    for z in noise {
                        panel.extend(features.iter().map(|feature| z * feature));
                    }
                    panel.extend(noise.iter().map(|z| z * z - 1.0));
                });
            }
        }
    }
    Sums {
        gradient,
        second: second.finish(),
        outer: outer.map(|gram| gram.finish().0),
    }
}
