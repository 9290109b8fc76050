//! The built program.

use std::path::Path;
use std::process::{Command, Output};

/// Runs the program in `folder`.
pub(crate) fn phantom(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_phantom"))
        .current_dir(folder)
        .env("PHANTOM_ROOT", env!("CARGO_MANIFEST_DIR"))
        .args(args)
        .output()
        .expect("the program starts")
}

/// Runs the program, which has to succeed; what it prints.
pub(crate) fn succeeds(folder: &Path, args: &[&str]) -> String {
    let output = phantom(folder, args);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{args:?}: {message}");
    String::from_utf8_lossy(&output.stdout).into_owned()
}
