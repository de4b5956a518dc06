//! Looking at a training changes no byte of its result, and shows the model as it is.

use cc4dgs::play::bake::keyframes;
use cc4dgs::train::train::{Observer, Snapshot, Standing, TrainJob, train};
use cc4dgs::{RunConfig, Session};
use cc4dgs_core::Stage;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

const KEYFRAMES: usize = 4;

/// Keeps the last snapshot; looks at every seventh iteration.
#[derive(Default)]
struct Looker {
    iterations: AtomicUsize,
    seen: Mutex<Vec<Standing>>,
    last: Mutex<Option<Snapshot>>,
}

impl Observer for Looker {
    fn after_iteration(&self, standing: &Standing, _: &AtomicBool) -> usize {
        self.iterations.fetch_add(1, Ordering::Relaxed);
        if standing.iteration.is_multiple_of(7) || standing.iteration == standing.of { KEYFRAMES } else { 0 }
    }
    fn receive(&self, snapshot: Snapshot) {
        self.seen.lock().unwrap().push(snapshot.standing);
        *self.last.lock().unwrap() = Some(snapshot);
    }
}

/// Trains into `out` and returns the checkpoint's bytes.
fn run(out: &Path, observer: Option<&dyn Observer>) -> Vec<u8> {
    let session = Session::builder().device("flex").build().unwrap();
    let sets = ["train.iterations=120", "train.batch=2", "train.checks=false", "train.log_every=5", "deformer.kind=cdf-basis", "deformer.unused=0.0"];
    let sets = sets.map(String::from);
    let config = RunConfig::resolve(Some("demo"), None, &sets).unwrap();
    let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene).unwrap());
    let (registry, events, stop) = (session.registry(), session.events(), &AtomicBool::new(false));
    train(&TrainJob { config: &config, scene, out: Some(out.to_path_buf()), resume: false, registry, events, stop, observer }).unwrap();
    std::fs::read(out.join("checkpoint")).unwrap()
}

#[test]
fn a_training_that_is_watched_ends_in_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let (alone, watched) = (folder.path().join("alone"), folder.path().join("watched"));
    let looker = Looker::default();
    assert!(run(&alone, None) == run(&watched, Some(&looker)));
    let seen = looker.seen.lock().unwrap();
    assert!(looker.iterations.load(Ordering::Relaxed) >= 120 && seen.iter().any(|s| s.stage == Stage::Coarse), "{seen:?}");
    // The last snapshot is the trained model, at its keyframes.
    let last = looker.last.lock().unwrap().take().unwrap();
    assert_eq!((last.standing.stage, last.standing.iteration, last.moved.len()), (Stage::Main, last.standing.of, KEYFRAMES));
    assert_eq!(last.standing.views, 2);
    let session = Session::builder().device("flex").build().unwrap();
    let model = session.open(&watched).unwrap();
    assert!(last.gaussians.means == model.gaussians.means && !last.rows.is_empty());
    let layer = keyframes(&last.gaussians, &last.rows, &last.moved).unwrap();
    let mut player = session.player(&model).unwrap();
    for k in 0..KEYFRAMES {
        let time = k as f32 / (KEYFRAMES - 1) as f32;
        // The player has the moving Gaussians first.
        let exact = player.gaussians_at(time).unwrap().to_host().unwrap();
        let shown = layer.apply(&last.gaussians, time);
        for (i, &row) in last.rows.iter().enumerate() {
            for c in 0..3 {
                let (a, b) = (exact.means[3 * i + c], shown.means[3 * row as usize + c]);
                assert!((a - b).abs() < 1e-4, "Gaussian {row} at {time}: {a} and {b}");
            }
        }
    }
}
