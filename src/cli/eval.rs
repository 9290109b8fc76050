//! `phantom eval`: the paper's test.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use clap::{Args, ValueEnum};

use super::{CliError, count, load_model, model_path, not_negative, positive, thread_count};
use crate::evaluate::{Evaluation, EvaluationRequest, evaluate};
use crate::policy::AffineGaussian;
use crate::randomise::Randomiser;
use crate::rollout::RolloutError;
use crate::run_dir;
use crate::task::Task;
use crate::task::push::{PushConfig, PushTask};
use crate::train::config::ensemble_rules;

/// Path of the target.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum TargetPath {
    /// out to 4 cm in 2 s, then one full circle in 2 s
    Spiral,
}

/// Test a policy: follow a target on a spiral, as in the paper's Table 1
///
/// The mean action of the policy, at the model's own time step (2 kHz). Rollouts differ in the start of the fingers and
/// in the positions of the bases. Prints the mean distance between object and target; writes every step as CSV.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom eval --policy runs/seed3/policy_best.json
  phantom eval --policy policy.json --mass 0.4 --rollouts 50 --json result.json
  phantom eval --policy policy.json --base-sigma 0     bases exactly where the model has them")]
pub(super) struct EvalArgs {
    /// Policy file, as written by `phantom train`
    #[arg(long, value_name = "FILE.json")]
    policy: PathBuf,
    /// Model (MJCF) [default: xml/phantom.xml]
    #[arg(long, value_name = "FILE.xml")]
    model: Option<PathBuf>,
    /// Path of the target
    #[arg(long, value_enum, default_value = "spiral")]
    path: TargetPath,
    /// Number of rollouts
    #[arg(long, value_name = "N", default_value = "10", value_parser = count)]
    rollouts: usize,
    /// Object mass, kg [default: the model's]
    #[arg(long, value_name = "KG", value_parser = positive, allow_negative_numbers = true)]
    mass: Option<f64>,
    /// Standard deviation of each base's position in x and y, m
    #[arg(long, value_name = "M", default_value = "0.005", value_parser = not_negative, allow_negative_numbers = true)]
    base_sigma: f64,
    /// Seed of starts and base positions
    #[arg(long, value_name = "S", default_value = "0")]
    seed: u64,
    /// Worker threads [default: one a core]
    #[arg(long, value_name = "T", value_parser = count)]
    threads: Option<usize>,
    /// Write the result as JSON
    #[arg(long, value_name = "FILE.json")]
    json: Option<PathBuf>,
    /// Where every step goes [default: beside the policy, as NAME.spiral.csv]
    #[arg(long, value_name = "FILE.csv")]
    steps: Option<PathBuf>,
}

impl EvalArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        let TargetPath::Spiral = self.path;
        let policy: AffineGaussian = run_dir::read_json(&self.policy)?;
        let model = load_model(&model_path(self.model.as_deref()))?;
        let task = PushTask::new(&model, PushConfig::default())?;
        policy
            .check(task.n_observation(), task.n_action())
            .map_err(|source| CliError::Policy {
                file: self.policy.clone(),
                source,
            })?;
        let randomiser = Randomiser::new(&model, &ensemble_rules(self.base_sigma, self.mass, 0.0))?;

        let threads = thread_count(self.threads);
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .map_err(|error| RolloutError::Threads {
                threads,
                reason: error.to_string(),
            })?;
        let model = Arc::new(model);
        let request = EvaluationRequest {
            n_rollout: self.rollouts,
            seed: self.seed,
        };
        let evaluation = pool.install(|| evaluate(&model, &task, &randomiser, &policy, request))?;

        let steps = self
            .steps
            .clone()
            .unwrap_or_else(|| self.policy.with_extension("spiral.csv"));
        write_steps(&steps, &evaluation)?;
        if let Some(file) = &self.json {
            let text =
                serde_json::to_string_pretty(&evaluation).map_err(|error| CliError::File {
                    file: file.clone(),
                    reason: error.to_string(),
                })?;
            run_dir::write_atomic(file, (text + "\n").as_bytes())?;
        }
        print(&evaluation, &steps);
        let broke_down = evaluation.rollouts.iter().any(|r| r.diverged.is_some());
        Ok(ExitCode::from(u8::from(broke_down)))
    }
}

fn print(evaluation: &Evaluation, steps: &Path) {
    println!("rollout  mean distance   rms torque");
    for (index, rollout) in evaluation.rollouts.iter().enumerate() {
        let note = rollout
            .diverged
            .as_ref()
            .map_or(String::new(), |reason| format!("  diverged: {reason}"));
        println!(
            "{index:7}  {:10.2} cm  {:7.3} N m{note}",
            rollout.mean_distance_cm, rollout.rms_torque_nm
        );
    }
    println!(
        "mean distance object-target {:.2} cm (standard deviation {:.2} cm over {} rollouts)",
        evaluation.mean_distance_cm,
        evaluation.std_cm,
        evaluation.rollouts.len()
    );
    println!("every step: {}", steps.display());
}

/// One row a step: rollout, time, target, object, distance.
fn write_steps(path: &Path, evaluation: &Evaluation) -> Result<(), CliError> {
    let failed = |error: csv::Error| CliError::File {
        file: path.to_owned(),
        reason: error.to_string(),
    };
    let mut csv = csv::Writer::from_writer(Vec::new());
    csv.write_record([
        "rollout",
        "time_s",
        "target_x_m",
        "target_y_m",
        "object_x_m",
        "object_y_m",
        "distance_cm",
    ])
    .map_err(failed)?;
    for (index, rollout) in evaluation.rollouts.iter().enumerate() {
        for step in &rollout.steps {
            let [tx, ty] = step.target_m;
            let [ox, oy] = step.object_m;
            csv.serialize((index, step.time_s, tx, ty, ox, oy, step.distance_cm))
                .map_err(failed)?;
        }
    }
    let bytes = csv.into_inner().map_err(|error| CliError::File {
        file: path.to_owned(),
        reason: error.to_string(),
    })?;
    Ok(run_dir::write_atomic(path, &bytes)?)
}
