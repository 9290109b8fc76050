//! Zero-phase low-pass: a Butterworth filter of fourth order, forwards and backwards.
//!
//! Two biquads by the bilinear transform, with K = tan(π f dt) and quality Q of each pole pair:
//!
//! ```text
//! y_t = b (x_t + 2 x_(t-1) + x_(t-2)) - a1 y_(t-1) - a2 y_(t-2)
//! c = 1 + K/Q + K²,  b = K²/c,  a1 = 2 (K² - 1)/c,  a2 = (1 - K/Q + K²)/c
//! ```
//!
//! Forwards and backwards together the gain at the cutoff is 1/2 and the phase 0. Both ends are continued: by their
//! point reflection, so that a constant or a ramp passes unchanged; or mirrored, where what is noise at the very end would
//! shift all of that by twice as much.

/// 1 / (2 cos θ) of the pole pairs at θ = π/8 and 3π/8.
const QUALITY: [f64; 2] = [0.541_196_100_146_197, 1.306_562_964_876_376_5];

/// How a signal goes on beyond its ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Beyond {
    /// reflected in its last point
    Reflected,
    /// mirrored in time
    Mirrored,
}

impl Beyond {
    fn value(self, end: f64, inside: f64) -> f64 {
        match self {
            Self::Reflected => 2.0 * end - inside,
            Self::Mirrored => inside,
        }
    }
}

/// Filter `n × width` values, column by column. `cutoff` is the frequency times the sample interval; at 1/2 and above
/// nothing is left to remove.
pub(super) fn low_pass(values: &mut [f64], width: usize, cutoff: f64, beyond: Beyond) {
    let n = values.len() / width.max(1);
    if cutoff >= 0.5 || n < 4 {
        return;
    }
    let padding = ((3.0 / cutoff).ceil() as usize).min(n - 1);
    for column in 0..width {
        let signal: Vec<f64> = values.iter().skip(column).step_by(width).copied().collect();
        let (first, last) = (signal[0], signal[n - 1]);
        let before = (1..=padding).rev().map(|i| beyond.value(first, signal[i]));
        let after = (1..=padding).map(|i| beyond.value(last, signal[n - 1 - i]));
        let mut padded: Vec<f64> = before.chain(signal.iter().copied()).chain(after).collect();
        for _ in 0..2 {
            for quality in QUALITY {
                biquad(&mut padded, cutoff, quality);
            }
            padded.reverse();
        }
        for (i, value) in padded[padding..padding + n].iter().enumerate() {
            values[i * width + column] = *value;
        }
    }
}

/// One pole pair, starting at rest on the first value.
fn biquad(signal: &mut [f64], cutoff: f64, quality: f64) {
    let k = (std::f64::consts::PI * cutoff).tan();
    let c = 1.0 + k / quality + k * k;
    let (b, a1, a2) = (
        k * k / c,
        2.0 * (k * k - 1.0) / c,
        (1.0 - k / quality + k * k) / c,
    );
    let start = signal[0];
    let (mut x1, mut x2, mut y1, mut y2) = (start, start, start, start);
    for value in signal {
        let x = *value;
        let y = b * (x + 2.0 * x1 + x2) - a1 * y1 - a2 * y2;
        (x2, x1, y2, y1) = (x1, x, y1, y);
        *value = y;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wave(frequency: f64) -> Vec<f64> {
        let phase = |i: i32| std::f64::consts::TAU * frequency * f64::from(i);
        (0..4000).map(|i| phase(i).sin()).collect()
    }

    #[test]
    fn gain_is_that_of_butterworth_squared_and_phase_is_zero() {
        let cutoff = 0.05_f64;
        for frequency in [0.01_f64, 0.05, 0.1] {
            let mut filtered = wave(frequency);
            low_pass(&mut filtered, 1, cutoff, Beyond::Reflected);
            // bilinear transform: frequencies appear as their tangents
            let pi = std::f64::consts::PI;
            let ratio = (pi * frequency).tan() / (pi * cutoff).tan();
            let gain = 1.0 / (1.0 + ratio.powi(8));
            for (a, b) in filtered.iter().zip(wave(frequency)).skip(1000).take(2000) {
                assert!(
                    (a - gain * b).abs() < 1e-6,
                    "{frequency}: {a} and {}",
                    gain * b
                );
            }
        }
    }

    #[test]
    fn ramps_pass_and_columns_do_not_mix() {
        let mut values: Vec<f64> = (0..300).flat_map(|i| [f64::from(i), 7.0]).collect();
        low_pass(&mut values, 2, 0.1, Beyond::Reflected);
        for (i, row) in values.chunks_exact(2).enumerate() {
            assert!((row[0] - i as f64).abs() < 1e-2, "{i}: {}", row[0]);
            assert!((row[1] - 7.0).abs() < 1e-9);
        }
    }
}
