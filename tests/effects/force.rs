//! Forces of effects on a pendulum, each derived here from its law.

use phantom::gap::effect::Form;

use crate::machine::{
    FULL, GRAVITY, INERTIA, LENGTH, MASS, PENDULUM, State, file, missing, states, with,
};

/// The law's torque at a state.
type Law = fn(State) -> f64;

/// What dry friction of level f gives at a state: the engine's own softened constraint, from its documentation.
fn ramp(level: f64, State { v, a, .. }: State) -> f64 {
    // written with solreffriction = (two steps, 1) and an impedance of 0.99
    let inertia = INERTIA + MASS * LENGTH * LENGTH + 0.001;
    let (d, stiffness) = (0.99, 0.0);
    let resistance = (1.0 - d) / d / inertia;
    let reference = -2.0 / (d * 0.002) * v - stiffness;
    (-(a - reference) / resistance).clamp(-level, level)
}

#[test]
fn laws_on_a_pendulum() {
    const NATIVE: Form = Form::Mjcf;
    const ADDED: Form = Form::Supplement;
    let laws: &[(&str, &str, &[f64], Form, Law)] = &[
        ("viscous_friction", "j", &[0.05], NATIVE, |s| -0.05 * s.v),
        ("coulomb_friction", "j", &[0.07], NATIVE, |s| ramp(0.07, s)),
        ("asymmetric_friction", "j", &[0.02, 0.07], ADDED, |s| {
            ramp(0.07, s) - 0.02
        }),
        ("asymmetric_friction", "j", &[-0.02, 0.07], ADDED, |s| {
            ramp(0.07, s) + 0.02
        }),
        ("stribeck_friction", "j", &[0.04, 0.05, 0.6], ADDED, |s| {
            ramp(0.05 + 0.04 * (-(s.v / 0.6).powi(2)).exp(), s)
        }),
        ("load_dependent_friction", "j", &[0.1, 0.03], ADDED, |s| {
            ramp(0.03 + 0.1 * (2.0 * s.u).abs(), s)
        }),
        ("quadratic_drag", "j", &[0.04], ADDED, |s| {
            -0.04 * s.v * s.v.abs()
        }),
        ("joint_spring", "j", &[0.8, 0.2], NATIVE, |s| {
            -0.8 * (s.q - 0.2)
        }),
        ("torque_offset", "j", &[-0.06], NATIVE, |_| -0.06),
        ("rotor_inertia", "j", &[0.002], NATIVE, |s| -0.002 * s.a),
        ("cogging", "j", &[0.03, -0.01, 20.0], ADDED, |s| {
            0.03 * (20.0 * s.q).sin() - 0.01 * (20.0 * s.q).cos()
        }),
        ("joint_stop", "j", &[3.0, 0.4, 1.0, 0.0], ADDED, |s| {
            -3.0 * (s.q - 0.4).max(0.0)
        }),
        ("joint_stop", "j", &[3.0, -0.4, -1.0, 0.0], ADDED, |s| {
            3.0 * (-0.4 - s.q).max(0.0)
        }),
        ("link_mass", "link", &[0.2], NATIVE, |s| {
            let inertia = INERTIA + MASS * LENGTH * LENGTH;
            -0.2 * (inertia * s.a + MASS * GRAVITY * LENGTH * s.q.sin())
        }),
        ("payload", "link", &[0.05, 0.0, 0.0, -0.5], NATIVE, |s| {
            let ball = 0.4 * 0.05 * 1e-6;
            -((0.05 * 0.25 + ball) * s.a + 0.05 * GRAVITY * 0.5 * s.q.sin())
        }),
        ("gravity_tilt", "world", &[0.0, 0.1], NATIVE, |s| {
            // gravity turned about the axis: the pendulum hangs at 0.1
            let hang = |angle: f64| -MASS * GRAVITY * LENGTH * angle.sin();
            hang(s.q - 0.1) - hang(s.q)
        }),
        ("torque_gain", "m", &[0.15], NATIVE, |s| 0.15 * FULL * s.u),
        ("torque_saturation", "m", &[0.4], NATIVE, |s| {
            (FULL * s.u).clamp(-0.6 * FULL, 0.6 * FULL) - FULL * s.u
        }),
        ("torque_ripple", "m", &[0.1, 0.05, 12.0], ADDED, |s| {
            let control = s.u * (1.0 + 0.1 * (12.0 * s.q).sin() + 0.05 * (12.0 * s.q).cos());
            FULL * control.clamp(-1.0, 1.0) - FULL * s.u
        }),
    ];
    let base = file(PENDULUM);
    for (name, place, values, form, law) in laws {
        let written = with(&base, name, place, values);
        assert_eq!(written.form, *form, "{name}");
        let mut largest = 0.0_f64;
        for state in states() {
            // what the effect supplies is no longer missing
            let supplied = missing(&base, state) - missing(&written.file, state);
            let expected = law(state);
            largest = largest.max(expected.abs());
            assert!(
                (supplied - expected).abs() < 1e-9,
                "{name} at {state:?}: {supplied} {expected}"
            );
        }
        assert!(largest > 0.01, "{name}: {largest}");
    }
}

/// Two joints pulled together.
#[test]
fn a_coupling_pulls_on_both_joints() {
    let chain = PENDULUM.replace(
        r#"<site name="tip" pos="0 0 -0.6"/>"#,
        r#"<body name="second" pos="0 0 -0.6"><joint name="k" axis="0 1 0"/>
           <inertial pos="0 0 -0.1" mass="0.1" diaginertia="1e-3 1e-3 1e-3"/></body>"#,
    );
    // without a motor on the second joint both have to be named as joints of one mechanism
    let chain = chain.replace(
        r#"<motor name="m""#,
        r#"<motor name="n" joint="k"/>
    <motor name="m""#,
    );
    let base = file(&chain);
    let written = with(&base, "joint_coupling", "j+k", &[0.7]);
    let force = |model: &phantom::gap::effect::ModelFile| {
        let mut data = phantom::mujoco::Data::new(model.model.clone()).expect("data");
        data.qpos_mut().copy_from_slice(&[0.3, -0.2]);
        data.inverse().expect("inverse");
        [data.qfrc_inverse()[0], data.qfrc_inverse()[1]]
    };
    let (without, with) = (force(&base), force(&written.file));
    for (i, expected) in [-0.7 * 0.5, 0.7 * 0.5].into_iter().enumerate() {
        assert!((without[i] - with[i] - expected).abs() < 1e-12, "{i}");
    }
}

/// An offset on a joint that no motor drives has no element of the engine.
#[test]
fn an_offset_without_a_motor_is_a_supplement() {
    let base = file(&PENDULUM.replace(
        "<motor name=\"m\" joint=\"j\"",
        "<position name=\"m\" joint=\"j\"",
    ));
    let written = with(&base, "torque_offset", "j", &[0.05]);
    assert_eq!(written.form, Form::Supplement);
    let state = State {
        q: 0.1,
        v: 0.2,
        a: 0.3,
        u: 0.0,
    };
    assert!((missing(&base, state) - missing(&written.file, state) - 0.05).abs() < 1e-12);
}

/// A joint that is dry already keeps its constraint's parameters, and its level is added to.
#[test]
fn dry_friction_adds_to_what_there_is() {
    let dry = PENDULUM.replace(
        "armature",
        "frictionloss=\"0.04\" solreffriction=\"0.003 1\" armature",
    );
    let base = file(&dry);
    let written = with(&base, "stribeck_friction", "j", &[0.02, 0.01, 0.1]);
    let loss = written.file.model.dof_frictionloss()[0];
    assert!((loss - 0.05).abs() < 1e-15);
    assert_eq!(written.file.model.dof_solref()[..2], [0.003, 1.0]);
    assert!(!written.file.xml.contains("solimpfriction"));
}
