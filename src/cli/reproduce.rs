//! `phantom reproduce`: the paper's table and figures.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};

use super::{CliError, count, interruption, load_model, model_path, read_toml, thread_count};
use crate::policy::AffineGaussian;
use crate::report::{Report, Section};
use crate::reproduce::table::{self, Evaluated, Row};
use crate::reproduce::{Case, Study, figures, policies};
use crate::rig::RigConfig;
use crate::rollout::RolloutError;
use crate::run_dir::{self, PROVENANCE_FILE, Provenance};
use crate::train::config::TrainConfig;

/// Rig that stands in for the paper's hardware, when none is named.
const RIG: &str = "rigs/paper.toml";

/// Part of the paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum What {
    /// Table 1: three policies, in simulation and on the rig
    Table1,
    /// learning curves
    Curve,
    /// weights of the correct policy
    Heatmap,
    /// paths from above, distance over time
    Spiral,
    /// force and torque per axis, with and without contact
    Forces,
    /// 200-step simulations from states recorded on the rig
    Rollouts,
    /// all of them
    All,
}

/// Repeat the experiments of the paper: Table 1 and its figures
///
/// Trains the three policies (object of 0.34 kg; 0.40 kg; 0.40 ± 0.03 kg) with every seed, once: they stay in
/// DIR/policies and are used again, and a run that was stopped or killed goes on. The virtual rig stands in for the paper's
/// hardware. Writes DIR/WHAT.html (one page, works without network), a figure as SVG and PNG each, and DIR/WHAT.json.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom reproduce all --out reproduction                           5 seeds, 60 iterations: about an hour on two cores
  phantom reproduce table1 --out reproduction --seeds 3 --iterations 40
  phantom reproduce heatmap --out reproduction                       of policies that are there
  phantom reproduce spiral --out other --rig my_rig.toml")]
pub(super) struct ReproduceArgs {
    /// Table or figure
    #[arg(value_enum, value_name = "WHAT")]
    what: What,
    /// Folder for policies, rollouts and results; made if need be
    #[arg(long, value_name = "DIR", default_value = "reproduction")]
    out: PathBuf,
    /// Number of training seeds, 0 to N-1
    #[arg(long, value_name = "N", default_value = "5", value_parser = count)]
    seeds: usize,
    /// Policy updates of each run
    #[arg(long, value_name = "N", default_value = "60", value_parser = count)]
    iterations: usize,
    /// Rollouts of each policy, in simulation and on the rig
    #[arg(long, value_name = "N", default_value = "10", value_parser = count)]
    rollouts: usize,
    /// Settings of training (TOML); masses and seeds are the study's
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// Model (MJCF) [default: xml/phantom.xml]
    #[arg(long, value_name = "FILE.xml")]
    model: Option<PathBuf>,
    /// Rig in place of the hardware [default: rigs/paper.toml]
    #[arg(long, value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    /// Worker threads; results do not depend on it [default: one a core]
    #[arg(long, value_name = "T", value_parser = count)]
    threads: Option<usize>,
    /// Print the table as JSON
    #[arg(long)]
    json: bool,
}

/// A policy with the case and seed it was trained for.
type Trained = (Case, u64, AffineGaussian);

/// What `WHAT.json` holds.
#[derive(Debug, serde::Serialize)]
struct Written<'a> {
    provenance: &'a Provenance,
    seeds: &'a [u64],
    iterations: u64,
    rollouts: usize,
    rig: &'a RigConfig,
    table1: Vec<Row>,
}

impl ReproduceArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        let study = self.study()?;
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(study.threads)
            .build()
            .map_err(|error| RolloutError::Threads {
                threads: study.threads,
                reason: error.to_string(),
            })?;
        std::fs::create_dir_all(&study.out).map_err(|reason| CliError::File {
            file: study.out.clone(),
            reason: reason.to_string(),
        })?;
        let Some(policies) = self.policies(&study)? else {
            println!("stopped; the same command goes on");
            return Ok(ExitCode::FAILURE);
        };
        let mut results = Vec::new();
        if self.has(What::Table1) || self.has(What::Spiral) {
            let bar = bar(policies.len() as u64, "rollouts of each policy");
            for (case, seed, policy) in &policies {
                results.push(table::evaluated(&study, &pool, *case, *seed, policy)?);
                bar.inc(1);
            }
            bar.finish_and_clear();
        }
        let report = pool.install(|| self.report(&study, &policies, &results))?;
        self.write(&study, &report, &results)?;
        Ok(ExitCode::SUCCESS)
    }

    fn study(&self) -> Result<Study, CliError> {
        let model_path = model_path(self.model.as_deref());
        let model = load_model(&model_path)?;
        let mut base: TrainConfig = match &self.config {
            Some(file) => read_toml(file)?,
            None => TrainConfig::default(),
        };
        base.train.iterations = self.iterations as u64;
        base.validate().map_err(|source| CliError::Setting {
            file: self.config.clone().unwrap_or_default(),
            source,
        })?;
        let rig_file = self.rig.clone().unwrap_or_else(|| beside(&model_path, RIG));
        let rig: RigConfig = read_toml(&rig_file)?;
        rig.validate().map_err(|source| CliError::Rig {
            file: rig_file,
            source,
        })?;
        Ok(Study {
            out: self.out.clone(),
            model_path: std::path::absolute(&model_path).unwrap_or(model_path),
            model: Arc::new(model),
            rig,
            base,
            seeds: (0..self.seeds as u64).collect(),
            n_rollout: self.rollouts,
            threads: thread_count(self.threads),
        })
    }

    fn has(&self, what: What) -> bool {
        self.what == what || self.what == What::All
    }

    /// The policies that are needed, trained if need be; nothing when the user stopped.
    fn policies(&self, study: &Study) -> Result<Option<Vec<Trained>>, CliError> {
        let (cases, seeds): (&[Case], &[u64]) = match self.what {
            What::Heatmap | What::Forces => (&Case::ALL[..1], &study.seeds[..1]),
            What::Rollouts | What::Spiral => (&Case::ALL, &study.seeds[..1]),
            What::Table1 | What::Curve | What::All => (&Case::ALL, &study.seeds),
        };
        let interrupted = interruption("finishing this iteration");
        let total = (cases.len() * seeds.len()) as u64 * study.iterations();
        let bar = bar(total, "");
        let (mut all, mut done) = (Vec::new(), 0);
        for seed in seeds {
            for case in cases {
                bar.set_message(format!("{} seed {seed}", case.name()));
                let policy = policies::policy(study, *case, *seed, &mut |record, _| {
                    bar.set_position(done + record.iteration);
                    !interrupted.load(Ordering::SeqCst)
                })?;
                let Some(policy) = policy else {
                    bar.finish_and_clear();
                    return Ok(None);
                };
                done += study.iterations();
                bar.set_position(done);
                all.push((*case, *seed, policy));
            }
        }
        bar.finish_and_clear();
        Ok(Some(all))
    }

    fn report(
        &self,
        study: &Study,
        policies: &[Trained],
        results: &[Evaluated],
    ) -> Result<Report, CliError> {
        let mut report = Report::new("Lowrey et al. 2018, reproduced");
        let first: Vec<(Case, AffineGaussian)> = policies
            .iter()
            .filter(|(_, seed, _)| *seed == study.first_seed())
            .map(|(case, _, policy)| (*case, policy.clone()))
            .collect();
        let correct = &first[0].1;
        let mut add = |section: Section| report.sections.push(section);
        if self.has(What::Table1) {
            add(figures::table1(study, results));
        }
        if self.has(What::Spiral) {
            add(figures::spiral(study, results));
        }
        if self.has(What::Curve) {
            add(figures::curve(study)?);
        }
        if self.has(What::Heatmap) {
            add(figures::weights(&study.model, correct)?);
        }
        if self.has(What::Forces) {
            add(figures::forces(study, correct)?);
        }
        if self.has(What::Rollouts) {
            add(figures::rollouts(study, &first)?);
        }
        Ok(report)
    }

    fn write(&self, study: &Study, report: &Report, results: &[Evaluated]) -> Result<(), CliError> {
        let name = match self.what.to_possible_value() {
            Some(value) => value.get_name().to_owned(),
            None => "all".to_owned(),
        };
        let provenance = Provenance::capture(study.threads, std::env::args());
        let table = if self.has(What::Table1) {
            table::rows(results)
        } else {
            Vec::new()
        };
        let written = Written {
            provenance: &provenance,
            seeds: &study.seeds,
            iterations: study.iterations(),
            rollouts: study.n_rollout,
            rig: &study.rig,
            table1: table,
        };
        let json = serde_json::to_string_pretty(&written).map_err(|error| CliError::File {
            file: study.out.join(PROVENANCE_FILE),
            reason: error.to_string(),
        })?;
        let file = |name: String| study.out.join(name);
        run_dir::write_atomic(
            &file(format!("{name}.json")),
            (json.clone() + "\n").as_bytes(),
        )?;
        let page = file(format!("{name}.html"));
        run_dir::write_atomic(&page, report.html()?.as_bytes())?;
        super::write_figures(&study.out, report)?;
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

/// A file of the checkout: from here, or from where the model's folder is.
fn beside(model: &Path, name: &str) -> PathBuf {
    let root = model.parent().and_then(Path::parent);
    match root.map(|root| root.join(name)) {
        Some(path) if !Path::new(name).exists() && path.exists() => path,
        _ => PathBuf::from(name),
    }
}

fn bar(total: u64, message: &str) -> ProgressBar {
    let bar = ProgressBar::new(total).with_message(message.to_owned());
    let style = ProgressStyle::with_template("{bar:24} {pos}/{len} {wide_msg} {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    bar.set_style(style);
    bar.tick();
    bar
}
