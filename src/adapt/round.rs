//! Rounds of the loop, each step of which is kept and found again.
//!
//! ```text
//! DIR/adapt.json                     what is asked for; a folder is for one loop
//! DIR/round-K/recordings/*.mcap      made with the policy of round K - 1
//! DIR/round-K/missing.json           physics that the model lacks, by the same recordings
//! DIR/round-K/identified.json        posterior of all recordings so far, models drawn from it
//! DIR/round-K/policy/                run folder of the training
//! DIR/round-K/tracking.json          the policy on the machine; of round 0, the policy to begin with
//! DIR/nominal/, DIR/truth/           the references, likewise
//! ```

use std::fs;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::identify::{Found, Identified, Missing, Named, identify};
use super::{AdaptError, Adaptation};
use crate::mujoco::Model;
use crate::policy::AffineGaussian;
use crate::recording;
use crate::rig::Trial;
use crate::rig::behaviour;
use crate::rig::tracking;
use crate::supplement;
use crate::train::Trainer;
use crate::train::config::TrainConfig;
use crate::train::folder::train_in;
use crate::{randomise::Ensemble, run_dir};

/// Between the seeds of the trainings of two rounds.
const SEEDS: u64 = 1000;

/// A policy on the machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Tracking {
    /// over all rollouts, cm
    pub mean_cm: f64,
    /// mean distance of each rollout, cm
    pub rollouts_cm: Vec<f64>,
    /// rollouts that broke down
    pub n_diverged: usize,
}

/// One time round the loop.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Round {
    /// from 0, the policy to begin with
    pub number: usize,
    /// of the policy at the end of the round
    pub tracking: Tracking,
    /// what was found in it
    pub identified: Option<Identified>,
}

/// Training as long, without identification.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Reference {
    /// on the nominal model
    Nominal,
    /// on the truth of the rig
    Truth,
}

/// Is told what is going on, and says whether to go on.
pub trait Watch {
    /// A step begins.
    fn stage(&mut self, text: &str);
    /// A little was done.
    fn advanced(&mut self) -> bool;
}

/// Where physics that the model lacks is looked for.
pub struct Search<'a> {
    /// the loop
    pub adaptation: &'a Adaptation,
    /// from 1
    pub round: usize,
    /// all so far
    pub recordings: &'a Named,
    /// of the round
    pub folder: &'a Path,
}

/// Finds physics that the model lacks.
pub type FindMissing<'a> =
    &'a mut dyn FnMut(&Search<'_>, &mut dyn Watch) -> Result<Found, AdaptError>;

impl Adaptation {
    /// All rounds, from round 0; nothing when `watch` ends them.
    ///
    /// # Errors
    /// A step fails, or the folder is that of another loop.
    pub fn run(
        &self,
        find: FindMissing<'_>,
        watch: &mut dyn Watch,
    ) -> Result<Option<Vec<Round>>, AdaptError> {
        self.claim()?;
        let mut policy = self.policy.clone();
        let mut rounds = vec![Round {
            number: 0,
            tracking: self.tracking(&self.round(0), &policy, watch)?,
            identified: None,
        }];
        let mut recordings = Named::new();
        for number in 1..=self.config.rounds {
            let folder = self.round(number);
            watch.stage(&format!("round {number}: recording"));
            recordings.extend(self.recordings(number, &policy)?);
            let file = folder.join("identified.json");
            let identified: Identified = if file.exists() {
                run_dir::read_json(&file)?
            } else {
                let Some(missing) = self.missing(number, &recordings, find, watch)? else {
                    return Ok(None);
                };
                watch.stage(&format!("round {number}: identification"));
                let mut go_on = true;
                let found = identify(self, &recordings, missing.as_ref(), &mut |_| {
                    go_on = watch.advanced();
                    go_on
                })?;
                if !go_on {
                    return Ok(None);
                }
                write(&file, &found)?;
                found
            };
            watch.stage(&format!("round {number}: training"));
            let model = load(&identified.model)?;
            let ensemble = Some(identified.ensemble.clone());
            let trained = self.train(
                &folder,
                &identified.model,
                model,
                ensemble,
                number,
                &policy,
                watch,
            )?;
            let Some(trained) = trained else {
                return Ok(None);
            };
            policy = trained;
            rounds.push(Round {
                number,
                tracking: self.tracking(&folder, &policy, watch)?,
                identified: Some(identified),
            });
        }
        Ok(Some(rounds))
    }

    /// As many trainings without identification, from the same policy; nothing when `watch` ends them.
    ///
    /// # Errors
    /// A training fails, or the truth cannot be told by a model.
    pub fn reference(
        &self,
        which: Reference,
        watch: &mut dyn Watch,
    ) -> Result<Option<Vec<Tracking>>, AdaptError> {
        self.claim()?;
        let (name, model) = match which {
            Reference::Nominal => ("nominal", self.model.try_clone()?),
            Reference::Truth => ("truth", self.rig.true_model()?.0),
        };
        let mut policy = self.policy.clone();
        let mut all = vec![self.tracking(&self.round(0), &policy, watch)?];
        for number in 1..=self.config.rounds {
            let folder = self.out.join(name).join(format!("round-{number}"));
            watch.stage(&format!("{name}, round {number}: training"));
            let model = model.try_clone()?;
            let trained = self.train(
                &folder,
                &self.model_path,
                model,
                None,
                number,
                &policy,
                watch,
            )?;
            let Some(trained) = trained else {
                return Ok(None);
            };
            policy = trained;
            all.push(self.tracking(&folder, &policy, watch)?);
        }
        Ok(Some(all))
    }

    /// What the model lacks by `recordings`, if anything; nothing when `watch` ends the search.
    #[allow(clippy::option_option)] // stopped, or nothing found
    fn missing(
        &self,
        number: usize,
        recordings: &Named,
        find: FindMissing<'_>,
        watch: &mut dyn Watch,
    ) -> Result<Option<Option<Missing>>, AdaptError> {
        if self.config.max_effects == 0 {
            return Ok(Some(None));
        }
        let folder = self.round(number);
        let file = folder.join("missing.json");
        if file.exists() {
            return Ok(Some(run_dir::read_json(&file)?));
        }
        watch.stage(&format!("round {number}: missing physics"));
        let search = Search {
            adaptation: self,
            round: number,
            recordings,
            folder: &folder,
        };
        let missing = match find(&search, watch)? {
            Found::Stopped => return Ok(None),
            Found::Nothing => None,
            Found::Missing(missing) => Some(missing),
        };
        write(&file, &missing)?;
        Ok(Some(missing))
    }

    fn round(&self, number: usize) -> PathBuf {
        self.out.join(format!("round-{number}"))
    }

    /// Make sure that the folder is this loop's.
    fn claim(&self) -> Result<(), AdaptError> {
        let mut config = self.config.clone();
        config.rounds = 0; // more of them go on
        let asked = json!({
            "model": self.model.fingerprint()?,
            "rig": self.rig.truth(),
            "policy": self.policy,
            "parameters": self.parameters,
            "config": config,
        });
        let file = self.out.join("adapt.json");
        if !file.exists() {
            return write(&file, &asked);
        }
        let found: Value = run_dir::read_json(&file)?;
        if found == asked {
            return Ok(());
        }
        let mut which = vec!["model", "rig", "policy", "parameters", "config"];
        which.retain(|key| found[*key] != asked[*key]);
        Err(AdaptError::File {
            file,
            reason: format!(
                "the loop in this folder has another {}: choose another folder",
                which.join(", ")
            ),
        })
    }

    /// The recordings of a round, made with `policy` unless they were before.
    fn recordings(&self, number: usize, policy: &AffineGaussian) -> Result<Named, AdaptError> {
        let folder = self.round(number).join("recordings");
        let mut named = Named::new();
        for name in &self.config.behaviours {
            let file = folder.join(format!("{name}.mcap"));
            if !file.exists() {
                let entry = behaviour::entry(name)?;
                let trial = Trial {
                    number: number as u64,
                    label: name.clone(),
                    seconds: self.config.seconds,
                };
                let mut behaviour = self.rig.behaviour(entry, &trial)?;
                let outcome = self.rig.record(behaviour.as_mut(), &trial, |_| ())?;
                if let Some(reason) = outcome.diverged {
                    return Err(AdaptError::Breakdown {
                        round: number,
                        behaviour: name.clone(),
                        reason,
                    });
                }
                make(&folder)?;
                recording::write(&file, &outcome.recording)?;
            }
            named.push((format!("round {number}, {name}"), recording::read(&file)?));
        }
        let file = folder.join("policy.mcap");
        if !file.exists() {
            let followed = tracking::follow(&self.rig, policy, self.first_trial(number))?;
            make(&folder)?;
            recording::write(&file, &followed.recording)?;
        }
        if self.config.identify_policy {
            named.push((format!("round {number}, policy"), recording::read(&file)?));
        }
        Ok(named)
    }

    /// Trials of the policy in recordings differ from those of tests.
    fn first_trial(&self, number: usize) -> u64 {
        (self.config.rollouts + number) as u64
    }

    /// `policy` on the machine.
    fn tracking(
        &self,
        folder: &Path,
        policy: &AffineGaussian,
        watch: &mut dyn Watch,
    ) -> Result<Tracking, AdaptError> {
        let file = folder.join("tracking.json");
        if file.exists() {
            return Ok(run_dir::read_json(&file)?);
        }
        watch.stage("the policy on the machine");
        let all: Vec<_> = (0..self.config.rollouts)
            .into_par_iter()
            .with_max_len(1)
            .map(|i| {
                let followed = tracking::follow(&self.rig, policy, i as u64)?;
                Ok((followed.mean_distance_cm(), followed.diverged.is_some()))
            })
            .collect();
        let all = all.into_iter().collect::<Result<Vec<_>, AdaptError>>()?;
        let rollouts_cm: Vec<f64> = all.iter().map(|(cm, _)| *cm).collect();
        let tracking = Tracking {
            mean_cm: rollouts_cm.iter().sum::<f64>() / rollouts_cm.len() as f64,
            rollouts_cm,
            n_diverged: all.iter().filter(|(_, diverged)| *diverged).count(),
        };
        write(&file, &tracking)?;
        Ok(tracking)
    }

    /// The training of a round.
    #[allow(clippy::too_many_arguments)] // what a training is
    fn train(
        &self,
        folder: &Path,
        path: &Path,
        model: Model,
        ensemble: Option<Ensemble>,
        number: usize,
        begin: &AffineGaussian,
        watch: &mut dyn Watch,
    ) -> Result<Option<AffineGaussian>, AdaptError> {
        let mut config: TrainConfig = self.config.training();
        config.train.seed += SEEDS * number as u64;
        config.ensemble = ensemble;
        let mut trainer = Trainer::new(model, config, self.threads)?;
        if !self.config.from_scratch {
            trainer.begin_with(begin.clone())?;
        }
        let folder = folder.join("policy");
        Ok(train_in(&folder, path, trainer, &mut |_, _| {
            watch.advanced()
        })?)
    }
}

fn load(file: &Path) -> Result<Model, AdaptError> {
    supplement::load(file).map_err(|source| AdaptError::Supplement {
        file: file.to_owned(),
        source,
    })
}

fn make(folder: &Path) -> Result<(), AdaptError> {
    fs::create_dir_all(folder).map_err(|reason| AdaptError::File {
        file: folder.to_owned(),
        reason: reason.to_string(),
    })
}

fn write<T: Serialize + ?Sized>(file: &Path, value: &T) -> Result<(), AdaptError> {
    if let Some(folder) = file.parent() {
        make(folder)?;
    }
    let text = serde_json::to_string_pretty(value).map_err(|error| AdaptError::File {
        file: file.to_owned(),
        reason: error.to_string(),
    })?;
    Ok(run_dir::write_atomic(file, (text + "\n").as_bytes())?)
}
