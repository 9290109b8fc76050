//! From MCAP's channels and messages to streams.

use std::collections::BTreeMap;
use std::path::Path;

use mcap::records::{Channel as Topic, Record, op};

use super::load::Loaded;
use super::mcap_lengths;
use super::mcap_read::{CHANNELS, RATE, RECORDING, Stop, ZERO};
use super::{Channel, Kind, Meta, Recording, RecordingError, Stream, row};

/// Sequence number, log time and publish time follow the channel's id in a message.
const MESSAGE_HEADER: usize = 22;
/// Log times before this are no dates; a file that does not tell its start then counts from 0.
const YEAR_NS: u64 = 365 * 24 * 3600 * 1_000_000_000;

/// Where the messages of a topic go.
enum Target {
    Stream(usize),
    /// not numbers in JSON
    Skipped,
}

/// A stream under way; its stamps are log times.
struct Growing {
    stream: Stream,
    /// the topic names its channels; else the first message counts them
    described: bool,
    log_times: Vec<u64>,
}

/// Collects records.
#[derive(Default)]
pub(super) struct Streams {
    /// by MCAP's channel id
    topics: BTreeMap<u16, (Topic, Target)>,
    growing: Vec<Growing>,
    meta: Option<Meta>,
    zero_ns: Option<u64>,
}

impl Streams {
    /// Take in a record of any kind.
    pub(super) fn record(&mut self, opcode: u8, body: &[u8]) -> Result<(), Stop> {
        match opcode {
            op::MESSAGE => self.message(body),
            op::CHANNEL => match mcap_lengths::parse(opcode, body)? {
                Record::Channel(topic) => self.topic(topic),
                _ => Ok(()),
            },
            op::METADATA => match mcap_lengths::parse(opcode, body)? {
                Record::Metadata(record) if record.name == RECORDING => self.meta(&record.metadata),
                _ => Ok(()),
            },
            _ => Ok(()),
        }
    }

    fn meta(&mut self, entries: &BTreeMap<String, String>) -> Result<(), Stop> {
        let text = |key: &str| entries.get(key).cloned().unwrap_or_default();
        let number = |key: &str| match entries.get(key) {
            None => Ok(None),
            Some(text) => text.parse().map(Some).map_err(|_| Stop::Content {
                place: format!("metadata `{RECORDING}`"),
                reason: format!("`{key}` is `{text}`, expected whole nanoseconds"),
            }),
        };
        let start_ns = number("start_ns")?.unwrap_or(0);
        self.zero_ns = Some(number(ZERO)?.unwrap_or(start_ns));
        self.meta = Some(Meta {
            model_hash: text("model_hash"),
            start_ns,
            source: text("source"),
            trial: text("trial"),
            notes: text("notes"),
        });
        Ok(())
    }

    fn topic(&mut self, topic: Topic) -> Result<(), Stop> {
        if let Some((known, _)) = self.topics.get(&topic.id) {
            return if *known == topic {
                Ok(())
            } else {
                Err(Stop::Damage(format!(
                    "channel {} is defined twice",
                    topic.id
                )))
            };
        }
        let target = if topic.message_encoding == "json" {
            Target::Stream(self.stream(&topic)?)
        } else {
            Target::Skipped
        };
        self.topics.insert(topic.id, (topic, target));
        Ok(())
    }

    /// The stream of a topic, a new one unless a topic of this name and these channels is there.
    fn stream(&mut self, topic: &Topic) -> Result<usize, Stop> {
        let parse = |key: &str, error: serde_json::Error| Stop::Content {
            place: format!("topic `{}`", topic.topic),
            reason: format!("its metadata `{key}` is not valid: {error}"),
        };
        let described = topic.metadata.get(CHANNELS);
        let channels: Vec<Channel> = match described {
            Some(text) => serde_json::from_str(text).map_err(|e| parse(CHANNELS, e))?,
            None => Vec::new(),
        };
        let rate_hz = match topic.metadata.get(RATE) {
            Some(text) => serde_json::from_str(text).map_err(|e| parse(RATE, e))?,
            None => None,
        };
        let stream = Stream::new(&topic.topic, rate_hz, channels);
        let same = self
            .growing
            .iter()
            .position(|g| g.stream.name == stream.name);
        match same {
            None => {
                self.growing.push(Growing {
                    stream,
                    described: described.is_some(),
                    log_times: Vec::new(),
                });
                Ok(self.growing.len() - 1)
            }
            Some(i)
                if described.is_none() || self.growing[i].stream.channels == stream.channels =>
            {
                Ok(i)
            }
            Some(_) => Err(Stop::Content {
                place: format!("topic `{}`", topic.topic),
                reason: "it comes twice, with different channels".into(),
            }),
        }
    }

    fn message(&mut self, body: &[u8]) -> Result<(), Stop> {
        let Some((header, text)) = body.split_first_chunk::<MESSAGE_HEADER>() else {
            return Err(Stop::Damage("a message without header".into()));
        };
        let id = u16::from_le_bytes([header[0], header[1]]);
        let [.., a, b, c, d, e, f, g, h, _, _, _, _, _, _, _, _] = *header;
        let log_time = u64::from_le_bytes([a, b, c, d, e, f, g, h]);
        let index = match self.topics.get(&id) {
            Some((_, Target::Stream(index))) => *index,
            Some((_, Target::Skipped)) => return Ok(()),
            None => return Err(Stop::Damage(format!("a message of unknown channel {id}"))),
        };
        let growing = &mut self.growing[index];
        let refuse = |reason: String| Stop::Content {
            place: format!("topic `{}` at {log_time} ns", growing.stream.name),
            reason,
        };
        let n = row::decode(text, &mut growing.stream.values)
            .map_err(|error| refuse(format!("not a row {{\"values\":[…]}}: {error}")))?;
        if !growing.described {
            growing.described = true;
            growing.stream.channels = unnamed(&growing.stream.name, n);
        }
        let expected = growing.stream.channels.len();
        if n != expected {
            let kept = growing.stream.values.len() - n;
            growing.stream.values.truncate(kept);
            return Err(refuse(format!("{n} values, expected {expected}")));
        }
        growing.log_times.push(log_time);
        Ok(())
    }

    /// The recording, with stamps from its start.
    pub(super) fn finish(
        self,
        path: &Path,
        damage: Option<RecordingError>,
    ) -> Result<Loaded, RecordingError> {
        let first = || {
            self.growing
                .iter()
                .flat_map(|g| &g.log_times)
                .min()
                .copied()
        };
        let start = self.zero_ns.or_else(first).unwrap_or(0);
        let zero = if self.zero_ns.is_some() || start > YEAR_NS {
            start
        } else {
            0
        };
        let meta = self.meta.clone().unwrap_or(Meta {
            start_ns: zero,
            ..Meta::default()
        });
        let mut streams = Vec::with_capacity(self.growing.len());
        for mut growing in self.growing {
            let stamps = growing
                .log_times
                .iter()
                .map(|t| i64::try_from(i128::from(*t) - i128::from(zero)).ok());
            growing.stream.stamps_ns =
                stamps
                    .collect::<Option<_>>()
                    .ok_or_else(|| RecordingError::Content {
                        path: path.to_owned(),
                        place: format!("topic `{}`", growing.stream.name),
                        reason: format!("a stamp is more than 292 years from {zero} ns"),
                    })?;
            streams.push(growing.stream);
        }
        let skipped = self.topics.into_values();
        Ok(Loaded {
            trials: vec![Recording { meta, streams }],
            skipped: skipped
                .filter(|(_, target)| matches!(target, Target::Skipped))
                .map(|(topic, _)| format!("{} ({})", topic.topic, topic.message_encoding))
                .collect(),
            damage,
        })
    }
}

/// Channels of a topic that does not name them.
fn unnamed(topic: &str, n: usize) -> Vec<Channel> {
    let channel = |i| Channel {
        name: format!("{topic}[{i}]"),
        kind: Kind::Sensor,
        unit: String::new(),
        noise_sigma: None,
    };
    (0..n).map(channel).collect()
}
