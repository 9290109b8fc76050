//! Figures as PNG, made from their SVG.

use std::sync::Arc;

use resvg::usvg::fontdb::Database;
use resvg::{tiny_skia, usvg};

use super::ReportError;

/// Pixels of the picture a pixel of the figure: sharp on fine screens and in print.
const SCALE: f32 = 2.0;

/// Draws PNG with the fonts of the system.
pub struct Rasteriser {
    options: usvg::Options<'static>,
}

impl Rasteriser {
    /// Find the fonts.
    ///
    /// # Errors
    /// There is none: the figure would be without words.
    pub fn new() -> Result<Self, ReportError> {
        let mut fonts = Database::new();
        fonts.load_system_fonts();
        let plain = |name: &String| {
            let name = name.to_lowercase();
            name.contains("sans") && !name.contains("mono") && !name.contains("condensed")
        };
        let families = || {
            fonts
                .faces()
                .flat_map(|f| f.families.iter().map(|(n, _)| n))
        };
        let family = families().find(|n| plain(n)).or_else(|| families().next());
        let family = family.cloned().ok_or(ReportError::NoFont)?;
        fonts.set_sans_serif_family(family);
        let options = usvg::Options {
            fontdb: Arc::new(fonts),
            ..usvg::Options::default()
        };
        Ok(Self { options })
    }

    /// The picture of an SVG document.
    ///
    /// # Errors
    /// The document cannot be read or the picture is too large.
    pub fn png(&self, name: &str, svg: &str) -> Result<Vec<u8>, ReportError> {
        let failed = |reason: String| ReportError::Draw {
            chart: name.to_owned(),
            reason,
        };
        let tree = usvg::Tree::from_str(svg, &self.options).map_err(|e| failed(e.to_string()))?;
        let size = tree.size().to_int_size();
        let (width, height) = (
            (SCALE * size.width() as f32).ceil() as u32,
            (SCALE * size.height() as f32).ceil() as u32,
        );
        let mut picture = tiny_skia::Pixmap::new(width, height)
            .ok_or_else(|| failed(format!("{width} × {height} pixels")))?;
        let scale = tiny_skia::Transform::from_scale(SCALE, SCALE);
        resvg::render(&tree, scale, &mut picture.as_mut());
        picture.encode_png().map_err(|e| failed(e.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_and_lines_leave_ink() {
        let Ok(rasteriser) = Rasteriser::new() else {
            return; // no font on this system
        };
        let svg = |inside: &str| {
            format!(
                r#"<svg xmlns="http://www.w3.org/2000/svg" width="60" height="20">{inside}</svg>"#
            )
        };
        let ink = |inside: &str| {
            let png = rasteriser.png("test", &svg(inside)).expect("a picture");
            assert!(png.starts_with(b"\x89PNG"));
            let picture = tiny_skia::Pixmap::decode_png(&png).expect("readable");
            assert_eq!((picture.width(), picture.height()), (120, 40));
            picture.pixels().iter().filter(|p| p.alpha() > 0).count()
        };
        assert_eq!(ink(""), 0);
        let words = r#"<text x="2" y="14" font-family="sans-serif" font-size="12">spiral</text>"#;
        assert!(ink(words) > 50, "the font is there");
        assert!(rasteriser.png("test", "no svg").is_err());
    }
}
