//! Behind the horizon: simulations that are pushed a little, and drawn anew block by block.
//!
//! Where the motion is chaotic, no simulation goes on as the recording did, but many that are pushed by small forces,
//! drawn anew by how well they fit, follow it (a particle filter). A pass begins with the swarm at its horizon, drawn
//! near x̄,
//!
//! ```text
//! w ∝ e^(−Σ ((x − x̄)/s)²/2)        x ← x + s √walk ξ as simulations are drawn        x̄ ← mean of x at the end
//! ```
//!
//! and s falls from pass to pass (iterated filtering), as do the forces. Where parameters are held, all simulations have x̄,
//! and x̄ has a log p. Where a block would leave too few, a part of its likelihood is weighed at its beginning, simulations
//! are drawn and moved there, and the block is simulated again.
//!
//! References: Ionides, Nguyen, Atchadé, Stoev, King 2015, "Inference for dynamic and latent variable models via
//! iterated, perturbed Bayes maps"; Liu and West 2001, "Combined parameter and state estimation in simulation-based
//! filtering", for the kernel.

use nalgebra::DVector;
use rayon::prelude::*;

use super::course::Course;
use super::kernel::Kernel;
use super::swarm::{Swarm, counting, draw, log_mean};
use crate::mujoco::Data;
use crate::rng::{self, Purpose};
use crate::sysid::SysidError;
use crate::sysid::problem::Problem;
use crate::sysid::shooting::simulate::{Pool, Simulator};
use crate::sysid::shooting::window::{self, Placed, State, Window};

/// h of the kernel.
const KERNEL: f64 = 0.2;
/// Part of the simulations that has to count for them to go on as they are, and that is left when they are drawn.
const ENOUGH: f64 = 0.5;
const LEAST: f64 = 0.2;
/// Steps of the parameters' walk, as a part of their spread.
const WALK: f64 = 0.1;
/// Times that a block may be simulated again: more, and the motion is lost.
const MOST_PARTS: usize = 30;
/// Steps of a block.
const BLOCK: usize = 10;

/// What passes run over.
pub(super) struct Follower<'a> {
    course: &'a Course<'a>,
    /// where passes begin, and what is drawn from
    pub swarm: &'a Swarm<'a>,
    blocks: Vec<Window>,
    placed: Vec<Vec<Placed>>,
    /// one a trial (knots × nu)
    controls: Vec<Vec<f64>>,
    /// step at which passes begin
    begin: usize,
    /// (nv) size of forces
    force_scale: &'a [f64],
    pool: Pool,
}

/// What a pass gives.
pub(super) struct Passed {
    /// mean of the parameters at the end
    pub x: Vec<f64>,
    /// log p of the samples behind the horizon
    pub evidence: f64,
}

#[derive(Clone)]
struct One {
    /// of every trial
    states: Vec<State>,
    x: Vec<f64>,
    /// log of what it counts
    weight: f64,
}

/// What passes are free to do.
pub(super) struct Freedom<'a> {
    /// unexplained force, as a part of the forces
    pub force: f64,
    /// (parameters) s of the module
    pub spread: &'a [f64],
    /// whether parameters are held: all simulations have x̄
    pub held: bool,
    /// simulations
    pub n: usize,
}

impl<'a> Follower<'a> {
    /// Behind the horizon of `swarm`.
    pub(super) fn new(
        course: &'a Course<'a>,
        swarm: &'a Swarm<'a>,
        x: &[f64],
        force_scale: &'a [f64],
    ) -> Self {
        // a simulation has made a step at least
        let begin = (swarm.horizon.floor() as usize).max(1);
        let mut blocks = Vec::new();
        for whole in &course.windows {
            let mut first = 0;
            while first < whole.last {
                let last = if first < begin { begin } else { first + BLOCK };
                let last = last.min(whole.last);
                blocks.push(Window {
                    trial: whole.trial,
                    first,
                    last,
                    followed: last < whole.last,
                    whole: true,
                });
                first = last;
            }
        }
        Self {
            placed: window::place(course.problem, &blocks, x),
            controls: (course.problem.trials.iter())
                .map(|t| course.problem.controls(t, x))
                .collect(),
            begin,
            course,
            swarm,
            blocks,
            force_scale,
            pool: Pool::default(),
        }
    }

    pub(super) fn problem(&self) -> &Problem {
        self.course.problem
    }

    /// Samples behind the horizon.
    pub(super) fn n_samples(&self) -> usize {
        let blocks = self.blocks.iter().zip(&self.placed);
        let behind = blocks.filter(|(block, _)| block.first >= self.begin);
        behind.map(|(_, placed)| placed.len()).sum()
    }

    /// The nearest parameters to `x` that are looked for.
    pub(super) fn inside(&self, x: &[f64]) -> Vec<f64> {
        let each = x.iter().zip(&self.course.ranges);
        each.map(|(x, (low, high))| x.clamp(*low, *high)).collect()
    }

    /// Simulations at the horizon, near `x`.
    fn begin(
        &self,
        x: &[f64],
        freedom: &Freedom<'_>,
        stream: &dyn Fn(u64) -> rng::Stream,
    ) -> Result<Vec<One>, SysidError> {
        let weights: Vec<f64> = (self.swarm.all.iter())
            .map(|p| {
                let near = p.z.iter().zip(x).zip(freedom.spread);
                near.map(|((z, x), s)| -0.5 * ((z - x) / s).powi(2)).sum()
            })
            .collect();
        let drawn = draw(&weights, rng::uniform(&mut stream(0), 0.0, 1.0));
        let all = (0..freedom.n)
            .into_par_iter()
            .map(|i| {
                let mut z = self.swarm.all[drawn[i * drawn.len() / freedom.n]].z.clone();
                if freedom.held {
                    z[..x.len()].copy_from_slice(x);
                }
                let simulated = self.course.simulate(&z, self.begin)?;
                Ok(simulated.map(|all| One {
                    states: all.into_iter().map(|s| s.end).collect(),
                    x: z[..x.len()].to_vec(),
                    weight: 0.0,
                }))
            })
            .collect::<Result<Vec<Option<One>>, SysidError>>()?;
        Ok(all.into_iter().flatten().collect())
    }

    /// One pass from about `x`; `None` if the motion is lost.
    pub(super) fn pass(
        &self,
        number: u64,
        x: &[f64],
        freedom: &Freedom<'_>,
    ) -> Result<Option<Passed>, SysidError> {
        let seed = self.swarm.seed;
        let mut round = 0;
        let mut streams = || {
            round += 1;
            let iteration = ((number + 1) << 32) + round;
            move |i: u64| rng::stream(seed, Purpose::Swarm, iteration, i)
        };
        let mut all = self.begin(x, freedom, &streams())?;
        let problem = self.course.problem;
        let force_sigma = problem.force_sigma_at(freedom.force, self.force_scale);
        let mut evidence = 0.0;
        for (block, placed) in self.blocks.iter().zip(&self.placed) {
            if block.first < self.begin {
                continue;
            }
            let mut left = 1.0;
            for part in 0.. {
                let stream = streams();
                let moved = (all.par_iter().enumerate())
                    .map(|(i, one)| {
                        self.advance(block, placed, one, &force_sigma, stream(i as u64))
                    })
                    .collect::<Result<Vec<_>, SysidError>>()?;
                let weights = |t: f64| -> Vec<f64> {
                    let both = all.iter().zip(&moved);
                    both.map(|(p, m)| p.weight + t * m.1).collect()
                };
                let n = all.len() as f64;
                let enough = counting(&weights(left)) >= ENOUGH * n;
                let t = if enough {
                    left
                } else {
                    most_of(left, LEAST * n, &weights)
                };
                let each = weights(t);
                if part > MOST_PARTS || counting(&each) == 0.0 {
                    return Ok(None);
                }
                let done = t >= left;
                if done {
                    for (one, (end, _)) in all.iter_mut().zip(moved) {
                        one.states[block.trial] = end;
                    }
                }
                if enough {
                    for (one, weight) in all.iter_mut().zip(each) {
                        one.weight = weight;
                    }
                } else {
                    evidence += log_mean(&each);
                    all = self.draw(&all, &each, freedom, &streams())?;
                }
                if done {
                    break;
                }
                left -= t;
            }
        }
        let rest: Vec<f64> = all.iter().map(|p| p.weight).collect();
        evidence += log_mean(&rest);
        let x = mean(&all);
        Ok(Some(Passed { x, evidence }))
    }

    /// The end of a block for one simulation, and log p of its samples less a constant.
    fn advance(
        &self,
        block: &Window,
        placed: &[Placed],
        one: &One,
        force_sigma: &[f64],
        mut rng: rng::Stream,
    ) -> Result<(State, f64), SysidError> {
        let problem = self.course.problem;
        let force: Vec<f64> = (force_sigma.iter())
            .map(|s| s * rng::normal(&mut rng))
            .collect();
        let free = problem.free_values(&one.x);
        let controls = &self.controls[block.trial];
        let state = &one.states[block.trial];
        Simulator::with(problem, &self.pool, &one.x, |simulator| {
            let push =
                &mut |_: usize, data: &mut Data| data.qfrc_applied_mut().copy_from_slice(&force);
            let Some(simulated) = simulator.run_with(block, state, controls, push)? else {
                return Ok((state.clone(), f64::NEG_INFINITY));
            };
            let samples = &problem.trials[block.trial].samples;
            let predicted = simulated.samples(problem, block, placed);
            let mut fit = 0.0;
            for (p, (z, _)) in placed.iter().zip(predicted) {
                let channel = &problem.channels[samples[p.sample].channel];
                fit -= (self.course).cost(block.trial, p, channel.reading(&free, z));
            }
            Ok((simulated.end, fit))
        })
    }

    /// Simulations drawn by their weights, and moved.
    fn draw(
        &self,
        all: &[One],
        weights: &[f64],
        freedom: &Freedom<'_>,
        stream: &dyn Fn(u64) -> rng::Stream,
    ) -> Result<Vec<One>, SysidError> {
        let problem = self.course.problem;
        let u = rng::uniform(&mut stream(all.len() as u64), 0.0, 1.0);
        let mut drawn: Vec<One> = (draw(weights, u).into_iter())
            .map(|i| One {
                weight: 0.0,
                ..all[i].clone()
            })
            .collect();
        let reference = drawn[0].states.clone();
        let tangents = (drawn.iter())
            .map(|one| {
                let mut z = Vec::new();
                for (state, from) in one.states.iter().zip(&reference) {
                    z.extend(state.minus(from, problem)?);
                }
                z.extend_from_slice(&one.x);
                Ok(DVector::from_vec(z))
            })
            .collect::<Result<Vec<_>, SysidError>>()?;
        let kernel = Kernel::of(&tangents);
        for (i, (one, z)) in drawn.iter_mut().zip(&tangents).enumerate() {
            let mut rng = stream(i as u64);
            let z = kernel.moved(z, KERNEL, &mut rng);
            let (tangent, x) = z.as_slice().split_at(z.len() - one.x.len());
            let each = tangent.chunks_exact(tangent.len() / reference.len());
            for ((state, from), tangent) in one.states.iter_mut().zip(&reference).zip(each) {
                *state = from.moved(problem, tangent)?;
            }
            if freedom.held {
                continue;
            }
            for (j, (own, x)) in one.x.iter_mut().zip(x).enumerate() {
                let step = WALK * freedom.spread[j] * rng::normal(&mut rng);
                let (low, high) = self.course.ranges[j];
                *own = (x + step).clamp(low, high);
            }
        }
        Ok(drawn)
    }
}

/// Mean of the parameters, by the weights.
fn mean(all: &[One]) -> Vec<f64> {
    let weights: Vec<f64> = all.iter().map(|p| p.weight).collect();
    // logs of weights may lie far below what a number holds
    let total = log_mean(&weights) + (weights.len() as f64).ln();
    (0..all[0].x.len())
        .map(|j| all.iter().map(|p| (p.weight - total).exp() * p.x[j]).sum())
        .collect()
}

/// The largest part t up to `left` after which `least` simulations count.
fn most_of(left: f64, least: f64, weights: &dyn Fn(f64) -> Vec<f64>) -> f64 {
    const HALVINGS: usize = 40;
    if counting(&weights(left)) >= least {
        return left;
    }
    let (mut low, mut high) = (0.0, left);
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if counting(&weights(middle)) < least {
            high = middle;
        } else {
            low = middle;
        }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mean_by_weights_of_any_size() {
        let one = |x: f64, weight: f64| One {
            states: Vec::new(),
            x: vec![x],
            weight,
        };
        let found = mean(&[one(1.0, -2000.0), one(5.0, -2000.0 + 3.0_f64.ln())]);
        assert!((found[0] - 4.0).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn a_part_of_a_likelihood_leaves_as_many_as_asked() {
        let mut rng = rng::stream(2, Purpose::Swarm, 0, 0);
        let fits: Vec<f64> = (0..1000)
            .map(|_| -50.0 * rng::normal(&mut rng).powi(2))
            .collect();
        let weights = |t: f64| -> Vec<f64> { fits.iter().map(|f| t * f).collect() };
        let t = most_of(1.0, 500.0, &weights);
        assert!(t < 1.0 && (counting(&weights(t)) - 500.0).abs() < 1.0);
        assert_eq!(most_of(1.0, 2.0, &weights), 1.0);
    }
}
