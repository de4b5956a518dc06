//! Which views of a dataset a scene has: frames, held-out cameras, missing images, the cap on training views.

use cc4dgs_core::playback::frame_time;
use cc4dgs_core::{CameraRef, Error, ImageSource, RawScene, RawView, Result, SceneOptions, Split, View};

/// Applies the options that choose views to `raw`, sorts its views by frame, then camera, drops cameras that show nothing, and returns the chosen views.
pub(super) fn select(raw: &mut RawScene, options: &SceneOptions) -> Result<Vec<View>> {
    choose_frames(raw, options)?;
    drop_missing(raw);
    if let Some(held_out) = &options.test_cameras {
        hold_out(raw, held_out)?;
    }
    raw.views.sort_by_key(|v| (v.frame, v.camera));
    cap_training_views(raw, options.max_views);
    drop_unused_cameras(raw);
    let times = times_norm(&raw.views);
    Ok(raw.views.iter().zip(times).map(|(v, time_norm)| View { camera: v.camera, frame: v.frame, time_norm, split: v.split }).collect())
}

/// Times of views, 0 for the first frame and 1 for the last: those that are stated, or even ones.
fn times_norm(views: &[RawView]) -> Vec<f32> {
    let count = views.iter().map(|v| v.frame + 1).max().unwrap_or(1);
    let times: Vec<f64> = views.iter().map(|v| v.time.unwrap_or_else(|| f64::from(frame_time(v.frame, count)))).collect();
    let (first, last) = times.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &t| (a.min(t), b.max(t)));
    let length = if last > first { last - first } else { 1.0 };
    times.iter().map(|t| ((t - first) / length) as f32).collect()
}

fn choose_frames(raw: &mut RawScene, options: &SceneOptions) -> Result<()> {
    let Some([start, count, stride]) = options.frames else { return Ok(()) };
    let available = raw.views.iter().map(|v| v.frame + 1).max().unwrap_or(0);
    raw.views.retain_mut(|v| {
        let Some(offset) = v.frame.checked_sub(start) else { return false };
        let rank = offset / stride;
        v.frame = rank;
        offset % stride == 0 && (count == 0 || rank < count)
    });
    if raw.views.is_empty() {
        return Err(Error::parameter(
            "scene.frames",
            format!("[{start}, {count}, {stride}] selects nothing of {available} frames"),
            "Choose frames that exist",
        ));
    }
    let found = raw.views.iter().map(|v| v.frame + 1).max().unwrap_or(0);
    if count > found {
        raw.warnings.push(format!("scene.frames asks for {count} frames from {start} on, {found} exist"));
    }
    Ok(())
}

fn drop_missing(raw: &mut RawScene) {
    let mut missing = Vec::new();
    raw.views.retain(|v| match &v.image {
        ImageSource::File { path, .. } if !path.is_file() => {
            missing.push(path.display().to_string());
            false
        }
        _ => true,
    });
    if !missing.is_empty() {
        missing.sort();
        let shown = missing.iter().take(3).cloned().collect::<Vec<_>>().join(", ");
        let more = if missing.len() > 3 { ", …" } else { "" };
        raw.warnings.push(format!("{} images the dataset names are missing and were skipped: {shown}{more}", missing.len()));
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
        // Those at which the running share of `cap` passes a whole number: evenly spread.
        keep[view] = ((k + 1) * cap) / train != (k * cap) / train;
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
