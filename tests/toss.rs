//! What a model of a tumbling body lacks: hidden in simulated tosses, and found by whole rollouts.

mod common;

use std::ops::Range;
use std::sync::Arc;

use common::toss::Toss;
use phantom::compare::Settings;
use phantom::compare::settings::Drop;
use phantom::gap::effect::ModelFile;
use phantom::gap::result::Verdict;
use phantom::gap::{self, GapError, Input, Options};
use phantom::mujoco::Model;
use phantom::recording::Recording;
use phantom::sysid::problem::ProblemConfig;

/// Friction of the table, cone and half an edge of the cube.
fn xml(friction: f64, cone: &str, half: f64) -> String {
    format!(
        r#"<mujoco model="cube"><option timestep="0.002" cone="{cone}"/><worldbody>
  <geom name="table" type="plane" size="1 1 .1" friction="{friction} .005 .0001"/>
  <body name="cube" pos="0 0 .05"><freejoint name="cube"/><inertial pos="0 0 0" mass=".4" diaginertia="7e-4 7e-4 7e-4"/>
    <geom name="cube" type="box" size="{half} {half} {half}" friction="{friction} .005 .0001"/></body></worldbody></mujoco>"#
    )
}

/// Tosses until the cube lies still, with a tenth of a millimetre of noise.
fn tosses(hidden: &str, numbers: Range<u64>) -> Vec<(String, Recording)> {
    let toss = Toss {
        height_m: 0.25,
        steps: 650,
        every: 4,
        noise: 1e-4,
    };
    let model = Arc::new(Model::from_xml_str(hidden).expect("loads"));
    toss.record(&model, numbers)
}

fn search(hidden: &str, effects: &[&str]) -> Result<gap::Outcome, GapError> {
    let drop = Drop {
        joint: "cube".into(),
        below_m: 0.0866,
        free_flight: true,
    };
    search_by(hidden, effects, drop)
}

fn search_by(hidden: &str, effects: &[&str], drop: Drop) -> Result<gap::Outcome, GapError> {
    let model = ModelFile::of_text(xml(0.7, "pyramidal", 0.05), "cube.xml").expect("loads");
    let protocol = Settings {
        forces: false,
        horizons_s: vec![],
        to_end: true,
        length_m: Some(0.1),
        drop: Some(drop),
        ..Settings::default()
    };
    let input = Input {
        model: &model,
        config: &ProblemConfig::default(),
        train: &tosses(hidden, 0..22),
        holdout: &tosses(hidden, 22..34),
        protocol: &protocol,
    };
    let options = Options {
        effects: effects.iter().map(|e| (*e).to_owned()).collect(),
        ..Options::default()
    };
    gap::run(&input, &options, &mut |_, _, _| true)
}

const EFFECTS: [&str; 3] = ["contact_friction", "friction_cone", "length_scale"];

#[test]
fn friction_cone_and_size_of_a_tossed_cube_are_named() {
    let outcome = search(&xml(0.25, "elliptic", 0.049), &EFFECTS).expect("searched");
    let answer = &outcome.answer;
    let value = |name: &str| {
        let found = answer.effects.iter().find(|e| e.name == name);
        let found = found.unwrap_or_else(|| panic!("{name} not found: {:?}", answer.effects));
        (found.parameters[0].value, found.parameters[0].ci95)
    };
    let friction = 0.7 * (1.0 + value("contact_friction").0);
    assert!((friction - 0.25).abs() < 0.02, "{friction}");
    value("friction_cone");
    let (share, ci95) = value("length_scale");
    assert!((share + 0.02).abs() < 1e-3, "{share}");
    assert!(
        ci95.is_some_and(|[low, high]| low < -0.0195 && high > -0.0205),
        "{ci95:?}"
    );
    let gap = answer.gap.holdout.as_ref().expect("held out");
    assert!(gap.after < 0.4 * gap.before, "{gap:?}");
    let repaired = Model::from_xml_str(&outcome.model).expect("loads");
    assert_eq!(repaired.option().cone, phantom::mujoco::Cone::Elliptic);
}

#[test]
fn of_a_cube_as_in_the_model_nothing_is_found() {
    let outcome = search(&xml(0.7, "pyramidal", 0.05), &EFFECTS).expect("searched");
    assert_eq!(
        outcome.answer.verdict,
        Verdict::None,
        "{:?}",
        outcome.answer.effects
    );
}

#[test]
fn what_never_falls_is_refused() {
    let refused = |joint: &str, below_m: f64, what: &str| {
        let drop = Drop {
            joint: joint.into(),
            below_m,
            free_flight: true,
        };
        let error = search_by(&xml(0.7, "pyramidal", 0.05), &EFFECTS, drop).expect_err(what);
        assert!(error.to_string().contains(what), "{error}");
    };
    refused("cube", 0.01, "never falls");
    refused("die", 0.0866, "die");
}
