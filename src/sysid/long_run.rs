//! The variance of a sum of autocorrelated terms, from as much of their spectrum near 0 as is flat.
//!
//! For a series g₁ … gₙ of correlated terms Var(Σ g) is not Σ g² but n times the spectral density at frequency 0. Each
//! cosine transform at a low frequency is an independent sample of it:
//!
//! ```text
//! c_k = √2 Σ_t g_t cos(π k (t + ½)/n)      E c_k² ≈ Var(Σ g)       frequency k/2n
//! ```
//!
//! and with several trials so is the spread of the trials' own sums (k = 0). The mean over the lowest B of them has a
//! χ² distribution with B degrees of freedom, so that intervals with Student's t hold for few as for many. B comes from
//! the data: it doubles as long as the next octave of the spectrum agrees with what is below it by an F test. The test
//! is lenient to one side: it is the falling spectrum of correlated noise whose high part must stay out.
//!
//! Reference: Lazarus, Lewis, Stock and Watson 2018, "HAR inference: recommendations for practice" (equal-weighted
//! cosines with t critical values); the choice of B is this module's.

use std::f64::consts::PI;

use super::student::f_quantile;

/// Least number of samples of the spectrum.
const LEAST: usize = 8;
/// More say nothing that a quantile of t would show.
const MOST: usize = 256;
/// Level of the test that the next octave is lower.
const LOWER: f64 = 0.2;
/// Level of the test that it is higher.
const HIGHER: f64 = 0.05;

/// Several series a trial, one column a quantity: (steps × columns) row by row.
pub(super) struct Trials<'a> {
    pub columns: usize,
    pub series: Vec<&'a [f64]>,
}

/// One sample of the spectrum: `value` a column.
struct Ordinate {
    /// cycles a step
    frequency: f64,
    /// factor on its square that makes it a sample of the variance over all trials
    weight: f64,
    value: Vec<f64>,
}

/// Samples of the spectrum near 0, ordered by frequency.
pub(super) struct Spectrum {
    ordinates: Vec<Ordinate>,
}

/// The variance of a column's sum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LongRun {
    pub variance: f64,
    pub dof: f64,
    /// number of ordinates it is the mean of
    pub used: usize,
}

impl Spectrum {
    pub(super) fn new(trials: &Trials<'_>) -> Self {
        let n = trials.columns;
        let steps: Vec<usize> = trials.series.iter().map(|s| s.len() / n.max(1)).collect();
        let total: usize = steps.iter().sum();
        let mut ordinates = Vec::new();
        // trials contribute frequencies in proportion to their length
        let highest = (0.25_f64).min(0.5 * MOST as f64 / total.max(1) as f64);
        for (series, &steps) in trials.series.iter().zip(&steps) {
            let last = (2.0 * steps as f64 * highest).round() as usize;
            for k in 1..=last {
                let mut value = vec![0.0; n];
                for (t, row) in series.chunks_exact(n).enumerate() {
                    let c = (PI * k as f64 * (t as f64 + 0.5) / steps as f64).cos();
                    for (v, g) in value.iter_mut().zip(row) {
                        *v += c * g;
                    }
                }
                let scale = std::f64::consts::SQRT_2;
                value.iter_mut().for_each(|v| *v *= scale);
                ordinates.push(Ordinate {
                    frequency: 0.5 * k as f64 / steps as f64,
                    weight: total as f64 / steps as f64,
                    value,
                });
            }
        }
        let n_trials = trials.series.len() as f64;
        if n_trials > 1.0 {
            for series in &trials.series {
                let mut value = vec![0.0; n];
                for row in series.chunks_exact(n) {
                    for (v, g) in value.iter_mut().zip(row) {
                        *v += g;
                    }
                }
                // the sums add up to 0, which takes one degree of freedom
                let weight = n_trials * n_trials / (n_trials - 1.0);
                ordinates.push(Ordinate {
                    frequency: 0.0,
                    weight,
                    value,
                });
            }
        }
        ordinates.sort_by(|a, b| a.frequency.total_cmp(&b.frequency));
        Self { ordinates }
    }

    /// Degrees of freedom of the first `n`.
    fn dof(&self, n: usize) -> f64 {
        let still = self
            .ordinates
            .iter()
            .take_while(|o| o.frequency == 0.0)
            .count();
        if still > 0 && n >= still {
            n as f64 - 1.0
        } else {
            n as f64
        }
    }

    /// The variance of the sum of a column, over as many frequencies as agree.
    pub(super) fn long_run(&self, column: usize) -> LongRun {
        let n = self.ordinates.len();
        let mut used = LEAST.min(n);
        while 2 * used <= n {
            let low = mean(&self.ordinates[..used], column);
            let next = mean(&self.ordinates[used..2 * used], column);
            let dof = self.dof(used);
            let m = used as f64;
            let falls = next < low / f_quantile(1.0 - LOWER, dof, m);
            let rises = next > low * f_quantile(1.0 - HIGHER, m, dof);
            if falls || rises {
                break;
            }
            used *= 2;
        }
        LongRun {
            variance: mean(&self.ordinates[..used], column),
            dof: self.dof(used).max(1.0),
            used,
        }
    }

    /// Covariance of the sums of all columns (columns × columns), over the first `used` frequencies.
    pub(super) fn covariance(&self, used: usize) -> Vec<f64> {
        let ordinates = &self.ordinates[..used.min(self.ordinates.len())];
        let n = ordinates.first().map_or(0, |o| o.value.len());
        let mut out = vec![0.0; n * n];
        for o in ordinates {
            let weight = o.weight / ordinates.len() as f64;
            for i in 0..n {
                for j in 0..n {
                    out[i * n + j] += weight * o.value[i] * o.value[j];
                }
            }
        }
        out
    }
}

/// Mean of the samples of a column's variance.
fn mean(ordinates: &[Ordinate], column: usize) -> f64 {
    let sum: f64 = ordinates
        .iter()
        .map(|o| o.weight * o.value[column].powi(2))
        .sum();
    sum / ordinates.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::super::student::two_sided_t;
    use super::*;
    use crate::rng::{self, Purpose};

    /// Share of series whose sum lies within its 95 % interval, and the mean length of the interval relative to the
    /// one of known variance. Terms follow g' = a g + e.
    fn coverage(a: f64, trials: usize, steps: usize) -> (f64, f64) {
        let n = 400;
        let (mut inside, mut length) = (0, 0.0);
        for i in 0..n {
            let mut rng = rng::stream(5, Purpose::SensorNoise, 0, i);
            let series: Vec<Vec<f64>> = (0..trials)
                .map(|_| {
                    let mut g = rng::normal(&mut rng) / (1.0 - a * a).sqrt();
                    (0..steps)
                        .map(|_| {
                            g = a * g + rng::normal(&mut rng);
                            g
                        })
                        .collect()
                })
                .collect();
            let n_total = (trials * steps) as f64;
            let sum: f64 = series.iter().flatten().sum();
            // as at an optimum, where the terms add up to 0
            let centred: Vec<Vec<f64>> = (series.iter())
                .map(|s| s.iter().map(|g| g - sum / n_total).collect())
                .collect();
            let spectrum = Spectrum::new(&Trials {
                columns: 1,
                series: centred.iter().map(Vec::as_slice).collect(),
            });
            let found = spectrum.long_run(0);
            let half = two_sided_t(0.95, found.dof) * found.variance.sqrt();
            inside += usize::from(sum.abs() < half);
            length += half / (1.96 * n_total.sqrt() / (1.0 - a));
        }
        (inside as f64 / n as f64, length / n as f64)
    }

    #[test]
    fn intervals_of_means_hold_whatever_the_correlation() {
        // expected 0.95; the standard error of 400 repetitions is 0.011
        for (a, trials, steps, least) in [
            (0.0, 1, 2000, 0.92),
            (0.9, 1, 2000, 0.92),
            (0.98, 1, 2000, 0.90),
            (0.98, 5, 1000, 0.91),
            (0.9, 20, 200, 0.92),
        ] {
            let (share, length) = coverage(a, trials, steps);
            println!("a {a}, {trials} trials of {steps}: {share} inside, length {length:.2}");
            assert!(
                (least..=0.985).contains(&share),
                "{a} {trials} {steps}: {share}"
            );
            assert!(length < 1.4, "{length}");
        }
    }
}
