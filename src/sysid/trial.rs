//! One recording on the grid of the model's time step.

use std::sync::Arc;

use super::SysidError;
use super::norm::Norm;
use super::problem::{Channel, ProblemConfig, Sample, Setting, Stage, Trial};
use crate::mjcf::glob;
use crate::mujoco::{Measures, Model};
use crate::recording::{Bound, BoundChannel, Channel as Described, Recording};

/// Least number of knots of a recording.
const MIN_KNOTS: usize = 8;
/// Ranges of a limited joint that its position may move through: degrees for rad are 57, mm for m 1000.
const MOST_RANGES: f64 = 5.0;

/// Samples and controls of a recording; its channels join those of earlier recordings, and so do notes.
pub(super) fn trial(
    model: &Model,
    config: &ProblemConfig,
    name: &str,
    recording: &Recording,
    bound: &Bound,
    (channels, notes): (&mut Vec<Channel>, &mut Vec<String>),
) -> Result<Trial, SysidError> {
    let refuse = |reason: String| SysidError::Recording {
        recording: name.to_owned(),
        reason,
    };
    if let Some(&(stream, column, expected)) = bound.wrong_units(recording, model).first() {
        let Described { name, unit, .. } = &recording.streams[stream].channels[column];
        return Err(refuse(format!(
            "channel `{name}` is in {unit}, its number in the model in {expected}; convert it in a binding table \
             (--binding: from, scale, unit)"
        )));
    }
    let n_sensordata = model.nsensordata();
    let measured = (bound
        .sensors
        .iter()
        .map(|b| (b, b.address, sensor_stage(model, b))))
    .chain(
        bound
            .qpos
            .iter()
            .map(|b| (b, n_sensordata + b.address, Stage::Position)),
    )
    .chain(
        bound
            .qvel
            .iter()
            .map(|b| (b, n_sensordata + model.nq() + b.address, Stage::Velocity)),
    );
    let mut series = Vec::new();
    for (b, source, stage) in measured {
        let described = &recording.streams[b.stream].channels[b.column];
        let rule = config
            .channel
            .iter()
            .find(|r| glob::matches(&r.name, &described.name));
        if rule.is_some_and(|r| r.ignore) {
            continue;
        }
        let known = rule.and_then(|r| r.noise_sigma).or(b.noise_sigma);
        if known.is_some_and(|s| !s.is_finite() || s <= 0.0)
            || rule.is_some_and(|r| !r.norm.is_valid())
        {
            return Err(refuse(format!(
                "channel `{}` needs a positive noise_sigma and norm",
                described.name
            )));
        }
        let values = samples(recording, b).map_err(&refuse)?;
        let lacks = recording.streams[b.stream].len() - values.len();
        // a table of several clocks lacks most numbers of the slower ones, and that is right
        if lacks > 0 && (lacks < values.len() || values.is_empty()) {
            notes.push(format!(
                "{name}: channel `{}` has no number in {lacks} of {} rows, which are left out",
                described.name,
                lacks + values.len()
            ));
        }
        if values.is_empty() {
            continue;
        }
        if let Some(joint) = position_of(model, source)
            && let Some(reason) = beyond_range(model, joint, &values)
        {
            return Err(refuse(format!("channel `{}` {reason}", described.name)));
        }
        let index = channels
            .iter()
            .position(|c| c.name == described.name)
            .unwrap_or_else(|| {
                channels.push(Channel {
                    name: described.name.clone(),
                    unit: described.unit.clone(),
                    source,
                    stage,
                    sigma: known.unwrap_or(0.0),
                    sigma_known: known.is_some(),
                    norm: rule.map_or(Norm::Quadratic, |r| r.norm),
                    bias: Setting::Fixed(0.0),
                    gain: Setting::Fixed(1.0),
                    delay: Setting::Fixed(0.0),
                });
                channels.len() - 1
            });
        series.push((index, values));
    }
    if series.is_empty() {
        return Err(refuse(
            "no channel is a sensor, joint position or velocity of the model".into(),
        ));
    }
    let first = |values: &[(f64, f64)]| values.first().map_or(f64::INFINITY, |s| s.0);
    let last = |values: &[(f64, f64)]| values.last().map_or(f64::NEG_INFINITY, |s| s.0);
    let mut controls: Vec<Vec<(f64, f64)>> = vec![Vec::new(); model.nu()];
    for b in &bound.controls {
        let series = samples(recording, b).map_err(&refuse)?;
        let stream = &recording.streams[b.stream];
        let control = &stream.channels[b.column].name;
        let lacks = stream.len() - series.len();
        if series.is_empty() {
            return Err(refuse(format!("control `{control}` has no number at all")));
        }
        if lacks > 0 && lacks < series.len() {
            notes.push(format!(
                "{name}: control `{control}` has no number in {lacks} of {} rows, where the one before holds on",
                stream.len()
            ));
        }
        controls[b.address] = series;
    }
    let sensed = series
        .iter()
        .map(|(_, v)| first(v))
        .fold(f64::INFINITY, f64::min);
    let start = controls.iter().map(|v| first(v)).fold(sensed, f64::max);
    let end = series
        .iter()
        .map(|(_, v)| last(v))
        .fold(f64::NEG_INFINITY, f64::max);
    let h = model.timestep();
    let n_knots = if end > start {
        ((end - start) / h + 1e-6).floor() as usize + 1
    } else {
        0
    };
    if n_knots < MIN_KNOTS {
        return Err(refuse(format!(
            "it covers {n_knots} steps of the model ({h} s each) with both sensors and controls, at least {MIN_KNOTS} are needed"
        )));
    }
    for control in &mut controls {
        for (time, _) in control {
            *time -= start;
        }
    }
    let mut all: Vec<Sample> = (series.iter())
        .flat_map(|(channel, values)| {
            (values.iter().zip(spreads(values))).map(|(&(time, value), spread)| Sample {
                channel: *channel,
                time: time - start,
                value,
                spread,
            })
        })
        .filter(|s| s.time > -1e-9)
        .collect();
    all.sort_by(|a, b| a.time.total_cmp(&b.time).then(a.channel.cmp(&b.channel)));
    Ok(Trial {
        name: name.to_owned(),
        n_knots,
        start_s: start,
        controls: Arc::new(controls),
        samples: Arc::new(all),
        recording: Arc::new(recording.clone()),
        path: None,
    })
}

/// The hinge or slide whose position a number of (sensordata, qpos, qvel) is.
fn position_of(model: &Model, source: usize) -> Option<usize> {
    let n = model.nsensordata();
    let address = if source >= n {
        (source - n < model.nq()).then_some(source - n)?
    } else {
        let owns = |sensor: &usize| model.sensor_adr()[*sensor] as usize == source;
        match model.measures((0..model.nsensor()).find(owns)?) {
            Measures::Position(address) => address,
            _ => return None,
        }
    };
    (0..model.njnt())
        .find(|j| model.jnt_qposadr()[*j] as usize == address && model.is_slide(*j).is_some())
}

/// Why readings cannot be positions of a limited joint in the model's unit.
fn beyond_range(model: &Model, joint: usize, values: &[(f64, f64)]) -> Option<String> {
    let (low, high) = (values.iter().map(|v| v.1))
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| {
            (l.min(v), h.max(v))
        });
    let range = model.jnt_range()[2 * joint + 1] - model.jnt_range()[2 * joint];
    if model.jnt_limited()[joint] == 0 || high - low <= MOST_RANGES * range {
        return None;
    }
    let (unit, other) = match model.is_slide(joint) {
        Some(true) => ("m", "mm"),
        _ => ("rad", "degrees"),
    };
    Some(format!(
        "moves through {:.4} where its joint has a range of {range:.4} {unit}: is it in {other}? convert it in a binding \
         table (--binding: from, scale, unit)",
        high - low
    ))
}

/// √n for every reading in a run of n equal ones.
pub(crate) fn spreads(values: &[(f64, f64)]) -> Vec<f64> {
    values
        .chunk_by(|a, b| a.1 == b.1)
        .flat_map(|run| vec![(run.len() as f64).sqrt(); run.len()])
        .collect()
}

/// Times and numbers of a channel, rows without a number left out.
fn samples(recording: &Recording, b: &BoundChannel) -> Result<Vec<(f64, f64)>, String> {
    let stream = &recording.streams[b.stream];
    let all = || (0..stream.len()).map(|i| (stream.time(i), stream.row(i)[b.column]));
    match all().find(|(_, value)| value.is_infinite()) {
        Some((time, value)) => Err(format!(
            "channel `{}` is {value} at {time} s; a number that is missing is written as NaN or left empty",
            stream.channels[b.column].name
        )),
        None => Ok(all().filter(|(_, value)| !value.is_nan()).collect()),
    }
}

fn sensor_stage(model: &Model, b: &BoundChannel) -> Stage {
    match model.sensor_needstage()[b.object] {
        1 => Stage::Position,
        2 => Stage::Velocity,
        _ => Stage::Acceleration,
    }
}
