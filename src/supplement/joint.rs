//! Forces of a joint that follow from its position and velocity alone.
//!
//! ```text
//! quadratic drag   −c v |v|
//! torque offset    b
//! cogging          a sin(n q) + b cos(n q)
//! joint stop       −σ max(0, k d + c d')   where d = σ(q − q₀) > 0, σ = ±1 the side
//! ```

use super::law::{At, Built, Law};
use crate::mujoco::{Forces, Model};

#[derive(Debug, Clone, Copy)]
enum Force {
    Drag,
    Offset,
    Cogging,
    Stop,
}

#[derive(Debug)]
struct OfJoint {
    qpos: usize,
    dof: usize,
    force: Force,
}

fn of_joint(model: &Model, joint: usize, force: Force) -> Box<dyn Law> {
    let (qpos, dof) = (
        model.jnt_qposadr()[joint] as usize,
        model.jnt_dofadr()[joint] as usize,
    );
    Box::new(OfJoint { qpos, dof, force })
}

pub(super) fn quadratic_drag(model: &Model, joint: usize) -> Built {
    Ok(of_joint(model, joint, Force::Drag))
}

pub(super) fn torque_offset(model: &Model, joint: usize) -> Built {
    Ok(of_joint(model, joint, Force::Offset))
}

pub(super) fn cogging(model: &Model, joint: usize) -> Built {
    Ok(of_joint(model, joint, Force::Cogging))
}

pub(super) fn joint_stop(model: &Model, joint: usize) -> Built {
    Ok(of_joint(model, joint, Force::Stop))
}

impl Law for OfJoint {
    fn force(&self, at: &At<'_>, forces: &mut Forces, _next: &mut [f64]) {
        let (q, v) = (at.data.qpos()[self.qpos], at.data.qvel()[self.dof]);
        let n = at.numbers;
        forces.passive[self.dof] += match self.force {
            Force::Drag => -n[0] * v * v.abs(),
            Force::Offset => n[0],
            Force::Cogging => n[0] * (n[2] * q).sin() + n[1] * (n[2] * q).cos(),
            Force::Stop => {
                let side = n[2].signum();
                let (depth, speed) = (side * (q - n[1]), side * v);
                // a stop pushes, it does not pull
                let pushes = if depth > 0.0 {
                    (n[0] * depth + n[3] * speed).max(0.0)
                } else {
                    0.0
                };
                -side * pushes
            }
        };
    }
}
