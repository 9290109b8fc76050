//! Figures that are more than curves over one abscissa: panels side by side, and maps of numbers as colours.
//!
//! They are described here and drawn by `panels` and `heat_map`, as SVG that goes into the page as it is.

/// How a curve is drawn.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Stroke {
    /// one pixel
    #[default]
    Thin,
    /// two pixels
    Thick,
    /// one pixel, pale: one of many
    Faint,
    /// dashes
    Dashed,
}

/// Points that are joined; a point that is not a number is a gap.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Curve {
    /// in the legend; empty: not there
    pub label: String,
    /// (n) x, y
    pub points: Vec<[f64; 2]>,
    /// of the page's colours
    pub colour: usize,
    /// drawing
    pub stroke: Stroke,
}

/// One pair of axes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Panel {
    /// above
    pub title: String,
    /// quantity and unit of the abscissa
    pub x_label: String,
    /// quantity and unit of the ordinate
    pub y_label: String,
    /// the same length means the same in both directions
    pub equal: bool,
    /// ends of the ordinate; none: as the points need
    pub y_range: Option<[f64; 2]>,
    /// later ones over earlier ones
    pub curves: Vec<Curve>,
}

/// Panels, row by row.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Panels {
    /// panels in a row
    pub columns: usize,
    /// width and height of a panel, pixels
    pub panel_size: (u32, u32),
    /// from left to right, then down
    pub panels: Vec<Panel>,
}

/// Neighbouring columns of a [`HeatMap`] with one scale of colours.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct HeatBlock {
    /// below the columns
    pub name: String,
    /// of the numbers
    pub unit: String,
    /// number of columns
    pub columns: usize,
}

/// Numbers as colours: blue below 0, red above, white 0.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct HeatMap {
    /// beside the rows
    pub rows: Vec<String>,
    /// from left to right
    pub blocks: Vec<HeatBlock>,
    /// (rows × columns of all blocks)
    pub values: Vec<f64>,
}

/// What a figure shows.
#[derive(Debug, Clone, PartialEq)]
pub enum Drawing {
    /// curves
    Panels(Panels),
    /// colours
    HeatMap(HeatMap),
}

/// A drawing with its words.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    /// name of the files
    pub name: String,
    /// above the drawing
    pub title: String,
    /// below it
    pub caption: String,
    /// what is shown
    pub drawing: Drawing,
}

impl Curve {
    /// A curve through `points` in the page's colour number `colour`.
    pub fn new(label: &str, colour: usize, stroke: Stroke, points: Vec<[f64; 2]>) -> Self {
        Self {
            label: label.to_owned(),
            points,
            colour,
            stroke,
        }
    }
}

impl Panel {
    /// Axes without curves.
    pub fn new(title: &str, x_label: &str, y_label: &str) -> Self {
        Self {
            title: title.to_owned(),
            x_label: x_label.to_owned(),
            y_label: y_label.to_owned(),
            ..Self::default()
        }
    }
}
