//! `phantom compare`: simulation against hardware.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use clap::{Args, ValueEnum};
use indicatif::ProgressBar;

use super::{CliError, load_model, model_path, positive, thread_count};
use crate::compare::{self, CompareError, Comparison, Settings, States, figures, policy};
use crate::mujoco::{Cone, Model};
use crate::policy::AffineGaussian;
use crate::recording::{Binding, Kind, Recording, read_trials};
use crate::rollout::RolloutError;
use crate::run_dir;

/// Friction cone
#[derive(Debug, Clone, Copy, ValueEnum)]
enum ConeName {
    /// its approximation by a pyramid
    Pyramidal,
    /// round
    Elliptic,
}

/// Compare a model with recordings of the machine
///
/// Forces: the model is put into every recorded state, and its sensors and the motor torques it needs are set against
/// the recorded ones. Rollouts: from many recorded states the model is simulated under the recorded controls, and its
/// deviation grows. Policy: where the recording has a target, the distance of the object to it.
///
/// Writes DIR/report.html (one page, works without network), DIR/compare.json and a figure a chart, DIR/*.svg.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom compare log.mcap --out comparison
  phantom compare --model xml/emps.xml emps_train.csv --binding bindings/emps.toml \\
      --protocol bindings/emps.protocol.toml --out emps
  phantom compare --model arm.xml log.mcap --set dof_damping=0 --set body_mass[3]=1.2 --out without_damping
  phantom compare real.mcap --policy policy.json --out policy")]
pub(super) struct CompareArgs {
    /// Recordings: .mcap, .csv or .csv.gz
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// Model (MJCF) [default: xml/phantom.xml]
    #[arg(long, value_name = "FILE.xml")]
    model: Option<PathBuf>,
    /// Folder for the results; made if need be
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Names, scales and units of the recordings' channels (TOML)
    #[arg(long, value_name = "FILE.toml")]
    binding: Option<PathBuf>,
    /// How to compare: filters, horizons, starts (TOML)
    #[arg(long, value_name = "FILE.toml")]
    protocol: Option<PathBuf>,
    /// Zero-phase low-pass of the recorded state, 1/s [default: 30 where positions carry known noise, else none]
    #[arg(long, value_name = "HZ", value_parser = positive)]
    cutoff_hz: Option<f64>,
    /// Duration of rollouts, s; several: one after another
    #[arg(long, value_name = "S", value_parser = positive)]
    horizon: Vec<f64>,
    /// Put a number in place of all of an array of mjModel, or of one entry
    #[arg(long, value_name = "ARRAY[[I]]=X", value_parser = change)]
    set: Vec<Change>,
    /// Friction cone [default: the model's]
    #[arg(long, value_enum)]
    cone: Option<ConeName>,
    /// Policy that moved the machine: simulate it towards the recorded target, and from recorded states
    #[arg(long, value_name = "FILE.json")]
    policy: Option<PathBuf>,
    /// Recordings of the same policy in another simulation
    #[arg(long, value_name = "FILE")]
    simulated: Vec<PathBuf>,
    /// Worker threads [default: one a core]
    #[arg(long, value_name = "T", value_parser = super::count)]
    threads: Option<usize>,
    /// Print the results as JSON
    #[arg(long)]
    json: bool,
}

/// Low-pass of positions that carry noise and come without a protocol: above what arms do, below what encoders add.
const NOISY_CUTOFF_HZ: f64 = 30.0;

/// A change of the model.
#[derive(Debug, Clone)]
struct Change {
    array: String,
    index: Option<usize>,
    value: f64,
}

/// Whether positions are known to carry noise, which two differences in time would turn into most of the acceleration.
fn noisy(recording: &Recording) -> bool {
    recording.channels().any(|c| {
        c.kind == Kind::Sensor
            && matches!(c.unit.as_str(), "rad" | "m")
            && c.noise_sigma.is_some_and(|sigma| sigma > 0.0)
    })
}

/// clap parser of a [`Change`].
fn change(text: &str) -> Result<Change, String> {
    let parse = || {
        let (place, value) = text.split_once('=')?;
        let value = value.parse().ok().filter(|v: &f64| v.is_finite())?;
        let (array, index) = match place.strip_suffix(']').map(|p| p.split_once('[')) {
            Some(Some((array, index))) => (array, Some(index.parse().ok()?)),
            Some(None) => return None,
            None => (place, None),
        };
        let array = array.to_owned();
        Some(Change {
            array,
            index,
            value,
        })
    };
    parse().ok_or_else(|| "expected ARRAY=NUMBER or ARRAY[INDEX]=NUMBER".to_owned())
}

impl CompareArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        let path = model_path(self.model.as_deref());
        let mut model = load_model(&path)?;
        for change in &self.set {
            apply(&mut model, change)?;
        }
        if !self.set.is_empty() {
            model.edit().finish()?;
        }
        if let Some(cone) = self.cone {
            let mut option = model.option();
            option.cone = match cone {
                ConeName::Pyramidal => Cone::Pyramidal,
                ConeName::Elliptic => Cone::Elliptic,
            };
            model.edit().set_option(&option)?;
        }
        let mut settings = self.settings()?;
        settings.check()?;
        let model = Arc::new(model);
        let recordings = self.recordings(&self.files, &settings)?;
        if self.protocol.is_none() && settings.cutoff_hz.is_none() && recordings.iter().any(noisy) {
            settings.cutoff_hz = Some(NOISY_CUTOFF_HZ);
            eprintln!(
                "positions carry noise: low-pass of {NOISY_CUTOFF_HZ} Hz (--cutoff-hz changes it)"
            );
        }
        if recordings.is_empty() {
            return Err(CliError::File {
                file: self.files[0].clone(),
                reason: "no trial is left to compare".to_owned(),
            });
        }
        let policy: Option<AffineGaussian> =
            self.policy.as_deref().map(run_dir::read_json).transpose()?;
        let threads = thread_count(self.threads);
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .map_err(|error| RolloutError::Threads {
                threads,
                reason: error.to_string(),
            })?;
        let bar = ProgressBar::new(recordings.len() as u64);
        let done = || bar.inc(1);
        let result = pool
            .install(|| compare::compare(&model, &recordings, &settings, policy.as_ref(), &done));
        bar.finish_and_clear();
        let mut comparison = result?;
        self.other_simulation(&model, &settings, &mut comparison)?;
        self.write(&path, &comparison, &settings)?;
        Ok(ExitCode::SUCCESS)
    }

    fn settings(&self) -> Result<Settings, CliError> {
        let mut settings = match &self.protocol {
            Some(file) => read_protocol(file)?,
            None => Settings::default(),
        };
        settings.cutoff_hz = self.cutoff_hz.or(settings.cutoff_hz);
        if !self.horizon.is_empty() {
            settings.horizons_s.clone_from(&self.horizon);
        }
        Ok(settings)
    }

    fn recordings(
        &self,
        files: &[PathBuf],
        settings: &Settings,
    ) -> Result<Vec<Recording>, CliError> {
        let binding = match &self.binding {
            Some(file) => Binding::from_file(file)?,
            None => Binding::default(),
        };
        let mut all = Vec::new();
        for file in files {
            let trials = read_trials(file, &binding)?;
            for mut recording in trials {
                if settings.uses_trial(&recording.meta.trial) {
                    recording.meta.source = file
                        .file_name()
                        .unwrap_or_default()
                        .to_string_lossy()
                        .into_owned();
                    all.push(recording);
                }
            }
        }
        Ok(all)
    }

    /// Add the tracking errors of recordings of another simulation.
    fn other_simulation(
        &self,
        model: &Arc<Model>,
        settings: &Settings,
        comparison: &mut Comparison,
    ) -> Result<(), CliError> {
        for recording in self.recordings(&self.simulated, settings)? {
            let states = States::new(&recording, model, settings)?;
            let Some(mut tracking) = policy::recorded_tracking(&states) else {
                return Err(CompareError::NoGoal {
                    recording: states.name,
                }
                .into());
            };
            tracking.origin = "simulated";
            comparison.tracking.push(tracking);
        }
        Ok(())
    }

    fn write(
        &self,
        model: &Path,
        comparison: &Comparison,
        settings: &Settings,
    ) -> Result<(), CliError> {
        let refuse = |file: PathBuf, reason: &dyn std::fmt::Display| CliError::File {
            file,
            reason: reason.to_string(),
        };
        fs::create_dir_all(&self.out).map_err(|error| refuse(self.out.clone(), &error))?;
        let title = format!(
            "{} against {} recordings",
            model.display(),
            self.files.len()
        );
        let report = figures::report(&title, comparison, settings);
        let json = serde_json::to_string_pretty(&serde_json::json!({
            "model": model,
            "files": self.files,
            "settings": settings,
            "result": comparison,
        }))
        .map_err(|error| refuse(self.out.join("compare.json"), &error))?;
        run_dir::write_atomic(
            &self.out.join("compare.json"),
            (json.clone() + "\n").as_bytes(),
        )?;
        let page = self.out.join("report.html");
        run_dir::write_atomic(&page, report.html()?.as_bytes())?;
        for (name, svg) in report.figures()? {
            run_dir::write_atomic(&self.out.join(name), svg.as_bytes())?;
        }
        if self.json {
            println!("{json}");
        } else {
            for table in report.tables() {
                println!("{}", table.text());
            }
            println!("report: {}", page.display());
        }
        Ok(())
    }
}

fn read_protocol(file: &Path) -> Result<Settings, CliError> {
    let text = fs::read_to_string(file).map_err(|error| CliError::File {
        file: file.to_owned(),
        reason: error.to_string(),
    })?;
    toml::from_str(&text).map_err(|error| CliError::Config {
        file: file.to_owned(),
        line: error
            .span()
            .map_or(1, |span| 1 + text[..span.start].matches('\n').count()),
        reason: error.message().replace('\n', ", "),
    })
}

fn apply(model: &mut Model, change: &Change) -> Result<(), CliError> {
    let mut edit = model.edit();
    let Some(values) = edit.numeric_field_mut(&change.array) else {
        return Err(CliError::Change {
            change: change.array.clone(),
            reason: "no such array of numbers in mjModel".to_owned(),
        });
    };
    match change.index {
        None => values.fill(change.value),
        Some(i) if i < values.len() => values[i] = change.value,
        Some(i) => {
            return Err(CliError::Change {
                change: format!("{}[{i}]", change.array),
                reason: format!("it has {} numbers", values.len()),
            });
        }
    }
    Ok(())
}
