//! Bodies that lie still while nothing that moves touches them.
//!
//! A free body at rest beside the machine says only that gravity and what it lies on are in balance, while its twelve
//! unknowns and its stiff contacts take most of the time of every derivative. In such windows its readings are left out,
//! and its first state stays where it was measured.

use std::collections::BTreeSet;
use std::sync::Arc;

use crate::mujoco::{Contact, Data};
use crate::sysid::SysidError;
use crate::sysid::islands::Partition;
use crate::sysid::problem::{Problem, Sample, Stage, Trial};

/// Knots of the motion that are looked at for contacts: every so many-th.
const EVERY: usize = 4;
/// Standard deviations that a reading may be off its mean at rest.
const AWAY: f64 = 5.0;
/// Standard deviations between the means of both halves of a window.
const DRIFT: f64 = 1.0;

/// Finds what lies still in windows of the motion at some parameters.
pub(super) struct Lying<'a> {
    problem: &'a Problem,
    data: Data,
}

/// Degrees of freedom, and the channels that show them.
#[derive(Debug, Clone, Default)]
pub(super) struct Still {
    pub dofs: Vec<usize>,
    pub channels: BTreeSet<usize>,
}

impl<'a> Lying<'a> {
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn new(problem: &'a Problem, x: &[f64]) -> Result<Self, SysidError> {
        let mut data = Data::new(Arc::clone(&problem.model))?;
        problem.parameters.apply(&problem.model, x, &mut data)?;
        Ok(Self { problem, data })
    }

    /// What lies still in the window `trial`, whose motion is estimated as `motion` (knots × nq).
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn of(&mut self, trial: &Trial, motion: &[f64]) -> Result<Still, SysidError> {
        let model = &*self.problem.model;
        let is_free = |dof: usize| model.is_free(model.dof_jntid()[dof] as usize);
        if !(0..model.nv()).any(is_free) {
            return Ok(Still::default());
        }
        let partition = self.partition(motion)?;
        let mut still = Still::default();
        for part in partition.dofs.iter().copied().collect::<BTreeSet<_>>() {
            let dofs: Vec<usize> = (0..model.nv())
                .filter(|d| partition.dofs[*d] == part)
                .collect();
            let channels: BTreeSet<usize> = (0..partition.channels.len())
                .filter(|c| partition.channels[*c] == Some(part))
                .collect();
            let free = dofs.iter().all(|d| is_free(*d));
            if free
                && !partition.driven.contains(&part)
                && self.rests(trial, &channels) == Some(true)
            {
                still.dofs.extend(dofs);
                still.channels.extend(channels);
            }
        }
        Ok(still)
    }

    /// Whether something driven touches a body that no motor moves of itself, or such a body moves, in a trial whose motion
    /// is estimated as `motion` (knots × nq).
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn is_pushed(&mut self, trial: &Trial, motion: &[f64]) -> Result<bool, SysidError> {
        let apart = Partition::new(self.problem, &BTreeSet::new());
        let together = self.partition(motion)?;
        let model = &*self.problem.model;
        for joint in (0..model.njnt()).filter(|j| model.is_free(*j)) {
            let dof = model.jnt_dofadr()[joint] as usize;
            let own = apart.dofs[dof];
            if apart.driven.contains(&own) {
                continue;
            }
            let channels: BTreeSet<usize> = (0..apart.channels.len())
                .filter(|c| apart.channels[*c] == Some(own))
                .collect();
            let touched = together.driven.contains(&together.dofs[dof]);
            if touched || self.rests(trial, &channels) == Some(false) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// What belongs together where things touch that do so in the motion.
    fn partition(&mut self, motion: &[f64]) -> Result<Partition, SysidError> {
        let mut contacts = BTreeSet::new();
        for qpos in motion.chunks_exact(self.problem.model.nq()).step_by(EVERY) {
            self.data.qpos_mut().copy_from_slice(qpos);
            self.data.position_stage()?;
            contacts.extend(self.data.contacts().iter().map(Contact::geoms));
        }
        Ok(Partition::new(self.problem, &contacts))
    }

    /// Whether none of the positions among the channels moves; none where there are none.
    fn rests(&self, trial: &Trial, channels: &BTreeSet<usize>) -> Option<bool> {
        let mut rests = None;
        for &c in channels {
            let channel = &self.problem.channels[c];
            let own: Vec<&Sample> = trial.samples.iter().filter(|s| s.channel == c).collect();
            if channel.stage != Stage::Position || own.len() < 2 {
                continue;
            }
            let mean =
                |part: &[&Sample]| part.iter().map(|s| s.value).sum::<f64>() / part.len() as f64;
            let (all, halves) = (mean(&own), own.split_at(own.len() / 2));
            let away = |s: &&Sample| (s.value - all).abs() > AWAY * channel.sigma_of(s);
            let drift = (mean(halves.1) - mean(halves.0)).abs();
            if own.iter().any(away) || drift > DRIFT * channel.sigma {
                return Some(false);
            }
            rests = Some(true);
        }
        rests
    }
}
