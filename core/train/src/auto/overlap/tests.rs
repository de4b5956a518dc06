//! Overlap of made-up cameras.

use super::*;
use cc4dgs_core::{NoImages, PointCloud, Split, View};
use std::sync::Arc;

fn camera(name: &str, eye: [f64; 3], target: [f64; 3]) -> Camera {
    Camera::look_at(name, (80, 60), 1.0, eye, target, [0.0, 1.0, 0.0])
}

/// Cameras that all see every one of `frames`.
fn scene(cameras: Vec<Camera>, frames: usize) -> Scene {
    let view = |frame: usize, camera: usize| View { camera, frame, time_norm: 0.0, split: Split::Train };
    let views = (0..frames).flat_map(|frame| (0..cameras.len()).map(move |camera| view(frame, camera))).collect();
    Scene::new("s", cameras, views, Arc::new(NoImages), 0).unwrap()
}

fn overlap(scene: &Scene) -> Option<Overlap> {
    Overlap::of(scene, &scene.split(Split::Train))
}

/// Cameras on a circle around the origin, of which the first `turned` look outwards.
fn ring(count: usize, turned: usize) -> Vec<Camera> {
    let at = |k: usize| {
        let (sin, cos) = (std::f64::consts::TAU * k as f64 / count as f64).sin_cos();
        let eye = [4.0 * cos, 0.0, 4.0 * sin];
        camera(&format!("c{k}"), eye, if k < turned { eye.map(|v| 2.0 * v) } else { [0.0; 3] })
    };
    (0..count).map(at).collect()
}

#[test]
fn cameras_that_face_one_box_share_all_of_it() {
    let mut two = scene(vec![camera("a", [-2.0, 0.0, -3.5], [0.0; 3]), camera("b", [2.0, 0.0, -3.5], [0.0; 3])], 3);
    two.init_box = Some(([-0.5; 3], [0.5; 3]));
    let found = overlap(&two).unwrap();
    assert_eq!(found, Overlap { compared: 2, cameras: 2, by_three: 0.0, alone: 0.0, apart: Vec::new() });
    assert_eq!((overlap(&two), found.warning()), (Some(found.clone()), None));
    let words = "overlap: half of what a camera sees is seen by 2 or more of 2 cameras; 0 % by at least three, 0 % by one alone";
    assert_eq!(found.describe("cameras"), words);
    // The same without a box, which is then judged from the cameras.
    two.init_box = None;
    assert!(overlap(&two).is_some_and(|found| found.alone < 1.0 && found.apart.is_empty()));
}

#[test]
fn cameras_back_to_back_share_nothing() {
    let found = overlap(&scene(vec![camera("a", [0.0, 0.0, -1.0], [0.0, 0.0, -2.0]), camera("b", [0.0, 0.0, 1.0], [0.0, 0.0, 2.0])], 1)).unwrap();
    assert_eq!(found, Overlap { compared: 2, cameras: 1, by_three: 0.0, alone: 1.0, apart: vec!["a".into(), "b".into()] });
    assert!(found.warning().is_some_and(|text| text.contains("cameras a, b is") && text.contains("scene.test_cameras")));
    // One of a ring is turned round, and sees nothing of the box.
    let mut turned = scene(ring(8, 1), 2);
    turned.init_box = Some(([-1.0; 3], [1.0; 3]));
    let found = overlap(&turned).unwrap();
    assert_eq!((found.apart.clone(), found.cameras), (vec!["c0".to_string()], 7));
    // A box that no camera sees is that of another scene.
    turned.init_box = Some(([100.0; 3], [101.0; 3]));
    assert!(overlap(&turned).is_some_and(|found| found.cameras > 1));
    let many = Overlap { apart: (0..6).map(|k| k.to_string()).collect(), ..found };
    assert!(many.warning().is_some_and(|text| text.contains("0, 1, 2, 3 and 2 more")));
}

#[test]
fn one_pose_has_nothing_to_share() {
    let one = || camera("a", [0.0, 0.0, -4.0], [0.0; 3]);
    assert_eq!(overlap(&scene(vec![one()], 5)), None);
    assert_eq!(overlap(&scene(vec![one(), one(), one()], 1)), None);
    // Where there is another pose, two that are the same count once.
    let found = overlap(&scene(vec![one(), one(), camera("b", [1.0, 0.0, -4.0], [0.0; 3])], 1)).unwrap();
    assert_eq!((found.compared, found.cameras), (2, 2));
}

#[test]
fn many_poses_are_sampled() {
    let mut many = scene(ring(300, 0), 1);
    many.init_box = Some(([-0.5; 3], [0.5; 3]));
    let found = overlap(&many).unwrap();
    assert_eq!((found.compared, found.cameras, found.alone), (MOST_POSES, MOST_POSES, 0.0));
    // On a straight walk, those that are compared see nothing of each other, but their neighbours do, unless one is turned round.
    let at = |k: u32| camera(&format!("{k}"), [f64::from(k), 0.0, -4.0], [f64::from(k), 0.0, if k == 320 { -8.0 } else { 0.0 }]);
    let mut walk = scene((0..640).map(at).collect(), 1);
    walk.init_box = Some(([-1.0, -1.0, -0.5], [641.0, 1.0, 0.5]));
    let found = overlap(&walk).unwrap();
    assert_eq!((found.cameras, found.alone, found.apart), (1, 1.0, vec!["320".to_string()]));
}

#[test]
fn known_points_are_preferred() {
    let pair = |points: usize, x: f32| {
        let mut pair = scene(vec![camera("a", [-2.0, 0.0, -3.5], [0.0; 3]), camera("b", [2.0, 0.0, -3.5], [0.0; 3])], 1);
        pair.init_box = Some(([-0.5; 3], [0.5; 3]));
        pair.points = Some(PointCloud { positions: vec![[x, 0.0, -2.0]; points], colors: vec![[0.5; 3]; points] });
        overlap(&pair).unwrap()
    };
    // Only `a` sees these points.
    let found = pair(LEAST_POINTS, -1.5);
    assert_eq!((found.cameras, found.alone, found.apart.len()), (1, 1.0, 0));
    // Too few, and none in view.
    assert_eq!([pair(LEAST_POINTS - 1, -1.5).cameras, pair(LEAST_POINTS, 90.0).cameras], [2, 2]);
}

#[test]
fn rays_meet_boxes_ahead() {
    let (low, high) = (DVec3::splat(-1.0), DVec3::splat(1.0));
    let inside = |start: [f64; 3], ray: [f64; 3]| depths_inside(start.into(), ray.into(), low, high);
    assert_eq!(inside([0.0, 0.0, -4.0], [0.0, 0.0, 1.0]), Some([3.0, 5.0]));
    assert_eq!(inside([0.0; 3], [0.0, 0.0, 2.0]), Some([0.0, 0.5]));
    assert_eq!(inside([0.0, 0.0, 4.0], [0.0, 0.0, 1.0]), None);
    assert_eq!(inside([2.0, 0.0, -4.0], [0.0, 0.0, 1.0]), None);
    assert_eq!(inside([0.0; 3], [0.0; 3]), None);
}
