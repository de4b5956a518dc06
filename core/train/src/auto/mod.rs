//! The preset `auto`: a plan made by looking at the scene, the machine and the time there is. Every choice is stated with its reason, written into
//! `config.toml`, and can be overridden.

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
        let before = began.elapsed().as_secs_f64() / 60.0 + timing.start / 60_000.0;
        let left = (PLANNED_SHARE * minutes - before).max(LEAST_SHARE * minutes);
        ends = (!layers.state("train.stretch")).then(|| Instant::now() + Duration::from_secs_f64(60.0 * left + timing.start / 1000.0));
        for choice in lengths(&facts, &config, timing, minutes, [before, left], layers.state("train.batch").then_some(config.train.batch)) {
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

/// How many views share a pass through the field, and the iterations for which the plan has `left` some of its `minutes`; what comes `before` them takes
/// others.
/// `batch` is the number that the user stated; of more than the scene has, training draws all. A stated `train.stretch` makes the main stage longer or shorter
/// than its share of the iterations.
fn lengths(facts: &Facts, config: &RunConfig, timing: Timing, minutes: f64, [before, left]: [f64; 2], batch: Option<usize>) -> Vec<Choice> {
    let total: f64 = config.train.shares.iter().sum::<f64>().max(1e-9);
    let main = config.train.shares[2] / total;
    let scored = config.train.dynamic != Dynamic::All;
    let moving = if scored { (2.0 * f64::from(facts.moving.unwrap_or(UNKNOWN_MOTION))).min(1.0) } else { 1.0 };
    let none = config.deformer.get("kind").and_then(|k| k.as_str()) == Some("none");
    let moving = if none { 0.0 } else { moving };
    let (field, view) = (moving * timing.shared, timing.still + moving * timing.per_time);
    let ms = |main: f64, views: f64| (1.0 - main) * EARLY * timing.still + main * (field + views * view);
    // Stages share the iterations that are planned; of the main one, `stretch` times as many are run.
    let stretch = config.train.stretch;
    let longer = 1.0 + main * (stretch - 1.0);
    let each = |views: f64| ms(stretch * main / longer, views);
    let fit = |views: f64| left * 60_000.0 / (longer * each(views));
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
    let needed = before + count * longer * each(views) / 60_000.0;
    let late = match needed > minutes {
        true => format!("; these and the {before:.1} minutes before them take about {needed:.1} minutes, not {minutes}"),
        false => String::new(),
    };
    let mut choices = vec![
        Choice { settings: rates.to_vec(), reason: format!("what views share of the deformer takes {field:.0} ms, a view {view:.0} ms{note}") },
        Choice {
            settings: vec![("train.iterations", toml::Value::Integer(count as i64))],
            reason: format!(
                "{left:.1} of {minutes} {} at about {:.0} ms per iteration on this machine{late}",
                plural(minutes, "minute", "minutes"),
                each(views)
            ),
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
mod tests;
