//! A supplement in every way a step is computed.

use std::sync::Arc;

use phantom::mujoco::{Data, MujocoError};
use phantom::supplement::KINDS;

use crate::machine::{INERTIA, STEP, numeric, rotor, run, torque};

/// One of each kind that fits the rotor.
const ALL: [(&str, &str, &str, &str); 14] = [
    ("actuator_delay", "m", "0.0034", "0"),
    ("actuator_lag", "m", "0.003", "0"),
    ("torque_ripple", "m", "0.2 0.1 20", "0 0 20"),
    ("backlash", "m", "0.01", "0"),
    ("transmission_compliance", "m", "0.01 0.3", "0 0.3"),
    ("asymmetric_friction", "j", "0.01", "0"),
    ("stribeck_friction", "j", "0.02 0.3", "0 0.3"),
    ("load_dependent_friction", "j", "0.1", "0"),
    ("quadratic_drag", "j", "0.03", "0"),
    ("torque_offset", "j", "0.02", "0"),
    ("cogging", "j", "0.03 0.02 15", "0 0 15"),
    ("joint_stop", "j", "3 0.05 1 0.02", "0 0.05 1 0"),
    ("encoder_scale", "j", "0.1", "0"),
    ("encoder_offset", "j", "0.02", "0"),
];
const FRICTION: &str = r#"frictionloss="0.03""#;

fn together() -> String {
    let some = ALL
        .iter()
        .map(|(kind, element, numbers, _)| numeric(kind, element, numbers));
    some.chain([numeric("sensor_delay", "encoders", "0.0021")])
        .collect()
}

#[test]
fn the_list_is_whole() {
    let listed = |name: &str| ALL.iter().any(|(kind, ..)| *kind == name);
    let elsewhere = ["sensor_delay", "torsional_friction", "force_sensor_bias"];
    for kind in KINDS {
        assert!(
            listed(kind.name) || elsewhere.contains(&kind.name),
            "{}",
            kind.name
        );
    }
}

/// A law of size 0 changes no bit.
#[test]
fn nothing_is_nothing() {
    let bits = |data: &mut Data| {
        let run = run(data, 300);
        (run.q, run.v, run.reading)
    };
    let plain = bits(&mut rotor("", FRICTION));
    for (kind, element, numbers, zero) in ALL {
        let absent = bits(&mut rotor(&numeric(kind, element, zero), FRICTION));
        assert!(absent == plain, "{kind} {zero}");
        let present = bits(&mut rotor(&numeric(kind, element, numbers), FRICTION));
        assert!(present != plain, "{kind} {numbers}");
    }
    let late = numeric("sensor_delay", "encoders", "0");
    assert!(bits(&mut rotor(&late, FRICTION)) == plain);
}

/// The force that the motion needs is the force there is, for each kind and for all together.
#[test]
fn inverse_dynamics_finds_nothing_missing() {
    let single = ALL
        .iter()
        .map(|(kind, element, numbers, _)| (*kind, numeric(kind, element, numbers)));
    for (kind, custom) in single.chain([("all", together())]) {
        let mut data = rotor(&custom, FRICTION);
        let mut inverse = Data::new(Arc::clone(data.model_arc())).expect("data");
        let (mut worst, mut unaware) = (0.0_f64, 0.0_f64);
        let mut plain = rotor("", FRICTION);
        for k in 0..800 {
            for inverse in [&mut inverse, &mut plain] {
                inverse.qpos_mut().copy_from_slice(data.qpos());
                inverse.qvel_mut().copy_from_slice(data.qvel());
                inverse.ctrl_mut()[0] = torque(k);
            }
            assert_eq!(inverse.memory(), data.memory(), "{kind}, step {k}");
            data.ctrl_mut()[0] = torque(k);
            let before = data.qvel()[0];
            data.step().expect("step");
            let acceleration = (data.qvel()[0] - before) / STEP;
            for (inverse, worst) in [(&mut inverse, &mut worst), (&mut plain, &mut unaware)] {
                inverse.qacc_mut()[0] = acceleration;
                inverse.inverse().expect("inverse");
                inverse.actuation().expect("actuation");
                *worst = worst.max((inverse.qfrc_inverse()[0] - inverse.qfrc_actuator()[0]).abs());
            }
            // computed without a step, remembered as if there had been one
            inverse.advance_memory();
        }
        assert!(worst < 1e-9, "{kind}: {worst}");
        let unseen = ["encoder_scale", "encoder_offset"].contains(&kind);
        assert!(unseen || unaware > 5e-3, "{kind}: {unaware}");
    }
}

#[test]
fn forward_dynamics_is_that_of_the_step() {
    let mut data = rotor(&together(), FRICTION);
    for k in 0..300 {
        data.ctrl_mut()[0] = torque(k);
        let state = data.state();
        data.forward().expect("forward");
        let (qacc, sensors) = (data.qacc()[0], data.sensordata().to_vec());
        assert_eq!(data.memory(), state.memory(), "no time passes");
        let before = data.qvel()[0];
        data.restore_state(&state).expect("same model");
        data.step().expect("step");
        assert!(
            (data.qvel()[0] - before - STEP * qacc).abs() < 1e-12,
            "step {k}"
        );
        assert_eq!(data.sensordata(), sensors, "step {k}");
    }
}

#[test]
fn halves_make_the_same_step() {
    let (mut whole, mut halves) = (rotor(&together(), FRICTION), rotor(&together(), FRICTION));
    halves.step1().expect("first half");
    for k in 0..500 {
        whole.ctrl_mut()[0] = torque(k);
        whole.step().expect("step");
        // the control is known only between the halves
        halves.ctrl_mut()[0] = torque(k);
        halves.step2().expect("second half");
        halves.step1().expect("first half");
        assert_eq!(
            whole.state(),
            {
                let mut s = halves.state();
                s.set_time(whole.time());
                s
            },
            "step {k}"
        );
    }
}

#[test]
fn a_restored_state_continues_with_the_same_bits() {
    let mut data = rotor(&together(), FRICTION);
    run(&mut data, 333);
    let state = data.state();
    assert!(!state.memory().is_empty());
    let first = run(&mut data, 200);
    let mut other = Data::new(Arc::clone(data.model_arc())).expect("data");
    other.restore_state(&state).expect("same model");
    let second = run(&mut other, 200);
    assert!(first.q == second.q && first.reading == second.reading);
    // the memory is what makes it so
    other.restore_state(&state).expect("same model");
    other
        .set_memory(&vec![0.0; state.memory().len()])
        .expect("length");
    assert!(run(&mut other, 200).q != first.q);
    assert!(rotor("", "").restore_state(&state).is_err());
    assert!(matches!(
        other.set_memory(&[0.0]),
        Err(MujocoError::Length { .. })
    ));
    other.reset();
    assert!(other.memory().iter().all(|m| *m == 0.0));
}

/// Numbers are read from the model in use: editing them changes the law of this simulation alone.
#[test]
fn numbers_are_parameters_of_the_model() {
    let mut data = rotor(&numeric("torque_offset", "j", "0"), "");
    let mut other = Data::new(Arc::clone(data.model_arc())).expect("data");
    data.edit_model(|edit| edit.numeric_data()[0] = 0.12)
        .expect("finite");
    data.step().expect("step");
    other.step().expect("step");
    assert!((data.qvel()[0] - STEP * 0.12 / INERTIA).abs() < 1e-15);
    assert_eq!(other.qvel()[0], 0.0);
}

/// Memory that depends on the time step follows it.
#[test]
fn a_finer_step_keeps_the_delay() {
    let mut data = rotor(&numeric("actuator_delay", "m", "0.004"), "");
    data.edit_model(|edit| edit.set_timestep(0.0001))
        .expect("edit")
        .expect("legal");
    for k in 0..100 {
        data.ctrl_mut()[0] = f64::from(u8::from(k >= 20));
        data.step().expect("step");
        assert_eq!(
            data.actuator_force()[0],
            f64::from(u8::from(k >= 60)),
            "step {k}"
        );
    }
}

#[test]
fn runge_kutta_is_refused() {
    let mut data = rotor(&numeric("torque_offset", "j", "0.1"), "");
    data.edit_model(|edit| {
        let mut option = edit.model().option();
        option.integrator = phantom::mujoco::Integrator::Rk4;
        edit.set_option(&option)
    })
    .expect("edit")
    .expect("legal");
    assert_eq!(data.step(), Err(MujocoError::RungeKutta));
}

/// A simulation that the engine resets forgets what it remembered.
#[test]
fn a_breakdown_is_forgotten() {
    let mut data = rotor(&numeric("actuator_lag", "m", "0.01"), "");
    run(&mut data, 50);
    assert!(data.memory().iter().any(|m| *m != 0.0));
    data.qpos_mut()[0] = f64::NAN;
    data.ctrl_mut()[0] = 0.0;
    data.step().expect("MuJoCo goes on");
    assert!(data.warnings().diverged());
    assert_eq!(data.memory(), [1.0, 0.0]);
}
