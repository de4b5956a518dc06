//! Frames of cameras whose clocks differ a little: the images that a rig takes together are one frame, although each states a time of its own.

use cc4dgs_core::{RawView, plural};
use std::collections::{BTreeMap, BTreeSet};

/// Share of the time from one image of a camera to its next within which the images of several cameras show one instant.
const ONE_INSTANT: f64 = 0.25;
/// Share of all images that are taken so: cameras of different rates meet at half of theirs.
const TOGETHER: f64 = 0.75;

/// Where nearly all images are taken by most cameras together, at times that differ by a small share of the time between two images of a camera, the images of
/// an instant become one frame, and a warning says so. Each keeps its own time. Frames of other scenes stay as they are.
pub(super) fn join_instants(views: &mut [RawView], warnings: &mut Vec<String>) {
    let Some(times) = views.iter().map(|view| view.time).collect::<Option<Vec<f64>>>() else { return };
    let mut order: Vec<usize> = (0..views.len()).collect();
    order.sort_by(|&a, &b| times[a].total_cmp(&times[b]).then(views[a].frame.cmp(&views[b].frame)));
    let mut latest: BTreeMap<usize, f64> = BTreeMap::new();
    let since_last = |&view: &usize| latest.insert(views[view].camera, times[view]).map(|last| times[view] - last);
    let mut intervals: Vec<f64> = order.iter().filter_map(since_last).filter(|interval| *interval > 0.0).collect();
    intervals.sort_by(f64::total_cmp);
    let Some(interval) = intervals.get(intervals.len() / 2) else { return };
    let groups: Vec<&[usize]> = order.chunk_by(|&a, &b| times[b] - times[a] <= ONE_INSTANT * interval).collect();
    let span = |group: &[usize]| times[group[group.len() - 1]] - times[group[0]];
    let is_instant = |group: &[usize]| {
        let cameras: BTreeSet<usize> = group.iter().map(|&view| views[view].camera).collect();
        span(group) <= ONE_INSTANT * interval && cameras.len() == group.len()
    };
    let instants: Vec<bool> = groups.iter().map(|group| is_instant(group)).collect();
    let of_instants = || groups.iter().zip(&instants).filter(|(_, is_instant)| **is_instant).map(|(group, _)| *group);
    let together: usize = of_instants().map(<[usize]>::len).filter(|count| 2 * count > latest.len()).sum();
    let differ = of_instants().any(|group| group.iter().any(|&view| views[view].frame != views[group[0]].frame));
    // A dataset may number its frames otherwise than by their times.
    if !differ || (together as f64) < TOGETHER * views.len() as f64 || !order.is_sorted_by_key(|&view| views[view].frame) {
        return;
    }
    let widest = of_instants().map(span).fold(0.0, f64::max);
    let mut frames = vec![0; views.len()];
    let (mut frame, mut before) = (0usize, None::<usize>);
    for (group, is_instant) in groups.iter().zip(&instants) {
        for (rank, &view) in group.iter().enumerate() {
            let joined = *is_instant && rank > 0;
            frame += usize::from(!joined && before.is_some_and(|before| before != views[view].frame));
            before = Some(views[view].frame);
            frames[view] = frame;
        }
    }
    views.iter_mut().zip(frames).for_each(|(view, frame)| view.frame = frame);
    warnings.push(format!(
        "the cameras take their images together, at times that differ by up to {:.1} % of the time from one image to the next: {} images are {} {}, each image \
         at its own time",
        100.0 * widest / interval,
        views.len(),
        frame + 1,
        plural(frame + 1, "frame", "frames")
    ));
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{ImageSource, RawScene, Split};

    /// The frames of images of these cameras at these times, ranked by time as readers do, and what is said of them.
    fn frames(images: &[(usize, f64)]) -> (Vec<usize>, Vec<usize>, Vec<String>) {
        let view = |&(camera, _): &(usize, f64)| RawView { camera, frame: 0, time: None, split: Split::Train, image: ImageSource::file("x.png") };
        let mut scene = RawScene { views: images.iter().map(view).collect(), ..Default::default() };
        scene.rank_times(&images.iter().map(|image| Some(image.1)).collect::<Vec<_>>(), "t").unwrap();
        let of = |views: &[RawView]| views.iter().map(|view| view.frame).collect::<Vec<_>>();
        let (ranks, times) = (of(&scene.views), scene.views.iter().map(|view| view.time).collect::<Vec<_>>());
        let mut said = Vec::new();
        join_instants(&mut scene.views, &mut said);
        assert_eq!(scene.views.iter().map(|view| view.time).collect::<Vec<_>>(), times);
        (ranks, of(&scene.views), said)
    }

    /// Images of `cameras` cameras at ten instants, each `late(camera, instant)` after the instant; the time between these is 1.
    fn rig(cameras: usize, late: impl Fn(usize, usize) -> f64) -> Vec<(usize, f64)> {
        (0..10).flat_map(|t| (0..cameras).map(move |c| (c, t))).map(|(c, t)| (c, t as f64 + late(c, t))).collect()
    }

    fn stays(images: &[(usize, f64)], what: &str) {
        let (ranks, found, said) = frames(images);
        assert!(ranks == found && said.is_empty(), "{what}: {found:?} {said:?}");
    }

    #[test]
    fn clocks_that_jitter_show_one_instant() {
        for cameras in [2, 5, 12] {
            let mut images = rig(cameras, |c, t| 0.02 * ((7 * c + 3 * t) % 11) as f64);
            let (ranks, found, said) = frames(&images);
            assert!(found.iter().enumerate().all(|(view, &frame)| frame == view / cameras), "{cameras} cameras: {found:?}");
            assert!(ranks != found && said[0].contains(&format!("{} images are 10 frames", images.len())), "{said:?}");
            // An image between two instants is a frame of its own.
            images[3 * cameras].1 = 3.5;
            let (_, found, _) = frames(&images);
            assert_eq!((found[3 * cameras - 1], found[3 * cameras + 1], found[3 * cameras], found[4 * cameras]), (2, 3, 4, 5), "{cameras} cameras");
        }
    }

    #[test]
    fn other_frames_stay_as_they_are() {
        stays(&rig(5, |_, _| 0.0), "one clock");
        stays(&rig(1, |_, t| 0.01 * t as f64), "one camera");
        for cameras in 2..9 {
            stays(&rig(cameras, |c, _| c as f64 / cameras as f64), "one camera after the other");
        }
        stays(&rig(12, |c, t| ((5 * c + 7 * t) % 12) as f64 / 12.0), "one camera at a time");
        stays(&(0..60).map(|k| (k, k as f64)).collect::<Vec<_>>(), "a moving camera");
        stays(&(0..60).map(|k| (k * 17 % 24, k as f64)).collect::<Vec<_>>(), "poses that return");
        // Some cameras are faster than others.
        let fast = (0..10).flat_map(|t| (1..5).map(move |part| (9, t as f64 + 0.2 * f64::from(part))));
        stays(&rig(4, |_, _| 0.0).into_iter().chain(fast).collect::<Vec<_>>(), "two rates");
        let beats = (0..61).map(|k| (0, f64::from(k))).chain((0..51).map(|k| (1, 1.2 * f64::from(k))));
        stays(&beats.collect::<Vec<_>>(), "two cameras, 6 images of one for 5 of the other");
        // A burst: two images of each camera in quick succession.
        let burst = (0..4).map(|c| (c, 4.1));
        stays(&rig(4, |_, _| 0.0).into_iter().chain(burst).collect::<Vec<_>>(), "a burst");
        stays(&[(0, 0.0), (1, 0.0)], "a single instant");
        stays(&[], "nothing");
    }
}
