//! Periodic torques, found without a simulation for each period.
//!
//! A torque that depends on the angle alone, or on the angle and the command, is known wherever the motion is. Each
//! window is cut into parts of equal length; what a constant torque in one part does to the readings is simulated once
//! (Φ, one column a part). A law f then does Φ f̄, with f̄ its means over the parts, whatever its period:
//!
//! ```text
//! gain(n) = max over a, b of the fall of ‖r̃ + Φ (a s̄ₙ + b c̄ₙ) + J̃ dx‖²/2        sₙ = g sin n q, cₙ = g cos n q
//! ```
//!
//! with g = 1 for cogging and the motor's command for ripple. What is best so is then simulated like any other effect.

use nalgebra::{DMatrix, DVector};

use super::GapError;
use super::effect::Periodic;
use super::linear::Linear;
use super::windows::Windows;
use crate::mujoco::{Model, ObjectKind};
use crate::sysid::problem::Problem;

/// Parts of a window.
const PARTS: usize = 8;
/// Ridge on sums of products, relative to their diagonal.
const RIDGE: f64 = 1e-9;

/// What torques at one joint do, part by part of every window.
pub(super) struct Pulses {
    joint: usize,
    windows: Vec<Sums>,
}

/// Sums of products of one window.
struct Sums {
    /// `ΦᵀΦ`
    square: DMatrix<f64>,
    /// `Φᵀ J̃`
    cross: DMatrix<f64>,
    /// `Φᵀ r̃`
    right: DVector<f64>,
}

impl Pulses {
    /// Of a joint of `held`, the problem without a free parameter, with torques of about `size`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn new(
        linear: &Linear,
        held: &Problem,
        joint: usize,
        size: f64,
    ) -> Result<Self, GapError> {
        let dof = held.model.jnt_dofadr()[joint] as usize;
        let all = linear.all();
        let mut columns = Vec::with_capacity(PARTS);
        for part in 0..PARTS {
            let moved = linear.moved(held, &all, false, &mut |point| {
                let steps = |w: usize| point.windows[w].len() - 1;
                let own: Vec<usize> = (0..point.windows.len()).collect();
                point.simulate_pushed(&own, &|w, knot, force| {
                    let inside = knot * PARTS / steps(w).max(1) == part;
                    force[dof] = if inside { size } else { 0.0 };
                })
            })?;
            columns.push(linear.part_of(&moved, size, None));
        }
        let windows = linear.rows.iter().enumerate().map(|(w, row)| {
            let own: Vec<DVector<f64>> = columns.iter().map(|c| c.parts[w].clone()).collect();
            let phi = DMatrix::from_columns(&own);
            Sums {
                square: phi.tr_mul(&phi),
                cross: phi.tr_mul(&row.parameters),
                right: phi.tr_mul(&row.residual),
            }
        });
        Ok(Self {
            joint,
            windows: windows.collect(),
        })
    }

    /// The value of `grid`, in periods over 2π, that explains most; `normal` is (Σ J̃ᵀJ̃ + P, its gradient).
    pub(super) fn best(
        &self,
        windows: &Windows,
        x: &[f64],
        kind: Periodic,
        motor: Option<usize>,
        grid: &[f64],
        (normal, gradient): &(DMatrix<f64>, DVector<f64>),
    ) -> Option<f64> {
        let motions = self.motions(windows, x, kind, motor);
        let factor = (!x.is_empty()).then(|| normal.clone().cholesky()).flatten();
        let mut best: Option<(f64, f64)> = None;
        for &n in grid {
            let mut square = DMatrix::zeros(2, 2);
            let mut cross = DMatrix::zeros(x.len(), 2);
            let mut right = DVector::zeros(2);
            for (sums, motion) in self.windows.iter().zip(&motions) {
                let force = means(motion, n);
                let through = &sums.square * &force;
                square += force.tr_mul(&through);
                cross += sums.cross.tr_mul(&force);
                right += force.tr_mul(&sums.right);
            }
            if let Some(factor) = &factor {
                let solved = factor.solve(&cross);
                square -= cross.tr_mul(&solved);
                right -= solved.tr_mul(gradient);
            }
            for i in 0..2 {
                square[(i, i)] *= 1.0 + RIDGE;
            }
            let Some(own) = square.cholesky() else {
                continue;
            };
            let gain = 0.5 * right.dot(&own.solve(&right));
            if best.is_none_or(|(g, _)| gain > g) {
                best = Some((gain, n));
            }
        }
        best.map(|(_, n)| n)
    }

    /// Per window and knot: (part, angle, factor of the law).
    fn motions(
        &self,
        windows: &Windows,
        x: &[f64],
        kind: Periodic,
        motor: Option<usize>,
    ) -> Vec<Vec<(usize, f64, f64)>> {
        let problem = &windows.problem;
        let model = &problem.model;
        let (nq, nu) = (model.nq(), model.nu());
        let address = model.jnt_qposadr()[self.joint] as usize;
        let each = problem.trials.iter().zip(&windows.trajectories);
        each.map(|(trial, motion)| {
            let controls = match kind {
                Periodic::Torque => Vec::new(),
                Periodic::Command => problem.controls(trial, x),
            };
            let steps = trial.n_knots - 1;
            (0..steps)
                .map(|k| {
                    // of a motor, in any unit: only the shape counts
                    let force = motor
                        .and_then(|u| controls.get(k * nu + u))
                        .copied()
                        .unwrap_or(1.0);
                    (k * PARTS / steps, motion[k * nq + address], force)
                })
                .collect()
        })
        .collect()
    }
}

/// (parts × 2) means of the law's sine and cosine.
fn means(motion: &[(usize, f64, f64)], n: f64) -> DMatrix<f64> {
    let mut sums = DMatrix::zeros(PARTS, 2);
    let mut counts = [0.0_f64; PARTS];
    for &(part, angle, force) in motion {
        let (sin, cos) = (n * angle).sin_cos();
        sums[(part, 0)] += force * sin;
        sums[(part, 1)] += force * cos;
        counts[part] += 1.0;
    }
    for (part, count) in counts.iter().enumerate() {
        sums.row_mut(part).scale_mut(count.max(1.0).recip());
    }
    sums
}

/// The joint and motor of a periodic effect's place.
pub(super) fn site(model: &Model, place: &super::effect::Place) -> Option<(usize, Option<usize>)> {
    let joint = model.id(ObjectKind::Joint, place.joint_name(model)?).ok()?;
    Some((joint, model.id(ObjectKind::Actuator, &place.name).ok()))
}
