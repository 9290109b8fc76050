//! Writing and reading a large recording.

use std::path::Path;
use std::time::Instant;

use serde::Serialize;

use super::peak_mb;
use crate::recording::{self, Channel, Kind, Meta, Recording, RecordingError, Stream};
use crate::rng;

/// Size of the recording: a minute of a machine of about the size of the shipped model.
const CHANNELS: usize = 60;
const RATE_HZ: f64 = 2000.0;
const SECONDS: f64 = 60.0;

/// The figures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingFigures {
    /// samples times channels
    pub numbers: usize,
    /// size of the file, MB
    pub file_mb: f64,
    /// seconds to write it
    pub write_s: f64,
    /// seconds to read it, best of three
    pub read_s: f64,
    /// peak resident memory of the process while reading, MB; of the whole run where the system cannot reset it
    pub read_peak_mb: Option<f64>,
}

/// Write a recording of noise with all its digits to `path`, which has to end in `.mcap`, and read it back.
///
/// # Errors
/// The file cannot be written or read.
pub fn measure_recording(path: &Path) -> Result<RecordingFigures, RecordingError> {
    let written = noise();
    let begin = Instant::now();
    recording::write(path, &written)?;
    let write_s = begin.elapsed().as_secs_f64();
    let numbers = written.streams[0].values.len();
    drop(written);
    reset_peak();
    let mut read_s = f64::INFINITY;
    for _ in 0..3 {
        let begin = Instant::now();
        let read = recording::read(path)?;
        read_s = read_s.min(begin.elapsed().as_secs_f64());
        drop(read);
    }
    let bytes = std::fs::metadata(path).map_or(f64::NAN, |m| m.len() as f64);
    Ok(RecordingFigures {
        numbers,
        file_mb: bytes / 1e6,
        write_s,
        read_s,
        read_peak_mb: peak_mb(),
    })
}

/// Noise is what compresses least.
fn noise() -> Recording {
    let channels = (0..CHANNELS).map(|i| Channel {
        name: format!("sensor{i}"),
        kind: Kind::Sensor,
        unit: "rad".into(),
        noise_sigma: None,
    });
    let mut stream = Stream::new("sensors", Some(RATE_HZ), channels.collect());
    let mut normal = rng::stream(0, rng::Purpose::Exploration, 0, 0);
    let mut row = [0.0; CHANNELS];
    for k in 0..(SECONDS * RATE_HZ) as i64 {
        row.fill_with(|| rng::normal(&mut normal));
        stream.push(k * (1e9 / RATE_HZ) as i64, &row);
    }
    Recording {
        meta: Meta::default(),
        streams: vec![stream],
    }
}

/// Start a new peak of resident memory, where the system can.
fn reset_peak() {
    // Linux: 5 sets the peak to what is resident now; elsewhere the figure is the peak of the whole run
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}
