//! `phantom gap bench`: the search against machines whose truth is sealed.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::Ordering;

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;

use crate::blind::{self, BlindError, Case, Row, Scored, Suite, SuiteConfig};
use crate::cli::{CliError, interruption, model_path, read_toml};
use crate::mjcf::glob;
use crate::report::Table;
use crate::rig::RigConfig;
use crate::run_dir;
use crate::sysid::problem::ProblemConfig;

/// Test the search on machines that hide effects
///
/// Makes every machine of the suite, records it, searches its recordings, and compares the answer with the sealed
/// truth. Writes into DIR: cases/, one file a machine, which a run that was stopped finds again, and table.json.
/// Cases share the cores, one a thread.
///
/// Exit code 0: every case was run; 1: stopped before.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  phantom gap bench --suite suites/arm.toml --out blind
  phantom gap bench --suite suites/arm.toml --out blind --arm nothing --arm one --machines 2")]
pub(super) struct BenchArgs {
    /// Which machines, which recordings (TOML)
    #[arg(long, value_name = "SUITE.toml")]
    suite: PathBuf,
    /// Folder for the results; made if need be
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Only arms whose names match these globs
    #[arg(long, value_name = "GLOB")]
    arm: Vec<String>,
    /// At most so many machines of every kind
    #[arg(long, value_name = "N")]
    machines: Option<u64>,
    /// Print the table as JSON
    #[arg(long)]
    json: bool,
}

impl BenchArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        let suite = self.suite()?;
        let first = suite.config.first_seed;
        let wanted = |case: &&Case| {
            let arm = &suite.config.arm[case.arm].name;
            (self.arm.is_empty() || self.arm.iter().any(|g| glob::matches(g, arm)))
                && self.machines.is_none_or(|n| case.seed - first < n)
        };
        let cases: Vec<&Case> = suite.cases.iter().filter(wanted).collect();
        if cases.is_empty() {
            return Err(self.refuse("no arm matches --arm"));
        }
        let folder = self.out.join("cases");
        fs::create_dir_all(&folder).map_err(|e| CliError::File {
            file: folder.clone(),
            reason: e.to_string(),
        })?;
        let scores = run_all(&suite, &cases, &folder)?;
        let complete = scores.len() == cases.len();
        let rows = blind::table(&scores);
        let json = serde_json::to_string_pretty(&rows).map_err(|e| self.refuse(&e.to_string()))?;
        run_dir::write_atomic(
            &self.out.join("table.json"),
            (json.clone() + "\n").as_bytes(),
        )?;
        if self.json {
            println!("{json}");
        } else {
            print!("{}", table(&rows));
            print_wrong(&scores);
        }
        Ok(ExitCode::from(u8::from(!complete)))
    }

    fn suite(&self) -> Result<Suite, CliError> {
        let config: SuiteConfig = read_toml(&self.suite)?;
        let beside = |path: &Path| self.suite.parent().unwrap_or(Path::new(".")).join(path);
        let rig_file = beside(&config.rig);
        let rig: RigConfig = read_toml(&rig_file)?;
        let parameters: ProblemConfig = read_toml(&beside(&config.parameters))?;
        let model = Suite::model_of(&rig, &rig_file).unwrap_or_else(|| model_path(None));
        Suite::new(config, rig, &model, parameters).map_err(|source| CliError::Blind {
            file: self.suite.clone(),
            source: Box::new(source),
        })
    }

    fn refuse(&self, reason: &str) -> CliError {
        CliError::File {
            file: self.suite.clone(),
            reason: reason.to_owned(),
        }
    }
}

/// Every case that was not run before; the scores of all that are there.
fn run_all(suite: &Suite, cases: &[&Case], folder: &Path) -> Result<Vec<Scored>, CliError> {
    let bar = ProgressBar::new(cases.len() as u64);
    if let Ok(style) = ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed} · {msg}") {
        bar.set_style(style);
    }
    let stop = interruption("ending after the cases at hand");
    let failed: Mutex<Option<CliError>> = Mutex::new(None);
    let scores: Vec<Option<Scored>> = (cases.par_iter())
        .map(|case| {
            let key = case.key(&suite.config);
            let file = folder.join(key.replace(['/', ' ', ','], "_") + ".json");
            if let Ok(known) = run_dir::read_json::<Scored>(&file) {
                bar.inc(1);
                return Some(known);
            }
            let halted =
                || stop.load(Ordering::SeqCst) || failed.lock().is_ok_and(|error| error.is_some());
            if halted() {
                return None;
            }
            let outcome = suite
                .run(case, &mut |_, _, _| !halted())
                .map_err(|source| CliError::Blind {
                    file: PathBuf::from(&key),
                    source: Box::new(source),
                })
                .and_then(|scored| {
                    let text =
                        serde_json::to_string_pretty(&scored).map_err(|e| CliError::File {
                            file: file.clone(),
                            reason: e.to_string(),
                        })?;
                    run_dir::write_atomic(&file, (text + "\n").as_bytes())?;
                    Ok(scored)
                });
            bar.set_message(key);
            bar.inc(1);
            match outcome {
                Ok(scored) => Some(scored),
                // a machine that breaks down says nothing of the search
                Err(CliError::Blind { source, .. })
                    if matches!(*source, BlindError::Diverged { .. }) =>
                {
                    bar.println(source.to_string());
                    None
                }
                Err(_) if halted() => None,
                Err(error) => {
                    if let Ok(mut first) = failed.lock() {
                        first.get_or_insert(error);
                    }
                    None
                }
            }
        })
        .collect();
    bar.finish_and_clear();
    match failed.into_inner() {
        Ok(Some(error)) => Err(error),
        _ => Ok(scores.into_iter().flatten().collect()),
    }
}

fn table(rows: &[Row]) -> String {
    let percent = |p: f64| format!("{:.0} %", 100.0 * p);
    let optional =
        |v: Option<f64>, digits: usize| v.map_or(String::new(), |v| format!("{v:.digits$}"));
    let mut table = Table::new(
        "Answers against the sealed truth",
        &[
            "arm",
            "effect",
            "size",
            "noise",
            "n",
            "found",
            "class",
            "name",
            "right",
            "95 %",
            "class size",
            "cover",
            "closed",
            "d",
            "s",
        ],
    );
    for r in rows {
        table.push(vec![
            r.arm.clone(),
            between(r.between).unwrap_or_else(|| r.effect.clone()),
            optional(r.severity, 2),
            optional(r.noise, 1),
            r.n.to_string(),
            percent(r.detected),
            percent(r.class),
            percent(r.exact),
            percent(r.right),
            format!(
                "{:.0}-{:.0}",
                100.0 * r.right_ci95[0],
                100.0 * r.right_ci95[1]
            ),
            optional(r.class_size, 1),
            r.coverage
                .map_or(String::new(), |(p, n)| format!("{} of {n}", percent(p))),
            optional(r.closed, 2),
            optional(r.detectability, 1),
            format!("{:.1}", r.seconds),
        ]);
    }
    table.text()
}

/// Levels of detectability, in words.
fn between(levels: Option<[f64; 2]>) -> Option<String> {
    let [low, high] = levels?;
    Some(match (low > 0.0, high.is_finite()) {
        (false, _) => format!("d below {high}"),
        (true, true) => format!("d {low} to {high}"),
        (true, false) => format!("d from {low}"),
    })
}

/// What was answered instead, most frequent first.
fn print_wrong(scores: &[Scored]) {
    let wrong: BTreeSet<String> = scores
        .iter()
        .filter(|s| !s.right)
        .map(|s| {
            let names = |at: &[blind::At]| match at {
                [] => "nothing".to_owned(),
                some => (some.iter())
                    .map(|a| format!("{} at {}", a.name, a.place))
                    .collect::<Vec<_>>()
                    .join(", "),
            };
            format!(
                "{}: {} taken for {} ({:?})",
                s.case,
                names(&s.truth),
                names(&s.found),
                s.verdict
            )
        })
        .collect();
    for line in wrong {
        println!("{line}");
    }
}
