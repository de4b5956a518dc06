//! The three-stage trainer (paper Section V): coarse, dynamic score, main.

mod field_optimizer;
mod sampler;
mod score;
mod smoothness;
mod state;
mod step;

pub use field_optimizer::FieldOptimizer;
pub use state::{Moving, Rows, TrainState};

use crate::checkpoint;
use crate::config::RunConfig;
use crate::densify::{Rounds, densify, reset_opacity};
use crate::init::initialise;
use crate::masks::{DynamicMask, dynamic_masks};
use crate::schedule::{Schedule, Stage};
use burn::tensor::{Device, Tensor};
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::{Error, Event, EventSink, Rasterizer, Registry, Result, Scene, Seed, Split, parse_device};
use sampler::{Prefetcher, Sampler};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Name of the checkpoint inside a run's folder.
pub const CHECKPOINT: &str = "checkpoint";
/// Name of the configuration inside a run's folder.
pub const CONFIG: &str = "config.toml";

/// Fewest iterations an opacity reset leaves the survivors to come back; a shorter stage is not reset.
const LEAST_RECOVERY: usize = 500;
/// Fewest iterations between two weight prunings, so that every view had a chance to show a Gaussian.
const LEAST_WITNESS: usize = 100;

/// What to train, where to, and who listens.
pub struct TrainJob<'a> {
    /// The configuration.
    pub config: &'a RunConfig,
    /// The scene, already opened.
    pub scene: Arc<Scene>,
    /// The run's folder; created if missing.
    pub out: PathBuf,
    /// Continue from the folder's checkpoint.
    pub resume: bool,
    /// Where plug-ins are found.
    pub registry: &'a Registry,
    /// Where events go.
    pub events: &'a dyn EventSink,
    /// Set to stop after the current iteration, with a checkpoint.
    pub stop: &'a AtomicBool,
}

/// What came of it.
#[derive(Clone, Debug, Serialize)]
pub struct TrainReport {
    /// Wall seconds of this call, all stages.
    pub seconds: f64,
    /// Wall seconds per stage of this call.
    pub stage_seconds: BTreeMap<String, f64>,
    /// Gaussians at the end.
    pub gaussians: usize,
    /// Of which the field moves.
    pub dynamic_gaussians: usize,
    /// The checkpoint.
    pub checkpoint: PathBuf,
}

/// What stays fixed during a run.
pub(crate) struct Context<'a> {
    pub job: &'a TrainJob<'a>,
    pub schedule: Schedule,
    pub device: Device,
    pub rasterizer: Box<dyn Rasterizer>,
    pub seed: Seed,
    pub extent: f32,
    pub masks: Vec<DynamicMask>,
}

/// Trains, writing `config.toml` and `checkpoint` into the run's folder.
///
/// # Errors
/// [`Error::Interrupted`] after `stop` was set (a checkpoint is written first), [`Error::Backend`] when the loss is no longer a number,
/// and whatever the scene, the plug-ins or the disk report.
pub fn train(job: &TrainJob) -> Result<TrainReport> {
    let began = Instant::now();
    let config = &job.config.settled_for(&job.scene)?;
    let job = &TrainJob { config, scene: job.scene.clone(), out: job.out.clone(), ..*job };
    std::fs::create_dir_all(&job.out).map_err(|e| Error::io(&job.out, e))?;
    write_atomically(job.out.join(CONFIG), config.to_toml()?.as_bytes())?;
    let device = parse_device(&config.device)?;
    let seed = Seed::root(config.seed);
    job.events.emit(&Event::RunStarted { command: "train".into(), device: config.device.clone(), seed: config.seed });
    for message in &job.scene.warnings {
        job.events.emit(&Event::Warning { object: job.scene.name.clone(), message: message.clone() });
    }

    let moving = decide_moving(job);
    let masks = match moving {
        Moving::Scored { .. } => dynamic_masks(&job.scene, Split::Train, config.train.mask_threshold, config.background()?, job.events)?,
        _ => Vec::new(),
    };
    let path = job.out.join(CHECKPOINT);
    let mut state = if job.resume {
        checkpoint::load(&path, job.registry, &device, &config.limits)?.into_state(config)?
    } else {
        let host = initialise(&job.scene, config, seed.child("init"), job.events)?;
        TrainState::new(&host, moving, &device)
    };
    let context = Context {
        job,
        schedule: Schedule::new(&config.train, matches!(moving, Moving::Scored { .. })),
        rasterizer: job.registry.build_rasterizer(&config.rasterizer)?,
        extent: job.scene.extent(),
        device,
        seed,
        masks,
    };

    let mut stage_seconds = BTreeMap::new();
    for stage in Stage::ALL {
        if stage < state.stage {
            continue;
        }
        let stage_began = Instant::now();
        context.run_stage(stage, &mut state, &path)?;
        stage_seconds.insert(stage.name().to_string(), stage_began.elapsed().as_secs_f64());
        if stage != Stage::Main {
            state.stage = Stage::ALL[stage as usize + 1];
            state.iteration = 0;
        }
    }
    context.save(&state, &path)?;
    let dynamic = state.moving_rows(&context.device)?.count(state.set.len());
    Ok(TrainReport { seconds: began.elapsed().as_secs_f64(), stage_seconds, gaussians: state.set.len(), dynamic_gaussians: dynamic, checkpoint: path })
}

/// Whether everything, nothing, or what the dynamic scores say may move.
fn decide_moving(job: &TrainJob) -> Moving {
    let train = &job.config.train;
    let mut frames_of_camera: BTreeMap<usize, usize> = BTreeMap::new();
    for view in job.scene.split(Split::Train) {
        *frames_of_camera.entry(job.scene.views[view].camera).or_default() += 1;
    }
    let can_score = frames_of_camera.values().any(|&frames| frames >= 2);
    let static_scene = job.scene.frame_count <= 1;
    match train.dynamic.as_str() {
        _ if static_scene => Moving::Nothing,
        "none" => Moving::Nothing,
        "all" => Moving::Everything,
        _ if can_score => Moving::Scored { zeta: train.zeta },
        wanted => {
            if wanted == "score" {
                let message = "no training camera has two frames, so nothing can be scored: everything may move".to_string();
                job.events.emit(&Event::Warning { object: "train.dynamic".into(), message });
            }
            Moving::Everything
        }
    }
}

impl Context<'_> {
    fn run_stage(&self, stage: Stage, state: &mut TrainState, path: &Path) -> Result<()> {
        let length = self.schedule.length(stage);
        let events = self.job.events;
        if length == 0 || (stage == Stage::Score && self.masks.is_empty()) {
            if stage == Stage::Main {
                self.begin_main(state)?;
            }
            return Ok(());
        }
        if state.iteration == 0 {
            state.begin_stage();
            if stage == Stage::Main {
                self.begin_main(state)?;
            }
        }
        events.emit(&Event::StageStarted { stage: stage.name().into(), iterations: length, gaussians: state.set.len() });
        let began = Instant::now();
        let mut sampler = Sampler::new(self.stage_views(stage), self.seed.child(stage.name()).child("views"), self.job.config.train.batch);
        // Only a canonical space that is the first frame can be left step by step.
        if stage == Stage::Main && self.stage_views(Stage::Coarse).len() < self.stage_views(Stage::Main).len() {
            let ramp = (self.job.config.train.time_ramp * length as f64).round() as usize;
            sampler = sampler.with_ramp(ramp, |view| self.job.scene.views[view].time_norm);
        }
        let prefetcher = Prefetcher::new(self.job.scene.clone());
        let mut log = step::Log::new(stage, length, self.job.config.train.log_every);
        let resumed_at = state.iteration;
        while state.iteration < length {
            if self.job.stop.load(Ordering::Relaxed) {
                self.save(state, path)?;
                return Err(Error::Interrupted(format!(
                    "at iteration {} of stage {}; everything is in {}, --resume continues",
                    state.iteration,
                    stage.name(),
                    path.display()
                )));
            }
            let batch = sampler.batch(state.iteration);
            prefetcher.want(sampler.batch(state.iteration + 1));
            let iteration = state.iteration + 1;
            match stage {
                Stage::Score => self.score_step(state, iteration, &mut log)?,
                _ => self.photometric_step(stage, state, iteration, &batch, &mut log)?,
            }
            state.iteration = iteration;
            if stage != Stage::Score {
                self.refine(stage, state, iteration)?;
            }
            let every = self.job.config.train.checkpoint_every;
            if every > 0 && iteration.is_multiple_of(every) && iteration < length {
                self.save(state, path)?;
            }
        }
        log.finish(events);
        if stage == Stage::Main && state.iteration > resumed_at {
            self.simplify(state)?;
        }
        events.emit(&Event::StageFinished { stage: stage.name().into(), seconds: began.elapsed().as_secs_f64(), gaussians: state.set.len() });
        if stage == Stage::Score {
            let rows = state.moving_rows(&self.device)?.count(state.set.len()) as u64;
            let all = state.set.len() as u64;
            events.emit(&Event::Work { stage: "score".into(), counter: "gaussians that move".into(), done: rows, skipped: all - rows });
        }
        Ok(())
    }

    /// The training views a stage draws from.
    fn stage_views(&self, stage: Stage) -> Vec<usize> {
        let scene = &self.job.scene;
        let all = scene.split(Split::Train);
        if stage != Stage::Coarse || self.job.config.train.coarse_frames == "all" {
            return all;
        }
        let first = all.iter().map(|&v| scene.views[v].frame).min().unwrap_or(0);
        let of_first: Vec<usize> = all.iter().copied().filter(|&v| scene.views[v].frame == first).collect();
        // One picture says nothing of depth: a moving single camera needs all of them.
        if of_first.len() >= 2 { of_first } else { all }
    }

    /// Builds the field over the box of what moves, once the scores are known.
    fn begin_main(&self, state: &mut TrainState) -> Result<()> {
        let section = &self.job.config.deformer;
        let context = state.field_context(self.job.scene.frame_count, self.seed.child("field"))?;
        let field = self.job.registry.build_deformer(section, &context, &self.device)?;
        state.set.add_attributes(&field.attributes(), self.seed.child("attributes"));
        let moves = !field.is_static() && state.moving_rows(&self.device)?.count(state.set.len()) > 0;
        if !moves && !field.is_static() && state.moving != Moving::Nothing {
            let message = "no dynamic score is over train.zeta: the field is skipped".to_string();
            self.job.events.emit(&Event::Warning { object: "deformer".into(), message });
        }
        state.field = Some(FieldOptimizer::new(field, section.clone(), context));
        Ok(())
    }

    /// Leaves out what the trained field does not use. A run that is resumed when it is done has been here.
    fn simplify(&self, state: &mut TrainState) -> Result<()> {
        let rows = state.moving_rows(&self.device)?;
        if rows.count(state.set.len()) == 0 {
            return Ok(());
        }
        let Some(optimizer) = &mut state.field else { return Ok(()) };
        let own: Vec<Tensor<2>> = optimizer.field.attributes().iter().filter_map(|a| state.set.column(&a.name)).map(|c| rows.select(c.value.clone())).collect();
        let spatial = optimizer.field.spatial_with(rows.select(state.set.columns[0].value.clone()), &own)?;
        let frames = self.job.scene.frame_count.max(2);
        let times: Vec<f32> = (0..frames).map(|f| f as f32 / (frames - 1) as f32).collect();
        if let Some(simple) = optimizer.field.simplified(spatial.values, &times)? {
            let mut section = simple.settings;
            if let Some(kind) = optimizer.section.get("kind") {
                section.insert("kind".into(), kind.clone());
            }
            self.job.events.emit(&Event::Note { object: "deformer".into(), message: simple.message });
            *optimizer = FieldOptimizer::new(simple.field, section, optimizer.context.clone());
        }
        Ok(())
    }

    /// Densification, pruning and opacity resets due after `iteration`.
    fn refine(&self, stage: Stage, state: &mut TrainState, iteration: usize) -> Result<()> {
        let config = &self.job.config.train.densify;
        let at = |reference| self.schedule.at(stage, reference);
        let until = at(if stage == Stage::Coarse { config.until.min(5000) } else { config.until });
        let every = self.schedule.interval(config.every, 25);
        let left = self.schedule.length(stage) - iteration;
        if config.reset_every > 0 && stage == Stage::Coarse && iteration.is_multiple_of(at(config.reset_every).max(1)) && left >= LEAST_RECOVERY {
            reset_opacity(&mut state.set, 0.01);
        }
        let due = iteration > at(config.from) && iteration < until && iteration.is_multiple_of(every);
        let weight_every = at(config.weight_every).max(LEAST_WITNESS);
        let prune_weight = config.weight_every > 0 && iteration < until && iteration.is_multiple_of(weight_every);
        if !due && !prune_weight {
            return Ok(());
        }
        let rounds = Rounds { grow: due, prune_weight, extent: self.extent };
        let seed = self.seed.child(stage.name()).child("densify").index(iteration as u64);
        let round = densify(&mut state.set, &mut state.stats, config, rounds, seed)?;
        self.job.events.emit(&Event::Densified { iteration, cloned: round.cloned, split: round.split, pruned: round.pruned, gaussians: state.set.len() });
        state.invalidate_rows();
        Ok(())
    }

    /// Whether blending weights will be asked for at a coming weight pruning.
    fn wants_weights(&self, stage: Stage, iteration: usize) -> bool {
        let config = &self.job.config.train.densify;
        let until = self.schedule.at(stage, if stage == Stage::Coarse { config.until.min(5000) } else { config.until });
        let every = self.schedule.at(stage, config.weight_every).max(LEAST_WITNESS);
        config.weight_every > 0 && iteration.div_ceil(every) * every < until
    }

    fn save(&self, state: &TrainState, path: &Path) -> Result<()> {
        let bytes = checkpoint::save(path, state, self.job.config)?;
        self.job.events.emit(&Event::Saved { path: path.display().to_string(), bytes });
        Ok(())
    }
}
