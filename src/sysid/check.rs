//! Mistakes that would otherwise show as a result that says nothing.

use super::SysidError;
use super::problem::{Problem, ProblemConfig};
use super::shooting::probe::unseen;
use crate::mjcf::glob;
use crate::mujoco::ObjectKind;
use crate::recording::{Kind, Recording};

/// Looks for rules without a channel, channels whose noise cannot be guessed, and joints and parameters that no reading
/// depends on. `x` (free) is where the search begins.
///
/// # Errors
/// The first mistake, with what to do.
pub fn check(
    problem: &Problem,
    config: &ProblemConfig,
    recordings: &[(String, Recording)],
    x: &[f64],
) -> Result<(), SysidError> {
    rules(config, recordings)?;
    constant(problem)?;
    let unseen = unseen(problem, x)?;
    let model = &problem.model;
    let joints: Vec<&str> = (unseen.joints.iter())
        .map(|&joint| model.name(ObjectKind::Joint, joint).unwrap_or("(unnamed)"))
        .filter(|name| !config.unseen.iter().any(|u| glob::matches(u, name)))
        .collect();
    if !joints.is_empty() {
        let names = joints.join("`, `");
        return Err(SysidError::Unseen {
            what: format!("where joint `{names}` is"),
            remedy: format!(
                "record a sensor that shows it, or, if its motion does not matter, write unseen = [\"{}\"] at the top of \
                 the parameter file",
                joints.join("\", \"")
            ),
        });
    }
    let parameters: Vec<_> = problem.parameters.iter_free().collect();
    let silent: Vec<&str> = (unseen.parameters.iter())
        // what is known of others stays all that is known
        .filter(|&&j| parameters[j].prior_sigma.is_infinite())
        .map(|&j| parameters[j].name.as_str())
        .collect();
    if !silent.is_empty() {
        return Err(SysidError::Unseen {
            what: format!("parameter `{}`: no reading changes with it", silent.join("`, `")),
            remedy: "hold it (frozen = true), say what is known of it (prior_sigma), leave it out, or record a motion \
                     that excites it (phantom sysid design)"
                .into(),
        });
    }
    Ok(())
}

/// Rules for channels that are in none of the recordings.
fn rules(config: &ProblemConfig, recordings: &[(String, Recording)]) -> Result<(), SysidError> {
    let mut names: Vec<&str> = (recordings.iter())
        .flat_map(|(_, r)| r.channels())
        .filter(|c| c.kind == Kind::Sensor)
        .map(|c| c.name.as_str())
        .collect();
    names.sort_unstable();
    names.dedup();
    for rule in &config.channel {
        if !names.iter().any(|n| glob::matches(&rule.name, n)) {
            return Err(SysidError::Channel {
                channel: rule.name.clone(),
                reason: format!(
                    "none is recorded of this name; there are: {}",
                    names.join(", ")
                ),
            });
        }
    }
    Ok(())
}

/// Channels that never move, of which the noise would be guessed to be nothing.
fn constant(problem: &Problem) -> Result<(), SysidError> {
    for (c, channel) in problem.channels.iter().enumerate() {
        let mut values = (problem.samples())
            .filter(|s| s.channel == c)
            .map(|s| s.value);
        let first = values.next();
        if let Some(first) = first
            && !channel.sigma_known
            && values.all(|v| v == first)
        {
            return Err(SysidError::Channel {
                channel: channel.name.clone(),
                reason: format!(
                    "every sample is {first}, which says nothing about its noise; if it is a reading, give its \
                     noise_sigma in a [[channel]] of the parameter file, else leave it out there (ignore = true)"
                ),
            });
        }
    }
    Ok(())
}
