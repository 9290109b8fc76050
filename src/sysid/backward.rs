//! Covariances of a filter, and its pass backwards.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

use super::SysidError;
use crate::mujoco::Model;

/// Least variance of the belief relative to its diagonal, for the square root.
const JITTER: f64 = 1e-12;

/// Everything the backward pass needs of a step.
pub(super) struct Kept {
    pub corrected: (Vec<f64>, Vec<f64>),
    pub ahead: (Vec<f64>, Vec<f64>),
    pub gain: DMatrix<f64>,
}

/// Lower triangular square root of a covariance, whose units may be far apart.
pub(super) fn square_root(covariance: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let (scale, factor) = scaled(covariance)?;
    let mut root = factor.l();
    for (mut row, s) in root.row_iter_mut().zip(&scale) {
        row *= *s;
    }
    Some(root)
}

/// Cholesky factor of a covariance with a little added to its diagonal.
pub(super) fn regular(covariance: &DMatrix<f64>) -> Option<Cholesky<f64, Dyn>> {
    let mut m = covariance.clone();
    for i in 0..m.nrows() {
        m[(i, i)] *= 1.0 + 1e-9;
    }
    m.cholesky()
}

/// Standard deviations, and the factor of the correlations.
fn scaled(covariance: &DMatrix<f64>) -> Option<(Vec<f64>, Cholesky<f64, Dyn>)> {
    let n = covariance.nrows();
    let scale: Vec<f64> = (0..n)
        .map(|i| covariance[(i, i)].max(1e-300).sqrt())
        .collect();
    let correlation = |jitter: f64| {
        DMatrix::from_fn(n, n, |i, j| {
            covariance[(i, j)] / (scale[i] * scale[j]) + if i == j { jitter } else { 0.0 }
        })
    };
    // rounding may leave a covariance a little less than positive
    let jitters = [JITTER, 1e-9, 1e-6];
    let factor = jitters
        .into_iter()
        .find_map(|j| correlation(j).cholesky())?;
    Some((scale, factor))
}

/// Positions with what came later taken into account (Rauch, Tung, Striebel), n × nq.
pub(super) fn backward(model: &Model, kept: &[Kept], nq: usize) -> Result<Vec<f64>, SysidError> {
    let nv = model.nv();
    let mut out = vec![0.0; kept.len() * nq];
    let mut later: Option<(Vec<f64>, Vec<f64>)> = None;
    for (k, step) in kept.iter().enumerate().rev() {
        let mut state = step.corrected.clone();
        if let Some((qpos, qvel)) = &later {
            let mut delta = vec![0.0; nv];
            model.differentiate_pos(&mut delta, 1.0, &step.ahead.0, qpos)?;
            delta.extend(qvel.iter().zip(&step.ahead.1).map(|(a, b)| a - b));
            let correction = &step.gain * DVector::from_vec(delta);
            model.integrate_pos(&mut state.0, &correction.as_slice()[..nv], 1.0)?;
            for (v, d) in state.1.iter_mut().zip(&correction.as_slice()[nv..]) {
                *v += d;
            }
        }
        out[k * nq..(k + 1) * nq].copy_from_slice(&state.0);
        later = Some(state);
    }
    Ok(out)
}
