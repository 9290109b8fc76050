//! Whitened rows of the linearised problem, knot by knot, into the elimination.

use super::arrow::Arrow;
use super::islands::Island;
use super::linearise::Blocks;
use super::newton::Solver;
use super::problem::{Setting, Stage};

/// Change of a position that the damping resists like one of the parameters' typical changes, rad or m.
const TYPICAL_POSITION: f64 = 0.01;

/// A sensor sample on the grid: between knots k and k + 1.
pub(super) struct Placed {
    pub knot: usize,
    pub part: f64,
    pub sample: usize,
}

impl Solver<'_> {
    /// Samples of a trial on the grid, in the order of knots.
    pub(super) fn placed(&self, trial: usize, x: &[f64]) -> Vec<Placed> {
        let h = self.problem.model.timestep();
        let free = self.problem.free_values(x);
        let trial = &self.problem.trials[trial];
        let last = trial.n_knots - 1;
        let mut placed: Vec<Placed> = (trial.samples.iter().enumerate())
            .filter_map(|(sample, s)| {
                let channel = &self.problem.channels[s.channel];
                let (low, high): (usize, usize) = match channel.stage {
                    Stage::Position => (0, last),
                    Stage::Velocity => (1, last),
                    Stage::Acceleration => (1, last - 1),
                };
                let at = s.time / h;
                if at < low as f64 - 1e-4 || at > high as f64 + 1e-4 {
                    return None;
                }
                let at = ((s.time - channel.delay.value(&free)) / h).clamp(low as f64, high as f64);
                let mut knot = (at + 1e-4).floor() as usize;
                let mut part = at - knot as f64;
                if channel.stage == Stage::Acceleration || part < 1e-4 || knot == high {
                    // forces are held over a step; stamps are rounded
                    (knot, part) = (knot.min(high), 0.0);
                }
                Some(Placed { knot, part, sample })
            })
            .collect();
        placed.sort_by_key(|p| p.knot);
        placed
    }

    /// A part of a trajectory eliminated, with `found` (knots × degrees of freedom) in place of the values of forces.
    pub(super) fn eliminate(
        &self,
        trial: usize,
        island: &Island,
        blocks: &Blocks,
        placed: &[Placed],
        damping: f64,
        found: Option<&[f64]>,
    ) -> Arrow {
        let (nv, np) = (island.dofs.len(), island.parameters.len());
        let free = self.problem.free_values(&self.x);
        let trial = &self.problem.trials[trial];
        let h = self.problem.model.timestep();
        let width = island.width();
        let resist = damping.sqrt() / TYPICAL_POSITION;
        let mut row_of = vec![None; self.problem.channels.len()];
        for (i, c) in island.channels.iter().enumerate() {
            row_of[*c] = Some(nv + i);
        }
        let mut arrow = Arrow::new(nv, np);
        let mut next = 0;
        for k in 0..trial.n_knots {
            if k > 0 && k + 1 < trial.n_knots {
                for (i, dof) in island.dofs.iter().enumerate() {
                    let (sigma, norm) = (self.force_sigma[*dof], self.problem.force_norm[*dof]);
                    let source = blocks.row(k, i);
                    let value = found.map_or(source[width - 1], |f| f[k * nv + i]);
                    let factor = norm.weight(value / sigma).sqrt() / sigma;
                    let row = arrow.row();
                    for (row, s) in row.iter_mut().zip(source) {
                        *row = factor * s;
                    }
                    row[width - 1] = -factor * value;
                }
            }
            while next < placed.len() && placed[next].knot == k {
                let Placed { part, sample, .. } = placed[next];
                next += 1;
                let s = &trial.samples[sample];
                let Some(source) = row_of[s.channel] else {
                    continue;
                };
                let channel = &self.problem.channels[s.channel];
                let (gain, bias) = (channel.gain.value(&free), channel.bias.value(&free));
                let here = blocks.row(k, source);
                let row = arrow.row();
                row.copy_from_slice(here);
                let mut slope = 0.0;
                if part > 0.0 {
                    let there = blocks.row(k + 1, source);
                    slope = (there[width - 1] - here[width - 1]) / h;
                    for v in row.iter_mut() {
                        *v *= 1.0 - part;
                    }
                    // the window of knot k + 1 stands one block to the right
                    for (v, t) in row[nv..3 * nv].iter_mut().zip(&there[..2 * nv]) {
                        *v += part * t;
                    }
                    for (v, t) in row[3 * nv..].iter_mut().zip(&there[3 * nv..]) {
                        *v += part * t;
                    }
                } else if k + 1 < trial.n_knots && channel.stage != Stage::Acceleration {
                    slope = (blocks.row(k + 1, source)[width - 1] - here[width - 1]) / h;
                }
                let z = row[width - 1];
                let sigma = channel.sigma_of(s);
                let r = (gain * z + bias - s.value) / sigma;
                let factor = channel.norm.weight(r).sqrt() / sigma;
                for v in row.iter_mut() {
                    *v *= factor * gain;
                }
                for (setting, derivative) in [
                    (channel.bias, 1.0),
                    (channel.gain, z),
                    (channel.delay, -gain * slope),
                ] {
                    if let Setting::Free(j) = setting {
                        // whoever has the channel has its parameters
                        let own = island.parameters.iter().position(|p| *p == j);
                        if let Some(own) = own {
                            row[3 * nv + own] +=
                                factor * derivative * self.problem.parameters.slope(j, free[j]);
                        }
                    }
                }
                row[width - 1] = -factor * (gain * z + bias - s.value);
            }
            for i in 0..nv {
                let row = arrow.row();
                row[nv + i] = resist;
            }
            arrow.close(k);
        }
        arrow.finish(trial.n_knots);
        arrow
    }
}
