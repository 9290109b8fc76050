//! Recorded logs of a machine: several streams, each with its own clock, channels and units.
//!
//! A recording is read from and written to MCAP, or CSV ([`read()`], [`write()`]). In memory a stream holds its stamps
//! and one row of numbers a stamp:
//!
//! ```text
//! recording ── streams ── stamps_ns [n]            nanoseconds since `Meta::start_ns`
//!                      ── values    [n × channels]  row by row; NaN: no sample of this channel at this time
//!                      ── channels  [{name, kind, unit, noise_sigma}]
//! ```
//!
//! Stamps are whole nanoseconds, so that they pass through every format unchanged.

mod binding;
mod bound;
mod check;
mod csv_read;
mod csv_write;
mod error;
mod load;
mod mcap_lengths;
mod mcap_read;
mod mcap_streams;
mod mcap_write;
mod merge;
mod row;
mod side;

use serde::{Deserialize, Serialize};

pub use binding::{Binding, Rule, read_trials};
pub use bound::{Bound, BoundChannel, Unbound};
pub use check::{Finding, Severity, check, check_file};
pub use error::RecordingError;
pub use load::{Loaded, read, salvage, write};

/// What a channel is, seen from the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// measured; compared with the sensor of the same name
    Sensor,
    /// commanded; drives the actuator of the same name
    Control,
    /// where the task wants the object, `goal[i]`
    Goal,
    /// anything else, carried along
    Other,
}

/// One scalar signal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Channel {
    /// as the model's sensor or actuator; a component of a vector is `name[i]`
    pub name: String,
    /// its part in the model
    pub kind: Kind,
    /// `rad`, `rad/s`, `m`, `m/s`, `N`, `N m`, `m/s^2`, `1` …; empty: unknown
    #[serde(default)]
    pub unit: String,
    /// known standard deviation of the noise, in `unit`
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub noise_sigma: Option<f64>,
}

/// Channels that are sampled together.
#[derive(Debug, Clone, PartialEq)]
pub struct Stream {
    /// topic
    pub name: String,
    /// nominal rate in 1/s
    pub rate_hz: Option<f64>,
    /// in the order of a row
    pub channels: Vec<Channel>,
    /// (n) nanoseconds since `Meta::start_ns`, strictly increasing in a sound recording
    pub stamps_ns: Vec<i64>,
    /// (n × channels) row by row, NaN where a channel has no sample
    pub values: Vec<f64>,
}

/// What is known of a recording as a whole.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Meta {
    /// [`crate::mujoco::Model::fingerprint`] of the model that describes the machine, if known
    #[serde(default)]
    pub model_hash: String,
    /// start, nanoseconds since 1970; 0: unknown
    #[serde(default)]
    pub start_ns: u64,
    /// machine or program it comes from
    #[serde(default)]
    pub source: String,
    /// number or name of the trial
    #[serde(default)]
    pub trial: String,
    /// free text
    #[serde(default)]
    pub notes: String,
}

/// A log.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Recording {
    /// of the whole
    pub meta: Meta,
    /// each with its own stamps
    pub streams: Vec<Stream>,
}

impl Stream {
    /// A stream without samples.
    pub fn new(name: &str, rate_hz: Option<f64>, channels: Vec<Channel>) -> Self {
        Self {
            name: name.to_owned(),
            rate_hz,
            channels,
            stamps_ns: Vec::new(),
            values: Vec::new(),
        }
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.stamps_ns.len()
    }

    /// Whether there is no sample.
    pub fn is_empty(&self) -> bool {
        self.stamps_ns.is_empty()
    }

    /// Append a sample; `row` has one number a channel.
    ///
    /// # Panics
    /// If `row` has another length.
    pub fn push(&mut self, stamp_ns: i64, row: &[f64]) {
        assert_eq!(row.len(), self.channels.len(), "one number a channel");
        self.stamps_ns.push(stamp_ns);
        self.values.extend_from_slice(row);
    }

    /// Sample `i`, one number a channel.
    pub fn row(&self, i: usize) -> &[f64] {
        let n = self.channels.len();
        &self.values[i * n..(i + 1) * n]
    }

    /// Time of sample `i` in s.
    pub fn time(&self, i: usize) -> f64 {
        self.stamps_ns[i] as f64 * 1e-9
    }
}

impl Recording {
    /// All channels, stream by stream.
    pub fn channels(&self) -> impl Iterator<Item = &Channel> {
        self.streams.iter().flat_map(|s| &s.channels)
    }

    /// The stream and column of a channel.
    pub fn channel(&self, name: &str) -> Option<(&Stream, usize)> {
        self.streams.iter().find_map(|stream| {
            let column = stream.channels.iter().position(|c| c.name == name)?;
            Some((stream, column))
        })
    }
}
