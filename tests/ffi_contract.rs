//! Versions, sizes, array lengths, stages: what the layer promises about the C library.

use mujoco_sys as ffi;
use phantom::mujoco::{Data, Model, ObjectKind, library_version};
use std::sync::Arc;

fn load(name: &str) -> Arc<Model> {
    Arc::new(Model::from_xml_path(format!("tests/models/{name}.xml")).expect("model loads"))
}

#[test]
fn library_and_headers_are_version_2_2_2() {
    assert_eq!(ffi::mjVERSION_HEADER, 222);
    assert_eq!(library_version(), 222);
}

/// `nbody`, `3`, `mjNREF`, `nmocap*3` … as a number, independently of the generated expressions.
fn evaluate(text: &str, model: &Model) -> usize {
    let sizes = model.sizes();
    let factor = |f: &str| match f {
        "mjNREF" | "mjNEQDATA_UNUSED" => 2,
        "mjNIMP" => 5,
        "mjNDYN" | "mjNGAIN" | "mjNBIAS" => 10,
        "mjNEQDATA" => 11,
        "mjNFLUID" => 12,
        _ => f.parse().unwrap_or_else(|_| {
            let size = sizes.iter().find(|(name, _)| *name == f);
            size.unwrap_or_else(|| panic!("unknown size {f}")).1
        }),
    };
    text.split('*').map(|f| factor(f.trim())).product()
}

macro_rules! lengths {
    ($m:ident, $([$doc:literal] $element:tt $name:ident ($rows:expr) ($cols:expr);)+) => {
        vec![$((stringify!($name), $m.$name().len(), size_of_val($m.$name()), touch($m.$name()))),+]
    };
}

/// Reads every element, so that a wrong length has a chance to crash.
fn touch<T: Copy + Into<f64>>(values: &[T]) -> f64 {
    values
        .iter()
        .map(|&v| v.into())
        .filter(|v: &f64| v.is_finite())
        .sum()
}

fn check_table(
    got: &[(&str, usize, usize, f64)],
    table: &[(&str, &str, &str, &str)],
    model: &Model,
) -> usize {
    let table: Vec<_> = table.iter().filter(|row| row.1 != "mjContact").collect();
    assert_eq!(got.len(), table.len());
    let mut non_empty = 0;
    for ((name, len, bytes, _), (table_name, element, rows, cols)) in got.iter().zip(table) {
        assert_eq!(name, table_name);
        let expected = evaluate(rows, model) * evaluate(cols, model);
        assert_eq!(*len, expected, "{name}");
        let size = match *element {
            "f64" => 8,
            "f32" | "i32" => 4,
            _ => 1,
        };
        assert_eq!(*bytes, expected * size, "{name}");
        non_empty += usize::from(*len > 0);
    }
    non_empty
}

#[test]
fn every_array_has_the_length_of_the_header_table() {
    for name in ["pendulum", "arm", "push_box"] {
        let model = load(name);
        let mut data = Data::new(model.clone()).expect("data");
        data.step().expect("step");
        let m = &*model;
        let of_model = ffi::for_each_model_array!(lengths, m);
        assert!(check_table(&of_model, ffi::MODEL_ARRAYS, m) > 100, "{name}");
        let m = &data;
        let of_data = ffi::for_each_data_array!(lengths, m);
        assert!(
            check_table(&of_data, ffi::DATA_ARRAYS, &model) > 70,
            "{name}"
        );
    }
}

#[test]
fn arrays_do_not_overlap_and_end_where_the_next_begins() {
    macro_rules! ranges {
        ($m:ident, $([$doc:literal] $element:tt $name:ident ($rows:expr) ($cols:expr);)+) => {
            vec![$((stringify!($name), {
                let range = $m.$name().as_ptr_range();
                range.start as usize..range.end as usize
            })),+]
        };
    }
    let model = load("arm");
    let data = Data::new(model.clone()).expect("data");
    let m = &*model;
    let mut of_model = ffi::for_each_model_array!(ranges, m);
    let m = &data;
    let mut of_data = ffi::for_each_data_array!(ranges, m);
    for all in [&mut of_model, &mut of_data] {
        all.retain(|(_, range)| !range.is_empty());
        all.sort_by_key(|(_, range)| range.start);
        for pair in all.windows(2) {
            assert!(
                pair[0].1.end <= pair[1].1.start,
                "{} and {}",
                pair[0].0,
                pair[1].0
            );
        }
    }
}

#[test]
fn sizes_and_arrays_say_what_the_model_file_says() {
    let model = load("arm");
    assert_eq!(
        (model.nq(), model.nv(), model.nu(), model.na()),
        (2, 2, 2, 1)
    );
    assert_eq!((model.nmocap(), model.nuserdata(), model.nkey()), (1, 3, 1));
    assert_eq!(
        (model.njmax(), model.nconmax(), model.nsensordata()),
        (60, 20, 5)
    );
    assert_eq!(model.jnt_range(), [-1.5, 1.5, -2.0, 2.0]);
    assert_eq!(model.dof_frictionloss(), [0.1, 0.05]);
    assert_eq!(model.sensor_adr(), [0, 1, 2]);
    assert_eq!(model.actuator_ctrllimited(), [1, 0]);
    let (mass, shape) = model.numeric_field_shaped("body_mass").expect("exists");
    assert_eq!((mass, shape), (model.body_mass(), (4, 1)));
    let (_, shape) = model
        .numeric_field_shaped("actuator_gainprm")
        .expect("exists");
    assert_eq!(shape, (2, 10));
    assert!(model.numeric_field("jnt_type").is_none() && model.numeric_field("mass").is_none());
    assert_eq!(model.timestep(), 0.001);
}

#[test]
fn names_and_ids_are_inverse() {
    let model = load("arm");
    for kind in [
        ObjectKind::Body,
        ObjectKind::Joint,
        ObjectKind::Actuator,
        ObjectKind::Sensor,
    ] {
        for id in 0..model.count(kind) {
            let name = model.name(kind, id).expect("all are named");
            assert_eq!(model.id(kind, name).expect("known"), id);
        }
        assert_eq!(model.name(kind, model.count(kind)), None);
        assert_eq!(model.name(kind, usize::MAX), None);
    }
}

#[test]
fn mass_matrix_and_jacobian_describe_the_pendulum() {
    let mut data = Data::new(load("pendulum")).expect("data");
    data.qpos_mut()[0] = 0.3;
    data.qvel_mut()[0] = 2.0;
    data.position_stage().expect("finite");
    data.velocity_stage().expect("finite");
    // bob of 1 kg on 0.5 m, and the sphere's own 2/5 m r²
    let inertia = 0.25 + 0.4 * 0.05 * 0.05;
    let mut mass = [0.0];
    data.full_mass_matrix(&mut mass).expect("1 × 1");
    assert!((mass[0] - inertia).abs() < 1e-12);
    let (mut jacp, mut jacr) = ([0.0; 3], [0.0; 3]);
    data.jac_site(0, &mut jacp, &mut jacr).expect("3 × 1");
    let (sin, cos) = 0.3_f64.sin_cos();
    for (got, expected) in jacp.into_iter().zip([-0.5 * cos, 0.0, 0.5 * sin]) {
        assert!((got - expected).abs() < 1e-12);
    }
    assert_eq!(jacr, [0.0, 1.0, 0.0]);
    let [potential, kinetic] = data.compute_energy().expect("finite");
    assert!((kinetic - 0.5 * inertia * 4.0).abs() < 1e-12);
    assert!((potential - 9.81 * (1.0 - 0.5 * cos)).abs() < 1e-12);
}

#[test]
fn positions_integrate_and_differentiate_on_the_quaternion() {
    let model = load("push_box");
    let mut data = Data::new(model.clone()).expect("data");
    data.step().expect("step");
    let start = data.qpos().to_vec();
    let velocity: Vec<f64> = (0..model.nv()).map(|i| 0.3 - 0.1 * i as f64).collect();
    let mut end = start.clone();
    model
        .integrate_pos(&mut end, &velocity, 0.5)
        .expect("lengths");
    let mut back = vec![0.0; model.nv()];
    model
        .differentiate_pos(&mut back, 0.5, &start, &end)
        .expect("lengths");
    for (a, b) in back.iter().zip(&velocity) {
        assert!((a - b).abs() < 1e-12, "{back:?} {velocity:?}");
    }
    assert!(model.integrate_pos(&mut end, &velocity[1..], 0.5).is_err());
}

#[test]
fn contacts_carry_the_weight_of_the_box() {
    let mut data = Data::new(load("push_box")).expect("data");
    for _ in 0..500 {
        data.step().expect("step");
    }
    assert_eq!(data.contacts().len(), data.ncon());
    let plane = data.model().id(ObjectKind::Geom, "floor").expect("floor");
    let mut normal = 0.0;
    for (i, contact) in data.contacts().iter().enumerate() {
        assert!(contact.geoms().contains(&plane) && contact.dist() < 1e-4);
        normal += data.contact_force(i).expect("in range")[0];
    }
    assert!((normal - 0.3 * 9.81).abs() < 1e-3, "{normal}");
}

#[test]
fn the_two_halves_make_a_step() {
    let mut whole = Data::new(load("push_box")).expect("data");
    let mut halves = Data::new(load("push_box")).expect("data");
    for _ in 0..50 {
        whole.step().expect("step");
        halves.step1().expect("first half");
        halves.step2().expect("second half");
    }
    assert_eq!(whole.qpos(), halves.qpos());
}
