//! `phantom sysid`: parameters of a model from recordings.

pub(in crate::cli) mod arguments;
mod design;
mod write;

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};
use indicatif::ProgressBar;
use serde::Serialize;

use self::arguments::FitArgs;
use super::{CliError, interruption, load_model, model_path, read_toml};
use crate::compare::Settings;
use crate::mujoco::Model;
use crate::sysid::fit::{Iteration, Start};
use crate::sysid::problem::{Problem, ProblemConfig};
use crate::sysid::summary::{Outcome, Summary};
use crate::sysid::{check, holdout, leave_out};

/// Identify parameters of a model from recordings
///
/// Estimates the parameters and the whole motion together, through contact. Writes into DIR: model.xml (the model file
/// with the identified numbers), sysid.json, report.html, the estimated motion (motion-*.mcap), and ensemble.toml, models
/// drawn from the posterior that `phantom train --ensemble` takes.
///
/// Exit code 0: done; 1: not converged, or no better than the nominal model on held-out recordings. See docs/sysid.md.
#[derive(Debug, Args)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = "Examples:
  phantom sysid --model arm.xml --parameters arm.toml free.mcap --holdout other.mcap --out id
  phantom sysid --parameters finger.toml sine.mcap chirp.mcap --holdout postures.mcap --out id --ensemble 64
  phantom sysid --model emps.xml --parameters emps.toml log.csv --binding emps_binding.toml --out id --json
  phantom sysid --model arm.xml --parameters arm.toml log.mcap --out id --leave-one-sensor-out
  phantom sysid --model toss.xml --parameters toss.toml tosses.csv.gz --out id --method shooting --window inf
  phantom sysid --model cube.xml --parameters cube.toml tosses.csv.gz --protocol drops.toml --out id --method rollout
  phantom sysid --model push.xml --parameters push.toml push.mcap --out id --method sequential --at-rest
  phantom sysid --model hand.xml --parameters contact.toml slide.mcap push.mcap --out id --method nudging
  phantom sysid design --model arm.xml --parameters arm.toml          what to record next"
)]
pub(super) struct SysidArgs {
    #[command(subcommand)]
    command: Option<SysidCommand>,
    #[command(flatten)]
    fit: FitArgs,
}

#[derive(Debug, Subcommand)]
enum SysidCommand {
    Design(design::DesignArgs),
}

impl SysidArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        match self.command {
            Some(SysidCommand::Design(args)) => args.run(),
            None => self.fit.run(),
        }
    }
}

/// Where the time of a run goes, s.
#[derive(Debug, Clone, Copy, Default, Serialize)]
struct Seconds {
    /// model, parameters and recordings
    read: f64,
    /// the estimator
    estimate: f64,
    /// residuals and intervals
    intervals: f64,
    /// held-out recordings and left-out sensors
    test: f64,
    /// all files but the one with these numbers
    write: f64,
}

/// Seconds since `clock`, which begins anew.
fn lap(clock: &mut Instant) -> f64 {
    std::mem::replace(clock, Instant::now())
        .elapsed()
        .as_secs_f64()
}

/// Shows iterations, and says when to stop.
struct Watch {
    bar: ProgressBar,
    interrupted: Arc<AtomicBool>,
    stage: String,
    n: u64,
}

impl Watch {
    fn new() -> Self {
        let bar = ProgressBar::new_spinner();
        bar.enable_steady_tick(Duration::from_millis(100));
        Self {
            bar,
            interrupted: interruption("keeping the best so far"),
            stage: String::new(),
            n: 0,
        }
    }

    fn begin(&mut self, stage: &str) {
        stage.clone_into(&mut self.stage);
        self.n = 0;
        self.bar.set_message(stage.to_owned());
    }

    fn see(&mut self, i: &Iteration) -> bool {
        self.n += 1;
        let level = if i.level > 0.0 {
            format!(" · unexplained {:.0e}", i.level)
        } else {
            String::new()
        };
        let horizon = (i.horizon_s).map_or_else(String::new, |s| format!(" · first {s:.3} s"));
        self.bar.set_message(format!(
            "{} · iteration {}{level}{horizon} · cost {:.6e} · step {:.1e}",
            self.stage, self.n, i.cost, i.step
        ));
        !self.stopped()
    }

    fn stopped(&self) -> bool {
        self.interrupted.load(Ordering::SeqCst)
    }
}

impl FitArgs {
    fn load(&self, path: &Path) -> Result<Model, CliError> {
        let mut model = load_model(path)?;
        if let Some(timestep) = self.timestep {
            if model.extension().is_some() {
                // what it remembers is counted in steps
                return Err(CliError::File {
                    file: path.to_owned(),
                    reason: "a model with supplements keeps its time step: change it in the file instead of by \
                             --timestep"
                        .to_owned(),
                });
            }
            model.edit().set_timestep(timestep)?;
        }
        Ok(model)
    }

    fn run(&self) -> Result<ExitCode, CliError> {
        let mut seconds = Seconds::default();
        let mut clock = Instant::now();
        let path = model_path(self.model.as_deref());
        let model = Arc::new(self.load(&path)?);
        let config: ProblemConfig = read_toml(self.parameters())?;
        let rollouts: Settings = match &self.protocol {
            Some(file) => read_toml(file)?,
            None => Settings::default(),
        };
        rollouts.check()?;
        let method = self.method(&rollouts)?;
        let [recordings, held_out] = self.recordings(&rollouts)?;
        let problem = Problem::new(Arc::clone(&model), &config, &recordings)?;
        if problem.parameters.is_empty() {
            return Err(CliError::File {
                file: self.parameters().to_owned(),
                reason: "there is no [[parameter]] to estimate".to_owned(),
            });
        }
        if !held_out.is_empty() {
            // a held-out recording that does not fit should not be found out after an hour
            method.fits(&Problem::new(Arc::clone(&model), &config, &held_out)?)?;
        }
        method.fits(&problem)?;
        check::check(&problem, &config, &recordings, &problem.parameters.start())?;
        for note in &problem.notes {
            eprintln!("phantom: {note}");
        }
        let out = write::Folder::new(&self.out, &path, &problem)?;
        seconds.read = lap(&mut clock);

        let mut watch = Watch::new();
        watch.begin("fit");
        let start = Start {
            x: problem.parameters.start(),
            trajectories: None,
            force_scale: None,
        };
        let fit = method.solve(&problem, &start, &mut |i| watch.see(i))?;
        seconds.estimate = lap(&mut clock);
        let outcome = Outcome::new(&problem, &method, &fit)?;
        let mut summary = outcome.summary.clone();
        seconds.intervals = lap(&mut clock);
        if !held_out.is_empty() && !watch.stopped() {
            watch.begin("held-out");
            summary.holdout = holdout::test(
                &problem,
                &fit,
                &config,
                &held_out,
                &method,
                &rollouts,
                &mut |i| watch.see(i),
            )?;
        }
        if self.leave_one_sensor_out {
            for sensor in leave_out::sensors(&problem) {
                if watch.stopped() {
                    break;
                }
                watch.begin(&format!("without {sensor}"));
                let rows = leave_out::without(
                    &problem,
                    &fit,
                    &config,
                    &recordings,
                    &sensor,
                    &method,
                    &mut |i| watch.see(i),
                )?;
                summary
                    .leave_one_sensor_out
                    .extend(rows.unwrap_or_default());
            }
        }
        seconds.test = lap(&mut clock);
        watch.begin("writing");
        let identified = write::Identified {
            problem: &problem,
            fit: &fit,
            outcome: &outcome,
            summary: &summary,
        };
        let written = out.write(self, &identified, seconds, clock)?;
        watch.bar.finish_and_clear();
        self.print(&summary, &written);
        Ok(ExitCode::from(u8::from(!summary.is_good())))
    }

    fn print(&self, summary: &Summary, written: &write::Written) {
        if self.json {
            println!("{}", written.json);
            return;
        }
        for table in write::tables(summary) {
            println!("{}", table.text());
        }
        for line in crate::sysid::figures::sentences(summary) {
            println!("{line}");
        }
        println!("model: {}", written.model.display());
        println!("report: {}", written.report.display());
    }
}
