//! Input that would give a result which says nothing: each is named with what to do, or works as one expects.
//!
//! The machine is the pendulum with a cart beside it, which a marker shows. Each test is a defect that other tools have.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::rng::{self, Purpose};
use phantom::sysid::problem::ProblemConfig;

use crate::machine::{MODEL, SIGMA, TRUE_DAMPING, TRUE_MASS, sysid, text};

const MARKER_SIGMA: f64 = 1e-4;

const PARAMETERS: &str = r#"command = "held"
[[parameter]]
element = "joint/hinge"
attribute = "damping"
[[parameter]]
element = "body/arm"
attribute = "mass"
"#;

const NOISE: &str = r#"[[channel]]
name = "encoder"
noise_sigma = 2e-4
[[channel]]
name = "marker*"
noise_sigma = 1e-4
"#;

fn model() -> String {
    MODEL
        .replace(
            "  </worldbody>",
            r#"    <body name="cart" pos="1 0 1">
      <joint name="rail" type="slide" axis="1 0 0" damping="0.5"/>
      <geom name="box" type="box" size="0.1 0.1 0.1" mass="1"/>
      <site name="marker"/>
    </body>
  </worldbody>"#,
        )
        .replace(
            r#"joint="hinge"/></sensor>"#,
            r#"joint="hinge"/><framepos name="marker" objtype="site" objname="marker"/></sensor>"#,
        )
}

/// Rows of the true machine: time, encoder, marker (3), torque.
fn rows() -> Vec<[f64; 6]> {
    let truth = model()
        .replace(r#"damping="0.05""#, &format!(r#"damping="{TRUE_DAMPING}""#))
        .replace(r#"mass="0.5""#, &format!(r#"mass="{TRUE_MASS}""#));
    let mut data = Data::new(Arc::new(Model::from_xml_str(&truth).expect("loads"))).expect("data");
    let mut rng = rng::stream(7, Purpose::SensorNoise, 0, 0);
    data.qvel_mut()[1] = 0.3;
    (0..400)
        .map(|k| {
            let t = f64::from(k) * 0.005;
            let u = 0.8 * (2.0 * t + 1.0).sin() + 0.5 * (9.0 * t).sin();
            let mut noise = |sigma: f64| sigma * rng::normal(&mut rng);
            let row = [
                t,
                data.qpos()[0] + noise(SIGMA),
                1.0 + data.qpos()[1] + noise(MARKER_SIGMA),
                noise(MARKER_SIGMA),
                1.0 + noise(MARKER_SIGMA),
                u,
            ];
            data.ctrl_mut()[0] = u;
            data.step().expect("step");
            row
        })
        .collect()
}

fn write_rows(path: &Path, rows: &[[f64; 6]]) {
    let mut csv = "time,encoder,marker[0],marker[1],marker[2],motor\n".to_owned();
    for row in rows {
        let cells: Vec<String> = row.iter().map(f64::to_string).collect();
        csv += &(cells.join(",") + "\n");
    }
    fs::write(path, csv).expect("written");
}

/// A folder with `m.xml`, `p.toml` and `log.csv`.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    fs::write(at("m.xml"), model()).expect("written");
    fs::write(at("p.toml"), PARAMETERS.to_owned() + NOISE).expect("written");
    write_rows(&at("log.csv"), &rows());
    folder
}

/// Runs `phantom sysid` by shooting, which is quick.
fn run(folder: &Path, parameters: &str, log: &str, more: &[&str]) -> (Option<i32>, String, String) {
    let mut arguments = vec![
        "--model",
        "m.xml",
        "--parameters",
        parameters,
        log,
        "--json",
    ];
    arguments.extend(["--ensemble", "1", "--method", "shooting"]);
    arguments.extend(more);
    let output = sysid(folder, &arguments);
    (
        output.status.code(),
        text(&output.stdout),
        text(&output.stderr),
    )
}

/// Values of all parameters.
fn values(json: &str) -> Vec<f64> {
    let json: serde_json::Value = serde_json::from_str(json).expect("JSON");
    let parameters = json["result"]["parameters"].as_array().expect("a list");
    let value = |p: &serde_json::Value| p["value"].as_f64().expect("a number");
    parameters.iter().map(value).collect()
}

fn assert_refused(folder: &Path, parameters: &str, log: &str, more: &[&str], words: &[&str]) {
    let (code, _, error) = run(folder, parameters, log, more);
    assert_eq!(code, Some(2), "{error}");
    for word in words {
        assert!(error.contains(word), "`{word}` in: {error}");
    }
    assert!(
        !folder.join("sysid/model.xml").exists(),
        "nothing is written"
    );
}

/// The machine is found, with a sensor of several columns and whenever the clock begins.
#[test]
fn sensors_of_several_columns_and_late_clocks() {
    let folder = folder();
    let (code, json, error) = run(folder.path(), "p.toml", "log.csv", &[]);
    assert_eq!(code, Some(0), "{error}");
    let found = values(&json);
    for (found, truth) in found.iter().zip([TRUE_DAMPING, TRUE_MASS]) {
        assert!((found / truth - 1.0).abs() < 5e-3, "{found} {truth}");
    }
    let mut late = rows();
    for row in &mut late {
        row[0] += 1000.0;
    }
    write_rows(&folder.path().join("late.csv"), &late);
    let (_, json, _) = run(folder.path(), "p.toml", "late.csv", &[]);
    for (found, late) in found.iter().zip(values(&json)) {
        assert!((found / late - 1.0).abs() < 1e-6, "{found} {late}");
    }
}

#[test]
fn frozen_parameters_are_applied() {
    let folder = folder();
    let frozen = PARAMETERS.replacen(
        "attribute = \"damping\"",
        "attribute = \"damping\"\nstart = 0.3\nfrozen = true",
        1,
    );
    fs::write(folder.path().join("frozen.toml"), frozen + NOISE).expect("written");
    let (_, json, error) = run(folder.path(), "frozen.toml", "log.csv", &[]);
    let found = values(&json);
    assert_eq!(found[0], 0.3, "{error}");
    // held in the simulations too: with so much damping another mass fits
    assert!((found[1] / TRUE_MASS - 1.0).abs() > 0.02, "{found:?}");
    let written = Model::from_xml_path(folder.path().join("sysid/model.xml")).expect("loads");
    assert_eq!(written.dof_damping()[0], 0.3);
}

/// A file of parameters that was read and written again means the same.
#[test]
fn parameter_files_survive_a_round_trip() {
    let folder = folder();
    let text = PARAMETERS.to_owned() + NOISE;
    let config: ProblemConfig = toml::from_str(&text).expect("TOML");
    let again = toml::to_string(&config).expect("TOML");
    assert_eq!(
        toml::from_str::<ProblemConfig>(&again).expect("TOML"),
        config
    );
    fs::write(folder.path().join("again.toml"), again).expect("written");
    let (_, first, _) = run(folder.path(), "p.toml", "log.csv", &[]);
    let (_, second, error) = run(folder.path(), "again.toml", "log.csv", &[]);
    assert_eq!(values(&first), values(&second), "{error}");
}

#[test]
fn parameters_without_effect_are_named() {
    let folder = folder();
    for (name, rule) in [
        (
            "geom/rod size[0]",
            "element = \"geom/rod\"\nattribute = \"size\"\ncomponents = [0]",
        ),
        (
            "body/arm ipos[1]",
            "element = \"body/arm\"\nattribute = \"ipos\"\ncomponents = [1]",
        ),
    ] {
        let silent = format!("{PARAMETERS}[[parameter]]\n{rule}\n");
        fs::write(folder.path().join("silent.toml"), silent.clone() + NOISE).expect("written");
        let words = [name, "no reading changes with it", "frozen = true"];
        assert_refused(folder.path(), "silent.toml", "log.csv", &[], &words);
        // what is known of it beforehand is all that is known
        let known = silent + "prior_sigma = 0.001\n" + NOISE;
        fs::write(folder.path().join("known.toml"), known).expect("written");
        let (code, json, error) = run(folder.path(), "known.toml", "log.csv", &["--out", "known"]);
        assert_eq!(code, Some(0), "{error}");
        assert!(json.contains("\"label\": \"prior\""), "{json}");
    }
}

#[test]
fn joints_that_nothing_shows_are_named() {
    let folder = folder();
    let log = fs::read_to_string(folder.path().join("log.csv")).expect("readable");
    let mut unmarked = String::new();
    for line in log.lines() {
        let cells: Vec<&str> = line.split(',').collect();
        unmarked += &[cells[0], cells[1], cells[5]].join(",");
        unmarked.push('\n');
    }
    fs::write(folder.path().join("unmarked.csv"), unmarked).expect("written");
    let encoder = NOISE.split("[[channel]]").nth(1).expect("there");
    let blind = format!("{PARAMETERS}[[channel]]{encoder}");
    fs::write(folder.path().join("blind.toml"), &blind).expect("written");
    let words = ["joint `rail`", "record a sensor", "unseen = [\"rail\"]"];
    assert_refused(folder.path(), "blind.toml", "unmarked.csv", &[], &words);
    let allowed = format!("unseen = [\"r*\"]\n{blind}");
    fs::write(folder.path().join("allowed.toml"), allowed).expect("written");
    let (code, _, error) = run(folder.path(), "allowed.toml", "unmarked.csv", &[]);
    assert_eq!(code, Some(0), "{error}");
}

#[test]
fn units_that_contradict_the_model_are_named() {
    let folder = folder();
    for (from, unit, expected) in [
        (
            "encoder",
            "deg",
            "is in deg, its number in the model in rad",
        ),
        ("marker[0]", "mm", "is in mm, its number in the model in m"),
    ] {
        let binding = format!("[[channel]]\nfrom = \"{from}\"\nunit = \"{unit}\"\n");
        fs::write(folder.path().join("b.toml"), binding).expect("written");
        let more = ["--binding", "b.toml"];
        let words = [from, expected, "--binding"];
        assert_refused(folder.path(), "p.toml", "log.csv", &more, &words);
    }
}

#[test]
fn degrees_that_name_no_unit_are_seen_by_the_joints_range() {
    let folder = folder();
    let limited = model().replace(
        r#"axis="0 1 0" damping"#,
        r#"axis="0 1 0" limited="true" range="-150 150" damping"#,
    );
    fs::write(folder.path().join("m.xml"), limited).expect("written");
    let mut degrees = rows();
    for row in &mut degrees {
        row[1] = row[1].to_degrees();
    }
    write_rows(&folder.path().join("degrees.csv"), &degrees);
    let words = ["encoder", "range of 5.2360 rad", "in degrees?", "--binding"];
    assert_refused(folder.path(), "p.toml", "degrees.csv", &[], &words);
    let binding = "[[channel]]\nfrom = \"encoder\"\nscale = 0.017453292519943295\n";
    fs::write(folder.path().join("b.toml"), binding).expect("written");
    let more = ["--binding", "b.toml"];
    let (code, _, error) = run(folder.path(), "p.toml", "degrees.csv", &more);
    assert_eq!(code, Some(0), "{error}");
}

#[test]
fn numbers_that_are_missing_infinite_or_always_the_same() {
    let folder = folder();
    let with = |name: &str, change: &dyn Fn(usize, &mut [f64; 6])| {
        let mut all = rows();
        for (k, row) in all.iter_mut().enumerate() {
            change(k, row);
        }
        write_rows(&folder.path().join(name), &all);
    };
    // a tenth of the samples lost: the rest is enough, and it is said
    with("lost.csv", &|k, row| {
        if k % 10 == 0 {
            row[1] = f64::NAN;
        }
    });
    let (code, json, error) = run(folder.path(), "p.toml", "lost.csv", &[]);
    assert_eq!(code, Some(0), "{error}");
    assert!(
        error.contains("`encoder` has no number in 40 of 400 rows"),
        "{error}"
    );
    assert!((values(&json)[1] / TRUE_MASS - 1.0).abs() < 5e-3);
    fs::remove_dir_all(folder.path().join("sysid")).expect("removed");
    with("infinite.csv", &|k, row| {
        if k == 100 {
            row[1] = f64::INFINITY;
        }
    });
    let words = ["`encoder` is inf at 0.5 s", "NaN"];
    assert_refused(folder.path(), "p.toml", "infinite.csv", &[], &words);
    with("uncontrolled.csv", &|_, row| row[5] = f64::NAN);
    let words = ["control `motor` has no number at all"];
    assert_refused(folder.path(), "p.toml", "uncontrolled.csv", &[], &words);
    // what never moves has no noise that could be guessed
    with("constant.csv", &|_, row| row[3] = 0.0);
    fs::write(folder.path().join("guess.toml"), PARAMETERS).expect("written");
    let words = [
        "`marker[1]`",
        "every sample is 0",
        "noise_sigma",
        "ignore = true",
    ];
    assert_refused(folder.path(), "guess.toml", "constant.csv", &[], &words);
    let (code, _, error) = run(folder.path(), "p.toml", "constant.csv", &[]);
    assert_eq!(code, Some(0), "{error}");
}

#[test]
fn globs_mean_what_can_have_the_attribute() {
    let folder = folder();
    let all = format!(
        "{}{NOISE}",
        PARAMETERS
            .replace("body/arm", "body/*")
            .replace("mass\"", "mass\"\nprior_sigma = 0.5")
    );
    fs::write(folder.path().join("all.toml"), all).expect("written");
    let (code, json, error) = run(folder.path(), "all.toml", "log.csv", &[]);
    assert_eq!(code, Some(0), "{error}");
    assert!(
        json.contains("body/cart mass") && !json.contains("body/world mass"),
        "{json}"
    );
    fs::remove_dir_all(folder.path().join("sysid")).expect("removed");
    let none = PARAMETERS.replace("body/arm", "body/w*") + NOISE;
    fs::write(folder.path().join("none.toml"), none).expect("written");
    let words = ["body/w* mass", "body `world` has no mass"];
    assert_refused(folder.path(), "none.toml", "log.csv", &[], &words);
}

#[test]
fn rules_and_windows_that_fit_nothing_are_named() {
    let folder = folder();
    let typo = PARAMETERS.to_owned() + &NOISE.replace("encoder", "encodr");
    fs::write(folder.path().join("typo.toml"), typo).expect("written");
    let words = ["channel `encodr`", "there are: encoder, marker[0]"];
    assert_refused(folder.path(), "typo.toml", "log.csv", &[], &words);
    write_rows(&folder.path().join("short.csv"), &rows()[..40]);
    let words = [
        "short.csv",
        "lasts 0.195 s, less than a window of 0.5 s",
        "--window inf",
    ];
    assert_refused(folder.path(), "p.toml", "short.csv", &[], &words);
    let words = ["held.csv", "less than a window"];
    write_rows(&folder.path().join("held.csv"), &rows()[..40]);
    let held = ["--holdout", "held.csv"];
    assert_refused(folder.path(), "p.toml", "log.csv", &held, &words);
}
