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
