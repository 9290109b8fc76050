//! Joints that only close loops: their positions, velocities and the independent directions of motion.
//!
//! Equality constraints c(q) = 0 with Jacobian J split the degrees of freedom into independent ones and passive ones
//! (in J, without an actuator). Positions by Gauss-Newton, velocities and directions by the linear map
//!
//! ```text
//! q_p ← q_p - J_p⁺ c(q)          v_p = -J_p⁺ J_i v_i          N = [I; -J_p⁺ J_i],   J N = 0
//! ```
//!
//! Forces of the constraints vanish in Nᵀ f whatever their size, so Nᵀ compares motor torques of a machine with loops
//! without knowing what its loops carry.

use std::sync::Arc;

use nalgebra::DMatrix;

use crate::mujoco::{Data, Model, MujocoError};

const ITERATIONS: usize = 20;
/// m or rad
const TOLERANCE: f64 = 1e-10;
/// relative to the largest singular value
const RANK: f64 = 1e-9;

/// Solver of the loops of one model.
#[derive(Debug)]
pub(super) struct Closure {
    data: Data,
    /// degrees of freedom in a loop, without actuator
    pub(super) passive: Vec<usize>,
}

impl Closure {
    /// Find the passive degrees of freedom, at the model's initial state.
    pub(super) fn new(model: &Model) -> Result<Self, MujocoError> {
        let mut data = Data::new(Arc::new(model.with_dense_jacobian()?))?;
        data.forward()?;
        let (j, _) = equality(&data);
        let nv = model.nv();
        let driven = |dof: usize| {
            data.actuator_moment()
                .iter()
                .skip(dof)
                .step_by(nv)
                .any(|m| *m != 0.0)
        };
        let passive = (0..nv)
            .filter(|dof| j.column(*dof).iter().any(|x| *x != 0.0) && !driven(*dof))
            .collect();
        Ok(Self { data, passive })
    }

    /// Move `passive` so that the loops close; returns what is left open.
    pub(super) fn close(
        &mut self,
        qpos: &mut [f64],
        passive: &[usize],
    ) -> Result<f64, MujocoError> {
        let nv = self.data.model().nv();
        for iteration in 0.. {
            self.data.qpos_mut().copy_from_slice(qpos);
            self.data.position_stage()?;
            let (j, residual) = equality(&self.data);
            let open = residual.iter().fold(0.0_f64, |most, r| most.max(r.abs()));
            if open <= TOLERANCE || iteration == ITERATIONS || passive.is_empty() {
                return Ok(open);
            }
            let step = pseudo_solve(
                &columns(&j, passive),
                &DMatrix::from_vec(residual.len(), 1, residual),
            );
            let mut direction = vec![0.0; nv];
            for (dof, change) in passive.iter().zip(step.iter()) {
                direction[*dof] = -change;
            }
            self.data.model().integrate_pos(qpos, &direction, 1.0)?;
        }
        unreachable!("the loop ends by its count")
    }

    /// Velocities of `passive` from the others, at `qpos`.
    pub(super) fn close_velocity(
        &mut self,
        qpos: &[f64],
        qvel: &mut [f64],
        passive: &[usize],
    ) -> Result<(), MujocoError> {
        let (directions, independent) = self.directions(qpos, passive)?;
        let moving =
            DMatrix::from_iterator(independent.len(), 1, independent.iter().map(|i| qvel[*i]));
        let all = directions * moving;
        for dof in passive {
            qvel[*dof] = all[*dof];
        }
        Ok(())
    }

    /// N (nv × independent) at `qpos`, and the independent degrees of freedom.
    pub(super) fn directions(
        &mut self,
        qpos: &[f64],
        passive: &[usize],
    ) -> Result<(DMatrix<f64>, Vec<usize>), MujocoError> {
        let nv = self.data.model().nv();
        let independent: Vec<usize> = (0..nv).filter(|dof| !passive.contains(dof)).collect();
        let mut n = DMatrix::zeros(nv, independent.len());
        for (column, dof) in independent.iter().enumerate() {
            n[(*dof, column)] = 1.0;
        }
        if !passive.is_empty() {
            self.data.qpos_mut().copy_from_slice(qpos);
            self.data.position_stage()?;
            let (j, _) = equality(&self.data);
            let map = pseudo_solve(&columns(&j, passive), &columns(&j, &independent));
            for (row, dof) in passive.iter().enumerate() {
                n.row_mut(*dof).copy_from(&(-map.row(row)));
            }
        }
        Ok((n, independent))
    }
}

/// Jacobian (rows × nv) and residual of the equality constraints of the last position stage.
fn equality(data: &Data) -> (DMatrix<f64>, Vec<f64>) {
    let nv = data.model().nv();
    let rows = data.equality_rows();
    let j = DMatrix::from_fn(rows.len(), nv, |r, c| data.efc_J()[rows[r] * nv + c]);
    let residual = rows.iter().map(|i| data.efc_pos()[*i]).collect();
    (j, residual)
}

fn columns(j: &DMatrix<f64>, dofs: &[usize]) -> DMatrix<f64> {
    DMatrix::from_fn(j.nrows(), dofs.len(), |r, c| j[(r, dofs[c])])
}

/// The least-norm least-squares solution of A x = b.
fn pseudo_solve(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    let svd = a.clone().svd(true, true);
    let smallest = RANK * svd.singular_values.max();
    svd.solve(b, smallest)
        .unwrap_or_else(|_| DMatrix::zeros(a.ncols(), b.ncols()))
}
