//! The windows in steps of another length: derivatives in longer ones.
//!
//! What a change of the model does to a window is needed to a few percent; what is left unexplained, to the last digit.
//! Residuals are therefore simulated in the model's own step h, and derivatives, as differences of two simulations alike,
//! in steps of c h. c is the largest of 8, 4, 2 with which the motors and every parameter act as in steps of h. Fits halve it
//! where no step of theirs leads on ([`super::fit`]); where they have ended it is chosen anew, for the screen and for what is
//! fitted next.

use std::sync::Arc;

use nalgebra::DVector;

use super::linear::Column;
use super::windows::Windows;
use crate::mujoco::Model;
use crate::sysid::SysidError;
use crate::sysid::norm::Norm;
use crate::sysid::problem::{Problem, Stage, Trial};
use crate::sysid::shooting::window::{Placed, Window};

/// Factors to choose from.
const FACTORS: [usize; 3] = [8, 4, 2];
/// Steps of a window that must be left.
const LEAST_STEPS: usize = 16;
/// Windows that are looked at to choose.
const LOOKS: usize = 16;
/// Part of a column that may be wrong.
const WRONG: f64 = 0.1;
/// Columns of which first states leave less than this part of the length say nothing on the step.
const OWN: f64 = 1e-3;

/// What lengths of windows, in steps, are multiples of.
pub(super) fn aligned(steps: usize) -> usize {
    let fits = |f: &usize| steps >= f * LEAST_STEPS;
    FACTORS.into_iter().find(fits).unwrap_or(1)
}

/// The model in steps `factor` times as long.
fn paced(model: &Arc<Model>, factor: f64) -> Result<Arc<Model>, SysidError> {
    if factor == 1.0 {
        return Ok(Arc::clone(model));
    }
    let mut own = model.try_clone()?;
    let mut edit = own.edit();
    edit.set_timestep(model.timestep() * factor)?;
    edit.finish()?;
    Ok(Arc::new(own))
}

/// The problem in steps `factor` times as long. Residuals have no norm there: rows are weighed where they are simulated exactly.
pub(super) fn problem(problem: &Problem, factor: f64) -> Result<Problem, SysidError> {
    let mut own = Problem {
        model: paced(&problem.model, factor)?,
        ..problem.clone()
    };
    for channel in &mut own.channels {
        channel.norm = Norm::Quadratic;
    }
    for trial in &mut own.trials {
        trial.n_knots = steps(trial.n_knots - 1, factor) + 1;
    }
    Ok(own)
}

/// So many steps in ones `factor` times as long.
fn steps(n: usize, factor: f64) -> usize {
    (n as f64 / factor) as usize
}

/// The windows of `windows`, whole trials, in those steps.
pub(super) fn windows(windows: &[Window], factor: f64) -> Vec<Window> {
    let each = windows.iter().map(|w| Window {
        last: steps(w.last, factor),
        ..w.clone()
    });
    each.collect()
}

/// Where samples lie in those steps, in the same order.
pub(super) fn placed(problem: &Problem, placed: &[Vec<Placed>], factor: f64) -> Vec<Vec<Placed>> {
    const ROUNDING: f64 = 1e-9;
    let one = |trial: &Trial, p: &Placed| {
        let at = (p.knot as f64 + p.part) / factor;
        let knot = (at + ROUNDING).floor() as usize;
        let held = problem.channels[trial.samples[p.sample].channel].stage == Stage::Acceleration;
        let part = if held {
            0.0
        } else {
            (at - knot as f64).max(0.0)
        };
        Placed {
            knot,
            part,
            sample: p.sample,
        }
    };
    let each = problem.trials.iter().zip(placed);
    each.map(|(t, own)| own.iter().map(|p| one(t, p)).collect())
        .collect()
}

impl Windows {
    /// Chooses the step of derivatives at parameters `x`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn choose_step(&mut self, x: &[f64]) -> Result<(), SysidError> {
        self.factor = 1;
        let whole = |f: &usize| {
            let ends =
                |t: &Trial| t.n_knots > f * LEAST_STEPS && (t.n_knots - 1).is_multiple_of(*f);
            self.problem.trials.iter().all(ends)
        };
        let possible: Vec<usize> = FACTORS.into_iter().filter(whole).collect();
        if possible.is_empty() {
            return Ok(());
        }
        let mut look = self.at_most(LOOKS);
        // where nothing can be simulated the fit says so
        if look.followed(x).is_err() {
            return Ok(());
        }
        let exact = look.responses(x)?;
        for factor in possible {
            look.factor = factor;
            // what breaks down in longer steps is no use
            let Ok(found) = look.responses(x) else {
                continue;
            };
            if exact.iter().zip(&found).all(|(a, b)| alike(a, b)) {
                self.factor = factor;
                break;
            }
        }
        Ok(())
    }

    /// What parameters and motors do to all rows, first states taken out.
    fn responses(&self, x: &[f64]) -> Result<Vec<(DVector<f64>, f64)>, SysidError> {
        let linear = self.linearise(x)?;
        let mut out = Vec::new();
        let n = linear.rows.iter().map(|r| r.residual.len()).sum();
        for j in 0..x.len() {
            let values = linear
                .rows
                .iter()
                .flat_map(|r| r.parameters.column(j).iter().copied().collect::<Vec<_>>());
            let own = DVector::from_iterator(n, values);
            let raw: f64 = own.norm_squared()
                + linear
                    .rows
                    .iter()
                    .map(|r| r.along.column(j).norm_squared())
                    .sum::<f64>();
            out.push((own, raw));
        }
        if let Some(Column { parts, raw }) = linear.motors(self, x)? {
            let values = parts
                .iter()
                .flat_map(|p| p.iter().copied().collect::<Vec<_>>());
            out.push((DVector::from_iterator(n, values), raw));
        }
        Ok(out)
    }
}

/// Whether a column, with its squared length before projection, is the exact one `a` as near as matters.
fn alike(a: &(DVector<f64>, f64), b: &(DVector<f64>, f64)) -> bool {
    let small = a.0.norm_squared() <= OWN * OWN * a.1;
    small || (&a.0 - &b.0).norm() <= WRONG * a.0.norm()
}

#[cfg(test)]
mod tests {
    use crate::gap::masses::{machine, searching};

    /// Where joints stick, the last steps of a fit are short ones; nothing after it needs them.
    #[test]
    fn a_fit_leaves_no_short_steps_behind() {
        let base = machine(r#"damping=".2" frictionloss=".05""#, "");
        let hidden = machine(r#"damping=".2" frictionloss=".5""#, "");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"frictionloss\"\n";
        searching(&base, &hidden, config, |search, watch| {
            assert!(search.windows.factor > 1);
            search.windows.factor = 1;
            search.settle(watch).expect("settled");
            assert!(search.windows.factor > 1);
        });
    }
}
