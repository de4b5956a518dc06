//! Validation views: training views that are kept out of training, so that settings can be chosen without looking at test views.

use crate::sample::spread;
use cc4dgs_core::{Error, Result, Scene, Split};
use std::collections::BTreeMap;

/// Of so many training cameras with several frames, one is kept out.
const CAMERAS_PER_VALIDATION: usize = 12;
/// Fewest such cameras of which one is kept out; below, single images are.
const LEAST_CAMERAS: usize = 4;

/// `scene` with validation views among its training views; where a reader already named some, they stay the only ones. A function of the scene and `count`
/// alone.
///
/// Where training cameras have several frames, whole cameras are kept out, evenly spread: a camera whose other frames are trained on says nothing of new
/// viewpoints. Else `count` single images are, evenly spread over the cameras and the frames of each. With a `count` of 0 nothing changes.
///
/// # Errors
/// [`Error::Parameter`] where fewer than two training views would be left.
pub fn hold_out(scene: &Scene, count: usize) -> Result<Scene> {
    let mut rest = scene.clone();
    if count == 0 || scene.views.iter().any(|view| view.split == Split::Validation) {
        return Ok(rest);
    }
    let mut train = scene.split(Split::Train);
    if count.saturating_add(2) > train.len() {
        return Err(Error::parameter(
            "train.validation",
            format!("{count} of {} training views cannot be spared", train.len()),
            format!("Choose at most {}", train.len().saturating_sub(2)),
        ));
    }
    let mut of_camera: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    train.iter().for_each(|&view| of_camera.entry(scene.views[view].camera).or_default().push(view));
    let filming: Vec<usize> = of_camera.iter().filter(|(_, views)| views.len() > 1).map(|(&camera, _)| camera).collect();
    let views: Vec<usize> = if filming.len() >= LEAST_CAMERAS {
        let kept_out = spread(&filming, filming.len().div_ceil(CAMERAS_PER_VALIDATION));
        kept_out.iter().flat_map(|camera| of_camera[camera].iter().copied()).collect()
    } else {
        if !filming.is_empty() {
            // Frame by frame, every n-th view may be of one camera.
            train.sort_by_key(|&view| (scene.views[view].camera, scene.views[view].frame));
        }
        spread(&train, count)
    };
    for view in views {
        rest.views[view].split = Split::Validation;
    }
    Ok(rest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Camera, NoImages, View};
    use std::sync::Arc;

    fn scene(cameras: usize, frames: usize) -> Scene {
        let camera = |k: usize| Camera::look_at(&format!("c{k}"), (8, 8), 1.0, [k as f64, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let views = (0..frames).flat_map(|frame| (0..cameras).map(move |camera| View { camera, frame, time_norm: 0.0, split: Split::Train })).collect();
        Scene::new("s", (0..cameras).map(camera).collect(), views, Arc::new(NoImages), 0).unwrap()
    }

    #[test]
    fn cameras_that_film_are_kept_out_whole() {
        let rest = hold_out(&scene(13, 5), 4).unwrap();
        let kept_out = rest.split(Split::Validation);
        let cameras: std::collections::BTreeSet<usize> = kept_out.iter().map(|&v| rest.views[v].camera).collect();
        assert_eq!((kept_out.len(), cameras.len()), (10, 2));
        assert_eq!(hold_out(&rest, 4).unwrap().views, rest.views, "there are some already");
    }

    #[test]
    fn else_single_images_are() {
        assert_eq!(hold_out(&scene(20, 1), 4).unwrap().split(Split::Validation).len(), 4);
        assert_eq!(hold_out(&scene(2, 10), 3).unwrap().split(Split::Validation).len(), 3);
        // Of all cameras, although the views go on frame by frame.
        for (cameras, frames, count) in [(2, 100, 5), (3, 200, 8)] {
            let rest = hold_out(&scene(cameras, frames), count).unwrap();
            let of: Vec<usize> = (0..cameras).map(|c| rest.split(Split::Validation).iter().filter(|&&v| rest.views[v].camera == c).count()).collect();
            assert!(of.iter().sum::<usize>() == count && of.iter().all(|n| *n >= count / cameras), "{of:?}");
        }
        assert!(hold_out(&scene(20, 1), 0).unwrap().split(Split::Validation).is_empty());
        for count in [4, usize::MAX] {
            assert!(hold_out(&scene(5, 1), count).err().unwrap().to_string().contains("at most 3"), "{count}");
        }
    }
}
