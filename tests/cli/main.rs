//! The built program: exit codes, messages, files.

#[path = "../common/mod.rs"]
mod common;
mod refused;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::program::phantom;

const SMALL: &str =
    "[train]\niterations = 2\ntrajectories = 16\ntrajectory_s = 0.1\nevaluate_every = 0\n";

fn model() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("xml/phantom.xml")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs it, expects exit code 2 and one sentence on standard error that contains all of `parts`.
fn refuses(folder: &Path, args: &[&str], parts: &[&str]) {
    let output = phantom(folder, args);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{args:?}: {message}");
    assert_eq!(message.trim_end().lines().count(), 1, "{args:?}: {message}");
    for part in parts {
        assert!(
            message.contains(part),
            "{args:?}: `{part}` is not in: {message}"
        );
    }
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

fn write(folder: &Path, name: &str, content: &str) {
    fs::write(folder.join(name), content).expect("writable");
}

/// A finished small run in `run`.
fn small_run(folder: &Path) {
    write(folder, "small.toml", SMALL);
    let output = phantom(folder, &["train", "--config", "small.toml", "--out", "run"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
}

#[test]
fn a_run_leaves_everything_needed() {
    let folder = folder();
    small_run(folder.path());
    let run = folder.path().join("run");
    for name in [
        "config.toml",
        "model.xml",
        "provenance.json",
        "metrics.csv",
        "checkpoint.json",
        "policy_last.json",
    ] {
        assert!(run.join(name).is_file(), "{name}");
    }
    assert!(
        run.join("tensorboard")
            .read_dir()
            .expect("a folder")
            .next()
            .is_some()
    );
    let metrics = fs::read_to_string(run.join("metrics.csv")).expect("readable");
    assert_eq!(metrics.lines().count(), 3, "a header and two rows");
    // the resolved configuration is a configuration: the same run again, to the same bits
    let config = run.join("config.toml");
    let output = phantom(
        folder.path(),
        &[
            "train",
            "--config",
            config.to_str().expect("UTF-8"),
            "--out",
            "again",
        ],
    );
    assert!(output.status.success(), "{}", text(&output.stderr));
    let policy =
        |name: &str| fs::read(folder.path().join(name).join("policy_last.json")).expect("readable");
    assert_eq!(policy("run"), policy("again"));
}

#[test]
fn resume_after_a_kill_gives_the_same_bits() {
    let folder = folder();
    let path = folder.path();
    write(
        path,
        "a.toml",
        &SMALL.replace("iterations = 2", "iterations = 20"),
    );
    write(
        path,
        "b.toml",
        &SMALL.replace("iterations = 2", "iterations = 10"),
    );
    assert!(
        phantom(path, &["train", "--config", "a.toml", "--out", "whole"])
            .status
            .success()
    );
    assert!(
        phantom(path, &["train", "--config", "b.toml", "--out", "parts"])
            .status
            .success()
    );
    // what a kill in the middle of an iteration leaves: rows and temporary files that no checkpoint vouches for
    let metrics = path.join("parts/metrics.csv");
    let mut rows = fs::read_to_string(&metrics).expect("readable");
    let torn = rows
        .lines()
        .last()
        .expect("a row")
        .replacen("10,", "11,", 1);
    rows.push_str(&torn[..torn.len() / 2]);
    fs::write(&metrics, rows).expect("writable");
    let output = phantom(
        path,
        &[
            "train",
            "--resume",
            "parts",
            "--iterations",
            "20",
            "--threads",
            "1",
        ],
    );
    assert!(output.status.success(), "{}", text(&output.stderr));
    let read = |name: &str| fs::read_to_string(path.join(name)).expect("readable");
    assert_eq!(
        read("whole/policy_last.json"),
        read("parts/policy_last.json")
    );
    let iterations = |name: &str| -> Vec<String> {
        read(name)
            .lines()
            .map(|line| line.split(',').next().unwrap_or_default().to_owned())
            .collect()
    };
    assert_eq!(
        iterations("whole/metrics.csv"),
        iterations("parts/metrics.csv")
    );
}

#[test]
fn ctrl_c_saves_and_says_how_to_go_on() {
    let folder = folder();
    write(
        folder.path(),
        "long.toml",
        &SMALL.replace("iterations = 2", "iterations = 100000"),
    );
    let child = Command::new(env!("CARGO_BIN_EXE_phantom"))
        .current_dir(folder.path())
        .args(["train", "--config", "long.toml", "--out", "run", "--model"])
        .arg(model())
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("the program starts");
    let checkpoint = folder.path().join("run/checkpoint.json");
    for _ in 0..600 {
        if checkpoint.exists() {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    let kill = Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status()
        .expect("kill runs");
    assert!(kill.success());
    let output = child.wait_with_output().expect("it ends");
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(
        text(&output.stdout).contains("phantom train --resume run"),
        "{}",
        text(&output.stdout)
    );
    let resumed = phantom(
        folder.path(),
        &["train", "--resume", "run", "--iterations", "1"],
    );
    assert!(
        resumed.status.success(),
        "nothing is left to do, which is no error"
    );
}

#[test]
fn eval_prints_and_writes_the_distance() {
    let folder = folder();
    small_run(folder.path());
    let args = [
        "eval",
        "--policy",
        "run/policy_last.json",
        "--rollouts",
        "2",
        "--json",
        "out.json",
    ];
    let output = phantom(folder.path(), &args);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let json = fs::read_to_string(folder.path().join("out.json")).expect("written");
    let value: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    let mean = value["mean_distance_cm"].as_f64().expect("a number");
    assert_eq!(value["rollouts"].as_array().map(Vec::len), Some(2));
    assert!(text(&output.stdout).contains(&format!("{mean:.2} cm")));
    // the figure is the mean of what the table of steps says
    let steps =
        fs::read_to_string(folder.path().join("run/policy_last.spiral.csv")).expect("written");
    let distances: Vec<f64> = steps
        .lines()
        .skip(1)
        .map(|line| {
            line.rsplit(',')
                .next()
                .and_then(|cell| cell.parse().ok())
                .expect("a number")
        })
        .collect();
    assert_eq!(distances.len(), 2 * 8000, "4 s at 2 kHz, twice");
    let expected = distances.iter().sum::<f64>() / distances.len() as f64;
    assert!((mean - expected).abs() < 1e-9);
}

#[test]
fn a_run_that_only_diverges_leaves_its_breakdowns() {
    let folder = folder();
    let path = folder.path();
    let unlimited = fs::read_to_string(model()).expect("readable");
    let unlimited = unlimited.replace("ctrllimited=\"true\"", "ctrllimited=\"false\"");
    write(path, "m.xml", &unlimited);
    write(path, "small.toml", SMALL);
    let args = [
        "train",
        "--model",
        "m.xml",
        "--config",
        "small.toml",
        "--out",
        "run",
    ];
    assert!(phantom(path, &args).status.success());

    // a motor that pushes beyond what the engine takes
    let file = path.join("run/checkpoint.json");
    let text = fs::read_to_string(&file).expect("readable");
    let mut checkpoint: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    checkpoint["policy"]["weights"][36] = 1e200.into();
    fs::write(&file, checkpoint.to_string()).expect("writable");
    let more = ["train", "--resume", "run", "--iterations", "5"];
    refuses(path, &more, &["all 16 trajectories diverged"]);
    let dump = path.join("run/diverged-00003-000.json");
    let output = phantom(path, &["replay", dump.to_str().expect("a plain path")]);
    assert_eq!(output.status.code(), Some(0), "it breaks down again");

    // a dump that cannot be written does not hide what happened
    fs::remove_file(&dump).expect("there");
    fs::create_dir(&dump).expect("free");
    let output = phantom(path, &more);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2));
    assert!(message.contains("diverged-00003-000.json"), "{message}");
    assert!(
        message.contains("all 16 trajectories diverged"),
        "{message}"
    );
}

#[test]
fn a_reader_that_leaves_is_no_panic() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_phantom"))
        .args(["record", "--list"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("the program starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("ends");
    assert_eq!(text(&output.stderr), "");
}

#[test]
fn every_help_has_examples() {
    for command in ["train", "eval", "bench", "replay"] {
        let output = phantom(Path::new("."), &[command, "--help"]);
        assert!(output.status.success());
        assert!(text(&output.stdout).contains("Examples:"), "{command}");
    }
}
