//! Bad models and bad numbers are Rust errors that say which and why.

use phantom::mujoco::{Data, Model, MujocoError, ObjectKind};
use std::fs;
use std::sync::Arc;

/// Puts a bad number somewhere.
type Spoil = fn(&mut Data);

fn load(name: &str) -> Arc<Model> {
    Arc::new(Model::from_xml_path(format!("tests/models/{name}.xml")).expect("model loads"))
}

#[test]
fn files_that_cannot_be_read() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let empty = dir.path().join("empty.xml");
    fs::write(&empty, "").expect("writable");
    for (path, reason) in [
        (dir.path().join("none.xml"), "no such file"),
        (dir.path().to_path_buf(), "it is not a file"),
        (empty, "it is empty"),
        ("a\0b.xml".into(), "nul"),
    ] {
        let error = Model::from_xml_path(&path).expect_err("no model");
        assert!(
            matches!(&error, MujocoError::File { file, .. } if *file == path),
            "{error:?}"
        );
        let text = error.to_string();
        let expected = text.to_lowercase().contains(reason);
        assert!(expected, "{text}");
    }
}

#[test]
fn models_that_do_not_compile_say_where_and_why() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let body = |inner: &str| format!("<mujoco><worldbody>{inner}</worldbody></mujoco>");
    let cases = [
        ("truncated", "<mujoco><worldbody>".to_string(), "XML"),
        ("no_xml", "not a model".to_string(), "XML"),
        ("tag", body("<bodi/>"), "bodi"),
        ("mass", body("<body><freejoint/></body>"), "mass"),
        ("mesh", body("<geom type='mesh' mesh='none'/>"), "mesh"),
        ("word", body("<geom size='abc'/>"), "size"),
        ("negative", body("<geom size='-1'/>"), "size"),
    ];
    for (name, xml, part) in cases {
        let file = dir.path().join(format!("{name}.xml"));
        fs::write(&file, &xml).expect("writable");
        let error = Model::from_xml_path(&file).expect_err(name);
        let text = error.to_string();
        assert!(matches!(error, MujocoError::Load { .. }), "{name}: {text}");
        assert!(
            text.contains(part) && text.contains(&file.display().to_string()),
            "{text}"
        );
        assert!(!text.contains('\n') && !text.ends_with('.'), "{text:?}");
        let error = Model::from_xml_str(&xml).expect_err(name).to_string();
        assert!(
            error.contains("<string>") && error.contains(part),
            "{error}"
        );
    }
    let mesh = "<mujoco><asset><mesh name='m' file='missing.stl'/></asset></mujoco>";
    let error = Model::from_xml_str(mesh).expect_err("no file").to_string();
    assert!(error.contains("missing.stl"), "{error}");
    assert!(Model::from_xml_str("").is_err() && Model::from_xml_str("<mujoco/>\0").is_err());
}

#[test]
fn a_warning_of_the_compiler_is_kept() {
    // a box that starts inside the floor has more contacts than fit
    let xml = fs::read_to_string("tests/models/push_box.xml").expect("readable");
    let xml = xml
        .replace("nconmax=\"30\"", "nconmax=\"2\"")
        .replace("0 0 0.05", "0 0 0.04");
    let model = Model::from_xml_str(&xml).expect("accepted");
    assert!(
        model.load_warning().is_some_and(|w| w.contains("contact")),
        "{:?}",
        model.load_warning()
    );
    assert_eq!(load("arm").load_warning(), None);
}

#[test]
fn text_and_file_give_the_same_model() {
    let xml = fs::read_to_string("tests/models/arm.xml").expect("readable");
    let (a, b) = (Model::from_xml_str(&xml).expect("loads"), load("arm"));
    for field in Model::NUMERIC_FIELDS {
        assert_eq!(a.numeric_field(field), b.numeric_field(field), "{field}");
    }
}

#[test]
fn an_unknown_name_lists_the_known_ones() {
    let model = load("arm");
    let error = model.id(ObjectKind::Joint, "knee").expect_err("no knee");
    let text = "the model has no joint named 'knee'; it has: shoulder, elbow";
    assert_eq!(error.to_string(), text);
    for name in ["", "el\0bow", "elbow "] {
        assert!(model.id(ObjectKind::Joint, name).is_err(), "{name:?}");
    }
    let text = model
        .id(ObjectKind::Tendon, "t")
        .expect_err("none")
        .to_string();
    assert!(text.ends_with("it has: none"), "{text}");
}

#[test]
fn a_nan_control_or_state_shows_after_the_step() {
    let mut data = Data::new(load("arm")).expect("data");
    data.check_finite().expect("all finite");
    data.ctrl_mut()[1] = f64::NAN;
    let error = data.check_finite().expect_err("NaN");
    assert_eq!(error.to_string(), "ctrl[1] is NaN, not a usable number");
    // this actuator filters its control: the activation becomes NaN, then the acceleration
    data.step().expect("MuJoCo goes on");
    assert!(data.warnings().diverged(), "{:?}", data.warnings());
    data.clear_warnings();
    assert!(!data.warnings().any());

    let spoil: [(Spoil, &str); 4] = [
        (|d| d.qpos_mut()[0] = f64::NAN, "qpos"),
        (|d| d.qvel_mut()[1] = f64::INFINITY, "qvel"),
        (|d| d.qpos_mut()[1] = 1e11, "qpos"),
        (|d| d.xfrc_applied_mut()[14] = f64::NAN, "xfrc_applied"),
    ];
    for (spoil, name) in spoil {
        data.reset();
        spoil(&mut data);
        assert!(
            data.check_finite()
                .expect_err("bad")
                .to_string()
                .starts_with(name)
        );
        data.step().expect("MuJoCo goes on");
        assert!(data.warnings().diverged(), "{name}: {:?}", data.warnings());
        assert!(data.qpos().iter().all(|q| q.is_finite()));
        data.check_finite().expect("the automatic reset mended it");
    }
}

#[test]
fn nan_that_mujoco_would_not_notice_is_an_error() {
    let mut data = Data::new(load("arm")).expect("data");
    data.mocap_pos_mut()[2] = f64::NAN;
    let error = data.step().expect_err("NaN");
    assert!(matches!(
        error,
        MujocoError::NotFinite {
            name: "mocap_pos",
            index: 2,
            ..
        }
    ));
    data.reset();
    data.step().expect("usable again");
    data.qpos_mut()[0] = f64::NAN;
    assert!(data.forward().is_err() && data.inverse().is_err() && data.position_stage().is_err());
}

#[test]
fn full_buffers_are_counted() {
    let xml = fs::read_to_string("tests/models/push_box.xml").expect("readable");
    let few_contacts = xml.replace("nconmax=\"30\"", "nconmax=\"2\"");
    let few_rows = xml.replace("njmax=\"120\"", "njmax=\"5\"");
    assert!(few_contacts != xml && few_rows != xml);
    for (xml, contacts) in [(few_contacts, true), (few_rows, false)] {
        let model = Arc::new(Model::from_xml_str(&xml).expect("loads"));
        let mut data = Data::new(model).expect("data");
        for _ in 0..100 {
            data.step().expect("step");
        }
        let warnings = data.warnings();
        assert_eq!(warnings.contact_full > 0, contacts, "{warnings:?}");
        assert_eq!(warnings.constraint_full > 0, !contacts, "{warnings:?}");
        assert!(warnings.any() && !warnings.diverged());
        assert!(data.contacts().len() <= data.model().nconmax());
        data.reset();
        assert!(!data.warnings().any());
    }
}

#[test]
fn a_fatal_error_poisons_one_simulation_and_nothing_else() {
    let xml = fs::read_to_string("tests/models/push_box.xml").expect("readable");
    let xml = xml.replace("nstack=\"40000\"", "nstack=\"250\"");
    let model = Arc::new(Model::from_xml_str(&xml).expect("loads"));
    for _ in 0..3 {
        let mut data = Data::new(model.clone()).expect("data");
        let error = (0..100).find_map(|_| data.step().err()).expect("overflow");
        assert!(
            matches!(&error, MujocoError::Fatal { message } if message == "Stack overflow"),
            "{error}"
        );
        let state = data.state();
        let again = [
            data.step(),
            data.forward(),
            data.inverse(),
            data.position_stage(),
            data.restore_state(&state),
            data.contact_force(0).map(drop),
        ];
        for result in again {
            assert!(
                matches!(result, Err(MujocoError::Poisoned { .. })),
                "{result:?}"
            );
        }
        data.reset();
        assert!(data.step().is_err(), "a reset does not heal");
    }
    // the library is still usable, and in the same way
    let run = || {
        let mut data = Data::new(load("push_box")).expect("data");
        (0..100).for_each(|_| data.step().expect("step"));
        data.state()
    };
    assert_eq!(run(), run());
}

#[test]
fn buffers_too_large_to_allocate_are_errors() {
    let xml = fs::read_to_string("tests/models/pendulum.xml").expect("readable");
    let huge = xml.replace("njmax=\"20\"", "njmax=\"30000\"");
    assert_ne!(huge, xml);
    let error = Model::from_xml_str(&huge).and_then(|m| Data::new(Arc::new(m)).map(drop));
    let text = error.expect_err("over 2 GB").to_string();
    assert!(text.contains("could not create mjData"), "{text}");
}

#[test]
fn nothing_is_logged_to_a_file() {
    let logged = || fs::metadata("MUJOCO_LOG.TXT").map_or(0, |log| log.len());
    let before = logged();
    let mut data = Data::new(load("arm")).expect("data");
    data.ctrl_mut().fill(f64::NAN);
    data.step().expect("MuJoCo goes on");
    assert!(data.warnings().bad_ctrl > 0);
    assert_eq!(logged(), before);
}
