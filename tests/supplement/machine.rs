//! A rotor on a hinge, whose whole equation is I q'' = torque, and what tests do with it.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::supplement;

/// kg m², armature included
pub(crate) const INERTIA: f64 = 0.012;
pub(crate) const ARMATURE: f64 = 0.002;
/// s
pub(crate) const STEP: f64 = 0.001;

/// The rotor with custom elements and more attributes of its joint.
pub(crate) fn text(custom: &str, joint: &str) -> String {
    format!(
        r#"<mujoco><option timestep="{STEP}" gravity="0 0 0" iterations="200" tolerance="0"/>
        <worldbody><body name="link"><inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <joint name="j" axis="0 0 1" armature="{ARMATURE}" {joint}/></body></worldbody>
        <actuator><motor name="m" joint="j" ctrllimited="true" ctrlrange="-2 2"/></actuator>
        <sensor><jointpos name="q" joint="j"/><jointvel name="v" joint="j"/></sensor>
        <custom>{custom}</custom></mujoco>"#
    )
}

/// One numeric of the scheme.
pub(crate) fn numeric(kind: &str, element: &str, data: &str) -> String {
    format!(r#"<numeric name="phantom:{kind}:{element}" data="{data}"/>"#)
}

pub(crate) fn rotor(custom: &str, joint: &str) -> Data {
    let text = text(custom, joint);
    let model = Model::from_xml_str(&text).unwrap_or_else(|e| panic!("{e}"));
    let model = supplement::attach(model).unwrap_or_else(|e| panic!("{e}"));
    Data::new(Arc::new(model)).expect("data")
}

/// A torque that reverses, of several frequencies, N m.
pub(crate) fn torque(k: usize) -> f64 {
    let t = k as f64 * STEP;
    0.2 * (9.0 * t + 0.3).sin() + 0.1 * (31.0 * t).sin()
}

/// Positions, velocities and readings of `n` steps under [`torque`], each from before its step.
pub(crate) struct Run {
    pub q: Vec<f64>,
    pub v: Vec<f64>,
    pub reading: Vec<[f64; 2]>,
}

pub(crate) fn run(data: &mut Data, n: usize) -> Run {
    let mut run = Run {
        q: Vec::new(),
        v: Vec::new(),
        reading: Vec::new(),
    };
    for k in 0..n {
        data.ctrl_mut()[0] = torque(k);
        run.q.push(data.qpos()[0]);
        run.v.push(data.qvel()[0]);
        data.step().expect("step");
        run.reading
            .push([data.sensordata()[0], data.sensordata()[1]]);
    }
    assert!(!data.warnings().any(), "{}", data.warnings());
    run
}

/// The same by the equation itself: semi-implicit Euler under `force(k, q, v)`, which includes the motor.
pub(crate) fn derive(n: usize, mut force: impl FnMut(usize, f64, f64) -> f64) -> [Vec<f64>; 2] {
    let (mut q, mut v) = (0.0, 0.0);
    let mut all = [Vec::new(), Vec::new()];
    for k in 0..n {
        all[0].push(q);
        all[1].push(v);
        v += STEP * force(k, q, v) / INERTIA;
        q += STEP * v;
    }
    all
}

pub(crate) fn assert_close(a: &[f64], b: &[f64], tolerance: f64, what: &str) {
    assert_eq!(a.len(), b.len(), "{what}");
    let size = b.iter().fold(1e-6_f64, |m, x| m.max(x.abs()));
    for (k, (a, b)) in a.iter().zip(b).enumerate() {
        assert!(
            (a - b).abs() <= tolerance * size,
            "{what}, step {k}: {a} and {b}"
        );
    }
}
