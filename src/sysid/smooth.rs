//! A noisy signal as a smooth function of time.
//!
//! The signal is taken for a motion whose jerk is white noise of intensity q, seen with noise σ:
//!
//! ```text
//! d³s/dt³ = w,  w ~ N(0, q δ)      y = s + N(0, σ²)
//! ```
//!
//! whose best estimate is a smoothing spline of degree five; a Kalman filter and a backward pass (Rauch, Tung, Striebel)
//! give it at any time, for samples at any times. q is the one under which the samples are most likely, so that neither
//! window nor cutoff has to be chosen.
//!
//! Reference: Särkkä 2013, "Bayesian Filtering and Smoothing", chapters 4, 8 and 12.

use nalgebra::{Matrix3, Vector3};

/// Steps of log₁₀ q that are tried, from coarse to fine.
const SEARCH: [f64; 3] = [1.0, 0.25, 0.06];
/// Variance of a state of which nothing is known, in units of the signal's largest.
const DIFFUSE: f64 = 1e2;
/// Samples that say where a signal begins.
const FIRST: usize = 8;
/// Factor on the variance of what they say, as they are used again.
const WIDER: f64 = 1e3;

/// Position, velocity and acceleration with their covariance.
#[derive(Debug, Clone, Copy)]
struct Belief {
    mean: Vector3<f64>,
    covariance: Matrix3<f64>,
}

/// Values of a signal given by (time, value), in the order of time, at `times`, likewise in order.
pub(super) fn smooth(
    samples: &[(f64, f64)],
    sigma: f64,
    times: impl Iterator<Item = f64>,
) -> Vec<f64> {
    let Some(first) = Prior::new(samples, sigma) else {
        return times
            .map(|_| samples.first().map_or(0.0, |s| s.1))
            .collect();
    };
    let q = first.most_likely(samples, sigma);
    // samples and wanted times in one order
    let mut events: Vec<(f64, Option<f64>)> = samples.iter().map(|&(t, y)| (t, Some(y))).collect();
    events.extend(times.map(|t| (t, None)));
    events.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.is_some().cmp(&a.1.is_some())));
    let mut filtered = Vec::with_capacity(events.len());
    let mut belief = first.sharpened(samples, sigma, q);
    let mut time = events[0].0;
    for &(t, y) in &events {
        let predicted = predict(&belief, t - time, q);
        belief = y.map_or(predicted, |y| update(&predicted, y, sigma).0);
        time = t;
        filtered.push((belief, predicted));
    }
    let mut out = Vec::new();
    let mut later = belief;
    for i in (0..events.len()).rev() {
        if i + 1 < events.len() {
            let (here, (_, ahead)) = (filtered[i].0, filtered[i + 1]);
            let f = transition(events[i + 1].0 - events[i].0);
            let gain = ahead
                .covariance
                .try_inverse()
                .map_or(Matrix3::zeros(), |p| here.covariance * f.transpose() * p);
            later = Belief {
                mean: here.mean + gain * (later.mean - ahead.mean),
                covariance: here.covariance
                    + gain * (later.covariance - ahead.covariance) * gain.transpose(),
            };
        }
        if events[i].1.is_none() {
            out.push(later.mean[0]);
        }
    }
    out.reverse();
    out
}

/// What is known of a signal before its first sample, and its size.
struct Prior {
    belief: Belief,
    q: f64,
}

impl Prior {
    fn new(samples: &[(f64, f64)], sigma: f64) -> Option<Self> {
        let (first, last) = (samples.first()?, samples.last()?);
        let span = last.0 - first.0;
        if samples.len() < 4 || span <= 0.0 {
            return None;
        }
        let (low, high) = samples
            .iter()
            .fold((first.1, first.1), |(l, h), s| (l.min(s.1), h.max(s.1)));
        let size = (high - low).max(sigma);
        let step = span / (samples.len() - 1) as f64;
        let largest = |differences: &mut dyn Iterator<Item = f64>| {
            differences.fold(sigma, |m, d| m.max(d.abs()))
        };
        let speed = largest(&mut samples.windows(2).map(|w| w[1].1 - w[0].1)) / step;
        let acceleration = largest(&mut samples.windows(3).map(|w| w[2].1 - 2.0 * w[1].1 + w[0].1))
            / (step * step);
        let variance = Vector3::new(size, speed, acceleration).map(|s| DIFFUSE * s * s);
        let belief = Belief {
            mean: Vector3::new(first.1, 0.0, 0.0),
            covariance: Matrix3::from_diagonal(&variance),
        };
        Some(Self {
            belief,
            q: size * size / span.powi(5),
        })
    }

    /// The belief before the first sample, from the first few themselves, much widened: next to a belief as wide as the
    /// signal, exact samples would drown in rounding.
    fn sharpened(&self, samples: &[(f64, f64)], sigma: f64, q: f64) -> Belief {
        // time runs backwards: so does the sign of the velocity
        let turn = |b: Belief| {
            let s = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 1.0));
            Belief {
                mean: s * b.mean,
                covariance: s * b.covariance * s,
            }
        };
        let few = &samples[..samples.len().min(FIRST)];
        let mut belief = self.belief;
        let mut time = few[few.len() - 1].0;
        for &(t, y) in few.iter().rev() {
            belief = update(&predict(&belief, time - t, q), y, sigma).0;
            time = t;
        }
        let belief = turn(belief);
        Belief {
            covariance: belief.covariance * WIDER,
            ..belief
        }
    }

    fn most_likely(&self, samples: &[(f64, f64)], sigma: f64) -> f64 {
        let cost = |exponent: f64| {
            let q = self.q * 10_f64.powf(exponent);
            let mut belief = self.belief;
            let mut time = samples[0].0;
            let mut sum = 0.0;
            for &(t, y) in samples {
                let (next, nll) = update(&predict(&belief, t - time, q), y, sigma);
                (belief, time) = (next, t);
                sum += nll;
            }
            sum
        };
        let (mut best, mut least) = (0.0, cost(0.0));
        // from a slow curve to one that follows every sample
        let coarse = (-4..=20).map(f64::from);
        for exponent in coarse {
            let c = cost(exponent);
            if c < least {
                (best, least) = (exponent, c);
            }
        }
        for step in &SEARCH[1..] {
            for exponent in [-3.0, -2.0, -1.0, 1.0, 2.0, 3.0].map(|i| best + i * step) {
                let c = cost(exponent);
                if c < least {
                    (best, least) = (exponent, c);
                }
            }
        }
        self.q * 10_f64.powf(best)
    }
}

fn transition(t: f64) -> Matrix3<f64> {
    Matrix3::new(1.0, t, 0.5 * t * t, 0.0, 1.0, t, 0.0, 0.0, 1.0)
}

fn predict(b: &Belief, t: f64, q: f64) -> Belief {
    let f = transition(t);
    let noise = Matrix3::new(
        t.powi(5) / 20.0,
        t.powi(4) / 8.0,
        t.powi(3) / 6.0,
        t.powi(4) / 8.0,
        t.powi(3) / 3.0,
        t * t / 2.0,
        t.powi(3) / 6.0,
        t * t / 2.0,
        t,
    );
    Belief {
        mean: f * b.mean,
        covariance: f * b.covariance * f.transpose() + noise * q,
    }
}

/// Belief after a sample, and the sample's negative log-likelihood.
fn update(b: &Belief, y: f64, sigma: f64) -> (Belief, f64) {
    let p = &b.covariance;
    let variance = p[(0, 0)] + sigma * sigma;
    let gain = p.column(0) / variance;
    let error = y - b.mean[0];
    // the form that keeps a covariance positive
    let keep = Matrix3::identity() - gain * Vector3::x().transpose();
    let covariance = keep * p * keep.transpose() + gain * gain.transpose() * (sigma * sigma);
    let nll = 0.5 * (error * error / variance + variance.ln());
    (
        Belief {
            mean: b.mean + gain * error,
            covariance,
        },
        nll,
    )
}

#[cfg(test)]
mod tests {
    use super::smooth;
    use crate::rng::{self, Purpose};

    fn error(truth: impl Fn(f64) -> f64, sigma: f64, noise: f64) -> f64 {
        let mut rng = rng::stream(1, Purpose::Model, 0, 0);
        let samples: Vec<(f64, f64)> = (0..2000)
            .map(|i| f64::from(i) * 1e-3)
            .map(|t| (t, truth(t) + noise * rng::normal(&mut rng)))
            .collect();
        let times: Vec<f64> = (0..4000).map(|i| 5e-4 * f64::from(i)).collect();
        let smoothed = smooth(&samples, sigma, times.iter().copied());
        let square: f64 = smoothed
            .iter()
            .zip(&times)
            .map(|(s, &t)| (s - truth(t)).powi(2))
            .sum();
        (square / times.len() as f64).sqrt()
    }

    #[test]
    fn noise_is_removed_and_motion_kept() {
        let slow = |t: f64| (3.0 * t).sin();
        assert!(error(slow, 1e-2, 1e-2) < 1.5e-3);
        // and from a quick signal only what can be told from it
        let quick = |t: f64| (60.0 * t).sin();
        assert!(error(quick, 1e-2, 1e-2) < 4e-3);
    }

    #[test]
    fn an_exact_signal_is_kept() {
        for truth in [|t: f64| (3.0 * t).sin(), |t: f64| 2.0 - t] {
            let error = error(truth, 1e-8, 0.0);
            assert!(error < 1e-8, "{error}");
        }
    }
}
