//! That no density control can take apart what is fitted: hostile controls in trainings, and those of the registry over long schedules.

use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs::{backends as _, codecs as _, deformers as _, parts as _};
use cc4dgs_core::{
    Camera, DensityControl, DensityPlan, DensityPlugin, Event, Gaussians, HostGaussians, Plugin, Recorder, Registry, Result, Schedule, Seed, Split, Stage,
    Statistic, View, ViewStatistics, config, inventory,
};
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::eval::{Scored, evaluate};
use cc4dgs_train::train::{TrainJob, train};
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::SeqCst};
use std::sync::{Arc, Mutex};

/// What the guard promises: iterations that a Gaussian is given, at least and as a divisor of the stage; views; share of a round.
const LEAST_AGE: usize = 50;
const AGE_SHARE: usize = 6;
const VIEWS: f32 = 16.0;
const MOST_REMOVED: f64 = 0.25;
/// A colour coefficient of something that is three times as bright as white.
const DAZZLING: f32 = 10.0;

/// What was carried out of the plans of a [`Hostile`].
#[derive(Default)]
struct Done {
    added: AtomicUsize,
    removed: AtomicUsize,
    /// Removed rows that were too young.
    young: AtomicUsize,
    /// Rounds that removed more than their share.
    excesses: AtomicUsize,
    resets: AtomicUsize,
    /// Whose statistics it received.
    seen: Mutex<Vec<(Camera, View)>>,
}

/// By what the control does, the latest training last.
static DONE: Mutex<Vec<(String, Arc<Done>)>> = Mutex::new(Vec::new());

/// Does harm after every iteration: `does = "remove"` keeps a single Gaussian, `"reset"` makes all nearly transparent, `"children"` adds copies and removes
/// those of the iteration before, `"dazzle"` makes all far too bright in the last tenth of the main stage, which no guard prevents. `"halve"` removes every
/// second one in the first iteration of the coarse stage and makes the others nearly transparent. The default does nothing, because other tests run every
/// registered control.
struct Hostile {
    does: String,
    done: Option<Arc<Done>>,
    schedule: Option<Schedule>,
    born: Vec<usize>,
    views: Vec<f32>,
}

#[derive(Default, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Settings {
    does: String,
}

impl DensityControl for Hostile {
    fn begin_stage(&mut self, count: usize, _: &Device) {
        (self.born, self.views) = (vec![0; count], vec![0.0; count]);
    }
    fn statistics(&self, _: &Schedule) -> Vec<Statistic> {
        Vec::new()
    }
    fn observe(&mut self, view: &ViewStatistics) -> Result<()> {
        let radii = view.radii.clone().float().into_data().to_vec::<f32>().unwrap();
        self.views.iter_mut().zip(radii).for_each(|(views, radius)| *views += f32::from(radius > 0.0));
        if let Some(done) = &self.done {
            done.seen.lock().unwrap().push((view.camera.clone(), view.view.clone()));
        }
        Ok(())
    }
    fn plan(&mut self, gaussians: &Gaussians, schedule: &Schedule, _: Seed) -> Result<Option<DensityPlan>> {
        self.schedule = Some(*schedule);
        let count = gaussians.len();
        let mut plan = DensityPlan::unchanged(count);
        match self.does.as_str() {
            "remove" => {
                plan = DensityPlan::new();
                plan.keep(0);
            }
            "halve" if schedule.stage == Stage::Coarse && schedule.iteration == 1 => {
                plan = DensityPlan::new();
                (0..count).step_by(2).for_each(|row| {
                    let kept = plan.keep(row);
                    plan.set(kept, "opacity_logits", &[-6.0]);
                });
                plan.restart("opacity_logits");
            }
            "reset" => {
                (0..count).for_each(|row| plan.set(row, "opacity_logits", &[-6.0]));
                plan.restart("opacity_logits");
            }
            "children" => {
                plan = DensityPlan::new();
                let old = (0..count).filter(|&row| self.born[row] == 0);
                old.for_each(|row| {
                    plan.keep(row);
                });
                (0..5).for_each(|row| {
                    plan.copy(row);
                });
            }
            _ => return Ok(None),
        }
        Ok(Some(plan))
    }
    fn after_step(&mut self, gaussians: &Gaussians, schedule: &Schedule, _: Seed) -> Result<Vec<(String, Tensor<2>)>> {
        let dazzles = self.does == "dazzle" && schedule.stage == Stage::Main && schedule.progress() > 0.9;
        Ok(if dazzles { vec![("sh_dc".into(), gaussians.sh_dc.clone().mul_scalar(0.0f32).add_scalar(DAZZLING))] } else { Vec::new() })
    }
    fn executed(&mut self, plan: &DensityPlan, _: &Device) -> Result<()> {
        let (Some(done), Some(schedule)) = (&self.done, &self.schedule) else { return Ok(()) };
        let removed = plan.removed(self.born.len());
        let most = (schedule.length / AGE_SHARE).max(LEAST_AGE);
        let patience = (2 * schedule.pass).clamp(LEAST_AGE, most);
        let young = |row: &&usize| {
            let age = schedule.iteration - self.born[**row];
            age < patience || (age < most && self.views[**row] < VIEWS)
        };
        done.young.fetch_add(removed.iter().filter(young).count(), SeqCst);
        done.removed.fetch_add(removed.len(), SeqCst);
        done.excesses.fetch_add(usize::from(removed.len() as f64 > (MOST_REMOVED * self.born.len() as f64).ceil()), SeqCst);
        done.added.fetch_add(plan.fresh().iter().filter(|&&fresh| fresh).count(), SeqCst);
        done.resets.fetch_add(usize::from(!plan.restarted().is_empty()), SeqCst);
        let rows = || plan.parents().iter().zip(plan.fresh());
        let born = rows().map(|(&parent, &fresh)| if fresh { schedule.iteration } else { self.born[parent] }).collect();
        let views = rows().map(|(&parent, &fresh)| if fresh { 0.0 } else { self.views[parent] }).collect();
        (self.born, self.views) = (born, views);
        Ok(())
    }
}

fn build(settings: &toml::Table) -> Result<Box<dyn DensityControl>> {
    let Settings { does } = config::parse_section("density hostile", settings)?;
    let done = DONE.lock().unwrap().iter().rev().find(|(name, _)| *name == does).map(|(_, done)| done.clone());
    Ok(Box::new(Hostile { does, done, schedule: None, born: Vec::new(), views: Vec::new() }))
}

inventory::submit! {
    DensityPlugin {
        info: Plugin { name: "hostile", version: "1", summary: "harm on demand", paper: "a test", schema: "does = \"\"\n", capabilities: &[] },
        build,
    }
}

/// How a training with a hostile control ended.
struct Run {
    done: Arc<Done>,
    begun: usize,
    ended: usize,
    /// Of training views.
    psnr_db: f64,
    notes: Vec<String>,
}

fn configured(does: &str, iterations: usize) -> RunConfig {
    let sets = [
        format!("density={{kind='hostile', does='{does}'}}"),
        format!("train.iterations={iterations}"),
        "device=flex".into(),
        "train.shares=[1.0, 0.0, 1.0]".into(),
        // The bounds below are of four views per step.
        "train.batch=4".into(),
        "train.coarse_batch=0".into(),
        "train.lr.batch_power=0".into(),
        "init.count=400".into(),
        "deformer.kind=none".into(),
    ];
    RunConfig::resolve(Some("demo"), None, &sets).unwrap()
}

fn run(does: &str, iterations: usize) -> Run {
    run_with(&configured(does, iterations), does, iterations)
}

/// A training with `config`, whose control does what `does` says.
fn run_with(config: &RunConfig, does: &str, iterations: usize) -> Run {
    let done = Arc::new(Done::default());
    DONE.lock().unwrap().push((does.into(), done.clone()));
    let registry = Registry::collect().unwrap();
    let scene = Arc::new(cc4dgs_train::data::open(Path::new("procedural:tiny"), &config.scene, &registry, &config.limits).unwrap());
    let (events, stop) = (Recorder::default(), AtomicBool::new(false));
    let job = TrainJob { config, scene: scene.clone(), out: None, resume: false, registry: &registry, events: &events, stop: &stop, observer: None };
    let model = train(&job).unwrap().0;
    let scored = Scored { max_views: 6, ..Scored::all(Split::Train) };
    let psnr_db = evaluate(&model, &scene, scored, &registry, &Device::flex(), &cc4dgs_core::Silent, &mut |_, _, _, _| Ok(())).unwrap().psnr_db;
    let events = events.events();
    let begun = events.iter().find_map(|event| if let Event::StageStarted { gaussians, .. } = event { Some(*gaussians) } else { None });
    let notes = events.into_iter().filter_map(|event| match event {
        Event::Note { object, message } if object == "density control" => Some(message),
        _ => None,
    });
    let run = Run { done, begun: begun.unwrap(), ended: model.gaussians.len(), psnr_db, notes: notes.collect() };
    let Done { added, removed, young, excesses, resets, .. } = &*run.done;
    let counts = [added, removed, young, excesses, resets].map(|count| count.load(SeqCst));
    println!("'{does}', {iterations} iterations: {} Gaussians became {}, {psnr_db:.2} dB, counts {counts:?}, {} notes", run.begun, run.ended, run.notes.len());
    run
}

/// PSNR in dB that any hostile control leaves at this size: removing whatever may go gives 18.5 dB in 300 iterations. The mean colour of the images has 15.5
/// dB.
const FLOOR_DB: f64 = 17.3;

#[test]
fn hostile_controls_do_not_take_a_training_apart() {
    for iterations in [300, 1200] {
        let left_alone = run("nothing", iterations);
        for does in ["remove", "reset", "children"] {
            let run = run(does, iterations);
            let last_notes = &run.notes[run.notes.len().saturating_sub(3)..];
            // Constant removal cancels most of what training gains; the other controls cost little.
            let least_db = if does == "remove" { FLOOR_DB } else { left_alone.psnr_db - 1.5 };
            assert!(run.psnr_db >= least_db, "'{does}', {iterations} iterations: {:.2} dB, at least {least_db:.2} are expected; {last_notes:?}", run.psnr_db);
            let count = |of: fn(&Done) -> &AtomicUsize| of(&run.done).load(SeqCst);
            assert_eq!((count(|d| &d.young), count(|d| &d.excesses)), (0, 0), "'{does}', {iterations} iterations: removed too young, or too many in a round");
            match does {
                "remove" => assert!(count(|d| &d.removed) > 0 && run.ended >= run.begun / 20, "{} of {}", run.ended, run.begun),
                "reset" => assert!(run.ended == run.begun && (count(|d| &d.resets) > 0) == (iterations > 300), "short runs have no time for a reset"),
                _ => assert!(count(|d| &d.added) > 0 && count(|d| &d.removed) > 0 && run.ended >= run.begun),
            }
        }
    }
}

#[test]
fn plans_are_carried_out_as_they_are_without_the_guard() {
    for guard in [true, false] {
        let mut config = configured("halve", 30);
        config.train.guard = guard;
        let run = run_with(&config, "halve", 30);
        let [removed, resets] = [&run.done.removed, &run.done.resets].map(|count| count.load(SeqCst));
        let expected = if guard { (0, 0, run.begun) } else { (run.begun / 2, 1, run.begun - run.begun / 2) };
        assert_eq!((removed, resets, run.ended), expected, "guard = {guard}, {:?}", run.notes);
    }
}

#[test]
fn controls_know_the_camera_and_the_time_of_a_view() {
    let (registry, config) = (Registry::collect().unwrap(), configured("look", 30));
    let scene = cc4dgs_train::data::open(Path::new("procedural:tiny"), &config.scene, &registry, &config.limits).unwrap();
    let run = run("look", 30);
    let seen = run.done.seen.lock().unwrap();
    assert!(seen.iter().all(|(camera, view)| scene.views.contains(view) && scene.cameras[view.camera] == *camera), "{seen:?}");
    let (cameras, frames): (BTreeSet<usize>, BTreeSet<usize>) = seen.iter().map(|(_, view)| (view.camera, view.frame)).unzip();
    assert!(cameras.len() > 1 && frames.len() > 1, "{cameras:?}, {frames:?}");
}

#[test]
fn a_run_that_falls_apart_late_fails_and_keeps_its_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let (registry, config) = (Registry::collect().unwrap(), configured("dazzle", 300));
    let scene = Arc::new(cc4dgs_train::data::open(Path::new("procedural:tiny"), &config.scene, &registry, &config.limits).unwrap());
    let (events, stop) = (Recorder::default(), AtomicBool::new(false));
    let fails = |resume| {
        let (scene, out) = (scene.clone(), Some(folder.path().to_path_buf()));
        let job = TrainJob { config: &config, scene, out, resume, registry: &registry, events: &events, stop: &stop, observer: None };
        train(&job).err().unwrap()
    };
    let error = fails(false);
    let said = error.to_string();
    assert!(error.exit_code() == 6 && said.contains("training views fell from") && said.contains("of 150 of the main stage"), "{said}");
    assert!(folder.path().join("checkpoint").is_file() && said.contains("The checkpoint is kept"), "{said}");
    let verdict = |event: &Event| matches!(event, Event::Note { object, message } if object == "verdict" && message.starts_with("fell apart"));
    assert!(events.events().iter().any(verdict), "{:?}", events.events());
    assert_eq!(fails(true).to_string(), said, "resumed, it says the same");
}

/// Gaussians at the start of a driven schedule, and the bound of controls that have one.
const START: usize = 300;
const MOST: usize = 900;
/// Views of the statistics between two plans are one in so many iterations.
const VIEW_EVERY: usize = 10;

pub(super) fn uniform(seed: Seed, k: usize) -> f32 {
    (seed.index(k as u64).value() >> 40) as f32 / (1u64 << 24) as f32
}

pub(super) fn gaussians(count: usize, device: &Device) -> Gaussians {
    let mut host = HostGaussians { quaternions: [1.0, 0.0, 0.0, 0.0].repeat(count), dynamic_scores: vec![0.0; count], ..Default::default() };
    let draws = |width: usize, from: f32, to: f32| (0..width * count).map(|k| from + (to - from) * uniform(Seed::root(3), k)).collect();
    (host.means, host.log_scales, host.opacity_logits, host.sh_dc) = (draws(3, -1.0, 1.0), draws(3, -6.0, -3.0), draws(1, -2.0, 3.0), draws(3, -1.0, 1.0));
    Gaussians::from_host(&host, device)
}

/// Statistics of a view that draws nine of ten of `count` Gaussians, and asks for more of one in thirty.
fn view(count: usize, wanted: &[Statistic], seed: Seed, device: &Device) -> ViewStatistics {
    let radii: Vec<i64> = (0..count).map(|row| i64::from(uniform(seed, row) < 0.9) * 5).collect();
    let gradients: Vec<f32> = (0..2 * count).map(|k| if (k / 2).is_multiple_of(30) { 2e-5 } else { 1e-8 } * uniform(seed, count + k)).collect();
    let weights: Vec<f32> = (0..count).map(|row| uniform(seed, 3 * count + row)).collect();
    let gradient = |statistic| wanted.contains(&statistic).then(|| Tensor::<2>::from_data(TensorData::new(gradients.clone(), [count, 2]), device));
    statistics(radii, gradient, wanted.contains(&Statistic::MaxWeight).then_some(weights), device)
}

/// Statistics of a view of 640x360 pixels in which Gaussians have these radii, gradients and largest weights.
pub(super) fn statistics(radii: Vec<i64>, gradient: impl Fn(Statistic) -> Option<Tensor<2>>, weights: Option<Vec<f32>>, device: &Device) -> ViewStatistics {
    let count = radii.len();
    let camera = Camera::look_at("test", (640, 360), 1.0, [0.0, -4.0, 0.0], [0.0; 3], [0.0, 0.0, 1.0]);
    let view = View { camera: 0, frame: 0, time_norm: 0.0, split: Split::Train };
    let mut seen = ViewStatistics::new(camera, view, Tensor::<1, Int>::from_data(TensorData::new(radii, [count]), device));
    seen.screen_gradient = gradient(Statistic::ScreenGradient);
    seen.absolute_screen_gradient = gradient(Statistic::AbsoluteScreenGradient);
    seen.max_weights = weights.map(|weights| Tensor::from_data(TensorData::new(weights, [count]), device));
    seen
}

/// The number of Gaussians after each plan of a control over coarse and main stage. After every plan one in a hundred fades.
fn counts(control: &mut dyn DensityControl, iterations: usize, device: &Device) -> Result<Vec<usize>> {
    let mut set = gaussians(START, device);
    let mut counts = vec![START];
    for (stage, length) in [(Stage::Coarse, iterations * 5 / 28), (Stage::Main, iterations * 20 / 28)] {
        control.begin_stage(set.len(), device);
        for iteration in 1..=length {
            let schedule = Schedule { stage, iteration, total: iterations, pass: 20, ..Schedule::main(length) };
            let seed = Seed::root(5).child(stage.name()).index(iteration as u64);
            if iteration.is_multiple_of(VIEW_EVERY) {
                let wanted = control.statistics(&schedule);
                control.observe(&view(set.len(), &wanted, seed.child("view"), device))?;
            }
            let Some(plan) = control.plan(&set, &schedule, seed.child("plan"))? else { continue };
            plan.check("driven", &set)?;
            set = plan.apply(&set)?;
            control.executed(&plan, device)?;
            counts.push(set.len());
            let mut host = set.to_host()?;
            host.opacity_logits.iter_mut().enumerate().filter(|(row, _)| uniform(seed, *row) < 0.01).for_each(|(_, logit)| *logit = -8.0);
            set = Gaussians::from_host(&host, device);
        }
    }
    Ok(counts)
}

#[test]
fn every_control_keeps_the_number_of_gaussians_within_bounds() {
    let (registry, device) = (Registry::collect().unwrap(), Device::flex());
    let controls: Vec<&Plugin> = registry.plugins().into_iter().filter(|(kind, _)| *kind == "density").map(|(_, plugin)| plugin).collect();
    assert!(controls.len() >= 3);
    for plugin in controls {
        for iterations in [300, 30_000] {
            let mut section = toml::Table::new();
            section.insert("kind".into(), plugin.name.into());
            if plugin.schema.contains("max_gaussians") {
                section.insert("max_gaussians".into(), (MOST as i64).into());
            }
            let mut control = registry.build_density(&section).unwrap();
            let counts = counts(control.as_mut(), iterations, &device).unwrap();
            let (least, most) = (counts.iter().min().unwrap(), counts.iter().max().unwrap());
            println!("{}, {iterations} iterations: {} plans, {least} to {most} Gaussians", plugin.name, counts.len() - 1);
            assert!(2 * least >= START && *most <= MOST, "{}, {iterations} iterations: {least} to {most} Gaussians", plugin.name);
        }
    }
}
