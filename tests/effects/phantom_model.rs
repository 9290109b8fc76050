//! Every effect on the shipped model.

use std::path::Path;

use phantom::gap::effect::Role as EffectRole;
use phantom::gap::effect::{Effect, ModelFile, Place, Scales, candidates, write};
use phantom::mjcf::attribute::{Target, resolve};
use phantom::mjcf::edit;
use phantom::mujoco::{Data, Model};
use phantom::sysid::parameter::{Parameters, Role};

fn shipped(damping: bool) -> ModelFile {
    let text = std::fs::read_to_string("xml/phantom.xml").expect("the shipped model");
    // solved to the limit of doubles, so that forward and inverse dynamics are the same numbers
    let text = text.replace(
        "iterations=\"20\" tolerance=\"1e-8\"",
        "iterations=\"100\" tolerance=\"0\"",
    );
    let text = if damping {
        text
    } else {
        text.replace("damping=\"0.002\"", "damping=\"0\"")
    };
    ModelFile::of_text(text, Path::new("xml/phantom.xml")).expect("loads")
}

fn typical(effect: &dyn Effect, model: &Model, place: &Place) -> Vec<f64> {
    let scales = Scales::of(model, place);
    effect
        .about()
        .parameters
        .iter()
        .map(|p| p.typical(&scales))
        .collect()
}

fn label(effect: &dyn Effect, place: &Place) -> String {
    format!("{} at {place}", effect.about().name)
}

/// Each effect at its first and its last place.
fn some(model: &Model) -> Vec<(&'static dyn Effect, Place)> {
    let all = candidates(model);
    let ends = |(i, (effect, _)): &(usize, &(&'static dyn Effect, Place))| {
        let other = |j: Option<usize>| {
            j.and_then(|j| all.get(j))
                .is_none_or(|(e, _)| e.about().name != effect.about().name)
        };
        other(i.checked_sub(1)) || other(Some(i + 1))
    };
    all.iter()
        .enumerate()
        .filter(ends)
        .map(|(_, c)| c.clone())
        .collect()
}

/// The number behind an estimated parameter.
fn target(model: &Model, rule: &phantom::sysid::parameter::ParameterRule) -> Target {
    resolve(model, &rule.element, &rule.attribute, &rule.components)
        .expect("an address")
        .remove(0)
}

/// Written, loaded and read back an effect has the values it was given; the estimator accepts its parameters.
#[test]
fn values_come_back_from_the_file() {
    let base = shipped(true);
    let all = some(&base.model);
    assert!(all.len() > 60, "{}", all.len());
    for (effect, place) in all {
        let label = label(effect, &place);
        let values = typical(effect, &base.model, &place);
        let written = write(&base, effect, &place, &values).unwrap_or_else(|e| panic!("{e}"));
        let again = ModelFile::of_text(written.file.xml.clone(), &base.path).expect("loads");
        let rules: Vec<_> = written.estimated.iter().map(|e| e.rule.clone()).collect();
        let parameters =
            Parameters::new(&again.model, &rules, &[]).unwrap_or_else(|e| panic!("{label}: {e}"));
        for (estimated, parameter) in written.estimated.iter().zip(&parameters.all) {
            let Role::Model(targets) = &parameter.role else {
                panic!("{label}: a number of the model")
            };
            assert_eq!(targets.len(), 1, "{label}");
            let value = estimated.value_of(targets[0].1);
            let expected = values[estimated.parameter];
            assert!(
                (value - expected).abs() <= 1e-9 * (1e-3 + expected.abs()),
                "{label}: {value} {expected}"
            );
            let back = estimated.value_of(estimated.number_of(2.0 * expected));
            assert!(
                (back - 2.0 * expected).abs() <= 1e-9 * (1e-3 + expected.abs()),
                "{label}"
            );
        }
        let comments = |xml: &str| xml.matches("<!--").count();
        assert_eq!(comments(&written.file.xml), comments(&base.xml), "{label}");
        assert_eq!(
            written.file.model.nq(),
            base.model.nq(),
            "{label}: the same states"
        );
        assert_eq!(
            written.file.model.nu(),
            base.model.nu(),
            "{label}: the same controls"
        );
    }
}

/// What the fingers do.
#[derive(Debug, Clone, Copy)]
struct Drive {
    /// rad by which they close on the object
    close: f64,
    /// rad of their swing
    swing: f64,
    /// rad/s by which the object turns on the spot at first
    spin: f64,
}

/// In the air, all over their range.
const FREE: Drive = Drive {
    close: -0.15,
    swing: 0.15,
    spin: 0.0,
};
/// Against the object.
const PUSHING: Drive = Drive {
    close: 0.2,
    swing: 0.06,
    spin: 3.0,
};

impl Drive {
    /// A stiff joint controller around moving targets.
    fn command(self, data: &Data, time: f64, ctrl: &mut [f64]) {
        for finger in 0..3 {
            let phase = 2.0 * finger as f64;
            let goal = [
                0.3 * self.swing * (7.0 * time + phase).sin(),
                0.25 * self.swing * (11.0 * time + phase).sin(),
                self.close * (8.0 * time).min(1.0) + self.swing * (9.0 * time + phase).sin(),
            ];
            for (motor, goal) in goal.iter().enumerate() {
                let [q, v] = data.joint_state(5 * finger + motor);
                ctrl[3 * finger + motor] = (4.0 * (goal - q) - 0.1 * v).clamp(-1.5, 1.5);
            }
        }
    }
}

/// Degree of freedom of the object's turn about the vertical.
const SPIN: usize = 20;

struct Motion {
    qpos: Vec<Vec<f64>>,
    qvel: Vec<Vec<f64>>,
    ctrl: Vec<Vec<f64>>,
}

fn simulate(model: &ModelFile, drive: Drive, steps: usize) -> Motion {
    let mut data = Data::new(model.model.clone()).expect("data");
    data.reset_to_keyframe(0).expect("home");
    data.qvel_mut()[SPIN] = drive.spin;
    let mut motion = Motion {
        qpos: Vec::new(),
        qvel: Vec::new(),
        ctrl: Vec::new(),
    };
    let mut ctrl = vec![0.0; data.model().nu()];
    for _ in 0..steps {
        drive.command(&data, data.time(), &mut ctrl);
        data.ctrl_mut().copy_from_slice(&ctrl);
        motion.qpos.push(data.qpos().to_vec());
        motion.qvel.push(data.qvel().to_vec());
        motion.ctrl.push(ctrl.clone());
        data.step().expect("step");
    }
    assert!(!data.warnings().any(), "{}", data.warnings());
    motion
}

/// rms of the force that a model leaves unexplained of a motion, over that of the motors.
fn unexplained(model: &ModelFile, motion: &Motion) -> f64 {
    let mut data = Data::new(model.model.clone()).expect("data");
    let h = model.model.timestep();
    let (mut residual, mut motor) = (0.0, 0.0);
    for k in 0..motion.qpos.len() - 1 {
        data.qpos_mut().copy_from_slice(&motion.qpos[k]);
        data.qvel_mut().copy_from_slice(&motion.qvel[k]);
        data.ctrl_mut().copy_from_slice(&motion.ctrl[k]);
        // the engine integrates damping D implicitly: its step has (M + h D) a = M qacc
        data.position_stage().expect("finite");
        let mut extra = vec![0.0; data.model().nv()];
        let (now, next) = (&motion.qvel[k], &motion.qvel[k + 1]);
        let a: Vec<f64> = next.iter().zip(now).map(|(b, a)| (b - a) / h).collect();
        let damped: Vec<f64> = a
            .iter()
            .zip(data.model().dof_damping())
            .map(|(a, d)| h * d * a)
            .collect();
        data.solve_mass_matrix(&mut extra, &damped)
            .expect("lengths");
        for ((qacc, a), extra) in data.qacc_mut().iter_mut().zip(&a).zip(&extra) {
            *qacc = a + extra;
        }
        data.inverse().expect("inverse");
        data.actuation().expect("actuation");
        data.advance_memory();
        for (inverse, actuator) in data.qfrc_inverse().iter().zip(data.qfrc_actuator()) {
            residual += (inverse - actuator).powi(2);
        }
        motor += data.qfrc_actuator().iter().map(|f| f * f).sum::<f64>();
    }
    (residual / motor).sqrt()
}

/// Effects that need contact to act.
const OF_CONTACT: [&str; 9] = [
    "base_pose",
    "object_mass",
    "contact_friction",
    "torsional_friction",
    "friction_cone",
    "contact_stiffness",
    "contact_damping",
    "anisotropic_friction",
    "fingertip_radius",
];
/// Effects on readings: the motion needs no other force.
const OF_READINGS: [&str; 4] = [
    "encoder_offset",
    "encoder_scale",
    "sensor_delay",
    "force_sensor_bias",
];

/// The model that made a motion explains it, in the air and in contact; the model without the effect does not.
#[test]
fn inverse_dynamics_finds_nothing_missing_at_the_truth() {
    let base = shipped(false);
    // solvers end a little short of the solution, in contact most of all
    let floor = |drive| unexplained(&base, &simulate(&base, drive, 600));
    let (in_air, in_contact) = (floor(FREE), floor(PUSHING));
    assert!(
        in_air < 1e-6 && in_contact < 3e-3,
        "{in_air:e} {in_contact:e}"
    );
    let mut seen: Vec<&str> = Vec::new();
    for (effect, place) in candidates(&base.model) {
        let name = effect.about().name;
        let touches = OF_CONTACT.contains(&name);
        // one place of each, of the second finger where there are several
        let one = |other: &str| place.name.starts_with(other);
        // the load of the shoulder never reverses
        let motor = if name == "backlash" { "p1_m1" } else { "p1_m2" };
        let of_finger =
            one("p1_upper") || one(motor) || one("p1_object") || one("p1_tip") || one("p1_base");
        if seen.contains(&name)
            || place.name == "p1_object" && name == "torsional_friction"
            || !(of_finger
                || one("p0_force")
                || place.name == "object" && name == "object_mass"
                || place.name == "object_table" && name == "torsional_friction"
                || place.name.is_empty())
        {
            continue;
        }
        seen.push(name);
        let mut values = typical(effect, &base.model, &place);
        match name {
            "torque_saturation" => values[0] = 0.95,
            "joint_stop" => values[1..3].copy_from_slice(&[0.0, -1.0]),
            _ => {}
        }
        let written = write(&base, effect, &place, &values).unwrap_or_else(|e| panic!("{e}"));
        let (drive, floor) = if touches {
            (PUSHING, in_contact)
        } else {
            (FREE, in_air)
        };
        let motion = simulate(&written.file, drive, 600);
        let label = label(effect, &place);
        let (with, without) = (
            unexplained(&written.file, &motion),
            unexplained(&base, &motion),
        );
        assert!(with < 3.0 * floor + 1e-7, "{label}: {with:e}");
        if !OF_READINGS.contains(&name) {
            let factor = if touches { 3.0 } else { 100.0 };
            assert!(without > factor * with, "{label}: {without:e} {with:e}");
        }
    }
    assert_eq!(seen.len(), 36, "{seen:?}");
}

/// With its numbers back at 0 a written effect is absent, to the bit where it is not one of another structure.
#[test]
fn numbers_at_0_are_the_model_without() {
    let base = shipped(true);
    let reference = simulate(&base, PUSHING, 150);
    for (effect, place) in candidates(&base.model) {
        let name = effect.about().name;
        if !place.name.starts_with("p0_turret")
            && ![
                "p0_m2",
                "p0_force",
                "p0_object",
                "p0_base",
                "object",
                "p0_tip",
                "p0_upper",
                "",
            ]
            .contains(&place.name.as_str())
        {
            continue;
        }
        let label = label(effect, &place);
        let values = typical(effect, &base.model, &place);
        let written = write(&base, effect, &place, &values).unwrap_or_else(|e| panic!("{e}"));
        let zeros: Vec<(Target, f64)> = (written.estimated.iter())
            .filter(|e| {
                let role = effect.about().parameters[e.parameter].role;
                !matches!(role, EffectRole::Shape(_) | EffectRole::Choice(_))
            })
            .map(|e| {
                // to the bit, where the model without has the number
                let rule = &e.rule;
                let before = resolve(
                    &base.model,
                    &rule.element,
                    &rule.attribute,
                    &rule.components,
                );
                let relative = ["tilt", "rotation", "geometry"].contains(&rule.attribute.as_str());
                let number = match before {
                    Ok(targets) if !relative => targets[0].value(&base.model),
                    _ => e.number_of(0.0),
                };
                (target(&written.file.model, rule), number)
            })
            .collect();
        // a payload of mass 0 is no body, a cone no number
        if zeros.is_empty() || name == "payload" {
            continue;
        }
        let mut model = written.file.model.try_clone().expect("a copy");
        let numbers: Vec<(&Target, f64)> = zeros.iter().map(|(t, v)| (t, *v)).collect();
        let mut edit = model.edit();
        edit::write(&mut edit, &numbers, false);
        edit.finish().expect("constants");
        let mut late = model.edit();
        edit::write(&mut late, &numbers, true);
        drop(late);
        let absent = ModelFile {
            model: model.into(),
            ..written.file.clone()
        };
        let motion = simulate(&absent, PUSHING, 150);
        // the same law in other numbers: rounding
        let rounds = [
            "contact_stiffness",
            "contact_damping",
            "base_pose",
            "gravity_tilt",
            "link_mass",
            "object_mass",
            "length_scale",
        ]
        .contains(&name);
        let worst = reference
            .qpos
            .iter()
            .flatten()
            .zip(motion.qpos.iter().flatten());
        let worst = worst.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(
            worst == 0.0 || (rounds && worst < 1e-10),
            "{label}: {worst:e}"
        );
    }
}
