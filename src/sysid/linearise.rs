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
//!
//! Columns of parts that nothing connects (see [`super::islands`]) are changed at once. During a descent forces keep the
//! A₀ they had where it began as their metric, A₀ (a − ā) in place of A (a − ā), so that the cost is one function of
//! motion and parameters: derivatives are those above, times A₀ A⁻¹. Contacts of parts that tell nothing are left out.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::SysidError;
use super::inverse::{Changed, Inverse};
use super::islands::{Island, Islands};
use super::manifold::times_jacobian;
use super::point::{Evaluated, Kinematics, Point, chunks, read_channels};

/// Change of a position in a finite difference, rad or m.
const STEP_POSITION: f64 = 1e-7;
/// Of a velocity, rad/s or m/s.
const STEP_VELOCITY: f64 = 1e-5;
/// Of an acceleration, in which everything is piecewise smooth and nearly linear, rad/s² or m/s².
const STEP_ACCELERATION: f64 = 1e-3;
/// Of a parameter, relative to its typical change.
const STEP_PARAMETER: f64 = 1e-6;

/// Rows of every knot of a part of the model: (n + channels) × (3 n + parameters + 1), the value itself in the last
/// column.
pub(super) struct Blocks {
    rows_per_knot: usize,
    width: usize,
    rows: Vec<f64>,
    metric: Vec<f64>, // (knots × n × n) by which forces are measured
    own: Vec<f64>,    // the same, A at the point of the linearisation
}

impl Blocks {
    fn new(island: &Island, n_knots: usize) -> Self {
        let (n, rows_per_knot, width) = (island.dofs.len(), island.n_rows(), island.width());
        Self {
            rows_per_knot,
            width,
            rows: vec![0.0; n_knots * rows_per_knot * width],
            metric: vec![0.0; n_knots * n * n],
            own: vec![0.0; n_knots * n * n],
        }
    }

    /// Measures forces by A at the point of the linearisation.
    pub(super) fn measure_by_own(&mut self, island: &Island) {
        let n = island.dofs.len();
        (self.rows)
            .par_chunks_mut((self.rows_per_knot * self.width).max(1))
            .zip(self.metric.par_chunks_mut((n * n).max(1)))
            .zip(self.own.par_chunks((n * n).max(1)))
            .for_each(|((rows, metric), own)| measure_by(island, rows, metric, own));
    }

    /// Row `i` of knot `k`: forces, then channels; columns q₋, q, q₊, x, value.
    pub(super) fn row(&self, k: usize, i: usize) -> &[f64] {
        let at = (k * self.rows_per_knot + i) * self.width;
        &self.rows[at..at + self.width]
    }

    /// Missing force at knot `k` where a − ā (nv) is `defect`.
    pub(super) fn force(&self, island: &Island, k: usize, defect: &[f64], out: &mut [f64]) {
        let n = island.dofs.len();
        let metric = &self.metric[k * n * n..(k + 1) * n * n];
        for (out, row) in out.iter_mut().zip(metric.chunks_exact(n)) {
            *out = (row.iter().zip(&island.dofs))
                .map(|(a, d)| a * defect[*d])
                .sum();
        }
    }
}

/// Rows and metric of some knots of one part.
struct Section<'a> {
    island: &'a Island,
    rows: &'a mut [f64],
    metric: &'a mut [f64],
    own: &'a mut [f64],
    /// A of an earlier linearisation, which is to stay
    kept: Option<&'a [f64]>,
}

impl Section<'_> {
    /// Rows of the `at`th knot.
    fn knot(&mut self, at: usize) -> &mut [f64] {
        let size = self.island.n_rows() * self.island.width();
        &mut self.rows[at * size..(at + 1) * size]
    }
}

impl Point<'_> {
    /// Residual force and channels of the last evaluation.
    fn read_all(&self, inverse: &Inverse, out: &mut [f64]) {
        let nv = self.problem.model.nv();
        out[..nv].copy_from_slice(inverse.residual());
        read_channels(self.problem, inverse, &mut out[nv..]);
    }

    /// Values and derivatives of all knots, part by part, where `evaluated` is what the model says at this point.
    /// Forces are measured by the metric of `kept`, if given.
    pub(super) fn linearise(
        &self,
        evaluated: &Evaluated,
        islands: &Islands,
        kept: Option<&[Blocks]>,
    ) -> Result<Vec<Blocks>, SysidError> {
        let n_knots = self.trial.n_knots;
        let controls = self.problem.controls(self.trial, self.x);
        let mut out: Vec<Blocks> = (islands.parts.iter())
            .map(|island| Blocks::new(island, n_knots))
            .collect();
        let ranges = chunks(0..n_knots);
        let size = ranges[0].len();
        let mut sections: Vec<Vec<Section>> = ranges.iter().map(|_| Vec::new()).collect();
        for (i, (island, blocks)) in islands.parts.iter().zip(&mut out).enumerate() {
            let n = island.dofs.len();
            let rows = (blocks.rows).chunks_mut(size * island.n_rows() * island.width());
            let metric = blocks.metric.chunks_mut(size * n * n);
            let own = blocks.own.chunks_mut(size * n * n);
            for (c, ((rows, metric), own)) in rows.zip(metric).zip(own).enumerate() {
                let kept = kept.map(|k| {
                    let first = c * size * n * n;
                    &k[i].metric[first..first + metric.len()]
                });
                sections[c].push(Section {
                    island,
                    rows,
                    metric,
                    own,
                    kept,
                });
            }
        }
        (ranges.into_par_iter())
            .zip(sections)
            .try_for_each(|(range, mut sections)| {
                let kinematics = &evaluated.kinematics[range.clone()];
                self.section(range, &controls, kinematics, islands, &mut sections)
            })?;
        Ok(out)
    }

    fn section(
        &self,
        range: Range<usize>,
        controls: &[f64],
        kinematics: &[Kinematics],
        islands: &Islands,
        sections: &mut [Section],
    ) -> Result<(), SysidError> {
        let nu = self.problem.model.nu();
        let mut inverse = self.inverse()?;
        if !islands.is_touching(&self.problem.model) {
            inverse.leave_out_contacts()?;
        }
        for (i, (k, at)) in range.clone().zip(kinematics).enumerate() {
            inverse.set_ctrl(&controls[k * nu..(k + 1) * nu]);
            self.trajectory_columns(&mut inverse, at, k, i, sections)?;
        }
        for group in &islands.colours {
            self.parameter_columns(&mut inverse, group, range.clone(), kinematics, sections)?;
        }
        for section in sections {
            let n = section.island.dofs.len();
            for (i, (k, at)) in range.clone().zip(kinematics).enumerate() {
                let here = i * n * n..(i + 1) * n * n;
                let size = section.island.n_rows() * section.island.width();
                let rows = &mut section.rows[i * size..(i + 1) * size];
                if !self.is_end(k) {
                    let metric = &mut section.metric[here.clone()];
                    at_prediction(section.island, rows, metric);
                    section.own[here.clone()].copy_from_slice(metric);
                    if let Some(kept) = section.kept {
                        measure_by(section.island, rows, metric, &kept[here]);
                    }
                    complete(section.island, rows, metric, at);
                }
                self.chain(section.island, k, rows, at);
            }
        }
        Ok(())
    }

    /// Derivatives by a, v, q of τ and sensors into the three blocks of knot `k`, the `i`th of the sections; values into
    /// the last column.
    fn trajectory_columns(
        &self,
        inverse: &mut Inverse,
        at: &Kinematics,
        k: usize,
        i: usize,
        sections: &mut [Section],
    ) -> Result<(), SysidError> {
        let model = &self.problem.model;
        let nv = model.nv();
        let n = nv + self.problem.channels.len();
        let (mut base, mut moved) = (vec![0.0; n], vec![0.0; n]);
        let mut a = at.predicted.clone();
        let mut v = at.before.clone();
        let ends = self.is_end(k);
        inverse.evaluate(self.knot(k), &v, &a, Changed::Position)?;
        self.read_all(inverse, &mut base);
        // columns of different parts at once
        let most = (sections.iter().map(|s| s.island.dofs.len())).max();
        let colours: Vec<Vec<usize>> = (0..most.unwrap_or(0))
            .map(|c| {
                (sections.iter())
                    .filter_map(|s| s.island.dofs.get(c).copied())
                    .collect()
            })
            .collect();
        let mut store = |moved: &[f64], block: usize, c: usize, step: f64| {
            for section in &mut *sections {
                let island = section.island;
                if c < island.dofs.len() {
                    let column = block * island.dofs.len() + c;
                    let rows = section.knot(i).chunks_exact_mut(island.width());
                    for (row, e) in rows.zip(entries(island, nv)) {
                        row[column] = (moved[e] - base[e]) / step;
                    }
                }
            }
        };
        // blocks hold τ_a, τ_q, τ_v for now
        for (c, dofs) in colours.iter().enumerate().filter(|_| !ends) {
            for &d in dofs {
                a[d] += STEP_ACCELERATION;
            }
            inverse.evaluate(self.knot(k), &v, &a, Changed::Acceleration)?;
            self.read_all(inverse, &mut moved);
            store(&moved, 0, c, STEP_ACCELERATION);
            for &d in dofs {
                a[d] = at.predicted[d];
            }
        }
        for (c, dofs) in colours.iter().enumerate() {
            for &d in dofs {
                v[d] += STEP_VELOCITY;
            }
            inverse.evaluate(self.knot(k), &v, &a, Changed::Velocity)?;
            self.read_all(inverse, &mut moved);
            store(&moved, 2, c, STEP_VELOCITY);
            for &d in dofs {
                v[d] = at.before[d];
            }
        }
        let mut tangent = vec![0.0; nv];
        for (c, dofs) in colours.iter().enumerate() {
            let mut qpos = self.knot(k).to_vec();
            for &d in dofs {
                tangent[d] = STEP_POSITION;
            }
            model.integrate_pos(&mut qpos, &tangent, 1.0)?;
            for &d in dofs {
                tangent[d] = 0.0;
            }
            inverse.evaluate(&qpos, &v, &a, Changed::Position)?;
            self.read_all(inverse, &mut moved);
            store(&moved, 1, c, STEP_POSITION);
        }
        for section in sections {
            let island = section.island;
            let rows = section.knot(i).chunks_exact_mut(island.width());
            for (row, e) in rows.zip(entries(island, nv)) {
                row[island.width() - 1] = base[e];
            }
            if ends {
                // no force here
                section.knot(i)[..island.dofs.len() * island.width()].fill(0.0);
            }
        }
        Ok(())
    }

    /// Derivatives by the parameters of a group, of which no part has two.
    fn parameter_columns(
        &self,
        inverse: &mut Inverse,
        group: &[usize],
        range: Range<usize>,
        kinematics: &[Kinematics],
        sections: &mut [Section],
    ) -> Result<(), SysidError> {
        let (nv, nu) = (self.problem.model.nv(), self.problem.model.nu());
        let mut moved = vec![0.0; nv + self.problem.channels.len()];
        let mut x = self.x.to_vec();
        let free: Vec<_> = self.problem.parameters.iter_free().collect();
        let step = |j: usize| STEP_PARAMETER * free[j].typical;
        for &j in group {
            x[j] += step(j);
        }
        let controls = self.problem.controls(self.trial, &x);
        inverse.set_parameters(&self.problem.parameters, &self.problem.model, &x)?;
        for (i, (k, at)) in range.zip(kinematics).enumerate() {
            inverse.set_ctrl(&controls[k * nu..(k + 1) * nu]);
            inverse.evaluate(self.knot(k), &at.before, &at.predicted, Changed::Position)?;
            self.read_all(inverse, &mut moved);
            let ends = self.is_end(k);
            for section in &mut *sections {
                let island = section.island;
                let own = (island.parameters.iter()).position(|j| group.contains(j));
                let Some(own) = own else { continue };
                let (n, width) = (island.dofs.len(), island.width());
                let step = step(island.parameters[own]);
                let rows = section.knot(i).chunks_exact_mut(width);
                for (r, (row, e)) in rows.zip(entries(island, nv)).enumerate() {
                    if !(ends && r < n) {
                        row[3 * n + own] = (moved[e] - row[width - 1]) / step;
                    }
                }
            }
        }
        Ok(())
    }

    /// From (`τ_a`, `τ_q`, `τ_v`) to (q₋, q, q₊).
    fn chain(&self, island: &Island, k: usize, rows: &mut [f64], at: &Kinematics) {
        let h = self.problem.model.timestep();
        let (nv, width) = (island.dofs.len(), island.width());
        let n = rows.len() / width;
        let own = |all: &[f64]| -> Vec<f64> { island.dofs.iter().map(|d| all[*d]).collect() };
        let (before, after) = (own(&at.before), own(&at.after));
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
            times_jacobian(&mut a, nv, &island.rotations, qvel, h);
            a
        };
        let minus = times(&through_v, &before, -h);
        let own = times(&through_v, &before, h);
        let back = times(&through_a, &after, -h);
        let plus = times(&through_a, &after, h);
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

/// Places of a part's rows among forces (nv) and channels of the whole.
fn entries(island: &Island, nv: usize) -> impl Iterator<Item = usize> {
    (island.dofs.iter().copied()).chain(island.channels.iter().map(move |c| nv + c))
}

/// Takes out A, and carries the dependence of sensors on ā to what ā depends on.
fn at_prediction(island: &Island, rows: &mut [f64], metric: &mut [f64]) {
    let (nv, width) = (island.dofs.len(), island.width());
    let (forces, sensors) = rows.split_at_mut(nv * width);
    for (metric, row) in (metric.chunks_exact_mut(nv)).zip(forces.chunks_exact(width)) {
        metric.copy_from_slice(&row[..nv]);
    }
    let mut solved = None;
    for row in sensors.chunks_exact_mut(width) {
        let by_a = DVector::from_column_slice(&row[..nv]);
        if by_a.iter().all(|&v| v == 0.0) {
            continue;
        }
        row[..nv].fill(0.0);
        let transposed =
            solved.get_or_insert_with(|| DMatrix::from_column_slice(nv, nv, metric).lu());
        if let Some(y) = transposed.solve(&by_a) {
            for (force, y) in forces.chunks_exact(width).zip(y.iter()) {
                for (s, f) in row[nv..width - 1].iter_mut().zip(&force[nv..width - 1]) {
                    *s -= y * f;
                }
            }
        }
    }
}

/// Turns forces into what they are by the metric `kept`: A₀ A⁻¹ times themselves.
fn measure_by(island: &Island, rows: &mut [f64], metric: &mut [f64], kept: &[f64]) {
    let (n, width) = (island.dofs.len(), island.width());
    if metric == kept {
        return;
    }
    let transposed = DMatrix::from_column_slice(n, n, metric).lu();
    // (A₀ A⁻¹)ᵀ = A⁻ᵀ A₀ᵀ
    let Some(turn) = transposed.solve(&DMatrix::from_column_slice(n, n, kept)) else {
        return;
    };
    let forces = &mut rows[..n * width];
    let old = DMatrix::from_row_slice(n, width, forces);
    let new = turn.tr_mul(&old);
    for (i, row) in forces.chunks_exact_mut(width).enumerate() {
        for (j, v) in row.iter_mut().enumerate() {
            *v = new[(i, j)];
        }
    }
    metric.copy_from_slice(kept);
}

/// The value of forces: A (a − ā).
fn complete(island: &Island, rows: &mut [f64], metric: &[f64], at: &Kinematics) {
    let (n, width) = (island.dofs.len(), island.width());
    for (metric, row) in (metric.chunks_exact(n)).zip(rows.chunks_exact_mut(width)) {
        row[width - 1] = (metric.iter().zip(&island.dofs))
            .map(|(m, d)| m * (at.acceleration[*d] - at.predicted[*d]))
            .sum::<f64>();
    }
}
