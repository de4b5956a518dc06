//! Whether the cameras of a dataset look at what it says is there.

use crate::Split;
use crate::reader::{InitBox, RawCamera, RawScene};

/// The least share of points in front of training cameras, over all of them. Cameras within a scene that look around have half of the points behind them.
const LEAST_IN_FRONT: f64 = 0.1;
/// Points and views that are looked at, about.
const POINTS: usize = 1000;
const VIEWS: usize = 50;

/// What is wrong if hardly any of the points, or without them of the corners of the box, are in front of the training cameras.
pub(super) fn behind(scene: &RawScene) -> Option<String> {
    let (what, points) = match (&scene.points, scene.init_box) {
        (Some(points), _) if !points.positions.is_empty() => ("points", points.positions.clone()),
        (_, Some(InitBox::Corners { low, high })) => ("corners of the box", corners(low, high)),
        _ => return None,
    };
    let views: Vec<_> = scene.views.iter().filter(|view| view.split == Split::Train).collect();
    let cameras = views.iter().step_by(views.len().div_ceil(VIEWS).max(1)).filter_map(|view| scene.cameras.get(view.camera));
    let (mut front, mut all) = (0usize, 0usize);
    for camera in cameras {
        for point in points.iter().step_by(points.len().div_ceil(POINTS).max(1)) {
            front += usize::from(depth(camera, point) > 0.0);
            all += 1;
        }
    }
    let axes = "the axes of a camera are x right, y down and z forward, and cc4dgs_core::reader::pose converts others";
    ((front as f64) < LEAST_IN_FRONT * all as f64).then(|| format!("{front} of {all} {what} are in front of the training cameras: {axes}"))
}

fn corners(low: [f64; 3], high: [f64; 3]) -> Vec<[f64; 3]> {
    (0..8).map(|corner| std::array::from_fn(|k| if (corner >> k) & 1 == 0 { low[k] } else { high[k] })).collect()
}

/// How far in front of a camera a point is.
fn depth(camera: &RawCamera, point: &[f64; 3]) -> f64 {
    let [x, y, z, w] = camera.world_to_camera[2];
    x * point[0] + y * point[1] + z * point[2] + w
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Camera, Distortion, ImageSource, RawPoints, RawView};

    /// Four cameras around the origin. With `flipped`, their y axes point up and their z axes backwards.
    fn scene(flipped: bool) -> RawScene {
        let camera = |index: usize| {
            let (s, c) = (1.5 * index as f64).sin_cos();
            let mut pose = Camera::look_at("c", (8, 6), 1.0, [4.0 * c, 4.0 * s, 1.0], [0.0; 3], [0.0, 0.0, 1.0]).world_to_camera;
            if flipped {
                pose[1..3].iter_mut().flatten().for_each(|v| *v = -*v);
            }
            RawCamera { name: index.to_string(), size: [8, 6], focal: [9.0; 2], principal: [4.0, 3.0], distortion: Distortion::None, world_to_camera: pose }
        };
        let view = |camera: usize| RawView { camera, frame: 0, time: None, split: Split::Train, image: ImageSource::file("x.png") };
        RawScene { name: "s".into(), cameras: (0..4).map(camera).collect(), views: (0..4).map(view).collect(), ..Default::default() }
    }

    #[test]
    fn cameras_that_look_away_are_found() {
        let points = RawPoints { positions: vec![[0.1, 0.2, 0.3], [-0.5, 0.0, 0.4]], colors: vec![[0.5; 3]; 2] };
        let init_box = Some(InitBox::Corners { low: [-1.0; 3], high: [1.0; 3] });
        for flipped in [false, true] {
            // Both are rigid.
            scene(flipped).validate().unwrap();
            assert_eq!(behind(&scene(flipped)), None, "without points and box nothing is known");
            let with_points = behind(&RawScene { points: Some(points.clone()), ..scene(flipped) });
            let with_box = behind(&RawScene { init_box, ..scene(flipped) });
            if flipped {
                assert!(with_points.unwrap().starts_with("0 of 8 points are in front of the training cameras"));
                assert!(with_box.unwrap().starts_with("0 of 32 corners of the box are in front"));
            } else {
                assert_eq!((with_points, with_box), (None, None));
            }
        }
    }
}
