//! What a training does with values that are not finite, with loss terms that produce them on purpose.

use burn::tensor::{Device, Tensor};
use cc4dgs::{Error, Event, RunConfig, Session};
use cc4dgs_core::{
    DensityControl, DensityPlan, DensityPlugin, Gaussians, LossInput, LossPlugin, LossTerm, Plugin, Result, Schedule, Seed, Silent, Stage, Statistic,
    ViewStatistics, config, inventory, toml,
};
use cc4dgs_train::train::{TrainJob, train};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

/// Adds NaN to the loss: `when = "once"` in one call at iteration 130 of the main stage, `"always"` from there on, `"opaque"` where an opacity logit is over
/// 30, `"never"` nowhere. The default is the mean of the planes, which conforms, because the conformance suite runs for every registered term.
#[derive(Default, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Poison {
    when: String,
    /// Calls of the term in the iteration in which it breaks once.
    #[serde(skip)]
    calls: AtomicUsize,
}

impl LossTerm for Poison {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let late = input.schedule.stage == Stage::Main && input.schedule.iteration >= 130;
        let breaks = match self.when.as_str() {
            "" => return Ok(Some(input.planes.clone().mean())),
            // Two views of the same iteration, or the search for the term's name, may call it again.
            "once" => late && input.schedule.iteration == 130 && self.calls.fetch_add(1, Ordering::SeqCst) < 2,
            "always" => late,
            "opaque" => input.gaussians.opacity_logits.clone().inner().max().into_scalar::<f32>() > 30.0,
            _ => false,
        };
        Ok(breaks.then(|| input.planes.clone().sum().mul_scalar(f32::NAN)))
    }
}

fn build(settings: &toml::Table) -> Result<Box<dyn LossTerm>> {
    Ok(Box::new(config::parse_section::<Poison>("loss poison", settings)?))
}

inventory::submit! {
    LossPlugin {
        info: Plugin { name: "poison", version: "1", summary: "NaN on demand", paper: "a test", schema: "when = \"\"\n", capabilities: &[] },
        build,
        fuses: None,
    }
}

/// No density control, but in the last iteration of the main stage the first Gaussian is broken if `breaks` says so, and all get a large score if `moves_all`
/// does.
#[derive(Default, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
struct BreakOne {
    breaks: bool,
    moves_all: bool,
}

impl DensityControl for BreakOne {
    fn begin_stage(&mut self, _count: usize, _device: &Device) {}
    fn statistics(&self, _schedule: &Schedule) -> Vec<Statistic> {
        Vec::new()
    }
    fn observe(&mut self, _view: &ViewStatistics) -> Result<()> {
        Ok(())
    }
    fn plan(&mut self, _gaussians: &Gaussians, _schedule: &Schedule, _seed: Seed) -> Result<Option<DensityPlan>> {
        Ok(None)
    }
    fn after_step(&mut self, gaussians: &Gaussians, schedule: &Schedule, _seed: Seed) -> Result<Vec<(String, Tensor<2>)>> {
        let (mut changed, device) = (Vec::new(), gaussians.means.device());
        if schedule.stage != Stage::Main || schedule.iteration < schedule.length {
            return Ok(changed);
        }
        if self.breaks {
            let broken = Tensor::full([1, 3], f32::NAN, &device);
            changed.push(("means".into(), gaussians.means.clone().slice_assign([0..1, 0..3], broken)));
        }
        if self.moves_all {
            changed.push(("dynamic_scores".into(), Tensor::full([gaussians.len(), 1], 100.0, &device)));
        }
        Ok(changed)
    }
}

fn build_break_one(settings: &toml::Table) -> Result<Box<dyn DensityControl>> {
    Ok(Box::new(config::parse_section::<BreakOne>("density break-one", settings)?))
}

inventory::submit! {
    DensityPlugin {
        info: Plugin { name: "break-one", version: "1", summary: "NaN in one Gaussian", paper: "a test", schema: "breaks = false\nmoves_all = false\n", capabilities: &[] },
        build: build_break_one,
    }
}

struct Run {
    outcome: std::result::Result<cc4dgs::HostGaussians, Error>,
    warnings: Vec<String>,
}

/// A short training with the term; `sets` are further settings.
fn run(when: &str, sets: &[&str]) -> Run {
    let heard: Arc<Mutex<Vec<String>>> = Arc::default();
    let listener = heard.clone();
    let session = Session::builder().device("flex").on_event(move |event| {
        if let Event::Warning { object, message } = event
            && object == "watchdog"
        {
            listener.lock().unwrap().push(message.clone());
        }
    });
    let session = session.build().unwrap();
    let loss = format!("loss=[{{kind='l1', weight=0.8}}, {{kind='dssim', weight=0.2}}, {{kind='poison', weight=1.0, when='{when}'}}]");
    let sets: Vec<&str> = [loss.as_str(), "train.iterations=600", "train.checkpoint_every=0", "train.log_every=10"].iter().chain(sets).copied().collect();
    let config: RunConfig = session.config("demo", &sets).unwrap();
    let scene = session.read_scene("procedural:tiny", &config.scene).unwrap();
    let outcome = session.train(&config, scene, None).map(|model| model.gaussians.clone());
    let warnings = heard.lock().unwrap().clone();
    Run { outcome, warnings }
}

#[test]
fn a_loss_that_breaks_once_leaves_no_trace_in_the_result() {
    let (whole, broken) = (run("never", &[]), run("once", &[]));
    assert!(whole.warnings.is_empty(), "{:?}", whole.warnings);
    assert!(broken.warnings.iter().any(|w| w.contains("poison") && w.contains("back to iteration 100")), "{:?}", broken.warnings);
    assert!(broken.warnings.iter().all(|w| !w.contains("learns")), "nothing is to blame: {:?}", broken.warnings);
    assert!(whole.outcome.unwrap() == broken.outcome.unwrap(), "the repeated iterations gave other bytes");
}

#[test]
fn a_loss_that_stays_broken_ends_the_run_with_its_name() {
    let broken = run("always", &[]);
    let error = broken.outcome.unwrap_err();
    assert!(matches!(&error, Error::Backend { .. }) && error.to_string().contains("poison") && error.to_string().contains("lowered 5 times"), "{error}");
    assert_eq!(broken.warnings.iter().filter(|w| w.contains("learns")).count(), 5, "{:?}", broken.warnings);
    assert!(broken.warnings.iter().any(|w| w.contains("iteration 130")), "the first broken iteration is found: {:?}", broken.warnings);
}

#[test]
fn the_part_that_runs_away_is_slowed_down() {
    let saved = run("opaque", &["train.lr.opacity=3.0"]);
    assert!(saved.warnings.iter().any(|w| w.contains("gaussians/opacity_logits learns 0.25 times")), "{:?}", saved.warnings);
    let gaussians = saved.outcome.unwrap();
    assert!(!gaussians.is_empty() && gaussians.opacity_logits.iter().all(|o| o.is_finite()));
}

#[test]
fn a_run_that_is_rarely_logged_recovers_as_well() {
    let [often, rarely] = ["train.log_every=10", "train.log_every=1000"].map(|every| run("opaque", &["train.lr.opacity=3.0", every]));
    let lowered = |run: &Run| run.warnings.iter().filter(|w| w.contains("learns")).cloned().collect::<Vec<_>>();
    assert!(!lowered(&often).is_empty());
    assert_eq!(lowered(&often), lowered(&rarely));
    assert!(often.outcome.unwrap() == rarely.outcome.unwrap(), "other bytes where the loss is rarely logged");
}

#[test]
fn checkpoints_on_the_way_change_nothing_where_there_is_trouble() {
    let [rare, often] = ["train.checkpoint_every=0", "train.checkpoint_every=7"]
        .map(|every| run("opaque", &["train.lr.opacity=3.0", "density={kind='none'}", "train.iterations=280", every]));
    let lowered = |run: &Run| run.warnings.iter().filter(|w| w.contains("learns")).cloned().collect::<Vec<_>>();
    assert!(!lowered(&rare).is_empty());
    assert_eq!(lowered(&rare), lowered(&often));
    assert!(rare.outcome.unwrap() == often.outcome.unwrap(), "checkpoints on the way gave other bytes");
}

#[test]
fn a_single_broken_gaussian_is_removed_before_the_model_is_stored() {
    let counts = [false, true].map(|breaks| {
        let session = Session::builder().device("flex").build().unwrap();
        let density = format!("density={{kind='break-one', breaks={breaks}}}");
        let config = session.config("demo", &[density.as_str(), "train.iterations=200"]).unwrap();
        let scene = session.read_scene("procedural:tiny", &config.scene).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        let model = session.train(&config, scene, Some(&run)).unwrap();
        assert!(model.gaussians.means.iter().all(|v| v.is_finite()));
        assert_eq!(session.open(&run).unwrap().gaussians.len(), model.gaussians.len());
        model.gaussians.len()
    });
    assert_eq!(counts[1] + 1, counts[0]);
}

#[test]
fn scores_that_a_density_control_sets_count_at_once() {
    let session = Session::builder().device("flex").build().unwrap();
    let [kept, set] = [false, true].map(|moves_all| {
        let density = format!("density={{kind='break-one', moves_all={moves_all}}}");
        let config = session.config("demo", &[density.as_str(), "deformer={kind='none'}", "train.iterations=60"]).unwrap();
        let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene).unwrap());
        let (registry, stop) = (session.registry(), AtomicBool::new(false));
        let job = TrainJob { config: &config, scene, out: None, resume: false, registry, events: &Silent, stop: &stop, observer: None };
        let report = train(&job).unwrap().1;
        [report.dynamic_gaussians, report.gaussians]
    });
    assert!(kept[0] < kept[1], "{kept:?}");
    assert_eq!(set[0], set[1]);
}
