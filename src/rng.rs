//! Random streams that do not depend on who draws from them.
//!
//! A stream is a `ChaCha8` generator whose key is (seed, purpose, iteration) and whose stream number is the
//! trajectory index. A trajectory therefore sees the same numbers on any thread, in any order and on any machine.
//! The versions of the random crates are pinned in `Cargo.toml`, because they may change values in minor releases;
//! the test below would notice.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// The generator behind every random number of the program.
pub type Stream = ChaCha8Rng;

/// What a stream is used for; streams of different purposes are independent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// Start states and goals of training trajectories.
    Start = 1,
    /// Exploration noise.
    Exploration = 2,
    /// Model parameters of one rollout.
    Model = 3,
    /// Start states of evaluation rollouts.
    Evaluation = 4,
    /// Initial policy weights.
    Policy = 5,
    /// What a virtual rig hides: its parameters, effects and calibration errors.
    Rig = 6,
    /// Sensor noise of one trial of a rig.
    SensorNoise = 7,
    /// Phases of an excitation.
    Excitation = 8,
    /// Draws from the posterior of identified parameters.
    Posterior = 9,
    /// A swarm of simulations: how it begins, is drawn and moved.
    Swarm = 10,
}

/// The stream of (`seed`, `purpose`, `iteration`, `index`).
pub fn stream(seed: u64, purpose: Purpose, iteration: u64, index: u64) -> Stream {
    let mut key = [0_u8; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&iteration.to_le_bytes());
    key[16] = purpose as u8;
    let mut rng = ChaCha8Rng::from_seed(key);
    rng.set_stream(index);
    rng
}

/// One standard normal number.
pub fn normal(rng: &mut Stream) -> f64 {
    StandardNormal.sample(rng)
}

/// A number uniform from `low` to `high`; `high` itself comes up by rounding only, and never when `low` is 0.
pub fn uniform(rng: &mut Stream, low: f64, high: f64) -> f64 {
    use rand::Rng;
    // the 53 high bits, so that every double of the grid is equally likely
    let unit = (rng.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
    low + unit * (high - low)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_draws_never_change() {
        let mut rng = stream(7, Purpose::Exploration, 3, 11);
        let drawn = [normal(&mut rng), uniform(&mut rng, -1.0, 1.0)];
        assert_eq!(
            drawn,
            [-0.199_625_149_284_124_2, 0.543_575_120_915_265_7],
            "saved runs would not resume to the same bits"
        );
    }

    #[test]
    fn streams_differ_in_every_part_of_their_address() {
        let first = |s, p, k, i| normal(&mut stream(s, p, k, i)).to_bits();
        let base = first(1, Purpose::Start, 2, 3);
        assert_eq!(base, first(1, Purpose::Start, 2, 3));
        for other in [
            first(2, Purpose::Start, 2, 3),
            first(1, Purpose::Model, 2, 3),
            first(1, Purpose::Start, 3, 3),
            first(1, Purpose::Start, 2, 4),
        ] {
            assert_ne!(base, other);
        }
    }

    #[test]
    fn moments_of_the_normal_stream() {
        let mut rng = stream(0, Purpose::Exploration, 0, 0);
        let n = 100_000;
        let (mut sum, mut square) = (0.0, 0.0);
        for _ in 0..n {
            let x = normal(&mut rng);
            sum += x;
            square += x * x;
        }
        assert!((sum / f64::from(n)).abs() < 0.013);
        assert!((square / f64::from(n) - 1.0).abs() < 0.018);
    }
}
