//! Differences of recorded positions: velocities and accelerations, with orientations as quaternions.

use super::CompareError;
use crate::mujoco::Model;

/// Addresses in qpos of the orientations of free joints.
pub(super) fn free_quaternions(model: &Model) -> Vec<usize> {
    let free = (0..model.njnt()).filter(|joint| model.is_free(*joint));
    free.map(|joint| model.jnt_qposadr()[joint] as usize + 3)
        .collect()
}

/// Give neighbouring quaternions one sign: q and -q are the same orientation.
pub(super) fn align(qpos: &mut [f64], nq: usize, quaternions: &[usize]) {
    for address in quaternions {
        for k in 1..qpos.len() / nq {
            let (before, this) = ((k - 1) * nq + address, k * nq + address);
            let product: f64 = (0..4).map(|i| qpos[before + i] * qpos[this + i]).sum();
            if product < 0.0 {
                qpos[this..this + 4].iter_mut().for_each(|q| *q = -*q);
            }
        }
    }
}

/// Make every quaternion one of length 1; zeros stay.
pub(super) fn normalise(qpos: &mut [f64], nq: usize, quaternions: &[usize]) {
    for row in qpos.chunks_exact_mut(nq) {
        for address in quaternions {
            let quat = &mut row[*address..address + 4];
            let length = quat.iter().map(|q| q * q).sum::<f64>().sqrt();
            if length > 0.0 {
                for q in quat.iter_mut() {
                    *q /= length;
                }
            }
        }
    }
}

/// Velocities between the neighbours of each sample, one-sided at the ends.
pub(super) fn differences(
    model: &Model,
    time_s: &[f64],
    qpos: &[f64],
) -> Result<Vec<f64>, CompareError> {
    let (n, nq, nv) = (time_s.len(), model.nq(), model.nv());
    let mut qvel = vec![0.0; n * nv];
    for (k, row) in qvel.chunks_exact_mut(nv).enumerate() {
        let (a, b) = (k.saturating_sub(1), (k + 1).min(n - 1));
        let row_of = |i: usize| &qpos[i * nq..(i + 1) * nq];
        model.differentiate_pos(row, time_s[b] - time_s[a], row_of(a), row_of(b))?;
    }
    Ok(qvel)
}

/// Differences of velocities, forwards for `step`, else between neighbours.
pub(super) fn accelerations(nv: usize, time_s: &[f64], qvel: &[f64], step: bool) -> Vec<f64> {
    let n = time_s.len();
    let mut qacc = vec![0.0; n * nv];
    for (k, row) in qacc.chunks_exact_mut(nv).enumerate() {
        let b = (k + 1).min(n - 1);
        let a = if step { b - 1 } else { k.saturating_sub(1) };
        for (dof, value) in row.iter_mut().enumerate() {
            *value = (qvel[b * nv + dof] - qvel[a * nv + dof]) / (time_s[b] - time_s[a]);
        }
    }
    qacc
}
