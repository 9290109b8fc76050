//! `phantom gap`: what a model lacks.

mod bench;
pub(super) mod write;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::{Args, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};

use super::sysid::arguments::{Named, read_all};
use super::{CliError, count, interruption, load_model, model_path, positive, read_toml};
use crate::compare::Settings;
use crate::gap::effect::ModelFile;
use crate::gap::result::Verdict;
use crate::gap::{self, GapError, Input, Options, Stage, figures};
use crate::sysid::problem::ProblemConfig;

/// Find, name and add the physics that a model lacks
///
/// Fits the parameters, looks where model and recordings still disagree, tests every effect of the catalogue at every
/// place, adds those that the recordings ask for, and shows the gap on held-out recordings. Writes into DIR: gap.json,
/// report.html (works without network), model.xml (the model file with the effects) and model.diff. A run that was
/// stopped or killed goes on from its finished stages, which are in DIR/stages until the end.
///
/// Exit code 0: effects were found, or nothing is missing; 1: something is missing that no effect explains. See
/// docs/gap.md.
#[derive(Debug, Args)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = "Examples:
  phantom gap --model arm.xml --parameters arm.toml --train a.mcap b.mcap --holdout c.mcap --out gap
  phantom gap --model emps.xml --parameters mass.toml --train emps_train.csv --holdout emps_pulses.csv \\
      --binding bindings/emps.toml --protocol bindings/emps.protocol.toml --out gap
  phantom gap --model cube.xml --train tosses.csv.gz --holdout tosses.csv.gz --binding bindings/cube_toss.toml \\
      --protocol bindings/cube_toss.protocol.toml --out gap             tosses, by whole rollouts
  phantom gap --parameters contact.toml --train slide.mcap push.mcap --holdout other.mcap --out gap
                                                                      machines that push a body
  phantom gap --parameters finger.toml --train free.mcap --out gap --max-effects 1 --json
  phantom gap bench --suite suites/arm.toml --out blind               how often it is right"
)]
pub(super) struct GapArgs {
    #[command(subcommand)]
    command: Option<GapCommand>,
    #[command(flatten)]
    search: SearchArgs,
}

#[derive(Debug, Subcommand)]
enum GapCommand {
    Bench(bench::BenchArgs),
}

impl GapArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        match self.command {
            Some(GapCommand::Bench(args)) => args.run(),
            None => self.search.run(),
        }
    }
}

#[derive(Debug, Args)]
struct SearchArgs {
    /// Model (MJCF) [default: xml/phantom.xml]
    #[arg(long, value_name = "FILE.xml")]
    model: Option<PathBuf>,
    /// What is fitted in any case, with priors, noise and norms (TOML), as in `phantom sysid`
    #[arg(long, value_name = "FILE.toml")]
    parameters: Option<PathBuf>,
    /// Recordings to find and fit what is missing: .mcap, .csv or .csv.gz
    #[arg(long, value_name = "FILE", num_args = 1.., required = true)]
    train: Vec<PathBuf>,
    /// Recordings to verify it
    #[arg(long, value_name = "FILE", num_args = 1..)]
    holdout: Vec<PathBuf>,
    /// Folder for the results; made if need be
    #[arg(long, value_name = "DIR", default_value = "gap")]
    out: PathBuf,
    /// Names, scales and units of the recordings' channels (TOML)
    #[arg(long, value_name = "FILE.toml")]
    binding: Option<PathBuf>,
    /// How held-out recordings are compared, as in `phantom compare` (TOML); with `[drop]` whole rollouts are searched
    #[arg(long, value_name = "FILE.toml")]
    protocol: Option<PathBuf>,
    /// Most effects; the same at several places is one
    #[arg(long, value_name = "N", default_value = "4", value_parser = count)]
    max_effects: usize,
    /// Look for these effects only, and for the dry friction that one of them varies [default: all of the catalogue]
    #[arg(long, value_name = "EFFECT", num_args = 1..)]
    effects: Vec<String>,
    /// Seed of what is drawn
    #[arg(long, value_name = "S", default_value = "0")]
    seed: u64,
    /// Length of the windows that are simulated, s [default: from the recordings]
    #[arg(long, value_name = "S", value_parser = positive)]
    window: Option<f64>,
    /// Pull simulations of whole recordings along their motion at this natural frequency, Hz, instead of windows [default:
    /// 5 where the machine pushes or presses a free body and no window is given]
    #[arg(long, value_name = "HZ", value_parser = positive, conflicts_with = "window")]
    pull: Option<f64>,
    /// Simulate in steps of this length, s [default: the model's; pulled simulations: up to 0.001 where contacts allow]
    #[arg(long, value_name = "S", value_parser = positive)]
    timestep: Option<f64>,
    /// Print gap.json
    #[arg(long)]
    json: bool,
}

impl SearchArgs {
    fn run(self) -> Result<ExitCode, CliError> {
        let path = model_path(self.model.as_deref());
        load_model(&path)?;
        let model = ModelFile::load(&path).map_err(GapError::from)?;
        let config: ProblemConfig = match &self.parameters {
            Some(file) => read_toml(file)?,
            None => ProblemConfig::default(),
        };
        let protocol: Settings = match &self.protocol {
            Some(file) => read_toml(file)?,
            None => Settings::default(),
        };
        protocol.check()?;
        let [train, holdout] = self.recordings(&protocol)?;
        let folder = write::Folder::new(&self.out)?;
        let input = Input {
            model: &model,
            config: &config,
            train: &train,
            holdout: &holdout,
            protocol: &protocol,
        };
        let options = Options {
            max_effects: self.max_effects,
            seed: self.seed,
            window_s: self.window,
            pull_hz: self.pull,
            timestep_s: self.timestep,
            effects: self.effects.clone(),
            ..Options::default()
        };
        let mut stages = write::Stages::new(&folder, &gap::key(&input, &options))?;
        let watch = Progress::new();
        let outcome = gap::resume(&input, &options, &mut stages, &mut |stage, note, part| {
            watch.see(stage, note, part)
        });
        watch.bar.finish_and_clear();
        let outcome = outcome?;
        let title = format!("What {} lacks", path.display());
        let written = folder.write(&title, &model, &outcome)?;
        stages.finish()?;
        if self.json {
            println!("{}", written.json);
        } else {
            for line in figures::summary(&outcome.answer) {
                println!("{line}");
            }
            println!("model: {}", written.model.display());
            println!("report: {}", written.report.display());
        }
        Ok(ExitCode::from(u8::from(
            outcome.answer.verdict == Verdict::Unknown,
        )))
    }

    /// Recordings to train and held-out ones; a protocol that splits trials by their number does so here too.
    fn recordings(&self, protocol: &Settings) -> Result<[Named; 2], CliError> {
        let mut train = read_all(&self.train, self.binding.as_deref())?;
        let mut holdout = read_all(&self.holdout, self.binding.as_deref())?;
        if protocol.except_multiples_of.is_some() {
            train.retain(|(_, r)| !protocol.uses_trial(&r.meta.trial));
            holdout.retain(|(_, r)| protocol.uses_trial(&r.meta.trial));
        }
        if train.is_empty() {
            return Err(refuse(&self.train[0], "no trial is left to train with"));
        }
        Ok([train, holdout])
    }
}

fn refuse(file: &Path, reason: &str) -> CliError {
    CliError::File {
        file: file.to_owned(),
        reason: reason.to_owned(),
    }
}

/// Shows stages, and says when to stop.
struct Progress {
    bar: ProgressBar,
    interrupted: Arc<AtomicBool>,
}

impl Progress {
    fn new() -> Self {
        let bar = ProgressBar::new_spinner();
        if let Ok(style) = ProgressStyle::with_template("{spinner} {elapsed} {msg}") {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(100));
        Self {
            bar,
            interrupted: interruption("stopping"),
        }
    }

    fn see(&self, stage: Stage, note: &str, part: Option<f64>) -> bool {
        let part = part.map_or(String::new(), |p| format!(" · {:.0} %", 100.0 * p));
        let note = if note.is_empty() {
            String::new()
        } else {
            format!(" · {note}")
        };
        self.bar
            .set_message(format!("{}{note}{part}", stage.name()));
        !self.interrupted.load(Ordering::SeqCst)
    }
}
