//! Normalised natural policy gradient (Lowrey et al. 2018, section III; Kakade 2001; Rajeswaran et al. 2017).
//!
//! ```text
//! g     = 1/n Σ ∇θ log π(a|s) A(s, a)                    vanilla gradient        (2)
//! F     = E[∇θ log π ∇θ log πᵀ]                          Fisher matrix           (4)
//! θ    ← θ + sqrt(δ / gᵀF⁻¹g) F⁻¹g                       normalised step         (5)
//! ```
//!
//! | symbol | name |
//! | --- | --- |
//! | δ | `step_size_delta`: the squared length of the step in the Fisher metric, **twice** its KL divergence |
//! | γ, λ | `discount`, `gae_lambda` |
//! | A | advantage, [`advantage`] |
//! | V | value function, [`baseline`] |
//! | F⁻¹g | `natural_gradient`, [`fisher`] |
//!
//! Every sum runs over trajectories in a fixed order (see `gram`), so that the result does not depend on threads.

pub mod advantage;
pub mod baseline;
pub mod fisher;
mod gram;

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::policy::AffineGaussian;
use crate::rollout::Trajectory;
use crate::task::ObservationGroup;
use baseline::{Baseline, FitReport, Target};
use fisher::{Fisher, FisherMode};
use gram::Gram;

/// Which value function the advantages are computed with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ValueFrom {
    /// the one fitted in the last iteration, as in the paper
    Previous,
    /// fitted to the other half of this iteration's trajectories: current, and independent of the sample
    Crossed,
}

/// Settings of the update.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NpgConfig {
    /// γ per control step
    pub discount: f64,
    /// λ per control step
    pub gae_lambda: f64,
    /// δ, twice the KL divergence of a step
    pub step_size_delta: f64,
    /// `exact` or `empirical`
    pub fisher: FisherMode,
    /// damping of the standardised Fisher matrix, relative to its diagonal
    pub fisher_damping: f64,
    /// advantages are clipped at this many standard deviations
    pub advantage_clip: f64,
    /// `crossed` or `previous`
    pub value_from: ValueFrom,
    /// ridge of the value fit, per sample
    pub value_ridge: f64,
    /// every how many-th sample the value function is fitted to
    pub value_stride: usize,
    /// log σ of the initial policy, log N m
    pub initial_log_sigma: f64,
    /// log σ is held at or above this, log N m
    pub log_sigma_floor: f64,
}

impl Default for NpgConfig {
    fn default() -> Self {
        Self {
            discount: 0.98,
            gae_lambda: 0.95,
            step_size_delta: 0.05,
            fisher: FisherMode::Exact,
            fisher_damping: 1e-4,
            advantage_clip: 5.0,
            value_from: ValueFrom::Crossed,
            value_ridge: 1e-4,
            value_stride: 4,
            initial_log_sigma: -1.6,
            log_sigma_floor: -2.2,
        }
    }
}

impl NpgConfig {
    /// Check all ranges; returns key, value and expectation of the first that is wrong.
    ///
    /// # Errors
    /// [`NpgError::Setting`].
    pub fn validate(&self) -> Result<(), NpgError> {
        let setting = |key, value: f64, ok: bool, expected| {
            if ok { Ok(()) } else { Err(NpgError::Setting { key, value, expected }) }
        };
        let unit = |x: f64| (0.0..=1.0).contains(&x);
        let positive = |x: f64| x.is_finite() && x > 0.0;
        setting("npg.discount", self.discount, unit(self.discount), "0 to 1")?;
        setting("npg.gae_lambda", self.gae_lambda, unit(self.gae_lambda), "0 to 1")?;
        for (key, value) in [
            ("npg.step_size_delta", self.step_size_delta),
            ("npg.fisher_damping", self.fisher_damping),
            ("npg.advantage_clip", self.advantage_clip),
            ("npg.value_ridge", self.value_ridge),
        ] {
            setting(key, value, positive(value), "a positive number")?;
        }
        setting("npg.value_stride", self.value_stride as f64, self.value_stride > 0, "at least 1")?;
        for (key, value) in
            [("npg.initial_log_sigma", self.initial_log_sigma), ("npg.log_sigma_floor", self.log_sigma_floor)]
        {
            setting(key, value, (-20.0..=20.0).contains(&value), "-20 to 20")?;
        }
        Ok(())
    }
}

/// Why an update could not be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum NpgError {
    /// A setting is out of range.
    #[error("`{key}` is {value}, expected {expected}")]
    Setting {
        /// configuration key
        key: &'static str,
        /// found
        value: f64,
        /// accepted range
        expected: &'static str,
    },
    /// No trajectory of the batch can be used.
    #[error("all {n_trajectory} trajectories diverged")]
    NoTrajectory {
        /// size of the batch
        n_trajectory: usize,
    },
    /// The metric could not be factored.
    #[error("the Fisher matrix is not positive definite or not finite")]
    Fisher,
    /// gᵀF⁻¹g must be positive; anything else is a defect or non-finite data, and is not masked.
    #[error("the squared length of the natural gradient is {value}, expected a positive number")]
    Gradient {
        /// gᵀF⁻¹g
        value: f64,
    },
}

/// What an update did.
#[derive(Debug, Clone, PartialEq)]
pub struct UpdateReport {
    /// samples in the gradient
    pub n_sample: usize,
    /// gᵀF⁻¹g
    pub gradient_norm2: f64,
    /// δ / 2
    pub kl_predicted: f64,
    /// KL(old ‖ new) of the step, averaged over the batch, closed form
    pub kl_measured: f64,
    /// cosine in the Fisher metric between the natural gradients of even and odd trajectories
    pub half_cosine: f64,
    /// the same, over the weights of each observation group alone
    pub group_cosines: Vec<(&'static str, f64)>,
    /// standard deviation of the advantages before they are normalised
    pub advantage_sigma: f64,
    /// share of advantages that were clipped
    pub clipped_share: f64,
    /// quality of the value function; `None`: too few samples, the old one was kept
    pub value_fit: Option<FitReport>,
}

/// Sums over one lane of trajectories.
struct Sums {
    gradient: Vec<f64>,     // Σ A u, in units of σ
    second: (DMatrix<f64>, usize), // Σ φφᵀ
    outer: Option<DMatrix<f64>>,   // Σ u uᵀ
}

/// An update and what it was computed from.
#[derive(Debug, Clone)]
pub struct Update {
    /// the policy after the step
    pub policy: AffineGaussian,
    /// the value functions fitted to the batch; `None`: too few samples
    pub fit: Option<baseline::Fit>,
    /// normalised and clipped advantages of every usable trajectory
    pub advantages: Vec<Vec<f64>>,
    /// g, in the order of [`AffineGaussian::parameters`]
    pub gradient: Vec<f64>,
    /// F⁻¹g
    pub natural_gradient: Vec<f64>,
    /// summary
    pub report: UpdateReport,
}

/// One update of `policy` and `baseline` from a batch.
///
/// # Errors
/// When the batch has no usable trajectory or the step is not defined; policy and baseline are then unchanged.
pub fn update(
    policy: &mut AffineGaussian,
    baseline: &mut Baseline,
    batch: &[Trajectory],
    horizon: usize,
    groups: &[ObservationGroup],
    config: &NpgConfig,
) -> Result<UpdateReport, NpgError> {
    let update = compute(policy, baseline, batch, horizon, groups, config)?;
    *policy = update.policy;
    if let Some(fit) = update.fit {
        *baseline = fit.all;
    }
    Ok(update.report)
}

/// The update of `policy` from a batch, with the value function `baseline` of the last one.
///
/// # Errors
/// When the batch has no usable trajectory or the step is not defined.
pub fn compute(
    policy: &AffineGaussian,
    baseline: &Baseline,
    batch: &[Trajectory],
    horizon: usize,
    groups: &[ObservationGroup],
    config: &NpgConfig,
) -> Result<Update, NpgError> {
    let usable: Vec<&Trajectory> = batch.iter().filter(|t| t.diverged.is_none() && !t.is_empty()).collect();
    if usable.is_empty() {
        return Err(NpgError::NoTrajectory { n_trajectory: batch.len() });
    }

    // value function and advantages
    let fit = fit_baseline(baseline, &usable, horizon, config);
    let mut advantages = advantages(baseline, fit.as_ref(), &usable, horizon, config);
    let (advantage_sigma, clipped_share) = normalise(&mut advantages, config.advantage_clip);

    // gradient and metric
    let n_weight = policy.weights().len();
    let samples: Vec<(&Trajectory, &[f64])> =
        usable.iter().copied().zip(advantages.iter().map(Vec::as_slice)).collect();
    let sums = gram::lanes(&samples, |lane| sum_lane(policy, lane, config.fisher));
    let n_sample: usize = sums.iter().map(|s| s.second.1).sum();
    let scale = 1.0 / n_sample as f64;
    let mut second = DMatrix::zeros(policy.n_observation() + 1, policy.n_observation() + 1);
    let mut outer: Option<DMatrix<f64>> = None;
    let mut halves = [vec![0.0; policy.n_parameter()], vec![0.0; policy.n_parameter()]];
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
    // from units of σ to weights
    let sigma: Vec<f64> = policy.log_sigma().iter().map(|l| l.exp()).collect();
    for half in &mut halves {
        for (row, sigma) in half[..n_weight].chunks_exact_mut(policy.n_observation() + 1).zip(&sigma) {
            for value in row {
                *value /= sigma;
            }
        }
    }
    let fisher = match outer {
        None => Fisher::exact(&second, policy.log_sigma(), config.fisher_damping),
        Some(mut outer) => {
            gram::symmetrise(&mut outer);
            Fisher::empirical(&outer, &second, policy.log_sigma(), config.fisher_damping)
        }
    }
    .ok_or(NpgError::Fisher)?;

    // the step
    let natural = [fisher.solve(&halves[0]), fisher.solve(&halves[1])];
    let gradient: Vec<f64> = halves[0].iter().zip(&halves[1]).map(|(a, b)| a + b).collect();
    let natural_gradient: Vec<f64> = natural[0].iter().zip(&natural[1]).map(|(a, b)| a + b).collect();
    let gradient_norm2 = dot(&gradient, &natural_gradient);
    if !(gradient_norm2.is_finite() && gradient_norm2 > 0.0) {
        return Err(NpgError::Gradient { value: gradient_norm2 });
    }
    let cosine = |columns: std::ops::Range<usize>| {
        let inner = |i: usize, j: usize| fisher.inner(&natural[i], &natural[j], columns.clone());
        inner(0, 1) / (inner(0, 0) * inner(1, 1)).sqrt()
    };
    let (kl_measured, next) = step(policy, &natural_gradient, gradient_norm2, &second, config);

    let report = UpdateReport {
        n_sample,
        gradient_norm2,
        kl_predicted: 0.5 * config.step_size_delta,
        kl_measured,
        half_cosine: cosine(0..policy.n_observation()),
        group_cosines: groups.iter().map(|g| (g.name, cosine(g.columns.clone()))).collect(),
        advantage_sigma,
        clipped_share,
        value_fit: fit.as_ref().map(|f| f.report),
    };
    Ok(Update { policy: next, fit, advantages, gradient, natural_gradient, report })
}

/// Fit value functions to the returns of `usable`; `None` when there are too few samples.
fn fit_baseline(
    baseline: &Baseline,
    usable: &[&Trajectory],
    horizon: usize,
    config: &NpgConfig,
) -> Option<baseline::Fit> {
    let n_observation = usable[0].final_observation.len();
    let returns = per_trajectory(usable, |trajectory| {
        let (mut last, mut returns) = (Vec::new(), Vec::new());
        baseline.values(&trajectory.final_observation, trajectory.len(), horizon, &mut last);
        advantage::returns(&trajectory.rewards, last[0], config.discount, &mut returns);
        returns
    });
    let targets: Vec<Target<'_>> = usable
        .iter()
        .zip(&returns)
        .map(|(trajectory, returns)| Target { observations: &trajectory.observations, returns })
        .collect();
    baseline::fit(&targets, n_observation, horizon, config.value_stride, config.value_ridge)
}

/// Generalised advantages of every trajectory.
fn advantages(
    previous: &Baseline,
    fit: Option<&baseline::Fit>,
    usable: &[&Trajectory],
    horizon: usize,
    config: &NpgConfig,
) -> Vec<Vec<f64>> {
    let numbered: Vec<(usize, &Trajectory)> = usable.iter().copied().enumerate().collect();
    per_trajectory(&numbered, |(index, trajectory)| {
        let value = match (config.value_from, fit) {
            (ValueFrom::Crossed, Some(fit)) => &fit.crossed[index % 2],
            _ => previous,
        };
        let (mut values, mut advantages) = (Vec::with_capacity(trajectory.len() + 1), Vec::new());
        value.values(&trajectory.observations, 0, horizon, &mut values);
        value.values(&trajectory.final_observation, trajectory.len(), horizon, &mut values);
        advantage::generalised_advantages(
            &trajectory.rewards,
            &values,
            config.discount,
            config.gae_lambda,
            &mut advantages,
        );
        advantages
    })
}

/// Apply `work` to every item on all threads, results in order.
fn per_trajectory<T: Sync, R: Send>(items: &[T], work: impl Fn(&T) -> R + Sync + Send) -> Vec<R> {
    use rayon::prelude::*;
    items.par_iter().map(work).collect()
}

/// Bring advantages to mean 0 and standard deviation 1 over the batch, clipped; returns the old standard deviation and
/// the clipped share.
fn normalise(advantages: &mut [Vec<f64>], clip: f64) -> (f64, f64) {
    let count = advantages.iter().map(Vec::len).sum::<usize>() as f64;
    let mean = advantages.iter().flatten().sum::<f64>() / count;
    let variance = advantages.iter().flatten().map(|a| (a - mean).powi(2)).sum::<f64>() / count;
    let sigma = variance.sqrt();
    let inverse = if sigma > 0.0 { 1.0 / sigma } else { 0.0 };
    let mut clipped = 0_usize;
    for a in advantages.iter_mut().flatten() {
        *a = (*a - mean) * inverse;
        if a.abs() > clip {
            *a = clip.copysign(*a);
            clipped += 1;
        }
    }
    (sigma, clipped as f64 / count)
}

fn sum_lane(
    policy: &AffineGaussian,
    lane: &mut dyn Iterator<Item = &(&Trajectory, &[f64])>,
    mode: FisherMode,
) -> Sums {
    let (n, n_action) = (policy.n_observation(), policy.n_action());
    let width = n + 1;
    let n_weight = width * n_action;
    let mut gradient = vec![0.0; policy.n_parameter()];
    let mut second = Gram::new(width);
    let mut outer = (mode == FisherMode::Empirical).then(|| Gram::new(policy.n_parameter()));
    for (trajectory, advantages) in lane {
        let rows = trajectory.observations.chunks_exact(n).zip(trajectory.noise.chunks_exact(n_action));
        for ((observation, noise), advantage) in rows.zip(*advantages) {
            for (row, z) in gradient[..n_weight].chunks_exact_mut(width).zip(noise) {
                let factor = advantage * z;
                for (sum, s) in row.iter_mut().zip(observation) {
                    *sum += factor * s;
                }
                row[n] += factor;
            }
            for (sum, z) in gradient[n_weight..].iter_mut().zip(noise) {
                *sum += advantage * (z * z - 1.0);
            }
            second.push(|panel| {
                panel.extend_from_slice(observation);
                panel.push(1.0);
            });
            if let Some(outer) = &mut outer {
                outer.push(|panel| {
                    for z in noise {
                        panel.extend(observation.iter().map(|s| z * s));
                        panel.push(*z);
                    }
                    panel.extend(noise.iter().map(|z| z * z - 1.0));
                });
            }
        }
    }
    Sums { gradient, second: second.finish(), outer: outer.map(|gram| gram.finish().0) }
}

/// The policy one normalised step along `direction`, and the KL divergence of the step. The step is halved while that is
/// over twice the predicted one, which the change of σ can cause. A σ that is below its floor beforehand is raised to
/// it first: that is no part of the step, and no shorter step would make it any smaller.
fn step(
    policy: &AffineGaussian,
    direction: &[f64],
    gradient_norm2: f64,
    second: &DMatrix<f64>,
    config: &NpgConfig,
) -> (f64, AffineGaussian) {
    let mut policy = policy.clone();
    policy.raise_log_sigma(config.log_sigma_floor);
    let theta = policy.parameters();
    let mut length = (config.step_size_delta / gradient_norm2).sqrt();
    loop {
        let mut next = policy.clone();
        let moved: Vec<f64> = theta.iter().zip(direction).map(|(t, d)| t + length * d).collect();
        if next.set_parameters(&moved).is_ok() {
            next.raise_log_sigma(config.log_sigma_floor);
            let kl = kl_divergence(&policy, &next, second);
            if kl <= config.step_size_delta {
                return (kl, next);
            }
        }
        length *= 0.5;
    }
}

/// KL(old ‖ new) averaged over observations with second moment `second`.
pub fn kl_divergence(old: &AffineGaussian, new: &AffineGaussian, second: &DMatrix<f64>) -> f64 {
    let width = second.nrows();
    let rows = old.weights().chunks_exact(width).zip(new.weights().chunks_exact(width));
    let sigmas = old.log_sigma().iter().zip(new.log_sigma());
    rows.zip(sigmas)
        .map(|((a, b), (l, m))| {
            let change = nalgebra::DVector::from_iterator(width, b.iter().zip(a).map(|(b, a)| b - a));
            let shift = change.dot(&(second * &change)); // E[(μ' - μ)²]
            m - l + ((2.0 * l).exp() + shift) / (2.0 * (2.0 * m).exp()) - 0.5
        })
        .sum()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Trajectories of one action without dynamics, rewarded for a = s.
    fn batch(policy: &AffineGaussian) -> Vec<Trajectory> {
        let mut rng = crate::rng::stream(1, crate::rng::Purpose::Exploration, 0, 0);
        let mut trajectory = |_| {
            let mut t = Trajectory { final_observation: vec![0.0], ..Trajectory::default() };
            for _ in 0..20 {
                let s = crate::rng::uniform(&mut rng, -1.0, 1.0);
                let (mut action, mut noise) = ([0.0], [0.0]);
                policy.sample(&[s], &mut rng, &mut action, &mut noise);
                t.observations.push(s);
                t.noise.extend(noise);
                t.rewards.push(-(action[0] - s).powi(2));
            }
            t
        };
        (0..20).map(&mut trajectory).collect()
    }

    #[test]
    fn a_sigma_far_below_its_floor_is_raised_and_the_step_still_made() {
        let mut policy = AffineGaussian::zeros(1, 1, -4.0);
        let batch = batch(&policy);
        let config = NpgConfig { log_sigma_floor: -1.0, ..NpgConfig::default() };
        let report = update(&mut policy, &mut Baseline::zero(1), &batch, 20, &[], &config).expect("an update");
        assert!(report.kl_measured > 0.0 && report.kl_measured <= config.step_size_delta);
        assert!(policy.log_sigma()[0] >= -1.0);
        assert!(policy.weights()[0] > 0.0, "towards a = s");
    }
}
