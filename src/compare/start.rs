//! Where rollouts begin.

use super::{CompareError, Settings, States};
use crate::mujoco::{Model, ObjectKind};

/// Starts of a recording where no distance between them is asked for.
const STARTS: usize = 100;

/// A sample, and the velocity to begin with.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    /// sample
    pub sample: usize,
    /// (nv)
    pub qvel: Vec<f64>,
}

/// The starts of a recording; nothing where the body never falls.
///
/// # Errors
/// The body that falls is none.
pub fn starts(
    model: &Model,
    states: &States,
    settings: &Settings,
) -> Result<Option<Vec<Start>>, CompareError> {
    if let Some(drop) = &settings.drop {
        let joint = model.id(ObjectKind::Joint, &drop.joint)?;
        if !model.is_free(joint) {
            return Err(CompareError::Setting {
                key: "drop.joint",
                value: drop.joint.clone(),
                expected: "a free joint",
            });
        }
        let address = model.jnt_qposadr()[joint] as usize;
        let height = |k: usize| states.qpos[k * model.nq() + address + 2];
        let below = (0..states.len()).find(|k| height(*k) <= drop.below_m);
        let Some(sample) = below.and_then(|k| k.checked_sub(1)) else {
            return Ok(None);
        };
        let mut start = at(model, states, sample);
        if drop.free_flight && sample > 0 {
            free_flight(model, states, joint, &mut start);
        }
        return Ok(Some(vec![start]));
    }
    let duration = states.time_s[states.len() - 1] - states.time_s[0];
    let every = settings.every_s.unwrap_or(duration / STARTS as f64);
    let first = states.time_s[0] + settings.skip_s;
    let mut next = first;
    let mut starts = Vec::new();
    // the last sample has nothing after it
    for k in 0..states.len() - 1 {
        if states.time_s[k] >= next - 1e-9 {
            starts.push(at(model, states, k));
            next = first + starts.len() as f64 * every;
        }
    }
    Ok(Some(starts))
}

fn at(model: &Model, states: &States, sample: usize) -> Start {
    let nv = model.nv();
    Start {
        sample,
        qvel: states.qvel[sample * nv..(sample + 1) * nv].to_vec(),
    }
}

/// Velocity of a body that flew freely up to `start.sample`: of p(t) - g t²/2 = p₀ + v₀ t by least squares, and the
/// mean of its angular velocity.
fn free_flight(model: &Model, states: &States, joint: usize, start: &mut Start) {
    let (nq, nv) = (model.nq(), model.nv());
    let (address, dof) = (
        model.jnt_qposadr()[joint] as usize,
        model.jnt_dofadr()[joint] as usize,
    );
    let samples = 0..=start.sample;
    let n = samples.clone().count() as f64;
    let end = states.time_s[start.sample];
    let time = |k: usize| states.time_s[k] - end;
    let mean_time = samples.clone().map(time).sum::<f64>() / n;
    let spread: f64 = samples.clone().map(|k| (time(k) - mean_time).powi(2)).sum();
    for axis in 0..3 {
        let gravity = model.option().gravity[axis];
        let straight =
            |k: usize| states.qpos[k * nq + address + axis] - 0.5 * gravity * time(k).powi(2);
        let slope: f64 = samples
            .clone()
            .map(|k| (time(k) - mean_time) * straight(k))
            .sum();
        start.qvel[dof + axis] = slope / spread;
        let turn: f64 = samples
            .clone()
            .map(|k| states.qvel[k * nv + dof + 3 + axis])
            .sum();
        start.qvel[dof + 3 + axis] = turn / n;
    }
}
