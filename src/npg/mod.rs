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
mod step;
mod totals;

pub use step::kl_divergence;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::policy::AffineGaussian;
use crate::rollout::Trajectory;
use crate::task::ObservationGroup;
use baseline::{Baseline, FitReport, Target};
use fisher::{Fisher, FisherMode};
use step::step;
use totals::Totals;

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
    /// δ at the end of the annealing, approached geometrically
    pub final_step_size_delta: f64,
    /// ceiling of log σ at the end of the annealing, approached linearly from `initial_log_sigma`, log N m
    pub final_log_sigma: f64,
    /// iterations over which δ and the ceiling of log σ go to their final values; 0: they stay
    pub anneal_iterations: u64,
    /// `exact` or `empirical`
    pub fisher: FisherMode,
    /// damping of the standardised Fisher matrix, relative to its diagonal
    pub fisher_damping: f64,
    /// advantages are clipped at this many standard deviations, and so are the targets of the value fit (not below 3
    /// there); the standard deviations are those after clipping
    pub advantage_clip: f64,
    /// `crossed` or `previous`
    pub value_from: ValueFrom,
    /// ridge of the value fit, per sample
    pub value_ridge: f64,
    /// every how many-th sample the value function is fitted to
    pub value_stride: usize,
    /// ρ, correlation of the exploration noise between control steps; 0: white noise, as in the paper
    pub noise_correlation: f64,
    /// log σ of the initial policy, log N m
    pub initial_log_sigma: f64,
    /// log σ is held at or above this, log N m
    pub log_sigma_floor: f64,
}

impl Default for NpgConfig {
    fn default() -> Self {
        Self {
            discount: 0.98,
            gae_lambda: 0.9,
            step_size_delta: 0.1,
            final_step_size_delta: 0.04,
            final_log_sigma: -2.4,
            anneal_iterations: 80,
            fisher: FisherMode::Exact,
            fisher_damping: 0.1,
            advantage_clip: 5.0,
            value_from: ValueFrom::Crossed,
            value_ridge: 1e-4,
            value_stride: 4,
            noise_correlation: 0.85,
            initial_log_sigma: -1.5,
            log_sigma_floor: -3.0,
        }
    }
}

impl NpgConfig {
    /// δ and the ceiling of log σ of an iteration, counted from 0.
    pub fn annealed(&self, iteration: u64) -> (f64, f64) {
        if self.anneal_iterations == 0 {
            return (self.step_size_delta, f64::INFINITY);
        }
        let share = (iteration as f64 / self.anneal_iterations as f64).min(1.0);
        let delta =
            self.step_size_delta * (self.final_step_size_delta / self.step_size_delta).powf(share);
        (
            delta,
            self.initial_log_sigma + share * (self.final_log_sigma - self.initial_log_sigma),
        )
    }

    /// Check all ranges; returns key, value and expectation of the first that is wrong.
    ///
    /// # Errors
    /// [`NpgError::Setting`].
    pub fn validate(&self) -> Result<(), NpgError> {
        let setting = |key, value: f64, ok: bool, expected| {
            if ok {
                Ok(())
            } else {
                Err(NpgError::Setting {
                    key,
                    value,
                    expected,
                })
            }
        };
        let unit = |x: f64| (0.0..=1.0).contains(&x);
        let positive = |x: f64| x.is_finite() && x > 0.0;
        setting("npg.discount", self.discount, unit(self.discount), "0 to 1")?;
        setting(
            "npg.gae_lambda",
            self.gae_lambda,
            unit(self.gae_lambda),
            "0 to 1",
        )?;
        for (key, value) in [
            ("npg.step_size_delta", self.step_size_delta),
            ("npg.final_step_size_delta", self.final_step_size_delta),
            ("npg.fisher_damping", self.fisher_damping),
            ("npg.advantage_clip", self.advantage_clip),
            ("npg.value_ridge", self.value_ridge),
        ] {
            setting(key, value, positive(value), "a positive number")?;
        }
        let rho = self.noise_correlation;
        setting(
            "npg.noise_correlation",
            rho,
            (0.0..1.0).contains(&rho),
            "at least 0 and below 1",
        )?;
        setting(
            "npg.value_stride",
            self.value_stride as f64,
            self.value_stride > 0,
            "at least 1",
        )?;
        for (key, value) in [
            ("npg.initial_log_sigma", self.initial_log_sigma),
            ("npg.log_sigma_floor", self.log_sigma_floor),
        ] {
            setting(key, value, (-20.0..=20.0).contains(&value), "-20 to 20")?;
        }
        setting(
            "npg.initial_log_sigma",
            self.initial_log_sigma,
            self.initial_log_sigma >= self.log_sigma_floor,
            "at least `npg.log_sigma_floor`",
        )?;
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
    /// KL(old ‖ new) averaged over the batch, closed form
    pub kl_measured: f64,
    /// cosine in the Fisher metric between the natural gradients of even and odd trajectories; not a number when one of
    /// them is zero
    pub half_cosine: f64,
    /// the same, over the weights of each observation group alone
    pub group_cosines: Vec<(&'static str, f64)>,
    /// standard deviation of the advantages before they are normalised, outliers clipped
    pub advantage_sigma: f64,
    /// share of advantages that were clipped
    pub clipped_share: f64,
    /// quality of the value function; `None`: too few samples, the old one was kept
    pub value_fit: Option<FitReport>,
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
    let usable: Vec<&Trajectory> = batch
        .iter()
        .filter(|t| t.diverged.is_none() && !t.is_empty())
        .collect();
    if usable.is_empty() {
        return Err(NpgError::NoTrajectory {
            n_trajectory: batch.len(),
        });
    }

    // value function and advantages
    let fit = fit_baseline(baseline, &usable, horizon, config);
    let mut advantages = advantages(baseline, fit.as_ref(), &usable, horizon, config);
    let (advantage_sigma, clipped_share) = normalise(&mut advantages, config.advantage_clip);

    // gradient and metric
    let samples: Vec<(&Trajectory, &[f64])> = usable
        .iter()
        .copied()
        .zip(advantages.iter().map(Vec::as_slice))
        .collect();
    let Totals {
        n_sample,
        halves,
        second,
        outer,
    } = Totals::of(policy, &samples, config);
    let fisher = match outer {
        None => Fisher::exact(&second, policy.log_sigma(), config.fisher_damping),
        Some(outer) => {
            Fisher::empirical(&outer, &second, policy.log_sigma(), config.fisher_damping)
        }
    }
    .ok_or(NpgError::Fisher)?;

    // the step
    let natural = [fisher.solve(&halves[0]), fisher.solve(&halves[1])];
    let gradient: Vec<f64> = halves[0]
        .iter()
        .zip(&halves[1])
        .map(|(a, b)| a + b)
        .collect();
    let direction: Vec<f64> = natural[0]
        .iter()
        .zip(&natural[1])
        .map(|(a, b)| a + b)
        .collect();
    let gradient_norm2 = dot(&gradient, &direction);
    if !(gradient_norm2.is_finite() && gradient_norm2 > 0.0) {
        return Err(NpgError::Gradient {
            value: gradient_norm2,
        });
    }
    let cosine = |columns: std::ops::Range<usize>| {
        let inner = |i: usize, j: usize| fisher.inner(&natural[i], &natural[j], columns.clone());
        inner(0, 1) / (inner(0, 0) * inner(1, 1)).sqrt()
    };
    let (kl_measured, next) = step(policy, &direction, gradient_norm2, &second, config);

    let report = UpdateReport {
        n_sample,
        gradient_norm2,
        kl_predicted: 0.5 * config.step_size_delta,
        kl_measured,
        half_cosine: cosine(0..policy.n_observation()),
        group_cosines: groups
            .iter()
            .map(|g| (g.name, cosine(g.columns.clone())))
            .collect(),
        advantage_sigma,
        clipped_share,
        value_fit: fit.as_ref().map(|f| f.report),
    };
    Ok(Update {
        policy: next,
        fit,
        advantages,
        gradient,
        natural_gradient: direction,
        report,
    })
}

/// Fit value functions to the returns of `usable`; `None` when there are too few samples.
fn fit_baseline(
    baseline: &Baseline,
    usable: &[&Trajectory],
    horizon: usize,
    config: &NpgConfig,
) -> Option<baseline::Fit> {
    let n_input = baseline.n_input();
    let mut returns = per_trajectory(usable, |trajectory| {
        let (mut last, mut returns) = (Vec::new(), Vec::new());
        let end = &trajectory.value_inputs[trajectory.len() * n_input..];
        baseline.values(end, trajectory.len(), horizon, &mut last);
        advantage::returns(&trajectory.rewards, last[0], config.discount, &mut returns);
        returns
    });
    // the object flung off the table once must not bend the value of every other state
    let clip = config.advantage_clip.max(advantage::MIN_CLIP);
    let (mean, sigma) = advantage::robust_moments(&returns, clip);
    for value in returns.iter_mut().flatten() {
        *value = value.max(mean - clip * sigma).min(mean + clip * sigma);
    }
    let targets: Vec<Target<'_>> = usable
        .iter()
        .zip(&returns)
        .map(|(trajectory, returns)| Target {
            inputs: &trajectory.value_inputs,
            returns,
        })
        .collect();
    baseline::fit(
        &targets,
        n_input,
        horizon,
        config.value_stride,
        config.value_ridge,
    )
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
        value.values(&trajectory.value_inputs, 0, horizon, &mut values);
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
    let (mean, sigma) = advantage::robust_moments(advantages, clip);
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

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

#[cfg(test)]
mod tests;
