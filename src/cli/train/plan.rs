//! What a run begins with: read by process 0, and sent to the others.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{EnsembleFile, TrainArgs, agree, read};
use crate::cli::{CliError, load_model, model_path, read_toml};
use crate::run_dir::RunDir;
use crate::team::Team;
use crate::train::config::TrainConfig;
use crate::train::folder::{CHECKPOINT_FILE, CONFIG_FILE, MODEL_FILE, MODEL_PATH_FILE};
use crate::train::{Checkpoint, Trainer};

/// Settings, model and state to begin with.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Plan {
    // a message is read by position, which settings that are left out would shift
    #[serde(with = "toml_text")]
    config: TrainConfig,
    /// absolute: there on every machine
    pub(super) model: PathBuf,
    checkpoint: Option<Checkpoint>,
}

impl Plan {
    /// The plan that the arguments ask for.
    pub(super) fn read(arguments: &TrainArgs) -> Result<Self, CliError> {
        let mut plan = match &arguments.resume {
            Some(folder) => Self::of_run(folder, arguments.model.as_deref())?,
            None => Self::of_new_run(arguments)?,
        };
        let train = &mut plan.config.train;
        if let Some(iterations) = arguments.iterations {
            train.iterations = iterations as u64;
        }
        if let Some(seed) = arguments.seed {
            train.seed = seed;
        }
        if arguments.mass.is_some() {
            train.object_mass_kg = arguments.mass;
        }
        Ok(plan)
    }

    fn of_new_run(arguments: &TrainArgs) -> Result<Self, CliError> {
        let mut config = match &arguments.config {
            Some(file) => read_config(file)?,
            None => TrainConfig::default(),
        };
        if let Some(file) = &arguments.ensemble {
            let table: EnsembleFile = read_toml(file)?;
            config.ensemble = Some(table.ensemble);
        }
        Ok(Self {
            config,
            model: absolute(model_path(arguments.model.as_deref())),
            checkpoint: None,
        })
    }

    fn of_run(folder: &Path, model: Option<&Path>) -> Result<Self, CliError> {
        let dir = RunDir::open(folder)?;
        let config = read_config(&dir.file(CONFIG_FILE))?;
        let path: PathBuf = match model {
            Some(path) => path.to_owned(),
            None => dir.read_json(MODEL_PATH_FILE)?,
        };
        if read(&path)? != read(&dir.file(MODEL_FILE))? {
            return Err(CliError::File {
                file: path,
                reason: format!(
                    "the model has changed since the run began; its copy is {}",
                    dir.file(MODEL_FILE).display()
                ),
            });
        }
        Ok(Self {
            config,
            model: absolute(path),
            checkpoint: Some(dir.read_json(CHECKPOINT_FILE)?),
        })
    }

    /// The trainer of this process, in the state to begin with.
    pub(super) fn trainer(
        &mut self,
        team: &Arc<Team>,
        arguments: &TrainArgs,
        threads: usize,
    ) -> Result<Trainer, CliError> {
        let loaded = load_model(&self.model).and_then(|model| Ok((model.fingerprint()?, model)));
        let (fingerprint, model) = agree(team, loaded)?;
        team.same("model", &fingerprint)?;
        let mut trainer = Trainer::in_team(Arc::clone(team), model, self.config.clone(), threads)?;
        if let (Some(folder), Some(checkpoint)) = (&arguments.resume, self.checkpoint.take()) {
            trainer
                .restore(checkpoint)
                .map_err(|error| CliError::File {
                    file: folder.join(CHECKPOINT_FILE),
                    reason: error.to_string(),
                })?;
        }
        Ok(trainer)
    }
}

fn absolute(path: PathBuf) -> PathBuf {
    std::path::absolute(&path).unwrap_or(path)
}

fn read_config(path: &Path) -> Result<TrainConfig, CliError> {
    let config: TrainConfig = read_toml(path)?;
    config.validate().map_err(|source| CliError::Setting {
        file: path.to_owned(),
        source,
    })?;
    Ok(config)
}

/// A field as TOML text.
mod toml_text {
    use serde::{Deserialize, Deserializer, Serialize, Serializer, de, ser};

    pub(super) fn serialize<T: Serialize, S: Serializer>(
        value: &T,
        to: S,
    ) -> Result<S::Ok, S::Error> {
        let text = toml::to_string(value).map_err(ser::Error::custom)?;
        to.serialize_str(&text)
    }

    pub(super) fn deserialize<'de, T: de::DeserializeOwned, D: Deserializer<'de>>(
        from: D,
    ) -> Result<T, D::Error> {
        let text = String::deserialize(from)?;
        toml::from_str(&text).map_err(de::Error::custom)
    }
}
