//! Reports: one HTML page that needs no network, the same charts as SVG files, the same tables as text.
//!
//! ```text
//! Report ── Section ── Block = Text | Table | Chart | Figure
//! ```
//!
//! A [`Chart`] is described once and drawn twice: by uPlot (zoom by dragging, values under the pointer, series
//! switched by a click), whose source is part of the page, and by plotters as a static figure. The page forbids
//! itself every request by a content security policy. All text is escaped. What is no set of curves over one abscissa is a
//! [`Figure`], the same drawing in the page and in its file; a [`Rasteriser`] makes PNG of any of them.

mod chart;
mod figure;
mod heat_map;
mod page;
mod panels;
mod png;
mod svg;
mod table;

pub use chart::{Axis, Chart, Line, Series};
pub use figure::{Curve, Drawing, Figure, HeatBlock, HeatMap, Panel, Panels, Stroke};
pub use png::Rasteriser;
pub use table::{Table, number};

use thiserror::Error;

/// Why a report cannot be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReportError {
    /// A series has another length than the abscissa.
    #[error("chart `{chart}`: series `{series}` has {got} values, expected {expected}")]
    Length {
        /// title
        chart: String,
        /// label
        series: String,
        /// points of the abscissa
        expected: usize,
        /// values of the series
        got: usize,
    },
    /// A row of a table has another number of cells than the table has columns.
    #[error("table `{table}`: row {row} has {got} cells, expected {expected}")]
    Row {
        /// caption
        table: String,
        /// from 0
        row: usize,
        /// columns
        expected: usize,
        /// cells
        got: usize,
    },
    /// No font is installed.
    #[error(
        "no font is installed, so that pictures would be without words (Debian: fonts-dejavu-core)"
    )]
    NoFont,
    /// The figure could not be drawn.
    #[error("chart `{chart}`: {reason}")]
    Draw {
        /// title
        chart: String,
        /// what the drawing library says
        reason: String,
    },
}

/// A part of a section.
#[derive(Debug, Clone, PartialEq)]
pub enum Block {
    /// a paragraph
    Text(String),
    /// numbers
    Table(Table),
    /// curves over one abscissa, which can be zoomed
    Chart(Chart),
    /// any other drawing
    Figure(Figure),
}

/// A headed part of a report.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Section {
    /// heading
    pub heading: String,
    /// from top to bottom
    pub blocks: Vec<Block>,
}

/// A page.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Report {
    /// heading of the page
    pub title: String,
    /// from top to bottom
    pub sections: Vec<Section>,
}

impl Section {
    /// An empty section.
    pub fn new(heading: &str) -> Self {
        Self {
            heading: heading.to_owned(),
            blocks: Vec::new(),
        }
    }

    /// Add a paragraph.
    #[must_use]
    pub fn text(mut self, text: &str) -> Self {
        self.blocks.push(Block::Text(text.to_owned()));
        self
    }

    /// Add a table.
    #[must_use]
    pub fn table(mut self, table: Table) -> Self {
        self.blocks.push(Block::Table(table));
        self
    }

    /// Add a chart.
    #[must_use]
    pub fn chart(mut self, chart: Chart) -> Self {
        self.blocks.push(Block::Chart(chart));
        self
    }

    /// Add a figure.
    #[must_use]
    pub fn figure(mut self, figure: Figure) -> Self {
        self.blocks.push(Block::Figure(figure));
        self
    }
}

impl Figure {
    /// The drawing as an SVG document.
    ///
    /// # Errors
    /// It has a wrong number of values, or cannot be drawn.
    pub fn svg(&self) -> Result<String, ReportError> {
        match &self.drawing {
            Drawing::Panels(panels) => panels::draw(&self.title, panels),
            Drawing::HeatMap(map) => heat_map::draw(&self.title, map),
        }
    }
}

impl Report {
    /// An empty report.
    pub fn new(title: &str) -> Self {
        Self {
            title: title.to_owned(),
            sections: Vec::new(),
        }
    }

    /// All tables, in order.
    pub fn tables(&self) -> impl Iterator<Item = &Table> {
        self.blocks().filter_map(|block| match block {
            Block::Table(table) => Some(table),
            _ => None,
        })
    }

    /// All charts, in order.
    pub fn charts(&self) -> impl Iterator<Item = &Chart> {
        self.blocks().filter_map(|block| match block {
            Block::Chart(chart) => Some(chart),
            _ => None,
        })
    }

    fn blocks(&self) -> impl Iterator<Item = &Block> {
        self.sections.iter().flat_map(|section| &section.blocks)
    }

    /// The page.
    ///
    /// # Errors
    /// A series or a row has the wrong length.
    pub fn html(&self) -> Result<String, ReportError> {
        self.check()?;
        page::render(self)
    }

    /// Name and content of a static figure for every chart: `01-title.svg`, …; other figures have their own names.
    ///
    /// # Errors
    /// A series has the wrong length, or the figure cannot be drawn.
    pub fn figures(&self) -> Result<Vec<(String, String)>, ReportError> {
        self.check()?;
        let charts = self.charts().enumerate().map(|(i, chart)| {
            let name = format!("{:02}-{}.svg", i + 1, slug(&chart.title));
            Ok((name, svg::draw(chart)?))
        });
        let others = self.blocks().filter_map(|block| match block {
            Block::Figure(figure) => Some(figure),
            _ => None,
        });
        let others =
            others.map(|figure| Ok((format!("{}.svg", slug(&figure.name)), figure.svg()?)));
        charts.chain(others).collect()
    }

    fn check(&self) -> Result<(), ReportError> {
        self.charts().try_for_each(Chart::check)?;
        self.tables().try_for_each(Table::check)
    }
}

/// A title as part of a file name: letters and digits, anything else a dash.
fn slug(title: &str) -> String {
    let plain = |c: char| {
        if c.is_ascii_alphanumeric() {
            c.to_ascii_lowercase()
        } else {
            '-'
        }
    };
    let dashed: String = title.chars().map(plain).collect();
    let words: Vec<&str> = dashed.split('-').filter(|w| !w.is_empty()).collect();
    words.join("-").chars().take(60).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_names_are_plain() {
        assert_eq!(slug("Force (N), <tip> 0/1"), "force-n-tip-0-1");
        assert_eq!(slug("../.."), "");
    }
}
