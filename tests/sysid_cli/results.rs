//! What an identification writes and says.

use std::fs;
use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::randomise::{Ensemble, Randomiser};
use phantom::recording;
use phantom::rng::{self, Purpose};

use crate::machine::{MODEL, SIGMA, TRUE_DAMPING, TRUE_MASS, folder, record, sysid, text};

#[test]
fn identifies_writes_and_tests() {
    let folder = folder();
    let output = sysid(
        folder.path(),
        &[
            "--model",
            "model.xml",
            "--parameters",
            "p.toml",
            "log1.mcap",
            "log2.mcap",
            "--out",
            "id",
            "--holdout",
            "log3.mcap",
            "--ensemble",
            "5",
            "--seed",
            "3",
            "--leave-one-sensor-out",
        ],
    );
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let printed = text(&output.stdout);
    assert!(
        printed.contains("joint/hinge damping") && printed.contains("Better on held-out"),
        "{printed}"
    );
    let id = folder.path().join("id");
    let read =
        |name: &str| fs::read_to_string(id.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));

    let json: serde_json::Value = serde_json::from_str(&read("sysid.json")).expect("JSON");
    let result = &json["result"];
    assert_eq!(result["status"], "converged");
    assert_eq!(result["holdout"]["verdict"], "better");
    let mut ends = Vec::new();
    for (parameter, truth) in [(0, TRUE_DAMPING), (1, TRUE_MASS)] {
        let p = &result["parameters"][parameter];
        assert_eq!(p["label"], "identified");
        let end = |i: usize| p["interval"][i].as_f64().expect("a number");
        let width = end(1) - end(0);
        // four standard deviations a side: this one seed must not decide
        let middle = 0.5 * (end(0) + end(1));
        assert!((middle - truth).abs() < width, "{p}");
        assert!(width < 0.02 * truth, "{p}");
        ends.push((end(0), end(1)));
    }
    // the only sensor: without it nothing is known
    assert_eq!(
        result["leave_one_sensor_out"][0]["without"],
        serde_json::Value::Null
    );

    // the model file: comments stay, numbers are the identified ones
    let xml = read("model.xml");
    assert!(xml.starts_with("<!-- Identified by phantom sysid"), "{xml}");
    assert!(
        xml.contains("<!-- a comment to keep -->") && xml.contains("log1.mcap, log2.mcap"),
        "{xml}"
    );
    let identified = Model::from_xml_path(id.join("model.xml")).expect("loads");
    let value = result["parameters"][0]["value"].as_f64().expect("a number");
    assert_eq!(identified.dof_damping()[0], value);

    // the motion binds to the model and is what the encoder saw
    let motion = recording::read(&id.join("motion-1-log1.mcap")).expect("readable");
    let (stream, column) = motion.channel("qpos[hinge]").expect("there");
    let recorded = record(1, 3.0);
    for k in [100, 300, 500] {
        let (estimated, measured) = (stream.row(k)[column], recorded.streams[0].row(k)[0]);
        assert!(
            (estimated - measured).abs() < 6.0 * SIGMA,
            "{k}: {estimated} {measured}"
        );
    }

    // the ensemble: as many models, spread as the posterior says, and fit for the identified model
    let table: toml::Table = read("ensemble.toml").parse().expect("TOML");
    let ensemble: Ensemble = table["ensemble"].clone().try_into().expect("an ensemble");
    assert_eq!(ensemble.models.len(), 5);
    let damping = ensemble
        .numbers
        .iter()
        .position(|n| n == "dof_damping[0]")
        .expect("there");
    let half = 0.5 * (ends[0].1 - ends[0].0);
    for row in &ensemble.models {
        assert!((row[damping] - value).abs() < 4.0 * half, "{row:?} {half}");
    }
    assert!(ensemble.models[0][damping] != ensemble.models[1][damping]);
    let randomiser = Randomiser::new(&identified, &[]).expect("no rule");
    let randomiser = randomiser
        .with_ensemble(&identified, &ensemble)
        .expect("fits");
    let mut data = Data::new(Arc::new(identified)).expect("data");
    let mut rng = rng::stream(0, Purpose::Model, 0, 0);
    randomiser.draw(&mut data, &mut rng).expect("drawn");
    let drawn = data.model().dof_damping()[0];
    assert!(ensemble.models.iter().any(|row| row[damping] == drawn));

    let page = read("report.html");
    for part in [
        "Held-out recordings",
        "Leave one sensor out",
        "Convergence",
        "joint/hinge damping",
    ] {
        assert!(page.contains(part), "{part}");
    }
}

#[test]
fn without_held_out_recordings_nothing_is_called_better() {
    let folder = folder();
    let arguments = [
        "--model",
        "model.xml",
        "--parameters",
        "p.toml",
        "log1.mcap",
        "--json",
    ];
    let output = sysid(folder.path(), &arguments);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(json["result"]["holdout"], serde_json::Value::Null);
    assert!(folder.path().join("sysid/model.xml").exists());
}

/// Held-out recordings of another machine speak against the identified model.
#[test]
fn no_better_on_another_machine_is_exit_code_1() {
    let folder = folder();
    // the log of a machine that is the nominal model
    let nominal = r#"
command = "held"
[[parameter]]
element = "joint/hinge"
attribute = "damping"
start = 0.2
frozen = true
[[parameter]]
element = "body/arm"
attribute = "mass"
[[channel]]
name = "encoder"
noise_sigma = 2e-4
"#;
    fs::write(folder.path().join("wrong.toml"), nominal).expect("written");
    let mut model = fs::read_to_string(folder.path().join("model.xml")).expect("readable");
    model = model
        .replace(r#"damping="0.05""#, r#"damping="0.08""#)
        .replace(r#"mass="0.5""#, r#"mass="0.6""#);
    fs::write(folder.path().join("true.xml"), model).expect("written");
    let output = sysid(
        folder.path(),
        &[
            "--model",
            "true.xml",
            "--parameters",
            "wrong.toml",
            "log1.mcap",
            "--holdout",
            "log3.mcap",
        ],
    );
    let printed = text(&output.stdout);
    assert_eq!(
        output.status.code(),
        Some(1),
        "{printed}{}",
        text(&output.stderr)
    );
    assert!(printed.contains("Not better on held-out"), "{printed}");
}

#[test]
fn what_cannot_be_told_apart_is_said() {
    let folder = folder();
    // only torque over inertia moves a pendulum without weight
    let model = MODEL
        .replace(
            r#"<option timestep="0.005"/>"#,
            r#"<option timestep="0.005" gravity="0 0 0"/>"#,
        )
        .replace(r#"damping="0.05""#, r#"damping="0""#);
    fs::write(folder.path().join("weightless.xml"), &model).expect("written");
    let parameters = r#"
command = "held"
[[parameter]]
element = "body/arm"
attribute = "mass"
[[parameter]]
element = "actuator/motor"
attribute = "gear"
components = [0]
[[parameter]]
element = "joint/hinge"
attribute = "stiffness"
prior_sigma = 0.01
[[parameter]]
element = "body/arm"
attribute = "ipos"
components = [1]
prior_sigma = 0.01
[[channel]]
name = "encoder"
noise_sigma = 2e-4
"#;
    fs::write(folder.path().join("q.toml"), parameters).expect("written");
    let mut data = Data::new(Arc::new(Model::from_xml_str(&model).expect("loads"))).expect("data");
    let mut recording = record(1, 2.0);
    for k in 0..recording.streams[0].len() {
        recording.streams[0].values[k] += data.qpos()[0] - recording.streams[0].values[k];
        data.ctrl_mut()[0] = recording.streams[1].values[k];
        data.step().expect("step");
    }
    recording::write(&folder.path().join("w.mcap"), &recording).expect("written");
    let arguments = [
        "--model",
        "weightless.xml",
        "--parameters",
        "q.toml",
        "w.mcap",
        "--json",
    ];
    let output = sysid(folder.path(), &arguments);
    let json: serde_json::Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|_| panic!("{}", text(&output.stderr)));
    let texts: Vec<&str> = (json["result"]["inseparable"]
        .as_array()
        .expect("a list")
        .iter())
    .map(|c| c["text"].as_str().expect("a sentence"))
    .collect();
    assert_eq!(
        texts,
        [
            "mass of arm and gear[0] of motor only as a ratio",
            "ipos[1] of arm is not determined by the recordings"
        ]
    );
    let label = |i: usize| {
        json["result"]["parameters"][i]["label"]
            .as_str()
            .expect("a word")
    };
    assert_eq!(
        [label(0), label(1), label(3)],
        ["undetermined", "undetermined", "undetermined"]
    );
}
