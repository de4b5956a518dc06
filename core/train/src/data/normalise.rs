//! The normalised frame: what the cameras look at is the origin, and they stand about four units away.
//!
//! Near planes, paddings, thresholds and the sizes fields begin with are numbers of this frame, so that a scene trains equally well whatever its unit and
//! origin. Four units is where the cameras of D-NeRF's scenes are, which those numbers were first chosen for.

use super::focus::focus;
use cc4dgs_core::{RawScene, Similarity, Split};
use glam::DVec3;

/// Distance of the median camera from the origin of the normalised frame.
pub(super) const CAMERA_DISTANCE: f64 = 4.0;
/// No dataset's origin is farther than this from what its cameras look at, in units of the normalised frame.
const FARTHEST: f64 = 1e18;
/// The most cameras and points that are asked how far away the points are.
const SAMPLE: [usize; 2] = [64, 2000];

/// The map from the dataset's coordinates to the normalised frame, judged from all cameras the dataset trains on, whatever the options choose of them.
pub(super) fn normalisation(raw: &RawScene) -> Similarity {
    let mut used = vec![false; raw.cameras.len()];
    let train = raw.views.iter().filter(|v| v.split == Split::Train);
    train.for_each(|v| used[v.camera] = true);
    if !used.contains(&true) {
        used.fill(true);
    }
    let chosen = raw.cameras.iter().zip(used).filter(|(_, used)| *used).map(|(camera, _)| camera.pinhole());
    let rays: Vec<(DVec3, DVec3)> = chosen
        .filter(|camera| camera.validate().is_ok())
        .map(|camera| (DVec3::from(camera.center_world()), DVec3::from(camera.forward_world()).normalize_or_zero()))
        .collect();
    let found = focus(&rays, depth_hint(raw, &rays));
    // Where nothing says how long a unit is, it stays as it is.
    let scale = found.distance.map_or(1.0, |d| significant(CAMERA_DISTANCE / d, 8));
    let mut map = Similarity::centred(found.point.to_array(), scale);
    map.translation = map.translation.map(|t| placed(t).clamp(-FARTHEST, FARTHEST));
    if map.validate("normalisation").is_ok() { map } else { Similarity::IDENTITY }
}

/// `value` with so many significant decimal digits. JSON readers take decimals of at most 15 digits back to the last bit, which they do not promise of others.
fn significant(value: f64, digits: usize) -> f64 {
    format!("{value:.*e}", digits - 1).parse().unwrap_or(value)
}

/// A coordinate with six decimal places, or 15 digits where that is less.
fn placed(value: f64) -> f64 {
    if value.abs() < 1e9 { format!("{value:.6}").parse().unwrap_or(value) } else { significant(value, 15) }
}

/// How far ahead of the cameras the scene is, from its points or its box: the median over cameras of the median depth, which a few points at the horizon or
/// a few odd cameras do not move.
fn depth_hint(raw: &RawScene, rays: &[(DVec3, DVec3)]) -> Option<f64> {
    let positions: Vec<DVec3> = match (&raw.points, raw.init_box) {
        (Some(points), _) if !points.positions.is_empty() => every(&points.positions, SAMPLE[1]).map(|p| DVec3::from(*p)).collect(),
        (_, Some(cc4dgs_core::InitBox::Corners { low, high })) => vec![0.5 * (DVec3::from(low) + DVec3::from(high))],
        _ => return None,
    };
    let depths = every(rays, SAMPLE[0]).filter_map(|(c, d)| median(positions.iter().map(|p| (*p - *c).dot(*d)).filter(|z| *z > 0.0).collect()));
    median(depths.collect()).filter(|d| d.is_finite())
}

fn every<T>(items: &[T], most: usize) -> impl Iterator<Item = &T> {
    items.iter().step_by(items.len().div_ceil(most).max(1))
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Camera, Distortion, ImageSource, InitBox, RawCamera, RawPoints, RawView};

    fn rig(eyes: &[[f64; 3]], target: impl Fn([f64; 3]) -> [f64; 3]) -> RawScene {
        let camera = |eye: &[f64; 3]| {
            let pose = Camera::look_at("t", (8, 6), 1.0, *eye, target(*eye), [0.0, 1.0, 0.0]);
            RawCamera {
                name: "t".into(),
                size: [8, 6],
                focal: [9.0; 2],
                principal: [4.0, 3.0],
                distortion: Distortion::None,
                world_to_camera: pose.world_to_camera,
            }
        };
        let image = || ImageSource::Video { path: "t".into(), frame: 0 };
        let views = (0..eyes.len()).map(|camera| RawView { camera, frame: 0, time: None, split: Split::Train, image: image() }).collect();
        RawScene { cameras: eyes.iter().map(camera).collect(), views, ..Default::default() }
    }

    #[test]
    fn points_say_how_far_a_planar_rig_looks_and_the_horizon_does_not() {
        let eyes: Vec<[f64; 3]> = (0..16).map(|i| [0.1 * f64::from(i % 4), 0.1 * f64::from(i / 4), 0.0]).collect();
        let mut scene = rig(&eyes, |eye| [eye[0], eye[1], 1.0]);
        let guess = normalisation(&scene);
        let mut positions: Vec<[f64; 3]> = (0..90).map(|i| [0.01 * f64::from(i), 0.0, 20.0]).collect();
        positions.extend([[1e3, 0.0, 1e9]; 10]);
        scene.points = Some(RawPoints { colors: vec![[0.5; 3]; positions.len()], positions });
        let found = normalisation(&scene);
        assert!((found.scale - CAMERA_DISTANCE / 20.0).abs() < 0.01 && found.scale < 0.5 * guess.scale, "{found:?} {guess:?}");
        let middle = found.apply([0.15, 0.15, 20.0]);
        assert!(middle.iter().all(|v| v.abs() < 0.05), "{middle:?}");
        // A box says the same.
        scene.points = None;
        scene.init_box = Some(InitBox::Corners { low: [-9.0, -9.0, 18.0], high: [9.0, 9.0, 22.0] });
        assert!((normalisation(&scene).scale / found.scale - 1.0).abs() < 0.02);
    }

    #[test]
    fn one_camera_and_one_point_of_view_keep_their_unit_unless_points_say_more() {
        for eyes in [vec![[5.0, 6.0, 7.0]], vec![[5.0, 6.0, 7.0]; 3]] {
            let mut scene = rig(&eyes, |_| [5.0, 6.0, 8.0]);
            assert_eq!(normalisation(&scene).scale, 1.0);
            scene.points = Some(RawPoints { positions: vec![[5.0, 6.0, 107.0]; 5], colors: vec![[0.5; 3]; 5] });
            let found = normalisation(&scene);
            assert!((found.scale - 0.04).abs() < 1e-6 && found.apply([5.0, 6.0, 107.0]).iter().all(|v| v.abs() < 1e-6), "{found:?}");
        }
        assert_eq!(normalisation(&RawScene::default()).scale, 1.0);
    }

    #[test]
    fn cameras_that_differ_by_rounding_keep_their_unit_unless_points_say_more() {
        let eyes = [[1e-13, 0.0, 0.0], [0.0, -1e-13, 0.0], [0.0, 0.0, 1e-13]];
        let mut scene = rig(&eyes, |eye| [eye[0], eye[1], eye[2] + 1.0]);
        assert_eq!(normalisation(&scene).scale, 1.0);
        scene.points = Some(RawPoints { positions: vec![[0.0, 0.0, 100.0]; 5], colors: vec![[0.5; 3]; 5] });
        assert!((normalisation(&scene).scale - 0.04).abs() < 1e-6);
    }

    #[test]
    fn json_keeps_every_bit() {
        for i in 0..2000 {
            let x = f64::from(i) * 0.618_033_988_749;
            let (size, far) = (10f64.powf(x.fract() * 16.0 - 8.0), 10f64.powf((1.7 * x).fract() * 20.0 - 8.0));
            let eyes: Vec<[f64; 3]> = (0..8).map(|k| f64::from(k) * 0.785).map(|a| [far + size * a.cos(), -far + 0.3 * size, size * a.sin()]).collect();
            let map = normalisation(&rig(&eyes, |_| [far, -far, 0.0]));
            let back: Similarity = serde_json::from_str(&serde_json::to_string(&map).unwrap()).unwrap();
            assert_eq!(back, map);
        }
    }

    #[test]
    fn a_few_odd_cameras_move_little() {
        let mut eyes: Vec<[f64; 3]> = (0..20).map(|i| f64::from(i) * 0.314).map(|a| [3.0 * a.cos(), 0.5, 3.0 * a.sin()]).collect();
        let before = normalisation(&rig(&eyes, |_| [0.0; 3]));
        eyes.push([5000.0, 10.0, 0.0]);
        let after = normalisation(&rig(&eyes, |_| [0.0; 3]));
        assert!((after.scale / before.scale - 1.0).abs() < 0.05, "{before:?} {after:?}");
    }
}
