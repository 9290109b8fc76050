//! Parameters by address: in the compiled model and back into its file.

use phantom::mjcf::attribute::{ATTRIBUTES, Target, resolve};
use phantom::mjcf::edit::{self, body_inertia};
use phantom::mjcf::file::rewrite;
use phantom::mujoco::Model;

use crate::common::phantom_model;

const SHIPPED: &str = "xml/phantom.xml";

fn written(model: &Model, values: &[(&Target, f64)]) -> Model {
    let mut changed = model.clone();
    let mut edit = changed.edit();
    edit::write(&mut edit, values, false);
    edit.finish().expect("constants");
    let mut edit = changed.edit();
    edit::write(&mut edit, values, true);
    drop(edit);
    changed
}

fn close(a: &[f64], b: &[f64], tolerance: f64, what: &str) {
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        assert!(
            (a - b).abs() <= tolerance * (1e-3 + a.abs()),
            "{what}[{i}]: {a} and {b}"
        );
    }
}

/// A search had gone on for minutes before its model could not be written: the world has no element in a file.
#[test]
fn globs_of_bodies_do_not_mean_the_world() {
    let model = phantom_model();
    for attribute in ATTRIBUTES.iter().filter(|a| a.kind == "body") {
        let found = resolve(&model, "body/*", attribute.name, &[]).expect("bodies");
        assert!(found.iter().all(|t| t.id > 0), "{}", attribute.name);
        let error = resolve(&model, "body/world", attribute.name, &[]);
        assert!(error.is_err(), "{}", attribute.name);
    }
}

/// Every kind of parameter of the shipped model: written to the text and loaded, it is the model it was edited to.
#[test]
fn text_and_compiled_model_agree() {
    let text = std::fs::read_to_string(SHIPPED).expect("readable");
    let model = phantom_model();
    let mut targets = Vec::new();
    for attribute in ATTRIBUTES {
        let element = match attribute.kind {
            "body" if attribute.name == "length" => "body/p0_tip",
            "body" if attribute.name == "geometry" => "body/object",
            "body" => "body/p0_upper",
            "joint" => "joint/p0_upper",
            "geom" => "geom/object",
            "site" => "site/p0_tip",
            "pair" => "pair/p1_object",
            "option" => "option/gravity",
            "custom" => "custom/start_low",
            _ => &format!("{}/p*", attribute.kind),
        };
        if matches!(attribute.name, "gainprm" | "biasprm" | "forcelimit") {
            continue; // a motor has none
        }
        if let Ok(found) = resolve(&model, element, attribute.name, &[]) {
            targets.extend(found);
        } else {
            assert!(
                matches!(attribute.kind, "tendon" | "equality"),
                "{element} {}",
                attribute.name
            );
        }
    }
    assert!(targets.len() > 100, "{}", targets.len());
    // one at a time, and all together
    let singles = targets
        .iter()
        .enumerate()
        .map(|(i, t)| (i, std::slice::from_ref(t)));
    let mut unlike = 0;
    for (i, group) in singles.chain([(0, targets.as_slice())]) {
        let values: Vec<(&Target, f64)> = (group.iter())
            .filter(|t| {
                group.len() == 1 || t.attribute.name != "solref" || t.attribute.kind != "pair"
            })
            .map(|t| {
                (
                    t,
                    1.03 * t.value(&model) + if t.attribute.positive { 1e-3 } else { 2e-3 },
                )
            })
            .collect();
        let edited = written(&model, &values);
        let addressed: Vec<&Target> = values.iter().map(|(t, _)| *t).collect();
        let rewritten = rewrite(&text, &edited, &addressed, "identified").expect("rewritten");
        let loaded = load(&rewritten);
        for field in Model::NUMERIC_FIELDS {
            if matches!(*field, "body_inertia" | "body_iquat" | "qpos_spring") {
                continue; // the same inertia may be written about other axes; compared below
            }
            if *field == "tendon_lengthspring" {
                continue; // taken from springref by the compiler, and of no effect without a stiffness
            }
            let (a, b) = (
                edited.numeric_field(field).expect("f"),
                loaded.numeric_field(field).expect("f"),
            );
            close(a, b, 1e-9, &format!("{} {field}", group[0].address()));
        }
        for body in 0..model.nbody() {
            let (a, b) = (
                body_inertia(&edited, body).matrix(),
                body_inertia(&loaded, body).matrix(),
            );
            assert!(
                (a - b).amax() <= 1e-12 * a.trace(),
                "{i}: inertia of body {body}"
            );
        }
        close(
            &edited.option().gravity,
            &loaded.option().gravity,
            1e-12,
            "gravity",
        );
        unlike += usize::from(rewritten != text);
        // nothing but attributes changed
        assert_eq!(
            text.matches("<!--").count() + 1,
            rewritten.matches("<!--").count()
        );
        assert_eq!(
            text.matches("name=").count(),
            rewritten.matches("name=").count()
        );
    }
    assert_eq!(unlike, targets.len() + 1);
}

fn load(text: &str) -> Model {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("model.xml");
    std::fs::write(&path, text).expect("written");
    Model::from_xml_path(&path).unwrap_or_else(|e| panic!("{e}"))
}

#[test]
fn short_forms_of_actuators_are_refused() {
    let model = phantom_model();
    let text = std::fs::read_to_string(SHIPPED).expect("readable");
    let target = &resolve(&model, "actuator/p0_m1", "gainprm", &[0]).expect("known")[0];
    let error = rewrite(&text, &model, &[target], "")
        .expect_err("a motor")
        .to_string();
    assert!(error.contains("`p0_m1` is a `motor`"), "{error}");
}

#[test]
fn a_spring_reference_keeps_the_unit_of_the_file() {
    let model = phantom_model();
    let text = std::fs::read_to_string(SHIPPED).expect("readable");
    let target = &resolve(&model, "joint/p0_upper", "springref", &[]).expect("known")[0];
    let edited = written(&model, &[(target, 0.1)]);
    let loaded = load(&rewrite(&text, &edited, &[target], "").expect("rewritten"));
    let at = model.jnt_qposadr()[target.id] as usize;
    assert!(
        (loaded.qpos_spring()[at] - 0.1).abs() < 1e-12,
        "{:?}",
        loaded.qpos_spring()
    );
}

/// The number in N/m is what a contact at rest shows.
#[test]
fn contact_stiffness_is_force_over_penetration() {
    const BALL: &str = r#"<mujoco><option timestep="0.001"/><worldbody><geom name="floor" type="plane" size="1 1 1"/>
      <body name="ball" pos="0 0 0.0995"><joint name="z" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size="0.1" mass="0.7"/></body></worldbody>
      <contact><exclude body1="world" body2="ball"/><pair name="c" geom1="ball" geom2="floor" condim="1"
      solimp="0.9 0.9 0.001"/></contact></mujoco>"#;
    let model = Model::from_xml_str(BALL).expect("loads");
    let find = |name| {
        resolve(&model, "pair/c", name, &[])
            .expect("known")
            .remove(0)
    };
    let (stiffness, damping) = (find("stiffness"), find("damping"));
    let edited = written(&model, &[(&stiffness, 5000.0), (&damping, 300.0)]);
    assert!((stiffness.value(&edited) - 5000.0).abs() < 1e-9);
    assert!((damping.value(&edited) - 300.0).abs() < 1e-9);
    // stiffness and damping ratio instead, in either order; the compiler's default ratio is 1
    let (hardness, ratio) = (find("hardness"), find("dampratio"));
    assert!((ratio.value(&model) - 1.0).abs() < 1e-12);
    let harder = written(&model, &[(&hardness, 5000.0)]);
    assert!((ratio.value(&harder) - 1.0).abs() < 1e-12);
    assert!((stiffness.value(&harder) - 5000.0).abs() < 1e-9);
    let before = damping.value(&model) / stiffness.value(&model).sqrt();
    assert!((damping.value(&harder) / 5000_f64.sqrt() / before - 1.0).abs() < 1e-12);
    let both = [(&hardness, 5000.0), (&ratio, 0.7)];
    for order in [both, [both[1], both[0]]] {
        let edited = written(&model, &order);
        assert!((hardness.value(&edited) - 5000.0).abs() < 1e-9);
        assert!((ratio.value(&edited) - 0.7).abs() < 1e-12);
    }
    let mut data = phantom::mujoco::Data::new(std::sync::Arc::new(edited)).expect("data");
    for _ in 0..5000 {
        data.step().expect("step");
    }
    let penetration = -data.contacts()[0].dist();
    let expected = 0.7 * 9.81 / 5000.0;
    assert!(
        (penetration / expected - 1.0).abs() < 1e-3,
        "{penetration} {expected}"
    );
}

#[test]
fn wrong_addresses_are_explained() {
    let model = phantom_model();
    for (element, attribute, components, part) in [
        ("joint", "damping", &[][..], "not of the form"),
        ("hinge/x", "damping", &[], "unknown kind, known are joint"),
        ("joint/*", "colour", &[], "it has: damping, frictionloss"),
        (
            "joint/q*",
            "damping",
            &[],
            "no joint is named `q*`; there are: p0_turret",
        ),
        (
            "pair/p0_object",
            "friction",
            &[5],
            "there is no component 5, it has 5",
        ),
        (
            "pair/p0_object",
            "friction",
            &[1, 1],
            "component 1 is listed twice",
        ),
        (
            "body/object",
            "pos",
            &[],
            "is free, its pose is part of the state",
        ),
        ("body/p0_base", "mass", &[], "has no mass"),
    ] {
        let error = resolve(&model, element, attribute, components)
            .expect_err(part)
            .to_string();
        assert!(error.contains(part), "{error}");
    }
}
