//! `phantom recording`, and the reader in Python.

use std::path::{Path, PathBuf};
use std::process::Command as Process;

use assert_cmd::Command;
use phantom::recording::{self, Channel, Kind, Recording, Stream};

fn phantom(arguments: &[&str], folder: &Path) -> (i32, String, String) {
    let output = Command::cargo_bin("phantom")
        .expect("the program")
        .arg("recording")
        .args(arguments)
        .current_dir(folder)
        .output()
        .expect("it runs");
    let text = |bytes| String::from_utf8(bytes).expect("UTF-8");
    (
        output.status.code().expect("a code"),
        text(output.stdout),
        text(output.stderr),
    )
}

#[test]
fn a_table_of_trials_becomes_recordings() {
    let folder = tempfile::tempdir().expect("a folder");
    let write =
        |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("written");
    write("log.csv", "toss,time,q\na,0,1\na,1,2\nb,0,3\n");
    write(
        "b.toml",
        "trial = 'toss'\n[[channel]]\nfrom = 'q'\nto = 'j1'\nunit = 'rad'\n",
    );
    let arguments = ["convert", "log.csv", "out.mcap", "--binding", "b.toml"];
    let (code, out, _) = phantom(&arguments, folder.path());
    assert_eq!((code, out.as_str()), (0, "2 recordings, 3 samples\n"));
    let second = recording::read(&folder.path().join("out-2.mcap")).expect("read");
    assert_eq!(
        (second.meta.trial.as_str(), second.streams[0].row(0)),
        ("b", [3.0].as_slice())
    );

    let (code, out, _) = phantom(&["info", "out-1.mcap", "--json"], folder.path());
    let info: serde_json::Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!(code, 0);
    assert_eq!(info[0]["streams"][0]["samples"], 2);
    assert_eq!(info[0]["streams"][0]["channels"][0]["name"], "j1");
}

#[test]
fn exit_codes_tell_what_was_found() {
    let folder = tempfile::tempdir().expect("a folder");
    let write =
        |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("written");
    write("good.csv", "time,q\n0,1\n1,2\n");
    write("bad.csv", "time,q\n0,1\n1,2\n0.5,3\n");
    write("torn.csv", "time,q\n0,1\n1,2\n2");
    assert_eq!(phantom(&["check", "good.csv"], folder.path()).0, 0);
    let (code, out, _) = phantom(&["check", "good.csv", "bad.csv"], folder.path());
    assert_eq!(code, 1);
    assert!(
        out.contains("bad.csv: error: table: at 0.5 s: time runs backwards"),
        "{out}"
    );
    let (code, out, _) = phantom(&["check", "torn.csv"], folder.path());
    assert_eq!(code, 1);
    assert!(
        out.contains("torn.csv: error: line 4: 1 columns, expected 2 [damaged]"),
        "{out}"
    );
    let (code, _, error) = phantom(&["check", "none.csv"], folder.path());
    assert_eq!(code, 2);
    assert!(error.contains("cannot read none.csv"), "{error}");

    // damaged data is taken only on request
    assert_eq!(
        phantom(&["convert", "torn.csv", "out.mcap"], folder.path()).0,
        2
    );
    assert!(!folder.path().join("out.mcap").exists());
    let (code, _, error) = phantom(
        &["convert", "torn.csv", "out.mcap", "--salvage"],
        folder.path(),
    );
    assert_eq!(code, 0);
    assert!(error.contains("line 4"), "{error}");
    let saved = recording::read(&folder.path().join("out.mcap")).expect("read");
    assert_eq!(saved.streams[0].len(), 2);
}

/// A Python with the package `mcap`, if there is one: of the cross-check's environment, or the system's.
fn python() -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    [root.join(".venv-crosscheck/bin/python"), "python3".into()]
        .into_iter()
        .find(|python| {
            let import = Process::new(python)
                .args(["-c", "import mcap, numpy"])
                .output();
            import.is_ok_and(|output| output.status.success())
        })
}

/// Needs the Python package `mcap`; passes without a look where there is none.
#[test]
fn the_public_package_reads_the_same_numbers() {
    let Some(python) = python() else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let channels = ["a", "b"].map(|name| Channel {
        name: name.into(),
        kind: Kind::Sensor,
        unit: "m".into(),
        noise_sigma: None,
    });
    let mut stream = Stream::new("s", Some(10.0), channels.to_vec());
    stream.push(-100_000_000, &[0.1, f64::NAN]);
    stream.push(0, &[1.0 / 3.0, -5e-324]);
    let recording = Recording {
        streams: vec![stream],
        ..Recording::default()
    };
    recording::write(&folder.path().join("log.mcap"), &recording).expect("written");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/read_recording.py");
    let run = |arguments: &[&str]| {
        let output = Process::new(&python)
            .args(arguments)
            .current_dir(folder.path())
            .output();
        let output = output.expect("Python runs");
        assert!(
            output.status.success(),
            "{}",
            String::from_utf8_lossy(&output.stderr)
        );
        String::from_utf8(output.stdout).expect("UTF-8")
    };
    let script = script.to_str().expect("UTF-8");
    let out = run(&[script, "log.mcap", "--npz", "log.npz"]);
    assert!(out.contains("s: 2 samples, 10.0 Hz"), "{out}");
    assert!(out.contains("-0.100000000 s: [0.1, None]"), "{out}");
    let same = "import numpy as n; z = n.load('log.npz'); \
                print(z['s/a'].tolist() == [0.1, 1/3], n.isnan(z['s/b'][0]), z['s/b'][1] == -5e-324)";
    assert_eq!(run(&["-c", same]).trim(), "True True True");
}
