//! Custom elements, good and bad.

use phantom::mujoco::Model;
use phantom::supplement::{self, Supplement};

use crate::machine::{numeric, text};

fn error(custom: &str, joint: &str) -> String {
    let model = Model::from_xml_str(&text(custom, joint)).unwrap_or_else(|e| panic!("{e}"));
    supplement::attach(model).expect_err(custom).to_string()
}

#[test]
fn mistakes_are_named() {
    for (kind, element, data, part) in [
        (
            "friction",
            "j",
            "1",
            "there is no kind `friction`; there are: actuator_delay",
        ),
        (
            "quadratic_drag",
            "x",
            "1",
            "the model has no joint named 'x'; it has: j",
        ),
        (
            "quadratic_drag",
            "j",
            "1 2",
            "it has 2 numbers, expected 1: drag (N m s^2/rad^2 or N s^2/m^2)",
        ),
        (
            "actuator_delay",
            "m",
            "0.3",
            "`time` is 0.3, expected 0 to 0.05",
        ),
        ("stribeck_friction", "j", "0.1 0", "`speed` is 0, expected"),
        (
            "stribeck_friction",
            "j",
            "0.1 0.1",
            "the joint has no frictionloss",
        ),
        (
            "sensor_delay",
            "q",
            "0.001",
            "it is for `q`, expected `encoders`",
        ),
        (
            "force_sensor_bias",
            "q",
            "0 0 0",
            "the sensor is not one of force or torque",
        ),
        (
            "torsional_friction",
            "p",
            "0 1",
            "the model has no geom named 'p'; it has: none, and no contact pair of that name",
        ),
    ] {
        let error = error(&numeric(kind, element, data), "");
        assert!(
            error.starts_with(&format!("custom element `phantom:{kind}:{element}`: ")),
            "{error}"
        );
        assert!(error.contains(part), "{error}");
    }
    let nameless = error(r#"<numeric name="phantom:drag" data="1"/>"#, "");
    assert!(
        nameless.contains("expected the name phantom:KIND:ELEMENT"),
        "{nameless}"
    );
    let words = error(r#"<text name="phantom:note:j" data="hello"/>"#, "");
    assert!(
        words.contains("it is a text, expected a numeric"),
        "{words}"
    );
}

#[test]
fn other_custom_elements_are_left_alone() {
    let model =
        Model::from_xml_str(&text(r#"<numeric name="start_low" data="1 2"/>"#, "")).expect("loads");
    assert!(Supplement::of(&model).expect("fine").is_none());
    assert!(
        supplement::attach(model)
            .expect("fine")
            .extension()
            .is_none()
    );
}

#[test]
fn the_list_names_kind_and_element() {
    let custom = numeric("cogging", "j", "0.1 0 5") + &numeric("actuator_lag", "m", "0.01");
    let model = Model::from_xml_str(&text(&custom, "")).expect("loads");
    let supplement = Supplement::of(&model).expect("fine").expect("some");
    // in the order in which they act
    let listed: Vec<_> = supplement.list().collect();
    assert_eq!(listed, [("actuator_lag", "m"), ("cogging", "j")]);
}

#[test]
fn models_are_loaded_from_files_and_texts_beside_them() {
    let folder = tempfile::tempdir().expect("folder");
    let file = folder.path().join("model.xml");
    let included = "<mujoco><custom><numeric name=\"phantom:torque_offset:j\" data=\"0.1\"/></custom></mujoco>";
    std::fs::write(folder.path().join("part.xml"), included).expect("written");
    let text = text("", "").replace("<custom></custom>", "<include file=\"part.xml\"/>");
    std::fs::write(&file, &text).expect("written");
    for model in [supplement::load(&file), supplement::load_text(&text, &file)] {
        assert!(model.expect("loads").extension().is_some());
    }
    assert!(supplement::load(folder.path().join("none.xml")).is_err());
}
