//! Free motion of the axes along a reference, tracked with the nominal inverse dynamics:
//!
//! ```text
//! τ = M_a (r'' + 2 ζ ω (r' - q') + ω² (r - q)) + b_a
//! ```
//!
//! References stay in a box: `start_low` to `start_high` of the model if it has these numerics, one number an axis,
//! else the middle of each joint's range.

use std::f64::consts::TAU;

use nalgebra::DVector;

use super::{Behaviour, smooth};
use crate::mujoco::{Model, MujocoError, ObjectKind};
use crate::rig::RigError;
use crate::rig::axes::Axis;
use crate::rig::estimate::Estimate;
use crate::rng::{self, Stream};

/// Bandwidth of tracking, rad/s, and damping ratio: well below the 100 Hz of the velocity filter.
const OMEGA: f64 = TAU * 6.0;
const ZETA: f64 = 0.8;
/// Share of a joint's range that is used, and half the box of a joint without limits.
const RANGE_SHARE: f64 = 0.6;
const FREE_HALF_WIDTH: f64 = 0.5;
/// Share of the box that references fill, to leave room for tracking errors.
const FILL: f64 = 0.85;
/// Time from the start state into the reference, s.
const BLEND_S: f64 = 0.7;
/// Step of the numerical derivatives of a reference, s.
const DIFFERENCE_S: f64 = 1e-4;
/// Sines of the sum, Hz at the lowest, and how many.
const LOWEST_HZ: f64 = 0.25;
const N_SINE: usize = 10;
/// Range of the chirp in Hz, and its largest acceleration, rad/s².
const CHIRP_HZ: [f64; 2] = [0.2, 15.0];
const CHIRP_ACCELERATION: f64 = 40.0;
/// Period of the slowest reversals, s.
const REVERSAL_S: f64 = 6.0;
/// Time a posture, and the share of it spent moving.
const POSTURE_S: f64 = 1.0;
const MOVING_SHARE: f64 = 0.4;

/// Where an axis may be.
#[derive(Debug, Clone, Copy)]
struct Interval {
    centre: f64,
    half: f64,
}

/// Path of one axis in its interval, from -1 to 1, at a time.
type Path = Box<dyn Fn(f64) -> f64>;

/// Tracking of paths.
struct Tracking {
    start: Vec<f64>,
    intervals: Vec<Interval>,
    paths: Vec<Path>,
}

impl Tracking {
    fn boxed(estimate: &Estimate, paths: Vec<Path>) -> Box<dyn Behaviour> {
        Box::new(Self {
            start: estimate.position().iter().copied().collect(),
            intervals: intervals(estimate.data().model(), estimate.axes()),
            paths,
        })
    }

    fn reference(&self, k: usize, time_s: f64) -> f64 {
        let Interval { centre, half } = self.intervals[k];
        let path = centre + FILL * half * (self.paths[k])(time_s);
        self.start[k] + smooth(time_s / BLEND_S) * (path - self.start[k])
    }
}

impl Behaviour for Tracking {
    fn command(
        &mut self,
        time_s: f64,
        estimate: &mut Estimate,
        ctrl: &mut [f64],
    ) -> Result<(), MujocoError> {
        let h = DIFFERENCE_S;
        let acceleration = DVector::from_fn(self.paths.len(), |k, _| {
            let [before, now, after] =
                [-h, 0.0, h].map(|shift| self.reference(k, (time_s + shift).max(0.0)));
            let (velocity, acceleration) = (
                (after - before) / (2.0 * h),
                (after - 2.0 * now + before) / (h * h),
            );
            acceleration
                + 2.0 * ZETA * OMEGA * (velocity - estimate.velocity()[k])
                + OMEGA * OMEGA * (now - estimate.position()[k])
        });
        estimate.command(&estimate.torque(&acceleration), ctrl);
        Ok(())
    }
}

fn intervals(model: &Model, axes: &[Axis]) -> Vec<Interval> {
    let numeric = |name: &str| {
        let id = model.id(ObjectKind::Numeric, name).ok()?;
        let start = model.numeric_adr()[id] as usize;
        let size = model.numeric_size()[id] as usize;
        (size == axes.len()).then(|| &model.numeric_data()[start..start + size])
    };
    let between = |low: f64, high: f64, share: f64| Interval {
        centre: 0.5 * (low + high),
        half: 0.5 * share * (high - low),
    };
    if let (Some(low), Some(high)) = (numeric("start_low"), numeric("start_high")) {
        return (0..axes.len())
            .map(|k| between(low[k], high[k], 1.0))
            .collect();
    }
    axes.iter()
        .map(|axis| match axis.joint_range {
            Some([low, high]) => between(low, high, RANGE_SHARE),
            None => between(-FREE_HALF_WIDTH, FREE_HALF_WIDTH, 1.0),
        })
        .collect()
}

/// Sums of sines at multiples of frequencies that no two axes share, amplitudes ∝ 1/frequency, phases at random.
#[expect(clippy::unnecessary_wraps, reason = "one signature for all behaviours")]
pub(super) fn multi_sine(
    estimate: &mut Estimate,
    _seconds: f64,
    mut rng: Stream,
) -> Result<Box<dyn Behaviour>, RigError> {
    let n = estimate.axes().len();
    let paths = (0..n)
        .map(|k| {
            let lowest = LOWEST_HZ * (1.0 + 0.5 * k as f64 / n as f64);
            let lines: Vec<[f64; 3]> = (1..=N_SINE)
                .map(|i| {
                    let i = i as f64;
                    [1.0 / i, TAU * lowest * i, rng::uniform(&mut rng, 0.0, TAU)]
                })
                .collect();
            // amplitudes add up to 1 at worst
            let total: f64 = lines.iter().map(|line| line[0]).sum();
            Box::new(move |t: f64| {
                lines
                    .iter()
                    .map(|[a, w, p]| a * (w * t + p).sin())
                    .sum::<f64>()
                    / total
            }) as Path
        })
        .collect();
    Ok(Tracking::boxed(estimate, paths))
}

/// One axis of each mechanism at a time sweeps its frequency, with less and less amplitude.
#[expect(clippy::unnecessary_wraps, reason = "one signature for all behaviours")]
pub(super) fn chirp(
    estimate: &mut Estimate,
    seconds: f64,
    _rng: Stream,
) -> Result<Box<dyn Behaviour>, RigError> {
    let axes = estimate.axes();
    let n_turn = axes.iter().map(|axis| axis.place + 1).max().unwrap_or(1);
    let span = seconds / n_turn as f64;
    let halves: Vec<f64> = intervals(estimate.data().model(), axes)
        .iter()
        .map(|interval| interval.half)
        .collect();
    let paths = axes
        .iter()
        .zip(halves)
        .map(|(axis, half)| {
            let begin = axis.place as f64 * span;
            Box::new(move |t: f64| {
                let x = (t - begin) / span;
                if !(0.0..1.0).contains(&x) {
                    return 0.0;
                }
                let [low, high] = CHIRP_HZ;
                let growth = (high / low).ln();
                let frequency = low * (growth * x).exp();
                let phase = TAU * low * span * ((growth * x).exp() - 1.0) / growth;
                let largest = CHIRP_ACCELERATION / (TAU * frequency).powi(2) / half.max(1e-9);
                let window = smooth(x / 0.05) * smooth((1.0 - x) / 0.05);
                window * largest.min(0.8) * phase.sin()
            }) as Path
        })
        .collect();
    Ok(Tracking::boxed(estimate, paths))
}

/// Triangles with rounded corners; the periods of the axes of a mechanism differ.
#[expect(clippy::unnecessary_wraps, reason = "one signature for all behaviours")]
pub(super) fn reversals(
    estimate: &mut Estimate,
    _seconds: f64,
    _rng: Stream,
) -> Result<Box<dyn Behaviour>, RigError> {
    let paths = estimate
        .axes()
        .iter()
        .map(|axis| {
            let period = REVERSAL_S / (1.0 + 0.6 * axis.place as f64);
            // arcsine of slightly less than a full sine: a triangle with round corners
            let full = 0.98_f64;
            Box::new(move |t: f64| (full * (TAU * t / period).sin()).asin() / full.asin()) as Path
        })
        .collect();
    Ok(Tracking::boxed(estimate, paths))
}

/// Moves and holds: corners of the box in an order that changes each axis at its own pace, and the centre.
#[expect(clippy::unnecessary_wraps, reason = "one signature for all behaviours")]
pub(super) fn postures(
    estimate: &mut Estimate,
    _seconds: f64,
    _rng: Stream,
) -> Result<Box<dyn Behaviour>, RigError> {
    let paths = estimate
        .axes()
        .iter()
        .map(|axis| {
            let level = {
                let place = axis.place as u32;
                move |i: u32| match (i / (1 + place)) % 4 {
                    0 => 1.0,
                    2 => -1.0,
                    _ => 0.0,
                }
            };
            Box::new(move |t: f64| {
                let i = (t / POSTURE_S).floor().max(0.0);
                let moved = smooth((t / POSTURE_S - i) / MOVING_SHARE);
                let i = i as u32;
                let from = level(i.saturating_sub(1));
                from + moved * (level(i) - from)
            }) as Path
        })
        .collect();
    Ok(Tracking::boxed(estimate, paths))
}
