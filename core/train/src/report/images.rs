//! Images of results: read from the sweep's folder, compared, cropped, and written as data URLs.

use super::charts::best_codecs;
use super::rows::Row;
use super::text::{base64, html};
use crate::images::{encode_png, error_map, heat_color};
use crate::sample::{by_group, spread_from_first};
use crate::sweep::{CellResult, ImageResult};
use cc4dgs_core::{Error, Image8, Result};
use image::codecs::jpeg::JpegEncoder;
use image::{ImageFormat, ImageReader, RgbImage, imageops};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::io::Cursor;
use std::path::{Component, Path, PathBuf};

/// Largest file of an image, bytes.
const MOST_BYTES: u64 = 64 << 20;
/// Largest side of an image, pixels.
const MOST_PIXELS: u32 = 8192;
/// Wider images are shrunk to this width; crops are cut before.
const SHOWN_WIDTH: u32 = 480;
/// JPEG quality of whole images. Crops are PNG, so that what is enlarged is exact.
const QUALITY: u8 = 92;
/// Mean absolute difference that error maps draw brightest.
const ERROR_SCALE: f32 = 0.2;
/// The same for flicker maps.
const FLICKER_SCALE: f32 = 0.1;
/// Most frames that a flicker map is taken over.
const FLICKER_FRAMES: usize = 48;
/// What to do about damaged images. A cell with a result is not run again, whatever became of its images.
const REMEDY: &str =
    "Remove the file, and the page leaves its image out. `sweep run` draws it again once the cell's file in the folder results is removed, too";

/// The contact sheets, sliders and flicker maps of a scene, as HTML; empty where the folder has no images of it.
///
/// # Errors
/// [`Error::Data`] for paths that leave the folder and for files that are no images of one size.
pub fn gallery(folder: &Path, scene: &str, rows: &[Row], views: usize) -> Result<String> {
    let shown: Vec<(&Row, &CellResult)> = best_codecs(rows).into_iter().filter_map(|row| Some((row, shown_cell(folder, row)?))).collect();
    let Some((_, first)) = shown.first() else { return Ok(String::new()) };
    let usable: Vec<usize> = (0..first.images.len()).filter(|i| shown.iter().all(|(_, cell)| file_of(folder, cell, *i).is_some())).collect();
    // In the order of their frames, every so many images are often of one camera.
    let usable = by_group(&usable, |image| first.images[image].camera.as_str());
    let mut chosen = spread_from_first(&usable, views);
    chosen.sort_unstable();
    let mut body = String::new();
    for view in chosen {
        body += &sheet(folder, scene, &shown, view)?;
    }
    body += &flicker(folder, &shown)?;
    if body.is_empty() {
        return Ok(body);
    }
    let head = "<h3>Images</h3>\n<p class=\"note\">First seed; per training the codec with the highest PSNR. Squares are enlarged below: where all renders together err most. Whole images are JPEG, squares are exact.</p>\n";
    Ok(head.to_string() + &body)
}

/// The first seed with files for an image.
fn shown_cell<'a>(folder: &Path, row: &Row<'a>) -> Option<&'a CellResult> {
    row.cells.iter().copied().find(|cell| (0..cell.images.len()).any(|i| file_of(folder, cell, i).is_some()))
}

fn file_of<'a>(folder: &Path, cell: &'a CellResult, index: usize) -> Option<(&'a ImageResult, &'a str, &'a str)> {
    let image = cell.images.get(index)?;
    let (truth, render) = (image.truth.as_deref()?, image.render.as_deref()?);
    (folder.join(truth).is_file() && folder.join(render).is_file()).then_some((image, truth, render))
}

/// Reads an image of the results. The path must stay within the folder, links included.
fn read(folder: &Path, name: &str) -> Result<Image8> {
    let inside = || -> Option<PathBuf> {
        let plain = Path::new(name).components().all(|c| matches!(c, Component::Normal(_)));
        let file = folder.join(name).canonicalize().ok()?;
        (plain && file.starts_with(folder.canonicalize().ok()?)).then_some(file)
    };
    let Some(file) = inside() else {
        return Err(Error::data(name, "this image lies outside the folder of the results", "Images are named relative to that folder, without .."));
    };
    let bytes = std::fs::metadata(&file).map_err(|e| Error::io(&file, e))?.len();
    if bytes > MOST_BYTES {
        return Err(Error::limit(name, bytes, MOST_BYTES, "Replace the file by a smaller image"));
    }
    let mut reader = ImageReader::with_format(Cursor::new(std::fs::read(&file).map_err(|e| Error::io(&file, e))?), ImageFormat::Png);
    let mut limits = image::Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(MOST_PIXELS), Some(MOST_PIXELS));
    reader.limits(limits);
    let rgb = reader.decode().map_err(|e| Error::data(name, format!("not a PNG image: {e}"), REMEDY))?.to_rgb8();
    let (width, height) = rgb.dimensions();
    Ok(Image8 { width, height, channels: 3, data: rgb.into_raw() })
}

fn read_pair(folder: &Path, truth: &str, render: &str) -> Result<(Image8, Image8)> {
    let (a, b) = (read(folder, truth)?, read(folder, render)?);
    if (a.width, a.height) != (b.width, b.height) {
        let problem = format!("{}x{} pixels, its ground truth {truth} has {}x{}", b.width, b.height, a.width, a.height);
        return Err(Error::data(render, problem, REMEDY));
    }
    Ok((a, b))
}

fn url(image: &Image8) -> Result<String> {
    let rgb =
        RgbImage::from_raw(image.width, image.height, image.data.clone()).ok_or_else(|| Error::backend("report", "an image of another size", "Report this"))?;
    let height = (u64::from(image.height) * u64::from(SHOWN_WIDTH) / u64::from(image.width)).max(1) as u32;
    let rgb = if image.width > SHOWN_WIDTH { imageops::thumbnail(&rgb, SHOWN_WIDTH, height) } else { rgb };
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, QUALITY).encode_image(&rgb).map_err(|e| Error::backend("JPEG encoder", e.to_string(), "Report this"))?;
    Ok(format!("data:image/jpeg;base64,{}", base64(&bytes)))
}

fn exact_url(image: &Image8) -> Result<String> {
    Ok(format!("data:image/png;base64,{}", base64(&encode_png(image)?)))
}

/// A square of an image: left, top, side in pixels.
type Square = (u32, u32, u32);

fn crop(image: &Image8, (left, top, side): Square) -> Image8 {
    let row = |y: u32| {
        let from = 3 * ((top + y) * image.width + left) as usize;
        &image.data[from..from + 3 * side as usize]
    };
    Image8 { width: side, height: side, channels: 3, data: (0..side).flat_map(row).copied().collect() }
}

/// Where squares of `side` pixels begin along `length` pixels, half a side apart. The last one ends at the edge.
fn offsets(length: u32, side: u32) -> impl Iterator<Item = u32> {
    let last = length.saturating_sub(side);
    (0..last).step_by((side / 2).max(1) as usize).chain([last])
}

/// Where the renders together differ most from the truth.
fn worst_square(truth: &Image8, renders: &[Image8]) -> Square {
    let side = (truth.width / 6).clamp(16, 96).min(truth.width).min(truth.height);
    let error = |left: u32, top: u32| -> u64 {
        let squares = renders.iter().map(|render| (crop(render, (left, top, side)), crop(truth, (left, top, side))));
        squares.map(|(a, b)| a.data.iter().zip(&b.data).map(|(x, y)| u64::from(x.abs_diff(*y))).sum::<u64>()).sum()
    };
    let mut best = ((0, 0, side), 0);
    for top in offsets(truth.height, side) {
        for left in offsets(truth.width, side) {
            let error = error(left, top);
            if error > best.1 {
                best = ((left, top, side), error);
            }
        }
    }
    best.0
}

/// One view: ground truth, then every render with its worst square and error map, and a slider.
fn sheet(folder: &Path, scene: &str, shown: &[(&Row, &CellResult)], view: usize) -> Result<String> {
    let mut cards = Vec::new();
    for (row, cell) in shown {
        if let Some((image, truth, render)) = file_of(folder, cell, view) {
            let (truth, render) = read_pair(folder, truth, render)?;
            cards.push((row, image, truth, render));
        }
    }
    let Some((_, image, truth, _)) = cards.first() else { return Ok(String::new()) };
    if let Some((row, ..)) =
        cards.iter().find(|(_, other, t, _)| (t.width, t.height, other.frame, &other.camera) != (truth.width, truth.height, image.frame, &image.camera))
    {
        return Err(Error::data(
            format!("{scene}, image {view} of {}", row.name()),
            "another view than in the other results of this scene",
            "Score all cells on the same views",
        ));
    }
    let renders: Vec<Image8> = cards.iter().map(|(.., render)| render.clone()).collect();
    let square = worst_square(truth, &renders);
    let percent = |v: u32, of: u32| 100.0 * f64::from(v) / f64::from(of);
    let frame = format!(
        "<i class=\"square\" style=\"left:{:.2}%;top:{:.2}%;width:{:.2}%;height:{:.2}%\"></i>",
        percent(square.0, truth.width),
        percent(square.1, truth.height),
        percent(square.2, truth.width),
        percent(square.2, truth.height)
    );
    let card = |name: &str, scores: &str, whole: &str, square: &str, error: Option<&str>| {
        let error = error.map_or_else(String::new, |url| format!("<img alt=\"error\" src=\"{url}\">"));
        let name = html(name);
        format!(
            "<div class=\"card\" data-name=\"{name}\"><div class=\"whole\"><img alt=\"{name}\" src=\"{whole}\">{frame}</div><div class=\"details\"><img class=\"exact\" alt=\"square\" src=\"{square}\">{error}</div><p><b>{name}</b><br>{}</p></div>\n",
            html(scores)
        )
    };
    let mut body = card("ground truth", &format!("{}x{} pixels", truth.width, truth.height), &url(truth)?, &exact_url(&crop(truth, square))?, None);
    for (row, image, truth, render) in &cards {
        let score = |key: &str, digits: usize| image.scores.get(key).map_or_else(|| "–".into(), |v| format!("{v:.digits$}"));
        let scores = format!("PSNR {} dB, SSIM {}, LPIPS {}", score("psnr_db", 2), score("ssim", 4), score("lpips", 4));
        let error = error_map(truth, render, ERROR_SCALE)?;
        body += &card(&row.name(), &scores, &url(render)?, &exact_url(&crop(render, square))?, Some(&url(&error)?));
    }
    let title = format!("{scene}, camera {}, frame {}", image.camera, image.frame);
    Ok(format!(
        "<section class=\"view\"><h4>{}</h4><div class=\"compare\"><div class=\"slider\" hidden><div class=\"pair\"><img class=\"below\" alt=\"ground truth\"><img class=\"above\" alt=\"render\"></div><label>left ground truth, right <select></select></label> <input type=\"range\" min=\"0\" max=\"100\" value=\"50\" aria-label=\"border between ground truth and render\"></div><div class=\"cards\">{body}</div></div><p class=\"note\">Right of each square: mean absolute difference, brightest at {ERROR_SCALE}.</p></section>\n",
        html(&title)
    ))
}

/// Per training: where a render changes over time otherwise than the truth.
fn flicker(folder: &Path, shown: &[(&Row, &CellResult)]) -> Result<String> {
    let mut cards = String::new();
    let mut frames_used = 0;
    for (row, cell) in shown {
        let mut cameras: BTreeMap<&str, BTreeMap<usize, usize>> = BTreeMap::new();
        for (index, image) in cell.images.iter().enumerate().filter(|(i, _)| file_of(folder, cell, *i).is_some()) {
            cameras.entry(&image.camera).or_default().insert(image.frame, index);
        }
        // Of equally long ones the first by name.
        let longest = cameras.values().map(BTreeMap::len).max().unwrap_or(0);
        let Some((camera, frames)) = cameras.iter().find(|(_, frames)| frames.len() == longest && longest >= 3) else { continue };
        let mut before: Option<(Image8, Image8)> = None;
        let mut sums: Vec<u64> = Vec::new();
        let mut steps = 0u64;
        for index in frames.values().take(FLICKER_FRAMES) {
            let Some((_, truth, render)) = file_of(folder, cell, *index) else { continue };
            let now = read_pair(folder, truth, render)?;
            sums.resize(now.0.data.len() / 3, 0);
            if let Some((truth, render)) = &before {
                if truth.data.len() != now.0.data.len() {
                    return Err(Error::data(format!("{}, camera {camera}", row.name()), "its images differ in size", REMEDY));
                }
                let change = |i: usize| (i32::from(now.1.data[i]) - i32::from(render.data[i])) - (i32::from(now.0.data[i]) - i32::from(truth.data[i]));
                sums.iter_mut().enumerate().for_each(|(p, sum)| *sum += (0..3).map(|c| u64::from(change(3 * p + c).unsigned_abs())).sum::<u64>());
                steps += 1;
            }
            before = Some(now);
        }
        let Some((last, _)) = before.filter(|_| steps > 0) else { continue };
        let level = |sum: u64| sum as f64 / (3 * steps) as f64;
        let data = sums.iter().flat_map(|sum| heat_color(level(*sum) as f32 / (255.0 * FLICKER_SCALE))).collect();
        let map = Image8 { width: last.width, height: last.height, channels: 3, data };
        let mean = sums.iter().map(|s| level(*s)).sum::<f64>() / sums.len() as f64;
        frames_used = frames_used.max(steps as usize + 1);
        _ = writeln!(
            cards,
            "<div class=\"card\"><div class=\"whole\"><img alt=\"flicker\" src=\"{}\"></div><p><b>{}</b><br>camera {}: {mean:.2} of 255 levels</p></div>",
            url(&map)?,
            html(&row.name()),
            html(camera)
        );
    }
    if cards.is_empty() {
        return Ok(String::new());
    }
    Ok(format!(
        "<section class=\"view\"><h4>Flicker</h4><div class=\"cards\">{cards}</div><p class=\"note\">Absolute difference between the change of the render and the change of the ground truth from one scored frame to the next, mean over colours and {frames_used} frames or fewer of the camera with the most frames; brightest at {FLICKER_SCALE}.</p></section>\n"
    ))
}

/// Names of scenes, of those given, whose images may be published: the built-in ones.
pub fn built_in<'a>(scenes: &BTreeMap<&'a str, Vec<Row<'a>>>) -> BTreeSet<&'a str> {
    let made = |cell: &CellResult| cell.provenance.data.files == 0 && crate::data::procedural::name_of(Path::new(&cell.provenance.data.path)).is_some();
    scenes.iter().filter(|(_, rows)| rows.iter().flat_map(|r| &r.cells).all(|cell| made(cell))).map(|(scene, _)| *scene).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squares_reach_every_edge() {
        assert_eq!(offsets(100, 16).last(), Some(84));
        assert_eq!((offsets(16, 16).collect::<Vec<_>>(), offsets(32, 16).collect::<Vec<_>>()), (vec![0], vec![0, 8, 16]));
        // Only the last rows and columns are wrong, which no multiple of half a side shows.
        let (width, height) = (100u32, 60u32);
        let image = |corner: u8| {
            let shade = |i: u32| if i % width >= 98 && i / width >= 58 { corner } else { 9 };
            Image8 { width, height, channels: 3, data: (0..width * height).flat_map(|i| [shade(i); 3]).collect() }
        };
        assert_eq!(worst_square(&image(9), &[image(200)]), (84, 44, 16));
    }
}
