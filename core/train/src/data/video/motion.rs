//! How much a video moves over time: mean absolute differences of consecutive images, small and grey.

use super::decoded::{Decoded, PRINT_TIMES};
use super::probe::{MOST_PRINTED, VideoFacts, probe};
use super::{CONSECUTIVE, STREAM, cache_folder, cache_name, input, run};
use cc4dgs_core::{Error, Limits, Result, SceneOptions};
use std::ffi::OsStr;
use std::path::Path;

/// Width and height of the small images. Their aspect does not matter: only differences are taken.
const SIZE: [usize; 2] = [64, 48];
const PIXELS: usize = SIZE[0] * SIZE[1];
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
/// the recordings at their beginnings. So do steps from and to frames that do not decode.
///
/// Errors: as [`probe`], and [`Error::Data`] for a video that does not decode.
pub(crate) fn motion(video: &Path, frames: &[Option<usize>], options: &SceneOptions, limits: &Limits) -> Result<Motion> {
    let facts = probe(video, options, limits)?;
    let last = frames.iter().flatten().copied().max().unwrap_or(0);
    let count = last + 1;
    let images = small_images(video, &facts, count, options)?;
    let image = |frame: usize| {
        let start = count + frame * PIXELS;
        images.get(start..start + PIXELS).filter(|_| images.get(frame) == Some(&1))
    };
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

/// The first `count` frames of a video, small and grey. One byte per frame says whether it was decoded (1), then come the images, black where it was not. Kept
/// in the cache.
fn small_images(video: &Path, facts: &VideoFacts, count: usize, options: &SceneOptions) -> Result<Vec<u8>> {
    let size = count * (1 + PIXELS);
    let cache = cache_folder(options)?;
    let file = cache.join(format!("{}.grey", cache_name(video, &format!("grey by time {SIZE:?} {count}"))?));
    if let Ok(bytes) = std::fs::read(&file)
        && bytes.len() == size
    {
        return Ok(bytes);
    }
    std::fs::create_dir_all(&cache).map_err(|e| Error::io(&cache, e))?;
    let work = tempfile::NamedTempFile::new_in(&cache).map_err(|e| Error::io(&cache, e))?;
    let filter = format!("{PRINT_TIMES},scale={}:{}:flags=area,format=gray,{CONSECUTIVE}", SIZE[0], SIZE[1]);
    let (video_input, output, map, frames) = (input(video), input(work.path()), format!("0:{STREAM}"), count.to_string());
    let mut arguments = ["-nostdin", "-v", "error", "-copyts", "-noautorotate", "-protocol_whitelist", "file", "-i"].map(OsStr::new).to_vec();
    arguments.push(&video_input);
    let after = ["-map", &map, "-vf", &filter, "-r", "25", "-frames:v", &frames, "-f", "rawvideo", "-pix_fmt", "gray", "-y"];
    arguments.extend(after.map(OsStr::new));
    arguments.push(&output);
    let printed = run(&options.ffmpeg, &arguments, video, MOST_PRINTED, Some(&cache))?;
    let images = std::fs::read(work.path()).map_err(|e| Error::io(work.path(), e))?;
    let mut bytes = vec![0; size];
    let (are_decoded, stored) = bytes.split_at_mut(count);
    let found = Decoded::read(&printed).images(facts, count);
    for ((is_decoded, stored), image) in are_decoded.iter_mut().zip(stored.chunks_exact_mut(PIXELS)).zip(found) {
        if let Some(image) = image.and_then(|image| images.get(image * PIXELS..(image + 1) * PIXELS)) {
            *is_decoded = 1;
            stored.copy_from_slice(image);
        }
    }
    std::fs::write(work.path(), &bytes).map_err(|e| Error::io(work.path(), e))?;
    work.persist(&file).map_err(|e| Error::io(&file, e.error))?;
    Ok(bytes)
}
