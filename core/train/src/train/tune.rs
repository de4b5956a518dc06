//! Fine-tuning: a trained model is trained further while its values are rounded as a codec will store them.

use super::log::Log;
use super::losses::LossTerms;
use super::probe::mean;
use super::pyramid::Pyramid;
use super::rounded::{Rounded, WeightScale};
use super::sampler::Sampler;
use super::stored_weights::StoredWeights;
use super::targets::{PerCamera, targets};
use super::{Context, Parts, RateFactors, TrainJob, TrainState, training_cameras};
use crate::config::RunConfig;
use crate::gaussian_set::GaussianSet;
use crate::sample::spread_views;
use crate::schedule::StageLengths;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::{
    AppearanceContext, EncodedWeights, Error, Event, EventSink, HostGaussians, Limits, PosesContext, Registry, Result, Scene, Schedule, Seed, Split, Stage,
    TuneModel, TunedModel, Tuning, WeightArray, WeightCodec, config, psnr_of,
};
use cc4dgs_play::model::ModelDeformer;
use cc4dgs_play::{Model, load_weights, weights_of};
use std::cell::{OnceCell, RefCell};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The most views on which PSNR is measured, and those on which the loss by rounding is.
const JUDGES: usize = 48;
const PROBES: usize = 8;
/// Views per iteration. With one, training loses more than rounding.
const BATCH: usize = 4;
/// Largest learning rate in quantisation steps, of Gaussians and of weights whose codec states its steps, of a training of so many iterations: larger ones make
/// values noisy, which costs bytes; half of it does not make up for the other steps of each round. Shorter trainings have larger ones, so that a random walk
/// goes as far.
const RATE: f64 = 0.02;
const RATE_ITERATIONS: f64 = 200.0;
/// Largest learning rate of weights without steps as a share of that in the middle of a main stage; ten times as much costs 0.4 dB.
const DEFORMER_RATE: f64 = 0.1;
/// Share of the iterations over which the learning rate rises.
const WARMUP: f64 = 0.1;
/// Share by which learning rates have fallen at the end of the last of several trainings.
const FALL: f64 = 0.5;
/// Iterations for which derivatives of the size are kept: they change slowly.
const SIZE_EVERY: usize = 8;
/// Iterations between two looks for values that are not finite, and between two events.
pub(super) const CHECK_EVERY: usize = 25;

/// What a [`Tuner`] works on.
pub struct TuneJob<'a> {
    /// The model.
    pub model: &'a Model,
    /// The scene that it was trained on.
    pub scene: Arc<Scene>,
    /// How the deformer's weights are stored: see [`cc4dgs_play::field_weights::FieldWeights::parse`]. The archive must name the same.
    pub field_weights: &'a str,
    /// Where plug-ins are found.
    pub registry: &'a Registry,
    /// The device of the model's deformer.
    pub device: &'a Device,
    /// What readers may believe.
    pub limits: &'a Limits,
    /// Where events go.
    pub events: &'a dyn EventSink,
    /// Set to stop.
    pub stop: &'a AtomicBool,
}

/// Trains a model with rounded values, with the loss and the optimizer that it was trained with. Density control, appearance, smoothness and noise are left
/// out. Loss terms of recorded depth are left out, with a warning, where the scene has none; a loss of such terms alone is an error.
///
/// Nothing is looked at before a codec asks for it.
pub struct Tuner<'a> {
    pub(super) job: TuneJob<'a>,
    config: OnceCell<RunConfig>,
    weights: OnceCell<StoredWeights>,
    targets: OnceCell<Arc<Scene>>,
    adopted: RefCell<Option<(Vec<WeightArray>, f64)>>,
}

impl<'a> Tuner<'a> {
    /// A tuner of `job.model`.
    pub fn new(job: TuneJob<'a>) -> Self {
        Self { job, config: OnceCell::new(), weights: OnceCell::new(), targets: OnceCell::new(), adopted: RefCell::default() }
    }
    /// The same tuner with the scene whose images it trains on.
    pub(super) fn with_targets(self, targets: Arc<Scene>) -> Self {
        Self { targets: OnceCell::from(targets), ..self }
    }
    /// The scene with the images to train on. Recorded depth is looked for once, before they are first used.
    ///
    /// # Errors
    /// [`Error::Parameter`] where all loss terms compare recorded depth and the scene has none, [`Error::Interrupted`], and what scene and device report.
    pub(super) fn targets(&self) -> Result<&Arc<Scene>> {
        if let Some(known) = self.targets.get() {
            return Ok(known);
        }
        self.check_depth()?;
        let found = targets(&self.job)?;
        Ok(self.targets.get_or_init(|| found))
    }
    /// Warns of loss terms that compare recorded depth where the scene has none.
    ///
    /// # Errors
    /// [`Error::Parameter`] where the loss has no other terms.
    fn check_depth(&self) -> Result<()> {
        let TuneJob { scene, registry, events, .. } = &self.job;
        if let Some((object, message)) = LossTerms::build(registry, &self.config()?.loss)?.check_depth_further(scene)? {
            events.emit(&Event::Warning { object, message });
        }
        Ok(())
    }
    /// The configuration of the model's training, without what fine-tuning leaves out.
    fn config(&self) -> Result<&RunConfig> {
        if let Some(known) = self.config.get() {
            return Ok(known);
        }
        let TuneJob { model, scene, .. } = &self.job;
        let views = scene.split(Split::Train).len();
        if views == 0 {
            return Err(Error::parameter("fine-tuning", format!("{} has no training views", scene.name), "Give the scene that the model was trained on"));
        }
        let none = || toml::Table::from_iter([("kind".into(), "none".into())]);
        let mut config: RunConfig = config::parse_section("configuration of the model", &model.provenance.config)?;
        (config.render, config.rasterizer) = (model.render.clone(), model.rasterizer.clone());
        (config.scene.background, config.render.background) = (None, Some(model.background_on(scene.background)));
        (config.density, config.appearance, config.poses) = (none(), none(), none());
        (config.train.image_growth, config.train.sh_every) = (0.0, 1);
        (config.train.time_noise, config.train.dropout, config.train.lambda_r, config.train.lr.cooldown) = (0.0, 0.0, 0.0, 0.0);
        // Learning rates are shares of those of the training, whose iterations drew no more views than there are.
        config.train.batch = config.train.batch.min(views);
        config.validate()?;
        Ok(self.config.get_or_init(|| config))
    }
    /// How the deformer's weights are stored.
    fn weights(&self) -> Result<&StoredWeights> {
        if let Some(known) = self.weights.get() {
            return Ok(known);
        }
        let found = StoredWeights::choose(&self.job, self.moving_field().is_some())?;
        Ok(self.weights.get_or_init(|| found))
    }
    /// The deformer, unless nothing moves: then it is not stored.
    fn moving_field(&self) -> Option<&ModelDeformer> {
        let model = self.job.model;
        let movable = model.moving.rows(&model.gaussians.dynamic_scores).is_none_or(|rows| !rows.is_empty());
        model.field.as_ref().filter(|f| movable && !f.field.is_static())
    }
    /// Calls `work` with the parts of a training and the state of `model`.
    pub(super) fn with_state<T>(&self, model: &TunedModel, seed: Seed, work: impl FnOnce(&Context, &mut TrainState) -> Result<T>) -> Result<T> {
        let TuneJob { registry, device, events, stop, .. } = &self.job;
        let (config, scene) = (self.config()?, self.targets()?);
        let training_camera = training_cameras(scene);
        let parts = Parts {
            appearance: registry.build_appearance(&config.appearance, &AppearanceContext { cameras: training_camera.len(), seed }, device)?,
            poses: registry.build_poses(&config.poses, &PosesContext { cameras: training_camera.len(), extent: f64::from(scene.extent()), seed }, device)?,
            density: registry.build_density(&config.density)?,
            optimizer: registry.build_optimizer(&config.optimizer)?,
        };
        let job = TrainJob { config, scene: scene.clone(), out: None, resume: false, registry, events: *events, stop, observer: None };
        let context = Context {
            job: &job,
            pyramid: Pyramid::new(scene, config)?,
            settings: config.clone(),
            lengths: StageLengths::new(&config.train, false, scene.extent()),
            rasterizer: registry.build_rasterizer(&config.rasterizer)?,
            losses: LossTerms::build(registry, &config.loss)?,
            score_loss: LossTerms::build_score(registry, &config.score_loss)?,
            background: Tensor::from_floats(config.background()?, device),
            device: (*device).clone(),
            seed,
            masks: Vec::new(),
            training_camera,
            ends: None,
            checkpoint: None,
        };
        let of = self.job.model;
        let mut state = TrainState::new(GaussianSet::new(&model.gaussians, device), of.moving, of.normalisation, of.render.focal, parts);
        if let Some(of) = self.moving_field() {
            let mut field = registry.build_deformer(&of.section, &of.context, device)?;
            load_weights("tuned weights", field.as_mut(), model.weights.clone(), device)?;
            state.deformer = Some(ModelDeformer { field, section: of.section.clone(), context: of.context.clone() });
        }
        state.stage = Stage::Main;
        work(&context, &mut state)
    }
    /// `like` with the values of `state`, which must be sound; `object` names them in errors.
    pub(super) fn columns_of(like: &HostGaussians, state: &TrainState, limits: &Limits, object: &str) -> Result<HostGaussians> {
        let (mut gaussians, found) = (like.clone(), state.set.host_gaussians()?);
        for ((_, _, to), (_, _, values)) in gaussians.columns_mut().into_iter().zip(found.columns()) {
            to.clone_from(values);
        }
        for (name, attribute) in &mut gaussians.extra {
            if let Some(found) = found.extra.get(name) {
                attribute.values.clone_from(&found.values);
            }
        }
        gaussians.validate(object, limits)?;
        Ok(gaussians)
    }
    /// Mean absolute error of `gaussians`, as they are, on a few training views.
    fn mean_error(&self, context: &Context, state: &mut TrainState, gaussians: &HostGaussians) -> Result<f64> {
        let scene = self.targets()?;
        let views = spread_views(scene, &scene.split(Split::Train), PROBES);
        let set = GaussianSet::new(gaussians, self.job.device).gaussians()?;
        let (background, requests) = (self.config()?.background()?, views.iter().map(|&v| (v, scene.views[v].time_norm)).collect::<Vec<_>>());
        let mut sum = 0.0;
        context.draw(state, &set, &requests, gaussians.sh_degree, |index, image| {
            let target = context.rasterizer.upload(&scene.frame(views[index])?, background, self.job.device);
            sum += f64::from(mean((image - target).abs(), "mean error")?);
            Ok(())
        })?;
        Ok(sum / views.len().max(1) as f64)
    }
    /// What the next step draws, given the state's values.
    fn round(&self, state: &TrainState, tuning: &Tuning, codec: &dyn WeightCodec, fixed: &Fixed) -> Result<Rounded> {
        let device = self.job.device;
        let host = state.set.host_gaussians()?;
        let exact = state.deformer.as_ref().map(|d| weights_of(d.field.as_ref())).transpose()?.unwrap_or_default();
        let weights = self.weights()?.rounded(&self.job, &exact, codec)?;
        let upload = |w: WeightArray| {
            let count = w.values.len();
            Tensor::<1>::from_data(TensorData::new(w.values, [count]), device)
        };
        Ok(Rounded {
            gaussians: GaussianSet::new(&tuning.rounding.round(&host)?, device),
            steps: fixed.steps.clone(),
            size: fixed.size.clone(),
            rate: fixed.rate,
            weights: weights.into_iter().map(upload).collect(),
            weight_scales: fixed.weights.clone(),
            exact_weights: Vec::new(),
        })
    }
}

/// The views on which PSNR is measured: some of those that judge ([`Scene::judging_split`]).
pub(super) fn judges(scene: &Scene) -> Vec<usize> {
    spread_views(scene, &scene.split(scene.judging_split()), JUDGES)
}

/// What changes slowly.
struct Fixed {
    steps: BTreeMap<String, Tensor<2>>,
    size: BTreeMap<String, Tensor<2>>,
    weights: Option<Vec<Option<WeightScale>>>,
    rate: f64,
}

/// The columns of `values` as tensors by name.
fn columns(values: &HostGaussians, device: &Device) -> BTreeMap<String, Tensor<2>> {
    GaussianSet::new(values, device).iter().map(|(name, values)| (name.to_string(), values.clone())).collect()
}

/// Share of the largest learning rate after the share `done` of the iterations: it rises linearly, then falls as a cosine.
pub(super) fn rate_at(done: f64) -> f64 {
    if done < WARMUP { done / WARMUP } else { 0.5 + 0.5 * (std::f64::consts::PI * (done - WARMUP) / (1.0 - WARMUP)).cos() }
}

impl TuneModel for Tuner<'_> {
    fn caution(&self) -> Result<Option<String>> {
        let PerCamera { colours, poses } = PerCamera::of(self.job.model)?;
        let what = match (colours, poses) {
            (false, false) => return Ok(None),
            (true, false) => "colours per camera",
            (false, true) => "corrected poses of its cameras",
            (true, true) => "colours per camera and corrected poses",
        };
        Ok(Some(format!("it was trained with {what}; what such models gain on training views may be lost on others")))
    }
    fn start(&self, gaussians: &HostGaussians) -> Result<TunedModel> {
        let weights = self.moving_field().map(|f| weights_of(f.field.as_ref())).transpose()?.unwrap_or_default();
        Ok(TunedModel { gaussians: gaussians.clone(), weights })
    }
    fn tune(&self, from: &TunedModel, tuning: &Tuning) -> Result<TunedModel> {
        let device = self.job.device;
        let stored = self.weights()?;
        let (codec, _) = stored.codec(&self.job, tuning.weight_steps)?;
        self.with_state(from, tuning.seed, |context, state| {
            let mut fixed = Fixed { steps: columns(&tuning.rounding.steps(&from.gaussians)?, device), size: BTreeMap::new(), weights: None, rate: 0.0 };
            let lost = self.mean_error(context, state, &tuning.rounding.round(&from.gaussians)?)? - self.mean_error(context, state, &from.gaussians)?;
            // Where all steps are as large as they should be, an octave more of them costs as much as it saves; a step's error adds in proportion to its
            // square.
            let per_bit = tuning.size_weight * 2.0 * std::f64::consts::LN_2 * lost.max(0.0) / tuning.bits_per_octave;
            let mut sampler = Sampler::new(self.job.scene.split(Split::Train), tuning.seed.child("views"), BATCH);
            let extent = self.job.scene.extent();
            // Nothing is logged.
            let mut log = Log::new(Stage::Main, usize::MAX, usize::MAX);
            for iteration in 1..=tuning.iterations {
                if self.job.stop.load(Ordering::Relaxed) {
                    return Err(Error::Interrupted("in fine-tuning; nothing was written".into()));
                }
                if per_bit > 0.0 && (iteration - 1).is_multiple_of(SIZE_EVERY) {
                    let slopes = columns(&tuning.rounding.bit_slopes(&state.set.host_gaussians()?)?, device);
                    let in_steps = |(name, slopes): (String, Tensor<2>)| Some((name.clone(), slopes * fixed.steps.get(&name)?.clone().mul_scalar(per_bit)));
                    fixed.size = slopes.into_iter().filter_map(in_steps).collect();
                }
                if (iteration - 1).is_multiple_of(SIZE_EVERY) {
                    let exact = state.deformer.as_ref().map(|d| weights_of(d.field.as_ref())).transpose()?;
                    fixed.weights = exact.map_or(Ok(None), |exact| stored.scales(&self.job, &exact, codec.as_ref(), per_bit))?;
                }
                let share =
                    rate_at((iteration as f64 - 0.5) / tuning.iterations as f64) * (1.0 - FALL * (tuning.of.0 + iteration) as f64 / tuning.of.1.max(1) as f64);
                fixed.rate = RATE * (RATE_ITERATIONS / tuning.iterations as f64).sqrt() * share;
                state.rounded = Some(self.round(state, tuning, codec.as_ref(), &fixed)?);
                state.rates = RateFactors(BTreeMap::from([("deformer".into(), DEFORMER_RATE * share)]));
                let schedule = Schedule { extent, sh_degree: from.gaussians.sh_degree, ..Schedule::further(tuning.of.0 + iteration) };
                let check = iteration.is_multiple_of(CHECK_EVERY);
                if let Some(trouble) = context.photometric_step(&schedule, state, &sampler.batch(iteration - 1), check, &mut log)? {
                    return Err(Error::backend("fine-tuning", format!("{} is not finite", trouble.what), "Compress with finetune=0"));
                }
                if check || iteration == tuning.iterations {
                    self.job.events.emit(&Event::Progress { task: "fine-tuning".into(), done: (tuning.of.0 + iteration) as u64, total: tuning.of.1 as u64 });
                }
            }
            let gaussians = Self::columns_of(&from.gaussians, state, self.job.limits, "Gaussians of fine-tuning")?;
            let weights = state.deformer.as_ref().map(|d| weights_of(d.field.as_ref())).transpose()?.unwrap_or_default();
            Ok(TunedModel { gaussians, weights })
        })
    }
    fn psnr(&self, gaussians: &HostGaussians, weights: &[WeightArray], weight_steps: Option<f64>) -> Result<f64> {
        let weights = match weight_steps {
            Some(factor) => self.weights()?.rounded(&self.job, weights, self.weights()?.codec(&self.job, factor)?.0.as_ref())?,
            None => weights.to_vec(),
        };
        // Images of cameras with colours of their own would hide what is lost.
        let scene = self.targets()?;
        let views = judges(scene);
        let model = TunedModel { gaussians: gaussians.clone(), weights };
        let mut sum = 0.0;
        self.with_state(&model, Seed::root(0), |context, state| {
            let requests: Vec<(usize, f32)> = views.iter().map(|&view| (view, scene.views[view].time_norm)).collect();
            let (set, background) = (state.set.gaussians()?, self.config()?.background()?);
            context.draw(state, &set, &requests, gaussians.sh_degree, |index, image| {
                let target = context.rasterizer.upload(&scene.frame(views[index])?, background, self.job.device);
                let difference = image.clamp(0.0, 1.0) - target;
                sum += psnr_of(f64::from(mean(difference.clone() * difference, "mean squared error")?));
                Ok(())
            })
        })?;
        Ok(sum / views.len().max(1) as f64)
    }
    fn encoded_weights(&self, weights: &[WeightArray], weight_steps: f64) -> Result<EncodedWeights> {
        if self.moving_field().is_none() {
            return Ok(EncodedWeights::default());
        }
        self.weights()?.encode(&self.job, weights, weight_steps)
    }
    fn adopt(&self, weights: Vec<WeightArray>, weight_steps: f64) {
        *self.adopted.borrow_mut() = Some((weights, weight_steps));
    }
    fn adopted(&self) -> Result<Option<EncodedWeights>> {
        self.adopted.borrow().as_ref().map(|(weights, steps)| self.encoded_weights(weights, *steps)).transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::archive::Provenance;
    use cc4dgs_core::{Camera, NoImages, Silent, Similarity, View, parse_device};
    use cc4dgs_play::model::ModelSize;
    use cc4dgs_play::{Moving, RenderConfig, default_rasterizer};

    #[test]
    fn learning_rates_follow_the_views_that_training_drew() {
        let camera = Camera::look_at("a", (8, 8), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let views = (0..3).map(|frame| View { camera: 0, frame, time_norm: 0.0, split: Split::Train }).collect();
        let scene = Arc::new(Scene::new("s", vec![camera], views, Arc::new(NoImages), 0).unwrap());
        let (registry, device, limits, stop) = (Registry::collect().unwrap(), parse_device("flex").unwrap(), Limits::default(), AtomicBool::new(false));
        for (batch, expected) in [(2, 2), (64, 3)] {
            let model = Model {
                gaussians: HostGaussians::default(),
                field: None,
                moving: Moving::Nothing,
                render: RenderConfig::default(),
                background: None,
                rasterizer: default_rasterizer(),
                frame_count: 3,
                normalisation: Similarity::IDENTITY,
                provenance: Provenance { config: format!("[train]\nbatch = {batch}").parse().unwrap(), ..Default::default() },
                size: ModelSize::default(),
            };
            let (field_weights, scene) = ("fp32", scene.clone());
            let job = TuneJob { model: &model, scene, field_weights, registry: &registry, device: &device, limits: &limits, events: &Silent, stop: &stop };
            assert_eq!(Tuner::new(job).config().unwrap().train.batch, expected);
        }
    }
}
