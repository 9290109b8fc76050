//! How much the mass matters to a policy: the spiral with other objects.

use serde::{Deserialize, Serialize};

use super::table::{Evaluated, at_mass, mean};
use super::{Case, ReproduceError, Study, TRUE_MASS_KG};
use crate::policy::AffineGaussian;

/// Masses of the object, kg: from three quarters of the true one to half again.
pub(super) const MASSES_KG: [f64; 5] = [0.26, 0.30, 0.34, 0.40, 0.50];

/// The test with one object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MassRow {
    /// of the object, kg
    pub mass_kg: f64,
    /// over all rollouts, cm
    pub mean_distance_cm: f64,
}

/// The test with every object; that with the true one, `true_cm`, is known.
pub(super) fn rows(
    study: &Study,
    policy: &AffineGaussian,
    true_cm: f64,
) -> Result<Vec<MassRow>, ReproduceError> {
    let row = |mass_kg: f64| {
        let mean_distance_cm = if mass_kg == TRUE_MASS_KG {
            true_cm
        } else {
            at_mass(study, policy, mass_kg, study.n_rollout)?.mean_distance_cm
        };
        Ok(MassRow {
            mass_kg,
            mean_distance_cm,
        })
    };
    MASSES_KG.into_iter().map(row).collect()
}

/// Mean over seeds at every mass, of the policies of a case.
pub(super) fn means(results: &[Evaluated], case: Case) -> Vec<[f64; 2]> {
    let at = |mass: f64| {
        let of_case = results.iter().filter(|r| r.case == case);
        let rows = of_case.flat_map(|r| &r.masses);
        let these: Vec<f64> = rows
            .filter(|m| m.mass_kg == mass)
            .map(|m| m.mean_distance_cm)
            .collect();
        [mass, mean(&these)]
    };
    MASSES_KG.into_iter().map(at).collect()
}
