//! Reading a table: a column of times, then a column a channel.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use csv::ByteRecord;
use flate2::read::MultiGzDecoder;

use super::load::{Format, Loaded, format};
use super::side::{self, Side};
use super::{Channel, Kind, Meta, Recording, RecordingError, Stream};

/// Name of the first column.
pub(super) const TIME: &str = "time";
/// A cell that stands for a sample without number.
pub(super) const NO_VALUE: &str = "nan";
/// Name of the stream of a table without side file.
const STREAM: &str = "table";

/// Which columns are not channels.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout<'a> {
    /// column of times
    pub(super) time: &'a str,
    /// seconds a unit of it
    pub(super) time_scale: f64,
    /// column that names the trial of a row
    pub(super) trial: Option<&'a str>,
    /// columns left out
    pub(super) ignore: &'a [String],
}

/// Read all rows before the first that is not valid.
pub(super) fn load(path: &Path, layout: Layout<'_>) -> Result<Loaded, RecordingError> {
    let file = File::open(path).map_err(|error| RecordingError::read(path, &error))?;
    let file = BufReader::with_capacity(1 << 18, file);
    if format(path)? == Format::CsvGz {
        Ok(Reader::new(path, MultiGzDecoder::new(file), layout)?.run())
    } else {
        Ok(Reader::new(path, file, layout)?.run())
    }
}

struct Reader<'a, R: Read> {
    path: &'a Path,
    rows: csv::Reader<R>,
    names: Vec<String>,
    time: usize,
    time_scale: f64,
    trial: Option<usize>,
    /// columns of each stream
    columns: Vec<Vec<usize>>,
    /// an empty recording
    blank: Recording,
    /// trials by name
    found: BTreeMap<Vec<u8>, usize>,
    trials: Vec<Recording>,
}

impl<'a, R: Read> Reader<'a, R> {
    fn new(path: &'a Path, input: R, layout: Layout<'_>) -> Result<Self, RecordingError> {
        let refuse = |reason: String| RecordingError::Content {
            path: path.to_owned(),
            place: "line 1".into(),
            reason,
        };
        let mut rows = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .from_reader(input);
        let header = rows.headers().map_err(|e| refuse(reason(&e)))?;
        let names: Vec<String> = header.iter().map(str::to_owned).collect();
        let position = |name: &str| names.iter().position(|n| n == name);
        let find = |name: &str| {
            position(name).ok_or_else(|| {
                refuse(format!(
                    "there is no column `{name}`; found {}",
                    names.join(", ")
                ))
            })
        };
        let mut seen = BTreeSet::new();
        if let Some(twice) = names.iter().find(|name| !seen.insert(*name)) {
            return Err(refuse(format!("two columns are called `{twice}`")));
        }
        let time = find(layout.time)?;
        let trial = layout.trial.map(find).transpose()?;
        let mut others: Vec<usize> = (0..names.len())
            .filter(|i| *i != time && Some(*i) != trial)
            .collect();
        for name in layout.ignore {
            let column = find(name)?;
            others.retain(|i| *i != column);
        }
        if let Some(i) = others.iter().find(|i| names[**i].is_empty()) {
            return Err(refuse(format!("column {} has no name", i + 1)));
        }
        if others.is_empty() {
            return Err(refuse("there is no column of numbers".into()));
        }
        let (blank, columns) = match side::read(path)? {
            Some(side) => split(&side, &names, &others).map_err(refuse)?,
            None => (single(&names, &others), vec![others]),
        };
        Ok(Self {
            path,
            rows,
            time,
            time_scale: layout.time_scale,
            trial,
            columns,
            blank,
            found: BTreeMap::new(),
            trials: Vec::new(),
            names,
        })
    }

    fn run(mut self) -> Loaded {
        if self.trial.is_none() {
            self.trials.push(self.blank.clone());
        }
        let mut record = ByteRecord::new();
        let mut cells = Vec::new();
        let damage = loop {
            match self.rows.read_byte_record(&mut record) {
                Ok(true) => {
                    if let Err(reason) = self.row(&record, &mut cells) {
                        break Some((record.position().cloned(), reason));
                    }
                }
                Ok(false) => break None,
                Err(error) => break Some((error.position().cloned(), reason(&error))),
            }
        };
        Loaded {
            damage: damage.map(|(place, reason)| RecordingError::Content {
                path: self.path.to_owned(),
                place: format!(
                    "line {}",
                    place.unwrap_or(self.rows.position().clone()).line()
                ),
                reason,
            }),
            trials: self.trials,
            skipped: Vec::new(),
        }
    }

    /// One line; on an error nothing of it is taken.
    fn row(&mut self, record: &ByteRecord, cells: &mut Vec<f64>) -> Result<(), String> {
        let stamp = parse_stamp(&record[self.time], self.time_scale).ok_or_else(|| {
            let text = String::from_utf8_lossy(&record[self.time]);
            format!(
                "column `{}` is `{text}`, expected a time",
                self.names[self.time]
            )
        })?;
        cells.clear();
        for column in self.columns.iter().flatten() {
            let text = &record[*column];
            cells.push(if text.is_empty() {
                f64::NAN
            } else {
                fast_float2::parse(text).map_err(|_| {
                    let text = String::from_utf8_lossy(text);
                    format!(
                        "column `{}` is `{text}`, expected a number",
                        self.names[*column]
                    )
                })?
            });
        }
        let trial = match self.trial {
            Some(column) => self.trial_of(&record[column]),
            None => 0,
        };
        let streams = &mut self.trials[trial].streams;
        let alone = streams.len() == 1;
        let mut rest = cells.as_slice();
        for (stream, columns) in streams.iter_mut().zip(&self.columns) {
            let row;
            (row, rest) = rest.split_at(columns.len());
            if alone || columns.iter().any(|c| !record[*c].is_empty()) {
                stream.push(stamp, row);
            }
        }
        Ok(())
    }

    fn trial_of(&mut self, name: &[u8]) -> usize {
        if let Some(index) = self.found.get(name) {
            return *index;
        }
        let mut recording = self.blank.clone();
        recording.meta.trial = String::from_utf8_lossy(name).into_owned();
        self.trials.push(recording);
        self.found.insert(name.to_owned(), self.trials.len() - 1);
        self.trials.len() - 1
    }
}

/// The reason without the place, which the caller knows.
fn reason(error: &csv::Error) -> String {
    match error.kind() {
        csv::ErrorKind::UnequalLengths {
            expected_len, len, ..
        } => format!("{len} columns, expected {expected_len}"),
        csv::ErrorKind::Utf8 { .. } => "not UTF-8".into(),
        csv::ErrorKind::Io(error) => error.to_string(),
        _ => error.to_string(),
    }
}

/// All channels in one stream.
fn single(names: &[String], columns: &[usize]) -> Recording {
    let channel = |i: &usize| Channel {
        name: names[*i].clone(),
        kind: Kind::Sensor,
        unit: String::new(),
        noise_sigma: None,
    };
    Recording {
        meta: Meta::default(),
        streams: vec![Stream::new(
            STREAM,
            None,
            columns.iter().map(channel).collect(),
        )],
    }
}

/// The streams of a side file and their columns.
fn split(
    side: &Side,
    names: &[String],
    columns: &[usize],
) -> Result<(Recording, Vec<Vec<usize>>), String> {
    let mut left: BTreeMap<&str, usize> =
        columns.iter().map(|i| (names[*i].as_str(), *i)).collect();
    let mut split = Vec::new();
    for stream in &side.streams {
        let mut own = Vec::new();
        for channel in &stream.channels {
            let column = left.remove(channel.name.as_str());
            own.push(column.ok_or_else(|| {
                format!(
                    "the side file has a channel `{}`, the table has no such column",
                    channel.name
                )
            })?);
        }
        split.push(own);
    }
    if let Some(name) = left.keys().next() {
        return Err(format!("column `{name}` is not in the side file"));
    }
    let recording = Recording {
        meta: side.meta.clone(),
        streams: side.streams.iter().map(side::SideStream::stream).collect(),
    };
    Ok((recording, split))
}

/// Nanoseconds of a cell: exact for decimals of seconds, rounded for other spellings and scales.
fn parse_stamp(text: &[u8], scale: f64) -> Option<i64> {
    if scale == 1.0
        && let Some(stamp) = exact_decimal(text)
    {
        return Some(stamp);
    }
    let ns = (fast_float2::parse::<f64, _>(text).ok()? * scale * 1e9).round();
    // 2^63 is the first that does not fit
    (ns.abs() < 9_223_372_036_854_775_808.0).then_some(ns as i64)
}

/// `[-]digits[.digits]` with at most nine decimals that are not 0.
fn exact_decimal(text: &[u8]) -> Option<i64> {
    let text = std::str::from_utf8(text).ok()?;
    let (negative, size) = match text.strip_prefix('-') {
        Some(size) => (true, size),
        None => (false, text),
    };
    let (whole, decimals) = size.split_once('.').unwrap_or((size, ""));
    let decimals = decimals.trim_end_matches('0');
    let digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    if whole.is_empty() || decimals.len() > 9 || !digits(whole) || !digits(decimals) {
        return None;
    }
    let ns = format!("{whole}{decimals:0<9}").parse::<i128>().ok()?;
    i64::try_from(if negative { -ns } else { ns }).ok()
}
