//! The table of a run: exact numbers, and each iteration once however often the run was killed.

use std::{fs, path::Path};

use phantom::run_dir::{METRICS_FILE, Metrics, RunDirError};

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

fn csv(dir: &Path) -> String {
    fs::read_to_string(dir.join(METRICS_FILE)).expect("the metrics")
}

#[test]
fn metrics_are_exact_and_empty_where_there_is_no_number() {
    let dir = folder();
    let mut metrics = Metrics::create(dir.path(), &["physics_steps", "reward"]).expect("metrics");
    metrics
        .row(1, &[("reward", 0.1), ("physics_steps", 2e7)])
        .expect("a row");
    metrics.row(2, &[("reward", f64::NAN)]).expect("a row");
    assert_eq!(
        csv(dir.path()),
        "iteration,physics_steps,reward\n1,20000000,0.1\n2,,\n"
    );
    let error = metrics
        .row(3, &[("rewards", 1.0)])
        .expect_err("a misspelt column");
    assert!(
        matches!(error, RunDirError::UnknownColumn { .. }),
        "{error}"
    );
    let error = metrics.row(2, &[]).expect_err("a row that is there");
    assert!(
        matches!(
            error,
            RunDirError::OutOfOrder {
                iteration: 2,
                last: 2,
                ..
            }
        ),
        "{error}"
    );
}

#[test]
fn resumed_metrics_have_each_iteration_once() {
    let dir = folder();
    let mut metrics = Metrics::create(dir.path(), &["reward"]).expect("metrics");
    for iteration in 1..=5 {
        metrics
            .row(iteration, &[("reward", iteration as f64 / 10.0)])
            .expect("a row");
    }
    drop(metrics);
    // killed in the middle of row 6; the last checkpoint is that of iteration 3
    let cut = csv(dir.path()) + "6,0.";
    fs::write(dir.path().join(METRICS_FILE), cut).expect("the cut file");
    let mut metrics = Metrics::resume(dir.path(), &["reward"], 3).expect("metrics");
    metrics.row(4, &[("reward", 7.0)]).expect("a row");
    assert_eq!(
        csv(dir.path()),
        "iteration,reward\n1,0.1\n2,0.2\n3,0.3\n4,7\n"
    );
    assert_eq!(names(dir.path()), [METRICS_FILE, "tensorboard"]);
    assert_eq!(
        names(&dir.path().join("tensorboard")).len(),
        2,
        "one event file a start"
    );
}

#[test]
fn row_cut_short_is_dropped_even_if_it_looks_whole() {
    let dir = folder();
    fs::write(
        dir.path().join(METRICS_FILE),
        "iteration,reward\n1,0.5\n2,0.2",
    )
    .expect("a file");
    Metrics::resume(dir.path(), &["reward"], 2).expect("metrics");
    assert_eq!(csv(dir.path()), "iteration,reward\n1,0.5\n");
}

#[test]
fn metrics_that_do_not_fit_are_refused_and_kept() {
    let dir = folder();
    let path = dir.path().join(METRICS_FILE);
    let resume = |text: &str| {
        fs::write(&path, text).expect("a file");
        let message = Metrics::resume(dir.path(), &["reward"], 9)
            .expect_err("malformed")
            .to_string();
        assert_eq!(csv(dir.path()), text);
        message
    };
    let place = path.display();
    assert_eq!(
        resume("iteration,kl\n"),
        format!("{place}: columns are `iteration,kl`, expected `iteration,reward`")
    );
    assert_eq!(
        resume("iteration,reward\n1,2\nx,2\n"),
        format!("{place}: line 3: `x` is no iteration number")
    );
    assert_eq!(
        resume("iteration,reward\n1\n"),
        format!("{place}: line 2: 1 cells, expected 2")
    );
    assert_eq!(
        resume("iteration,reward\n2,1\n2,1\n"),
        format!("{place}: line 3: iteration 2 comes after iteration 2")
    );
    fs::remove_file(&path).expect("gone");
    let message = Metrics::resume(dir.path(), &["reward"], 9)
        .expect_err("missing")
        .to_string();
    assert_eq!(
        message,
        format!("cannot read {place}: No such file or directory (os error 2)")
    );
}
