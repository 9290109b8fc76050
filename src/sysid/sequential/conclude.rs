//! From a swarm to a fit.
//!
//! Sensitivities of samples are slopes over the swarm, Σ⁻¹ cov(x, ŝ), which average over what contacts do to single
//! derivatives, and in which first states follow the parameters as the samples have them.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::Found;
use super::course::Course;
use super::swarm::Swarm;
use crate::sysid::SysidError;
use crate::sysid::fit::{Fit, Innovations, Iteration, Status};

/// Simulations whose slopes are summed by one thread.
const CHUNK: usize = 32;

/// The fit; motion behind the horizon is `smoothed`.
pub(super) fn conclude(
    swarm: &Swarm<'_>,
    course: &Course<'_>,
    found: Found,
    smoothed: Vec<Vec<f64>>,
    (status, history): (Status, Vec<Iteration>),
) -> Result<Fit, SysidError> {
    let problem = course.problem;
    let nq = problem.model.nq();
    let steps = (swarm.horizon.floor() as usize).max(1);
    let (best, cost) = swarm.best();
    let mut trajectories = smoothed;
    if let Some(simulated) = course.simulate(&best.z, steps)? {
        for (all, own) in trajectories.iter_mut().zip(&simulated) {
            let n = (steps * nq).min(own.qpos.len());
            all[..n].copy_from_slice(&own.qpos[..n]);
        }
    }
    Ok(Fit {
        x: found.x,
        trajectories,
        cost,
        negative_log_evidence: -swarm.evidence,
        level: found.level,
        force_sigma: vec![0.0; problem.model.nv()],
        horizon_s: (swarm.horizon < course.end() as f64)
            .then(|| swarm.horizon * problem.model.timestep()),
        status,
        history,
        innovations: innovations(swarm, course, steps)?,
        weakest: (1.0, 0, 0, 0),
    })
}

/// Sums over simulations.
struct Sums {
    /// simulations
    n: f64,
    /// (samples) of ŝ − s
    residual: Vec<f64>,
    /// (samples × parameters) of (x − x̄)(ŝ − s)
    product: Vec<f64>,
}

fn innovations(
    swarm: &Swarm<'_>,
    course: &Course<'_>,
    steps: usize,
) -> Result<Innovations, SysidError> {
    let problem = course.problem;
    let np = course.ranges.len();
    let (mean, _) = swarm.moments();
    let mut covariance = DMatrix::zeros(np, np);
    let mut of_first = DMatrix::zeros(course.len() - np, np);
    for p in &swarm.all {
        let off = DVector::from_fn(np, |j, _| p.z[j] - mean[j]);
        covariance.ger(1.0, &off, &off, 1.0);
        let u = DVector::from_fn(course.len() - np, |j, _| p.z[np + j] - mean[np + j]);
        of_first.ger(1.0, &u, &off, 1.0);
    }
    let inverse = covariance.pseudo_inverse(0.0).unwrap_or_default();

    let mut places = Vec::new();
    let mut sigma = Vec::new();
    if let Some(simulated) = course.simulate(&swarm.all[0].z, steps)? {
        course.readings(&swarm.all[0].z, &simulated, steps, &mut |trial, p, _| {
            let s = &problem.trials[trial].samples[p.sample];
            places.push((trial, p.knot));
            sigma.push(problem.channels[s.channel].sigma_of(s));
        });
    }
    let n_samples = places.len();
    let parts: Vec<Sums> = (swarm.all.par_chunks(CHUNK))
        .map(|chunk| {
            let mut sums = Sums {
                n: 0.0,
                residual: vec![0.0; n_samples],
                product: vec![0.0; n_samples * np],
            };
            for particle in chunk {
                let Some(simulated) = course.simulate(&particle.z, steps)? else {
                    continue;
                };
                sums.n += 1.0;
                let mut i = 0;
                course.readings(&particle.z, &simulated, steps, &mut |trial, p, reading| {
                    if i < n_samples {
                        let r = reading - problem.trials[trial].samples[p.sample].value;
                        sums.residual[i] += r;
                        let own = &mut sums.product[i * np..(i + 1) * np];
                        for (sum, (x, mean)) in own.iter_mut().zip(particle.z.iter().zip(&mean)) {
                            *sum += (x - mean) * r;
                        }
                    }
                    i += 1;
                });
            }
            Ok(sums)
        })
        .collect::<Result<_, SysidError>>()?;
    let n: f64 = parts.iter().map(|s| s.n).sum();
    let mut out = Innovations {
        n_parameters: np,
        ..Innovations::default()
    };
    let mut add = |slopes: DVector<f64>, value: f64, place: (usize, usize)| {
        out.rows.extend(slopes.iter());
        out.rows.push(value);
        out.places.push(place);
    };
    // what was known of first states
    let mut k = 0;
    for (trial, first) in course.firsts.iter().enumerate() {
        for _ in 0..first.len() {
            let slopes = &inverse * of_first.row(k).transpose();
            add(slopes, -mean[np + k], (trial, 0));
            k += 1;
        }
    }
    for i in 0..n_samples {
        let sum = |of: &dyn Fn(&Sums) -> f64| parts.iter().map(of).sum::<f64>();
        let product = DVector::from_fn(np, |j, _| sum(&|s| s.product[i * np + j]));
        let residual = sum(&|s| s.residual[i]) / n.max(1.0);
        add(
            &inverse * product / sigma[i],
            -residual / sigma[i],
            places[i],
        );
    }
    Ok(out)
}
