//! A record of what this program computes, made for another implementation to check.
//!
//! [`record`] simulates a few models, runs the pushing task and makes one policy update, and keeps every input next
//! to every result. `scripts/crosscheck.py` computes the same from the inputs, with the official Python package and
//! `NumPy`, and compares. Nothing in a record depends on the machine's number of threads.
//!
//! The fields of [`Record`] and below are those of the JSON document, numbers with all their digits.

pub mod physics;
pub mod pushing;
pub mod update;

use std::path::Path;

use serde::Serialize;
use thiserror::Error;

use crate::supplement::SupplementError;
use crate::train::TrainError;
use physics::Physics;
use pushing::Pushing;
use update::UpdateRecord;

/// Version of the document's layout.
pub const FORMAT: &str = "phantom-crosscheck-1";

/// The document.
#[derive(Debug, Serialize)]
pub struct Record {
    /// [`FORMAT`]
    pub format: &'static str,
    /// version of the `MuJoCo` library, `222` for 2.2.2
    pub mujoco: &'static str,
    /// seed of every draw
    pub seed: u64,
    /// simulations
    pub physics: Vec<Physics>,
    /// observations, actions and rewards
    pub pushing: Pushing,
    /// one iteration's learning step
    pub update: UpdateRecord,
}

/// Why there is no record.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CrosscheckError {
    /// The pushing task or its training failed.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A model cannot be loaded or simulated.
    #[error(transparent)]
    Supplement(#[from] SupplementError),
}

/// Compute a record from the models below `root`, the top of the repository.
///
/// # Errors
/// When a model cannot be loaded, or any of the computations fails.
pub fn record(root: &Path, seed: u64) -> Result<Record, CrosscheckError> {
    let mut physics = physics::small_models(root, seed)?;
    let (phantom, pushing) = pushing::record(root, seed)?;
    physics.extend(phantom);
    let update = update::record(root, seed)?;
    // the library was found to be of this version when the first model was loaded
    let mujoco = env!("PHANTOM_MUJOCO_HEADER_VERSION");
    Ok(Record {
        format: FORMAT,
        mujoco,
        seed,
        physics,
        pushing,
        update,
    })
}
