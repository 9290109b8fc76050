//! One effect at several joints, and one whose numbers the recordings do not tell apart.

mod common;

use common::driven::{self, FRICTION};
use phantom::compare::Settings;
use phantom::gap::Options;
use phantom::gap::effect::ModelFile;
use phantom::gap::result::{Answer, Verdict};
use phantom::recording::Recording;

/// Two links one after the other; `DRY` stands for attributes of both joints.
const CHAIN: &str = r#"<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" gravity="0 0 0"/>
  <default><joint axis="0 1 0" stiffness="2" damping="0.02" DRY/></default>
  <worldbody>
    <body name="a">
      <inertial pos="0 0 0.1" mass="0.4" diaginertia="0.004 0.004 0.004"/>
      <joint name="a"/>
      <body name="b" pos="0 0 0.2">
        <inertial pos="0 0 0.1" mass="0.4" diaginertia="0.004 0.004 0.004"/>
        <joint name="b"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="drive_a" joint="a"/><motor name="drive_b" joint="b"/></actuator>
  <sensor><jointpos name="angle_a" joint="a"/><jointpos name="angle_b" joint="b"/></sensor>
</mujoco>"#;
/// A pendulum on a cart; `MASS` stands for its mass, kg, whatever its moments of inertia.
const CART: &str = r#"<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001"/>
  <worldbody>
    <body name="cart">
      <inertial pos="0 0 0" mass="0.8" diaginertia="0.01 0.01 0.01"/>
      <joint name="slide" type="slide" axis="1 0 0" stiffness="10" damping="1"/>
      <body name="pole">
        <inertial pos="0 0 -0.25" mass="MASS" diaginertia="0.004 0.004 0.0001"/>
        <joint name="hinge" axis="0 1 0" damping="0.001"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide" gear="15"/></actuator>
  <sensor><jointpos name="x" joint="slide"/><jointpos name="angle" joint="hinge"/></sensor>
</mujoco>"#;
/// m and rad
const NOISE: f64 = 2e-4;

fn file(xml: &str, (hole, value): (&str, &str)) -> ModelFile {
    ModelFile::of_text(xml.replace(hole, value), "m.xml").unwrap_or_else(|e| panic!("{e}"))
}

/// What `base` lacks of `machine`, of which two joints are read.
fn search(
    (base, machine): (&ModelFile, &ModelFile),
    bodies: &str,
    positions: [(&str, &str, f64); 2],
    motors: &[(&str, f64)],
) -> Answer {
    let record = |seed: u64| -> (String, Recording) {
        let motors: Vec<(&str, f64)> = (motors.iter())
            .map(|(name, phase)| (*name, phase + seed as f64))
            .collect();
        driven::record(&machine.model, seed, 4000, &positions, &motors)
    };
    let options = Options {
        max_effects: 1,
        ..Options::default()
    };
    let of: [&[_]; 2] = [&[record(1)], &[record(101)]];
    driven::search_with(base, bodies, of, (&options, &Settings::default())).answer
}

/// One effect was sought where two joints have it: the other was left, and said to be nothing known.
#[test]
fn friction_of_all_joints_is_one_effect() {
    let of = |dry: &str| file(CHAIN, ("DRY", dry));
    let positions = ["angle_a", "angle_b"].map(|name| (name, "rad", NOISE));
    let motors = [("drive_a", 0.0), ("drive_b", 0.5)];
    let answer = search((&of(""), &of(FRICTION)), "?", positions, &motors);
    let effects = answer.effects.iter();
    let mut found: Vec<(&str, &str)> =
        (effects.map(|e| (e.name.as_str(), e.at.as_str()))).collect();
    found.sort_unstable();
    let wanted = ["a", "b"].map(|at| ("coulomb_friction", at));
    assert_eq!(found, wanted, "{answer:#?}");
    for effect in &answer.effects {
        let level = &effect.parameters[0];
        assert!((level.value / 0.05 - 1.0).abs() < 0.05, "{effect:?}");
    }
    assert_eq!(answer.verdict, Verdict::Effect, "{answer:#?}");
}

/// How heavy it is and where it sits were not told apart, and with its mass as uncertain as that every effect of the
/// catalogue could have stood for it.
#[test]
fn an_effect_of_uncertain_size_is_told_from_others() {
    let of = |mass: &str| file(CART, ("MASS", mass));
    let positions = [("x", "m", NOISE), ("angle", "rad", NOISE)];
    let motors = [("push", 0.0)];
    let answer = search((&of("0.2"), &of("0.22")), "*", positions, &motors);
    let [effect] = &answer.effects[..] else {
        panic!("{answer:#?}");
    };
    assert_eq!(effect.at, "pole", "{effect:#?}");
    assert!(effect.class.len() < 4, "{effect:#?}");
    // states are without the noise of the readings, a velocity of 0.14 m/s, which had been 365 % of the forces
    let held = answer.gap.holdout.expect("held-out forces");
    assert!(held.after < 0.6 * held.before, "{held:?}");
    assert!(held.after < 2.0, "{held:?}");
}

#[test]
fn a_model_of_long_steps_is_said_to_have_them() {
    let machine = file(CART, ("MASS", "0.2"));
    let text = machine
        .xml
        .replace("timestep=\"0.001\"", "timestep=\"0.01\"");
    let base = ModelFile::of_text(text, "m.xml").unwrap_or_else(|e| panic!("{e}"));
    let positions = [("x", "m", 0.1 * NOISE), ("angle", "rad", 0.1 * NOISE)];
    let of = |base: &ModelFile| search((base, &machine), "*", positions, &[("push", 0.0)]);
    let said = |answer: &Answer| {
        answer
            .gap
            .notes
            .iter()
            .any(|n| n.starts_with("steps of 0.01 s"))
    };
    let long = of(&base);
    assert!(said(&long), "{long:#?}");
    let own = of(&machine);
    assert_eq!(
        (own.verdict, own.gap.notes.len()),
        (Verdict::None, 0),
        "{own:#?}"
    );
}
