//! The catalogue's own consistency, and what is refused.

use phantom::gap::effect::Parameter;
use phantom::gap::effect::{CATALOGUE, Place, PlaceKind, Role, Scales, candidates, named, write};
use phantom::rig::behaviour::BEHAVIOURS;

use crate::machine::{PENDULUM, effect, file, with};

const NAMES: &str = "viscous_friction coulomb_friction asymmetric_friction stribeck_friction \
    load_dependent_friction quadratic_drag joint_spring torque_offset rotor_inertia link_mass payload gravity_tilt \
    torque_gain torque_saturation actuator_lag actuator_delay torque_ripple cogging backlash transmission_compliance \
    joint_coupling joint_stop encoder_offset encoder_scale sensor_delay force_sensor_bias base_pose object_mass \
    contact_friction torsional_friction friction_cone contact_stiffness contact_damping anisotropic_friction \
    fingertip_radius length_scale";

#[test]
fn every_effect_is_there_once_and_knows_its_like() {
    let names: Vec<&str> = CATALOGUE.iter().map(|e| e.about().name).collect();
    assert_eq!(names, NAMES.split_whitespace().collect::<Vec<_>>());
    for effect in CATALOGUE {
        let about = effect.about();
        assert!(!about.law.is_empty() && !about.signature.is_empty());
        for neighbour in about.neighbours {
            assert!(
                named(neighbour.name).is_some(),
                "{}: {}",
                about.name,
                neighbour.name
            );
            assert!(neighbour.name != about.name && !neighbour.split.is_empty());
        }
        for behaviour in about.behaviours {
            assert!(
                BEHAVIOURS.iter().any(|b| b.name == *behaviour),
                "{}: {behaviour}",
                about.name
            );
        }
        assert!(
            about.parameters.iter().any(Parameter::is_size),
            "{}",
            about.name
        );
    }
}

#[test]
fn sizes_follow_the_machine() {
    let base = file(PENDULUM);
    let place = Place::at(PlaceKind::Joint, "j");
    let scales = Scales::of(&base.model, &place);
    assert!((scales.travel - 3.0).abs() < 1e-12, "of the range");
    assert!(
        (scales.force - 0.2).abs() < 1e-12,
        "a tenth of what the motor gives"
    );
    for (effect, place) in candidates(&base.model) {
        let scales = Scales::of(&base.model, &place);
        for p in effect.about().parameters {
            let (typical, grid) = (p.typical(&scales), p.grid(&scales));
            assert!(typical.is_finite() && !p.unit(&scales).is_empty());
            let gridded = matches!(
                p.role,
                Role::Shape(_) | Role::Choice(_) | Role::Threshold(_) | Role::Bent(_)
            );
            assert_eq!(gridded, !grid.is_empty(), "{}", p.name);
            let starts = matches!(p.role, Role::Bent(_)) || grid.first() == Some(&typical);
            assert!(grid.is_empty() || starts, "{}", p.name);
            assert!(
                p.is_size() || !matches!(p.role, Role::Amplitude),
                "{}",
                p.name
            );
        }
    }
}

#[test]
fn nothing_is_written_at_size_0() {
    let base = file(PENDULUM);
    for (effect, place) in candidates(&base.model) {
        let scales = Scales::of(&base.model, &place);
        let values: Vec<f64> = (effect.about().parameters.iter())
            .map(|p| if p.is_size() { 0.0 } else { p.typical(&scales) })
            .collect();
        let written = write(&base, effect, &place, &values).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(written.file.xml, base.xml, "{}", effect.about().name);
    }
}

#[test]
fn mistakes_are_named() {
    let base = file(PENDULUM);
    let at = |kind, name: &str| Place::at(kind, name);
    let joint = at(PlaceKind::Joint, "j");
    let motor = at(PlaceKind::Actuator, "m");
    for (name, place, values, part) in [
        (
            "viscous_friction",
            &at(PlaceKind::Joint, "x"),
            &[0.1][..],
            "has no joint named 'x'; it has: j",
        ),
        (
            "viscous_friction",
            &joint,
            &[-0.1],
            "`damping` is -0.1, expected a number of at least 0",
        ),
        ("viscous_friction", &joint, &[f64::NAN], "`damping` is NaN"),
        (
            "viscous_friction",
            &joint,
            &[0.1, 0.2],
            "it has 1 parameters, got 2 values",
        ),
        (
            "torque_saturation",
            &motor,
            &[1.0],
            "`cut` is 1, which leaves nothing",
        ),
        (
            "joint_coupling",
            &joint,
            &[1.0],
            "a coupling needs a second joint",
        ),
        (
            "actuator_delay",
            &motor,
            &[0.2],
            "`time` is 0.2, expected 0 to 0.05",
        ),
    ] {
        let error = write(&base, effect(name), place, values)
            .expect_err(part)
            .to_string();
        assert!(error.contains(part) && error.contains(name), "{error}");
    }
}

/// A file keeps its comments and order: lines that say something else are those of the effect.
#[test]
fn nothing_else_changes_in_the_file() {
    let base = file(PENDULUM);
    let changed = |name: &str, place: &str, values: &[f64]| -> Vec<String> {
        let written = with(&base, name, place, values).file.xml;
        assert!(written.contains("<!-- hangs -->"));
        let before: Vec<&str> = base.xml.lines().collect();
        written
            .lines()
            .filter(|line| !before.contains(line))
            .map(|line| line.trim().to_owned())
            .collect()
    };
    assert_eq!(
        changed("viscous_friction", "j", &[0.05]),
        [
            r#"<joint name="j" axis="0 1 0" armature="0.001" limited="true" range="-1.5 1.5" damping="0.05"/>"#
        ]
    );
    assert_eq!(
        changed("torque_offset", "j", &[0.05]),
        [r#"<general name="m" joint="j" gear="2" ctrllimited="true" ctrlrange="-1 1" gaintype="fixed" gainprm="1" biastype="affine" biasprm="0.025 0 0"/>"#]
            .map(|line| line.replace("biasprm=\"0.025 0 0\"", "biasprm=\"0.025 0 0 0 0 0 0 0 0 0\""))
    );
    assert_eq!(
        changed("quadratic_drag", "j", &[0.05]),
        [
            "<custom>",
            r#"<numeric name="phantom:quadratic_drag:j" data="0.05"/>"#,
            "</custom>"
        ]
    );
    let payload = changed("payload", "link", &[0.05, 0.0, 0.1, 0.0]);
    let expected = r#"<body name="link_payload" pos="0 0.1 0"> <inertial pos="0 0 0" mass="0.05" diaginertia=""#;
    assert!(
        payload.len() == 1 && payload[0].starts_with(expected),
        "{payload:?}"
    );
}
