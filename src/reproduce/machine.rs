//! The machines that stand in for the paper's hardware.

use super::{ReproduceError, TRUE_MASS_KG};
use crate::mujoco::Model;
use crate::randomise::{Distribution, Rule};
use crate::rig::{Rig, RigConfig};

/// Machine number `index` of the family of `rig`, with the paper's object.
///
/// # Errors
/// The configuration does not fit the model.
pub fn machine(model: &Model, rig: &RigConfig, index: u64) -> Result<Rig, ReproduceError> {
    let mut config = rig.clone();
    config.seed = rig.seed + index;
    config.randomise.push(Rule::new(
        "body/object",
        "mass",
        &[],
        Distribution::Fixed(TRUE_MASS_KG),
    ));
    Ok(Rig::new(model.try_clone()?, config)?)
}
