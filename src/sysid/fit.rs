//! What an estimator starts from and what it gives.

use serde::Serialize;

/// Where a solver starts: parameters, and trajectories if they are known.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    /// free parameters
    pub x: Vec<f64>,
    /// per trial (knots × nq)
    pub trajectories: Option<Vec<Vec<f64>>>,
    /// (nv) size of the forces, which unexplained forces are parts of
    pub force_scale: Option<Vec<f64>>,
}

/// Why the solver stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// the cost no longer falls
    Converged,
    /// the cost rises on all sides, at a kink of dry friction or contact, and the step that a smooth cost would ask for is
    /// short against the intervals
    ConvergedAtKink,
    /// no damping gives a lower cost, though the gradient says there is one
    Stalled,
    /// the iterations ran out
    MaxIterations,
    /// asked to stop
    Interrupted,
}

impl Status {
    /// Whether the estimate is where the cost is least.
    pub fn is_converged(self) -> bool {
        matches!(self, Self::Converged | Self::ConvergedAtKink)
    }
}

/// One iteration.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Iteration {
    /// unexplained force, as a part of the forces
    pub level: f64,
    /// true cost after it
    pub cost: f64,
    /// damping it was taken with
    pub damping: f64,
    /// seconds of the recordings that it sees, where that is less than all
    pub horizon_s: Option<f64>,
    /// largest change of a parameter's x; of a swarm: largest spread of one, in its size
    pub step: f64,
    /// free parameters after it
    pub x: Vec<f64>,
}

/// The innovations: what carries the information on the parameters; see `arrow`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Innovations {
    /// free parameters
    pub n_parameters: usize,
    /// rows of sensitivities and value
    pub rows: Vec<f64>,
    /// trial and knot of each row, in order
    pub places: Vec<(usize, usize)>,
}

/// A solution.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// free parameters
    pub x: Vec<f64>,
    /// per trial (knots × nq)
    pub trajectories: Vec<Vec<f64>>,
    /// of residuals and priors
    pub cost: f64,
    /// of evidence, see the module
    pub negative_log_evidence: f64,
    /// unexplained force, as a part of the forces
    pub level: f64,
    /// (nv) its standard deviation
    pub force_sigma: Vec<f64>,
    /// seconds of each recording that simulations of the model follow, where that is less than all
    pub horizon_s: Option<f64>,
    /// why it stopped
    pub status: Status,
    /// what happened
    pub history: Vec<Iteration>,
    /// for intervals
    pub innovations: Innovations,
    /// least observable state: (diagonal ratio, trial, knot, dof)
    pub weakest: (f64, usize, usize, usize),
}
