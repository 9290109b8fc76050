//! Recordings that were not used: does the identified model explain and predict them better than the nominal one?
//!
//! - **Residual**: parameters held, the motion estimated with the noise and unexplained force of the fit. The costs of
//!   both models differ knot by knot; the mean difference has a standard error in which autocorrelation is respected.
//! - **Rollouts**: from recorded states, under the recorded controls, over several horizons
//!   ([`crate::compare::rollouts`]); each model with its own sensor biases, gains and delays.
//!
//! The verdict is "better" if the residual falls by more than two standard errors, and rollouts do not get worse.

use std::sync::Arc;

use serde::Serialize;

use super::SysidError;
use super::fit::{Fit, Iteration, Start};
use super::method::Method;
use super::parameter::{Parameter, Parameters};
use super::predict::{
    ChannelResidual, Explained, ForceResidual, channel_residuals, force_residuals,
};
use super::problem::{Problem, ProblemConfig, Setting};
use super::{ensemble, instrument, long_run, rollouts};
use crate::compare::{self, CompareError, Settings, rollouts::Rollouts};
use crate::mujoco::Model;
use crate::recording::Recording;

/// Geometric mean of rollout errors, identified over nominal, up to which they count as not worse.
const NOT_WORSE: f64 = 1.02;

/// What held-out recordings say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// explains them better, and predicts no worse
    Better,
    /// no such evidence
    NotBetter,
}

/// One model on the held-out recordings, motion estimated.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Residual {
    /// cost a knot, or a rollout
    pub cost_per_knot: f64,
    /// of every channel
    pub channels: Vec<ChannelResidual>,
    /// of every degree of freedom
    pub forces: Vec<ForceResidual>,
}

/// A rollout error of both models.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Growth {
    /// joint or body
    pub channel: String,
    /// of the errors
    pub unit: String,
    /// s; none: to the end of the recording
    pub horizon_s: Option<f64>,
    /// root mean square over the horizon, nominal model
    pub nominal: f64,
    /// identified
    pub identified: f64,
}

/// Rollouts of both models.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Prediction {
    /// rollouts of each model
    pub n: usize,
    /// of which the simulation broke down, nominal and identified
    pub diverged: [usize; 2],
    /// by channel and horizon
    pub growth: Vec<Growth>,
    /// geometric mean of identified over nominal; none: no error was positive
    pub ratio: Option<f64>,
}

/// The result.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Holdout {
    /// names
    pub recordings: Vec<String>,
    /// the model as it was
    pub nominal: Residual,
    /// as identified
    pub identified: Residual,
    /// fall of the cost a knot
    pub gain: f64,
    /// its standard error
    pub gain_sigma: f64,
    /// errors of rollouts; none: see `no_prediction`
    pub prediction: Option<Prediction>,
    /// why there are no rollouts
    pub no_prediction: Option<String>,
    /// summary
    pub verdict: Verdict,
}

/// Compares the models on `recordings`; `watch` stops it by `false`, and then there is no result.
///
/// # Errors
/// A recording does not fit, or the engine refuses a number.
pub fn test(
    trained: &Problem,
    fit: &Fit,
    config: &ProblemConfig,
    recordings: &[(String, Recording)],
    method: &Method,
    protocol: &Settings,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Option<Holdout>, SysidError> {
    let problem = Problem::new(Arc::clone(&trained.model), config, recordings)?;
    let values = trained.parameters.values(&fit.x);
    let found = |name: &str| {
        let at = trained.parameters.all.iter().position(|p| p.name == name);
        at.map(|i| values[i])
    };
    let nominal = hold(&problem, |p| p.nominal);
    let identified = hold(&problem, |p| found(&p.name).unwrap_or(p.start));
    let Some((mut nominal_residual, mut nominal_cost)) =
        residual(nominal.clone(), fit, method, watch)?
    else {
        return Ok(None);
    };
    let Some((mut identified_residual, mut cost)) =
        residual(identified.clone(), fit, method, watch)?
    else {
        return Ok(None);
    };
    if let Method::Rollout(settings) = method {
        // recordings are explained as far as rollouts follow them, in units of the nominal model's deviations
        let before = rollouts::costs(&nominal, settings, None)?;
        let after = rollouts::costs(&identified, settings, Some(&before.scales))?;
        (nominal_cost, cost) = (before.of_starts, after.of_starts);
        nominal_residual.cost_per_knot = mean(&nominal_cost);
        identified_residual.cost_per_knot = mean(&cost);
    }
    let (gain, gain_sigma) = difference(&nominal_cost, &cost);
    let model_of = |p: &Problem| ensemble::model_at(&p.model, &p.parameters, &[]);
    let models = [model_of(&nominal)?, model_of(&identified)?].map(Arc::new);
    let predicted = predict(
        &models,
        &[&nominal.parameters, &identified.parameters],
        recordings,
        protocol,
    );
    let (prediction, no_prediction) = match predicted {
        Ok(prediction) => (Some(prediction), None),
        Err(CompareError::Mujoco(error)) => return Err(error.into()),
        Err(other) => (None, Some(other.to_string())),
    };
    let no_worse = prediction
        .as_ref()
        .is_none_or(|p| p.ratio.is_none_or(|r| r <= NOT_WORSE) && p.diverged[1] <= p.diverged[0]);
    let verdict = if gain > 2.0 * gain_sigma && no_worse {
        Verdict::Better
    } else {
        Verdict::NotBetter
    };
    Ok(Some(Holdout {
        recordings: recordings.iter().map(|(name, _)| name.clone()).collect(),
        nominal: nominal_residual,
        identified: identified_residual,
        gain,
        gain_sigma,
        prediction,
        no_prediction,
        verdict,
    }))
}

/// The problem with every parameter held at `value`.
pub(crate) fn hold(problem: &Problem, value: impl Fn(&Parameter) -> f64) -> Problem {
    let mut out = problem.clone();
    for p in &mut out.parameters.all {
        p.start = value(p);
    }
    let held: Vec<f64> = out.parameters.iter_free().map(|p| p.start).collect();
    let fixed = |setting: &mut Setting| {
        if let Setting::Free(j) = *setting {
            *setting = Setting::Fixed(held[j]);
        }
    };
    for channel in &mut out.channels {
        [&mut channel.bias, &mut channel.gain, &mut channel.delay]
            .into_iter()
            .for_each(fixed);
    }
    out.command_delay.iter_mut().for_each(fixed);
    out.parameters.free.clear();
    out
}

/// Costs of every trial and knot, or of every trial and rollout.
type KnotCosts = Vec<Vec<f64>>;

/// Estimates the motion with parameters held and the noise of `fit`.
fn residual(
    mut problem: Problem,
    fit: &Fit,
    method: &Method,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Option<(Residual, KnotCosts)>, SysidError> {
    problem.force_sigma.clone_from(&fit.force_sigma);
    let method = method.as_strict_as(fit, true).of_motion();
    let start = Start {
        x: Vec::new(),
        trajectories: None,
        force_scale: None,
    };
    let mut stopped = false;
    let held = method.solve(&problem, &start, &mut |i| {
        let go_on = watch(i);
        stopped |= !go_on;
        go_on
    })?;
    if stopped {
        return Ok(None);
    }
    let explained = method.explain(&problem, &held)?;
    let costs = (problem.trials.iter().zip(&explained))
        .map(|(trial, e)| knot_costs(&problem, fit, trial.n_knots, e))
        .collect::<Vec<_>>();
    let residual = Residual {
        cost_per_knot: mean(&costs),
        channels: channel_residuals(&problem, &explained),
        forces: force_residuals(&problem, &explained, &fit.force_sigma),
    };
    Ok(Some((residual, costs)))
}

fn mean(costs: &KnotCosts) -> f64 {
    let n: usize = costs.iter().map(Vec::len).sum();
    costs.iter().flatten().sum::<f64>() / n as f64
}

/// Cost of every knot of a trial: its forces, and the samples from it to the next.
fn knot_costs(problem: &Problem, fit: &Fit, n_knots: usize, explained: &Explained) -> Vec<f64> {
    let (nv, h) = (problem.model.nv(), problem.model.timestep());
    let mut costs = vec![0.0; n_knots];
    for (k, row) in explained.force.chunks_exact(nv).enumerate() {
        for ((force, sigma), norm) in row.iter().zip(&fit.force_sigma).zip(&problem.force_norm) {
            if *sigma > 0.0 {
                costs[k] += norm.cost(force / sigma);
            }
        }
    }
    for (channel, p) in problem.channels.iter().zip(&explained.channels) {
        for ((time, m), z) in p.time_s.iter().zip(&p.measured).zip(&p.predicted) {
            let k = ((time / h) as usize).min(n_knots - 1);
            costs[k] += channel.norm.cost((z - m) / channel.sigma);
        }
    }
    costs
}

/// Mean of a − b over all knots, and its standard error.
fn difference(a: &[Vec<f64>], b: &[Vec<f64>]) -> (f64, f64) {
    let series: Vec<Vec<f64>> = (a.iter().zip(b))
        .map(|(a, b)| a.iter().zip(b).map(|(a, b)| a - b).collect())
        .collect();
    long_run::mean(&series)
}

/// Rollouts of both models.
fn predict(
    models: &[Arc<Model>; 2],
    parameters: &[&Parameters; 2],
    recordings: &[(String, Recording)],
    settings: &Settings,
) -> Result<Prediction, CompareError> {
    let settings = Settings {
        forces: false,
        ..settings.clone()
    };
    let run = |i: usize| -> Result<Rollouts, CompareError> {
        let corrected: Vec<Recording> = (recordings.iter())
            .map(|(_, r)| instrument::corrected(r, parameters[i]))
            .collect();
        Ok(compare::compare(&models[i], &corrected, &settings, None, &|| ())?.rollouts)
    };
    let (nominal, identified) = (run(0)?, run(1)?);
    let growth: Vec<Growth> = (nominal.growth.iter())
        .filter_map(|a| {
            let same = |b: &&compare::rollouts::Growth| {
                b.channel == a.channel && b.horizon_s == a.horizon_s
            };
            let b = identified.growth.iter().find(same)?;
            Some(Growth {
                channel: a.channel.clone(),
                unit: a.unit.clone(),
                horizon_s: a.horizon_s,
                nominal: a.window_rms,
                identified: b.window_rms,
            })
        })
        .collect();
    let logs: Vec<f64> = (growth.iter())
        .filter(|g| g.nominal > 0.0 && g.identified > 0.0)
        .map(|g| (g.identified / g.nominal).ln())
        .collect();
    let ratio = (!logs.is_empty()).then(|| (logs.iter().sum::<f64>() / logs.len() as f64).exp());
    Ok(Prediction {
        n: nominal.n,
        diverged: [nominal.diverged, identified.diverged],
        growth,
        ratio,
    })
}
