//! The command line: arguments in, a library call, files and a summary out.
//!
//! Exit codes: 0 done, 1 ran but the answer is no, 2 bad input, 3 `MuJoCo` fatal error.
#![allow(clippy::print_stdout, clippy::print_stderr)] // what this module is for

mod adapt;
mod bench;
mod compare;
mod error;
mod eval;
mod gap;
mod record;
mod recording;
mod replay;
mod reproduce;
mod sysid;
mod train;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::{Parser, Subcommand};

use crate::mujoco::Model;
use crate::report::{Rasteriser, Report};
use crate::run_dir;
use crate::supplement::{self, SupplementError};
pub use error::CliError;

/// Model used when none is named, relative to the working directory or to the checkout.
const DEFAULT_MODEL: &str = "xml/phantom.xml";

/// Train robot policies in `MuJoCo`, and test them.
#[derive(Debug, Parser)]
#[command(
    version,
    about,
    propagate_version = true,
    arg_required_else_help = true
)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Train a policy by natural policy gradient
    Train(train::TrainArgs),
    /// Test a policy: follow a target on a spiral, as in the paper's Table 1
    Eval(eval::EvalArgs),
    /// Measure speed and memory
    Bench(bench::BenchArgs),
    /// Record a virtual rig, a machine that is not quite like its model
    Record(record::RecordArgs),
    /// Compare a model with recordings of the machine
    Compare(compare::CompareArgs),
    /// Run a trajectory again that broke down in training
    Replay(replay::ReplayArgs),
    Recording(recording::RecordingArgs),
    Reproduce(reproduce::ReproduceArgs),
    Adapt(adapt::AdaptArgs),
    Sysid(sysid::SysidArgs),
    Gap(gap::GapArgs),
}

impl Cli {
    /// Run the chosen command.
    ///
    /// # Errors
    /// Whatever the user has to put right; see [`CliError::report`].
    pub fn run(self) -> Result<ExitCode, CliError> {
        match self.command {
            Command::Train(args) => args.run(),
            Command::Eval(args) => args.run(),
            Command::Bench(args) => args.run(),
            Command::Compare(args) => args.run(),
            Command::Replay(args) => args.run(),
            Command::Record(args) => args.run(),
            Command::Recording(args) => args.run(),
            Command::Reproduce(args) => args.run(),
            Command::Adapt(args) => args.run(),
            Command::Sysid(args) => args.run(),
            Command::Gap(args) => args.run(),
        }
    }
}

/// The model file to use: the named one, else the shipped one.
fn model_path(named: Option<&Path>) -> PathBuf {
    if let Some(path) = named {
        return path.to_owned();
    }
    let local = PathBuf::from(DEFAULT_MODEL);
    match std::env::var_os("PHANTOM_ROOT") {
        Some(root) if !local.exists() => Path::new(&root).join(DEFAULT_MODEL),
        _ => local,
    }
}

/// A model with its supplements.
fn load_model(path: &Path) -> Result<Model, CliError> {
    supplement::load(path).map_err(|error| match error {
        SupplementError::Mujoco(engine) => engine.into(),
        source => CliError::Supplement {
            file: path.to_owned(),
            source,
        },
    })
}

/// A configuration file; mistakes are named with their line.
fn read_toml<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, CliError> {
    let text = std::fs::read_to_string(path).map_err(|reason| CliError::File {
        file: path.to_owned(),
        reason: match reason.kind() {
            std::io::ErrorKind::InvalidData => "not UTF-8 text".to_owned(),
            _ => reason.to_string(),
        },
    })?;
    toml::from_str(&text).map_err(|error| {
        let line = error
            .span()
            .map_or(1, |span| 1 + text[..span.start].matches('\n').count());
        CliError::Config {
            file: path.to_owned(),
            line,
            reason: error.message().replace('\n', ", "),
        }
    })
}

/// Every figure of `report` as SVG and PNG in `folder`; without PNG where there is no font.
fn write_figures(folder: &Path, report: &Report) -> Result<(), CliError> {
    let rasteriser = Rasteriser::new();
    if let Err(reason) = &rasteriser {
        eprintln!("phantom: no PNG: {reason}");
    }
    for (name, svg) in report.figures()? {
        let file = folder.join(&name);
        run_dir::write_atomic(&file, svg.as_bytes())?;
        if let Ok(rasteriser) = &rasteriser {
            let png = rasteriser.png(&name, &svg)?;
            run_dir::write_atomic(&file.with_extension("png"), &png)?;
        }
    }
    Ok(())
}

/// A flag that Ctrl-C sets; a second Ctrl-C ends the program at once. `message` says what is done before the end.
fn interruption(message: &'static str) -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&flag);
    // without a handler Ctrl-C simply ends the program, and what was saved stands
    let _ = ctrlc::set_handler(move || {
        if seen.swap(true, Ordering::SeqCst) {
            #[allow(clippy::exit)] // the user asked twice
            std::process::exit(130);
        }
        eprintln!("\n{message}; Ctrl-C again to stop at once");
    });
    flag
}

/// Worker threads: as asked, else one a core.
fn thread_count(asked: Option<usize>) -> usize {
    asked.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, std::num::NonZero::get))
}

/// clap parser of a number above 0.
fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err("expected a positive number".to_owned()),
    }
}

/// clap parser of a number of at least 0.
fn not_negative(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value >= 0.0 => Ok(value),
        _ => Err("expected a number of at least 0".to_owned()),
    }
}

/// clap parser of a count.
fn count(text: &str) -> Result<usize, String> {
    match text.parse::<usize>() {
        Ok(value) if (1..=1_000_000).contains(&value) => Ok(value),
        _ => Err("expected a whole number from 1 to 1000000".to_owned()),
    }
}
