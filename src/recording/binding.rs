//! A table that tells what the columns of somebody else's log are.
//!
//! ```toml
//! time = "t_ms"          # column of times [time]
//! time_scale = 0.001     # seconds a unit of it [1]
//! trial = "toss"         # column that splits a table into recordings
//! ignore = ["comment"]   # columns left out
//!
//! [[channel]]
//! from = "q1"            # name in the log
//! to = "j1_pos"          # name in the model [as in the log]
//! scale = 0.0174533      # value = scale · logged + offset
//! offset = 0.0
//! unit = "rad"           # after scaling
//! kind = "sensor"        # sensor, control, goal, other
//! noise_sigma = 1e-4     # standard deviation after scaling
//! ```

use std::collections::BTreeSet;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::csv_read::{Layout, TIME};
use super::{Channel, Kind, Recording, RecordingError, Stream};

/// The table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Binding {
    /// column of times, in tables
    pub time: String,
    /// seconds a unit of that column
    pub time_scale: f64,
    /// column that names the trial, in tables of several
    pub trial: Option<String>,
    /// columns left out
    pub ignore: Vec<String>,
    /// what to change
    pub channel: Vec<Rule>,
}

/// One channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rule {
    /// name in the log
    pub from: String,
    /// name in the model; the same if not given
    #[serde(default)]
    pub to: Option<String>,
    /// factor on the logged value
    #[serde(default = "one")]
    pub scale: f64,
    /// added after the factor
    #[serde(default)]
    pub offset: f64,
    /// unit after scaling
    #[serde(default)]
    pub unit: Option<String>,
    /// part in the model
    #[serde(default)]
    pub kind: Option<Kind>,
    /// standard deviation of the noise after scaling
    #[serde(default)]
    pub noise_sigma: Option<f64>,
}

fn one() -> f64 {
    1.0
}

impl Default for Binding {
    fn default() -> Self {
        Self {
            time: TIME.to_owned(),
            time_scale: 1.0,
            trial: None,
            ignore: Vec::new(),
            channel: Vec::new(),
        }
    }
}

impl Binding {
    /// Read a table.
    ///
    /// # Errors
    /// The file cannot be read, or is not such a table; with its line.
    pub fn from_file(path: &Path) -> Result<Self, RecordingError> {
        let text =
            std::fs::read_to_string(path).map_err(|error| RecordingError::read(path, &error))?;
        Self::from_toml(&text, path)
    }

    /// As [`Binding::from_file`], of text; errors name `path`.
    ///
    /// # Errors
    /// It is not such a table.
    pub fn from_toml(text: &str, path: &Path) -> Result<Self, RecordingError> {
        let refuse = |line: usize, reason: String| RecordingError::Table {
            path: path.to_owned(),
            line,
            reason,
        };
        let binding: Self = toml::from_str(text).map_err(|error| {
            let line = |span: std::ops::Range<usize>| 1 + text[..span.start].matches('\n').count();
            refuse(
                error.span().map_or(1, line),
                error.message().replace('\n', ", "),
            )
        })?;
        match binding.mistake() {
            None => Ok(binding),
            Some(reason) => Err(refuse(1, reason)),
        }
    }

    /// The first setting out of range.
    fn mistake(&self) -> Option<String> {
        let positive = |x: f64| x.is_finite() && x > 0.0;
        if !positive(self.time_scale) {
            return Some(format!(
                "time_scale is {}, expected a positive number",
                self.time_scale
            ));
        }
        let mut seen = BTreeSet::new();
        for rule in &self.channel {
            let Rule {
                from,
                scale,
                offset,
                ..
            } = rule;
            if !seen.insert(from) {
                return Some(format!("channel `{from}` has two entries"));
            }
            if !scale.is_finite() || *scale == 0.0 {
                return Some(format!(
                    "channel `{from}`: scale is {scale}, expected a number that is not 0"
                ));
            }
            if !offset.is_finite() {
                return Some(format!("channel `{from}`: offset is {offset}"));
            }
            if rule.noise_sigma.is_some_and(|sigma| !positive(sigma)) {
                return Some(format!("channel `{from}`: noise_sigma is not positive"));
            }
        }
        None
    }

    /// Rename, scale, and label the channels of a recording.
    ///
    /// # Errors
    /// A channel is missing, or two would have one name; the recording is then unchanged.
    pub fn apply(&self, recording: &mut Recording) -> Result<(), RecordingError> {
        let refuse = |reason: String| Err(RecordingError::Binding { reason });
        for rule in &self.channel {
            if recording.channel(&rule.from).is_none() {
                let known: Vec<&str> = recording.channels().map(|c| c.name.as_str()).collect();
                return refuse(format!(
                    "no channel `{}` in the recording, which has {}",
                    rule.from,
                    known.join(", ")
                ));
            }
        }
        let mut seen = BTreeSet::new();
        for channel in recording.channels() {
            let name = self
                .rule(channel)
                .and_then(|r| r.to.as_ref())
                .unwrap_or(&channel.name);
            if !self.ignore.contains(&channel.name) && !seen.insert(name) {
                return refuse(format!("two channels would be called `{name}`"));
            }
        }
        let keeps = |c: &Channel| !self.ignore.contains(&c.name);
        recording
            .streams
            .retain(|s| s.channels.is_empty() || s.channels.iter().any(keeps));
        for stream in &mut recording.streams {
            self.drop_ignored(stream);
            self.change(stream);
        }
        Ok(())
    }

    fn rule(&self, channel: &Channel) -> Option<&Rule> {
        self.channel.iter().find(|rule| rule.from == channel.name)
    }

    fn drop_ignored(&self, stream: &mut Stream) {
        let keep: Vec<bool> = stream
            .channels
            .iter()
            .map(|c| !self.ignore.contains(&c.name))
            .collect();
        if keep.iter().all(|k| *k) {
            return;
        }
        let mut kept = keep.iter().cycle();
        stream.values.retain(|_| kept.next() == Some(&true));
        let mut kept = keep.iter();
        stream.channels.retain(|_| kept.next() == Some(&true));
    }

    fn change(&self, stream: &mut Stream) {
        let n = stream.channels.len();
        for column in 0..n {
            let channel = &mut stream.channels[column];
            let Some(rule) = self.channel.iter().find(|rule| rule.from == channel.name) else {
                continue;
            };
            channel.name = rule.to.as_ref().unwrap_or(&rule.from).clone();
            channel.kind = rule.kind.unwrap_or(channel.kind);
            if let Some(unit) = &rule.unit {
                channel.unit.clone_from(unit);
            }
            let scaled = channel.noise_sigma.map(|sigma| sigma * rule.scale.abs());
            channel.noise_sigma = rule.noise_sigma.or(scaled);
            if rule.scale != 1.0 || rule.offset != 0.0 {
                for value in stream.values.iter_mut().skip(column).step_by(n) {
                    *value = rule.scale * *value + rule.offset;
                }
            }
        }
    }

    /// What reading a table has to know.
    pub(super) fn layout(&self) -> Layout<'_> {
        Layout {
            time: &self.time,
            time_scale: self.time_scale,
            trial: self.trial.as_deref(),
            ignore: &self.ignore,
        }
    }
}

/// Read the recordings of a file, one a trial, with their channels named as in the model.
///
/// # Errors
/// As [`super::read`], and where file and table do not fit.
pub fn read_trials(path: &Path, binding: &Binding) -> Result<Vec<Recording>, RecordingError> {
    let loaded = super::salvage(path, binding)?;
    match loaded.damage {
        None => Ok(loaded.trials),
        Some(damage) => Err(damage),
    }
}
