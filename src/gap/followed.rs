//! Windows simulated exactly: what the model does from a first state, beside what was read.

use std::sync::Arc;

use nalgebra::DVector;

use super::linear::Row;
use super::windows::Windows;
use crate::sysid::SysidError;
use crate::sysid::shooting::columns::Point;
use crate::sysid::shooting::loops::Loops;
use crate::sysid::shooting::simulate::Pool;
use crate::sysid::shooting::window::{State, place};

/// A window simulated exactly.
#[derive(Debug, Clone)]
pub(super) struct Followed {
    pub state: State,
    /// at the last knot
    pub end: State,
    /// (rows) in standard deviations
    pub residual: Vec<f64>,
    /// (rows) as sensors have it
    pub predicted: Vec<f64>,
    /// (knots × nq)
    pub qpos: Vec<f64>,
    pub cost: f64,
    /// samples of the rows
    pub samples: Vec<usize>,
}

impl Windows {
    /// Every window from its first state; nothing if one breaks down.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn simulate(
        &self,
        x: &[f64],
        states: &[State],
    ) -> Result<Option<Vec<Followed>>, SysidError> {
        let followed = self.simulate_some(x, states, &self.all())?;
        Ok(followed.into_iter().collect())
    }

    pub(super) fn simulate_some(
        &self,
        x: &[f64],
        states: &[State],
        some: &[usize],
    ) -> Result<Vec<Option<Followed>>, SysidError> {
        let windows = self.windows();
        let placed = place(&self.problem, &windows, x);
        let pool = Pool::default();
        let mut states = states.to_vec();
        if let Some(mut loops) = Loops::new(&self.problem, x)? {
            for &w in some {
                states[w] = loops.close(&states[w])?;
            }
        }
        let point = Point {
            problem: &self.problem,
            windows: &windows,
            placed: &placed,
            x,
            states: &states,
            free_states: true,
            directions: &[],
            pool: &pool,
        };
        let free = self.problem.free_values(x);
        let simulated = point.simulate_some(some)?;
        let followed = some.iter().zip(simulated).map(|(&w, simulated)| {
            let simulated = simulated?;
            let samples = &self.problem.trials[w].samples;
            let mut cost = 0.0;
            let predicted: Vec<f64> = (simulated.samples(&self.problem, &windows[w], &placed[w]))
                .map(|(z, _)| z)
                .collect();
            let residual = (predicted.iter().zip(&placed[w]))
                .map(|(&z, p)| {
                    let s = &samples[p.sample];
                    let c = &self.problem.channels[s.channel];
                    let r = (c.reading(&free, z) - s.value) / c.sigma_of(s);
                    cost += c.norm.cost(r);
                    r
                })
                .collect();
            Some(Followed {
                state: states[w].clone(),
                end: simulated.end,
                residual,
                predicted,
                qpos: simulated.qpos,
                cost,
                samples: placed[w].iter().map(|p| p.sample).collect(),
            })
        });
        Ok(followed.collect())
    }

    /// Makes readings of what was simulated, without noise.
    pub(super) fn have_recorded(&mut self, followed: &[Followed]) {
        for (trial, followed) in self.problem.trials.iter_mut().zip(followed) {
            let samples = Arc::make_mut(&mut trial.samples);
            for (i, r) in followed.samples.iter().zip(&followed.residual) {
                let sample = &mut samples[*i];
                sample.value += r * self.problem.channels[sample.channel].sigma_of(sample);
            }
        }
    }
}

impl Followed {
    /// (rows) the residual, weighed as `row` is.
    pub(super) fn weighted(&self, row: &Row) -> DVector<f64> {
        let each = self.residual.iter().zip(&row.weight);
        DVector::from_iterator(self.residual.len(), each.map(|(r, w)| r * w))
    }

    /// Whether `row` has as many readings.
    pub(super) fn is_like(&self, row: &Row) -> bool {
        row.weight.len() == self.residual.len()
    }

    /// (rank) Qᵀ r
    pub(super) fn along(&self, row: &Row) -> DVector<f64> {
        row.basis.tr_mul(&self.weighted(row))
    }
}
