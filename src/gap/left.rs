//! Is there more to explain than the catalogue has? A flexible regression says what could be.
//!
//! The missing forces f of the windows are predicted from position, velocity and motor force u ([`super::predict`]). Of a
//! joint with rms f ≥ 2 % of rms u a force is reported if a quarter of its variance can be predicted, or if much is left of
//! the readings. Whatever was found is not what is missing, or not all of it, where
//!
//! ```text
//! law:  √explainable · rms f ≥ rms u / 20        at any joint, explainable ≥ 0.6
//! much: remaining² = (|r̃|² − noise²)/|m̃|²        of the channel where it is largest, ≥ 3 % and a fifth of that before
//! some: the same                                 ≥ the least size of an effect and a twentieth
//! misled: force of inverse dynamics, held out    more than before any effect, while what remains is of the least size of one
//! most: force of inverse dynamics, held out      ≥ half of the measured and twice its noise floor, where nothing was found
//!       and rollouts of the shortest horizon       off by half as much as the longest
//! ```
//!
//! with m̃ what the motors do to the readings. `misled` is of models that follow the recordings by a law that they do not obey: dry friction
//! for cogging made 32 % of 22.5, a rotor for a joint that sticks 19.5 of 17.2, drag for a stop 91 of 85; right ones have less than before,
//! but for drives that give way, of which little remains, or more than there was in other weights.
//!
//! `most` is of recordings that a model cannot follow in any window: what is lost
//! there weighs so little in training that nothing is missing in them; with nothing hidden a finger kept 0.14 %, and one
//! whose soft drive was not found 151 to 253 %. Small arms whose one effect was named rightly kept 0.2 to 1.3 % of the motors
//! (11 % of 109 with a delay of 19 ms) and a law of 0.0 to 1.6 % (4.4 % with a drive's spring); arms whose effect is in no
//! catalogue 13 to 98 %, at least 0.6 of what they had, or, friction by place, 6 to 9 % of 8 to 21; stiffening springs 18 to
//! 22 % of 78 to 103, with a law of 8.5 to 140 %.

use nalgebra::DMatrix;

use super::GapError;
use super::candidate::largest_part;
use super::linear::Linear;
use super::locate::Missing;
use super::predict::{Inputs, predicted};
use super::result::{Gap, Left, Remaining, Rollout};
use super::score::rms;
use super::search::Search;

/// Part of the motors' force below which nothing is reported.
const SIZE: f64 = 0.02;
/// Predictable part from which there is structure.
const STRUCTURE: f64 = 0.25;
/// Predictable part from which most of it is one law, and part of the motors' force from which that is one more.
const MOSTLY: f64 = 0.6;
const LAW: f64 = 0.05;
/// Part of the motors' response, and of what there was at first, from which what is left is a force that the catalogue
/// does not have.
const MUCH: f64 = 0.03;
const MOST: f64 = 0.2;
/// Part of what there was at first from which other effects may explain it better.
const PART: f64 = 0.05;
/// Percent of the held-out force, and multiple of its noise, from which a model without effects is not all there is.
const HELD_OUT_PERCENT: f64 = 50.0;
const FLOORS: f64 = 2.0;
/// Part of the error of rollouts that there is after the shortest of them where the motion is lost at once.
const AT_ONCE: f64 = 0.5;

impl Search<'_> {
    /// Of the module; `linear` is of the present model, `motors` the squared length of what they do to each channel.
    /// None where they do nothing.
    pub(super) fn remaining(&self, linear: &Linear, motors: Option<&[f64]>) -> Option<f64> {
        let rows = &linear.rows;
        let mut left = linear.by_channel(rows.iter().map(|row| &row.residual));
        for row in rows {
            for (&c, weight) in row.channel.iter().zip(&row.weight) {
                left[c] -= weight * weight * self.noise_square(c);
            }
        }
        for square in &mut left {
            *square = square.max(0.0);
        }
        largest_part(&left, motors?)
    }

    /// Whether what remains is at most `part` of what there was `before`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn takes(&self, part: f64, before: Option<f64>) -> Result<bool, GapError> {
        let linear = self.windows.linearise(&self.x)?;
        let motors = linear.motors(&self.windows, &self.x)?;
        let motors = motors.map(|m| linear.by_channel(&m.parts));
        let after = self.remaining(&linear, motors.as_deref());
        Ok((before.zip(after)).is_some_and(|(before, after)| after <= part * before))
    }
}

/// Whether what remains is another force than those found.
pub(super) fn much(remaining: &Remaining) -> bool {
    is_left(remaining, MUCH, MOST)
}

/// Whether so much remains that other effects than those found, of the size `least` each, may explain it better.
pub(super) fn some(remaining: &Remaining, least: f64) -> bool {
    is_left(remaining, least, PART)
}

/// Whether held-out forces are further off than without the effects, though as much as the size `least` of one is left.
pub(super) fn misled(gap: &Gap, remaining: &Remaining, least: f64) -> bool {
    let more = (gap.holdout.as_ref()).is_some_and(|forces| forces.after > forces.before);
    more && is_left(remaining, least, 0.0) && remaining.after < remaining.before
}

/// Whether the part `least` of the motors' response remains, and `part` of what there was before.
fn is_left(remaining: &Remaining, least: f64, part: f64) -> bool {
    let most = (remaining.before).map_or(least, |before| least.max(part * before));
    remaining.after.is_some_and(|after| after >= most)
}

/// Whether what is left at a joint follows a law that was not found.
pub(super) fn law(left: &[Left]) -> bool {
    let told = |l: &Left| l.explainable.sqrt() * l.of_motor;
    let mut each = left.iter().filter(|l| l.explainable >= MOSTLY);
    each.any(|l| told(l) >= LAW)
}

/// Whether the machine that was fitted lacks most of the held-out force, and loses the motion at once: motors that idle
/// give forces that any error is most of.
pub(super) fn most(gap: &Gap) -> bool {
    // distances have no floor
    let forces = gap.holdout.as_ref().is_some_and(|forces| {
        (forces.noise_floor)
            .is_some_and(|floor| forces.after >= HELD_OUT_PERCENT.max(FLOORS * floor))
    });
    // of each unit the shortest first
    let at_once = |first: &Rollout| {
        let alike = gap.rollout.iter().filter(|r| r.unit == first.unit);
        let largest = alike.map(|r| r.after).fold(0.0, f64::max);
        largest > 0.0 && first.after >= AT_ONCE * largest
    };
    forces && gap.rollout.first().is_some_and(at_once)
}

/// Joints at which structure is left, or all with a force of practical size if `much` is left of the readings.
pub(super) fn left(missing: &Missing, much: bool) -> Vec<Left> {
    let column = |m: &DMatrix<f64>, joint: usize| rms(m.column(joint).as_slice());
    let mut kept: Vec<(usize, f64, f64)> = (0..missing.joints.len())
        .map(|j| (j, column(&missing.force, j), column(&missing.motor, j)))
        .filter(|(_, size, motor)| *size >= SIZE * motor && *motor != 0.0)
        .collect();
    if kept.is_empty() {
        return Vec::new();
    }
    let explainable = predicted(missing, Inputs::ALL);
    kept.retain(|(joint, ..)| much || explainable[*joint] >= STRUCTURE);
    if kept.is_empty() {
        return Vec::new();
    }
    let all = Inputs::ALL;
    let without = [
        (
            "position",
            Inputs {
                position: false,
                ..all
            },
        ),
        (
            "velocity",
            Inputs {
                velocity: false,
                ..all
            },
        ),
        (
            "motor force",
            Inputs {
                motor: false,
                ..all
            },
        ),
    ]
    .map(|(name, inputs)| (name, predicted(missing, inputs)));
    let each = kept.into_iter().map(|(joint, size, motor)| {
        let lost = |(name, told): &(&str, Vec<f64>)| {
            ((*name).to_owned(), explainable[joint] - told[joint])
        };
        Left {
            channel: missing.joints[joint].clone(),
            size,
            of_motor: size / motor,
            unit: missing.units[joint].to_owned(),
            explainable: explainable[joint].max(0.0),
            inputs: without.iter().map(lost).collect(),
        }
    });
    each.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::result::Holdout;

    /// Held-out forces, percent, and the rollouts of the shortest and the longest horizon.
    fn gap((before, after): (f64, f64), noise_floor: Option<f64>, rollouts: [f64; 2]) -> Gap {
        let rollout = |(horizon_s, after): (f64, f64)| Rollout {
            horizon_s: Some(horizon_s),
            before: after,
            after,
            unit: "rad".into(),
        };
        Gap {
            holdout: Some(Holdout {
                quantity: "force".into(),
                before,
                after,
                noise_floor,
                unit: "%".into(),
            }),
            rollout: [0.05, 1.0].into_iter().zip(rollouts).map(rollout).collect(),
            channels: Vec::new(),
            worse: Vec::new(),
            notes: Vec::new(),
        }
    }

    /// Half of the force counts where noise makes less than half of that and rollouts are lost at once; distances, which have no
    /// floor, do not.
    #[test]
    fn most_of_a_force_is_not_noise() {
        let lacks = |after: f64, noise_floor: Option<f64>, soon: f64| {
            most(&gap((after, after), noise_floor, [soon, 0.14]))
        };
        assert!(lacks(151.5, Some(0.3), 0.13) && lacks(60.0, Some(0.0), 0.13));
        assert!(!lacks(40.0, Some(0.3), 0.13) && !lacks(60.0, Some(40.0), 0.13));
        assert!(!lacks(110.0, None, 0.13));
        assert!(!lacks(125.0, Some(0.04), 0.002));
    }

    /// A finger that cogs, for which friction was named; one that rubs; and two whose drives give way.
    #[test]
    fn what_makes_forces_worse_and_leaves_much_misleads() {
        let misleads = |forces, (before, after)| {
            let remaining = Remaining {
                before: Some(before),
                after: Some(after),
            };
            misled(&gap(forces, None, [0.0; 2]), &remaining, 0.01)
        };
        assert!(misleads((22.54, 32.0), (0.229, 0.0413)));
        assert!(!misleads((11.22, 6.87), (0.229, 0.0413)));
        assert!(!misleads((2.035, 2.203), (0.0040, 0.0042)));
        assert!(!misleads((0.786, 0.979), (0.0038, 0.0175)));
    }
}
