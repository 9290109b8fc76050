//! `phantom adapt`: record, identify, train, test; again.

mod missing;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::{Args, ValueEnum};
use indicatif::ProgressBar;
use serde_json::json;

use super::{
    CliError, count, interruption, load_model, model_path, positive, read_toml, thread_count,
};
use crate::adapt::{
    AdaptConfig, AdaptError, Adaptation, Objective, Reference, Tracking, Watch, report,
};
use crate::policy::AffineGaussian;
use crate::rig::{Rig, RigConfig};
use crate::rollout::RolloutError;
use crate::run_dir::{self, Provenance};
use crate::sysid::problem::ProblemConfig;

/// What training on the posterior is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ObjectiveName {
    /// the mean over the models
    Mean,
    /// the worst share of the trajectories, see --epsilon
    Epopt,
}

/// Adapt a policy to a machine: record, identify, train on the posterior, test; again
///
/// Each round lets the machine follow the spiral under the current policy and do what identifies it, finds physics that the
/// model lacks (`phantom gap`), estimates the parameters of both from all recordings so far, trains on models drawn from their posterior, and tests the policy on the machine.
/// Beside it, as long a training on the nominal model and on the rig's truth. Writes DIR/adapt.html, DIR/result.json, a
/// figure as SVG and PNG, and all steps; what is there is used again, so that a loop that was stopped or killed goes on.
///
/// Exit code 0: the last policy tracks better than that of the nominal model; 1: it does not, or the loop was stopped.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom adapt --rig machine.toml --policy policy_best.json --parameters fingers.toml --out loop
  phantom adapt --rig machine.toml --policy policy_best.json --parameters fingers.toml --out loop \\
      --rounds 3 --objective epopt --epsilon 0.25
  phantom adapt --rig machine.toml --policy policy_best.json --parameters fingers.toml --out loop --config adapt.toml")]
pub(super) struct AdaptArgs {
    /// The machine: rig file (TOML)
    #[arg(long, value_name = "RIG.toml")]
    rig: PathBuf,
    /// Policy to begin with, trained on the nominal model
    #[arg(long, value_name = "FILE.json")]
    policy: PathBuf,
    /// What to identify (TOML), as for `phantom sysid`
    #[arg(long, value_name = "FILE.toml")]
    parameters: PathBuf,
    /// Folder of the loop; made if need be
    #[arg(long, value_name = "DIR", default_value = "adapt")]
    out: PathBuf,
    /// Settings (TOML): rounds, behaviours, seconds, models, objective, rollouts, training; see docs/adapt.md
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// Nominal model (MJCF) [default: that of the rig file]
    #[arg(long, value_name = "FILE.xml")]
    model: Option<PathBuf>,
    /// Times round the loop
    #[arg(long, value_name = "N", value_parser = count)]
    rounds: Option<usize>,
    /// Policy updates of each round
    #[arg(long, value_name = "N", value_parser = count)]
    iterations: Option<usize>,
    /// What training on the posterior is for
    #[arg(long, value_enum)]
    objective: Option<ObjectiveName>,
    /// Most effects that are looked for in a round; 0: none
    #[arg(long, value_name = "N")]
    max_effects: Option<usize>,
    /// Share of the trajectories, the worst, of --objective epopt [default: 0.25]
    #[arg(long, value_name = "SHARE", value_parser = positive)]
    epsilon: Option<f64>,
    /// Seed of training and of the models drawn
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
    /// Leave out the trainings on the nominal model and on the truth
    #[arg(long)]
    no_references: bool,
    /// Worker threads; results do not depend on it [default: one a core]
    #[arg(long, value_name = "T", value_parser = count)]
    threads: Option<usize>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Shows what is done, and ends it when the user asks.
struct Bar {
    spinner: ProgressBar,
    interrupted: Arc<AtomicBool>,
    stage: String,
    n: u64,
}

impl Watch for Bar {
    fn stage(&mut self, text: &str) {
        text.clone_into(&mut self.stage);
        self.n = 0;
        self.spinner.set_message(text.to_owned());
    }

    fn advanced(&mut self) -> bool {
        self.n += 1;
        let text = format!("{} · iteration {}", self.stage, self.n);
        self.spinner.set_message(text);
        !self.interrupted.load(Ordering::SeqCst)
    }
}

impl AdaptArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        let adaptation = self.adaptation()?;
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(adaptation.threads)
            .build()
            .map_err(|error| RolloutError::Threads {
                threads: adaptation.threads,
                reason: error.to_string(),
            })?;
        let mut bar = Bar {
            spinner: ProgressBar::new_spinner(),
            interrupted: interruption("finishing this iteration"),
            stage: String::new(),
            n: 0,
        };
        bar.spinner.enable_steady_tick(Duration::from_millis(100));
        let outcome = pool.install(|| self.all(&adaptation, &mut bar))?;
        bar.spinner.finish_and_clear();
        let Some((rounds, references)) = outcome else {
            println!("stopped; the same command goes on");
            return Ok(ExitCode::FAILURE);
        };
        let lacking = if references.is_empty() {
            Vec::new()
        } else {
            let truth = adaptation.rig.true_model();
            truth.map_err(AdaptError::from)?.1
        };
        let page = report(&adaptation.config, &rounds, &references, &lacking);
        let result = json!({
            "provenance": Provenance::capture(adaptation.threads, std::env::args()),
            "config": adaptation.config,
            "truth": adaptation.rig.truth(),
            "truth_model_lacks": lacking,
            "rounds": rounds,
            "references": references.iter().map(|(name, t)| json!({"name": name, "tracking": t})).collect::<Vec<_>>(),
        });
        self.write(&page, &result)?;
        let last = |t: &[Tracking]| t.last().map_or(f64::NAN, |t| t.mean_cm);
        let before = references
            .iter()
            .find(|(name, _)| *name == "nominal")
            .map_or(rounds[0].tracking.mean_cm, |(_, t)| last(t));
        let after = rounds.last().map_or(f64::NAN, |r| r.tracking.mean_cm);
        Ok(ExitCode::from(u8::from(after >= before)))
    }

    /// The loop and its references; nothing when the user stopped.
    fn all(&self, adaptation: &Adaptation, bar: &mut Bar) -> Result<Option<Outcome>, CliError> {
        let Some(rounds) = adaptation.run(&mut missing::find, bar)? else {
            return Ok(None);
        };
        let mut references = Vec::new();
        if !self.no_references {
            for (name, which) in [("nominal", Reference::Nominal), ("truth", Reference::Truth)] {
                let Some(tracking) = adaptation.reference(which, bar)? else {
                    return Ok(None);
                };
                references.push((name, tracking));
            }
        }
        Ok(Some((rounds, references)))
    }

    fn adaptation(&self) -> Result<Adaptation, CliError> {
        let mut config: AdaptConfig = match &self.config {
            Some(file) => read_toml(file)?,
            None => AdaptConfig::default(),
        };
        config.rounds = self.rounds.unwrap_or(config.rounds);
        config.max_effects = self.max_effects.unwrap_or(config.max_effects);
        if let Some(iterations) = self.iterations {
            config.training.train.iterations = iterations as u64;
        }
        if let Some(seed) = self.seed {
            config.training.train.seed = seed;
        }
        config.objective = match (self.objective, self.epsilon, config.objective) {
            (Some(ObjectiveName::Mean), ..) => Objective::Mean,
            (Some(ObjectiveName::Epopt), share, _) => Objective::Epopt(share.unwrap_or(0.25)),
            (None, Some(share), _) => Objective::Epopt(share),
            (None, None, objective) => objective,
        };
        config.validate()?;
        let rig: RigConfig = read_toml(&self.rig)?;
        let model_path = match (&self.model, &rig.model) {
            (None, Some(path)) => self.rig.parent().unwrap_or(Path::new(".")).join(path),
            (named, _) => model_path(named.as_deref()),
        };
        let model = load_model(&model_path)?;
        let policy: AffineGaussian = run_dir::read_json(&self.policy)?;
        Ok(Adaptation {
            out: self.out.clone(),
            rig: Rig::new(model.try_clone()?, rig).map_err(|source| CliError::Rig {
                file: self.rig.clone(),
                source,
            })?,
            model_path: std::path::absolute(&model_path).unwrap_or(model_path),
            model: Arc::new(model),
            policy,
            parameters: read_toml::<ProblemConfig>(&self.parameters)?,
            config,
            threads: thread_count(self.threads),
        })
    }

    fn write(
        &self,
        page: &crate::report::Report,
        result: &serde_json::Value,
    ) -> Result<(), CliError> {
        let file = |name: &str| self.out.join(name);
        let text = serde_json::to_string_pretty(result).map_err(|error| CliError::File {
            file: file("result.json"),
            reason: error.to_string(),
        })?;
        run_dir::write_atomic(&file("result.json"), (text.clone() + "\n").as_bytes())?;
        run_dir::write_atomic(&file("adapt.html"), page.html()?.as_bytes())?;
        super::write_figures(&self.out, page)?;
        if self.json {
            println!("{text}");
            return Ok(());
        }
        for table in page.tables() {
            println!("{}", table.text());
        }
        println!("report: {}", file("adapt.html").display());
        Ok(())
    }
}

/// Rounds, and names with trackings.
type Outcome = (Vec<crate::adapt::Round>, Vec<(&'static str, Vec<Tracking>)>);

impl From<AdaptError> for CliError {
    fn from(error: AdaptError) -> Self {
        match error {
            AdaptError::Folder(error) => error.into(),
            AdaptError::RunDir(error) => error.into(),
            AdaptError::Train(error) => error.into(),
            AdaptError::Sysid(error) => error.into(),
            AdaptError::Mujoco(error) => error.into(),
            other => Self::Adapt(Box::new(other)),
        }
    }
}
