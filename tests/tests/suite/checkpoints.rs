//! Checkpoints that were damaged: an error, or the same model; never another one. Which settings a run may be given when it goes on, and what is kept of one
//! whose images cannot be read any more.

use burn::tensor::{Device, Tensor};
use cc4dgs_core::{Error, Event, EventSink, FrameSource, HostGaussians, Image8, Limits, PointCloud, Recorder, Registry, Result, Scene, Seed, Silent};
use cc4dgs_play::Model;
use cc4dgs_play::checkpoint::{CHECKPOINT, CheckpointArrays, CheckpointFile, FORMAT, read_model};
use cc4dgs_train::checkpoint::load;
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::train::{TrainJob, TrainReport, train};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A run in `folder`, at the smallest size, that `events` may stop.
fn run(folder: &Path, sets: &[&str], resume: bool, events: &dyn EventSink, stop: &AtomicBool) -> Result<TrainReport> {
    let registry = Registry::collect().unwrap();
    let sets: Vec<String> = ["scene.width=24", "scene.height=24", "init.count=60"].iter().chain(sets).map(ToString::to_string).collect();
    let config = RunConfig::resolve(Some("demo"), None, &sets)?;
    let scene = Arc::new(cc4dgs_train::data::open(Path::new("procedural"), &config.scene, &registry, &config.limits)?);
    let out = Some(folder.to_path_buf());
    train(&TrainJob { config: &config, scene, out, resume, registry: &registry, events, stop, observer: None }).map(|(_, report)| report)
}

/// Stops a run after an iteration of its main stage.
struct StopAt<'a>(usize, &'a AtomicBool);

impl EventSink for StopAt<'_> {
    fn emit(&self, event: &Event) {
        if matches!(event, Event::Iteration { stage, iteration, .. } if stage == "main" && *iteration == self.0) {
            self.1.store(true, Ordering::Relaxed);
        }
    }
}

#[test]
fn the_length_of_a_main_stage_may_be_set_until_it_is_settled() {
    let folder = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    // 40 iterations of the main stage; its length is settled after 8 of them.
    let sets = ["train.iterations=50", "train.shares=[1,0,4]", "train.dynamic=all", "train.log_every=1"];
    let with = |stretch: &'static str| [&sets[..], &[stretch]].concat();
    let bytes = |name: &str| std::fs::read(folder.path().join(name).join(CHECKPOINT)).unwrap();
    let stopped = |name: &str, sets: &[&str], iteration: usize| {
        let stop = AtomicBool::new(false);
        let interrupted = run(&folder.path().join(name), sets, false, &StopAt(iteration, &stop), &stop);
        assert!(matches!(interrupted, Err(Error::Interrupted(_))), "{interrupted:?}");
    };
    let resumed = |name: &str, sets: &[&str]| run(&folder.path().join(name), sets, true, &Silent, &never);
    let whole = run(&folder.path().join("whole"), &with("train.stretch=1.4"), false, &Silent, &never).unwrap();
    assert_eq!(whole.iterations, 10 + 56);
    for (name, iteration) in [("early", 5), ("last", 8)] {
        stopped(name, &sets, iteration);
        assert_eq!(resumed(name, &with("train.stretch=1.4")).unwrap().iterations, 66);
        assert!(bytes(name) == bytes("whole"), "{name}");
    }
    for (name, iteration) in [("next", 9), ("late", 30)] {
        stopped(name, &sets, iteration);
        let refused = resumed(name, &with("train.stretch=1.4")).unwrap_err().to_string();
        assert!(refused.contains("--resume") && refused.contains("train.stretch was 1.0 and is 1.4"), "{refused}");
        assert_eq!(resumed(name, &sets).unwrap().iterations, 50);
    }
    // A length that was settled at another value is not given up either.
    stopped("stretched", &with("train.stretch=1.4"), 20);
    assert!(resumed("stretched", &sets).unwrap_err().to_string().contains("train.stretch was 1.4 and is 1.0"));
}

/// Stops a run before the first iteration of a stage.
struct StopBefore<'a>(&'a str, &'a AtomicBool);

impl EventSink for StopBefore<'_> {
    fn emit(&self, event: &Event) {
        if matches!(event, Event::StageStarted { stage, .. } if stage == self.0) {
            self.1.store(true, Ordering::Relaxed);
        }
    }
}

/// Centres of the Gaussians of a checkpoint as bits, each with its second moments.
fn moments_of_centres(checkpoint: &Path) -> Vec<([u32; 3], Vec<f32>)> {
    let file = CheckpointFile::read(checkpoint, &Limits::default()).unwrap();
    let count = file.header::<serde_json::Value>().unwrap()["model"]["gaussians"].as_u64().unwrap() as usize;
    let of = |name: &str| file.array(name, Some(3 * count)).unwrap();
    let (means, second) = (of("gaussians/means"), of("optimizer/gaussians/means/second_moment"));
    means.chunks_exact(3).zip(second.chunks_exact(3)).map(|(mean, second)| ([mean[0], mean[1], mean[2]].map(f32::to_bits), second.to_vec())).collect()
}

#[test]
fn a_main_stage_goes_on_with_the_moments_of_the_coarse_one_where_it_is_told_to() {
    let (folder, never) = (tempfile::tempdir().unwrap(), AtomicBool::new(false));
    // 20, 20 and 2 iterations, in which no centre moves.
    let still = ["train.lr.means=0", "train.lr.means_end=0", "density={kind='none'}", "train.dynamic=score", "train.zeta=0.1", "train.checks=false"];
    let sets = [&["init.count=200", "train.iterations=42", "train.shares=[10,10,1]"][..], &still].concat();
    let kept = [&sets[..], &["train.keep_moments=true"]].concat();
    let path = |name: &str| folder.path().join(name).join(CHECKPOINT);
    let steps = |name: &str| {
        let header = CheckpointFile::read(&path(name), &Limits::default()).unwrap().header::<serde_json::Value>().unwrap();
        let steps = &header["training"]["optimizer_steps"];
        (steps["gaussians/means"].as_u64().unwrap(), steps.get("gaussians/dynamic_scores").is_some())
    };
    run(&folder.path().join("anew"), &sets, false, &Silent, &never).unwrap();
    assert_eq!(steps("anew"), (2, false));
    run(&folder.path().join("whole"), &kept, false, &Silent, &never).unwrap();
    assert_eq!(steps("whole"), (22, false));

    // The state survives an interruption between the stages.
    let stop = AtomicBool::new(false);
    let interrupted = run(&folder.path().join("stopped"), &kept, false, &StopBefore("score", &stop), &stop);
    assert!(matches!(interrupted, Err(Error::Interrupted(_))), "{interrupted:?}");
    assert_eq!(steps("stopped"), (20, false));
    let coarse = moments_of_centres(&path("stopped"));
    run(&folder.path().join("stopped"), &kept, true, &Silent, &never).unwrap();
    assert!(std::fs::read(path("stopped")).unwrap() == std::fs::read(path("whole")).unwrap());

    // What moves is first by then, and every centre has its own moments: two steps take 0.2 % of them.
    let main = moments_of_centres(&path("whole"));
    assert!(main.len() == coarse.len() && main.iter().zip(&coarse).any(|(now, then)| now.0 != then.0), "the order is the same");
    let of_coarse: BTreeMap<[u32; 3], Vec<f32>> = coarse.into_iter().collect();
    for (mean, now) in main {
        let then = &of_coarse[&mean];
        assert!(now.iter().zip(then).all(|(now, then)| *now >= 0.99 * then), "{now:?} now, {then:?} after the coarse stage");
    }
}

/// The images of a scene, which cannot be read while the flag is set.
struct Fragile(Arc<Scene>, Arc<AtomicBool>);

impl FrameSource for Fragile {
    fn load(&self, view: usize) -> Result<Image8> {
        if self.1.load(Ordering::Relaxed) {
            return Err(Error::data(format!("image {view}"), "the disk is gone", "Bring it back"));
        }
        Ok((*self.0.frame(view)?).clone())
    }
}

/// The scene of [`run`] with images that can be lost, none of which is kept, and its settings.
fn fragile(sets: &[&str], lost: &Arc<AtomicBool>) -> (RunConfig, Scene) {
    let sets: Vec<String> = ["scene.width=24", "scene.height=24", "init.count=60"].iter().chain(sets).map(ToString::to_string).collect();
    let config = RunConfig::resolve(Some("demo"), None, &sets).unwrap();
    let whole = Arc::new(cc4dgs_train::data::open(Path::new("procedural"), &config.scene, &Registry::collect().unwrap(), &config.limits).unwrap());
    let source = Arc::new(Fragile(whole.clone(), lost.clone()));
    let mut scene = Scene::new("fragile", whole.cameras.clone(), whole.views.clone(), source, 0).unwrap();
    (scene.normalisation, scene.points, scene.background) = (whole.normalisation, whole.points.clone(), whole.background);
    (config, scene)
}

/// Takes the images away after an event.
struct LoseAfter<'a>(fn(&Event) -> bool, &'a AtomicBool);

impl EventSink for LoseAfter<'_> {
    fn emit(&self, event: &Event) {
        if (self.0)(event) {
            self.1.store(true, Ordering::Relaxed);
        }
    }
}

#[test]
fn a_run_whose_images_are_lost_keeps_what_it_learned() {
    // What fails, the event that the images are lost after, settings, and the iteration of the main stage that the run goes on with.
    type Case<'a> = (&'a str, fn(&Event) -> bool, &'a [&'a str], usize);
    let main_begins: fn(&Event) -> bool = |event| matches!(event, Event::StageStarted { stage, .. } if stage == "main");
    let score_ends: fn(&Event) -> bool = |event| matches!(event, Event::StageFinished { stage, .. } if stage == "score");
    let seventh: fn(&Event) -> bool = |event| matches!(event, Event::Iteration { stage, iteration, .. } if stage == "main" && *iteration == 7);
    // Each of the 20 iterations of the main stage is validated.
    let validated = ["train.validation=2", "train.shares=[1,0,1]", "train.dynamic=all"];
    let often = [&validated[..], &["train.checkpoint_every=5"]].concat();
    let cases: [Case; 5] = [
        ("in a step", seventh, &[], 8),
        ("in the first step", main_begins, &[], 1),
        ("for key frames", score_ends, &["train.key_frames=4", "deformer.life=true", "train.dynamic=score"], 1),
        ("for validation", seventh, &validated, 1),
        ("for validation, after a checkpoint", seventh, &often, 6),
    ];
    let (registry, never) = (Registry::collect().unwrap(), AtomicBool::new(false));
    for (case, loses, own, goes_on_with) in cases {
        let (folder, lost) = (tempfile::tempdir().unwrap(), Arc::new(AtomicBool::new(false)));
        let sets = [&["train.iterations=40", "train.log_every=1", "density={kind='none'}"][..], own].concat();
        let (config, scene) = fragile(&sets, &lost);
        let scene = Arc::new(scene);
        let train = |name: &str, resume: bool, events: &dyn EventSink| {
            let (out, scene) = (Some(folder.path().join(name)), scene.clone());
            train(&TrainJob { config: &config, scene, out, resume, registry: &registry, events, stop: &never, observer: None }).map(|(_, report)| report)
        };
        let bytes = |name: &str| std::fs::read(folder.path().join(name).join(CHECKPOINT)).unwrap();
        train("whole", false, &Silent).unwrap();
        let error = train("broken", false, &LoseAfter(loses, &lost)).unwrap_err();
        assert!(matches!(&error, Error::Data { .. }) && error.to_string().contains("the disk is gone"), "{case}: {error}");
        let heard = Recorder::default();
        lost.store(false, Ordering::Relaxed);
        train("broken", true, &heard).unwrap_or_else(|error| panic!("{case}: {error}"));
        let iteration_of = |event: Event| if let Event::Iteration { stage, iteration, .. } = event { Some((stage, iteration)) } else { None };
        assert_eq!(heard.events().into_iter().find_map(iteration_of), Some(("main".into(), goes_on_with)), "{case}");
        assert!(bytes("broken") == bytes("whole"), "{case}");
    }
}

#[test]
fn first_points_that_are_not_finite_are_removed_where_the_main_stage_is_the_only_one() {
    let (registry, stop) = (Registry::collect().unwrap(), AtomicBool::new(false));
    for density in ["density={kind='none'}", "density={kind='clone-split'}", "density={kind='mcmc'}"] {
        let (config, mut scene) = fragile(&["train.iterations=6", "train.shares=[0,0,1]", "train.checks=false", density], &Arc::default());
        let positions = vec![[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [f32::NAN, 0.0, 0.0], [0.0, 0.5, 0.0]];
        scene.points = Some(PointCloud { colors: vec![[0.5; 3]; positions.len()], positions });
        let scene = Arc::new(scene);
        let job = TrainJob { config: &config, scene, out: None, resume: false, registry: &registry, events: &Silent, stop: &stop, observer: None };
        let (model, report) = train(&job).unwrap();
        assert_eq!(report.gaussians, 3, "{density}");
        assert!(model.gaussians.means.iter().all(|v| v.is_finite()), "{density}");
    }
}

#[test]
fn going_on_without_a_folder_is_refused() {
    let (registry, stop) = (Registry::collect().unwrap(), AtomicBool::new(false));
    let sets = ["scene.width=24", "scene.height=24", "init.count=60", "train.iterations=2"].map(String::from);
    let config = RunConfig::resolve(Some("demo"), None, &sets).unwrap();
    let scene = Arc::new(cc4dgs_train::data::open(Path::new("procedural"), &config.scene, &registry, &config.limits).unwrap());
    let job = TrainJob { config: &config, scene, out: None, resume: true, registry: &registry, events: &Silent, stop: &stop, observer: None };
    let error = train(&job).map(|(_, report)| report).unwrap_err();
    assert!(matches!(&error, Error::Parameter { .. }) && error.to_string().contains("no folder"), "{error}");
}

/// The checkpoint of a short run with a deformer that keeps attributes, in `folder`.
fn checkpoint(folder: &Path) -> Vec<u8> {
    let deformer = ["kind=embedding", "gaussian_features=6", "time_features=10", "time_rows=9", "coarse_rows=4", "width=16"];
    let sets: Vec<String> = deformer.iter().map(|set| format!("deformer.{set}")).chain(["train.iterations=24".into()]).collect();
    let sets: Vec<&str> = sets.iter().map(String::as_str).collect();
    run(folder, &sets, false, &Silent, &AtomicBool::new(false)).unwrap();
    std::fs::read(folder.join(CHECKPOINT)).unwrap()
}

/// Everything of a model that a damaged byte could change.
fn contents(model: &Model) -> (HostGaussians, Vec<f32>, String) {
    let field = model.field.as_ref().map(|f| (f.section.clone(), f.context.clone()));
    let weights = model.field.iter().flat_map(|f| f.field.parameters()).flat_map(|p| p.value.clone().into_data().to_vec::<f32>().unwrap()).collect();
    let rest =
        format!("{field:?} {:?} {:?} {:?} {:?} {} {:?}", model.moving, model.render, model.background, model.rasterizer, model.frame_count, model.provenance);
    (model.gaussians.clone(), weights, rest)
}

#[test]
fn a_damaged_checkpoint_is_refused_or_the_same() {
    let registry = Registry::collect().unwrap();
    let (folder, device, limits) = (tempfile::tempdir().unwrap(), Device::flex(), Limits::default());
    let sound = checkpoint(folder.path());
    let path = folder.path().join("damaged");
    let open = |bytes: &[u8]| -> Result<Model> {
        std::fs::write(&path, bytes).unwrap();
        // The trainer reads more of the file than playback does, and must not be less strict.
        load(&path, &registry, &device, &limits)?;
        read_model(&path, &registry, &device, &limits)
    };
    let whole = contents(&open(&sound).unwrap());
    let header = 8 + u64::from_le_bytes(sound[..8].try_into().unwrap()) as usize;
    let (mut refused, mut same) = (0, 0);
    for k in 0..200u64 {
        let draw = Seed::root(31).index(k).value();
        let mut damaged = sound.clone();
        // Half of the damages hit the header, where names and sizes are.
        let at = (draw >> 16) as usize % if k % 2 == 0 { header } else { sound.len() };
        damaged[at] = if k % 4 < 2 { damaged[at] ^ 1 << (draw % 8) } else { (draw >> 8) as u8 };
        match open(&damaged) {
            Err(e) => {
                assert!(e.to_string().contains(". "), "{e} names no remedy");
                refused += 1;
            }
            Ok(model) => {
                assert!(contents(&model) == whole, "byte {at}: another model was read");
                same += 1;
            }
        }
    }
    assert!(refused >= 190, "{refused} refused, {same} read as they were");
}

#[test]
fn checkpoints_of_other_formats_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(CHECKPOINT);
    let mut arrays = CheckpointArrays::default();
    arrays.add("a".into(), &Tensor::<1>::from_floats([1.0, 2.0], &Device::flex())).unwrap();
    for (format, taken) in [(FORMAT, true), (FORMAT + 1, false)] {
        arrays.write(&path, &serde_json::json!({ "format": format })).unwrap();
        match CheckpointFile::read(&path, &Limits::default()) {
            Ok(file) => {
                assert!(taken);
                assert_eq!(file.array("a", Some(2)).unwrap(), [1.0, 2.0]);
                assert!(file.array("a", Some(3)).is_err() && file.array("b", Some(2)).is_err() && file.array("a", None).is_err());
            }
            Err(e) => assert!(!taken && e.to_string().contains(&format!("format {format}")), "{e}"),
        }
    }
    let broken = Tensor::<1>::from_floats([f32::NAN], &Device::flex());
    assert!(arrays.add("b".into(), &broken).is_err());
}
