//! Poses that are learned: cameras that stand elsewhere than the dataset says, resuming, and mistakes of pose models.

use burn::tensor::{Device, Tensor};
use cc4dgs::{Session, deformers as _, parts as _};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    Camera, Error, Event, Parameter, ParameterGroup, Part, Plugin, Posed, Poses, PosesContext, PosesPlugin, Registry, Result, Scene, Seed, Split, conformance,
    toml,
};
use cc4dgs_tests::StopAfter;
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::train::{TrainJob, train};
use glam::{DMat3, DVec3};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

/// Radians by which cameras are turned, and units of the scene by which they are moved, about.
const TURN: f64 = 0.03;
const SHIFT: f64 = 0.03;

fn config(session: &Session, poses: &str, iterations: usize) -> RunConfig {
    let iterations = format!("train.iterations={iterations}");
    let sets =
        ["scene.frames=[0, 1, 1]", "scene.width=64", "train.shares=[1.0, 0.0, 1.0]", "train.checks=false", "deformer.kind=none", "density={kind='none'}"];
    let sets: Vec<&str> = sets.into_iter().chain(["init.count=2000", poses, &iterations]).collect();
    session.config("demo", &sets).unwrap()
}

/// The built-in scene, whose training cameras stand a little elsewhere than they say, in other directions.
fn displaced(session: &Session, config: &RunConfig) -> Scene {
    let mut scene = session.read_scene("procedural", &config.scene).unwrap();
    let training: Vec<usize> = scene.split(Split::Train).iter().map(|&view| scene.views[view].camera).collect();
    assert_eq!(training.len(), 12, "the directions below cancel out");
    let count = training.len() as f64;
    for (k, camera) in training.into_iter().enumerate() {
        // Evenly spread phases: the mean over twelve cameras is 0.
        let phase = std::f64::consts::TAU * k as f64 / count;
        let (r, t) = scene.cameras[camera].rotation_translation();
        let turn = DVec3::new((5.0 * phase).sin(), (5.0 * phase).cos(), (3.0 * phase).sin()) * TURN;
        let center = -(r.transpose() * t) + DVec3::new((3.0 * phase).cos(), (4.0 * phase).sin(), (4.0 * phase).cos()) * SHIFT;
        let r = r * DMat3::from_axis_angle(turn.normalize(), turn.length());
        let t = -(r * center);
        for row in 0..3 {
            scene.cameras[camera].world_to_camera[row] = [r.row(row).x, r.row(row).y, r.row(row).z, t[row]];
        }
    }
    scene
}

/// PSNR of the test images after so many iterations from displaced cameras, and what the run says of its poses.
fn trained(poses: &str, iterations: usize) -> (f64, Option<String>) {
    let said = Arc::new(Mutex::new(None));
    let told = said.clone();
    let listener = move |event: &Event| {
        if let Event::Note { object, message } = event
            && object == "poses"
        {
            *told.lock().unwrap() = Some(message.clone());
        }
    };
    let session = Session::builder().device("flex").on_event(listener).build().unwrap();
    let config = config(&session, poses, iterations);
    let scene = Arc::new(displaced(&session, &config));
    let model = session.train(&config, scene.clone(), None).unwrap();
    let psnr = session.evaluate(&model, &scene, Split::Test).unwrap().psnr_db;
    let said = said.lock().unwrap().take();
    (psnr, said)
}

#[test]
fn cameras_that_stand_elsewhere_are_found() {
    let (without, silent) = trained("poses.kind=none", 800);
    let (with, said) = trained("poses.kind=refined", 800);
    assert!(with > without + 4.0, "held-out cameras: {without} dB with the displaced poses, {with} with corrected ones");
    assert!(silent.is_none() && said.is_some_and(|said| said.contains("degrees")), "the run does not say what it corrected");
}

#[test]
fn who_scores_training_views_is_told_whose_poses_they_have() {
    let warnings = Arc::new(AtomicUsize::new(0));
    let counted = warnings.clone();
    let listener = move |event: &Event| {
        if let Event::Warning { message, .. } = event
            && message.contains("poses of the dataset")
        {
            counted.fetch_add(1, Ordering::Relaxed);
        }
    };
    let session = Session::builder().device("flex").on_event(listener).build().unwrap();
    for (poses, of_training_views) in [("poses.kind=refined", 1), ("poses.kind=none", 0)] {
        let config = config(&session, poses, 40);
        let scene = Arc::new(displaced(&session, &config));
        let model = session.train(&config, scene.clone(), None).unwrap();
        for (split, expected) in [(Split::Train, of_training_views), (Split::Test, 0)] {
            warnings.store(0, Ordering::Relaxed);
            session.evaluate(&model, &scene, split).unwrap();
            assert_eq!(warnings.load(Ordering::Relaxed), expected, "{poses}, {split:?}");
        }
    }
}

#[test]
fn a_resumed_run_continues_with_the_poses_it_had() {
    let session = Session::builder().device("flex").build().unwrap();
    let mut config = config(&session, "poses={kind='refined', identity=0.5}", 40);
    // Small images, whose cameras have poses of the same index.
    config.train.image_growth = 0.5;
    let (registry, scene, folder) = (Registry::collect().unwrap(), Arc::new(displaced(&session, &config)), tempfile::tempdir().unwrap());
    let run = |out: &Path, resume: bool, after: usize| {
        let stop = AtomicBool::new(false);
        let events = StopAfter { left: AtomicUsize::new(after), stop: &stop };
        let (config, scene, out) = (&config, scene.clone(), Some(out.to_path_buf()));
        train(&TrainJob { config, scene, out, resume, registry: &registry, events: &events, stop: &stop, observer: None })
    };
    let (whole, parts) = (folder.path().join("whole"), folder.path().join("parts"));
    run(&whole, false, usize::MAX).unwrap();
    assert!(run(&parts, false, 2).is_err(), "it was not interrupted");
    run(&parts, true, usize::MAX).unwrap();
    let bytes = |out: &Path| std::fs::read(out.join("checkpoint")).unwrap();
    assert!(bytes(&whole) == bytes(&parts), "an interrupted and resumed run differs from an uninterrupted one");
}

#[test]
fn mistakes_in_settings_are_named() {
    let registry = Registry::collect().unwrap();
    let context = PosesContext { cameras: 3, extent: 1.0, seed: Seed::root(1) };
    let refused = |section: &str| {
        let section: toml::Table = section.parse().unwrap();
        registry.build_poses(&section, &context, &Device::flex()).err().unwrap().to_string()
    };
    assert!(refused("kind = 'refind'").contains("refined"));
    assert!(refused("kind = 'refined'\nlr = -1.0").contains("lr"));
    assert!(refused("kind = 'refined'\nwarmup = 2.0").contains("warmup"));
    assert!(refused("kind = 'refined'\nidentity = nan").contains("identity"));
    assert!(refused("kind = 'refined'\nrate = 1.0").contains("rate"));
}

/// A shift per training camera along its own axes, with a mistake.
struct Shifted {
    mistake: Mistake,
    parameters: Vec<Parameter>,
}

#[derive(Clone, Copy, PartialEq)]
enum Mistake {
    None,
    /// The probe has the opposite gradient.
    Opposite,
    /// The probe lacks one of the three numbers.
    Partial,
    /// The rotation is stretched.
    Stretched,
    /// All cameras may move together.
    Together,
    /// So they may, but not along (1, 1, 1).
    TogetherAcross,
    /// A camera that is the only one may move.
    Single,
    /// A camera that does not exist is taken for the first.
    Beyond,
}

impl Poses for Shifted {
    fn corrected(&self, camera: &Camera, index: usize) -> Result<Option<Posed>> {
        let all = self.parameters[0].value.clone().reshape([self.parameters[0].shape[0], 3]);
        let centred = match self.mistake {
            Mistake::Together => all.clone(),
            Mistake::TogetherAcross => all.clone() - all.clone().mean_dim(0).mean_dim(1),
            Mistake::Single if all.dims()[0] == 1 => all.clone(),
            _ => all.clone() - all.clone().mean_dim(0),
        };
        let index = if index >= all.dims()[0] && self.mistake == Mistake::Beyond { 0 } else { index };
        if index >= all.dims()[0] {
            return Err(Error::parameter("poses", "there is no such camera", "Report this"));
        }
        let own = centred.narrow(0, index, 1);
        let mut moved = camera.clone();
        for (row, shift) in moved.world_to_camera.iter_mut().zip(to_vec(own.clone(), "shift")?) {
            row[3] += f64::from(shift);
            if self.mistake == Mistake::Stretched {
                row[0] *= 1.01;
            }
        }
        let column = own.reshape([3, 1]).mul_scalar(if self.mistake == Mistake::Opposite { -1.0 } else { 1.0 });
        let device = column.device();
        let column = match self.mistake {
            Mistake::Partial => column * Tensor::<2>::from_floats([[1.0], [1.0], [0.0]], &device),
            _ => column,
        };
        let probe = Tensor::cat(vec![Tensor::zeros([3, 3], &device), column], 1);
        Ok(Some(Posed { camera: moved, probe: Tensor::cat(vec![probe, Tensor::zeros([1, 4], &device)], 0) }))
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        vec![ParameterGroup::plain("shifts", 1e-3, 1e-3)]
    }
}

fn build_shifted(mistake: Mistake, settings: &toml::Table, context: &PosesContext, device: &Device) -> Result<Box<dyn Poses>> {
    if let Some(key) = settings.keys().next() {
        return Err(Error::parameter(format!("poses shifted: {key}"), "there is no such setting", "Leave it out"));
    }
    let n = context.cameras;
    let shifts = Parameter { name: "shifts".into(), part: Part::Net, shape: vec![n, 3], value: Tensor::zeros([3 * n], device), group: 0 };
    Ok(Box::new(Shifted { mistake, parameters: vec![shifts] }))
}

type Build = fn(&toml::Table, &PosesContext, &Device) -> Result<Box<dyn Poses>>;

#[test]
fn mistakes_of_pose_models_are_found() {
    let cases: [(Build, &str); 8] = [
        (|settings, context, device| build_shifted(Mistake::None, settings, context, device), ""),
        (|settings, context, device| build_shifted(Mistake::Opposite, settings, context, device), "per unit along a direction"),
        (|settings, context, device| build_shifted(Mistake::Partial, settings, context, device), "per unit along a direction"),
        (|settings, context, device| build_shifted(Mistake::TogetherAcross, settings, context, device), "where all weights change alike"),
        (|settings, context, device| build_shifted(Mistake::Stretched, settings, context, device), "is not rigid"),
        (|settings, context, device| build_shifted(Mistake::Together, settings, context, device), "where all weights change alike"),
        (|settings, context, device| build_shifted(Mistake::Single, settings, context, device), "a single camera moves"),
        (|settings, context, device| build_shifted(Mistake::Beyond, settings, context, device), "is no error"),
    ];
    for (build, wanted) in cases {
        let info = Plugin { name: "shifted", version: "1", summary: "a test", paper: "", schema: "# no settings\n", capabilities: &[] };
        let found = conformance::poses(&PosesPlugin { info, build }, &toml::Table::new(), &Device::flex()).join("\n");
        assert!(found.contains(wanted) && found.is_empty() == wanted.is_empty(), "expected '{wanted}' among:\n{found}");
    }
}
