//! Encoders of the joints, and the velocities made from them.
//!
//! ```text
//! x = round(N (s q(t - d) + b)) / N                      N counts a radian, scale s, bias b, delay d
//! v_k = a v_(k-1) + (1 - a)(x_k - x_(k-1)) rate          a = exp(-2π f_c / rate)
//! ```
//!
//! White quantisation noise of 1/(N √12) comes out of the filter as rate (1 - a) √(2/(1 + a)) / (N √12).

use std::collections::VecDeque;
use std::f64::consts::TAU;

use crate::rig::config::SensingConfig;

/// One encoder with its velocity filter.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Encoder {
    counts: f64,
    bias: f64,
    scale: f64,
    rate_hz: f64,
    /// share of the old velocity that the filter keeps; none: exact velocities
    keep: Option<f64>,
    /// samples that the delay spans
    delay: f64,
    past: VecDeque<[f64; 2]>, // position, velocity; the newest first
    last: Option<f64>,
    velocity: f64,
}

impl Encoder {
    pub(in crate::rig) fn new(
        config: &SensingConfig,
        rate_hz: f64,
        bias: f64,
        scale: f64,
        delay_s: f64,
    ) -> Self {
        Self {
            counts: config.encoder_steps_per_rad,
            bias,
            scale,
            rate_hz,
            keep: keep(config, rate_hz),
            delay: delay_s * rate_hz,
            past: VecDeque::new(),
            last: None,
            velocity: 0.0,
        }
    }

    /// One sample of the true angle and speed: measured position and velocity.
    pub(in crate::rig) fn read(&mut self, angle: f64, speed: f64) -> (f64, f64) {
        let [angle, speed] = self.delayed([angle, speed]);
        let exact = self.scale * angle + self.bias;
        let position = quantise(exact, self.counts);
        self.velocity = match self.keep {
            None => self.scale * speed,
            Some(keep) => {
                let difference = position - self.last.unwrap_or(position);
                keep * self.velocity + (1.0 - keep) * difference * self.rate_hz
            }
        };
        self.last = Some(position);
        (position, self.velocity)
    }

    /// The state of `delay` samples ago, between samples on a straight line; before the start, that of the start.
    fn delayed(&mut self, now: [f64; 2]) -> [f64; 2] {
        if self.delay == 0.0 {
            return now;
        }
        self.past.push_front(now);
        self.past.truncate(self.delay as usize + 2);
        let oldest = self.past.len() - 1;
        let before = (self.delay as usize).min(oldest);
        let (a, b) = (self.past[before], self.past[(before + 1).min(oldest)]);
        let share = self.delay.fract();
        [0, 1].map(|i| (1.0 - share) * a[i] + share * b[i])
    }
}

fn keep(config: &SensingConfig, rate_hz: f64) -> Option<f64> {
    let cutoff = config.velocity_cutoff_hz;
    (cutoff > 0.0).then(|| (-TAU * cutoff / rate_hz).exp())
}

/// `x` to the next of `counts` a unit; 0: as it is.
fn quantise(x: f64, counts: f64) -> f64 {
    if counts > 0.0 {
        (x * counts).round() / counts
    } else {
        x
    }
}

/// Standard deviation of measured positions, rad.
pub(in crate::rig) fn position_sigma(config: &SensingConfig) -> f64 {
    if config.encoder_steps_per_rad > 0.0 {
        1.0 / (config.encoder_steps_per_rad * 12.0_f64.sqrt())
    } else {
        0.0
    }
}

/// Standard deviation of measured velocities, rad/s.
pub(in crate::rig) fn velocity_sigma(config: &SensingConfig, rate_hz: f64) -> f64 {
    keep(config, rate_hz).map_or(0.0, |a| {
        position_sigma(config) * rate_hz * (1.0 - a) * (2.0 / (1.0 + a)).sqrt()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{self, Purpose};

    fn paper() -> SensingConfig {
        SensingConfig {
            encoder_steps_per_rad: 5000.0,
            velocity_cutoff_hz: 100.0,
            ..SensingConfig::default()
        }
    }

    #[test]
    fn positions_are_whole_counts_within_half_a_count() {
        let mut encoder = Encoder::new(&paper(), 2000.0, 0.0, 1.0, 0.0);
        for k in 0..1000 {
            let angle = 0.37 * f64::from(k).sin();
            let counts = encoder.read(angle, 0.0).0 * 5000.0;
            assert!((counts - counts.round()).abs() < 1e-9);
            assert!((counts - 5000.0 * angle).abs() <= 0.5 + 1e-9);
        }
    }

    #[test]
    fn a_ramp_comes_out_as_the_filters_step_response() {
        let config = SensingConfig {
            encoder_steps_per_rad: 0.0,
            ..paper()
        };
        let mut encoder = Encoder::new(&config, 2000.0, 0.01, 1.0, 0.0);
        encoder.read(0.0, 0.0);
        for k in 1..200 {
            let time = f64::from(k) / 2000.0;
            let (_, velocity) = encoder.read(3.0 * time, 0.0);
            let expected = 3.0 * (1.0 - (-TAU * 100.0 * time).exp());
            assert!((velocity - expected).abs() < 1e-9, "{velocity} {expected}");
        }
    }

    #[test]
    fn noise_is_as_stated() {
        // the same motion, by random amounts within ten counts, through an exact and a counting encoder
        let mut counting = Encoder::new(&paper(), 2000.0, 0.0, 1.0, 0.0);
        let mut exact = counting.clone();
        exact.counts = 0.0;
        let mut rng = rng::stream(1, Purpose::SensorNoise, 0, 0);
        let (mut square, n) = ([0.0; 2], 50_000);
        for _ in 0..n {
            let angle = rng::uniform(&mut rng, 0.0, 0.002);
            let (a, b) = (counting.read(angle, 0.0), exact.read(angle, 0.0));
            square[0] += (a.0 - b.0).powi(2);
            square[1] += (a.1 - b.1).powi(2);
        }
        let stated = [position_sigma(&paper()), velocity_sigma(&paper(), 2000.0)];
        for (square, stated) in square.iter().zip(stated) {
            // a standard deviation from 50000 samples is good to 0.5 %
            let sigma = (square / f64::from(n)).sqrt();
            assert!((sigma / stated - 1.0).abs() < 0.02, "{sigma} {stated}");
        }
    }

    #[test]
    fn delay_between_samples_is_interpolated() {
        let config = SensingConfig::default();
        let mut encoder = Encoder::new(&config, 2000.0, 0.0, 1.0, 0.00125);
        let mut last = (0.0, 0.0);
        for k in 0..50 {
            last = encoder.read(f64::from(k), 7.0);
        }
        assert!((last.0 - (49.0 - 2.5)).abs() < 1e-9, "{}", last.0);
        assert_eq!(last.1, 7.0);
    }
}
