//! What held-out recordings say of an effect.
//!
//! Parameters, the effect's among them, stay as they were fitted; only first states of windows are estimated. Windows are
//! gathered in blocks of time, and the falls dᵦ of their costs are tested by ranks, one-sided (Wilcoxon 1945): a few blocks
//! may hold most of what an effect does.
//!
//! ```text
//! W = Σ rank |dᵦ| over dᵦ > 0        p = q (1 − ln q),  q = p₁ p₂
//! ```
//!
//! with p₁ the chance in the recordings that were fitted, times the number of candidates, and p₂ that of W, times the
//! number of effects that were fitted: both are independent where nothing is there (Fisher 1932).

use super::GapError;
use super::fit::Fitted;
use super::fitted::AtHand;
use super::score::{by_stretch, stretches};
use super::search::{ITERATIONS, Search, unbroken};
use super::windows::Windows;

/// Blocks, about.
const BLOCKS: usize = 16;
/// Part of the cost that noise is not taken to explain.
const UNEXPLAINED: f64 = 0.1;
/// How much likelier an effect has to make what is hardly more than noise.
const LIKELIER: f64 = 1e3;

/// Costs of held-out windows.
#[derive(Debug, Clone)]
pub(super) struct Held {
    /// of all, and of priors
    pub cost: f64,
    /// that the noise of the sensors explains
    noise: f64,
    /// the same if channels were weighed by that noise
    noise_alone: f64,
    /// of every window
    each: Vec<f64>,
    block_of: Vec<usize>,
}

impl Held {
    /// Of one window.
    #[cfg(test)]
    pub(super) fn of(cost: f64, noise: f64) -> Self {
        Self {
            cost,
            noise,
            noise_alone: noise,
            each: vec![cost],
            block_of: vec![0],
        }
    }

    /// Cost that the noise of the sensors does not explain: motions that show little of an effect are mostly noise.
    pub(super) fn unexplained(&self) -> f64 {
        unexplained(self.cost, self.noise)
    }

    /// Whether noise explains all that it may be taken to.
    pub(super) fn is_noise(&self) -> bool {
        is_noise(self.cost, self.noise)
    }

    /// Fall of the cost by which noise is [`LIKELIER`] times likelier: channels may weigh less than their noise lets them, and costs
    /// with them.
    pub(super) fn likelier(&self) -> f64 {
        LIKELIER.ln() * self.noise / self.noise_alone.max(f64::MIN_POSITIVE)
    }

    /// Chance of so much less than `before`.
    pub(super) fn chance(&self, before: &Self) -> f64 {
        let each = self.each.iter().zip(&before.each);
        let falls = each.map(|(after, before)| before - after);
        chance(&by_stretch(falls, &self.block_of))
    }
}

/// Whether held-out recordings cost less `after` than `before`, by more than `least` makes of these; they have no say where
/// there are none.
pub(super) fn falls(
    before: Option<&Held>,
    after: Option<&Held>,
    least: impl Fn(&Held) -> f64,
) -> bool {
    before.is_none_or(|before| after.is_some_and(|after| after.cost < before.cost - least(before)))
}

/// What is not noise of a cost, of which noise is not taken to explain all, whatever it is told to be.
pub(super) fn unexplained(cost: f64, noise: f64) -> f64 {
    (cost - noise).max(UNEXPLAINED * cost)
}

/// Whether noise explains all of a cost that it may be taken to.
pub(super) fn is_noise(cost: f64, noise: f64) -> bool {
    cost - noise <= UNEXPLAINED * cost
}

/// Of a sum of the ranks of all that fell like that of `falls`, or more, were either sign of each as likely.
fn chance(falls: &[f64]) -> f64 {
    let mut order: Vec<f64> = falls.to_vec();
    order.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
    let ranked = order.iter().enumerate().map(|(i, d)| (i + 1, *d));
    let sum: usize = ranked.filter(|(_, d)| *d > 0.0).map(|(rank, _)| rank).sum();
    // chance of every sum of ranks, one rank after the other
    let mut chances = vec![0.0; order.len() * (order.len() + 1) / 2 + 1];
    chances[0] = 1.0;
    for rank in 1..=order.len() {
        for s in (0..chances.len()).rev() {
            let with = if s < rank { 0.0 } else { chances[s - rank] };
            chances[s] = 0.5 * (chances[s] + with);
        }
    }
    chances[sum..].iter().sum()
}

/// Of two independent chances together.
pub(super) fn both(a: f64, b: f64) -> f64 {
    let q = (a * b).max(f64::MIN_POSITIVE);
    (q * (1.0 - q.ln())).min(1.0)
}

impl Search<'_> {
    /// Held-out recordings with parameters as fitted to `windows`, weighed like those, without what encoders show in the first
    /// `recorded_s` of each window; none without such recordings, or where the model does not follow them.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn held(&self, of: AtHand<'_>, recorded_s: f64) -> Result<Option<Held>, GapError> {
        let Some((held, fit)) = self.held_at(of, recorded_s)? else {
            return Ok(None);
        };
        let own = |name: &str| {
            let channels = &self.windows.problem.channels;
            channels.iter().position(|c| c.name == name)
        };
        let channels = held.problem.channels.iter();
        let own: Vec<Option<usize>> = channels.map(|c| own(&c.name)).collect();
        let samples = held.problem.samples();
        let read: Vec<usize> = samples.filter_map(|s| own[s.channel]).collect();
        let recording: Vec<usize> = held.origin.iter().map(|o| o.0).collect();
        let (_, windows, x) = of;
        Ok(Some(Held {
            cost: fit.cost + windows.problem.parameters.prior_cost(x),
            noise_alone: 0.5 * read.len() as f64,
            noise: self.noise_cost(read.into_iter()),
            each: fit.each,
            block_of: stretches(&recording, BLOCKS),
        }))
    }

    /// The windows of held-out recordings with their first states, and the fit of these; as [`Search::held`].
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn held_at(
        &self,
        (built, windows, x): AtHand<'_>,
        recorded_s: f64,
    ) -> Result<Option<(Windows, Fitted)>, GapError> {
        let held_out = self.held_out.as_ref();
        let Some(mut held) = held_out.and_then(|held| held.without_first(recorded_s)) else {
            return Ok(None);
        };
        let Ok(problem) = built.problem(&held.problem) else {
            return Ok(None);
        };
        held.problem = windows.held(&problem, x);
        // as the present model's, whichever is looked at
        for own in &self.windows.problem.channels {
            let mut channels = held.problem.channels.iter_mut();
            if let Some(channel) = channels.find(|channel| channel.name == own.name) {
                channel.sigma = own.sigma;
            }
        }
        // the least: which of these windows stick is not known
        let least = windows.factors.iter().copied().min().unwrap_or(1);
        held.factors.fill(least);
        let fit = unbroken(&mut held, |held| held.fit(&[], ITERATIONS, &mut |_| true))?;
        Ok(fit.map(|fit| (held, fit)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_that_agree_leave_little_to_chance() {
        assert!((chance(&[3.0, 40.0, 5.0, 0.1, 7.0]) - 0.5_f64.powi(5)).abs() < 1e-12);
        // as counted: of 32 choices of signs of the ranks 1 to 5, three have a sum of 13 or more
        assert!(
            (chance(&[3.0, -1.0, -0.5, 4.0, 5.0]) - chance(&[3.0, 4.0, 5.0, -0.5, -1.0])).abs()
                < 1e-12
        );
        assert!((chance(&[3.0, -2.0, 1.0, 4.0, 5.0]) - 3.0 / 32.0).abs() < 1e-12);
        assert!((chance(&[-1.0, -2.0]) - 1.0).abs() < 1e-12);
        assert!((chance(&[]) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn what_is_mostly_noise_falls_by_what_is_not() {
        let held = |cost| Held {
            cost,
            noise: 8.0,
            noise_alone: 8.0,
            each: Vec::new(),
            block_of: Vec::new(),
        };
        let before = held(20.0);
        let of_all = |held: &Held| 0.2 * held.cost;
        let of_rest = |held: &Held| 0.2 * held.unexplained();
        let both = |after| {
            let after = held(after);
            let before = Some(&before);
            [
                falls(before, Some(&after), of_all),
                falls(before, Some(&after), of_rest),
            ]
        };
        assert_eq!(both(17.5), [false, true]);
        assert_eq!(both(17.7), [false, false]);
        assert!(falls(None, None, of_rest) && !falls(Some(&before), None, of_rest));
        assert!((unexplained(20.0, 19.5) - 2.0).abs() < 1e-12);
    }

    /// Channels that weigh a hundredth make all costs a hundredth.
    #[test]
    fn noise_is_as_much_likelier_whatever_channels_weigh() {
        let weighed = |part: f64| Held {
            noise: part * 950.0,
            noise_alone: 950.0,
            ..Held::of(part * 1000.0, 0.0)
        };
        for part in [1.0, 0.01] {
            assert!(part * 7.0 > weighed(part).likelier());
            assert!(part * 6.8 < weighed(part).likelier());
        }
    }

    #[test]
    fn chances_together_are_a_chance() {
        // where both are even, so is theirs: a quarter of all pairs on a grid is below 1/4
        let n = 400;
        let even = |i: usize| (i as f64 + 0.5) / n as f64;
        let below = (0..n * n)
            .filter(|k| both(even(k / n), even(k % n)) < 0.25)
            .count();
        let part = below as f64 / (n * n) as f64;
        assert!((part - 0.25).abs() < 0.005, "{part}");
    }
}
