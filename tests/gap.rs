//! What a model lacks: hidden in simulated recordings, and found.

mod common;

use std::sync::Arc;

use common::driven::{self, FRICTION, channel, config};
use common::program::succeeds;
use phantom::compare::Settings;
use phantom::gap::effect::ModelFile;
use phantom::gap::result::Verdict;
use phantom::gap::{self, GapError, Input, Keeper, Options, Outcome, figures};
use phantom::mujoco::{Data, Model, ObjectKind};
use phantom::recording::{Kind, Meta, Recording, Stream};
use phantom::sysid::problem::ProblemConfig;

/// A pendulum with a motor; `HIDDEN` stands for attributes of its joint.
const MACHINE: &str = r#"<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001"/>
  <worldbody>
    <!-- hangs -->
    <body name="link">
      <inertial pos="0 0 -0.3" mass="0.4" diaginertia="0.004 0.004 0.004"/>
      <joint name="hinge" axis="0 1 0" HIDDEN/>
    </body>
  </worldbody>
  <actuator>
    <motor name="drive" joint="hinge"/>
  </actuator>
  <sensor>
    <jointpos name="angle" joint="hinge"/>
  </sensor>
</mujoco>"#;
/// rad
const NOISE: f64 = 5e-5;

fn file(hidden: &str) -> ModelFile {
    let xml = MACHINE.replace(" HIDDEN", &format!(" {hidden}"));
    ModelFile::of_text(xml, "machine.xml").unwrap_or_else(|e| panic!("{e}"))
}

/// Eight seconds of a machine under several sines.
fn record(hidden: &str, seed: u64) -> (String, Recording) {
    let motors = [("drive", seed as f64)];
    let positions = [("angle", "rad", NOISE)];
    driven::record(&file(hidden).model, seed, 8000, &positions, &motors)
}

fn search(hidden: &str, seed: u64) -> Outcome {
    let (train, holdout) = ([record(hidden, seed)], [record(hidden, seed + 100)]);
    driven::search(&file(""), "link", &train, &holdout)
}

#[test]
fn hidden_friction_is_found_named_and_added() {
    let outcome = search(FRICTION, 1);
    let answer = &outcome.answer;
    let names: Vec<&str> = answer.effects.iter().map(|e| e.name.as_str()).collect();
    assert_eq!(names, ["coulomb_friction"], "{answer:#?}");
    let effect = &answer.effects[0];
    assert_eq!((effect.at.as_str(), effect.expressed_as), ("hinge", "mjcf"));
    let level = &effect.parameters[0];
    assert!((level.value / 0.05 - 1.0).abs() < 0.05, "{level:?}");
    let [low, high] = level.ci95.expect("an interval");
    assert!(low < level.value && level.value < high);
    assert!(effect.p_value < 0.01 && effect.probability > 0.5);
    // located where it acts, both ways
    assert!(
        answer
            .located
            .iter()
            .any(|l| l.phase.contains("forwards") && l.mean < 0.0)
    );
    assert!(
        answer
            .located
            .iter()
            .any(|l| l.phase.contains("backwards") && l.mean > 0.0)
    );
    // the gap shrinks and nothing becomes worse
    let held = answer.gap.holdout.as_ref().expect("held-out forces");
    assert!(held.after < 0.3 * held.before, "{held:?}");
    assert!(answer.gap.rollout.iter().all(|r| r.after < 0.3 * r.before));
    assert!(answer.gap.worse.is_empty(), "{:?}", answer.gap.worse);
    // simulated and searched again, it lacks nothing
    let again = answer.round_trip.as_ref().expect("a round trip");
    assert!(again.found.is_empty(), "{again:?}");
    assert!(
        again.returned.len() == 1 && again.returned[0].is_inside(),
        "{again:?}"
    );
    // the repaired file keeps its comment, loads, and has the friction
    assert!(outcome.model.contains("<!-- hangs -->"));
    let repaired = ModelFile::of_text(outcome.model.clone(), "machine.xml").expect("it loads");
    // the number and the value differ by the rounding of origin + slope × value
    let written = repaired.model.dof_frictionloss()[0];
    assert!((written / level.value - 1.0).abs() < 1e-12, "{written}");
    // the same seed gives the same report
    let again = search(FRICTION, 1);
    let page = |o: &Outcome| {
        let diff = gap::diff::diff(&file("").xml, &o.model, "machine.xml");
        figures::report("report", o, &diff).html().expect("a page")
    };
    assert_eq!(page(&outcome), page(&again));
    draws_without_network(&page(&outcome), "coulomb_friction");
}

/// Two seconds of the finger, read by encoders.
fn record_finger(model: &Arc<Model>, seed: u64) -> (String, Recording) {
    const MOTORS: [&str; 3] = ["p0_m1", "p0_m2", "p0_m3"];
    const JOINTS: [&str; 3] = ["p0_turret", "p0_upper", "p0_crank"];
    const MIDDLE_RAD: [f64; 3] = [0.0, -0.15, 0.05];
    const STEP_RAD: f64 = 2e-4;
    let mut data = Data::new(Arc::clone(model)).expect("data");
    let sigma = STEP_RAD / 12_f64.sqrt();
    let positions = JOINTS.map(|j| channel(&format!("{j}_pos"), Kind::Sensor, "rad", Some(sigma)));
    let motors = MOTORS.map(|m| channel(m, Kind::Control, "N m", None));
    let mut stream = Stream::new("all", Some(2000.0), [positions, motors].concat());
    for k in 0..4000_i64 {
        let t = k as f64 * 5e-4;
        let mut row = Vec::new();
        let mut torques = Vec::new();
        for (i, joint) in JOINTS.iter().enumerate() {
            let joint = model.id(ObjectKind::Joint, joint).expect("a joint");
            let dof = model.jnt_dofadr()[joint] as usize;
            let angle = data.qpos()[model.jnt_qposadr()[joint] as usize];
            row.push((angle / STEP_RAD).floor() * STEP_RAD + 0.5 * STEP_RAD);
            // held off its stops by a controller
            let phase = (seed as usize * 3 + i) as f64;
            let wanted = MIDDLE_RAD[i]
                + 0.12 * (6.0 * t + phase).sin()
                + 0.04 * (23.0 * t + 2.0 * phase).sin();
            torques.push(4.0 * (wanted - angle) - 0.1 * data.qvel()[dof]);
        }
        data.ctrl_mut().copy_from_slice(&torques);
        row.extend(torques);
        stream.push(k * 500_000, &row);
        data.step().expect("step");
    }
    let meta = Meta::default();
    let streams = vec![stream];
    (format!("finger {seed}"), Recording { meta, streams })
}

/// First states of a machine with loops once ran off along what the loops forbid; friction then lost against a motor
/// that saturates.
#[test]
fn friction_of_a_machine_with_loops_is_named() {
    let text = std::fs::read_to_string("xml/finger.xml").expect("the shipped finger");
    let base = ModelFile::of_text(text.clone(), "finger.xml").unwrap_or_else(|e| panic!("{e}"));
    let joint = r#"<joint name="p0_upper" class="upper""#;
    assert!(text.contains(joint));
    let rubs = format!(
        r#"{joint} frictionloss="0.02" solreffriction="0.001 1" solimpfriction="0.99 0.99 0.001""#
    );
    let truth = Arc::new(Model::from_xml_str(&text.replace(joint, &rubs)).expect("a model"));
    let train = [1, 2, 3, 4].map(|seed| record_finger(&truth, seed));
    let holdout = [record_finger(&truth, 9)];
    let config = toml::from_str(
        // the engine's own steps: half a step between command and motion is friction of 0.3 mN m to the turret
        "command = \"held\"\n[[parameter]]\nelement = \"body/p0_forearm\"\nattribute = \"mass\"\nprior_sigma = 0.1\n",
    )
    .expect("a configuration");
    let input = Input {
        model: &base,
        config: &config,
        train: &train,
        holdout: &holdout,
        protocol: &Settings::default(),
    };
    let effects = ["coulomb_friction", "torque_saturation", "rotor_inertia"];
    let options = Options {
        effects: effects.map(String::from).to_vec(),
        ..Options::default()
    };
    let outcome = gap::run(&input, &options, &mut |_, _, _| true).unwrap_or_else(|e| panic!("{e}"));
    let found = &outcome.answer.effects;
    assert_eq!(found.len(), 1, "{:#?}", outcome.answer);
    assert_eq!(
        (found[0].name.as_str(), found[0].at.as_str()),
        ("coulomb_friction", "p0_upper")
    );
    let level = &found[0].parameters[0];
    assert!((level.value / 0.02 - 1.0).abs() < 0.002, "{level:?}");
}

/// Stages in memory.
#[derive(Default, Clone)]
struct Kept(std::collections::BTreeMap<String, Vec<u8>>);

impl Keeper for Kept {
    fn load(&mut self, stage: &str) -> Option<Vec<u8>> {
        self.0.get(stage).cloned()
    }

    fn save(&mut self, stage: &str, bytes: &[u8]) {
        self.0.insert(stage.into(), bytes.to_vec());
    }
}

#[test]
fn a_search_goes_on_from_its_finished_stages() {
    let (model, config) = (file(""), config("link"));
    let (train, holdout) = ([record(FRICTION, 1)], [record(FRICTION, 101)]);
    let input = Input {
        model: &model,
        config: &config,
        train: &train,
        holdout: &holdout,
        protocol: &Settings::default(),
    };
    let options = Options::default();
    let run = |kept: &mut Kept| {
        let mut fits = 0;
        let outcome = gap::resume(&input, &options, kept, &mut |stage, note, _| {
            fits += usize::from(stage == gap::Stage::Fit && note.contains("cost"));
            true
        });
        (outcome.unwrap_or_else(|e| panic!("{e}")), fits)
    };
    let mut all = Kept::default();
    let (whole, fits) = run(&mut all);
    assert!(fits > 0);
    let stages: Vec<&str> = all.0.keys().map(String::as_str).collect();
    assert_eq!(stages, ["effect-1", "effect-2", "fit", "screen"]);
    for killed_after in [
        &["fit"][..],
        &["fit", "screen", "effect-1"],
        stages.as_slice(),
    ] {
        let mut some = all.clone();
        some.0
            .retain(|stage, _| killed_after.contains(&stage.as_str()));
        let (again, fits) = run(&mut some);
        assert_eq!(
            (again.answer, again.model),
            (whole.answer.clone(), whole.model.clone())
        );
        assert_eq!(fits, 0, "the base model is fitted again");
    }
    // a stage that was cut short is done again
    let mut broken = all.clone();
    if let Some(bytes) = broken.0.get_mut("fit") {
        bytes.truncate(100);
    }
    let (again, fits) = run(&mut broken);
    assert_eq!(again.model, whole.model);
    assert!(fits > 0);
    // other inputs have another key
    let other = Options {
        seed: 1,
        ..options.clone()
    };
    assert_ne!(gap::key(&input, &options), gap::key(&input, &other));
    let fewer = Input {
        holdout: &[],
        ..input
    };
    assert_ne!(gap::key(&input, &options), gap::key(&fewer, &options));
}

#[test]
fn where_nothing_is_hidden_nothing_is_found() {
    for seed in 1..4 {
        let answer = search("", seed).answer;
        assert_eq!(answer.verdict, Verdict::None, "{seed}: {answer:#?}");
        assert!(answer.effects.is_empty());
    }
}

/// The zero of an encoder once went 20 standard deviations of its prior in the first step, and windows held it there.
#[test]
fn a_fit_from_afar_comes_to_the_noise() {
    let dir = tempfile::tempdir().expect("a directory");
    let root = |path: &str| format!("{}/{path}", env!("CARGO_MANIFEST_DIR"));
    let rig = root("rigs/finger.toml");
    succeeds(
        dir.path(),
        &[
            "record",
            "--rig",
            &rig,
            "--behaviour",
            "reversals",
            "--seconds",
            "3",
            "--seed",
            "9502",
            "--out",
            "f.mcap",
        ],
    );
    let (model, parameters) = (root("xml/finger.xml"), root("parameters/finger.toml"));
    succeeds(
        dir.path(),
        &[
            "gap",
            "--model",
            &model,
            "--parameters",
            &parameters,
            "--train",
            "f.mcap",
            "--effects",
            "torque_offset",
            "--out",
            "gap",
        ],
    );
    let json = std::fs::read_to_string(dir.path().join("gap/gap.json")).expect("written");
    let answer: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    let left = answer["remaining"]["after"].as_f64().expect("a number");
    assert!(left < 5e-4, "{left}"); // once 0.0054
}

#[test]
fn inputs_that_cannot_work_say_what_to_do() {
    let (model, config) = (file(""), config("link"));
    let train = [record("", 1)];
    let refused =
        |config: &ProblemConfig, options: &Options, recordings: &[(String, Recording)]| {
            let input = Input {
                model: &model,
                config,
                train: recordings,
                holdout: &[],
                protocol: &Settings::default(),
            };
            match gap::run(&input, options, &mut |_, _, _| true) {
                Err(error @ GapError::Input { .. }) => error.to_string(),
                other => panic!("{other:?}"),
            }
        };
    let only = |name: &str| Options {
        effects: vec![name.into()],
        ..Options::default()
    };
    // an effect that does not exist, and one that has no place in the model
    let message = refused(&config, &only("friction"), &train);
    assert!(
        message.contains("no effect `friction`") && message.contains("coulomb_friction"),
        "{message}"
    );
    let message = refused(&config, &only("friction_cone"), &train);
    assert!(
        message.contains("cannot carry the effect `friction_cone`"),
        "{message}"
    );
    // a machine at rest says nothing of its mass
    let mut still = record("", 1);
    for value in &mut still.1.streams[0].values {
        *value = 0.0;
    }
    let free: ProblemConfig =
        toml::from_str("[[parameter]]\nelement = \"body/link\"\nattribute = \"mass\"\n")
            .expect("a configuration");
    let message = refused(&free, &Options::default(), &[still]);
    assert!(
        message.contains("excitation") && message.contains("link"),
        "{message}"
    );
}

fn draws_without_network(html: &str, word: &str) {
    let Some(dom) = common::browser::dom(html) else {
        return;
    };
    assert!(dom.contains(word), "{dom:.2000}");
    assert!(dom.contains("data-drawn"), "no chart was drawn");
}

#[test]
fn held_out_recordings_of_another_machine_are_refused() {
    let (model, config) = (file(""), config("link"));
    let train = [record("", 1)];
    let mut other = record("", 2);
    let run = |train: &[(String, Recording)], holdout: &[(String, Recording)]| {
        let input = Input {
            model: &model,
            config: &config,
            train,
            holdout,
            protocol: &Settings::default(),
        };
        gap::run(&input, &Options::default(), &mut |_, _, _| true)
    };
    let mut marked = train.clone();
    marked[0].1.meta.model_hash = "a".into();
    other.1.meta.model_hash = "b".into();
    let error = run(&marked, std::slice::from_ref(&other)).expect_err("two models");
    assert!(error.to_string().contains("of another model"), "{error}");
    other.1.meta.model_hash.clear();
    other.1.streams[0].channels[1].name = "engine".into();
    let error = run(&train, &[other]).expect_err("no control");
    assert!(error.to_string().contains("drive"), "{error}");
    // stopped from outside
    let input = Input {
        model: &model,
        config: &config,
        train: &train,
        holdout: &[],
        protocol: &Settings::default(),
    };
    let stopped = gap::run(&input, &Options::default(), &mut |stage, _, _| {
        stage != gap::Stage::Screen
    });
    assert!(matches!(stopped, Err(GapError::Stopped)));
}
