//! A small machine and its recordings, and the program run on them.

use std::fs;
use std::path::Path;
use std::process::Output;
use std::sync::Arc;

use assert_cmd::Command;
use phantom::mujoco::{Data, Model};
use phantom::recording::{self, Channel, Kind, Recording, Stream};
use phantom::rng::{self, Purpose};

/// A pendulum whose file says less than what it is.
pub(crate) const MODEL: &str = r#"<mujoco model="pendulum">
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

pub(crate) const TRUE_DAMPING: f64 = 0.08;
pub(crate) const TRUE_MASS: f64 = 0.6;
pub(crate) const SIGMA: f64 = 2e-4;

pub(crate) const PARAMETERS: &str = r#"
command = "held"
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
pub(crate) fn record(seed: u64, seconds: f64) -> Recording {
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

pub(crate) fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    fs::write(at("model.xml"), MODEL).expect("written");
    fs::write(at("p.toml"), PARAMETERS).expect("written");
    for seed in 1..=3 {
        recording::write(&at(&format!("log{seed}.mcap")), &record(seed, 3.0)).expect("written");
    }
    folder
}

pub(crate) fn sysid(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::cargo_bin("phantom").expect("the program");
    command.current_dir(folder).arg("sysid").args(arguments);
    command.output().expect("it runs")
}

pub(crate) fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}
