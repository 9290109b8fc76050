//! The `phantom` program: parse, run, report one error, exit.

use std::process::ExitCode;

use clap::Parser;
use phantom::cli::Cli;

fn main() -> ExitCode {
    // `phantom record --list | head` ends quietly, like any filter
    sigpipe::reset();
    // clap prints help and usage errors itself, with exit codes 0 and 2
    match Cli::parse().run() {
        Ok(code) => code,
        Err(error) => error.report(),
    }
}
