//! The cost of rollouts: of parameters, and of every start by itself.

use std::sync::Arc;

use rayon::prelude::*;

use crate::compare::rollouts::{Rolled, roll_out};
use crate::compare::start::{Start, starts};
use crate::compare::{CompareError, Settings, States};
use crate::mujoco::Model;
use crate::recording::Recording;
use crate::sysid::SysidError;
use crate::sysid::ensemble;
use crate::sysid::instrument;
use crate::sysid::parameter::Role;
use crate::sysid::problem::Problem;

/// Rollouts of all trials of a problem.
pub(crate) struct Objective<'a> {
    pub problem: &'a Problem,
    pub protocol: &'a Settings,
    /// whether readings change with parameters
    instruments: bool,
}

/// What deviates: a channel up to a horizon.
#[derive(Debug, Clone, PartialEq)]
struct Term {
    channel: String,
    horizon: usize,
    /// dimensions of the deviation, shared among the horizons
    weight: f64,
}

/// Rollouts of all trials at some parameters.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Rollouts {
    /// trial, and time of its start since the first knot, s
    pub starts: Vec<(usize, f64)>,
    terms: Vec<Term>,
    /// (starts × terms) mean deviations; none where the recording ends before
    deviations: Vec<Vec<Option<f64>>>,
}

/// Times of the starts of a trial since its first knot, s, and its rollouts.
type Trial = (Vec<f64>, Vec<Rolled>);

/// Least mean deviation, m or rad: a logarithm needs one.
const LEAST: f64 = 1e-12;

impl Rollouts {
    /// (terms) mean over the starts.
    pub(crate) fn scales(&self) -> Vec<f64> {
        (0..self.terms.len())
            .map(|t| {
                let all = self.deviations.iter().filter_map(|d| d[t]);
                let (sum, n) = all.fold((0.0, 0.0), |(s, n), d| (s + d, n + 1.0));
                (sum / f64::max(n, 1.0)).max(LEAST)
            })
            .collect()
    }

    /// −log p of all starts, with the scales of greatest likelihood.
    pub(crate) fn cost(&self) -> f64 {
        let scales = self.scales();
        (self
            .deviations
            .iter()
            .flatten()
            .zip(self.terms.iter().zip(&scales).cycle()))
        .filter(|(d, _)| d.is_some())
        .map(|(_, (term, scale))| term.weight * scale.ln())
        .sum()
    }

    /// Sum of the weights of all deviations: a cost over it is the mean logarithm of a deviation.
    pub(crate) fn weight(&self) -> f64 {
        let all = self.deviations.iter().flatten();
        (all.zip(self.terms.iter().cycle()))
            .filter(|(d, _)| d.is_some())
            .map(|(_, term)| term.weight)
            .sum()
    }

    /// (starts) how much smaller the deviations of `other` are, (d − d′)/(d + d′) from −1 to 1, by weight; none where it
    /// has other starts.
    pub(crate) fn falls(&self, other: &Self) -> Option<Vec<f64>> {
        if self.starts != other.starts || self.terms != other.terms {
            return None;
        }
        let of = |(a, b): (&Vec<Option<f64>>, &Vec<Option<f64>>)| {
            (a.iter().zip(b).zip(&self.terms))
                .filter_map(|((a, b), term)| {
                    let (a, b) = ((*a)?, (*b)?);
                    Some(term.weight * (a - b) / (a + b).max(LEAST))
                })
                .sum()
        };
        Some(
            self.deviations
                .iter()
                .zip(&other.deviations)
                .map(of)
                .collect(),
        )
    }

    /// Deviations of each channel up to each horizon (index): one a start.
    pub(crate) fn kinds(&self) -> impl Iterator<Item = (&str, usize, Vec<f64>)> {
        self.terms.iter().enumerate().map(|(t, term)| {
            let all = self.deviations.iter().filter_map(|d| d[t]).collect();
            (term.channel.as_str(), term.horizon, all)
        })
    }

    /// (starts) deviations in units of `scales`: −log p of each start with scales that are given.
    pub(crate) fn costs(&self, scales: &[f64]) -> Vec<f64> {
        let of = |start: &Vec<Option<f64>>| {
            (start.iter().zip(self.terms.iter().zip(scales)))
                .filter_map(|(d, (term, scale))| Some(term.weight * (*d)? / scale))
                .sum()
        };
        self.deviations.iter().map(of).collect()
    }
}

impl<'a> Objective<'a> {
    pub(crate) fn new(problem: &'a Problem, protocol: &'a Settings) -> Self {
        let instruments =
            (problem.parameters.all.iter()).any(|p| matches!(p.role, Role::Instrument(..)));
        Self {
            problem,
            protocol,
            instruments,
        }
    }

    /// The model at free parameters `x`.
    pub(super) fn model(&self, x: &[f64]) -> Result<Arc<Model>, SysidError> {
        let Problem {
            model, parameters, ..
        } = self.problem;
        Ok(Arc::new(ensemble::model_at(model, parameters, x)?))
    }

    /// Recorded states and starts of a trial; `None` where it has none.
    pub(super) fn begin(
        &self,
        trial: usize,
        model: &Model,
        x: &[f64],
    ) -> Result<Option<(States, Vec<Start>)>, SysidError> {
        let states = self.states(trial, model, x)?;
        let starts = starts(model, &states, self.protocol).map_err(refused)?;
        Ok(starts.map(|starts| (states, starts)))
    }

    /// Recorded states of a trial.
    pub(super) fn states(
        &self,
        trial: usize,
        model: &Model,
        x: &[f64],
    ) -> Result<States, SysidError> {
        let recording = &self.problem.trials[trial].recording;
        let corrected;
        let recording: &Recording = if self.instruments {
            let mut parameters = self.problem.parameters.clone();
            for (p, value) in parameters
                .all
                .iter_mut()
                .zip(self.problem.parameters.values(x))
            {
                p.start = value;
            }
            corrected = instrument::corrected(recording, &parameters);
            &corrected
        } else {
            recording
        };
        States::new(recording, model, self.protocol).map_err(refused)
    }

    /// All rollouts at `x`; `None` where one breaks down.
    pub(crate) fn roll_out(&self, x: &[f64]) -> Result<Option<Rollouts>, SysidError> {
        let model = self.model(x)?;
        let mut out = Rollouts {
            starts: Vec::new(),
            terms: Vec::new(),
            deviations: Vec::new(),
        };
        let horizons = self.protocol.horizons_s.len() + usize::from(self.protocol.to_end);
        let of = |trial: usize| -> Result<Option<Trial>, SysidError> {
            let Some((states, starts)) = self.begin(trial, &model, x)? else {
                return Ok(None);
            };
            let rolled = roll_out(&model, &states, &starts, self.protocol, &|data, time| {
                states.controls_at(time, data.ctrl_mut());
            })
            .map_err(refused)?;
            let first_s = self.problem.trials[trial].start_s;
            let since = |start: &Start| (states.time_s[start.sample] - first_s).max(0.0);
            Ok(Some((starts.iter().map(since).collect(), rolled)))
        };
        let trials = 0..self.problem.trials.len();
        let all: Vec<_> = trials.into_par_iter().map(of).collect();
        for (trial, one) in all.into_iter().enumerate() {
            let Some((times, rolled)) = one? else {
                continue;
            };
            if rolled.iter().any(Rolled::diverged) {
                return Ok(None);
            }
            for (time, rolled) in times.iter().zip(&rolled) {
                out.starts.push((trial, *time));
                out.add(rolled, horizons);
            }
        }
        let n = out.terms.len();
        for row in &mut out.deviations {
            row.resize(n, None);
        }
        Ok(Some(out))
    }
}

impl Rollouts {
    fn add(&mut self, rolled: &Rolled, horizons: usize) {
        let mut row = vec![None; self.terms.len()];
        for d in rolled.positions() {
            let known =
                (self.terms.iter()).position(|t| t.horizon == d.horizon && t.channel == d.channel);
            let at = known.unwrap_or_else(|| {
                self.terms.push(Term {
                    channel: d.channel.to_owned(),
                    horizon: d.horizon,
                    weight: d.dimensions as f64 / horizons as f64,
                });
                row.push(None);
                self.terms.len() - 1
            });
            row[at] = Some(d.mean);
        }
        self.deviations.push(row);
    }
}

fn refused(error: CompareError) -> SysidError {
    match error {
        CompareError::Mujoco(error) => error.into(),
        other => SysidError::Setting {
            reason: other.to_string(),
        },
    }
}
