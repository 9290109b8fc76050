//! Binding tables, names of the model, and what the checks find.

use std::path::Path;

use phantom::mujoco::Model;
use phantom::recording::{
    self, Binding, Bound, Channel, Kind, Recording, RecordingError, Severity, Stream, check,
};

const MODEL: &str = r#"<mujoco>
  <worldbody>
    <body name="arm"><joint name="j1" axis="0 1 0"/><geom size="0.1"/><site name="tip"/></body>
    <body name="box" pos="1 0 0"><freejoint name="box"/><geom size="0.1"/></body>
    <body name="cart" pos="2 0 0"><joint name="rail" type="slide"/><geom size="0.1"/></body>
  </worldbody>
  <actuator><motor name="m1" joint="j1"/><motor name="m2" joint="rail"/></actuator>
  <sensor>
    <jointpos name="j1_pos" joint="j1"/>
    <jointvel name="rail_vel" joint="rail"/>
    <framepos name="box_pos" objtype="body" objname="box"/>
  </sensor>
</mujoco>"#;

fn model() -> Model {
    Model::from_xml_str(MODEL).expect("a model")
}

fn channel(name: &str, kind: Kind, unit: &str) -> Channel {
    Channel {
        name: name.into(),
        kind,
        unit: unit.into(),
        noise_sigma: None,
    }
}

/// 100 samples at 100 Hz, each channel another moving signal.
fn recording(channels: &[Channel]) -> Recording {
    let mut stream = Stream::new("s", Some(100.0), channels.to_vec());
    for k in 0..100 {
        let row: Vec<f64> = (0..channels.len())
            .map(|c| f64::from(k) + c as f64)
            .collect();
        stream.push(i64::from(k) * 10_000_000, &row);
    }
    Recording {
        streams: vec![stream],
        ..Recording::default()
    }
}

/// A recording of everything in the model.
fn complete() -> Recording {
    let sensor = |name, unit| channel(name, Kind::Sensor, unit);
    recording(&[
        sensor("j1_pos", "rad"),
        sensor("rail_vel", "m/s"),
        sensor("box_pos[0]", "m"),
        sensor("box_pos[1]", "m"),
        sensor("box_pos[2]", "m"),
        channel("m1", Kind::Control, "N m"),
        channel("m2", Kind::Control, "N"),
    ])
}

fn rules(recording: &Recording, model: Option<&Model>) -> Vec<&'static str> {
    check(recording, model).iter().map(|f| f.rule).collect()
}

fn toml(text: &str) -> Binding {
    Binding::from_toml(text, Path::new("b.toml")).expect("a table")
}

#[test]
fn names_lead_to_the_numbers_of_the_model() {
    let model = model();
    let names = [
        "box_pos[2]",
        "j1_pos",
        "m2",
        "goal[1]",
        "qpos[rail]",
        "qpos[box][6]",
        "qvel[box][0]",
        "qvel[j1]",
        "box_pos",
        "box_pos[3]",
        "qpos[box]",
        "qpos[nowhere]",
        "other",
    ];
    // kinds as a plain table has them
    let recording = recording(&names.map(|n| channel(n, Kind::Sensor, "")));
    let bound = Bound::new(&recording, &model).expect("bound");
    let addresses = |list: &[recording::BoundChannel]| -> Vec<(usize, usize)> {
        list.iter().map(|b| (b.column, b.address)).collect()
    };
    assert_eq!(addresses(&bound.sensors), [(1, 0), (0, 4)]);
    assert_eq!(addresses(&bound.controls), [(2, 1)]);
    assert_eq!(addresses(&bound.goal), [(3, 1)]);
    assert_eq!(addresses(&bound.qpos), [(5, 7), (4, 8)]);
    assert_eq!(addresses(&bound.qvel), [(7, 0), (6, 1)]);
    let unbound: Vec<&str> = bound.unbound.iter().map(|u| u.name.as_str()).collect();
    assert_eq!(unbound, &names[8..]);
    assert_eq!(bound.missing_controls(&model), ["m1"]);
    assert_eq!(bound.missing_sensors(&model), ["rail_vel", "box_pos"]);
}

#[test]
fn two_channels_for_one_number_are_refused() {
    let recording = recording(&["j1_pos", "j1_pos[0]"].map(|n| channel(n, Kind::Sensor, "")));
    assert!(matches!(
        Bound::new(&recording, &model()),
        Err(RecordingError::Binding { .. })
    ));
}

#[test]
fn a_table_renames_scales_and_splits() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("log.csv");
    let table = "toss,t_ms,q,label,u\n1,0.5,10,a,1\n1,1,20,b,2\n2,0,30,c,\n1,2.25,40,d,3\n";
    std::fs::write(&path, table).expect("written");
    let binding = toml(
        "time = 't_ms'\ntime_scale = 1e-3\ntrial = 'toss'\nignore = ['label']\n\
         [[channel]]\nfrom = 'q'\nto = 'u'\nscale = -0.5\noffset = 1.0\nunit = 'rad'\n\
         [[channel]]\nfrom = 'u'\nto = 'q'\nkind = 'control'\nnoise_sigma = 0.25\n",
    );
    let trials = recording::read_trials(&path, &binding).expect("trials");
    let names: Vec<&str> = trials.iter().map(|r| r.meta.trial.as_str()).collect();
    assert_eq!(names, ["1", "2"]);
    let stream = &trials[0].streams[0];
    assert_eq!(stream.stamps_ns, [500_000, 1_000_000, 2_250_000]);
    assert_eq!(stream.values, [-4.0, 1.0, -9.0, 2.0, -19.0, 3.0]);
    assert_eq!(stream.channels[0], channel("u", Kind::Sensor, "rad"));
    assert_eq!(stream.channels[1].kind, Kind::Control);
    assert_eq!(stream.channels[1].noise_sigma, Some(0.25));
    assert!(trials[1].streams[0].row(0)[1].is_nan());
}

#[test]
fn ignored_channels_leave_the_others_alone() {
    let mut recording = complete();
    let before = recording.clone();
    toml("ignore = ['rail_vel', 'm2']")
        .apply(&mut recording)
        .expect("applied");
    let (stream, old) = (&recording.streams[0], &before.streams[0]);
    assert_eq!(stream.channels.len(), 5);
    for i in 0..stream.len() {
        let row = old.row(i);
        assert_eq!(stream.row(i), [row[0], row[2], row[3], row[4], row[5]]);
    }
}

#[test]
fn mistakes_in_a_binding_are_named() {
    for (text, expected) in [
        ("time = 1", "b.toml:1: invalid type"),
        (
            "[[channel]]\nfrom = 'a'\ngain = 2.0",
            "b.toml:3: unknown field `gain`",
        ),
        ("time_scale = 0.0", "b.toml:1: time_scale is 0"),
        (
            "[[channel]]\nfrom = 'a'\nscale = nan",
            "b.toml:1: channel `a`: scale is NaN",
        ),
    ] {
        let message = Binding::from_toml(text, Path::new("b.toml"))
            .expect_err(text)
            .to_string();
        assert!(message.starts_with(expected), "{message}");
    }
    for (text, expected) in [
        (
            "[[channel]]\nfrom = 'a'",
            "binding: no channel `a` in the recording, which has j1_pos",
        ),
        (
            "[[channel]]\nfrom = 'm1'\nto = 'm2'",
            "binding: two channels would be called `m2`",
        ),
    ] {
        let mut recording = complete();
        let message = toml(text)
            .apply(&mut recording)
            .expect_err(text)
            .to_string();
        assert!(message.starts_with(expected), "{message}");
        assert_eq!(recording, complete());
    }
}

#[test]
fn a_sound_recording_has_no_findings() {
    assert_eq!(rules(&complete(), Some(&model())), Vec::<&str>::new());
}

/// Each fault alone gives its own finding and no other, at its own time.
#[test]
fn each_fault_is_found() {
    type Fault = (&'static str, Severity, Option<f64>, fn(&mut Stream));
    let faults: [Fault; 11] = [
        ("time_backwards", Severity::Error, Some(0.4), |s| {
            s.stamps_ns.swap(39, 40);
        }),
        ("stamp_twice", Severity::Error, Some(0.39), |s| {
            s.stamps_ns[40] = s.stamps_ns[39];
        }),
        ("not_finite", Severity::Error, Some(0.5), |s| {
            s.values[50 * 7] = f64::INFINITY;
        }),
        ("gap", Severity::Warning, Some(0.59), |s| {
            s.stamps_ns[60..].iter_mut().for_each(|t| *t += 30_000_000);
        }),
        ("rate", Severity::Error, None, |s| s.rate_hz = Some(1000.0)),
        ("never_moves", Severity::Warning, Some(0.0), |s| {
            s.values.iter_mut().step_by(7).for_each(|v| *v = 2.0);
        }),
        ("missing", Severity::Warning, Some(0.7), |s| {
            s.values[70 * 7 + 1] = f64::NAN;
        }),
        ("unit", Severity::Error, None, |s| {
            s.channels[0].unit = "deg".into();
        }),
        ("no_samples", Severity::Warning, None, |s| {
            s.values.iter_mut().step_by(7).for_each(|v| *v = f64::NAN);
        }),
        ("no_control", Severity::Error, None, |s| {
            s.channels[5].kind = Kind::Other;
        }),
        ("no_sensor", Severity::Warning, None, |s| {
            s.channels[0].kind = Kind::Other;
        }),
    ];
    for (rule, severity, time_s, break_it) in faults {
        let mut recording = complete();
        break_it(&mut recording.streams[0]);
        let findings = check(&recording, Some(&model()));
        let [finding] = findings.as_slice() else {
            panic!("{rule}: {findings:?}")
        };
        assert_eq!((finding.rule, finding.severity), (rule, severity));
        if let Some(expected) = time_s {
            assert!(
                (finding.time_s.expect("a time") - expected).abs() < 0.011,
                "{finding}"
            );
        }
    }
}

#[test]
fn units_may_be_spelled_in_several_ways() {
    let mut recording = complete();
    recording.streams[0].channels[1].unit = " m / s".into();
    assert_eq!(rules(&recording, Some(&model())), Vec::<&str>::new());
}

#[test]
fn a_name_that_fits_nothing_is_told_with_what_is_missing() {
    let mut recording = complete();
    recording.streams[0].channels[0].name = "j1_position".into();
    assert_eq!(
        rules(&recording, Some(&model())),
        ["not_in_model", "no_sensor"]
    );
    recording.streams[0].channels[0].name = "m1".into();
    assert!(rules(&recording, None).contains(&"name_twice"));
}
