//! Baking: the motion of a model's deformer as a playback layer (`cc4dgs_core::playback`).
//!
//! The deformer is evaluated at even times, and its results, as the rasterizer would receive them, are compared with the canonical Gaussians. A singular value
//! decomposition of a sample of the Gaussians gives functions of time per head and segment, in order of importance; every Gaussian then takes as many of them,
//! and coefficients as fine, as its own tolerance needs. The error is measured on the quantised result: at all samples of all Gaussians, and half way between
//! samples of up to 1,024 of them.

mod archive;
mod between;
mod functions;
mod keyframes;
mod motion;
mod rows;
mod tolerance;

use crate::{Model, Orbit};
pub use archive::{Additions, Motion as AddedMotion, PLAYBACK, with_additions};
use between::Between;
use burn::tensor::Device;
pub use cc4dgs_core::playback::MaxError;
use cc4dgs_core::playback::{CodedTrack, Head, MAX_SAMPLES, PlaybackLayer};
use cc4dgs_core::{Camera, Error, Event, EventSink, Result, Stream};
use functions::{HeadFunctions, segment_ends};
pub use keyframes::keyframes;
use motion::Motion;
use serde::Serialize;
use std::sync::atomic::{AtomicBool, Ordering};
use tolerance::Tolerances;

/// Gaussians that the functions are found from.
const SAMPLED_ROWS: usize = 3072;
/// Floats of offsets held at a time. The sample that the functions are found from has so many at one time per frame, and more in proportion where there are
/// more times ([`choose_samples`]).
const FLOATS: usize = 24 << 20;
/// Samples per frame at most, but any sequence may have so many: functions are shared by all Gaussians.
const SAMPLES_PER_FRAME: usize = 8;
const SAMPLES_OF_ANY: usize = 577;
/// The same where so many Gaussians move that their coefficients could exceed [`COEFFICIENTS`].
const SAMPLES_OF_MANY: usize = 257;
/// Most coefficients of [`SAMPLES_OF_ANY`] samples (1 GiB). All coefficients stay in memory until the layer is written, up to one per sample, Gaussian and
/// number of its offsets.
const COEFFICIENTS: usize = 256 << 20;
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
    /// Ends the baking with [`Error::Interrupted`] once it is set.
    pub stop: &'a AtomicBool,
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
    /// Whether motion between samples asks for more of them than a layer of so many frames and Gaussians gets.
    pub samples_limited: bool,
    /// Segments of time.
    pub segments: usize,
    /// The bound that was asked for.
    pub max_error: MaxError,
    /// The heads that the layer changes.
    pub heads: Vec<HeadReport>,
    /// The largest error at a sample over its tolerance, all heads and Gaussians; at most 1 where the bound is kept.
    pub at_samples: f32,
    /// The largest error half way between samples over its tolerance, all heads, of the Gaussians that were measured there.
    pub between_samples: f32,
    /// The 99th percentile over these Gaussians, of the largest error of each.
    pub between_p99: f32,
    /// The share of these Gaussians that are over their tolerance, 0..1.
    pub between_over: f32,
    /// The number of these Gaussians, evenly spread over those that move.
    pub between_measured: usize,
}

impl BakeReport {
    /// By how much the bound is exceeded, and what helps, in a sentence; `None` where it is kept.
    pub fn over_bound(&self) -> Option<String> {
        if self.at_samples.max(self.between_samples) <= KEPT {
            return None;
        }
        let remedy = if self.samples_limited {
            format!("motion is too fast for {} samples, the most that this layer gets, so play the model with its deformer", self.samples)
        } else {
            "state a smaller bound (--max-error, or max_error of the exporter web), or play the model with its deformer".into()
        };
        Some(format!(
            "the worst Gaussian is {:.2} times the bound off at samples and {:.2} times half way between them, where {:.1} % of {} Gaussians are over it: {remedy}",
            self.at_samples,
            self.between_samples,
            100.0 * self.between_over,
            self.between_measured
        ))
    }
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
/// [`Error::Parameter`] for a bound that is not positive; [`Error::Interrupted`] where something moves and `options.stop` is set; [`Error::Limit`] for a layer
/// with larger numbers than its format holds; what the deformer reports.
pub fn bake(model: &Model, options: &BakeOptions, device: &Device, events: &dyn EventSink) -> Result<Option<Baked>> {
    options.max_error.check()?;
    let Some(motion) = Motion::of(model, device, options.stop)? else { return Ok(None) };
    let around;
    let cameras = if options.cameras.is_empty() {
        around = Orbit { frames: 12, ..Orbit::default() }.around(&model.gaussians)?;
        &around
    } else {
        options.cameras
    };
    let tolerances = Tolerances::new(options.max_error, cameras);
    let probe = motion.rows_evenly(SAMPLED_ROWS.min(FLOATS / (motion.width() * model.frame_count.max(2)).max(1)).max(1));
    let (samples, samples_limited) = choose_samples(&motion, &tolerances, &probe, model.frame_count)?;
    let sample = motion.evaluate(&probe, samples, &tolerances)?;
    let ends = segment_ends(&sample, samples, motion.rows.len(), options.stop)?;
    let mut functions: Vec<Vec<HeadFunctions>> = Vec::new();
    for span in ends.windows(2) {
        functions.push(sample.heads.iter().map(|head| HeadFunctions::of(head, span[0]..=span[1], options.stop)).collect::<Result<_>>()?);
    }
    let mut coded: Vec<Vec<rows::TrackBuilder>> = functions.iter().map(|heads| heads.iter().map(rows::TrackBuilder::new).collect()).collect();
    let chunk = rows_at_once(&motion, samples);
    let all: Vec<usize> = (0..motion.rows.len()).collect();
    for (done, part) in all.chunks(chunk).enumerate() {
        let offsets = motion.evaluate(part, samples, &tolerances)?;
        for (builders, (heads, span)) in coded.iter_mut().zip(functions.iter().zip(ends.windows(2))) {
            for ((builder, functions), head) in builders.iter_mut().zip(heads).zip(&offsets.heads) {
                builder.extend(functions, head, span[0], options.stop)?;
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
    let between = Between::measure(&motion, &tolerances, samples, &coded, &functions, &ends)?;
    let at_samples = coded.iter().flatten().map(|t| t.worst()).fold(0.0, f32::max);
    let segments: Vec<(usize, Vec<CodedTrack>)> = coded
        .into_iter()
        .zip(functions.iter().zip(&ends[1..]))
        .map(|(tracks, (heads, &end))| (end, tracks.into_iter().zip(heads).filter_map(|(t, functions)| t.finish(functions)).collect()))
        .collect();
    let streams = PlaybackLayer::encode(&motion.rows, model.gaussians.sh_degree, samples, &segments)?;
    let report = BakeReport {
        moving: motion.rows.len(),
        samples,
        samples_limited,
        segments: segments.len(),
        max_error: options.max_error,
        heads,
        at_samples,
        between_samples: between.largest(),
        between_p99: between.percentile_99(),
        between_over: between.share_over(KEPT),
        between_measured: between.measured(),
    };
    if let Some(message) = report.over_bound() {
        events.emit(&Event::Warning { object: "bake".into(), message });
    }
    Ok(Some(Baked { streams, report }))
}

/// Gaussians whose offsets at `samples` times are held at a time.
fn rows_at_once(motion: &Motion, samples: usize) -> usize {
    (FLOATS / (motion.width() * samples).max(1)).clamp(1, 1 << 14)
}

/// The most samples of a sequence of `frames`, whose moving Gaussians have `numbers` offsets per sample in all.
fn most_samples(frames: usize, numbers: usize) -> usize {
    let of_any = if numbers.saturating_mul(SAMPLES_OF_ANY) <= COEFFICIENTS { SAMPLES_OF_ANY } else { SAMPLES_OF_MANY };
    SAMPLES_PER_FRAME.saturating_mul(frames.max(2)).clamp(of_any, MAX_SAMPLES / 2)
}

/// The number of samples: one per frame, and more where motion between frames is far from straight. Also whether more than the most would be needed.
fn choose_samples(motion: &Motion, tolerances: &Tolerances, probe: &[usize], frames: usize) -> Result<(usize, bool)> {
    let most = most_samples(frames, motion.rows.len() * motion.width());
    let few: Vec<usize> = probe.iter().step_by(probe.len().div_ceil(256)).copied().collect();
    let mut samples = frames.clamp(2, MAX_SAMPLES);
    loop {
        let finer = 2 * samples - 1;
        let error = motion.evaluate(&few, finer, tolerances)?.largest_bend();
        let limited = finer > most;
        if error <= BETWEEN_SHARE || limited {
            return Ok((samples, error > BETWEEN_SHARE));
        }
        samples = finer;
    }
}

/// An [`Error::Interrupted`] once `stop` is set.
fn check_stop(stop: &AtomicBool) -> Result<()> {
    if stop.load(Ordering::Relaxed) { Err(Error::Interrupted("in baking; nothing was written".into())) } else { Ok(()) }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use crate::layer_deformer::of_layer;
    use crate::model::ModelSize;
    use crate::{Moving, RenderConfig, default_rasterizer};
    use cc4dgs_core::archive::Provenance;
    use cc4dgs_core::{DeformerContext, HostGaussians, Seed, Silent, Similarity};

    /// Two Gaussians at `positions` on the x axis at even times, over two frames, joined by lines.
    fn moved(positions: &[[f32; 2]], device: &Device) -> Result<Model> {
        let at = |[a, b]: [f32; 2]| HostGaussians {
            means: vec![a, 0.0, 1.0, b, 0.0, 1.0],
            log_scales: vec![-2.0; 6],
            quaternions: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
            opacity_logits: vec![0.5; 2],
            sh_dc: vec![0.1; 6],
            dynamic_scores: vec![1.0; 2],
            ..Default::default()
        };
        let mut gaussians = at([0.0; 2]);
        let keys: Vec<HostGaussians> = positions.iter().map(|position| at(*position)).collect();
        let layer = keyframes(&gaussians, &[0, 1], &keys)?;
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 2, sh_degree: 0, seed: Seed::root(1) };
        let field = of_layer("t", layer, &mut gaussians, &[0, 1], &context, device)?;
        Ok(Model {
            gaussians,
            field: Some(field),
            moving: Moving::Everything,
            render: RenderConfig::default(),
            background: None,
            rasterizer: default_rasterizer(),
            frame_count: 2,
            normalisation: Similarity::IDENTITY,
            provenance: Provenance::default(),
            size: ModelSize::default(),
        })
    }

    fn baked(model: &Model, stop: bool, device: &Device) -> Result<Option<Baked>> {
        let camera = Camera::look_at("t", (8, 6), 1.0, [0.0, 0.0, -3.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]);
        let options = BakeOptions { max_error: MaxError::Length(0.001), cameras: std::slice::from_ref(&camera), stop: &AtomicBool::new(stop) };
        bake(model, &options, device, &Silent)
    }

    #[test]
    fn errors_between_samples_are_reported() {
        let device = Device::flex();
        let drifting = moved(&[[0.1, -0.1], [0.6, -0.6]], &device).unwrap();
        let report = baked(&drifting, false, &device).unwrap().unwrap().report;
        assert_eq!((report.samples, report.samples_limited, report.between_over, report.between_measured), (2, false, 0.0, 2), "{report:?}");
        assert_eq!(report.over_bound(), None);
        // One Gaussian jumps, the other stays where it is.
        let positions: Vec<[f32; 2]> = (0..61).map(|k| [(k * k * 7 % 13) as f32 / 26.0, 0.0]).collect();
        let report = baked(&moved(&positions, &device).unwrap(), false, &device).unwrap().unwrap().report;
        assert_eq!((report.samples, report.samples_limited, report.between_over, report.between_measured), (513, true, 0.5, 2), "{report:?}");
        assert!(report.at_samples <= KEPT && report.between_samples > 10.0 && report.between_p99 == report.between_samples, "{report:?}");
        let sentence = report.over_bound().unwrap();
        assert!(sentence.contains("half way between them, where 50.0 % of 2 Gaussians are over it") && sentence.contains("513 samples"), "{sentence}");
    }

    #[test]
    fn very_many_gaussians_get_fewer_samples() {
        assert_eq!([most_samples(10, 120_000), most_samples(10, 10_000_000), most_samples(300, 10_000_000)], [577, 257, 2048]);
    }

    #[test]
    fn a_set_flag_interrupts() {
        let device = Device::flex();
        let model = moved(&[[0.1, -0.1], [0.6, -0.6]], &device).unwrap();
        assert_eq!(baked(&model, false, &device).unwrap().unwrap().report.moving, 2);
        let error = baked(&model, true, &device).err().unwrap();
        assert_eq!(error.exit_code(), 130);
        assert_eq!(error.to_string(), "interrupted: in baking; nothing was written");
    }
}
