//! Gauss-Newton over ensembles that become narrower.

use nalgebra::DVector;

use super::broken;
use super::course::{Course, Here};
use super::ensemble::{Ensemble, Slopes};
use super::step::Quadratic;
use crate::sysid::SysidError;
use crate::sysid::fit::{Fit, Innovations, Iteration, Status};
use crate::sysid::parameter::Parameter;
use crate::sysid::problem::Problem;

/// Spread of the first ensemble, in prior spreads, or in sizes where there are none.
const WIDE: [f64; 2] = [0.3, 0.1];
/// Spread of an ensemble, in standard deviations of the estimate.
const SPREAD: f64 = 4.0;
/// Least change of a spread from ensemble to ensemble.
const SHRINK: f64 = 0.5;
/// Farthest a parameter goes in one step, in spreads.
const FAR: f64 = 2.0;
/// Parts of a step that are tried.
const PARTS: [f64; 3] = [1.0, 0.5, 0.25];
/// Rise of F that is taken for chaos, in parts of the ensemble's roughness.
const CHAOS: f64 = 0.5;
/// Fall of F that is one, in parts of what chaos leaves in an ensemble's mean.
const FALL: f64 = 2.0;
/// Ensembles without a lower cost after which there is none.
const PATIENCE: usize = 2;
/// Ensembles at the end that are averaged.
const LAST: usize = 4;

/// The present point of the search.
pub(super) struct Search<'a> {
    course: Course<'a>,
    x: Vec<f64>,
    /// one simulation there
    here: Here,
    spreads: Vec<f64>,
    /// least cost of an ensemble's mean so far, and ensembles since
    least: (f64, usize),
    /// centres of steps and ensembles that are averaged, once the cost no longer falls; before, only the last
    last: Vec<(Vec<f64>, Ensemble)>,
}

impl<'a> Search<'a> {
    pub(super) fn new(problem: &'a Problem, hz: f64, x: &[f64]) -> Result<Self, SysidError> {
        let course = Course::new(problem, hz, x)?;
        Ok(Self {
            here: course.at(x)?.ok_or_else(broken)?,
            course,
            x: x.to_vec(),
            spreads: problem.parameters.iter_free().map(first_spread).collect(),
            least: (f64::INFINITY, 0),
            last: Vec::new(),
        })
    }

    fn is_still(&self) -> bool {
        self.least.1 > PATIENCE
    }

    /// Whether enough ensembles have been averaged.
    pub(super) fn is_done(&self) -> bool {
        self.is_still() && self.last.len() == LAST
    }

    /// One ensemble, and the step that it asks for; none where no simulation goes there.
    pub(super) fn advance(&mut self) -> Result<Option<Iteration>, SysidError> {
        let ensemble = Ensemble::new(&self.course, &self.x, &self.spreads)?;
        let was_still = self.is_still();
        if !was_still {
            let cost = self.course.cost(&self.x, ensemble.mean.as_slice());
            let chaos = FALL * ensemble.rough / ensemble.n as f64;
            self.least = if cost < self.least.0 - chaos {
                (cost, 0)
            } else {
                (self.least.0, self.least.1 + 1)
            };
        }
        let (dx, sigma) = self.step(&ensemble);
        let Some((cost, x, here)) = self.along(&dx, &ensemble) else {
            return Ok(None);
        };
        if !was_still {
            self.last.clear();
        }
        self.last.push((x.clone(), ensemble));
        (self.x, self.here) = (x, here);
        for (spread, sigma) in self.spreads.iter_mut().zip(&sigma) {
            *spread = (SPREAD * sigma).clamp(SHRINK * *spread, *spread);
        }
        if !self.is_still() {
            self.course.correct(&self.x, &self.here)?;
            self.here = self.course.at(&self.x)?.ok_or_else(broken)?;
        }
        let length = (dx.iter().zip(&sigma)).fold(0.0_f64, |m, (d, s)| m.max((d / s).abs()));
        Ok(Some(Iteration {
            level: 0.0,
            cost,
            damping: 0.0,
            horizon_s: None,
            step: length,
            x: self.x.clone(),
        }))
    }

    /// The step within bounds, and standard deviations. What chaos adds to the squares of slopes damps it.
    fn step(&self, ensemble: &Ensemble) -> (Vec<f64>, Vec<f64>) {
        let parameters = &self.course.problem.parameters;
        let weights = self.course.weights(ensemble.mean.as_slice());
        let here = Quadratic::new(ensemble, &weights, parameters, &self.x);
        let dx = here.step(parameters, &self.x, (&self.spreads, FAR));
        let sigma = match here.normal.cholesky() {
            Some(factor) => (factor.inverse().diagonal().iter())
                .map(|v| v.sqrt())
                .collect(),
            None => self.spreads.clone(),
        };
        (dx, sigma)
    }

    /// As far along a step as a simulation asks for, with its cost; none where all diverge.
    fn along(&self, dx: &[f64], ensemble: &Ensemble) -> Option<(f64, Vec<f64>, Here)> {
        let enough = self.course.cost(&self.x, &self.here.bins) + CHAOS * ensemble.rough;
        let mut best: Option<(f64, Vec<f64>, Here)> = None;
        for part in PARTS {
            let x: Vec<f64> = self.x.iter().zip(dx).map(|(x, d)| x + part * d).collect();
            // a step may leave what the engine accepts: then it is none
            let Ok(Some(here)) = self.course.at(&x) else {
                continue;
            };
            let cost = self.course.cost(&x, &here.bins);
            if best.as_ref().is_none_or(|b| cost < b.0) {
                best = Some((cost, x, here));
            }
            if best.as_ref().is_some_and(|b| b.0 < enough) {
                break;
            }
        }
        best
    }

    /// The mean over the last ensembles.
    fn mean(&self) -> Vec<f64> {
        let n = self.last.len() as f64;
        if n < 2.0 {
            return self.x.clone();
        }
        let sum = |j: usize| self.last.iter().map(|(x, _)| x[j]).sum::<f64>();
        (0..self.x.len()).map(|j| sum(j) / n).collect()
    }

    /// That, and spreads of ensembles about it.
    pub(super) fn ended(self) -> (Vec<f64>, Vec<f64>) {
        (self.mean(), self.spreads)
    }

    /// The fit.
    pub(super) fn conclude(
        mut self,
        status: Status,
        history: Vec<Iteration>,
    ) -> Result<Fit, SysidError> {
        if self.last.len() > 1 {
            self.x = self.mean();
            self.here = self.course.at(&self.x)?.ok_or_else(broken)?;
        }
        let cost = self.course.cost(&self.x, &self.here.bins);
        let innovations = self.innovations();
        let simulated = self.here.simulated.into_iter();
        Ok(Fit {
            trajectories: simulated.map(|s| s.qpos).collect(),
            cost,
            negative_log_evidence: cost,
            level: 0.0,
            force_sigma: vec![0.0; self.course.problem.model.nv()],
            horizon_s: None,
            status,
            history,
            innovations,
            weakest: (1.0, 0, 0, 0),
            x: self.x,
        })
    }

    /// Of the means over the last ensembles.
    fn innovations(&self) -> Innovations {
        let n = self.last.len() as f64;
        let n_bins = self.here.bins.len();
        let mut mean = DVector::zeros(n_bins);
        let mut slopes = Slopes::zeros(n_bins, self.x.len());
        for (_, ensemble) in &self.last {
            mean += &ensemble.mean / n;
            slopes.by += &ensemble.slopes.by / n;
            slopes.chaos += &ensemble.slopes.chaos / (n * n);
        }
        self.course.innovations(&mean, &slopes)
    }
}

/// Spread of a parameter in the first ensemble.
fn first_spread(parameter: &Parameter) -> f64 {
    if parameter.has_prior() {
        WIDE[0] * parameter.prior_sigma
    } else {
        WIDE[1] * parameter.typical
    }
}
