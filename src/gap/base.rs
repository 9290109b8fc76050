//! The base model, fitted with channels weighed by what is left of them ([`super::weigh`]).
//!
//! Parameters that would have to explain missing physics do not leave what their priors allow. Where they end depends on the
//! first weights: by what nominal numbers leave, or by what is left when all but noise is explained, which may lead past all
//! priors. Of both fits the one is taken whose parameters are nearer to their priors, as the other has explained more by
//! them than they can. But a fit that is lost, with windows that end at a stop which the machine never met, leaves parameters
//! alone too, as hardly anything weighs in it. So the one that leaves less than half is taken where chance allows its priors, or
//! where it leaves no more than noise:
//!
//! ```text
//! mean ln σ < mean ln σ' − ln 2    and    (½ Σ z² ≤ n  or  all σ ≤ 2 noise)
//! ```
//!
//! with σ, σ' of the channels in the two fits and z the n distances from priors, in standard deviations. Without priors the fit
//! from the noise alone is made. The few windows that meet a limit where the model is lost are left out of it ([`super::limits`]).

use super::fit::Fitted;
use super::weigh::{FAR, ROUGH_ITERATIONS};
use super::windows::Windows;
use super::{GapError, Watch};

/// Iterations of a fit.
const ITERATIONS: usize = 40;

/// How well a fit ended.
#[derive(Debug, Clone, Copy)]
struct End {
    /// cost of the priors
    prior: f64,
    /// mean logarithm of the channels' standard deviations
    left: f64,
    /// whether that is more than noise
    misfit: bool,
}

impl End {
    fn of(windows: &Windows, fit: &Fitted, noise: &[f64]) -> Self {
        let channels = &windows.problem.channels;
        let sum: f64 = channels.iter().map(|c| c.sigma.ln()).sum();
        Self {
            prior: windows.problem.parameters.prior_cost(&fit.x),
            left: sum / channels.len().max(1) as f64,
            misfit: windows.misfit(noise),
        }
    }

    /// Whether a fit that ended so is to be preferred to one that ended like `other`, with so many priors.
    fn is_better(self, other: Self, n_priors: usize) -> bool {
        let found = |own: Self, lost: Self| {
            let may_be = !own.misfit || own.prior <= n_priors as f64;
            own.left < lost.left - FAR.ln() && may_be
        };
        found(self, other) || (!found(other, self) && self.prior < other.prior)
    }
}

/// Fits the base model to `windows` from where its parameters start. The windows, weighed, with the noise of channels as they
/// were told, and the fit.
///
/// # Errors
/// See [`Windows::fit`].
pub(super) fn fit(
    mut windows: Windows,
    watch: &mut Watch<'_>,
) -> Result<(Windows, Vec<f64>, Fitted), GapError> {
    let noise = windows.problem.sigma();
    let start = windows.problem.parameters.start();
    windows.choose_step(&start)?;
    windows.followed(&start)?;
    let mut explained = windows.clone();
    let rough = explained.fit(&start, ROUGH_ITERATIONS, &mut |i| watch.fit(i))?;
    explained.weigh(&rough.x, &noise)?;
    let mut fitted = |mut windows: Windows, x: &[f64]| {
        let from = (x, &*noise);
        let fit = windows.fit_weighed(from, ITERATIONS, |windows, x, most| {
            windows.fit(x, most, &mut |i| watch.fit(i))
        })?;
        Ok::<_, GapError>((End::of(&windows, &fit, &noise), windows, fit))
    };
    let mut best = fitted(explained, &start)?;
    let free = windows.problem.parameters.iter_free();
    let n_priors = free.filter(|p| p.has_prior()).count();
    if n_priors > 0 {
        windows.weigh(&start, &noise)?;
        let other = fitted(windows, &start)?;
        if other.0.is_better(best.0, n_priors) {
            best = other;
        }
    }
    let (_, mut windows, mut fit) = best;
    if let Some(others) = windows.off_limits(&fit.each) {
        (_, windows, fit) = fitted(windows.only(&others), &fit.x)?;
    }
    let fit = windows.within_priors(fit, &noise, |windows, x| {
        windows.fit(x, ITERATIONS, &mut |i| watch.fit(i))
    })?;
    windows.choose_step(&fit.x)?;
    Ok((windows, noise, fit))
}

#[cfg(test)]
mod tests {
    use super::End;

    /// Ends of fits of fingers, 11 priors: what another leaves is not much less, or explained by parameters that cannot be.
    #[test]
    fn priors_decide_unless_a_fit_is_lost() {
        let end = |prior: f64, left: f64| End {
            prior,
            left,
            misfit: left > -9.5,
        };
        // (the better, the other)
        let pairs = [
            // lost: windows ended at a stop
            (end(1.50, -9.39), end(1.32, -4.61)),
            // masses that stand for a motor's gain
            (end(2.45, -5.01), end(16.46, -5.07)),
            // and for the asymmetry of a friction
            (end(1.50, -4.19), end(60.1, -5.56)),
            // and, a little, for a spring
            (end(4.74, -4.29), end(9.04, -4.61)),
            // a number far from its prior, and nothing else
            (end(20.0, -9.7), end(1.0, -4.0)),
        ];
        for (better, other) in pairs {
            assert!(better.is_better(other, 11) && !other.is_better(better, 11));
        }
    }
}
