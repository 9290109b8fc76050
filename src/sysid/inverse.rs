//! The exact inverse of one step of `mj_step`: three consecutive positions in, the missing generalised force out.
//!
//! The semi-implicit Euler step of the engine, with D the joint damping, which it integrates implicitly, is
//!
//! ```text
//! (M + h D) a = M qacc          v' = v + h a          q' = q ⊕ h v'
//! ```
//!
//! so three positions determine what the engine had at the middle one, quaternions on their manifold:
//!
//! ```text
//! v = (q ⊖ q₋) / h      a = ((q₊ ⊖ q)/h − v) / h      qacc = a + M⁻¹ h D a
//! r = mj_inverse(q, v, qacc) − qfrc_actuator(q, v, ctrl)
//! ```
//!
//! r (nv) is zero where the model explains the motion. `mj_inverse` of `MuJoCo` 2.2.2 takes the continuous
//! acceleration, so without the third formula damping would show as an armature of h D that is not there.
//!
//! [`Inverse::evaluate`] computes r and the sensors of one knot; after a change of the acceleration or velocity alone
//! only the later stages run, which is what makes finite differences cheap.

use std::sync::Arc;

use super::SysidError;
use super::parameter::Parameters;
use crate::mujoco::{Data, Integrator, Model, Result};

/// What changed since the last evaluation at the same knot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Changed {
    /// acceleration only
    Acceleration,
    /// velocity, and what depends on it
    Velocity,
    /// everything, or a parameter of the model
    Position,
}

/// Why inverse dynamics cannot be used with a model.
pub(crate) fn unsupported(model: &Model) -> Option<String> {
    let option = model.option();
    if option.integrator != Integrator::Euler {
        return Some("its integrator is not Euler, whose step is the one that is inverted".into());
    }
    if model.na() > 0 {
        return Some(
            "it has actuators with an internal state (activation), which positions do not determine".into(),
        );
    }
    None
}

/// A workspace that inverts the steps of one model.
#[derive(Debug)]
pub struct Inverse {
    data: Data,
    damped: bool,
    sensors: bool,
    contacts: bool,
    scaled: Vec<f64>,   // h D a (nv)
    solved: Vec<f64>,   // M⁻¹ h D a (nv)
    residual: Vec<f64>, // r (nv)
}

impl Inverse {
    /// A workspace for `model`; `sensors`: whether sensor values are wanted.
    ///
    /// # Errors
    /// When out of memory.
    pub fn new(model: Arc<Model>, sensors: bool) -> Result<Self> {
        Ok(Self::with(Data::new(model)?, sensors))
    }

    /// A workspace made of a simulation that is at hand.
    pub(super) fn with(data: Data, sensors: bool) -> Self {
        let nv = data.model().nv();
        Self {
            damped: data.model().dof_damping().iter().any(|&d| d > 0.0),
            data,
            sensors,
            contacts: true,
            scaled: vec![0.0; nv],
            solved: vec![0.0; nv],
            residual: vec![0.0; nv],
        }
    }

    /// The simulation behind it, for another use.
    pub(super) fn into_data(self) -> Data {
        self.data
    }

    /// The model in use.
    pub fn model(&self) -> &Model {
        self.data.model()
    }

    /// The simulation behind it: contacts, kinematics and constraint forces of the last evaluation.
    pub fn data(&self) -> &Data {
        &self.data
    }

    /// From now on computes as if nothing touched.
    ///
    /// # Errors
    /// As [`Data::edit_model`].
    pub(super) fn leave_out_contacts(&mut self) -> Result<()> {
        self.contacts = false;
        self.data.edit_model(|edit| edit.set_contacts(false))
    }

    /// Gives the model the numbers of `nominal` changed by parameters `x` (free).
    ///
    /// # Errors
    /// A number that is not finite.
    pub(super) fn set_parameters(
        &mut self,
        parameters: &Parameters,
        nominal: &Model,
        x: &[f64],
    ) -> std::result::Result<(), SysidError> {
        parameters.apply(nominal, x, &mut self.data)?;
        if !self.contacts {
            self.leave_out_contacts()?;
        }
        self.damped = self.data.model().dof_damping().iter().any(|&d| d > 0.0);
        Ok(())
    }

    /// Controls for the next evaluation (nu).
    pub fn set_ctrl(&mut self, ctrl: &[f64]) {
        self.data.ctrl_mut().copy_from_slice(ctrl);
    }

    /// Residual force and sensors where position, velocity and finite-difference acceleration are given.
    ///
    /// # Errors
    /// Numbers that are not finite.
    pub fn evaluate(
        &mut self,
        qpos: &[f64],
        qvel: &[f64],
        acceleration: &[f64],
        changed: Changed,
    ) -> Result<()> {
        let data = &mut self.data;
        if changed >= Changed::Position {
            data.qpos_mut().copy_from_slice(qpos);
            data.position_stage()?;
            if self.sensors {
                data.position_sensors()?;
            }
        }
        if changed >= Changed::Velocity {
            data.qvel_mut().copy_from_slice(qvel);
            data.velocity_stage()?;
            if self.sensors {
                data.velocity_sensors()?;
            }
            data.actuation()?;
        }
        data.qacc_mut().copy_from_slice(acceleration);
        if self.damped {
            let h = data.model().timestep();
            for ((s, d), a) in (self.scaled.iter_mut())
                .zip(data.model().dof_damping())
                .zip(acceleration)
            {
                *s = h * d * a;
            }
            data.solve_mass_matrix(&mut self.solved, &self.scaled)?;
            for (qacc, extra) in data.qacc_mut().iter_mut().zip(&self.solved) {
                *qacc += extra;
            }
        }
        data.inverse_of_acceleration(self.sensors)?;
        for ((r, inverse), actuator) in (self.residual.iter_mut())
            .zip(data.qfrc_inverse())
            .zip(data.qfrc_actuator())
        {
            *r = inverse - actuator;
        }
        Ok(())
    }

    /// The acceleration (finite-difference, nv) that the engine itself takes from a state under the controls set, and
    /// the sensors that go with it. `guess` is where its solver starts.
    ///
    /// `None` where it has none: numbers beyond its range.
    ///
    /// # Errors
    /// Numbers that are not finite.
    pub fn predict(
        &mut self,
        qpos: &[f64],
        qvel: &[f64],
        guess: &[f64],
        out: &mut [f64],
    ) -> Result<bool> {
        let data = &mut self.data;
        data.qpos_mut().copy_from_slice(qpos);
        data.qvel_mut().copy_from_slice(qvel);
        data.qacc_warmstart_mut().copy_from_slice(guess);
        data.step()?;
        if data.warnings().any() {
            data.clear_warnings();
            return Ok(false);
        }
        let h = data.model().timestep();
        for ((out, after), before) in out.iter_mut().zip(data.qvel()).zip(qvel) {
            *out = (after - before) / h;
        }
        data.qpos_mut().copy_from_slice(qpos);
        data.qvel_mut().copy_from_slice(qvel);
        data.set_time(0.0);
        Ok(true)
    }

    /// Residual force of the last evaluation (nv).
    pub fn residual(&self) -> &[f64] {
        &self.residual
    }

    /// Sensors of the last evaluation (nsensordata).
    pub fn sensordata(&self) -> &[f64] {
        self.data.sensordata()
    }
}
