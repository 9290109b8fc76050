//! How large what lies still is: a separate finding.
//!
//! Tosses go astray by a tenth of a body's size, which hides that its size is off by a hundredth. Where it ends says so
//! directly: with r the height of its centre at the end of a trial that ends at rest, and m(s) the height at which the
//! model's body comes to rest from there, its size times 1 + s,
//!
//! ```text
//! s = mean of (r − m(0)) / m'(0)
//! ```
//!
//! with the spread over trials for its interval. A scale of the readings looks the same here; it also shows in flight, as
//! gravity times the same factor.

use std::sync::Arc;

use rayon::prelude::*;

use super::judge::{Judge, Point};
use crate::compare::{Settings, States};
use crate::gap::GapError;
use crate::gap::effect::{Place, PlaceKind, named};
use crate::gap::model::Chosen;
use crate::gap::score::{mean, rms, two_sided};
use crate::mujoco::{Data, Model, ObjectKind};
use crate::sysid::ensemble;
use crate::sysid::problem::Problem;
use crate::sysid::student::two_sided_t;

/// The effect.
pub(super) const NAME: &str = "length_scale";
/// Part of its largest speed below which a degree of freedom rests, and over how long, s.
const REST: f64 = 0.05;
const STILL_S: f64 = 0.05;
/// Time that the model has to come to rest, s.
const SETTLE_S: f64 = 1.0;
/// Part by which a size has to be off.
const LEAST: f64 = 0.005;
/// Change of size for the slope.
const STEP: f64 = 0.01;

/// A size that is off.
#[derive(Debug, Clone)]
pub(super) struct Size {
    pub place: Place,
    /// s, and its 95 % interval
    pub share: f64,
    pub ci95: [f64; 2],
    /// of as much by chance
    pub p_value: f64,
    /// recorded less the model's height: mean and root mean square, m
    pub mean_m: f64,
    pub rms_m: f64,
    /// trials
    pub n: usize,
}

impl Size {
    /// Whether it is off for sure, and by as much as matters.
    pub(super) fn counts(&self, p: f64) -> bool {
        self.p_value <= p && self.share.abs() >= LEAST
    }

    pub(super) fn chosen(&self) -> Option<Chosen> {
        Some(Chosen {
            effect: named(NAME)?,
            place: self.place.clone(),
            values: vec![self.share],
        })
    }
}

/// The size of the body that falls; nothing where fewer than two trials end at rest, or it has its size already.
pub(super) fn size(judge: &Judge<'_>, point: &Point) -> Result<Option<Size>, GapError> {
    let (Some(drop), Some(effect)) = (&judge.protocol.drop, named(NAME)) else {
        return Ok(None);
    };
    let model = &judge.problem.model;
    let joint = model.id(ObjectKind::Joint, &drop.joint)?;
    let body = model.name(ObjectKind::Body, model.jnt_bodyid()[joint] as usize);
    let place = Place::at(PlaceKind::Body, body.unwrap_or_default());
    let taken = point.chosen.iter().any(|c| c.effect.about().name == NAME);
    if taken || !effect.places(model).contains(&place) {
        return Ok(None);
    }
    let ends = &judge.ends;
    let height = model.jnt_qposadr()[joint] as usize + 2;
    let settled = |share: f64| -> Result<Option<Vec<f64>>, GapError> {
        let mut point = point.clone();
        point.chosen.push(Chosen {
            effect,
            place: place.clone(),
            values: vec![share],
        });
        let Some((_, problem, x)) = judge.build(&point, &judge.problem) else {
            return Ok(None);
        };
        let model = Arc::new(ensemble::model_at(&problem.model, &problem.parameters, &x)?);
        let each: Result<Vec<f64>, GapError> = ends
            .par_iter()
            .map(|qpos| settle(&model, qpos, height))
            .collect();
        Ok(Some(each?))
    };
    let (Some(as_is), Some(larger)) = (settled(0.0)?, settled(STEP)?) else {
        return Ok(None);
    };
    let off: Vec<f64> = ends
        .iter()
        .zip(&as_is)
        .map(|(q, m)| q[height] - m)
        .collect();
    let shares: Vec<f64> = (off.iter().zip(as_is.iter().zip(&larger)))
        .filter(|(_, (a, b))| b > a)
        .map(|(off, (a, b))| off * STEP / (b - a))
        .collect();
    if shares.len() < 2 {
        return Ok(None);
    }
    let n = shares.len() as f64;
    let (share, sigma) = mean(&shares);
    let half = two_sided_t(0.95, n - 1.0) * sigma;
    Ok(Some(Size {
        place,
        share,
        ci95: [share - half, share + half],
        p_value: two_sided(share / sigma, n - 1.0),
        mean_m: mean(&off).0,
        rms_m: rms(&off),
        n: shares.len(),
    }))
}

/// The last positions of all trials that end at rest.
pub(super) fn ends(problem: &Problem, protocol: &Settings) -> Result<Vec<Vec<f64>>, GapError> {
    let model = &problem.model;
    let mut ends = Vec::new();
    for trial in &problem.trials {
        let states = States::new(&trial.recording, model, protocol)?;
        ends.extend(end(&states, model.nq(), model.nv()));
    }
    Ok(ends)
}

/// The last positions of a recording; nothing where something moves there.
fn end(states: &States, nq: usize, nv: usize) -> Option<Vec<f64>> {
    let n = states.len();
    let last = states.time_s[n - 1] - STILL_S;
    let from = states.time_s.partition_point(|t| *t < last).min(n - 1);
    let rests = |dof: usize| {
        let speeds = |from: usize| states.qvel[from * nv + dof..].iter().step_by(nv);
        let most = speeds(0).fold(0.0_f64, |m, v| m.max(v.abs()));
        let mean = speeds(from).sum::<f64>() / (n - from) as f64;
        mean.abs() <= REST * most
    };
    if !(0..nv).all(rests) {
        return None;
    }
    Some(states.qpos[(n - 1) * nq..].to_vec())
}

/// Height at which the model's body comes to rest.
fn settle(model: &Arc<Model>, qpos: &[f64], height: usize) -> Result<f64, GapError> {
    let mut data = Data::new(Arc::clone(model))?;
    data.qpos_mut().copy_from_slice(qpos);
    for _ in 0..(SETTLE_S / model.timestep()).ceil() as usize {
        data.step()?;
    }
    Ok(data.qpos()[height])
}
