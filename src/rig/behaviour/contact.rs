//! Motion with the object, as forces at the fingertips on top of the torques that hold the fingers:
//!
//! ```text
//! F = K (x_ref - x) + D (x_ref' - x') + F_n n           n: from the tip to the object's axis
//! ```

use std::f64::consts::TAU;

use nalgebra::Vector3;

use super::tips::{Hand, Tip};
use super::{Behaviour, smooth};
use crate::mujoco::MujocoError;
use crate::rig::RigError;
use crate::rig::estimate::Estimate;
use crate::rng::Stream;

/// Stiffness and damping of a fingertip, N/m and N s/m: critical for the 0.1 kg a tip feels like.
const STIFFNESS: f64 = 300.0;
const DAMPING: f64 = 8.0;
/// Gap of a finger that waits, m.
const GAP: f64 = 0.02;
/// Speed of approach, m/s, and the spring force that tells contact, N: half of what moves the object.
const APPROACH: f64 = 0.03;
const FELT: f64 = 0.4;
/// Forces of the ladder, N.
const LADDER: [f64; 8] = [0.3, 0.6, 1.2, 2.0, 3.0, 4.0, 2.0, 0.8];
/// Force that holds the object for sliding, N; how far a finger slides, m.
const HOLD: f64 = 0.8;
const SLIDE: f64 = 0.012;
/// Time for all fingers to reach the object, s.
const GATHER_S: f64 = 1.0;
/// How far the object is pushed, m; the spring that pulls the tips to it, N/m; its rest below the surface, m; the force
/// towards the goal, N/m; the damper, N s/m.
const PUSH: f64 = 0.025;
const PUSH_SPRING: f64 = 60.0;
const PUSH_DEPTH: f64 = 0.02;
const PUSH_GOAL: f64 = 400.0;
const PUSH_DAMPING: f64 = 2.5;
const N_DIRECTION: usize = 8;
/// Time a direction: faster, and the fingers lose the object.
const PUSH_S: f64 = 1.875;

/// Reference of a finger: where, how fast, and a force.
struct Pull {
    place: Vector3<f64>,
    velocity: Vector3<f64>,
    force: Vector3<f64>,
    /// directions in which the spring acts: 1 or 0 along n
    normal_stiffness: f64,
}

impl Pull {
    fn at(place: Vector3<f64>) -> Self {
        Self {
            place,
            velocity: Vector3::zeros(),
            force: Vector3::zeros(),
            normal_stiffness: 1.0,
        }
    }

    fn force_at(&self, tip: &Tip, outwards: &Vector3<f64>) -> Vector3<f64> {
        let mut error = self.place - tip.place;
        error -= (1.0 - self.normal_stiffness) * error.dot(outwards) * outwards;
        STIFFNESS * error + DAMPING * (self.velocity - tip.velocity) + self.force
    }
}

/// Sum the torques of all fingers and command them.
fn command(
    hand: &Hand,
    estimate: &mut Estimate,
    ctrl: &mut [f64],
    mut force: impl FnMut(usize, &Tip) -> Vector3<f64>,
) -> Result<(), MujocoError> {
    let mut torque = estimate.holding_torque().clone();
    for i in 0..hand.len() {
        let tip = hand.tip(i, estimate)?;
        torque += tip.torque(force(i, &tip));
    }
    estimate.command(&torque, ctrl);
    Ok(())
}

/// Where a tip waits or touches: `gap` off the surface, `height` above the object's centre.
fn beside(hand: &Hand, finger: usize, gap: f64, height: f64) -> Vector3<f64> {
    hand.object + (hand.touching + gap) * hand.outwards[finger] + Vector3::new(0.0, 0.0, height)
}

struct Touch {
    hand: Hand,
    /// gap of each finger's reference, m
    gaps: Vec<f64>,
    starts: Vec<Vector3<f64>>,
    turn_s: f64,
    last_s: f64,
}

pub(super) fn touch(
    estimate: &mut Estimate,
    seconds: f64,
    _rng: Stream,
) -> Result<Box<dyn Behaviour>, RigError> {
    let hand = Hand::find(estimate)?;
    let n = hand.len();
    let starts = starts(&hand, estimate)?;
    Ok(Box::new(Touch {
        gaps: vec![GAP; n],
        starts,
        turn_s: seconds / (2 * n) as f64,
        last_s: 0.0,
        hand,
    }))
}

fn starts(hand: &Hand, estimate: &mut Estimate) -> Result<Vec<Vector3<f64>>, MujocoError> {
    (0..hand.len())
        .map(|i| Ok(hand.tip(i, estimate)?.place))
        .collect()
}

impl Behaviour for Touch {
    fn command(
        &mut self,
        time_s: f64,
        estimate: &mut Estimate,
        ctrl: &mut [f64],
    ) -> Result<(), MujocoError> {
        let Self {
            hand,
            gaps,
            starts,
            turn_s,
            last_s,
        } = self;
        let step = time_s - *last_s;
        *last_s = time_s;
        let turn = (time_s / *turn_s).floor();
        let share = time_s / *turn_s - turn;
        let active = turn as usize % hand.len();
        // a quarter of the half height below the middle, then above
        let high = if turn as usize >= hand.len() {
            0.25
        } else {
            -0.25
        };
        let height = high * hand.half_height;
        let table = hand.clone();
        command(hand, estimate, ctrl, |i, tip| {
            let mut pull = Pull::at(beside(&table, i, gaps[i], height));
            let (low, inwards) = (-GAP, -table.outwards[i]);
            let pressed = STIFFNESS * (pull.place - tip.place).dot(&inwards);
            let mut speed = 0.0;
            if i == active && (0.2..0.75).contains(&share) {
                if pressed < FELT && gaps[i] > low {
                    speed = -APPROACH;
                }
            } else if gaps[i] < GAP {
                speed = 2.0 * APPROACH;
            }
            gaps[i] = (gaps[i] + speed * step).clamp(low, GAP);
            pull.velocity = speed * table.outwards[i];
            // into the first reference from where the finger starts
            let arrived = smooth(time_s / (0.2 * *turn_s));
            pull.place = starts[i] + arrived * (pull.place - starts[i]);
            pull.force_at(tip, &table.outwards[i])
        })
    }
}

/// All fingers at the object with a normal force, and a shift along its surface.
struct Grip {
    hand: Hand,
    starts: Vec<Vector3<f64>>,
    schedule: Schedule,
}

#[derive(Clone, Copy)]
enum Schedule {
    Ladder { rung_s: f64 },
    Slides { turn_s: f64 },
}

impl Schedule {
    /// Normal force of all fingers.
    fn force(self, time_s: f64) -> f64 {
        match self {
            Self::Ladder { rung_s } => {
                let rung = ((time_s / rung_s) as usize).min(LADDER.len() - 1);
                let share = time_s / rung_s - rung as f64;
                let from = rung.checked_sub(1).map_or(LADDER[0], |r| LADDER[r]);
                from + smooth(share / 0.2) * (LADDER[rung] - from)
            }
            Self::Slides { .. } => HOLD,
        }
    }

    /// Shift of a finger along the surface: around, up.
    fn shift(self, finger: usize, n_finger: usize, time_s: f64) -> [f64; 2] {
        let Self::Slides { turn_s } = self else {
            return [0.0; 2];
        };
        let turn = (time_s / turn_s).floor();
        if turn as usize % n_finger != finger {
            return [0.0; 2];
        }
        // one full sine around, then one up and down
        let share = time_s / turn_s - turn;
        let wave = SLIDE * (2.0 * TAU * share).sin();
        if share < 0.5 {
            [wave, 0.0]
        } else {
            [0.0, wave]
        }
    }
}

pub(super) fn press(
    estimate: &mut Estimate,
    seconds: f64,
    _rng: Stream,
) -> Result<Box<dyn Behaviour>, RigError> {
    let rung_s = (seconds - GATHER_S).max(0.1) / LADDER.len() as f64;
    grip(estimate, Schedule::Ladder { rung_s })
}

pub(super) fn slide(
    estimate: &mut Estimate,
    seconds: f64,
    _rng: Stream,
) -> Result<Box<dyn Behaviour>, RigError> {
    let hand = Hand::find(estimate)?;
    let turn_s = (seconds - GATHER_S).max(0.1) / hand.len() as f64;
    grip(estimate, Schedule::Slides { turn_s })
}

fn grip(estimate: &mut Estimate, schedule: Schedule) -> Result<Box<dyn Behaviour>, RigError> {
    let hand = Hand::find(estimate)?;
    let starts = starts(&hand, estimate)?;
    Ok(Box::new(Grip {
        hand,
        starts,
        schedule,
    }))
}

impl Behaviour for Grip {
    fn command(
        &mut self,
        time_s: f64,
        estimate: &mut Estimate,
        ctrl: &mut [f64],
    ) -> Result<(), MujocoError> {
        let Self {
            hand,
            starts,
            schedule,
        } = self;
        let n = hand.len();
        command(hand, estimate, ctrl, |i, tip| {
            let outwards = hand.outwards[i];
            if time_s < GATHER_S {
                // to a centimetre from the surface, then on by force
                let near = beside(hand, i, 0.5 * GAP, 0.0);
                let share = smooth(time_s / GATHER_S);
                return Pull::at(starts[i] + share * (near - starts[i])).force_at(tip, &outwards);
            }
            let time_s = time_s - GATHER_S;
            let [around, up] = schedule.shift(i, n, time_s);
            let sideways = Vector3::z().cross(&outwards);
            let mut pull = Pull::at(
                beside(hand, i, 0.0, 0.0) + around * sideways + Vector3::new(0.0, 0.0, up),
            );
            pull.normal_stiffness = 0.0;
            pull.force = -schedule.force(time_s) * outwards;
            pull.force_at(tip, &outwards)
        })
    }
}

/// The hand-made policy of `scripts/hand_policy.py`, with the tips' Jacobians of the present posture.
struct Push {
    hand: Hand,
}

pub(super) fn push(
    estimate: &mut Estimate,
    _seconds: f64,
    _rng: Stream,
) -> Result<Box<dyn Behaviour>, RigError> {
    Ok(Box::new(Push {
        hand: Hand::find(estimate)?,
    }))
}

impl Behaviour for Push {
    fn command(
        &mut self,
        time_s: f64,
        estimate: &mut Estimate,
        ctrl: &mut [f64],
    ) -> Result<(), MujocoError> {
        let hand = &self.hand;
        let object = estimate.object().map_or(hand.object, Vector3::from);
        let goal = self.goal(time_s).map_or(object, Vector3::from);
        let arrived = smooth(time_s / GATHER_S);
        command(hand, estimate, ctrl, |i, tip| {
            let mut rest = object + (hand.touching - PUSH_DEPTH) * hand.outwards[i];
            rest.z = hand.object.z;
            let mut force = PUSH_SPRING * (rest - tip.place) - PUSH_DAMPING * tip.velocity;
            let mut towards = goal - object;
            towards.z = 0.0;
            force += PUSH_GOAL * towards;
            arrived * force - (1.0 - arrived) * DAMPING * tip.velocity
        })
    }

    fn goal(&self, time_s: f64) -> Option<[f64; 3]> {
        let time_s = (time_s - GATHER_S).max(0.0);
        let direction = (time_s / PUSH_S).floor();
        let share = time_s / PUSH_S - direction;
        let out = smooth(share / 0.4) * smooth((1.0 - share) / 0.4);
        // neighbours in time are no neighbours in direction: 0, 135, 270, ... degrees
        let angle = 3.0 * direction * TAU / N_DIRECTION as f64;
        let start = self.hand.object;
        Some([
            start.x + PUSH * out * angle.cos(),
            start.y + PUSH * out * angle.sin(),
            start.z,
        ])
    }
}
