//! Settings of the update: defaults, ranges, annealing.

use serde::{Deserialize, Serialize};

use super::NpgError;
use super::fisher::FisherMode;

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
    /// share of the trajectories, the worst by mean reward, that the step is made for: `EPOpt`'s ε; 1: all
    pub epopt_epsilon: f64,
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
            step_size_delta: 0.2,
            final_step_size_delta: 0.04,
            final_log_sigma: -2.4,
            anneal_iterations: 60,
            fisher: FisherMode::Exact,
            fisher_damping: 0.1,
            advantage_clip: 1.5,
            epopt_epsilon: 1.0,
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
        let epsilon = self.epopt_epsilon;
        setting(
            "npg.epopt_epsilon",
            epsilon,
            epsilon > 0.0 && epsilon <= 1.0,
            "above 0 and at most 1",
        )?;
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
