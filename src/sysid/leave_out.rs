//! Leave one sensor out: fitted without it, does the model still say what it reads?
//!
//! For each sensor the problem is solved without its channels, from the solution with all of them; what the model then
//! predicts for the sensor is set against what it measured. An error far above the sensor's noise says that model or
//! sensor is wrong in a way that the whole fit covers up. Kolev and Todorov 2015 validate their estimates like this.

use std::sync::Arc;

use serde::Serialize;

use super::SysidError;
use super::fit::{Fit, Iteration, Start};
use super::method::Method;
use super::norm::Norm;
use super::predict::{channel_residuals, explain};
use super::problem::{ChannelRule, Problem, ProblemConfig};
use crate::mjcf::glob;
use crate::recording::Recording;

/// Least ratio of the trajectory's triangular factor up to which the other sensors determine the motion.
const OBSERVABLE: f64 = 1e-9;

/// A channel predicted without its sensor.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LeftOut {
    /// channel
    pub channel: String,
    /// of the errors
    pub unit: String,
    /// its noise
    pub sigma: f64,
    /// root mean square error in the fit with all sensors
    pub with: f64,
    /// in the fit without; none: the other sensors do not determine the motion
    pub without: Option<f64>,
}

/// Channels by sensor: components of a vector belong together.
pub fn sensors(problem: &Problem) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for channel in &problem.channels {
        let name = sensor(&channel.name);
        if !names.iter().any(|n| n == name) {
            names.push(name.to_owned());
        }
    }
    names
}

/// `tip` for `tip[2]`; positions and velocities of joints stand for themselves.
fn sensor(channel: &str) -> &str {
    match channel.rsplit_once('[') {
        Some((name, rest))
            if !matches!(name, "qpos" | "qvel")
                && rest
                    .strip_suffix(']')
                    .is_some_and(|i| i.parse::<usize>().is_ok()) =>
        {
            name
        }
        _ => channel,
    }
}

/// Fits without `sensor` and predicts it; nothing if `watch` stops it by `false`.
///
/// # Errors
/// The engine refuses a number.
pub fn without(
    problem: &Problem,
    fit: &Fit,
    config: &ProblemConfig,
    recordings: &[(String, Recording)],
    left_out: &str,
    method: &Method,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Option<Vec<LeftOut>>, SysidError> {
    let of_sensor = |name: &str| sensor(name) == left_out;
    let mut rest = config.clone();
    for channel in problem.channels.iter().filter(|c| of_sensor(&c.name)) {
        let rule = ChannelRule {
            name: channel.name.clone(),
            noise_sigma: None,
            norm: Norm::Quadratic,
            ignore: true,
        };
        rest.channel.insert(0, rule);
    }
    // its bias, gain and delay are not parameters any more
    rest.parameter
        .retain(|rule| match rule.element.strip_prefix("channel/") {
            None => true,
            Some(pattern) => (problem.channels.iter())
                .any(|c| !of_sensor(&c.name) && glob::matches(pattern, &c.name)),
        });
    let explained = explain(problem, &fit.x, &fit.trajectories)?;
    let mut results: Vec<LeftOut> = channel_residuals(problem, &explained)
        .into_iter()
        .filter(|c| of_sensor(&c.name))
        .map(|c| LeftOut {
            channel: c.name,
            unit: c.unit,
            sigma: c.sigma,
            with: c.rms,
            without: None,
        })
        .collect();
    let Ok(mut reduced) = Problem::new(Arc::clone(&problem.model), &rest, recordings) else {
        // nothing else was measured
        return Ok(Some(results));
    };
    reduced.force_sigma.clone_from(&fit.force_sigma);
    if reduced
        .trials
        .iter()
        .zip(&problem.trials)
        .any(|(a, b)| (a.n_knots, a.start_s) != (b.n_knots, b.start_s))
    {
        return Ok(Some(results));
    }
    let x = |name: &str| {
        let at = problem.parameters.iter_free().position(|p| p.name == name);
        at.map(|i| fit.x[i])
    };
    let start = Start {
        x: (reduced.parameters.iter_free())
            .map(|p| x(&p.name).unwrap_or_else(|| p.to_x(p.start)))
            .collect(),
        trajectories: Some(fit.trajectories.clone()),
        force_scale: None,
    };
    let method = method.as_strict_as(fit, false);
    let mut stopped = false;
    let again = method.solve(&reduced, &start, &mut |i| {
        let go_on = watch(i);
        stopped |= !go_on;
        go_on
    })?;
    if stopped {
        return Ok(None);
    }
    if again.weakest.0 < OBSERVABLE {
        return Ok(Some(results));
    }
    let both: Vec<f64> = (problem.parameters.iter_free().zip(&fit.x))
        .map(|(p, &own)| {
            let at = reduced
                .parameters
                .iter_free()
                .position(|q| q.name == p.name);
            at.map_or(own, |i| again.x[i])
        })
        .collect();
    let predicted = channel_residuals(problem, &explain(problem, &both, &again.trajectories)?);
    for result in &mut results {
        let found = predicted.iter().find(|c| c.name == result.channel);
        result.without = found.map(|c| c.rms);
    }
    Ok(Some(results))
}

#[cfg(test)]
mod tests {
    use super::sensor;

    #[test]
    fn components_belong_to_one_sensor() {
        assert_eq!(sensor("tip[2]"), "tip");
        assert_eq!(sensor("encoder"), "encoder");
        assert_eq!(sensor("qpos[hinge]"), "qpos[hinge]");
        assert_eq!(sensor("qpos[free][3]"), "qpos[free]");
    }
}
