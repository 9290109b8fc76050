//! The repaired model, simulated and searched again.
//!
//! What it would have recorded is one of its simulations, with the noise of the sensors, in place of each recording:
//! nothing more must be found, and the effects' numbers must come back. Chaos gives one such recording what looks like an
//! effect now and then; what is found in each of two stands.

use super::forward::forward;
use super::judge::{Judge, Point};
use super::name::HALF;
use super::refit::Fitted;
use super::screen::{Candidate, again};
use crate::gap::result::{Returned, RoundTrip};
use crate::gap::round_trip::returned;
use crate::gap::run::Options;
use crate::gap::{GapError, Watch};

/// Recordings that are made.
const DRAWS: usize = 2;

/// Searches what the model of `fitted` would have recorded, by the columns of `screened`; nothing where it breaks down.
///
/// # Errors
/// The engine fails; the search is stopped.
pub(super) fn round_trip(
    judge: &Judge<'_>,
    options: &Options,
    fitted: &Fitted,
    screened: &[Candidate],
    watch: &mut Watch<'_>,
) -> Result<Option<RoundTrip>, GapError> {
    let Some(draws) = judge.recorded(fitted, DRAWS, options.seed)? else {
        return Ok(None);
    };
    let screened: Vec<&Candidate> = screened.iter().collect();
    let mut found: Option<String> = None;
    let mut back = Vec::new();
    for (draw, more) in draws.into_iter().enumerate() {
        let own = judge.retold(more);
        let known = &fitted.ensemble.slopes;
        let at = |x: Vec<f64>| -> Result<Option<Fitted>, GapError> {
            let written = fitted.point.written.clone();
            own.reached(Point { written, x }, known)
        };
        let Some(seen) = at(fitted.point.x.clone())? else {
            return Ok(None);
        };
        let Some(moved) = at(own.step(&seen))? else {
            return Ok(None);
        };
        if draw == 0 {
            back = came_back(judge, fitted, &moved);
        }
        // what both cost differs by chaos, for little is told
        let present = if moved.cost < seen.cost { moved } else { seen };
        let all = again(&own, &present, &screened);
        let added = forward(&own, options, &present, &all, watch)?;
        let added = added.and_then(|(fitted, _)| fitted.chosen().pop());
        let name = added.map(|c| format!("{} at {}", c.effect.about().name, c.place));
        found = name.filter(|name| draw == 0 || found.as_ref() == Some(name));
        if found.is_none() {
            break;
        }
    }
    Ok(Some(RoundTrip {
        found: found.into_iter().collect(),
        returned: back,
    }))
}

/// Numbers of the effects, as they were put in and as they came back.
fn came_back(judge: &Judge<'_>, fitted: &Fitted, back: &Fitted) -> Vec<Returned> {
    let covariance = fitted.covariance(judge);
    let (put_in, back) = (fitted.chosen(), back.chosen());
    let number = |(j, i, p, slope): (usize, usize, usize, f64)| {
        let half = HALF * covariance[(j, j)].sqrt() * slope.abs();
        returned(&put_in[i], p, back[i].values[p], half)
    };
    let free = fitted.machine.built.free(&fitted.machine.problem);
    free.into_iter().map(number).collect()
}
