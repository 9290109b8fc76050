//! What is to be estimated: numbers of the model and of its sensors, with scale, bounds and prior.
//!
//! The estimator works with one number x a parameter; its value is x (`linear`) or e^x (`log`, for quantities that are
//! positive, whose uncertainty is a factor).
//!
//! ```toml
//! [[parameter]]
//! element = "joint/p*_upper"   # kind/glob of the model, `channel/glob` for sensors, `control/glob` for actuators
//! attribute = "damping"        # see `mjcf::attribute`; of a channel: bias, gain, delay; of a control: delay
//! components = [0]             # all when absent
//! tied = true                  # one value for all elements that match; they keep their ratios (log) or differences
//! scale = "log"                # or "linear"; log where the attribute is positive and its value not 0
//! start = 0.01                 # where to begin; the model's value when absent
//! prior = 0.01                 # expected value; the model's when absent
//! prior_sigma = 0.2            # its standard deviation, a factor on the log scale; none when absent
//! lower = 1e-4
//! upper = 1.0
//! frozen = false               # hold at `start`
//! ```

use serde::{Deserialize, Serialize};

pub use super::rule::ParameterRule;
use super::{SysidError, rule};
use crate::mjcf::attribute::{Place, Target};
use crate::mjcf::{edit, glob};
use crate::mujoco::{Data, Model};

/// Largest change of x on a log scale in one step of an estimator.
const LOG_STEP: f64 = 1.0;

/// How a value is written in the estimator's number x.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scale {
    /// x
    Linear,
    /// e^x
    Log,
}

/// A property of the measurement, not of the machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Instrument {
    /// added to the reading, in its unit
    Bias,
    /// factor on the true value
    Gain,
    /// seconds by which the reading is late
    Delay,
    /// seconds by which a command acts late
    CommandDelay,
}

/// What a parameter changes.
#[derive(Debug, Clone, PartialEq)]
pub enum Role {
    /// numbers of the model, each with its nominal value
    Model(Vec<(Target, f64)>),
    /// an instrument; names of channels or actuators by glob
    Instrument(Instrument, String),
}

impl Role {
    /// Whether it changes the motion; what sensors make of the motion needs no simulation.
    pub(crate) fn acts(&self) -> bool {
        match self {
            Self::Model(_) | Self::Instrument(Instrument::CommandDelay, _) => true,
            Self::Instrument(Instrument::Bias | Instrument::Gain | Instrument::Delay, _) => false,
        }
    }
}

/// One parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// address
    pub name: String,
    /// what it changes
    pub role: Role,
    /// of x
    pub scale: Scale,
    /// unit of the value
    pub unit: &'static str,
    /// the model's value
    pub nominal: f64,
    /// first value
    pub start: f64,
    /// expected value
    pub prior: f64,
    /// standard deviation of x, infinite if nothing is known
    pub prior_sigma: f64,
    /// least value
    pub lower: f64,
    /// greatest value
    pub upper: f64,
    /// whether it is held
    pub frozen: bool,
    /// size of a change of x that matters
    pub typical: f64,
}

impl Parameter {
    /// Whether anything was known of it before.
    pub fn has_prior(&self) -> bool {
        self.prior_sigma.is_finite()
    }

    /// x of a value.
    pub fn to_x(&self, value: f64) -> f64 {
        match self.scale {
            Scale::Linear => value,
            Scale::Log => value.ln(),
        }
    }

    /// Value of x.
    pub fn to_value(&self, x: f64) -> f64 {
        match self.scale {
            Scale::Linear => x,
            Scale::Log => x.exp(),
        }
    }

    /// Bounds of x.
    pub fn bounds(&self) -> (f64, f64) {
        (self.to_x(self.lower), self.to_x(self.upper))
    }

    /// How far `x` may go down and up within its bounds, by at most `log_step` on a log scale.
    pub(crate) fn reach(&self, x: f64, log_step: f64) -> (f64, f64) {
        let (lower, upper) = self.bounds();
        let most = match self.scale {
            Scale::Log => log_step,
            Scale::Linear => f64::INFINITY,
        };
        ((lower - x).max(-most), (upper - x).min(most))
    }
}

/// All parameters of a problem.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Parameters {
    /// estimated and frozen, in the order of the rules
    pub all: Vec<Parameter>,
    /// indices of those estimated
    pub free: Vec<usize>,
    inertial: bool,
    late: bool,
}

impl Parameters {
    /// Resolves rules against a model; `channels` are the names of the recorded sensor channels.
    ///
    /// # Errors
    /// A rule that means nothing, a start on or outside its bounds, a scale that does not fit, a number twice.
    pub fn new(
        model: &Model,
        rules: &[ParameterRule],
        channels: &[String],
    ) -> Result<Self, SysidError> {
        let mut all: Vec<Parameter> = Vec::new();
        for rule in rules {
            for parameter in rule::parameters(model, rule, channels)? {
                if let Some(twin) = all.iter().find(|p| overlaps(p, &parameter)) {
                    return Err(rule::refuse(
                        rule,
                        format!("is already set by `{}`", twin.name),
                    ));
                }
                all.push(parameter);
            }
        }
        let targets = || {
            all.iter().flat_map(|p| match &p.role {
                Role::Model(targets) => targets.as_slice(),
                Role::Instrument(..) => &[],
            })
        };
        let inertial = targets().any(|(t, _)| t.is_inertial(model));
        let late = targets().any(|(t, _)| t.follows_constants());
        let free = (0..all.len()).filter(|&i| !all[i].frozen).collect();
        Ok(Self {
            all,
            free,
            inertial,
            late,
        })
    }

    /// Number of estimated parameters.
    pub fn len(&self) -> usize {
        self.free.len()
    }

    /// Whether nothing is estimated.
    pub fn is_empty(&self) -> bool {
        self.free.is_empty()
    }

    /// The estimated parameters.
    pub fn iter_free(&self) -> impl Iterator<Item = &Parameter> {
        self.free.iter().map(|&i| &self.all[i])
    }

    /// x (free) at the start.
    pub fn start(&self) -> Vec<f64> {
        self.iter_free().map(|p| p.to_x(p.start)).collect()
    }

    /// x (free) of the nominal model where that lies inside the bounds.
    pub fn nominal(&self) -> Vec<f64> {
        let clamp = |p: &Parameter| p.to_x(p.nominal.clamp(p.lower, p.upper));
        self.iter_free().map(clamp).collect()
    }

    /// Values of all parameters, frozen ones included.
    pub fn values(&self, x: &[f64]) -> Vec<f64> {
        let mut values: Vec<f64> = self.all.iter().map(|p| p.start).collect();
        for (&i, &x) in self.free.iter().zip(x) {
            values[i] = self.all[i].to_value(x);
        }
        values
    }

    /// Change of the value of estimated parameter `j`, now `value`, with its x.
    pub fn slope(&self, j: usize, value: f64) -> f64 {
        match self.all[self.free[j]].scale {
            Scale::Linear => 1.0,
            Scale::Log => value,
        }
    }

    /// How far x (free) may go down and up in one step of an estimator.
    pub(crate) fn reach(&self, x: &[f64]) -> impl Iterator<Item = (f64, f64)> {
        let each = self.iter_free().zip(x);
        each.map(|(p, x)| p.reach(*x, LOG_STEP))
    }

    /// Whether estimated parameter `j` changes the model, not an instrument.
    pub fn changes_model(&self, j: usize) -> bool {
        matches!(self.all[self.free[j]].role, Role::Model(_))
    }

    /// Every number of the model that parameters stand for, at x (free).
    fn numbers(&self, x: &[f64]) -> Vec<(&Target, f64)> {
        let values = self.values(x);
        let mut numbers = Vec::new();
        for (parameter, &value) in self.all.iter().zip(&values) {
            if let Role::Model(targets) = &parameter.role {
                for (target, own) in targets {
                    let first = targets[0].1;
                    let number = match parameter.scale {
                        Scale::Log if first != 0.0 => value * own / first,
                        _ => value + own - first,
                    };
                    numbers.push((target, number));
                }
            }
        }
        numbers
    }

    /// The number at a place of the model, at x (free), if a parameter stands for it.
    pub(crate) fn number(&self, place: &Place, x: &[f64]) -> Option<f64> {
        let mut numbers = self.numbers(x).into_iter();
        numbers.find(|n| n.0.place == *place).map(|n| n.1)
    }

    /// Gives the model of `data` the numbers of `nominal` changed by `x` (free).
    ///
    /// # Errors
    /// When the engine refuses the model.
    pub fn apply(&self, nominal: &Model, x: &[f64], data: &mut Data) -> Result<(), SysidError> {
        let numbers = self.numbers(x);
        data.restore_model(nominal)?;
        data.edit_model(|edit| {
            edit::write(edit, &numbers, false);
            if self.inertial {
                edit.recompute_constants();
            }
        })?;
        if self.late {
            data.edit_model(|edit| edit::write(edit, &numbers, true))?;
        }
        Ok(())
    }

    /// Targets in the model of all parameters.
    pub fn targets(&self) -> Vec<&Target> {
        self.all
            .iter()
            .filter_map(|p| match &p.role {
                Role::Model(targets) => Some(targets),
                Role::Instrument(..) => None,
            })
            .flatten()
            .map(|(target, _)| target)
            .collect()
    }
}

/// Whether two parameters change the same number.
fn overlaps(a: &Parameter, b: &Parameter) -> bool {
    match (&a.role, &b.role) {
        (Role::Model(a), Role::Model(b)) => a
            .iter()
            .any(|(x, _)| b.iter().any(|(y, _)| x.place == y.place)),
        (Role::Instrument(i, p), Role::Instrument(j, q)) => {
            i == j && (glob::matches(p, q) || glob::matches(q, p))
        }
        _ => false,
    }
}
