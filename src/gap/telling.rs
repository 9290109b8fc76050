//! The readings of a window that say something of their own.
//!
//! A counter is off by as much as half a count. Where a joint crosses many counts these errors are like noise; where it rests or
//! creeps there is one error for as long as the count stays, and taken for so many of their own they tell of accelerations that
//! never were: a motor came out 0.5 % too weak, four standard deviations, for the sake of four windows of 75 in which other
//! joints moved by less than seven counts. A reading in a run of m equal ones, in a window with n of its channel, therefore counts
//!
//! ```text
//! max(1/m, 3/n)
//! ```
//!
//! and of all that a channel has, one is kept for every 1 that they count: the middle of a run, as likely too low as too
//! high. A joint that rests throughout stays within a count, which three readings say: a drift of D counts from
//! beginning to end costs about D². Readings with noise of more than a count hardly repeat themselves, and all are kept,
//! or every other, or third, if there are more than [`SAMPLES`].
//!
//! Widrow and Kollár 2008 (where quantisation is noise).

use crate::sysid::problem::Sample;

/// Samples of a channel in a window that are kept; more say the same again.
const SAMPLES: f64 = 96.0;
/// What the readings of a window count together at least.
const OF_A_COUNT: f64 = 3.0;

/// Those of the `samples` of a window that say something of their own, of `n_channels` channels; in their order, each with the noise
/// of its channel.
pub(super) fn telling(samples: &[Sample], n_channels: usize) -> Vec<Sample> {
    let mut n = vec![0.0; n_channels];
    for sample in samples {
        n[sample.channel] += 1.0;
    }
    let counts = |s: &Sample| s.spread.powi(-2).max(OF_A_COUNT / n[s.channel]).min(1.0);
    let mut total = vec![0.0; n_channels];
    for sample in samples {
        total[sample.channel] += counts(sample);
    }
    let every: Vec<f64> = total.iter().map(|t| (t / SAMPLES).ceil()).collect();
    let mut passed = vec![0.5_f64; n_channels];
    let mut kept = Vec::new();
    for sample in samples {
        let c = sample.channel;
        let before = passed[c].floor();
        passed[c] += counts(sample) / every[c];
        if passed[c].floor() > before {
            kept.push(Sample {
                spread: 1.0,
                ..*sample
            });
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;
    use crate::rng::{self, Purpose};
    use crate::sysid::trial::spreads;

    const COUNT: f64 = 2e-4;
    const N: usize = 400;
    const TRIALS: usize = 300;

    /// `value` of time 0 to 1, read N times.
    fn read(value: impl Fn(f64) -> f64) -> Vec<Sample> {
        let times = (0..N).map(|k| k as f64 / N as f64);
        let values: Vec<(f64, f64)> = times.map(|t| (t, value(t))).collect();
        let each = values.iter().zip(spreads(&values));
        each.map(|(&(time, value), spread)| Sample {
            channel: 0,
            time,
            value,
            spread,
        })
        .collect()
    }

    fn counted(value: f64) -> f64 {
        (value / COUNT).round() * COUNT
    }

    #[test]
    fn of_noise_is_kept_what_there_is_room_for() {
        let all = read(|t| (1e4 * t).sin());
        assert_eq!(telling(&all[..90], 1), all[..90]);
        let kept = telling(&all, 1);
        assert_eq!(kept.len(), N / 5);
        let steps = kept.windows(2).map(|w| w[1].time - w[0].time);
        assert!(steps.into_iter().all(|s| (s * N as f64 - 5.0).abs() < 1.5));
    }

    #[test]
    fn of_rest_three_readings_are_kept_and_of_a_run_its_middle() {
        let kept = telling(&read(|_| 0.3), 1);
        let times: Vec<f64> = kept.iter().map(|s| s.time).collect();
        let thirds = [1.0 / 6.0, 0.5, 5.0 / 6.0];
        assert!(
            times
                .iter()
                .zip(thirds)
                .all(|(t, to)| (t - to).abs() < 0.01)
        );
        assert_eq!(times.len(), 3);
        let ramp = |t: f64| 20.0 * COUNT * t;
        let kept = telling(&read(|t| counted(ramp(t))), 1);
        assert_eq!(kept.len(), 21);
        // those at the window's ends are of half a run
        let mut off = kept[1..20].iter().map(|s| s.value - ramp(s.time));
        assert!(off.all(|off| off.abs() < 0.1 * COUNT));
    }

    /// Accelerations of what creeps through a few counts, by a parabola: off by as much as noise of a count has them off.
    #[test]
    fn what_creeps_tells_of_accelerations_as_surely_as_is_said() {
        let mut rng = rng::stream(0, Purpose::SensorNoise, 0, 0);
        let mut squares = [0.0; 2];
        for _ in 0..TRIALS {
            let [at, speed, bend] =
                [1.0, 3.0, 3.0].map(|size| size * COUNT * rng::normal(&mut rng));
            let all = read(|t| counted(at + speed * t + 0.5 * bend * t * t));
            for (kept, sum) in [all.clone(), telling(&all, 1)].iter().zip(&mut squares) {
                let columns = DMatrix::from_fn(kept.len(), 3, |i, j| kept[i].time.powi(j as i32));
                let values = DVector::from_iterator(kept.len(), kept.iter().map(|s| s.value));
                let inverse = (columns.tr_mul(&columns))
                    .try_inverse()
                    .expect("three readings");
                let found = 2.0 * (&inverse * columns.tr_mul(&values))[2];
                let sigma = 2.0 * inverse[(2, 2)].sqrt() * COUNT / 12.0_f64.sqrt();
                *sum += ((found - bend) / sigma).powi(2);
            }
        }
        let [all, kept] = squares.map(|sum| (sum / TRIALS as f64).sqrt());
        assert!(all > 3.0, "{all}");
        assert!(kept < 1.3 && kept > 0.3, "{kept}");
    }
}
