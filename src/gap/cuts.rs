//! The recordings in windows that the model follows.
//!
//! A missing force f moves a joint of inertia M by f T²/M within a window of length T. Long windows show small forces best, and
//! large ones not at all: where a light joint sticks, or ends at a stop, a model that lacks it leaves a window of 0.2 s by more
//! than the joint ever moves, and derivatives there say nothing of the machine. How far a model is astray is
//!
//! ```text
//! astray = max over channels  rms(ŝ − s)/sd(s)  ~ T²
//! ```
//!
//! The base model is therefore fitted to windows that are shorter by as many halves as it takes, and windows are made longer again
//! once an effect is found, as far as the model with it follows: then small effects beside a large one show. What does not bring
//! the model to follow is not what is missing, however well it fits in short windows: readings that are late by most of one
//! are there whatever the model does.
//!
//! First states are projected out of what is astray. Where a machine runs away from a ridge of its forces, as a light joint does that
//! cogs, what is measured of them is too far off for that, and they are fitted: with such a cogging 0.10 becomes 0.010 in windows of
//! 0.2 s, without it 0.26 is 0.24.

use std::sync::Arc;

use super::inputs::{judged, same_channels};
use super::run::{Input, Options};
use super::search::{Search, unbroken};
use super::windows::{self, Windows};
use super::{GapError, Watch};
use crate::sysid::SysidError;
use crate::sysid::problem::{Problem, Stage};

/// From where on a model is lost.
const ASTRAY: f64 = 0.1;
/// How far it shall be in windows that were made shorter.
const NEAR: f64 = 0.006;
/// Halves that a window is made shorter by at once, at most.
const HALVES: f64 = 6.0;
/// Iterations of a fit of first states alone.
const STATES_ITERATIONS: usize = 5;
/// Readings of a channel that a shorter window has at least.
const READINGS: f64 = 10.0;
/// Noises by which a channel changes at least: what hardly moves is as far astray as its noise.
const MOVES: f64 = 100.0;
/// Factor by which windows that are made longer are longer at least.
const LONGER: f64 = 1.5;

/// Recordings to be cut into windows.
pub(super) struct Cuts {
    /// the training recordings
    pub whole: Problem,
    held_out: Option<Problem>,
    most_windows: usize,
    /// s of the windows that suit the readings
    pub length_s: f64,
    /// whether someone has chosen that
    chosen: bool,
}

impl Cuts {
    /// Of the recordings of `input`, in windows that `options` ask for or that suit the readings.
    ///
    /// # Errors
    /// Input that does not fit together.
    pub(super) fn new(input: &Input<'_>, options: &Options) -> Result<Self, GapError> {
        let config = judged(input)?;
        let of = |all| Problem::new(Arc::clone(&input.model.model), &config, all);
        let whole = of(input.train)?;
        same_channels(&whole, &config, input)?;
        // what cannot be estimated from is compared all the same
        let held_out = if input.holdout.is_empty() {
            None
        } else {
            of(input.holdout).ok()
        };
        Ok(Self {
            length_s: (options.window_s).unwrap_or_else(|| windows::length_s(&whole)),
            chosen: options.window_s.is_some(),
            held_out,
            most_windows: options.most_windows,
            whole,
        })
    }

    /// Windows of the training recordings.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn train(&self, length_s: f64) -> Result<Windows, SysidError> {
        let start = self.whole.parameters.start();
        Windows::cut(&self.whole, &start, length_s, self.most_windows)
    }

    /// Windows of the held-out recordings, if there are any.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn held_out(&self, length_s: f64) -> Result<Option<Windows>, SysidError> {
        let cut = |problem: &Problem| {
            let start = problem.parameters.start();
            Windows::cut(problem, &start, length_s, self.most_windows.div_ceil(2))
        };
        self.held_out.as_ref().map(cut).transpose()
    }

    /// Windows of the training recordings that the base model follows from where its parameters start.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn followed(&self) -> Result<Windows, SysidError> {
        let start = self.whole.parameters.start();
        let noise = self.whole.sigma();
        let astray_in = |windows: &Windows| {
            let mut own = windows.clone();
            own.begin_as_measured(&start)?;
            own.astray(&start, &noise)
        };
        let mut windows = self.train(self.length_s)?;
        if self.chosen {
            return Ok(windows);
        }
        let mut astray = astray_in(&windows)?;
        let least_s = READINGS * self.interval_s();
        while astray >= ASTRAY {
            let mut length_s = shorter(windows.length_s, astray);
            while length_s < least_s {
                length_s *= 2.0;
            }
            if length_s >= windows.length_s {
                break;
            }
            let less = self.train(length_s)?;
            let left = astray_in(&less)?;
            // what does not grow with the length of windows is no force
            if left >= astray * length_s / windows.length_s {
                break;
            }
            (windows, astray) = (less, left);
        }
        Ok(windows)
    }

    /// s between readings of the channel that has fewest.
    fn interval_s(&self) -> f64 {
        let mut counts = vec![0_usize; self.whole.channels.len()];
        for sample in self.whole.samples() {
            counts[sample.channel] += 1;
        }
        let steps: usize = self.whole.trials.iter().map(|t| t.n_knots - 1).sum();
        let fewest = counts.into_iter().filter(|n| *n > 0).min().unwrap_or(1);
        steps as f64 * self.whole.model.timestep() / fewest as f64
    }
}

/// s of windows in which a model is likely to be near that is `astray` in windows of `length_s`.
fn shorter(length_s: f64, astray: f64) -> f64 {
    let halves = (0.5 * (astray / NEAR).log2()).ceil();
    length_s * (-halves.clamp(1.0, HALVES)).exp2()
}

impl Search<'_> {
    /// Goes on in windows that are longer, if the model follows them; whether it does.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn lengthen(
        &mut self,
        cuts: &Cuts,
        watch: &mut Watch<'_>,
    ) -> Result<bool, GapError> {
        let mut length_s = cuts.length_s;
        while length_s >= LONGER * self.windows.length_s {
            // a fit that needs no other states ends sooner from those of the first step
            let mut windows = self.cut(cuts, length_s)?;
            let mut begun = windows.clone();
            begun.begin_as_measured(&self.x)?;
            windows.factors.clone_from(&begun.factors);
            let mut astray = begun.astray(&self.x, &self.noise)?;
            if astray >= ASTRAY && begun.fit_states(&self.x, watch)? {
                astray = begun.astray(&self.x, &self.noise)?;
                windows = begun;
            }
            if astray < ASTRAY {
                self.go_on_in(windows, cuts)?;
                self.settle(watch)?;
                return Ok(true);
            }
            length_s = shorter(length_s, astray);
        }
        Ok(false)
    }

    /// Takes other windows, and of the held-out recordings those of their length.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn go_on_in(&mut self, windows: Windows, cuts: &Cuts) -> Result<(), GapError> {
        if self.windows.length_s != windows.length_s {
            self.held_out = cuts.held_out(windows.length_s)?;
        }
        self.stretch_of = windows.stretches();
        self.windows = windows;
        Ok(())
    }

    /// Windows of another length for the present model.
    fn cut(&self, cuts: &Cuts, length_s: f64) -> Result<Windows, GapError> {
        let mut windows = cuts.train(length_s)?;
        windows.problem = self.built.problem(&windows.problem)?;
        windows.problem.take_sigma(&self.windows.problem.sigma());
        Ok(windows)
    }
}

impl Windows {
    /// Takes first states as they were measured, of each window that from which the model stays nearer to its readings, and the step
    /// of derivatives that suits the model.
    fn begin_as_measured(&mut self, x: &[f64]) -> Result<(), SysidError> {
        self.choose_step(x)?;
        let all = self.all();
        let mut best = vec![None; self.len()];
        for way in &self.measured {
            self.nearer(x, way, &all, &mut best)?;
        }
        for (state, best) in self.states.iter_mut().zip(best) {
            if let Some(own) = best {
                *state = own.state;
            }
        }
        Ok(())
    }

    /// Fits first states alone, parameters at `x`; whether the model follows all windows, which else stay as they are.
    fn fit_states(&mut self, x: &[f64], watch: &mut Watch<'_>) -> Result<bool, GapError> {
        let mut own = self.holding(x);
        let fit = unbroken(&mut own, |own| {
            own.fit(&[], STATES_ITERATIONS, &mut watch.fit_nearly())
        })?;
        let follows = fit.is_some();
        if follows {
            self.states = own.states;
        }
        Ok(follows)
    }

    /// How far a model with parameters `x` leaves the motion from its first states, see the module, `noise` being that of every
    /// channel; where it does not get through, infinitely far.
    ///
    /// # Errors
    /// The engine refuses a number.
    fn astray(&self, x: &[f64], noise: &[f64]) -> Result<f64, SysidError> {
        let linear = match self.linearise(x) {
            Ok(linear) => linear,
            Err(SysidError::Mujoco(error)) => return Err(error.into()),
            Err(_) => return Ok(f64::INFINITY),
        };
        let channels = &self.problem.channels;
        let mut readings = vec![[0.0; 3]; channels.len()];
        for sample in self.problem.samples() {
            let own = [1.0, sample.value, sample.value.powi(2)];
            for (sum, own) in readings[sample.channel].iter_mut().zip(own) {
                *sum += own;
            }
        }
        let deviations = linear.by_channel(linear.rows.iter().map(|row| &row.residual));
        let each = (channels.iter().zip(noise)).zip(readings.into_iter().zip(deviations));
        let positions =
            each.filter(|((c, _), (sums, _))| c.stage == Stage::Position && sums[0] > 0.0);
        Ok(positions
            .map(|((c, noise), ([n, sum, squares], deviations))| {
                let variance = (squares / n - (sum / n).powi(2)).max(0.0);
                let moves = variance.sqrt().max(MOVES * noise);
                c.sigma * (deviations / n).sqrt() / moves
            })
            .fold(0.0, f64::max))
    }
}

#[cfg(test)]
mod tests {
    use super::{ASTRAY, NEAR, Search, Watch, Windows, shorter};
    use crate::gap::effect::write;
    use crate::gap::masses::{chosen, found, machine, searching_cut};

    const CONFIG: &str = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"armature\"\nscale = \"linear\"\n\
                          prior_sigma = 0.02\n";

    #[test]
    fn windows_are_halved_until_little_is_astray() {
        let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
        assert!(near(shorter(0.2, 4.0 * NEAR), 0.1) && near(shorter(0.2, 15.0 * NEAR), 0.05));
        // whatever comes next is shorter
        assert!(near(shorter(0.2, 0.1 * NEAR), 0.1));
        assert!(shorter(0.2, ASTRAY) < 0.1);
        assert!(shorter(0.2, f64::INFINITY) > 0.0);
    }

    /// A spring under which a mass goes to and fro several times in a window.
    #[test]
    fn windows_are_as_long_as_the_model_follows() {
        let base = machine("", "");
        let spring = chosen(&base, "joint_spring", "a", &[600.0, 0.0]);
        let hidden = write(&base, spring.effect, &spring.place, &spring.values).expect("written");
        searching_cut(&base, &hidden.file, CONFIG, |search, cuts, watch| {
            let short_s = search.windows.length_s;
            assert!(short_s < 0.5 * cuts.length_s, "{short_s}");
            assert!(short_s >= super::READINGS * cuts.interval_s());
            assert!(!search.lengthen(cuts, watch).expect("looked at"));
            assert_eq!(search.windows.length_s, short_s);
            found(search, std::slice::from_ref(&spring), watch);
            assert!(search.lengthen(cuts, watch).expect("looked at"));
            assert_eq!(search.windows.length_s, cuts.length_s);
            assert_eq!(search.stretch_of.len(), search.windows.len());
            let stiffness = search.chosen[0].values[0];
            assert!((stiffness / 600.0 - 1.0).abs() < 1e-3, "{stiffness}");
        });
    }

    /// A mass that runs off ridges: what is measured of its first states is too far off for the right law, which follows once they are
    /// fitted; to a model without ridges they are no help.
    #[test]
    fn a_right_model_is_near_from_states_that_are_fitted() {
        let base = machine(r#"stiffness="20""#, "");
        let ridges = chosen(&base, "cogging", "a", &[13.0, 0.0, 60.0]);
        let hidden = write(&base, ridges.effect, &ridges.place, &ridges.values).expect("written");
        // parameters are known: nothing but first states can be off
        let known = CONFIG.replace("0.02", "1e-6");
        searching_cut(&base, &hidden.file, &known, |search, cuts, watch| {
            let astray = |search: &Search<'_>, watch: &mut Watch<'_>| {
                let mut windows = search.cut(cuts, cuts.length_s).expect("cut");
                windows.begin_as_measured(&search.x).expect("simulated");
                let of = |windows: &Windows| windows.astray(&search.x, &search.noise);
                let measured = of(&windows).expect("simulated");
                assert!(windows.fit_states(&search.x, watch).expect("fitted"));
                (measured, of(&windows).expect("simulated"))
            };
            let without = astray(search, watch);
            assert!(without.1 > 0.9 * without.0, "{without:?}");
            let fits = search.fitted(std::slice::from_ref(&ridges), 0, watch);
            search.take(fits.expect("fitted").expect("follows"));
            let with = astray(search, watch);
            assert!(with.1 < 0.1 * with.0, "{with:?}");
        });
    }

    #[test]
    fn what_a_model_follows_stays_as_it_suits_the_readings() {
        let base = machine("", "");
        let light = machine("", r#"armature=".05" damping=".2""#);
        searching_cut(&base, &light, CONFIG, |search, cuts, _| {
            assert_eq!(search.windows.length_s, cuts.length_s);
        });
    }
}
