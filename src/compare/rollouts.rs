//! Short rollouts: from recorded states, under the recorded controls or a policy; how far simulation and machine come
//! apart.

use std::sync::Arc;

use rayon::prelude::*;
use serde::Serialize;

use super::start::Start;
use super::{CompareError, Settings, States};
use crate::mujoco::{Data, Model, MujocoError, ObjectKind};

/// Horizon that stands for the end of the recording in results, s.
const TO_END: f64 = f64::INFINITY;

/// What a channel compares.
#[derive(Debug, Clone, PartialEq)]
enum Part {
    /// number of `qpos`
    Position(usize),
    /// number of `qvel`
    Velocity(usize),
    /// distance of the places of a free body, from this address in `qpos`
    Distance(usize),
    /// angle between its orientations, from this address
    Angle(usize),
}

#[derive(Debug, Clone, PartialEq)]
struct Channel {
    name: String,
    unit: &'static str,
    part: Part,
}

/// Deviations of one rollout within one horizon, per channel.
#[derive(Debug, Clone, Copy, Default)]
struct Deviation {
    n: usize,
    sum: f64,
    squares: f64,
    end: f64,
}

/// One rollout.
#[derive(Debug, Clone)]
pub struct Rolled {
    channels: Arc<Vec<Channel>>,
    /// (horizons × channels); nothing where the recording ends before
    deviations: Vec<Option<Vec<Deviation>>>,
    diverged: bool,
}

/// Mean deviation of a place or orientation from the recording, in one rollout up to one horizon.
#[derive(Debug, Clone, PartialEq)]
pub struct MeanDeviation<'a> {
    /// joint or body
    pub channel: &'a str,
    /// index of the horizon
    pub horizon: usize,
    /// of which the deviation is the magnitude
    pub dimensions: usize,
    /// mean magnitude, in the unit of the channel
    pub mean: f64,
}

impl Rolled {
    /// Whether the simulation broke down.
    pub fn diverged(&self) -> bool {
        self.diverged
    }

    /// Of joints, and of free bodies as a whole; velocities are left out.
    pub fn positions(&self) -> impl Iterator<Item = MeanDeviation<'_>> {
        let whole = |address: usize| {
            let parts = self.channels.iter().map(|c| &c.part);
            parts
                .filter(|p| matches!(p, Part::Distance(a) if (*a..a + 3).contains(&address)))
                .count()
                > 0
        };
        let dimensions = move |part: &Part| match part {
            Part::Distance(_) | Part::Angle(_) => Some(3),
            Part::Position(a) => (!whole(*a)).then_some(1),
            Part::Velocity(_) => None,
        };
        let horizons = self.deviations.iter().enumerate();
        horizons.flat_map(move |(horizon, deviations)| {
            let all = deviations.iter().flat_map(|d| self.channels.iter().zip(d));
            all.filter_map(move |(channel, d)| {
                Some(MeanDeviation {
                    channel: &channel.name,
                    horizon,
                    dimensions: dimensions(&channel.part)?,
                    mean: d.sum / d.n as f64,
                })
            })
        })
    }
}

/// Deviation of a channel within a horizon, over all rollouts.
#[derive(Debug, Clone, Serialize)]
pub struct Growth {
    /// joint or body
    pub channel: String,
    /// of the deviations
    pub unit: String,
    /// duration; none: to the end of the recording
    pub horizon_s: Option<f64>,
    /// rollouts
    pub n: usize,
    /// root mean square at the end of the horizon
    pub end_rms: f64,
    /// root mean square over all samples up to there
    pub window_rms: f64,
    /// mean over rollouts of the mean magnitude up to there
    pub mean: f64,
    /// standard deviation of that between rollouts
    pub mean_sigma: f64,
}

/// All rollouts.
#[derive(Debug, Clone, Serialize)]
pub struct Rollouts {
    /// rollouts that were simulated
    pub n: usize,
    /// of which the simulation broke down; they are in no figure
    pub diverged: usize,
    /// recordings without a start
    pub skipped: usize,
    /// by channel, then horizon
    pub growth: Vec<Growth>,
}

/// What is compared, of what was measured.
fn channels(model: &Model, states: &States) -> Vec<Channel> {
    let mut channels = Vec::new();
    let seen = |address: usize| states.measured_qpos.contains(&address);
    for joint in 0..model.njnt() {
        let name = model.name(ObjectKind::Joint, joint).unwrap_or("joint");
        let (q, v) = (
            model.jnt_qposadr()[joint] as usize,
            model.jnt_dofadr()[joint] as usize,
        );
        let mut add = |name: String, unit, part| channels.push(Channel { name, unit, part });
        if let Some(slide) = model.is_slide(joint) {
            if seen(q) {
                let (position, velocity) = if slide {
                    ("m", "m/s")
                } else {
                    ("rad", "rad/s")
                };
                add(name.to_owned(), position, Part::Position(q));
                add(format!("{name} velocity"), velocity, Part::Velocity(v));
            }
        } else if model.is_free(joint) {
            for (i, axis) in ["x", "y", "z"]
                .into_iter()
                .enumerate()
                .filter(|(i, _)| seen(q + i))
            {
                add(format!("{name} {axis}"), "m", Part::Position(q + i));
            }
            if (0..3).all(|i| seen(q + i)) {
                add(format!("{name} distance"), "m", Part::Distance(q));
            }
            if (3..7).all(|i| seen(q + i)) {
                add(format!("{name} rotation"), "rad", Part::Angle(q + 3));
            }
        }
    }
    channels
}

fn horizons(settings: &Settings) -> Vec<f64> {
    let end = settings.to_end.then_some(TO_END);
    settings.horizons_s.iter().copied().chain(end).collect()
}

/// Sets the controls of a step that begins at a time.
pub type Drive<'a> = &'a (dyn Fn(&mut Data, f64) + Sync);

/// Simulate from every start, driven by `drive`.
///
/// # Errors
/// The engine fails.
pub fn roll_out(
    model: &Arc<Model>,
    states: &States,
    starts: &[Start],
    settings: &Settings,
    drive: Drive<'_>,
) -> Result<Vec<Rolled>, CompareError> {
    let channels = Arc::new(channels(model, states));
    let horizons = horizons(settings);
    let results: Vec<Result<Rolled, MujocoError>> = starts
        .par_iter()
        .map_init(
            || Data::new(Arc::clone(model)),
            |data, start| match data {
                Ok(data) => from(data, states, start, &channels, &horizons, drive),
                Err(error) => Err(error.clone()),
            },
        )
        .collect();
    Ok(results.into_iter().collect::<Result<_, _>>()?)
}

/// Position (nq) and velocity (nv).
type Moved<'a> = (&'a [f64], &'a [f64]);

/// A simulation from a start, in the order of time.
pub(crate) struct Run<'d> {
    data: &'d mut Data,
    begin_s: f64,
    steps: usize,
    qpos: Vec<f64>,
}

impl<'d> Run<'d> {
    pub(crate) fn new(
        data: &'d mut Data,
        states: &States,
        start: &Start,
    ) -> Result<Self, MujocoError> {
        let nq = data.model().nq();
        let begin_s = states.time_s[start.sample];
        data.reset();
        data.set_memory(states.memory(start.sample))?;
        data.set_time(begin_s);
        let row = start.sample * nq..(start.sample + 1) * nq;
        data.qpos_mut().copy_from_slice(&states.qpos[row]);
        data.qvel_mut().copy_from_slice(&start.qvel);
        Ok(Self {
            data,
            begin_s,
            steps: 0,
            qpos: vec![0.0; nq],
        })
    }

    /// Position and velocity at a time: by whole steps, and the rest of a step at constant velocity. None where the
    /// simulation broke down.
    pub(crate) fn at(
        &mut self,
        time_s: f64,
        drive: Drive<'_>,
    ) -> Result<Option<Moved<'_>>, MujocoError> {
        let h = self.data.model().timestep();
        let elapsed = time_s - self.begin_s;
        while (self.steps as f64 + 0.5) * h <= elapsed {
            drive(self.data, self.begin_s + self.steps as f64 * h);
            self.data.step()?;
            self.steps += 1;
        }
        if self.data.warnings().diverged() {
            return Ok(None);
        }
        self.qpos.copy_from_slice(self.data.qpos());
        let rest = elapsed - self.steps as f64 * h;
        let model = self.data.model();
        model.integrate_pos(&mut self.qpos, self.data.qvel(), rest)?;
        Ok(Some((&self.qpos, self.data.qvel())))
    }
}

/// One rollout, compared at every sample.
fn from(
    data: &mut Data,
    states: &States,
    start: &Start,
    channels: &Arc<Vec<Channel>>,
    horizons: &[f64],
    drive: Drive<'_>,
) -> Result<Rolled, MujocoError> {
    let (nq, nv) = (data.model().nq(), data.model().nv());
    let begin = states.time_s[start.sample];
    let mut run = Run::new(data, states, start)?;
    // half an interval: the sample nearest to the end of a horizon belongs to it
    let slack = 0.5 * states.interval_s();
    let longest = horizons.iter().copied().fold(0.0, f64::max);
    let mut running = vec![Deviation::default(); channels.len()];
    let mut deviations = vec![None; horizons.len()];
    for k in start.sample..states.len() {
        let elapsed = states.time_s[k] - begin;
        if elapsed > longest + slack {
            break;
        }
        let Some(simulated) = run.at(states.time_s[k], drive)? else {
            break;
        };
        let real = (
            &states.qpos[k * nq..(k + 1) * nq],
            &states.qvel[k * nv..(k + 1) * nv],
        );
        for (channel, sum) in channels.iter().zip(&mut running) {
            let error = deviation(&channel.part, simulated, real);
            *sum = Deviation {
                n: sum.n + 1,
                sum: sum.sum + error,
                squares: sum.squares + error * error,
                end: error,
            };
        }
        for (horizon, result) in horizons.iter().zip(&mut deviations) {
            let last = k + 1 == states.len();
            let next = states
                .time_s
                .get(k + 1)
                .map_or(f64::INFINITY, |t| t - begin);
            let reached =
                elapsed <= horizon + slack && next > horizon + slack && elapsed >= horizon - slack;
            if reached || (last && *horizon == TO_END) {
                *result = Some(running.clone());
            }
        }
    }
    Ok(Rolled {
        channels: Arc::clone(channels),
        deviations,
        diverged: data.warnings().diverged(),
    })
}

/// Magnitude of the difference of two states.
fn deviation(part: &Part, simulated: Moved<'_>, real: Moved<'_>) -> f64 {
    match *part {
        Part::Position(i) => (simulated.0[i] - real.0[i]).abs(),
        Part::Velocity(i) => (simulated.1[i] - real.1[i]).abs(),
        Part::Distance(i) => {
            let square = |j: usize| (simulated.0[j] - real.0[j]).powi(2);
            (i..i + 3).map(square).sum::<f64>().sqrt()
        }
        Part::Angle(i) => {
            // by the shorter chord: exact where an arc cosine of the product is not
            let chord = |sign: f64| -> f64 {
                let square = |j: usize| (simulated.0[j] - sign * real.0[j]).powi(2);
                (i..i + 4).map(square).sum::<f64>().sqrt()
            };
            4.0 * (0.5 * chord(1.0).min(chord(-1.0))).min(1.0).asin()
        }
    }
}

/// Figures over all rollouts, in the order of the first one's channels.
pub(super) fn summarise(rolled: &[Rolled], skipped: usize, settings: &Settings) -> Rollouts {
    let sound: Vec<&Rolled> = rolled.iter().filter(|r| !r.diverged).collect();
    let mut names: Vec<Channel> = Vec::new();
    for rollout in rolled {
        for channel in rollout.channels.iter() {
            if !names.contains(channel) {
                names.push(channel.clone());
            }
        }
    }
    let mut growth = Vec::new();
    for channel in &names {
        for (h, horizon) in horizons(settings).into_iter().enumerate() {
            let of = |r: &&Rolled| {
                let i = r.channels.iter().position(|c| c == channel)?;
                Some(r.deviations[h].as_ref()?[i])
            };
            let all: Vec<Deviation> = sound.iter().filter_map(of).collect();
            if !all.is_empty() {
                growth.push(summary(channel, horizon, &all));
            }
        }
    }
    Rollouts {
        n: rolled.len(),
        diverged: rolled.len() - sound.len(),
        skipped,
        growth,
    }
}

fn summary(channel: &Channel, horizon: f64, all: &[Deviation]) -> Growth {
    let n = all.len() as f64;
    let samples: usize = all.iter().map(|d| d.n).sum();
    let means: Vec<f64> = all.iter().map(|d| d.sum / d.n as f64).collect();
    let mean = means.iter().sum::<f64>() / n;
    let variance = means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    Growth {
        channel: channel.name.clone(),
        unit: channel.unit.to_owned(),
        horizon_s: horizon.is_finite().then_some(horizon),
        n: all.len(),
        end_rms: (all.iter().map(|d| d.end * d.end).sum::<f64>() / n).sqrt(),
        window_rms: (all.iter().map(|d| d.squares).sum::<f64>() / samples as f64).sqrt(),
        mean,
        mean_sigma: variance.sqrt(),
    }
}
