//! `phantom sysid design`: what to record next.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use clap::{Args, ValueEnum};
use nalgebra::DMatrix;
use serde_json::json;

use super::Watch;
use super::arguments::read_all;
use crate::cli::{CliError, count, load_model, model_path, positive, read_toml};
use crate::mujoco::Model;
use crate::recording::Recording;
use crate::report::{Table, number};
use crate::rig::behaviour::{self, BEHAVIOURS};
use crate::rig::{Rig, RigConfig, RigError, Trial};
use crate::sysid::design::{Candidate, Criterion, Plan, information, plan};
use crate::sysid::joint::JointSettings;
use crate::sysid::parameter::Scale;
use crate::sysid::problem::{Problem, ProblemConfig};

/// What makes a recording good
#[derive(Debug, Clone, Copy, ValueEnum)]
enum CriterionName {
    /// volume of the confidence ellipsoid
    D,
    /// its longest axis
    E,
}

/// Say what to record next, to learn most about the parameters
///
/// Simulates behaviours of `phantom record` on the model as it is, seen through the sensors of a rig file, and computes
/// what each would tell about the parameters, the motion itself being unknown. Nothing hidden in the rig file is used.
/// Recordings can stand in for behaviours (--candidate), and those that exist count as known (--recorded).
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom sysid design --parameters finger.toml --rig rigs/paper.toml
  phantom sysid design --parameters finger.toml --rig rigs/paper.toml --behaviours multi_sine,chirp --criterion e
  phantom sysid design --model arm.xml --parameters arm.toml --recorded sine.mcap --next 2 --json
  phantom sysid design --model arm.xml --parameters arm.toml --behaviours none --candidate a.mcap b.mcap")]
pub(super) struct DesignArgs {
    /// Model (MJCF) [default: xml/phantom.xml]
    #[arg(long, value_name = "FILE.xml")]
    model: Option<PathBuf>,
    /// What to estimate, with priors and noise (TOML)
    #[arg(long, value_name = "FILE.toml")]
    parameters: PathBuf,
    /// Rig file, for its sensors alone [default: ideal sensors, noise as the parameter file says]
    #[arg(long, value_name = "FILE.toml")]
    rig: Option<PathBuf>,
    /// Behaviours to try, see `phantom record --list`; `none`: none [default: all that fit the model]
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    behaviours: Vec<String>,
    /// Duration of each, s
    #[arg(long, value_name = "S", default_value = "2", value_parser = positive)]
    seconds: f64,
    /// Recordings to judge beside the behaviours
    #[arg(long, value_name = "FILE", num_args = 1..)]
    candidate: Vec<PathBuf>,
    /// Recordings that exist
    #[arg(long, value_name = "FILE", num_args = 1..)]
    recorded: Vec<PathBuf>,
    /// Names, scales and units of the recordings' channels (TOML)
    #[arg(long, value_name = "FILE.toml")]
    binding: Option<PathBuf>,
    /// What makes a recording good
    #[arg(long, value_enum, default_value = "d")]
    criterion: CriterionName,
    /// How many recordings to propose
    #[arg(long, value_name = "N", default_value = "3", value_parser = count)]
    next: usize,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl DesignArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        let model = Arc::new(load_model(&model_path(self.model.as_deref()))?);
        let config: ProblemConfig = read_toml(&self.parameters)?;
        let mut watch = Watch::new();
        let mut candidates = self.simulate(&model, &mut watch)?;
        candidates.extend(read_all(&self.candidate, self.binding.as_deref())?);
        let nothing = |reason: &str| CliError::File {
            file: self.parameters.clone(),
            reason: reason.to_owned(),
        };
        if candidates.is_empty() {
            return Err(nothing("there is no behaviour and no --candidate to judge"));
        }
        let settings = JointSettings::default();
        let mut known: Option<DMatrix<f64>> = None;
        let mut judged = Vec::new();
        let mut last = None;
        let recorded = read_all(&self.recorded, self.binding.as_deref())?;
        let n_recorded = recorded.len();
        for (i, (name, recording)) in recorded.into_iter().chain(candidates).enumerate() {
            watch.begin(&name);
            let problem = Problem::new(Arc::clone(&model), &config, &[(name.clone(), recording)])?;
            if problem.parameters.is_empty() {
                return Err(nothing("there is no [[parameter]] to estimate"));
            }
            let found = information(&problem, &settings, &mut |i| watch.see(i))?;
            if watch.stopped() {
                return Ok(ExitCode::FAILURE);
            }
            let known = known.get_or_insert_with(|| DMatrix::zeros(found.nrows(), found.nrows()));
            if known.nrows() != found.nrows() {
                return Err(nothing(&format!(
                    "`{name}` has other channels, and so other parameters, than the recordings before it"
                )));
            }
            if i < n_recorded {
                *known += found;
            } else {
                judged.push(Candidate {
                    name,
                    duration_s: (problem.trials[0].n_knots - 1) as f64 * model.timestep(),
                    information: found,
                });
            }
            last = Some(problem);
        }
        watch.bar.finish_and_clear();
        let (Some(problem), Some(known)) = (last, known) else {
            return Err(nothing("there is nothing to judge"));
        };
        let criterion = match self.criterion {
            CriterionName::D => Criterion::D,
            CriterionName::E => Criterion::E,
        };
        let plan = plan(&problem, &known, &judged, criterion, self.next);
        self.print(&problem, &plan)?;
        Ok(ExitCode::SUCCESS)
    }

    /// The behaviours, on the model as it is.
    fn simulate(
        &self,
        model: &Arc<Model>,
        watch: &mut Watch,
    ) -> Result<Vec<(String, Recording)>, CliError> {
        if self.behaviours.len() == 1 && self.behaviours[0] == "none" {
            return Ok(Vec::new());
        }
        let file = self.rig.clone().unwrap_or_else(|| "design".into());
        let at = |source| CliError::Rig {
            file: file.clone(),
            source,
        };
        let mut config: RigConfig = match &self.rig {
            Some(file) => read_toml(file)?,
            None => RigConfig::default(),
        };
        // the machine is the model: what a rig file hides stays hidden
        (config.randomise, config.effect, config.family) = (Vec::new(), Vec::new(), None);
        (config.physics.substeps, config.physics.integrator) = (1, None);
        let rig = Rig::new(model.try_clone()?, config).map_err(at)?;
        let names: Vec<&str> = if self.behaviours.is_empty() {
            BEHAVIOURS.iter().map(|b| b.name).collect()
        } else {
            self.behaviours.iter().map(String::as_str).collect()
        };
        let mut all = Vec::new();
        for name in names {
            watch.begin(&format!("simulating {name}"));
            let entry = behaviour::entry(name).map_err(at)?;
            let trial = Trial {
                number: 0,
                label: name.to_owned(),
                seconds: self.seconds,
            };
            let mut behaviour = match rig.behaviour(entry, &trial) {
                Ok(behaviour) => behaviour,
                // asked for by name it has to fit; of all, those that do are taken
                Err(RigError::Model { .. }) if self.behaviours.is_empty() => continue,
                Err(error) => return Err(at(error)),
            };
            let outcome = rig.record(behaviour.as_mut(), &trial, |_| ()).map_err(at)?;
            if let Some(reason) = outcome.diverged {
                eprintln!("phantom: `{name}` is left out, its simulation broke down: {reason}");
                continue;
            }
            all.push((name.to_owned(), outcome.recording));
        }
        Ok(all)
    }

    fn print(&self, problem: &Problem, plan: &Plan) -> Result<(), CliError> {
        if self.json {
            let text =
                serde_json::to_string_pretty(&json!(plan)).map_err(|error| CliError::File {
                    file: "--json".into(),
                    reason: error.to_string(),
                })?;
            println!("{text}");
            return Ok(());
        }
        let mut scores = Table::new(
            "What each would tell",
            &["recording", "seconds", "log det gain", "least eigenvalue ×"],
        );
        for s in &plan.scores {
            let cells = [s.duration_s, s.d_gain, s.e_ratio].map(number);
            scores.push(std::iter::once(s.name.clone()).chain(cells).collect());
        }
        println!("{}", scores.text());
        let mut columns = vec!["parameter", "now"];
        columns.extend(plan.scores.iter().map(|s| s.name.as_str()));
        let planned: Vec<String> = plan.next.iter().map(|s| format!("+ {}", s.name)).collect();
        columns.extend(planned.iter().map(String::as_str));
        let mut table = Table::new(
            "Expected spread: alone, and after each of the proposed",
            &columns,
        );
        let all = || plan.scores.iter().chain(&plan.next);
        for (i, p) in problem.parameters.iter_free().enumerate() {
            let cell = |sigma: f64| match p.scale {
                Scale::Log if sigma < 3.0 => format!("{} %", number(100.0 * sigma)),
                Scale::Linear if sigma < 3.0 * p.typical => number(sigma),
                _ => "?".to_owned(),
            };
            let mut row = vec![p.name.clone(), cell(plan.sigma[i])];
            row.extend(all().map(|s| cell(s.sigma[i])));
            table.push(row);
        }
        println!("{}", table.text());
        let names: Vec<&str> = plan.next.iter().map(|s| s.name.as_str()).collect();
        println!("record next: {}", names.join(", then "));
        Ok(())
    }
}
