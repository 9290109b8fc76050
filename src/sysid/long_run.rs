//! How much wider estimates scatter than white noise would make them, from the spectrum of their scores near 0.
//!
//! An estimate from rows sᵣ (sensitivities) and eᵣ (whitened values) errs by Σ h·sᵣ eᵣ, h a row of H⁻¹. Were e white, the
//! terms would add up to the variance hᵀ A h, A = Σ s sᵀ. Correlated noise makes it the spectral density of the terms at
//! frequency 0 instead, of which sums with slow weights are samples:
//!
//! ```text
//! c_k = Σ w_k h·s e      w_k = √2 cos(π k τ), k = 1, 2 …; with several trials also 1 over one trial (k = 0)
//! ```
//!
//! τ is not time but the share of the parameter's information Σ (h·s)² gathered so far: a parameter that is excited for a
//! moment has all its frequencies in that moment. At the estimate part of c is fitted away; for white noise
//!
//! ```text
//! M_kl = E c_k c_l = Σ w_k w_l (h·s)² − a_kᵀ H⁻¹ a_l      a_k = Σ w_k (h·s) s
//! ```
//!
//! is left. So Σ c² / tr M over the lowest frequencies is the factor on the variance, with (tr M)²/tr M² degrees of
//! freedom. How many frequencies comes from the data: their number doubles as long as the next octave of the spectrum
//! agrees with what is below it by an F test. The test is lenient to one side: it is the falling spectrum of correlated
//! noise whose high part must stay out.
//!
//! Reference: Lazarus, Lewis, Stock and Watson 2018, "HAR inference: recommendations for practice" (equal-weighted
//! cosines with t critical values); Bell and `McCaffrey` 2002 for the correction of what is fitted away. The clock and the
//! choice of the number of frequencies are this module's.

use std::f64::consts::{PI, SQRT_2};

use nalgebra::{DMatrix, DVector};

use super::student::f_quantile;

/// Least degrees of freedom of the mean.
const LEAST: f64 = 4.0;
/// More samples of the spectrum say nothing that a quantile of t would show.
const MOST: usize = 128;
/// Stretches of constant weight a half period.
const BINS: usize = 4;
/// Level of the test that the next octave is lower.
const LOWER: f64 = 0.35;
/// Level of the test that it is higher.
const HIGHER: f64 = 0.05;

/// Rows of a least-squares problem along trials.
pub(super) struct Rows<'a> {
    /// sensitivities and value, one behind the other
    pub values: &'a [f64],
    /// numbers a row
    pub width: usize,
    /// trial and step of each
    pub places: &'a [(usize, usize)],
    /// steps of each trial
    pub lengths: &'a [usize],
    /// (column of a row, factor on it) of each parameter
    pub columns: Vec<(usize, f64)>,
}

/// Variance over that for white noise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Inflation {
    pub factor: f64,
    pub dof: f64,
}

/// A stretch of a trial.
#[derive(Clone)]
struct Bin {
    score: f64,          // Σ h·s e
    information: f64,    // Σ (h·s)²
    cross: DVector<f64>, // Σ (h·s) s
}

/// One sample of the spectrum.
struct Ordinate {
    trial: usize,
    /// cycles a unit of information
    frequency: f64,
    /// of each bin of the trial
    weights: Vec<f64>,
    /// c
    value: f64,
    /// a
    cross: DVector<f64>,
}

impl Rows<'_> {
    /// A = Σ s sᵀ.
    pub(super) fn information(&self) -> DMatrix<f64> {
        let n = self.columns.len();
        let mut out = DMatrix::zeros(n, n);
        for row in self.values.chunks_exact(self.width) {
            let s = self.sensitivity(row);
            out.ger(1.0, &s, &s, 1.0);
        }
        out
    }

    fn sensitivity(&self, row: &[f64]) -> DVector<f64> {
        DVector::from_iterator(
            self.columns.len(),
            self.columns.iter().map(|&(c, f)| f * row[c]),
        )
    }

    /// Of the combination `direction` of scores; `inverse` is H⁻¹.
    pub(super) fn inflation(&self, direction: &DVector<f64>, inverse: &DMatrix<f64>) -> Inflation {
        let trials = self.bins(direction);
        let mut ordinates = ordinates(&trials);
        ordinates.sort_by(|a, b| a.frequency.total_cmp(&b.frequency));
        let m = covariance(&ordinates, &trials, inverse);
        let n = ordinates.len();
        let pool = |range: std::ops::Range<usize>| {
            pool(
                &ordinates[range.clone()],
                &m.view((range.start, range.start), (range.len(), range.len()))
                    .into(),
            )
        };
        // sums over whole trials have no lower ones
        let whole = ordinates.iter().filter(|o| o.frequency == 0.0).count();
        let mut used = n.min(whole.max(LEAST as usize));
        while used < n && pool(0..used).dof < LEAST {
            used += 1;
        }
        // of a direction without information there is no spectrum
        while used > 0 && 2 * used <= n {
            let (low, next) = (pool(0..used), pool(used..2 * used));
            let falls = next.factor * f_quantile(1.0 - LOWER, low.dof, next.dof) < low.factor;
            let rises = next.factor > low.factor * f_quantile(1.0 - HIGHER, next.dof, low.dof);
            if falls || rises {
                break;
            }
            used *= 2;
        }
        // few samples can be small by chance: no less than noise of all frequencies
        let (slow, all) = (pool(0..used), pool(0..n));
        if slow.factor < all.factor { all } else { slow }
    }

    /// Stretches of nearly equal information, trial by trial.
    fn bins(&self, direction: &DVector<f64>) -> Vec<Vec<Bin>> {
        let rows = || self.values.chunks_exact(self.width).zip(self.places);
        let along: Vec<f64> = rows()
            .map(|(row, _)| direction.dot(&self.sensitivity(row)))
            .collect();
        let mut gathered: Vec<Vec<f64>> = self.lengths.iter().map(|&n| vec![0.0; n]).collect();
        for (&(trial, step), u) in self.places.iter().zip(&along) {
            gathered[trial][step] += u * u;
        }
        let total: f64 = gathered.iter().flatten().sum();
        let mut trials: Vec<Vec<Bin>> = Vec::new();
        for steps in &mut gathered {
            let own: f64 = steps.iter().sum();
            let n = ((BINS * MOST) as f64 * own / total.max(f64::MIN_POSITIVE)).round() as usize;
            // from information a step to the bin in whose middle it is
            let mut before = 0.0;
            for value in steps.iter_mut() {
                let middle = before + 0.5 * *value;
                before += *value;
                *value = (n as f64 * middle / own.max(f64::MIN_POSITIVE)).floor();
            }
            let empty = Bin {
                score: 0.0,
                information: 0.0,
                cross: DVector::zeros(self.columns.len()),
            };
            trials.push(vec![empty; n.max(1)]);
        }
        for (((row, &(trial, step)), &u), e) in rows().zip(&along).zip(self.residuals()) {
            let bins = &mut trials[trial];
            let at = (gathered[trial][step] as usize).min(bins.len() - 1);
            bins[at].score += u * e;
            bins[at].information += u * u;
            bins[at].cross.axpy(u, &self.sensitivity(row), 1.0);
        }
        trials
    }

    fn residuals(&self) -> impl Iterator<Item = f64> {
        self.values
            .iter()
            .skip(self.width - 1)
            .step_by(self.width)
            .copied()
    }
}

fn ordinates(trials: &[Vec<Bin>]) -> Vec<Ordinate> {
    let mut out = Vec::new();
    for (trial, bins) in trials.iter().enumerate() {
        let own: f64 = bins.iter().map(|b| b.information).sum();
        for k in usize::from(trials.len() < 2)..=bins.len() / BINS {
            let weight = |bin: usize| {
                let phase = PI * k as f64 * (bin as f64 + 0.5) / bins.len() as f64;
                if k == 0 { 1.0 } else { SQRT_2 * phase.cos() }
            };
            let weights: Vec<f64> = (0..bins.len()).map(weight).collect();
            let mut cross = DVector::zeros(bins[0].cross.len());
            let mut value = 0.0;
            for (bin, &w) in bins.iter().zip(&weights) {
                value += w * bin.score;
                cross.axpy(w, &bin.cross, 1.0);
            }
            out.push(Ordinate {
                trial,
                frequency: k as f64 / own.max(f64::MIN_POSITIVE),
                weights,
                value,
                cross,
            });
        }
    }
    out
}

/// M.
fn covariance(ordinates: &[Ordinate], trials: &[Vec<Bin>], inverse: &DMatrix<f64>) -> DMatrix<f64> {
    let n = ordinates.len();
    let solved: Vec<DVector<f64>> = ordinates.iter().map(|o| inverse * &o.cross).collect();
    let mut m = DMatrix::zeros(n, n);
    for (i, a) in ordinates.iter().enumerate() {
        for (j, b) in ordinates.iter().enumerate().take(i + 1) {
            let mut sum = -b.cross.dot(&solved[i]);
            if a.trial == b.trial {
                for ((bin, v), w) in trials[a.trial].iter().zip(&a.weights).zip(&b.weights) {
                    sum += v * w * bin.information;
                }
            }
            (m[(i, j)], m[(j, i)]) = (sum, sum);
        }
    }
    m
}

/// Mean of squares over their expectation, and its degrees of freedom.
fn pool(ordinates: &[Ordinate], m: &DMatrix<f64>) -> Inflation {
    let squares: f64 = ordinates.iter().map(|o| o.value * o.value).sum();
    let expected = m.trace();
    if expected <= 0.0 {
        return Inflation {
            factor: 1.0,
            dof: 1.0,
        };
    }
    Inflation {
        factor: squares / expected,
        dof: (expected * expected / m.norm_squared()).max(1.0),
    }
}

/// Mean of several series and its standard error.
pub(super) fn mean(series: &[Vec<f64>]) -> (f64, f64) {
    let lengths: Vec<usize> = series.iter().map(Vec::len).collect();
    let n = lengths.iter().sum::<usize>() as f64;
    let mean = series.iter().flatten().sum::<f64>() / n;
    let sigma = (series
        .iter()
        .flatten()
        .map(|v| (v - mean).powi(2))
        .sum::<f64>()
        / n)
        .sqrt();
    if sigma == 0.0 {
        return (mean, 0.0);
    }
    let rows: Vec<f64> = series
        .iter()
        .flatten()
        .flat_map(|v| [1.0, (v - mean) / sigma])
        .collect();
    let places: Vec<(usize, usize)> = (lengths.iter().enumerate())
        .flat_map(|(trial, &n)| (0..n).map(move |step| (trial, step)))
        .collect();
    let rows = Rows {
        values: &rows,
        width: 2,
        places: &places,
        lengths: &lengths,
        columns: vec![(0, 1.0)],
    };
    let one = DVector::from_element(1, 1.0);
    let inflation = rows.inflation(&one, &DMatrix::from_element(1, 1, 1.0 / n));
    (mean, sigma * (inflation.factor / n).sqrt())
}

#[cfg(test)]
mod tests {
    use super::super::student::two_sided_t;
    use super::*;
    use crate::rng::{self, Purpose};

    /// Share of regressions whose slopes lie within 95 % intervals, and the mean length of these relative to the ones of
    /// known variance. Noise follows e' = a e + white; regressors are 1 and, excited in one tenth of the time alone, a
    /// slow sine.
    fn coverage(a: f64, trials: usize, steps: usize) -> [f64; 2] {
        let n = 200;
        let mut inside = [0; 2];
        for i in 0..n {
            let mut rng = rng::stream(5, Purpose::SensorNoise, 0, i);
            let (mut rows, mut places) = (Vec::new(), Vec::new());
            for trial in 0..trials {
                let mut e = rng::normal(&mut rng) / (1.0 - a * a).sqrt();
                for step in 0..steps {
                    e = a * e + rng::normal(&mut rng);
                    let part = step as f64 / steps as f64;
                    let sine = if part < 0.1 { (60.0 * part).sin() } else { 0.0 };
                    rows.extend([1.0, sine, e]);
                    places.push((trial, step));
                }
            }
            let mut normal = DMatrix::zeros(2, 2);
            let mut right = DVector::zeros(2);
            for row in rows.chunks_exact(3) {
                let s = DVector::from_column_slice(&row[..2]);
                normal.ger(1.0, &s, &s, 1.0);
                right.axpy(row[2], &s, 1.0);
            }
            let inverse = normal.try_inverse().expect("regular");
            let x = &inverse * right;
            for row in rows.chunks_exact_mut(3) {
                row[2] -= row[0] * x[0] + row[1] * x[1];
            }
            let rows = Rows {
                values: &rows,
                width: 3,
                places: &places,
                lengths: &vec![steps; trials],
                columns: vec![(0, 1.0), (1, 1.0)],
            };
            for j in 0..2 {
                let found = rows.inflation(&inverse.column(j).into(), &inverse);
                let half = two_sided_t(0.95, found.dof) * (found.factor * inverse[(j, j)]).sqrt();
                inside[j] += usize::from(x[j].abs() < half);
            }
        }
        inside.map(|k| k as f64 / n as f64)
    }

    #[test]
    fn intervals_of_slopes_hold_whatever_the_correlation() {
        // expected 0.95, the standard error of 200 repetitions is 0.015; the sine lasts for 200 steps, ten to twenty
        // correlation times at most, too few for the last few percent
        for (a, trials, steps, least) in [
            (0.0, 1, 1000, 0.91),
            (0.9, 1, 2000, 0.85),
            (0.98, 5, 1000, 0.89),
            (0.9, 20, 200, 0.91),
        ] {
            let shares = coverage(a, trials, steps);
            for share in shares {
                assert!(
                    (least..=0.995).contains(&share),
                    "{a} {trials} {steps}: {shares:?}"
                );
            }
        }
    }

    #[test]
    fn the_mean_of_a_constant_is_exact() {
        assert_eq!(mean(&[vec![2.0; 30], vec![2.0; 10]]), (2.0, 0.0));
    }

    #[test]
    fn many_short_trials_are_averaged_over_all_of_them() {
        let n = 240;
        for seed in 0..5 {
            let mut rng = rng::stream(seed, Purpose::SensorNoise, 0, 0);
            let series: Vec<Vec<f64>> = (0..n).map(|_| vec![rng::normal(&mut rng)]).collect();
            let (_, sigma) = mean(&series);
            let expected = 1.0 / f64::from(n).sqrt();
            assert!((sigma / expected - 1.0).abs() < 0.15, "{sigma} {expected}");
        }
    }
}
