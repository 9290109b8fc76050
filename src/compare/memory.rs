//! Recordings of machines whose model has a [`crate::supplement`]: what the model remembers at each sample, and where
//! joints are whose encoders show something else.

use std::sync::Arc;

use super::CompareError;
use crate::mujoco::{Data, Model, MujocoError};

/// Follows the samples of a recording; does nothing for a model without supplement.
#[derive(Debug)]
pub(super) struct Memory {
    data: Data,
    active: bool,
    /// s by which encoders are late
    pub(super) delay_s: f64,
}

/// Sets the controls of a time.
type Controls<'a> = &'a dyn Fn(f64, &mut [f64]);

impl Memory {
    pub(super) fn new(model: &Model) -> Result<Self, CompareError> {
        let extension = model.extension();
        Ok(Self {
            data: Data::new(Arc::new(model.try_clone()?))?,
            active: extension.is_some(),
            delay_s: extension
                .and_then(|e| e.encoder_delay_s(model))
                .unwrap_or(0.0),
        })
    }

    /// What is remembered at each sample (n × memory), of states `qpos` (n × nq) and `qvel` (n × nv). Between samples
    /// states stay as they are.
    pub(super) fn follow(
        &mut self,
        time_s: &[f64],
        qpos: &[f64],
        qvel: &[f64],
        controls: Controls<'_>,
    ) -> Result<Vec<f64>, MujocoError> {
        let mut rows = Vec::new();
        if !self.active {
            return Ok(rows);
        }
        let data = &mut self.data;
        let (nq, nv, h) = (
            data.model().nq(),
            data.model().nv(),
            data.model().timestep(),
        );
        data.reset();
        let mut steps = 0_usize;
        for (k, time) in time_s.iter().enumerate() {
            data.qpos_mut().copy_from_slice(&qpos[k * nq..(k + 1) * nq]);
            data.qvel_mut().copy_from_slice(&qvel[k * nv..(k + 1) * nv]);
            rows.extend_from_slice(data.memory());
            let next = time_s.get(k + 1).unwrap_or(time) - time_s[0];
            while (steps as f64 + 0.5) * h <= next {
                controls(time_s[0] + steps as f64 * h, data.ctrl_mut());
                data.forward()?;
                data.advance_memory();
                steps += 1;
            }
        }
        Ok(rows)
    }

    /// Positions of hinges and slides in place of what their encoders show, for the joints in `measured` (addresses in
    /// `qpos`); `rows` by [`Self::follow`].
    pub(super) fn decode(
        &mut self,
        rows: &[f64],
        qpos: &mut [f64],
        measured: &[usize],
    ) -> Result<(), MujocoError> {
        if !self.active {
            return Ok(());
        }
        let model = Arc::clone(self.data.model_arc());
        for (k, row) in qpos.chunks_exact_mut(model.nq()).enumerate() {
            self.at(rows, k)?;
            for joint in 0..model.njnt() {
                let address = model.jnt_qposadr()[joint] as usize;
                if model.is_slide(joint).is_some() && measured.contains(&address) {
                    row[address] = self.data.decode(joint, [row[address], 0.0])[0];
                }
            }
        }
        Ok(())
    }

    /// The velocity of degree of freedom `dof` at sample `k`, of which the encoder shows `velocity`.
    pub(super) fn velocity(
        &mut self,
        rows: &[f64],
        k: usize,
        dof: usize,
        velocity: f64,
    ) -> Result<f64, MujocoError> {
        let joint = self.data.model().dof_jntid()[dof] as usize;
        if !self.active || self.data.model().is_slide(joint).is_none() {
            return Ok(velocity);
        }
        self.at(rows, k)?;
        Ok(self.data.decode(joint, [0.0, velocity])[1])
    }

    fn at(&mut self, rows: &[f64], k: usize) -> Result<(), MujocoError> {
        let n = self.data.memory().len();
        self.data.set_memory(&rows[k * n..(k + 1) * n])
    }
}
