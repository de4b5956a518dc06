//! Scenes that cannot be reconstructed are refused with the likely cause, correct ones are not, and runs say how they went.

use super::readers::common::{load, options, real};
use cc4dgs::{backends as _, codecs as _, deformers as _, parts as _};
use cc4dgs_core::{Camera, Error, Event, FrameSource, Image8, Limits, Recorder, Registry, Result, Scene, SceneOptions, Similarity, Split, View};
use cc4dgs_play::Model;
use cc4dgs_train::checks::{Finding, Judgement, Severity, Subject, check_scene};
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::data::{self, procedural::NAMES};
use cc4dgs_train::train::{TrainJob, TrainReport, train};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Images of another scene, changed.
struct Changed<F>(Arc<Scene>, F);

impl<F: Fn(&Scene, usize) -> Result<Image8> + Send + Sync> FrameSource for Changed<F> {
    fn load(&self, view: usize) -> Result<Image8> {
        self.1(&self.0, view)
    }
}

fn builtin(name: &str) -> Arc<Scene> {
    let wanted = SceneOptions { width: 96, ..options() };
    Arc::new(data::open(Path::new(&format!("procedural:{name}")), &wanted, &Registry::collect().unwrap(), &Limits::default()).unwrap())
}

/// `scene` without points, with other cameras, views and images.
fn remade(scene: &Arc<Scene>, cameras: Vec<Camera>, views: Vec<View>, image: impl Fn(&Scene, usize) -> Result<Image8> + Send + Sync + 'static) -> Scene {
    let mut remade = Scene::new("damaged", cameras, views, Arc::new(Changed(scene.clone(), image)), 100_000_000).unwrap();
    remade.background = scene.background;
    remade
}

fn image(scene: &Scene, view: usize) -> Result<Image8> {
    Ok((*scene.frame(view)?).clone())
}

/// The scene with its cameras changed.
fn with_cameras(scene: &Arc<Scene>, change: impl Fn(usize, &Camera) -> Camera) -> Scene {
    remade(scene, scene.cameras.iter().enumerate().map(|(index, camera)| change(index, camera)).collect(), scene.views.clone(), image)
}

fn findings(scene: &Scene) -> Vec<Finding> {
    check_scene(scene, scene.background.unwrap_or([1.0; 3])).unwrap()
}

/// The one finding about `subject`, of at least the given severity.
fn found(what: &str, scene: &Scene, subject: Subject, severity: Severity) -> String {
    let all = findings(scene);
    let wanted = |f: &&Finding| f.subject == subject && (f.severity == severity || severity == Severity::Doubt);
    let finding = all.iter().find(wanted).unwrap_or_else(|| panic!("{what}: {all:?}"));
    format!("{}. {}", finding.problem, finding.remedy)
}

#[test]
fn correct_scenes_are_not_refused() {
    let mut wrong = Vec::new();
    for name in NAMES {
        wrong.extend(findings(&builtin(name)).into_iter().map(|finding| format!("{name}: {finding:?}")));
    }
    for name in ["panoptic_basketball", "dnerf_mutant", "fox_third", "n3dv_flame_steak_1frame"] {
        let Some(path) = real(name) else { continue };
        wrong.extend(findings(&load(&path).unwrap()).into_iter().map(|finding| format!("{name}: {finding:?}")));
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn wrong_poses_are_found() {
    let scene = builtin("default");
    let count = scene.split(Split::Train).len() / scene.frame_count;
    // The training cameras come first.
    let other = |index: usize| if index < count { (index * 5 + 3) % count } else { index };
    let shuffled = with_cameras(&scene, |index, camera| Camera { name: camera.name.clone(), ..scene.cameras[other(index)].clone() });
    assert!(found("shuffled", &shuffled, Subject::Poses, Severity::Refuse).contains("poses are shuffled"));
    let flipped = |signs: [f64; 3]| {
        with_cameras(&scene, move |_, camera| {
            let mut turned = camera.clone();
            turned.world_to_camera.iter_mut().zip(signs).for_each(|(row, sign)| row.iter_mut().for_each(|v| *v *= sign));
            turned
        })
    };
    assert!(found("facing away", &flipped([-1.0, 1.0, -1.0]), Subject::Poses, Severity::Refuse).contains("axes"));
    assert!(found("other axes", &flipped([1.0, -1.0, -1.0]), Subject::Poses, Severity::Refuse).contains("axes"));
    let halves = with_cameras(&scene, |index, camera| {
        let scale = if index % 2 == 0 { 2.0 } else { 1.0 };
        Similarity { scale, translation: [0.0; 3] }.apply_camera(camera)
    });
    found("half of the cameras in another unit", &halves, Subject::Poses, Severity::Doubt);
    // One camera alone is named.
    let one = with_cameras(&scene, |index, camera| if index == 4 { Camera { name: camera.name.clone(), ..scene.cameras[9].clone() } } else { camera.clone() });
    assert!(found("one wrong pose", &one, Subject::Poses, Severity::Doubt).contains(&scene.cameras[4].name));
}

#[test]
fn wrong_focal_lengths_of_real_cameras_are_found() {
    for name in ["panoptic_basketball", "fox_third", "n3dv_flame_steak_1frame"] {
        let Some(path) = real(name) else { continue };
        let scene = Arc::new(load(&path).unwrap());
        for (factor, better) in [(1.3, "0.75"), (0.75, "1.33")] {
            let zoomed = with_cameras(&scene, |_, camera| Camera { fx: factor * camera.fx, fy: factor * camera.fy, ..camera.clone() });
            let message = found(name, &zoomed, Subject::Poses, Severity::Refuse);
            assert!(message.contains(&format!("focal lengths times about {better} fit better")), "{name}: {message}");
        }
    }
}

#[test]
fn images_cameras_and_times_without_sense_are_found() {
    let scene = builtin("default");
    let train = scene.split(Split::Train);
    let only = |keep: &dyn Fn(usize, &View) -> bool| -> Vec<usize> { train.iter().copied().filter(|&v| keep(v, &scene.views[v])).collect() };
    // `kept` views, changed, with their images.
    let part = |kept: Vec<usize>, change: fn(&View) -> View| {
        let views = kept.iter().map(|&v| change(&scene.views[v])).collect();
        remade(&scene, scene.cameras.clone(), views, move |scene, view| image(scene, kept[view]))
    };
    let black = |scene: &Scene, view: usize| {
        let mut image = image(scene, view)?;
        image.data.fill(0);
        Ok(image)
    };
    let all_black = remade(&scene, scene.cameras.clone(), scene.views.clone(), black);
    assert!(found("black", &all_black, Subject::Images, Severity::Refuse).contains("are black"));
    let some_black =
        remade(
            &scene,
            scene.cameras.clone(),
            scene.views.clone(),
            move |scene, view| {
                if scene.views[view].camera == 2 { black(scene, view) } else { image(scene, view) }
            },
        );
    assert!(found("one camera black", &some_black, Subject::Images, Severity::Doubt).contains(&scene.cameras[2].name));

    let one = part(vec![train[0]], View::clone);
    assert!(found("one image", &one, Subject::Cameras, Severity::Refuse).contains("one training image only"));
    let fixed = part(only(&|_, view| view.camera == 0), View::clone);
    assert!(found("one fixed camera", &fixed, Subject::Cameras, Severity::Refuse).contains("parallax"));

    let timeless = part(train.clone(), |view| View { frame: 0, time_norm: 0.0, ..view.clone() });
    let message = found("all times zero", &timeless, Subject::Times, Severity::Refuse);
    assert!(message.contains("10 images of camera") && message.contains("are at time 0"), "{message}");
    let wanted = SceneOptions { width: 96, frames: Some([0, 40, 1]), ..options() };
    let scene = Arc::new(data::open(Path::new("procedural"), &wanted, &Registry::collect().unwrap(), &Limits::default()).unwrap());
    let mut order: Vec<usize> = (0..40).collect();
    let disorder = |frame: usize| ((frame as f64 * 12.9898).sin() * 43_758.545_3).rem_euclid(1.0);
    order.sort_by(|&a, &b| disorder(a).total_cmp(&disorder(b)));
    let mixed = remade(&scene, scene.cameras.clone(), scene.views.clone(), move |scene, view| {
        let View { camera, frame, .. } = scene.views[view];
        let source = scene.views.iter().position(|v| (v.camera, v.frame) == (camera, order[frame])).unwrap_or(view);
        image(scene, source)
    });
    found("frames out of order", &mixed, Subject::Times, Severity::Doubt);
}

/// A run of a thousand iterations at the smallest size.
fn run(scene: &Arc<Scene>, sets: &[&str]) -> (Result<(Model, TrainReport)>, Vec<Event>) {
    let base = ["train.iterations=1000", "init.count=200", "density={kind='none'}", "train.time_ramp=0.0", "device=flex"];
    let sets: Vec<String> = base.iter().chain(sets).map(ToString::to_string).collect();
    let config = RunConfig::resolve(Some("demo"), None, &sets).unwrap();
    let (registry, events, stop) = (Registry::collect().unwrap(), Recorder::default(), AtomicBool::new(false));
    let job = TrainJob { config: &config, scene: scene.clone(), out: None, resume: false, registry: &registry, events: &events, stop: &stop, observer: None };
    (train(&job), events.events())
}

#[test]
fn a_run_ends_with_a_verdict_and_checks_do_not_change_it() {
    let open = |options: &SceneOptions| Arc::new(data::open(Path::new("procedural:tiny"), options, &Registry::collect().unwrap(), &Limits::default()).unwrap());
    let scene = open(&options());
    let (checked, events) = run(&scene, &["train.validation=3"]);
    let (model, report) = checked.unwrap();
    let verdict = report.verdict.unwrap();
    assert!(verdict.train_psnr_db > verdict.baselines.blur_db && verdict.baselines.blur_db > verdict.baselines.mean_colour_db, "{verdict:?}");
    assert!(verdict.validation_psnr_db.is_some() && verdict.judgement != Judgement::Doubtful, "{verdict:?}");
    assert!(events.iter().any(|e| matches!(e, Event::Note { object, message } if object == "verdict" && *message == verdict.sentence)));
    let (unchecked, _) = run(&scene, &["train.validation=3", "train.checks=false"]);
    let (same, report) = unchecked.unwrap();
    assert!(report.verdict.is_none() && same.gaussians == model.gaussians);
    let (refused, _) = run(&scene, &["train.validation=23"]);
    assert!(refused.err().unwrap().to_string().contains("train.validation"));
    // The caller's scene is as it was.
    assert_eq!(scene.split(Split::Train).len(), 24);
}

#[test]
fn a_run_that_learns_nothing_fails() {
    let scene = builtin("tiny");
    let still = "train.lr={means=0.0,means_end=0.0,log_scales=0.0,quaternions=0.0,opacity=0.0,sh_dc=0.0,sh_rest=0.0,score=0.0,extra=0.0}";
    let (failed, _) = run(&scene, &[still, "init.source=random"]);
    let error = failed.err().unwrap();
    assert!(matches!(error, Error::Failed { .. }) && error.exit_code() == 6, "{error}");
    assert!(error.to_string().contains("less than") && error.to_string().contains("train.iterations = 3000"), "{error}");
    assert!(run(&scene, &[still, "init.source=random", "train.checks=false"]).0.is_ok());
}
