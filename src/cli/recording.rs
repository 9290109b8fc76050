//! `phantom recording`: look at, convert and check recorded logs.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Subcommand};
use indicatif::ProgressBar;
use serde::Serialize;

use super::{CliError, load_model};
use crate::recording::{
    Binding, Channel, Finding, Meta, Recording, Severity, Stream, check_file, read_trials, salvage,
    write,
};

/// Look at, convert and check recorded logs
///
/// Recordings are `.mcap`, `.csv` or `.csv.gz` files; see docs/recording.md.
#[derive(Debug, Args)]
pub(super) struct RecordingArgs {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    Info(InfoArgs),
    Convert(ConvertArgs),
    Check(CheckArgs),
}

/// Show streams, channels, rates and times
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom recording info log.mcap
  phantom recording info a.csv b.csv.gz --json")]
struct InfoArgs {
    /// Recordings
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// Names, scales and units (TOML)
    #[arg(long, value_name = "FILE.toml")]
    binding: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Write a recording in another format
///
/// Of a table of several trials, each becomes a file: OUT-1.mcap, OUT-2.mcap …
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom recording convert log.csv log.mcap --binding names.toml
  phantom recording convert cut.mcap saved.mcap --salvage")]
struct ConvertArgs {
    /// Recording
    #[arg(value_name = "FILE")]
    from: PathBuf,
    /// New file; its ending is the format
    #[arg(value_name = "OUT")]
    to: PathBuf,
    /// Names, scales and units (TOML)
    #[arg(long, value_name = "FILE.toml")]
    binding: Option<PathBuf>,
    /// Of a damaged file, take what stands before the damage
    #[arg(long)]
    salvage: bool,
}

/// Look for damage, bad stamps, dead channels, wrong units
///
/// Exit code 0: no errors, maybe warnings; 1: errors.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom recording check log.mcap
  phantom recording check log.csv --binding names.toml --model xml/phantom.xml
  phantom recording check *.mcap --json")]
struct CheckArgs {
    /// Recordings
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// Names, scales and units (TOML)
    #[arg(long, value_name = "FILE.toml")]
    binding: Option<PathBuf>,
    /// Model (MJCF) whose sensors and actuators the channels should be
    #[arg(long, value_name = "FILE.xml")]
    model: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl RecordingArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        match self.action {
            Action::Info(args) => args.run(),
            Action::Convert(args) => args.run(),
            Action::Check(args) => args.run(),
        }
    }
}

fn binding(file: Option<&Path>) -> Result<Binding, CliError> {
    Ok(match file {
        Some(file) => Binding::from_file(file)?,
        None => Binding::default(),
    })
}

/// A progress bar over files, or a sign of life for one.
fn bar(n: usize) -> ProgressBar {
    let bar = if n > 1 {
        ProgressBar::new(n as u64)
    } else {
        ProgressBar::new_spinner()
    };
    bar.enable_steady_tick(std::time::Duration::from_millis(100));
    bar
}

fn print_json(value: &impl Serialize) -> Result<(), CliError> {
    let text = serde_json::to_string_pretty(value).map_err(|error| CliError::File {
        file: "--json".into(),
        reason: error.to_string(),
    })?;
    println!("{text}");
    Ok(())
}

/// What `info` tells of a recording.
#[derive(Debug, Serialize)]
struct Summary<'a> {
    file: &'a Path,
    meta: &'a Meta,
    streams: Vec<StreamSummary<'a>>,
}

#[derive(Debug, Serialize)]
struct StreamSummary<'a> {
    name: &'a str,
    samples: usize,
    rate_hz: Option<f64>,
    first_s: Option<f64>,
    last_s: Option<f64>,
    channels: &'a [Channel],
}

impl<'a> Summary<'a> {
    fn new(file: &'a Path, recording: &'a Recording) -> Self {
        let stream = |s: &'a Stream| StreamSummary {
            name: &s.name,
            samples: s.len(),
            rate_hz: s.rate_hz,
            first_s: s.stamps_ns.iter().min().map(|ns| *ns as f64 * 1e-9),
            last_s: s.stamps_ns.iter().max().map(|ns| *ns as f64 * 1e-9),
            channels: &s.channels,
        };
        Self {
            file,
            meta: &recording.meta,
            streams: recording.streams.iter().map(stream).collect(),
        }
    }

    fn print(&self) {
        println!("{}", self.file.display());
        let meta = self.meta;
        for (key, value) in [
            ("trial", &meta.trial),
            ("source", &meta.source),
            ("model", &meta.model_hash),
            ("notes", &meta.notes),
        ] {
            if !value.is_empty() {
                println!("  {key:7} {value}");
            }
        }
        if meta.start_ns > 0 {
            let start = std::time::UNIX_EPOCH + std::time::Duration::from_nanos(meta.start_ns);
            println!("  start   {}", humantime::format_rfc3339_nanos(start));
        }
        for stream in &self.streams {
            let rate = stream
                .rate_hz
                .map_or("no nominal rate".to_owned(), |r| format!("{r} Hz"));
            let span = match (stream.first_s, stream.last_s) {
                (Some(first), Some(last)) => format!(", {first} to {last} s"),
                _ => String::new(),
            };
            println!(
                "  stream  {}: {} samples, {rate}{span}",
                stream.name, stream.samples
            );
            for channel in stream.channels {
                let kind = format!("{:?}", channel.kind).to_lowercase();
                let sigma = channel
                    .noise_sigma
                    .map_or(String::new(), |s| format!("  sigma {s}"));
                println!("    {kind:8} {} {}{sigma}", channel.name, channel.unit);
            }
        }
    }
}

impl InfoArgs {
    fn run(self) -> Result<ExitCode, CliError> {
        let binding = binding(self.binding.as_deref())?;
        let bar = bar(self.files.len());
        let mut all = Vec::new();
        for file in &self.files {
            all.extend(read_trials(file, &binding)?.into_iter().map(|r| (file, r)));
            bar.inc(1);
        }
        bar.finish_and_clear();
        let summaries: Vec<Summary<'_>> = all.iter().map(|(f, r)| Summary::new(f, r)).collect();
        if self.json {
            print_json(&summaries)?;
        } else {
            summaries.iter().for_each(Summary::print);
        }
        Ok(ExitCode::SUCCESS)
    }
}

impl ConvertArgs {
    fn run(self) -> Result<ExitCode, CliError> {
        let binding = binding(self.binding.as_deref())?;
        let bar = bar(1);
        let trials = if self.salvage {
            let loaded = salvage(&self.from, &binding)?;
            match &loaded.damage {
                Some(damage) => eprintln!("phantom: {damage}; what stands before it is taken"),
                None => eprintln!("phantom: {} is not damaged", self.from.display()),
            }
            loaded.trials
        } else {
            read_trials(&self.from, &binding)?
        };
        for (index, recording) in trials.iter().enumerate() {
            let path = if trials.len() > 1 {
                numbered(&self.to, index + 1)
            } else {
                self.to.clone()
            };
            write(&path, recording)?;
        }
        bar.finish_and_clear();
        let samples: usize = trials
            .iter()
            .flat_map(|r| &r.streams)
            .map(Stream::len)
            .sum();
        println!("{} recordings, {samples} samples", trials.len());
        Ok(ExitCode::SUCCESS)
    }
}

/// `out.csv.gz` → `out-3.csv.gz`.
fn numbered(path: &Path, number: usize) -> PathBuf {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let (stem, ending) = name.split_once('.').unwrap_or((&name, ""));
    path.with_file_name(format!("{stem}-{number}.{ending}"))
}

impl CheckArgs {
    fn run(self) -> Result<ExitCode, CliError> {
        let binding = binding(self.binding.as_deref())?;
        let model = self.model.as_deref().map(load_model).transpose()?;
        let bar = bar(self.files.len());
        let mut findings = Vec::new();
        for file in &self.files {
            findings.extend(check_file(file, &binding, model.as_ref())?);
            bar.inc(1);
        }
        bar.finish_and_clear();
        let count = |severity| {
            findings
                .iter()
                .filter(|f: &&Finding| f.severity == severity)
                .count()
        };
        let (errors, warnings) = (count(Severity::Error), count(Severity::Warning));
        if self.json {
            print_json(&findings)?;
        } else {
            for finding in &findings {
                println!("{finding}");
            }
            println!(
                "{} files, {errors} errors, {warnings} warnings",
                self.files.len()
            );
        }
        Ok(ExitCode::from(u8::from(errors > 0)))
    }
}
