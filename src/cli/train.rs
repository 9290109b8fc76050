//! `phantom train`: the main job.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::time::Instant;

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use serde::{Deserialize, Serialize};

use super::{CliError, count, interruption, load_model, model_path, positive, thread_count};
use crate::randomise::Ensemble;
use crate::rollout::Diverged;
use crate::run_dir::{self, Metrics, PROVENANCE_FILE, Provenance, RunDir};
use crate::train::config::TrainConfig;
use crate::train::{Checkpoint, IterationRecord, Trainer};

const CONFIG_FILE: &str = "config.toml";
const MODEL_FILE: &str = "model.xml";
const CHECKPOINT_FILE: &str = "checkpoint.json";
const POLICY_LAST: &str = "policy_last.json";
const POLICY_BEST: &str = "policy_best.json";
/// Breakdowns written a run; more of them say nothing new.
const DUMP_LIMIT: u64 = 100;

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
  phantom train --resume runs/seed3 --iterations 200")]
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

/// A dumped breakdown, all that `phantom replay` needs.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Dump {
    pub(super) model: PathBuf,
    pub(super) config: TrainConfig,
    pub(super) diverged: Diverged,
}

/// What `phantom sysid` writes for training.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct EnsembleFile {
    pub(super) ensemble: Ensemble,
}

/// A run folder with everything open.
struct Run {
    dir: RunDir,
    model: PathBuf,
    metrics: Metrics,
    trainer: Trainer,
}

impl TrainArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        let mut run = match &self.resume {
            Some(dir) => self.resume(dir)?,
            None => self.begin()?,
        };
        let interrupted = interruption("finishing this iteration");
        let total = run.trainer.config().train.iterations;
        let bar = progress(total, run.trainer.checkpoint().iteration);
        let begin = Instant::now();
        let mut steps = 0;
        while run.trainer.checkpoint().iteration < total {
            let record = match run.trainer.advance() {
                Ok(record) => record,
                Err(error) => {
                    // what stopped the run comes first, whether or not it can be dumped
                    if let Err(failure) = run.dump_unreported() {
                        bar.suspend(|| eprintln!("phantom: {failure}"));
                    }
                    return Err(error.into());
                }
            };
            steps += record.physics_steps;
            let last = record.iteration == total || interrupted.load(Ordering::SeqCst);
            run.save(&record, last)?;
            show(
                &bar,
                &record,
                run.trainer.checkpoint(),
                steps as f64 / begin.elapsed().as_secs_f64(),
            );
            if interrupted.load(Ordering::SeqCst) {
                break;
            }
        }
        bar.finish_and_clear();
        summarise(&run, total);
        Ok(ExitCode::SUCCESS)
    }

    /// Open a new run folder.
    fn begin(&self) -> Result<Run, CliError> {
        let mut config = match &self.config {
            Some(file) => read_config(file)?,
            None => TrainConfig::default(),
        };
        self.override_config(&mut config);
        if let Some(file) = &self.ensemble {
            let table: EnsembleFile = super::read_toml(file)?;
            config.ensemble = Some(table.ensemble);
        }
        let path = std::path::absolute(model_path(self.model.as_deref()))
            .unwrap_or_else(|_| model_path(self.model.as_deref()));
        let threads = thread_count(self.threads);
        let trainer = Trainer::new(load_model(&path)?, config, threads)?;

        let provenance = Provenance::capture(threads, std::env::args());
        let out = self.out.clone().unwrap_or_else(|| {
            let date: String = provenance
                .started
                .chars()
                .filter(char::is_ascii_digit)
                .take(14)
                .collect();
            PathBuf::from(format!("runs/{date}-seed{}", trainer.config().train.seed))
        });
        let dir = RunDir::create(out)?;
        dir.write_json(PROVENANCE_FILE, &provenance)?;
        let text = toml::to_string(trainer.config()).map_err(|error| CliError::File {
            file: dir.file(CONFIG_FILE),
            reason: error.to_string(),
        })?;
        let header = format!(
            "# resolved settings of this run\n# model: {}\n",
            path.display()
        );
        run_dir::write_atomic(&dir.file(CONFIG_FILE), (header + &text).as_bytes())?;
        run_dir::write_atomic(&dir.file(MODEL_FILE), &read(&path)?)?;
        dir.write_json("model_path.json", &path)?;
        let metrics = Metrics::create(dir.path(), &names(&columns(&trainer)))?;
        Ok(Run {
            dir,
            model: path,
            metrics,
            trainer,
        })
    }

    /// Open the folder of an earlier run.
    fn resume(&self, folder: &Path) -> Result<Run, CliError> {
        let dir = RunDir::open(folder)?;
        let mut config = read_config(&dir.file(CONFIG_FILE))?;
        self.override_config(&mut config);
        let path: PathBuf = match &self.model {
            Some(path) => path.clone(),
            None => dir.read_json("model_path.json")?,
        };
        if read(&path)? != read(&dir.file(MODEL_FILE))? {
            return Err(CliError::File {
                file: path,
                reason: format!(
                    "the model has changed since the run began; its copy is {}",
                    dir.file(MODEL_FILE).display()
                ),
            });
        }
        let mut trainer = Trainer::new(load_model(&path)?, config, thread_count(self.threads))?;
        let checkpoint: Checkpoint = dir.read_json(CHECKPOINT_FILE)?;
        let iteration = checkpoint.iteration;
        trainer
            .restore(checkpoint)
            .map_err(|error| CliError::File {
                file: dir.file(CHECKPOINT_FILE),
                reason: error.to_string(),
            })?;
        let metrics = Metrics::resume(dir.path(), &names(&columns(&trainer)), iteration)?;
        Ok(Run {
            dir,
            model: path,
            metrics,
            trainer,
        })
    }

    fn override_config(&self, config: &mut TrainConfig) {
        if let Some(iterations) = self.iterations {
            config.train.iterations = iterations as u64;
        }
        if let Some(seed) = self.seed {
            config.train.seed = seed;
        }
        if self.mass.is_some() {
            config.train.object_mass_kg = self.mass;
        }
    }
}

impl Run {
    /// Write what an iteration left: metrics, policies, breakdowns, and last the checkpoint that vouches for them.
    fn save(&mut self, record: &IterationRecord, last: bool) -> Result<(), CliError> {
        let state = self.trainer.checkpoint();
        let row = row(record, state);
        let row: Vec<(&str, f64)> = row
            .iter()
            .map(|(name, value)| (name.as_str(), *value))
            .collect();
        self.metrics.row(record.iteration, &row)?;
        let before = state.n_diverged - record.diverged.len() as u64;
        let left = DUMP_LIMIT.saturating_sub(before) as usize;
        self.dump(record.iteration, record.diverged.iter().take(left))?;
        if record.is_best {
            self.dir.write_json(POLICY_BEST, &state.policy)?;
        }
        if last
            || record
                .iteration
                .is_multiple_of(self.trainer.config().train.checkpoint_every)
        {
            self.dir.write_json(POLICY_LAST, &state.policy)?;
            self.dir.write_json(CHECKPOINT_FILE, state)?;
        }
        Ok(())
    }
}

impl Run {
    /// Write breakdowns, so that `phantom replay` can show them.
    fn dump<'a>(
        &self,
        iteration: u64,
        breakdowns: impl Iterator<Item = &'a Diverged>,
    ) -> Result<(), CliError> {
        for (number, diverged) in breakdowns.enumerate() {
            let dump = Dump {
                model: self.model.clone(),
                config: self.trainer.config().clone(),
                diverged: diverged.clone(),
            };
            self.dir
                .write_json(format!("diverged-{iteration:05}-{number:03}.json"), &dump)?;
        }
        Ok(())
    }

    /// Write the breakdowns of an iteration that left nothing to learn from.
    fn dump_unreported(&self) -> Result<(), CliError> {
        let state = self.trainer.checkpoint();
        let left = DUMP_LIMIT.saturating_sub(state.n_diverged) as usize;
        let breakdowns = self.trainer.unreported_breakdowns().take(left);
        self.dump(state.iteration + 1, breakdowns)
    }
}

fn read(path: &Path) -> Result<Vec<u8>, CliError> {
    std::fs::read(path).map_err(|reason| CliError::File {
        file: path.to_owned(),
        reason: reason.to_string(),
    })
}

fn read_config(path: &Path) -> Result<TrainConfig, CliError> {
    let config: TrainConfig = super::read_toml(path)?;
    config.validate().map_err(|source| CliError::Setting {
        file: path.to_owned(),
        source,
    })?;
    Ok(config)
}

const FIXED_COLUMNS: [&str; 25] = [
    "physics_steps",
    "seconds",
    "reward",
    "object_distance_cm",
    "final_distance_cm",
    "eval_distance_cm",
    "eval_std_cm",
    "trajectories",
    "step_size_delta",
    "kl_predicted",
    "kl_measured",
    "gradient_norm2",
    "half_cosine",
    "sigma_nm",
    "advantage_sigma",
    "clipped_share",
    "value_explained_variance",
    "value_condition",
    "n_diverged",
    "update_skipped",
    "physics_steps_per_s",
    "rollout_s",
    "update_s",
    "evaluate_s",
    "best_distance_cm",
];

/// All columns: the fixed ones, and the agreement of half batches over each observation group.
fn columns(trainer: &Trainer) -> Vec<String> {
    let groups = trainer.sampler().task().observation_groups();
    let fixed = FIXED_COLUMNS.iter().map(ToString::to_string);
    fixed
        .chain(
            groups
                .iter()
                .map(|group| format!("half_cosine_{}", group.name)),
        )
        .collect()
}

fn names(columns: &[String]) -> Vec<&str> {
    columns.iter().map(String::as_str).collect()
}

/// The numbers of an iteration by column.
fn row(record: &IterationRecord, state: &Checkpoint) -> Vec<(String, f64)> {
    let mut row: Vec<(String, f64)> = Vec::new();
    let mut put = |name: &str, value: f64| row.push((name.to_owned(), value));
    put("physics_steps", state.physics_steps as f64);
    put("seconds", state.seconds);
    put("reward", record.reward);
    put("object_distance_cm", record.distance_cm);
    put("final_distance_cm", record.final_distance_cm);
    if let Some(evaluation) = &record.evaluation {
        put("eval_distance_cm", evaluation.mean_distance_cm);
        put("eval_std_cm", evaluation.std_cm);
    }
    put("trajectories", record.n_trajectory as f64);
    put("sigma_nm", record.sigma);
    put("n_diverged", state.n_diverged as f64);
    put(
        "update_skipped",
        f64::from(u8::from(record.update.is_err())),
    );
    put(
        "physics_steps_per_s",
        record.physics_steps as f64 / record.rollout_s,
    );
    put("rollout_s", record.rollout_s);
    put("update_s", record.update_s);
    put("evaluate_s", record.evaluate_s);
    put(
        "best_distance_cm",
        state.best_distance_cm.unwrap_or(f64::NAN),
    );
    if let Ok(update) = &record.update {
        put("step_size_delta", 2.0 * update.kl_predicted);
        put("kl_predicted", update.kl_predicted);
        put("kl_measured", update.kl_measured);
        put("gradient_norm2", update.gradient_norm2);
        put("half_cosine", update.half_cosine);
        put("advantage_sigma", update.advantage_sigma);
        put("clipped_share", update.clipped_share);
        if let Some(fit) = update.value_fit {
            put("value_explained_variance", fit.explained_variance);
            put("value_condition", fit.condition);
        }
        for &(name, cosine) in &update.group_cosines {
            put(&format!("half_cosine_{name}"), cosine);
        }
    }
    row
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
    if !record.diverged.is_empty() {
        let first = &record.diverged[0].reason;
        let n = record.diverged.len();
        bar.suspend(|| {
            eprintln!(
                "phantom: iteration {}: {n} trajectories diverged, left out ({first})",
                record.iteration
            );
        });
    }
}

fn summarise(run: &Run, total: u64) {
    let state = run.trainer.checkpoint();
    let folder = run.dir.path().display();
    println!(
        "{} iterations, {:.1} million physics steps, {:.0} s",
        state.iteration,
        1e-6 * state.physics_steps as f64,
        state.seconds
    );
    if let Some(best) = state.best_distance_cm {
        println!("best on the spiral: {best:.2} cm mean distance (paper, simulation: 2.1 cm)");
        println!("test it:  phantom eval --policy {folder}/{POLICY_BEST}");
    }
    if state.iteration < total {
        println!("continue: phantom train --resume {folder}");
    } else {
        println!("files:    {folder}");
    }
}
