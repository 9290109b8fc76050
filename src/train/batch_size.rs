//! A batch that grows as the gradient drowns in its noise.
//!
//! The natural gradients of even and odd trajectories share their signal and not their noise. With a half-batch signal
//! to noise ratio s (of squared lengths), the cosine between them is
//!
//! ```text
//! c = s / (1 + s),    s in proportion to the number of trajectories
//! ```
//!
//! One cosine is itself uncertain by about 1/√(number of parameters), so a running mean of it is followed: as long as
//! that is below `growth_cosine`, each batch is larger than the last by 5 %, up to `max_trajectories`.

use serde::{Deserialize, Serialize};

use super::config::ScheduleConfig;

/// Growth from one iteration to the next.
const GROWTH: f64 = 1.05;
/// Weight of the latest cosine in the running mean.
const LATEST: f64 = 0.25;

/// Size of the next batch; part of a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatchSize {
    /// trajectories of the next batch, before rounding
    size: f64,
    /// running mean of the half-batch cosine; 1 at the start
    cosine: f64,
}

impl BatchSize {
    /// Begin with `trajectories`.
    pub fn new(trajectories: usize) -> Self {
        Self {
            size: trajectories as f64,
            cosine: 1.0,
        }
    }

    /// Trajectories of the next batch.
    pub fn n_trajectory(&self) -> usize {
        self.size.round() as usize
    }

    /// Take note of an iteration's half-batch cosine (not a number: left out).
    pub fn follow(&mut self, half_cosine: f64, config: &ScheduleConfig) {
        if !half_cosine.is_finite() {
            return;
        }
        self.cosine += LATEST * (half_cosine - self.cosine);
        if config.growth_cosine > 0.0 && self.cosine < config.growth_cosine {
            // a batch that is larger by configuration stays
            let limit = (config.max_trajectories as f64).max(self.size);
            self.size = (self.size * GROWTH).min(limit);
        }
    }

    /// Whether the numbers make sense, for a file.
    pub fn is_sound(&self) -> bool {
        self.size.is_finite() && self.size >= 0.5 && self.cosine.is_finite()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grows_while_the_halves_disagree_and_only_then() {
        let config = ScheduleConfig {
            max_trajectories: 200,
            growth_cosine: 0.2,
            ..ScheduleConfig::default()
        };
        let mut size = BatchSize::new(100);
        for _ in 0..20 {
            size.follow(0.5, &config);
        }
        assert_eq!(size.n_trajectory(), 100);
        for _ in 0..100 {
            let before = size.n_trajectory();
            size.follow(f64::NAN, &config);
            assert_eq!(size.n_trajectory(), before, "no news");
            size.follow(0.05, &config);
        }
        assert_eq!(size.n_trajectory(), 200);
        for _ in 0..20 {
            size.follow(0.5, &config);
        }
        assert_eq!(size.n_trajectory(), 200, "does not shrink");
    }

    #[test]
    fn a_configured_batch_above_the_limit_stays() {
        let config = ScheduleConfig {
            max_trajectories: 50,
            growth_cosine: 0.2,
            ..ScheduleConfig::default()
        };
        let mut size = BatchSize::new(100);
        for _ in 0..50 {
            size.follow(0.0, &config);
        }
        assert_eq!(size.n_trajectory(), 100);
        let off = ScheduleConfig::default();
        for _ in 0..50 {
            size.follow(-0.5, &off);
        }
        assert_eq!(size.n_trajectory(), 100, "growth is off unless asked for");
    }
}
