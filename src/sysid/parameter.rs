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

use super::SysidError;
use crate::mjcf::attribute::{self, Target};
use crate::mjcf::{edit, glob};
use crate::mujoco::{Data, Model, ObjectKind};

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

/// One rule of the file; see the module.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ParameterRule {
    /// `kind/glob`
    pub element: String,
    /// attribute
    pub attribute: String,
    /// empty: all
    #[serde(default)]
    pub components: Vec<usize>,
    /// one value for all
    #[serde(default)]
    pub tied: bool,
    /// of x
    #[serde(default)]
    pub scale: Option<Scale>,
    /// first value
    #[serde(default)]
    pub start: Option<f64>,
    /// expected value
    #[serde(default)]
    pub prior: Option<f64>,
    /// standard deviation of x around that of `prior`
    #[serde(default)]
    pub prior_sigma: Option<f64>,
    /// least value
    #[serde(default)]
    pub lower: Option<f64>,
    /// greatest value
    #[serde(default)]
    pub upper: Option<f64>,
    /// hold
    #[serde(default)]
    pub frozen: bool,
}

impl ParameterRule {
    /// A rule with everything at its default.
    pub fn new(element: &str, attribute: &str) -> Self {
        Self {
            element: element.to_owned(),
            attribute: attribute.to_owned(),
            components: Vec::new(),
            tied: false,
            scale: None,
            start: None,
            prior: None,
            prior_sigma: None,
            lower: None,
            upper: None,
            frozen: false,
        }
    }
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
            let groups = match rule.element.split_once('/') {
                Some((kind @ ("channel" | "control"), pattern)) => {
                    instruments(model, rule, kind, pattern, channels)?
                }
                _ => model_groups(model, rule)?,
            };
            for (name, role, nominal) in groups {
                let parameter = parameter(model, rule, name, role, nominal)?;
                if let Some(twin) = all.iter().find(|p| overlaps(p, &parameter)) {
                    return Err(refuse(rule, format!("is already set by `{}`", twin.name)));
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
    pub(super) fn reach(&self, x: &[f64]) -> impl Iterator<Item = (f64, f64)> {
        self.iter_free().zip(x).map(|(p, x)| {
            let (lower, upper) = p.bounds();
            let most = if p.scale == Scale::Log {
                LOG_STEP
            } else {
                f64::INFINITY
            };
            ((lower - x).max(-most), (upper - x).min(most))
        })
    }

    /// Whether estimated parameter `j` changes the model, not an instrument.
    pub fn changes_model(&self, j: usize) -> bool {
        matches!(self.all[self.free[j]].role, Role::Model(_))
    }

    /// Gives the model of `data` the numbers of `nominal` changed by `x` (free).
    ///
    /// # Errors
    /// When the engine refuses the model.
    pub fn apply(&self, nominal: &Model, x: &[f64], data: &mut Data) -> Result<(), SysidError> {
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

fn refuse(rule: &ParameterRule, reason: String) -> SysidError {
    SysidError::Parameter {
        element: rule.element.clone(),
        attribute: rule.attribute.clone(),
        reason,
    }
}

type Group = (String, Role, f64);

fn model_groups(model: &Model, rule: &ParameterRule) -> Result<Vec<Group>, SysidError> {
    let targets = attribute::resolve(model, &rule.element, &rule.attribute, &rule.components)?;
    let with_value = |t: Target| {
        let value = t.value(model);
        (t, value)
    };
    if !rule.tied {
        return Ok(targets
            .into_iter()
            .map(|t| {
                let value = t.value(model);
                (t.address(), Role::Model(vec![with_value(t)]), value)
            })
            .collect());
    }
    // one group a component
    let mut components: Vec<usize> = targets.iter().map(|t| t.component).collect();
    components.sort_unstable();
    components.dedup();
    let several = components.len() > 1 || !rule.components.is_empty();
    Ok(components
        .into_iter()
        .map(|c| {
            let members: Vec<_> = targets
                .iter()
                .filter(|t| t.component == c)
                .cloned()
                .map(with_value)
                .collect();
            let component = if several {
                format!("[{c}]")
            } else {
                String::new()
            };
            let name = format!("{} {}{component}", rule.element, rule.attribute);
            let value = members[0].1;
            (name, Role::Model(members), value)
        })
        .collect())
}

fn instruments(
    model: &Model,
    rule: &ParameterRule,
    kind: &str,
    pattern: &str,
    channels: &[String],
) -> Result<Vec<Group>, SysidError> {
    let (instrument, nominal) = match (kind, rule.attribute.as_str()) {
        ("channel", "bias") => (Instrument::Bias, 0.0),
        ("channel", "gain") => (Instrument::Gain, 1.0),
        ("channel", "delay") => (Instrument::Delay, 0.0),
        ("control", "delay") => (Instrument::CommandDelay, 0.0),
        ("channel", _) => return Err(refuse(rule, "a channel has bias, gain and delay".into())),
        _ => return Err(refuse(rule, "a control has a delay only".into())),
    };
    let names: Vec<String> = if kind == "channel" {
        channels.to_vec()
    } else {
        (0..model.nu())
            .filter_map(|i| model.name(ObjectKind::Actuator, i).map(str::to_owned))
            .collect()
    };
    let found: Vec<&String> = names.iter().filter(|n| glob::matches(pattern, n)).collect();
    if found.is_empty() {
        let known = names.join(", ");
        return Err(refuse(
            rule,
            format!("no {kind} is named `{pattern}`; there are: {known}"),
        ));
    }
    let group = |pattern: &str| {
        let name = format!("{kind}/{pattern} {}", rule.attribute);
        (
            name,
            Role::Instrument(instrument, pattern.to_owned()),
            nominal,
        )
    };
    Ok(if rule.tied {
        vec![group(pattern)]
    } else {
        found.into_iter().map(|name| group(name)).collect()
    })
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

fn parameter(
    model: &Model,
    rule: &ParameterRule,
    name: String,
    role: Role,
    nominal: f64,
) -> Result<Parameter, SysidError> {
    let (positive, typical, unit) = match &role {
        Role::Model(targets) => {
            let a = targets[0].0.attribute;
            (a.positive, a.typical, targets[0].0.unit(model))
        }
        Role::Instrument(Instrument::Bias, _) => (false, 1e-3, ""),
        Role::Instrument(Instrument::Gain, _) => (true, 1e-2, "1"),
        Role::Instrument(..) => (false, 1e-3, "s"),
    };
    let start = rule.start.unwrap_or(nominal);
    let scale = rule.scale.unwrap_or(if positive && start > 0.0 {
        Scale::Log
    } else {
        Scale::Linear
    });
    let log = scale == Scale::Log;
    let lower = rule
        .lower
        .unwrap_or(if positive { 0.0 } else { f64::NEG_INFINITY });
    let upper = rule.upper.unwrap_or(f64::INFINITY);
    let prior = rule.prior.unwrap_or(nominal);
    let fail = |reason: String| Err(refuse(rule, format!("{reason} ({name})")));
    for (key, value) in [("start", start), ("prior", prior)] {
        if !value.is_finite() {
            return fail(format!("{key} is {value}, expected a number"));
        }
    }
    if lower >= upper {
        return fail(format!(
            "lower bound {lower} is not below the upper bound {upper}"
        ));
    }
    if log && lower < 0.0 {
        return fail(format!("lower bound {lower} is negative on a log scale"));
    }
    if log && start <= 0.0 {
        return fail(format!(
            "starts at {start} on a log scale; give a positive start or scale = \"linear\""
        ));
    }
    if !(lower..=upper).contains(&start) {
        return fail(format!(
            "starts at {start}, outside its bounds {lower} to {upper}"
        ));
    }
    if !rule.frozen && (start == lower || start == upper) && !(start == 0.0 && positive) {
        return fail(format!(
            "starts on its bound {start}, where it cannot move both ways; start inside"
        ));
    }
    let prior_sigma = rule.prior_sigma.unwrap_or(f64::INFINITY);
    if prior_sigma.is_nan() || prior_sigma <= 0.0 {
        return fail(format!(
            "prior_sigma is {prior_sigma}, expected a positive number; to hold it use frozen"
        ));
    }
    if log && prior <= 0.0 && prior_sigma.is_finite() {
        return fail(format!(
            "prior is {prior} on a log scale, expected a positive number"
        ));
    }
    Ok(Parameter {
        name,
        role,
        scale,
        unit,
        nominal,
        start,
        prior,
        prior_sigma,
        lower,
        upper,
        frozen: rule.frozen,
        typical: if log { 1.0 } else { start.abs().max(typical) },
    })
}
