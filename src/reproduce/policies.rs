//! The policies of a study: trained once, and found again.

use std::path::PathBuf;

use super::{Case, ReproduceError, Study};
use crate::policy::AffineGaussian;
use crate::train::config::TrainConfig;
use crate::train::folder::train_in;
use crate::train::{Checkpoint, IterationRecord, Trainer};

/// Where the run of a case and seed is.
pub fn folder(study: &Study, case: Case, seed: u64) -> PathBuf {
    let name = format!("{}-seed{seed}", case.name());
    study.out.join("policies").join(name)
}

/// Settings of a run.
pub fn config(study: &Study, case: Case, seed: u64) -> TrainConfig {
    let mut config = study.base.clone();
    let [mass, sigma] = case.mass_kg();
    config.train.seed = seed;
    config.train.object_mass_kg = Some(mass);
    config.train.object_mass_sigma_kg = sigma;
    config
}

/// The policy of a case and seed after the last iteration, trained now unless it was before. Evaluations during training
/// know the true mass, so that no policy is chosen by them. `watch` sees every iteration and says whether to go on;
/// nothing is returned when it does not.
///
/// # Errors
/// The folder holds another run, or training fails.
pub fn policy(
    study: &Study,
    case: Case,
    seed: u64,
    watch: &mut dyn FnMut(&IterationRecord, &Checkpoint) -> bool,
) -> Result<Option<AffineGaussian>, ReproduceError> {
    let model = study.model.try_clone()?;
    let trainer = Trainer::new(model, config(study, case, seed), study.threads)?;
    let folder = folder(study, case, seed);
    Ok(train_in(&folder, &study.model_path, trainer, watch)?)
}
