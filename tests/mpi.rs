//! The program under `mpirun`: the same bits for every split, and an end when a process ends.
//!
//! `cargo test --release --features mpi --test mpi`. Without `mpirun` the tests say that they skip.
#![cfg(feature = "mpi")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

const SMALL: &str = "[train]
trajectories = 48
trajectory_s = 0.16
evaluate_every = 2
evaluation_rollouts = 3
checkpoint_every = 1
[npg]
value_stride = 1
";

/// `mpirun` for `n` processes; nothing, with a word, where there is none.
fn mpirun(n: usize) -> Option<Command> {
    let Ok(version) = Command::new("mpirun").arg("--version").output() else {
        eprintln!("skipped: there is no mpirun");
        return None;
    };
    let mut command = Command::new("mpirun");
    if String::from_utf8_lossy(&version.stdout).contains("Open MPI") {
        // as CI and containers have it: few cores, and the superuser
        command.args([
            "--oversubscribe",
            "--allow-run-as-root",
            "--bind-to",
            "none",
        ]);
    }
    command.args(["-n", &n.to_string()]);
    Some(command)
}

/// Finishes the command line of a small run.
fn train<'a>(command: &'a mut Command, folder: &Path, args: &[&str]) -> &'a mut Command {
    fs::write(folder.join("small.toml"), SMALL).expect("writable");
    command
        .current_dir(folder)
        .env("PHANTOM_ROOT", env!("CARGO_MANIFEST_DIR"))
        .args([env!("CARGO_BIN_EXE_phantom"), "train"])
        .args(args)
}

fn new_run(
    command: &mut Command,
    folder: &Path,
    threads: &str,
    iterations: &str,
    out: &str,
) -> Output {
    let args = [
        "--config",
        "small.toml",
        "--threads",
        threads,
        "--iterations",
        iterations,
        "--out",
        out,
    ];
    train(command, folder, &args)
        .output()
        .expect("mpirun starts")
}

/// Policy and state of a run, without the clock.
fn result(run: &Path) -> (String, serde_json::Value) {
    let policy = fs::read_to_string(run.join("policy_last.json")).expect("a policy");
    let state = fs::read(run.join("checkpoint.json")).expect("a checkpoint");
    let mut state: serde_json::Value = serde_json::from_slice(&state).expect("JSON");
    state["seconds"] = 0.into();
    (policy, state)
}

fn succeeded(output: &Output) {
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{message}");
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn processes_times_threads_do_not_matter() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let mut alone = Command::new("env"); // no launcher
    succeeded(&new_run(&mut alone, path, "2", "3", "alone"));
    for (processes, threads) in [(1, "2"), (2, "1"), (4, "1"), (3, "2")] {
        let Some(mut command) = mpirun(processes) else {
            return;
        };
        let out = format!("{processes}x{threads}");
        let output = new_run(&mut command, path, threads, "3", &out);
        succeeded(&output);
        assert!(
            result(&path.join(&out)) == result(&path.join("alone")),
            "{out} differs"
        );
        let told = text(&output.stdout);
        let of_many = format!("{processes} processes, ");
        assert_eq!(told.contains(&of_many), processes > 1, "{told}");
        assert_eq!(
            told.matches("files:").count(),
            1,
            "one process speaks: {told}"
        );
        let provenance =
            fs::read_to_string(path.join(&out).join("provenance.json")).expect("a file");
        assert!(provenance.contains(&format!("\"processes\": {processes}")));
    }
}

/// A long run of three processes that has saved something.
struct Running {
    child: Child,
    run: PathBuf,
}

impl Running {
    fn start(folder: &Path) -> Option<Self> {
        let run = folder.join("run");
        let out = run.to_str().expect("UTF-8").to_owned();
        let args = [
            "--config",
            "small.toml",
            "--threads",
            "1",
            "--iterations",
            "100000",
            "--out",
            &out,
        ];
        let child = train(&mut mpirun(3)?, folder, &args)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("mpirun starts");
        let begin = Instant::now();
        while !run.join("checkpoint.json").exists() {
            assert!(
                begin.elapsed() < Duration::from_mins(1),
                "nothing was saved"
            );
            sleep(Duration::from_millis(20));
        }
        Some(Self { child, run })
    }

    /// Send `signal` to process `rank` of this run, and see how it ends.
    fn signal(self, rank: usize, signal: &str) -> (Output, Duration) {
        let process = self.process(rank).expect("it runs");
        let killed = Command::new("kill").args([signal, &process]).status();
        assert!(killed.expect("kill").success());
        let begin = Instant::now();
        let output = self.child.wait_with_output().expect("an end");
        (output, begin.elapsed())
    }

    fn process(&self, rank: usize) -> Option<String> {
        let run = self.run.to_str().expect("UTF-8");
        let ranks = ["OMPI_COMM_WORLD_RANK", "PMI_RANK"].map(|name| format!("{name}={rank}"));
        let is_it = |folder: &Path| {
            let read = |name: &str| {
                fs::read(folder.join(name)).map_or_else(|_| String::new(), |b| text(&b))
            };
            let (command, environment) = (read("cmdline"), read("environ"));
            !command.contains("mpirun")
                && command.split('\0').any(|argument| argument == run)
                && environment
                    .split('\0')
                    .any(|entry| ranks.iter().any(|r| r == entry))
        };
        let processes = fs::read_dir("/proc").expect("Linux");
        let mut folders = processes.flatten().map(|entry| entry.path());
        let found = folders.find(|folder| is_it(folder))?;
        Some(found.file_name()?.to_str()?.to_owned())
    }
}

/// The run goes on with another number of processes, to the same bits as one that was never stopped.
fn goes_on(folder: &Path) {
    let (_, state) = result(&folder.join("run"));
    let more = state["iteration"].as_u64().expect("a count") + 2;
    let more = more.to_string();
    let args = ["--resume", "run", "--threads", "1", "--iterations", &more];
    let mut command = mpirun(2).expect("there before");
    succeeded(
        &train(&mut command, folder, &args)
            .output()
            .expect("mpirun starts"),
    );
    let mut alone = Command::new("env");
    succeeded(&new_run(&mut alone, folder, "2", &more, "alone"));
    assert!(result(&folder.join("run")) == result(&folder.join("alone")));
    let metrics = fs::read_to_string(folder.join("run/metrics.csv")).expect("metrics");
    let iterations = metrics.lines().skip(1).map(|line| line.split(',').next());
    let all: Vec<String> = iterations.flatten().map(str::to_owned).collect();
    let expected: Vec<String> = (1..=more.parse().expect("a count"))
        .map(|i: u64| i.to_string())
        .collect();
    assert_eq!(all, expected, "each iteration once");
}

#[test]
fn a_process_that_is_killed_ends_the_run_which_can_go_on() {
    for rank in [2, 0] {
        let folder = tempfile::tempdir().expect("a folder");
        let Some(running) = Running::start(folder.path()) else {
            return;
        };
        let (output, time) = running.signal(rank, "-KILL");
        assert!(!output.status.success());
        assert!(time < Duration::from_secs(10), "{time:?}");
        assert!(!text(&output.stderr).trim().is_empty(), "a message");
        goes_on(folder.path());
    }
}

#[test]
fn an_interruption_of_one_lets_all_finish() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(running) = Running::start(folder.path()) else {
        return;
    };
    let (output, time) = running.signal(1, "-INT");
    succeeded(&output);
    assert!(time < Duration::from_secs(20), "{time:?}");
    assert!(text(&output.stdout).contains("continue: phantom train --resume"));
    goes_on(folder.path());
}

#[test]
fn an_error_is_told_once_and_ends_all() {
    let folder = tempfile::tempdir().expect("a folder");
    fs::create_dir(folder.path().join("used")).expect("writable");
    fs::write(folder.path().join("used/metrics.csv"), "").expect("writable");
    for (out, config, part) in [
        ("new", "no.toml", "no.toml"),
        ("used", "small.toml", "used"),
    ] {
        let Some(mut command) = mpirun(3) else {
            return;
        };
        let args = ["--config", config, "--out", out];
        let begin = Instant::now();
        let output = train(&mut command, folder.path(), &args)
            .output()
            .expect("mpirun starts");
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(begin.elapsed() < Duration::from_secs(20));
        assert_eq!(message.matches("phantom: ").count(), 1, "{message}");
        assert!(message.contains(part), "{message}");
        assert!(!folder.path().join("new").exists());
    }
}
