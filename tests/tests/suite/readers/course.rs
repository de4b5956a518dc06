//! A short training, iteration by iteration, to be compared with another one of the same scene.

use cc4dgs_core::{Event, HostGaussians, Recorder, Registry, Scene, Seed, Silent, Stage};
use cc4dgs_play::Model;
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::init::initialise;
use cc4dgs_train::train::{Observer, Snapshot, Standing, TrainJob, train};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

/// Gaussians at the beginning of a short training.
pub const COUNT: usize = 300;
/// Iterations of its coarse and of its main stage: too few for differences of rounding to grow, as they do in a long training.
const STAGES: [usize; 2] = [6, 10];
/// Iterations between two rounds of density control: each stage has one.
pub const ROUND: usize = 4;
/// Learning rates of centres and velocities, as shares of the extent.
const RATES: [f64; 2] = [1.6e-4, 1.6e-3];

/// Keeps the model after every iteration.
#[derive(Default)]
struct Snapshots(Mutex<Vec<Snapshot>>);

impl Observer for Snapshots {
    fn after_iteration(&self, _: &Standing, _: &AtomicBool) -> usize {
        1
    }
    fn receive(&self, snapshot: Snapshot) {
        self.0.lock().unwrap().push(snapshot);
    }
}

/// A short training, iteration by iteration.
pub struct Course {
    extent: f64,
    start: HostGaussians,
    after: Vec<Snapshot>,
    events: Vec<Event>,
    pub model: Model,
}

/// The configuration of a short training with `parts`.
pub fn short(parts: &[String]) -> RunConfig {
    let [coarse, main] = STAGES;
    let mut sets = parts.to_vec();
    sets.extend(["init.source=points", "train.dynamic=all", "train.log_every=1", "train.lr.batch_power=0.0", "density.from=0"].map(String::from));
    sets.extend([format!("init.count={COUNT}"), format!("train.iterations={}", coarse + main), format!("train.shares=[{coarse}.0,0.0,{main}.0]")]);
    sets.extend([format!("train.lr.means={}", RATES[0]), format!("train.lr.means_end={}", RATES[0]), format!("density.every={ROUND}")]);
    RunConfig::resolve(Some("demo"), None, &sets).unwrap()
}

impl Course {
    /// Trains on `scene`, whose images are read during training.
    pub fn run(scene: Scene, config: &RunConfig) -> Self {
        let start = initialise(&scene, config, Seed::root(config.seed).child("init"), &Silent).unwrap();
        let (registry, scene, stop) = (&Registry::collect().unwrap(), Arc::new(scene), &AtomicBool::new(false));
        let (events, snapshots) = (Recorder::default(), Snapshots::default());
        let observer: Option<&dyn Observer> = Some(&snapshots);
        let (model, _) = train(&TrainJob { config, scene: scene.clone(), out: None, resume: false, registry, events: &events, stop, observer }).unwrap();
        assert_eq!(model.normalisation, scene.normalisation);
        Self { extent: f64::from(scene.extent()), start, after: snapshots.0.into_inner().unwrap(), events: events.events(), model }
    }
    /// The loss of every iteration, smoothed within its stage.
    pub fn losses(&self) -> Vec<f64> {
        self.events.iter().filter_map(|event| if let Event::Iteration { loss, .. } = event { Some(f64::from(*loss)) } else { None }).collect()
    }
    /// Gaussians cloned, split, relocated and removed by every round of density control.
    pub fn rounds(&self) -> Vec<[usize; 4]> {
        let round =
            |event: &Event| if let Event::Densified { cloned, split, moved, pruned, .. } = event { Some([*cloned, *split, *moved, *pruned]) } else { None };
        self.events.iter().filter_map(round).collect()
    }
    /// Adam's first step is as long as the learning rate: centres and velocities are to learn in proportion to the extent.
    pub fn check_rates(&self, what: &str) {
        let longest = |values: &[f64]| values.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
        let centres = longest(&steps(&self.start, &self.after[0].gaussians)[0].1);
        assert!(near(RATES[0] * self.extent, centres, 0.01), "{what}: centres step by {centres}, the extent is {}", self.extent);
        let first = &self.after[STAGES[0]];
        assert_eq!((first.standing.stage, first.standing.iteration), (Stage::Main, 1));
        if let Some(velocities) = first.gaussians.extra.get("velocity") {
            let velocities = longest(&velocities.values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>());
            assert!(near(RATES[1] * self.extent, velocities, 0.01), "{what}: velocities step by {velocities}, the extent is {}", self.extent);
        }
    }
    /// Asserts that `other`, of the same scene in other units or with a translation, is the same training.
    pub fn check_same(&self, other: &Self, what: &str) {
        let (losses, others) = (self.losses(), other.losses());
        assert_eq!((losses.len(), self.after.len(), others.len(), other.after.len()), (STAGES[0] + STAGES[1], losses.len(), losses.len(), losses.len()));
        for (k, (a, b)) in losses.iter().zip(&others).enumerate() {
            assert!(near(*a, *b, if k < ROUND { 1e-3 } else { 1e-2 }), "{what}: loss {b} in iteration {}, {a} unchanged", k + 1);
        }
        // Gaussian by Gaussian until the first round, whose thresholds single ones may pass by rounding; so may signs of the smallest derivatives change.
        for (k, (a, b)) in self.after.iter().zip(&other.after).take(ROUND - 1).enumerate() {
            for ((name, ways), (_, others)) in steps(&self.start, &a.gaussians).iter().zip(&steps(&other.start, &b.gaussians)) {
                let mut apart: Vec<f64> = ways.iter().zip(others).map(|(a, b)| (a - b).abs()).collect();
                apart.sort_by(f64::total_cmp);
                let (most, way) = (apart[apart.len() * 19 / 20], rms(ways));
                assert!(most <= 0.02 * way, "{what}: after iteration {} {name} differ by {most:.1e}, they moved by {way:.1e}", k + 1);
            }
        }
        // Then all Gaussians together.
        let (rounds, others) = (self.rounds(), other.rounds());
        assert!(rounds.len() == others.len() && rounds.iter().zip(&others).all(|(a, b)| alike(a, b, 0.02)), "{what}: {others:?}, {rounds:?} unchanged");
        for (a, b) in self.after.windows(2).zip(other.after.windows(2)) {
            let (at, counts) = (a[1].standing, [a, b].map(|pair| [0, 1].map(|k| pair[k].gaussians.len())));
            assert_eq!(at, b[1].standing);
            assert!(near(counts[0][1] as f64, counts[1][1] as f64, 0.02), "{what}: {at:?}, {counts:?}");
            if counts.iter().any(|[before, after]| before != after) {
                continue;
            }
            for ((name, ways), (_, others)) in steps(&a[0].gaussians, &a[1].gaussians).iter().zip(&steps(&b[0].gaussians, &b[1].gaussians)) {
                let (way, other) = (rms(ways), rms(others));
                assert!(near(way, other, 0.02), "{what}: {name} move by {other:.3e}, {way:.3e} unchanged, at {at:?}");
            }
        }
    }
}

/// Whether `b` is `a`, but for `share` of it.
pub fn near(a: f64, b: f64, share: f64) -> bool {
    (a - b).abs() <= share * a.abs()
}

/// Whether the numbers of a round agree to within `share` of the Gaussians.
pub fn alike(a: &[usize; 4], b: &[usize; 4], share: f64) -> bool {
    a.iter().zip(b).all(|(a, b)| a.abs_diff(*b) as f64 <= share * COUNT as f64)
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

/// How far each attribute of each Gaussian moved. Rotations are left out: derivatives of round Gaussians by them are rounding errors alone.
fn steps<'a>(from: &'a HostGaussians, to: &'a HostGaussians) -> Vec<(&'a str, Vec<f64>)> {
    fn attributes(g: &HostGaussians) -> Vec<(&str, &Vec<f32>)> {
        let mut all = vec![("means", &g.means), ("log_scales", &g.log_scales), ("opacity_logits", &g.opacity_logits), ("sh_dc", &g.sh_dc)];
        all.extend(g.extra.iter().map(|(name, extra)| (name.as_str(), &extra.values)));
        all
    }
    let difference = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*b) - f64::from(*a)).collect();
    attributes(from).into_iter().zip(attributes(to)).map(|((name, a), (_, b))| (name, difference(a, b))).collect()
}
