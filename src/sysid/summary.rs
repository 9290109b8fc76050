//! The result of an identification as one document; docs/sysid.md describes it.

use serde::Serialize;

use super::SysidError;
use super::fit::{Fit, Iteration, Status};
use super::holdout::{Holdout, Verdict};
use super::interval::{Estimate, Posterior};
use super::leave_out::LeftOut;
use super::method::Method;
use super::predict::{
    ChannelResidual, Explained, ForceResidual, channel_residuals, force_residuals,
};
use super::problem::Problem;
use super::separate::Combination;

/// Version of the document.
pub const SCHEMA: u32 = 1;
/// Correlation from which a pair is listed.
pub const CORRELATED: f64 = 0.9;

/// A recording that was used.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Used {
    /// file or trial
    pub name: String,
    /// s
    pub duration_s: f64,
    /// of the motion
    pub knots: usize,
    /// of all channels
    pub samples: usize,
}

/// Two parameters whose estimates move together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Pair {
    /// address
    pub first: String,
    /// address
    pub second: String,
    /// −1 to 1
    pub correlation: f64,
}

/// Correlations.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Correlation {
    /// estimated parameters, in the order of the matrix
    pub names: Vec<String>,
    /// row by row
    pub matrix: Vec<Vec<f64>>,
    /// strongest pairs, strongest first
    pub strong: Vec<Pair>,
}

/// How the state is determined at its weakest.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Weakest {
    /// 0 to 1; 0: not at all
    pub ratio: f64,
    /// recording
    pub recording: String,
    /// s
    pub time_s: f64,
    /// joint
    pub joint: String,
}

/// The document.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// [`SCHEMA`]
    pub schema: u32,
    /// why the solver stopped
    pub status: Status,
    /// of residuals and priors
    pub cost: f64,
    /// unexplained force, as a part of the forces
    pub level: f64,
    /// seconds of each recording that simulations of the model follow; none: all, or not asked
    pub horizon_s: Option<f64>,
    /// recordings
    pub recordings: Vec<Used>,
    /// what to know of them
    pub notes: Vec<String>,
    /// all parameters
    pub parameters: Vec<Estimate>,
    /// what the recordings cannot tell apart
    pub inseparable: Vec<Combination>,
    /// of the estimates
    pub correlation: Correlation,
    /// residuals
    pub channels: Vec<ChannelResidual>,
    /// residuals
    pub forces: Vec<ForceResidual>,
    /// least determined state
    pub weakest: Weakest,
    /// held-out recordings; none: there were none
    pub holdout: Option<Holdout>,
    /// channels predicted without their sensor
    pub leave_one_sensor_out: Vec<LeftOut>,
    /// iterations
    pub history: Vec<Iteration>,
}

/// A fit with everything derived from it.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// trial by trial
    pub explained: Vec<Explained>,
    /// of the parameters
    pub posterior: Posterior,
    /// the document, without held-out recordings and left-out sensors
    pub summary: Summary,
}

impl Outcome {
    /// Residuals, intervals and all else that a fit says.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub fn new(problem: &Problem, method: &Method, fit: &Fit) -> Result<Self, SysidError> {
        let explained = method.explain(problem, fit)?;
        let lengths: Vec<usize> = problem.trials.iter().map(|t| t.n_knots).collect();
        let posterior = Posterior::new(&problem.parameters, &fit.x, &fit.innovations, &lengths);
        let h = problem.model.timestep();
        let (ratio, trial, knot, dof) = fit.weakest;
        let recordings = (problem.trials.iter())
            .map(|t| Used {
                name: t.name.clone(),
                duration_s: (t.n_knots - 1) as f64 * h,
                knots: t.n_knots,
                samples: t.samples.len(),
            })
            .collect();
        let summary = Summary {
            schema: SCHEMA,
            status: fit.status,
            cost: fit.cost,
            level: fit.level,
            horizon_s: fit.horizon_s,
            recordings,
            notes: problem.notes.clone(),
            parameters: posterior.estimates.clone(),
            inseparable: posterior.inseparable.clone(),
            correlation: correlation(problem, &posterior),
            channels: channel_residuals(problem, &explained),
            forces: force_residuals(problem, &explained, &fit.force_sigma),
            weakest: Weakest {
                ratio,
                recording: problem.trials[trial].name.clone(),
                time_s: knot as f64 * h,
                joint: super::predict::dof_name(&problem.model, dof),
            },
            holdout: None,
            leave_one_sensor_out: Vec::new(),
            history: fit.history.clone(),
        };
        Ok(Self {
            explained,
            posterior,
            summary,
        })
    }
}

fn correlation(problem: &Problem, posterior: &Posterior) -> Correlation {
    let names: Vec<String> = problem
        .parameters
        .iter_free()
        .map(|p| p.name.clone())
        .collect();
    let c = posterior.correlation();
    let mut strong = Vec::new();
    for i in 0..names.len() {
        for j in 0..i {
            if c[(i, j)].abs() > CORRELATED {
                strong.push(Pair {
                    first: names[j].clone(),
                    second: names[i].clone(),
                    correlation: c[(i, j)],
                });
            }
        }
    }
    strong.sort_by(|a, b| b.correlation.abs().total_cmp(&a.correlation.abs()));
    Correlation {
        matrix: c.row_iter().map(|r| r.iter().copied().collect()).collect(),
        names,
        strong,
    }
}

impl Summary {
    /// Whether the answer is yes: the solver converged, and no held-out recording speaks against the model.
    pub fn is_good(&self) -> bool {
        let converged = self.status.is_converged();
        converged
            && self
                .holdout
                .as_ref()
                .is_none_or(|h| h.verdict == Verdict::Better)
    }
}
