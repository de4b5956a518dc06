//! That learning rates follow the views that an iteration has, and not those that it was to have.

use cc4dgs::train::train::{TrainJob, train};
use cc4dgs::{RunConfig, Session};
use cc4dgs_core::HostGaussians;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Trains on the six views of one frame with `batch` views per iteration.
fn trained(batch: usize) -> HostGaussians {
    let session = Session::builder().device("flex").build().unwrap();
    let mut sets = vec![format!("train.batch={batch}")];
    sets.extend(["train.coarse_batch=0", "train.lr.batch_power=0.5", "train.iterations=20", "train.shares=[1.0, 0.0, 1.0]"].map(String::from));
    sets.extend(["train.checks=false", "scene.frames=[0, 1, 1]", "init.count=300", "deformer.kind=none"].map(String::from));
    let config = RunConfig::resolve(Some("demo"), None, &sets).unwrap();
    let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene).unwrap());
    let (registry, events, stop) = (session.registry(), session.events(), &AtomicBool::new(false));
    train(&TrainJob { config: &config, scene, out: None, resume: false, registry, events, stop, observer: None }).unwrap().0.gaussians
}

#[test]
fn a_batch_of_more_views_than_there_are_trains_as_one_of_all_views() {
    assert!(trained(6) == trained(9), "learning rates are those of views that are not there");
}
