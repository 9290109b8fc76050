//! Charts as static SVG.

use std::fmt::Display;

use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::prelude::*;

use super::ReportError;
use super::chart::{Axis, Chart, Line};
use super::page::COLOURS;

const SIZE: (u32, u32) = (900, 360);

/// The chart as an SVG document.
pub(super) fn draw(chart: &Chart) -> Result<String, ReportError> {
    let (low, high) = range(chart);
    match chart.y_axis {
        Axis::Linear => draw_on(chart, low..high),
        Axis::Log => draw_on(chart, (low..high).log_scale()),
    }
}

fn draw_on<Y>(chart: &Chart, y: Y) -> Result<String, ReportError>
where
    Y: AsRangedCoord<Value = f64>,
    Y::CoordDescType: ValueFormatter<f64>,
{
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        root.fill(&WHITE).map_err(|e| failed(&chart.title, &e))?;
        let (first, last) = ends(&chart.x);
        let mut context = ChartBuilder::on(&root)
            .caption(&chart.title, ("sans-serif", 18))
            .margin(12)
            .x_label_area_size(42)
            .y_label_area_size(78)
            .build_cartesian_2d(first..last, y)
            .map_err(|e| failed(&chart.title, &e))?;
        context
            .configure_mesh()
            .x_desc(&chart.x_label)
            .y_desc(&chart.y_label)
            .y_label_formatter(&|v| tick(*v))
            .light_line_style(TRANSPARENT)
            .draw()
            .map_err(|e| failed(&chart.title, &e))?;
        let drawn = chart.drawn();
        for (i, series) in chart.series.iter().enumerate() {
            let (r, g, b) = COLOURS[i % COLOURS.len()];
            let colour = RGBColor(r, g, b);
            for run in runs(chart, &series.values, &drawn) {
                let result = match series.line {
                    Line::Solid => context.draw_series(LineSeries::new(run, colour)).map(drop),
                    Line::Dashed => context
                        .draw_series(DashedLineSeries::new(run, 6, 4, colour.stroke_width(1)))
                        .map(drop),
                    Line::Points => context
                        .draw_series(run.into_iter().map(|p| Circle::new(p, 2, colour.filled())))
                        .map(drop),
                };
                result.map_err(|e| failed(&chart.title, &e))?;
            }
            // the legend's entry, whether or not there is a point
            context
                .draw_series(LineSeries::new(std::iter::empty(), colour))
                .map_err(|e| failed(&chart.title, &e))?
                .label(&series.label)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour));
        }
        context
            .configure_series_labels()
            .position(SeriesLabelPosition::UpperLeft)
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()
            .map_err(|e| failed(&chart.title, &e))?;
        root.present().map_err(|e| failed(&chart.title, &e))?;
    }
    Ok(text)
}

pub(super) fn failed(chart: &str, error: &impl Display) -> ReportError {
    ReportError::Draw {
        chart: chart.to_owned(),
        reason: error.to_string(),
    }
}

/// Stretches of points without a gap.
fn runs(chart: &Chart, values: &[f64], drawn: &[usize]) -> Vec<Vec<(f64, f64)>> {
    let point = |i: usize| chart.shown(values[i]).map(|y| (chart.x[i], y));
    drawn
        .split(|i| point(*i).is_none())
        .filter(|run| !run.is_empty())
        .map(|run| run.iter().filter_map(|i| point(*i)).collect())
        .collect()
}

/// Ends of the abscissa; one apart where there is nothing between them.
fn ends(x: &[f64]) -> (f64, f64) {
    match (x.first(), x.last()) {
        (Some(a), Some(b)) if a < b => (*a, *b),
        (Some(a), _) => (*a, a + 1.0),
        _ => (0.0, 1.0),
    }
}

/// Ends of the ordinate, with a margin.
fn range(chart: &Chart) -> (f64, f64) {
    let all = chart.series.iter().flat_map(|s| &s.values);
    let shown = all.filter_map(|v| chart.shown(*v));
    let (low, high) = shown.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    });
    if low > high {
        return (0.1, 1.0);
    }
    if chart.y_axis == Axis::Log {
        return (low / 1.3, high * 1.3);
    }
    // a constant gets room too
    let margin = (0.05 * (high - low)).max(1e-6 * high.abs().max(1e-6));
    (low - margin, high + margin)
}

/// A number beside the axis.
pub(super) fn tick(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 {
        "0".to_owned()
    } else if (1e-3..1e5).contains(&size) {
        format!("{value:.4}")
            .trim_end_matches('0')
            .trim_end_matches('.')
            .to_owned()
    } else {
        format!("{value:.1e}")
    }
}
