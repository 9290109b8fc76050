//! Physics that the model lacks, looked for in a round of the loop.

use crate::adapt::{AdaptError, Found, Missing, Search, Watch};
use crate::cli::gap::write::Folder;
use crate::compare::Settings;
use crate::gap::effect::ModelFile;
use crate::gap::{self, GapError, Input, Options};
use crate::run_dir;

/// Searches the recordings of a round, and writes what `phantom gap` does into its folder `gap`. All but the last
/// recording find and fit, that one verifies; a single one does both.
pub(super) fn find(search: &Search<'_>, watch: &mut dyn Watch) -> Result<Found, AdaptError> {
    let refuse = |reason: String| AdaptError::Gap {
        round: search.round,
        reason,
    };
    let config = &search.adaptation.config;
    let model = ModelFile::load(&search.adaptation.model_path)
        .map_err(|error| refuse(error.to_string()))?;
    let n = search.recordings.len();
    let (train, holdout) = search.recordings.split_at(n.saturating_sub(1).max(1));
    let protocol = Settings::default();
    let input = Input {
        model: &model,
        config: &search.adaptation.parameters,
        train,
        holdout,
        protocol: &protocol,
    };
    let options = Options {
        max_effects: config.max_effects,
        seed: config.training.train.seed,
        ..Options::default()
    };
    let outcome = gap::run(&input, &options, &mut |_, _, _| watch.advanced());
    let outcome = match outcome {
        Err(GapError::Stopped) => return Ok(Found::Stopped),
        other => other.map_err(|error| refuse(error.to_string()))?,
    };
    let folder = search.folder.join("gap");
    let title = format!("Round {}: what the model lacks", search.round);
    Folder::new(&folder)
        .and_then(|folder| folder.write(&title, &model, &outcome))
        .map_err(|error| refuse(error.to_string()))?;
    // priors of the other numbers are around those of the model as it was
    let extended = folder.join("extended.xml");
    run_dir::write_atomic(&extended, outcome.extended.as_bytes())?;
    if outcome.answer.effects.is_empty() {
        return Ok(Found::Nothing);
    }
    Ok(Found::Missing(Missing {
        model: extended,
        effects: (outcome.answer.effects.iter())
            .map(|e| format!("{} at {}", e.name, e.at))
            .collect(),
        parameters: outcome.rules,
    }))
}
