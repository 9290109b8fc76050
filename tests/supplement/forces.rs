//! Forces of joints and contacts.

use phantom::mujoco::{Data, Model};

use crate::machine::{INERTIA, STEP, assert_close, derive, numeric, rotor, run, torque};

const N: usize = 1500;

#[test]
fn laws_of_position_and_velocity() {
    type Law = fn(f64, f64) -> f64;
    let laws: [(&str, &str, Law); 5] = [
        ("quadratic_drag", "0.03", |_, v| -0.03 * v * v.abs()),
        ("torque_offset", "-0.04", |_, _| -0.04),
        ("cogging", "0.05 -0.02 14", |q, _| {
            0.05 * (14.0 * q).sin() - 0.02 * (14.0 * q).cos()
        }),
        ("joint_stop", "3 0.1 1 0.02", |q, v| {
            if q > 0.1 {
                -(3.0 * (q - 0.1) + 0.02 * v).max(0.0)
            } else {
                0.0
            }
        }),
        ("joint_stop", "3 0.1 -1 0", |q, _| {
            if q < 0.1 { 3.0 * (0.1 - q) } else { 0.0 }
        }),
    ];
    let plain = run(&mut rotor("", ""), N);
    for (kind, data, law) in laws {
        let simulated = run(&mut rotor(&numeric(kind, "j", data), ""), N);
        let [q, v] = derive(N, |k, q, v| torque(k) + law(q, v));
        assert_close(&simulated.q, &q, 1e-11, kind);
        assert_close(&simulated.v, &v, 1e-11, kind);
        let moved = (simulated.q[N - 1] - plain.q[N - 1]).abs();
        assert!(moved > 1e-3, "{kind} matters: {moved}");
    }
}

/// Friction laws against a model whose `frictionloss` is set anew before each step.
#[test]
fn friction_laws_move_the_level_of_dry_friction() {
    type Level = fn(f64, f64) -> f64;
    let laws: [(&str, &str, Level); 2] = [
        ("stribeck_friction", "0.04 0.3", |v, _| {
            0.05 + 0.04 * (-(v / 0.3) * (v / 0.3)).exp()
        }),
        ("load_dependent_friction", "0.2", |_, tau| {
            0.05 + 0.2 * tau.abs()
        }),
    ];
    for (kind, numbers, level) in laws {
        let simulated = run(
            &mut rotor(&numeric(kind, "j", numbers), r#"frictionloss="0.05""#),
            N,
        );
        let mut plain = rotor("", r#"frictionloss="0.05""#);
        let constant = run(&mut rotor("", r#"frictionloss="0.05""#), N);
        for k in 0..N {
            let v = plain.qvel()[0];
            assert_eq!(simulated.q[k], plain.qpos()[0], "{kind}, step {k}");
            plain
                .edit_model(|edit| edit.dof_frictionloss()[0] = level(v, torque(k)))
                .expect("finite");
            plain.ctrl_mut()[0] = torque(k);
            plain.step().expect("step");
        }
        assert!(
            (simulated.q[N - 1] - constant.q[N - 1]).abs() > 1e-3,
            "{kind} matters"
        );
    }
}

/// More friction forwards than backwards, of which each slows its own direction; at rest it holds whatever is between.
#[test]
fn friction_differs_with_direction() {
    let (asymmetry, level) = (0.03, 0.05);
    let rotor = |v: f64| {
        let mut data = rotor(
            &numeric("asymmetric_friction", "j", "0.03"),
            r#"frictionloss="0.05""#,
        );
        data.qvel_mut()[0] = v;
        data
    };
    for (v, held) in [(2.0, level + asymmetry), (-2.0, level - asymmetry)] {
        let mut data = rotor(v);
        for _ in 0..100 {
            data.step().expect("step");
        }
        let slowed = (v - data.qvel()[0]) * v.signum() * INERTIA / (100.0 * STEP);
        assert!((slowed - held).abs() < 1e-9, "{slowed} {held}");
        // a torque just short of the level moves hardly, one just above does
        for (part, moves) in [(0.95, false), (1.05, true)] {
            let mut data = rotor(0.0);
            data.ctrl_mut()[0] = part * held * v.signum();
            for _ in 0..1000 {
                data.step().expect("step");
            }
            let moved = data.qpos()[0].abs();
            assert_eq!(moved > 0.01, moves, "{part} of {held}: {moved}");
        }
    }
}

/// A level cannot fall below nothing: friction never drives.
#[test]
fn friction_never_drives() {
    let mut data = rotor(
        &numeric("asymmetric_friction", "j", "0.5"),
        r#"frictionloss="0.1""#,
    );
    data.qvel_mut()[0] = -1.0;
    for _ in 0..100 {
        data.step().expect("step");
        assert!((data.qvel()[0] + 1.0).abs() < 1e-12, "{}", data.qvel()[0]);
    }
}

/// A disc that stands on the floor and spins: only torsional friction slows it.
fn disc(custom: &str) -> Data {
    let text = format!(
        r#"<mujoco><option timestep="0.001" cone="pyramidal" tolerance="0" iterations="100"/>
        <worldbody><geom name="floor" type="plane" size="1 1 1" contype="0" conaffinity="0"/>
        <body name="disc" pos="0 0 0.1"><joint name="z" type="slide" axis="0 0 1"/><joint name="spin" axis="0 0 1"/>
        <geom name="disc" type="sphere" size="0.1" mass="2" contype="0" conaffinity="0"/></body></worldbody>
        <contact><pair name="p" geom1="disc" geom2="floor" condim="3"/></contact>
        <sensor><torque name="t" site="s"/></sensor><custom>{custom}</custom></mujoco>"#
    )
    .replace("<sensor><torque name=\"t\" site=\"s\"/></sensor>", "");
    let model =
        phantom::supplement::attach(Model::from_xml_str(&text).expect("loads")).expect("a law");
    Data::new(std::sync::Arc::new(model)).expect("data")
}

#[test]
fn torsional_friction_slows_spin_by_the_normal_force() {
    let mut data = disc(&numeric("torsional_friction", "p", "0.01 0.5"));
    let mut plain = disc("");
    for data in [&mut data, &mut plain] {
        for _ in 0..1000 {
            data.step().expect("rests");
        }
        data.qvel_mut()[1] = 3.0;
    }
    let inertia = 0.4 * 2.0 * 0.01;
    let mut spin: f64 = 3.0;
    for k in 0..200 {
        data.step().expect("step");
        plain.step().expect("step");
        spin -= 0.001 * 0.01 * 2.0 * 9.81 * (spin / 0.5).tanh() / inertia;
        assert!(
            (data.qvel()[1] - spin).abs() < 1e-4 * spin,
            "step {k}: {} {spin}",
            data.qvel()[1]
        );
    }
    assert_eq!(plain.qvel()[1], 3.0);
    // the contact is as stiff as without
    assert!((data.qpos()[0] - plain.qpos()[0]).abs() < 1e-9);
}
