//! How a comparison is made.

use serde::{Deserialize, Serialize};

use super::CompareError;

/// Where accelerations come from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Derivative {
    /// `step` for recorded, unfiltered velocities sampled at the model's time step, else `central`
    #[default]
    Auto,
    /// (v(t + dt) - v(t - dt)) / 2 dt, for recordings of a machine
    Central,
    /// (v(t + h) - v(t)) / h as in the engine's own step, for recordings of a simulation
    Step,
}

/// Start where the height of a free body first falls to a limit, at the last sample above it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drop {
    /// free joint
    pub joint: String,
    /// height of its origin, m
    pub below_m: f64,
    /// take the velocity from free flight up to there: a parabola for the place, the mean angular velocity
    #[serde(default)]
    pub free_flight: bool,
}

/// Settings of a comparison, a TOML file of the same keys.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// zero-phase low-pass of the recorded state, 1/s; none: as recorded
    pub cutoff_hz: Option<f64>,
    /// zero-phase low-pass of computed and measured forces, 1/s
    pub force_cutoff_hz: Option<f64>,
    /// compare forces at all
    pub forces: bool,
    /// left out at both ends of the forces, and before the first rollout, s
    pub skip_s: f64,
    /// use every so many-th sample of the forces
    pub decimate: usize,
    /// velocities by differences even where they are recorded
    pub differences: bool,
    /// source of accelerations
    pub derivative: Derivative,
    /// durations of rollouts, s
    pub horizons_s: Vec<f64>,
    /// also simulate to the end of the recording
    pub to_end: bool,
    /// distance between starts, s; none: a hundred a recording
    pub every_s: Option<f64>,
    /// one start a recording, where a body falls
    pub drop: Option<Drop>,
    /// size that distances are given in percent of, m
    pub length_m: Option<f64>,
    /// leave out recordings whose trial is a multiple of this
    pub except_multiples_of: Option<u64>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            cutoff_hz: None,
            force_cutoff_hz: None,
            forces: true,
            skip_s: 0.0,
            decimate: 1,
            differences: false,
            derivative: Derivative::Auto,
            horizons_s: vec![0.05, 0.1, 0.25, 0.5, 1.0],
            to_end: false,
            every_s: None,
            drop: None,
            length_m: None,
            except_multiples_of: None,
        }
    }
}

impl Settings {
    /// Look for settings out of range.
    ///
    /// # Errors
    /// The first.
    pub fn check(&self) -> Result<(), CompareError> {
        let refuse = |key, value: String, expected| {
            Err(CompareError::Setting {
                key,
                value,
                expected,
            })
        };
        let optional = [
            ("cutoff_hz", self.cutoff_hz),
            ("force_cutoff_hz", self.force_cutoff_hz),
            ("every_s", self.every_s),
            ("length_m", self.length_m),
        ];
        let given = optional.iter().filter_map(|(k, v)| v.map(|v| (*k, v)));
        let horizons = self.horizons_s.iter().map(|h| ("horizons_s", *h));
        for (key, value) in given.chain(horizons) {
            if !(value.is_finite() && value > 0.0) {
                return refuse(key, value.to_string(), "a positive number");
            }
        }
        if !(self.skip_s.is_finite() && self.skip_s >= 0.0) {
            return refuse("skip_s", self.skip_s.to_string(), "a number of at least 0");
        }
        if self.decimate == 0 {
            return refuse("decimate", "0".to_owned(), "at least 1");
        }
        if self.except_multiples_of == Some(0) {
            return refuse("except_multiples_of", "0".to_owned(), "at least 1");
        }
        if self.horizons_s.is_empty() && !self.to_end {
            return refuse(
                "horizons_s",
                "empty".to_owned(),
                "a duration, or to_end = true",
            );
        }
        Ok(())
    }

    /// Whether the recording of this trial is used.
    pub fn uses_trial(&self, trial: &str) -> bool {
        match (self.except_multiples_of, trial.parse::<u64>()) {
            (Some(n), Ok(number)) => number % n != 0,
            _ => true,
        }
    }
}
