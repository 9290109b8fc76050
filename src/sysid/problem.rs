//! Recordings brought onto the model: knots of the trajectory, controls, samples of sensors.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

pub use super::commands::CommandTiming;
use super::norm::Norm;
use super::parameter::{Instrument, ParameterRule, Parameters, Role};
use super::path::Path;
use super::{SysidError, inverse, trial};
use crate::mjcf::glob;
use crate::mujoco::{Model, ObjectKind};
use crate::recording::{Bound, Recording};

/// Noise of the channels that match.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelRule {
    /// glob of channel names
    pub name: String,
    /// standard deviation in the channel's unit
    #[serde(default)]
    pub noise_sigma: Option<f64>,
    /// cost of a residual
    #[serde(default)]
    pub norm: Norm,
    /// leave the channel out of the fit, to see how well it is predicted
    #[serde(default)]
    pub ignore: bool,
}

/// How far force and motion may disagree at the joints that match.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ForceRule {
    /// glob of joint names
    pub joint: String,
    /// standard deviation of the force that nothing explains, N m or N
    #[serde(default)]
    pub sigma: Option<f64>,
    /// cost of a residual
    #[serde(default)]
    pub norm: Norm,
}

/// The file of parameters: what to estimate and how to weigh.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ProblemConfig {
    /// what to estimate
    pub parameter: Vec<ParameterRule>,
    /// noise of channels; the first that matches counts
    pub channel: Vec<ChannelRule>,
    /// forces; the first that matches counts
    pub force: Vec<ForceRule>,
    /// unexplained force as a part of the force at a joint, where no rule gives it [0.01]
    pub force_sigma_relative: Option<f64>,
    /// globs of joints whose motion no sensor has to show
    pub unseen: Vec<String>,
    /// when commands act
    pub command: CommandTiming,
}

/// At which stage of the engine a number is known, and so which knots it depends on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// q of the knot
    Position,
    /// and of the one before
    Velocity,
    /// and of the one after
    Acceleration,
}

/// A measured signal.
#[derive(Debug, Clone, PartialEq)]
pub struct Channel {
    /// its name
    pub name: String,
    /// its unit
    pub unit: String,
    /// index in (sensordata, qpos, qvel), one behind the other
    pub source: usize,
    /// what it depends on
    pub stage: Stage,
    /// standard deviation of its noise
    pub sigma: f64,
    /// whether that is given, not estimated from the signal
    pub sigma_known: bool,
    /// cost of a residual
    pub norm: Norm,
    /// estimated parameters (index among the free) and values that hold otherwise
    pub bias: Setting,
    /// factor
    pub gain: Setting,
    /// seconds
    pub delay: Setting,
}

impl Channel {
    /// What is recorded where the model's sensor shows `z`, but for the delay.
    pub(crate) fn reading(&self, free_values: &[f64], z: f64) -> f64 {
        self.gain.value(free_values) * z + self.bias.value(free_values)
    }

    /// Standard deviation of a sample of its own, see [`Sample::spread`].
    pub(crate) fn sigma_of(&self, sample: &Sample) -> f64 {
        self.sigma * sample.spread
    }
}

/// An instrument's number: a constant, or an estimated parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Setting {
    /// held
    Fixed(f64),
    /// index among the free parameters
    Free(usize),
}

impl Setting {
    /// Its value, given the values of the free parameters.
    pub fn value(self, free_values: &[f64]) -> f64 {
        match self {
            Self::Fixed(value) => value,
            Self::Free(j) => free_values[j],
        }
    }
}

/// One number of a sensor at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// index in `Problem::channels`
    pub channel: usize,
    /// seconds since the first knot
    pub time: f64,
    /// measured
    pub value: f64,
    /// factor on the standard deviation of its channel: √n in a run of n equal readings, whose error is one and the same.
    /// Many readings of a counter at rest tell no more than one
    pub spread: f64,
}

/// A recording on the grid of the model's time step.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// name
    pub name: String,
    /// number of knots
    pub n_knots: usize,
    /// seconds from the recording's start to the first knot
    pub start_s: f64,
    /// per actuator: (time since the first knot, value held from there)
    pub controls: Arc<Vec<Vec<(f64, f64)>>>,
    /// in the order of time
    pub samples: Arc<Vec<Sample>>,
    /// as it was recorded
    pub recording: Arc<Recording>,
    /// the motion by its readings, where windows have to know what was before them
    pub path: Option<Path>,
}

/// Everything the estimators need.
#[derive(Debug, Clone)]
pub struct Problem {
    /// nominal model
    pub model: Arc<Model>,
    /// what is estimated
    pub parameters: Parameters,
    /// of all trials
    pub channels: Vec<Channel>,
    /// recordings
    pub trials: Vec<Trial>,
    /// (nv) standard deviation of the unexplained force; 0: from the size of the forces
    pub force_sigma: Vec<f64>,
    /// (nv)
    pub force_norm: Vec<Norm>,
    /// see [`ProblemConfig`]
    pub force_sigma_relative: f64,
    /// (nu) seconds by which commands act late
    pub command_delay: Vec<Setting>,
    /// what a user should know of the recordings
    pub notes: Vec<String>,
    /// when they act otherwise
    pub command: CommandTiming,
}

/// Part of the forces at a joint that may stay unexplained, unless told.
const FORCE_SIGMA_RELATIVE: f64 = 0.01;

impl Problem {
    /// Standard deviation of every channel.
    pub(crate) fn sigma(&self) -> Vec<f64> {
        self.channels.iter().map(|c| c.sigma).collect()
    }

    /// What rules say of another model.
    ///
    /// # Errors
    /// As [`Parameters::new`].
    pub(crate) fn parameters_of(
        &self,
        model: &Model,
        rules: &[ParameterRule],
    ) -> Result<Parameters, SysidError> {
        let names: Vec<String> = self.channels.iter().map(|c| c.name.clone()).collect();
        Parameters::new(model, rules, &names)
    }

    /// Takes a standard deviation for every channel.
    pub(crate) fn take_sigma(&mut self, sigma: &[f64]) {
        for (channel, sigma) in self.channels.iter_mut().zip(sigma) {
            channel.sigma = *sigma;
        }
    }

    /// Binds recordings to a model. `names` has one name a recording.
    ///
    /// # Errors
    /// A model the method cannot handle, a rule or recording that does not fit, no sensor, a missing control.
    pub fn new(
        model: Arc<Model>,
        config: &ProblemConfig,
        recordings: &[(String, Recording)],
    ) -> Result<Self, SysidError> {
        if let Some(reason) = inverse::unsupported(&model) {
            return Err(SysidError::Model { reason });
        }
        let mut channels: Vec<Channel> = Vec::new();
        let mut trials = Vec::new();
        let mut notes = Vec::new();
        for (name, recording) in recordings {
            let bound = Bound::new(recording, &model)?;
            if let Some(missing) = bound.missing_controls(&model).first() {
                let reason = format!("the control of actuator `{missing}` is not recorded");
                return Err(SysidError::Recording {
                    recording: name.clone(),
                    reason,
                });
            }
            trials.push(trial::trial(
                &model,
                config,
                name,
                recording,
                &bound,
                (&mut channels, &mut notes),
            )?);
        }
        let names: Vec<String> = channels.iter().map(|c| c.name.clone()).collect();
        let parameters = Parameters::new(&model, &config.parameter, &names)?;
        for channel in &mut channels {
            let setting = |i, otherwise| instrument(&parameters, i, &channel.name, otherwise);
            (channel.bias, channel.gain, channel.delay) = (
                setting(Instrument::Bias, 0.0),
                setting(Instrument::Gain, 1.0),
                setting(Instrument::Delay, 0.0),
            );
        }
        let command_delay = (0..model.nu())
            .map(|i| {
                let name = model.name(ObjectKind::Actuator, i).unwrap_or_default();
                instrument(&parameters, Instrument::CommandDelay, name, 0.0)
            })
            .collect();
        let (force_sigma, force_norm) = forces(&model, config)?;
        let relative = config.force_sigma_relative.unwrap_or(FORCE_SIGMA_RELATIVE);
        if !(relative.is_finite() && relative > 0.0) {
            let reason = format!("force_sigma_relative is {relative}, expected a positive number");
            return Err(SysidError::Setting { reason });
        }
        let mut problem = Self {
            model,
            parameters,
            channels,
            trials,
            force_sigma,
            force_norm,
            force_sigma_relative: relative,
            command_delay,
            notes,
            command: config.command,
        };
        problem.guess_noise();
        Ok(problem)
    }

    /// (nv) standard deviation of unexplained forces at a level, where forces are as large as `scale`. A given one is
    /// eased above level 1.
    pub(super) fn force_sigma_at(&self, level: f64, scale: &[f64]) -> Vec<f64> {
        (self.force_sigma.iter().zip(scale))
            .map(|(given, scale)| {
                if *given > 0.0 {
                    given * level.max(1.0)
                } else {
                    level * scale
                }
            })
            .collect()
    }

    /// Samples of all trials, one trial after the other.
    pub(crate) fn samples(&self) -> impl Iterator<Item = &Sample> {
        self.trials.iter().flat_map(|t| t.samples.iter())
    }

    /// How far every channel ranges over all trials: the most of those with its unit, as the one that hardly moves
    /// belongs to a motion like theirs.
    pub(super) fn channel_ranges(&self) -> Vec<f64> {
        let mut ends = vec![(f64::INFINITY, f64::NEG_INFINITY); self.channels.len()];
        for s in self.samples() {
            let (low, high) = &mut ends[s.channel];
            (*low, *high) = (low.min(s.value), high.max(s.value));
        }
        let ranges: Vec<f64> = ends
            .into_iter()
            .map(|(low, high)| (high - low).max(0.0))
            .collect();
        let alike = |c: &Channel| {
            let pairs = self.channels.iter().zip(&ranges);
            pairs
                .filter(|(o, _)| o.unit == c.unit)
                .fold(0.0_f64, |m, (_, r)| m.max(*r))
        };
        self.channels.iter().map(alike).collect()
    }

    /// Values of the free parameters at `x`.
    pub fn free_values(&self, x: &[f64]) -> Vec<f64> {
        self.parameters
            .iter_free()
            .zip(x)
            .map(|(p, &x)| p.to_value(x))
            .collect()
    }

    /// Noise of channels for which none is given: from third differences, in which a smooth signal vanishes.
    fn guess_noise(&mut self) {
        for (c, channel) in self.channels.iter_mut().enumerate() {
            if channel.sigma_known {
                continue;
            }
            let (mut sum, mut n, mut low, mut high) = (0.0, 0.0, f64::INFINITY, f64::NEG_INFINITY);
            for trial in &self.trials {
                let values: Vec<f64> = trial
                    .samples
                    .iter()
                    .filter(|s| s.channel == c)
                    .map(|s| s.value)
                    .collect();
                for w in values.windows(4) {
                    sum += (w[3] - 3.0 * w[2] + 3.0 * w[1] - w[0]).powi(2) / 20.0;
                    n += 1.0;
                }
                for v in values {
                    (low, high) = (low.min(v), high.max(v));
                }
            }
            let floor = 1e-6 * (high - low).max(1e-3);
            channel.sigma = (sum / f64::max(n, 1.0)).sqrt().max(floor);
        }
    }
}

fn instrument(parameters: &Parameters, what: Instrument, name: &str, otherwise: f64) -> Setting {
    let index = parameters.all.iter().position(|p| {
        matches!(&p.role, Role::Instrument(i, pattern) if *i == what && glob::matches(pattern, name))
    });
    match index {
        None => Setting::Fixed(otherwise),
        Some(i) => match parameters.free.iter().position(|&f| f == i) {
            Some(j) => Setting::Free(j),
            None => Setting::Fixed(parameters.all[i].start),
        },
    }
}

fn forces(model: &Model, config: &ProblemConfig) -> Result<(Vec<f64>, Vec<Norm>), SysidError> {
    let mut sigma = vec![0.0; model.nv()];
    let mut norm = vec![Norm::Quadratic; model.nv()];
    for rule in config.force.iter().rev() {
        let given = rule.sigma.unwrap_or(0.0);
        if !given.is_finite() || given < 0.0 || rule.sigma == Some(0.0) || !rule.norm.is_valid() {
            let reason = format!(
                "force `{}`: sigma and norm need positive numbers",
                rule.joint
            );
            return Err(SysidError::Setting { reason });
        }
        let mut found = false;
        for joint in 0..model.njnt() {
            let name = model.name(ObjectKind::Joint, joint).unwrap_or_default();
            if glob::matches(&rule.joint, name) {
                found = true;
                for dof in crate::mjcf::attribute::dofs(model, joint) {
                    (sigma[dof], norm[dof]) = (given, rule.norm);
                }
            }
        }
        if !found {
            let reason = format!("force `{}`: no joint of this name", rule.joint);
            return Err(SysidError::Setting { reason });
        }
    }
    Ok((sigma, norm))
}
