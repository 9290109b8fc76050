//! `phantom bench`: speed and memory, as ratios.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use indicatif::ProgressBar;

use super::{CliError, count, load_model, model_path, thread_count};
use crate::bench::measure;
use crate::run_dir;
use crate::train::config::TrainConfig;

/// Measure speed and memory
///
/// Ratios are taken within one run, against a bare `mj_step` loop through the same states. Takes about a minute.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom bench
  phantom bench --threads 2 --json bench.json")]
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
    /// Write the figures as JSON
    #[arg(long, value_name = "FILE.json")]
    json: Option<PathBuf>,
}

impl BenchArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
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
        if let Some(file) = &self.json {
            let text = serde_json::to_string_pretty(&figures).map_err(|error| CliError::File {
                file: file.clone(),
                reason: error.to_string(),
            })?;
            run_dir::write_atomic(file, (text + "\n").as_bytes())?;
        }
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
}
