use serde::{Deserialize, Serialize};

use super::BatchSize;
use crate::npg::baseline::Baseline;
use crate::policy::AffineGaussian;
use crate::rollout::Start;

/// Everything a run needs to go on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Checkpoint {
    /// iterations done
    pub iteration: u64,
    /// current policy
    pub policy: AffineGaussian,
    /// how many trajectories the next iteration takes
    pub batch_size: BatchSize,
    /// current value function
    pub baseline: Baseline,
    /// states to continue from
    pub pool: Vec<Start>,
    /// physics steps simulated so far
    pub physics_steps: u64,
    /// seconds spent so far
    pub seconds: f64,
    /// trajectories that diverged so far
    pub n_diverged: u64,
    /// best evaluation so far, cm
    pub best_distance_cm: Option<f64>,
}
