//! What sensors make of the machine.

use phantom::mujoco::{Data, Model};

use crate::machine::{numeric, rotor, run};

const N: usize = 400;

#[test]
fn encoders_scale_then_shift_then_delay() {
    let custom = [
        numeric("encoder_offset", "j", "0.07"),
        numeric("sensor_delay", "encoders", "0.0025"),
        numeric("encoder_scale", "j", "0.2"),
    ]
    .concat();
    let simulated = run(&mut rotor(&custom, ""), N);
    let plain = run(&mut rotor("", ""), N);
    assert_eq!(simulated.q, plain.q, "the machine moves as before");
    let shown = |k: usize| [1.2 * plain.q[k] + 0.07, 1.2 * plain.v[k]];
    for k in 3..N {
        let (a, b) = (shown(k - 2), shown(k - 3));
        for i in 0..2 {
            let expected = 0.5 * (a[i] + b[i]);
            assert!(
                (simulated.reading[k][i] - expected).abs() < 1e-14,
                "step {k}"
            );
        }
    }
}

/// A window that begins in motion: its first readings are of before.
#[test]
fn a_past_is_shown_late() {
    let mut data = rotor(&numeric("sensor_delay", "encoders", "0.0035"), "");
    let speed = 0.8;
    for ago in (1..=50).rev() {
        data.qpos_mut()[0] = 0.3 - f64::from(ago) * 0.001 * speed;
        data.qvel_mut()[0] = speed;
        data.advance_past().expect("remembered");
    }
    data.qpos_mut()[0] = 0.3;
    let [q, v] = data.encoder(0);
    assert!((q - (0.3 - 0.0035 * speed)).abs() < 1e-14 && (v - speed).abs() < 1e-14);
}

#[test]
fn what_is_encoded_is_decoded() {
    let custom = [
        numeric("encoder_offset", "j", "0.07"),
        numeric("encoder_scale", "j", "-0.1"),
        numeric("transmission_compliance", "m", "0.05 0.4"),
    ]
    .concat();
    let mut data = rotor(&custom, "");
    run(&mut data, 100);
    let [q, v] = data.decode(0, data.encoder(0));
    assert!((data.encoder(0)[0] - data.qpos()[0]).abs() > 0.05);
    assert!((q - data.qpos()[0]).abs() < 1e-15 && (v - data.qvel()[0]).abs() < 1e-14);
}

#[test]
fn a_force_sensor_shows_its_bias() {
    let text = |custom: &str| {
        format!(
            r#"<mujoco><worldbody><body name="b"><joint name="j" type="slide" axis="0 0 1"/>
            <geom size="0.1" mass="2"/><body name="tip"><geom size="0.01" mass="1"/><site name="s"/></body></body></worldbody>
            <sensor><force name="f" site="s"/><torque name="t" site="s"/></sensor><custom>{custom}</custom></mujoco>"#
        )
    };
    let read = |custom: &str| {
        let model = phantom::supplement::attach(Model::from_xml_str(&text(custom)).expect("loads"));
        let mut data = Data::new(std::sync::Arc::new(model.expect("a law"))).expect("data");
        data.step().expect("step");
        let stepped = data.sensordata().to_vec();
        data.forward().expect("forward");
        data.inverse().expect("inverse");
        (stepped, data.sensordata().to_vec())
    };
    let (plain, biased) = (
        read(""),
        read(&numeric("force_sensor_bias", "f", "0.1 -0.2 0.4")),
    );
    let bias = [0.1, -0.2, 0.4, 0.0, 0.0, 0.0];
    for (plain, biased) in [(plain.0, biased.0), (plain.1, biased.1)] {
        for ((p, b), bias) in plain.iter().zip(&biased).zip(bias) {
            assert!((b - p - bias).abs() < 1e-12, "{plain:?} {biased:?}");
        }
    }
}
