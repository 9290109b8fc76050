//! Panels side by side, as SVG.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::ReportError;
use super::figure::{Curve, Panel, Panels, Stroke};
use super::page::COLOURS;
use super::svg::{failed, tick};

/// Height of the title of the whole figure, pixels.
const TITLE: u32 = 30;
/// What surrounds the axes of a panel, pixels.
const MARGIN: u32 = 8;
const LABEL_X: u32 = 36;
const LABEL_Y: u32 = 54;
const CAPTION: u32 = 24;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// The panels as an SVG document.
pub(super) fn draw(title: &str, panels: &Panels) -> Result<String, ReportError> {
    let columns = panels.columns.clamp(1, panels.panels.len().max(1));
    let rows = panels.panels.len().div_ceil(columns).max(1);
    let (width, height) = panels.panel_size;
    let size = (width * columns as u32, height * rows as u32 + TITLE);
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
        root.fill(&WHITE).map_err(|e| failed(title, &e))?;
        let root = root
            .titled(title, ("sans-serif", 17))
            .map_err(|e| failed(title, &e))?;
        for (panel, area) in panels.panels.iter().zip(root.split_evenly((rows, columns))) {
            draw_panel(title, panel, &area)?;
        }
        root.present().map_err(|e| failed(title, &e))?;
    }
    Ok(text)
}

fn draw_panel(title: &str, panel: &Panel, area: &Area<'_>) -> Result<(), ReportError> {
    let (x, y) = ranges(panel, area.dim_in_pixel());
    let mut context = ChartBuilder::on(area)
        .caption(&panel.title, ("sans-serif", 14))
        .margin(MARGIN)
        .x_label_area_size(LABEL_X)
        .y_label_area_size(LABEL_Y)
        .build_cartesian_2d(x[0]..x[1], y[0]..y[1])
        .map_err(|e| failed(title, &e))?;
    context
        .configure_mesh()
        .x_labels(6)
        .y_labels(6)
        .x_desc(&panel.x_label)
        .y_desc(&panel.y_label)
        .x_label_formatter(&|v| tick(snapped(*v, x)))
        .y_label_formatter(&|v| tick(snapped(*v, y)))
        .bold_line_style(BLACK.mix(0.08))
        .light_line_style(TRANSPARENT)
        .draw()
        .map_err(|e| failed(title, &e))?;
    for curve in &panel.curves {
        let style = style(curve);
        for run in runs(curve) {
            let drawn = if curve.stroke == Stroke::Dashed {
                context
                    .draw_series(DashedLineSeries::new(run, 6, 4, style))
                    .map(drop)
            } else {
                context.draw_series(LineSeries::new(run, style)).map(drop)
            };
            drawn.map_err(|e| failed(title, &e))?;
        }
        if !curve.label.is_empty() {
            context
                .draw_series(LineSeries::new(std::iter::empty(), style))
                .map_err(|e| failed(title, &e))?
                .label(&curve.label)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], style));
        }
    }
    if panel.curves.iter().any(|c| !c.label.is_empty()) {
        context
            .configure_series_labels()
            .position(SeriesLabelPosition::UpperLeft)
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()
            .map_err(|e| failed(title, &e))?;
    }
    Ok(())
}

/// A label without the rounding of its sum: 0 is 0.
fn snapped(value: f64, [low, high]: [f64; 2]) -> f64 {
    if value.abs() < 1e-9 * (high - low) {
        0.0
    } else {
        value
    }
}

fn style(curve: &Curve) -> ShapeStyle {
    let (r, g, b) = COLOURS[curve.colour % COLOURS.len()];
    let (width, opacity) = match curve.stroke {
        Stroke::Thin | Stroke::Dashed => (1, 1.0),
        Stroke::Thick => (2, 1.0),
        Stroke::Faint => (1, 0.4),
    };
    RGBColor(r, g, b).mix(opacity).stroke_width(width)
}

/// Stretches of points without a gap.
fn runs(curve: &Curve) -> Vec<Vec<(f64, f64)>> {
    let split = curve
        .points
        .split(|[x, y]| !(x.is_finite() && y.is_finite()));
    split
        .filter(|run| !run.is_empty())
        .map(|run| run.iter().map(|[x, y]| (*x, *y)).collect())
        .collect()
}

/// Ends of both axes: all points, with a margin.
fn ranges(panel: &Panel, pixels: (u32, u32)) -> ([f64; 2], [f64; 2]) {
    let points = || panel.curves.iter().flat_map(|c| &c.points);
    let ends = |i: usize, margin: f64| {
        let finite = points().map(|p| p[i]).filter(|v| v.is_finite());
        let (low, high) = finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
            (low.min(v), high.max(v))
        });
        if low > high {
            return [0.0, 1.0];
        }
        // a constant gets room too
        let room = (margin * (high - low)).max(1e-6 * high.abs().max(1e-6));
        [low - room, high + room]
    };
    let (mut x, mut y) = (ends(0, 0.0), panel.y_range.unwrap_or(ends(1, 0.06)));
    if panel.equal {
        x = ends(0, 0.06);
        let width = f64::from(pixels.0.saturating_sub(2 * MARGIN + LABEL_Y).max(1));
        let height = f64::from(
            pixels
                .1
                .saturating_sub(2 * MARGIN + LABEL_X + CAPTION)
                .max(1),
        );
        let scale = ((x[1] - x[0]) / width).max((y[1] - y[0]) / height);
        let widen = |[low, high]: [f64; 2], pixels: f64| {
            let (middle, half) = (0.5 * (low + high), 0.5 * scale * pixels);
            [middle - half, middle + half]
        };
        (x, y) = (widen(x, width), widen(y, height));
    }
    (x, y)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_axes_have_one_scale() {
        let mut panel = Panel::new("", "", "");
        panel.equal = true;
        panel.curves = vec![Curve::new(
            "",
            0,
            Stroke::Thin,
            vec![[0.0, 0.0], [4.0, 1.0]],
        )];
        let (x, y) = ranges(&panel, (500, 300));
        let width = f64::from(500 - 2 * MARGIN - LABEL_Y);
        let height = f64::from(300 - 2 * MARGIN - LABEL_X - CAPTION);
        let (a, b) = ((x[1] - x[0]) / width, (y[1] - y[0]) / height);
        assert!((a / b - 1.0).abs() < 1e-12, "{a} {b}");
        assert!(x[0] < 0.0 && x[1] > 4.0 && y[0] < 0.0 && y[1] > 1.0);
    }

    #[test]
    fn gaps_split_a_curve() {
        let points = vec![[0.0, 1.0], [1.0, f64::NAN], [2.0, 1.0], [3.0, 2.0]];
        let split = runs(&Curve::new("", 0, Stroke::Thin, points));
        assert_eq!(split.iter().map(Vec::len).collect::<Vec<_>>(), [1, 2]);
    }
}
