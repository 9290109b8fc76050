//! Simulations that are drawn by how well they fit, and moved so that they do not become copies.
//!
//! With ℓ(z, τ) the cost of the samples up to the horizon τ (in steps; within one, in proportion) and π the prior,
//! simulations are drawn from p(z | τ) ∝ π e^(−ℓ(z, τ)): from one horizon to the next with weights
//! e^(ℓ(z, τ) − ℓ(z, τ′)), few of them, each of which goes on as a chain of moves that keep p,
//!
//! ```text
//! z → z + γ (z_a − z_b)        a, b drawn by the weights, log γ ~ N(log scale, 0.7²)
//! ```
//!
//! and all links of all chains are the next swarm. Chains become longer where they no longer forget their beginnings,
//! which a swarm of single simulations could not tell: where its moves are too few, it contracts beside the truth.
//! Moves are not made as short as would let a quarter of them be taken: where p is rough, long ones that are hardly ever
//! taken lead farther.
//!
//! References: Chopin 2002, "A sequential particle filter method for static models"; Dau and Chopin 2022, "Waste-free
//! sequential Monte Carlo"; ter Braak 2006, "A Markov chain Monte Carlo version of the genetic algorithm Differential
//! Evolution".

use rayon::prelude::*;

use super::course::Course;
use crate::rng::{self, Purpose};
use crate::sysid::SysidError;

/// Part of the simulations that still counts at the next horizon.
const COUNTING: f64 = 0.5;
/// Links of a chain: at first, at least, at most.
const LINKS: usize = 20;
const FEWEST_LINKS: usize = 10;
const MOST_LINKS: usize = 80;
/// Stirring below which chains become longer, and above which shorter.
const LITTLE: f64 = 0.35;
const MUCH: f64 = 0.8;
/// Part of the moves that should be taken.
const TAKEN: f64 = 0.15;
/// Bounds of the scale of moves.
const SCALES: [f64; 2] = [0.3, 1.0];
/// Standard deviation of the logarithm of γ.
const VARIED: f64 = 0.7;

/// One simulation.
#[derive(Debug, Clone)]
pub(super) struct Particle {
    pub z: Vec<f64>,
    prior: f64,
    /// step of the first number of `costs`
    first: usize,
    /// see [`Course::costs`]; infinite ones where it diverges
    costs: Vec<f64>,
}

impl Particle {
    /// With costs from step `first` to step `last`.
    fn new(
        course: &Course<'_>,
        z: Vec<f64>,
        (first, last): (usize, usize),
    ) -> Result<Self, SysidError> {
        let prior = course.prior(&z);
        let costs = if prior.is_finite() {
            course.costs(&z, last)?.map(|mut all| all.split_off(first))
        } else {
            None
        };
        Ok(Self {
            costs: costs.unwrap_or_else(|| vec![f64::INFINITY; last + 1 - first]),
            z,
            prior,
            first,
        })
    }

    /// Step up to which it is simulated.
    fn last(&self) -> usize {
        self.first + self.costs.len() - 1
    }

    /// ℓ at a horizon.
    fn cost(&self, horizon: f64) -> f64 {
        let k = (horizon.floor() as usize).min(self.last());
        let here = self.costs[k - self.first];
        let next = self.costs[(k + 1).min(self.last()) - self.first];
        let part = horizon - k as f64;
        if part > 0.0 && next.is_finite() {
            here + part * (next - here)
        } else {
            here
        }
    }
}

/// All simulations.
#[derive(Clone)]
pub(super) struct Swarm<'a> {
    course: &'a Course<'a>,
    pub all: Vec<Particle>,
    /// steps
    pub horizon: f64,
    /// log of the probability of the samples so far, less a constant
    pub evidence: f64,
    n_chains: usize,
    n_links: usize,
    /// of moves
    scale: f64,
    pub seed: u64,
    round: u64,
}

/// What one chain comes to.
struct Chain {
    all: Vec<Particle>,
    /// moves that were taken
    taken: usize,
}

impl<'a> Swarm<'a> {
    /// `n_chains` times some simulations drawn from the prior.
    pub(super) fn new(course: &'a Course<'a>, n_chains: usize, seed: u64) -> Self {
        let free: Vec<_> = course.problem.parameters.iter_free().collect();
        let draw = |i: usize| {
            let mut rng = rng::stream(seed, Purpose::Swarm, 0, i as u64);
            let mut z: Vec<f64> = (free.iter().zip(&course.ranges))
                .map(|(p, range)| {
                    if p.has_prior() {
                        let x = p.to_x(p.prior) + p.prior_sigma * rng::normal(&mut rng);
                        x.clamp(range.0, range.1)
                    } else {
                        rng::uniform(&mut rng, range.0, range.1)
                    }
                })
                .collect();
            z.resize_with(course.len(), || rng::normal(&mut rng));
            Particle {
                prior: course.prior(&z),
                z,
                first: 0,
                costs: vec![0.0],
            }
        };
        Self {
            course,
            all: (0..n_chains * LINKS).map(draw).collect(),
            horizon: 0.0,
            evidence: 0.0,
            n_chains,
            n_links: LINKS,
            // as long as serves a normal distribution best
            scale: (2.38 / (2.0 * course.len().max(1) as f64).sqrt()).clamp(SCALES[0], SCALES[1]),
            seed,
            round: 0,
        }
    }

    /// Simulates everything up to `steps` at least.
    pub(super) fn extend(&mut self, steps: usize) -> Result<(), SysidError> {
        let (course, first) = (self.course, self.horizon.floor() as usize);
        let short = self.all.par_iter_mut().filter(|p| p.last() < steps);
        short.try_for_each(|p| {
            *p = Particle::new(course, std::mem::take(&mut p.z), (first, steps))?;
            Ok(())
        })
    }

    /// Logs of weights at a horizon.
    fn weights(&self, horizon: f64) -> Vec<f64> {
        let own = |p: &Particle| {
            let change = p.cost(self.horizon) - p.cost(horizon);
            if change.is_nan() {
                f64::NEG_INFINITY
            } else {
                change
            }
        };
        self.all.iter().map(own).collect()
    }

    /// The farthest horizon up to `steps` at which enough simulations count; all are simulated up to there.
    pub(super) fn farthest(&self, steps: usize) -> f64 {
        let enough =
            |horizon: f64| counting(&self.weights(horizon)) >= COUNTING * self.all.len() as f64;
        let first = self.horizon.floor() as usize + 1;
        let Some(bad) = (first..=steps).find(|&k| !enough(k as f64)) else {
            return steps as f64;
        };
        let (mut good, mut bad) = (self.horizon.max(bad as f64 - 1.0), bad as f64);
        for _ in 0..40 {
            let middle = 0.5 * (good + bad);
            if enough(middle) {
                good = middle;
            } else {
                bad = middle;
            }
        }
        good.max(self.horizon + 1e-9)
    }

    /// Draws simulations for a new horizon, and moves them; new ones are simulated up to `steps`. Gives how well they are
    /// stirred: 1 where chains have forgotten their beginnings, 0 where they stand still.
    pub(super) fn advance(&mut self, horizon: f64, steps: usize) -> Result<f64, SysidError> {
        let weights = self.weights(horizon);
        self.evidence += log_mean(&weights);
        self.horizon = horizon;
        self.round += 1;
        let mut rng = rng::stream(self.seed, Purpose::Swarm, self.round, u64::MAX);
        let drawn = draw(&weights, rng::uniform(&mut rng, 0.0, 1.0));
        let here = &*self;
        let chains = (0..self.n_chains)
            .into_par_iter()
            .map(|i| {
                let mut rng = rng::stream(here.seed, Purpose::Swarm, here.round, i as u64);
                let first = drawn[i * drawn.len() / here.n_chains];
                here.chain(first, &drawn, steps, &mut rng)
            })
            .collect::<Result<Vec<_>, SysidError>>()?;
        let stirred = stirred(&chains, self.course.len());
        let taken: usize = chains.iter().map(|c| c.taken).sum();
        let tried = self.n_chains * (self.n_links - 1);
        let factor = (taken as f64 / tried as f64 / TAKEN).clamp(0.5, 2.0);
        self.scale = (self.scale * factor).clamp(SCALES[0], SCALES[1]);
        if stirred < LITTLE {
            self.n_links = (self.n_links * 3 / 2).min(MOST_LINKS);
        } else if stirred > MUCH {
            self.n_links = (self.n_links * 2 / 3).max(FEWEST_LINKS);
        }
        self.all = chains.into_iter().flat_map(|c| c.all).collect();
        Ok(stirred)
    }

    /// Whether chains are as long as they may be.
    pub(super) fn is_longest(&self) -> bool {
        self.n_links >= MOST_LINKS
    }

    /// Returns to what it was, with the moves it has learned to make.
    pub(super) fn go_back(&mut self, before: Self) {
        let (n_links, scale, round) = (self.n_links, self.scale, self.round);
        *self = Self {
            n_links,
            scale,
            round,
            ..before
        };
    }

    /// Moves from simulation `first` on, by differences of those that were `drawn`.
    fn chain(
        &self,
        first: usize,
        drawn: &[usize],
        steps: usize,
        rng: &mut rng::Stream,
    ) -> Result<Chain, SysidError> {
        let span = (self.horizon.floor() as usize, steps);
        let mut here = self.all[first].clone();
        let mut chain = Chain {
            all: vec![here.clone()],
            taken: 0,
        };
        for _ in 1..self.n_links {
            let mut pick = || {
                let i = rng::uniform(rng, 0.0, drawn.len() as f64) as usize;
                &self.all[drawn[i.min(drawn.len() - 1)]].z
            };
            let (mut a, mut b) = (pick(), pick());
            for _ in 0..10 {
                if a != b {
                    break;
                }
                (a, b) = (pick(), pick());
            }
            let length = self.scale * (VARIED * rng::normal(rng)).exp();
            let z: Vec<f64> = (here.z.iter().zip(a.iter().zip(b)))
                .map(|(z, (a, b))| z + length * (a - b))
                .collect();
            let new = Particle::new(self.course, z, span)?;
            let of = |p: &Particle| p.prior + p.cost(self.horizon);
            // false where the new one is impossible
            if rng::uniform(rng, 0.0, 1.0).ln() < of(&here) - of(&new) {
                here = new;
                chain.taken += 1;
            }
            chain.all.push(here.clone());
        }
        Ok(chain)
    }

    /// The simulation that costs least, its prior included.
    pub(super) fn best(&self) -> (&Particle, f64) {
        let cost = |p: &Particle| p.prior + p.cost(self.horizon);
        let mut best = &self.all[0];
        for p in &self.all {
            if cost(p) < cost(best) {
                best = p;
            }
        }
        (best, cost(best))
    }

    /// Least cost of samples.
    pub(super) fn least(&self) -> f64 {
        let costs = self.all.iter().map(|p| p.cost(self.horizon));
        costs.fold(f64::INFINITY, f64::min)
    }

    /// Mean and standard deviation of each unknown.
    pub(super) fn moments(&self) -> (Vec<f64>, Vec<f64>) {
        moments(&self.all.iter().collect::<Vec<_>>(), self.course.len())
    }
}

fn moments(all: &[&Particle], n_unknowns: usize) -> (Vec<f64>, Vec<f64>) {
    let n = all.len() as f64;
    (0..n_unknowns)
        .map(|j| {
            let mean = all.iter().map(|p| p.z[j]).sum::<f64>() / n;
            let squares = all.iter().map(|p| (p.z[j] - mean).powi(2));
            (mean, (squares.sum::<f64>() / n).sqrt())
        })
        .unzip()
}

/// Mean square distance from the beginnings of chains to their ends, over that of two simulations of the swarm.
fn stirred(chains: &[Chain], n_unknowns: usize) -> f64 {
    let all: Vec<&Particle> = chains.iter().flat_map(|c| &c.all).collect();
    let (_, sigma) = moments(&all, n_unknowns);
    let distance = |chain: &Chain| {
        let ends = chain.all[0].z.iter().zip(&chain.all[chain.all.len() - 1].z);
        let squares = (ends.zip(&sigma).filter(|(_, s)| **s > 0.0))
            .map(|((a, b), s)| 0.5 * ((a - b) / s).powi(2));
        squares.sum::<f64>() / n_unknowns.max(1) as f64
    };
    chains.iter().map(distance).sum::<f64>() / chains.len() as f64
}

/// Number of simulations that count, by the logs of their weights.
pub(super) fn counting(weights: &[f64]) -> f64 {
    let most = weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if most == f64::NEG_INFINITY {
        return 0.0;
    }
    let (sum, squares) = (weights.iter()).fold((0.0, 0.0), |(s, q), w| {
        let e = (w - most).exp();
        (s + e, q + e * e)
    });
    sum * sum / squares
}

pub(super) fn log_mean(weights: &[f64]) -> f64 {
    let most = weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let sum: f64 = weights.iter().map(|w| (w - most).exp()).sum();
    most + (sum / weights.len() as f64).ln()
}

/// As many indices as weights, each as often as its weight says within one (systematic resampling); `u` from 0 to 1.
pub(super) fn draw(weights: &[f64], u: f64) -> Vec<usize> {
    let most = weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let each: Vec<f64> = weights.iter().map(|w| (w - most).exp()).collect();
    let step = each.iter().sum::<f64>() / each.len() as f64;
    let (mut at, mut sum) = (0, each[0]);
    (0..each.len())
        .map(|k| {
            while sum < (k as f64 + u) * step && at + 1 < each.len() {
                at += 1;
                sum += each[at];
            }
            at
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_is_drawn_as_often_as_it_weighs() {
        let weights = [1.0_f64, 3.0, 0.0, 4.0].map(f64::ln);
        assert_eq!(draw(&weights, 0.5), [0, 1, 3, 3].map(|i: usize| i));
        assert!((counting(&weights) - 64.0 / 26.0).abs() < 1e-12);
        assert!((log_mean(&weights) - 2.0_f64.ln()).abs() < 1e-12);
        assert_eq!(counting(&[f64::NEG_INFINITY; 3]), 0.0);
    }
}
