//! The parameters under which the samples are most likely, by following every trial (see `track`).
//!
//! At each level of unexplained force Gauss-Newton steps are taken; the likelihood then says whether a lower level
//! explains the samples better. Where contacts make the motion chaotic the likelihood is rough, however small the
//! step: steps that lose less than the roughness are taken, and the estimate is the mean of where the last ones
//! pointed to.
//!
//! Signals much finer than the motion is known at first would lead the filter astray: their noise starts as a part of
//! the signal's range and falls, as long as the likelihood grows.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::SysidError;
use super::box_qp::solve_in_box;
use super::fit::{Iteration, Status};
use super::problem::Problem;
use super::start::Belief;
use super::track::{Followed, Following, follow};

/// First noise of a signal as a part of its range, at the least.
const FIRST_NOISE: f64 = 2e-3;
/// Factor by which it falls.
const FINER: f64 = 0.2;
/// Highest level at which a trial is followed.
const FIRST_LEVEL: f64 = 1.0;
/// Levels taken before the noise of signals falls.
const BEFORE_FINER: f64 = 0.1;
/// Loss of likelihood a sample (nats) that counts as roughness.
const ROUGH: f64 = 5e-3;
/// Loss of likelihood a sample (nats) that shows that the motion is lost.
const LOST: f64 = 2e-2;
/// Gain of a step (nats) below which it need not be taken.
const NO_GAIN: f64 = 0.05;
/// Gain of likelihood (nats) for which a lower level or a finer noise is taken.
const WORTH: f64 = 2.0;
/// Steps at a level.
const STEPS: usize = 4;
/// Steps that a finer noise has to last without losing the motion.
const FINER_STEPS: usize = 8;
/// Steps at the last level.
const LAST_STEPS: usize = 16;
/// Steps whose targets are averaged.
const AVERAGED: usize = 12;
/// How often steps are taken once more where a finer noise loses the motion.
const SETTLING: usize = 3;

/// The trials with what is known of where they begin.
pub(super) struct Likelihood<'a> {
    pub problem: &'a Problem,
    /// (nv) size of forces
    pub force_scale: &'a [f64],
    /// one a trial
    pub beliefs: &'a [Belief],
}

/// Where the search stands.
#[derive(Debug, Clone)]
pub(super) struct Found {
    pub x: Vec<f64>,
    pub level: f64,
    /// noise of signals as a part of their range, at the least
    pub noise: f64,
    pub nll: f64,
    pub status: Status,
}

/// All trials followed at some parameters.
struct Pass {
    nll: f64,
    n: usize,
    normal: DMatrix<f64>,
    right: DVector<f64>,
}

impl Likelihood<'_> {
    /// Standard deviations of channels at least `noise` times their range.
    pub(super) fn channel_sigma(&self, noise: f64) -> Vec<f64> {
        let ranges = self.problem.channel_ranges();
        (self.problem.channels.iter().zip(ranges))
            .map(|(c, range)| c.sigma.max(noise * range))
            .collect()
    }

    /// Every trial followed, from `x`; `None` if one is lost.
    pub(super) fn follow(
        &self,
        x: &[f64],
        level: f64,
        noise: f64,
        smooth: bool,
    ) -> Result<Option<Vec<Followed>>, SysidError> {
        let force_sigma = self.problem.force_sigma_at(level, self.force_scale);
        let channel_sigma = self.channel_sigma(noise);
        let following = Following {
            force_sigma: &force_sigma,
            channel_sigma: &channel_sigma,
            smooth,
        };
        let all: Vec<Result<Option<Followed>, SysidError>> = (self.beliefs.par_iter().enumerate())
            .map(|(trial, belief)| follow(self.problem, trial, x, belief, following))
            .collect();
        all.into_iter().collect()
    }

    fn pass(&self, x: &[f64], level: f64, noise: f64) -> Result<Option<Pass>, SysidError> {
        let Some(followed) = self.follow(x, level, noise, false)? else {
            return Ok(None);
        };
        let np = x.len();
        let mut pass = Pass {
            nll: 0.0,
            n: 0,
            normal: DMatrix::zeros(np, np),
            right: DVector::zeros(np),
        };
        for f in &followed {
            pass.nll += f.nll;
            pass.n += f.knots.len();
            for row in f.innovations.chunks_exact(np + 1) {
                for i in 0..np {
                    pass.right[i] += row[i] * row[np];
                    for j in 0..np {
                        pass.normal[(i, j)] += row[i] * row[j];
                    }
                }
            }
        }
        pass.nll += self.problem.parameters.prior_cost(x);
        for (i, (precision, slope)) in (self.problem.parameters.prior_slopes(x)).enumerate() {
            pass.normal[(i, i)] += precision;
            pass.right[i] -= slope;
        }
        Ok(Some(pass))
    }

    /// Gauss-Newton step from `x`, damped in the units of the information itself.
    fn step(&self, x: &[f64], pass: &Pass, damping: f64) -> Vec<f64> {
        let mut normal = pass.normal.clone();
        for (i, p) in self.problem.parameters.iter_free().enumerate() {
            normal[(i, i)] *= 1.0 + damping;
            // what the samples do not tell stays
            normal[(i, i)] += 1e-6 / p.typical.powi(2);
        }
        let (low, high): (Vec<f64>, Vec<f64>) = self.problem.parameters.reach(x).unzip();
        solve_in_box(&normal, &pass.right, &low, &high)
    }

    /// Steps at one level, `limit` at the most; `None` if the simulation is lost from the start, or the likelihood there
    /// is not `below`: a filter that trusts the model more than it may loses the motion.
    fn climb(
        &self,
        from: &[f64],
        level: f64,
        noise: f64,
        (limit, below): (usize, f64),
        watch: &mut dyn FnMut(&Iteration) -> bool,
    ) -> Result<Option<Found>, SysidError> {
        let mut x = from.to_vec();
        let mut damping = 0.0;
        let mut best: Option<(Vec<f64>, Pass)> = None;
        let mut targets: Vec<Vec<f64>> = Vec::new();
        let (mut rough, mut before) = (false, f64::INFINITY);
        let mut status = Status::MaxIterations;
        let rough_nats = if below.is_finite() { LOST } else { ROUGH };
        for _ in 0..limit {
            let pass = self.pass(&x, level, noise)?;
            let worse = |p: &Pass| {
                best.as_ref()
                    .is_some_and(|(_, b)| p.nll > b.nll + rough_nats * b.n as f64)
            };
            let lost = |p: &Pass| best.is_none() && p.nll > below;
            let Some(pass) = pass.filter(|p| !worse(p) && !lost(p)) else {
                // where finer is tried, a step that does not do what it promised is a sign of it, too
                let Some((at, pass)) = best.as_ref().filter(|_| below.is_infinite()) else {
                    return Ok(None);
                };
                damping = if damping == 0.0 { 1.0 } else { 10.0 * damping };
                x = sum(at, &self.step(at, pass, damping));
                continue;
            };
            let dx = self.step(&x, &pass, 0.0);
            let gain: f64 = pass.right.iter().zip(&dx).map(|(b, d)| 0.5 * b * d).sum();
            targets.push(sum(&x, &dx));
            rough |= pass.nll > before + NO_GAIN;
            before = pass.nll;
            let step = dx.iter().fold(0.0_f64, |m, d| m.max(d.abs()));
            let go_on = watch(&Iteration {
                level,
                cost: pass.nll,
                damping,
                horizon_s: None,
                step,
                x: x.clone(),
            });
            let next = targets[targets.len() - 1].clone();
            if best.as_ref().is_none_or(|(_, b)| pass.nll < b.nll) {
                best = Some((x, pass));
            }
            damping = 0.0;
            x = next;
            if !go_on || (gain < NO_GAIN && !rough) {
                status = if go_on {
                    Status::Converged
                } else {
                    Status::Interrupted
                };
                break;
            }
        }
        let Some((at, pass)) = best else {
            return Ok(None);
        };
        let last = &targets[targets.len().saturating_sub(AVERAGED)..];
        let x = match status {
            Status::Interrupted => at,
            _ => (0..from.len())
                .map(|i| last.iter().map(|t| t[i]).sum::<f64>() / last.len() as f64)
                .collect(),
        };
        Ok(Some(Found {
            x,
            level,
            noise,
            nll: pass.nll,
            status,
        }))
    }

    /// Searches from `x` down the `levels`, as long as the likelihood grows.
    pub(super) fn search(
        &self,
        x: &[f64],
        levels: &[f64],
        by_evidence: bool,
        watch: &mut dyn FnMut(&Iteration) -> bool,
    ) -> Result<Option<Found>, SysidError> {
        let (&last, _) = levels.split_last().unwrap_or((&FIRST_LEVEL, &[]));
        if !by_evidence {
            return self.climb(x, last, self.finest(), (LAST_STEPS, f64::INFINITY), watch);
        }
        let levels: Vec<f64> = levels
            .iter()
            .copied()
            .filter(|l| *l <= FIRST_LEVEL.max(last))
            .collect();
        let finest = self.finest();
        let mut best: Option<Found> = None;
        let mut at = x.to_vec();
        let mut noise = FIRST_NOISE;
        let mut lower = levels.iter().copied().peekable();
        let better = |new: &Found, best: &Option<Found>| {
            best.as_ref().is_none_or(|b| new.nll < b.nll - WORTH)
        };
        // down to where signals may be taken as fine as they are
        while let Some(level) = lower.next_if(|l| *l >= BEFORE_FINER * 0.999) {
            let Some(found) = self.climb(&at, level, noise, (STEPS, f64::INFINITY), watch)? else {
                continue;
            };
            at.clone_from(&found.x);
            if found.status == Status::Interrupted {
                return Ok(Some(found));
            }
            if better(&found, &best) {
                best = Some(found);
            }
        }
        let Some(mut best) = best else {
            return Ok(None);
        };
        let mut settled = 0;
        while noise > finest {
            let found = self.climb(
                &best.x,
                best.level,
                noise * FINER,
                (FINER_STEPS, best.nll),
                watch,
            )?;
            match found.filter(|f| f.nll < best.nll - WORTH) {
                Some(found) => {
                    best = found;
                    noise *= FINER;
                    settled = 0;
                }
                // perhaps it was not near enough yet
                None if settled < SETTLING => {
                    let found = self.climb(
                        &best.x,
                        best.level,
                        noise,
                        (LAST_STEPS, f64::INFINITY),
                        watch,
                    )?;
                    best = found.unwrap_or(best);
                    settled += 1;
                }
                None => break,
            }
            if best.status == Status::Interrupted {
                return Ok(Some(best));
            }
        }
        for level in lower {
            let found = self.climb(&best.x, level, best.noise, (STEPS, best.nll), watch)?;
            let Some(found) = found.filter(|f| f.nll < best.nll - WORTH) else {
                break;
            };
            best = found;
            if best.status == Status::Interrupted {
                return Ok(Some(best));
            }
        }
        let last = self.climb(
            &best.x,
            best.level,
            best.noise,
            (LAST_STEPS, f64::INFINITY),
            watch,
        )?;
        Ok(Some(last.unwrap_or(best)))
    }

    /// Part of the range that the finest signal's own noise is.
    fn finest(&self) -> f64 {
        let ranges = self.problem.channel_ranges();
        let parts = self
            .problem
            .channels
            .iter()
            .zip(ranges)
            .filter(|(_, r)| *r > 0.0)
            .map(|(c, r)| c.sigma / r);
        parts.fold(f64::INFINITY, f64::min)
    }
}

fn sum(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a + b).collect()
}
