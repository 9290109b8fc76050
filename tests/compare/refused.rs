//! Recordings and settings that cannot be compared, named.

use std::sync::Arc;

use phantom::compare::{CompareError, Settings, compare};
use phantom::mujoco::Model;
use phantom::recording::Recording;

use super::{BALL, FINGER, carriage_log, carriages, without};

fn refuse(model: &Arc<Model>, recording: Recording, settings: &Settings) -> CompareError {
    compare(model, &[recording], settings, None, &|| ()).expect_err("not comparable")
}

#[test]
fn unusable_recordings_are_named() {
    let model = carriages("2");
    let error = refuse(
        &model,
        without(carriage_log("2"), "mb"),
        &Settings::default(),
    );
    assert_eq!(
        error.to_string(),
        "recording simulation: no control of actuator mb"
    );
    let error = refuse(
        &model,
        without(carriage_log("2"), "pb"),
        &Settings::default(),
    );
    assert_eq!(
        error.to_string(),
        "recording simulation: the position of joint `b` is not recorded"
    );
    let error = refuse(
        &super::model(FINGER),
        carriage_log("2"),
        &Settings::default(),
    );
    assert!(
        matches!(error, CompareError::MissingControls { .. }),
        "{error}"
    );
    let error = refuse(&super::model(BALL), carriage_log("2"), &Settings::default());
    assert!(matches!(error, CompareError::NoPosition { .. }), "{error}");
    assert!(error.to_string().contains("`pa`"), "{error}");
    let mut short = carriage_log("2");
    short.streams[0].stamps_ns.truncate(2);
    short.streams[0].values.truncate(12);
    let error = refuse(&model, short, &Settings::default());
    assert!(
        matches!(error, CompareError::TooShort { got: 2, .. }),
        "{error}"
    );
}

#[test]
fn settings_out_of_range_are_named() {
    let model = carriages("2");
    for (settings, key) in [
        (
            Settings {
                decimate: 0,
                ..Settings::default()
            },
            "decimate",
        ),
        (
            Settings {
                horizons_s: vec![0.1, -1.0],
                ..Settings::default()
            },
            "horizons_s",
        ),
        (
            Settings {
                horizons_s: Vec::new(),
                ..Settings::default()
            },
            "horizons_s",
        ),
        (
            Settings {
                cutoff_hz: Some(f64::NAN),
                ..Settings::default()
            },
            "cutoff_hz",
        ),
    ] {
        let error = refuse(&model, carriage_log("2"), &settings);
        assert!(
            error.to_string().starts_with(&format!("`{key}` is ")),
            "{error}"
        );
    }
}
