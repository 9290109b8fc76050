//! The affine Gaussian policy of the paper.
//!
//! ```text
//! a ~ N(W s + b, diag(exp(2 l)))          l: log standard deviations, independent of the state
//! ```
//!
//! How the noise of neighbouring steps hangs together, and the score, are in [`crate::exploration`].
//!
//! | symbol | name | shape |
//! | --- | --- | --- |
//! | (W b) | `weights` | `n_action × (n_observation + 1)`, row-major, bias last |
//! | l | `log_sigma` | `n_action` |
//! | θ | `parameters()` | all weights row by row, then `log_sigma` |
//!
//! The JSON written by serde is the deployable policy: field names as here, action in the actuators' units (N m),
//! observation in the order given by `observation_names`.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Version of the JSON layout.
pub const FORMAT: &str = "phantom-affine-gaussian-1";

/// Beyond this, exp(l) or the score overflow to something useless; the settings have the same range.
const MAX_LOG_SIGMA: f64 = 20.0;

/// What can be wrong with a policy.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PolicyError {
    /// The file is of another kind or of another version.
    #[error("format is `{found}`, expected `{FORMAT}`")]
    Format {
        /// what the file says
        found: String,
    },
    /// An array has the wrong length.
    #[error("`{name}` has {got} values, expected {expected}")]
    Length {
        /// field
        name: &'static str,
        /// required length
        expected: usize,
        /// found length
        got: usize,
    },
    /// A parameter is not a finite number.
    #[error("`{name}[{index}]` is {value}, not a finite number")]
    NotFinite {
        /// field
        name: &'static str,
        /// position
        index: usize,
        /// value
        value: f64,
    },
    /// A log standard deviation whose exponential is no usable number.
    #[error("`log_sigma[{index}]` is {value}, expected -20 to 20")]
    LogSigma {
        /// position
        index: usize,
        /// value
        value: f64,
    },
    /// The policy is for a task with other sizes.
    #[error(
        "the policy maps {got_observation} observations to {got_action} actions, \
         the task needs {expected_observation} to {expected_action}"
    )]
    Size {
        /// observations of the policy
        got_observation: usize,
        /// actions of the policy
        got_action: usize,
        /// observations of the task
        expected_observation: usize,
        /// actions of the task
        expected_action: usize,
    },
}

/// An affine policy with Gaussian exploration noise; see the module for shapes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AffineGaussian {
    format: String,
    n_observation: usize,
    n_action: usize,
    /// `n_action × (n_observation + 1)`, row-major, bias last in each row
    weights: Vec<f64>,
    /// natural logarithm of the noise standard deviation of each action
    log_sigma: Vec<f64>,
    /// names of the observations, in order (for the reader of the file)
    #[serde(default)]
    observation_names: Vec<String>,
    /// names of the actions, in order
    #[serde(default)]
    action_names: Vec<String>,
}

impl AffineGaussian {
    /// A policy with zero weights and the same noise on every action.
    pub fn zeros(n_observation: usize, n_action: usize, log_sigma: f64) -> Self {
        Self {
            format: FORMAT.to_owned(),
            n_observation,
            n_action,
            weights: vec![0.0; n_action * (n_observation + 1)],
            log_sigma: vec![log_sigma; n_action],
            observation_names: Vec::new(),
            action_names: Vec::new(),
        }
    }

    /// Record the names of observations and actions in the file.
    #[must_use]
    pub fn with_names(mut self, observation: Vec<String>, action: Vec<String>) -> Self {
        self.observation_names = observation;
        self.action_names = action;
        self
    }

    /// Number of observations.
    pub fn n_observation(&self) -> usize {
        self.n_observation
    }

    /// Number of actions.
    pub fn n_action(&self) -> usize {
        self.n_action
    }

    /// Length of θ.
    pub fn n_parameter(&self) -> usize {
        self.weights.len() + self.log_sigma.len()
    }

    /// (W b), row-major.
    pub fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// Log standard deviations, one an action.
    pub fn log_sigma(&self) -> &[f64] {
        &self.log_sigma
    }

    /// θ: weights row by row, then the log standard deviations.
    pub fn parameters(&self) -> Vec<f64> {
        [self.weights.as_slice(), self.log_sigma.as_slice()].concat()
    }

    /// Replace θ.
    ///
    /// # Errors
    /// When the length differs from [`Self::n_parameter`] or a value is not finite; the policy is then unchanged.
    pub fn set_parameters(&mut self, theta: &[f64]) -> Result<(), PolicyError> {
        if theta.len() != self.n_parameter() {
            return Err(PolicyError::Length {
                name: "parameters",
                expected: self.n_parameter(),
                got: theta.len(),
            });
        }
        check_finite("parameters", theta)?;
        let (weights, log_sigma) = theta.split_at(self.weights.len());
        self.weights.copy_from_slice(weights);
        self.log_sigma.copy_from_slice(log_sigma);
        Ok(())
    }

    /// Hold every log standard deviation at or above `floor`, so that exploration never dies out.
    pub fn raise_log_sigma(&mut self, floor: f64) {
        for value in &mut self.log_sigma {
            *value = value.max(floor);
        }
    }

    /// Hold every log standard deviation at or below `ceiling`.
    pub fn lower_log_sigma(&mut self, ceiling: f64) {
        for value in &mut self.log_sigma {
            *value = value.min(ceiling);
        }
    }

    /// The mean action W s + b.
    pub fn mean(&self, observation: &[f64], action: &mut [f64]) {
        debug_assert_eq!(observation.len(), self.n_observation);
        for (row, out) in self
            .weights
            .chunks_exact(self.n_observation + 1)
            .zip(action)
        {
            let (weights, bias) = row.split_at(self.n_observation);
            // left to right, as any reader of the file would sum it
            *out = weights
                .iter()
                .zip(observation)
                .fold(0.0, |sum, (w, s)| sum + w * s)
                + bias[0];
        }
    }

    /// Check a policy that came from a file, and that it fits a task.
    ///
    /// # Errors
    /// Wrong format, lengths, sizes, or a number that is not finite.
    pub fn check(&self, n_observation: usize, n_action: usize) -> Result<(), PolicyError> {
        if self.format != FORMAT {
            return Err(PolicyError::Format {
                found: self.format.clone(),
            });
        }
        if self.n_observation != n_observation || self.n_action != n_action {
            return Err(PolicyError::Size {
                got_observation: self.n_observation,
                got_action: self.n_action,
                expected_observation: n_observation,
                expected_action: n_action,
            });
        }
        let expected = n_action * (n_observation + 1);
        for (name, values, expected) in [
            ("weights", &self.weights, expected),
            ("log_sigma", &self.log_sigma, n_action),
        ] {
            if values.len() != expected {
                return Err(PolicyError::Length {
                    name,
                    expected,
                    got: values.len(),
                });
            }
            check_finite(name, values)?;
        }
        if let Some(index) = self.log_sigma.iter().position(|l| l.abs() > MAX_LOG_SIGMA) {
            let value = self.log_sigma[index];
            return Err(PolicyError::LogSigma { index, value });
        }
        // names are for the reader; none at all is fine
        for (name, names, expected) in [
            ("observation_names", &self.observation_names, n_observation),
            ("action_names", &self.action_names, n_action),
        ] {
            if !names.is_empty() && names.len() != expected {
                return Err(PolicyError::Length {
                    name,
                    expected,
                    got: names.len(),
                });
            }
        }
        Ok(())
    }
}

fn check_finite(name: &'static str, values: &[f64]) -> Result<(), PolicyError> {
    match values.iter().position(|v| !v.is_finite()) {
        Some(index) => Err(PolicyError::NotFinite {
            name,
            index,
            value: values[index],
        }),
        None => Ok(()),
    }
}
