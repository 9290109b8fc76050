//! Which effects the recordings ask for: forward and delete.
//!
//! From the fitted base model, effects are put in one at a time ([`super::forward`]). After each step effects that are no
//! longer needed go. It ends where no candidate is
//!
//! - significant: p × number of candidates below [`Limits::family_p`],
//! - of practical size: its response at least [`Limits::size`] of that of the motors, its gain at least
//!   [`Limits::gain`] of what the noise of the sensors does not explain of the cost,
//! - and of use where it was not fitted: held-out recordings, their first states alone estimated, cost a twentieth less, or are a
//!   thousand times likelier where they are nearly noise.

use std::borrow::Cow;

use nalgebra::DVector;

use super::candidate::Candidate;
use super::effect::{ModelFile, Place};
use super::evidence::Evidence;
use super::fitted::{AtHand, Fitted};
use super::linear::{Linear, Row};
use super::model::{Built, Chosen, Measured};
use super::score;
use super::screen::{Look, Screen};
use super::windows::Windows;
use super::{GapError, Stage, Watch, base};
use crate::sysid::SysidError;
use crate::sysid::parameter::ParameterRule;

/// What an effect has to reach.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// probability of any candidate by chance
    pub family_p: f64,
    /// response, as a part of that of the motors
    pub size: f64,
    /// fall of the cost, as a part of what noise does not explain of it
    pub gain: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            family_p: 0.001,
            size: 0.01,
            gain: 0.03,
        }
    }
}

impl Limits {
    /// Whether so little is left to chance.
    pub(super) fn significant(&self, p_value: f64) -> bool {
        p_value <= self.family_p
    }

    /// Whether a response is large; where there are no motors nothing says that it is not.
    pub(super) fn large(&self, size: Option<f64>) -> bool {
        size.is_none_or(|size| size >= self.size)
    }
}

/// Iterations of a fit after a small change.
pub(super) const ITERATIONS: usize = 12;
/// Iterations after which what is far behind, and falls no more, is given up.
pub(super) const FEW_ITERATIONS: usize = 3;
/// Times as many that a fit which still falls may take.
const MORE: usize = 4;
/// Iterations before shapes of a new effect are freed.
const HELD_ITERATIONS: usize = 3;
/// Chance that a kept effect is none, above which it goes.
const LEAVES: f64 = 0.01;

/// The search as it stands.
#[derive(Clone)]
pub(super) struct Search<'a> {
    pub base: &'a ModelFile,
    /// of the base model, see [`super::loose`]
    pub rules: Cow<'a, [ParameterRule]>,
    pub limits: Limits,
    /// names of those to look for; none: all
    pub effects: Vec<String>,
    pub windows: Windows,
    /// of the held-out recordings, if there are any
    pub held_out: Option<Windows>,
    pub stretch_of: Vec<usize>,
    /// of every channel, as told
    pub noise: Vec<f64>,
    pub measured: Measured,
    /// with the values fitted
    pub chosen: Vec<Chosen>,
    /// with the values that they were written into the model with
    pub written: Vec<Chosen>,
    /// evidence of each when it was chosen
    pub evidence: Vec<Evidence>,
    pub built: Built,
    pub x: Vec<f64>,
    pub cost: f64,
}

impl<'a> Search<'a> {
    /// Fits the base model, see [`super::base`].
    ///
    /// # Errors
    /// See [`Windows::fit`].
    pub(super) fn new(
        of: (&'a ModelFile, &'a [ParameterRule]),
        windows: Windows,
        limits: &(Limits, Vec<String>),
        watch: &mut Watch<'_>,
    ) -> Result<Self, GapError> {
        let (windows, noise, fit) = base::fit(windows, watch)?;
        Self::at(of, windows, limits.clone(), noise, (fit.x, fit.cost))
    }

    /// The search with the base model fitted.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn at(
        (base, rules): (&'a ModelFile, &'a [ParameterRule]),
        windows: Windows,
        (limits, effects): (Limits, Vec<String>),
        noise: Vec<f64>,
        (x, cost): (Vec<f64>, f64),
    ) -> Result<Self, GapError> {
        let measured = Measured::new(&windows.problem, &x, &windows.trajectories)?;
        Ok(Self {
            built: Built::new(base, rules, &[], &Measured::default())?,
            base,
            rules: Cow::Borrowed(rules),
            limits,
            effects,
            stretch_of: windows.stretches(),
            noise,
            measured,
            chosen: Vec::new(),
            written: Vec::new(),
            evidence: Vec::new(),
            x,
            cost,
            windows,
            held_out: None,
        })
    }

    /// Every candidate beside the present model; nothing if stopped.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn screen(&self, watch: &mut Watch<'_>) -> Result<Option<Screen>, GapError> {
        watch.stage(Stage::Screen);
        self.look().screen(&mut |done, of| watch.part(done, of))
    }

    /// The same where nothing goes on without it.
    ///
    /// # Errors
    /// The engine refuses a number; [`GapError::Stopped`].
    pub(super) fn screened(&self, watch: &mut Watch<'_>) -> Result<Screen, GapError> {
        self.screen(watch)?.ok_or(GapError::Stopped)
    }

    /// What a screen looks at.
    pub(super) fn look(&self) -> Look<'_> {
        Look {
            base: self.base,
            built: &self.built,
            windows: &self.windows,
            x: &self.x,
            measured: &self.measured,
            stretch_of: &self.stretch_of,
            only: &self.effects,
            taken: (self.chosen.iter())
                .map(|c| (c.effect.about().name, c.place.clone()))
                .collect(),
        }
    }

    /// Weighs the channels by what is left now, and fits again.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn settle(&mut self, watch: &mut Watch<'_>) -> Result<(), GapError> {
        self.windows.weigh(&self.x, &self.noise)?;
        self.hold_both_ways();
        let now = (&*self.x, &*self.noise);
        let fit = (self.windows).fit_weighed(now, ITERATIONS, |windows, x, most| {
            windows.fit(x, most, &mut watch.fit_nearly())
        })?;
        let fit = (self.windows).within_priors(fit, &self.noise, |windows, x| {
            windows.fit(x, ITERATIONS, &mut watch.fit_nearly())
        })?;
        self.chosen = self
            .built
            .values(&self.windows.problem, &fit.x, &self.chosen);
        (self.x, self.cost) = (fit.x, fit.cost);
        self.windows.choose_step(&self.x)?;
        Ok(())
    }

    /// Takes out the effects that are no longer needed; whether there was one.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn delete(&mut self, watch: &mut Watch<'_>) -> Result<bool, GapError> {
        let mut any = false;
        while self.chosen.len() > 1 {
            let normal = self.normal(&self.windows.linearise(&self.x)?);
            let mut weakest: Option<(f64, usize)> = None;
            for (i, _) in self.chosen.iter().enumerate() {
                let p = doubt(&self.sureness(&normal, i, None));
                if p > LEAVES && weakest.is_none_or(|(w, _)| p > w) {
                    weakest = Some((p, i));
                }
            }
            let Some((_, i)) = weakest else { break };
            let mut chosen = self.chosen.clone();
            chosen.remove(i);
            let Some(fitted) = self.fitted(&chosen, ITERATIONS, watch)? else {
                break;
            };
            self.evidence.remove(i);
            self.take(fitted);
            any = true;
        }
        Ok(any)
    }

    /// Sums of products of parameters alone, `linear` being at the present point.
    pub(super) fn normal(&self, linear: &Linear) -> score::Normal {
        self.normal_of(&linear.rows, &self.x)
    }

    /// The same of rows at `x`.
    pub(super) fn normal_of(&self, rows: &[Row], x: &[f64]) -> score::Normal {
        let prior: Vec<(f64, f64)> = (self.windows.problem.parameters.prior_slopes(x)).collect();
        score::Normal::new(rows, &[], &self.stretch_of, &prior)
    }

    /// Square that the sensors' noise gives a residual of a channel.
    pub(super) fn noise_square(&self, channel: usize) -> f64 {
        (self.noise[channel] / self.windows.problem.channels[channel].sigma).powi(2)
    }

    /// Cost that the sensors' noise gives readings of these channels.
    pub(super) fn noise_cost(&self, channels: impl Iterator<Item = usize>) -> f64 {
        channels.map(|c| 0.5 * self.noise_square(c)).sum()
    }

    /// The present model.
    pub(super) fn at_hand(&self) -> AtHand<'_> {
        (&self.built, &self.windows, &self.x)
    }

    /// (t, degrees of freedom) of every size of an effect in the model, `step` being what the model's own step makes of
    /// parameters. Shapes are held: without the effect they mean nothing, and whether it is there is not asked by how well
    /// its size is known beside them (Davies 1977).
    pub(super) fn sureness(
        &self,
        normal: &score::Normal,
        effect: usize,
        step: Option<&DVector<f64>>,
    ) -> Vec<(f64, f64)> {
        let (normal, sizes) = self.sizes(normal, effect);
        let each = sizes.iter().map(|size| {
            let (sigma, dof) = normal.fitted(size.at);
            let by_step = step.map_or(0.0, |dx| dx[size.free].abs());
            ((size.x.abs() - by_step).max(0.0) / sigma, dof)
        });
        each.collect()
    }

    /// `normal` with the shapes of an effect held, and the sizes of it.
    pub(super) fn sizes(
        &self,
        normal: &score::Normal,
        effect: usize,
    ) -> (score::Normal, Vec<Size>) {
        let problem = &self.windows.problem;
        let shapes = self.built.shapes(problem, &self.chosen);
        let held: Vec<usize> = (shapes.filter(|s| s.1 == effect)).map(|s| s.0).collect();
        let chosen = &self.chosen[effect];
        let parameters = chosen.effect.about().parameters;
        let free = self.built.free(problem).into_iter();
        let own = free.filter(|f| f.1 == effect && parameters[f.2].is_size());
        let sizes = own.map(|(free, _, p, slope)| Size {
            free,
            at: free - held.iter().filter(|h| **h < free).count(),
            x: chosen.values[p] / slope,
        });
        (normal.holding(&held), sizes.collect())
    }

    /// The model with these effects, fitted; nothing if it cannot be. Shapes of those that are not in the present model
    /// are held at first: until its size fits, another period or speed than an effect's own may fit better.
    pub(super) fn fitted(
        &self,
        chosen: &[Chosen],
        iterations: usize,
        watch: &mut Watch<'_>,
    ) -> Result<Option<Fitted>, GapError> {
        self.fitted_after(None, chosen, (iterations, f64::INFINITY), watch)
    }

    /// The present model with more effects, as the screen of it expects them and all parameters with them.
    pub(super) fn fitted_with(
        &self,
        more: &[&Candidate],
        screen: &Screen,
        effort: Effort,
        watch: &mut Watch<'_>,
    ) -> Result<Option<Fitted>, GapError> {
        let mut chosen = self.chosen.clone();
        chosen.extend(more.iter().map(|c| c.chosen()));
        let columns: Vec<usize> = more
            .iter()
            .flat_map(|c| c.columns.iter().copied())
            .collect();
        let step = screen.normal.step(&columns);
        self.fitted_after(Some((&step, &screen.linear)), &chosen, effort, watch)
    }

    /// As [`Search::fitted`] with a fit that starts after a step of the base model's parameters: where they stood for an
    /// effect to one part in a thousand, as masses do for a motor's gain, the model is far from all recordings until they
    /// give way. First states follow by the present model's derivatives: where a joint now sticks they would lead astray.
    pub(super) fn fitted_after(
        &self,
        step: Option<(&[f64], &Linear)>,
        chosen: &[Chosen],
        (iterations, bound): Effort,
        watch: &mut Watch<'_>,
    ) -> Result<Option<Fitted>, GapError> {
        let Ok(built) = Built::new(self.base, &self.rules, chosen, &self.measured) else {
            return Ok(None);
        };
        let mut windows = self.windows.clone();
        let Ok(problem) = built.problem(&windows.problem) else {
            return Ok(None);
        };
        windows.problem = problem;
        let n_base =
            self.windows.problem.parameters.len() - self.built.free(&self.windows.problem).len();
        let mut x = windows.problem.parameters.start();
        x[..n_base].copy_from_slice(&self.x[..n_base]);
        if let Some((step, linear)) = step {
            let reach = self.windows.problem.parameters.reach(&self.x);
            for ((x, d), (low, high)) in x[..n_base].iter_mut().zip(step).zip(reach) {
                *x += d.max(low).min(high);
            }
            if unbroken(&mut windows, |own| own.move_states(&x, linear))?.is_none() {
                return Ok(None);
            }
        }
        let new = |c: &Chosen| !self.has(c.effect.about().name, &c.place);
        if let Some(held) = built.holding_shapes(chosen, new) {
            let Ok(some) = held.problem(&self.windows.problem) else {
                return Ok(None);
            };
            let whole = std::mem::replace(&mut windows.problem, some);
            let of = |f: &usize| whole.parameters.free.iter().position(|own| own == f);
            let own: Vec<usize> = (windows.problem.parameters.free.iter())
                .filter_map(of)
                .collect();
            let from: Vec<f64> = own.iter().map(|i| x[*i]).collect();
            let fit = unbroken(&mut windows, |own| {
                own.fit_below(bound, &from, HELD_ITERATIONS, &mut watch.fit_nearly())
            })?;
            let Some(fit) = fit else {
                return Ok(None);
            };
            for (i, value) in own.into_iter().zip(fit.x) {
                x[i] = value;
            }
            windows.problem = whole;
        }
        let most = ITERATIONS.min(MORE * iterations);
        let fit = unbroken(&mut windows, |own| {
            own.fit_below(bound, &x, most, &mut watch.fit_while_falling(iterations))
        })?;
        let Some(fit) = fit else {
            return Ok(None);
        };
        let values = built.values(&windows.problem, &fit.x, chosen);
        let cost = self.rated((&windows, &fit.x, fit.cost), &values, watch)?;
        Ok(Some(Fitted {
            chosen: values,
            written: chosen.to_vec(),
            built,
            x: fit.x,
            itself: fit.cost,
            cost,
            windows,
        }))
    }

    /// With a fitted model in the place of the present one.
    pub(super) fn with(&self, fitted: Fitted) -> Self {
        let mut then = self.clone();
        then.take(fitted);
        then
    }

    /// The same, settled.
    ///
    /// # Errors
    /// See [`Search::settle`].
    pub(super) fn settled_with(
        &self,
        fitted: Fitted,
        watch: &mut Watch<'_>,
    ) -> Result<Self, GapError> {
        let mut then = self.with(fitted);
        then.settle(watch)?;
        Ok(then)
    }

    /// Whether one of the effects `chosen` of a model has numbers that no machine has, or beside others hardly a shape.
    pub(super) fn absurd(&self, built: &Built, chosen: &[Chosen]) -> bool {
        chosen.iter().any(|c| {
            let scales = self.measured.scales(&built.file.model, &c.place);
            c.absurd(&scales) || (chosen.len() > 1 && c.has_few_periods(&scales))
        })
    }

    /// Makes a fitted model the present one.
    pub(super) fn take(&mut self, fitted: Fitted) {
        (self.chosen, self.written) = (fitted.chosen, fitted.written);
        self.built = fitted.built;
        self.windows = fitted.windows;
        self.x = fitted.x;
        self.cost = fitted.itself;
    }

    /// Whether an effect is in the model.
    pub(super) fn has(&self, name: &str, place: &Place) -> bool {
        self.chosen
            .iter()
            .any(|c| c.effect.about().name == name && c.place == *place)
    }
}

/// Iterations of a fit, and the cost below which it has to be foretold to end.
pub(super) type Effort = (usize, f64);

/// What came of windows; nothing where the model follows none.
pub(super) fn sound<T>(of: Result<T, SysidError>) -> Result<Option<T>, GapError> {
    match of {
        Ok(of) => Ok(Some(of)),
        Err(SysidError::Mujoco(error)) => Err(GapError::Sysid(error.into())),
        Err(_) => Ok(None),
    }
}

/// What a fit finds in `windows`; nothing where the model breaks down, be it in one of them.
pub(super) fn unbroken<T>(
    windows: &mut Windows,
    fit: impl FnOnce(&mut Windows) -> Result<T, SysidError>,
) -> Result<Option<T>, GapError> {
    let whole = windows.len();
    let found = sound(fit(windows))?;
    Ok(found.filter(|_| windows.len() == whole))
}

/// Probability that an effect in the model is nothing: of its surest size. 0 for one without a number.
pub(super) fn doubt(sureness: &[(f64, f64)]) -> f64 {
    let each = sureness.iter().map(|(t, dof)| score::two_sided(*t, *dof));
    each.reduce(f64::min).unwrap_or(0.0)
}

/// A size of an effect in the model.
pub(super) struct Size {
    /// among the free parameters
    pub free: usize,
    /// among them, the shapes of the effect left out
    pub at: usize,
    /// how far it is from 0
    pub x: f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::masses::{chosen, machine, searching};

    /// Cogging, whose period is held at first, beside a last window that begins where the engine gives up.
    #[test]
    fn an_effect_with_which_a_window_breaks_down_is_not_fitted() {
        let base = machine("", "");
        searching(&base, &base, "", |search, watch| {
            let cogging = [chosen(&base, "cogging", "a", &[0.1, 0.1, 40.0])];
            let fitted = search.fitted(&cogging, ITERATIONS, watch);
            assert!(fitted.expect("fitted").is_some());
            let last = search.windows.states.last_mut().expect("windows");
            last.qpos[0] = 1e11;
            let fitted = search.fitted(&cogging, ITERATIONS, watch);
            assert!(fitted.expect("given up").is_none());
        });
    }
}
