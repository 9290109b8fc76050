//! The rig file.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::RigError;
use super::effects::EffectConfig;
use super::family::FamilyConfig;
use crate::mujoco::Integrator;
use crate::randomise::Rule;

/// A rig file; every key has a default, which makes the exact model with ideal sensors.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RigConfig {
    /// model the machine is described by, relative to the rig file; none: the shipped one
    pub model: Option<PathBuf>,
    /// state at the start; none: the first keyframe, else the model's reference
    pub keyframe: Option<String>,
    /// which machine is drawn
    pub seed: u64,
    /// how finely the truth is simulated
    pub physics: Physics,
    /// what the sensors do to it
    pub sensing: SensingConfig,
    /// parameters drawn off the model's, once a machine
    pub randomise: Vec<Rule>,
    /// physics the model has not
    pub effect: Vec<EffectConfig>,
    /// effects drawn by the seed
    pub family: Option<FamilyConfig>,
}

/// Integration scheme of the truth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Scheme {
    /// semi-implicit
    Euler,
    /// fourth-order Runge-Kutta
    Rk4,
    /// implicit in velocity
    Implicit,
}

impl From<Scheme> for Integrator {
    fn from(scheme: Scheme) -> Self {
        match scheme {
            Scheme::Euler => Self::Euler,
            Scheme::Rk4 => Self::Rk4,
            Scheme::Implicit => Self::Implicit,
        }
    }
}

/// How the truth is simulated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Physics {
    /// control and encoder samples a second; none: one a time step of the model
    pub rate_hz: Option<f64>,
    /// inner steps a sample
    pub substeps: usize,
    /// none: the model's
    pub integrator: Option<Scheme>,
}

impl Default for Physics {
    fn default() -> Self {
        Self {
            rate_hz: None,
            substeps: 10,
            integrator: None,
        }
    }
}

/// The sensors. `*_sigma_*` are standard deviations; those of calibration errors are drawn once a machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensingConfig {
    /// counts of the joint encoders, 1/rad; 0: exact
    pub encoder_steps_per_rad: f64,
    /// their calibration error, rad
    pub encoder_bias_sigma_rad: f64,
    /// low-pass of the differences of positions, Hz; 0: exact velocities
    pub velocity_cutoff_hz: f64,
    /// resolution of commanded controls, in their unit; 0: exact
    pub command_step: f64,
    /// frames of the motion capture, 1/s
    pub mocap_hz: f64,
    /// its noise, m
    pub mocap_sigma_m: f64,
    /// its systematic error: uniform up to this in each direction, m
    pub mocap_error_m: f64,
    /// its clock is late by up to this, s
    pub mocap_clock_s: f64,
    /// standard deviation of the rate of its clock, less 1
    pub mocap_clock_drift_sigma: f64,
    /// samples of force and torque sensors, 1/s, a whole part of the encoders' rate; 0: that rate
    pub force_hz: f64,
    /// their noise, N
    pub force_sigma_n: f64,
    /// their noise, N m
    pub torque_sigma_nm: f64,
    /// their calibration error, N
    pub force_bias_sigma_n: f64,
    /// their calibration error, N m
    pub torque_bias_sigma_nm: f64,
    /// their drift, a random walk, N in 1 s
    pub force_drift_sigma_n: f64,
    /// their drift, N m in 1 s
    pub torque_drift_sigma_nm: f64,
}

impl Default for SensingConfig {
    fn default() -> Self {
        Self {
            encoder_steps_per_rad: 0.0,
            encoder_bias_sigma_rad: 0.0,
            velocity_cutoff_hz: 0.0,
            command_step: 0.0,
            mocap_hz: 240.0,
            mocap_sigma_m: 0.0,
            mocap_error_m: 0.0,
            mocap_clock_s: 0.0,
            mocap_clock_drift_sigma: 0.0,
            force_hz: 0.0,
            force_sigma_n: 0.0,
            torque_sigma_nm: 0.0,
            force_bias_sigma_n: 0.0,
            torque_bias_sigma_nm: 0.0,
            force_drift_sigma_n: 0.0,
            torque_drift_sigma_nm: 0.0,
        }
    }
}

impl RigConfig {
    /// Check every number against its range.
    ///
    /// # Errors
    /// [`RigError::Setting`].
    pub fn validate(&self) -> Result<(), RigError> {
        let s = &self.sensing;
        let not_negative = [
            ("sensing.encoder_steps_per_rad", s.encoder_steps_per_rad),
            ("sensing.encoder_bias_sigma_rad", s.encoder_bias_sigma_rad),
            ("sensing.velocity_cutoff_hz", s.velocity_cutoff_hz),
            ("sensing.command_step", s.command_step),
            ("sensing.mocap_sigma_m", s.mocap_sigma_m),
            ("sensing.mocap_error_m", s.mocap_error_m),
            ("sensing.mocap_clock_s", s.mocap_clock_s),
            ("sensing.mocap_clock_drift_sigma", s.mocap_clock_drift_sigma),
            ("sensing.force_hz", s.force_hz),
            ("sensing.force_sigma_n", s.force_sigma_n),
            ("sensing.torque_sigma_nm", s.torque_sigma_nm),
            ("sensing.force_bias_sigma_n", s.force_bias_sigma_n),
            ("sensing.torque_bias_sigma_nm", s.torque_bias_sigma_nm),
            ("sensing.force_drift_sigma_n", s.force_drift_sigma_n),
            ("sensing.torque_drift_sigma_nm", s.torque_drift_sigma_nm),
        ];
        for (key, value) in not_negative {
            if !(value.is_finite() && value >= 0.0) {
                return Err(setting(key, value, "a finite number of at least 0"));
            }
        }
        if s.mocap_clock_drift_sigma > 0.01 {
            let (key, value) = ("sensing.mocap_clock_drift_sigma", s.mocap_clock_drift_sigma);
            return Err(setting(key, value, "at most 0.01"));
        }
        if !(1.0..=1e5).contains(&s.mocap_hz) {
            return Err(setting("sensing.mocap_hz", s.mocap_hz, "1 to 100000"));
        }
        if !(1..=1000).contains(&self.physics.substeps) {
            let got = self.physics.substeps as f64;
            return Err(setting("physics.substeps", got, "1 to 1000"));
        }
        if let Some(rate) = self.physics.rate_hz
            && !(1.0..=1e5).contains(&rate)
        {
            return Err(setting("physics.rate_hz", rate, "1 to 100000"));
        }
        if let Some(family) = &self.family {
            family.validate()?;
        }
        Ok(())
    }
}

/// The error of a setting.
pub(super) fn setting(key: &'static str, value: f64, expected: &'static str) -> RigError {
    RigError::Setting {
        key,
        value,
        expected,
    }
}
