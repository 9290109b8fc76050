//! Windows of other lengths, where something is missing that no effect explains.
//!
//! Long windows show slow effects, a drive's spring or a weak torque; in short ones, where a model is lost for some of the motion
//! only ([`super::cuts`]), changes of it are better than others. Where the verdict is `unknown` the search is made again in
//! windows a quarter and twice as long. Its answer counts if it has another verdict and
//!
//! ```text
//! remaining after ≤ remaining before / 5
//! ```
//!
//! ([`super::left`]), and it goes on after two effects only if they take as much.

use super::result::Verdict;
use super::run::{self, Input, Options, Outcome};
use super::stages::{Keeper, Prefixed};
use super::{GapError, Watch};

/// Lengths that are tried, as multiples of the first.
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
    let first = run::at_length(input, options, keeper, watch, None)?.ok_or(GapError::Stopped)?;
    let measured = first.answer.remaining.after.is_some();
    if first.answer.verdict != Verdict::Unknown || options.window_s.is_some() || !measured {
        return Ok(first);
    }
    for multiple in MULTIPLES {
        let length = multiple * first.answer.window_s;
        let options = Options {
            window_s: Some(length),
            ..options.clone()
        };
        let mut own = Prefixed {
            keeper: &mut *keeper,
            prefix: format!("{length}s-"),
        };
        watch.windows = format!("windows of {length} s");
        let again = run::at_length(input, &options, &mut own, watch, Some(CLEAR));
        watch.windows.clear();
        match again {
            Ok(Some(other)) if clear(&other) => return Ok(other),
            Err(GapError::Stopped) => return Err(GapError::Stopped),
            // no window of this length can be simulated, or none explains more
            _ => {}
        }
    }
    Ok(first)
}

fn clear(outcome: &Outcome) -> bool {
    let remaining = &outcome.answer.remaining;
    outcome.answer.verdict != Verdict::Unknown
        && (remaining.before.zip(remaining.after)).is_some_and(|(b, a)| a <= CLEAR * b)
}
