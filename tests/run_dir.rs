//! The run folder as its users meet it: what is refused, what comes back, what the messages say.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use phantom::run_dir::{PROVENANCE_FILE, Provenance, RunDir, RunDirError, read_json};

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

fn names(dir: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(dir)
        .expect("the folder")
        .map(|entry| {
            entry
                .expect("an entry")
                .file_name()
                .to_string_lossy()
                .into_owned()
        })
        .collect();
    names.sort();
    names
}

#[test]
fn new_run_makes_the_folder_and_leaves_it_clean() {
    let dir = folder();
    let path = dir.path().join("a/b");
    let run = RunDir::create(&path).expect("a run");
    assert_eq!(run.path(), path);
    assert!(names(&path).is_empty());
    RunDir::create(&path).expect("an empty folder is free");
}

#[test]
fn unwritable_folder_is_named_with_the_reason() {
    // a file is in the way: refused to the superuser too
    let dir = folder();
    let file = dir.path().join("file");
    fs::write(&file, "").expect("a file");
    let below = file.join("run");
    let message = RunDir::create(&below)
        .expect_err("a file is no folder")
        .to_string();
    assert!(
        message.starts_with(&format!("cannot create folder {}: ", below.display())),
        "{message}"
    );
    assert!(
        !message.contains('\n') && !message.ends_with('.'),
        "{message}"
    );
    // a file system that takes no files
    let message = RunDir::create("/proc/self")
        .expect_err("no folder for files")
        .to_string();
    assert!(
        message.starts_with("cannot write /proc/self: "),
        "{message}"
    );
}

#[test]
fn existing_run_is_refused_unless_told() {
    let dir = folder();
    let run = RunDir::create(dir.path()).expect("a run");
    let provenance = Provenance::capture(2, ["phantom".to_owned(), "train".to_owned()]);
    run.write_json(PROVENANCE_FILE, &provenance)
        .expect("a file");
    let before = fs::read(run.file(PROVENANCE_FILE)).expect("the file");
    let error = RunDir::create(dir.path()).expect_err("it holds a run");
    assert!(
        matches!(
            error,
            RunDirError::Occupied {
                marker: PROVENANCE_FILE,
                ..
            }
        ),
        "{error}"
    );
    assert_eq!(
        fs::read(run.file(PROVENANCE_FILE)).expect("the file"),
        before
    );
    RunDir::create_or_overwrite(dir.path()).expect("told to");
    assert_eq!(
        RunDir::open(dir.path())
            .expect("the run")
            .read_json::<Provenance>(PROVENANCE_FILE)
            .expect("the same"),
        provenance
    );
}

#[test]
fn folder_without_a_run_does_not_open() {
    let dir = folder();
    assert!(matches!(
        RunDir::open(dir.path()),
        Err(RunDirError::NotARun { .. })
    ));
    assert!(matches!(
        RunDir::open(dir.path().join("missing")),
        Err(RunDirError::Read { .. })
    ));
    let file = dir.path().join("file");
    fs::write(&file, "").expect("a file");
    assert_eq!(
        RunDir::open(&file)
            .expect_err("a file is no folder")
            .to_string(),
        format!("cannot read {}: not a directory", file.display())
    );
}

#[test]
fn provenance_describes_this_build() {
    let provenance = Provenance::capture(3, ["phantom".to_owned()]);
    assert_eq!(provenance.mujoco_header_version, "222");
    assert!(
        provenance.rustc_version.starts_with("rustc "),
        "{}",
        provenance.rustc_version
    );
    assert_eq!(
        provenance.git_dirty.is_none(),
        provenance.git_commit == "unknown"
    );
    let (started, now) = (
        &provenance.started,
        humantime::format_rfc3339_seconds(std::time::SystemTime::now()),
    );
    assert_eq!(started.len(), "2026-01-01T00:00:00Z".len());
    assert_eq!(started[..7], now.to_string()[..7]);
}

#[test]
fn json_keeps_every_bit_and_leaves_no_temporary_files() {
    let dir = folder();
    let run = RunDir::create(dir.path()).expect("a run");
    let values = [0.1, 1.0 / 3.0, 1e-308, -0.0, f64::MAX, 6.02e23];
    for _ in 0..3 {
        run.write_json("values.json", &values).expect("a file");
    }
    assert_eq!(names(dir.path()), ["values.json"]);
    let back: [f64; 6] = run.read_json("values.json").expect("the same");
    assert_eq!(back.map(f64::to_bits), values.map(f64::to_bits));
    assert!(
        fs::read(run.file("values.json"))
            .expect("the file")
            .ends_with(b"]\n")
    );
}

#[test]
fn json_errors_name_file_key_and_line() {
    let dir = folder();
    let path: PathBuf = dir.path().join("policy.json");
    let read = |text: &str| {
        fs::write(&path, text).expect("a file");
        read_json::<BTreeMap<String, Vec<f64>>>(&path)
            .expect_err("malformed")
            .to_string()
    };
    let place = path.display();
    assert_eq!(
        read("{\"gain\":\n [1.0, null]}"),
        format!("{place}: at key `gain[1]`: invalid type: null, expected f64 at line 2 column 11")
    );
    assert!(read("{\"gain\": [1.0").contains("at line 1 column 13"));
    assert!(read("{} x").contains("trailing characters at line 1 column 4"));
}
