//! Cases in which a careless binding reads or writes memory it does not own.

use phantom::mujoco::{Data, Model, MujocoError, ObjectKind};
use std::sync::Arc;

fn load(name: &str) -> Arc<Model> {
    Arc::new(Model::from_xml_path(format!("tests/models/{name}.xml")).expect("model loads"))
}

#[test]
fn ids_and_slices_out_of_bounds_are_errors() {
    let mut data = Data::new(load("arm")).expect("data");
    let (mut p, mut r) = ([0.0; 6], [0.0; 6]);
    data.jac_site(1, &mut p, &mut r).expect("in range");
    for site in [2, i32::MAX as usize + 2, usize::MAX] {
        let error = data
            .jac_site(site, &mut p, &mut r)
            .expect_err("no such site");
        assert!(
            matches!(
                error,
                MujocoError::Index {
                    kind: "site",
                    count: 2,
                    ..
                }
            ),
            "{error}"
        );
    }
    assert!(data.jac_site(0, &mut p[..5], &mut r).is_err());
    assert!(data.jac_site(0, &mut p, &mut []).is_err());
    assert!(data.full_mass_matrix(&mut [0.0; 3]).is_err());
    assert!(data.contact_force(0).is_err() && data.contact_force(usize::MAX).is_err());
    assert!(data.reset_to_keyframe(usize::MAX).is_err());
    assert_eq!(data.model().name(ObjectKind::Site, 1 << 32), None);
}

#[test]
fn data_refuses_a_model_of_another_structure() {
    let mut data = Data::new(load("arm")).expect("data");
    let before = data.state();
    for other in ["pendulum", "push_box"] {
        let other = load(other);
        assert!(matches!(
            data.restore_model(&other),
            Err(MujocoError::ModelMismatch { .. })
        ));
        assert!(matches!(
            data.set_model(other),
            Err(MujocoError::ModelMismatch { .. })
        ));
    }
    // all sizes equal, but a joint limit less, or the buffer smaller
    let xml = std::fs::read_to_string("tests/models/arm.xml").expect("readable");
    for (from, to, detail) in [
        (
            "range=\"-2 2\" limited=\"true\"",
            "range=\"-2 2\" limited=\"false\"",
            "jnt_limited",
        ),
        ("njmax=\"60\"", "njmax=\"59\"", "njmax"),
        (
            "joint=\"elbow\"/>\n    <framepos",
            "joint=\"shoulder\"/>\n    <framepos",
            "sensor_objid",
        ),
    ] {
        let other = xml.replace(from, to);
        assert_ne!(other, xml);
        let other = Arc::new(Model::from_xml_str(&other).expect("loads"));
        let error = data.set_model(other).expect_err(detail);
        assert!(error.to_string().contains(detail), "{error}");
    }
    assert_eq!(data.state(), before);
    data.step().expect("still usable");
    // the same file again, with other numbers, is fine
    let heavier = xml.replace("mass=\"0.6\"", "mass=\"0.9\"");
    data.set_model(Arc::new(Model::from_xml_str(&heavier).expect("loads")))
        .expect("same");
    assert_eq!(data.model().body_mass()[2], 0.9);
    data.step().expect("usable");
}

#[test]
fn simulations_move_between_threads_but_are_not_shared() {
    fn send<T: Send>() {}
    fn sync<T: Sync>() {}
    send::<Data>();
    send::<Model>();
    sync::<Model>();
    let mut data = Data::new(load("arm")).expect("data");
    let moved = std::thread::spawn(move || data.step().map(|()| data))
        .join()
        .expect("joins");
    drop(moved.expect("step"));
}

#[test]
fn a_model_edited_to_nan_is_not_computed_with() {
    let nominal = load("push_box");
    let mut data = Data::new(nominal.clone()).expect("data");
    for bad in [f64::NAN, f64::INFINITY, 1e200] {
        let error = data
            .edit_model(|e| e.geom_size()[3] = bad)
            .expect_err("bad");
        assert!(matches!(
            error,
            MujocoError::NotFinite {
                name: "geom_size",
                index: 3,
                ..
            }
        ));
        assert!(data.step().is_err() && data.forward().is_err());
        data.restore_model(&nominal).expect("same structure");
        data.step().expect("mended");
    }
    let mut model = Model::clone(&nominal);
    model.edit().body_pos()[0] = f64::NAN; // guard dropped without `finish`
    assert!(Data::new(Arc::new(model.clone())).is_err());
    assert!(data.set_model(Arc::new(model.clone())).is_err());
    model.edit().body_pos()[0] = 0.0;
    Data::new(Arc::new(model)).expect("mended");
}

#[test]
fn indices_kept_as_doubles_cannot_be_edited() {
    let mut model = Model::clone(&load("arm"));
    assert!(model.numeric_field("wrap_prm").is_some());
    assert!(model.edit().numeric_field_mut("wrap_prm").is_none());
    assert!(model.edit().numeric_field_mut("jnt_type").is_none());
}

#[test]
fn settings_changed_between_stages_leave_no_stale_rows() {
    use phantom::mujoco::{Cone, Jacobian, Solver};
    let mut data = Data::new(load("push_box")).expect("data");
    for k in 0..200 {
        data.position_stage().expect("finite");
        let (cone, jacobian, solver) = (
            [Cone::Pyramidal, Cone::Elliptic][k % 2],
            [Jacobian::Dense, Jacobian::Sparse, Jacobian::Auto][k % 3],
            [Solver::Pgs, Solver::Cg, Solver::Newton][k / 3 % 3],
        );
        data.edit_model(|edit| {
            let mut option = edit.model().option();
            (option.cone, option.jacobian, option.solver) = (cone, jacobian, solver);
            edit.set_option(&option)
        })
        .expect("edit")
        .expect("legal");
        assert_eq!(
            (data.ncon(), data.nefc()),
            (0, 0),
            "laid out for other settings"
        );
        data.velocity_stage().expect("finite");
        data.step2().expect("step");
        data.step().expect("step");
    }
    assert!(data.check_finite().is_ok());
}

#[test]
fn stages_on_fresh_data_in_any_order_are_harmless() {
    let call: [fn(&mut Data) -> bool; 6] = [
        |d| d.step2().is_ok(),
        |d| d.velocity_stage().is_ok(),
        |d| d.velocity_sensors().is_ok(),
        |d| d.position_sensors().is_ok(),
        |d| d.compute_energy().is_ok(),
        |d| d.inverse().is_ok(),
    ];
    for call in call {
        let mut data = Data::new(load("push_box")).expect("data");
        assert!(call(&mut data));
    }
}
