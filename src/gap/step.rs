//! What the model's own step makes of the numbers that are estimated in it.
//!
//! A machine moves on in no steps; a model in steps of h is off by about a constant times h, and its numbers are fitted
//! so as to make up for that. No residual tells: the error is the same in every window. It is measured by simulating the
//! windows once more in half the step,
//!
//! ```text
//! dx = −2 (J̃ᵀJ̃ + P)⁻¹ J̃ᵀ (r(h/2) − r(h))
//! ```
//!
//! twice, as half the error is gone in half the step, and belongs to the intervals of numbers (Richardson 1911).

use std::sync::Arc;

use nalgebra::DVector;

use super::linear::Linear;
use super::windows::Windows;
use crate::sysid::SysidError;
use crate::sysid::problem::Problem;
use crate::sysid::shooting::columns::Point;
use crate::sysid::shooting::simulate::Pool;
use crate::sysid::shooting::window::{Placed, Window};

impl Windows {
    /// dx of every free parameter from the step of the model; `linear` is at `x`. `None` where half the step breaks down.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn step_error(
        &self,
        x: &[f64],
        linear: &Linear,
        solve: impl Fn(&DVector<f64>) -> DVector<f64>,
    ) -> Result<Option<DVector<f64>>, SysidError> {
        let held = self.held(&self.problem, x);
        let fine = halved(&held)?;
        let fine_windows: Vec<Window> = (linear.windows.iter())
            .map(|w| Window {
                last: 2 * w.last,
                ..w.clone()
            })
            .collect();
        let fine_placed: Vec<Vec<Placed>> = (linear.placed.iter())
            .map(|own| own.iter().map(twice).collect())
            .collect();
        let pools = [Pool::default(), Pool::default()];
        let point = |problem, windows, placed, pool| Point {
            problem,
            windows,
            placed,
            x: &[],
            states: &self.states,
            free_states: true,
            directions: &[],
            pool,
        };
        let whole = point(&held, &linear.windows, &linear.placed, &pools[0]).simulate()?;
        let half = point(&fine, &fine_windows, &fine_placed, &pools[1]).simulate()?;
        let mut along = DVector::zeros(x.len());
        for (w, row) in linear.rows.iter().enumerate() {
            let (Some(whole), Some(half)) = (&whole[w], &half[w]) else {
                return Ok(None);
            };
            let z = whole.samples(&held, &linear.windows[w], &linear.placed[w]);
            let z_half = half.samples(&fine, &fine_windows[w], &fine_placed[w]);
            let change =
                (z.zip(z_half).zip(&row.factor)).map(|((z, z_half), f)| f * (z_half.0 - z.0));
            // J̃ has nothing of what first states do
            let change = DVector::from_iterator(row.residual.len(), change);
            along.gemv_tr(-2.0, &row.parameters, &change, 1.0);
        }
        Ok(Some(solve(&along)))
    }
}

fn halved(problem: &Problem) -> Result<Problem, SysidError> {
    let mut model = problem.model.try_clone()?;
    let mut edit = model.edit();
    edit.set_timestep(0.5 * problem.model.timestep())?;
    edit.finish()?;
    let mut fine = Problem {
        model: Arc::new(model),
        ..problem.clone()
    };
    for trial in &mut fine.trials {
        trial.n_knots = 2 * (trial.n_knots - 1) + 1;
    }
    Ok(fine)
}

/// Where a sample lies in half the step.
fn twice(p: &Placed) -> Placed {
    let at = 2.0 * p.part;
    let second = usize::from(at >= 1.0);
    Placed {
        knot: 2 * p.knot + second,
        part: at - second as f64,
        sample: p.sample,
    }
}
