//! States as they are measured, where sensors show position and velocity of every joint.

use super::window::State;
use crate::mujoco::{JointReading, Model};
use crate::sysid::problem::{Problem, Trial};

/// Stamps are rounded: this close to a knot, in steps, a sample is on it.
const ON_KNOT: f64 = 1e-4;

/// Where the state is read.
pub(super) struct Readings<'a> {
    problem: &'a Problem,
    /// per degree of freedom, channels of position and velocity
    channels: Vec<[usize; 2]>,
}

impl<'a> Readings<'a> {
    /// `None` unless every joint is a hinge or slide and both its numbers are recorded.
    pub(super) fn of(problem: &'a Problem) -> Option<Self> {
        let model = &problem.model;
        // what a supplement makes of a reading is not the state
        if model.extension().is_some() {
            return None;
        }
        let shown: Vec<Option<(usize, JointReading)>> = (problem.channels.iter())
            .map(|channel| shown(model, channel.source))
            .collect();
        let channels = (0..model.njnt())
            .map(|joint| {
                model.is_slide(joint)?;
                let of = |reading| shown.iter().position(|s| *s == Some((joint, reading)));
                Some([of(JointReading::Position)?, of(JointReading::Velocity)?])
            })
            .collect::<Option<_>>()?;
        Some(Self { problem, channels })
    }

    /// States of a trial at `knots`, with bias, gain and delay of parameters `x`; `None` where one was not sampled
    /// there.
    pub(super) fn states(&self, trial: &Trial, x: &[f64], knots: &[usize]) -> Option<Vec<State>> {
        let h = self.problem.model.timestep();
        let free = self.problem.free_values(x);
        let mut series: Vec<Vec<(f64, f64)>> = vec![Vec::new(); self.problem.channels.len()];
        for s in trial.samples.iter() {
            series[s.channel].push((s.time, s.value));
        }
        let read = |c: usize, knot: usize| {
            let channel = &self.problem.channels[c];
            let time = knot as f64 * h + channel.delay.value(&free);
            let slack = ON_KNOT * h;
            let at = series[c].partition_point(|s| s.0 < time - slack);
            let (stamp, value) = *series[c].get(at)?;
            let value = (value - channel.bias.value(&free)) / channel.gain.value(&free);
            (stamp <= time + slack).then_some(value)
        };
        (knots.iter())
            .map(|&knot| {
                let both = |of: usize| self.channels.iter().map(move |c| read(c[of], knot));
                Some(State {
                    qpos: both(0).collect::<Option<_>>()?,
                    qvel: both(1).collect::<Option<_>>()?,
                })
            })
            .collect()
    }
}

/// What an entry of (sensordata, qpos, qvel) shows of which joint.
fn shown(model: &Model, source: usize) -> Option<(usize, JointReading)> {
    let joint_at = |addresses: &[i32], address: usize| {
        let joint = addresses.iter().position(|&a| a as usize == address)?;
        model.is_slide(joint).map(|_| joint)
    };
    let (n_sensordata, nq) = (model.nsensordata(), model.nq());
    if source < n_sensordata {
        let sensor = (model.sensor_adr().iter()).position(|&a| a as usize == source)?;
        model.sensed_joint(sensor)
    } else if source < n_sensordata + nq {
        let joint = joint_at(model.jnt_qposadr(), source - n_sensordata)?;
        Some((joint, JointReading::Position))
    } else {
        let joint = joint_at(model.jnt_dofadr(), source - n_sensordata - nq)?;
        Some((joint, JointReading::Velocity))
    }
}
