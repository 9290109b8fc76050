//! Where joints were around a window, by their own readings.
//!
//! Encoders that are T late show at the beginning of a window what was before it, which its simulation does not know. A
//! smoothed recording m does: m(t) = q(t − T), so that from the window's first state q₀ at t₀
//!
//! ```text
//! q(t₀ − s) = q₀ + m(t₀ − s + T) − m(t₀ + T)
//! ```
//!
//! Extrapolated from q₀ and its velocity alone, positions are off by half the acceleration times T², at 13 ms and 100 rad/s² by
//! 8 mrad: a hundred times the noise of an encoder, and late readings are estimated wrong.

use std::borrow::Cow;
use std::sync::Arc;

use super::problem::Problem;
use super::{SysidError, start};
use crate::mujoco::{Extension, Swing};
use crate::supplement::swing;

/// Smoothed readings of a recording, as positions.
#[derive(Debug, Clone, PartialEq)]
pub struct Path {
    /// (n × nq)
    qpos: Arc<Vec<f64>>,
    nq: usize,
    /// s between rows
    timestep: f64,
    /// s from the first row to the first knot of the trial
    origin_s: f64,
}

impl Path {
    /// Rows (n × nq) every `timestep` s, of which the first is the trial's first knot.
    pub(crate) fn new(qpos: Vec<f64>, nq: usize, timestep: f64) -> Self {
        Self {
            qpos: Arc::new(qpos),
            nq,
            timestep,
            origin_s: 0.0,
        }
    }

    /// The same for a trial that begins `later_s` later.
    pub(crate) fn from(&self, later_s: f64) -> Self {
        Self {
            origin_s: self.origin_s + later_s,
            ..self.clone()
        }
    }

    /// (n × nq)
    pub(crate) fn rows(&self) -> &[f64] {
        &self.qpos
    }

    /// Its acceleration there, a mean over ±`half_s` weighed as a triangle.
    pub(crate) fn acceleration(&self, address: usize, time_s: f64, half_s: f64) -> f64 {
        let at = |time_s: f64| self.at(address, time_s);
        let bend = at(time_s + half_s) - 2.0 * at(time_s) + at(time_s - half_s);
        bend / (half_s * half_s)
    }

    /// What is quick there.
    pub(crate) fn swing(&self, address: usize, time_s: f64) -> Swing {
        swing(|off_s| self.at(address, time_s + off_s))
    }

    /// The number at address `address` of qpos at `time_s` after the trial's first knot; beyond the ends as there.
    pub(crate) fn at(&self, address: usize, time_s: f64) -> f64 {
        let last = self.qpos.len() / self.nq - 1;
        let row = ((self.origin_s + time_s) / self.timestep).clamp(0.0, last as f64);
        let (whole, part) = (row.floor() as usize, row.fract());
        let value = |row: usize| self.qpos[row.min(last) * self.nq + address];
        value(whole) + part * (value(whole + 1) - value(whole))
    }
}

/// The problem with the path of each trial, its sensors as at `x`, if encoders are late or transmissions loaded; else as
/// it is.
///
/// # Errors
/// The engine refuses a number.
pub(crate) fn remember<'a>(
    problem: &'a Problem,
    x: &[f64],
) -> Result<Cow<'a, Problem>, SysidError> {
    let model = &problem.model;
    let felt = |e: &Arc<dyn Extension>| e.encoder_delay_s(model).is_some() || e.is_loaded();
    if !model.extension().is_some_and(felt) {
        return Ok(Cow::Borrowed(problem));
    }
    let mut own = problem.clone();
    for trial in &mut own.trials {
        let qpos = start::trajectory(problem, trial, x)?;
        trial.path = Some(Path::new(qpos, model.nq(), model.timestep()));
    }
    Ok(Cow::Owned(own))
}

#[cfg(test)]
mod tests {
    use super::Path;

    #[test]
    fn straight_between_rows_and_still_beyond_the_ends() {
        let path = Path::new(vec![0.0, 5.0, 1.0, 5.0, 3.0, 5.0], 2, 0.1).from(0.1);
        let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
        assert!(near(path.at(0, 0.0), 1.0) && near(path.at(0, 0.05), 2.0));
        assert!(near(path.at(0, -0.05), 0.5) && near(path.at(1, 0.02), 5.0));
        assert!(near(path.at(0, -1.0), 0.0) && near(path.at(0, 1.0), 3.0));
    }
}
