//! Encoders that are late: what windows know of the motion before them.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};

use crate::rotor::{fitted, record, rotor};

/// s
const STEP: f64 = 0.001;

/// A rotor whose encoder is `late_s` late.
fn late(late_s: f64) -> Arc<Model> {
    let custom = format!(r#"<numeric name="phantom:sensor_delay:encoders" data="{late_s}"/>"#);
    rotor(STEP, 0.01, r#"damping="0.02""#, &custom)
}

/// With windows begun as if at constant velocity it came out 0.2 ms too large, its interval twenty times as wide.
#[test]
fn lateness_is_estimated_from_windows_that_begin_in_motion() {
    const TRUE_S: f64 = 0.013;
    let config = r#"
        command = "held"
        [[parameter]]
        element = "custom/phantom:sensor_delay:encoders"
        attribute = "data"
        components = [0]
        scale = "linear"
        lower = 0.0
        upper = 0.04
        "#;
    let torque = |k: i64, _: &Data| {
        let t = k as f64 * STEP;
        0.4 * (9.0 * t).sin() + 0.5 * (37.0 * t + 1.0).sin()
    };
    let (values, _) = fitted(late(0.01), config, &record(late(TRUE_S), torque));
    let late_s = values[0];
    assert!((late_s - TRUE_S).abs() < 2e-5, "{late_s}");
}
