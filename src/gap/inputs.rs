//! Whether model, parameters and recordings fit together, and what of them is looked at.

use std::sync::Arc;

use super::effect;
use super::run::Input;
use super::search::Search;
use super::{GapError, windows};
use crate::mujoco::Model;
use crate::sysid::problem::{ChannelRule, Problem, ProblemConfig};

/// Standard deviation of a parameter, in changes that matter, from which the recordings say nothing of it.
const BLIND: f64 = 30.0;

/// Names of the effects to look for: those asked for, and dry friction where one of them is a variety of it that has none to
/// vary.
///
/// # Errors
/// Effects must exist, and have a place in the model.
pub(super) fn wanted(names: &[String], model: &Model) -> Result<Vec<String>, GapError> {
    let mut wanted = names.to_vec();
    for name in names {
        let known = || {
            let mut all: Vec<&str> = effect::CATALOGUE.iter().map(|e| e.about().name).collect();
            all.sort_unstable();
            all.join(", ")
        };
        let places = effect::named(name).map(|e| (e, e.places(model)));
        let reason = match places {
            None => format!("there is no effect `{name}`; there are {}", known()),
            Some((e, places)) if places.is_empty() => format!(
                "the model cannot carry the effect `{name}` ({}): it has no place where that could act; leave it out, \
                 or give the model such a place",
                e.about().law
            ),
            Some((e, places)) => {
                let bare = e.about().is_variety() && !places.iter().any(|p| p.is_dry(model));
                if bare && !wanted.iter().any(|n| n == effect::DRY) {
                    wanted.push(effect::DRY.to_owned());
                }
                continue;
            }
        };
        return Err(GapError::Input { reason });
    }
    Ok(wanted)
}

/// Whether an effect is among the names `only` to look for; none: all.
pub(super) fn is_wanted(only: &[String], name: &str) -> bool {
    only.is_empty() || only.iter().any(|n| n == name)
}

/// Every fitted parameter must show in the recordings, or have a prior.
pub(super) fn excited(search: &Search<'_>) -> Result<(), GapError> {
    let parameters = &search.windows.problem.parameters;
    let linear = search.windows.linearise(&search.x)?;
    let spread = search.normal(&linear).spread();
    let blind: Vec<&str> = (parameters.iter_free().zip(&spread))
        .filter(|(p, sigma)| !p.has_prior() && **sigma > BLIND * p.typical)
        .map(|(p, _)| p.name.as_str())
        .collect();
    if blind.is_empty() {
        return Ok(());
    }
    let reason = format!(
        "the recordings do not have the excitation that these parameters need: {}; record a motion on which they \
         depend (`phantom sysid design` proposes one), give them a `prior_sigma`, or do not fit them",
        blind.join(", ")
    );
    Err(GapError::Input { reason })
}

/// The configuration, without the velocities of joints whose positions are measured: those are made from positions, by
/// filters that look like late sensors.
pub(super) fn judged(input: &Input<'_>) -> Result<ProblemConfig, GapError> {
    let model = &input.model.model;
    let names = Problem::new(
        Arc::clone(model),
        &without_parameters(input.config),
        input.train,
    )?;
    let positions =
        (names.channels.iter()).any(|c| c.stage == crate::sysid::problem::Stage::Position);
    let mut config = input.config.clone();
    if positions {
        let velocities = names
            .channels
            .iter()
            .filter(|c| windows::is_velocity(model, c.source));
        let ignored = velocities.map(|c| ChannelRule {
            name: c.name.clone(),
            noise_sigma: None,
            norm: crate::sysid::norm::Norm::default(),
            ignore: true,
        });
        config.channel = ignored.chain(config.channel).collect();
    }
    Ok(config)
}

pub(super) fn without_parameters(config: &ProblemConfig) -> ProblemConfig {
    ProblemConfig {
        parameter: Vec::new(),
        ..config.clone()
    }
}

/// Held-out recordings must be of the same machine: the same channels.
pub(super) fn same_channels(
    train: &Problem,
    config: &ProblemConfig,
    input: &Input<'_>,
) -> Result<(), GapError> {
    if input.holdout.is_empty() {
        return Ok(());
    }
    let known: Vec<&String> = (input.train.iter())
        .map(|(_, r)| &r.meta.model_hash)
        .filter(|hash| !hash.is_empty())
        .collect();
    for (name, recording) in input.holdout {
        let own = &recording.meta.model_hash;
        if let Some(other) = (known.iter()).find(|hash| !own.is_empty() && **hash != own) {
            let reason = format!(
                "held-out recording `{name}` is of another model than the training recordings ({own}, {other})"
            );
            return Err(GapError::Input { reason });
        }
    }
    let held = Problem::new(
        Arc::clone(&input.model.model),
        &without_parameters(config),
        input.holdout,
    )?;
    let missing: Vec<&str> = (train.channels.iter())
        .filter(|c| !held.channels.iter().any(|h| h.name == c.name))
        .map(|c| c.name.as_str())
        .collect();
    if !missing.is_empty() {
        let reason = format!(
            "held-out recordings have no channel {}, which the training recordings have",
            missing.join(", ")
        );
        return Err(GapError::Input { reason });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{effect, wanted};
    use crate::gap::masses::machine;

    #[test]
    fn a_variety_of_friction_brings_what_it_varies() {
        let (smooth, dry) = (machine("", ""), machine("", r#"frictionloss=".1""#));
        let asked = |names: &[&str], model| {
            let names: Vec<String> = names.iter().map(|n| (*n).to_owned()).collect();
            wanted(&names, model).expect("they have places")
        };
        let both = ["asymmetric_friction", effect::DRY];
        assert_eq!(asked(&both[..1], &smooth.model), both);
        assert_eq!(asked(&both, &smooth.model), both);
        assert_eq!(asked(&both[..1], &dry.model), both[..1]);
        assert_eq!(asked(&["joint_spring"], &smooth.model), ["joint_spring"]);
        assert!(asked(&[], &smooth.model).is_empty());
    }
}
