//! Where a motor is in its play, as its encoder shows it.
//!
//! Under feedback a motor rattles from end to end of its play p, hundreds of times a second. Its readings θ = q + s are then a joint's
//! motion, which in a few milliseconds is a parabola, and a swing by p:
//!
//! ```text
//! r = θ − (a + b t + c t²)  over ±6 ms        s ≈ r(0) − (max r + min r)/2
//! ```

use crate::mujoco::Swing;

/// Readings that are looked at before and after a time, and s between them.
const HALF: usize = 12;
const EVERY_S: f64 = 5e-4;
/// Sums of squares and of fourth powers of their numbers.
const SQUARES: f64 = (HALF * (HALF + 1) * (2 * HALF + 1) / 3) as f64;
const FOURTHS: f64 =
    (HALF * (HALF + 1) * (2 * HALF + 1) * (3 * HALF * HALF + 3 * HALF - 1) / 15) as f64;

/// Of readings around a time, by the seconds that they are later.
pub(crate) fn swing(at: impl Fn(f64) -> f64) -> Swing {
    let values: [(f64, f64); 2 * HALF + 1] = std::array::from_fn(|i| {
        let k = i as f64 - HALF as f64;
        (k, at(k * EVERY_S))
    });
    let sum = |of: &dyn Fn(f64, f64) -> f64| values.iter().map(|(k, v)| of(*k, *v)).sum::<f64>();
    // odd and even powers do not mix
    let n = values.len() as f64;
    let (even, odd, bent) = (sum(&|_, v| v), sum(&|k, v| k * v), sum(&|k, v| k * k * v));
    let determinant = n * FOURTHS - SQUARES * SQUARES;
    let a = (FOURTHS * even - SQUARES * bent) / determinant;
    let (b, c) = (odd / SQUARES, (n * bent - SQUARES * even) / determinant);
    let quick = |(k, v): &(f64, f64)| v - a - k * (b + k * c);
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for r in values.iter().map(quick) {
        (low, high) = (r.min(low), r.max(high));
    }
    Swing {
        offset: Some(quick(&values[HALF]) - 0.5 * (low + high)),
        range: high - low,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A joint that speeds up, behind a motor that flies from end to end and back every 2 ms.
    #[test]
    fn readings_show_a_motor_and_how_far_it_goes() {
        let play = 0.008;
        let s = |t: f64| {
            let phase = (t / 2e-3).rem_euclid(1.0);
            play * (2.0 * (phase - 0.5).abs() - 0.5)
        };
        let reading = |t: f64| 0.3 - 2.0 * t + 50.0 * t * t + s(t);
        for k in 0..40 {
            let now = 0.1 + 3.7e-4 * f64::from(k);
            let found = swing(|off_s| reading(now + off_s));
            let off = found.offset.expect("readings as they are") - s(now);
            assert!(off.abs() < 0.1 * play, "{k}: {off}");
            // four readings a turn miss each end by up to a quarter
            let part = found.range / play;
            assert!(part > 0.5 && part < 1.2, "{k}: {part}");
        }
        let still = swing(|off_s| 1.0 + off_s - 30.0 * off_s * off_s);
        assert!(still.range < 1e-12);
    }
}
