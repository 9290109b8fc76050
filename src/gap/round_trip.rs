//! The repaired model, simulated and searched again.
//!
//! Some of its windows, from the first states and under the commands of the training recordings, with as much noise as the
//! sensors have: nothing more must be found, and the effects' numbers must come back.

use std::sync::Arc;

use super::effect::Role;
use super::model::Chosen;
use super::result::{Returned, RoundTrip};
use super::search::Search;
use super::{GapError, Watch};
use crate::rng::{self, Purpose};
use crate::sysid::student::two_sided_t;

/// Most windows that are looked at: what is simulated holds no surprises, as a shock that only one of them shows.
const WINDOWS: usize = 40;
/// Iterations of the fit.
const ITERATIONS: usize = 8;

/// Number `p` of an effect that was put in, as it came back, known to ±`half`.
pub(super) fn returned(put_in: &Chosen, p: usize, value: f64, half: f64) -> Returned {
    let about = put_in.effect.about();
    Returned {
        name: format!("{} {}", about.name, about.parameters[p].name),
        at: put_in.place.to_string(),
        put_in: put_in.values[p],
        value,
        ci95: [value - half, value + half],
    }
}

/// Searches what the present model of `search` would have recorded; nothing if stopped.
///
/// # Errors
/// The engine refuses a number.
pub(super) fn round_trip(
    search: &Search<'_>,
    seed: u64,
    watch: &mut Watch<'_>,
) -> Result<Option<RoundTrip>, GapError> {
    let mut again = search.clone();
    again.windows = again.windows.at_most(WINDOWS);
    again.stretch_of = again.windows.stretches();
    let windows = &mut again.windows;
    let Some(followed) = windows.simulate(&search.x, &windows.states)? else {
        return Ok(None);
    };
    windows.have_recorded(&followed);
    windows.problem.take_sigma(&search.noise);
    for (w, (trial, followed)) in (windows.problem.trials.iter_mut().zip(&followed)).enumerate() {
        let mut rng = rng::stream(seed, Purpose::SensorNoise, u64::MAX, w as u64);
        let samples = Arc::make_mut(&mut trial.samples);
        for i in &followed.samples {
            let sample = &mut samples[*i];
            sample.value += search.noise[sample.channel] * rng::normal(&mut rng);
        }
    }
    let put_in = search.chosen.clone();
    let fit = windows.fit(&search.x, ITERATIONS, &mut |i| watch.fit(i))?;
    again.chosen = again.built.values(&again.windows.problem, &fit.x, &put_in);
    (again.x, again.cost) = (fit.x, fit.cost);
    let Some(screen) = again.screen(watch)? else {
        return Ok(None);
    };
    let found = (again.worthy(&screen).iter())
        .map(|c| format!("{} at {}", c.effect.about().name, c.place))
        .collect();
    let free = again.built.free(&again.windows.problem);
    let mut back = Vec::new();
    for (i, (before, after)) in put_in.iter().zip(&again.chosen).enumerate() {
        for (p, parameter) in before.effect.about().parameters.iter().enumerate() {
            let number = free.iter().find(|f| f.1 == i && f.2 == p);
            let Some((j, _, _, slope)) = number.filter(|_| parameter.role != Role::Companion)
            else {
                continue;
            };
            let (sigma, dof) = screen.normal.fitted(*j);
            let half = two_sided_t(0.95, dof.max(1.0)) * sigma * slope.abs();
            back.push(returned(before, p, after.values[p], half));
        }
    }
    Ok(Some(RoundTrip {
        found,
        returned: back,
    }))
}
