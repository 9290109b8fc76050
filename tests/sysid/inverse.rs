//! The inverse of a step finds nothing missing in what the engine itself made.

use std::sync::Arc;

use phantom::mujoco::Model;
use phantom::sysid::inverse::{Changed, Inverse};

use crate::common::phantom_model;
use crate::simulate::{Run, rms, swing_fingers, tighten};

/// Residual rms over torque rms.
fn relative_residual(model: &Model, run: &Run) -> f64 {
    let model = Arc::new(model.clone());
    let mut inverse = Inverse::new(model.clone(), false).expect("workspace");
    let h = model.timestep();
    let (mut before, mut after) = (vec![0.0; model.nv()], vec![0.0; model.nv()]);
    let mut residuals = Vec::new();
    for k in 1..run.qpos.len() - 1 {
        let q = &run.qpos;
        (model.differentiate_pos(&mut before, h, &q[k - 1], &q[k])).expect("lengths");
        (model.differentiate_pos(&mut after, h, &q[k], &q[k + 1])).expect("lengths");
        let acceleration: Vec<f64> = (after.iter().zip(&before))
            .map(|(b, a)| (b - a) / h)
            .collect();
        inverse.set_ctrl(&run.ctrl[k]);
        (inverse.evaluate(&q[k], &before, &acceleration, Changed::Position)).expect("finite");
        residuals.extend_from_slice(inverse.residual());
    }
    rms(residuals.iter()) / rms(run.ctrl.iter().flatten())
}

#[test]
fn free_space_with_friction_and_limits() {
    let mut model = phantom_model();
    tighten(&mut model);
    let mut edit = model.edit();
    for finger in 0..3 {
        edit.dof_frictionloss()[5 * finger..5 * finger + 3].fill(0.01);
    }
    // off the object, which lies on the table
    edit.qpos0()[15] = 0.5;
    edit.key_qpos()[15] = 0.5;
    edit.finish().expect("constants");
    let run = swing_fingers(model.clone(), 1000, -0.3, 0.45);
    assert!(run.n_constrained > 900, "friction and limits act");
    let ratio = relative_residual(&model, &run);
    assert!(ratio < 1e-6, "{ratio:e}");
}

#[test]
fn pushing_the_object() {
    let mut model = phantom_model();
    tighten(&mut model);
    let run = swing_fingers(model.clone(), 2000, 0.2, 0.06);
    let moved = (run.qpos[1999][15] - run.qpos[0][15]).hypot(run.qpos[1999][16] - run.qpos[0][16]);
    assert!(moved > 0.002, "{moved}");
    let ratio = relative_residual(&model, &run);
    assert!(ratio < 5e-4, "{ratio:e}");
    // the conversion for implicit damping is what makes it so
    let mut undamped = model.clone();
    undamped.edit().dof_damping().fill(0.0);
    assert!(relative_residual(&undamped, &run) > 2.0 * ratio);
}
