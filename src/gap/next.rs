//! Which motion would tell apart the effects that fit the recordings alike.
//!
//! What effect k, the one that was found, would have recorded in a motion e is simulated, and the model with rival j in its
//! place, fitted to the present recordings, is fitted to that:
//!
//! ```text
//! d²(e, j) = 2 min C_j(x; ŝ_k(e))        ln odds (e) = ½ min_j d²(e, j)        e* = argmax ln odds
//! ```
//!
//! with channels weighed as at present and x free, as if nothing were known of it but its priors: what the motion promises is
//! told from below. (Box and Hill 1967; Buzzi-Ferraris and Forzatti 1983.) Motions are made of the windows of the recordings,
//! their first states and commands changed, so that any machine can be asked; each is as long as what was recorded.

use std::sync::Arc;

use super::fitted::Fitted;
use super::name;
use super::result::{Expected, Experiment, Named, Untestable};
use super::screen::Screen;
use super::search::{ITERATIONS, Search, unbroken};
use super::windows::Windows;
use super::{GapError, Stage, Watch};

/// Rivals that are asked, those most alike.
const RIVALS: usize = 2;
/// Odds from which a motion tells effects apart.
const ODDS: f64 = 20.0;

/// A motion to simulate.
struct Motion {
    said: &'static str,
    /// of recorded commands
    command: f64,
    /// of recorded first velocities
    velocity: f64,
}

const fn motion(said: &'static str, command: f64, velocity: f64) -> Motion {
    Motion {
        said,
        command,
        velocity,
    }
}

const MOTIONS: [Motion; 7] = [
    motion("the recorded motions once more", 1.0, 1.0),
    motion(
        "the recorded motions half as fast, under half the commands",
        0.5,
        0.5,
    ),
    motion(
        "the recorded motions twice as fast, under twice the commands",
        2.0,
        2.0,
    ),
    motion(
        "from rest in the recorded postures, under the recorded commands",
        1.0,
        0.0,
    ),
    motion(
        "from rest in the recorded postures, under twice the commands",
        2.0,
        0.0,
    ),
    motion("motors off in the middle of the recorded motions", 0.0, 1.0),
    motion("let go at rest in the recorded postures", 0.0, 0.0),
];

impl Motion {
    /// Makes recorded windows those of this motion.
    fn begin(&self, windows: &mut Windows) {
        for trial in &mut windows.problem.trials {
            for (_, command) in Arc::make_mut(&mut trial.controls).iter_mut().flatten() {
                *command *= self.command;
            }
        }
        for state in &mut windows.states {
            for v in &mut state.qvel {
                *v *= self.velocity;
            }
        }
    }
}

/// What to record next; `effects` are those of `search`, of whose model `screen` is.
///
/// # Errors
/// The engine refuses a number; [`GapError::Stopped`].
pub(super) fn experiment(
    search: &Search<'_>,
    screen: &Screen,
    (effects, untestable): (&[Named], &[Untestable]),
    watch: &mut Watch<'_>,
) -> Result<Option<Experiment>, GapError> {
    let known = || name::next_experiment(effects, untestable);
    let Some(i) = effects.iter().position(|e| e.class.len() > 1) else {
        return Ok(known());
    };
    watch.stage(Stage::Name);
    let mut rivals: Vec<Fitted> = Vec::new();
    let other = search.by_other_name(i)?; // which no motion tells from it
    let mut class = effects[i].class.clone();
    class.retain(|name| !other.iter().any(|own| own.effect.about().name == name));
    for rival in name::class(search, screen, i) {
        if rivals.len() == RIVALS {
            break;
        }
        let Some(instead) = rival.chosen() else {
            continue;
        };
        if other.iter().any(|own| rival.is(own)) {
            continue;
        }
        if let Some(mut fitted) = search.fitted_instead(i, instead, f64::INFINITY, watch)? {
            fitted.improve(search, watch)?;
            rivals.push(fitted);
        }
    }
    if rivals.is_empty() {
        return Ok(known());
    }
    let mut expected = Vec::new();
    for (done, motion) in MOTIONS.iter().enumerate() {
        watch.part(done, MOTIONS.len());
        watch.go_on()?;
        let log_odds = search.log_odds(motion, &rivals, watch)?;
        expected.extend(log_odds.map(|log_odds| Expected {
            motion: motion.said.to_owned(),
            log_odds,
        }));
    }
    expected.sort_by(|a, b| b.log_odds.total_cmp(&a.log_odds));
    let best = expected.first();
    if let Some(best) = best.filter(|best| best.log_odds >= ODDS.ln()) {
        return Ok(Some(Experiment {
            effects: class.clone(),
            motion: best.motion.clone(),
            behaviours: name::behaviours_of(&class),
            expected,
        }));
    }
    // what was simulated is of this class alone
    let split = name::splitting(&class).map(|split| Experiment { expected, ..split });
    Ok(split.or_else(known))
}

impl Search<'_> {
    /// Of the present model in a motion against the likeliest of `rivals`; none where one of them cannot follow it.
    fn log_odds(
        &self,
        motion: &Motion,
        rivals: &[Fitted],
        watch: &mut Watch<'_>,
    ) -> Result<Option<f64>, GapError> {
        let mut recorded = self.windows.clone();
        motion.begin(&mut recorded);
        let Some(followed) = recorded.simulate(&self.x, &recorded.states)? else {
            return Ok(None);
        };
        recorded.have_recorded(&followed);
        let mut least: Option<f64> = None;
        for rival in rivals {
            let mut windows = recorded.clone();
            windows.problem = rival.built.problem(&recorded.problem)?;
            windows.measured = std::array::from_fn(|_| recorded.states.clone());
            let fit = unbroken(&mut windows, |own| {
                own.fit(&rival.x, ITERATIONS, &mut watch.fit_nearly())
            })?;
            let Some(fit) = fit else {
                return Ok(None);
            };
            let cost = fit.each.iter().sum();
            least = Some(least.map_or(cost, |least| least.min(cost)));
        }
        Ok(least)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::alike::Rival;
    use crate::gap::masses::{chosen, found, machine, searching};

    /// What to do next with a machine whose joint `a` is `hidden`, of which `own` was found and `other` is said to be alike:
    /// name, place and value of each.
    fn told(hidden: &str, own: (&str, &str, f64), other: (&str, &str, f64)) -> Experiment {
        let (base, hidden) = (machine("", ""), machine(hidden, ""));
        let of = |(name, at, value): (&str, &str, f64)| chosen(&base, name, at, &[value]);
        let mut told = None;
        searching(&base, &hidden, "", |search, watch| {
            found(search, &[of(own)], watch);
            search.evidence[0].alike = vec![Rival::of(&of(other), 1.0)];
            let screen = search.screened(watch).expect("screened");
            let effects = name::name(search, None, &screen, None);
            let next = experiment(search, &screen, (&effects, &[]), watch);
            told = next.expect("simulated");
        });
        told.expect("an experiment")
    }

    /// Drag goes with the square of the speed: the faster, the less it is like damping.
    #[test]
    fn a_motion_that_tells_more_is_chosen() {
        let (damping, drag) = (("viscous_friction", "a", 1.9), ("quadratic_drag", "a", 1.0));
        let next = told(r#"damping="2""#, damping, drag);
        assert_eq!(next.motion, next.expected[0].motion);
        let of = |said: &str| {
            let own = next.expected.iter().find(|e| e.motion.contains(said));
            own.expect("simulated").log_odds
        };
        let (once, twice) = (of("once more"), of("twice as fast"));
        assert!(twice > 2.0 * once && twice >= ODDS.ln(), "{once} {twice}");
    }

    /// Where forces do nothing but move it, a motor's rotor is a weakness of the motor.
    #[test]
    fn what_no_motion_tells_apart_is_said() {
        let (rotor, weak) = (("rotor_inertia", "a", 0.1), ("torque_gain", "ma", -0.15));
        let next = told(r#"armature=".1""#, rotor, weak);
        assert!(next.expected.iter().all(|e| e.log_odds < 0.1), "{next:?}");
        assert!(next.expected.iter().all(|e| e.motion != next.motion));
    }
}
