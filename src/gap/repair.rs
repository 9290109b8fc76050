//! What a search comes to: the model that it ends with, as numbers and as a file.

use std::sync::Arc;

use super::GapError;
use super::effect::{EffectError, ModelFile};
use super::model::{Built, Chosen};
use super::verify::Machine;
use crate::mjcf::file::rewrite;
use crate::sysid::ensemble;
use crate::sysid::holdout::hold;
use crate::sysid::parameter::ParameterRule;
use crate::sysid::problem::Problem;

/// The model of a problem with free numbers `x`.
///
/// # Errors
/// The engine refuses a number.
pub(super) fn machine(problem: &Problem, x: &[f64]) -> Result<Machine, GapError> {
    let model = ensemble::model_at(&problem.model, &problem.parameters, x)?;
    let values = problem.parameters.values(x);
    let all = &problem.parameters.all;
    let held = hold(problem, |p| {
        all.iter()
            .position(|o| o.name == p.name)
            .map_or(p.start, |i| values[i])
    });
    Ok(Machine {
        model: Arc::new(model),
        parameters: held.parameters,
    })
}

/// The file of the base model with the effects and all fitted numbers.
///
/// # Errors
/// The engine refuses a number.
pub(super) fn repaired(
    (base, built): (&ModelFile, &Built),
    problem: &Problem,
    x: &[f64],
    chosen: &[Chosen],
) -> Result<String, GapError> {
    let model = ensemble::model_at(&problem.model, &problem.parameters, x)?;
    let effects: Vec<String> = (chosen.iter())
        .map(|c| format!("{} at {}", c.effect.about().name, c.place))
        .collect();
    let header = format!(
        "{} with what phantom gap {} found missing: {}.",
        base.path.file_name().unwrap_or_default().to_string_lossy(),
        env!("CARGO_PKG_VERSION"),
        if effects.is_empty() {
            "nothing".to_owned()
        } else {
            effects.join(", ")
        },
    );
    let text = rewrite(
        &built.file.xml,
        &model,
        &problem.parameters.targets(),
        &header,
    );
    Ok(text.map_err(EffectError::from)?)
}

/// What is estimated, numbers of the effects beginning where they are.
pub(super) fn rules(built: &Built) -> Vec<ParameterRule> {
    let mut rules = built.rules.clone();
    let first = rules.len() - built.estimated.len();
    for rule in &mut rules[first..] {
        rule.start = None;
    }
    rules
}
