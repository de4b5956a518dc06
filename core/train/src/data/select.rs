//! Which views of a dataset a scene has: frames, held-out cameras, missing images, the cap on training views.

use super::Trained;
use cc4dgs_core::{CameraRef, Error, ImageSource, RawScene, RawView, Result, SceneOptions, Split, View, plural};

/// How far beyond the first and last time of training a time may be and still count as that time.
const SAME: f64 = 1e-6;

/// Applies the options that choose views to `raw`, sorts its views by frame, then camera, drops cameras that show nothing, and returns the chosen views. Their
/// times are 0 for the first frame and 1 for the last: of the chosen ones, or of those that a model was trained on.
pub(super) fn select(raw: &mut RawScene, options: &SceneOptions, trained: Option<&Trained>) -> Result<Vec<View>> {
    let available = count(&raw.views);
    for view in &mut raw.views {
        view.time.get_or_insert(view.frame as f64 / available.saturating_sub(1).max(1) as f64);
    }
    let trained_on = match trained.map(|t| t.frames).filter(|frames| *frames != options.frames) {
        Some(frames) => {
            let mut views = raw.views.clone();
            keep_frames(&mut views, frames);
            views.retain(|v| absent(v).is_none());
            Some(ends(&views))
        }
        None => None,
    };
    choose_frames(raw, options, available)?;
    drop_missing(raw);
    if let Some(held_out) = &options.test_cameras {
        hold_out(raw, held_out)?;
    }
    raw.views.sort_by_key(|v| (v.frame, v.camera));
    // Before views are left out, so that the times of the others do not depend on how many.
    let (first, last) = trained_on.unwrap_or_else(|| ends(&raw.views));
    cap_training_views(raw, options.max_views);
    drop_unused_cameras(raw);
    let length = if last > first { last - first } else { 1.0 };
    let time_of = |view: &RawView| (time(view) - first) / length;
    // Times that are not finite are refused with the rest of the scene.
    if let Some(view) = raw.views.iter().find(|v| !(-SAME..=1.0 + SAME).contains(&time_of(v))).filter(|_| trained_on.is_some()) {
        let problem = format!("image {} of the chosen ones was taken outside of the time that the model was trained on", view.frame);
        return Err(Error::parameter("scene.frames", problem, "Choose frames between the first and the last one of its training"));
    }
    // Only frames other than those of training are beyond, and by rounding alone.
    let view = |v: &RawView| View { camera: v.camera, frame: v.frame, time_norm: time_of(v).clamp(0.0, 1.0) as f32, split: v.split };
    Ok(raw.views.iter().map(view).collect())
}

/// Frames of `views`.
fn count(views: &[RawView]) -> usize {
    views.iter().map(|v| v.frame + 1).max().unwrap_or(0)
}

/// When an image was taken, on the dataset's own clock.
fn time(view: &RawView) -> f64 {
    view.time.unwrap_or_default()
}

/// The first and the last time of `views`.
fn ends(views: &[RawView]) -> (f64, f64) {
    views.iter().map(time).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), t| (a.min(t), b.max(t)))
}

/// Keeps the views of the frames that are chosen by first frame, number and stride, and numbers these anew.
fn keep_frames(views: &mut Vec<RawView>, frames: Option<[usize; 3]>) {
    let Some([start, count, stride]) = frames else { return };
    views.retain_mut(|v| {
        let Some(offset) = v.frame.checked_sub(start) else { return false };
        let rank = offset / stride;
        v.frame = rank;
        offset % stride == 0 && (count == 0 || rank < count)
    });
}

/// The file of a view that does not exist.
fn absent(view: &RawView) -> Option<&std::path::Path> {
    match &view.image {
        ImageSource::File { path, .. } if !path.is_file() => Some(path),
        _ => None,
    }
}

fn choose_frames(raw: &mut RawScene, options: &SceneOptions, available: usize) -> Result<()> {
    let Some([start, wanted, stride]) = options.frames else { return Ok(()) };
    keep_frames(&mut raw.views, options.frames);
    if raw.views.is_empty() {
        return Err(Error::parameter(
            "scene.frames",
            format!("[{start}, {wanted}, {stride}] selects nothing of {available} frames"),
            "Choose frames that exist",
        ));
    }
    let found = count(&raw.views);
    if wanted > found {
        raw.warnings.push(format!("scene.frames asks for {wanted} frames from {start} on, {found} {}", plural(found, "exists", "exist")));
    }
    Ok(())
}

fn drop_missing(raw: &mut RawScene) {
    let mut missing = Vec::new();
    raw.views.retain(|v| {
        missing.extend(absent(v).map(|path| path.display().to_string()));
        absent(v).is_none()
    });
    if !missing.is_empty() {
        missing.sort();
        let shown = missing.iter().take(3).cloned().collect::<Vec<_>>().join(", ");
        let more = if missing.len() > 3 { ", …" } else { "" };
        let named = plural(missing.len(), "image the dataset names is missing and was", "images the dataset names are missing and were");
        raw.warnings.push(format!("{} {named} skipped: {shown}{more}", missing.len()));
    }
}

fn hold_out(raw: &mut RawScene, held_out: &[CameraRef]) -> Result<()> {
    let mut test = vec![false; raw.cameras.len()];
    for reference in held_out {
        let found: Vec<usize> = match reference {
            CameraRef::Index(i) => (*i < test.len()).then_some(*i).into_iter().collect(),
            CameraRef::Name(name) => (0..test.len()).filter(|&i| raw.cameras[i].name == *name).collect(),
        };
        if found.is_empty() {
            let known = raw.cameras.iter().take(40).map(|c| c.name.as_str()).collect::<Vec<_>>().join(", ");
            let wanted = match reference {
                CameraRef::Index(index) => index.to_string(),
                CameraRef::Name(name) => format!("{name:?}"),
            };
            return Err(Error::parameter(
                "scene.test_cameras",
                format!("there is no camera {wanted}"),
                format!("The scene has {}: {known}", raw.cameras.len()),
            ));
        }
        found.into_iter().for_each(|i| test[i] = true);
    }
    for view in &mut raw.views {
        view.split = if test[view.camera] { Split::Test } else { Split::Train };
    }
    Ok(())
}

fn cap_training_views(raw: &mut RawScene, cap: usize) {
    let train = raw.views.iter().filter(|v| v.split == Split::Train).count();
    if cap == 0 || train <= cap {
        return;
    }
    // Camera by camera, so that each keeps its share: of views by frame, every so many would always be of the same cameras.
    let mut order: Vec<usize> = (0..raw.views.len()).filter(|&v| raw.views[v].split == Split::Train).collect();
    order.sort_by_key(|&v| (raw.views[v].camera, raw.views[v].frame));
    let mut keep = vec![true; raw.views.len()];
    for (k, view) in order.into_iter().enumerate() {
        // The first, and those at which the running share of `cap` passes a whole number: evenly spread.
        keep[view] = k == 0 || (k * cap) / train != ((k - 1) * cap) / train;
    }
    let mut keep = keep.into_iter();
    raw.views.retain(|_| keep.next().unwrap_or(true));
}

fn drop_unused_cameras(raw: &mut RawScene) {
    let mut used = vec![false; raw.cameras.len()];
    raw.views.iter().for_each(|v| used[v.camera] = true);
    let mut new_index = vec![0; used.len()];
    let mut next = 0;
    for (slot, &is_used) in new_index.iter_mut().zip(&used) {
        *slot = next;
        next += usize::from(is_used);
    }
    let mut keep = used.iter();
    raw.cameras.retain(|_| *keep.next().unwrap_or(&false));
    raw.views.iter_mut().for_each(|v| v.camera = new_index[v.camera]);
}
