//! Files of an identification.

use std::fmt::Display;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde_json::json;

use super::arguments::FitArgs;
use super::{Seconds, lap};
use crate::cli::CliError;
use crate::cli::train::EnsembleFile;
use crate::mjcf::file::rewrite;
use crate::mujoco::Model;
use crate::recording;
use crate::report::Table;
use crate::run_dir;
use crate::sysid::fit::Fit;
use crate::sysid::problem::Problem;
use crate::sysid::summary::{Outcome, Summary};
use crate::sysid::{ensemble, figures, predict};

/// Where results go; checked before the work begins.
pub(super) struct Folder {
    path: PathBuf,
    model_file: PathBuf,
    text: String,
}

/// A problem and what was found.
pub(super) struct Identified<'a> {
    pub problem: &'a Problem,
    pub fit: &'a Fit,
    pub outcome: &'a Outcome,
    pub summary: &'a Summary,
}

/// What was written.
pub(super) struct Written {
    pub model: PathBuf,
    pub report: PathBuf,
    pub json: String,
}

/// The tables of a result on a terminal.
pub(super) fn tables(summary: &Summary) -> Vec<Table> {
    vec![figures::parameter_table(&summary.parameters)]
}

impl Folder {
    /// Makes the folder, and makes sure that the identified numbers can be written into the model file.
    pub(super) fn new(path: &Path, model_file: &Path, problem: &Problem) -> Result<Self, CliError> {
        let text = fs::read_to_string(model_file).map_err(|error| refuse(model_file, &error))?;
        let targets = problem.parameters.targets();
        rewrite(&text, &problem.model, &targets, "").map_err(|error| refuse(model_file, &error))?;
        fs::create_dir_all(path).map_err(|error| refuse(path, &error))?;
        Ok(Self {
            path: path.to_owned(),
            model_file: model_file.to_owned(),
            text,
        })
    }

    pub(super) fn write(
        &self,
        args: &FitArgs,
        identified: &Identified<'_>,
        mut seconds: Seconds,
        mut clock: Instant,
    ) -> Result<Written, CliError> {
        let &Identified {
            problem,
            fit,
            outcome,
            summary,
        } = identified;
        let model = self.model(problem, fit, summary, args.timestep)?;
        self.motions(problem, fit, outcome)?;
        let draws = ensemble::draw(
            &problem.parameters,
            &fit.x,
            &outcome.posterior,
            args.ensemble,
            args.seed,
        );
        self.ensemble(args, problem, &draws)?;
        let title = format!(
            "{} identified from {}",
            self.model_file.display(),
            match problem.trials.as_slice() {
                [one] => one.name.clone(),
                all => format!("{} recordings", all.len()),
            }
        );
        let page = figures::report(&title, problem, outcome, summary);
        let report = self.path.join("report.html");
        run_dir::write_atomic(&report, page.html()?.as_bytes())?;
        seconds.write = lap(&mut clock);
        let file = self.path.join("sysid.json");
        let json = serde_json::to_string_pretty(&json!({
            "model": self.model_file,
            "parameters_file": args.parameters(),
            "files": args.files,
            "holdout_files": args.holdout,
            "seed": args.seed,
            "seconds": seconds,
            "result": summary,
        }))
        .map_err(|error| refuse(&file, &error))?;
        run_dir::write_atomic(&file, (json.clone() + "\n").as_bytes())?;
        Ok(Written {
            model,
            report,
            json,
        })
    }

    /// The model file with the identified numbers.
    fn model(
        &self,
        problem: &Problem,
        fit: &Fit,
        summary: &Summary,
        timestep: Option<f64>,
    ) -> Result<PathBuf, CliError> {
        let identified = ensemble::model_at(&problem.model, &problem.parameters, &fit.x)?;
        let names: Vec<&str> = summary.recordings.iter().map(|r| r.name.as_str()).collect();
        let header = format!(
            "Identified by phantom sysid {} from {}: parameters of {} adjusted to {}. \
             Intervals and residuals are in sysid.json.{}",
            env!("CARGO_PKG_VERSION"),
            self.model_file
                .file_name()
                .unwrap_or_default()
                .to_string_lossy(),
            problem.parameters.all.len(),
            names.join(", "),
            timestep.map_or_else(String::new, |s| format!(
                " Identified with a time step of {s} s."
            )),
        );
        let targets = problem.parameters.targets();
        let text = rewrite(&self.text, &identified, &targets, &header)
            .map_err(|error| refuse(&self.model_file, &error))?;
        let path = self.path.join("model.xml");
        run_dir::write_atomic(&path, text.as_bytes())?;
        if let Err(error) = Model::from_xml_path(&path) {
            eprintln!(
                "phantom: {} does not load from its folder: {error}; put it beside {}",
                path.display(),
                self.model_file.display()
            );
        }
        Ok(path)
    }

    /// The estimated motion of every recording.
    fn motions(&self, problem: &Problem, fit: &Fit, outcome: &Outcome) -> Result<(), CliError> {
        for (i, (trial, explained)) in problem.trials.iter().zip(&outcome.explained).enumerate() {
            let recording = predict::recording(problem, fit, explained, i)?;
            let plain: String = (trial.name.split('.').next().unwrap_or_default().chars())
                .map(|c| {
                    if c.is_ascii_alphanumeric() || c == '_' {
                        c
                    } else {
                        '-'
                    }
                })
                .collect();
            let path = self.path.join(format!("motion-{}-{plain}.mcap", i + 1));
            recording::write(&path, &recording)?;
        }
        Ok(())
    }

    /// Models for training.
    fn ensemble(
        &self,
        args: &FitArgs,
        problem: &Problem,
        draws: &[Vec<f64>],
    ) -> Result<(), CliError> {
        let path = self.path.join("ensemble.toml");
        let models = ensemble::models(&problem.model, &problem.parameters, draws)?;
        let text = toml::to_string(&EnsembleFile { ensemble: models })
            .map_err(|error| refuse(&path, &error))?;
        let header = format!(
            "# {} models drawn from the posterior by phantom sysid, seed {}; for phantom train --ensemble\n",
            draws.len(),
            args.seed
        );
        Ok(run_dir::write_atomic(&path, (header + &text).as_bytes())?)
    }
}

fn refuse(file: &Path, reason: &dyn Display) -> CliError {
    CliError::File {
        file: file.to_owned(),
        reason: reason.to_string(),
    }
}
