//! The first points of a scene from its images, for each arrangement of cameras, compared with the known geometry.

use super::common::*;
use cc4dgs_core::{
    Camera, Distortion, Event, FrameSource, Image8, ImageSource, Limits, PointCloud, RawCamera, RawScene, RawView, Recorder, Result, Scene, Seed, Silent, Split,
};
use cc4dgs_train::config::{InitSource, RunConfig};
use cc4dgs_train::data::assemble;
use cc4dgs_train::data::init::{find_points, photo_points};
use cc4dgs_train::data::procedural::{Object, ProceduralScene, Shape};
use cc4dgs_train::init::{from_points, initialise};
use glam::DVec3;
use std::sync::Arc;

/// Images of the built-in objects by cameras of the test's own.
struct Film {
    truth: ProceduralScene,
    cameras: Vec<Camera>,
    /// Camera and time of each image.
    shots: Vec<(usize, f64)>,
}

impl FrameSource for Film {
    fn load(&self, index: usize) -> Result<Image8> {
        let (camera, time) = self.shots[index];
        Ok(self.truth.render(&self.cameras[camera], time))
    }
}

/// A scene without points and box. `shots` are camera and frame of each training image; frames are spread evenly over 0..1.
fn film(truth: &ProceduralScene, cameras: Vec<Camera>, shots: &[(usize, usize)]) -> Scene {
    let last = shots.iter().map(|s| s.1).max().unwrap().max(1);
    let time = |frame: usize| frame as f64 / last as f64;
    let raw = |c: &Camera| RawCamera {
        name: c.name.clone(),
        size: [c.width, c.height],
        focal: [c.fx, c.fy],
        principal: [c.cx, c.cy],
        distortion: Distortion::None,
        world_to_camera: c.world_to_camera,
    };
    let raw_cameras = cameras.iter().map(raw).collect();
    let shots_at: Vec<(usize, f64)> = shots.iter().map(|&(camera, frame)| (camera, time(frame))).collect();
    let source: Arc<dyn FrameSource> = Arc::new(Film { truth: truth.clone(), cameras, shots: shots_at });
    let view = |(index, &(camera, frame)): (usize, &(usize, usize))| RawView {
        camera,
        frame,
        time: Some(time(frame)),
        split: Split::Train,
        image: ImageSource::Frames { source: source.clone(), index },
    };
    let views = shots.iter().enumerate().map(view).collect();
    assemble(RawScene { name: "film".into(), cameras: raw_cameras, views, resized: true, ..Default::default() }, &options(), None, &Limits::default()).unwrap()
}

/// Cameras on an arc of `radians` around the built-in objects.
fn arc(count: usize, radians: f64) -> Vec<Camera> {
    let eye = |i: usize| {
        let angle = radians * i as f64 / (count - 1).max(1) as f64;
        [4.2 * angle.cos(), 4.2 * angle.sin(), 1.6 + 0.3 * (3.0 * angle).sin()]
    };
    (0..count).map(|i| Camera::look_at(&format!("c{i}"), (160, 120), 0.9, eye(i), [0.0, 0.0, 0.5], [0.0, 0.0, 1.0])).collect()
}

fn playground() -> ProceduralScene {
    ProceduralScene { supersampling: 2, ..ProceduralScene::named("default").unwrap() }
}

/// The built-in ball and box without the floor, before a plain background, in images without alpha.
fn on_magenta() -> ProceduralScene {
    let truth = playground();
    let small = |o: &Object| match o.shape {
        Shape::Cuboid { half } => half.max_element() < 1.0,
        _ => true,
    };
    let objects: Vec<Object> = truth.objects.iter().filter(|o| o.motion.is_still() && small(o)).cloned().collect();
    assert!(!objects.is_empty());
    ProceduralScene { objects, background: [1.0, 0.0, 1.0], ..truth }
}

/// Share of the points whose distance from a camera is that of the surface it sees there, to within `tolerance`, in at least one view.
fn on_surfaces(scene: &Scene, truth: &ProceduralScene, positions: &[[f32; 3]], tolerance: f64) -> f64 {
    let views: Vec<usize> = scene.split(Split::Train).into_iter().step_by(scene.views.len().div_ceil(16)).collect();
    let eyes: Vec<_> = views.iter().map(|&v| (dataset_camera(scene, v), truth.tracer(f64::from(scene.views[v].time_norm)))).collect();
    let right = |p: &&[f32; 3]| {
        let p = DVec3::from(dataset_point(scene, **p));
        eyes.iter().any(|(camera, tracer)| {
            let (u, v, z) = project(camera, p.to_array());
            let eye = DVec3::from(camera.center_world());
            let distance = eye.distance(p);
            let inside = z > 0.0 && u >= 0.0 && v >= 0.0 && u <= f64::from(camera.width) && v <= f64::from(camera.height);
            inside && tracer.hit(eye, (p - eye) / distance).is_some_and(|hit| (hit.distance / distance - 1.0).abs() < tolerance)
        })
    };
    positions.iter().filter(right).count() as f64 / positions.len().max(1) as f64
}

fn config(sets: &[&str]) -> RunConfig {
    RunConfig::resolve(Some("demo"), None, &sets.iter().map(ToString::to_string).collect::<Vec<_>>()).unwrap()
}

#[test]
fn one_moving_camera_finds_what_stands_still() {
    let truth = playground();
    let shots: Vec<(usize, usize)> = (0..40).map(|i| (i, i)).collect();
    let scene = film(&truth, arc(40, 3.4), &shots);
    let find = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| find_points(&scene, InitSource::Auto, 4000, Seed::root(1)).unwrap())
    };
    let found = find(3);
    let share = on_surfaces(&scene, &truth, &found.cloud.positions[..found.matched], 0.05);
    eprintln!("{}; {:.1} % of the matched ones on surfaces", found.describe(), 100.0 * share);
    assert!(found.across_times && found.matched > 1500 && share > 0.75, "{} {share}", found.describe());
    assert_eq!(found, find(1), "the number of threads must not matter");
    assert!(found.cloud.colors.iter().flatten().all(|c| (0.0..=1.0).contains(c)));
}

#[test]
fn a_handful_of_points_of_the_dataset_is_not_enough() {
    let mut scene = film(&playground(), arc(6, 1.2), &(0..6).map(|camera| (camera, 0)).collect::<Vec<_>>());
    let own = PointCloud { positions: vec![[0.0, 0.0, 0.5]; 3], colors: vec![[0.5; 3]; 3] };
    scene.points = Some(own);
    let count = |source: &str| initialise(&scene, &config(&[source, "init.count=2000"]), Seed::root(1), &Silent).unwrap().len();
    assert_eq!(count("init.source=points"), 3, "what is asked for is what there is");
    assert!((500..=2000).contains(&count("init.source=auto")));
    let events = Recorder::default();
    initialise(&scene, &config(&["init.source=auto", "init.count=2000"]), Seed::root(1), &events).unwrap();
    assert!(events.events().iter().any(|e| matches!(e, Event::Note { message, .. } if message.contains("3 points of the dataset are few"))));
}

#[test]
fn few_cameras_at_one_time_are_used() {
    let truth = playground();
    for cameras in [2, 3] {
        // Fixed cameras: other times add no positions.
        let shots: Vec<(usize, usize)> = (0..3).flat_map(|frame| (0..cameras).map(move |c| (c, frame))).collect();
        let scene = film(&truth, arc(cameras, 0.15 * (cameras - 1) as f64), &shots);
        let found = find_points(&scene, InitSource::Photo, 3000, Seed::root(1)).unwrap();
        let share = on_surfaces(&scene, &truth, &found.cloud.positions[..found.matched], 0.05);
        eprintln!("{cameras} cameras: {}; {:.3} % of the matched ones on surfaces", found.describe(), 100.0 * share);
        assert!(!found.across_times && found.matched > 300 && share > 0.7, "{} {share}", found.describe());
    }
}

#[test]
fn a_plain_background_gives_a_hull() {
    let truth = on_magenta();
    for shots in [(0..24).map(|i| (i, i)).collect::<Vec<_>>(), (0..24).map(|i| (i, 0)).collect()] {
        let scene = film(&truth, arc(24, 6.0), &shots);
        let found = find_points(&scene, InitSource::Hull, 2000, Seed::root(1)).unwrap();
        assert!(found.hull == found.cloud.positions.len() && found.hull > 500, "{}", found.describe());
        let share = on_surfaces(&scene, &truth, &found.cloud.positions, 0.04);
        eprintln!("{}; {:.1} % near surfaces", found.describe(), 100.0 * share);
        assert!(share > 0.7, "{share}");
        let foreign = found.cloud.colors.iter().filter(|c| c[0] > 0.8 && c[1] < 0.2 && c[2] > 0.8).count();
        assert!(foreign * 20 < found.hull, "{foreign} points have the background's colour");
    }
    let full = film(&playground(), arc(8, 3.0), &(0..8).map(|i| (i, 0)).collect::<Vec<_>>());
    let error = find_points(&full, InitSource::Hull, 100, Seed::root(0)).unwrap_err().to_string();
    assert!(error.contains("plain background"), "{error}");
}

#[test]
fn later_frames_reveal_what_the_first_hides() {
    let truth = playground();
    let shots = |frames: usize| (0..frames).flat_map(|frame| (0..10).map(move |c| (c, frame))).collect::<Vec<_>>();
    let one = film(&truth, arc(10, 1.8), &shots(1));
    let three = film(&truth, arc(10, 1.8), &shots(5));
    let find = |scene: &Scene| find_points(scene, InitSource::Photo, 1_000_000, Seed::root(1)).unwrap();
    let (a, b) = (find(&one), find(&three));
    let share = on_surfaces(&three, &truth, &b.cloud.positions[..b.matched], 0.03);
    eprintln!("{} at one time, {} with later ones, {:.1} % on surfaces", a.matched, b.matched, 100.0 * share);
    assert!(b.matched > a.matched && share > 0.8, "{} {} {share}", a.matched, b.matched);
}

#[test]
fn images_from_one_position_start_from_random_points() {
    let truth = playground();
    let scene = film(&truth, arc(1, 0.0), &[(0, 0), (0, 1), (0, 2)]);
    let error = photo_points(&scene, 100, Seed::root(0)).unwrap_err().to_string();
    assert!(error.contains("one position") && error.contains("random"), "{error}");
    let events = Recorder::default();
    let host = initialise(&scene, &config(&["init.source=auto", "init.count=800"]), Seed::root(0), &events).unwrap();
    let note = events.events().iter().find_map(|e| if let Event::Note { message, .. } = e { Some(message.clone()) } else { None }).unwrap();
    assert!(host.len() >= 200 && note.contains("random"), "{} {note}", host.len());
}

#[test]
fn random_points_are_in_view_and_leave_it_open() {
    let truth = playground();
    let scene = film(&truth, arc(12, 3.0), &(0..12).map(|i| (i, 0)).collect::<Vec<_>>());
    let config = config(&["init.source=random", "init.count=3000", "init.opacity=0.5"]);
    let host = initialise(&scene, &config, Seed::root(2), &Silent).unwrap();
    assert_eq!(host.len(), 3000);
    let mut depth = 0.0;
    for row in 0..host.len() {
        let p: [f64; 3] = std::array::from_fn(|k| f64::from(host.means[3 * row + k]));
        let size = f64::from(host.log_scales[3 * row]).exp();
        let opacity = 1.0 / (1.0 + (-f64::from(host.opacity_logits[row])).exp());
        let mut seen = 0;
        for camera in &scene.cameras {
            let (u, v, z) = project(camera, p);
            if z > 0.0 && (0.0..160.0).contains(&u) && (0.0..120.0).contains(&v) {
                seen += 1;
                let pixels = size * camera.fx / z;
                assert!(pixels < 1.01 * 160.0 * 4.0 / 3000f64.sqrt(), "{pixels} pixels");
                depth += opacity * std::f64::consts::TAU * pixels * pixels / (160.0 * 120.0) / scene.cameras.len() as f64;
            }
        }
        assert!(seen >= 2, "point {row} is seen by {seen} cameras");
    }
    assert!(depth < 2.1, "the mean optical depth is {depth}");
    // The mean of an image is closer to the truth than grey is.
    let mean = |values: Vec<f32>| values.iter().sum::<f32>() / values.len() as f32;
    let blue = mean(host.sh_dc.chunks_exact(3).map(|c| c[2] - c[0]).collect());
    assert!(blue > 0.05, "the colours are those of the images: {blue}");
}

#[test]
fn plain_first_points_stay_as_they_are() {
    let scene = film(&playground(), arc(12, 3.0), &(0..12).map(|i| (i, 0)).collect::<Vec<_>>());
    let start = |plain: bool| {
        let config = config(&["init.source=random", "init.count=3000", "init.opacity=0.5", "train.sh_degree=1", &format!("init.plain={plain}")]);
        initialise(&scene, &config, Seed::root(2), &Silent).unwrap()
    };
    let (plain, limited) = (start(true), start(false));
    assert_eq!(plain.means, limited.means);
    let positions: Vec<[f32; 3]> = plain.means.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
    let points = PointCloud { colors: vec![[0.5; 3]; positions.len()], positions };
    assert_eq!(plain, from_points(&points, 1, 0.5), "random points are grey, neither smaller nor fainter");
    assert!(limited.opacity_logits != plain.opacity_logits && limited.sh_dc != plain.sh_dc);
}

#[test]
fn only_what_covers_an_image_is_made_smaller() {
    let mut scene = film(&playground(), arc(6, 1.0), &(0..6).map(|i| (i, 0)).collect::<Vec<_>>());
    let grid: Vec<[f32; 3]> = (0..1000).map(|i| [i % 10, i / 10 % 10, i / 100].map(|k| 0.1 * (k as f32 - 4.5))).collect();
    let start = |scene: &Scene| initialise(scene, &config(&["init.source=points", "train.sh_degree=2"]), Seed::root(0), &Silent).unwrap();
    let mut points = PointCloud { colors: vec![[0.5; 3]; grid.len()], positions: grid };
    scene.points = Some(points.clone());
    assert_eq!(start(&scene), from_points(&points, 2, 0.1), "ordinary points stay as they are");
    points.positions.push([0.0, 0.0, 40.0]);
    points.colors.push([0.5; 3]);
    scene.points = Some(points.clone());
    let (plain, capped) = (from_points(&points, 2, 0.1), start(&scene));
    assert_eq!(plain.log_scales[..3000], capped.log_scales[..3000]);
    assert!(plain.log_scales[3000] > capped.log_scales[3000] + 1.0, "{} {}", plain.log_scales[3000], capped.log_scales[3000]);
    let config = config(&["init.source=points", "train.sh_degree=2", "init.plain=true"]);
    assert_eq!(initialise(&scene, &config, Seed::root(0), &Silent).unwrap(), plain);
}
