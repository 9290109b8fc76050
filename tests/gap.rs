//! What a model lacks: hidden in simulated recordings, and found.
#![allow(clippy::print_stdout)] // what was skipped

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use phantom::compare::Settings;
use phantom::gap::effect::ModelFile;
use phantom::gap::result::Verdict;
use phantom::gap::{self, GapError, Input, Options, Outcome, figures};
use phantom::mujoco::Data;
use phantom::recording::{Channel, Kind, Meta, Recording, Stream};
use phantom::rng::{self, Purpose};
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
const FRICTION: &str =
    r#"frictionloss="0.05" solreffriction="0.002 1" solimpfriction="0.99 0.99 0.001""#;
/// rad
const NOISE: f64 = 5e-5;

fn file(hidden: &str) -> ModelFile {
    let xml = MACHINE.replace(" HIDDEN", &format!(" {hidden}"));
    ModelFile::of_text(xml, "machine.xml").unwrap_or_else(|e| panic!("{e}"))
}

/// Eight seconds of a machine under several sines.
fn record(hidden: &str, seed: u64) -> (String, Recording) {
    let model = file(hidden).model;
    let mut data = Data::new(Arc::clone(&model)).expect("data");
    let mut rng = rng::stream(seed, Purpose::SensorNoise, 0, 0);
    let channel = |name: &str, kind, unit: &str, noise_sigma| Channel {
        name: name.into(),
        kind,
        unit: unit.into(),
        noise_sigma,
    };
    let mut stream = Stream::new(
        "all",
        Some(1000.0),
        vec![
            channel("angle", Kind::Sensor, "rad", Some(NOISE)),
            channel("drive", Kind::Control, "N m", None),
        ],
    );
    let phase = seed as f64;
    for k in 0..8000_i64 {
        let t = k as f64 * 1e-3;
        let torque = 0.4 * (3.1 * t + phase).sin()
            + 0.3 * (7.3 * t + 2.0 * phase).sin()
            + 0.1 * (23.0 * t + phase).sin();
        let angle = data.qpos()[0] + NOISE * rng::normal(&mut rng);
        stream.push(k * 1_000_000, &[angle, torque]);
        data.ctrl_mut()[0] = torque;
        data.step().expect("step");
    }
    let recording = Recording {
        meta: Meta::default(),
        streams: vec![stream],
    };
    (format!("{seed}"), recording)
}

fn config() -> ProblemConfig {
    toml::from_str(
        "[[parameter]]\nelement = \"body/link\"\nattribute = \"mass\"\nprior_sigma = 0.1\n",
    )
    .expect("a configuration")
}

fn search(hidden: &str, seed: u64) -> Outcome {
    let (model, config) = (file(""), config());
    let (train, holdout) = ([record(hidden, seed)], [record(hidden, seed + 100)]);
    let input = Input {
        model: &model,
        config: &config,
        train: &train,
        holdout: &holdout,
        protocol: &Settings {
            cutoff_hz: Some(30.0),
            ..Settings::default()
        },
    };
    gap::run(&input, &Options::default(), &mut |_, _, _| true).unwrap_or_else(|e| panic!("{e}"))
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
    // the repaired file keeps its comment, loads, and has the friction
    assert!(outcome.model.contains("<!-- hangs -->"));
    let repaired = ModelFile::of_text(outcome.model.clone(), "machine.xml").expect("it loads");
    assert_eq!(repaired.model.dof_frictionloss()[0], level.value);
    // the same seed gives the same report
    let again = search(FRICTION, 1);
    let page = |o: &Outcome| {
        let diff = figures::diff(&file("").xml, &o.model, "machine.xml");
        figures::report("report", o, &diff).html().expect("a page")
    };
    assert_eq!(page(&outcome), page(&again));
    opens_without_network(&page(&outcome), "coulomb_friction");
}

#[test]
fn where_nothing_is_hidden_nothing_is_found() {
    for seed in 1..4 {
        let answer = search("", seed).answer;
        assert_eq!(answer.verdict, Verdict::None, "{seed}: {answer:#?}");
        assert!(answer.effects.is_empty());
    }
}

/// Opens a page in a browser that cannot resolve any host, and looks for a word.
fn opens_without_network(html: &str, word: &str) {
    let paths = std::env::var_os("PATH").unwrap_or_default();
    let mut found = std::env::split_paths(&paths).map(|folder| folder.join("chromium"));
    let Some(browser) = found.find(|path: &PathBuf| path.is_file()) else {
        println!("skipped: no chromium (Debian package `chromium`)");
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let page: &Path = &folder.path().join("report.html");
    std::fs::write(page, html).expect("written");
    let output = Command::new(browser)
        .args([
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
        ])
        .args([
            "--host-resolver-rules=MAP * ~NOTFOUND",
            "--virtual-time-budget=10000",
        ])
        .arg(format!(
            "--user-data-dir={}",
            folder.path().join("profile").display()
        ))
        .arg("--dump-dom")
        .arg(format!("file://{}", page.display()))
        .output()
        .expect("the browser runs");
    let dom = String::from_utf8_lossy(&output.stdout);
    assert!(dom.contains(word), "{dom:.2000}");
    assert!(dom.contains("data-drawn"), "no chart was drawn");
}

#[test]
fn held_out_recordings_of_another_machine_are_refused() {
    let (model, config) = (file(""), config());
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
