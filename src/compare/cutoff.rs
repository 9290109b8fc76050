//! The low-pass that takes noise and leaves motion.
//!
//! A cutoff f takes from a reading q with noise of standard deviation σ, a sample every h, what lies above it. While that is
//! noise alone
//!
//! ```text
//! mean (q − q_f)² ≤ 1.5 σ² (1 − 2 f h)
//! ```
//!
//! The lowest f for which this holds is taken, of several readings the highest (the discrepancy principle, Morozov 1966). The
//! factor is for what is known of σ, and for motion that is lost in it. Unfiltered, states of a fast recording have
//! velocities of noise: from two samples apart it is σ/(√2 h).

use super::butterworth::{Beyond, low_pass};
use super::samples::{Samples, median_interval};
use crate::recording::{Kind, Recording};

/// Times h: nothing worth filtering is above.
const HIGHEST: f64 = 0.4;
/// Times h, of the lowest that is tried, and the factor between two.
const LOWEST: f64 = 0.002;
const FACTOR: f64 = 1.15;
/// Of the noise's variance, that may be taken.
const SLACK: f64 = 1.5;
/// Samples that a reading needs.
const FEWEST: usize = 100;

/// Cutoff for the positions of `recordings`, whose channels have noise of `sigma`; none where noise is not known, or
/// where motion is as fast.
pub fn cutoff_hz<'a>(
    recordings: impl IntoIterator<Item = &'a Recording>,
    sigma: &dyn Fn(&str) -> Option<f64>,
) -> Option<f64> {
    let mut highest: Option<f64> = None;
    for stream in recordings.into_iter().flat_map(|r| &r.streams) {
        for (column, channel) in stream.channels.iter().enumerate() {
            // tables have no units: of velocities too then, which only makes it higher
            let position =
                channel.kind == Kind::Sensor && matches!(&*channel.unit, "rad" | "m" | "");
            let Some(sigma) = sigma(&channel.name).filter(|s| position && *s > 0.0) else {
                continue;
            };
            let own = Samples::of(stream, column);
            let interval = median_interval(&own.time_s);
            if own.values.len() < FEWEST || interval <= 0.0 {
                continue;
            }
            let hz = lowest(&own.values, sigma)? / interval;
            highest = Some(highest.map_or(hz, |most| hz.max(most)));
        }
    }
    highest
}

/// The lowest cutoff, times the interval, that takes noise of `sigma` alone; none below [`HIGHEST`].
fn lowest(values: &[f64], sigma: f64) -> Option<f64> {
    let tried = std::iter::successors(Some(LOWEST), |f| Some(f * FACTOR));
    let mut tried = tried.take_while(|f| *f < HIGHEST);
    tried.find(|f| {
        let mut passed = values.to_vec();
        low_pass(&mut passed, 1, *f, Beyond::Reflected);
        let taken: f64 = values
            .iter()
            .zip(&passed)
            .map(|(q, p)| (q - p).powi(2))
            .sum();
        taken <= SLACK * sigma * sigma * (1.0 - 2.0 * f) * values.len() as f64
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::{Channel, Meta, Stream};
    use crate::rng::{self, Purpose};

    /// Ten seconds of a sine of `hz` and 1 rad, a sample a millisecond.
    fn recording(hz: f64, noise: f64) -> Recording {
        let channel = Channel {
            name: "angle".into(),
            kind: Kind::Sensor,
            unit: "rad".into(),
            noise_sigma: None,
        };
        let mut stream = Stream::new("all", Some(1000.0), vec![channel]);
        let mut rng = rng::stream(1, Purpose::SensorNoise, 0, 0);
        for k in 0..10_000_i64 {
            let angle = (std::f64::consts::TAU * hz * k as f64 * 1e-3).sin();
            stream.push(k * 1_000_000, &[angle + noise * rng::normal(&mut rng)]);
        }
        Recording {
            meta: Meta::default(),
            streams: vec![stream],
        }
    }

    #[test]
    fn what_is_taken_is_noise() {
        let of =
            |hz: f64, noise: f64, said: f64| cutoff_hz(&[recording(hz, noise)], &|_| Some(said));
        let slow = of(1.0, 1e-2, 1e-2).expect("a cutoff");
        let fast = of(10.0, 1e-2, 1e-2).expect("a cutoff");
        assert!(
            (1.0..6.0).contains(&slow) && (10.0..50.0).contains(&fast),
            "{slow} {fast}"
        );
        // less noise asks for more of the motion
        assert!(of(1.0, 1e-4, 1e-4).expect("a cutoff") > slow);
        // more noise than was said: it would be taken for motion
        assert_eq!(of(1.0, 1e-2, 1e-3), None);
        assert_eq!(cutoff_hz(&[recording(1.0, 1e-2)], &|_| None), None);
    }
}
