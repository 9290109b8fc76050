//! Small machines, and what inverse dynamics says of them with an effect and without.

use std::path::Path;

use phantom::gap::effect::{Effect, ModelFile, Place, Written, named, write};
use phantom::mujoco::Data;

/// m, kg, m, m/s²
pub(crate) const LENGTH: f64 = 0.3;
pub(crate) const MASS: f64 = 0.4;
pub(crate) const INERTIA: f64 = 0.004;
pub(crate) const GRAVITY: f64 = 9.81;
/// N m of the motor's whole range
pub(crate) const FULL: f64 = 2.0;

/// A pendulum that hangs along −z and turns about y, with a motor.
pub(crate) const PENDULUM: &str = r#"<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" tolerance="0" iterations="200"/>
  <worldbody>
    <!-- hangs -->
    <body name="link">
      <inertial pos="0 0 -0.3" mass="0.4" diaginertia="0.004 0.004 0.004"/>
      <joint name="j" axis="0 1 0" armature="0.001" limited="true" range="-1.5 1.5"/>
      <site name="tip" pos="0 0 -0.6"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="m" joint="j" gear="2" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
  <sensor>
    <jointpos name="q" joint="j"/>
    <jointvel name="v" joint="j"/>
  </sensor>
</mujoco>"#;

pub(crate) fn file(xml: &str) -> ModelFile {
    ModelFile::of_text(xml.to_owned(), Path::new("machine.xml")).unwrap_or_else(|e| panic!("{e}"))
}

pub(crate) fn effect(name: &str) -> &'static dyn Effect {
    named(name).unwrap_or_else(|| panic!("{name} is in the catalogue"))
}

/// The effect at the place of that name.
pub(crate) fn with(base: &ModelFile, name: &str, place: &str, values: &[f64]) -> Written {
    let effect = effect(name);
    let places = effect.places(&base.model);
    let place: &Place = places
        .iter()
        .find(|p| p.to_string() == place)
        .unwrap_or_else(|| {
            let all: Vec<String> = places.iter().map(ToString::to_string).collect();
            panic!("{name} acts at {}", all.join(", "))
        });
    write(base, effect, place, values).unwrap_or_else(|e| panic!("{e}"))
}

/// A state with acceleration and control of one degree of freedom.
#[derive(Debug, Clone, Copy)]
pub(crate) struct State {
    pub q: f64,
    pub v: f64,
    pub a: f64,
    pub u: f64,
}

/// States all over the range.
pub(crate) fn states() -> Vec<State> {
    (0..60)
        .map(|k| {
            let t = f64::from(k);
            State {
                q: 1.2 * (0.7 * t).sin(),
                v: 2.5 * (1.3 * t + 0.4).sin(),
                a: 30.0 * (0.9 * t + 1.0).sin(),
                u: 0.95 * (2.1 * t).sin(),
            }
        })
        .collect()
}

/// The force that the motion needs beyond what the model supplies, motor included.
pub(crate) fn missing(model: &ModelFile, state: State) -> f64 {
    let mut data = Data::new(model.model.clone()).expect("data");
    data.qpos_mut()[0] = state.q;
    data.qvel_mut()[0] = state.v;
    data.ctrl_mut()[0] = state.u;
    data.qacc_mut()[0] = state.a;
    data.inverse().expect("inverse");
    data.actuation().expect("actuation");
    data.qfrc_inverse()[0] - data.qfrc_actuator()[0]
}
