//! Blind tests of [`crate::gap`]: machines that hide effects, searched by what knows only their recordings.
//!
//! ```text
//! suite file ──> cases: arm × effect × severity × noise × machine                     [suite]
//! case ──> rig with the effect hidden ──> recordings ──> gap::run ──> answer
//!              └── sealed truth ───────────────────────────┴──> score                 [score]
//! scores ──> table                                                                    [table]
//! ```
//!
//! The rig has its own code for every effect, parameters off the model's, finer steps and real sensors
//! ([`crate::rig`]); its truth is opened after the answer. Machines of one number have the same parameters and noise at
//! every severity, so that a curve against severity is one of severity alone.

mod score;
mod suite;
mod table;

use std::path::{Path, PathBuf};
use std::time::Instant;

use thiserror::Error;

pub use score::{At, Covered, Scored};
pub use suite::{Arm, Case, Expect, SuiteConfig, TrialConfig};
pub use table::{Row, table};

use crate::compare::Settings;
use crate::gap::effect::{EffectError, ModelFile};
use crate::gap::{self, GapError, Input, Options};
use crate::recording::Recording;
use crate::rig::behaviour;
use crate::rig::{Rig, RigConfig, RigError, Trial};
use crate::sysid::problem::ProblemConfig;

/// Why a suite cannot be run.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BlindError {
    /// The rig of a case.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The search.
    #[error(transparent)]
    Gap(#[from] GapError),
    /// The model.
    #[error(transparent)]
    Effect(#[from] EffectError),
    /// The suite file makes no sense.
    #[error("{reason}")]
    Suite {
        /// key, found, expected
        reason: String,
    },
    /// A machine broke down while it was recorded.
    #[error("case `{case}`: the machine breaks down: {reason}")]
    Diverged {
        /// see [`Case::key`]
        case: String,
        /// what the engine said
        reason: String,
    },
}

/// A suite with what it refers to.
#[derive(Debug)]
pub struct Suite {
    /// as in the file
    pub config: SuiteConfig,
    rig: RigConfig,
    model: ModelFile,
    parameters: ProblemConfig,
    /// every case, in order
    pub cases: Vec<Case>,
}

impl Suite {
    /// From the contents of the files that the suite file names; `model` is the rig's.
    ///
    /// # Errors
    /// What does not fit together.
    pub fn new(
        config: SuiteConfig,
        rig: RigConfig,
        model: &Path,
        parameters: ProblemConfig,
    ) -> Result<Self, BlindError> {
        let model = ModelFile::load(model)?;
        let cases = config.cases(&model.model, &rig)?;
        Ok(Self {
            config,
            rig,
            model,
            parameters,
            cases,
        })
    }

    /// Model file of a rig file's content.
    pub fn model_of(rig: &RigConfig, rig_file: &Path) -> Option<PathBuf> {
        let folder = rig_file.parent().unwrap_or(Path::new("."));
        rig.model.as_ref().map(|path| folder.join(path))
    }

    /// Records the machine of a case, searches, and scores the answer.
    ///
    /// # Errors
    /// The machine breaks down, the engine fails.
    pub fn run(&self, case: &Case, report: gap::Report<'_>) -> Result<Scored, BlindError> {
        let arm = &self.config.arm[case.arm];
        let model = self.model.model.try_clone().map_err(RigError::from)?;
        let rig = Rig::new(model, suite::hide(&self.rig, arm, case))?;
        let record = |trials: &[TrialConfig]| -> Result<Vec<(String, Recording)>, BlindError> {
            (trials.iter().enumerate())
                .map(|(i, t)| Ok((format!("{} {i}", t.behaviour), self.record(case, &rig, t)?)))
                .collect()
        };
        let train = record(arm.train.as_ref().unwrap_or(&self.config.train))?;
        let holdout = record(&self.config.holdout)?;
        let protocol = Settings::default();
        let input = Input {
            model: &self.model,
            config: &self.parameters,
            train: &train,
            holdout: &holdout,
            protocol: &protocol,
        };
        let defaults = Options::default();
        let options = Options {
            max_effects: self.config.max_effects,
            seed: case.seed,
            pull_hz: self.config.pull_hz,
            timestep_s: self.config.timestep,
            most_windows: self.config.most_windows.unwrap_or(defaults.most_windows),
            ..defaults
        };
        let begin = Instant::now();
        let mut kept = gap::Kept::default();
        let answer = gap::resume(&input, &options, &mut kept, &mut *report)?.answer;
        let seconds = begin.elapsed().as_secs_f64();
        // the seal is broken here
        let truth = rig.truth();
        let given: Vec<(String, String)> = (score::hidden(truth).into_iter())
            .map(|at| (at.name, at.place))
            .collect();
        let oracle = if given.is_empty() || holdout.is_empty() {
            None
        } else {
            gap::with_effects(&input, &options, &given, &mut kept, report)?
        };
        let scored = score::score(&self.config, case, truth, &answer, oracle.as_ref());
        Ok(Scored { seconds, ..scored })
    }

    fn record(&self, case: &Case, rig: &Rig, trial: &TrialConfig) -> Result<Recording, BlindError> {
        let entry = behaviour::entry(&trial.behaviour)?;
        let trial = Trial {
            number: trial.trial,
            label: trial.behaviour.clone(),
            seconds: trial.seconds.unwrap_or(entry.seconds),
        };
        let mut behaviour = rig.behaviour(entry, &trial)?;
        let outcome = rig.record(behaviour.as_mut(), &trial, |_| ())?;
        match outcome.diverged {
            Some(reason) => Err(BlindError::Diverged {
                case: case.key(&self.config),
                reason,
            }),
            None => Ok(outcome.recording),
        }
    }
}
