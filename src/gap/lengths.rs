//! Windows of other lengths, where something is missing that no effect explains.
//!
//! Long windows show slow effects, a drive's spring or a weak torque; in short ones, where a model is lost for some of the motion
//! only ([`super::cuts`]), changes of it are better than others. Where the verdict is `unknown` the search is made again: in windows
//! of the length that suits the readings, if the model has been lost in these throughout, and then in windows a quarter and twice
//! as long. The answer of the latter counts if it has another verdict and
//!
//! ```text
//! remaining after ≤ remaining before / 5
//! ```
//!
//! ([`super::left`]), and it goes on after two effects only if they take as much.

use super::cuts::Cuts;
use super::result::Verdict;
use super::run::{self, Input, Options, Outcome};
use super::stages::{Keeper, Prefixed};
use super::{GapError, Watch};

/// Lengths that are tried, as multiples of the one that suits the readings.
const MULTIPLES: [f64; 2] = [0.25, 2.0];
/// Part of the readings' misfit that a clear answer leaves.
const CLEAR: f64 = 0.2;

/// The search in windows of the length that suits the recordings, then of others where that explains nothing.
///
/// # Errors
/// Of the first length; [`GapError::Stopped`].
pub(super) fn search(
    input: &Input<'_>,
    options: &Options,
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
) -> Result<Outcome, GapError> {
    let mut first =
        run::at_length(input, options, keeper, watch, None)?.ok_or(GapError::Stopped)?;
    if first.answer.verdict != Verdict::Unknown || options.window_s.is_some() {
        return Ok(first);
    }
    let suits_s = Cuts::new(input, options)?.length_s;
    if first.answer.window_s < suits_s
        && let Some(other) = at(suits_s, (input, options), keeper, watch, None)?
    {
        first = other;
    }
    if first.answer.verdict != Verdict::Unknown || first.answer.remaining.after.is_none() {
        return Ok(first);
    }
    for multiple in MULTIPLES {
        let length_s = multiple * suits_s;
        if let Some(other) = at(length_s, (input, options), keeper, watch, Some(CLEAR))?
            && clear(&other)
        {
            return Ok(other);
        }
    }
    Ok(first)
}

/// The search in windows of `length_s`; nothing if none of these can be simulated, or if it does not take what is `enough`.
fn at(
    length_s: f64,
    (input, options): (&Input<'_>, &Options),
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
    enough: Option<f64>,
) -> Result<Option<Outcome>, GapError> {
    let options = Options {
        window_s: Some(length_s),
        ..options.clone()
    };
    let mut own = Prefixed {
        keeper,
        prefix: format!("{length_s}s-"),
    };
    watch.windows = format!("windows of {length_s} s");
    let again = run::at_length(input, &options, &mut own, watch, enough);
    watch.windows.clear();
    match again {
        Err(GapError::Stopped) => Err(GapError::Stopped),
        other => Ok(other.ok().flatten()),
    }
}

fn clear(outcome: &Outcome) -> bool {
    let remaining = &outcome.answer.remaining;
    outcome.answer.verdict != Verdict::Unknown
        && (remaining.before.zip(remaining.after)).is_some_and(|(b, a)| a <= CLEAR * b)
}
