//! Inverse dynamics undoes forward dynamics.

use phantom::mujoco::{Data, Model};
use std::sync::Arc;

/// Along a driven motion: the force that `inverse` finds for the acceleration of `forward` is the
/// applied one, and no limit, friction or contact force is missing.
#[test]
fn inverse_recovers_the_forces_that_made_the_acceleration() {
    for (name, tolerance) in [("pendulum", 1e-12), ("arm", 1e-7), ("push_box", 1e-7)] {
        let path = format!("tests/models/{name}.xml");
        let model = Model::from_xml_path(path).expect("model loads");
        let mut data = Data::new(Arc::new(model)).expect("data");
        data.edit_model(|edit| {
            let mut option = edit.model().option();
            option.tolerance = 0.0;
            option.iterations = 200;
            edit.set_option(&option)
        })
        .expect("edit")
        .expect("legal");
        let (mut worst, mut constrained) = (0.0_f64, 0);
        for k in 0..400 {
            let t = data.time();
            for (i, u) in data.ctrl_mut().iter_mut().enumerate() {
                *u = 4.0 * (5.0 * t + i as f64).sin();
            }
            let n = data.qfrc_applied().len();
            data.qfrc_applied_mut()[n - 1] = 0.2 * (3.0 * t).cos();
            data.forward().expect("finite");
            constrained += usize::from(data.nefc() > 0);
            let applied: Vec<f64> = (data.qfrc_applied().iter())
                .zip(data.qfrc_actuator())
                .map(|(a, b)| a + b)
                .collect();
            data.inverse().expect("finite");
            for (inverse, applied) in data.qfrc_inverse().iter().zip(&applied) {
                worst = worst.max((inverse - applied).abs());
            }
            assert!(worst < tolerance, "{name} step {k}: {worst:e}");
            data.step().expect("step");
        }
        assert_eq!(constrained > 0, name != "pendulum", "{name}");
        assert!(!data.warnings().any());
    }
}
