//! Evaluation by the protocol of published tables: 8-bit images, metrics per image, then their means.

use crate::blocks::{BlockScore, UsualImage};
use crate::config::TrainConfig;
use crate::masks::{PUBLISHED_SIGMA, dynamic_masks};
use crate::sample::spread_views;
use burn::tensor::Device;
use cc4dgs_core::metrics::{FLIP_PIXELS_PER_DEGREE, FrameSet, Metric, Rounding, SsimConvention, installed_lpips};
use cc4dgs_core::{Error, Event, EventSink, Image8, Registry, Result, Scene, Split};
use cc4dgs_play::model::ModelSize;
use cc4dgs_play::player::{FrameTime, PlayWork};
use cc4dgs_play::{Model, Player};
use serde::Serialize;
use std::collections::BTreeMap;

/// Why LPIPS is absent where it is not computed on purpose.
const NOT_ASKED: &str = "LPIPS and FLIP are not measured: cc4dgs eval --perceptual and sweeps compute them";

/// Sizes in MB = 10^6 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SizeMb {
    /// Everything.
    pub total: f64,
    /// The field.
    pub deform: f64,
    /// The Gaussians.
    pub point_cloud: f64,
    /// Float32 size of the field's spatial encoding.
    pub deform_grid_f32: f64,
    /// Float32 size of the rest of the field.
    pub deform_net_f32: f64,
}

impl From<ModelSize> for SizeMb {
    fn from(s: ModelSize) -> Self {
        let mb = |bytes: u64| bytes as f64 / 1e6;
        Self { total: mb(s.total), deform: mb(s.deform), point_cloud: mb(s.point_cloud), deform_grid_f32: mb(s.deform_grid), deform_net_f32: mb(s.deform_net) }
    }
}

/// Milliseconds per frame: the first frame (t = 0, spatial features computed) apart from the others.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct FrameMs {
    /// Mean of a whole frame at t > 0.
    pub mean: f64,
    /// The field in the first frame.
    pub field_first: f64,
    /// The rasterizer in the first frame.
    pub raster_first: f64,
    /// The field, median of the other frames.
    pub field: f64,
    /// The rasterizer, median of the other frames.
    pub raster: f64,
}

/// One image's numbers.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ImageScore {
    /// Index of the view in the scene.
    pub view: usize,
    /// The camera's name.
    pub camera: String,
    /// Frame index.
    pub frame: usize,
    /// Peak signal-to-noise ratio, 8-bit images, all pixels and channels.
    pub psnr_db: f64,
    /// The same over the pixels that see something move ([`EvalReport::psnr_dynamic_db`]); absent where there is no such pixel.
    pub psnr_dynamic_db: Option<f64>,
    /// Structural similarity, Inria's convention.
    pub ssim: f64,
    /// The same over windows centred on pixels that see something move.
    pub ssim_dynamic: Option<f64>,
    /// Learned perceptual distance; absent where [`EvalReport::lpips_absent`] says why.
    pub lpips: Option<f64>,
    /// Visible difference on flipping between the images; absent where it was not asked for.
    pub flip: Option<f64>,
    /// Blocks in which something moves; absent where the camera has few frames or nothing moves in this one.
    pub blocks: Option<BlockScore>,
    /// Milliseconds.
    pub field_ms: f64,
    /// Milliseconds.
    pub raster_ms: f64,
}

/// The whole evaluation.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EvalReport {
    /// Scene name.
    pub scene: String,
    /// Which views.
    pub split: Split,
    /// Mean over images.
    pub psnr_db: f64,
    /// Mean over the images that have it, of the pixels that see something move. For a camera with two frames or more on this side of the split, scored or not,
    /// these are the pixels whose temporal deviation is over the training threshold (Swift4D's masks), the same in all frames. For other cameras they are the
    /// pixels of the image that show a moving object, where the dataset knows them ([`Scene::motion_mask`]: built-in scenes).
    pub psnr_dynamic_db: Option<f64>,
    /// Mean over images, Inria's convention.
    pub ssim: f64,
    /// Mean over the images that have it, of the windows centred on pixels that see something move.
    pub ssim_dynamic: Option<f64>,
    /// PSNR of the worst moving block of an image, mean over the images that have one (`cc4dgs_train::blocks`).
    pub psnr_worst_block_db: Option<f64>,
    /// Share of all moving blocks whose render is nearer to what the camera usually sees than to the truth: what moves is missing there.
    pub lost_blocks: Option<f64>,
    /// Mean over images, skimage's Gaussian convention.
    pub ssim_skimage: f64,
    /// Mean over images; absent where an image is too small for five scales.
    pub ms_ssim: Option<f64>,
    /// Learned perceptual distance (AlexNet, v0.1; lower is better), mean over images.
    pub lpips: Option<f64>,
    /// Why `lpips` is absent: not asked for, no weights, or images that are too small.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_absent: Option<String>,
    /// Visible difference on flipping between the images (lower is better), mean over images; absent where it was not asked for.
    pub flip: Option<f64>,
    /// Sizes.
    pub size_mb: SizeMb,
    /// Times.
    pub frame_ms: FrameMs,
    /// Gaussians.
    pub gaussians: usize,
    /// Of which the field moves.
    pub dynamic_gaussians: usize,
    /// Work counted over all frames.
    pub work: PlayWork,
    /// What the numbers mean.
    pub protocol: &'static str,
    /// The protocol of each mean by its key.
    pub metrics: BTreeMap<&'static str, Metric>,
    /// Per image.
    pub images: Vec<ImageScore>,
}

/// Which images [`evaluate`] scores, and by what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Scored {
    /// The side of the split.
    pub split: Split,
    /// At most so many views, spread over cameras and frames; 0 is all.
    pub max_views: usize,
    /// Whether LPIPS and FLIP are computed too. They cost more than drawing the image: about 0.2 s for 400x400 pixels, 0.9 s for 800x800, on one core.
    pub perceptual: bool,
}

impl Scored {
    /// All views of a side of the split, by PSNR and structural similarity.
    pub fn all(split: Split) -> Self {
        Self { split, max_views: 0, perceptual: false }
    }
    /// The views of `scene` that are scored, in the order in which they are.
    pub fn views(&self, scene: &Scene) -> Vec<usize> {
        let all = scene.split(self.split);
        if self.max_views == 0 { all } else { spread_views(scene, &all, self.max_views) }
    }
    /// Refuses a scene without views of the split. Call it before anything is replaced.
    ///
    /// # Errors
    /// [`Error::Parameter`].
    pub fn check(&self, scene: &Scene) -> Result<()> {
        if !scene.split(self.split).is_empty() {
            return Ok(());
        }
        let problem = format!("{} has no view of split {:?}", scene.name, self.split);
        let remedy = "Evaluate another split; there are validation views where the dataset has some, or the model was trained with train.validation";
        Err(Error::parameter("--split", problem, remedy))
    }
}

/// What [`evaluate`] hands to `on_image`: the view, the truth, the render, and their score.
pub type OnImage<'a> = dyn FnMut(usize, &Image8, &Image8, &ImageScore) -> Result<()> + 'a;

/// Renders the views that `scored` names and scores them. A model without a background of its own is drawn on the
/// scene's. Training views of a model whose training corrected their poses are drawn at those of the scene, with a warning.
///
/// # Errors
/// [`Error::Parameter`] for a split without views, and what scene, field, rasterizer and `on_image` report.
pub fn evaluate(
    model: &Model,
    scene: &Scene,
    scored: Scored,
    registry: &Registry,
    device: &Device,
    events: &dyn EventSink,
    on_image: &mut OnImage,
) -> Result<EvalReport> {
    let Scored { split, perceptual, .. } = scored;
    scored.check(scene)?;
    if split == Split::Train
        && let Some(kind) = model.provenance.config.get("poses").and_then(|poses| poses.get("kind")?.as_str()).filter(|kind| *kind != "none")
    {
        let message = format!(
            "trained with corrected poses of its cameras (poses.kind = \"{kind}\"), which models do not keep: training views are scored at the poses of the dataset"
        );
        events.emit(&Event::Warning { object: "model".into(), message });
    }
    let (views, in_split) = (scored.views(scene), scene.split(split).len());
    let background = model.background_on(scene.background);
    let mut player = Player::new(model, registry, device)?.on(scene.background);
    let mut images = Vec::with_capacity(views.len());
    let mut times: Vec<FrameTime> = Vec::with_capacity(views.len());
    let (mut skimage, mut ms_ssim) = (0.0, Some(0.0));
    // Datasets have images of one kind.
    let transparent = scene.frame(views[0])?.channels == 4;
    let frames = FrameSet { split, count: views.len(), of: in_split, background: transparent.then_some(background) };
    let metric = |m: Metric| m.over(frames.clone());
    let psnr_metric = metric(Metric::psnr(Rounding::EightBit));
    let dynamic_metric = metric(Metric::psnr(Rounding::EightBit).masked());
    let over_time: BTreeMap<usize, Vec<bool>> = dynamic_masks(scene, split, TrainConfig::default().mask_threshold, PUBLISHED_SIGMA, background, events)?
        .into_iter()
        .map(|m| (scene.views[m.view].camera, m.mask))
        .collect();
    let usual = usual_images(scene, split, background)?;
    let ssim_metric = metric(Metric::ssim(SsimConvention::Inria, Rounding::EightBit));
    let ssim_dynamic_metric = metric(Metric::ssim(SsimConvention::Inria, Rounding::EightBit).masked());
    let skimage_metric = metric(Metric::ssim(SsimConvention::Skimage, Rounding::EightBit));
    let ms_ssim_metric = metric(Metric::ms_ssim(Rounding::EightBit));
    let flip_metric = perceptual.then(|| metric(Metric::flip(FLIP_PIXELS_PER_DEGREE, Rounding::EightBit)));
    let mut lpips_metric = match perceptual {
        true => installed_lpips().map(|found| metric(Metric::lpips(found.network.clone(), Rounding::EightBit))).map_err(str::to_string),
        false => Err(NOT_ASKED.to_string()),
    };
    for (done, &view) in views.iter().enumerate() {
        let camera = scene.camera(view);
        let (output, time) = player.render(camera, scene.views[view].time_norm)?;
        let render = player.download(output.planes)?;
        let frame = scene.frame(view)?;
        // Both images are rounded to 8 bits before they are compared.
        let truth = Image8::from_planes(&frame.to_planes(background), camera.width, camera.height);
        skimage += skimage_metric.score_images(&truth, &render)?;
        let multi_scale = ms_ssim_metric.score_images(&truth, &render).ok();
        ms_ssim = ms_ssim.zip(multi_scale).map(|(sum, value)| sum + value);
        let lpips = match lpips_metric.as_ref().map(|metric| metric.score_images(&truth, &render)) {
            Ok(Ok(value)) => Some(value),
            // Cameras may differ in size. A mean over some of them would be compared with means over all.
            Ok(Err(e)) => {
                lpips_metric = Err(e.to_string());
                None
            }
            Err(_) => None,
        };
        let known = if over_time.contains_key(&scene.views[view].camera) { None } else { scene.motion_mask(view)? };
        let mask = over_time.get(&scene.views[view].camera).or(known.as_ref()).filter(|mask| mask.contains(&true));
        let shape = [3, camera.height as usize, camera.width as usize];
        let planes = mask.map(|mask| ([&truth, &render].map(|image| image.to_planes(background)), mask));
        let masked = |metric: &Metric| planes.as_ref().map(|([a, b], mask)| metric.score(a, b, shape, Some(mask))).transpose();
        let (psnr_dynamic_db, ssim_dynamic) = (masked(&dynamic_metric)?, masked(&ssim_dynamic_metric)?);
        let score = ImageScore {
            view,
            camera: camera.name.clone(),
            frame: scene.views[view].frame,
            psnr_db: psnr_metric.score_images(&truth, &render)?,
            psnr_dynamic_db,
            ssim: ssim_metric.score_images(&truth, &render)?,
            ssim_dynamic,
            lpips,
            flip: flip_metric.as_ref().map(|metric| metric.score_images(&truth, &render)).transpose()?,
            blocks: usual.get(&scene.views[view].camera).and_then(|usual| usual.score(&truth, &render)),
            field_ms: time.field_ms,
            raster_ms: time.raster_ms,
        };
        on_image(view, &truth, &render, &score)?;
        images.push(score);
        times.push(time);
        events.emit(&Event::Progress { task: "evaluate".into(), done: done as u64 + 1, total: views.len() as u64 });
    }
    let mut metrics = BTreeMap::from([
        ("psnr_db", psnr_metric),
        ("psnr_dynamic_db", dynamic_metric),
        ("ssim", ssim_metric),
        ("ssim_dynamic", ssim_dynamic_metric),
        ("ssim_skimage", skimage_metric),
        ("ms_ssim", ms_ssim_metric),
    ]);
    metrics.extend(flip_metric.map(|metric| ("flip", metric)));
    let lpips_absent = lpips_metric.map(|metric| metrics.insert("lpips", metric)).err();
    let n = images.len() as f64;
    let steady = if times.len() > 1 { &times[1..] } else { &times[..] };
    let frame_ms = FrameMs {
        mean: steady.iter().map(|t| t.field_ms + t.raster_ms).sum::<f64>() / steady.len() as f64,
        field_first: times[0].field_ms,
        raster_first: times[0].raster_ms,
        field: median(steady.iter().map(|t| t.field_ms)),
        raster: median(steady.iter().map(|t| t.raster_ms)),
    };
    Ok(EvalReport {
        scene: scene.name.clone(),
        split,
        psnr_db: images.iter().map(|i| i.psnr_db).sum::<f64>() / n,
        psnr_dynamic_db: mean(images.iter().filter_map(|i| i.psnr_dynamic_db)),
        ssim: images.iter().map(|i| i.ssim).sum::<f64>() / n,
        ssim_dynamic: mean(images.iter().filter_map(|i| i.ssim_dynamic)),
        psnr_worst_block_db: mean(images.iter().filter_map(|i| i.blocks).map(|b| b.worst_psnr_db)),
        lost_blocks: lost_share(&images),
        ssim_skimage: skimage / n,
        ms_ssim: ms_ssim.map(|s| s / n),
        lpips: if lpips_absent.is_none() { mean(images.iter().filter_map(|i| i.lpips)) } else { None },
        lpips_absent,
        flip: if perceptual { mean(images.iter().filter_map(|i| i.flip)) } else { None },
        size_mb: model.size.into(),
        frame_ms,
        gaussians: model.gaussians.len(),
        dynamic_gaussians: player.moving(),
        work: player.work,
        protocol: "8-bit RGB images, range 255; PSNR over all pixels and channels; SSIM 11x11 Gaussian sigma 1.5, zero padding (Inria); LPIPS v0.1 on AlexNet; FLIP at 67 pixels per degree; means over images; times on the stated device, synchronised, first frame apart",
        metrics,
        images,
    })
}

/// What every camera of `split` with enough frames usually sees.
fn usual_images(scene: &Scene, split: Split, background: [f32; 3]) -> Result<BTreeMap<usize, UsualImage>> {
    let mut of_camera: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    scene.split(split).into_iter().for_each(|view| of_camera.entry(scene.views[view].camera).or_default().push(view));
    let usual = of_camera.into_iter().map(|(camera, views)| Ok(UsualImage::of(scene, &views, background)?.map(|usual| (camera, usual))));
    Ok(usual.collect::<Result<Vec<_>>>()?.into_iter().flatten().collect())
}

/// The share of moving blocks that are lost.
fn lost_share(images: &[ImageScore]) -> Option<f64> {
    let (moving, lost) = images.iter().filter_map(|image| image.blocks).fold((0, 0), |(m, l), b| (m + b.moving, l + b.lost));
    (moving > 0).then(|| lost as f64 / moving as f64)
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0u64), |(sum, count), v| (sum + v, count + 1));
    (count > 0).then(|| sum / count as f64)
}

/// The middle one of `values`, or the mean of the two in the middle; 0 of none.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    let (last, at) = (values.len().saturating_sub(1), |index: usize| values.get(index).copied().unwrap_or(0.0));
    0.5 * (at(last / 2) + at(last.div_ceil(2)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_lie_in_the_middle() {
        let of = |values: &[f64]| median(values.iter().copied());
        assert_eq!([of(&[]), of(&[7.0]), of(&[4.0, 1.0]), of(&[9.0, 1.0, 2.0]), of(&[8.0, 1.0, 2.0, 4.0])], [0.0, 7.0, 2.5, 2.0, 3.0]);
    }
}
