//! One step of Gauss-Newton: its cost, the system it solves, and where it leads.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::SysidError;
use super::arrow::Arrow;
use super::box_qp::solve_in_box;
use super::newton::{LEAST_DAMPING, Linear, Solver};
use super::point::Evaluated;

/// Forces (knots × degrees of freedom) of every part of every trial.
pub(super) type Forces = Vec<Vec<Vec<f64>>>;

impl Solver<'_> {
    /// Cost where `evaluated` is what the model says, missing forces by the metric of `linear`.
    pub(super) fn cost(&self, x: &[f64], evaluated: &[Evaluated], linear: &Linear) -> f64 {
        let n_channels = self.problem.channels.len();
        let free = self.problem.free_values(x);
        let mut sum = self.problem.parameters.prior_cost(x);
        for (i, evaluated) in evaluated.iter().enumerate() {
            let islands = &self.islands[i];
            let forces = self.forces(i, evaluated, linear);
            for (island, force) in islands.parts.iter().zip(&forces) {
                for row in force.chunks_exact(island.dofs.len()) {
                    for (f, d) in row.iter().zip(&island.dofs) {
                        sum += self.problem.force_norm[*d].cost(f / self.force_sigma[*d]);
                    }
                }
            }
            let mut counts = vec![false; n_channels];
            for c in islands.parts.iter().flat_map(|p| &p.channels) {
                counts[*c] = true;
            }
            for p in self.placed(i, x) {
                let s = &self.problem.trials[i].samples[p.sample];
                if !counts[s.channel] {
                    continue;
                }
                let channel = &self.problem.channels[s.channel];
                let mut z = evaluated.sensors[p.knot * n_channels + s.channel];
                if p.part > 0.0 {
                    z += p.part * (evaluated.sensors[(p.knot + 1) * n_channels + s.channel] - z);
                }
                let predicted = channel.reading(&free, z);
                sum += channel
                    .norm
                    .cost((predicted - s.value) / channel.sigma_of(s));
            }
        }
        sum
    }

    /// Missing forces of the parts of a trial.
    fn forces(&self, trial: usize, evaluated: &Evaluated, linear: &Linear) -> Vec<Vec<f64>> {
        let nv = self.problem.model.nv();
        (self.islands[trial].parts.iter().zip(&linear[trial]))
            .map(|(island, blocks)| {
                let mut out = vec![0.0; evaluated.kinematics.len() * island.dofs.len()];
                let knots = evaluated.defect.chunks_exact(nv).enumerate();
                for ((k, defect), out) in knots.zip(out.chunks_exact_mut(island.dofs.len())) {
                    blocks.force(island, k, defect, out);
                }
                out
            })
            .collect()
    }

    /// Values that forces would have had to have here for the step to `evaluated` to be as foreseen.
    pub(super) fn corrected(
        &self,
        linear: &Linear,
        changes: &[Vec<f64>],
        dx: &[f64],
        evaluated: &[Evaluated],
    ) -> Forces {
        let nv = self.problem.model.nv();
        (evaluated.iter().enumerate())
            .map(|(trial, evaluated)| {
                let change = &changes[trial];
                let mut forces = self.forces(trial, evaluated, linear);
                let last = evaluated.kinematics.len() - 1;
                for (part, force) in forces.iter_mut().enumerate() {
                    let island = &self.islands[trial].parts[part];
                    let (n, blocks) = (island.dofs.len(), &linear[trial][part]);
                    for k in 1..last {
                        for (i, f) in force[k * n..(k + 1) * n].iter_mut().enumerate() {
                            let row = blocks.row(k, i);
                            for (block, knot) in (k - 1..=k + 1).enumerate() {
                                for (c, d) in island.dofs.iter().enumerate() {
                                    *f -= row[block * n + c] * change[knot * nv + d];
                                }
                            }
                            for (c, j) in island.parameters.iter().enumerate() {
                                *f -= row[3 * n + c] * dx[*j];
                            }
                        }
                    }
                }
                forces
            })
            .collect()
    }

    /// All parts of all trajectories eliminated, with `found` in place of the values of forces.
    pub(super) fn eliminate_all(
        &self,
        linear: &Linear,
        damping: f64,
        found: Option<&Forces>,
    ) -> Vec<Vec<Arrow>> {
        (linear.par_iter().enumerate())
            .map(|(trial, parts)| {
                let placed = self.placed(trial, &self.x);
                (parts.par_iter().enumerate())
                    .map(|(part, blocks)| {
                        let island = &self.islands[trial].parts[part];
                        let found = found.map(|f| f[trial][part].as_slice());
                        self.eliminate(trial, island, blocks, &placed, damping, found)
                    })
                    .collect()
            })
            .collect()
    }

    /// The step at a damping: eliminated trajectories, the change of the parameters within their bounds, and the cost
    /// that is foreseen.
    pub(super) fn step(
        &self,
        linear: &Linear,
        damping: f64,
        found: Option<&Forces>,
    ) -> (Vec<Vec<Arrow>>, Vec<f64>, f64) {
        let arrows = self.eliminate_all(linear, damping, found);
        let (normal, right) = self.normal(&arrows, damping);
        let reach = self.problem.parameters.reach(&self.x);
        let (low, high): (Vec<f64>, Vec<f64>) = reach
            .map(|(l, h)| if self.hold { (0.0, 0.0) } else { (l, h) })
            .unzip();
        let dx = solve_in_box(&normal, &right, &low, &high);
        let x: Vec<f64> = self.x.iter().zip(&dx).map(|(x, d)| x + d).collect();
        let mut foreseen = self.problem.parameters.prior_cost(&x);
        for (arrow, own) in self.with_parameters(&arrows) {
            for row in arrow.innovations.chunks_exact(own.len() + 1) {
                let moved: f64 = own.iter().zip(row).map(|(j, s)| s * dx[*j]).sum();
                foreseen += 0.5 * (row[own.len()] - moved).powi(2);
            }
        }
        (arrows, dx, foreseen)
    }

    /// Normal equations of the parameters.
    pub(super) fn normal(
        &self,
        arrows: &[Vec<Arrow>],
        damping: f64,
    ) -> (DMatrix<f64>, DVector<f64>) {
        let np = self.x.len();
        let mut normal = DMatrix::zeros(np, np);
        let mut right = DVector::zeros(np);
        for (arrow, own) in self.with_parameters(arrows) {
            for row in arrow.innovations.chunks_exact(own.len() + 1) {
                for (a, &i) in own.iter().enumerate() {
                    right[i] += row[a] * row[own.len()];
                    for (b, &j) in own.iter().enumerate() {
                        normal[(i, j)] += row[a] * row[b];
                    }
                }
            }
        }
        let parameters = &self.problem.parameters;
        let priors = parameters.prior_slopes(&self.x);
        for (i, (p, (precision, slope))) in parameters.iter_free().zip(priors).enumerate() {
            normal[(i, i)] += damping / p.typical.powi(2);
            normal[(i, i)] += precision;
            right[i] -= slope;
        }
        (normal, right)
    }

    /// Information on the parameters, and the step without damping.
    pub(super) fn undamped(&self, linear: &Linear) -> (DMatrix<f64>, Vec<f64>) {
        let (arrows, dx, _) = self.step(linear, LEAST_DAMPING, None);
        (self.normal(&arrows, LEAST_DAMPING).0, dx)
    }

    /// Every arrow with the free parameters of its border.
    fn with_parameters<'b>(
        &'b self,
        arrows: &'b [Vec<Arrow>],
    ) -> impl Iterator<Item = (&'b Arrow, &'b [usize])> {
        (arrows.iter().zip(&self.islands)).flat_map(|(arrows, islands)| {
            (arrows.iter().zip(&islands.parts)).map(|(a, i)| (a, i.parameters.as_slice()))
        })
    }

    /// Changes of all trajectories (knots × nv).
    pub(super) fn changes(&self, arrows: &[Vec<Arrow>], dx: &[f64]) -> Vec<Vec<f64>> {
        let nv = self.problem.model.nv();
        (arrows.iter().zip(&self.islands).zip(&self.problem.trials))
            .map(|((arrows, islands), trial)| {
                let mut out = vec![0.0; trial.n_knots * nv];
                for (arrow, island) in arrows.iter().zip(&islands.parts) {
                    let own: Vec<f64> = island.parameters.iter().map(|j| dx[*j]).collect();
                    let change = arrow.back_substitute(&own);
                    let knots = change.chunks_exact(island.dofs.len());
                    for (out, change) in out.chunks_exact_mut(nv).zip(knots) {
                        if change.iter().all(|c| c.is_finite()) {
                            for (d, c) in island.dofs.iter().zip(change) {
                                out[*d] = *c;
                            }
                        }
                    }
                }
                out
            })
            .collect()
    }

    pub(super) fn moved(&self, changes: &[Vec<f64>]) -> Result<Vec<Vec<f64>>, SysidError> {
        let model = &self.problem.model;
        let (nq, nv) = (model.nq(), model.nv());
        let mut out = self.trajectories.clone();
        for (change, qpos) in changes.iter().zip(&mut out) {
            for (q, d) in qpos
                .chunks_exact_mut(nq.max(1))
                .zip(change.chunks_exact(nv.max(1)))
            {
                model.integrate_pos(q, d, 1.0)?;
            }
        }
        Ok(out)
    }
}
