//! What a rig hides: every effect shows, and the truth alone says so.

use std::collections::BTreeMap;
use std::sync::Arc;

use phantom::mjcf;
use phantom::mujoco::{Data, ObjectKind};
use phantom::recording::Recording;
use phantom::rig::RigConfig;
use phantom::rig::effects::{self, CATALOGUE, EffectConfig, Place};

use super::{bits, coarse, config, rig, run, shipped};

/// A value of an effect that shows in a short trial, and where to put it.
fn place(name: &str, place: Place) -> (&'static str, &'static str) {
    match (name, place) {
        ("torque_saturation", _) => ("p1_m2", "free"),
        ("joint_stop", _) => ("p1_turret", "free"),
        ("link_mass" | "payload", _) => ("p1_forearm", "free"),
        ("object_mass", _) => ("object", "push"),
        ("base_pose", _) => ("p1_base", "push"),
        ("length_scale" | "fingertip_radius", _) => ("p1_tip", "push"),
        ("torsional_friction", _) => ("object_table", "push"),
        ("friction_cone", _) => ("", "push"),
        (_, Place::World) => ("", "free"),
        (_, Place::Joint) => ("p1_crank", "free"),
        (_, Place::Actuator) => ("p1_m3", "free"),
        (_, Place::Contact) => ("p1_object", "push"),
        (_, Place::Sensor) => ("p0_force", "free"),
        _ => ("*", "push"),
    }
}

fn effect(entry: &effects::Entry, amplitude: f64) -> EffectConfig {
    let mut parameters: BTreeMap<String, f64> = entry
        .parameters
        .iter()
        .map(|p| (p.name.to_owned(), 0.5 * (p.low + p.high)))
        .collect();
    parameters.insert(entry.parameters[0].name.to_owned(), amplitude);
    EffectConfig {
        name: entry.effect,
        place: place(entry.name, entry.place).0.to_owned(),
        with: (entry.name == "joint_coupling").then(|| "p1_upper".to_owned()),
        parameters,
    }
}

#[test]
fn every_effect_shows_in_the_recording_and_is_absent_at_amplitude_zero() {
    let record = |effects: Vec<EffectConfig>, what: &str| {
        let mut config = RigConfig {
            effect: effects,
            ..RigConfig::default()
        };
        coarse(&mut config);
        let rig = rig(config);
        let outcome = match what {
            "push" => run(&rig, "push", 2.0, 0),
            "free" => run(&rig, "multi_sine", 0.8, 0),
            _ => run(&rig, "multi_sine", 0.05, 0),
        };
        (bits(&outcome.recording), rig.truth().clone())
    };
    let (free, truth) = record(Vec::new(), "free");
    assert!(truth.parameter.is_empty() && truth.effect.is_empty());
    let (push, _) = record(Vec::new(), "push");
    let (short, _) = record(Vec::new(), "short");
    for entry in CATALOGUE {
        let what = place(entry.name, entry.place).1;
        let without = if what == "push" { &push } else { &free };
        let (absent, _) = record(vec![effect(entry, 0.0)], "short");
        assert!(absent == short, "{}: shows at amplitude 0", entry.name);
        let (present, truth) = record(vec![effect(entry, entry.parameters[0].high)], what);
        assert!(present != *without, "{}: does not show", entry.name);
        assert_eq!(truth.effect[0].name, entry.name);
    }
}

#[test]
fn nothing_of_the_truth_is_in_what_a_recording_says_of_itself() {
    let mut config = shipped("rigs/family.toml");
    config.physics.substeps = 1;
    config.seed = 90_210;
    let rig = rig(config);
    let recording = run(&rig, "multi_sine", 0.1, 0).recording;
    let channels: Vec<_> = recording
        .streams
        .iter()
        .map(|s| (&s.name, &s.channels))
        .collect();
    let said = format!("{:?} {channels:?}", recording.meta);
    assert!(!rig.truth().effect.is_empty());
    for effect in &rig.truth().effect {
        assert!(!said.contains(&effect.name), "{}", effect.name);
    }
    for word in ["90210", "family", "true", "bias", "effect"] {
        assert!(!said.contains(word), "{word}");
    }
    // what channels state is the data sheet's, the same for every machine
    let mut exact = shipped("rigs/paper.toml");
    exact.physics.substeps = 1;
    let paper = run(&self::rig(exact), "multi_sine", 0.1, 0).recording;
    let of = |r: &Recording| {
        r.streams
            .iter()
            .map(|s| s.channels.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(of(&recording), of(&paper));
}

/// Its stiffness at the damping ratio it has, its damping ratio at that stiffness.
#[test]
fn contacts_are_harder_or_lossier_and_not_both() {
    let contact = |effect: &str| {
        let text = if effect.is_empty() {
            String::new()
        } else {
            format!("[[effect]]\nname = \"{effect}\"\nwhere = \"object_table\"\nshare = 0.5\n")
        };
        let (model, _) = rig(config(&text)).true_model().expect("a model");
        let pair = model.id(ObjectKind::Pair, "object_table").expect("a pair");
        mjcf::edit::contact(&model, pair)
    };
    let (stiffness, damping) = contact("");
    let close = |a: (f64, f64), b: (f64, f64)| {
        assert!(
            (a.0 / b.0 - 1.0).abs() < 1e-9 && (a.1 / b.1 - 1.0).abs() < 1e-9,
            "{a:?} {b:?}"
        );
    };
    close(
        contact("contact_stiffness"),
        (1.5 * stiffness, 1.5_f64.sqrt() * damping),
    );
    close(contact("contact_damping"), (stiffness, 1.5 * damping));
}

#[test]
fn the_true_model_has_what_the_engine_can_say_and_names_the_rest() {
    let effects = "[[effect]]\nname = \"torque_gain\"\nwhere = \"p?_m3\"\ngain = -0.6\n\
        [[effect]]\nname = \"coulomb_friction\"\nwhere = \"p0_upper\"\ntorque_nm = 0.03\n\
        [[effect]]\nname = \"torque_offset\"\nwhere = \"p2_crank\"\ntorque_nm = -0.2\n\
        [[effect]]\nname = \"joint_spring\"\nwhere = \"p2_crank\"\nstiffness_nm_rad = 0.3\nrest_rad = 0.1\n\
        [[effect]]\nname = \"cogging\"\nwhere = \"p1_crank\"\namplitude_nm = 0.01\n";
    let (model, lacking) = rig(config(effects)).true_model().expect("a model");
    let gears: Vec<f64> = model.actuator_gear().iter().step_by(6).copied().collect();
    assert_eq!(gears, [1.0, 1.0, 0.4].repeat(3));
    let joint = model.id(ObjectKind::Joint, "p0_upper").expect("a joint");
    assert_eq!(
        model.dof_frictionloss()[model.jnt_dofadr()[joint] as usize],
        0.03
    );
    assert_eq!(lacking, ["cogging"]);
    let model = Arc::new(model);
    let joint = model.id(ObjectKind::Joint, "p2_crank").expect("a joint");
    let mut data = Data::new(Arc::clone(&model)).expect("data");
    data.qpos_mut()[model.jnt_qposadr()[joint] as usize] = 0.3;
    data.forward().expect("forward");
    let torque = data.qfrc_passive()[model.jnt_dofadr()[joint] as usize];
    assert!(
        (torque - (-0.2 - 0.3 * (0.3 - 0.1))).abs() < 1e-5,
        "{torque}"
    );
}

#[test]
fn families_draw_machines_by_seed() {
    let truth = |seed| {
        let mut config = shipped("rigs/family.toml");
        config.seed = seed;
        rig(config).truth().clone()
    };
    let mut names: Vec<String> = Vec::new();
    for seed in 0..60 {
        let truth = truth(seed);
        assert!((1..=2).contains(&truth.effect.len()), "{:?}", truth.effect);
        names.extend(truth.effect.into_iter().map(|e| e.name));
    }
    names.sort();
    names.dedup();
    assert!(names.len() > 20, "{names:?}");
    assert_eq!(truth(7), truth(7));
}

/// Four times a difference between directions was more than the friction of either, which pushed a joint on.
#[test]
fn large_friction_stays_friction_either_way() {
    for seed in 0..20 {
        let mut config = shipped("rigs/family.toml");
        config.seed = seed;
        let family = config.family.as_mut().expect("a family");
        family.effects = vec!["asymmetric_friction".to_owned()];
        family.count = [1, 1];
        family.severity = 4.0;
        let truth = rig(config).truth().clone();
        let of = |name: &str| {
            let mut all = truth.parameter.iter();
            let own = all.find(|p| p.attribute == format!("asymmetric_friction.{name}"));
            own.expect("a parameter").value
        };
        let (difference, level) = (of("difference_nm"), of("torque_nm"));
        assert!(difference <= level, "{difference} {level}");
    }
}
