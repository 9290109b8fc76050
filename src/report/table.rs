//! Tables.

use super::ReportError;

/// Rows of text under headings; cells that are numbers should be formatted by the caller.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Table {
    /// above the table
    pub caption: String,
    /// headings
    pub columns: Vec<String>,
    /// one cell a column
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// A table without rows.
    pub fn new(caption: &str, columns: &[&str]) -> Self {
        Self {
            caption: caption.to_owned(),
            columns: columns.iter().map(|c| (*c).to_owned()).collect(),
            rows: Vec::new(),
        }
    }

    /// Add a row.
    pub fn push(&mut self, row: Vec<String>) {
        self.rows.push(row);
    }

    /// The table for a terminal: first column to the left, the others to the right.
    pub fn text(&self) -> String {
        let lines = || std::iter::once(&self.columns).chain(&self.rows);
        let width = |i: usize| {
            let cells = lines().filter_map(|line| line.get(i));
            cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..self.columns.len()).map(width).collect();
        let mut text = format!("{}\n", self.caption);
        for line in lines() {
            for (i, (cell, width)) in line.iter().zip(&widths).enumerate() {
                let padded = if i == 0 {
                    format!("  {cell:<width$}")
                } else {
                    format!("  {cell:>width$}")
                };
                text.push_str(&padded);
            }
            text.truncate(text.trim_end().len());
            text.push('\n');
        }
        text
    }

    pub(super) fn check(&self) -> Result<(), ReportError> {
        let expected = self.columns.len();
        match self.rows.iter().position(|row| row.len() != expected) {
            None => Ok(()),
            Some(row) => Err(ReportError::Row {
                table: self.caption.clone(),
                row,
                expected,
                got: self.rows[row].len(),
            }),
        }
    }
}

/// A number for a cell: four significant digits.
pub fn number(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 {
        "0".to_owned()
    } else if (1e-3..1e5).contains(&size) {
        let digits = (3.0 - size.log10().floor()).max(0.0) as usize;
        format!("{value:.digits$}")
    } else {
        format!("{value:.3e}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_line_up() {
        let mut table = Table::new("errors", &["joint", "rms"]);
        table.push(vec!["elbow".into(), "0.5".into()]);
        table.push(vec!["q".into(), "12.25".into()]);
        assert_eq!(
            table.text(),
            "errors\n  joint    rms\n  elbow    0.5\n  q      12.25\n"
        );
    }
}
