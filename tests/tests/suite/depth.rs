//! Recorded depth in training: the value of the loss term `depth`, scenes without depth, and what the term does to the depth of a model.

use burn::tensor::{Device, Int, Tensor};
use cc4dgs::Session;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, Event, Gaussians, HostGaussians, LossInput, Registry, Schedule, Split, Stage, View, toml};
use cc4dgs_train::train::{RefitJob, prune_and_refit};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

/// The value of the term with `settings` for three pixels, the third of unknown depth, and its gradients by alpha and depth.
fn of_three_pixels(settings: &str, schedule: &Schedule) -> (f32, Vec<f32>) {
    let device = Device::flex().autodiff();
    let (alpha, depth) = ([0.5f32, 1.0, 0.0], [1.0f32, 3.0, 7.0]);
    let planes = Tensor::<3>::from_floats([[[0.3; 3]], [[0.3; 3]], [[0.3; 3]], [alpha], [depth]], &device).require_grad();
    let (target, recorded) = (Tensor::<3>::zeros([3, 1, 3], &device), Tensor::<3>::from_floats([[[2.0f32, 2.0, 0.0]]], &device));
    let gaussians = Gaussians::from_host(&HostGaussians { sh_degree: 1, ..Default::default() }, &device);
    let radii = Tensor::<1, Int>::zeros([1], &Device::flex());
    let camera = Camera::look_at("a camera", (3, 1), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
    let view = View { camera: 0, frame: 0, time_norm: 0.5, split: Split::Train };
    let settings: toml::Table = settings.parse().unwrap();
    let term = (Registry::collect().unwrap().loss("depth").unwrap().build)(&settings).unwrap();
    let input = LossInput::new(&camera, &view, &planes, &target, &gaussians, &radii, schedule);
    assert!(term.wants_depth() && term.value(&input).unwrap().is_none(), "a view without depth adds nothing");
    let value = term.value(&input.with_depth(Some(&recorded))).unwrap().unwrap();
    let gradients = to_vec(planes.grad(&value.clone().backward()).unwrap(), "gradients").unwrap();
    assert_eq!(gradients[..9], [0.0; 9], "colours do not matter");
    (to_vec(value, "value").unwrap()[0], gradients[9..].to_vec())
}

#[test]
fn the_difference_is_a_share_of_the_recorded_depth() {
    let start = Schedule::main(10);
    // Half of a surface at 2 is no difference, all of one at 3 is half of the depth. An alpha of 0 and a depth that is unknown have no gradient.
    let (value, gradients) = of_three_pixels("", &start);
    assert_eq!((value, gradients), (0.25, vec![0.0, -0.5, 0.0, 0.0, 0.25, 0.0]));
    let falling = |schedule: &Schedule| of_three_pixels("end_share = 0.01", schedule).0;
    let expected = [(start, 0.01f64.powf(0.1)), (Schedule { iteration: 10, ..start }, 0.01), (Schedule { stage: Stage::Coarse, iteration: 10, ..start }, 1.0)];
    for (schedule, share) in expected {
        assert!((f64::from(falling(&schedule)) / 0.25 - share).abs() < 1e-6, "{schedule:?}: {} times {share}", falling(&schedule));
    }
    for settings in ["end_share = 0.0", "end_share = 1.5", "end_share = nan"] {
        let built = (Registry::collect().unwrap().loss("depth").unwrap().build)(&settings.parse().unwrap());
        assert!(built.err().unwrap().to_string().contains("end_share"), "{settings}");
    }
}

/// Settings of a short training of what one instant shows, with a `weight` of the term.
fn sets(weight: f32, iterations: usize) -> Vec<String> {
    let mut sets = vec![format!("loss=[{{kind='l1', weight=0.8}}, {{kind='dssim', weight=0.2}}, {{kind='depth', weight={weight:?}}}]")];
    sets.push(format!("train.iterations={iterations}"));
    sets.extend(["train.shares=[1.0, 0.0, 1.0]", "train.checks=false", "deformer.kind=none", "density={kind='none'}"].map(String::from));
    sets.extend(["init.source=random", "init.count=600", "scene.frames=[0, 1, 1]", "scene.width=48"].map(String::from));
    sets
}

/// The mean of |z / d - 1| over the pixels of all training views of a capture of four cameras, with the depth z of the model after so many iterations.
fn depth_error(weight: f32, iterations: usize) -> f64 {
    let session = Session::builder().device("flex").build().unwrap();
    let sets = sets(weight, iterations);
    let config = session.config("demo", &sets.iter().map(String::as_str).collect::<Vec<_>>()).unwrap();
    let scene = Arc::new(session.read_scene("procedural:captures/sparse", &config.scene).unwrap());
    let model = session.train(&config, scene.clone(), None).unwrap();
    let mut player = session.player(&model).unwrap();
    let (mut sum, mut count) = (0.0, 0.0);
    for view in scene.split(Split::Train) {
        let planes = to_vec(player.render(scene.camera(view), scene.views[view].time_norm).unwrap().0.planes, "planes").unwrap();
        let recorded = scene.depth(view).unwrap().unwrap();
        let pixels = recorded.values.len();
        for (pixel, d) in recorded.values.iter().enumerate().filter(|(_, d)| **d > 0.0) {
            let z = planes[4 * pixels + pixel] / planes[3 * pixels + pixel].max(1e-3);
            sum += f64::from((z / d - 1.0).abs());
            count += 1.0;
        }
    }
    assert!(count > 1000.0);
    sum / count
}

#[test]
fn the_depth_of_a_model_follows_the_recorded_one() {
    let (first, without, with) = (depth_error(1.0, 4), depth_error(0.0, 200), depth_error(1.0, 200));
    assert!(with < 0.8 * first && with < 0.8 * without, "{first} at first, {without} without the term, {with} with it");
}

#[test]
fn a_scene_without_depth_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    crate::readers::common::write_nerfstudio(folder.path(), 4);
    let session = Session::builder().device("flex").build().unwrap();
    let train = |weight: f32| {
        let sets = sets(weight, 4);
        let config = session.config("demo", &sets.iter().map(String::as_str).collect::<Vec<_>>()).unwrap();
        let scene = session.read_scene(folder.path(), &config.scene).unwrap();
        session.train(&config, scene, None).map(drop).map_err(|e| e.to_string())
    };
    let message = train(1.0).unwrap_err();
    assert!(message.starts_with("loss depth: ") && message.contains("depth_file_path"), "{message}");
    assert_eq!(train(0.0), Ok(()), "a term without weight wants nothing");
}

#[test]
fn further_training_leaves_out_depth_that_is_missing_unless_nothing_else_is_left() {
    let folder = tempfile::tempdir().unwrap();
    crate::readers::common::write_nerfstudio(folder.path(), 4);
    let warnings = Arc::new(Mutex::new(Vec::new()));
    let told = warnings.clone();
    let listener = move |event: &Event| {
        if let Event::Warning { object, message } = event {
            told.lock().unwrap().push(format!("{object}: {message}"));
        }
    };
    let session = Session::builder().device("flex").on_event(listener).build().unwrap();
    let sets = sets(0.0, 4);
    let config = session.config("demo", &sets.iter().map(String::as_str).collect::<Vec<_>>()).unwrap();
    let scene = Arc::new(session.read_scene(folder.path(), &config.scene).unwrap());
    let mut model = session.train(&config, scene.clone(), None).unwrap();
    let (finetune, never): (toml::Table, AtomicBool) = ("finetune = 2".parse().unwrap(), AtomicBool::new(false));
    // The outcomes of fine-tuning and of re-fit, and the warnings about depth of both, for a model that was trained with `loss`.
    let mut further = |loss: &str| {
        let trained: toml::Table = format!("loss = [{loss}]").parse().unwrap();
        model.provenance.config.insert("loss".into(), trained["loss"].clone());
        warnings.lock().unwrap().clear();
        let tuned = model.save_tuned(folder.path().join("model.cc4d"), "compact:max-drop=0.5dB", &finetune, "fp32", &scene).map(drop);
        let (registry, device, limits, events) = (session.registry(), session.device(), session.limits(), session.events());
        let refitted = prune_and_refit(&mut model, &scene, 0.2, 2, &RefitJob { registry, device, limits, events, stop: &never }).map(drop);
        let warned = warnings.lock().unwrap().iter().filter(|line| line.starts_with("loss depth: ")).count();
        ([tuned, refitted].map(|done| done.map_err(|e| e.to_string())), warned)
    };
    let (alone, warned) = further("{kind='depth', weight=0.2}");
    for done in alone {
        let message = done.unwrap_err();
        assert!(message.starts_with("loss depth: ") && message.contains("finetune=0") && message.contains("--refit 0"), "{message}");
    }
    assert_eq!(warned, 0);
    assert_eq!(further("{kind='l1', weight=0.8}, {kind='depth', weight=0.2}"), ([Ok(()), Ok(())], 2), "each warns once");
}

#[test]
fn scores_are_not_trained_on_depth() {
    let session = Session::builder().device("flex").build().unwrap();
    let mut sets = sets(0.0, 4);
    sets.push("score_loss={kind='depth', weight=1.0}".into());
    let config = session.config("demo", &sets.iter().map(String::as_str).collect::<Vec<_>>()).unwrap();
    let scene = session.read_scene("procedural:captures/sparse", &config.scene).unwrap();
    let message = session.train(&config, scene, None).map(drop).unwrap_err().to_string();
    assert!(message.starts_with("score_loss depth: ") && message.contains("mask-bce"), "{message}");
}
