//! A position fitted to what sensors show and equality constraints ask.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::SysidError;
use super::problem::Problem;
use crate::mujoco::Data;

/// Weight of staying at the knot before, relative to the finest measurement's.
const STAY: f64 = 1e-4;
/// How exactly equality constraints hold, m or rad.
const EQUALITY_SIGMA: f64 = 1e-5;
const STEP: f64 = 1e-6;
/// How far a position may be from the model's own where nothing measures it, m or rad.
pub(super) const UNKNOWN_SIGMA: f64 = 1e-2;

/// A position being fitted to sensor values.
pub(super) struct Pose<'a> {
    problem: &'a Problem,
    pub data: Data,
}

impl<'a> Pose<'a> {
    pub(super) fn new(problem: &'a Problem, x: &[f64]) -> Result<Self, SysidError> {
        let mut data = Data::new(Arc::clone(&problem.model))?;
        problem.parameters.apply(&problem.model, x, &mut data)?;
        data.reset();
        Ok(Self { problem, data })
    }

    /// Whitened residuals of goals and equality constraints.
    fn residual(&mut self, goals: &[(usize, f64)]) -> Result<Vec<f64>, SysidError> {
        self.data.position_stage()?;
        self.data.position_sensors()?;
        let model = self.data.model();
        let n_sensordata = model.nsensordata();
        let mut out: Vec<f64> = (goals.iter())
            .map(|&(c, goal)| {
                let channel = &self.problem.channels[c];
                let i = channel.source;
                let value = if i < n_sensordata {
                    self.data.sensordata()[i]
                } else {
                    self.data.qpos()[i - n_sensordata]
                };
                (value - goal) / channel.sigma
            })
            .collect();
        let open = self.data.equality_rows().into_iter();
        out.extend(open.map(|row| self.data.efc_pos()[row] / EQUALITY_SIGMA));
        Ok(out)
    }

    /// Derivatives of residuals that are `base` here.
    fn jacobian(
        &mut self,
        base: &[f64],
        goals: &[(usize, f64)],
    ) -> Result<DMatrix<f64>, SysidError> {
        let nv = self.data.model().nv();
        let qpos = self.data.qpos().to_vec();
        let mut jacobian = DMatrix::zeros(base.len(), nv);
        let mut tangent = vec![0.0; nv];
        for j in 0..nv {
            tangent[j] = STEP;
            let mut moved = qpos.clone();
            self.data.model().integrate_pos(&mut moved, &tangent, 1.0)?;
            tangent[j] = 0.0;
            self.data.qpos_mut().copy_from_slice(&moved);
            for (i, (m, b)) in self.residual(goals)?.iter().zip(base).enumerate() {
                jacobian[(i, j)] = (m - b) / STEP;
            }
        }
        self.data.qpos_mut().copy_from_slice(&qpos);
        Ok(jacobian)
    }

    /// Covariance (nv × nv) of a position about `qpos` at which `channels` are measured once.
    pub(super) fn covariance(
        &mut self,
        qpos: &[f64],
        channels: &[usize],
    ) -> Result<DMatrix<f64>, SysidError> {
        let jacobian = self.derivatives(qpos, channels)?;
        let nv = jacobian.ncols();
        let information =
            jacobian.transpose() * jacobian + DMatrix::identity(nv, nv) * UNKNOWN_SIGMA.powi(-2);
        let unknown = || DMatrix::identity(nv, nv) * UNKNOWN_SIGMA.powi(2);
        Ok(information.cholesky().map_or_else(unknown, |c| c.inverse()))
    }

    /// Whitened derivatives (channels × nv) of `channels` at `qpos`.
    pub(super) fn sensitivity(
        &mut self,
        qpos: &[f64],
        channels: &[usize],
    ) -> Result<DMatrix<f64>, SysidError> {
        let all = self.derivatives(qpos, channels)?;
        Ok(all.rows(0, channels.len()).into_owned())
    }

    /// Whitened derivatives of `channels`, then of equality constraints, at `qpos`.
    pub(super) fn derivatives(
        &mut self,
        qpos: &[f64],
        channels: &[usize],
    ) -> Result<DMatrix<f64>, SysidError> {
        self.data.qpos_mut().copy_from_slice(qpos);
        let goals: Vec<(usize, f64)> = channels.iter().map(|&c| (c, 0.0)).collect();
        let base = self.residual(&goals)?;
        self.jacobian(&base, &goals)
    }

    /// Moves the position to where sensors have the values `goals`.
    pub(super) fn fit(
        &mut self,
        goals: &[(usize, f64)],
        n_iterations: usize,
    ) -> Result<(), SysidError> {
        let nv = self.data.model().nv();
        let finest = goals
            .iter()
            .map(|&(c, _)| self.problem.channels[c].sigma)
            .fold(1.0, f64::min);
        let stay = STAY / finest;
        for _ in 0..n_iterations {
            let base = self.residual(goals)?;
            let qpos = self.data.qpos().to_vec();
            let mut jacobian = self
                .jacobian(&base, goals)?
                .insert_rows(base.len(), nv, 0.0);
            for j in 0..nv {
                jacobian[(base.len() + j, j)] = stay;
            }
            let mut right = DVector::zeros(base.len() + nv);
            for (r, b) in right.iter_mut().zip(&base) {
                *r = -b;
            }
            let step = jacobian
                .svd(true, true)
                .solve(&right, 1e-12)
                .unwrap_or_else(|_| DVector::zeros(nv));
            // a wrong turn of a far start must not leave the neighbourhood in which it is linear
            let length = step.amax();
            let factor = if length > 0.5 { 0.5 / length } else { 1.0 };
            let mut moved = qpos;
            let step: Vec<f64> = step.iter().map(|s| s * factor).collect();
            self.data.model().integrate_pos(&mut moved, &step, 1.0)?;
            self.data.qpos_mut().copy_from_slice(&moved);
            if length < 1e-9 {
                break;
            }
        }
        Ok(())
    }
}
