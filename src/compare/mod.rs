//! Simulation against hardware: the first experiment of Lowrey et al. 2018, for any model and recording.
//!
//! ```text
//! forces     at every sample: state recorded → forces computed, against forces measured            [forces]
//! rollouts   from many samples: state recorded → simulate under the recorded controls → deviation  [rollouts]
//! policy     the same policy on both: distance of the object to its target                         [policy]
//! ```
//!
//! | symbol | name |
//! | --- | --- |
//! | state q, v at the samples of the recording, a by differences | [`States`] |
//! | motor torque by inverse dynamics, and as commanded | [`forces::Forces`] |
//! | deviation after a horizon, per channel | [`rollouts::Growth`] |
//!
//! Reference: Lowrey, Kolev, Dao, Rajeswaran, Todorov 2018, section VI.A and figures 3 and 5.

mod butterworth;
mod closure;
pub mod cutoff;
mod differences;
mod error;
pub mod figures;
pub mod forces;
mod memory;
pub mod policy;
pub mod rollouts;
mod samples;
mod seeded;
pub mod settings;
pub mod start;
mod states;
mod swings;

pub use error::CompareError;
pub use seeded::{Seeded, seeded};
pub use settings::Settings;

pub use states::States;

use std::sync::Arc;

use serde::Serialize;

use crate::mujoco::Model;
use crate::policy::AffineGaussian;
use crate::recording::Recording;

/// The result for one or several recordings.
#[derive(Debug, Clone, Serialize)]
pub struct Comparison {
    /// instantaneous forces, one entry a recording
    pub forces: Vec<forces::Forces>,
    /// error growth over all recordings
    pub rollouts: rollouts::Rollouts,
    /// the same under the policy, if there is one
    pub policy_rollouts: Option<rollouts::Rollouts>,
    /// tracking errors; empty where no recording has a target
    pub tracking: Vec<policy::Tracking>,
}

/// Compare `model` with recordings, and `policy` on both; `done` is told after each recording.
///
/// # Errors
/// A recording does not fit the model, or the engine fails.
pub fn compare(
    model: &Arc<Model>,
    recordings: &[Recording],
    settings: &Settings,
    policy: Option<&AffineGaussian>,
    done: &(dyn Fn() + Sync),
) -> Result<Comparison, CompareError> {
    settings.check()?;
    let mut forces = Vec::new();
    let (mut rolled, mut followed) = (Vec::new(), Vec::new());
    let mut tracking = Vec::new();
    let mut skipped = 0;
    for recording in recordings {
        let states = States::new(recording, model, settings)?;
        if settings.forces {
            forces.push(forces::instantaneous(model, &states, settings)?);
        }
        match start::starts(model, &states, settings)? {
            Some(starts) => {
                let roll_out = |drive: rollouts::Drive<'_>| {
                    rollouts::roll_out(model, &states, &starts, settings, drive)
                };
                rolled.extend(roll_out(&|data, time| {
                    states.controls_at(time, data.ctrl_mut());
                })?);
                if let Some(policy) = policy {
                    let follower = policy::Follower::new(model, &states, policy)?;
                    followed.extend(roll_out(&|data, time| follower.act(data, time))?);
                }
            }
            None => skipped += 1,
        }
        tracking.extend(policy::recorded_tracking(&states));
        if let Some(policy) = policy {
            let follower = policy::Follower::new(model, &states, policy)?;
            tracking.push(policy::simulated_tracking(model, &states, &follower)?);
        }
        done();
    }
    Ok(Comparison {
        forces,
        rollouts: rollouts::summarise(&rolled, skipped, settings),
        policy_rollouts: policy.map(|_| rollouts::summarise(&followed, skipped, settings)),
        tracking,
    })
}
