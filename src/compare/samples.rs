//! Samples of one channel, without gaps.

use crate::recording::Stream;

/// Finite values, and when they were taken.
pub(super) struct Samples {
    pub time_s: Vec<f64>,
    pub values: Vec<f64>,
}

impl Samples {
    /// Of column `column` of `stream`.
    pub(super) fn of(stream: &Stream, column: usize) -> Self {
        let rows = (0..stream.len()).map(|i| (stream.time(i), stream.row(i)[column]));
        let (time_s, values) = rows.filter(|(_, value)| value.is_finite()).unzip();
        Self { time_s, values }
    }

    /// By straight lines; NaN outside.
    pub(super) fn at(&self, time: f64) -> f64 {
        let after = self.time_s.partition_point(|t| *t < time);
        match (after.checked_sub(1), self.time_s.get(after)) {
            (_, Some(t)) if *t == time => self.values[after],
            (Some(before), Some(t)) => {
                let part = (time - self.time_s[before]) / (t - self.time_s[before]);
                self.values[before] + part * (self.values[after] - self.values[before])
            }
            _ => f64::NAN,
        }
    }

    pub(super) fn all_at(&self, times: &[f64]) -> Vec<f64> {
        times.iter().map(|t| self.at(*t)).collect()
    }
}

/// s; 0 of less than two times.
pub(super) fn median_interval(time_s: &[f64]) -> f64 {
    let mut intervals: Vec<f64> = time_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    intervals.sort_by(f64::total_cmp);
    intervals.get(intervals.len() / 2).copied().unwrap_or(0.0)
}
