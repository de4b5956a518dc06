//! Baking: the motion of a model's deformer as a playback layer (`cc4dgs_core::playback`).
//!
//! The deformer is evaluated at even times, and its results, as the rasterizer would receive them, are compared with the canonical Gaussians. A singular value
//! decomposition of a sample of the Gaussians gives functions of time per head and segment, in order of importance; every Gaussian then takes as many of them, and
//! coefficients as fine, as its own tolerance needs. The error is measured on the quantised result, at all samples of all Gaussians.

mod archive;
mod functions;
mod keyframes;
mod motion;
mod rows;
mod tolerance;

use crate::{Model, Orbit};
pub use archive::{Additions, Motion as AddedMotion, PLAYBACK, with_additions};
use burn::tensor::Device;
pub use cc4dgs_core::playback::MaxError;
use cc4dgs_core::playback::{CodedTrack, Head, MAX_SAMPLES, PlaybackLayer};
use cc4dgs_core::{Camera, Event, EventSink, Result, Stream};
use functions::{HeadFunctions, segment_ends};
pub use keyframes::keyframes;
use motion::Motion;
use serde::Serialize;
use tolerance::Tolerances;

/// Gaussians that the functions are found from.
const SAMPLED_ROWS: usize = 3072;
/// Floats of offsets held at a time.
const FLOATS: usize = 24 << 20;
/// Samples per frame at most, but any sequence may have so many: functions are shared by all Gaussians.
const SAMPLES_PER_FRAME: usize = 8;
const SAMPLES_OF_ANY: usize = 257;
/// The part of the tolerance that linear interpolation between samples may use up before the samples are doubled.
const BETWEEN_SHARE: f32 = 0.5;

/// Errors over the tolerance from which on a warning is given; a little is left for rounding.
const KEPT: f32 = 1.001;

/// What [`bake`] is asked for.
pub struct BakeOptions<'a> {
    /// How far a point of a Gaussian may be off.
    pub max_error: MaxError,
    /// The cameras in which pixels are counted, in the coordinates of the model; without any, an orbit round the model.
    pub cameras: &'a [Camera],
}

/// A playback layer and what is known of it.
pub struct Baked {
    /// The streams of the layer.
    pub streams: Vec<Stream>,
    /// Figures.
    pub report: BakeReport,
}

/// What baking came to.
#[derive(Clone, Debug, Serialize)]
pub struct BakeReport {
    /// Gaussians that move.
    pub moving: usize,
    /// Samples of time.
    pub samples: usize,
    /// Segments of time.
    pub segments: usize,
    /// The bound that was asked for.
    pub max_error: MaxError,
    /// The heads that the layer changes.
    pub heads: Vec<HeadReport>,
    /// The largest error at a sample over its tolerance, all heads and Gaussians; at most 1 where the bound is kept.
    pub at_samples: f32,
    /// The largest error half way between samples over its tolerance, of a sample of the Gaussians.
    pub between_samples: f32,
}

/// Figures of one head.
#[derive(Clone, Debug, Serialize)]
pub struct HeadReport {
    /// Its name.
    pub head: &'static str,
    /// Most functions in any segment.
    pub functions: usize,
    /// Gaussians that it changes.
    pub rows: usize,
    /// Coefficients of all segments.
    pub coefficients: usize,
    /// Largest error at a sample over its tolerance.
    pub max_error: f32,
}

/// The motion of `model` as a playback layer; `None` if nothing moves. `device` is that of the model's deformer.
///
/// # Errors
/// [`cc4dgs_core::Error::Parameter`] for a bound that is not positive; what the deformer reports.
pub fn bake(model: &Model, options: &BakeOptions, device: &Device, events: &dyn EventSink) -> Result<Option<Baked>> {
    options.max_error.check()?;
    let Some(motion) = Motion::of(model, device)? else { return Ok(None) };
    let around;
    let cameras = if options.cameras.is_empty() {
        around = Orbit { frames: 12, ..Orbit::default() }.around(&model.gaussians)?;
        &around
    } else {
        options.cameras
    };
    let tolerances = Tolerances::new(options.max_error, cameras);
    let probe = motion.rows_evenly(SAMPLED_ROWS.min(FLOATS / (motion.width() * model.frame_count.max(2)).max(1)).max(1));
    let (samples, between_samples) = choose_samples(&motion, &tolerances, &probe, model.frame_count)?;
    let sample = motion.evaluate(&probe, samples, &tolerances)?;
    let ends = segment_ends(&sample, samples, motion.rows.len());
    let functions: Vec<Vec<HeadFunctions>> = ends.windows(2).map(|w| sample.heads.iter().map(|head| HeadFunctions::of(head, w[0]..=w[1])).collect()).collect();
    let mut coded: Vec<Vec<rows::TrackBuilder>> = functions.iter().map(|heads| heads.iter().map(rows::TrackBuilder::new).collect()).collect();
    let chunk = (FLOATS / (motion.width() * samples).max(1)).clamp(1, 1 << 14);
    let all: Vec<usize> = (0..motion.rows.len()).collect();
    for (done, part) in all.chunks(chunk).enumerate() {
        let offsets = motion.evaluate(part, samples, &tolerances)?;
        for (builders, (heads, span)) in coded.iter_mut().zip(functions.iter().zip(ends.windows(2))) {
            for ((builder, functions), head) in builders.iter_mut().zip(heads).zip(&offsets.heads) {
                builder.extend(functions, head, span[0]);
            }
        }
        events.emit(&Event::Progress { task: "bake".into(), done: ((done + 1) * chunk).min(all.len()) as u64, total: all.len() as u64 });
    }
    let mut heads: Vec<HeadReport> = Vec::new();
    for head in Head::ALL {
        let tracks: Vec<&rows::TrackBuilder> = coded.iter().flatten().filter(|t| t.head() == head && t.rank() > 0).collect();
        if let Some(most) = tracks.iter().map(|t| t.rank()).max() {
            heads.push(HeadReport {
                head: head.name(),
                functions: most,
                rows: tracks.iter().map(|t| t.users()).max().unwrap_or(0),
                coefficients: tracks.iter().map(|t| t.coefficients()).sum(),
                max_error: tracks.iter().map(|t| t.worst()).fold(0.0, f32::max),
            });
        }
    }
    let at_samples = coded.iter().flatten().map(|t| t.worst()).fold(0.0, f32::max);
    let segments: Vec<(usize, Vec<CodedTrack>)> = coded
        .into_iter()
        .zip(functions.iter().zip(&ends[1..]))
        .map(|(tracks, (heads, &end))| (end, tracks.into_iter().zip(heads).filter_map(|(t, functions)| t.finish(functions)).collect()))
        .collect();
    let indices: Vec<u32> = motion.rows.iter().map(|&row| row as u32).collect();
    let streams = PlaybackLayer::encode(&indices, model.gaussians.sh_degree, samples, &segments)?;
    if at_samples.max(between_samples) > KEPT {
        let message = format!(
            "a point may be {at_samples:.2} times as far off as allowed at the {samples} samples of time, and {between_samples:.2} times half way between \
             them, because it moves too fast for so many; look at the result, or play the model with its deformer"
        );
        events.emit(&Event::Warning { object: "bake".into(), message });
    }
    let report = BakeReport { moving: indices.len(), samples, segments: segments.len(), max_error: options.max_error, heads, at_samples, between_samples };
    Ok(Some(Baked { streams, report }))
}

/// The number of samples: one per frame, and more where motion between frames is far from straight. Also the error that is left half way between samples, over
/// the tolerance.
fn choose_samples(motion: &Motion, tolerances: &Tolerances, probe: &[usize], frames: usize) -> Result<(usize, f32)> {
    let few: Vec<usize> = probe.iter().step_by(probe.len().div_ceil(256)).copied().collect();
    let mut samples = frames.clamp(2, MAX_SAMPLES);
    loop {
        let finer = 2 * samples - 1;
        let error = motion.evaluate(&few, finer, tolerances)?.largest_bend();
        let most = SAMPLES_PER_FRAME.saturating_mul(frames.max(2)).clamp(SAMPLES_OF_ANY, MAX_SAMPLES / 2);
        if error <= BETWEEN_SHARE || finer > most {
            return Ok((samples, error));
        }
        samples = finer;
    }
}
