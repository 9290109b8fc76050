//! `phantom compare` as users meet it.

use std::fs;
use std::path::Path;

use assert_cmd::Command;

const MODEL: &str = r#"<mujoco><option timestep="0.01"/>
  <worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body></worldbody>
  <actuator><motor name="m" joint="x"/></actuator>
  <sensor><jointpos name="p" joint="x"/></sensor>
</mujoco>"#;

/// A mass of 2 kg under 1 N: x = t²/4.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    fs::write(folder.path().join("model.xml"), MODEL).expect("written");
    let rows = (0..200)
        .map(|i| f64::from(i) * 0.01)
        .map(|t| format!("{t},{},1\n", 0.25 * t * t));
    let table = "time,p,m\n".to_owned() + &rows.collect::<String>();
    fs::write(folder.path().join("log.csv"), table).expect("written");
    folder
}

fn compare(folder: &Path, more: &[&str]) -> std::process::Output {
    let mut command = Command::cargo_bin("phantom").expect("the program");
    command.current_dir(folder).args([
        "compare",
        "--model",
        "model.xml",
        "--out",
        "out",
        "log.csv",
    ]);
    command.args(more).output().expect("it runs")
}

fn force_error(output: &std::process::Output) -> f64 {
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    json["result"]["forces"][0]["signals"][0]["relative_percent"]
        .as_f64()
        .expect("a number")
}

#[test]
fn writes_page_figures_and_results() {
    let folder = folder();
    let output = compare(folder.path(), &[]);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(
        text.contains("Instantaneous forces") && text.contains("0.25 s"),
        "{text}"
    );
    let out = folder.path().join("out");
    assert!(
        fs::read_to_string(out.join("report.html"))
            .expect("a page")
            .contains("uPlot")
    );
    let figures = fs::read_dir(&out).expect("files").filter(|f| {
        f.as_ref()
            .is_ok_and(|f| f.path().extension().is_some_and(|e| e == "svg"))
    });
    assert_eq!(figures.count(), 3, "a force, and two kinds of growth");
    let json = fs::read_to_string(out.join("compare.json")).expect("results");
    assert!(json.contains("\"horizon_s\": 0.25"), "{json}");
}

#[test]
fn a_changed_model_changes_the_result() {
    let folder = folder();
    let right = compare(folder.path(), &["--json"]);
    let wrong = compare(folder.path(), &["--json", "--set", "body_mass[1]=3"]);
    // only the ends of the recording, where differences are one-sided, are off for the right mass
    assert!(force_error(&right) < 10.0, "{}", force_error(&right));
    // 3 kg need half as much again
    assert!(
        (force_error(&wrong) - 50.0).abs() < 5.0,
        "{}",
        force_error(&wrong)
    );
}

#[test]
fn mistakes_are_named_with_exit_code_2() {
    let folder = folder();
    fs::write(
        folder.path().join("bad.toml"),
        "every_s = 1.0\nhorizon = 3\n",
    )
    .expect("written");
    fs::write(folder.path().join("low.toml"), "cutoff_hz = -1.0\n").expect("written");
    for (arguments, message) in [
        (["--set", "no_such=1"], "cannot set `no_such`"),
        (
            ["--set", "body_mass[9]=1"],
            "cannot set `body_mass[9]`: it has 2 numbers",
        ),
        (["--set", "body_mass"], "expected ARRAY=NUMBER"),
        (
            ["--protocol", "bad.toml"],
            "bad.toml:2: unknown field `horizon`",
        ),
        (["--protocol", "low.toml"], "`cutoff_hz` is -1"),
        (["--protocol", "none.toml"], "none.toml"),
        (["--policy", "none.json"], "none.json"),
        (["--simulated", "none.csv"], "none.csv"),
    ] {
        let output = compare(folder.path(), &arguments);
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {error}");
        assert!(error.contains(message), "{arguments:?}: {error}");
    }
    fs::write(
        folder.path().join("log.csv"),
        "time,p\n0,1\n1,2\n2,3\n3,4\n",
    )
    .expect("written");
    let output = compare(folder.path(), &[]);
    assert_eq!(output.status.code(), Some(2));
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(
        error.contains("log.csv") && error.contains("no control of actuator m"),
        "{error}"
    );
}
