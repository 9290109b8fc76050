//! The true machine: the engine at a finer step, with the effects it does not have.

use super::RigError;
use super::axes::Axis;
use super::effects::contact::Torsion;
use super::effects::drive::Drive;
use super::effects::joint::{Motion, Term, terms};
use super::effects::transmission::Transmission;
use super::effects::{Bound, Effect};
use crate::mujoco::{Data, Model, MujocoError};

/// Range of a control that nothing reaches.
const UNLIMITED: [f64; 2] = [-1e9, 1e9];

/// The simulated truth.
#[derive(Debug)]
pub(super) struct Plant {
    pub(super) data: Data,
    pub(super) transmissions: Vec<Transmission>,
    axes: Vec<Axis>,
    drives: Vec<Option<Drive>>, // one an actuator
    terms: Vec<Term>,
    torsions: Vec<Torsion>,
    step_s: f64,
    applied: Vec<f64>, // (nv)
    load: Vec<f64>,    // (nv) motor torque of the last step
    ctrl: Vec<f64>,    // (nu)
}

impl Plant {
    /// A plant at the state of `data`, whose model is the true one.
    ///
    /// # Errors
    /// [`RigError::Effect`] for an effect that does not fit its place; the engine refuses a number.
    pub(super) fn new(mut data: Data, axes: &[Axis], effects: &[Bound]) -> Result<Self, RigError> {
        let model = data.model_arc().clone();
        let step_s = model.timestep();
        let fail = |bound: &Bound, reason| RigError::Effect {
            name: bound.effect.entry().name,
            reason,
        };
        let mut drives: Vec<Option<Drive>> = vec![None; model.nu()];
        let mut all_terms = Vec::new();
        let mut torsions = Vec::new();
        for bound in effects {
            match bound.effect {
                Effect::ActuatorDelay
                | Effect::ActuatorLag
                | Effect::TorqueGain
                | Effect::TorqueRipple
                | Effect::TorqueSaturation => {
                    for axis in axes.iter().filter(|a| bound.elements.contains(&a.actuator)) {
                        drives[axis.actuator]
                            .get_or_insert_with(|| Drive::new(axis))
                            .add(bound, step_s);
                    }
                }
                Effect::TorsionalFriction => torsions.push(Torsion::new(&model, bound)),
                _ => all_terms.extend(terms(&model, bound).map_err(|r| fail(bound, r))?),
            }
        }
        for axis in sprung(axes, effects) {
            drives[axis.actuator].get_or_insert_with(|| Drive::new(axis)); // their torque passes the engine by
        }
        // what is edited is a copy: none for a machine without drives
        if drives.iter().any(Option::is_some) {
            data.edit_model(|edit| {
                let ranges = edit.actuator_ctrlrange().chunks_exact_mut(2);
                for (range, _) in ranges.zip(&drives).filter(|own| own.1.is_some()) {
                    range.copy_from_slice(&UNLIMITED); // drives limit commands, not what they make of them
                }
            })?;
        }
        let transmissions = transmissions(axes, effects, step_s)?;
        let mut plant = Self {
            transmissions,
            axes: axes.to_vec(),
            drives,
            terms: all_terms,
            torsions,
            step_s,
            applied: vec![0.0; model.nv()],
            load: vec![0.0; model.nv()],
            ctrl: vec![0.0; model.nu()],
            data,
        };
        for transmission in &mut plant.transmissions {
            transmission.reset(plant.data.qpos());
        }
        Ok(plant)
    }

    /// One inner step with the controls `command` (nu).
    ///
    /// # Errors
    /// When the engine refuses.
    pub(super) fn step(&mut self, command: &[f64]) -> Result<(), MujocoError> {
        self.applied.fill(0.0);
        self.load.copy_from_slice(self.data.qfrc_actuator());
        let (qpos, qvel) = (self.data.qpos(), self.data.qvel());
        for ((ctrl, &command), drive) in self.ctrl.iter_mut().zip(command).zip(&mut self.drives) {
            *ctrl = match drive {
                Some(drive) => drive.output(command, qpos),
                None => command,
            };
        }
        for transmission in &mut self.transmissions {
            let (dof, q) = (transmission.dof, qpos[transmission.qpos]);
            // made for axes only
            let Some(axis) = self.axes.iter().find(|axis| axis.dof == dof) else {
                continue;
            };
            let motor = axis.torque(self.ctrl[axis.actuator]);
            self.ctrl[axis.actuator] = 0.0;
            let passed = transmission.step(motor, q, qvel[dof], self.step_s);
            self.applied[dof] += passed;
            self.load[dof] = passed;
        }
        let motion = Motion {
            qpos,
            qvel,
            load: &self.load,
            step_s: self.step_s,
        };
        for term in &mut self.terms {
            term.apply(motion, &mut self.applied);
        }
        self.data.ctrl_mut().copy_from_slice(&self.ctrl);
        self.data.qfrc_applied_mut().copy_from_slice(&self.applied);
        if !self.torsions.is_empty() {
            self.data.xfrc_applied_mut().fill(0.0);
            for torsion in &self.torsions {
                torsion.apply(&mut self.data)?;
            }
        }
        self.data.step()
    }
}

/// Dofs whose rotor turns with the motor, apart from the joint.
pub(super) fn sprung_dofs(axes: &[Axis], effects: &[Bound]) -> Vec<usize> {
    sprung(axes, effects).map(|axis| axis.dof).collect()
}

/// Axes with play or stretch between motor and joint.
fn sprung<'a>(axes: &'a [Axis], effects: &'a [Bound]) -> impl Iterator<Item = &'a Axis> {
    let sprung = |axis: &&Axis| springs(axis, effects).next().is_some();
    axes.iter().filter(sprung)
}

fn springs<'a>(axis: &'a Axis, effects: &'a [Bound]) -> impl Iterator<Item = &'a Bound> {
    effects.iter().filter(|bound| {
        matches!(
            bound.effect,
            Effect::Backlash | Effect::TransmissionCompliance
        ) && bound.elements.contains(&axis.actuator)
    })
}

/// The transmissions of the axes that have play or stretch.
fn transmissions(
    axes: &[Axis],
    effects: &[Bound],
    step_s: f64,
) -> Result<Vec<Transmission>, RigError> {
    let mut all = Vec::new();
    for axis in axes {
        let own: Vec<&Bound> = springs(axis, effects).collect();
        let Some(first) = own.first() else { continue };
        let made = if axis.is_plain_motor {
            Transmission::new(&own, axis, step_s)
        } else {
            Err("it needs a motor: an actuator without bias and activation".to_owned())
        };
        all.push(made.map_err(|reason| RigError::Effect {
            name: first.effect.entry().name,
            reason,
        })?);
    }
    Ok(all)
}

/// Take the rotor inertia of sprung axes off the joints, where the motors have it.
///
/// # Errors
/// When the engine refuses.
pub(super) fn move_rotors(model: &mut Model, dofs: &[usize]) -> Result<(), MujocoError> {
    if dofs.is_empty() {
        return Ok(());
    }
    let mut edit = model.edit();
    for &dof in dofs {
        edit.dof_armature()[dof] = 0.0;
    }
    edit.finish()
}
