//! Machines that nothing connects are searched as if each were alone.

mod common;

use common::driven::{self, FRICTION, search};
use phantom::gap::effect::ModelFile;
use phantom::recording::Recording;

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
    let place = ["place[0]", "place[1]", "place[2]"].map(|name| (name, "m", PLACE_NOISE));
    let angles = ["angle_a", "angle_b"].map(|name| (name, "rad", NOISE));
    let positions = [angles.as_slice(), &place].concat();
    let phase = seed as f64;
    let motors = [("drive_a", phase), ("drive_b", phase + 0.5)];
    driven::record(&file(dry).model, seed, 6000, &positions, &motors)
}

#[test]
fn friction_of_one_machine_is_found_there_and_a_ball_at_rest_tells_nothing() {
    let (train, holdout) = ([record(FRICTION, 1)], [record(FRICTION, 101)]);
    let answer = search(&file(""), "?", &train, &holdout).answer;
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
        .filter(|u| u.at.iter().any(|at| at == "ball" || at == "ball+floor"))
        .map(|u| u.name.as_str())
        .collect();
    assert!(
        untested.contains(&"object_mass") && untested.contains(&"contact_friction"),
        "{untested:?}"
    );
    let again = answer.round_trip.expect("a round trip");
    assert!(again.found.is_empty(), "{again:?}");
}
