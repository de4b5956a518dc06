//! The three-stage trainer (paper Section V): coarse, dynamic score, main. It is composed of parts that are found by name: deformer, rasterizer, density
//! control, loss terms, appearance model, pose model and optimizer.

mod capacity;
mod cost;
mod density;
mod dropout;
mod folder;
mod guard;
mod key_frames;
mod log;
mod losses;
mod moving;
mod observe;
mod pace;
mod parameters;
mod parents;
mod probe;
mod pyramid;
mod record;
mod recover;
mod refit;
mod residual;
mod rounded;
mod sampler;
mod score;
mod settle;
mod smoothness;
mod stage;
mod state;
mod step;
mod stored_weights;
mod strain;
mod targets;
mod tune;
mod validate;
mod watchdog;

pub(crate) use cost::share_per_view;
pub use folder::{CONFIG, check_unused};
pub use guard::Guard;
pub(crate) use losses::LossTerms;
pub use observe::{Observer, Snapshot, Standing};
pub(crate) use pace::growth;
pub use record::Record;
pub(crate) use record::Score;
pub use refit::{RefitJob, prune_and_refit};
pub(crate) use state::{APPEARANCE, POSES};
pub use state::{Parts, TrainState};
pub(crate) use strain::Neighbours;
pub use tune::{TuneJob, Tuner};
pub use watchdog::RateFactors;

use crate::checkpoint;
use crate::checks::{Verdict, Watch, examine};
use crate::config::RunConfig;
use crate::data::hold_out;
use crate::gaussian_set::GaussianSet;
use crate::init::initialise;
use crate::masks::{DynamicMask, dynamic_masks};
use crate::schedule::StageLengths;
use burn::tensor::{Device, Tensor};
use cc4dgs_core::{AppearanceContext, Event, EventSink, PosesContext, Rasterizer, Registry, Result, Scene, Seed, Split, Stage, parse_device};
use cc4dgs_play::checkpoint::CHECKPOINT;
use cc4dgs_play::{Model, Moving};
use folder::FolderLock;
use moving::decide_moving;
use pyramid::Pyramid;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// What to train, where to, and who listens.
pub struct TrainJob<'a> {
    /// The configuration.
    pub config: &'a RunConfig,
    /// The scene, already opened.
    pub scene: Arc<Scene>,
    /// The run's folder, created if missing; `None` writes nothing.
    pub out: Option<PathBuf>,
    /// Continue from the checkpoint of the folder, which must be given.
    pub resume: bool,
    /// Where plug-ins are found.
    pub registry: &'a Registry,
    /// Where events go.
    pub events: &'a dyn EventSink,
    /// Set to stop after the current iteration, with a checkpoint.
    pub stop: &'a AtomicBool,
    /// Looks at the model now and then.
    pub observer: Option<&'a dyn Observer>,
}

/// What came of it.
#[derive(Clone, Debug, Serialize)]
pub struct TrainReport {
    /// Wall seconds of this call, all stages.
    pub seconds: f64,
    /// Wall seconds per stage of this call.
    pub stage_seconds: BTreeMap<String, f64>,
    /// Iterations of all stages.
    pub iterations: usize,
    /// Gaussians at the end.
    pub gaussians: usize,
    /// Of which the deformer moves.
    pub dynamic_gaussians: usize,
    /// The checkpoint, where a folder was given.
    pub checkpoint: Option<PathBuf>,
    /// How it went; absent for runs that are too short to be judged, and without `train.checks`.
    pub verdict: Option<Verdict>,
}

/// Where a run starts.
enum Start {
    /// At a checkpoint.
    Resumed(Box<TrainState>),
    /// At the beginning, with these plug-ins.
    New(Parts),
}

impl Start {
    /// Whether masks of what moves will be read: by the score stage, and by key frames when the main stage begins.
    fn needs_masks(&self) -> bool {
        match self {
            Self::Resumed(state) => state.stage < Stage::Main || state.iteration == 0,
            Self::New(_) => true,
        }
    }
}

/// What stays fixed during a run.
pub(crate) struct Context<'a> {
    pub job: &'a TrainJob<'a>,
    /// The configuration with what the run has settled: what is stored.
    pub settings: RunConfig,
    pub lengths: StageLengths,
    pub pyramid: Pyramid,
    pub device: Device,
    /// The colour behind everything `[3]`.
    pub background: Tensor<1>,
    pub rasterizer: Box<dyn Rasterizer>,
    pub losses: LossTerms,
    pub score_loss: LossTerms,
    pub seed: Seed,
    pub masks: Vec<DynamicMask>,
    /// Index among the training cameras, by index in the scene.
    pub training_camera: BTreeMap<usize, usize>,
    /// When the run is to end, where the length of its main stage follows from that and is not settled yet.
    pub ends: Option<Instant>,
    pub checkpoint: Option<PathBuf>,
}

/// Trains. With a folder, `config.toml` and `checkpoint` are written into it.
///
/// # Errors
/// [`Error::Parameter`] for settings out of range and for a folder that another training writes into, before anything is written, and for going on without a
/// folder, [`Error::Interrupted`] after `stop` was set (a checkpoint is written first), [`Error::Backend`] when loss or parameters do not stay finite even with
/// lower rates, [`Error::Data`] for a scene that cannot be reconstructed, [`Error::Failed`] for a model that is no better than simple baselines, or ends far
/// below its own earlier scores (the checkpoint is kept), and whatever the scene, the plug-ins or the disk report. A checkpoint is written before the error of
/// an image that cannot be read any more.
///
/// [`Error::Parameter`]: cc4dgs_core::Error::Parameter
/// [`Error::Interrupted`]: cc4dgs_core::Error::Interrupted
/// [`Error::Backend`]: cc4dgs_core::Error::Backend
/// [`Error::Data`]: cc4dgs_core::Error::Data
/// [`Error::Failed`]: cc4dgs_core::Error::Failed
pub fn train(job: &TrainJob) -> Result<(Model, TrainReport)> {
    // On a thread of the pool, so that each of the thousands of parallel operations of a step starts at once: 17 % faster on two threads, 25 % on one.
    rayon::scope(|_| train_here(job))
}

fn train_here(job: &TrainJob) -> Result<(Model, TrainReport)> {
    let began = Instant::now();
    job.config.validate()?;
    if job.resume && job.out.is_none() {
        let problem = "there is no folder, and so no checkpoint to go on from";
        return Err(cc4dgs_core::Error::parameter("resume", problem, "Give the folder of the run, or begin a new one"));
    }
    // Held until the end.
    let mut lock = job.out.as_deref().map_or(Ok(None), FolderLock::take)?;
    let config = &job.config.settled_for(&job.scene)?.completed(job.registry)?;
    let scene = hold_out(&job.scene, config.train.validation)?;
    let job = &TrainJob { config, scene: Arc::new(scene), out: job.out.clone(), ..*job };
    let device = parse_device(&config.device)?;
    let seed = Seed::root(config.seed);
    job.events.emit(&Event::RunStarted { command: "train".into(), device: config.device.clone(), seed: config.seed });
    for line in config.auto.plan.iter().filter(|_| !job.resume) {
        job.events.emit(&Event::Note { object: "plan".into(), message: line.clone() });
    }
    for message in &job.scene.warnings {
        job.events.emit(&Event::Warning { object: job.scene.name.clone(), message: message.clone() });
    }
    let moving = decide_moving(&config.train, &job.scene)?;
    let training_camera = training_cameras(&job.scene);
    let parts = Parts {
        appearance: job.registry.build_appearance(
            &config.appearance,
            &AppearanceContext { cameras: training_camera.len(), seed: seed.child("appearance") },
            &device,
        )?,
        poses: job.registry.build_poses(
            &config.poses,
            &PosesContext { cameras: training_camera.len(), extent: f64::from(job.scene.extent()), seed: seed.child("poses") },
            &device,
        )?,
        density: job.registry.build_density(&config.density)?,
        optimizer: job.registry.build_optimizer(&config.optimizer)?,
    };
    let checkpoint = job.out.as_ref().map(|out| out.join(CHECKPOINT));
    // A continuation that is refused is refused at once.
    let start = match &checkpoint {
        Some(path) if job.resume => Start::Resumed(Box::new(folder::resumed(job, path, &device, parts)?)),
        _ => Start::New(parts),
    };
    let doubts = if config.train.checks { examine(&job.scene, config.background()?, job.events)? } else { Vec::new() };
    let masks = match moving {
        Moving::Scored { .. } if start.needs_masks() => {
            let train = &config.train;
            dynamic_masks(&job.scene, Split::Train, train.mask_threshold, train.mask_sigma, config.background()?, job.events)?
        }
        _ => Vec::new(),
    };
    let rasterizer = job.registry.build_rasterizer(&config.rasterizer)?;
    let losses = LossTerms::build(job.registry, &config.loss)?;
    losses.check_depth(&job.scene)?;
    let score_loss = LossTerms::build_score(job.registry, &config.score_loss)?;
    score_loss.refuse_depth()?;
    let mut state = match start {
        Start::Resumed(state) => *state,
        Start::New(parts) => {
            let host = initialise(&job.scene, config, seed.child("init"), job.events)?;
            // What is refused until here leaves the run that was to be overwritten.
            if let Some(out) = job.out.as_deref().filter(|_| !job.resume) {
                folder::begin(out, config, &mut lock)?;
            }
            TrainState::new(GaussianSet::new(&host, &device), moving, job.scene.normalisation, state::longest_focal(&job.scene), parts)
        }
    };
    let left = config.auto.time_left.or_else(|| Duration::try_from_secs_f64(state.record.seconds_left?).ok());
    let mut context = Context {
        job,
        settings: config.clone(),
        pyramid: Pyramid::new(&job.scene, config)?,
        lengths: StageLengths::new(&config.train, matches!(moving, Moving::Scored { .. }), job.scene.extent()),
        rasterizer,
        losses,
        score_loss,
        background: Tensor::from_floats(config.background()?, &device),
        device,
        seed,
        masks,
        training_camera,
        ends: left.filter(|_| config.train.stretch == 1.0).and_then(|left| began.checked_add(left)),
        checkpoint,
    };

    for stage in Stage::ALL {
        let views = context.stage_views(stage);
        let cameras: std::collections::BTreeSet<usize> = views.iter().map(|&view| job.scene.views[view].camera).collect();
        context.lengths.set_pass(stage, cameras.len().div_ceil(config.train.views_per_iteration(stage)));
    }
    let mut watch = Watch::new(&context, doubts, &state)?;
    let mut stage_seconds = BTreeMap::new();
    for stage in Stage::ALL {
        if stage < state.stage {
            continue;
        }
        let stage_began = Instant::now();
        // Where no camera stands still; the score stage leaves the geometry alone, so a resumed run finds the same masks.
        if stage == Stage::Score && matches!(moving, Moving::Scored { .. }) && context.masks.is_empty() && context.lengths.length(stage) > 0 {
            let masks = context.residual_masks(&mut state);
            context.masks = context.saved_before_error(masks, &mut state)?;
        }
        context.run_stage(stage, &mut state, &mut watch)?;
        stage_seconds.insert(stage.name().to_string(), stage_began.elapsed().as_secs_f64());
        if stage != Stage::Main {
            state.stage = Stage::ALL[stage as usize + 1];
            state.iteration = 0;
        }
    }
    context.ends = None;
    context.save(&mut state)?;
    if let Some(message) = state.poses.summary()? {
        job.events.emit(&Event::Note { object: "poses".into(), message });
    }
    let verdict = watch.conclude(&context, &mut state)?;
    let dynamic_gaussians = state.moving_rows(&context.device)?.count();
    let report = TrainReport {
        seconds: began.elapsed().as_secs_f64(),
        stage_seconds,
        iterations: context.lengths.total(),
        gaussians: state.set.len(),
        dynamic_gaussians,
        checkpoint: context.checkpoint.clone(),
        verdict,
    };
    Ok((checkpoint::trained_model(state, &context.settings)?, report))
}

/// Index among the training cameras, by index in the scene.
fn training_cameras(scene: &Scene) -> BTreeMap<usize, usize> {
    let used: std::collections::BTreeSet<usize> = scene.split(Split::Train).into_iter().map(|view| scene.views[view].camera).collect();
    used.into_iter().enumerate().map(|(index, camera)| (camera, index)).collect()
}
