//! `phantom bench`: speed and memory, as ratios.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use indicatif::ProgressBar;
use serde::Serialize;

use super::{CliError, count, load_model, model_path, thread_count};
use crate::bench::{measure, measure_recording};
use crate::run_dir;
use crate::train::config::TrainConfig;

/// Measure speed and memory
///
/// Ratios are taken within one run, against a bare `mj_step` loop through the same states. Takes about a minute.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom bench
  phantom bench --threads 2 --json bench.json
  phantom bench --recording log.mcap --json bench.json    only write and read a recording, and keep it")]
pub(super) struct BenchArgs {
    /// Model (MJCF) [default: xml/phantom.xml]
    #[arg(long, value_name = "FILE.xml")]
    model: Option<PathBuf>,
    /// Worker threads [default: one a core]
    #[arg(long, value_name = "T", value_parser = count)]
    threads: Option<usize>,
    /// Iterations of training before measuring, to bring the fingers into contact
    #[arg(long, value_name = "N", default_value = "15", value_parser = count)]
    warm_up: usize,
    /// Measure recordings only: write one of 60 s, 60 channels, 2 kHz to this file, and read it
    #[arg(long, value_name = "FILE.mcap", conflicts_with_all = ["model", "threads", "warm_up"])]
    recording: Option<PathBuf>,
    /// Write the figures as JSON
    #[arg(long, value_name = "FILE.json")]
    json: Option<PathBuf>,
}

impl BenchArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        if let Some(file) = &self.recording {
            return self.run_recording(file);
        }
        let model = load_model(&model_path(self.model.as_deref()))?;
        let bar = ProgressBar::new(self.warm_up as u64 + 15);
        let figures = measure(
            &model,
            &TrainConfig::default(),
            thread_count(self.threads),
            self.warm_up,
            || bar.inc(1),
        )?;
        bar.finish_and_clear();
        self.write(&figures)?;
        let f = &figures;
        println!(
            "closed_loop_ratio {:8.3}   sampler / bare mj_step loop, one thread, same states",
            f.closed_loop_ratio
        );
        println!(
            "thread_scaling    {:8.3}   {} threads / one",
            f.thread_scaling, f.threads
        );
        println!("update_share      {:8.3}   of an iteration", f.update_share);
        println!("peak_mb           {:8.0}", f.peak_mb);
        println!(
            "physics steps/s: bare {:.0}, sampler {:.0}, all threads {:.0}; {:.1} contacts, {:.0} constraint rows",
            f.bare_steps_per_s,
            f.closed_loop_steps_per_s,
            f.all_threads_steps_per_s,
            f.mean_contacts,
            f.mean_constraint_rows
        );
        Ok(ExitCode::SUCCESS)
    }

    fn run_recording(&self, file: &Path) -> Result<ExitCode, CliError> {
        let bar = ProgressBar::new_spinner().with_message("writing and reading a recording");
        bar.enable_steady_tick(std::time::Duration::from_millis(100));
        let f = measure_recording(file)?;
        bar.finish_and_clear();
        self.write(&f)?;
        println!("write_s           {:8.3}", f.write_s);
        println!("read_s            {:8.3}", f.read_s);
        println!(
            "read_peak_mb      {:8.0}",
            f.read_peak_mb.unwrap_or(f64::NAN)
        );
        println!("{} numbers in {:.1} MB", f.numbers, f.file_mb);
        Ok(ExitCode::SUCCESS)
    }

    /// The figures as JSON, if asked for.
    fn write(&self, figures: &impl Serialize) -> Result<(), CliError> {
        let Some(file) = &self.json else {
            return Ok(());
        };
        let text = serde_json::to_string_pretty(figures).map_err(|error| CliError::File {
            file: file.clone(),
            reason: error.to_string(),
        })?;
        Ok(run_dir::write_atomic(file, (text + "\n").as_bytes())?)
    }
}
