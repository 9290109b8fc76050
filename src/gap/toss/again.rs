//! The repaired model tossed and searched again: nothing more must be found, and its numbers must come back.

use std::sync::Arc;

use super::forward::{candidates, forward, screen};
use super::judge::{Judge, Point};
use super::name::intervals;
use super::rest;
use crate::compare::rollouts::Run;
use crate::compare::start::starts;
use crate::compare::{CompareError, Settings, States};
use crate::gap::result::{Returned, RoundTrip};
use crate::gap::search::Limits;
use crate::gap::{GapError, Watch};
use crate::mujoco::{Data, Model};
use crate::recording::{Bound, BoundChannel, Recording};
use crate::rng::{self, Purpose};
use crate::sysid::ensemble;
use crate::sysid::problem::Problem;

/// Searches what the model of `whole` would have recorded, begun as the training recordings. The first `fitted` of its
/// effects were fitted to tosses, one after them to what lies still.
pub(super) fn again(
    judge: &Judge<'_>,
    (whole, fitted): (&Point, usize),
    limits: &Limits,
    seed: u64,
    watch: &mut Watch<'_>,
) -> Result<Option<RoundTrip>, GapError> {
    let Some((_, problem, x)) = judge.build(whole, &judge.problem) else {
        return Ok(None);
    };
    let model = Arc::new(ensemble::model_at(&problem.model, &problem.parameters, &x)?);
    let mut tossed = judge.problem.clone();
    for i in 0..tossed.trials.len() {
        let made = toss(&judge.problem, i, &model, judge.protocol, seed)?;
        tossed.trials[i].recording = Arc::new(made);
    }
    let other = judge.of(tossed)?;
    let Some(seen) = other.see(whole.clone())? else {
        return Ok(None);
    };
    let Some(back) = other.polish(&seen, true, watch)? else {
        return Ok(None);
    };
    let all = candidates(&other, &whole.chosen, &[]);
    let screened = screen(&other, &back.seen, &all, watch)?;
    let more = forward(&other, limits, &back.seen, screened, watch)?;
    let found = more.and_then(|(more, _)| {
        let last = more.point.chosen.last()?.clone();
        Some(format!("{} at {}", last.effect.about().name, last.place))
    });
    let intervals = intervals(&back);
    let mut returned = Vec::new();
    for (i, before) in whole.chosen.iter().enumerate().take(fitted) {
        let about = before.effect.about();
        for (p, ci95) in &intervals[i] {
            returned.push(Returned {
                name: format!("{} {}", about.name, about.parameters[*p].name),
                at: before.place.to_string(),
                put_in: before.values[*p],
                value: back.seen.point.chosen[i].values[*p],
                ci95: *ci95,
            });
        }
    }
    if let Some(before) = whole.chosen.get(fitted) {
        let mut point = whole.clone();
        point.chosen.truncate(fitted);
        let size = rest::size(&other, &point)?;
        returned.extend(size.map(|size| Returned {
            name: format!("{} share", rest::NAME),
            at: size.place.to_string(),
            put_in: before.values[0],
            value: size.share,
            ci95: size.ci95,
        }));
    }
    Ok(Some(RoundTrip {
        found: found.into_iter().collect(),
        returned,
    }))
}

/// A training recording with the motion of `model` from its start on, and as much noise as its channels have.
fn toss(
    problem: &Problem,
    trial: usize,
    model: &Arc<Model>,
    settings: &Settings,
    seed: u64,
) -> Result<Recording, GapError> {
    let mut recording = Recording::clone(&problem.trials[trial].recording);
    let states = States::new(&recording, model, settings)?;
    let Some(start) = starts(model, &states, settings)?.and_then(|s| s.into_iter().next()) else {
        return Ok(recording);
    };
    let bound = Bound::new(&recording, model).map_err(CompareError::from)?;
    let mut data = Data::new(Arc::clone(model))?;
    let mut run = Run::new(&mut data, &states, &start)?;
    let mut rng = rng::stream(seed, Purpose::SensorNoise, u64::MAX, trial as u64);
    for time in &states.time_s[start.sample + 1..] {
        let moved = run.at(*time, &|data, time| {
            states.controls_at(time, data.ctrl_mut());
        })?;
        let Some((qpos, qvel)) = moved else { break };
        let mut put = |channels: &[BoundChannel], values: &[f64], first: usize| {
            for b in channels {
                let stream = &mut recording.streams[b.stream];
                let Some(row) = (0..stream.len()).find(|i| (stream.time(*i) - time).abs() < 1e-9)
                else {
                    continue;
                };
                let own = problem
                    .channels
                    .iter()
                    .find(|c| c.source == first + b.address);
                let noise = own.map_or(0.0, |c| c.sigma) * rng::normal(&mut rng);
                let width = stream.channels.len();
                stream.values[row * width + b.column] = values[b.address] + noise;
            }
        };
        put(&bound.qpos, qpos, model.nsensordata());
        put(&bound.qvel, qvel, model.nsensordata() + model.nq());
    }
    Ok(recording)
}
