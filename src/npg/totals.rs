//! Everything an update sums over the samples of a batch.

use nalgebra::DMatrix;

use super::NpgConfig;
use super::fisher::FisherMode;
use super::gram::{self, Gram};
use crate::exploration::score_features;
use crate::policy::AffineGaussian;
use crate::rollout::Trajectory;
use crate::task::symmetry::{self, Symmetry};
use crate::team::{Deal, TeamError};

/// Means over all samples of a batch.
pub(super) struct Totals {
    /// number of samples
    pub(super) n_sample: usize,
    /// gradient, mean over all turns, from the trajectories of even and of odd index; their sum is the gradient
    pub(super) halves: [Vec<f64>; 2],
    /// `E[ψψᵀ]`, mean over all turns
    pub(super) second: DMatrix<f64>,
    /// `E[u uᵀ]`, where u is the score in units of σ; mean over all turns; with the empirical
    /// Fisher matrix only
    pub(super) outer: Option<DMatrix<f64>>,
}

impl Totals {
    /// Sum over this process's trajectories of a batch, and everyone's, with their advantages; trajectories without
    /// advantages take no part.
    ///
    /// # Errors
    /// When the processes of the team cannot reach each other.
    pub(super) fn of(
        policy: &AffineGaussian,
        deal: &Deal<'_>,
        trajectories: &[Trajectory],
        advantages: &[Vec<f64>],
        symmetries: &[Symmetry],
        config: &NpgConfig,
    ) -> Result<Self, TeamError> {
        let (width, n_parameter) = (policy.n_observation() + 1, policy.n_parameter());
        let sums = deal.halves(|lane| {
            let samples = lane
                .iter()
                .map(|&place| (&trajectories[place], advantages[place].as_slice()));
            sum_lane(policy, samples, config)
        })?;
        let mut halves = [vec![], vec![]];
        let mut grams = vec![0.0; sums[0].len() - n_parameter];
        for (half, sum) in halves.iter_mut().zip(&sums) {
            let (gradient, gram) = sum.split_at(n_parameter);
            half.extend_from_slice(gradient);
            for (total, value) in grams.iter_mut().zip(gram) {
                *total += value;
            }
        }
        let (second, outer) = grams.split_at(gram::packed_len(width));
        let (second, n_sample) = gram::unpack(width, second);
        let scale = 1.0 / n_sample as f64;
        // from sums to means, and from units of σ to weights
        let units = policy.log_sigma().iter().map(|l| scale / l.exp());
        let units: Vec<f64> = units
            .flat_map(|unit| std::iter::repeat_n(unit, width))
            .chain(policy.log_sigma().iter().map(|_| scale))
            .collect();
        for half in &mut halves {
            *half = symmetry::mean_of_parameters(symmetries, half);
            for (value, unit) in half.iter_mut().zip(&units) {
                *value *= unit;
            }
        }
        let outer = (!outer.is_empty()).then(|| gram::unpack(n_parameter, outer).0 * scale);
        let of_features = symmetries
            .iter()
            .map(|s| symmetry::with_constant(&s.observation));
        let of_scores = symmetries.iter().map(Symmetry::of_parameters);
        Ok(Self {
            n_sample,
            halves,
            second: symmetry::mean_of_moments(of_features, &(second * scale)),
            outer: outer.map(|outer| symmetry::mean_of_moments(of_scores, &outer)),
        })
    }
}

/// Sums over one lane of trajectories: Σ A u in units of σ, Σ ψψᵀ, and Σ u uᵀ if it is wanted.
fn sum_lane<'a>(
    policy: &AffineGaussian,
    lane: impl Iterator<Item = (&'a Trajectory, &'a [f64])>,
    config: &NpgConfig,
) -> Vec<f64> {
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
        for (t, (noise, advantage)) in noise.zip(advantages).enumerate() {
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
    let mut sums = gradient;
    sums.extend(second.packed());
    sums.extend(outer.into_iter().flat_map(Gram::packed));
    sums
}
