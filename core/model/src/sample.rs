//! Evenly spread samples of views and other lists.

use crate::Scene;
use std::collections::BTreeMap;

/// Share of its frames by which the views of a camera are rotated relative to those of the previous camera: multiples of the golden ratio spread over 0..1.
const TURN: f64 = 0.618_033_988_749_895;

/// At most `most` of `items`, from the middles of equal parts.
pub fn spread<T: Copy>(items: &[T], most: usize) -> Vec<T> {
    let n = items.len();
    if n <= most { items.to_vec() } else { (0..most).map(|i| items[(2 * i + 1) * n / (2 * most)]).collect() }
}

/// At most `most` of `items`, the first of each of equal parts.
pub fn spread_from_first<T: Copy>(items: &[T], most: usize) -> Vec<T> {
    let n = items.len();
    if n <= most { items.to_vec() } else { (0..most).map(|i| items[i * n / most]).collect() }
}

/// `views` of `scene` camera after camera; the frames of each camera are rotated relative to those of the previous one. Scenes list their views by frame, where
/// every n-th view may be of one camera; in this order every n-th views are of all cameras and of many frames.
pub fn by_camera(scene: &Scene, views: &[usize]) -> Vec<usize> {
    by_group(views, |view| scene.views[view].camera)
}

/// `items` group after group; those of each group are rotated relative to those of the previous one.
pub fn by_group<T: Copy, K: Ord>(items: &[T], group: impl Fn(T) -> K) -> Vec<T> {
    let mut groups: BTreeMap<K, Vec<T>> = BTreeMap::new();
    items.iter().for_each(|&item| groups.entry(group(item)).or_default().push(item));
    let mut order = Vec::with_capacity(items.len());
    for (k, mut own) in groups.into_values().enumerate() {
        let turn = ((k as f64 * TURN).fract() * own.len() as f64) as usize;
        own.rotate_left(turn);
        order.append(&mut own);
    }
    order
}

/// At most `most` of `views`, spread over cameras and over frames, in ascending order where some are left out.
pub fn spread_views(scene: &Scene, views: &[usize], most: usize) -> Vec<usize> {
    if views.len() <= most {
        return views.to_vec();
    }
    let mut chosen = spread(&by_camera(scene, views), most);
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Camera, NoImages, Split, View};
    use std::collections::BTreeSet;
    use std::sync::Arc;

    /// Views by frame, as readers give them.
    fn scene(cameras: usize, frames: usize) -> Scene {
        let camera = |k: usize| Camera::look_at(&format!("c{k}"), (8, 8), 1.0, [k as f64, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let view = |i: usize| View { camera: i % cameras, frame: i / cameras, time_norm: 0.0, split: Split::Train };
        Scene::new("s", (0..cameras).map(camera).collect(), (0..cameras * frames).map(view).collect(), Arc::new(NoImages), 0).unwrap()
    }

    #[test]
    fn views_are_spread_over_cameras_and_frames() {
        for (cameras, frames, most) in [(20, 300, 3), (20, 150, 24), (8, 300, 24), (24, 10, 24), (2, 240, 8), (1, 100, 3)] {
            let scene = scene(cameras, frames);
            let chosen = spread_views(&scene, &scene.split(Split::Train), most);
            let seen: BTreeSet<usize> = chosen.iter().map(|&v| scene.views[v].camera).collect();
            let times: BTreeSet<usize> = chosen.iter().map(|&v| 4 * scene.views[v].frame / frames).collect();
            assert_eq!((chosen.len(), seen.len()), (most, cameras.min(most)), "{cameras} cameras, {frames} frames");
            assert!(chosen.is_sorted() && times.len() >= if most < 8 { 2 } else { 3 }, "{cameras} cameras, {frames} frames: {times:?}");
        }
    }

    #[test]
    fn every_so_many_views_by_camera_are_of_all_cameras() {
        let scene = scene(4, 12);
        let all = scene.split(Split::Train);
        let order = by_camera(&scene, &all);
        let cameras = |views: &[usize]| views.iter().map(|&v| scene.views[v].camera).collect::<BTreeSet<usize>>().len();
        assert_eq!((cameras(&spread_from_first(&all, 12)), cameras(&spread_from_first(&order, 12))), (1, 4));
        let frames: BTreeSet<usize> = spread_from_first(&order, 12).into_iter().map(|v| scene.views[v].frame).collect();
        assert!(frames.len() >= 6, "{frames:?}");
        let mut sorted = order;
        sorted.sort_unstable();
        assert_eq!(sorted, all);
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
