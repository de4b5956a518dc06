//! The preset `auto`: plans for captures, and that no density control makes a training collapse.

use burn::tensor::Device;
use cc4dgs::{backends as _, codecs as _, deformers as _, parts as _};
use cc4dgs_core::{Event, Recorder, Registry, Scene, Silent, Split};
use cc4dgs_play::Model;
use cc4dgs_train::auto;
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::data::hold_out;
use cc4dgs_train::eval::{Scored, evaluate};
use cc4dgs_train::layers::Layers;
use cc4dgs_train::train::{TrainJob, train};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// The plan for a capture at small size, with a stated number of iterations, so that nothing depends on how fast the machine is.
fn planned(capture: &str, sets: &[&str], registry: &Registry) -> (RunConfig, Arc<Scene>) {
    let sets: Vec<String> = ["scene.width=64", "device=flex", "train.log_every=10"].iter().chain(sets).map(ToString::to_string).collect();
    let layers = Layers::collect(registry, Some(auto::PRESET), None, &sets).unwrap();
    auto::open(Path::new(&format!("procedural:captures/{capture}")), &layers, registry, &Silent, &AtomicBool::new(false)).unwrap()
}

fn trained(config: &RunConfig, scene: &Arc<Scene>, registry: &Registry) -> (Model, Vec<Event>) {
    let (events, stop) = (Recorder::default(), AtomicBool::new(false));
    let job = TrainJob { config, scene: scene.clone(), out: None, resume: false, registry, events: &events, stop: &stop, observer: None };
    let model = train(&job).unwrap().0;
    (model, events.events())
}

/// Gaussians are neither lost nor multiplied without bound, and the held-out images are better than a grey blur, with each density control.
#[test]
fn density_control_does_not_collapse() {
    let registry = Registry::collect().unwrap();
    let controls: Vec<&str> = registry.plugins().into_iter().filter(|(kind, _)| *kind == "density").map(|(_, plugin)| plugin.name).collect();
    assert!(controls.len() >= 2);
    // PSNR in dB that the worst control reaches on each capture at this size in 300 iterations, less 1.5 dB.
    for (capture, floor_db) in [("handheld", 17.6), ("turntable", 16.3), ("rig", 17.9)] {
        for control in &controls {
            let density = format!("density={{kind='{control}'}}");
            let (config, scene) = planned(capture, &["train.iterations=300", "init.count=1500", &density], &registry);
            let (model, events) = trained(&config, &scene, &registry);
            let begun = events.iter().find_map(|event| match event {
                Event::StageStarted { gaussians, .. } => Some(*gaussians),
                _ => None,
            });
            let (begun, ended) = (begun.unwrap(), model.gaussians.len());
            assert!(2 * ended >= begun && ended <= 20 * begun, "{capture}, {control}: {begun} Gaussians became {ended}");
            let psnr =
                evaluate(&model, &scene, Scored { max_views: 6, ..Scored::all(Split::Test) }, &registry, &Device::flex(), &Silent, &mut |_, _, _, _| Ok(()))
                    .unwrap()
                    .psnr_db;
            println!("{capture}, {control}: {psnr:.2} dB, {begun} Gaussians became {ended}");
            assert!(psnr >= floor_db, "{capture}, {control}: {psnr:.2} dB, at least {floor_db} are expected");
        }
    }
}

/// What is special about a capture is found, and what is stated has precedence.
#[test]
fn plans_fit_the_capture() {
    let registry = Registry::collect().unwrap();
    let plan = |capture: &str| planned(capture, &["train.iterations=100"], &registry).0;
    let kind = |section: &toml::Table| section["kind"].as_str().unwrap().to_string();
    let photos = plan("photos");
    assert_eq!(kind(&photos.deformer), "none");
    let handheld = plan("handheld");
    assert_eq!((kind(&handheld.deformer), handheld.train.iterations), ("cdf-basis".into(), 100));
    // The upper bound of Gaussians is that of the control that is asked for, if it has one.
    let with = |control: &str| planned("handheld", &["train.iterations=100", &format!("density.kind={control}")], &registry).0.density;
    assert_eq!(with("clone-split")["max_gaussians"], handheld.density["max_gaussians"]);
    assert!(!with("none").contains_key("max_gaussians"));
    assert_eq!(kind(&plan("exposure").appearance), "affine");
    assert_eq!(kind(&plan("dome").appearance), "none");
    let turntable = plan("turntable");
    assert!(turntable.render.background.unwrap().iter().all(|c| *c > 0.97), "{:?}", turntable.render.background);
    assert!(handheld.render.background.is_some_and(|c| c.iter().all(|c| *c < 0.9)), "the mean colour of the images");
    // The plan is part of the configuration; planning again from it changes nothing.
    let text = handheld.to_toml().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("config.toml");
    std::fs::write(&file, &text).unwrap();
    let layers = Layers::collect(&registry, None, Some(&file), &[]).unwrap();
    assert!(!layers.want_plan() && !handheld.auto.plan.is_empty());
    let overlap = |config: &RunConfig, noun: &str| config.auto.plan.iter().any(|line| line.starts_with("overlap: ") && line.contains(noun));
    assert!(overlap(&handheld, "of 64 positions") && overlap(&photos, "of 35 cameras"), "{:?} {:?}", handheld.auto.plan, photos.auto.plan);
    assert_eq!(layers.config().unwrap().to_toml().unwrap(), text);
    let (other, _) = planned("handheld", &["train.iterations=100", "deformer.kind=hexplane", "train.batch=2"], &registry);
    assert_eq!((kind(&other.deformer), other.train.batch), ("hexplane".into(), 2));
    // One line names what is left out, by the settings of the deformer and of the rasterizer.
    let skips = |config: &RunConfig| config.auto.plan.iter().find(|line| line.starts_with("not computed")).cloned().unwrap();
    let named = |config: &RunConfig| ["train.batch", "deformer.vertex_reuse", "rasterizer.opacity_shortcut"].map(|key| skips(config).contains(key));
    assert_eq!((named(&handheld), named(&other), named(&photos)), ([false, true, true], [true, false, true], [false, false, true]));
}

#[test]
fn a_plan_does_not_look_at_what_training_keeps_out() {
    let registry = Registry::collect().unwrap();
    let (config, scene) = planned("sparse", &["train.iterations=100", "train.validation=1"], &registry);
    let trained_on = hold_out(&scene, 1).unwrap().split(Split::Train).len();
    let seen = &config.auto.plan[0];
    assert!(trained_on < scene.split(Split::Train).len() && seen.contains(&format!(": {trained_on} training images")), "{trained_on}, {seen}");
}
