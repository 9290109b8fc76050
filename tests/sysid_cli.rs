//! `phantom sysid` as users meet it.

use std::fs;
use std::path::Path;
use std::process::Output;
use std::sync::Arc;

use assert_cmd::Command;
use phantom::mujoco::{Data, Model};
use phantom::randomise::{Ensemble, Randomiser};
use phantom::recording::{self, Channel, Kind, Recording, Stream};
use phantom::rng::{self, Purpose};

/// A pendulum whose file says less than what it is.
const MODEL: &str = r#"<mujoco model="pendulum">
  <!-- a comment to keep -->
  <option timestep="0.005"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" damping="0.05"/>
      <geom name="rod" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.4" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="1"/></actuator>
  <sensor><jointpos name="encoder" joint="hinge"/></sensor>
</mujoco>
"#;

const TRUE_DAMPING: f64 = 0.08;
const TRUE_MASS: f64 = 0.6;
const SIGMA: f64 = 2e-4;

const PARAMETERS: &str = r#"
[[parameter]]
element = "joint/hinge"
attribute = "damping"

[[parameter]]
element = "body/arm"
attribute = "mass"

[[channel]]
name = "encoder"
noise_sigma = 2e-4
"#;

/// Seconds of the true pendulum under two sines of torque.
fn record(seed: u64, seconds: f64) -> Recording {
    let truth = MODEL
        .replace(r#"damping="0.05""#, &format!(r#"damping="{TRUE_DAMPING}""#))
        .replace(r#"mass="0.5""#, &format!(r#"mass="{TRUE_MASS}""#));
    let mut data = Data::new(Arc::new(Model::from_xml_str(&truth).expect("loads"))).expect("data");
    let channel = |name: &str, kind, unit: &str| Channel {
        name: name.into(),
        kind,
        unit: unit.into(),
        noise_sigma: None,
    };
    let mut sensors = Stream::new("s", None, vec![channel("encoder", Kind::Sensor, "rad")]);
    let mut controls = Stream::new("c", None, vec![channel("motor", Kind::Control, "N m")]);
    let mut rng = rng::stream(seed, Purpose::SensorNoise, 0, 0);
    for k in 0..(seconds / 0.005) as i64 {
        let t = k as f64 * 0.005;
        let u = 0.8 * (2.0 * t + seed as f64).sin() + 0.5 * (9.0 * t).sin();
        sensors.push(
            5_000_000 * k,
            &[data.qpos()[0] + SIGMA * rng::normal(&mut rng)],
        );
        controls.push(5_000_000 * k, &[u]);
        data.ctrl_mut()[0] = u;
        data.step().expect("step");
    }
    Recording {
        streams: vec![sensors, controls],
        ..Recording::default()
    }
}

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    fs::write(at("model.xml"), MODEL).expect("written");
    fs::write(at("p.toml"), PARAMETERS).expect("written");
    for seed in 1..=3 {
        recording::write(&at(&format!("log{seed}.mcap")), &record(seed, 3.0)).expect("written");
    }
    folder
}

fn sysid(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::cargo_bin("phantom").expect("the program");
    command.current_dir(folder).arg("sysid").args(arguments);
    command.output().expect("it runs")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

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

#[test]
fn mistakes_are_named_with_exit_code_2() {
    let folder = folder();
    let write =
        |name: &str, content: &str| fs::write(folder.path().join(name), content).expect("written");
    let with = |old: &str, new: &str| PARAMETERS.replace(old, new);
    write("element.toml", &with("joint/hinge", "joint/hing"));
    write("attribute.toml", &with("\"damping\"", "\"dampening\""));
    write(
        "key.toml",
        &with("attribute = \"mass\"", "attribute = \"mass\"\nsigma = 1"),
    );
    write(
        "bound.toml",
        &with("attribute = \"mass\"", "attribute = \"mass\"\nlower = 0.5"),
    );
    write(
        "twice.toml",
        &with(
            "\"body/arm\"\nattribute = \"mass\"",
            "\"joint/*\"\nattribute = \"damping\"",
        ),
    );
    write("none.toml", "[[channel]]\nname = \"encoder\"\n");
    write(
        "rk4.xml",
        &MODEL.replace(
            "timestep=\"0.005\"",
            "timestep=\"0.005\" integrator=\"RK4\"",
        ),
    );
    write(
        "included.xml",
        &MODEL.replace(
            "<body name=\"arm\"",
            "<include file=\"arm.xml\"/><body name=\"other\"",
        ),
    );
    write("broken.xml", "<mujoco><worldbody>");
    write("no_control.csv", "time,encoder\n0,0\n0.005,0\n0.01,0\n");
    write(
        "short.csv",
        "time,encoder,motor\n0,0,0\n0.005,0,0\n0.01,0,0\n",
    );
    write(
        "unknown.csv",
        "time,voltage,motor\n0,0,0\n0.005,0,0\n0.01,0,0\n",
    );
    write("low.toml", "horizons_s = [-1.0]\n");
    for (arguments, message) in [
        (
            &["--parameters", "element.toml", "log1.mcap"][..],
            "no joint is named `hing`; there are: hinge",
        ),
        (
            &["--parameters", "attribute.toml", "log1.mcap"],
            "it has: damping, frictionloss",
        ),
        (
            &["--parameters", "key.toml", "log1.mcap"],
            "key.toml:9: unknown field `sigma`",
        ),
        (
            &["--parameters", "bound.toml", "log1.mcap"],
            "starts on its bound 0.5",
        ),
        (
            &["--parameters", "twice.toml", "log1.mcap"],
            "is already set by `joint/hinge damping`",
        ),
        (
            &["--parameters", "none.toml", "log1.mcap"],
            "there is no [[parameter]] to estimate",
        ),
        (&["--parameters", "gone.toml", "log1.mcap"], "gone.toml"),
        (&["--parameters", "p.toml", "gone.mcap"], "gone.mcap"),
        (
            &["--parameters", "p.toml", "no_control.csv"],
            "actuator `motor` is not recorded",
        ),
        (&["--parameters", "p.toml", "short.csv"], "covers 3 steps"),
        (
            &["--parameters", "p.toml", "unknown.csv"],
            "no channel is a sensor",
        ),
        (
            &[
                "--parameters",
                "p.toml",
                "log1.mcap",
                "--holdout",
                "short.csv",
            ],
            "covers 3 steps",
        ),
        (
            &[
                "--parameters",
                "p.toml",
                "log1.mcap",
                "--protocol",
                "low.toml",
            ],
            "`horizons_s` is -1",
        ),
        (
            &["--parameters", "p.toml", "log1.mcap", "--ensemble", "0"],
            "1 to 1000000",
        ),
        (
            &["--parameters", "p.toml", "log1.mcap", "--model", "rk4.xml"],
            "its integrator is not Euler",
        ),
        (
            &[
                "--parameters",
                "p.toml",
                "log1.mcap",
                "--model",
                "broken.xml",
            ],
            "broken.xml",
        ),
        (
            &[
                "--parameters",
                "p.toml",
                "log1.mcap",
                "--out",
                "model.xml/x",
            ],
            "model.xml/x",
        ),
        (&["--parameters", "p.toml"], "<FILE>"),
        (
            &["design", "--parameters", "p.toml", "--behaviours", "dance"],
            "there is no behaviour `dance`",
        ),
        (
            &["design", "--parameters", "p.toml", "--behaviours", "push"],
            "the model does not fit",
        ),
        (
            &["design", "--parameters", "p.toml", "--behaviours", "none"],
            "no --candidate to judge",
        ),
    ] {
        let mut all = arguments.to_vec();
        if !all.contains(&"--model") {
            all.extend(["--model", "model.xml"]);
        }
        let output = sysid(folder.path(), &all);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {error}");
        assert!(error.contains(message), "{arguments:?}: {error}");
    }
    assert!(
        !folder.path().join("sysid/model.xml").exists(),
        "nothing is written"
    );
}

/// Of a sine and of standing still, the sine tells more; both are judged from files and from the library.
#[test]
fn design_prefers_motion() {
    let folder = folder();
    let mut still = record(1, 1.0);
    for stream in &mut still.streams {
        stream.values.fill(0.0);
    }
    recording::write(&folder.path().join("still.mcap"), &still).expect("written");
    let arguments = [
        "design",
        "--model",
        "model.xml",
        "--parameters",
        "p.toml",
        "--behaviours",
        "multi_sine",
        "--seconds",
        "1",
        "--candidate",
        "still.mcap",
        "--next",
        "2",
        "--json",
    ];
    let output = sysid(folder.path(), &arguments);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(json["scores"][0]["name"], "multi_sine");
    assert_eq!(json["scores"][1]["name"], "still.mcap");
    assert_eq!(json["next"][1]["name"], "multi_sine");
    let sigma = |s: &serde_json::Value| s["sigma"][0].as_f64().expect("a number");
    let (once, twice) = (sigma(&json["next"][0]), sigma(&json["next"][1]));
    assert!(
        (twice / once * 2_f64.sqrt() - 1.0).abs() < 0.01,
        "{once} {twice}"
    );
    // of the weight of a hanging pendulum nothing is seen
    assert!(sigma(&json["scores"][1]) > 1.0 && once < 0.1, "{json}");
}
