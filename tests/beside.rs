//! Machines that nothing connects are searched as if each were alone.

use std::sync::Arc;

use phantom::compare::Settings;
use phantom::gap::effect::ModelFile;
use phantom::gap::{self, Input, Options};
use phantom::mujoco::Data;
use phantom::recording::{Channel, Kind, Meta, Recording, Stream};
use phantom::rng::{self, Purpose};

/// Two pendulums with motors, and a ball that lies still beside them.
const MACHINES: &str = r#"<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001"/>
  <default><default class="dry"><joint DRY/></default></default>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1" pos="0 0 -1"/>
    <body name="a">
      <inertial pos="0 0 -0.3" mass="0.4" diaginertia="0.004 0.004 0.004"/>
      <joint name="a" axis="0 1 0"/>
    </body>
    <body name="b" pos="2 0 0">
      <inertial pos="0 0 -0.3" mass="0.4" diaginertia="0.004 0.004 0.004"/>
      <joint name="b" axis="0 1 0" class="dry"/>
    </body>
    <body name="ball" pos="4 0 -0.9"><freejoint name="ball"/><geom name="ball" size="0.1" mass="0.2"/></body>
  </worldbody>
  <actuator><motor name="drive_a" joint="a"/><motor name="drive_b" joint="b"/></actuator>
  <sensor>
    <jointpos name="angle_a" joint="a"/><jointpos name="angle_b" joint="b"/>
    <framepos name="place" objtype="body" objname="ball"/>
  </sensor>
</mujoco>"#;
const FRICTION: &str =
    r#"frictionloss="0.05" solreffriction="0.002 1" solimpfriction="0.99 0.99 0.001""#;
/// rad
const NOISE: f64 = 5e-5;
/// m
const PLACE_NOISE: f64 = 1e-4;

fn file(dry: &str) -> ModelFile {
    let xml = MACHINES.replace("DRY", dry);
    ModelFile::of_text(xml, "machines.xml").unwrap_or_else(|e| panic!("{e}"))
}

/// Six seconds under several sines.
fn record(dry: &str, seed: u64) -> (String, Recording) {
    let mut data = Data::new(Arc::clone(&file(dry).model)).expect("data");
    let mut rng = rng::stream(seed, Purpose::SensorNoise, 0, 0);
    let channel = |name: &str, kind, unit: &str, noise_sigma| Channel {
        name: name.into(),
        kind,
        unit: unit.into(),
        noise_sigma,
    };
    let sensor = |name, unit, sigma| channel(name, Kind::Sensor, unit, Some(sigma));
    let mut stream = Stream::new(
        "all",
        Some(1000.0),
        vec![
            sensor("angle_a", "rad", NOISE),
            sensor("angle_b", "rad", NOISE),
            sensor("place[0]", "m", PLACE_NOISE),
            sensor("place[1]", "m", PLACE_NOISE),
            sensor("place[2]", "m", PLACE_NOISE),
            channel("drive_a", Kind::Control, "N m", None),
            channel("drive_b", Kind::Control, "N m", None),
        ],
    );
    for k in 0..6000_i64 {
        let t = k as f64 * 1e-3;
        let torque = |phase: f64| {
            0.4 * (3.1 * t + phase).sin()
                + 0.3 * (7.3 * t + 2.0 * phase).sin()
                + 0.1 * (23.0 * t + phase).sin()
        };
        let torques = [torque(seed as f64), torque(seed as f64 + 0.5)];
        let mut row: Vec<f64> = data.qpos()[..5].to_vec();
        for (value, sigma) in
            row.iter_mut()
                .zip([NOISE, NOISE, PLACE_NOISE, PLACE_NOISE, PLACE_NOISE])
        {
            *value += sigma * rng::normal(&mut rng);
        }
        row.extend(torques);
        stream.push(k * 1_000_000, &row);
        data.ctrl_mut().copy_from_slice(&torques);
        data.step().expect("step");
    }
    let recording = Recording {
        meta: Meta::default(),
        streams: vec![stream],
    };
    (format!("{seed}"), recording)
}

#[test]
fn friction_of_one_machine_is_found_there_and_a_ball_at_rest_tells_nothing() {
    let rules = "[[parameter]]\nelement = \"body/?\"\nattribute = \"mass\"\nprior_sigma = 0.1\n";
    let config = toml::from_str(rules).expect("a configuration");
    let (train, holdout) = ([record(FRICTION, 1)], [record(FRICTION, 101)]);
    let input = Input {
        model: &file(""),
        config: &config,
        train: &train,
        holdout: &holdout,
        protocol: &Settings {
            cutoff_hz: Some(30.0),
            ..Settings::default()
        },
    };
    let answer = gap::run(&input, &Options::default(), &mut |_, _, _| true)
        .unwrap_or_else(|e| panic!("{e}"))
        .answer;
    let found: Vec<_> = answer
        .effects
        .iter()
        .map(|e| (e.name.as_str(), e.at.as_str()))
        .collect();
    assert_eq!(found, [("coulomb_friction", "b")], "{answer:#?}");
    let level = &answer.effects[0].parameters[0];
    assert!((level.value / 0.05 - 1.0).abs() < 0.05, "{level:?}");
    // what happens at one machine is not seen at the other
    assert!(
        answer.located.iter().all(|l| l.channel == "b"),
        "{:?}",
        answer.located
    );
    assert!(
        answer.located.iter().all(|l| l.phase.starts_with("free")),
        "{:?}",
        answer.located
    );
    // its readings are left out, so nothing that acts on it can be tested
    let untested: Vec<&str> = (answer.untestable.iter())
        .filter(|u| u.at.iter().any(|at| at == "ball"))
        .map(|u| u.name.as_str())
        .collect();
    assert!(
        untested.contains(&"object_mass") && untested.contains(&"contact_friction"),
        "{untested:?}"
    );
    let again = answer.round_trip.expect("a round trip");
    assert!(again.found.is_empty(), "{again:?}");
}
