use std::{
    fs::{self, File, OpenOptions},
    path::{Path, PathBuf},
};

use super::{METRICS_FILE, RunDirError, tensorboard::EventWriter, write_atomic};

/// Name of the first column.
const ITERATION: &str = "iteration";

/// The numbers of a run, one row an iteration: `metrics.csv`, and the same for `TensorBoard`.
///
/// The first column is `iteration`, the others are the given ones in the given order. Numbers have the
/// fewest digits that read back to the same bits; a cell without value, or with NaN, is empty. Every row is
/// handed to the system before [`Metrics::row`] returns, so a killed process loses none.
#[derive(Debug)]
pub struct Metrics {
    path: PathBuf,
    columns: Vec<String>,
    last: Option<u64>,
    csv: csv::Writer<File>,
    events: EventWriter,
}

impl Metrics {
    /// Begins the metrics of a new run in the folder `dir`; an older `metrics.csv` is replaced.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn create(dir: &Path, columns: &[&str]) -> Result<Self, RunDirError> {
        let path = dir.join(METRICS_FILE);
        write_rows(&path, &header(columns), &[])?;
        Self::append(dir, path, columns, None, None)
    }

    /// Goes on with the metrics of a run whose last saved state is that after `keep_until_iteration`.
    ///
    /// Rows of later iterations are dropped, since these iterations run again; so is a row that a crash cut
    /// short. `TensorBoard` gets a new event file that tells viewers the same.
    ///
    /// # Errors
    /// The file is missing, has other columns, has a row that is no row, or cannot be written.
    pub fn resume(
        dir: &Path,
        columns: &[&str],
        keep_until_iteration: u64,
    ) -> Result<Self, RunDirError> {
        let path = dir.join(METRICS_FILE);
        let bytes = fs::read(&path).map_err(|reason| RunDirError::Read {
            path: path.clone(),
            reason,
        })?;
        let kept = kept_rows(&path, &bytes, &header(columns), keep_until_iteration)?;
        let rows: Vec<csv::StringRecord> = kept.iter().map(|(_, row)| row.clone()).collect();
        write_rows(&path, &header(columns), &rows)?;
        let last = kept.last().map(|(iteration, _)| *iteration);
        Self::append(dir, path, columns, last, Some(keep_until_iteration + 1))
    }

    fn append(
        dir: &Path,
        path: PathBuf,
        columns: &[&str],
        last: Option<u64>,
        restart_at: Option<u64>,
    ) -> Result<Self, RunDirError> {
        let file = OpenOptions::new()
            .append(true)
            .open(&path)
            .map_err(|reason| RunDirError::Write {
                path: path.clone(),
                reason,
            })?;
        Ok(Self {
            path,
            columns: columns.iter().map(ToString::to_string).collect(),
            last,
            csv: csv::Writer::from_writer(file),
            events: EventWriter::create(dir, restart_at)?,
        })
    }

    /// Appends the row of one iteration; columns that are not mentioned stay empty.
    ///
    /// # Errors
    /// An unknown column, an iteration that is not later than the last, or a file that cannot be written.
    pub fn row(&mut self, iteration: u64, values: &[(&str, f64)]) -> Result<(), RunDirError> {
        if let Some(last) = self.last.filter(|&last| iteration <= last) {
            return Err(RunDirError::OutOfOrder {
                path: self.path.clone(),
                iteration,
                last,
            });
        }
        let mut cells = vec![String::new(); self.columns.len() + 1];
        cells[0] = iteration.to_string();
        for (name, value) in values {
            let Some(column) = self.columns.iter().position(|column| column == name) else {
                return Err(RunDirError::UnknownColumn {
                    path: self.path.clone(),
                    name: (*name).to_owned(),
                });
            };
            cells[column + 1] = cell(*value);
        }
        self.csv
            .write_record(&cells)
            .map_err(|error| write_error(&self.path, error))?;
        self.csv.flush().map_err(|reason| RunDirError::Write {
            path: self.path.clone(),
            reason,
        })?;
        self.last = Some(iteration);
        self.events.scalars(iteration, values)
    }
}

fn header(columns: &[&str]) -> Vec<String> {
    [ITERATION]
        .iter()
        .chain(columns)
        .map(ToString::to_string)
        .collect()
}

/// Shortest digits that read back exactly; counts without the `.0`.
fn cell(value: f64) -> String {
    if value.is_nan() {
        String::new()
    } else if value == value.trunc() && value.abs() < 2f64.powi(53) {
        format!("{value}")
    } else {
        format!("{value:?}")
    }
}

/// The leading rows up to the given iteration, with their iterations.
fn kept_rows(
    path: &Path,
    bytes: &[u8],
    header: &[String],
    keep_until: u64,
) -> Result<Vec<(u64, csv::StringRecord)>, RunDirError> {
    // only a line with its end is known to be whole
    let whole = bytes
        .iter()
        .rposition(|&byte| byte == b'\n')
        .map_or(0, |end| end + 1);
    let mut reader = csv::ReaderBuilder::new()
        .flexible(true)
        .from_reader(&bytes[..whole]);
    let malformed = |line, reason: String| RunDirError::Row {
        path: path.to_owned(),
        line,
        reason,
    };
    let found = reader
        .headers()
        .map_err(|error| malformed(1, error.to_string()))?;
    if found != header {
        return Err(RunDirError::Columns {
            path: path.to_owned(),
            expected: header.join(","),
            found: found.iter().collect::<Vec<_>>().join(","),
        });
    }
    let mut kept: Vec<(u64, csv::StringRecord)> = vec![];
    for record in reader.records() {
        let line_before = kept.len() as u64 + 2;
        let record = record.map_err(|error| malformed(line_before, error.to_string()))?;
        let line = record.position().map_or(line_before, csv::Position::line);
        if record.len() != header.len() {
            return Err(malformed(
                line,
                format!("{} cells, expected {}", record.len(), header.len()),
            ));
        }
        let iteration: u64 = record[0]
            .parse()
            .map_err(|_| malformed(line, format!("`{}` is no iteration number", &record[0])))?;
        if iteration > keep_until {
            break;
        }
        if let Some((last, _)) = kept.last().filter(|(last, _)| iteration <= *last) {
            return Err(malformed(
                line,
                format!("iteration {iteration} comes after iteration {last}"),
            ));
        }
        kept.push((iteration, record));
    }
    Ok(kept)
}

fn write_rows(
    path: &Path,
    header: &[String],
    rows: &[csv::StringRecord],
) -> Result<(), RunDirError> {
    let mut writer = csv::Writer::from_writer(vec![]);
    let write = |writer: &mut csv::Writer<Vec<u8>>| {
        writer.write_record(header)?;
        rows.iter().try_for_each(|row| writer.write_record(row))
    };
    write(&mut writer).map_err(|error| write_error(path, error))?;
    let bytes = writer.into_inner().map_err(|error| RunDirError::Write {
        path: path.to_owned(),
        reason: error.into_error(),
    })?;
    write_atomic(path, &bytes)
}

fn write_error(path: &Path, error: csv::Error) -> RunDirError {
    RunDirError::Write {
        path: path.to_owned(),
        reason: error.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_read_back_exactly() {
        for value in [
            0.1,
            -0.0,
            1e-300,
            123_456_789.125,
            2e7,
            1e300,
            f64::MIN_POSITIVE,
            1.0 / 3.0,
        ] {
            let text = cell(value);
            let back: f64 = text.parse().expect("a number");
            assert_eq!(back.to_bits(), value.to_bits(), "{text}");
        }
        assert_eq!(cell(20_000_000.0), "20000000");
        assert_eq!(cell(0.1), "0.1");
        assert_eq!(cell(f64::NAN), "");
    }
}
