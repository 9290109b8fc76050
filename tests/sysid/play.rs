//! Play in a drive that rattles: windows put the motor where its readings show it.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};

use crate::rotor::{fitted, record, rotor};

/// s
const STEP: f64 = 5e-4;

/// A link behind a light motor with `play`, rad.
fn played(play: f64) -> Arc<Model> {
    let custom = format!(r#"<numeric name="phantom:backlash:m" data="{play}"/>"#);
    rotor(STEP, 0.001, r#"damping="0.002" armature="1e-5""#, &custom)
}

/// What windows of fifty flights leave, under the commands of a loop that is late.
#[test]
fn play_is_seen_in_windows_of_a_motor_that_rattles() {
    const TRUE: f64 = 0.008;
    let config = r#"
        command = "held"
        [[parameter]]
        element = "joint/j"
        attribute = "damping"
        prior_sigma = 0.1
        "#;
    let torque = |k: i64, data: &Data| {
        let (shown, own) = (data.encoder(0), data.joint_state(0));
        let before = shown[0] - own[0] - STEP * (shown[1] - own[1]);
        0.02 * (40.0 * k as f64 * STEP).sin() - 0.12_f64.copysign(before)
    };
    let recording = record(played(TRUE), torque);
    let left = |play: f64| fitted(played(play), config, &recording).1;
    let least = left(TRUE);
    let others = [0.0, 0.4, 0.8, 1.3].map(|part| left(part * TRUE));
    assert!(
        others.iter().all(|other| *other > 3.0 * least),
        "{least} {others:?}"
    );
}
