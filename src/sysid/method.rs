//! The ways to solve a problem, behind one interface.

use super::SysidError;
use super::fit::{Fit, Iteration, Start};
use super::joint::{self, JointSettings};
use super::nudging::{self, NudgingSettings};
use super::predict::{self, Explained};
use super::problem::Problem;
use super::rollouts::{self, RolloutSettings};
use super::sequential::{self, SequentialSettings};
use super::shooting::{self, ShootingSettings};

/// Relative decrease of the cost below which windows of which only the first states are unknown have converged.
const MOTION_TOLERANCE: f64 = 1e-4;

/// Length of windows in which held-out recordings are explained, as a part of the horizon of a swarm.
const PART: f64 = 0.25;

/// How to solve a problem.
#[derive(Debug, Clone, PartialEq)]
pub enum Method {
    /// the whole motion is unknown, and what inverse dynamics makes of it is compared with the controls
    Joint(JointSettings),
    /// first states of windows are unknown, and simulations from there are compared with the sensors
    Shooting(ShootingSettings),
    /// rollouts from recorded states are compared with the recordings, and parameters searched without slopes
    Rollout(RolloutSettings),
    /// simulations of whole recordings are nudged along the recorded motion
    Nudging(NudgingSettings),
    /// a swarm of simulations sees more and more of the recordings
    Sequential(SequentialSettings),
}

impl Method {
    /// Looks for recordings that the method cannot use.
    ///
    /// # Errors
    /// The first.
    pub fn fits(&self, problem: &Problem) -> Result<(), SysidError> {
        match self {
            Self::Joint(_) | Self::Nudging(_) | Self::Rollout(_) | Self::Sequential(_) => Ok(()),
            Self::Shooting(settings) => settings.fits(problem),
        }
    }

    /// Estimates parameters and motion. `watch` is told of each iteration, and stops the solver by `false`.
    ///
    /// # Errors
    /// Those of the method.
    pub fn solve(
        &self,
        problem: &Problem,
        start: &Start,
        watch: &mut dyn FnMut(&Iteration) -> bool,
    ) -> Result<Fit, SysidError> {
        match self {
            Self::Joint(settings) => joint::solve(problem, settings, start, watch),
            Self::Shooting(settings) => shooting::solve(problem, settings, start, watch),
            Self::Nudging(settings) => nudging::solve(problem, settings, start, watch),
            Self::Rollout(settings) => rollouts::solve(problem, settings, start, watch),
            Self::Sequential(settings) => sequential::solve(problem, settings, start, watch),
        }
    }

    /// The same, for one more solution as strict as `fit` was; `eased`: by way of the looser levels before it.
    pub(super) fn as_strict_as(&self, fit: &Fit, eased: bool) -> Self {
        match self {
            Self::Joint(settings) => {
                let levels = settings.levels.iter().copied();
                Self::Joint(JointSettings {
                    levels: if eased {
                        levels.filter(|l| *l >= fit.level * 0.999).collect()
                    } else {
                        vec![fit.level]
                    },
                    by_evidence: false,
                    ..settings.clone()
                })
            }
            // how long windows may be, the swarm has found out
            Self::Sequential(_) => Self::Shooting(ShootingSettings {
                window_s: fit.horizon_s.map_or(f64::INFINITY, |s| PART * s),
                ..ShootingSettings::default()
            }),
            Self::Shooting(_) | Self::Rollout(_) | Self::Nudging(_) => self.clone(),
        }
    }

    /// The same where only the motion is unknown, to the precision that costs are compared with.
    pub(super) fn of_motion(self) -> Self {
        match self {
            Self::Shooting(settings) => Self::Shooting(ShootingSettings {
                tolerance: settings.tolerance.max(MOTION_TOLERANCE),
                ..settings
            }),
            other => other,
        }
    }

    /// What the model says along the motion of `fit`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub fn explain(&self, problem: &Problem, fit: &Fit) -> Result<Vec<Explained>, SysidError> {
        let mut explained = predict::explain(problem, &fit.x, &fit.trajectories)?;
        if !matches!(self, Self::Joint(_)) {
            // windows and rollouts obey the model; what inverse dynamics would make of the jumps between them is no force
            for trial in &mut explained {
                trial.force.fill(0.0);
            }
        }
        Ok(explained)
    }
}
