//! The same scene in other units, translated and rotated: training must not depend on it.

use super::common::*;
use super::course::{COUNT, Course, ROUND, alike, near, short};
use cc4dgs_core::{Camera, HostGaussians, Limits, PointCloud, Registry, Scene, Seed, Silent, Split, parse_device};
use cc4dgs_play::{ArchiveOptions, Model};
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::data::Trained;
use cc4dgs_train::data::procedural::ProceduralScene;
use cc4dgs_train::init::initialise;
use glam::{DMat3, DQuat, DVec3};
use std::path::Path;

/// Largest difference of positions in the normalised frame, whose cameras are four units away: those of datasets are mapped in float64, offsets are rounded to
/// 1e-6, and points are float32.
const ROUNDING: f64 = 1e-5;

/// How the dataset was changed: x -> scale * rotation * x + translation.
#[derive(Clone, Copy, Debug)]
struct Change {
    scale: f64,
    rotation: DMat3,
    translation: DVec3,
}

const SAME: Change = Change { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

fn moved() -> [(&'static str, Change); 3] {
    let far = DVec3::new(1e5, -1e5, 1e5);
    [("moved", Change { translation: far, ..SAME }), ("shrunk", Change { scale: 1e-4, ..SAME }), ("grown", Change { scale: 1e4, ..SAME })]
}

fn turned() -> Change {
    Change { rotation: DMat3::from_quat(DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 1.1)), ..SAME }
}

impl Change {
    fn point(&self, p: DVec3) -> DVec3 {
        self.scale * (self.rotation * p) + self.translation
    }
    fn camera(&self, camera: &Camera) -> Camera {
        let (r, _) = camera.rotation_translation();
        let rotation = r * self.rotation.transpose();
        let t = -(rotation * self.point(DVec3::from(camera.center_world())));
        let row = |i: usize| [rotation.x_axis[i], rotation.y_axis[i], rotation.z_axis[i], t[i]];
        Camera { world_to_camera: [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]], ..camera.clone() }
    }
}

/// The built-in scene, with its images.
struct Truth {
    scene: ProceduralScene,
    train: Vec<Camera>,
    test: Vec<Camera>,
}

impl Truth {
    fn new() -> Self {
        let scene = ProceduralScene::named("tiny").unwrap();
        let side = |split| scene.cameras().into_iter().filter(|(_, s)| *s == split).map(|(c, _)| c).collect();
        Self { train: side(Split::Train), test: side(Split::Test), scene }
    }
    fn write_image(&self, path: &Path, camera: &Camera, frame: usize) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let image = self.scene.render(camera, self.scene.time(frame));
        image::RgbImage::from_raw(image.width, image.height, image.data).unwrap().save(path).unwrap();
    }
    /// All cameras at all times.
    fn panoptic(&self, root: &Path, change: &Change) {
        for (name, cameras, first) in [("train", &self.train, 0), ("test", &self.test, self.train.len())] {
            let per_time = |f: &dyn Fn(usize, usize) -> serde_json::Value| -> Vec<Vec<serde_json::Value>> {
                (0..self.scene.frames).map(|t| (0..cameras.len()).map(|c| f(t, c)).collect()).collect()
            };
            let document = serde_json::json!({
                "w": self.scene.width, "h": self.scene.height,
                "k": per_time(&|_, c| serde_json::json!([[cameras[c].fx, 0.0, cameras[c].cx], [0.0, cameras[c].fy, cameras[c].cy], [0.0, 0.0, 1.0]])),
                "w2c": per_time(&|_, c| serde_json::json!(change.camera(&cameras[c]).world_to_camera)),
                "fn": per_time(&|t, c| serde_json::json!(format!("{}/{t:06}.png", first + c))),
                "cam_id": per_time(&|_, c| serde_json::json!(first + c)),
            });
            std::fs::write(root.join(format!("{name}_meta.json")), document.to_string()).unwrap();
            for (c, camera) in cameras.iter().enumerate() {
                (0..self.scene.frames).for_each(|t| self.write_image(&root.join(format!("ims/{}/{t:06}.png", first + c)), camera, t));
            }
        }
    }
    /// One camera at each time.
    fn blender(&self, root: &Path, change: &Change) {
        for (name, cameras) in [("train", &self.train), ("test", &self.test)] {
            let frame = |(i, camera): (usize, &Camera)| {
                let time = i % self.scene.frames;
                self.write_image(&root.join(format!("{name}/{i}.png")), camera, time);
                let pose = opengl_camera_to_world(&change.camera(camera));
                serde_json::json!({"file_path": format!("{name}/{i}"), "time": self.scene.time(time), "transform_matrix": pose})
            };
            let frames: Vec<_> = cameras.iter().enumerate().map(frame).collect();
            std::fs::write(root.join(format!("transforms_{name}.json")), serde_json::json!({"camera_angle_x": 0.85, "frames": frames}).to_string()).unwrap();
        }
    }
    /// The first time, with points.
    fn colmap(&self, root: &Path, change: &Change) {
        let model = root.join("sparse/0");
        std::fs::create_dir_all(&model).unwrap();
        let (mut cameras, mut images, mut points) = (String::new(), String::new(), String::new());
        for (i, camera) in self.train.iter().enumerate() {
            self.write_image(&root.join(format!("images/{i}.png")), camera, 0);
            let (q, t) = quaternion(&change.camera(camera));
            cameras += &format!("{i} PINHOLE {} {} {} {} {} {}\n", camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy);
            images += &format!("{i} {} {} {} {} {} {} {} {i} {i}.png\n\n", q[0], q[1], q[2], q[3], t[0], t[1], t[2]);
        }
        for (i, p) in self.scene.surface_samples(200).0.positions.iter().enumerate() {
            let p = change.point(DVec3::from(p.map(f64::from)));
            points += &format!("{i} {} {} {} 200 100 50 0.1\n", p.x, p.y, p.z);
        }
        for (name, text) in [("cameras", cameras), ("images", images), ("points3D", points)] {
            std::fs::write(model.join(format!("{name}.txt")), text).unwrap();
        }
    }
}

type Write = fn(&Truth, &Path, &Change);
const FORMATS: [(&str, Write); 3] = [("panoptic", Truth::panoptic), ("blender", Truth::blender), ("colmap", Truth::colmap)];

fn scene(truth: &Truth, write: Write, change: &Change) -> (tempfile::TempDir, Scene) {
    let root = tempfile::tempdir().unwrap();
    write(truth, root.path(), change);
    let scene = load(root.path()).unwrap();
    (root, scene)
}

fn config(sets: &[&str]) -> RunConfig {
    RunConfig::resolve(Some("demo"), None, &sets.iter().map(ToString::to_string).collect::<Vec<_>>()).unwrap()
}

fn start(scene: &Scene) -> HostGaussians {
    let source = if scene.points.is_some() { "init.source=points" } else { "init.source=random" };
    initialise(scene, &config(&[source, "init.count=300"]), Seed::root(1), &Silent).unwrap()
}

/// The largest distance of corresponding points, `a` rotated by `rotation`.
fn apart(a: &[f32], b: &[f32], rotation: DMat3) -> f64 {
    assert_eq!(a.len(), b.len());
    let point = |p: &[f32]| DVec3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]));
    a.chunks_exact(3).zip(b.chunks_exact(3)).map(|(a, b)| (rotation * point(a) - point(b)).length()).fold(0.0, f64::max)
}

#[test]
fn the_normalised_scene_does_not_depend_on_unit_origin_and_direction() {
    let truth = Truth::new();
    for (name, write) in FORMATS {
        let (_root, base) = scene(&truth, write, &SAME);
        let before = start(&base);
        for (what, change) in moved().into_iter().chain([("turned", turned())]) {
            let (_root, found) = scene(&truth, write, &change);
            let r = change.rotation;
            assert_eq!(base.cameras.len(), found.cameras.len());
            for (a, b) in base.cameras.iter().zip(&found.cameras) {
                let distance = (r * DVec3::from(a.center_world()) - DVec3::from(b.center_world())).length();
                let turn = (r * DVec3::from(a.forward_world()) - DVec3::from(b.forward_world())).length();
                assert!(distance < ROUNDING && turn < 1e-6, "{name} {what}: camera {} is {distance:.1e} away and turned by {turn:.1e}", a.name);
                assert!((2.0..8.0).contains(&DVec3::from(b.center_world()).length()), "cameras stand about four units away");
            }
            let extents = (f64::from(base.extent()), f64::from(found.extent()));
            assert!(near(extents.0, extents.1, ROUNDING), "{name} {what}: the extents are {extents:?}");
            // Back in the dataset, everything is where it was put.
            let own = found.normalisation.inverse().apply_camera(&found.cameras[0]);
            let put = change.point(DVec3::from(base.normalisation.inverse().apply_camera(&base.cameras[0]).center_world()));
            assert!((DVec3::from(own.center_world()) - put).length() < 1e-4 * change.scale, "{name} {what}");
            if let (Some(a), Some(b)) = (base.init_box, found.init_box) {
                // Boxes are axis-aligned: their centres and sides must agree, their corners need not.
                let middle = |(low, high): ([f32; 3], [f32; 3])| std::array::from_fn::<f32, 3, _>(|k| 0.5 * (low[k] + high[k]));
                let sides = [a, b].map(|(low, high)| f64::from(high[0] - low[0]));
                assert!(apart(&middle(a), &middle(b), r) < ROUNDING && near(sides[0], sides[1], ROUNDING), "{name} {what}: {a:?} {b:?}");
            }
            let after = start(&found);
            // Random points fill an axis-aligned box, which is another box in a rotated scene.
            if what != "turned" || base.points.is_some() {
                let distance = apart(&before.means, &after.means, r);
                let widest = before.log_scales.iter().zip(&after.log_scales).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                // Random points lie up to eight times as far from the cameras as the origin.
                assert!(distance < 8.0 * ROUNDING && widest < 1e-3, "{name} {what}: Gaussians are {distance:.1e} apart, log-scales {widest:.1e}");
            }
        }
    }
}

/// A scene with the same points in every dataset: random ones fill an axis-aligned box.
fn with_points(truth: &Truth, write: Write, change: &Change) -> (tempfile::TempDir, Scene) {
    let (root, mut found) = scene(truth, write, change);
    let PointCloud { positions, colors } = truth.scene.surface_samples(COUNT).0;
    let to_scene = found.normalisation;
    let to_frame = |p: &[f32; 3]| to_scene.apply(change.point(DVec3::from(p.map(f64::from))).to_array()).map(|v| v as f32);
    found.points = Some(PointCloud { positions: positions.iter().map(to_frame).collect(), colors });
    (root, found)
}

/// Mean centre and mean log-scale of a model's Gaussians in the coordinates of its dataset, read back from an archive.
fn exported(model: &Model) -> (DVec3, f64) {
    let (registry, limits, folder) = (Registry::collect().unwrap(), Limits::default(), tempfile::tempdir().unwrap());
    let path = folder.path().join("model.cc4d");
    let options = ArchiveOptions { codec: "raw", settings: &toml::Table::new(), field_weights: "fp32", views: None, tuner: None };
    model.save_archive(&path, &options, &registry, &limits, &Silent).unwrap();
    let model = Model::open(&path, &registry, &parse_device("flex").unwrap(), &limits, &Silent).unwrap();
    let mut gaussians = model.gaussians.clone();
    model.to_dataset(&mut gaussians);
    let mean = |k: usize| gaussians.means.iter().skip(k).step_by(3).map(|&v| f64::from(v)).sum::<f64>() / gaussians.len() as f64;
    let log_scale = gaussians.log_scales.iter().map(|&v| f64::from(v)).sum::<f64>() / gaussians.log_scales.len() as f64;
    (DVec3::new(mean(0), mean(1), mean(2)), log_scale)
}

#[test]
fn training_does_not_depend_on_unit_origin_and_direction() {
    let truth = Truth::new();
    let sets = |parts: &[&str]| parts.iter().map(ToString::to_string).collect::<Vec<_>>();
    // Both density controls, and deformers with and without rates of attributes. The scene of COLMAP stands still.
    let parts = [sets(&["density.kind=clone-split", "density.gradient=1e-6"]), sets(&["deformer.kind=free-time"])];
    for ((name, write), mut parts) in FORMATS.into_iter().zip(parts) {
        let clones = parts.len() > 1;
        let (_root, unchanged) = with_points(&truth, write, &SAME);
        if clones {
            // About half of the Gaussians are larger.
            let mut sizes = initialise(&unchanged, &short(&parts), Seed::root(0), &Silent).unwrap().log_scales;
            sizes.sort_by(f32::total_cmp);
            parts.push(format!("density.dense_share={:.6}", sizes[sizes.len() / 2].exp() / unchanged.extent()));
        }
        let config = short(&parts);
        let base = Course::run(unchanged, &config);
        base.check_rates(name);
        let first = base.rounds()[0];
        assert!(first[1] > COUNT / 20 && (first[0] > COUNT / 20) == clones, "{name}: {first:?}");
        let (middle, log_scale) = exported(&base.model);
        for (what, change) in moved() {
            let what = format!("{name} {what}");
            let (_root, found) = with_points(&truth, write, &change);
            let course = Course::run(found, &config);
            course.check_rates(&what);
            base.check_same(&course, &what);
            // Exports are in the coordinates of the dataset.
            let (found, found_scale) = exported(&course.model);
            let distance = (found - change.point(middle)).length() / change.scale;
            let growth = found_scale - change.scale.ln() - log_scale;
            assert!(distance < 0.02 && growth.abs() < 0.02, "{what}: {distance} from {found}, log-scale {found_scale}");
        }
        // Adam steps along axes, and splits are drawn along them: only what comes before is equal.
        let (_root, found) = with_points(&truth, write, &turned());
        let course = Course::run(found, &config);
        course.check_rates(name);
        let losses: Vec<(f64, f64)> = base.losses().into_iter().zip(course.losses()).take(ROUND).collect();
        assert!(near(losses[0].0, losses[0].1, 1e-3) && losses.iter().all(|(a, b)| near(*a, *b, 1e-2)), "{name} turned: {losses:?}");
        assert!(alike(&first, &course.rounds()[0], 0.1), "{name} turned: {:?}, {first:?} unchanged", course.rounds()[0]);
    }
}

#[test]
fn a_model_brings_its_frame_to_other_choices_of_the_dataset() {
    let truth = Truth::new();
    let (root, whole) = scene(&truth, Truth::blender, &moved()[0].1);
    let registry = Registry::collect().unwrap();
    // Fewer cameras are another rig, the dataset's frame stays.
    let options = cc4dgs_core::SceneOptions { frames: Some([0, 1, 1]), ..options() };
    assert_eq!(open(root.path(), &options, &Limits::default()).unwrap().normalisation, whole.normalisation);
    let other = cc4dgs_core::Similarity::centred([1e5, -1e5, 1e5], 0.5);
    let found =
        cc4dgs_train::data::open_in(root.path(), &options, &Trained { normalisation: other, frames: options.frames }, &registry, &Limits::default()).unwrap();
    assert_eq!(found.normalisation, other);
    let (a, b) = (dataset_camera(&found, 0), dataset_camera(&whole, 0));
    assert!((DVec3::from(a.center_world()) - DVec3::from(b.center_world())).length() < 1e-6);
}
