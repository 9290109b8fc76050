//! Numbers as colours, as SVG.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::ReportError;
use super::figure::HeatMap;
use super::svg::failed;
use super::table::number;

/// Side of a cell and what surrounds the cells, pixels.
const CELL: i32 = 20;
const LEFT: i32 = 70;
const TOP: i32 = 40;
const BOTTOM: i32 = 54;
const BETWEEN: i32 = 8;
/// Ends of the scale: blue, red (Brewer's `RdBu`).
const LOW: (f64, f64, f64) = (33.0, 102.0, 172.0);
const HIGH: (f64, f64, f64) = (178.0, 24.0, 43.0);

/// The map as an SVG document.
pub(super) fn draw(title: &str, map: &HeatMap) -> Result<String, ReportError> {
    let n: usize = map.blocks.iter().map(|b| b.columns).sum();
    let expected = n * map.rows.len();
    if map.values.len() != expected {
        return Err(ReportError::Length {
            chart: title.to_owned(),
            series: "values".to_owned(),
            expected,
            got: map.values.len(),
        });
    }
    let width = LEFT + n as i32 * CELL + map.blocks.len() as i32 * BETWEEN + BETWEEN;
    let height = TOP + map.rows.len() as i32 * CELL + BOTTOM;
    let mut text = String::new();
    {
        let root =
            SVGBackend::with_string(&mut text, (width as u32, height as u32)).into_drawing_area();
        root.fill(&WHITE).map_err(|e| failed(title, &e))?;
        let write = |words: &str, at: (i32, i32), size: i32, h: HPos| {
            let style = ("sans-serif", size)
                .into_font()
                .color(&BLACK)
                .pos(Pos::new(h, VPos::Center));
            root.draw(&Text::new(words.to_owned(), at, style))
                .map_err(|e| failed(title, &e))
        };
        write(title, (width / 2, TOP / 2), 17, HPos::Center)?;
        for (i, name) in map.rows.iter().enumerate() {
            let y = TOP + i as i32 * CELL + CELL / 2;
            write(name, (LEFT - 6, y), 12, HPos::Right)?;
        }
        let (mut first, mut left) = (0, LEFT);
        for block in &map.blocks {
            let columns = first..first + block.columns;
            let values = |row: usize| &map.values[row * n..][columns.clone()];
            let all = (0..map.rows.len()).flat_map(values);
            let scale = all.map(|v| v.abs()).fold(0.0, f64::max);
            for row in 0..map.rows.len() {
                for (column, value) in values(row).iter().enumerate() {
                    let (x, y) = (left + column as i32 * CELL, TOP + row as i32 * CELL);
                    let cell = [(x, y), (x + CELL, y + CELL)];
                    let style = colour(*value / scale.max(f64::MIN_POSITIVE)).filled();
                    root.draw(&Rectangle::new(cell, style))
                        .map_err(|e| failed(title, &e))?;
                }
            }
            let right = left + block.columns as i32 * CELL;
            let bottom = TOP + map.rows.len() as i32 * CELL;
            root.draw(&Rectangle::new([(left, TOP), (right, bottom)], BLACK))
                .map_err(|e| failed(title, &e))?;
            let middle = left.midpoint(right);
            write(&block.name, (middle, bottom + 14), 13, HPos::Center)?;
            write(
                &format!("±{}", number(scale)),
                (middle, bottom + 30),
                11,
                HPos::Center,
            )?;
            write(&block.unit, (middle, bottom + 44), 11, HPos::Center)?;
            first = columns.end;
            left = right + BETWEEN;
        }
        root.present().map_err(|e| failed(title, &e))?;
    }
    Ok(text)
}

/// The colour of a number from -1 to 1.
fn colour(share: f64) -> RGBColor {
    let end = if share < 0.0 { LOW } else { HIGH };
    let mix = |c: f64| (255.0 + (c - 255.0) * share.abs().min(1.0)).round() as u8;
    RGBColor(mix(end.0), mix(end.1), mix(end.2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::figure::HeatBlock;

    #[test]
    fn each_block_has_its_own_scale() {
        let block = |name: &str, columns| HeatBlock {
            name: name.to_owned(),
            unit: "N".to_owned(),
            columns,
        };
        let map = HeatMap {
            rows: vec!["a".into(), "b".into()],
            blocks: vec![block("small", 1), block("large", 2)],
            values: vec![0.1, 0.0, 50.0, -0.05, -100.0, 0.0],
        };
        let svg = draw("weights", &map).expect("a figure");
        assert!(svg.contains("±0.1000") && svg.contains("±100.0"), "{svg}");
        assert_eq!(
            svg.matches("#B2182B").count(),
            1,
            "0.1 is the largest of its block"
        );
        assert_eq!(
            svg.matches("#2166AC").count(),
            1,
            "-100 is the smallest of its block"
        );
        assert!(matches!(
            draw(
                "w",
                &HeatMap {
                    values: vec![1.0],
                    ..map
                }
            ),
            Err(ReportError::Length {
                expected: 6,
                got: 1,
                ..
            })
        ));
    }
}
