//! Cameras that started at different moments: the frames of each are moved by its offset, stated in the options or found in its videos.

use super::sync::{FEWEST, frame_offsets};
use super::video::motion;
use cc4dgs_core::{Error, ImageSource, Limits, RawScene, Result, SceneOptions, SyncMode, plural};
use std::collections::BTreeMap;
use std::path::Path;

/// The largest offset that is looked for, in seconds.
const MOST_SECONDS: f64 = 5.0;
/// How many frames are compared, from the beginning.
const WINDOW: usize = 900;

/// Undoes the frame offsets of cameras, if any are stated or found, and drops frames outside the range that all cameras cover then.
///
/// The search depends on the dataset alone, not on the frames that the options choose.
///
/// Errors: [`Error::Parameter`] for offsets of cameras that do not exist or cannot be moved, or that leave nothing; those of ffmpeg.
pub(super) fn align(raw: &mut RawScene, options: &SceneOptions, limits: &Limits) -> Result<()> {
    let offsets = match options.sync {
        _ if !options.offsets.is_empty() => stated(raw, options)?,
        SyncMode::Auto => found(raw, options, limits)?,
        SyncMode::Off => return Ok(()),
    };
    if offsets.iter().any(|o| *o != 0) { shift(raw, &offsets) } else { Ok(()) }
}

/// The offsets of the options, per camera.
fn stated(raw: &RawScene, options: &SceneOptions) -> Result<Vec<i64>> {
    let mut offsets = vec![0; raw.cameras.len()];
    for (name, frames) in &options.offsets {
        let mut known = false;
        for (index, _) in raw.cameras.iter().enumerate().filter(|(_, c)| c.name == *name) {
            (offsets[index], known) = (i64::from(*frames), true);
        }
        if !known {
            let names = raw.cameras.iter().take(40).map(|c| c.name.as_str()).collect::<Vec<_>>().join(", ");
            return Err(Error::parameter("scene.offsets", format!("there is no camera {name:?}"), format!("The scene has {}: {names}", raw.cameras.len())));
        }
    }
    Ok(offsets)
}

/// The frames of a camera that is one video.
struct Recording<'a> {
    path: &'a Path,
    /// Frame of the video at each of the first instants.
    frames: Vec<Option<usize>>,
}

/// The recordings of all cameras; `None` for a scene that holds other than videos.
fn recordings(raw: &RawScene) -> Option<BTreeMap<usize, Recording<'_>>> {
    let mut found: BTreeMap<usize, Recording<'_>> = BTreeMap::new();
    for view in &raw.views {
        let ImageSource::Video { path, frame } = &view.image else { return None };
        let recording = found.entry(view.camera).or_insert_with(|| Recording { path, frames: Vec::new() });
        if view.time.is_some() || recording.path != path {
            return None;
        }
        if view.frame < WINDOW {
            recording.frames.resize(recording.frames.len().max(view.frame + 1), None);
            recording.frames[view.frame] = Some(*frame);
        }
    }
    Some(found)
}

/// Offsets of cameras from the motion in their videos; none for scenes that hold other than videos.
fn found(raw: &mut RawScene, options: &SceneOptions, limits: &Limits) -> Result<Vec<i64>> {
    let mut offsets = vec![0; raw.cameras.len()];
    let Some(recordings) = recordings(raw) else { return Ok(offsets) };
    if recordings.len() < 2 || recordings.values().any(|r| r.frames.len() <= FEWEST) {
        return Ok(offsets);
    }
    let motions = recordings.values().map(|r| motion(r.path, &r.frames, options, limits)).collect::<Result<Vec<_>>>()?;
    let rate = motions.iter().map(|m| m.rate).fold(0.0, f64::max);
    let energies: Vec<Vec<f32>> = motions.into_iter().map(|m| m.energy).collect();
    let mut warnings = Vec::new();
    for (camera, offset) in recordings.keys().zip(frame_offsets(&energies, (MOST_SECONDS * rate) as usize)) {
        if let Some(offset) = offset.filter(|o| o.frames != 0) {
            offsets[*camera] = offset.frames;
            warnings.push(format!(
                "camera {}: its frame k{:+} shows what the other cameras show at frame k (correlation {:.2}); this was undone (scene.sync = \"off\" keeps it)",
                raw.cameras[*camera].name, offset.frames, offset.confidence
            ));
        }
    }
    raw.warnings.extend(warnings);
    Ok(offsets)
}

/// Makes frame k + offset of each camera its frame k, and keeps the frames that all cameras cover, counted from 0.
fn shift(raw: &mut RawScene, offsets: &[i64]) -> Result<()> {
    let mut ranges: BTreeMap<usize, [i64; 2]> = BTreeMap::new();
    for view in &raw.views {
        if view.time.is_some() {
            let camera = &raw.cameras[view.camera].name;
            return Err(Error::parameter(
                "scene.offsets",
                format!("the images of camera {camera} have times of their own"),
                "Correct the times in the dataset",
            ));
        }
        let frame = (view.frame as i64).saturating_sub(offsets[view.camera]);
        let range = ranges.entry(view.camera).or_insert([frame; 2]);
        *range = [range[0].min(frame), range[1].max(frame)];
    }
    let low = ranges.values().map(|r| r[0]).max().unwrap_or(0);
    let high = ranges.values().map(|r| r[1]).min().unwrap_or(0);
    if low > high {
        return Err(Error::parameter("scene.offsets", "they leave no frame that all cameras have", "Write smaller offsets, for cameras with several frames"));
    }
    let before = raw.views.len();
    raw.views.retain_mut(|view| {
        let frame = (view.frame as i64).saturating_sub(offsets[view.camera]);
        view.frame = frame.saturating_sub(low).max(0) as usize;
        (low..=high).contains(&frame)
    });
    let (common, dropped) = (high.saturating_sub(low).saturating_add(1), before - raw.views.len());
    let [are, were] = [plural(common, "frame is", "frames are"), plural(dropped, "image was", "images were")];
    raw.warnings.push(format!("{common} {are} common to all cameras after their offsets; {dropped} {were} dropped"));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Distortion, RawCamera, RawView, Split};

    /// Three cameras with ten frames each.
    fn scene() -> RawScene {
        let camera = |name: &str| RawCamera {
            name: name.into(),
            size: [8, 8],
            focal: [8.0; 2],
            principal: [4.0; 2],
            distortion: Distortion::None,
            world_to_camera: std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j)))),
        };
        let view = |camera, frame: usize| {
            let image = ImageSource::file(format!("{frame}.png"));
            RawView { camera, frame, time: None, split: Split::Train, image }
        };
        RawScene { cameras: ["a", "b", "c"].map(camera).to_vec(), views: (0..3).flat_map(|c| (0..10).map(move |f| view(c, f))).collect(), ..Default::default() }
    }

    fn aligned(offsets: &[(&str, i32)]) -> Result<RawScene> {
        let options = SceneOptions { offsets: offsets.iter().map(|(n, o)| (n.to_string(), *o)).collect(), ..Default::default() };
        let mut raw = scene();
        align(&mut raw, &options, &Limits::default()).map(|()| raw)
    }

    #[test]
    fn stated_offsets_move_frames() {
        let raw = aligned(&[("b", 3), ("c", -2)]).unwrap();
        let file = |camera: usize, frame: usize| {
            let view = raw.views.iter().find(|v| v.camera == camera && v.frame == frame)?;
            let ImageSource::File { path, .. } = &view.image else { return None };
            Some(path.display().to_string())
        };
        // b covers -3..=6 of the others' frames, c covers 2..=11, a 0..=9: 2..=6 are common.
        let files = |frame: usize| [0, 1, 2].map(|c| file(c, frame));
        assert_eq!(files(0), ["2.png", "5.png", "0.png"].map(|f| Some(f.to_string())));
        assert_eq!(files(4), ["6.png", "9.png", "4.png"].map(|f| Some(f.to_string())));
        assert_eq!(files(5), [None, None, None]);
        assert!(raw.warnings[0].contains("5 frames") && raw.warnings[0].contains("15 images"), "{:?}", raw.warnings);
        assert!(aligned(&[]).unwrap().warnings.is_empty());
    }

    #[test]
    fn offsets_that_make_no_sense_are_refused() {
        let message = aligned(&[("d", 3)]).unwrap_err().to_string();
        assert!(message.contains("\"d\"") && message.contains("a, b, c"), "{message}");
        assert!(aligned(&[("a", 10)]).unwrap_err().to_string().contains("no frame"));
        assert!(aligned(&[("a", i32::MIN), ("b", i32::MAX)]).is_err());
        let mut raw = scene();
        raw.views[3].time = Some(0.5);
        let options = SceneOptions { offsets: [("a".to_string(), 1)].into(), ..Default::default() };
        assert!(align(&mut raw, &options, &Limits::default()).unwrap_err().to_string().contains("times of their own"));
    }
}
