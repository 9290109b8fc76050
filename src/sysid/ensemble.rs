//! Models drawn from the posterior, for training.
//!
//! x ~ N(x̂, C), inside the bounds. Directions that nothing determines would give absurd models: along each principal
//! axis, in units of the parameters' sizes, the spread is at most `MOST`.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::SysidError;
use super::interval::Posterior;
use super::parameter::{Parameter, Parameters};
use crate::mjcf::attribute::Place;
use crate::mujoco::{Data, Model};
use crate::randomise::Ensemble;
use crate::rng::{self, Purpose};

/// Largest standard deviation along a principal axis, in sizes: a factor of about 1.6 on log scales.
const MOST: f64 = 0.5;

/// `n` draws of the free parameters (n × free).
pub fn draw(
    parameters: &Parameters,
    x: &[f64],
    posterior: &Posterior,
    n: usize,
    seed: u64,
) -> Vec<Vec<f64>> {
    let free: Vec<&Parameter> = parameters.iter_free().collect();
    let m = x.len();
    let scaled = DMatrix::from_fn(m, m, |i, j| {
        posterior.covariance[(i, j)] / (free[i].typical * free[j].typical)
    });
    let eigen = SymmetricEigen::new(scaled);
    let sigma = eigen.eigenvalues.map(|v| v.max(0.0).sqrt().min(MOST));
    (0..n)
        .map(|k| {
            let mut rng = rng::stream(seed, Purpose::Posterior, 0, k as u64);
            let z = DVector::from_fn(m, |i, _| sigma[i] * rng::normal(&mut rng));
            let change = &eigen.eigenvectors * z;
            (0..m)
                .map(|i| {
                    let (lower, upper) = free[i].bounds();
                    (x[i] + change[i] * free[i].typical).clamp(lower, upper)
                })
                .collect()
        })
        .collect()
}

/// The model with parameters `x` (free).
///
/// # Errors
/// The engine refuses a number.
pub fn model_at(
    nominal: &Arc<Model>,
    parameters: &Parameters,
    x: &[f64],
) -> Result<Model, SysidError> {
    let mut data = Data::new(Arc::clone(nominal))?;
    parameters.apply(nominal, x, &mut data)?;
    Ok(data.model().try_clone()?)
}

/// The draws as numbers of the model, for training.
///
/// # Errors
/// The engine refuses a number.
pub fn models(
    nominal: &Arc<Model>,
    parameters: &Parameters,
    draws: &[Vec<f64>],
) -> Result<Ensemble, SysidError> {
    let models = (draws.iter())
        .map(|x| model_at(nominal, parameters, x))
        .collect::<Result<Vec<_>, _>>()?;
    let mut arrays: Vec<&str> = Vec::new();
    for target in parameters.targets() {
        let changed: &[&str] = match target.place {
            Place::Slots {
                array: "geom_size", ..
            } => &["geom_size", "geom_rbound"],
            Place::Slots { array, .. } => &[array],
            Place::Mass(_) => &["body_mass", "body_inertia"],
            Place::Inertia(..) => &["body_mass", "body_ipos", "body_inertia", "body_iquat"],
            Place::Rotation(..) => &["body_quat"],
            Place::Gravity(_) | Place::Tilt(_) => &["gravity"],
            Place::ContactStiffness(_)
            | Place::ContactDamping(_)
            | Place::ContactHardness(_)
            | Place::ContactRatio(_) => &["pair_solref"],
            Place::Sliding(_) => &["pair_friction"],
            Place::Length(_) => &["body_pos"],
            Place::Geometry(_) => &["geom_size", "geom_pos", "geom_rbound"],
            Place::ForceLimit(_) => &["actuator_forcerange"],
        };
        for array in changed {
            if !arrays.contains(array) {
                arrays.push(array);
            }
        }
    }
    Ok(Ensemble::new(nominal, &models, &arrays))
}
