//! What a chart shows, and how many of its points are drawn.

use super::ReportError;

/// More points than this are thinned; a screen has fewer columns.
const MAX_POINTS: usize = 6000;

/// Scale of an axis.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Axis {
    /// equal steps
    #[default]
    Linear,
    /// equal factors; numbers that are not positive are left out
    Log,
}

/// How the points of a series are drawn.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Line {
    /// joined
    #[default]
    Solid,
    /// joined by dashes
    Dashed,
    /// each on its own
    Points,
}

/// Values over the abscissa of a chart.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// in the legend
    pub label: String,
    /// (n); not a number: a gap
    pub values: Vec<f64>,
    /// drawing
    pub line: Line,
}

/// Series over a common abscissa.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Chart {
    /// above the chart
    pub title: String,
    /// quantity and unit of the abscissa
    pub x_label: String,
    /// quantity and unit of the ordinate
    pub y_label: String,
    /// scale of the ordinate
    pub y_axis: Axis,
    /// (n) abscissa, increasing
    pub x: Vec<f64>,
    /// curves
    pub series: Vec<Series>,
}

impl Chart {
    /// A chart without series.
    pub fn new(title: &str, x_label: &str, y_label: &str, x: Vec<f64>) -> Self {
        Self {
            title: title.to_owned(),
            x_label: x_label.to_owned(),
            y_label: y_label.to_owned(),
            y_axis: Axis::Linear,
            x,
            series: Vec::new(),
        }
    }

    /// Add a series.
    #[must_use]
    pub fn series(mut self, label: &str, line: Line, values: Vec<f64>) -> Self {
        self.series.push(Series {
            label: label.to_owned(),
            values,
            line,
        });
        self
    }

    /// Draw the ordinate by factors.
    #[must_use]
    pub fn log(mut self) -> Self {
        self.y_axis = Axis::Log;
        self
    }

    pub(super) fn check(&self) -> Result<(), ReportError> {
        let expected = self.x.len();
        match self.series.iter().find(|s| s.values.len() != expected) {
            None => Ok(()),
            Some(series) => Err(ReportError::Length {
                chart: self.title.clone(),
                series: series.label.clone(),
                expected,
                got: series.values.len(),
            }),
        }
    }

    /// The value as drawn: nothing where there is no number, or none this axis can show.
    pub(super) fn shown(&self, value: f64) -> Option<f64> {
        (value.is_finite() && (self.y_axis == Axis::Linear || value > 0.0)).then_some(value)
    }

    /// Indices of the points that are drawn: all, or of each of equal stretches the ends and the extremes of every
    /// series, so that no peak is lost.
    pub(super) fn drawn(&self) -> Vec<usize> {
        let n = self.x.len();
        if n <= MAX_POINTS {
            return (0..n).collect();
        }
        let kept = 2 + 2 * self.series.len();
        let stretch = n.div_ceil((MAX_POINTS / kept).max(1));
        let mut indices = Vec::new();
        for begin in (0..n).step_by(stretch) {
            let end = (begin + stretch).min(n);
            indices.extend([begin, end - 1]);
            for series in &self.series {
                let finite = || (begin..end).filter(|i| series.values[*i].is_finite());
                let by_value =
                    |a: &usize, b: &usize| series.values[*a].total_cmp(&series.values[*b]);
                indices.extend(finite().min_by(by_value));
                indices.extend(finite().max_by(by_value));
            }
        }
        indices.sort_unstable();
        indices.dedup();
        indices
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_keeps_a_single_peak() {
        let n = 100_000;
        let mut values: Vec<f64> = (0..n).map(|i| f64::from(i).sin()).collect();
        values[54_321] = 9.0;
        values[70_000] = f64::NAN;
        let x = (0..n).map(f64::from).collect();
        let chart = Chart::new("", "", "", x).series("", Line::Solid, values);
        let drawn = chart.drawn();
        assert!(drawn.len() <= MAX_POINTS + 4, "{}", drawn.len());
        assert!(drawn.contains(&54_321));
        assert!(drawn.windows(2).all(|pair| pair[0] < pair[1]));
        assert_eq!((drawn[0], drawn.last()), (0, Some(&(n as usize - 1))));
    }
}
