//! A trained policy on the machine: the pushing task's observation of the sensed state, the paper's spiral as target.

use super::Behaviour;
use crate::mujoco::{Model, MujocoError};
use crate::policy::AffineGaussian;
use crate::rig::RigError;
use crate::rig::estimate::Estimate;
use crate::task::Task;
use crate::task::push::{PushConfig, PushTask};
use crate::task::spiral;

/// The mean action of a policy.
#[derive(Debug)]
pub struct PolicyBehaviour {
    policy: AffineGaussian,
    task: PushTask,
    observation: Vec<f64>,
    height: f64,
}

impl PolicyBehaviour {
    /// `policy` on a machine described by `model`.
    ///
    /// # Errors
    /// [`RigError::Task`], [`RigError::Policy`] when model or policy do not fit the pushing task.
    pub fn new(policy: AffineGaussian, model: &Model) -> Result<Self, RigError> {
        let task = PushTask::new(model, PushConfig::default())?;
        policy.check(task.n_observation(), task.n_action())?;
        let goal = model.id(crate::mujoco::ObjectKind::Body, "goal")?;
        Ok(Self {
            observation: vec![0.0; task.n_observation()],
            height: model.body_pos()[3 * goal + 2],
            policy,
            task,
        })
    }
}

impl Behaviour for PolicyBehaviour {
    fn command(
        &mut self,
        time_s: f64,
        estimate: &mut Estimate,
        ctrl: &mut [f64],
    ) -> Result<(), MujocoError> {
        let [x, y] = spiral::target(time_s);
        self.task.set_goal(estimate.data_mut(), x, y);
        self.task.observe(estimate.data(), &mut self.observation);
        self.policy.mean(&self.observation, ctrl);
        for axis in estimate.axes() {
            if let Some([low, high]) = axis.ctrl_range {
                ctrl[axis.actuator] = ctrl[axis.actuator].clamp(low, high);
            }
        }
        Ok(())
    }

    fn goal(&self, time_s: f64) -> Option<[f64; 3]> {
        let [x, y] = spiral::target(time_s);
        Some([x, y, self.height])
    }
}
