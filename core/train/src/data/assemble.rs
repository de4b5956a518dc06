//! From what a reader hands over to a [`Scene`]: the steps all scenes share.

use super::Trained;
use super::align::align;
use super::camera_box::camera_box;
use super::frames::{Job, Plan, SceneFrames};
use super::instants::join_instants;
use super::normalise::{CAMERA_DISTANCE, normalisation};
use super::select::select;
use super::undistort::Undistort;
use super::video::VideoFrames;
use cc4dgs_core::reader::files::image_size;
use cc4dgs_core::{
    Camera, Error, FrameSource, ImageSource, InitBox, Limits, PointCloud, RawCamera, RawPoints, RawScene, Result, Scene, SceneOptions, Similarity, Split,
    plural,
};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Positions over this many units of the normalised frame are useless.
const FARTHEST: f64 = 1e9;

/// Size per axis of stored frames of a video whose lens has to be undone, over their final one.
const LENS_SHARE: f64 = 1.5;

/// Width and height in pixels of images, and of the larger ones that the options ask for.
type Smaller = [(u32, u32); 2];

/// The scene a reader parsed, with frames and cameras chosen, lenses undone and images brought to the size the options ask for, if it is not larger.
///
/// The scene is in the normalised frame of its cameras and on a clock of its own, or in those of a model.
///
/// Errors: [`Error::Parameter`] for options that choose nothing, [`Error::Data`] for a scene that is not sound, [`Error::Limit`] for images over `limits`.
pub fn assemble(mut raw: RawScene, options: &SceneOptions, trained: Option<&Trained>, limits: &Limits) -> Result<Scene> {
    if let Some(v) = raw.views.iter().find(|v| v.camera >= raw.cameras.len()) {
        return Err(Error::data(raw.name, format!("an image names camera {} of {}", v.camera, raw.cameras.len()), "Check the dataset's index files"));
    }
    // Before views are chosen: the frame must not depend on the options.
    let frame = trained.map_or_else(|| normalisation(&raw), |t| t.normalisation);
    align(&mut raw, options, limits)?;
    join_instants(&mut raw.views, &mut raw.warnings);
    let views = select(&mut raw, options, trained)?;
    if !views.iter().any(|v| v.split == Split::Train) {
        let hint = raw.warnings.last().cloned().unwrap_or_default();
        return Err(Error::data(raw.name, format!("there is no training image. {hint}"), "Check the path, scene.frames and scene.test_cameras"));
    }
    raw.validate()?;
    let mut plans = Vec::with_capacity(raw.cameras.len());
    let mut cameras = Vec::with_capacity(raw.cameras.len());
    let mut smaller = Vec::new();
    let mut first_images: Vec<Option<&ImageSource>> = vec![None; raw.cameras.len()];
    raw.views.iter().rev().for_each(|view| first_images[view.camera] = Some(&view.image));
    for (camera, image) in raw.cameras.iter_mut().zip(first_images) {
        let native = match image {
            Some(ImageSource::File { path, .. }) => fit_to_image(camera, image_size(path, limits)?, &mut raw.warnings)?,
            _ => camera.size,
        };
        let is_video = matches!(image, Some(ImageSource::Video { .. }));
        let (plan, pinhole, is_smaller) = plan_camera(camera, native, is_video, (!raw.resized).then_some(options), limits)?;
        smaller.extend(is_smaller);
        plans.push(plan);
        cameras.push(frame.apply_camera(&pinhole));
    }
    if let Some([(w, h), (width, height)]) = smaller.first() {
        raw.warnings.push(format!(
            "the images of {} of {} {} are smaller than scene.width, scene.height or scene.downscale ask for and are not enlarged ({w}x{h}, where \
             {width}x{height} is asked for)",
            smaller.len(),
            plans.len(),
            plural(plans.len(), "camera", "cameras")
        ));
    }
    let videos = VideoFrames::new(&raw.views, &plans, options, limits)?;
    let jobs = raw.views.iter().map(|v| Job { image: Some(v.image.clone()), plan: v.camera }).collect();
    let mask = |image: &ImageSource| match image {
        ImageSource::File { mask: Some(path), .. } if path.is_file() => Some(ImageSource::file(path)),
        _ => None,
    };
    let masks: Vec<Job> = raw.views.iter().map(|v| Job { image: mask(&v.image), plan: v.camera }).collect();
    let has_masks = masks.iter().any(|j| j.image.is_some());
    let source = SceneFrames { jobs, plans: plans.clone(), videos, limits: *limits, scale: frame.scale };
    let mut scene = Scene::new(raw.name, cameras, views, Arc::new(source), options.cache_mb.saturating_mul(1_000_000))?;
    if has_masks {
        let source: Arc<dyn FrameSource> = Arc::new(SceneFrames { jobs: masks, plans, videos: VideoFrames::default(), limits: *limits, scale: frame.scale });
        scene.foreground_masks = Some(source);
    }
    let single = |p: [f64; 3]| p.map(|v| v as f32);
    scene.normalisation = frame;
    scene.points = raw.points.map(|p| normalised_points(&p, &frame, &mut raw.warnings)).filter(|p| !p.positions.is_empty());
    let init_box = raw.init_box.map(|found| match found {
        InitBox::Corners { low, high } => (single(frame.apply(low)), single(frame.apply(high))),
        InitBox::Cube { half_share } => (single([-half_share * CAMERA_DISTANCE; 3]), single([half_share * CAMERA_DISTANCE; 3])),
    });
    let usable = |b: &([f32; 3], [f32; 3])| (0..3).all(|k| b.0[k] < b.1[k] && b.0[k].is_finite() && b.1[k].is_finite());
    scene.init_box = init_box.filter(usable).or_else(|| scene.points.is_none().then(|| camera_box(&scene)));
    scene.background = options.background.as_ref().map(|b| b.rgb()).transpose()?.or(raw.background);
    scene.warnings = dedupe(raw.warnings);
    Ok(scene)
}

/// The points in the normalised frame. Points so far away that squares of their distances leave float32 are left out.
fn normalised_points(points: &RawPoints, frame: &Similarity, warnings: &mut Vec<String>) -> PointCloud {
    let mut cloud = PointCloud::default();
    for (position, color) in points.positions.iter().zip(&points.colors) {
        let position = frame.apply(*position);
        if position.iter().all(|v| v.abs() < FARTHEST) {
            cloud.positions.push(position.map(|v| v as f32));
            cloud.colors.push(*color);
        }
    }
    let left_out = points.positions.len() - cloud.positions.len();
    if left_out > 0 {
        let [are, were] = [plural(left_out, "point is", "points are"), plural(left_out, "was", "were")];
        warnings.push(format!("{left_out} {are} over {FARTHEST:e} units of the normalised frame away and {were} left out"));
    }
    cloud
}

/// Brings the calibration to the size the images really have, if only the scale differs.
pub(super) fn fit_to_image(camera: &mut RawCamera, found: (u32, u32), warnings: &mut Vec<String>) -> Result<[u32; 2]> {
    let [w, h] = camera.size.map(f64::from);
    let (sx, sy) = (f64::from(found.0) / w, f64::from(found.1) / h);
    if camera.size == [found.0, found.1] {
        return Ok(camera.size);
    }
    if !sx.is_finite() || !sy.is_finite() || (sx / sy - 1.0).abs() > 0.01 {
        let is_turned = (f64::from(found.0) / h / (f64::from(found.1) / w) - 1.0).abs() < 0.01;
        let remedy = match is_turned {
            true => "The sides are swapped: if the photo has an EXIF rotation, which readers ignore, write it into the pixels (mogrify -auto-orient FILES)",
            false => "Use the images the calibration was made for",
        };
        let problem = format!("calibrated for {w}x{h} pixels, its image has {}x{}", found.0, found.1);
        return Err(Error::data(format!("camera {}", camera.name), problem, remedy));
    }
    warnings.push(format!("the images are {}x{}, the calibration is for {w}x{h}; it was scaled", found.0, found.1));
    camera.focal = [camera.focal[0] * sx, camera.focal[1] * sy];
    camera.principal = [camera.principal[0] * sx, camera.principal[1] * sy];
    camera.size = [found.0, found.1];
    Ok(camera.size)
}

/// What happens to the images of a camera, the pinhole camera they have then, and their size where a larger one is asked for. Without options they keep it.
fn plan_camera(
    camera: &RawCamera,
    native: [u32; 2],
    is_video: bool,
    options: Option<&SceneOptions>,
    limits: &Limits,
) -> Result<(Plan, Camera, Option<Smaller>)> {
    let object = format!("camera {}", camera.name);
    let (undistort, pinhole) = without_lens(&object, camera, native)?;
    let size = (pinhole.width, pinhole.height);
    let (asked, output) = options.map_or((size, size), |o| (o.target_size(size), o.image_size(size)));
    let smaller = (asked.0 > size.0 || asked.1 > size.1).then_some([size, asked]);
    limits.check_pixels(&object, u64::from(output.0), u64::from(output.1))?;
    let plan = Plan { native, undistort, output };
    let share = LENS_SHARE * f64::max(f64::from(output.0) / f64::from(size.0), f64::from(output.1) / f64::from(size.1));
    if !is_video || plan.undistort.is_none() || share >= 1.0 {
        return Ok((plan, pinhole.resized(output.0, output.1), smaller));
    }
    // Every frame is stored before its lens is undone, so it should not be larger than needed.
    let small = native.map(|n| (f64::from(n) * share).ceil() as u32);
    let scaled = |values: [f64; 2]| [0, 1].map(|axis| values[axis] * f64::from(small[axis]) / f64::from(native[axis]));
    let camera = RawCamera { size: small, focal: scaled(camera.focal), principal: scaled(camera.principal), ..camera.clone() };
    let (undistort, pinhole) = without_lens(&object, &camera, small)?;
    Ok((Plan { native: small, undistort, output }, pinhole.resized(output.0, output.1), smaller))
}

/// How the lens of a camera whose images have `native` pixels is undone, if it has one, and the pinhole camera that is left.
fn without_lens(object: &str, camera: &RawCamera, native: [u32; 2]) -> Result<(Option<Undistort>, Camera)> {
    let mut pinhole = Camera { width: native[0], height: native[1], ..camera.pinhole() };
    pinhole.validate()?;
    if camera.distortion.is_identity() {
        return Ok((None, pinhole));
    }
    let plan = Undistort::plan(object, &camera.distortion, native, camera.focal, camera.principal)?;
    [pinhole.width, pinhole.height] = plan.size;
    [pinhole.cx, pinhole.cy] = plan.principal_point();
    Ok((Some(plan), pinhole))
}

/// Each distinct warning once, with how often it came.
fn dedupe(warnings: Vec<String>) -> Vec<String> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for w in warnings {
        *counts.entry(w).or_default() += 1;
    }
    counts.into_iter().map(|(w, n)| if n > 1 { format!("{w} ({n} times)") } else { w }).collect()
}
