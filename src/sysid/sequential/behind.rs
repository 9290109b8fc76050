//! The search behind the horizon: passes that find the neighbourhood, then clouds of points in it.

use nalgebra::DVector;

use super::follow::{Follower, Freedom};
use super::held::{self, Clouds};
use super::kernel::Kernel;
use super::{Found, SequentialSettings, widest};
use crate::sysid::SysidError;
use crate::sysid::fit::Iteration;

/// Unexplained force of the first pass, as a part of the forces; the least of all; factor after a pass that loses the motion.
const FIRST_FORCE: f64 = 0.01;
const LEAST_FORCE: f64 = 0.004;
const FREER: f64 = 2.0;
/// Factor on forces and on the spread of parameters from pass to pass, and its least part.
const COOL: f64 = 0.7;
const LEAST_SPREAD: f64 = 0.2;
/// Simulations for each chain: of a pass, and of one with parameters held.
const PER_CHAIN: usize = 20;
const PER_CHAIN_HELD: usize = 3;
/// Cost of a pass, in what noise alone costs, from which it does not follow the recordings.
const UNFOLLOWED: f64 = 2.0;
/// Evidence (nats) by which a pass may lie below the best without having lost the motion for a while.
const LOST: f64 = 15.0;
/// Least scatter of passes, as a part of the spread of parameters at the horizon.
const LEAST_SCATTER: f64 = 0.05;

/// What is searched.
pub(super) struct Behind<'a> {
    pub follower: Follower<'a>,
    pub settings: &'a SequentialSettings,
    /// spread of parameters at the horizon
    pub sigma: &'a [f64],
}

impl Behind<'_> {
    /// Improves what is `found`; false if interrupted.
    pub(super) fn find(
        &self,
        found: &mut Found,
        record: &mut dyn FnMut(Iteration) -> bool,
    ) -> Result<bool, SysidError> {
        let weighed = held::suits(found.x.len());
        // clouds need a neighbourhood only
        let passes = if weighed {
            self.settings.passes.div_ceil(2)
        } else {
            self.settings.passes
        };
        let (passed, goes_on) = self.passes(passes, found, record)?;
        let last = if weighed { 0 } else { passed.len() / 2 };
        let passed = &passed[last..];
        if passed.is_empty() {
            return Ok(goes_on);
        }
        let n = passed.len() as f64;
        let mean_of = |of: &dyn Fn(&[f64]) -> f64| passed.iter().map(|x| of(x)).sum::<f64>() / n;
        found.x = (0..self.sigma.len()).map(|j| mean_of(&|x| x[j])).collect();
        if !weighed || !goes_on {
            return Ok(goes_on);
        }
        let scatter: Vec<f64> = (self.sigma.iter().zip(&found.x).enumerate())
            .map(|(j, (sigma, mean))| {
                let square = mean_of(&|x| (x[j] - mean).powi(2));
                square.sqrt().max(LEAST_SCATTER * sigma)
            })
            .collect();
        let near: Vec<f64> = self.sigma.iter().map(|s| LEAST_SPREAD * s).collect();
        let all: Vec<DVector<f64>> = (self.follower.swarm.all.iter())
            .map(|p| DVector::from_column_slice(&p.z[..near.len()]))
            .collect();
        let clouds = Clouds {
            follower: &self.follower,
            freedom: Freedom {
                force: found.level,
                spread: &near,
                held: true,
                n: self.settings.n_chains * PER_CHAIN_HELD,
            },
            known: Kernel::of(&all),
        };
        let mut goes_on = true;
        let held = clouds.least(&found.x, &scatter, &mut |iteration| {
            goes_on = record(iteration);
            goes_on
        })?;
        if let Some(x) = held {
            found.x = x;
        }
        Ok(goes_on)
    }

    /// Parameters after each of the passes that have not lost the motion, and whether they were not interrupted.
    fn passes(
        &self,
        passes: usize,
        found: &mut Found,
        record: &mut dyn FnMut(Iteration) -> bool,
    ) -> Result<(Vec<Vec<f64>>, bool), SysidError> {
        let mut x = found.x.clone();
        let mut spread = self.sigma.to_vec();
        let mut force = FIRST_FORCE;
        let mut all: Vec<(f64, Vec<f64>)> = Vec::new();
        let mut best = f64::NEG_INFINITY;
        let mut goes_on = true;
        for number in 0..passes as u64 {
            if !goes_on {
                break;
            }
            let freedom = Freedom {
                force,
                spread: &spread,
                held: false,
                n: self.settings.n_chains * PER_CHAIN,
            };
            let most = UNFOLLOWED * 0.5 * self.follower.n_samples() as f64;
            let passed = self.follower.pass(number, &x, &freedom)?;
            let Some(passed) = passed.filter(|p| -p.evidence <= most) else {
                force = (force * FREER).min(1.0);
                continue;
            };
            let evidence = passed.evidence;
            best = best.max(evidence);
            goes_on = record(Iteration {
                level: force,
                cost: -evidence,
                damping: 0.0,
                horizon_s: None,
                step: widest(self.follower.problem(), &spread),
                x: passed.x.clone(),
            });
            // a pass that has lost the motion for a while tells nothing of the parameters
            if evidence >= best - LOST {
                x.clone_from(&passed.x);
                all.push((evidence, passed.x));
            }
            found.level = force;
            force = (force * COOL).max(LEAST_FORCE);
            for (s, full) in spread.iter_mut().zip(self.sigma) {
                *s = (*s * COOL).max(LEAST_SPREAD * full);
            }
        }
        all.retain(|(evidence, _)| *evidence >= best - LOST);
        Ok((all.into_iter().map(|(_, x)| x).collect(), goes_on))
    }
}
