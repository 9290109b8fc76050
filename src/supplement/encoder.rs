//! What encoders make of joints (of motors, where a [`super::transmission`] is between).
//!
//! ```text
//! scale    (1 + k) q        offset   q + b        delay   q(t − T)
//! ```
//!
//! Readings are those of `jointpos` and `jointvel` sensors and of whatever looks at a machine through its encoders. Between
//! steps a delayed reading lies on a straight line; before the first step the machine had been at rest where it began.
//! Memory of the delay: as for commands, with position and velocity of every hinge and slide.

use super::MAX_DELAY_S;
use super::command::{Line, line_len};
use super::law::{At, Built, Law};
use crate::mujoco::{Measures, Model};

/// Kind of the delay.
pub(super) const DELAY: &str = "sensor_delay";

#[derive(Debug)]
struct Scale(usize);

#[derive(Debug)]
struct Offset(usize);

#[derive(Debug)]
struct Delay(Vec<usize>); // hinges and slides

pub(super) fn scale(_: &Model, joint: usize) -> Built {
    Ok(Box::new(Scale(joint)))
}

pub(super) fn offset(_: &Model, joint: usize) -> Built {
    Ok(Box::new(Offset(joint)))
}

pub(super) fn delay(model: &Model, _: usize) -> Built {
    Ok(Box::new(Delay(model.scalar_joints().collect())))
}

/// Joint, address and which of position and velocity of every sensor of a hinge or slide.
pub(super) fn sensors(model: &Model) -> impl Iterator<Item = (usize, usize, usize)> {
    let joint_at =
        |addresses: &[i32], at: usize| model.scalar_joints().find(|j| addresses[*j] as usize == at);
    (0..model.nsensor()).filter_map(move |sensor| {
        let address = model.sensor_adr()[sensor] as usize;
        match model.measures(sensor) {
            Measures::Position(at) => Some((joint_at(model.jnt_qposadr(), at)?, address, 0)),
            Measures::Velocity(at) => Some((joint_at(model.jnt_dofadr(), at)?, address, 1)),
            _ => None,
        }
    })
}

impl Law for Scale {
    fn reads(&self, joint: usize) -> bool {
        joint == self.0
    }

    fn encode(&self, at: &At<'_>, joint: usize, reading: &mut [f64; 2]) {
        if joint == self.0 {
            *reading = reading.map(|x| x * (1.0 + at.numbers[0]));
        }
    }

    fn decode(&self, at: &At<'_>, joint: usize, reading: &mut [f64; 2]) {
        if joint == self.0 {
            *reading = reading.map(|x| x / (1.0 + at.numbers[0]));
        }
    }
}

impl Law for Offset {
    fn reads(&self, joint: usize) -> bool {
        joint == self.0
    }

    fn encode(&self, at: &At<'_>, joint: usize, reading: &mut [f64; 2]) {
        if joint == self.0 && at.numbers[0] != 0.0 {
            reading[0] += at.numbers[0];
        }
    }

    fn decode(&self, at: &At<'_>, joint: usize, reading: &mut [f64; 2]) {
        if joint == self.0 && at.numbers[0] != 0.0 {
            reading[0] -= at.numbers[0];
        }
    }
}

impl Law for Delay {
    fn memory_len(&self, timestep: f64) -> usize {
        line_len(timestep, 2 * self.0.len())
    }

    fn reads(&self, joint: usize) -> bool {
        self.0.contains(&joint)
    }

    fn encode(&self, at: &At<'_>, joint: usize, reading: &mut [f64; 2]) {
        let time = at.numbers[0].min(MAX_DELAY_S);
        let Some(i) = self
            .0
            .iter()
            .position(|j| *j == joint)
            .filter(|_| time > 0.0)
        else {
            return;
        };
        let line = Line::new(at.memory);
        for (which, now) in reading.iter_mut().enumerate() {
            *now = line.before(*now, time / at.timestep, 2 * self.0.len(), 2 * i + which);
        }
    }

    fn record(&self, _at: &At<'_>, encoder: &dyn Fn(usize) -> [f64; 2], next: &mut [f64]) {
        let readings: Vec<f64> = self.0.iter().flat_map(|joint| encoder(*joint)).collect();
        Line::push(next, readings.len(), |i| readings[i]);
    }
}
