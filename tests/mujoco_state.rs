//! Saving, restoring and sharing simulation states.

use phantom::mujoco::{Data, Model, ObjectKind};
use std::sync::Arc;

fn load(name: &str) -> Arc<Model> {
    Arc::new(Model::from_xml_path(format!("tests/models/{name}.xml")).expect("model loads"))
}

#[test]
fn restored_state_continues_with_the_same_bits() {
    for name in ["pendulum", "arm", "push_box"] {
        let mut data = Data::new(load(name)).expect("data");
        data.ctrl_mut().fill(2.0);
        for _ in 0..300 {
            data.step().expect("step");
        }
        let state = data.state();
        let run = |data: &mut Data| {
            for _ in 0..100 {
                data.step().expect("step");
            }
            data.state()
        };
        let first = run(&mut data);
        data.restore_state(&state).expect("restore");
        assert_eq!(data.state(), state);
        assert_eq!(run(&mut data), first, "{name}");
    }
}

#[test]
fn names_and_arrays() {
    let model = load("arm");
    assert_eq!(model.id(ObjectKind::Joint, "elbow").expect("elbow"), 1);
    println!(
        "{}",
        model.id(ObjectKind::Joint, "knee").expect_err("no knee")
    );
    assert_eq!(model.jnt_range(), [-1.5, 1.5, -2.0, 2.0]);
    assert_eq!(model.numeric_field("body_mass"), Some(model.body_mass()));
}
