//! Contact sheets: ground truth, render and error side by side, one row per view.

use super::{GLYPH_HEIGHT, GLYPH_WIDTH, draw_text, error_map, text_width};
use cc4dgs_core::{Error, Image8, Result};
use image::{RgbImage, imageops};

/// One row of a sheet.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// What is shown and how well it came out, one line.
    pub caption: String,
    /// The image to match.
    pub reference: Image8,
    /// The rendered image, of the same size.
    pub render: Image8,
}

/// How a sheet looks.
#[derive(Clone, Debug, PartialEq)]
pub struct SheetOptions {
    /// A line above everything; may be empty.
    pub title: String,
    /// Wider images are shrunk to this width, in pixels.
    pub max_cell_width: u32,
    /// The mean absolute difference (0..1) drawn brightest in the error column.
    pub error_full_scale: f32,
}

impl Default for SheetOptions {
    fn default() -> Self {
        Self { title: String::new(), max_cell_width: 400, error_full_scale: 0.2 }
    }
}

const PAPER: [u8; 3] = [24, 24, 28];
const INK: [u8; 3] = [235, 235, 235];
const GAP: u32 = 6;
const COLUMNS: u32 = 3;
/// A sheet is for looking at; beyond this no viewer shows it.
const MAX_SHEET_PIXELS: u64 = 200_000_000;

/// Draws ground truth | render | error for every comparison. Refuses an empty list, pairs of different sizes and sheets over 200 megapixels.
pub fn comparison_sheet(comparisons: &[Comparison], options: &SheetOptions) -> Result<Image8> {
    if comparisons.is_empty() {
        return Err(Error::parameter("contact sheet", "there is no view to show", "Evaluate at least one view"));
    }
    let cells: Vec<(u32, u32)> = comparisons.iter().map(|c| cell_size(&c.reference, options.max_cell_width)).collect();
    let cell_width = cells.iter().map(|c| c.0).max().unwrap_or(1);
    let scale = if cell_width >= 240 { 2 } else { 1 };
    let line = GLYPH_HEIGHT * scale + GAP;
    let head = if options.title.is_empty() { line } else { 2 * line };
    // Narrow images must not cut their captions off.
    let texts = comparisons.iter().map(|c| &c.caption).chain([&options.title]);
    let widest_text = texts.map(|t| text_width(t, scale)).max().unwrap_or(0).min(COLUMNS * 400) + 2 * GAP;
    let width = u64::from((COLUMNS * cell_width + (COLUMNS + 1) * GAP).max(widest_text));
    let height = u64::from(head) + cells.iter().map(|c| u64::from(c.1 + line + GAP)).sum::<u64>() + u64::from(GAP);
    if width * height > MAX_SHEET_PIXELS {
        return Err(Error::limit("contact sheet pixels", width * height, MAX_SHEET_PIXELS, "Show fewer views or narrower images"));
    }
    let mut sheet = Image8 { width: width as u32, height: height as u32, channels: 3, data: PAPER.repeat((width * height) as usize) };
    if !options.title.is_empty() {
        draw_text(&mut sheet, GAP, GAP, &fit(&options.title, width as u32, scale), INK, scale);
    }
    let error_title = format!("error (bright = {})", options.error_full_scale);
    for (column, title) in ["ground truth", "render", &error_title].into_iter().enumerate() {
        let x = GAP + column as u32 * (cell_width + GAP);
        let title: String = title.chars().take((cell_width / (GLYPH_WIDTH * scale)) as usize).collect();
        draw_text(&mut sheet, x, head - line + GAP, &title, INK, scale);
    }
    let mut y = head + GAP;
    for (comparison, size) in comparisons.iter().zip(cells) {
        draw_text(&mut sheet, GAP, y, &fit(&comparison.caption, width as u32, scale), INK, scale);
        y += line - GAP;
        // The error is taken at full size and then shrunk: shrinking first would hide it.
        let error = error_map(&comparison.reference, &comparison.render, options.error_full_scale)?;
        for (column, image) in [&comparison.reference, &comparison.render, &error].into_iter().enumerate() {
            paste(&mut sheet, &shrink(image, size)?, GAP + column as u32 * (cell_width + GAP), y);
        }
        y += size.1 + 2 * GAP;
    }
    Ok(sheet)
}

fn cell_size(image: &Image8, max_width: u32) -> (u32, u32) {
    let max_width = max_width.max(1);
    if image.width <= max_width {
        return (image.width, image.height);
    }
    let height = (u64::from(image.height) * u64::from(max_width) + u64::from(image.width) / 2) / u64::from(image.width);
    (max_width, height.max(1) as u32)
}

fn fit(text: &str, width: u32, scale: u32) -> String {
    text.chars().take((width.saturating_sub(2 * GAP) / (GLYPH_WIDTH * scale)) as usize).collect()
}

fn shrink(image: &Image8, (width, height): (u32, u32)) -> Result<RgbImage> {
    let rgb = image.data.chunks_exact(image.channels.max(1) as usize).flat_map(|p| [p[0], p[1], p[2]]).collect();
    let whole = RgbImage::from_raw(image.width, image.height, rgb).ok_or_else(|| {
        Error::parameter("contact sheet", format!("an image of {} bytes is not {}x{}", image.data.len(), image.width, image.height), "Pass whole images")
    })?;
    Ok(if (image.width, image.height) == (width, height) { whole } else { imageops::thumbnail(&whole, width, height) })
}

fn paste(sheet: &mut Image8, image: &RgbImage, x: u32, y: u32) {
    let row_bytes = 3 * image.width() as usize;
    for (row, line) in image.as_raw().chunks_exact(row_bytes).enumerate() {
        let at = 3 * ((y as usize + row) * sheet.width as usize + x as usize);
        sheet.data[at..at + row_bytes].copy_from_slice(line);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(width: u32, height: u32, value: u8) -> Image8 {
        Image8 { width, height, channels: 3, data: vec![value; (3 * width * height) as usize] }
    }

    #[test]
    fn each_image_lands_in_its_column() {
        let row = Comparison { caption: "cam 3 t 0.25".into(), reference: flat(60, 20, 200), render: flat(60, 20, 149) };
        let sheet = comparison_sheet(&[row.clone(), row], &SheetOptions { title: "demo".into(), ..Default::default() }).unwrap();
        assert_eq!(sheet.data.len(), (3 * sheet.width * sheet.height) as usize);
        let bottom = sheet.height - 2 * GAP - 2;
        let pixel = |x: u32| sheet.data[(3 * (bottom * sheet.width + x)) as usize];
        assert_eq!((pixel(GAP + 30), pixel(2 * GAP + 90)), (200, 149));
        // |200 - 149| / 255 is 0.2, the full scale.
        assert_eq!(pixel(3 * GAP + 150), 252);
    }

    #[test]
    fn wide_images_shrink_and_bad_input_is_refused() {
        let pair = |a: Image8, b: Image8| Comparison { caption: String::new(), reference: a, render: b };
        let sheet = comparison_sheet(&[pair(flat(1000, 500, 7), flat(1000, 500, 7))], &SheetOptions::default()).unwrap();
        assert_eq!(sheet.width, 3 * 400 + 4 * GAP);
        assert!(comparison_sheet(&[], &SheetOptions::default()).is_err());
        assert!(comparison_sheet(&[pair(flat(10, 10, 0), flat(10, 11, 0))], &SheetOptions::default()).is_err());
    }
}
