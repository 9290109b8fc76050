//! Bad files and numbers: exit code 2 and one sentence that names them.

use std::fs;

use super::{folder, model, phantom, refuses, small_run, text, write};

#[test]
fn bad_files_are_named() {
    let folder = folder();
    let path = folder.path();
    small_run(path);
    write(path, "broken.xml", "<mujoco><worldbody></mujoco>");
    write(path, "other.xml", "<mujoco><worldbody/></mujoco>");
    write(path, "unknown.toml", "[train]\ntrajectoris = 3\n");
    write(path, "negative.toml", "[train]\ntimestep_s = -0.001\n");
    write(path, "typo.toml", "[train\n");
    write(
        path,
        "rule.toml",
        "[[randomise]]\nelement = \"body/nobody\"\nattribute = \"mass\"\ndistribution = { normal = 0.1 }\n",
    );
    let policy = fs::read_to_string(path.join("run/policy_last.json")).expect("readable");
    write(
        path,
        "size.json",
        &policy.replace("\"n_observation\": 36", "\"n_observation\": 35"),
    );
    write(
        path,
        "format.json",
        &policy.replace("phantom-affine-gaussian-1", "something else"),
    );
    write(path, "cut.json", &policy[..policy.len() / 2]);
    refuses(path, &["train", "--model", "missing.xml"], &["missing.xml"]);
    refuses(
        path,
        &["train", "--model", "broken.xml"],
        &["broken.xml", "XML"],
    );
    refuses(path, &["train", "--model", "other.xml"], &["p0_turret"]);
    refuses(
        path,
        &["train", "--config", "missing.toml"],
        &["missing.toml", "No such file"],
    );
    refuses(
        path,
        &["train", "--config", "unknown.toml"],
        &["unknown.toml:2", "trajectoris"],
    );
    refuses(
        path,
        &["train", "--config", "negative.toml"],
        &["negative.toml", "train.timestep_s", "-0.001"],
    );
    refuses(path, &["train", "--config", "typo.toml"], &["typo.toml:1"]);
    refuses(
        path,
        &["train", "--config", "rule.toml"],
        &["body/nobody", "nobody"],
    );
    refuses(
        path,
        &["train", "--out", "/proc/phantom"],
        &["/proc/phantom"],
    );
    refuses(path, &["train", "--out", "run"], &["run"]);
    refuses(path, &["train", "--resume", "nowhere"], &["nowhere"]);
    refuses(
        path,
        &["eval", "--policy", "missing.json"],
        &["missing.json"],
    );
    refuses(
        path,
        &["eval", "--policy", "size.json"],
        &["size.json", "35"],
    );
    refuses(
        path,
        &["eval", "--policy", "format.json"],
        &["format.json", "something else"],
    );
    refuses(path, &["eval", "--policy", "cut.json"], &["cut.json"]);
    refuses(
        path,
        &[
            "eval",
            "--policy",
            "run/policy_last.json",
            "--json",
            "/proc/out.json",
        ],
        &["/proc/out.json"],
    );
    refuses(path, &["replay", "missing.json"], &["missing.json"]);
    refuses(path, &["replay", "cut.json"], &["cut.json"]);
}

#[test]
fn a_damaged_checkpoint_is_refused_and_left_alone() {
    let folder = folder();
    let path = folder.path();
    small_run(path);
    let file = path.join("run/checkpoint.json");
    let good = fs::read_to_string(&file).expect("readable");
    let metrics = fs::read_to_string(path.join("run/metrics.csv")).expect("readable");
    for (what, damaged) in [
        ("cut short", good[..good.len() / 3].to_owned()),
        (
            "null for NaN",
            good.replacen("\"weights\": [\n", "\"weights\": [\n null,", 1),
        ),
        (
            "too large",
            good.replacen("\"log_sigma\": [\n", "\"log_sigma\": [\n 1e999,", 1),
        ),
        (
            "wrong length",
            good.replacen("\"weights\": [\n", "\"weights\": [\n 0.5,", 1),
        ),
        ("empty", String::new()),
    ] {
        fs::write(&file, &damaged).expect("writable");
        let output = phantom(path, &["train", "--resume", "run", "--iterations", "5"]);
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{what}: {message}");
        assert!(message.contains("checkpoint.json"), "{what}: {message}");
        assert_eq!(
            fs::read_to_string(&file).expect("readable"),
            damaged,
            "{what}: the file was touched"
        );
        assert_eq!(
            fs::read_to_string(path.join("run/metrics.csv")).expect("readable"),
            metrics,
            "{what}"
        );
    }
}

#[test]
fn a_changed_model_is_not_resumed() {
    let folder = folder();
    let path = folder.path();
    small_run(path);
    let edited = fs::read_to_string(model())
        .expect("readable")
        .replace("0.34", "0.35");
    write(path, "edited.xml", &edited);
    refuses(
        path,
        &[
            "train",
            "--resume",
            "run",
            "--model",
            "edited.xml",
            "--iterations",
            "5",
        ],
        &["edited.xml", "changed"],
    );
}

#[test]
fn numbers_out_of_range_are_usage_errors() {
    let folder = folder();
    for args in [
        ["train", "--iterations=0"],
        ["train", "--threads=0"],
        ["train", "--seed=-1"],
        ["train", "--mass=-0.3"],
        ["train", "--mass=nan"],
        ["eval", "--rollouts=0"],
        ["eval", "--base-sigma=-1"],
        ["bench", "--threads=x"],
    ] {
        let output = phantom(folder.path(), &args);
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        let option = args[1].split('=').next().unwrap_or_default();
        assert!(text(&output.stderr).contains(option), "{args:?}");
    }
    let output = phantom(folder.path(), &["train", "--mass", "-0.3"]);
    let message = text(&output.stderr);
    assert!(message.contains("expected a positive number"), "{message}");
}

#[test]
fn a_search_for_missing_effects_refuses_what_it_cannot_use() {
    let folder = folder();
    let at = folder.path();
    let none = ["gap", "--model", "none.xml", "--train", "a.mcap"];
    refuses(at, &none, &["none.xml"]);
    write(at, "bad.xml", "<mujoco><worldbody><body></mujoco>");
    let bad = ["gap", "--model", "bad.xml", "--train", "a.mcap"];
    refuses(at, &bad, &["bad.xml"]);
    let missing = ["gap", "--train", "a.mcap"];
    refuses(at, &missing, &["a.mcap"]);
}
