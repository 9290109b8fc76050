//! Physics that the engine does not have, at the places of a step where it has to act.
//!
//! ```text
//! step:     positions, velocities ─ sense ─ command ─ actuation ─ force ─ accelerations, contacts ─ settle ─ integration
//! inverse:  positions, velocities ─ sense ─ command ─ actuation ─ force ─ contacts, qfrc_inverse ─ settle
//! ```
//!
//! An [`Extension`] belongs to a [`Model`] and is shared like it. What it has to remember from step to step is a row of
//! numbers in each [`Data`], the memory, which is saved and restored with the state. Forces enter `qfrc_passive`, so that
//! `qfrc_inverse` contains them as the engine's own passive forces; the level of a joint's dry friction is changed in
//! its constraint row, where the solver treats it implicitly. With no extension nothing here runs.
//!
//! The step is cut where the engine's own `mj_step1` and `mj_step2` meet, so Runge-Kutta integration is refused.

use super::arrays::view_mut;
use super::{Data, Integrator, Model, MujocoError, Result, ffi};
use std::sync::Arc;

/// Stage of the engine after which a sensor is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// depends on positions
    Position,
    /// and on velocities
    Velocity,
    /// and on accelerations and forces
    Acceleration,
}

/// What an extension adds in one evaluation. All zero on entry.
#[derive(Debug, Default)]
pub struct Forces {
    /// (nv) generalised force, in the unit of each degree of freedom
    pub passive: Vec<f64>,
    /// (nv) change of the dry friction of joints whose `frictionloss` is above 0
    pub friction: Vec<f64>,
    /// (nbody × 3) torque on bodies in the world's frame, N m
    pub torque: Vec<f64>,
}

/// Where a motor is in its play, as quick readings of its encoder show it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Swing {
    /// rad or m from the middle between the ends; none where what is quick was taken from the motion
    pub offset: Option<f64>,
    /// rad or m from end to end
    pub range: f64,
}

/// Physics beyond the engine's. `memory` is what it remembered at the beginning of the step, `next` what it will at its
/// end, a copy of `memory` on entry. All zero memory means that nothing has happened yet.
pub trait Extension: std::fmt::Debug + Send + Sync {
    /// Numbers of memory for a model.
    fn memory_len(&self, model: &Model) -> usize;

    /// Turns the commands in `ctrl` (nu) into the controls that actuators get. Positions and velocities are evaluated.
    fn command(&self, data: &Data, memory: &[f64], ctrl: &mut [f64], next: &mut [f64]);

    /// Whether a command of this actuator is changed on its way.
    fn changes_command(&self, _actuator: usize) -> bool {
        false
    }

    /// Adds forces. `actuator_force` and `qfrc_actuator` are those of this step.
    fn force(&self, data: &Data, memory: &[f64], forces: &mut Forces, next: &mut [f64]);

    /// Looks at contact forces, which are known only now; positions may have moved on.
    fn settle(&self, data: &Data, next: &mut [f64]);

    /// Turns what sensors of a stage would read into what they do read (nsensordata).
    fn sense(&self, data: &Data, memory: &[f64], stage: Stage, sensordata: &mut [f64]);

    /// Remembers what encoders show at the positions and velocities in `data`.
    fn record(&self, data: &Data, memory: &[f64], next: &mut [f64]);

    /// Position and velocity of a hinge or slide that its encoder shows as `reading`, delays apart.
    fn decode(&self, data: &Data, memory: &[f64], joint: usize, reading: [f64; 2]) -> [f64; 2];

    /// Position and velocity of a hinge or slide as its encoder shows them.
    fn encoder(&self, data: &Data, memory: &[f64], joint: usize) -> [f64; 2];

    /// Seconds by which encoders show older positions and velocities than those in the simulation, if they ever do.
    fn encoder_delay_s(&self, _model: &Model) -> Option<f64> {
        None
    }

    /// Whether springs or play between motors and joints are loaded by what went before, see [`Extension::load`].
    fn is_loaded(&self) -> bool {
        false
    }

    /// Loads springs and play between motors and joints as they are where motors accelerate by `acceleration` of each
    /// hinge or slide. A second call, `since_s` after the first, leaves them half way between both, moving from one to
    /// the other.
    fn load(
        &self,
        _data: &Data,
        _memory: &[f64],
        _acceleration: &dyn Fn(usize) -> f64,
        _since_s: Option<f64>,
        _next: &mut [f64],
    ) {
    }

    /// Whether the motor of a hinge or slide is put where its readings show it, see [`Data::show`].
    fn follows(&self, _joint: usize) -> bool {
        false
    }

    /// Whether trees that nothing of the engine ties together, contacts included, feel nothing of each other by it either.
    fn is_local(&self) -> bool {
        false
    }
}

/// An extension at work in one simulation.
#[derive(Debug)]
pub(super) struct Extended {
    extension: Arc<dyn Extension>,
    memory: Vec<f64>,
    next: Vec<f64>,
    kept: Vec<f64>,        // room for another `next`
    commands: Vec<f64>,    // (nu) as given by the caller, while ctrl holds what actuators get
    effective: Vec<f64>,   // (nu)
    own_passive: Vec<f64>, // (nv) the engine's
    own_xfrc: Vec<f64>,    // (nbody × 6) the caller's
    forces: Forces,
    readings: Vec<f64>, // (nsensordata)
}

/// Which way dynamics are computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Direction {
    Forward,
    Inverse,
}

impl Extended {
    pub(super) fn of(model: &Model) -> Option<Box<Self>> {
        let extension = Arc::clone(model.extension()?);
        let memory = vec![0.0; extension.memory_len(model)];
        Some(Box::new(Self {
            extension,
            next: memory.clone(),
            kept: memory.clone(),
            memory,
            commands: vec![0.0; model.nu()],
            effective: vec![0.0; model.nu()],
            own_passive: vec![0.0; model.nv()],
            own_xfrc: vec![0.0; 6 * model.nbody()],
            forces: Forces {
                passive: vec![0.0; model.nv()],
                friction: vec![0.0; model.nv()],
                torque: vec![0.0; 3 * model.nbody()],
            },
            readings: vec![0.0; model.nsensordata()],
        }))
    }

    fn clear(&mut self) {
        self.memory.fill(0.0);
        self.next.fill(0.0);
    }
}

impl Data {
    /// What the model's extension remembers; empty without one.
    pub fn memory(&self) -> &[f64] {
        self.extended.as_ref().map_or(&[], |x| &x.memory)
    }

    /// Puts back what the extension remembered.
    ///
    /// # Errors
    /// [`MujocoError::Length`].
    pub fn set_memory(&mut self, memory: &[f64]) -> Result<()> {
        let (expected, got) = (self.memory().len(), memory.len());
        if expected != got {
            return Err(MujocoError::Length {
                name: "memory",
                expected,
                got,
            });
        }
        if let Some(x) = &mut self.extended {
            x.memory.copy_from_slice(memory);
            x.next.copy_from_slice(memory);
        }
        Ok(())
    }

    /// Lets the extension remember the last evaluation ([`Data::forward`], [`Data::inverse`], …) as the step that ends
    /// now. Steps do so by themselves.
    pub fn advance_memory(&mut self) {
        if let Some(x) = &mut self.extended {
            let Extended { memory, next, .. } = x.as_mut();
            memory.copy_from_slice(next);
        }
    }

    /// Lets the extension take ctrl, qpos and qvel for those of a step that ended before: what was commanded, and what
    /// encoders showed, with no force having acted.
    ///
    /// # Errors
    /// None today.
    pub fn advance_past(&mut self) -> Result<()> {
        self.with_extension(|data, x| {
            x.next.copy_from_slice(&x.memory);
            x.effective.copy_from_slice(data.ctrl());
            (x.extension).command(data, &x.memory, &mut x.effective, &mut x.next);
            (x.extension).record(data, &x.memory, &mut x.next);
            x.memory.copy_from_slice(&x.next);
            Ok(())
        })
    }

    /// Loads the extension's springs and play, see [`Extension::load`], under the torques of ctrl.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub fn load_memory(
        &mut self,
        acceleration: &dyn Fn(usize) -> f64,
        since_s: Option<f64>,
    ) -> Result<()> {
        self.forward()?;
        self.with_extension(|data, x| {
            x.next.copy_from_slice(&x.memory);
            (x.extension).load(data, &x.memory, acceleration, since_s, &mut x.next);
            x.memory.copy_from_slice(&x.next);
            Ok(())
        })
    }

    /// Tells extensions the commands (nu) that hold in the step to come, where ctrl has those of a time that suits the engine;
    /// none: those of ctrl. What moves by itself within a step follows them.
    pub fn hold(&mut self, commands: Option<&[f64]>) {
        let mut late = std::mem::take(&mut self.late);
        late.clear();
        let each = commands.unwrap_or_default().iter().zip(self.ctrl());
        late.extend(each.map(|(held, own)| held - own));
        self.late = late;
    }

    /// What the command of an actuator that holds in the step to come is more than its ctrl.
    pub fn late(&self, actuator: usize) -> f64 {
        self.late.get(actuator).copied().unwrap_or(0.0)
    }

    /// Tells extensions where recorded readings show motors (joint, swing) at the beginning of the step to come; of others
    /// nothing is known but what went before.
    pub fn show(&mut self, swings: impl IntoIterator<Item = (usize, Swing)>) {
        self.shown.clear();
        self.shown.extend(swings);
    }

    /// Where readings show the motor of a joint.
    pub fn shown(&self, joint: usize) -> Option<Swing> {
        let own = self.shown.iter().find(|(j, _)| *j == joint);
        own.map(|(_, swing)| *swing)
    }

    /// Position and velocity of a hinge or slide as its encoder shows them; without an extension the true ones.
    ///
    /// # Panics
    /// If there is no such joint.
    pub fn encoder(&self, joint: usize) -> [f64; 2] {
        match &self.extended {
            Some(x) => x.extension.encoder(self, &x.memory, joint),
            None => self.joint_state(joint),
        }
    }

    /// Position and velocity of a hinge or slide whose encoder shows `reading`: the inverse of [`Data::encoder`], delays
    /// apart.
    pub fn decode(&self, joint: usize, reading: [f64; 2]) -> [f64; 2] {
        match &self.extended {
            Some(x) => x.extension.decode(self, &x.memory, joint, reading),
            None => reading,
        }
    }

    /// The first position and velocity of a joint.
    ///
    /// # Panics
    /// If there is no such joint.
    pub fn joint_state(&self, joint: usize) -> [f64; 2] {
        let model = self.model();
        let (q, v) = (model.jnt_qposadr()[joint], model.jnt_dofadr()[joint]);
        [self.qpos()[q as usize], self.qvel()[v as usize]]
    }

    /// Whether a step has to be cut.
    pub(super) fn is_extended(&self) -> bool {
        self.extended.is_some()
    }

    /// Refuses what cannot be cut.
    pub(super) fn check_integrator(&self) -> Result<()> {
        match self.model().option().integrator {
            Integrator::Rk4 => Err(MujocoError::RungeKutta),
            _ => Ok(()),
        }
    }

    /// Forgets everything, and follows a change of the model.
    pub(super) fn fit_extension(&mut self) {
        let model = self.model();
        let fits = match (&self.extended, model.extension()) {
            (None, None) => true,
            (Some(x), Some(now)) => {
                Arc::ptr_eq(&x.extension, now) && x.memory.len() == now.memory_len(model)
            }
            _ => false,
        };
        if !fits {
            self.extended = Extended::of(model);
        }
    }

    pub(super) fn forget(&mut self) {
        self.late.clear();
        self.shown.clear();
        if let Some(x) = &mut self.extended {
            x.clear();
        }
    }

    fn with_extension(
        &mut self,
        f: impl FnOnce(&mut Self, &mut Extended) -> Result<()>,
    ) -> Result<()> {
        let Some(mut x) = self.extended.take() else {
            return Ok(());
        };
        let result = f(self, &mut x);
        self.extended = Some(x);
        result
    }

    /// Runs a call in which the engine may reset a state that broke down; then nothing is remembered either.
    pub(super) fn call_that_resets(
        &mut self,
        f: impl FnOnce(*const ffi::mjModel, *mut ffi::mjData),
    ) -> Result<()> {
        if self.extended.is_none() {
            return self.call(f);
        }
        let before = self.warnings();
        self.call(f)?;
        if self.warnings().diverged() && self.warnings() != before {
            self.forget();
        }
        Ok(())
    }

    /// After the velocity stage: keeps the engine's own passive forces, to which those of the extension are added.
    pub(super) fn keep_passive(&mut self) -> Result<()> {
        self.with_extension(|data, x| {
            x.own_passive.copy_from_slice(data.qfrc_passive());
            Ok(())
        })
    }

    /// Turns the readings of a stage, of which nothing was turned yet.
    pub(super) fn sense(&mut self, stage: Stage) -> Result<()> {
        self.with_extension(|data, x| {
            x.readings.copy_from_slice(data.sensordata());
            (x.extension).sense(data, &x.memory, stage, &mut x.readings);
            let (ptr, len) = (data.raw().sensordata, x.readings.len());
            // SAFETY: nsensordata numbers; `&mut self` is exclusive.
            let sensordata = unsafe { view_mut(ptr, len) };
            sensordata.copy_from_slice(&x.readings);
            Ok(())
        })
    }

    /// Forces of the actuators from the controls they get, not from the commands in ctrl.
    pub(super) fn extended_actuation(&mut self) -> Result<()> {
        self.with_extension(|data, x| {
            // what the last evaluation would remember stays
            std::mem::swap(&mut x.next, &mut x.kept);
            let result = x.actuate(data);
            std::mem::swap(&mut x.next, &mut x.kept);
            data.ctrl_mut().copy_from_slice(&x.commands);
            result
        })
    }

    /// Before accelerations or `qfrc_inverse`: puts the extension's forces where the engine will look. Ends with
    /// [`Self::conclude`].
    pub(super) fn prepare(&mut self, direction: Direction) -> Result<()> {
        self.with_extension(|data, x| {
            x.actuate(data)?;
            let forces = &mut x.forces;
            forces.passive.fill(0.0);
            forces.friction.fill(0.0);
            forces.torque.fill(0.0);
            (x.extension).force(data, &x.memory, forces, &mut x.next);
            data.add_torques(x, direction)?;
            data.write_passive(&x.own_passive, &x.forces.passive);
            data.write_friction(&x.forces.friction);
            Ok(())
        })
    }

    /// After the engine has used what [`Self::prepare`] wrote: gives the caller's inputs back, looks at the contacts,
    /// and reads the sensors of the last stage if they were computed.
    pub(super) fn conclude(&mut self, sensors: bool) -> Result<()> {
        self.with_extension(|data, x| {
            data.ctrl_mut().copy_from_slice(&x.commands);
            data.xfrc_applied_mut().copy_from_slice(&x.own_xfrc);
            (x.extension).settle(data, &mut x.next);
            Ok(())
        })?;
        if sensors {
            self.sense(Stage::Acceleration)?;
        }
        Ok(())
    }

    /// Torques on bodies: an input of the forward direction; inversely they are part of what is known, and the engine
    /// takes the input for the sensors alone.
    fn add_torques(&mut self, x: &mut Extended, direction: Direction) -> Result<()> {
        x.own_xfrc.copy_from_slice(self.xfrc_applied());
        for body in 0..self.model().nbody() {
            let torque: [f64; 3] = std::array::from_fn(|i| x.forces.torque[3 * body + i]);
            if torque == [0.0; 3] {
                continue;
            }
            for (i, t) in torque.iter().enumerate() {
                self.xfrc_applied_mut()[6 * body + 3 + i] += t;
            }
            if direction == Direction::Inverse {
                let (none, passive) = ([0.0; 3], x.forces.passive.as_mut_ptr());
                let (none, torque) = (none.as_ptr(), torque.as_ptr());
                let body = body as i32;
                // SAFETY: body in range, three numbers each, and nv in the target; none of them is the engine's.
                self.call(|m, d| unsafe {
                    ffi::mj_applyFT(m, d, none, torque, none, body, passive);
                })?;
            }
        }
        Ok(())
    }

    fn write_passive(&mut self, own: &[f64], added: &[f64]) {
        let (ptr, len) = (self.raw().qfrc_passive, own.len());
        // SAFETY: nv numbers; `&mut self` is exclusive.
        let passive = unsafe { view_mut(ptr, len) };
        for ((p, own), added) in passive.iter_mut().zip(own).zip(added) {
            // not +0, which would turn -0
            *p = if *added == 0.0 { *own } else { own + added };
        }
    }

    /// The levels of dry friction: those of the model, changed.
    fn write_friction(&mut self, change: &[f64]) {
        const FRICTION_OF_DOF: i32 = ffi::mjtConstraint_::mjCNSTR_FRICTION_DOF as i32;
        let first = self.raw().ne.max(0) as usize;
        for row in first..first + self.raw().nf.max(0) as usize {
            if self.efc_type()[row] != FRICTION_OF_DOF {
                continue;
            }
            let dof = self.efc_id()[row] as usize;
            let level = (self.model().dof_frictionloss()[dof] + change[dof]).max(0.0);
            let (ptr, len) = (self.raw().efc_frictionloss, self.model().njmax());
            // SAFETY: njmax numbers; `&mut self` is exclusive.
            let levels = unsafe { view_mut(ptr, len) };
            levels[row] = level;
        }
    }
}

impl Extended {
    /// Commands into ctrl as actuators get them, and their forces.
    fn actuate(&mut self, data: &mut Data) -> Result<()> {
        self.next.copy_from_slice(&self.memory);
        self.commands.copy_from_slice(data.ctrl());
        self.effective.copy_from_slice(data.ctrl());
        (self.extension).command(data, &self.memory, &mut self.effective, &mut self.next);
        data.ctrl_mut().copy_from_slice(&self.effective);
        // SAFETY: invariant 2.
        data.call(|m, d| unsafe { ffi::mj_fwdActuation(m, d) })
    }
}
