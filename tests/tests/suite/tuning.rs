//! Fine-tuning through quantisation: smaller files at the same loss, reproducible, and sound for models of every kind.

use burn::tensor::Device;
use cc4dgs::{backends as _, codecs as _, deformers as _, parts as _};
use cc4dgs_core::archive::Archive;
use cc4dgs_core::{Error, FrameSource, Image8, Limits, Registry, Result, Scene, Silent, TuneModel};
use cc4dgs_play::prune::prune;
use cc4dgs_play::{ArchiveOptions, Model, Moving, ViewSource};
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::data;
use cc4dgs_train::train::{RefitJob, TrainJob, TuneJob, Tuner, prune_and_refit, train};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

const FIELD_WEIGHTS: &str = "compact:max-drop=0.05dB";
const LIMIT_DB: f64 = 0.2;
const ITERATIONS: usize = 150;

/// A scene and what is needed to train and store models of it.
struct Bench {
    registry: Registry,
    limits: Limits,
    device: Device,
    scene: Arc<Scene>,
    never: AtomicBool,
}

impl Bench {
    fn new(config: &RunConfig) -> Self {
        let (registry, limits) = (Registry::collect().unwrap(), Limits::default());
        let scene = Arc::new(data::open(Path::new("procedural"), &config.scene, &registry, &limits).unwrap());
        Self { registry, limits, device: Device::flex(), scene, never: AtomicBool::new(false) }
    }
    fn train(&self, config: &RunConfig) -> Model {
        let Self { registry, scene, never, .. } = self;
        train(&TrainJob { config, scene: scene.clone(), out: None, resume: false, registry, events: &Silent, stop: never, observer: None }).unwrap().0
    }
    fn tuner<'a>(&'a self, model: &'a Model, stop: &'a AtomicBool) -> Tuner<'a> {
        let Self { registry, limits, device, scene, .. } = self;
        Tuner::new(TuneJob { model, scene: scene.clone(), field_weights: FIELD_WEIGHTS, registry, device, limits, events: &Silent, stop })
    }
    fn archive(&self, model: &Model, finetune: usize, tuner: Option<&dyn TuneModel>) -> Result<Vec<u8>> {
        self.archive_as(&format!("max-drop={LIMIT_DB}dB"), model, finetune, tuner)
    }
    fn archive_as(&self, profile: &str, model: &Model, finetune: usize, tuner: Option<&dyn TuneModel>) -> Result<Vec<u8>> {
        let settings: toml::Table = format!("finetune = {finetune}").parse().unwrap();
        let codec = format!("compact:{profile}");
        let views = Some((ViewSource::Scene(&self.scene), &self.device));
        let options = ArchiveOptions { codec: &codec, settings: &settings, field_weights: FIELD_WEIGHTS, views, tuner };
        model.to_archive(&options, &self.registry, &self.limits, &Silent)
    }
    fn tuned(&self, model: &Model, finetune: usize) -> Result<Vec<u8>> {
        self.archive(model, finetune, Some(&self.tuner(model, &self.never)))
    }
    fn open(&self, bytes: &[u8]) -> Model {
        let archive = Archive::from_bytes("archive", bytes.to_vec(), &self.limits).unwrap();
        Model::of_archive("archive", &archive, &self.registry, &self.device, &self.limits, &Silent).unwrap()
    }
    /// PSNR in dB on training views.
    fn psnr(&self, model: &Model) -> f64 {
        let tuner = self.tuner(model, &self.never);
        let start = tuner.start(&model.gaussians).unwrap();
        tuner.psnr(&start.gaussians, &start.weights, None).unwrap()
    }
}

fn tiny(extra: &[&str]) -> RunConfig {
    let sets = ["scene.width=48", "scene.height=48", "train.iterations=160", "init.count=400", "train.validation=0"];
    RunConfig::resolve(Some("demo"), None, &sets.iter().chain(extra).map(ToString::to_string).collect::<Vec<_>>()).unwrap()
}

#[test]
fn fine_tuning_saves_bytes_at_the_same_loss() {
    let config = tiny(&[]);
    let bench = Bench::new(&config);
    let model = bench.train(&config);
    let plain = bench.archive(&model, 0, None).unwrap();
    let tuned = bench.tuned(&model, ITERATIONS).unwrap();
    let before = bench.psnr(&model);
    let drops = [&plain, &tuned].map(|bytes| before - bench.psnr(&bench.open(bytes)));
    println!("{} bytes with a loss of {:.3} dB, {} with {:.3} dB after fine-tuning", plain.len(), drops[0], tuned.len(), drops[1]);
    assert!(drops[1] <= LIMIT_DB + 1e-3, "{drops:?}");
    assert!(100 * tuned.len() < 97 * plain.len(), "{} bytes before, {} after", plain.len(), tuned.len());
    assert!(tuned == bench.tuned(&model, ITERATIONS).unwrap(), "two compressions of one model differ");
    // Without iterations the tuner changes nothing.
    assert!(plain == bench.tuned(&model, 0).unwrap());

    let stopped = AtomicBool::new(true);
    let error = bench.archive(&model, ITERATIONS, Some(&bench.tuner(&model, &stopped))).unwrap_err();
    assert!(matches!(error, Error::Interrupted(_)), "{error}");
}

#[test]
fn a_bound_on_the_file_holds_after_fine_tuning() {
    let config = tiny(&[]);
    let bench = Bench::new(&config);
    let model = bench.train(&config);
    let plain = bench.archive(&model, 0, None).unwrap().len();
    // Most of so small a file are weights.
    for share in [102, 100] {
        let most = share * plain / 100;
        let tuner = bench.tuner(&model, &bench.never);
        let bytes = bench.archive_as(&format!("max-size={}MB", most as f64 / 1e6), &model, 60, Some(&tuner)).unwrap();
        println!("{} of {most} bytes", bytes.len());
        assert!(bytes.len() <= most && 100 * bytes.len() > 93 * most, "{} of {most} bytes", bytes.len());
        assert!(share == 100 || tuner.adopted().unwrap().is_some(), "training was worth nothing");
    }
}

#[test]
fn models_of_every_kind_are_tuned_or_left_alone() {
    let config = tiny(&["train.iterations=40", "train.dynamic=all"]);
    let bench = Bench::new(&config);
    let moving = bench.train(&config);
    let mut cases = Vec::new();
    for count in [0, 1, moving.gaussians.len()] {
        let mut model = bench.open(&bench.archive(&moving, 0, None).unwrap());
        model.gaussians = model.gaussians.select(&(0..count).collect::<Vec<usize>>());
        cases.push((format!("{count} Gaussians"), model));
    }
    let mut fixed = bench.open(&bench.archive(&moving, 0, None).unwrap());
    (fixed.field, fixed.moving, fixed.provenance) = (None, Moving::Nothing, Default::default());
    cases.push(("static, without a configuration".into(), fixed));
    // It moves, and has no weights.
    let of_attributes = tiny(&["train.iterations=40", "train.dynamic=all", "deformer.kind=free-time"]);
    cases.push(("free-time".into(), bench.train(&of_attributes)));
    for (name, model) in cases {
        let count = model.gaussians.len();
        let bytes = bench.tuned(&model, 7).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(bench.open(&bytes).gaussians.len(), count, "{name}");
    }
}

/// The images of a scene as cameras with colours of their own would take them: darker, each in other channels.
struct Tinted(Arc<Scene>);

impl FrameSource for Tinted {
    fn load(&self, view: usize) -> Result<Image8> {
        let mut image = self.0.frame(view)?.as_ref().clone();
        let camera = self.0.views[view].camera;
        for pixel in image.data.chunks_exact_mut(image.channels as usize) {
            (0..3).for_each(|k| pixel[k] = (f32::from(pixel[k]) * if (camera + k).is_multiple_of(3) { 0.5 } else { 0.8 }) as u8);
        }
        Ok(image)
    }
}

#[test]
fn colours_per_camera_are_not_learned_by_models_that_were_trained_with_some() {
    let config = tiny(&["train.dynamic=all"]);
    let bench = Bench::new(&config);
    let mut model = bench.train(&config);
    let scene = &bench.scene;
    let tinted = Scene::new("tinted", scene.cameras.clone(), scene.views.clone(), Arc::new(Tinted(scene.clone())), 1 << 24).unwrap();
    let tinted = Bench { scene: Arc::new(tinted), ..Bench::new(&config) };
    // PSNR on images without a tint.
    let before = bench.psnr(&model);
    let refitted = |model: &Model| {
        let Bench { registry, limits, device, scene, never } = &tinted;
        let mut copy = bench.open(&model.to_archive(&raw(), registry, limits, &Silent).unwrap());
        let job = RefitJob { registry, device, limits, events: &Silent, stop: never };
        prune_and_refit(&mut copy, scene, LIMIT_DB, 60, &job).unwrap();
        bench.psnr(&copy) - before
    };
    assert_eq!(tinted.tuner(&model, &tinted.never).caution().unwrap(), None);
    let plain = refitted(&model);
    let affine = toml::Table::from_iter([("kind".into(), "affine".into())]);
    model.provenance.config.insert("appearance".into(), affine.into());
    assert!(tinted.tuner(&model, &tinted.never).caution().unwrap().is_some(), "it is fine-tuned unasked");
    let own = refitted(&model);
    println!("{before:.2} dB; re-fitted on images with tints {plain:+.2} dB, as a model that was trained with colours per camera {own:+.2} dB");
    // So short a training draws colours that are off everywhere, and keeps them.
    assert!(plain < -4.0 && own > -2.0, "{plain} and {own}");

    let stopped = AtomicBool::new(true);
    let error = tinted.archive(&model, 80, Some(&tinted.tuner(&model, &stopped))).unwrap_err();
    assert!(matches!(error, Error::Interrupted(_)), "{error}");
}

#[test]
fn pruning_with_refit_keeps_fewer_within_the_same_loss() {
    let config = tiny(&[]);
    let bench = Bench::new(&config);
    let Bench { registry, limits, device, scene, never } = &bench;
    let copy = |model: &Model| bench.open(&model.to_archive(&raw(), registry, limits, &Silent).unwrap());
    let model = bench.train(&config);
    let before = bench.psnr(&model);
    let job = RefitJob { registry, device, limits, events: &Silent, stop: never };
    let (mut plain, mut refitted, mut again) = (copy(&model), copy(&model), copy(&model));
    let without = prune(&mut plain, scene, LIMIT_DB, registry, device, &Silent).unwrap();
    let with = prune_and_refit(&mut refitted, scene, LIMIT_DB, 60, &job).unwrap();
    println!("of {} Gaussians, {} are kept without re-fit and {} with it", with.before, without.after, with.after);
    assert!(with.after < without.after, "{with:?} {without:?}");
    assert!(without.psnr_refit_alone_db.is_none() && with.psnr_refit_alone_db.unwrap() > with.psnr_before_db, "{with:?}");
    assert_eq!(refitted.gaussians.len(), with.after);
    let drop = before - bench.psnr(&refitted);
    assert!(drop <= LIMIT_DB + 1e-3, "{drop} dB");
    assert_eq!(refitted.size, refitted.float32_size());
    let most = prune(&mut plain, scene, 50.0, registry, device, &Silent).unwrap();
    assert!(most.after < most.before && plain.size == plain.float32_size(), "{most:?}");
    plain.gaussians = plain.gaussians.select(&[]);
    let none = prune(&mut plain, scene, LIMIT_DB, registry, device, &Silent).unwrap();
    assert_eq!((none.before, none.after), (0, 0));
    prune_and_refit(&mut again, scene, LIMIT_DB, 60, &job).unwrap();
    assert!(again.gaussians == refitted.gaussians, "two runs differ");

    let stopped = AtomicBool::new(true);
    let error = prune_and_refit(&mut again, scene, LIMIT_DB, 60, &RefitJob { stop: &stopped, ..job }).unwrap_err();
    assert!(matches!(error, Error::Interrupted(_)), "{error}");
    let error = prune_and_refit(&mut again, scene, -1.0, 60, &RefitJob { registry, device, limits, events: &Silent, stop: never }).unwrap_err();
    assert!(error.to_string().contains("-1 dB"), "{error}");
}

fn raw() -> ArchiveOptions<'static> {
    static NONE: std::sync::LazyLock<toml::Table> = std::sync::LazyLock::new(toml::Table::new);
    ArchiveOptions { codec: "raw", settings: &NONE, field_weights: "fp32", views: None, tuner: None }
}
