//! What is wrong with a recording, each finding with its channel and the time where it begins.
//!
//! | rule | severity | finding |
//! | --- | --- | --- |
//! | `damaged` | error | the file ends early, or bytes are changed |
//! | `time_backwards` | error | a stamp before the one before |
//! | `stamp_twice` | error | a stamp as the one before |
//! | `not_finite` | error | an infinite value |
//! | `rate` | error | stamps do not fit the nominal rate |
//! | `unit` | error | the unit is not that of the sensor |
//! | `name_twice` | error | two channels of one name, or for one number of the model |
//! | `no_control` | error | no channel for an actuator |
//! | `gap` | warning | an interval of several periods |
//! | `missing` | warning | some rows, not the most, lack a number |
//! | `no_samples` | warning | a channel without any number |
//! | `never_moves` | warning | one value throughout |
//! | `no_sensor` | warning | no channel for a sensor |
//! | `not_in_model` | warning | a channel for nothing in the model |
//! | `skipped` | warning | a topic that holds no rows of numbers |

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{Binding, Bound, Channel, Kind, Recording, RecordingError, Stream, salvage};
use crate::mujoco::Model;

/// Intervals longer than so many usual ones are gaps.
const GAP_PERIODS: f64 = 2.5;
/// Largest relative difference of the usual interval from the nominal one.
const RATE_TOLERANCE: f64 = 0.05;
/// Samples from which intervals and movement mean something.
const ENOUGH: usize = 10;

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// worth knowing
    Warning,
    /// results would be wrong
    Error,
}

/// Something wrong.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// how bad
    pub severity: Severity,
    /// which rule; see the module
    pub rule: &'static str,
    /// the file, if it is known
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// the trial, in a file of several
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trial: Option<String>,
    /// the channel, or the stream
    #[serde(skip_serializing_if = "Option::is_none")]
    pub channel: Option<String>,
    /// where it begins, s
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_s: Option<f64>,
    /// what was found
    pub message: String,
}

impl Finding {
    fn new(severity: Severity, rule: &'static str, message: String) -> Self {
        Self {
            severity,
            rule,
            file: None,
            trial: None,
            channel: None,
            time_s: None,
            message,
        }
    }

    fn of(mut self, channel: &str) -> Self {
        self.channel = Some(channel.to_owned());
        self
    }

    fn at(mut self, stream: &Stream, sample: usize) -> Self {
        self.time_s = Some(stream.time(sample));
        self
    }
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some(file) = &self.file {
            write!(f, "{}: ", file.display())?;
        }
        f.write_str(match self.severity {
            Severity::Warning => "warning: ",
            Severity::Error => "error: ",
        })?;
        if let Some(trial) = &self.trial {
            write!(f, "trial {trial}: ")?;
        }
        if let Some(channel) = &self.channel {
            write!(f, "{channel}: ")?;
        }
        if let Some(time) = self.time_s {
            write!(f, "at {time} s: ")?;
        }
        write!(f, "{} [{}]", self.message, self.rule)
    }
}

/// Check a file: whether it is whole, and what it holds, all that can be read of it.
///
/// # Errors
/// Nothing of it can be read, or the binding does not fit.
pub fn check_file(
    path: &Path,
    binding: &Binding,
    model: Option<&Model>,
) -> Result<Vec<Finding>, RecordingError> {
    let loaded = salvage(path, binding)?;
    let mut findings = Vec::new();
    if let Some(damage) = &loaded.damage {
        let message = match damage {
            RecordingError::Damaged { offset, reason, .. } => format!("byte {offset}: {reason}"),
            RecordingError::Content { place, reason, .. } => format!("{place}: {reason}"),
            other => other.to_string(),
        };
        findings.push(Finding::new(Severity::Error, "damaged", message));
    }
    for topic in &loaded.skipped {
        let message = "holds no rows of numbers in JSON, left out".to_owned();
        findings.push(Finding::new(Severity::Warning, "skipped", message).of(topic));
    }
    for recording in &loaded.trials {
        let trial = (loaded.trials.len() > 1).then(|| recording.meta.trial.clone());
        findings.extend(check(recording, model).into_iter().map(|finding| Finding {
            trial: trial.clone(),
            ..finding
        }));
    }
    for finding in &mut findings {
        finding.file = Some(path.to_owned());
    }
    Ok(findings)
}

/// Check a recording, and with a model whether it fits.
pub fn check(recording: &Recording, model: Option<&Model>) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut seen = BTreeSet::new();
    for channel in recording.channels() {
        if !seen.insert(&channel.name) {
            let message = "two channels have this name".to_owned();
            findings.push(Finding::new(Severity::Error, "name_twice", message).of(&channel.name));
        }
    }
    for stream in &recording.streams {
        stamps(stream, &mut findings);
        for (column, channel) in stream.channels.iter().enumerate() {
            values(stream, column, channel, &mut findings);
        }
    }
    if let Some(model) = model {
        against(recording, model, &mut findings);
    }
    findings
}

/// Order, rate and gaps of a stream.
fn stamps(stream: &Stream, findings: &mut Vec<Finding>) {
    for (rule, what, bad) in [
        (
            "time_backwards",
            "time runs backwards",
            (|a, b| b < a) as fn(i64, i64) -> bool,
        ),
        ("stamp_twice", "two samples have one stamp", |a, b| a == b),
    ] {
        let pairs = || stream.stamps_ns.windows(2).enumerate();
        let count = pairs().filter(|(_, pair)| bad(pair[0], pair[1])).count();
        if let Some((first, _)) = pairs().find(|(_, pair)| bad(pair[0], pair[1])) {
            let message = format!("{what}, {count} times");
            findings.push(
                Finding::new(Severity::Error, rule, message)
                    .of(&stream.name)
                    .at(stream, first + 1),
            );
        }
    }
    let all: Vec<usize> = (0..stream.len()).collect();
    let Some(usual) = gaps(stream, &stream.name, &all, findings) else {
        return;
    };
    if let Some(rate) = stream.rate_hz
        && ((1.0 / usual - rate) / rate).abs() > RATE_TOLERANCE
    {
        let message = format!(
            "nominal rate {rate} Hz, stamps are {usual} s apart ({:.6} Hz)",
            1.0 / usual
        );
        findings.push(Finding::new(Severity::Error, "rate", message).of(&stream.name));
    }
}

/// Long intervals among `samples` of a stream; returns the usual interval in s.
fn gaps(
    stream: &Stream,
    name: &str,
    samples: &[usize],
    findings: &mut Vec<Finding>,
) -> Option<f64> {
    if samples.len() < ENOUGH {
        return None;
    }
    let interval = |pair: &[usize]| {
        (i128::from(stream.stamps_ns[pair[1]]) - i128::from(stream.stamps_ns[pair[0]])) as f64
            * 1e-9
    };
    let mut sorted: Vec<f64> = samples
        .windows(2)
        .map(interval)
        .filter(|dt| *dt > 0.0)
        .collect();
    let middle = sorted.len() / 2;
    let usual = *sorted
        .get_mut(..)?
        .select_nth_unstable_by(middle, f64::total_cmp)
        .1;
    let long = || {
        samples
            .windows(2)
            .filter(|pair| interval(pair) > GAP_PERIODS * usual)
    };
    if let Some(first) = long().next() {
        let longest = long().map(interval).fold(0.0, f64::max);
        let message = format!(
            "{} gaps, the first of {:.6} s, the longest of {longest:.6} s; samples are usually {usual:.6} s apart",
            long().count(),
            interval(first),
        );
        findings.push(
            Finding::new(Severity::Warning, "gap", message)
                .of(name)
                .at(stream, first[0]),
        );
    }
    Some(usual)
}

/// The numbers of one channel.
fn values(stream: &Stream, column: usize, channel: &Channel, findings: &mut Vec<Finding>) {
    let value = |sample: usize| stream.row(sample)[column];
    let samples: Vec<usize> = (0..stream.len()).filter(|i| !value(*i).is_nan()).collect();
    let add = |finding: Finding| finding.of(&channel.name);
    let infinite = || samples.iter().filter(|i| value(**i).is_infinite());
    if let Some(first) = infinite().next() {
        let message = format!("{} values are infinite", infinite().count());
        findings.push(add(Finding::new(Severity::Error, "not_finite", message)).at(stream, *first));
    }
    let Some(first) = samples.first() else {
        let message = "no sample in the whole recording".to_owned();
        findings.push(add(Finding::new(Severity::Warning, "no_samples", message)));
        return;
    };
    // goals and others may change when they like
    if !matches!(channel.kind, Kind::Sensor | Kind::Control) {
        return;
    }
    if samples.len() < stream.len() {
        gaps(stream, &channel.name, &samples, findings);
    }
    // a table of several clocks lacks most numbers of the slower ones, and that is right
    let missing = stream.len() - samples.len();
    if let Some(first) = (0..stream.len()).find(|i| value(*i).is_nan())
        && missing < samples.len()
    {
        let message = format!("{missing} of {} samples have no number", stream.len());
        findings.push(add(Finding::new(Severity::Warning, "missing", message)).at(stream, first));
    }
    if samples.len() >= ENOUGH && samples.iter().all(|i| value(*i) == value(*first)) {
        let message = format!("all {} samples are {}", samples.len(), value(*first));
        findings
            .push(add(Finding::new(Severity::Warning, "never_moves", message)).at(stream, *first));
    }
}

/// Names and units against the model.
fn against(recording: &Recording, model: &Model, findings: &mut Vec<Finding>) {
    let bound = match Bound::new(recording, model) {
        Ok(bound) => bound,
        Err(error) => {
            findings.push(Finding::new(
                Severity::Error,
                "name_twice",
                error.to_string(),
            ));
            return;
        }
    };
    for (stream, column, expected) in bound.wrong_units(recording, model) {
        let channel = &recording.streams[stream].channels[column];
        let message = format!("unit `{}`, the sensor has `{expected}`", channel.unit);
        findings.push(Finding::new(Severity::Error, "unit", message).of(&channel.name));
    }
    for unbound in &bound.unbound {
        let message = format!("not in the model: {}", unbound.reason);
        findings.push(Finding::new(Severity::Warning, "not_in_model", message).of(&unbound.name));
    }
    for name in bound.missing_controls(model) {
        let message = "no channel has the control of this actuator".to_owned();
        findings.push(Finding::new(Severity::Error, "no_control", message).of(&name));
    }
    for name in bound.missing_sensors(model) {
        let message = "no channel, or not all components, of this sensor".to_owned();
        findings.push(Finding::new(Severity::Warning, "no_sensor", message).of(&name));
    }
}
