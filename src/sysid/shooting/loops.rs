//! First states on the loops that equality constraints close.
//!
//! A machine with loops moves in fewer directions than its model has degrees of freedom. The engine's constraints are
//! springs: a first state off the loops is pulled onto them within milliseconds, which hardly shows in the readings, and
//! moves everything else a little. As unknowns such states are all but free, and estimates run away along them. With
//! c(q) = 0 the constraints and J their Jacobian, first states therefore obey
//!
//! ```text
//! c(q) = 0     J v = 0     q ← q ⊕ −J⁺ c(q)     v ← v − J⁺ J v     and change along N,  J N = 0
//! ```
//!
//! Constraints that are springs by intent, slower than [`QUICK_S`], leave their states free.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::window::State;
use crate::mujoco::{Data, Model};
use crate::sysid::SysidError;
use crate::sysid::islands::joined;
use crate::sysid::problem::Problem;

/// Time constant above which a constraint is a spring, s.
const QUICK_S: f64 = 0.03;
const ITERATIONS: usize = 5;
/// m or rad
const CLOSED: f64 = 1e-10;
/// Part of the largest information of a direction below which the constraints say nothing of it.
const RANK: f64 = 1e-9;

/// Solver of the loops of one model.
pub(crate) struct Loops {
    data: Data,
}

impl Loops {
    /// Of the model with parameters `x`; none where no constraint is quick.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(crate) fn new(problem: &Problem, x: &[f64]) -> Result<Option<Self>, SysidError> {
        let Some(mut loops) = Self::of(&problem.model)? else {
            return Ok(None);
        };
        let nominal = Arc::clone(loops.data.model_arc());
        problem.parameters.apply(&nominal, x, &mut loops.data)?;
        Ok(Some(loops))
    }

    fn of(model: &Model) -> Result<Option<Self>, SysidError> {
        if !model.eq_solref().chunks_exact(2).any(is_quick) {
            return Ok(None);
        }
        let data = Data::new(Arc::new(model.with_dense_jacobian()?))?;
        Ok(Some(Self { data }))
    }

    /// A state brought onto the loops.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(crate) fn close(&mut self, state: &State) -> Result<State, SysidError> {
        let mut state = state.clone();
        let mut jacobian = DMatrix::zeros(0, 0);
        for _ in 0..ITERATIONS {
            let (j, open) = self.constraints(&state.qpos)?;
            jacobian = j;
            if open.amax() <= CLOSED {
                break;
            }
            let step = least(&jacobian, &open);
            let model = self.data.model();
            model.integrate_pos(&mut state.qpos, (-step).as_slice(), 1.0)?;
        }
        if jacobian.nrows() > 0 {
            let v = DVector::from_column_slice(&state.qvel);
            let off = least(&jacobian, &(&jacobian * &v));
            state.qvel.copy_from_slice((v - off).as_slice());
        }
        Ok(state)
    }

    /// (2 nv × n) orthonormal directions in which each state may change: of position, then of velocity. Those that have
    /// fewer are filled with zeros.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(crate) fn directions(&mut self, states: &[State]) -> Result<Vec<DMatrix<f64>>, SysidError> {
        let mut all = (states.iter())
            .map(|state| self.along(state))
            .collect::<Result<Vec<_>, _>>()?;
        let most = all.iter().map(DMatrix::ncols).max().unwrap_or_default();
        for own in &mut all {
            let missing = most - own.ncols();
            let padded = std::mem::take(own).insert_columns(most - missing, missing, 0.0);
            *own = padded;
        }
        Ok(all)
    }

    fn along(&mut self, state: &State) -> Result<DMatrix<f64>, SysidError> {
        let (j, _) = self.constraints(&state.qpos)?;
        let nv = state.qvel.len();
        let normal = j.tr_mul(&j);
        let most = normal.diagonal().max();
        let mut found: Vec<(Vec<usize>, DVector<f64>)> = Vec::new();
        // what no constraint ties together has directions of its own
        for dofs in tied(&j) {
            let own = normal.select_rows(&dofs).select_columns(&dofs);
            let eigen = SymmetricEigen::new(own);
            let free = (0..dofs.len()).filter(|&i| eigen.eigenvalues[i] <= RANK * most);
            found.extend(free.map(|i| (dofs.clone(), eigen.eigenvectors.column(i).into_owned())));
        }
        let n = found.len();
        let mut out = DMatrix::zeros(2 * nv, 2 * n);
        for (k, (dofs, own)) in found.iter().enumerate() {
            for (&d, value) in dofs.iter().zip(own.iter()) {
                out[(d, k)] = *value;
                out[(nv + d, n + k)] = *value;
            }
        }
        Ok(out)
    }

    /// J and c of the quick constraints.
    fn constraints(&mut self, qpos: &[f64]) -> Result<(DMatrix<f64>, DVector<f64>), SysidError> {
        self.data.qpos_mut().copy_from_slice(qpos);
        self.data.position_stage()?;
        let (data, model) = (&self.data, self.data.model());
        let nv = model.nv();
        let solref = |row: usize| &model.eq_solref()[2 * data.efc_id()[row] as usize..];
        let mut rows = data.equality_rows();
        rows.retain(|&row| is_quick(solref(row)));
        let jacobian = DMatrix::from_fn(rows.len(), nv, |r, c| data.efc_J()[rows[r] * nv + c]);
        let open = DVector::from_fn(rows.len(), |r, _| data.efc_pos()[rows[r]]);
        Ok((jacobian, open))
    }
}

/// Whether a constraint's `solref` is one of time constant and damping ratio, and quick.
fn is_quick(solref: &[f64]) -> bool {
    solref[0] > 0.0 && solref[0] <= QUICK_S
}

/// Degrees of freedom that rows of a Jacobian tie together, in groups.
fn tied(jacobian: &DMatrix<f64>) -> Vec<Vec<usize>> {
    let ties: Vec<BTreeSet<usize>> = (jacobian.row_iter())
        .map(|row| (0..row.len()).filter(|&dof| row[dof] != 0.0).collect())
        .collect();
    let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (dof, group) in joined(jacobian.ncols(), ties.iter())
        .into_iter()
        .enumerate()
    {
        groups.entry(group).or_default().push(dof);
    }
    groups.into_values().collect()
}

/// The least-norm solution of J d = b.
fn least(jacobian: &DMatrix<f64>, b: &DVector<f64>) -> DVector<f64> {
    let svd = jacobian.clone().svd(true, true);
    let smallest = RANK * svd.singular_values.max();
    svd.solve(b, smallest)
        .unwrap_or_else(|_| DVector::zeros(jacobian.ncols()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two hinges that an equality ties, and a third one.
    const TIED: &str = r#"<mujoco>
      <worldbody><body>
        <joint name="a" axis="0 1 0"/><geom size="0.1"/>
        <body pos="0 0 0.3"><joint name="b" axis="0 1 0"/><geom size="0.1"/></body>
        <body pos="0.5 0 0"><joint name="c" axis="0 1 0"/><geom size="0.1"/></body>
      </body></worldbody>
      <equality><joint joint1="b" joint2="a" polycoef="0.1 -2 0.5 0 0" solref="TIME 1"/></equality>
    </mujoco>"#;

    fn loops(time: &str) -> Option<Loops> {
        let model = Model::from_xml_str(&TIED.replace("TIME", time)).expect("a model");
        Loops::of(&model).expect("loops")
    }

    #[test]
    fn states_obey_what_constraints_ask_of_position_and_velocity() {
        let mut loops = loops("0.01").expect("a quick constraint");
        let off = State {
            qpos: vec![0.3, 0.2, -0.4],
            qvel: vec![1.0, 1.0, 0.7],
        };
        let on = loops.close(&off).expect("closed");
        let (a, b) = (on.qpos[0], on.qpos[1]);
        assert!((b - (0.1 - 2.0 * a + 0.5 * a * a)).abs() < 1e-9, "{on:?}");
        let slope = -2.0 + a;
        assert!((on.qvel[1] - slope * on.qvel[0]).abs() < 1e-9, "{on:?}");
        // what no constraint holds stays
        assert_eq!((on.qpos[2], on.qvel[2]), (-0.4, 0.7));
        let again = loops.close(&on).expect("closed");
        assert!((again.qpos[0] - a).abs() < 1e-12);
        // two free directions, each of position and of velocity, along the constraint
        let all = loops.directions(&[on]).expect("directions");
        assert_eq!(all[0].shape(), (6, 4));
        for k in 0..2 {
            let (position, velocity) = (all[0].column(k), all[0].column(k + 2));
            assert!((position[1] - slope * position[0]).abs() < 1e-9);
            assert!((velocity[4] - slope * velocity[3]).abs() < 1e-9);
        }
    }

    #[test]
    fn a_slow_constraint_is_a_spring_and_leaves_states_free() {
        assert!(loops("0.1").is_none());
    }
}
