//! A seeded search of a box without slopes: evolution by covariance matrix adaptation (CMA-ES).
//!
//! Each generation is drawn from a normal distribution, whose mean and covariance follow the better half of it. Only the
//! order of costs counts, so the search goes on where the cost is rough, as long as it has a slope over the width of a
//! generation. Numbers are searched in units of `spread`.
//!
//! Reference: Hansen and Ostermeier 2001, "Completely derandomized self-adaptation in evolution strategies".

use fcmaes_core::{Cmaes, CmaesParams, Fitness};
use rayon::prelude::*;

use super::SysidError;
use super::fit::Status;
use super::parameter::{Parameters, Scale};

/// Part of the box, or of what matters, by which the first generation spreads.
const FIRST_SPREAD: f64 = 0.25;
/// How far the search goes where there is no bound, in sizes of parameters.
const REACH: f64 = 3.0;
/// Cost of a candidate that cannot be simulated: above all others.
const LOST: f64 = 1e30;

/// How to search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Evolution {
    /// most generations
    pub generations: usize,
    /// candidates a generation; none: by the number of parameters
    pub population: Option<usize>,
    /// fall of the cost over many generations below which it has converged
    pub tolerance: f64,
    /// of the draws
    pub seed: u64,
}

/// A candidate.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Candidate {
    pub x: Vec<f64>,
    /// none: cannot be simulated
    pub cost: Option<f64>,
}

/// Where and how widely to search: lower, upper and first spread of each x.
pub(super) fn ranges(parameters: &Parameters, x: &[f64]) -> Vec<(f64, f64, f64)> {
    (parameters.iter_free().zip(x))
        .map(|(p, &x)| {
            let (lower, upper) = p.bounds();
            let reach = REACH * p.typical;
            let (lower, upper) = (lower.max(x - reach), upper.min(x + reach));
            let most = match p.scale {
                Scale::Log => 1.0,
                Scale::Linear => p.typical,
            };
            (lower, upper, FIRST_SPREAD * (upper - lower).min(2.0 * most))
        })
        .collect()
}

/// All candidates in the order of generations, from `x` on. `cost` is asked for many at once; `watch` is told of the
/// best after each generation, and stops the search by `false`.
pub(super) fn search(
    evolution: Evolution,
    x: &[f64],
    ranges: &[(f64, f64, f64)],
    cost: &(dyn Fn(&[f64]) -> Option<f64> + Sync),
    watch: &mut dyn FnMut(&Candidate, f64) -> bool,
) -> Result<(Vec<Candidate>, Status), SysidError> {
    let unit = |i: usize| ranges[i].2;
    let (lower, upper): (Vec<f64>, Vec<f64>) = (ranges.iter().enumerate())
        .map(|(i, r)| ((r.0 - x[i]) / unit(i), (r.1 - x[i]) / unit(i)))
        .unzip();
    if (lower.iter().zip(&upper)).any(|(l, u)| !(l.is_finite() && u.is_finite() && l < u)) {
        return Err(SysidError::Setting {
            reason: "a parameter has no room to be searched: widen its bounds".into(),
        });
    }
    let n = x.len();
    let population = (evolution.population).unwrap_or(8 + (4.0 * (n as f64).ln()) as usize);
    let parameters = CmaesParams {
        popsize: population as i32,
        max_evaluations: (evolution.generations * population) as u64,
        stop_tol_hist_fun: evolution.tolerance,
        seed: evolution.seed,
        ..CmaesParams::default()
    };
    let mut strategy = Cmaes::new(
        Fitness::bounded(n, 1, &lower, &upper),
        &vec![0.0; n],
        &[1.0],
        &parameters,
    );
    let first = Candidate {
        x: x.to_vec(),
        cost: cost(x),
    };
    let mut best = first.clone();
    let mut all = vec![first];
    for _ in 0..evolution.generations {
        let asked = strategy.ask();
        let generation: Vec<Candidate> = (asked.par_iter())
            .map(|z| {
                let x: Vec<f64> = (z.iter().enumerate())
                    .map(|(i, z)| x[i] + unit(i) * z)
                    .collect();
                let cost = cost(&x).filter(|c| c.is_finite());
                Candidate { x, cost }
            })
            .collect();
        let costs: Vec<f64> = generation.iter().map(|c| c.cost.unwrap_or(LOST)).collect();
        let stop = strategy.tell(&costs);
        let before = best.x.clone();
        for candidate in generation {
            if candidate.cost.unwrap_or(LOST) < best.cost.unwrap_or(LOST) {
                best = candidate.clone();
            }
            all.push(candidate);
        }
        let moved = (best.x.iter().zip(&before)).fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()));
        if !watch(&best, moved) {
            return Ok((all, Status::Interrupted));
        }
        if stop != 0 {
            return Ok((all, Status::Converged));
        }
    }
    Ok((all, Status::MaxIterations))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(seed: u64, threads: usize) -> (Vec<Candidate>, Status) {
        // a narrow valley with ripples a tenth as high as it is deep
        let cost = |x: &[f64]| {
            let (a, b) = (x[0] - 0.7, 30.0 * (x[1] + 0.2 + x[0]));
            Some(a * a + b * b + 0.01 * (200.0 * x[0]).sin() * (170.0 * x[1]).cos())
        };
        let evolution = Evolution {
            generations: 100,
            population: None,
            tolerance: 1e-9,
            seed,
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let pool = pool.build().expect("threads");
        pool.install(|| {
            let ranges = [(-2.0, 2.0, 0.5); 2];
            search(evolution, &[-1.0, 1.0], &ranges, &cost, &mut |_, _| true).expect("searched")
        })
    }

    #[test]
    fn follows_a_valley_over_ripples() {
        for seed in 0..5 {
            let (all, _) = found(seed, 2);
            let cost = |c: &&Candidate| c.cost.unwrap_or(f64::INFINITY);
            let best = (all.iter())
                .min_by(|a, b| cost(a).total_cmp(&cost(b)))
                .expect("some");
            assert!((best.x[0] - 0.7).abs() < 0.15, "{best:?}");
            assert!((best.x[1] + 0.9).abs() < 0.15, "{best:?}");
        }
    }

    #[test]
    fn same_seed_same_search_on_any_number_of_threads() {
        assert_eq!(found(3, 1).0, found(3, 4).0);
        assert_ne!(found(3, 1).0, found(4, 1).0);
    }
}
