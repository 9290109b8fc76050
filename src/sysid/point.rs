//! What the model says along a trajectory, knot by knot and in parallel.
//!
//! At each knot the trajectory demands an acceleration a, and the engine would take ā from the same position,
//! velocity and control. Sensors are read where they belong to ā, so that forces among them are possible ones.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::SysidError;
use super::inverse::{Changed, Inverse};
use super::problem::{Problem, Trial};
use super::reach::Contacts;
use crate::mujoco::Contact;

/// What the model says along a trajectory.
#[derive(Debug, Clone, Default)]
pub(super) struct Evaluated {
    /// velocities and accelerations of every knot
    pub kinematics: Vec<Kinematics>,
    /// (knots × nv) a − ā; 0 at both ends, where it is not defined
    pub defect: Vec<f64>,
    /// (knots × nv) force that a demands and nothing gives, if asked for; 0 at both ends
    pub force: Vec<f64>,
    /// (knots × channels) sensors
    pub sensors: Vec<f64>,
    /// pairs of geoms that touch
    pub contacts: Contacts,
}

/// A trial with a trajectory and parameters.
#[derive(Clone, Copy)]
pub(super) struct Point<'a> {
    pub problem: &'a Problem,
    pub trial: &'a Trial,
    /// (knots × nq)
    pub qpos: &'a [f64],
    /// free parameters
    pub x: &'a [f64],
}

/// Velocities and accelerations at a knot, nv each.
#[derive(Debug, Clone)]
pub(super) struct Kinematics {
    /// v, from the knot before
    pub before: Vec<f64>,
    /// v', to the knot after
    pub after: Vec<f64>,
    /// a = (v' − v)/h
    pub acceleration: Vec<f64>,
    /// ā
    pub predicted: Vec<f64>,
}

impl Kinematics {
    pub(super) fn new(nv: usize) -> Self {
        let [before, after, acceleration, predicted] = [(); 4].map(|()| vec![0.0; nv]);
        Self {
            before,
            after,
            acceleration,
            predicted,
        }
    }
}

impl Point<'_> {
    /// A workspace at the parameters.
    pub(super) fn inverse(&self) -> Result<Inverse, SysidError> {
        let mut inverse = Inverse::new(
            Arc::clone(&self.problem.model),
            !self.problem.channels.is_empty(),
        )?;
        inverse.set_parameters(&self.problem.parameters, &self.problem.model, self.x)?;
        Ok(inverse)
    }

    /// Position of a knot.
    pub(super) fn knot(&self, k: usize) -> &[f64] {
        let nq = self.problem.model.nq();
        &self.qpos[k * nq..(k + 1) * nq]
    }

    /// Whether no force is defined at a knot, as it has no neighbour on one side.
    pub(super) fn is_end(&self, k: usize) -> bool {
        k == 0 || k + 1 == self.trial.n_knots
    }

    /// Velocities and accelerations at knot `k`, with the sensors of ā in `inverse`; whether the engine takes a step.
    pub(super) fn kinematics(
        &self,
        inverse: &mut Inverse,
        controls: &[f64],
        k: usize,
        out: &mut Kinematics,
    ) -> Result<bool, SysidError> {
        let model = &self.problem.model;
        let (h, nu) = (model.timestep(), model.nu());
        let last = self.trial.n_knots - 1;
        // at the ends the one velocity there is; the acceleration is then not used
        let (a, b) = (k.saturating_sub(1), k.max(1));
        model.differentiate_pos(&mut out.before, h, self.knot(a), self.knot(b))?;
        let (a, b) = (k.min(last - 1), (k + 1).min(last));
        model.differentiate_pos(&mut out.after, h, self.knot(a), self.knot(b))?;
        for ((a, b), v) in (out.acceleration.iter_mut())
            .zip(&out.after)
            .zip(&out.before)
        {
            *a = (b - v) / h;
        }
        inverse.set_ctrl(&controls[k * nu..(k + 1) * nu]);
        let guess = out.acceleration.clone();
        Ok(inverse.predict(self.knot(k), &out.before, &guess, &mut out.predicted)?)
    }

    /// Values along the whole trajectory, `forces` included or not; `None` where the engine takes no step.
    pub(super) fn evaluate(&self, forces: bool) -> Result<Option<Evaluated>, SysidError> {
        let controls = self.problem.controls(self.trial, self.x);
        let parts: Vec<Result<Option<Evaluated>, SysidError>> = chunks(0..self.trial.n_knots)
            .into_par_iter()
            .map(|range| self.evaluate_part(range, &controls, forces))
            .collect();
        let mut all = Evaluated::default();
        for part in parts {
            let Some(mut part) = part? else {
                return Ok(None);
            };
            all.kinematics.append(&mut part.kinematics);
            all.contacts.append(&mut part.contacts);
            all.defect.extend_from_slice(&part.defect);
            all.force.extend_from_slice(&part.force);
            all.sensors.extend_from_slice(&part.sensors);
        }
        Ok(Some(all))
    }

    fn evaluate_part(
        &self,
        range: Range<usize>,
        controls: &[f64],
        forces: bool,
    ) -> Result<Option<Evaluated>, SysidError> {
        let nv = self.problem.model.nv();
        let mut inverse = self.inverse()?;
        let mut out = Evaluated::default();
        let mut sensors = vec![0.0; self.problem.channels.len()];
        for k in range {
            let mut at = Kinematics::new(nv);
            if !self.kinematics(&mut inverse, controls, k, &mut at)? {
                return Ok(None);
            }
            (out.contacts).extend(inverse.data().contacts().iter().map(Contact::geoms));
            read_channels(self.problem, &inverse, &mut sensors);
            out.sensors.extend_from_slice(&sensors);
            let defined = if self.is_end(k) { 0.0 } else { 1.0 };
            let defect = at.acceleration.iter().zip(&at.predicted);
            out.defect.extend(defect.map(|(a, p)| defined * (a - p)));
            if forces {
                inverse.evaluate(
                    self.knot(k),
                    &at.before,
                    &at.acceleration,
                    Changed::Position,
                )?;
                out.force
                    .extend(inverse.residual().iter().map(|f| defined * f));
            }
            out.kinematics.push(at);
        }
        Ok(Some(out))
    }
}

/// Channels of the last evaluation or prediction.
pub(super) fn read_channels(problem: &Problem, inverse: &Inverse, out: &mut [f64]) {
    let (n_sensordata, nq) = (problem.model.nsensordata(), problem.model.nq());
    for (out, channel) in out.iter_mut().zip(&problem.channels) {
        let i = channel.source;
        *out = if i < n_sensordata {
            inverse.sensordata()[i]
        } else if i < n_sensordata + nq {
            inverse.data().qpos()[i - n_sensordata]
        } else {
            inverse.data().qvel()[i - n_sensordata - nq]
        };
    }
}

/// Parts of a range of knots for the threads. Results do not depend on how it is cut.
pub(super) fn chunks(range: Range<usize>) -> Vec<Range<usize>> {
    let size = range
        .len()
        .div_ceil(4 * rayon::current_num_threads())
        .max(16);
    range
        .clone()
        .step_by(size)
        .map(|a| a..(a + size).min(range.end))
        .collect()
}
