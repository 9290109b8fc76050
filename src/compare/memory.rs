//! Recordings of machines whose model has a [`crate::supplement`]: what the model remembers at each sample, and where
//! joints are whose encoders show something else.
//!
//! Springs and play between motors and joints are followed by their own law, under the commands, where motion is as recorded.
//! Where it is filtered the law would swing to commands that the motion has nothing of any more; there the encoders, which
//! sit on the motors, say how they are loaded, t = τ − J θ'', with commands filtered as the motion is.

use std::sync::Arc;

use super::CompareError;
use super::butterworth::{Beyond, low_pass};
use super::differences::accelerations;
use super::swings::Swings;
use crate::mujoco::{Data, Model, MujocoError};

/// What loads springs and play between motors and joints, at each sample.
pub(super) struct Drives {
    /// (n × nv) of what encoders show
    pub qacc: Vec<f64>,
    /// (n × nu) means around each sample
    ctrl: Vec<f64>,
}

impl Drives {
    /// Loads those of `data` as at sample `k`, from the samples before and after.
    fn load(&self, data: &mut Data, time_s: &[f64], k: usize) -> Result<(), MujocoError> {
        let model = Arc::clone(data.model_arc());
        let (nu, nv) = (model.nu(), model.nv());
        let (before, after) = (k.saturating_sub(1), (k + 1).min(time_s.len() - 1));
        let since_s = time_s[after] - time_s[before];
        for (i, since_s) in [(before, None), (after, Some(since_s))] {
            data.ctrl_mut()
                .copy_from_slice(&self.ctrl[i * nu..(i + 1) * nu]);
            let qacc = &self.qacc[i * nv..(i + 1) * nv];
            data.load_memory(&|joint| qacc[model.jnt_dofadr()[joint] as usize], since_s)?;
        }
        Ok(())
    }
}

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

    /// What loads drives while encoders move by `shown` (n × nv), of which what is faster than `cutoff` (times the interval
    /// between samples) was taken; none without drives that are loaded.
    pub(super) fn drives(
        &self,
        (time_s, interval): (&[f64], f64),
        shown: &[f64],
        cutoff: f64,
        controls: Controls<'_>,
    ) -> Option<Drives> {
        let model = self.data.model();
        if !model.has_loaded_drives() {
            return None;
        }
        // an even number: none falls on a sample, where commands change
        let parts = 2 * (interval / model.timestep()).round().max(1.0) as usize;
        let mut ctrl = Vec::with_capacity(time_s.len() * model.nu());
        let mut now = vec![0.0; model.nu()];
        for time in time_s {
            let mut mean = vec![0.0; model.nu()];
            for part in 0..parts {
                let off = (part as f64 + 0.5) / parts as f64 - 0.5;
                controls(time + off * interval, &mut now);
                for (mean, now) in mean.iter_mut().zip(&now) {
                    *mean += now / parts as f64;
                }
            }
            ctrl.extend(mean);
        }
        low_pass(&mut ctrl, model.nu(), cutoff, Beyond::Reflected);
        Some(Drives {
            qacc: accelerations(model.nv(), time_s, shown, false),
            ctrl,
        })
    }

    /// What is remembered at each sample (n × memory), of states `qpos` (n × nq) and `qvel` (n × nv). Between samples
    /// states stay as they are. Drives are loaded by those of `loaded`, beside which are accelerations (n × nv) of the states;
    /// motors are where `swings` show them.
    pub(super) fn follow(
        &mut self,
        time_s: &[f64],
        (qpos, qvel): (&[f64], &[f64]),
        controls: Controls<'_>,
        loaded: Option<(&Drives, &[f64])>,
        swings: &Swings,
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
            let dofs = k * nv..(k + 1) * nv;
            data.qpos_mut().copy_from_slice(&qpos[k * nq..(k + 1) * nq]);
            data.show(swings.at(k));
            if let Some((drives, qacc)) = loaded {
                // a law of drives remembers how fast the joint was one step ago
                let now = qvel[dofs.clone()].iter().zip(&qacc[dofs.clone()]);
                for (own, (v, a)) in data.qvel_mut().iter_mut().zip(now) {
                    *own = v - h * a;
                }
                drives.load(data, time_s, k)?;
            }
            data.qvel_mut().copy_from_slice(&qvel[dofs]);
            rows.extend_from_slice(data.memory());
            let next = time_s.get(k + 1).unwrap_or(time) - time_s[0];
            while (steps as f64 + 0.5) * h <= next {
                controls(time_s[0] + steps as f64 * h, data.ctrl_mut());
                data.forward()?;
                data.advance_memory();
                data.show([]);
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
