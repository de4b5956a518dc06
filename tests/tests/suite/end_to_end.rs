//! Complete runs on the built-in scene at small size: reproducibility, resuming, archives, options.

use burn::tensor::Device;
use cc4dgs::{backends as _, codecs as _, deformers as _, parts as _};
use cc4dgs_core::{Error, Event, EventSink, Limits, PresetRole, Recorder, Registry, Scene, Silent, Split};
use cc4dgs_play::checkpoint::CHECKPOINT;
use cc4dgs_play::player::Player;
use cc4dgs_play::{ArchiveOptions, Model};
use cc4dgs_tests::StopAfter;
use cc4dgs_train::agreement::agreement;
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::eval::{EvalReport, Scored, evaluate};
use cc4dgs_train::train::{CONFIG, TrainJob, TrainReport, train};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock};

/// The demo at small size with `clone-split`: every stage runs, and every kind of density control happens at least once.
fn tiny(extra: &[&str]) -> RunConfig {
    tiny_of("demo", extra)
}

/// [`tiny`] with another method.
fn tiny_of(preset: &str, extra: &[&str]) -> RunConfig {
    let small = ["scene.width=48", "scene.height=48", "train.iterations=160", "train.batch=2", "init.count=400"];
    let mut sets: Vec<String> =
        small.iter().chain(&["train.log_every=5", "train.lambda_r=0.01", "density.kind=clone-split"]).map(ToString::to_string).collect();
    sets.extend(extra.iter().map(ToString::to_string));
    RunConfig::resolve(Some(preset), None, &sets).unwrap()
}

/// Storage with `codec` and the weight codec `field_weights`, without a scene.
fn options<'a>(codec: &'a str, field_weights: &'a str) -> ArchiveOptions<'a> {
    static NO_SETTINGS: LazyLock<toml::Table> = LazyLock::new(toml::Table::new);
    ArchiveOptions { codec, settings: &NO_SETTINGS, field_weights, views: None, tuner: None }
}

fn open(config: &RunConfig) -> Arc<Scene> {
    Arc::new(cc4dgs_train::data::open(Path::new("procedural"), &config.scene, &Registry::collect().unwrap(), &config.limits).unwrap())
}

fn run(config: &RunConfig, out: &Path, resume: bool, events: &dyn EventSink, stop: &AtomicBool) -> cc4dgs_core::Result<TrainReport> {
    let registry = Registry::collect().unwrap();
    train(&TrainJob { config, scene: open(config), out: Some(out.to_path_buf()), resume, registry: &registry, events, stop, observer: None })
        .map(|(_, report)| report)
}

fn load(path: &Path) -> Model {
    Model::open(path, &Registry::collect().unwrap(), &Device::flex(), &Limits::default(), &Silent).unwrap()
}

fn score(model: &Model, config: &RunConfig) -> EvalReport {
    let registry = Registry::collect().unwrap();
    evaluate(model, &open(config), Scored::all(Split::Test), &registry, &Device::flex(), &Silent, &mut |_, _, _, _| Ok(())).unwrap()
}

#[test]
fn same_seed_gives_the_same_bytes_and_resuming_does_too() {
    let config = tiny(&[]);
    let folder = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    let [a, b, c] = ["a", "b", "c"].map(|name| folder.path().join(name));
    let recorder = Recorder::default();
    run(&config, &a, false, &recorder, &never).unwrap();
    run(&config, &b, false, &Silent, &never).unwrap();
    let bytes = |out: &Path| std::fs::read(out.join(CHECKPOINT)).unwrap();
    assert!(bytes(&a) == bytes(&b), "two runs of one seed differ");

    // Interrupted in the coarse, the score and the main stage, and resumed each time.
    let mut resume = false;
    for events_before_stop in [3, 4, 6] {
        let stop = AtomicBool::new(false);
        let listener = StopAfter { left: AtomicUsize::new(events_before_stop), stop: &stop };
        match run(&config, &c, resume, &listener, &stop) {
            Err(Error::Interrupted(_)) => resume = true,
            other => panic!("expected an interruption, got {other:?}"),
        }
    }
    run(&config, &c, true, &Silent, &never).unwrap();
    assert!(bytes(&a) == bytes(&c), "an interrupted and resumed run differs from an uninterrupted one");

    let stages: Vec<String> =
        recorder.events().iter().filter_map(|e| if let Event::StageFinished { stage, .. } = e { Some(stage.clone()) } else { None }).collect();
    assert_eq!(stages, ["coarse", "score", "main"]);
    assert!(recorder.events().iter().any(|e| matches!(e, Event::Densified { .. })), "nothing was densified");

    // Equal checkpoints give equal archives, and an archive renders the same images as its checkpoint.
    let registry = Registry::collect().unwrap();
    let archives = [(&a, "a.cc4d"), (&b, "b.cc4d")].map(|(run, name)| {
        let path = folder.path().join(name);
        load(run).save_archive(&path, &options("cca:default", "fp32"), &registry, &Limits::default(), &Silent).unwrap();
        std::fs::read(path).unwrap()
    });
    assert!(archives[0] == archives[1], "archives of equal checkpoints differ");
    let (before, after) = (score(&load(&a), &config), score(&load(&folder.path().join("a.cc4d")), &config));
    assert!((before.psnr_db - after.psnr_db).abs() < 0.5, "{} dB became {} dB", before.psnr_db, after.psnr_db);
    assert!(after.size_mb.total < before.size_mb.total);
}

#[test]
fn a_training_has_the_same_bytes_on_any_number_of_threads() {
    let (config, folder, never) = (tiny(&["train.iterations=60"]), tempfile::tempdir().unwrap(), AtomicBool::new(false));
    let of = |threads: usize| {
        let out = folder.path().join(threads.to_string());
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| run(&config, &out, false, &Silent, &never)).unwrap();
        std::fs::read(out.join(CHECKPOINT)).unwrap()
    };
    assert!(of(1) == of(3), "the number of threads shows");
}

#[test]
fn a_run_that_has_time_left_is_longer_and_its_settings_repeat_it() {
    let mut config = tiny(&["train.iterations=60"]);
    let planned = config.train.iterations;
    config.auto.time_left = Some(std::time::Duration::from_secs(36_000));
    let folder = tempfile::tempdir().unwrap();
    let [a, b, c] = ["a", "b", "c"].map(|name| folder.path().join(name));
    let never = AtomicBool::new(false);
    let report = run(&config, &a, false, &Silent, &never).unwrap();
    let settled = RunConfig::resolve(None, Some(&a.join(CONFIG)), &[]).unwrap();
    assert_eq!(settled.train.stretch, 4.0, "the largest factor");
    assert!(report.iterations > 3 * planned && settled.train.iterations == planned && settled.auto.time_left.is_none(), "{}", report.iterations);
    run(&settled, &b, false, &Silent, &never).unwrap();
    let bytes = |out: &Path| std::fs::read(out.join(CHECKPOINT)).unwrap();
    assert!(bytes(&a) == bytes(&b), "the settings of a run that settled its length do not repeat it");

    // Interrupted after the length was settled, and before: the checkpoint says how much time was left.
    for (events_before_stop, stretch) in [(16, 4.0), (5, 1.0)] {
        let stop = AtomicBool::new(false);
        let listener = StopAfter { left: AtomicUsize::new(events_before_stop), stop: &stop };
        let _ = std::fs::remove_dir_all(&c);
        assert!(matches!(run(&config, &c, false, &listener, &stop), Err(Error::Interrupted(_))));
        let left = RunConfig::resolve(None, Some(&c.join(CONFIG)), &[]).unwrap();
        assert_eq!(left.train.stretch, stretch);
        run(&left, &c, true, &Silent, &never).unwrap();
        assert!(bytes(&a) == bytes(&c), "interrupted with a stretch of {stretch}");
    }
}

/// Sets the stop flag when scores are fitted.
struct StopAfterScores<'a>(&'a AtomicBool);

impl EventSink for StopAfterScores<'_> {
    fn emit(&self, event: &Event) {
        if matches!(event, Event::StageFinished { stage, .. } if stage == "score") {
            self.0.store(true, Ordering::Relaxed);
        }
    }
}

#[test]
fn key_frames_are_added_once_however_a_run_is_interrupted() {
    let config = tiny_of("demo+free-time", &["train.key_frames=4", "train.dynamic=score", "train.iterations=60", "scene.width=96", "scene.height=96"]);
    let folder = tempfile::tempdir().unwrap();
    let [a, b] = ["a", "b"].map(|name| folder.path().join(name));
    let (recorder, never, stop) = (Recorder::default(), AtomicBool::new(false), AtomicBool::new(false));
    run(&config, &a, false, &recorder, &never).unwrap();
    let added = |e: &Event| matches!(e, Event::Note { message, .. } if message.contains("points of") && message.contains("key frames"));
    assert!(recorder.events().iter().any(added), "no key frames: {:?}", recorder.events());
    assert!(matches!(run(&config, &b, false, &StopAfterScores(&stop), &stop), Err(Error::Interrupted(_))));
    run(&config, &b, true, &Silent, &never).unwrap();
    let bytes = |out: &Path| std::fs::read(out.join(CHECKPOINT)).unwrap();
    assert!(bytes(&a) == bytes(&b), "an interruption changed the run");
}

#[test]
fn what_key_frames_add_counts_before_a_warning_that_nothing_moves() {
    // No score gets there; the Gaussians of key frames are given one.
    let zeta = ["train.key_frames=4", "train.dynamic=score", "train.zeta=1e6", "train.iterations=12", "scene.width=96", "scene.height=96"];
    let recorder = Recorder::default();
    run(&tiny_of("demo+free-time", &zeta), tempfile::tempdir().unwrap().path(), false, &recorder, &AtomicBool::new(false)).unwrap();
    let events = recorder.events();
    let added = events.iter().position(|e| matches!(e, Event::Note { object, .. } if object == "key frames")).unwrap();
    let warned = events.iter().position(|e| matches!(e, Event::Warning { object, message } if object == "deformer" && message.contains("train.zeta")));
    assert!(warned.is_none_or(|warned| warned > added), "{events:?}");
}

#[test]
fn a_training_that_is_refused_leaves_the_run_before() {
    let folder = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    run(&tiny(&["train.iterations=12", "train.shares=[1,0,0]"]), folder.path(), false, &Silent, &never).unwrap();
    let before = std::fs::read(folder.path().join(CHECKPOINT)).unwrap();
    let wrong = tiny(&["train.iterations=12", "loss=[{kind='l1',weight=0}]"]);
    assert!(run(&wrong, folder.path(), false, &Silent, &never).is_err());
    assert!(std::fs::read(folder.path().join(CHECKPOINT)).unwrap() == before, "the checkpoint is gone");
}

#[test]
fn resuming_with_another_configuration_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = tiny(&["train.iterations=12", "train.shares=[1,0,0]"]);
    let never = AtomicBool::new(false);
    run(&config, folder.path(), false, &Silent, &never).unwrap();
    let other = tiny(&["train.iterations=12", "train.shares=[1,0,0]", "loss=[{kind='l1'}]"]);
    let message = run(&other, folder.path(), true, &Silent, &never).unwrap_err().to_string();
    assert!(message.contains("--resume"), "{message}");
}

#[test]
fn cache_and_reuse_change_the_work_and_not_the_image() {
    let folder = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    let base = tiny_of("demo+cdf", &["train.dynamic=all", "train.iterations=60"]);
    run(&base, folder.path(), false, &Silent, &never).unwrap();
    let registry = Registry::collect().unwrap();
    let scene = open(&base);
    let camera = scene.camera(0);
    let mut images = Vec::new();
    for (cache, reuse) in [(true, true), (false, false)] {
        let mut model = load(folder.path());
        let field = model.field.take().unwrap();
        let mut section = field.section.clone();
        section.insert("cache".into(), cache.into());
        section.insert("vertex_reuse".into(), reuse.into());
        let mut rebuilt = registry.build_deformer(&section, &field.context, &Device::flex()).unwrap();
        for (to, from) in rebuilt.parameters_mut().into_iter().zip(field.field.parameters()) {
            to.value = from.value.clone();
        }
        model.field = Some(cc4dgs_play::model::ModelDeformer { field: rebuilt, section, context: field.context });
        let mut player = Player::new(&model, &registry, &Device::flex()).unwrap();
        let frames: Vec<Vec<f32>> =
            [0.0, 0.3, 0.9].iter().map(|&t| player.render(camera, t).unwrap().0.planes.into_data().try_to_vec::<f32>().unwrap()).collect();
        let work = player.work;
        assert_eq!(work.spatial_cached, if cache { 2 } else { 0 });
        if reuse {
            assert!(work.spatial.vertices_decoded < work.spatial.vertices_queried / 2);
        } else {
            assert_eq!(work.spatial.vertices_decoded, work.spatial.vertices_queried);
        }
        images.push(frames);
    }
    assert!(images[0] == images[1], "caching or reuse changed the image");
}

#[test]
fn static_gaussians_cost_no_field_time() {
    let folder = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    let config = tiny(&["train.zeta=0.3"]);
    let report = run(&config, folder.path(), false, &Silent, &never).unwrap();
    let model = load(folder.path());
    let mut player = Player::new(&model, &Registry::collect().unwrap(), &Device::flex()).unwrap();
    player.gaussians_at(0.5).unwrap();
    let longest = open(&config).cameras.iter().map(|c| (c.fx * c.fy).sqrt()).fold(0.0, f64::max);
    assert!(model.render.focal.is_some_and(|focal| (longest..longest + 0.011).contains(&focal)), "{:?}, {longest}", model.render);
    let still = (report.gaussians - report.dynamic_gaussians) as u64;
    assert!(still > 0 && report.dynamic_gaussians > 0, "{report:?}");
    // Training keeps what moves first, whatever density control does.
    assert_eq!(model.moving.rows(&model.gaussians.dynamic_scores), Some((0..report.dynamic_gaussians).collect()));
    assert_eq!((player.work.deformed, player.work.static_skipped), (report.dynamic_gaussians as u64, still));
    assert_eq!(player.work.spatial.gaussians, report.dynamic_gaussians as u64);
    // Frames are updated in place unless the last one is still referenced; the result is the same in both cases.
    let registry = Registry::collect().unwrap();
    for (name, device) in cc4dgs_tests::devices() {
        let model = Model::open(folder.path(), &registry, &device, &Limits::default(), &Silent).unwrap();
        let fresh = |time| Player::new(&model, &registry, &device).unwrap().gaussians_at(time).unwrap().to_host().unwrap();
        let mut player = Player::new(&model, &registry, &device).unwrap();
        let kept = player.gaussians_at(0.2).unwrap();
        assert!(player.gaussians_at(0.9).unwrap().to_host().unwrap() == fresh(0.9), "{name}: a frame depends on the one before it");
        assert!(player.gaussians_at(0.4).unwrap().to_host().unwrap() == fresh(0.4), "{name}: a frame depends on the ones before it");
        assert!(kept.to_host().unwrap() == fresh(0.2), "{name}: a frame that was kept has changed");
    }
}

#[test]
fn runs_on_wgpu_are_reproducible_and_every_device_draws_the_same() {
    let devices = cc4dgs_tests::devices();
    if !devices.iter().any(|(name, _)| *name == "wgpu") {
        return;
    }
    let mut config = tiny(&["train.iterations=30", "scene.width=32", "scene.height=32"]);
    config.device = "wgpu".into();
    let folder = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    let [a, b] = ["a", "b"].map(|name| folder.path().join(name));
    run(&config, &a, false, &Silent, &never).unwrap();
    run(&config, &b, false, &Silent, &never).unwrap();
    let bytes = |out: &Path| std::fs::read(out.join(CHECKPOINT)).unwrap();
    assert!(bytes(&a) == bytes(&b), "two runs of one seed differ");

    let (scene, registry) = (open(&config), Registry::collect().unwrap());
    let load = |device: &Device| Model::open(&a, &registry, device, &Limits::default(), &Silent).unwrap();
    let models: Vec<(String, Device, Model)> = devices.into_iter().map(|(name, device)| (name.to_string(), device.clone(), load(&device))).collect();
    for found in agreement(&models, &scene, &scene.split(Split::Test), &registry, &Silent).unwrap() {
        assert!(found.max_difference <= 1.0 / 255.0 && found.psnr_difference_db.abs() < 0.01, "{found:?}");
    }
}

/// PSNR in dB that 40 iterations at 32x32 reach at least, by method: about 0.7 dB below what one seed gave on flex.
const FLOORS_DB: [(&str, f64); 11] = [
    ("cdf", 17.4),
    ("swift4d", 17.2),
    ("grid4d", 16.6),
    ("hexplane", 17.5),
    ("embedding", 17.5),
    ("deform-mlp", 16.9),
    ("native-4d", 16.0),
    ("free-time", 17.2),
    ("cdf-basis", 17.2),
    ("hash-basis", 17.2),
    ("none", 17.1),
];

/// Every deformer, with its attributes per Gaussian, can be trained, resumed to the same bytes, played back, and stored in an archive.
#[test]
fn every_field_trains_resumes_plays_and_is_archived() {
    let registry = Registry::collect().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    let methods: Vec<&str> = registry.presets().filter(|p| p.role == PresetRole::Method).map(|p| p.info.name).collect();
    // Only the workspace's own crates are linked here.
    let unmeasured: Vec<&str> = methods.iter().copied().filter(|method| FLOORS_DB.iter().all(|(name, _)| name != method)).collect();
    assert!(unmeasured.is_empty(), "state floors of {unmeasured:?}");
    for (method, floor) in FLOORS_DB {
        assert!(methods.contains(&method), "{method} is not registered");
        let sets: Vec<String> = ["scene.width=32", "scene.height=32", "train.iterations=40", "init.count=150", "train.log_every=5", "train.dynamic=all"]
            .iter()
            .map(ToString::to_string)
            .collect();
        let config = RunConfig::resolve(Some(&format!("demo+{method}")), None, &sets).unwrap();
        let [whole, parts] = ["whole", "parts"].map(|name| folder.path().join(format!("{method}-{name}")));
        run(&config, &whole, false, &Silent, &never).unwrap();
        let stop = AtomicBool::new(false);
        let listener = StopAfter { left: AtomicUsize::new(6), stop: &stop };
        assert!(matches!(run(&config, &parts, false, &listener, &stop), Err(Error::Interrupted(_))), "{method}");
        run(&config, &parts, true, &Silent, &never).unwrap();
        let bytes = |out: &Path| std::fs::read(out.join(CHECKPOINT)).unwrap();
        assert!(bytes(&whole) == bytes(&parts), "{method}: resuming ends in other bytes");

        let model = load(&whole);
        if let Some(field) = &model.field {
            for spec in field.field.attributes() {
                let own = &model.gaussians.extra[&spec.name];
                assert!(
                    own.values.len() == spec.width * model.gaussians.len() && own.values.iter().any(|v| *v != spec.start),
                    "{method}: {} was not learned",
                    spec.name
                );
            }
        }
        let before = score(&model, &config).psnr_db;
        println!("{method}: {before:.2} dB");
        assert!(before >= floor, "{method}: {before} dB, at least {floor} are expected");
        let mut deform = Vec::new();
        for (precision, allowed) in [("fp32", 1e-3), ("fp16", 0.05), ("int8", 0.5)] {
            let archive = folder.path().join(format!("{method}-{precision}.cc4d"));
            model.save_archive(&archive, &options("raw", precision), &registry, &Limits::default(), &Silent).unwrap();
            let stored = load(&archive);
            assert_eq!(stored.render.focal, model.render.focal, "{method}");
            let after = score(&stored, &config).psnr_db;
            assert!((before - after).abs() < allowed, "{method}: {before} dB, {after} from the archive with {precision} weights");
            deform.push(stored.size.deform);
        }
        let weightless = model.field.as_ref().is_none_or(|f| f.field.parameters().is_empty());
        assert!(weightless || (deform[1] < deform[0] && deform[2] < deform[1]), "{method}: {deform:?} bytes of weights");
    }
}

/// Moving pixels of a moving camera are those that show something that moves; of fixed cameras those that change over time, in all frames alike.
#[test]
fn moving_pixels_are_scored_for_moving_cameras_too() {
    let session = cc4dgs::Session::builder().device("flex").build().unwrap();
    let scored = |name: &str, frames: &str| {
        let config = session.config("demo", &["scene.width=40", frames, "train.iterations=12", "init.source=random", "init.count=200"]).unwrap();
        let scene = Arc::new(session.read_scene(format!("procedural:captures/{name}"), &config.scene).unwrap());
        let model = session.train(&config, scene.clone(), None).unwrap();
        let mut by_hand = Vec::new();
        let report = evaluate(&model, &scene, Scored::all(Split::Test), session.registry(), session.device(), &Silent, &mut |view, truth, render, score| {
            let mask = scene.motion_mask(view)?;
            let squares = mask.iter().flatten().zip(truth.data.chunks_exact(3).zip(render.data.chunks_exact(3))).filter(|(moves, _)| **moves);
            let errors: Vec<f64> = squares.flat_map(|(_, (a, b))| (0..3).map(|k| (f64::from(a[k]) - f64::from(b[k])).powi(2)).collect::<Vec<_>>()).collect();
            let mean = errors.iter().sum::<f64>() / errors.len() as f64;
            by_hand.push(score.psnr_dynamic_db.map(|psnr| psnr - 10.0 * (255.0 * 255.0 / mean).log10()));
            Ok(())
        });
        (report.unwrap(), by_hand)
    };
    let (handheld, differences) = scored("handheld", "scene.frames=[0,12,1]");
    assert!(handheld.psnr_dynamic_db.is_some() && handheld.ssim_dynamic.is_some());
    assert!(differences.len() == 2 && differences.iter().all(|difference| difference.unwrap().abs() < 1e-6), "{differences:?}");
    let (dome, differences) = scored("dome", "scene.frames=[0,3,1]");
    assert!(dome.psnr_dynamic_db.is_some() && differences.iter().any(|difference| difference.unwrap().abs() > 1e-3), "{differences:?}");
    let (photos, _) = scored("photos", "scene.max_views=8");
    assert!(photos.psnr_dynamic_db.is_none() && photos.ssim_dynamic.is_none());
}
