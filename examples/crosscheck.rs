//! Writes the record that `scripts/crosscheck.py` compares with Python: `crosscheck --out FILE [--seed N]`.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use phantom::crosscheck;

/// Compute what the cross-check compares, and write it as JSON.
#[derive(Parser)]
struct Arguments {
    /// the record to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// top of the repository, which holds the models
    #[arg(long, value_name = "DIR", default_value = env!("CARGO_MANIFEST_DIR"))]
    root: PathBuf,
    /// seed of every draw
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

#[allow(clippy::print_stderr)]
fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("crosscheck: {message}");
            ExitCode::from(2)
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), String> {
    let record = crosscheck::record(&arguments.root, arguments.seed).map_err(|e| e.to_string())?;
    let fail = |reason: String| format!("cannot write {}: {reason}", arguments.out.display());
    let mut file = BufWriter::new(File::create(&arguments.out).map_err(|e| fail(e.to_string()))?);
    serde_json::to_writer(&mut file, &record).map_err(|e| fail(e.to_string()))?;
    file.flush().map_err(|e| fail(e.to_string()))
}
