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
//! With `epopt_epsilon` below 1 the step is made for the worst trajectories alone, that is for the models of the ensemble
//! that are hardest to live with (Rajeswaran, Ghotra, Ravindran, Levine 2017, *`EPOpt`*, algorithm 1): gradient, Fisher
//! matrix and advantages are those of the share ε with the lowest mean reward. The value function is fitted to all.
//!
//! Where task and policy are the same after every turn of [`Known::symmetries`], g and F are the means over all turns, and
//! the value function is fitted to what every sample looks like after each: as if all trajectories had been turned too.
//!
//! Every sum over trajectories runs in a fixed order and over all processes (see [`crate::team`]), so that the result
//! depends neither on threads nor on processes.

pub mod advantage;
pub mod baseline;
mod config;
pub mod fisher;
mod gram;
mod step;
mod totals;

pub use config::{NpgConfig, ValueFrom};
pub use step::kl_divergence;

use thiserror::Error;

use crate::policy::AffineGaussian;
use crate::rollout::Trajectory;
use crate::task::ObservationGroup;
use crate::task::symmetry::Symmetry;
use crate::team::{Deal, TeamError};
use baseline::{Baseline, FitReport, Target};
use fisher::Fisher;
use step::step;
use totals::Totals;

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
    /// The processes of the team could not add up.
    #[error(transparent)]
    Team(#[from] TeamError),
}

/// What is known of the task whose trajectories an update is made from.
#[derive(Debug, Clone, Copy)]
pub struct Known<'a> {
    /// control steps of a trajectory
    pub horizon: usize,
    /// what observations mean, for diagnostics
    pub groups: &'a [ObservationGroup],
    /// turns that change neither the task nor the policy
    pub symmetries: &'a [Symmetry],
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
    /// normalised and clipped advantages of this process's trajectories; none for those that take no part
    pub advantages: Vec<Vec<f64>>,
    /// g, in the order of [`AffineGaussian::parameters`]
    pub gradient: Vec<f64>,
    /// F⁻¹g
    pub natural_gradient: Vec<f64>,
    /// summary
    pub report: UpdateReport,
}

/// One update of `policy` and `baseline` from a batch, of which `batch` holds this process's trajectories as `deal` has
/// dealt them.
///
/// # Errors
/// When the batch has no usable trajectory or the step is not defined; policy and baseline are then unchanged.
pub fn update(
    policy: &mut AffineGaussian,
    baseline: &mut Baseline,
    batch: &[Trajectory],
    deal: &Deal<'_>,
    known: &Known<'_>,
    config: &NpgConfig,
) -> Result<UpdateReport, NpgError> {
    let update = compute(policy, baseline, batch, deal, known, config)?;
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
    deal: &Deal<'_>,
    known: &Known<'_>,
    config: &NpgConfig,
) -> Result<Update, NpgError> {
    let [n_trajectory, n_usable] =
        deal.totals(|place| [1.0, f64::from(u8::from(is_usable(&batch[place])))])?;
    if n_usable == 0.0 {
        return Err(NpgError::NoTrajectory {
            n_trajectory: n_trajectory as usize,
        });
    }

    // value function and advantages
    let fit = fit_baseline(baseline, batch, deal, known, config)?;
    let limit = worst(batch, deal, n_usable, config.epopt_epsilon)?;
    let takes_part = |t: &Trajectory| is_usable(t) && t.mean_reward() <= limit;
    let fitted = match config.value_from {
        ValueFrom::Crossed => fit.as_ref().map(|fit| &fit.crossed),
        ValueFrom::Previous => None,
    };
    let mut advantages = per_trajectory(batch, |place, trajectory| {
        let value = fitted.map_or(baseline, |crossed| &crossed[deal.mine()[place] % 2]);
        if takes_part(trajectory) {
            advantages(value, trajectory, known.horizon, config)
        } else {
            Vec::new()
        }
    });
    let (advantage_sigma, clipped_share) = normalise(deal, &mut advantages, config.advantage_clip)?;

    // gradient and metric
    let Totals {
        n_sample,
        halves,
        second,
        outer,
    } = Totals::of(policy, deal, batch, &advantages, known.symmetries, config)?;
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
        group_cosines: known
            .groups
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

/// Whether there is anything to learn from.
fn is_usable(trajectory: &Trajectory) -> bool {
    trajectory.diverged.is_none() && !trajectory.is_empty()
}

/// The mean reward up to which a trajectory is one of the worst `epsilon` of `n_usable`.
fn worst(
    batch: &[Trajectory],
    deal: &Deal<'_>,
    n_usable: f64,
    epsilon: f64,
) -> Result<f64, TeamError> {
    if epsilon >= 1.0 {
        return Ok(f64::INFINITY);
    }
    let usable = batch.iter().filter(|t| is_usable(t));
    let rewards: Vec<f64> = usable.map(Trajectory::mean_reward).collect();
    let last = (epsilon * n_usable).round().max(1.0) as usize - 1;
    let limit = deal.team().sorted_value(&rewards, last)?;
    Ok(limit.unwrap_or(f64::INFINITY))
}

/// Fit value functions to the returns of all usable trajectories; `None` when there are too few samples.
fn fit_baseline(
    baseline: &Baseline,
    batch: &[Trajectory],
    deal: &Deal<'_>,
    known: &Known<'_>,
    config: &NpgConfig,
) -> Result<Option<baseline::Fit>, TeamError> {
    let n_input = baseline.n_input();
    let mut returns = per_trajectory(batch, |_, trajectory| {
        let (mut last, mut returns) = (Vec::new(), Vec::new());
        if is_usable(trajectory) {
            let end = &trajectory.value_inputs[trajectory.len() * n_input..];
            baseline.values(end, trajectory.len(), known.horizon, &mut last);
            advantage::returns(&trajectory.rewards, last[0], config.discount, &mut returns);
        }
        returns
    });
    // the object flung off the table once must not bend the value of every other state
    let clip = config.advantage_clip.max(advantage::MIN_CLIP);
    let (mean, sigma) = advantage::robust_moments(deal, &returns, clip)?;
    for value in returns.iter_mut().flatten() {
        *value = value.max(mean - clip * sigma).min(mean + clip * sigma);
    }
    let targets: Vec<Target<'_>> = batch
        .iter()
        .zip(&returns)
        .map(|(trajectory, returns)| Target {
            inputs: if returns.is_empty() {
                &[]
            } else {
                &trajectory.value_inputs
            },
            returns,
        })
        .collect();
    baseline::fit(
        deal,
        &targets,
        n_input,
        known,
        config.value_stride,
        config.value_ridge,
    )
}

/// Generalised advantages of a trajectory.
fn advantages(
    value: &Baseline,
    trajectory: &Trajectory,
    horizon: usize,
    config: &NpgConfig,
) -> Vec<f64> {
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
}

/// Apply `work` to every place and trajectory on all threads, results in order.
fn per_trajectory<R: Send>(
    batch: &[Trajectory],
    work: impl Fn(usize, &Trajectory) -> R + Sync + Send,
) -> Vec<R> {
    use rayon::prelude::*;
    let numbered = batch.par_iter().enumerate();
    numbered.map(|(place, t)| work(place, t)).collect()
}

/// Bring advantages to mean 0 and standard deviation 1 over the batch, clipped; returns the old standard deviation and
/// the clipped share.
fn normalise(
    deal: &Deal<'_>,
    advantages: &mut [Vec<f64>],
    clip: f64,
) -> Result<(f64, f64), TeamError> {
    let (mean, sigma) = advantage::robust_moments(deal, advantages, clip)?;
    let inverse = if sigma > 0.0 { 1.0 / sigma } else { 0.0 };
    let mut clipped = vec![0_usize; advantages.len()];
    for (advantages, clipped) in advantages.iter_mut().zip(&mut clipped) {
        for a in advantages {
            *a = (*a - mean) * inverse;
            if a.abs() > clip {
                *a = clip.copysign(*a);
                *clipped += 1;
            }
        }
    }
    let [count, clipped] =
        deal.totals(|place| [advantages[place].len() as f64, clipped[place] as f64])?;
    Ok((sigma, clipped / count))
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

#[cfg(test)]
mod tests;
