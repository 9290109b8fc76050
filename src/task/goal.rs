//! The goal: a mocap body that is put anywhere in a disc and stands there, or moves on within it.
//!
//! A policy for a goal that stands still has only the time until the object is there to learn from, and is paid little for
//! a high gain; one for a goal that moves is never done. Evaluation moves the goal, too ([`super::spiral`]), along another
//! path and at other speeds.
//!
//! A goal that is put far from the object asks for low gains: the force of an affine policy grows with the distance, and
//! one that follows closely would throw the object off the table. Where goals only ever move on, as in the evaluation, that
//! need not be learned ([`PushConfig::goal_jump_m`]).
//!
//! A goal that moves goes straight on at one speed in the direction of its x axis, mirrored at the edge of the disc. Its
//! whole state is thus its pose.

use std::f64::consts::TAU;

use super::TaskError;
use super::push::PushConfig;
use crate::mujoco::{Data, Model, ObjectKind};
use crate::rng::{self, Stream};

/// A goal of one model.
#[derive(Debug, Clone)]
pub(super) struct Goal {
    mocap: usize,
    radius_m: f64,
    speed_m_s: f64,
    jump_m: Option<f64>,
}

impl Goal {
    /// The body `goal` of `model`, to be moved as `config` says, around the origin.
    ///
    /// # Errors
    /// When there is no such mocap body.
    pub(super) fn new(model: &Model, config: &PushConfig) -> Result<Self, TaskError> {
        let body = model.id(ObjectKind::Body, "goal")?;
        let Ok(mocap) = usize::try_from(model.body_mocapid()[body]) else {
            return Err(TaskError::Model {
                reason: "body `goal` is not a mocap body".to_owned(),
            });
        };
        Ok(Self {
            mocap,
            radius_m: 0.5 * config.goal_diameter_m,
            speed_m_s: config.goal_speed_m_s,
            jump_m: config.goal_jump_m,
        })
    }

    /// The position, m.
    pub(super) fn position<'a>(&self, data: &'a Data) -> &'a [f64] {
        &data.mocap_pos()[3 * self.mocap..3 * self.mocap + 3]
    }

    /// Move it to (`x`, `y`), at its height.
    pub(super) fn set_position(&self, data: &mut Data, [x, y]: [f64; 2]) {
        data.mocap_pos_mut()[3 * self.mocap..3 * self.mocap + 2].copy_from_slice(&[x, y]);
    }

    /// Its x axis in the plane.
    pub(super) fn heading(&self, data: &Data) -> [f64; 2] {
        let quat = &data.mocap_quat()[4 * self.mocap..4 * self.mocap + 4];
        let (sin, cos) = (2.0 * quat[3].atan2(quat[0])).sin_cos();
        [cos, sin]
    }

    /// Turn its x axis into the direction (`x`, `y`).
    pub(super) fn set_heading(&self, data: &mut Data, [x, y]: [f64; 2]) {
        let (sin, cos) = (0.5 * y.atan2(x)).sin_cos();
        data.mocap_quat_mut()[4 * self.mocap..4 * self.mocap + 4]
            .copy_from_slice(&[cos, 0.0, 0.0, sin]);
    }

    /// Velocity in the plane, m/s.
    pub(super) fn velocity(&self, data: &Data) -> [f64; 2] {
        self.heading(data).map(|x| self.speed_m_s * x)
    }

    /// Put it anywhere in the disc; or, where jumps are limited, anywhere so near to `object`, and then into the disc.
    pub(super) fn draw(&self, data: &mut Data, object: [f64; 2], rng: &mut Stream) {
        let (centre, farthest) = match self.jump_m {
            None => ([0.0; 2], self.radius_m),
            Some(jump) => (object, jump),
        };
        // uniform: the radius of a share u of the area is R sqrt(u)
        let radius = farthest * rng::uniform(rng, 0.0, 1.0).sqrt();
        let (sin, cos) = rng::uniform(rng, 0.0, TAU).sin_cos();
        let place = [centre[0] + radius * cos, centre[1] + radius * sin];
        let outside = (place[0].hypot(place[1]) / self.radius_m).max(1.0);
        self.set_position(data, place.map(|x| x / outside));
        if self.speed_m_s > 0.0 {
            let (sin, cos) = rng::uniform(rng, 0.0, TAU).sin_cos();
            self.set_heading(data, [cos, sin]);
        }
    }

    /// Let it move for `seconds`.
    pub(super) fn pass(&self, data: &mut Data, seconds: f64) {
        if self.speed_m_s == 0.0 {
            return;
        }
        let (x, y) = (self.position(data)[0], self.position(data)[1]);
        let [dx, dy] = self.heading(data);
        let outward = x * dx + y * dy;
        if outward > 0.0 && x.hypot(y) > self.radius_m {
            let share = 2.0 * outward / (x * x + y * y);
            self.set_heading(data, [dx - share * x, dy - share * y]);
        }
        let [vx, vy] = self.velocity(data);
        self.set_position(data, [x + seconds * vx, y + seconds * vy]);
    }
}
