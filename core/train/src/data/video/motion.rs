//! How much a video moves over time: mean absolute differences of consecutive images, small and grey.

use super::probe::probe;
use super::{CONSECUTIVE, STREAM, cache_folder, cache_name, input, run};
use cc4dgs_core::{Error, Limits, Result, SceneOptions};
use std::ffi::OsStr;
use std::io::Write;
use std::path::Path;

/// Width and height of the small images. Their aspect does not matter: only differences are taken.
const SIZE: [usize; 2] = [64, 48];
/// If a larger share of the frames are key frames, they are not told apart.
const MOST_KEYS: f64 = 0.25;

/// The motion of a video at given frames.
pub(crate) struct Motion {
    /// Mean absolute difference to the image before, in grey levels; NaN where it is unknown. One less than there are frames.
    pub energy: Vec<f32>,
    /// Frames per second, as sampled.
    pub rate: f64,
}

/// The motion between the listed frames of a video; `None` in the list are instants without a frame.
///
/// Encoders write a key frame every second or so, and the image changes there although nothing moves. These steps count as unknown; they would align
/// the recordings at their beginnings.
///
/// Errors: as [`probe`], and [`Error::Data`] for a video that does not decode.
pub(crate) fn motion(video: &Path, frames: &[Option<usize>], options: &SceneOptions, limits: &Limits) -> Result<Motion> {
    let facts = probe(video, options, limits)?;
    let last = frames.iter().flatten().copied().max().unwrap_or(0);
    let images = small_images(video, last + 1, options)?;
    let pixels = SIZE[0] * SIZE[1];
    let image = |frame: usize| images.get(frame * pixels..(frame + 1) * pixels);
    let keys = facts.keys.iter().filter(|k| **k).count() as f64;
    let telling = keys <= MOST_KEYS * facts.keys.len() as f64;
    let has_key = |a: usize, b: usize| telling && facts.keys.iter().take(b + 1).skip(a + 1).any(|k| *k);
    let step = |pair: &[Option<usize>]| match (pair[0], pair[1]) {
        (Some(a), Some(b)) if !has_key(a, b) => image(a).zip(image(b)).map_or(f32::NAN, |(a, b)| difference(a, b)),
        _ => f32::NAN,
    };
    let energy = frames.windows(2).map(step).collect();
    let known = |k: &usize| frames[*k].and_then(|f| facts.times.get(f)).map(|t| (*k as f64, *t));
    let (first, end) = ((0..frames.len()).find_map(|k| known(&k)), (0..frames.len()).rev().find_map(|k| known(&k)));
    let rate = first.zip(end).map_or(0.0, |(a, b)| (b.0 - a.0) / (b.1 - a.1));
    Ok(Motion { energy, rate: if rate.is_finite() { rate } else { 0.0 } })
}

fn difference(a: &[u8], b: &[u8]) -> f32 {
    let sum: u64 = a.iter().zip(b).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    sum as f32 / a.len() as f32
}

/// The first `count` frames of a video, small and grey, one after the other; fewer if it has fewer. Kept in the cache.
fn small_images(video: &Path, count: usize, options: &SceneOptions) -> Result<Vec<u8>> {
    let most = (count * SIZE[0] * SIZE[1]) as u64;
    let cache = cache_folder(options)?;
    let file = cache.join(format!("{}.grey", cache_name(video, &format!("grey {SIZE:?} {count}"))?));
    if let Ok(bytes) = std::fs::read(&file)
        && bytes.len() as u64 <= most
    {
        return Ok(bytes);
    }
    let filter = format!("scale={}:{}:flags=area,format=gray,{CONSECUTIVE}", SIZE[0], SIZE[1]);
    let (video_input, map, frames) = (input(video), format!("0:{STREAM}"), count.to_string());
    let mut arguments = ["-nostdin", "-v", "error", "-noautorotate", "-protocol_whitelist", "file", "-i"].map(OsStr::new).to_vec();
    arguments.push(&video_input);
    let after = ["-map", &map, "-vf", &filter, "-r", "25", "-frames:v", &frames, "-f", "rawvideo", "-pix_fmt", "gray", "pipe:1"];
    arguments.extend(after.map(OsStr::new));
    let bytes = run(&options.ffmpeg, &arguments, video, most, None)?;
    std::fs::create_dir_all(&cache).map_err(|e| Error::io(&cache, e))?;
    let mut work = tempfile::NamedTempFile::new_in(&cache).map_err(|e| Error::io(&cache, e))?;
    work.write_all(&bytes).map_err(|e| Error::io(&file, e))?;
    work.persist(&file).map_err(|e| Error::io(&file, e.error))?;
    Ok(bytes)
}
