//! `phantom train`: the main job, by one process or by a team of them.

mod plan;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use serde::{Deserialize, Serialize};

use super::{CliError, count, interruption, positive, thread_count};
use crate::randomise::Ensemble;
use crate::rollout::Diverged;
use crate::run_dir::Provenance;
use crate::team::Team;
use crate::train::folder::{POLICY_BEST, RunFolder};
use crate::train::{Checkpoint, IterationRecord, Trainer};
use plan::Plan;

/// Train a policy by natural policy gradient
///
/// Makes a run folder with the resolved configuration, metrics (CSV and event files), checkpoints and policies.
/// Ctrl-C finishes the iteration and saves; the run can then be continued with --resume.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom train                                     the paper's task with shipped settings
  phantom train --seed 3 --out runs/seed3
  phantom train --config examples/ensemble.toml --iterations 100
  phantom train --model id/model.xml --ensemble id/ensemble.toml     models drawn by `phantom sysid`
  phantom train --resume runs/seed3                 continue to the configured number of iterations
  phantom train --resume runs/seed3 --iterations 200
  mpirun -n 4 phantom train                         four processes, to the same bits (docs/mpi.md)")]
pub(super) struct TrainArgs {
    /// Settings (TOML); what it does not name keeps its default
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// Models to train on, drawn by `phantom sysid`: its ensemble.toml
    #[arg(long, value_name = "FILE.toml", conflicts_with = "resume")]
    ensemble: Option<PathBuf>,
    /// Model (MJCF) [default: xml/phantom.xml]
    #[arg(long, value_name = "FILE.xml")]
    model: Option<PathBuf>,
    /// Policy updates, in all
    #[arg(long, value_name = "N", value_parser = count)]
    iterations: Option<usize>,
    /// Seed of every random number
    #[arg(long, value_name = "S", conflicts_with = "resume")]
    seed: Option<u64>,
    /// Object mass in training, kg
    #[arg(long, value_name = "KG", value_parser = positive, allow_negative_numbers = true, conflicts_with = "resume")]
    mass: Option<f64>,
    /// Worker threads; the result does not depend on it [default: one a core]
    #[arg(long, value_name = "T", value_parser = count)]
    threads: Option<usize>,
    /// Run folder [default: runs/DATE-seedS]
    #[arg(long, value_name = "DIR", conflicts_with = "resume")]
    out: Option<PathBuf>,
    /// Continue the run in this folder, to the same bits as if it had never stopped
    #[arg(long, value_name = "DIR", conflicts_with = "config")]
    resume: Option<PathBuf>,
}

/// What `phantom sysid` writes for training.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct EnsembleFile {
    pub(super) ensemble: Ensemble,
}

impl TrainArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        let team = Arc::new(Team::from_environment()?);
        match self.train(&team) {
            // who is alone with an error leaves without a farewell, which ends the others
            Err(error) if error.is_lonely() => Err(error),
            Err(error) => {
                // told once, and before anyone leaves: a launcher may end the others then
                let told = team.is_first().then(|| error.report());
                team.from_first(told.map(|_| ()))?;
                team.finish();
                Ok(error.exit_code())
            }
            outcome => {
                team.finish();
                outcome
            }
        }
    }

    /// Every process of the team does this; errors are those of all of them.
    fn train(&self, team: &Arc<Team>) -> Result<ExitCode, CliError> {
        let first = team.is_first();
        let plan = agree(team, first.then(|| Plan::read(self)).transpose())?;
        let mut plan = team.from_first(plan)?;
        let mut trainer = agree(team, plan.trainer(team, self, thread_count(self.threads)))?;
        let folder = first.then(|| self.open(&plan, &trainer));
        let mut folder = agree(team, folder.transpose())?;

        let interrupted = interruption("finishing this iteration");
        let total = trainer.config().train.iterations;
        let bar = if first {
            progress(total, trainer.checkpoint().iteration)
        } else {
            ProgressBar::hidden()
        };
        let begin = Instant::now();
        let (mut steps, mut message_bytes) = (0, 0);
        while trainer.checkpoint().iteration < total {
            let record = match trainer.advance() {
                Ok(record) => record,
                Err(error) => {
                    // what stopped the run comes first, whether or not it can be dumped
                    let dumped = folder.as_ref().map(|f| f.dump_unreported(&trainer));
                    if let Some(Err(failure)) = dumped {
                        bar.suspend(|| eprintln!("phantom: {failure}"));
                    }
                    return Err(error.into());
                }
            };
            steps += record.physics_steps;
            message_bytes = record.message_bytes;
            let stop = team.all(&interrupted.load(Ordering::SeqCst), |a, b| a || b)?;
            let last = record.iteration == total || stop;
            let saved = folder.as_mut().map(|f| f.save(&trainer, &record, last));
            agree(team, saved.transpose().map_err(CliError::from))?;
            if first {
                let steps_per_s = steps as f64 / begin.elapsed().as_secs_f64();
                show(&bar, &record, trainer.checkpoint(), steps_per_s);
            }
            if stop {
                break;
            }
        }
        bar.finish_and_clear();
        if let Some(folder) = folder {
            summarise(&trainer, folder.path(), message_bytes);
        }
        Ok(ExitCode::SUCCESS)
    }
}

impl TrainArgs {
    /// A new folder, or that of the run to be resumed.
    fn open(&self, plan: &Plan, trainer: &Trainer) -> Result<RunFolder, CliError> {
        if let Some(folder) = &self.resume {
            return Ok(RunFolder::resume(folder, &plan.model, trainer)?);
        }
        let threads = trainer.sampler().threads().current_num_threads();
        let provenance = Provenance::capture(threads, std::env::args());
        let provenance = provenance.in_team(trainer.team().size());
        let out = self.out.clone().unwrap_or_else(|| {
            let digits = provenance.started.chars().filter(char::is_ascii_digit);
            let date: String = digits.take(14).collect();
            PathBuf::from(format!("runs/{date}-seed{}", trainer.config().train.seed))
        });
        Ok(RunFolder::create(out, &plan.model, trainer, &provenance)?)
    }
}

/// Go on only if every process can.
fn agree<T>(team: &Team, result: Result<T, CliError>) -> Result<T, CliError> {
    team.agree(result, CliError::is_fatal)
}

fn read(path: &Path) -> Result<Vec<u8>, CliError> {
    std::fs::read(path).map_err(|reason| CliError::File {
        file: path.to_owned(),
        reason: reason.to_string(),
    })
}

fn progress(total: u64, done: u64) -> ProgressBar {
    let bar = ProgressBar::new(total).with_position(done);
    let style = ProgressStyle::with_template("{bar:24} {pos}/{len} {wide_msg} {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    bar.set_style(style);
    bar.reset_eta();
    bar.tick();
    bar
}

fn show(bar: &ProgressBar, record: &IterationRecord, state: &Checkpoint, steps_per_s: f64) {
    let kl = record.update.as_ref().map_or(f64::NAN, |u| u.kl_measured);
    let best = state
        .best_distance_cm
        .map_or(String::new(), |best| format!(" · spiral {best:.2} cm"));
    bar.set_message(format!(
        "reward {:.3} · object {:.2} cm{best} · KL {kl:.3} · {:.0}k steps/s",
        record.reward,
        record.final_distance_cm,
        1e-3 * steps_per_s
    ));
    bar.inc(1);
    if let Err(reason) = &record.update {
        bar.suspend(|| {
            eprintln!(
                "phantom: iteration {}: no update: {reason}",
                record.iteration
            );
        });
    }
    if let Some(Diverged { reason, .. }) = record.diverged.first() {
        let n = record.n_diverged;
        bar.suspend(|| {
            eprintln!(
                "phantom: iteration {}: {n} trajectories diverged, left out ({reason})",
                record.iteration
            );
        });
    }
}

fn summarise(trainer: &Trainer, folder: &Path, message_bytes: u64) {
    let (state, folder) = (trainer.checkpoint(), folder.display());
    println!(
        "{} iterations, {:.1} million physics steps, {:.0} s",
        state.iteration,
        1e-6 * state.physics_steps as f64,
        state.seconds
    );
    if !trainer.symmetries().is_empty() {
        println!(
            "the policy is the same after each of {} turns and mirror images of the machine (train.symmetric)",
            trainer.symmetries().len()
        );
    }
    if trainer.team().size() > 1 {
        println!(
            "{} processes, {:.0} kB of messages an iteration at most at each",
            trainer.team().size(),
            1e-3 * message_bytes as f64
        );
    }
    if let Some(best) = state.best_distance_cm {
        println!("best on the spiral: {best:.2} cm mean distance (paper, simulation: 2.1 cm)");
        println!("test it:  phantom eval --policy {folder}/{POLICY_BEST}");
    }
    if state.iteration < trainer.config().train.iterations {
        println!("continue: phantom train --resume {folder}");
    } else {
        println!("files:    {folder}");
    }
}
