//! The preset `auto`: a plan made by looking at the scene, the machine and the time there is. Every choice is stated with its reason, written into `config.toml`, and
//! can be overridden.

mod calibrate;
mod choose;
mod facts;
mod memory;
mod overlap;
mod skips;

pub use choose::{Choice, Machine};
pub use facts::{Arrangement, Facts};
pub(crate) use memory::scene_options;
pub use overlap::Overlap;

use crate::config::{Dynamic, RunConfig};
use crate::data;
use crate::layers::Layers;
use crate::train_config::LEAST_ITERATIONS;
use calibrate::{Timing, calibrate};
use cc4dgs_core::{Error, Event, EventSink, Registry, Result, Scene, Split, auto_device, config, plural, resolved_device};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Name of the preset.
pub const PRESET: &str = "auto";
/// Minutes on processors and on a graphics card, where none are asked for.
const MINUTES: [f64; 2] = [10.0, 5.0];
/// Share of the time that is planned for; checkpoints and the verdict take the rest.
const PLANNED_SHARE: f64 = 0.95;
/// Largest share of the time for decoding images before the first iteration.
const DECODING_SHARE: f64 = 0.1;
/// Least share of the time for iterations, however long the plan and the first points take.
const LEAST_SHARE: f64 = 0.4;
/// Fewest and most iterations.
const ITERATIONS: [f64; 2] = [LEAST_ITERATIONS as f64, 200_000.0];
/// Iterations below which each has fewer views instead.
const ENOUGH: f64 = 500.0;
/// Share of moving pixels that is expected where no camera stands still.
const UNKNOWN_MOTION: f32 = 0.1;
/// What an iteration of the coarse and the score stage takes of one of the main stage where nothing moves: Gaussians are fewer, and colours simpler.
const EARLY: f64 = 0.6;
/// Views of an iteration take about twice as long as the pass through the field that they share, but are not more than these.
const FIELD_VIEWS: f64 = 0.5;
const MOST_VIEWS: f64 = 8.0;
/// Views of an iteration where one camera at a time sees everything move, if so many iterations fit: the gradients of one view at one time are noisy, and fewer
/// iterations of more views are 1 dB better after five minutes of mutant.
const STEADY_VIEWS: usize = 4;
const STEADY: f64 = 1500.0;
/// Share of the main stage over which learning rates fall at its end, and the iterations from which on that was better: shorter runs still learn too much.
const COOLDOWN: f64 = 0.1;
const COOLED: f64 = 2000.0;
/// Iterations below which a run is too short for its scene.
const SHORT: f64 = 2000.0;
/// Iterations of the score stage per unit of the score that a Gaussian can reach in them.
const ITERATIONS_PER_SCORE: f64 = 400.0;

/// The section `[auto]`: what was asked, and what came of it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AutoConfig {
    /// Wall time of the training in minutes on this machine; absent: ten on processors, five on a graphics card. Read by the preset `auto` only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub minutes: Option<f64>,
    /// The plan, a line per choice. Where it is stated, the settings are those of the file and none is chosen anew.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub plan: Vec<String>,
    /// What the plan leaves of its time, first points and iterations of a training together, in a process that has made it: `train` counts it from its own
    /// beginning, and settles `train.stretch`. Never in a file.
    #[serde(skip)]
    pub time_left: Option<Duration>,
}

impl AutoConfig {
    /// Refuses times that are not positive or longer than a month.
    pub(crate) fn validate(&self) -> Result<()> {
        match self.minutes {
            Some(minutes) if !(minutes > 0.0 && minutes <= 43_200.0) => {
                Err(Error::parameter("auto.minutes", format!("{minutes} minutes"), "Give a time above 0 and of at most 43,200 minutes"))
            }
            _ => Ok(()),
        }
    }
}

/// Choices as a table of settings, in order.
#[derive(Default)]
struct Plan {
    table: toml::Table,
    choices: Vec<Choice>,
}

impl Plan {
    fn add(&mut self, choice: Choice) -> Result<()> {
        for (key, value) in &choice.settings {
            config::set(&mut self.table, &format!("{key}={value}"))?;
        }
        self.choices.push(choice);
        Ok(())
    }
    /// A line per choice that `layers` do not override; another deformer has none of the settings of the planned one.
    fn lines(&self, layers: &Layers) -> Vec<String> {
        let overridden = |key: &str| layers.state(key) || (key.starts_with("deformer.") && layers.state("deformer.kind"));
        let line = |choice: &Choice| {
            let own: Vec<String> = choice.settings.iter().filter(|(key, _)| !overridden(key)).map(|(key, value)| format!("{key} = {value}")).collect();
            (!own.is_empty()).then(|| format!("{} ({})", own.join(", "), choice.reason))
        };
        self.choices.iter().filter_map(line).collect()
    }
}

/// Opens the scene at `path` and settles the configuration of `layers`. Where they ask for the preset `auto` and hold no plan yet, the plan is made here.
///
/// # Errors
/// [`Error::Interrupted`] where `stop` is set while a plan is made, and what configuration, reader and images report.
pub fn open(path: &Path, layers: &Layers, registry: &Registry, events: &dyn EventSink, stop: &AtomicBool) -> Result<(RunConfig, Arc<Scene>)> {
    open_shared(path, layers, registry, events, stop, 1)
}

/// As [`open`], where `processes` processes, this one included, share the memory of the machine. Each of several keeps images decoded in a third of an equal
/// part at most, whatever the configuration states.
///
/// # Errors
/// As [`open`].
pub fn open_shared(
    path: &Path,
    layers: &Layers,
    registry: &Registry,
    events: &dyn EventSink,
    stop: &AtomicBool,
    processes: usize,
) -> Result<(RunConfig, Arc<Scene>)> {
    let asked = layers.config()?;
    let read = |config: &RunConfig| Ok::<_, Error>(Arc::new(data::open(path, &scene_options(config, processes), registry, &config.limits)?));
    if !layers.want_plan() {
        return Ok((asked.clone(), read(&asked)?));
    }
    let began = Instant::now();
    let step = |done| {
        events.emit(&Event::Progress { task: "look at the scene".into(), done, total: 3 });
        proceed(stop)
    };
    step(0)?;
    let mut plan = Plan::default();
    let device = resolved_device(if layers.state("device") { &asked.device } else { "auto" }).to_string();
    plan.add(Choice { settings: vec![("device", device.clone().into())], reason: auto_device().1 })?;
    let graphics = !matches!(device.as_str(), "flex" | "ndarray");
    let machine = Machine { threads: rayon::current_num_threads(), graphics, memory: memory::memory(processes) };
    let minutes = asked.auto.minutes.unwrap_or(MINUTES[usize::from(machine.graphics)]);
    // Views that training keeps out are not looked at.
    let seen = |scene: &Scene| data::hold_out(scene, asked.train.validation);
    let mut scene = read(&asked)?;
    if let Some(choice) = choose::image_size(&native_sizes(&seen(&scene)?), &asked.scene, machine, minutes) {
        plan.add(choice)?;
        scene = read(&layers.over(&plan.table).config()?)?;
    }
    step(1)?;
    let facts = Facts::of(&seen(&scene)?)?;
    if let Some(message) = facts.overlap.as_ref().and_then(Overlap::warning) {
        events.emit(&Event::Warning { object: scene.name.clone(), message });
    }
    step(2)?;
    let full_size = if graphics { Some(layers.at_full_size(registry, choose::dataset_like(&facts))?) } else { None };
    let depths = memory::depths(facts.views, &full_size.as_ref().unwrap_or(layers).config()?.loss, registry)?;
    let cache = memory::cache(scene.views.len(), depths, facts.pixels(), asked.scene.cache_mb, machine.memory);
    if let Some(choice) = cache.filter(|_| !layers.state("scene.cache_mb")) {
        plan.add(choice)?;
        scene = read(&layers.over(&plan.table).config()?)?;
    }
    let layers = full_size.as_ref().unwrap_or(layers);
    let kind = asked.deformer.get("kind").and_then(|k| k.as_str());
    let most = asked.density.get("max_gaussians").and_then(|most| most.as_integer()).filter(|most| *most > 0).map(|most| most as f64);
    let stated = choose::Stated {
        deformer: kind.filter(|_| layers.state("deformer.kind")),
        gaussians: most.filter(|_| layers.state("density.max_gaussians")),
        first: layers.state("init.count").then_some(asked.init.count as f64),
    };
    for choice in choose::choose(&facts, machine, minutes, stated) {
        plan.add(for_density_of(layers, &asked, choice, registry)?)?;
    }
    let mut ends = None;
    if !layers.state("train.iterations") {
        let patience = Duration::from_secs_f64(DECODING_SHARE * 60.0 * minutes);
        let timing = calibrate(&layers.over(&plan.table).config()?.settled_for(&scene)?, &Arc::new(seen(&scene)?), registry, patience, stop)?;
        let config = layers.over(&plan.table).config()?;
        let spent = began.elapsed().as_secs_f64() / 60.0;
        let left = (PLANNED_SHARE * minutes - spent - timing.start / 60_000.0).max(LEAST_SHARE * minutes);
        ends = (!layers.state("train.stretch")).then(|| Instant::now() + Duration::from_secs_f64(60.0 * left + timing.start / 1000.0));
        for choice in lengths(&facts, &config, timing, minutes, left, layers.state("train.batch").then_some(config.train.batch)) {
            plan.add(choice)?;
        }
    } else {
        let reason = "the iterations are stated, so none were timed: one view each";
        plan.add(Choice { settings: vec![("train.batch", 1.into())], reason: reason.into() })?;
    }
    step(3)?;
    let config = layers.over(&plan.table).config()?;
    if config.train.shares[1] > 0.0 {
        let score = config.train.iterations as f64 * config.train.shares[1] / config.train.shares.iter().sum::<f64>();
        let zeta = (score / ITERATIONS_PER_SCORE).clamp(1.0, 7.0);
        let reason = format!("what a score can reach in {score:.0} iterations of its stage");
        plan.add(Choice { settings: vec![("train.zeta", toml::Value::Float((100.0 * zeta).round() / 100.0))], reason })?;
    }
    let mut config = layers.over(&plan.table).config()?;
    // A stated `auto` becomes the device that it stands for here.
    config.device = device;
    let [width, height] = facts.size;
    let [images, frames] = [plural(facts.views, "image", "images"), plural(facts.frames, "frame", "frames")];
    let seen = format!("{}: {} training {images} of {width}x{height} pixels, {} {frames}", facts.arrangement.describe(), facts.views, facts.frames);
    let noun = if matches!(facts.arrangement, Arrangement::OneMovingCamera | Arrangement::OneCameraAnywhere) { "positions" } else { "cameras" };
    let overlap = facts.overlap.iter().map(|overlap| overlap.describe(noun)).collect();
    let skips = skips::describe(&config, registry)?.into_iter().collect();
    config.auto.plan = [vec![seen], overlap, plan.lines(layers), skips].concat();
    config.auto.plan.extend(few(config.train.iterations, layers.state("train.iterations")));
    config.auto.time_left = ends.map(|ends| ends.saturating_duration_since(Instant::now()));
    Ok((config, scene))
}

/// The line of a plan whose `iterations` are too few for its scene. Where they are `stated`, no time changes them.
fn few(iterations: usize, stated: bool) -> Option<String> {
    let are = plural(iterations, "iteration is", "iterations are");
    let more = if stated { "more of them (train.iterations) give" } else { "more minutes or smaller images (--minutes, scene.width) give" };
    ((iterations as f64) < SHORT).then(|| format!("{iterations} {are} few: {more} a better model"))
}

/// An [`Error::Interrupted`] once `stop` is set.
fn proceed(stop: &AtomicBool) -> Result<()> {
    if stop.load(Ordering::Relaxed) { Err(Error::Interrupted("in planning; nothing was written".into())) } else { Ok(()) }
}

/// `choice` for the density control that `layers` state: its upper bound of Gaussians is the plan's too, where it has one.
fn for_density_of(layers: &Layers, asked: &RunConfig, mut choice: Choice, registry: &Registry) -> Result<Choice> {
    if !layers.state("density.kind") {
        return Ok(choice);
    }
    let kind = asked.density.get("kind").and_then(|k| k.as_str()).unwrap_or_default();
    let schema = config::parse_table("plug-in schema", registry.density(kind)?.info.schema)?;
    choice.settings.retain(|(key, _)| key.strip_prefix("density.").is_none_or(|key| key == "kind" || schema.contains_key(key)));
    choice.settings.iter_mut().filter(|(key, _)| *key == "density.kind").for_each(|(_, value)| *value = kind.into());
    Ok(choice)
}

/// How many views share a pass through the field, and the iterations for which the plan has `left` some of its `minutes`. `batch` is the number that the user stated;
/// of more than the scene has, training draws all.
fn lengths(facts: &Facts, config: &RunConfig, timing: Timing, minutes: f64, left: f64, batch: Option<usize>) -> Vec<Choice> {
    let total: f64 = config.train.shares.iter().sum::<f64>().max(1e-9);
    let main = config.train.shares[2] / total;
    let scored = config.train.dynamic != Dynamic::All;
    let moving = if scored { (2.0 * f64::from(facts.moving.unwrap_or(UNKNOWN_MOTION))).min(1.0) } else { 1.0 };
    let none = config.deformer.get("kind").and_then(|k| k.as_str()) == Some("none");
    let moving = if none { 0.0 } else { moving };
    let (field, view) = (moving * timing.shared, timing.still + moving * timing.per_time);
    let ms = |views: f64| (1.0 - main) * EARLY * timing.still + main * (field + views * view);
    let fit = |views: f64| left * 60_000.0 / ms(views);
    let shared = (field / (FIELD_VIEWS * view)).round().clamp(1.0, MOST_VIEWS);
    let noisy = facts.arrangement == Arrangement::OneCameraAnywhere && moving > 0.0;
    let steady = (1..=STEADY_VIEWS).rev().map(|views| views as f64).find(|&views| noisy && fit(views) >= STEADY).unwrap_or(1.0);
    let wanted = batch.map_or(shared.max(steady), |batch| batch as f64).min(facts.views.max(1) as f64);
    let mut views = wanted;
    while batch.is_none() && views > 1.0 && fit(views) < ENOUGH {
        views -= 1.0;
    }
    let count = fit(views).clamp(ITERATIONS[0], ITERATIONS[1]);
    let count = if count > 2000.0 { (count / 100.0).floor() * 100.0 } else { count.floor() };
    let rates = [("train.batch", toml::Value::Integer(views as i64)), ("train.coarse_batch", 1.into()), ("train.lr.batch_power", 0.5.into())];
    let note = match views {
        _ if views < wanted => format!("; with more views, fewer than {ENOUGH:.0} iterations fit into the time"),
        _ if batch.is_none() && views > shared => format!("; up to {STEADY_VIEWS} make steadier steps, as many as leave {STEADY:.0} iterations"),
        _ => String::new(),
    };
    let mut choices = vec![
        Choice { settings: rates.to_vec(), reason: format!("what views share of the deformer takes {field:.0} ms, a view {view:.0} ms{note}") },
        Choice {
            settings: vec![("train.iterations", toml::Value::Integer(count as i64))],
            reason: format!("{left:.1} of {minutes} {} at about {:.0} ms per iteration on this machine", plural(minutes, "minute", "minutes"), ms(views)),
        },
    ];
    if count >= COOLED {
        let reason = "a run of so many iterations is limited by the noise of its steps, too".into();
        choices.push(Choice { settings: vec![("train.lr.cooldown", COOLDOWN.into())], reason });
    }
    choices
}

/// Width and height in pixels of every training camera, sorted by the number of pixels.
fn native_sizes(scene: &Scene) -> Vec<[u32; 2]> {
    let cameras: BTreeSet<usize> = scene.split(Split::Train).into_iter().map(|view| scene.views[view].camera).collect();
    let mut sizes: Vec<[u32; 2]> = cameras.into_iter().map(|camera| [scene.cameras[camera].width, scene.cameras[camera].height]).collect();
    sizes.sort_unstable_by_key(|size| u64::from(size[0]) * u64::from(size[1]));
    sizes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_stated_is_not_in_the_plan() {
        let registry = Registry::collect().unwrap();
        let layers = Layers::collect(&registry, Some(PRESET), None, &["train.batch=3".into()]).unwrap();
        let mut plan = Plan::default();
        plan.add(Choice { settings: vec![("train.batch", 1.into()), ("train.zeta", 2.5.into())], reason: "because".into() }).unwrap();
        assert_eq!(plan.lines(&layers), ["train.zeta = 2.5 (because)"]);
        let config = layers.over(&plan.table).config().unwrap();
        assert_eq!((config.train.batch, config.train.zeta), (3, 2.5));
    }

    /// Views per iteration and iterations where `left` minutes are left, with the times that `cdf` took on the capture `turntable`.
    fn planned(left: f64, batch: Option<usize>) -> (i64, i64) {
        planned_for(Arrangement::OneCameraAnywhere, 100, 193.0, left, batch)
    }

    /// As [`planned`], of so many training `views` that share `shared` ms.
    fn planned_for(arrangement: Arrangement, views: usize, shared: f64, left: f64, batch: Option<usize>) -> (i64, i64) {
        let registry = Registry::collect().unwrap();
        let mut config = Layers::collect(&registry, Some(PRESET), None, &[]).unwrap().config().unwrap();
        (config.train.shares, config.train.dynamic) = ([2.0, 0.0, 18.0], Dynamic::All);
        let facts = Facts {
            arrangement,
            views,
            cameras: 64,
            frames: 120,
            size: [192, 192],
            points: 0,
            transparent: 0.0,
            plain: None,
            mean: None,
            detail: 0.11,
            moving: None,
            occupied: None,
            noise: None,
            exposure: None,
            overlap: None,
        };
        let timing = Timing { still: 4.0, shared, per_time: 59.0, start: 0.0 };
        let choices = lengths(&facts, &config, timing, 3.0, left, batch);
        let value = |key: &str| choices.iter().flat_map(|c| &c.settings).find(|(k, _)| *k == key).and_then(|(_, value)| value.as_integer()).unwrap();
        (value("train.batch"), value("train.iterations"))
    }

    #[test]
    fn an_iteration_has_fewer_views_where_too_few_iterations_fit() {
        assert_eq!(planned(12.0, None), (6, 1400), "what fits is left as it is");
        assert_eq!((planned(2.4, None), planned(1.45, None)), ((2, 501), (1, 377)));
        assert_eq!(planned(0.5, None), (1, LEAST_ITERATIONS as i64));
        assert_eq!(planned(2.4, Some(6)), (6, 280), "stated views are left as they are");
    }

    #[test]
    fn an_iteration_is_planned_with_no_more_views_than_there_are() {
        let of = |views, batch| planned_for(Arrangement::OneCameraAnywhere, views, 193.0, 12.0, batch);
        assert_eq!(of(3, Some(64)), of(100, Some(3)), "training draws three");
        assert_eq!(of(3, None), of(100, Some(3)));
        assert_eq!((of(1, None).0, of(1, Some(4)).0), (1, 1));
    }

    #[test]
    fn iterations_have_several_views_where_one_camera_at_a_time_sees_everything_move() {
        let views = |arrangement, left| planned_for(arrangement, 100, 10.0, left, None).0;
        let found = [2.0, 3.2, 4.5, 6.0, 9.0].map(|left| views(Arrangement::OneCameraAnywhere, left));
        assert_eq!(found, [1, 2, 3, 4, 4], "as many as leave 1,500 iterations");
        assert_eq!(views(Arrangement::OneMovingCamera, 9.0), 1);
    }

    #[test]
    fn few_iterations_have_a_remedy_that_helps() {
        assert!(few(600, false).is_some_and(|line| line.starts_with("600 iterations are few") && line.contains("--minutes")));
        assert!(few(600, true).is_some_and(|line| line.contains("train.iterations") && !line.contains("--minutes")));
        assert_eq!((few(2000, false), few(2000, true)), (None, None));
    }

    #[test]
    fn times_are_checked() {
        let with = |minutes| AutoConfig { minutes: Some(minutes), ..Default::default() }.validate();
        assert!(with(3.0).is_ok() && with(0.0).is_err() && with(f64::NAN).is_err() && with(1e9).is_err());
    }
}
