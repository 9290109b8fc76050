//! Recordings brought onto the model: knots of the trajectory, controls, samples of sensors.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

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

/// When the command of a step acts.
///
/// The engine's step ties q₍k−1₎, qₖ and q₍k+1₎ to the command that holds from k to k + 1. In continuous time that second
/// difference is the mean acceleration around k, to which the command before k contributes as much: the engine takes
/// commands half a step early, which identification would see as damping (7 % of a Phantom's at 0.5 ms).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CommandTiming {
    /// the mean of the command from half a step before a knot to half a step after it: machines, finer simulations
    #[default]
    Centred,
    /// the mean over the step that begins at the knot: recordings simulated by the engine with the model's own step
    Held,
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
    pub controls: Vec<Vec<(f64, f64)>>,
    /// in the order of time
    pub samples: Vec<Sample>,
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

    /// How far every channel ranges over all trials: the most of those with its unit, as the one that hardly moves
    /// belongs to a motion like theirs.
    pub(super) fn channel_ranges(&self) -> Vec<f64> {
        let mut ends = vec![(f64::INFINITY, f64::NEG_INFINITY); self.channels.len()];
        for s in self.trials.iter().flat_map(|t| &t.samples) {
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

    /// Controls of every knot of a trial (`n_knots` × nu): means of the command over a step, see [`CommandTiming`].
    pub fn controls(&self, trial: &Trial, x: &[f64]) -> Vec<f64> {
        self.controls_from(trial, x, 0, trial.n_knots)
    }

    /// The same of `n` knots from `first`, which may lie before the trial's first (n × nu).
    pub(crate) fn controls_from(
        &self,
        trial: &Trial,
        x: &[f64],
        first: isize,
        n: usize,
    ) -> Vec<f64> {
        let early = match self.command {
            CommandTiming::Centred => 0.5 * self.model.timestep(),
            CommandTiming::Held => 0.0,
        };
        self.means(trial, x, (first, n), early)
    }

    /// What motors themselves get: means of the command over the step that begins at each of `n` knots from `first` (n × nu).
    /// None where those are the controls.
    pub(crate) fn held_controls(
        &self,
        trial: &Trial,
        x: &[f64],
        (first, n): (isize, usize),
    ) -> Option<Vec<f64>> {
        let held = self.command == CommandTiming::Held;
        (!held).then(|| self.means(trial, x, (first, n), 0.0))
    }

    /// Means of the commands over a step from `early` s before each of `n` knots from `first` (n × nu).
    fn means(&self, trial: &Trial, x: &[f64], (first, n): (isize, usize), early: f64) -> Vec<f64> {
        let (h, nu) = (self.model.timestep(), self.model.nu());
        let free = self.free_values(x);
        let mut out = vec![0.0; n * nu];
        for (i, series) in trial.controls.iter().enumerate() {
            let delay = self.command_delay[i].value(&free);
            let mut at = 0;
            for k in 0..n {
                let from = (first as f64 + k as f64) * h - delay - early;
                out[k * nu + i] = mean_of_held(series, from, from + h, &mut at);
            }
        }
        out
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

/// Mean over `from .. to` of a signal that holds each value until the next; `at` remembers the place.
fn mean_of_held(series: &[(f64, f64)], from: f64, to: f64, at: &mut usize) -> f64 {
    const SLACK: f64 = 1e-9; // stamps are whole nanoseconds
    while *at + 1 < series.len() && series[*at + 1].0 <= from + SLACK {
        *at += 1;
    }
    let (mut sum, mut time, mut i) = (0.0, from, *at);
    while i + 1 < series.len() && series[i + 1].0 < to - SLACK {
        let next = series[i + 1].0.max(time);
        sum += series[i].1 * (next - time);
        (time, i) = (next, i + 1);
    }
    (sum + series[i].1 * (to - time)) / (to - from)
}

#[cfg(test)]
mod tests {
    use super::mean_of_held;

    #[test]
    fn a_held_signal_is_averaged_over_the_step() {
        let series = [(0.0, 1.0), (0.1, 3.0), (0.15, -1.0)];
        let mean = |from, to| mean_of_held(&series, from, to, &mut 0);
        assert_eq!(mean(0.0, 0.1), 1.0);
        assert!((mean(0.05, 0.15) - 2.0).abs() < 1e-12);
        assert!((mean(0.1, 0.2) - 1.0).abs() < 1e-12);
        assert_eq!(mean(5.0, 6.0), -1.0);
        assert_eq!(mean(-2.0, -1.0), 1.0);
    }
}
