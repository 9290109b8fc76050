//! A rule of a parameter file, and the parameters that it means for a model.

use serde::{Deserialize, Serialize};

use super::SysidError;
use super::parameter::{Instrument, Parameter, Role, Scale};
use crate::mjcf::attribute::{self, Target};
use crate::mjcf::glob;
use crate::mujoco::{Model, ObjectKind};

/// One rule of the file; see [`super::parameter`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ParameterRule {
    /// `kind/glob`
    pub element: String,
    /// globs of names that it passes over
    #[serde(default)]
    pub except: Vec<String>,
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
            except: Vec::new(),
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

/// The parameters of a rule; `channels` are the names of the recorded sensor channels.
pub(super) fn parameters(
    model: &Model,
    rule: &ParameterRule,
    channels: &[String],
) -> Result<Vec<Parameter>, SysidError> {
    let groups = match rule.element.split_once('/') {
        Some((kind @ ("channel" | "control"), pattern)) => {
            if !rule.except.is_empty() {
                let reason = "`except` is for elements of the model";
                return Err(refuse(rule, reason.into()));
            }
            instruments(model, rule, kind, pattern, channels)?
        }
        _ => model_groups(model, rule)?,
    };
    (groups.into_iter())
        .map(|(name, role, nominal)| parameter(model, rule, name, role, nominal))
        .collect()
}

pub(super) fn refuse(rule: &ParameterRule, reason: String) -> SysidError {
    SysidError::Parameter {
        element: rule.element.clone(),
        attribute: rule.attribute.clone(),
        reason,
    }
}

type Group = (String, Role, f64);

fn model_groups(model: &Model, rule: &ParameterRule) -> Result<Vec<Group>, SysidError> {
    let mut targets = attribute::resolve(model, &rule.element, &rule.attribute, &rule.components)?;
    targets.retain(|t| !rule.except.iter().any(|e| glob::matches(e, &t.element)));
    if targets.is_empty() {
        return Err(refuse(rule, "`except` leaves no element".into()));
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn globs_pass_over_what_they_except() {
        let model = Model::from_xml_str(
            r#"<mujoco><worldbody>
              <body name="a"><joint name="ja" damping="1"/><geom size=".1"/>
                <body name="load"><geom size=".1"/></body></body></worldbody></mujoco>"#,
        )
        .expect("loads");
        let rule = |element: &str, attribute: &str, except: &str| ParameterRule {
            except: vec![except.to_owned()],
            ..ParameterRule::new(element, attribute)
        };
        let of = |rule: &ParameterRule| parameters(&model, rule, &["angle".to_owned()]);
        let masses = of(&rule("body/*", "mass", "lo*")).expect("one");
        let names: Vec<&str> = masses.iter().map(|p| p.name.as_str()).collect();
        assert_eq!(names, ["body/a mass"]);
        let tied = ParameterRule {
            tied: true,
            ..rule("body/*", "mass", "load")
        };
        let [Parameter { role, .. }] = &of(&tied).expect("one")[..] else {
            panic!("one parameter");
        };
        assert!(matches!(role, Role::Model(targets) if targets.len() == 1));
        for (element, attribute, said) in [
            ("joint/*", "damping", "leaves no element"),
            ("channel/*", "bias", "elements of the model"),
        ] {
            let refused = of(&rule(element, attribute, "*")).expect_err("nothing is meant");
            assert!(refused.to_string().contains(said), "{refused}");
        }
    }
}
