//! Forces that are missing, sensors, and their derivatives along a trajectory, in parallel.
//!
//! Where the trajectory demands acceleration a and the engine would take ā from the same state, the force
//!
//! ```text
//! r = A (a − ā)      A = ∂τ/∂a at ā
//! ```
//!
//! is missing: the residual of inverse dynamics, τ(q, v, a) − u, to first order in a − ā. All derivatives of τ are
//! taken at ā, where contacts carry forces that are possible. At a itself they would carry those of measurement
//! noise, and parameters that multiply them would be estimated too small (attenuation); ā plays the part of an
//! instrumental variable.
//!
//! Finite differences reuse the engine's stages: a change of the acceleration runs the last one only, a change of the
//! velocity the last two. The chain rule through v = (q ⊖ q₋)/h, a = (v' − v)/h, v' = (q₊ ⊖ q)/h gives the three blocks
//! of a window; J(±φ) is [`super::manifold`]'s:
//!
//! ```text
//! ∂r/∂q₋ = −(τ_v − A/h) J(−hv)/h
//! ∂r/∂q  =  τ_q + (τ_v − A/h) J(hv)/h − A/h J(−hv')/h
//! ∂r/∂q₊ =  A/h J(hv')/h
//! ```
//!
//! A sensor that depends on the acceleration is read at ā(q, v, P), which solves τ(q, v, ā, P) = u.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::SysidError;
use super::inverse::{Changed, Inverse};
use super::manifold::{rotations, times_jacobian};
use super::point::{Kinematics, Point, chunks, read_channels};

/// Change of a position in a finite difference, rad or m.
const STEP_POSITION: f64 = 1e-7;
/// Of a velocity, rad/s or m/s.
const STEP_VELOCITY: f64 = 1e-5;
/// Of an acceleration, in which everything is piecewise smooth and nearly linear, rad/s² or m/s².
const STEP_ACCELERATION: f64 = 1e-3;
/// Of a parameter, relative to its typical change.
const STEP_PARAMETER: f64 = 1e-6;

/// Rows of every knot: (nv + channels) × (3 nv + np + 1), the value itself in the last column.
pub(super) struct Blocks {
    rows_per_knot: usize,
    width: usize,
    rows: Vec<f64>,
    mass: Vec<f64>, // (knots × nv × nv) A
}

impl Blocks {
    /// Row `i` of knot `k`: forces, then channels; columns q₋, q, q₊, x, value.
    pub(super) fn row(&self, k: usize, i: usize) -> &[f64] {
        let at = (k * self.rows_per_knot + i) * self.width;
        &self.rows[at..at + self.width]
    }

    /// Missing force (nv) at knot `k` where a − ā is `defect`.
    pub(super) fn force(&self, k: usize, defect: &[f64], out: &mut [f64]) {
        let nv = defect.len();
        let mass = &self.mass[k * nv * nv..(k + 1) * nv * nv];
        for (out, row) in out.iter_mut().zip(mass.chunks_exact(nv)) {
            *out = row.iter().zip(defect).map(|(a, d)| a * d).sum();
        }
    }
}

impl Point<'_> {
    /// Residual force and channels of the last evaluation.
    fn read_all(&self, inverse: &Inverse, out: &mut [f64]) {
        let nv = self.problem.model.nv();
        out[..nv].copy_from_slice(inverse.residual());
        read_channels(self.problem, inverse, &mut out[nv..]);
    }

    /// Values and derivatives of all knots.
    pub(super) fn linearise(&self) -> Result<Blocks, SysidError> {
        let nv = self.problem.model.nv();
        let rows_per_knot = nv + self.problem.channels.len();
        let width = 3 * nv + self.x.len() + 1;
        let n_knots = self.trial.n_knots;
        let controls = self.problem.controls(self.trial, self.x);
        let mut rows = vec![0.0; n_knots * rows_per_knot * width];
        let mut mass = vec![0.0; n_knots * nv * nv];
        let parts = chunks(0..n_knots);
        let size = parts[0].len();
        (parts.into_par_iter())
            .zip(rows.par_chunks_mut(size * rows_per_knot * width))
            .zip(mass.par_chunks_mut(size * nv * nv))
            .try_for_each(|((part, rows), mass)| self.part(part, &controls, rows, mass, width))?;
        Ok(Blocks {
            rows_per_knot,
            width,
            rows,
            mass,
        })
    }

    fn part(
        &self,
        part: Range<usize>,
        controls: &[f64],
        rows: &mut [f64],
        mass: &mut [f64],
        width: usize,
    ) -> Result<(), SysidError> {
        let nv = self.problem.model.nv();
        let per_knot = rows.len() / part.len();
        let mut inverse = self.inverse()?;
        let mut kinematics = Vec::with_capacity(part.len());
        for (k, rows) in part.clone().zip(rows.chunks_exact_mut(per_knot)) {
            let mut at = Kinematics::new(nv);
            if !self.kinematics(&mut inverse, controls, k, &mut at)? {
                return Err(SysidError::NoStep {
                    recording: self.trial.name.clone(),
                    time_s: k as f64 * self.problem.model.timestep(),
                });
            }
            self.trajectory_columns(&mut inverse, &at, k, rows, width)?;
            kinematics.push(at);
        }
        self.parameter_columns(&mut inverse, part.clone(), &kinematics, rows, width)?;
        for (((k, rows), mass), at) in part
            .zip(rows.chunks_exact_mut(per_knot))
            .zip(mass.chunks_exact_mut(nv * nv))
            .zip(&kinematics)
        {
            if !self.is_end(k) {
                at_prediction(rows, mass, at, width);
            }
            self.chain(k, rows, at, width);
        }
        Ok(())
    }

    /// Derivatives by a, v, q of τ and sensors into the three blocks, values into the last column.
    fn trajectory_columns(
        &self,
        inverse: &mut Inverse,
        at: &Kinematics,
        k: usize,
        rows: &mut [f64],
        width: usize,
    ) -> Result<(), SysidError> {
        let model = &self.problem.model;
        let nv = model.nv();
        let n = rows.len() / width;
        let mut base = vec![0.0; n];
        let mut moved = vec![0.0; n];
        let mut a = at.predicted.clone();
        let mut v = at.before.clone();
        let ends = self.is_end(k);
        inverse.evaluate(self.knot(k), &v, &a, Changed::Position)?;
        self.read_all(inverse, &mut base);
        let store = |moved: &[f64], rows: &mut [f64], column: usize, step: f64| {
            for (i, (m, b)) in moved.iter().zip(&base).enumerate() {
                rows[i * width + column] = (m - b) / step;
            }
        };
        // blocks hold τ_a, τ_q, τ_v for now
        if !ends {
            for j in 0..nv {
                let old = a[j];
                a[j] += STEP_ACCELERATION;
                inverse.evaluate(self.knot(k), &v, &a, Changed::Acceleration)?;
                self.read_all(inverse, &mut moved);
                store(&moved, rows, j, STEP_ACCELERATION);
                a[j] = old;
            }
        }
        for j in 0..nv {
            let old = v[j];
            v[j] += STEP_VELOCITY;
            inverse.evaluate(self.knot(k), &v, &a, Changed::Velocity)?;
            self.read_all(inverse, &mut moved);
            store(&moved, rows, 2 * nv + j, STEP_VELOCITY);
            v[j] = old;
        }
        let mut tangent = vec![0.0; nv];
        for j in 0..nv {
            let mut qpos = self.knot(k).to_vec();
            tangent[j] = STEP_POSITION;
            model.integrate_pos(&mut qpos, &tangent, 1.0)?;
            tangent[j] = 0.0;
            inverse.evaluate(&qpos, &v, &a, Changed::Position)?;
            self.read_all(inverse, &mut moved);
            store(&moved, rows, nv + j, STEP_POSITION);
        }
        for (row, base) in rows.chunks_exact_mut(width).zip(&base) {
            row[width - 1] = *base;
        }
        if ends {
            // no force here
            rows[..nv * width].fill(0.0);
        }
        Ok(())
    }

    fn parameter_columns(
        &self,
        inverse: &mut Inverse,
        part: Range<usize>,
        kinematics: &[Kinematics],
        rows: &mut [f64],
        width: usize,
    ) -> Result<(), SysidError> {
        let (nv, nu) = (self.problem.model.nv(), self.problem.model.nu());
        let per_knot = rows.len() / part.len();
        let mut moved = vec![0.0; per_knot / width];
        for (j, parameter) in self.problem.parameters.iter_free().enumerate() {
            let step = STEP_PARAMETER * parameter.typical;
            let mut x = self.x.to_vec();
            x[j] += step;
            let controls = self.problem.controls(self.trial, &x);
            inverse.set_parameters(&self.problem.parameters, &self.problem.model, &x)?;
            for ((k, rows), at) in part
                .clone()
                .zip(rows.chunks_exact_mut(per_knot))
                .zip(kinematics)
            {
                inverse.set_ctrl(&controls[k * nu..(k + 1) * nu]);
                inverse.evaluate(self.knot(k), &at.before, &at.predicted, Changed::Position)?;
                self.read_all(inverse, &mut moved);
                let ends = self.is_end(k);
                for (i, row) in rows.chunks_exact_mut(width).enumerate() {
                    if !(ends && i < nv) {
                        row[3 * nv + j] = (moved[i] - row[width - 1]) / step;
                    }
                }
            }
        }
        Ok(())
    }

    /// From (`τ_a`, `τ_q`, `τ_v`) to (q₋, q, q₊).
    fn chain(&self, k: usize, rows: &mut [f64], at: &Kinematics, width: usize) {
        let model = &self.problem.model;
        let (nv, h) = (model.nv(), model.timestep());
        let n = rows.len() / width;
        let turning = rotations(model);
        let block = |b: usize| -> Vec<f64> {
            rows.chunks_exact(width)
                .flat_map(|row| row[b * nv..(b + 1) * nv].to_vec())
                .collect()
        };
        let (by_a, by_q, by_v) = (block(0), block(1), block(2));
        let through_v: Vec<f64> = by_v
            .iter()
            .zip(&by_a)
            .map(|(v, a)| (v - a / h) / h)
            .collect();
        let through_a: Vec<f64> = by_a.iter().map(|a| a / (h * h)).collect();
        let times = |a: &[f64], qvel: &[f64], h: f64| {
            let mut a = a.to_vec();
            times_jacobian(&mut a, nv, &turning, qvel, h);
            a
        };
        let minus = times(&through_v, &at.before, -h);
        let own = times(&through_v, &at.before, h);
        let back = times(&through_a, &at.after, -h);
        let plus = times(&through_a, &at.after, h);
        for i in 0..n {
            let row = &mut rows[i * width..(i + 1) * width];
            for j in 0..nv {
                let e = i * nv + j;
                // velocity sensors are not used at the first knot
                (row[j], row[nv + j]) = if k > 0 {
                    (-minus[e], by_q[e] + own[e] - back[e])
                } else {
                    (0.0, by_q[e])
                };
                row[2 * nv + j] = plus[e];
            }
        }
    }
}

/// Completes the value of forces, whose rows hold τ at ā, and carries the dependence of sensors on ā to what ā
/// depends on.
fn at_prediction(rows: &mut [f64], mass: &mut [f64], at: &Kinematics, width: usize) {
    let nv = at.before.len();
    let (forces, sensors) = rows.split_at_mut(nv * width);
    for (mass, row) in mass
        .chunks_exact_mut(nv)
        .zip(forces.chunks_exact_mut(width))
    {
        mass.copy_from_slice(&row[..nv]);
        let defect = at
            .acceleration
            .iter()
            .zip(&at.predicted)
            .map(|(a, p)| a - p);
        row[width - 1] += mass.iter().zip(defect).map(|(m, d)| m * d).sum::<f64>();
    }
    let mut solved = None;
    for row in sensors.chunks_exact_mut(width) {
        let by_a = DVector::from_column_slice(&row[..nv]);
        if by_a.iter().all(|&v| v == 0.0) {
            continue;
        }
        row[..nv].fill(0.0);
        let transposed =
            solved.get_or_insert_with(|| DMatrix::from_column_slice(nv, nv, mass).lu());
        if let Some(y) = transposed.solve(&by_a) {
            for (force, y) in forces.chunks_exact(width).zip(y.iter()) {
                for (s, f) in row[nv..width - 1].iter_mut().zip(&force[nv..width - 1]) {
                    *s -= y * f;
                }
            }
        }
    }
}
