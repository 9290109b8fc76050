//! What the binary was built from, for the provenance file of each run, and where its `MuJoCo` library is.

use std::{env, path::Path, process::Command};

/// What ends up in the binary: "dirty" means that one of these differs from the commit.
const SOURCES: [&str; 5] = ["build.rs", "Cargo.toml", "Cargo.lock", "src", "mujoco-sys"];

fn main() {
    for source in SOURCES {
        println!("cargo::rerun-if-changed={source}");
    }
    let (commit, dirty) =
        git_state().unwrap_or_else(|| ("unknown".to_owned(), "unknown".to_owned()));
    println!("cargo::rustc-env=PHANTOM_GIT_COMMIT={commit}");
    println!("cargo::rustc-env=PHANTOM_GIT_DIRTY={dirty}");

    let header = env::var("DEP_MUJOCO_HEADER_VERSION").unwrap_or_else(|_| "222".to_owned());
    println!("cargo::rustc-env=PHANTOM_MUJOCO_HEADER_VERSION={header}");

    // set when MUJOCO_DIR is: the program must find that library again without LD_LIBRARY_PATH
    if let Ok(folder) = env::var("DEP_MUJOCO_LIB_DIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }

    let rustc = env::var("RUSTC").unwrap_or_else(|_| "rustc".to_owned());
    let version = output(&rustc, &["--version"]).unwrap_or_else(|| "unknown".to_owned());
    println!("cargo::rustc-env=PHANTOM_RUSTC_VERSION={version}");
}

/// Commit and "true" or "false" for dirty; none where this folder is no checkout of its own.
fn git_state() -> Option<(String, String)> {
    // an unpacked archive inside another project's checkout must not take that project's commit
    let top = Path::new(&git(&["rev-parse", "--show-toplevel"])?)
        .canonicalize()
        .ok()?;
    if top
        != Path::new(&env::var_os("CARGO_MANIFEST_DIR")?)
            .canonicalize()
            .ok()?
    {
        return None;
    }
    // a path that does not exist would count as changed in every build
    for name in ["HEAD", "refs/heads", "packed-refs"] {
        let path = git(&["rev-parse", "--git-path", name])?;
        if Path::new(&path).exists() {
            println!("cargo::rerun-if-changed={path}");
        }
    }
    let commit = git(&["rev-parse", "HEAD"])?;
    let mut status = vec!["--no-optional-locks", "status", "--porcelain", "--"];
    status.extend(SOURCES);
    let dirty = !git(&status)?.is_empty();
    Some((commit, dirty.to_string()))
}

fn git(args: &[&str]) -> Option<String> {
    output("git", args)
}

fn output(program: &str, args: &[&str]) -> Option<String> {
    let output = Command::new(program)
        .args(args)
        .output()
        .ok()
        .filter(|output| output.status.success())?;
    Some(String::from_utf8(output.stdout).ok()?.trim().to_owned())
}
