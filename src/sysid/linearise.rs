//! Residual forces, sensors and their derivatives along a trajectory, in parallel.
//!
//! Finite differences reuse the engine's stages: a change of the acceleration runs the last one only, a change of the
//! velocity the last two. With τ(q, v, a) the residual force of [`super::inverse`] and the same for sensors, the chain
//! rule through v = (q ⊖ q₋)/h, a = (v' − v)/h, v' = (q₊ ⊖ q)/h gives the three blocks of a window; J(±φ) is
//! [`super::manifold`]'s:
//!
//! ```text
//! ∂/∂q₋ = −(τ_v − τ_a/h) J(−hv)/h
//! ∂/∂q  =  τ_q + (τ_v − τ_a/h) J(hv)/h − τ_a/h J(−hv')/h
//! ∂/∂q₊ =  τ_a/h J(hv')/h
//! ```

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::SysidError;
use super::inverse::{Changed, Inverse};
use super::manifold::{rotations, times_jacobian};
use super::problem::{Problem, Trial};

/// Change of a position in a finite difference, rad or m.
const STEP_POSITION: f64 = 1e-7;
/// Of a velocity, rad/s or m/s.
const STEP_VELOCITY: f64 = 1e-5;
/// Of an acceleration, in which everything is piecewise smooth and nearly linear, rad/s² or m/s².
const STEP_ACCELERATION: f64 = 1e-3;
/// Of a parameter, relative to its typical change.
const STEP_PARAMETER: f64 = 1e-6;

/// What the model says along a trajectory.
#[derive(Debug, Clone, Default)]
pub(super) struct Evaluated {
    /// (knots × nv) residual force; 0 at both ends, where it is not defined
    pub force: Vec<f64>,
    /// (knots × channels) sensors
    pub sensors: Vec<f64>,
}

/// Rows of one knot: (nv + channels) × (3 nv + np + 1), the value itself in the last column.
pub(super) struct Blocks {
    pub first: usize,
    pub rows_per_knot: usize,
    pub width: usize,
    pub rows: Vec<f64>,
}

impl Blocks {
    /// Row `i` of knot `k`.
    pub(super) fn row(&self, k: usize, i: usize) -> &[f64] {
        let at = ((k - self.first) * self.rows_per_knot + i) * self.width;
        &self.rows[at..at + self.width]
    }
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

/// A knot's state, as the inverse takes it.
struct Kinematics {
    before: Vec<f64>, // v (nv)
    after: Vec<f64>,  // v' (nv)
    acceleration: Vec<f64>,
}

impl Point<'_> {
    fn inverse(&self) -> Result<Inverse, SysidError> {
        let sensors = !self.problem.channels.is_empty();
        let mut inverse = Inverse::new(Arc::clone(&self.problem.model), sensors)?;
        inverse.set_parameters(&self.problem.parameters, &self.problem.model, self.x)?;
        Ok(inverse)
    }

    fn knot(&self, k: usize) -> &[f64] {
        let nq = self.problem.model.nq();
        &self.qpos[k * nq..(k + 1) * nq]
    }

    fn kinematics(&self, k: usize, out: &mut Kinematics) -> Result<(), SysidError> {
        let model = &self.problem.model;
        let h = model.timestep();
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
        Ok(())
    }

    /// Values along the whole trajectory.
    pub(super) fn evaluate(&self) -> Result<Evaluated, SysidError> {
        let (nv, n_channels) = (self.problem.model.nv(), self.problem.channels.len());
        let controls = self.problem.controls(self.trial, self.x);
        let parts: Vec<Result<Evaluated, SysidError>> = chunks(0..self.trial.n_knots)
            .into_par_iter()
            .map(|range| {
                let mut inverse = self.inverse()?;
                let mut out = Evaluated::default();
                let mut row = vec![0.0; nv + n_channels];
                let mut kinematics = Kinematics::new(nv);
                for k in range {
                    self.kinematics(k, &mut kinematics)?;
                    self.run(&mut inverse, &controls, k, &kinematics, Changed::Position)?;
                    self.read(&inverse, &mut row);
                    if k == 0 || k + 1 == self.trial.n_knots {
                        row[..nv].fill(0.0);
                    }
                    out.force.extend_from_slice(&row[..nv]);
                    out.sensors.extend_from_slice(&row[nv..]);
                }
                Ok(out)
            })
            .collect();
        let mut all = Evaluated::default();
        for part in parts {
            let part = part?;
            all.force.extend_from_slice(&part.force);
            all.sensors.extend_from_slice(&part.sensors);
        }
        Ok(all)
    }

    fn run(
        &self,
        inverse: &mut Inverse,
        controls: &[f64],
        k: usize,
        at: &Kinematics,
        changed: Changed,
    ) -> Result<(), SysidError> {
        let nu = self.problem.model.nu();
        inverse.set_ctrl(&controls[k * nu..(k + 1) * nu]);
        inverse.evaluate(self.knot(k), &at.before, &at.acceleration, changed)?;
        Ok(())
    }

    /// Residual force and channels of the last evaluation.
    fn read(&self, inverse: &Inverse, out: &mut [f64]) {
        let model = &self.problem.model;
        let (nv, n_sensordata, nq) = (model.nv(), model.nsensordata(), model.nq());
        out[..nv].copy_from_slice(inverse.residual());
        for (out, channel) in out[nv..].iter_mut().zip(&self.problem.channels) {
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

    /// Values and derivatives of knots `range`.
    pub(super) fn linearise(&self, range: Range<usize>) -> Result<Blocks, SysidError> {
        let model = &self.problem.model;
        let (nv, np) = (model.nv(), self.x.len());
        let rows_per_knot = nv + self.problem.channels.len();
        let width = 3 * nv + np + 1;
        let controls = self.problem.controls(self.trial, self.x);
        let parts: Vec<Result<Vec<f64>, SysidError>> = chunks(range.clone())
            .into_par_iter()
            .map(|part| {
                let mut inverse = self.inverse()?;
                let mut rows = vec![0.0; part.len() * rows_per_knot * width];
                for (k, rows) in part
                    .clone()
                    .zip(rows.chunks_exact_mut(rows_per_knot * width))
                {
                    self.trajectory_columns(&mut inverse, &controls, k, rows, width)?;
                }
                self.parameter_columns(&mut inverse, part, &mut rows, width)?;
                Ok(rows)
            })
            .collect();
        let mut rows = Vec::with_capacity(range.len() * rows_per_knot * width);
        for part in parts {
            rows.extend_from_slice(&part?);
        }
        Ok(Blocks {
            first: range.start,
            rows_per_knot,
            width,
            rows,
        })
    }

    fn trajectory_columns(
        &self,
        inverse: &mut Inverse,
        controls: &[f64],
        k: usize,
        rows: &mut [f64],
        width: usize,
    ) -> Result<(), SysidError> {
        let model = &self.problem.model;
        let (nv, h) = (model.nv(), model.timestep());
        let n = rows.len() / width;
        let mut at = Kinematics::new(nv);
        self.kinematics(k, &mut at)?;
        let mut base = vec![0.0; n];
        let mut moved = vec![0.0; n];
        // (n × nv) each
        let [mut by_q, mut by_v, mut by_a] = [(); 3].map(|()| vec![0.0; n * nv]);
        let ends = k == 0 || k + 1 == self.trial.n_knots;
        self.run(inverse, controls, k, &at, Changed::Position)?;
        self.read(inverse, &mut base);
        let store = |moved: &[f64], into: &mut [f64], j: usize, step: f64| {
            for (i, (m, b)) in moved.iter().zip(&base).enumerate() {
                into[i * nv + j] = (m - b) / step;
            }
        };
        if !ends {
            for j in 0..nv {
                let old = at.acceleration[j];
                at.acceleration[j] += STEP_ACCELERATION;
                self.run(inverse, controls, k, &at, Changed::Acceleration)?;
                self.read(inverse, &mut moved);
                store(&moved, &mut by_a, j, STEP_ACCELERATION);
                at.acceleration[j] = old;
            }
        }
        for j in 0..nv {
            let old = at.before[j];
            at.before[j] += STEP_VELOCITY;
            self.run(inverse, controls, k, &at, Changed::Velocity)?;
            self.read(inverse, &mut moved);
            store(&moved, &mut by_v, j, STEP_VELOCITY);
            at.before[j] = old;
        }
        let mut tangent = vec![0.0; nv];
        for j in 0..nv {
            let mut qpos = self.knot(k).to_vec();
            tangent[j] = STEP_POSITION;
            model.integrate_pos(&mut qpos, &tangent, 1.0)?;
            tangent[j] = 0.0;
            inverse.evaluate(&qpos, &at.before, &at.acceleration, Changed::Position)?;
            self.read(inverse, &mut moved);
            store(&moved, &mut by_q, j, STEP_POSITION);
        }
        if ends {
            // no force here, and velocity sensors are not used at the first knot
            by_v[..nv * nv].fill(0.0);
            by_q[..nv * nv].fill(0.0);
            base[..nv].fill(0.0);
        }
        let turning = rotations(model);
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
                if k > 0 {
                    row[j] = -minus[e];
                    row[nv + j] = by_q[e] + own[e] - back[e];
                } else {
                    row[nv + j] = by_q[e];
                }
                row[2 * nv + j] = plus[e];
            }
            row[width - 1] = base[i];
        }
        Ok(())
    }

    fn parameter_columns(
        &self,
        inverse: &mut Inverse,
        part: Range<usize>,
        rows: &mut [f64],
        width: usize,
    ) -> Result<(), SysidError> {
        let nv = self.problem.model.nv();
        let per_knot = rows.len() / part.len();
        let n = per_knot / width;
        let mut moved = vec![0.0; n];
        let mut at = Kinematics::new(nv);
        for (j, parameter) in self.problem.parameters.iter_free().enumerate() {
            let step = STEP_PARAMETER * parameter.typical;
            let mut x = self.x.to_vec();
            x[j] += step;
            let controls = self.problem.controls(self.trial, &x);
            inverse.set_parameters(&self.problem.parameters, &self.problem.model, &x)?;
            for (k, rows) in part.clone().zip(rows.chunks_exact_mut(per_knot)) {
                self.kinematics(k, &mut at)?;
                self.run(inverse, &controls, k, &at, Changed::Position)?;
                self.read(inverse, &mut moved);
                let ends = k == 0 || k + 1 == self.trial.n_knots;
                for (i, row) in rows.chunks_exact_mut(width).enumerate() {
                    if !(ends && i < nv) {
                        row[3 * nv + j] = (moved[i] - row[width - 1]) / step;
                    }
                }
            }
        }
        Ok(())
    }
}

impl Kinematics {
    fn new(nv: usize) -> Self {
        Self {
            before: vec![0.0; nv],
            after: vec![0.0; nv],
            acceleration: vec![0.0; nv],
        }
    }
}

/// Parts of a range of knots for the threads. Results do not depend on how it is cut.
fn chunks(range: Range<usize>) -> Vec<Range<usize>> {
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
