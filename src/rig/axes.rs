//! The axes of a machine: its motors that turn or slide one joint each.

use crate::mujoco::{Model, N_PRM};

// `mjtJoint`, `mjtTrn`, `mjtGain`, `mjtBias`, `mjtDyn` of the engine's model format
const SLIDE: i32 = 2;
const HINGE: i32 = 3;
const ON_JOINT: i32 = 0;
const FIXED_GAIN: i32 = 0;
const AFFINE_BIAS: i32 = 1;
const NO_DYNAMICS: i32 = 0;

/// Whether a joint of this type has one coordinate.
pub(super) fn is_scalar(joint_type: i32) -> bool {
    matches!(joint_type, SLIDE | HINGE)
}

/// One motor and its joint.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    /// actuator
    pub actuator: usize,
    /// joint
    pub joint: usize,
    /// address in qpos
    pub qpos: usize,
    /// address in qvel
    pub dof: usize,
    /// number of the mechanism it belongs to: axes with one root body
    pub group: usize,
    /// place among the axes of its group
    pub place: usize,
    /// limits of the control, if any
    pub ctrl_range: Option<[f64; 2]>,
    /// limits of the joint, if any
    pub joint_range: Option<[f64; 2]>,
    gear: f64,
    gain: f64,
    bias: [f64; 3],
    /// rotor inertia in the model, kg m²
    pub(super) armature: f64,
    /// control is force, without activation
    pub(super) is_plain_motor: bool,
}

impl Axis {
    /// The control that makes the joint torque (or force) `torque` at rest of any activation, within its limits.
    ///
    /// force = gain ctrl + b0 + b1 gear q + b2 gear v, torque = gear force
    pub fn control(&self, torque: f64, q: f64, v: f64) -> f64 {
        let [b0, b1, b2] = self.bias;
        let ctrl = (torque / self.gear - b0 - self.gear * (b1 * q + b2 * v)) / self.gain;
        match self.ctrl_range {
            Some([low, high]) => ctrl.clamp(low, high),
            None => ctrl,
        }
    }

    /// A motor of gear 1 with rotor inertia `armature`.
    #[cfg(test)]
    pub(super) fn of_motor(armature: f64) -> Self {
        Self {
            actuator: 0,
            joint: 0,
            qpos: 0,
            dof: 0,
            group: 0,
            place: 0,
            ctrl_range: None,
            joint_range: None,
            gear: 1.0,
            gain: 1.0,
            bias: [0.0; 3],
            armature,
            is_plain_motor: true,
        }
    }

    /// The greatest torque of a plain motor in size, if its control is limited.
    pub(super) fn full_torque(&self) -> Option<f64> {
        let [low, high] = self.ctrl_range?;
        let torque = self.torque(low).abs().max(self.torque(high).abs());
        (torque > 0.0).then_some(torque)
    }

    /// Torque of a plain motor, whatever the range of its control.
    pub(super) fn torque(&self, ctrl: f64) -> f64 {
        self.gear * self.gain * ctrl
    }
}

/// The axes of `model`, in the order of its actuators. Actuators that drive something else than a joint of their own
/// are none.
pub fn axes(model: &Model) -> Vec<Axis> {
    let mut axes: Vec<Axis> = Vec::new();
    let mut roots: Vec<i32> = Vec::new();
    for actuator in 0..model.nu() {
        let joint = model.actuator_trnid()[2 * actuator] as usize;
        let gear = model.actuator_gear()[6 * actuator];
        let gain = model.actuator_gainprm()[N_PRM * actuator];
        if model.actuator_trntype()[actuator] != ON_JOINT
            || !is_scalar(model.jnt_type()[joint])
            || model.actuator_gaintype()[actuator] != FIXED_GAIN
            || gear * gain == 0.0
            || axes.iter().any(|axis| axis.joint == joint)
        {
            continue;
        }
        let root = model.body_rootid()[model.jnt_bodyid()[joint] as usize];
        let group = roots.iter().position(|r| *r == root).unwrap_or_else(|| {
            roots.push(root);
            roots.len() - 1
        });
        let affine = model.actuator_biastype()[actuator] == AFFINE_BIAS;
        let prm = &model.actuator_biasprm()[N_PRM * actuator..];
        let range = |limited: u8, ranges: &[f64], i: usize| {
            (limited != 0).then(|| [ranges[2 * i], ranges[2 * i + 1]])
        };
        axes.push(Axis {
            actuator,
            joint,
            qpos: model.jnt_qposadr()[joint] as usize,
            dof: model.jnt_dofadr()[joint] as usize,
            group,
            place: axes.iter().filter(|axis| axis.group == group).count(),
            ctrl_range: range(
                model.actuator_ctrllimited()[actuator],
                model.actuator_ctrlrange(),
                actuator,
            ),
            joint_range: range(model.jnt_limited()[joint], model.jnt_range(), joint),
            gear,
            gain,
            bias: if affine {
                [prm[0], prm[1], prm[2]]
            } else {
                [0.0; 3]
            },
            armature: model.dof_armature()[model.jnt_dofadr()[joint] as usize],
            is_plain_motor: !affine && model.actuator_dyntype()[actuator] == NO_DYNAMICS,
        });
    }
    axes
}
