//! Noise-free trajectories made by the engine itself.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};

/// States and controls of consecutive steps; sensors as the step saw them.
#[derive(Debug, Clone, Default)]
pub(crate) struct Run {
    pub qpos: Vec<Vec<f64>>,
    pub qvel: Vec<Vec<f64>>,
    pub ctrl: Vec<Vec<f64>>,
    pub sensordata: Vec<Vec<f64>>,
    /// steps in which constraint rows were active
    pub n_constrained: usize,
}

/// The solver at the limit of what doubles allow.
pub(crate) fn tighten(model: &mut Model) {
    let mut option = model.option();
    option.tolerance = 0.0;
    option.iterations = 100;
    model.edit().set_option(&option).expect("legal");
}

/// Simulates `n` steps under `control(data, time)`.
pub(crate) fn simulate(
    data: &mut Data,
    n: usize,
    mut control: impl FnMut(&Data, &mut [f64]),
) -> Run {
    let mut run = Run::default();
    let mut ctrl = vec![0.0; data.model().nu()];
    for _ in 0..n {
        control(data, &mut ctrl);
        data.ctrl_mut().copy_from_slice(&ctrl);
        run.qpos.push(data.qpos().to_vec());
        run.qvel.push(data.qvel().to_vec());
        run.ctrl.push(ctrl.clone());
        data.step().expect("step");
        run.sensordata.push(data.sensordata().to_vec());
        run.n_constrained += usize::from(data.nefc() > 6);
    }
    assert!(!data.warnings().any(), "{}", data.warnings());
    run
}

/// Fingers under a stiff joint controller around targets that move by `swing` (rad).
pub(crate) fn swing_fingers(model: Model, n: usize, close: f64, swing: f64) -> Run {
    let mut data = Data::new(Arc::new(model)).expect("data");
    data.reset_to_keyframe(0).expect("home");
    simulate(&mut data, n, |data, ctrl| {
        let t = data.time();
        for finger in 0..3 {
            let phase = 2.0 * finger as f64;
            let goal = [
                0.3 * swing * (7.0 * t + phase).sin(),
                0.2 * swing * (11.0 * t + phase).sin(),
                close * (4.0 * t).min(1.0) + swing * (9.0 * t + phase).sin(),
            ];
            for (motor, goal) in goal.iter().enumerate() {
                let (q, v) = (
                    data.qpos()[5 * finger + motor],
                    data.qvel()[5 * finger + motor],
                );
                ctrl[3 * finger + motor] = (4.0 * (goal - q) - 0.1 * v).clamp(-1.5, 1.5);
            }
        }
    })
}

pub(crate) fn rms<'a>(values: impl Iterator<Item = &'a f64>) -> f64 {
    let (mut sum, mut n) = (0.0, 0);
    for v in values {
        sum += v * v;
        n += 1;
    }
    (sum / f64::from(n)).sqrt()
}
