//! Short trainings with something switched off.

use super::super::Spread;
use super::{EARLY_OUTS, LeftOut, REUSE, SHARES_VERTICES, Switch, available, digest};
use crate::commands::Context;
use crate::interrupt;
use burn::tensor::Device;
use cc4dgs_core::{Error, Event, EventSink, HostGaussians, Result, Scene, Silent, Split, Stage, config, split_kind};
use cc4dgs_train::config::{Dynamic, RunConfig, TrainConfig};
use cc4dgs_train::eval::{Scored, evaluate};
use cc4dgs_train::train::{Observer, Snapshot, Standing, TrainJob, train};
use serde::Serialize;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// At most so many views are scored.
const SCORED: usize = 10;

/// All heads of deformers that have a choice, and the largest degree of spherical harmonics.
const HEADS: [&str; 5] = ["means", "log_scales", "quaternions", "opacity", "sh"];
const MOST_SH_DEGREE: usize = 3;

/// Trainings with something switched off.
#[derive(Serialize)]
pub struct StepRow {
    pub off: &'static str,
    /// What was set over the configuration of the model.
    pub set: Vec<String>,
    /// Iterations of the coarse and the main stage over the views drawn, of each round.
    pub ms_per_view: Spread,
    pub ratio: f64,
    /// Whether the Gaussians at the end are the same bits as with nothing switched off. Switches that change no pixel may still change which Gaussians count as
    /// visible, and so what sparse Adam and density control do.
    pub same_bits: bool,
    /// Of some views of the split, after so few iterations.
    pub psnr_db: f64,
}

/// A training to time.
pub struct Case {
    off: &'static str,
    set: Vec<String>,
    /// The configuration of the model with `set` over it.
    config: RunConfig,
}

pub struct StepBench<'a> {
    pub context: &'a Context<'a>,
    /// Where the configuration comes from.
    pub model: &'a Path,
    /// The configuration that the model was trained with.
    pub stated: toml::Table,
    pub scene: Arc<Scene>,
    pub device: &'a Device,
    pub device_name: &'a str,
    pub iterations: usize,
    pub rounds: usize,
    /// Views that trainings are scored on.
    pub split: Split,
    pub events: &'a dyn EventSink,
}

impl StepBench<'_> {
    /// What to train. `fixed` says why the rasterizer's early outs cannot be switched off.
    ///
    /// # Errors
    /// [`Error::Parameter`] where the model has no configuration, or one that this version cannot read.
    pub fn cases(&self, fixed: Option<&str>, left_out: &mut Vec<LeftOut>) -> Result<Vec<Case>> {
        if self.stated.is_empty() {
            let problem = format!("{} has no configuration of a training", self.model.display());
            return Err(Error::parameter("--iterations", problem, "Give the folder of a run, or an archive that was made of one; or leave --iterations out"));
        }
        let switches = self.switches(&self.config(&[])?, fixed)?;
        let mut cases = vec![Case { off: "nothing", set: Vec::new(), config: self.config(&[])? }];
        let mut all = Vec::new();
        for Switch { name: off, off: set, .. } in available("trainings", switches, left_out) {
            all.extend(set.clone());
            cases.push(Case { off, config: self.config(&set)?, set });
        }
        cases.push(Case { off: "all", config: self.config(&all)?, set: all });
        Ok(cases)
    }
    /// The configuration of the model with `sets` over it, for this device and so many iterations.
    fn config(&self, sets: &[String]) -> Result<RunConfig> {
        let mut table = self.stated.clone();
        let device = format!("device={}", self.device_name);
        let common = [format!("train.iterations={}", self.iterations), "train.checks=false".into(), "train.validation=0".into(), device];
        config::set_all(&mut table, &[&common, sets].concat())?;
        config::parse_section("configuration of the model", &table)
    }
    fn switches(&self, base: &RunConfig, fixed: Option<&str>) -> Result<Vec<Switch<Vec<String>>>> {
        let (deformer, _) = split_kind("deformer", &base.deformer)?;
        let shares = self.context.registry.deformer(&deformer)?.info.capabilities.contains(&SHARES_VERTICES);
        let TrainConfig { batch, sparse_adam, sh_every, image_growth, sh_degree, dynamic, .. } = base.train;
        let unless = |used: bool| (!used).then(|| "the configuration does not use it".to_string());
        let switch = |name, missing, set: &[String]| Switch { name, off: set.to_vec(), missing };
        let views = views_of_iterations(batch, &self.scene);
        let single = ["train.batch=1".to_string(), "train.coarse_batch=0".into(), format!("train.iterations={}", self.iterations * views)];
        let list = |key: &str| base.deformer.get(key).and_then(toml::Value::as_array);
        let few_heads = list("heads").is_some_and(|heads| heads.len() < HEADS.len());
        let coarse_voxels = list("resolutions").filter(|_| shares);
        let finer = coarse_voxels.map_or_else(String::new, |voxels| {
            let next = voxels.last().and_then(toml::Value::as_integer).map_or(8, |finest| 2 * finest);
            format!("deformer.resolutions={}", toml::Value::Array([voxels.as_slice(), &[next.into()]].concat()))
        });
        let gates = matches!(dynamic, Dynamic::Auto | Dynamic::Score);
        Ok(vec![
            switch("static gating", unless(gates), &["train.dynamic=all".into()]),
            switch("vertex reuse", (!shares).then(|| format!("the deformer {deformer} decodes no vertices")), &[format!("deformer.{REUSE}=false")]),
            switch("opacity early out", fixed.map(Into::into), &[format!("rasterizer.{}=false", EARLY_OUTS[0])]),
            switch("transmittance early out", fixed.map(Into::into), &[format!("rasterizer.{}=false", EARLY_OUTS[1])]),
            switch("sparse Adam", unless(sparse_adam), &["train.sparse_adam=false".into()]),
            switch("higher SH degrees less often", unless(sh_every > 1), &["train.sh_every=1".into()]),
            switch("several views per spatial pass", unless(views > 1), &single),
            switch("lower resolution early", unless(image_growth > 0.0), &["train.image_growth=0.0".into()]),
            switch("leaving out heads", unless(few_heads), &[format!("deformer.heads={HEADS:?}")]),
            switch("leaving out finer voxels", unless(coarse_voxels.is_some()), &[finer]),
            switch("leaving out higher SH degrees", unless(sh_degree < MOST_SH_DEGREE), &[format!("train.sh_degree={MOST_SH_DEGREE}")]),
            switch("SH degrees one after another", unless(sh_degree > 0), &["train.sh_interval=1".into()]),
        ])
    }
    /// Trains all cases, round by round.
    pub fn run(&self, cases: Vec<Case>) -> Result<Vec<StepRow>> {
        let stop = interrupt::stop_flag()?;
        let mut times = vec![Vec::with_capacity(self.rounds); cases.len()];
        let mut ends = Vec::with_capacity(cases.len());
        for round in 0..self.rounds {
            for (index, case) in cases.iter().enumerate() {
                let clock = Clock::default();
                let (trained, _) = train(&TrainJob {
                    config: &case.config,
                    scene: self.scene.clone(),
                    out: None,
                    resume: false,
                    registry: &self.context.registry,
                    events: &Silent,
                    observer: Some(&clock),
                    stop,
                })?;
                times[index].push(clock.ms_per_view());
                if round == 0 {
                    let scored = Scored { max_views: SCORED, ..Scored::all(self.split) };
                    let scores = evaluate(&trained, &self.scene, scored, &self.context.registry, self.device, &Silent, &mut |_, _, _, _| Ok(()))?;
                    ends.push((bits(&trained.gaussians), scores.psnr_db));
                }
                let (done, total) = ((round * cases.len() + index + 1) as u64, (self.rounds * cases.len()) as u64);
                self.events.emit(&Event::Progress { task: "bench trainings".into(), done, total });
            }
        }
        let spreads: Vec<Spread> = times.into_iter().map(Spread::of).collect();
        let (usual_ms, usual_bits) = (spreads[0].median_ms.max(1e-9), ends[0].0);
        let row = |((case, ms_per_view), (bits, psnr_db)): ((Case, Spread), (u64, f64))| StepRow {
            off: case.off,
            set: case.set,
            ms_per_view,
            ratio: ms_per_view.median_ms / usual_ms,
            same_bits: bits == usual_bits,
            psnr_db,
        };
        Ok(cases.into_iter().zip(spreads).zip(ends).map(row).collect())
    }
}

/// The views of an iteration of the main stage: there are no more than `scene` has for training.
fn views_of_iterations(batch: usize, scene: &Scene) -> usize {
    batch.min(scene.split(Split::Train).len())
}

fn bits(gaussians: &HostGaussians) -> u64 {
    let own = gaussians.columns().into_iter().flat_map(|(_, _, values)| values);
    digest(own.chain(gaussians.extra.values().flat_map(|attribute| &attribute.values)))
}

/// Times the iterations of the coarse and the main stage. The first of each is left out: it comes after what a stage begins with.
#[derive(Default)]
struct Clock(Mutex<ClockState>);

#[derive(Default)]
struct ClockState {
    last: Option<(Stage, Instant)>,
    seconds: f64,
    views: usize,
}

impl Clock {
    fn ms_per_view(&self) -> f64 {
        let state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        state.seconds * 1e3 / state.views.max(1) as f64
    }
    /// Notes an iteration of `stage` that drew so many `views` and ended `now`.
    fn note(&self, stage: Stage, views: usize, now: Instant) {
        let mut state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // The score stage fits scores, and its iterations cost less.
        if let Some((_, last)) = state.last.filter(|(before, _)| *before == stage && stage != Stage::Score) {
            state.seconds += now.duration_since(last).as_secs_f64();
            state.views += views;
        }
        state.last = Some((stage, now));
    }
}

impl Observer for Clock {
    fn after_iteration(&self, standing: &Standing, _: &AtomicBool) -> usize {
        self.note(standing.stage, standing.views, Instant::now());
        0
    }
    fn receive(&self, _: Snapshot) {}
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Camera, NoImages, View};
    use std::time::Duration;

    #[test]
    fn the_clock_counts_views_of_iterations_that_follow_one_of_their_stage() {
        let clock = Clock::default();
        let began = Instant::now();
        let iterations = [(Stage::Coarse, 1), (Stage::Coarse, 1), (Stage::Score, 4), (Stage::Score, 4), (Stage::Main, 4), (Stage::Main, 4), (Stage::Main, 4)];
        for (k, (stage, views)) in iterations.into_iter().enumerate() {
            clock.note(stage, views, began + Duration::from_millis(90 * k as u64));
        }
        // One interval of the coarse stage with a view, two of the main stage with four.
        assert!((clock.ms_per_view() - 3.0 * 90.0 / 9.0).abs() < 1e-6, "{}", clock.ms_per_view());
    }

    #[test]
    fn iterations_draw_no_more_views_than_the_scene_has() {
        let camera = Camera::look_at("a", (8, 8), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let view = |frame, split| View { camera: 0, frame, time_norm: 0.0, split };
        let views = vec![view(0, Split::Train), view(1, Split::Test), view(2, Split::Train), view(3, Split::Train)];
        let scene = Scene::new("s", vec![camera], views, Arc::new(NoImages), 0).unwrap();
        assert_eq!([1, 3, 64].map(|batch| views_of_iterations(batch, &scene)), [1, 3, 3]);
    }
}
