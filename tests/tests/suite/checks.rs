//! Scenes that cannot be reconstructed are refused with the likely cause, correct ones are not, and runs say how they went.

use super::readers::common::{load, options, real};
use cc4dgs::{backends as _, codecs as _, deformers as _, parts as _};
use cc4dgs_core::{Camera, Error, Event, EventSink, FrameSource, Image8, Limits, Recorder, Registry, Result, Scene, SceneOptions, Similarity, Split, View};
use cc4dgs_play::Model;
use cc4dgs_play::checkpoint::{CHECKPOINT, CheckpointFile};
use cc4dgs_train::checks::{Finding, Judgement, Severity, Subject, check_scene};
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::data::{self, procedural::NAMES};
use cc4dgs_train::train::{TrainJob, TrainReport, train};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

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
fn configured(sets: &[&str]) -> RunConfig {
    let base = ["train.iterations=1000", "init.count=200", "density={kind='none'}", "train.time_ramp=0.0", "device=flex"];
    let sets: Vec<String> = base.iter().chain(sets).map(ToString::to_string).collect();
    RunConfig::resolve(Some("demo"), None, &sets).unwrap()
}

/// The run of [`configured`], in the folder `out` if there is one; it is interrupted once `stops` says so of an event.
fn run_in(scene: &Arc<Scene>, sets: &[&str], out: Option<&Path>, resume: bool, stops: fn(&Event) -> bool) -> (Result<(Model, TrainReport)>, Vec<Event>) {
    run_as(&configured(sets), scene, out, resume, stops)
}

fn run_as(config: &RunConfig, scene: &Arc<Scene>, out: Option<&Path>, resume: bool, stops: fn(&Event) -> bool) -> (Result<(Model, TrainReport)>, Vec<Event>) {
    let registry = Registry::collect().unwrap();
    let listener = Listener { heard: Recorder::default(), stops, stop: AtomicBool::new(false) };
    let (out, scene, events, stop) = (out.map(Path::to_path_buf), scene.clone(), &listener, &listener.stop);
    let trained = train(&TrainJob { config, scene, out, resume, registry: &registry, events, stop, observer: None });
    (trained, listener.heard.events())
}

fn run(scene: &Arc<Scene>, sets: &[&str]) -> (Result<(Model, TrainReport)>, Vec<Event>) {
    run_in(scene, sets, None, false, |_| false)
}

/// Remembers events, and interrupts the run at one of them.
struct Listener {
    heard: Recorder,
    stops: fn(&Event) -> bool,
    stop: AtomicBool,
}

impl EventSink for Listener {
    fn emit(&self, event: &Event) {
        self.heard.emit(event);
        if (self.stops)(event) {
            self.stop.store(true, Ordering::Relaxed);
        }
    }
}

/// What the notes of the verdict say.
fn verdicts(events: &[Event]) -> Vec<&String> {
    events.iter().filter_map(|e| if let Event::Note { object, message } = e { (object == "verdict").then_some(message) } else { None }).collect()
}

/// Nothing is learned with these rates, and random points show nothing.
const LEARNS_NOTHING: [&str; 2] =
    ["train.lr={means=0.0,means_end=0.0,log_scales=0.0,quaternions=0.0,opacity=0.0,sh_dc=0.0,sh_rest=0.0,score=0.0,extra=0.0}", "init.source=random"];

#[test]
fn a_run_ends_with_a_verdict_and_checks_do_not_change_it() {
    let open = |options: &SceneOptions| Arc::new(data::open(Path::new("procedural:tiny"), options, &Registry::collect().unwrap(), &Limits::default()).unwrap());
    let scene = open(&options());
    let (checked, events) = run(&scene, &["train.validation=3"]);
    let (model, report) = checked.unwrap();
    let verdict = report.verdict.unwrap();
    assert!(verdict.train_psnr_db > verdict.baselines.blur_db && verdict.baselines.blur_db > verdict.baselines.mean_colour_db, "{verdict:?}");
    assert!(verdict.validation_psnr_db.is_some() && verdict.judgement != Judgement::Doubtful, "{verdict:?}");
    assert_eq!(verdicts(&events), [&verdict.sentence]);
    let (unchecked, _) = run(&scene, &["train.validation=3", "train.checks=false"]);
    let (same, report) = unchecked.unwrap();
    assert!(report.verdict.is_none() && same.gaussians == model.gaussians);
    let (refused, _) = run(&scene, &["train.validation=23"]);
    assert!(refused.err().unwrap().to_string().contains("train.validation"));
    // The caller's scene is as it was.
    assert_eq!(scene.split(Split::Train).len(), 24);
}

#[test]
fn a_run_that_learns_nothing_stops_on_its_way() {
    let (scene, folder) = (builtin("tiny"), tempfile::tempdir().unwrap());
    let [whole, parts] = ["whole", "parts"].map(|name| folder.path().join(name));
    // No score stage: the main stage has 800 iterations.
    let sets = [&LEARNS_NOTHING[..], &["train.shares=[1,0,4]", "train.dynamic=none", "train.checkpoint_every=0", "train.log_every=10"]].concat();
    let last_iteration =
        |events: &[Event]| events.iter().filter_map(|e| if let Event::Iteration { iteration, .. } = e { Some(*iteration) } else { None }).next_back();

    let (failed, events) = run_in(&scene, &sets, Some(&whole), false, |_| false);
    let error = failed.err().unwrap();
    assert!(matches!(error, Error::Failed { .. }) && error.exit_code() == 6, "{error}");
    for words in ["stopped at iteration 680 of 800 of the main stage", "less than", "train.iterations = 3000"] {
        assert!(error.to_string().contains(words), "{words}: {error}");
    }
    assert_eq!(last_iteration(&events), Some(680));
    let bytes = |out: &Path| std::fs::read(out.join("checkpoint")).unwrap();
    let stopped = bytes(&whole);

    // Resumed, it fails with the same words and without an iteration.
    let (again, events) = run_in(&scene, &sets, Some(&whole), true, |_| false);
    assert_eq!((again.err().unwrap().to_string(), last_iteration(&events)), (error.to_string(), None));
    assert!(bytes(&whole) == stopped);
    // Interrupted between the scores, it ends in the same way.
    let (interrupted, _) = run_in(&scene, &sets, Some(&parts), false, |e| matches!(e, Event::Iteration { stage, iteration: 500, .. } if stage == "main"));
    assert!(matches!(interrupted, Err(Error::Interrupted(_))));
    let (resumed, events) = run_in(&scene, &sets, Some(&parts), true, |_| false);
    assert_eq!((resumed.err().unwrap().to_string(), last_iteration(&events)), (error.to_string(), Some(680)));
    assert!(bytes(&parts) == stopped);
    // Without checks it goes on from there.
    let unchecked = [&sets[..], &["train.checks=false"]].concat();
    let (finished, events) = run_in(&scene, &unchecked, Some(&whole), true, |_| false);
    assert!(finished.unwrap().1.verdict.is_none());
    assert_eq!(last_iteration(&events), Some(800));
}

#[test]
fn short_runs_are_judged_at_their_end_and_shorter_ones_are_not() {
    let scene = builtin("tiny");
    let with = |sets: &[&str], iterations: &str| run(&scene, &[sets, &[iterations]].concat());
    let (failed, _) = with(&LEARNS_NOTHING, "train.iterations=300");
    let error = failed.err().unwrap();
    assert!(matches!(error, Error::Failed { .. }) && error.to_string().contains("after 300 iterations training views reach"), "{error}");
    let (sound, events) = with(&[], "train.iterations=300");
    assert_eq!(verdicts(&events), [&sound.unwrap().1.verdict.unwrap().sentence]);

    let (unjudged, events) = with(&LEARNS_NOTHING, "train.iterations=299");
    assert!(unjudged.unwrap().1.verdict.is_none());
    assert!(matches!(verdicts(&events)[..], [said] if said.contains("299 iterations are too few")), "{events:?}");
    let (_, events) = with(&LEARNS_NOTHING[..1], "train.checks=false");
    assert!(verdicts(&events).is_empty());
}

#[test]
fn a_run_is_judged_by_the_length_that_it_gets() {
    let (scene, folder) = (builtin("tiny"), tempfile::tempdir().unwrap());
    // 264 iterations of the main stage are planned.
    let sets = [&LEARNS_NOTHING[..], &["train.iterations=330", "train.shares=[1,0,4]", "train.dynamic=none", "train.checkpoint_every=0"]].concat();
    // The outcome of a run with so much time, and the iterations at which it was scored.
    let ended = |seconds: u64| {
        let mut config = configured(&sets);
        config.auto.time_left = Some(Duration::from_secs(seconds));
        let out = folder.path().join(seconds.to_string());
        let (trained, events) = run_as(&config, &scene, Some(&out), false, |_| false);
        let header: serde_json::Value = CheckpointFile::read(&out.join(CHECKPOINT), &Limits::default()).unwrap().header().unwrap();
        let scores = header["training"]["record"]["scores"].as_array().unwrap().iter().map(|score| score["percent"].as_u64().unwrap()).collect::<Vec<_>>();
        (trained, events, scores)
    };
    let (long, _, scores) = ended(36_000);
    let error = long.err().unwrap().to_string();
    assert!(error.contains("stopped at iteration 897 of 1056 of the main stage"), "{error}");
    assert_eq!(scores, [0, 50, 85]);
    let (short, events, scores) = ended(0);
    assert!(short.unwrap().1.verdict.is_none() && scores.is_empty(), "{scores:?}");
    assert!(matches!(verdicts(&events)[..], [said] if said.contains("251 iterations are too few")), "{events:?}");
    // The same from a file that states the length.
    let (stated, _) = run(&scene, &[&sets[..], &["train.iterations=120", "train.stretch=4.0"]].concat());
    let error = stated.err().unwrap().to_string();
    assert!(error.contains("after 408 iterations training views reach"), "{error}");
}

#[test]
fn a_static_deformer_is_warned_once() {
    let (trained, events) = run(&builtin("tiny"), &["deformer={kind='none'}"]);
    let warned = events.iter().filter(|e| matches!(e, Event::Warning { message, .. } if message.contains("this run holds everything still"))).count();
    assert!(trained.unwrap().1.verdict.is_some() && warned == 1, "{events:?}");
}

#[test]
fn the_readers_validation_views_are_scored_without_being_asked_for() {
    let tiny = builtin("tiny");
    let names_them = |readable: bool| {
        let mut views = tiny.views.clone();
        views.iter_mut().filter(|view| view.split == Split::Test).for_each(|view| view.split = Split::Validation);
        let mut scene = remade(&tiny, tiny.cameras.clone(), views, move |scene, view| match scene.views[view].split {
            Split::Test if !readable => Err(Error::data(format!("view {view}"), "it is damaged", "None")),
            _ => image(scene, view),
        });
        scene.points.clone_from(&tiny.points);
        Arc::new(scene)
    };
    let sets = ["train.iterations=300", "train.validation=0"];
    let (with, without) = (run(&names_them(true), &sets).0.unwrap(), run(&names_them(true), &[&sets[..], &["train.checks=false"]].concat()).0.unwrap());
    let verdict = with.1.verdict.unwrap();
    assert!(verdict.validation_psnr_db.is_some_and(|db| db > verdict.baselines.mean_colour_db), "{verdict:?}");
    assert!(with.0.gaussians == without.0.gaussians, "scoring validation views changed the training");
    // No setting asks for these views: damaged ones do not end the run.
    let (trained, events) = run(&names_them(false), &sets);
    assert_eq!(trained.unwrap().1.verdict.unwrap().validation_psnr_db, None);
    assert!(events.iter().any(|e| matches!(e, Event::Warning { object, .. } if object == "validation views")));
}
