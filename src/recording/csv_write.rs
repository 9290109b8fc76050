//! A recording as one table: `time` in s, then a column a channel; an empty cell is no sample.

use std::collections::BTreeSet;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;

use super::csv_read::{NO_VALUE, TIME};
use super::merge::by_time;
use super::{Recording, RecordingError, side};
use crate::run_dir::write_atomic_with;

/// Write table and side file.
pub(super) fn write(
    path: &Path,
    recording: &Recording,
    packed: bool,
) -> Result<(), RecordingError> {
    check(recording).map_err(|reason| RecordingError::Write {
        path: path.to_owned(),
        reason,
    })?;
    side::write(path, recording)?;
    write_atomic_with(path, |file| {
        let file = BufWriter::new(file);
        if packed {
            let mut packer = GzEncoder::new(file, Compression::fast());
            fill(&mut packer, recording)?;
            packer.finish()?.flush()
        } else {
            let mut file = file;
            fill(&mut file, recording)?;
            file.flush()
        }
    })
    .map_err(|error| RecordingError::write(path, &error))
}

/// Every column has a name of its own.
fn check(recording: &Recording) -> Result<(), String> {
    let mut names = BTreeSet::from([TIME]);
    for stream in &recording.streams {
        if stream.channels.is_empty() {
            return Err(format!("stream `{}` has no channels", stream.name));
        }
        for channel in &stream.channels {
            // readers of tables take blanks around a name for layout
            if channel.name.trim() != channel.name || channel.name.is_empty() {
                return Err(format!(
                    "channel `{}` has a name that a table cannot hold",
                    channel.name
                ));
            }
            if !names.insert(&channel.name) {
                return Err(format!("two columns would be called `{}`", channel.name));
            }
        }
    }
    Ok(())
}

fn fill(out: &mut impl Write, recording: &Recording) -> io::Result<()> {
    let mut header = csv::Writer::from_writer(Vec::new());
    let channels = recording.streams.iter().flat_map(|s| &s.channels);
    let names = channels.map(|c| c.name.as_str());
    header.write_record(std::iter::once(TIME).chain(names))?;
    out.write_all(
        &header
            .into_inner()
            .map_err(|e| io::Error::other(e.to_string()))?,
    )?;

    let mut line = Vec::new();
    let mut samples = by_time(&recording.streams).peekable();
    while let Some((first, sample)) = samples.next() {
        let stamp = recording.streams[first].stamps_ns[sample];
        line.clear();
        seconds(stamp, &mut line);
        let mut at = Some((first, sample));
        for (index, stream) in recording.streams.iter().enumerate() {
            match at {
                Some((i, sample)) if i == index => {
                    cells(stream.row(sample), &mut line);
                    // the next stream, if it has a sample at the same time
                    at = samples.next_if(|(i, s)| {
                        *i > index && recording.streams[*i].stamps_ns[*s] == stamp
                    });
                }
                _ => line.extend(std::iter::repeat_n(b',', stream.channels.len())),
            }
        }
        line.push(b'\n');
        out.write_all(&line)?;
    }
    Ok(())
}

/// The numbers of a stream. A row without any still says that there was a sample.
fn cells(row: &[f64], line: &mut Vec<u8>) {
    let mut digits = zmij::Buffer::new();
    let nothing = row.iter().all(|v| v.is_nan());
    for value in row {
        line.push(b',');
        if !value.is_nan() {
            line.extend_from_slice(digits.format(*value).as_bytes());
        } else if nothing {
            line.extend_from_slice(NO_VALUE.as_bytes());
        }
    }
}

/// Nanoseconds as an exact decimal of seconds.
fn seconds(stamp_ns: i64, line: &mut Vec<u8>) {
    let size = stamp_ns.unsigned_abs();
    let sign = if stamp_ns < 0 { "-" } else { "" };
    let text = format!("{sign}{}.{:09}", size / 1_000_000_000, size % 1_000_000_000);
    line.extend_from_slice(text.trim_end_matches('0').trim_end_matches('.').as_bytes());
}
