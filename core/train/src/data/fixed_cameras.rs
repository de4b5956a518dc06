//! Scenes whose files list images, each with a pose and a time: the images of a camera that stands still are frames of one camera.

use cc4dgs_core::{RawScene, plural};
use std::collections::{BTreeMap, BTreeSet};

/// Says so where some images state a time and others none: these count as images of time 0.
pub(super) fn warn_of_missing_times(times: &[Option<f64>], warnings: &mut Vec<String>) {
    let missing = times.iter().filter(|time| time.is_none()).count();
    if (1..times.len()).contains(&missing) {
        let taken = plural(missing, "states no time and is taken as an image", "state no time and are taken as images");
        warnings.push(format!("{missing} of {} images {taken} of time 0", times.len()));
    }
}

/// Where most entries are further instants of a camera that stands still, `scene` gets one camera for each; `times` are those of its views, of which camera k
/// has view k. With `by_split`, the cameras of each side of the split stay apart. Returns whether it did, and warns where only the times are against it.
pub(super) fn merge_fixed_cameras(scene: &mut RawScene, times: &[Option<f64>], by_split: bool) -> bool {
    let mut groups: BTreeMap<String, Vec<usize>> = BTreeMap::new();
    for (index, c) in scene.cameras.iter().enumerate() {
        let split = by_split.then_some(scene.views[index].split);
        groups.entry(format!("{:?}", (c.size, c.focal, c.principal, &c.distortion, c.world_to_camera, split))).or_default().push(index);
    }
    // A moving camera may rest for a moment.
    if 2 * groups.len() > scene.views.len() {
        return false;
    }
    let untimed = times.iter().filter(|time| time.is_none()).count();
    let instants = |of: &[usize]| of.iter().filter_map(|&view| times[view].map(f64::to_bits)).collect::<BTreeSet<_>>().len();
    let repeated = times.len() - untimed - groups.values().map(|of| instants(of)).sum::<usize>();
    if untimed + repeated > 0 {
        scene.warnings.push(format!(
            "{} images have {} {}, but {untimed} of them {} no time and {repeated} the same time as another image of {} pose: each image is taken for a camera \
             of its own (state a different \"time\" for each image of one camera)",
            times.len(),
            groups.len(),
            plural(groups.len(), "pose", "poses"),
            plural(untimed, "states", "state"),
            plural(repeated, "its", "their")
        ));
        return false;
    }
    let mut groups: Vec<Vec<usize>> = groups.into_values().collect();
    groups.sort();
    let cameras = groups.iter().map(|of| scene.cameras[of[0]].clone()).collect();
    for (camera, views) in groups.iter().enumerate() {
        views.iter().for_each(|&view| scene.views[view].camera = camera);
    }
    scene.cameras = cameras;
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_without_a_time_among_others_are_told() {
        let told = |times: &[Option<f64>]| {
            let mut warnings = Vec::new();
            warn_of_missing_times(times, &mut warnings);
            warnings.join("")
        };
        assert!(told(&[Some(0.0), None, Some(1.0)]).starts_with("1 of 3 images states no time and is taken as an image of time 0"));
        assert_eq!(told(&[None, None]) + &told(&[Some(0.5)]) + &told(&[]), "");
    }
}
