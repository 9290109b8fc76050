//! The program with supplemented models: training, evaluation, rigs, comparisons.

use std::sync::Arc;

use phantom::compare::{self, Settings};
use phantom::mjcf::structure::{Change, change};
use phantom::mujoco::Model;
use phantom::recording::Recording;
use phantom::rig::{Rig, RigConfig, Trial, behaviour};
use phantom::supplement;

use crate::common::program::{phantom, succeeds};

fn shipped() -> String {
    std::fs::read_to_string("xml/phantom.xml").expect("the shipped model")
}

/// The shipped model with one law of each sort.
fn supplemented() -> String {
    let numeric = |name: &str, data: &[f64]| Change::Numeric {
        name: format!("phantom:{name}"),
        data: data.to_vec(),
    };
    let level = Change::Attribute {
        kind: "joint",
        element: "p0_turret".to_owned(),
        attribute: "frictionloss",
        value: "0.01".to_owned(),
    };
    let changes = [
        level,
        Change::Room { rows: 1 },
        numeric("stribeck_friction:p0_turret", &[0.03, 0.2]),
        numeric("actuator_lag:p0_m2", &[0.004]),
        numeric("actuator_delay:p1_m1", &[0.0023]),
        numeric("transmission_compliance:p1_m2", &[0.004, 0.3]),
        numeric("quadratic_drag:p2_turret", &[0.02]),
        numeric("encoder_offset:p2_crank", &[0.03]),
        numeric("encoder_scale:p0_crank", &[0.04]),
        numeric("sensor_delay:encoders", &[0.0015]),
        numeric("torsional_friction:p0_object", &[0.005, 0.1]),
        numeric("force_sensor_bias:p0_force", &[0.1, 0.2, -0.1]),
    ];
    change(&shipped(), &changes).expect("changed")
}

fn model(text: &str) -> Model {
    supplement::load_text(text, "xml/phantom.xml").unwrap_or_else(|e| panic!("{e}"))
}

/// Train, test, record and compare on the command line: with the supplement all results differ, and nothing else is
/// needed than the model file.
#[test]
fn a_supplemented_model_just_works() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path();
    let write = |name: &str, text: &str| std::fs::write(path.join(name), text).expect("written");
    write("plain.xml", &shipped());
    write("more.xml", &supplemented());
    write(
        "small.toml",
        "[train]\niterations = 1\ntrajectories = 8\ntrajectory_s = 0.05\nevaluate_every = 0\n",
    );
    let mut seen = Vec::new();
    for name in ["plain", "more"] {
        let (xml, out) = (format!("{name}.xml"), format!("run_{name}"));
        succeeds(
            path,
            &[
                "train",
                "--config",
                "small.toml",
                "--model",
                &xml,
                "--out",
                &out,
            ],
        );
        let metrics =
            std::fs::read_to_string(path.join(&out).join("metrics.csv")).expect("metrics");
        let policy = "run_plain/policy_last.json";
        let (json, steps) = (format!("{name}.json"), format!("{name}.csv"));
        let eval = [
            "eval",
            "--policy",
            policy,
            "--model",
            &xml,
            "--rollouts",
            "1",
            "--json",
            &json,
            "--steps",
            &steps,
        ];
        succeeds(path, &eval);
        let distance = std::fs::read_to_string(path.join(&json)).expect("result");
        write(
            "rig.toml",
            &format!("model = \"{xml}\"\n[physics]\nsubsteps = 1\n"),
        );
        let mcap = format!("{name}.mcap");
        let record = [
            "record",
            "--rig",
            "rig.toml",
            "--behaviour",
            "multi_sine",
            "--seconds",
            "0.2",
            "--out",
            &mcap,
        ];
        succeeds(path, &record);
        succeeds(
            path,
            &[
                "compare",
                &mcap,
                "--model",
                &xml,
                "--out",
                &format!("out_{name}"),
            ],
        );
        seen.push([
            metrics,
            distance,
            std::fs::read_to_string(path.join(format!("out_{name}/compare.json"))).expect("json"),
        ]);
    }
    for (what, (plain, more)) in ["train", "eval", "compare"]
        .iter()
        .zip(seen[0].iter().zip(&seen[1]))
    {
        assert_ne!(plain, more, "{what}");
    }
    write(
        "bad.xml",
        &supplemented().replace("quadratic_drag", "cubic_drag"),
    );
    for command in [
        vec![
            "train",
            "--config",
            "small.toml",
            "--model",
            "bad.xml",
            "--out",
            "bad",
        ],
        vec![
            "eval",
            "--policy",
            "run_plain/policy_last.json",
            "--model",
            "bad.xml",
        ],
        vec!["compare", "more.mcap", "--model", "bad.xml", "--out", "bad"],
    ] {
        let output = phantom(path, &command);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        let expected =
            "bad.xml: custom element `phantom:cubic_drag:p2_turret`: there is no kind `cubic_drag`";
        assert!(message.contains(expected), "{message}");
    }
}

/// An ideal rig whose truth is the model at its own step.
fn recording(text: &str) -> Recording {
    // without this low-pass the controller shakes the light rotor behind the spring
    let config = "[physics]\nsubsteps = 1\n[sensing]\nvelocity_cutoff_hz = 100\n";
    let config: RigConfig = toml::from_str(config).expect("a rig file");
    let rig = Rig::new(model(text), config).expect("a rig");
    let trial = Trial {
        number: 0,
        label: "reversals".to_owned(),
        seconds: 2.0,
    };
    let entry = behaviour::entry("reversals").expect("a behaviour");
    let mut behaviour = rig.behaviour(entry, &trial).expect("it fits");
    let outcome = rig
        .record(behaviour.as_mut(), &trial, |_| {})
        .expect("recorded");
    assert_eq!(outcome.diverged, None);
    outcome.recording
}

/// A machine like the supplemented model is explained by it, and not by the plain model: states are found behind
/// encoders, motors and delays, forces agree, rollouts stay close.
#[test]
fn comparison_sees_through_encoders_and_transmissions() {
    let recording = recording(&supplemented());
    let settings = Settings {
        horizons_s: vec![0.05],
        differences: true,
        ..Settings::default()
    };
    let compared = |text: &str| {
        let model = Arc::new(model(text));
        compare::compare(
            &model,
            std::slice::from_ref(&recording),
            &settings,
            None,
            &|| {},
        )
        .expect("compared")
    };
    let (more, plain) = (compared(&supplemented()), compared(&shipped()));
    let deviation = |c: &compare::Comparison, joint: &str| {
        let growth = c.rollouts.growth.iter().find(|g| g.channel == joint);
        growth.expect("a channel").end_rms
    };
    for joint in [
        "p0_turret",
        "p0_upper",
        "p0_crank",
        "p1_turret",
        "p1_upper",
        "p2_turret",
    ] {
        let (with, without) = (deviation(&more, joint), deviation(&plain, joint));
        assert!(with < 0.2 * without, "{joint}: {with:e} {without:e}");
    }
    let rms = |c: &compare::Comparison, name: &str| {
        let signal = c.forces[0].signals.iter().find(|s| s.name == name);
        signal.expect("a signal").rms
    };
    for joint in [
        "p0_turret",
        "p0_upper",
        "p1_turret",
        "p2_turret",
        "p2_crank",
    ] {
        let (with, without) = (rms(&more, joint), rms(&plain, joint));
        assert!(with < 0.3 * without, "{joint}: {with:e} {without:e}");
    }
}
