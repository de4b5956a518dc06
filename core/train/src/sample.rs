//! A few of many, evenly spread.

use cc4dgs_core::Scene;
use std::collections::BTreeMap;

/// Share of its frames by which the views of a camera are turned against those of the one before: multiples of the golden ratio are spread over 0..1.
const TURN: f64 = 0.618_033_988_749_895;

/// At most `most` of `items`, from the middles of equal parts.
pub(crate) fn spread<T: Copy>(items: &[T], most: usize) -> Vec<T> {
    let n = items.len();
    if n <= most { items.to_vec() } else { (0..most).map(|i| items[(2 * i + 1) * n / (2 * most)]).collect() }
}

/// At most `most` of `items`, the first of each of equal parts.
pub(crate) fn spread_from_first<T: Copy>(items: &[T], most: usize) -> Vec<T> {
    let n = items.len();
    if n <= most { items.to_vec() } else { (0..most).map(|i| items[i * n / most]).collect() }
}

/// At most `most` of `views`, spread over cameras and over frames. Scenes have their views by frame, where every so many are often of one camera.
pub(crate) fn spread_views(scene: &Scene, views: &[usize], most: usize) -> Vec<usize> {
    if views.len() <= most {
        return views.to_vec();
    }
    let mut of_camera: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    views.iter().for_each(|&view| of_camera.entry(scene.views[view].camera).or_default().push(view));
    let mut order = Vec::with_capacity(views.len());
    for (k, mut own) in of_camera.into_values().enumerate() {
        let turn = ((k as f64 * TURN).fract() * own.len() as f64) as usize;
        own.rotate_left(turn);
        order.append(&mut own);
    }
    let mut chosen = spread(&order, most);
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Camera, Error, FrameSource, Image8, Result, Split, View};
    use std::collections::BTreeSet;
    use std::sync::Arc;

    struct NoImages;
    impl FrameSource for NoImages {
        fn load(&self, view: usize) -> Result<Image8> {
            Err(Error::unsupported(format!("view {view}"), "no images here", "None"))
        }
    }

    #[test]
    fn views_are_spread_over_cameras_and_frames() {
        for (cameras, frames, most) in [(20, 300, 3), (20, 150, 24), (8, 300, 24), (24, 10, 24), (2, 240, 8), (1, 100, 3)] {
            let camera = |k: usize| Camera::look_at(&format!("c{k}"), (8, 8), 1.0, [k as f64, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
            let view = |i: usize| View { camera: i % cameras, frame: i / cameras, time_norm: 0.0, split: Split::Train };
            let views: Vec<View> = (0..cameras * frames).map(view).collect();
            let scene = Scene::new("s", (0..cameras).map(camera).collect(), views, Arc::new(NoImages), 0).unwrap();
            let chosen = spread_views(&scene, &scene.split(Split::Train), most);
            let seen: BTreeSet<usize> = chosen.iter().map(|&v| scene.views[v].camera).collect();
            let times: BTreeSet<usize> = chosen.iter().map(|&v| 4 * scene.views[v].frame / frames).collect();
            assert_eq!((chosen.len(), seen.len()), (most, cameras.min(most)), "{cameras} cameras, {frames} frames");
            assert!(chosen.is_sorted() && times.len() >= if most < 8 { 2 } else { 3 }, "{cameras} cameras, {frames} frames: {times:?}");
        }
    }

    #[test]
    fn samples_are_spread() {
        let hundred: Vec<usize> = (0..100).collect();
        assert_eq!(spread(&hundred, 4), [12, 37, 62, 87]);
        assert_eq!(spread_from_first(&hundred, 4), [0, 25, 50, 75]);
        assert_eq!((spread(&[3, 4, 5], 5), spread_from_first(&[3, 4, 5], 5)), (vec![3, 4, 5], vec![3, 4, 5]));
        assert!(spread(&hundred, 0).is_empty() && spread_from_first::<usize>(&[], 3).is_empty());
    }
}
