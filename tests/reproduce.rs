//! The paper's experiments in small: every table and figure, and runs that go on where they were stopped.

mod common;

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use phantom::policy::AffineGaussian;
use phantom::run_dir;
use phantom::train::Trainer;
use phantom::train::config::TrainConfig;
use phantom::train::folder::{FolderError, train_in};
use serde_json::Value;

const MODEL: &str = "xml/phantom.xml";
const SMALL: &str = "[train]\ntrajectories = 16\ntrajectory_s = 0.1\nevaluate_every = 0\n";
/// Coarse, so that a rollout takes a moment.
const RIG: &str = "[physics]\nsubsteps = 1\n[sensing]\nmocap_sigma_m = 1e-4\n";

fn small(iterations: u64) -> TrainConfig {
    let mut config: TrainConfig = toml::from_str(SMALL).expect("valid");
    config.train.iterations = iterations;
    config
}

fn trainer(config: TrainConfig) -> Trainer {
    Trainer::new(common::phantom_model(), config, 2).expect("a trainer")
}

fn train(folder: &Path, config: TrainConfig) -> Result<Option<AffineGaussian>, FolderError> {
    train_in(folder, Path::new(MODEL), trainer(config), &mut |_, _| true)
}

#[test]
fn a_run_that_was_stopped_goes_on_to_the_same_bits() {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, parts) = (folder.path().join("whole"), folder.path().join("parts"));
    let expected = train(&whole, small(3))
        .expect("trains")
        .expect("to its end");
    let stopped = train_in(
        &parts,
        Path::new(MODEL),
        trainer(small(3)),
        &mut |record, _| record.iteration < 2,
    );
    assert!(
        stopped.expect("trains").is_none(),
        "stopped is not finished"
    );
    let got = train(&parts, small(3))
        .expect("goes on")
        .expect("to its end");
    assert_eq!(got.parameters(), expected.parameters());
    let rows = fs::read_to_string(parts.join("metrics.csv")).expect("metrics");
    assert_eq!(rows.lines().count(), 4, "each iteration once");
    // a finished run is not touched
    let before = fs::read(parts.join("checkpoint.json")).expect("a checkpoint");
    let again = train_in(&parts, Path::new(MODEL), trainer(small(3)), &mut |_, _| {
        panic!("there is nothing left to do")
    });
    assert_eq!(again.expect("is there").expect("finished"), got);
    assert_eq!(
        fs::read(parts.join("checkpoint.json")).expect("still"),
        before
    );
}

#[test]
fn another_run_in_the_folder_is_not_taken_for_this_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = folder.path().join("run");
    train(&run, small(1)).expect("trains");
    let mut other = small(2);
    other.train.object_mass_kg = Some(0.4);
    let message = train(&run, other).expect_err("other settings").to_string();
    assert!(
        message.contains("config.toml") && message.contains("other settings"),
        "{message}"
    );
    // killed before its first checkpoint: begun anew
    fs::remove_file(run.join("checkpoint.json")).expect("there was one");
    assert!(train(&run, small(1)).expect("trains").is_some());
}

#[test]
fn a_run_can_begin_with_a_policy() {
    let config = small(1);
    let floor = config.npg.initial_log_sigma;
    let mut warm = trainer(config.clone());
    let mut policy = warm.checkpoint().policy.clone();
    let n = policy.n_parameter();
    policy
        .set_parameters(&[vec![0.01; n - 9], vec![-2.5; 9]].concat())
        .expect("the right length");
    warm.begin_with(policy).expect("fits");
    let begun = &warm.checkpoint().policy;
    assert!(begun.weights().iter().all(|w| *w == 0.01));
    assert!(
        begun.log_sigma().iter().all(|l| *l == floor),
        "explores again"
    );
    assert!(
        trainer(config)
            .begin_with(AffineGaussian::zeros(2, 9, -1.0))
            .is_err()
    );
}

/// Runs the program in `folder`.
fn reproduce(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_phantom"))
        .current_dir(folder)
        .env("PHANTOM_ROOT", env!("CARGO_MANIFEST_DIR"))
        .arg("reproduce")
        .args(args)
        .output()
        .expect("the program starts")
}

#[test]
fn every_table_and_figure_is_made_from_policies_trained_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    fs::write(path.join("small.toml"), SMALL).expect("writable");
    fs::write(path.join("rig.toml"), RIG).expect("writable");
    let common = [
        "--config",
        "small.toml",
        "--rig",
        "rig.toml",
        "--seeds",
        "1",
        "--rollouts",
        "1",
        "--out",
        "study",
    ];
    let run = |what: &str, iterations: &str| {
        let args = [&[what, "--iterations", iterations][..], &common].concat();
        let output = reproduce(path, &args);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{what}: {error}");
    };
    run("all", "2");
    let study = path.join("study");
    let page = fs::read_to_string(study.join("all.html")).expect("a page");
    let captions = page.matches("stands in for the paper").count();
    assert!(
        captions >= 4,
        "table, spiral, forces, rollouts say so: {captions}"
    );
    for name in ["masses", "spiral", "curve", "heatmap", "forces", "rollouts"] {
        let svg = fs::read_to_string(study.join(format!("{name}.svg"))).expect(name);
        assert!(
            svg.starts_with("<svg") && page.contains(&svg),
            "{name} is in the page"
        );
        if let Ok(png) = fs::read(study.join(format!("{name}.png"))) {
            assert!(png.starts_with(b"\x89PNG") && png.len() > 5000, "{name}");
        }
    }
    let written: Value = run_dir::read_json(&study.join("all.json")).expect("figures as JSON");
    let rows = written["table1"].as_array().expect("rows");
    assert_eq!(rows.len(), 3);
    for row in rows {
        // two updates teach nothing: the object hardly leaves the origin, 3 cm from the target on average
        for key in ["simulation_cm", "machine_cm"] {
            let cm = row[key].as_f64().expect("a number");
            assert!((1.0..10.0).contains(&cm), "{key} {cm}");
        }
    }

    let run_folder = study.join("policies/ensemble-seed0");
    let read = |name: &str| fs::read(run_folder.join(name)).expect(name);
    let (checkpoint, provenance) = (read("checkpoint.json"), read("provenance.json"));
    run("heatmap", "2");
    assert_eq!(read("checkpoint.json"), checkpoint, "not trained again");
    run("curve", "3");
    assert_ne!(read("checkpoint.json"), checkpoint, "trained on");
    assert_eq!(read("provenance.json"), provenance, "in the same run");
}

#[test]
fn bad_requests_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    fs::write(folder.path().join("rig.toml"), "[physics]\nsubsteps = 0\n").expect("writable");
    fs::write(folder.path().join("small.toml"), SMALL).expect("writable");
    for (args, part) in [
        (vec!["table2"], "table2"),
        (vec!["table1", "--rig", "missing.toml"], "missing.toml"),
        (vec!["table1", "--seeds", "0"], "--seeds"),
        (
            vec![
                "spiral",
                "--rig",
                "rig.toml",
                "--config",
                "small.toml",
                "--seeds",
                "1",
                "--iterations",
                "1",
            ],
            "physics.substeps",
        ),
    ] {
        let output = reproduce(folder.path(), &args);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{args:?}: {message}");
        assert!(message.contains(part), "{args:?}: {message}");
    }
}
