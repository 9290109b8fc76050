//! `phantom record`: a recording of a virtual rig.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use indicatif::ProgressBar;
use serde::Serialize;

use super::{CliError, load_model, model_path, positive};
use crate::policy::AffineGaussian;
use crate::recording;
use crate::rig::behaviour::{self, BEHAVIOURS, Behaviour, PolicyBehaviour};
use crate::rig::effects::CATALOGUE;
use crate::rig::{Outcome, Rig, RigConfig, RigError, Trial};
use crate::run_dir;

/// Duration of a policy's trial: the spiral's.
const POLICY_S: f64 = crate::task::spiral::DURATION_S;

/// Record a virtual rig: a machine that is like its model, but not quite
///
/// The rig file says how the truth differs from the model and what the sensors add; the seed draws one machine. The
/// recording holds what a real machine would tell. The truth goes to a file of its own.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom record --list
  phantom record --rig rigs/paper.toml --behaviour multi_sine --out free.mcap
  phantom record --rig rigs/paper.toml --behaviour push --trial 2 --out push2.mcap --truth truth.toml
  phantom record --rig rigs/family.toml --seed 17 --behaviour reversals --out r.mcap --truth r.toml
  phantom record --rig rigs/paper.toml --policy runs/a/policy_best.json --out policy.mcap")]
pub(super) struct RecordArgs {
    /// Rig file (TOML)
    #[arg(long, value_name = "RIG.toml", required_unless_present = "list")]
    rig: Option<PathBuf>,
    /// What the machine does; see --list
    #[arg(long, value_name = "NAME", conflicts_with = "policy", required_unless_present_any = ["list", "policy"])]
    behaviour: Option<String>,
    /// Let a policy push the object along the spiral
    #[arg(long, value_name = "FILE.json")]
    policy: Option<PathBuf>,
    /// Where the recording goes
    #[arg(long, value_name = "FILE.mcap", required_unless_present = "list")]
    out: Option<PathBuf>,
    /// Where the truth goes [default: nowhere]
    #[arg(long, value_name = "TRUTH.toml")]
    truth: Option<PathBuf>,
    /// Which machine [default: `seed` of the rig file]
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
    /// Which trial of the machine: sensor noise and phases differ
    #[arg(long, value_name = "N", default_value = "0")]
    trial: u64,
    /// Duration, s [default: the behaviour's]
    #[arg(long, value_name = "S", value_parser = positive)]
    seconds: Option<f64>,
    /// Write times and counts as JSON
    #[arg(long, value_name = "FILE.json")]
    json: Option<PathBuf>,
    /// Print behaviours and effects
    #[arg(long)]
    list: bool,
}

/// The result in figures.
#[derive(Debug, Serialize)]
struct Summary {
    behaviour: String,
    trial: u64,
    seconds: f64,
    samples: Vec<(String, usize)>,
    simulation_s: f64,
    control_s: f64,
    recording_s: f64,
    recording_ratio: f64,
    diverged: Option<String>,
}

impl RecordArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        if self.list {
            list();
            return Ok(ExitCode::SUCCESS);
        }
        // clap has made sure of both
        let (Some(rig_file), Some(out)) = (&self.rig, &self.out) else {
            return Ok(ExitCode::from(2));
        };
        let at = |source| CliError::Rig {
            file: rig_file.clone(),
            source,
        };
        let mut config: RigConfig = super::read_toml(rig_file)?;
        config.seed = self.seed.unwrap_or(config.seed);
        let model_file = match &config.model {
            Some(path) => rig_file.parent().unwrap_or(Path::new(".")).join(path),
            None => model_path(None),
        };
        let rig = Rig::new(load_model(&model_file)?, config).map_err(at)?;
        let (mut behaviour, trial) = self.behaviour(&rig).map_err(|error| match error {
            Problem::Cli(error) => error,
            Problem::Rig(source) => at(source),
        })?;
        let bar = ProgressBar::new(1000);
        let outcome = rig
            .record(behaviour.as_mut(), &trial, |share| {
                bar.set_position((1000.0 * share) as u64);
            })
            .map_err(at)?;
        bar.finish_and_clear();
        let summary = summary(&outcome, &trial, self.name());
        if outcome.diverged.is_none() {
            recording::write(out, &outcome.recording)?;
            if let Some(file) = &self.truth {
                write_text(file, toml::to_string(rig.truth()))?;
            }
        }
        if let Some(file) = &self.json {
            write_text(file, serde_json::to_string_pretty(&summary))?;
        }
        print(&summary, out);
        Ok(ExitCode::from(u8::from(summary.diverged.is_some())))
    }

    fn name(&self) -> &str {
        self.behaviour.as_deref().unwrap_or("policy")
    }

    fn behaviour(&self, rig: &Rig) -> Result<(Box<dyn Behaviour>, Trial), Problem> {
        let trial = |seconds| Trial {
            number: self.trial,
            label: self.name().to_owned(),
            seconds: self.seconds.unwrap_or(seconds),
        };
        if let Some(file) = &self.policy {
            let policy: AffineGaussian = run_dir::read_json(file).map_err(CliError::from)?;
            let behaviour = PolicyBehaviour::new(policy, rig.model())?;
            return Ok((Box::new(behaviour), trial(POLICY_S)));
        }
        let entry = behaviour::entry(self.name())?;
        let trial = trial(entry.seconds);
        Ok((rig.behaviour(entry, &trial)?, trial))
    }
}

/// What may keep a behaviour from being made.
enum Problem {
    Cli(CliError),
    Rig(RigError),
}

impl From<CliError> for Problem {
    fn from(error: CliError) -> Self {
        Self::Cli(error)
    }
}

impl From<RigError> for Problem {
    fn from(error: RigError) -> Self {
        Self::Rig(error)
    }
}

fn write_text<E: std::fmt::Display>(file: &Path, text: Result<String, E>) -> Result<(), CliError> {
    let text = text.map_err(|error| CliError::File {
        file: file.to_owned(),
        reason: error.to_string(),
    })?;
    Ok(run_dir::write_atomic(file, (text + "\n").as_bytes())?)
}

fn summary(outcome: &Outcome, trial: &Trial, name: &str) -> Summary {
    let cost = outcome.cost;
    Summary {
        behaviour: name.to_owned(),
        trial: trial.number,
        seconds: trial.seconds,
        samples: outcome
            .recording
            .streams
            .iter()
            .map(|s| (s.name.clone(), s.len()))
            .collect(),
        simulation_s: cost.simulation.as_secs_f64(),
        control_s: cost.control.as_secs_f64(),
        recording_s: cost.recording.as_secs_f64(),
        recording_ratio: cost.recording.as_secs_f64() / cost.simulation.as_secs_f64(),
        diverged: outcome.diverged.clone(),
    }
}

fn print(summary: &Summary, out: &Path) {
    if let Some(reason) = &summary.diverged {
        println!("the simulation broke down: {reason}; nothing written");
        return;
    }
    for (stream, samples) in &summary.samples {
        println!("{stream:10} {samples:8} samples");
    }
    println!(
        "simulation {:.2} s, control {:.2} s, sensors and recording {:.2} s ({:.1} % of the simulation)",
        summary.simulation_s,
        summary.control_s,
        summary.recording_s,
        100.0 * summary.recording_ratio
    );
    println!("recording: {}", out.display());
}

fn list() {
    println!("Behaviours (--behaviour)");
    for entry in BEHAVIOURS {
        println!(
            "  {:12} {:4} s  {}",
            entry.name, entry.seconds, entry.summary
        );
    }
    println!("\nEffects ([[effect]] in a rig file)");
    for entry in CATALOGUE {
        println!(
            "  {:24} {:9} {}",
            entry.name,
            entry.place.text(),
            entry.summary
        );
        for p in entry.parameters {
            let default = p
                .default
                .map_or(String::new(), |d| format!(", default {d}"));
            println!(
                "      {:20} {:14} families {} to {}{default}",
                p.name, p.unit, p.low, p.high
            );
        }
    }
}
