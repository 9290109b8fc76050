//! `phantom sysid` as users meet it.

use std::fs;
use std::path::Path;
use std::process::Output;
use std::sync::Arc;

use assert_cmd::Command;
use phantom::mujoco::{Data, Model};
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
            "--holdout",
            "log3.mcap",
            "--out",
            "id",
            "--ensemble",
            "5",
        ],
    );
    println!("{}\n{}", text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let id = folder.path().join("id");
    let json: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(id.join("sysid.json")).expect("there"))
            .expect("JSON");
    println!(
        "{}",
        serde_json::to_string_pretty(&json["result"]["holdout"]).unwrap()
    );
}
