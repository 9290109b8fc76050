//! The HTML page.

use maud::{DOCTYPE, Markup, PreEscaped, html};
use serde_json::{Value, json};

use super::chart::{Axis, Chart, Line};
use super::{Block, Report, ReportError, Table};

// npm package uplot 1.6.32, MIT; licence text beside it and in the page
const UPLOT_JS: &str = include_str!("assets/uPlot.iife.min.js");
const UPLOT_CSS: &str = include_str!("assets/uPlot.min.css");
const UPLOT_LICENCE: &str = include_str!("assets/LICENSE.uPlot");
const PAGE_CSS: &str = include_str!("assets/page.css");
const PAGE_JS: &str = include_str!("assets/page.js");

/// Nothing is fetched, from anywhere.
const POLICY: &str =
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:";

/// Colours that people with any colour vision tell apart (Okabe and Ito 2008).
pub(super) const COLOURS: [(u8, u8, u8); 7] = [
    (0, 0, 0),
    (213, 94, 0),
    (0, 114, 178),
    (0, 158, 115),
    (204, 121, 167),
    (230, 159, 0),
    (86, 180, 233),
];

pub(super) fn render(report: &Report) -> Result<String, ReportError> {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta http-equiv="Content-Security-Policy" content=(POLICY);
                meta name="viewport" content="width=device-width";
                title { (report.title) }
                (PreEscaped(format!("<!-- uPlot 1.6.32\n{UPLOT_LICENCE}\n-->")))
                style { (PreEscaped(UPLOT_CSS)) (PreEscaped(PAGE_CSS)) }
                script { (PreEscaped(UPLOT_JS)) }
                script { (PreEscaped(PAGE_JS)) }
            }
            body {
                h1 { (report.title) }
                @for section in &report.sections {
                    section {
                        h2 { (section.heading) }
                        @for block in &section.blocks { (render_block(block)?) }
                    }
                }
            }
        }
    };
    Ok(page.into_string())
}

fn render_block(block: &Block) -> Result<Markup, ReportError> {
    Ok(match block {
        Block::Text(text) => html! { p { (text) } },
        Block::Table(table) => render_table(table),
        Block::Chart(chart) => html! {
            figure {
                figcaption { (chart.title) }
                div.chart {}
                script { (PreEscaped(format!("phantomChart({})", script_json(&description(chart))))) }
            }
        },
        Block::Figure(figure) => html! {
            figure {
                figcaption { (figure.title) }
                div.drawing { (PreEscaped(figure.svg()?)) }
                p { (figure.caption) }
            }
        },
    })
}

fn render_table(table: &Table) -> Markup {
    html! {
        table {
            caption { (table.caption) }
            thead { tr { @for column in &table.columns { th { (column) } } } }
            tbody {
                @for row in &table.rows { tr { @for cell in row { td { (cell) } } } }
            }
        }
    }
}

/// What `page.js` hands to uPlot.
fn description(chart: &Chart) -> Value {
    let drawn = chart.drawn();
    let x: Vec<f64> = drawn.iter().map(|i| rounded(chart.x[*i])).collect();
    let series: Vec<Value> = chart
        .series
        .iter()
        .enumerate()
        .map(|(i, series)| {
            let (r, g, b) = COLOURS[i % COLOURS.len()];
            let value = |i: &usize| chart.shown(series.values[*i]).map(rounded);
            json!({
                "label": series.label,
                "stroke": format!("rgb({r},{g},{b})"),
                "dashed": series.line == Line::Dashed,
                "points": series.line == Line::Points,
                "values": drawn.iter().map(value).collect::<Vec<_>>(),
            })
        })
        .collect();
    json!({
        "x": x,
        "xLabel": chart.x_label,
        "yLabel": chart.y_label,
        "log": chart.y_axis == Axis::Log,
        "series": series,
    })
}

/// To seven digits: what a pointer can read off, at half the size of the page.
fn rounded(value: f64) -> f64 {
    format!("{value:.6e}").parse().unwrap_or(value)
}

/// `<` must not end the script element early.
fn script_json(value: &Value) -> String {
    value.to_string().replace('<', "\\u003c")
}
