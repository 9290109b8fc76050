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

use nalgebra::DVector;

use super::coarse;
use super::linear::Linear;
use super::score::Normal;
use super::windows::Windows;
use crate::sysid::SysidError;
use crate::sysid::shooting::columns::Point;
use crate::sysid::shooting::simulate::Pool;

impl Windows {
    /// dx of every free parameter from the step of the model; `linear` and `normal` are at `x`. `None` where half the step
    /// breaks down.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn step_error(
        &self,
        x: &[f64],
        linear: &Linear,
        normal: &Normal,
    ) -> Result<Option<DVector<f64>>, SysidError> {
        let held = self.held(&self.problem, x);
        let fine = coarse::problem(&held, 0.5)?;
        let fine_windows = coarse::windows(&linear.windows, 0.5);
        let fine_placed = coarse::placed(&held, &linear.placed, 0.5);
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
        Ok(Some(normal.solve(&along)))
    }
}
