//! Trainings with pose models: values that are not finite, checkpoints without poses, wgpu, key frames, and cameras that are one, that move, or that share a
//! point.

use burn::tensor::{Device, Tensor};
use cc4dgs::{RunConfig, deformers as _, parts as _};
use cc4dgs_core::config::parse_section;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    Camera, Error, Event, EventSink, HostGaussians, Limits, Parameter, ParameterGroup, Part, Plugin, Posed, Poses, PosesContext, PosesPlugin, Recorder,
    Registry, Result, Scene, Silent, Split, inventory, toml,
};
use cc4dgs_play::Model;
use cc4dgs_play::checkpoint::{CHECKPOINT, CheckpointArrays, CheckpointFile};
use cc4dgs_tests::StopAfter;
use cc4dgs_train::train::{CONFIG, TrainJob, train};
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize};

const REFINED: &str = "poses.kind=refined";
const ONE_FRAME: &str = "scene.frames=[0, 1, 1]";

/// Settings of a training whose iterations take milliseconds.
fn settings(device: &str, sets: &[&str]) -> RunConfig {
    let small = ["scene.width=24", "init.count=200", "train.shares=[1.0, 0.0, 1.0]", "train.checks=false", "train.log_every=5"];
    let parts = ["deformer.kind=none", "density={kind='none'}"];
    let sets: Vec<String> = small.iter().chain(&parts).chain(sets).map(ToString::to_string).collect();
    let mut config = RunConfig::resolve(Some("demo"), None, &sets).unwrap();
    config.device = device.into();
    config
}

fn open(path: &str, config: &RunConfig) -> Scene {
    cc4dgs_train::data::open(Path::new(path), &config.scene, &Registry::collect().unwrap(), &config.limits).unwrap()
}

/// Number of training cameras.
fn cameras(scene: &Scene) -> usize {
    scene.split(Split::Train).into_iter().map(|view| scene.views[view].camera).collect::<BTreeSet<usize>>().len()
}

fn run(out: &Path, config: &RunConfig, scene: &Arc<Scene>, resume: bool, events: &dyn EventSink, stop: &AtomicBool) -> Result<Model> {
    let registry = Registry::collect().unwrap();
    let (scene, out) = (scene.clone(), Some(out.to_path_buf()));
    train(&TrainJob { config, scene, out, resume, registry: &registry, events, stop, observer: None }).map(|(model, _)| model)
}

/// What a training left.
struct Trained {
    gaussians: HostGaussians,
    checkpoint: CheckpointFile,
    events: Vec<Event>,
}

fn trained(config: &RunConfig, scene: Scene) -> Trained {
    let (folder, events) = (tempfile::tempdir().unwrap(), Recorder::default());
    let model = run(folder.path(), config, &Arc::new(scene), false, &events, &AtomicBool::new(false)).unwrap();
    let checkpoint = CheckpointFile::read(&folder.path().join(CHECKPOINT), &Limits::default()).unwrap();
    Trained { gaussians: model.gaussians, checkpoint, events: events.events() }
}

impl Trained {
    /// An array of the checkpoint with three numbers per camera.
    fn of_cameras(&self, name: &str, cameras: usize) -> Vec<f32> {
        self.checkpoint.array(name, Some(3 * cameras)).unwrap()
    }
    /// Training half of the header.
    fn header(&self) -> serde_json::Value {
        self.checkpoint.header::<serde_json::Value>().unwrap()["training"].clone()
    }
    /// Messages about `wanted`.
    fn said(&self, wanted: &str) -> Vec<String> {
        let message = |event: &Event| match event {
            Event::Note { object, message } | Event::Warning { object, message } if object == wanted => Some(message.clone()),
            _ => None,
        };
        self.events.iter().filter_map(message).collect()
    }
    /// Asserts that the poses of all cameras changed, and that the run says so in numbers.
    fn assert_refined(&self, cameras: usize) {
        for name in ["rotations", "centres"] {
            let weights = self.of_cameras(&format!("poses/{name}"), cameras);
            let changed = weights.chunks_exact(3).filter(|own| own.iter().any(|weight| *weight != 0.0)).count();
            assert_eq!(changed, cameras, "{name}: {weights:?}");
        }
        let said = self.said("poses");
        assert!(said.len() == 1 && said[0].starts_with(&format!("{cameras} training cameras")), "{said:?}");
        assert!(!said[0].contains("NaN") && !said[0].contains("inf"), "{said:?}");
    }
}

/// Shifts every camera along its own axes, less the mean. Where a weight is over `limit`, no pose is finite; with `gather` all cameras stand at the origin.
/// With the defaults neither happens, because the conformance suite runs for every registered model.
struct Stumbling {
    settings: Settings,
    shifts: Parameter,
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Settings {
    limit: f32,
    gather: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self { limit: 1e9, gather: false }
    }
}

impl Poses for Stumbling {
    fn corrected(&self, camera: &Camera, index: usize) -> Result<Option<Posed>> {
        let count = self.shifts.shape[0];
        if index >= count {
            return Err(Error::parameter("poses stumbling", "there is no such camera", "Report this"));
        }
        let all = self.shifts.value.clone().reshape([count, 3]);
        let own = (all.clone() - all.mean_dim(0)).narrow(0, index, 1);
        let largest = to_vec(self.shifts.value.clone(), "shifts")?.into_iter().map(f32::abs).fold(0.0, f32::max);
        let mut moved = camera.clone();
        for (row, shift) in moved.world_to_camera.iter_mut().zip(to_vec(own.clone(), "shift")?) {
            row[3] += if largest > self.settings.limit { f64::NAN } else { f64::from(shift) };
            if self.settings.gather {
                row[3] = 0.0;
            }
        }
        let column = own.reshape([3, 1]);
        let device = column.device();
        let probe = Tensor::cat(vec![Tensor::zeros([3, 3], &device), column], 1);
        Ok(Some(Posed { camera: moved, probe: Tensor::cat(vec![probe, Tensor::zeros([1, 4], &device)], 0) }))
    }
    fn parameters(&self) -> Vec<&Parameter> {
        vec![&self.shifts]
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        vec![&mut self.shifts]
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        vec![ParameterGroup::plain("shifts", 1e-3, 1e-3)]
    }
}

fn build(section: &toml::Table, context: &PosesContext, device: &Device) -> Result<Box<dyn Poses>> {
    let (settings, count) = (parse_section("poses stumbling", section)?, context.cameras);
    let shifts = Parameter { name: "shifts".into(), part: Part::Net, shape: vec![count, 3], value: Tensor::zeros([3 * count], device), group: 0 };
    Ok(Box::new(Stumbling { settings, shifts }))
}

inventory::submit! {
    PosesPlugin {
        info: Plugin {
            name: "stumbling",
            version: "1",
            summary: "poses that break",
            paper: "a test",
            schema: "limit = 1e9\ngather = false\n",
            capabilities: &[],
        },
        build,
    }
}

#[test]
fn poses_and_their_moments_go_back_with_the_model() {
    // The term breaks at iteration 130, and the last good state is that of iteration 100.
    let of = |when: &str| {
        let loss = format!("loss=[{{kind='l1'}}, {{kind='poison', when='{when}'}}]");
        let config = settings("flex", &[REFINED, ONE_FRAME, "train.shares=[0.0, 0.0, 1.0]", "train.iterations=140", &loss]);
        let scene = open("procedural", &config);
        let count = cameras(&scene);
        (trained(&config, scene), count)
    };
    let ((whole, count), (broken, _)) = (of("never"), of("once"));
    whole.assert_refined(count);
    let said = broken.said("watchdog");
    assert!(whole.said("watchdog").is_empty() && said.len() == 1 && said[0].contains("back to iteration 100"), "{said:?}");
    for name in ["rotations", "centres"] {
        for array in [format!("poses/{name}"), format!("optimizer/poses/{name}/first_moment"), format!("optimizer/poses/{name}/second_moment")] {
            assert!(whole.of_cameras(&array, count) == broken.of_cameras(&array, count), "{array}: the repeated iterations gave other values");
        }
    }
    assert_eq!(whole.header()["optimizer_steps"], broken.header()["optimizer_steps"]);
    assert!(whole.gaussians == broken.gaussians, "the repeated iterations gave other Gaussians");
}

#[test]
fn poses_that_are_not_finite_learn_more_slowly() {
    // Below 100 iterations the only good state is the first one.
    let config = settings("flex", &["poses={kind='stumbling', limit=0.003}", ONE_FRAME, "train.shares=[0.0, 0.0, 1.0]", "train.iterations=90"]);
    let run = trained(&config, open("procedural", &config));
    let said = run.said("watchdog");
    assert!(said.iter().any(|message| message.contains("the corrected pose of camera") && message.contains("to find its source")), "{said:?}");
    assert!(said.iter().any(|message| message.contains("back to iteration 0, and poses learns 0.25 times")), "{said:?}");
    let header = run.header();
    let rates = header["rates"].as_object().unwrap();
    assert!(rates.len() == 1 && rates["poses"].as_f64().unwrap() <= 0.25, "nothing else is to blame: {rates:?}");
}

/// Makes the run in `folder`, interrupted in its coarse stage, one of a program that knew no pose models.
fn forget_poses(folder: &Path) {
    #[derive(serde::Deserialize)]
    struct Stored {
        model: StoredModel,
        training: StoredTraining,
    }
    #[derive(serde::Deserialize)]
    struct StoredModel {
        gaussians: usize,
        attributes: Vec<(String, usize)>,
    }
    #[derive(serde::Deserialize)]
    struct StoredTraining {
        guard: Vec<(String, usize)>,
        optimizer: Vec<(String, [usize; 2])>,
    }
    let path = folder.join(CHECKPOINT);
    let file = CheckpointFile::read(&path, &Limits::default()).unwrap();
    let Stored { model: StoredModel { gaussians, attributes }, training: StoredTraining { guard, optimizer } } = file.header().unwrap();
    let of_model = attributes.into_iter().map(|(name, width)| (format!("gaussians/{name}"), vec![gaussians, width]));
    let of_guard = guard.into_iter().map(|(name, count)| (format!("guard/{name}"), vec![count]));
    let of_optimizer = optimizer.into_iter().map(|(name, shape)| (format!("optimizer/{name}"), shape.to_vec()));
    let mut arrays = CheckpointArrays::default();
    for (name, shape) in of_model.chain(of_guard).chain(of_optimizer) {
        let values = file.array(&name, Some(shape.iter().product())).unwrap();
        arrays.add_values(name, shape, values).unwrap();
    }
    let mut header: serde_json::Value = file.header().unwrap();
    assert!(header["training"].get("poses").is_none(), "a run without poses states some");
    header["model"]["provenance"]["config"].as_object_mut().unwrap().remove("poses").unwrap();
    arrays.write(&path, &header).unwrap();

    let path = folder.join(CONFIG);
    let mut stored: toml::Table = std::fs::read_to_string(&path).unwrap().parse().unwrap();
    stored.remove("poses").unwrap();
    std::fs::write(&path, toml::to_string(&stored).unwrap()).unwrap();
}

#[test]
fn a_run_that_knows_no_poses_goes_on_without_them() {
    let config = settings("flex", &[ONE_FRAME, "train.iterations=40"]);
    let (scene, folder, never) = (Arc::new(open("procedural", &config)), tempfile::tempdir().unwrap(), AtomicBool::new(false));
    let [whole, none, older] = ["whole", "none", "older"].map(|name| folder.path().join(name));
    run(&whole, &config, &scene, false, &Silent, &never).unwrap();
    let bytes = |out: &Path| std::fs::read(out.join(CHECKPOINT)).unwrap();
    for out in [&none, &older] {
        let stop = AtomicBool::new(false);
        let interrupted = run(out, &config, &scene, false, &StopAfter { left: AtomicUsize::new(2), stop: &stop }, &stop);
        assert!(matches!(interrupted.err(), Some(Error::Interrupted(_))));
        if *out == older {
            forget_poses(out);
        }
        let stored = RunConfig::resolve(None, Some(&out.join(CONFIG)), &[]).unwrap();
        // The poses of a run are decided when it begins.
        let mut refined = stored.clone();
        refined.poses = "kind = 'refined'".parse().unwrap();
        let refused = run(out, &refined, &scene, true, &Silent, &never).err().unwrap().to_string();
        assert!(refused.contains("--resume") && refused.contains("poses.kind was \"none\" and is \"refined\""), "{refused}");
        run(out, &stored, &scene, true, &Silent, &never).unwrap();
        assert!(bytes(out) == bytes(&whole), "{}: it ends in other bytes", out.display());
    }
}

#[test]
fn poses_are_refined_on_wgpu_as_on_processors() {
    if !cc4dgs_tests::devices().iter().any(|(name, _)| *name == "wgpu") {
        return;
    }
    let of = |device: &str| {
        let config = settings(device, &[REFINED, ONE_FRAME, "train.iterations=30"]);
        let scene = open("procedural", &config);
        let count = cameras(&scene);
        let run = trained(&config, scene);
        run.assert_refined(count);
        ["poses/rotations", "poses/centres"].map(|name| run.of_cameras(name, count))
    };
    let (wgpu, again, flex) = (of("wgpu"), of("wgpu"), of("flex"));
    assert!(wgpu == again, "two runs of one seed differ");
    for (a, b) in wgpu.iter().zip(&flex) {
        let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum::<f64>();
        let cosine = dot(a, b) / (dot(a, a) * dot(b, b)).sqrt();
        assert!(cosine > 0.9, "wgpu moves cameras elsewhere than flex, cosine {cosine}: {a:?} and {b:?}");
    }
}

#[test]
fn a_single_camera_is_trained_as_without_poses() {
    for frames in [ONE_FRAME, "scene.frames=[0, 3, 1]"] {
        let of = |poses: &str| {
            let config = settings("flex", &[poses, frames, "train.iterations=20"]);
            let mut scene = open("procedural", &config);
            let camera = scene.views[scene.split(Split::Train)[0]].camera;
            scene.views.iter_mut().filter(|view| view.camera != camera).for_each(|view| view.split = Split::Test);
            assert_eq!(cameras(&scene), 1);
            trained(&config, scene)
        };
        let (none, refined) = (of("poses.kind=none"), of(REFINED));
        assert!(none.gaussians == refined.gaussians, "{frames}: a pose that does not change changes the Gaussians");
        for name in ["poses/rotations", "poses/centres"] {
            assert_eq!(refined.of_cameras(name, 1), [0.0; 3], "{frames}");
        }
        assert_eq!(refined.said("poses"), ["a single training camera keeps its pose"]);
    }
}

#[test]
fn every_pose_of_a_moving_camera_is_refined() {
    let config = settings("flex", &[REFINED, "scene.frames=[0, 12, 1]", "init.source=random", "train.iterations=40"]);
    let scene = open("procedural:captures/handheld", &config);
    let count = cameras(&scene);
    assert!(count > 8 && scene.split(Split::Train).len() == count, "one camera per frame");
    trained(&config, scene).assert_refined(count);
}

#[test]
fn cameras_that_share_a_point_are_refined() {
    let config = settings("flex", &[REFINED, ONE_FRAME, "train.iterations=40"]);
    let mut scene = open("procedural", &config);
    // They differ by a roll, so that all of them see the scene.
    let first = scene.cameras[0].world_to_camera;
    for (index, camera) in scene.cameras.iter_mut().enumerate() {
        let (sin, cos) = (0.05 * index as f64).sin_cos();
        camera.world_to_camera = first;
        camera.world_to_camera[0] = std::array::from_fn(|k| cos * first[0][k] + sin * first[1][k]);
        camera.world_to_camera[1] = std::array::from_fn(|k| cos * first[1][k] - sin * first[0][k]);
    }
    assert_eq!(scene.extent(), 1.0, "their distances from the mean are no unit of length");
    let count = cameras(&scene);
    trained(&config, scene).assert_refined(count);
}

#[test]
fn key_frames_are_matched_with_corrected_cameras() {
    let of = |poses: &str| {
        let small = ["scene.width=96", "scene.height=96", "init.count=200", "train.shares=[0.0, 1.0, 1.0]", "train.iterations=12", "train.checks=false"];
        let parts = ["density={kind='none'}", "train.key_frames=4", "train.dynamic=score", poses];
        let sets: Vec<String> = small.iter().chain(&parts).map(ToString::to_string).collect();
        let mut config = RunConfig::resolve(Some("demo+free-time"), None, &sets).unwrap();
        config.device = "flex".into();
        trained(&config, open("procedural", &config))
    };
    let (recorded, gathered) = (of("poses.kind=none"), of("poses={kind='stumbling', gather=true}"));
    assert!(recorded.said("train.key_frames").is_empty() && recorded.said("key frames").len() == 1, "{:?}", recorded.events);
    // Images from one point say nothing of depth.
    let said = gathered.said("train.key_frames");
    assert!(said.len() == 1 && said[0].contains("points need several cameras") && gathered.said("key frames").is_empty(), "{:?}", gathered.events);
}
