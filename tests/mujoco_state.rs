//! Saving, restoring and sharing simulation states: the same bits every time.

use phantom::mujoco::{Data, Model, MujocoError, State};
use std::sync::Arc;

fn load(name: &str) -> Arc<Model> {
    Arc::new(Model::from_xml_path(format!("tests/models/{name}.xml")).expect("model loads"))
}

fn steps(data: &mut Data, n: usize) {
    for _ in 0..n {
        data.step().expect("step");
    }
    assert!(!data.warnings().any(), "{:?}", data.warnings());
}

/// Some inputs that differ from step to step, a function of time alone.
fn drive(data: &mut Data, n: usize) -> Vec<u64> {
    let mut bits = Vec::new();
    for _ in 0..n {
        let t = data.time();
        for (i, u) in data.ctrl_mut().iter_mut().enumerate() {
            *u = 3.0 * (7.0 * t + i as f64).sin();
        }
        data.step().expect("step");
        bits.extend(
            data.qpos()
                .iter()
                .chain(data.sensordata())
                .map(|x| x.to_bits()),
        );
    }
    bits
}

#[test]
fn restored_state_continues_with_the_same_bits() {
    for (name, contact) in [("pendulum", false), ("arm", false), ("push_box", true)] {
        let mut data = Data::new(load(name)).expect("data");
        drive(&mut data, 300);
        if let Some(x) = data.mocap_pos_mut().first_mut() {
            *x = 0.7;
        }
        if let Some(x) = data.userdata_mut().first_mut() {
            *x = 42.0;
        }
        let state = data.state();
        assert_eq!(data.ncon() > 0, contact, "{name}");
        let first = drive(&mut data, 100);

        data.restore_state(&state).expect("same model");
        assert_eq!(data.state(), state, "{name}");
        assert_eq!(drive(&mut data, 100), first, "{name}: same data");

        let mut other = Data::new(data.model_arc().clone()).expect("data");
        other.restore_state(&state).expect("same model");
        assert_eq!(other.time(), state.time());
        assert_eq!(other.act(), state.act());
        assert_eq!(other.mocap_pos(), state.mocap_pos());
        assert_eq!(drive(&mut other, 100), first, "{name}: fresh data");
    }
}

#[test]
fn the_warmstart_is_part_of_the_state() {
    let mut data = Data::new(load("push_box")).expect("data");
    // few iterations, so that the starting point shows in the result
    data.edit_model(|edit| {
        let mut option = edit.model().option();
        option.iterations = 1;
        edit.set_option(&option)
    })
    .expect("edit")
    .expect("legal");
    drive(&mut data, 300);
    let mut state = data.state();
    let first = drive(&mut data, 5);
    state.qacc_warmstart_mut().fill(0.0);
    data.restore_state(&state).expect("same model");
    assert_ne!(drive(&mut data, 5), first);
}

#[test]
fn activation_and_time_are_part_of_the_state() {
    let mut data = Data::new(load("arm")).expect("data");
    drive(&mut data, 50);
    let state = data.state();
    assert!(state.act()[0] != 0.0 && (state.time() - 0.05).abs() < 1e-9);
    data.reset();
    assert_eq!((data.act()[0], data.time()), (0.0, 0.0));
    data.restore_state(&state).expect("same model");
    assert_eq!((data.act()[0], data.time()), (state.act()[0], state.time()));
}

#[test]
fn a_state_of_another_model_is_refused_and_nothing_changes() {
    let arm = Data::new(load("arm")).expect("data").state();
    let mut data = Data::new(load("pendulum")).expect("data");
    let before = data.state();
    let error = data.restore_state(&arm).expect_err("other sizes");
    assert!(
        matches!(
            error,
            MujocoError::Length {
                name: "qpos",
                expected: 1,
                got: 2
            }
        ),
        "{error}"
    );
    assert!(data.restore_state(&State::default()).is_err());
    assert_eq!(data.state(), before);
}

#[test]
fn keyframes_reset_the_state() {
    let mut data = Data::new(load("arm")).expect("data");
    data.reset_to_keyframe(0).expect("keyframe");
    assert_eq!((data.qpos(), data.act()), (&[0.4, -0.8][..], &[0.1][..]));
    let error = data.reset_to_keyframe(1).expect_err("only one");
    assert_eq!(
        error.to_string(),
        "keyframe 1 does not exist, the model has 1"
    );
}

#[test]
fn threads_that_share_a_model_give_the_same_bits_as_one() {
    let model = load("push_box");
    let run = |model: Arc<Model>, seed: usize| {
        let mut data = Data::new(model).expect("data");
        data.qvel_mut()[0] = 0.01 * seed as f64;
        drive(&mut data, 400)
    };
    let serial: Vec<_> = (0..4).map(|seed| run(model.clone(), seed)).collect();
    let parallel: Vec<_> = std::thread::scope(|scope| {
        let spawn = |seed| {
            let model = model.clone();
            scope.spawn(move || run(model, seed))
        };
        let threads: Vec<_> = (0..4).map(spawn).collect();
        threads
            .into_iter()
            .map(|t| t.join().expect("thread"))
            .collect()
    });
    assert!(serial == parallel);
    assert!(serial[0] != serial[1]);
}

#[test]
fn edits_copy_a_shared_model_and_restore_brings_the_nominal_back() {
    let nominal = load("push_box");
    let mut reference = Data::new(nominal.clone()).expect("data");
    let mut data = Data::new(nominal.clone()).expect("data");
    steps(&mut data, 50);
    let state = data.state();
    let mass = nominal.body_mass()[1];

    data.edit_model(|edit| {
        edit.body_mass()[1] *= 2.0;
        edit.numeric_field_mut("body_pos").expect("by name")[6] += 0.01;
        edit.set_timestep(0.0005).expect("legal");
        edit.recompute_constants();
    })
    .expect("finite");
    assert_eq!(data.state(), state, "the edit keeps the state");
    assert_eq!(data.model().body_mass()[1], 2.0 * mass);
    assert!((data.model().body_subtreemass()[0] - nominal.total_mass() - mass).abs() < 1e-12);
    assert_eq!(nominal.body_mass()[1], mass, "others keep theirs");

    // the model is its own now: no further copy
    let address = Arc::as_ptr(data.model_arc());
    data.edit_model(|edit| edit.body_mass()[1] *= 2.0)
        .expect("finite");
    assert_eq!(Arc::as_ptr(data.model_arc()), address);
    assert_ne!(drive(&mut data, 100), drive(&mut reference, 100));

    data.restore_model(&nominal).expect("same structure");
    assert_eq!(Arc::as_ptr(data.model_arc()), address);
    for field in Model::NUMERIC_FIELDS {
        assert_eq!(
            data.model().numeric_field(field),
            nominal.numeric_field(field),
            "{field}"
        );
    }
    assert_eq!(data.model().option(), nominal.option());
    data.reset();
    reference.reset();
    assert_eq!(drive(&mut data, 100), drive(&mut reference, 100));
}

#[test]
fn a_finished_edit_recomputes_derived_constants() {
    let mut model = Model::clone(&load("arm"));
    let before = model.dof_M0().to_vec();
    let mut edit = model.edit();
    edit.dof_armature()[0] += 0.5;
    edit.finish().expect("finite");
    assert!((model.dof_M0()[0] - before[0] - 0.5).abs() < 1e-12);
    assert!(model.edit().set_timestep(-1.0).is_err());
    assert!(model.edit().set_timestep(f64::NAN).is_err());
    model.edit().set_timestep(0.004).expect("legal");
    assert_eq!(model.timestep(), 0.004);
}

#[test]
fn a_fingerprint_is_that_of_the_physics() {
    let of = |xml: &str| {
        Model::from_xml_str(xml)
            .expect("loads")
            .fingerprint()
            .expect("saved")
    };
    let xml = "<mujoco><worldbody><body><joint name='j' damping='1'/><geom size='1'/></body></worldbody></mujoco>";
    assert_eq!(of(xml).len(), 64);
    assert_eq!(
        of(xml),
        of(&xml.replace("<mujoco>", "<mujoco><!-- arm -->"))
    );
    assert_ne!(
        of(xml),
        of(&xml.replace("damping='1'", "damping='1.000001'"))
    );
    assert_ne!(of(xml), of(&xml.replace("name='j'", "name='k'")));
}
