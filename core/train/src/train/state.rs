//! Everything a run needs to continue to the same bytes.

use super::capacity::PairCapacities;
use super::guard::Guard;
use super::record::Record;
use super::rounded::Rounded;
use super::strain::Neighbours;
use super::watchdog::RateFactors;
use crate::config::RunConfig;
use crate::gaussian_set::GaussianSet;
use burn::tensor::Device;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Appearance, DensityControl, HostGaussians, Optimizer, Parameter, Poses, Result, Scene, Similarity, SpatialInput, Split, Stage, path_holds};
use cc4dgs_play::model::ModelDeformer;
use cc4dgs_play::{Moving, MovingRows, RenderConfig};

/// The state between two iterations.
pub struct TrainState {
    /// Stage under way.
    pub stage: Stage,
    /// Iterations of the stage that are done.
    pub iteration: usize,
    /// The Gaussians.
    pub set: GaussianSet,
    /// What may move.
    pub moving: Moving,
    /// From the coordinates of the dataset to those of the Gaussians.
    pub normalisation: Similarity,
    /// Longest focal length of the training images in pixels (`longest_focal`).
    pub focal: Option<f64>,
    /// The deformer, from the main stage on.
    pub deformer: Option<ModelDeformer>,
    /// Between rendered and recorded images.
    pub appearance: Box<dyn Appearance>,
    /// Corrects the poses of training cameras.
    pub poses: Box<dyn Poses>,
    /// Adds, moves and removes Gaussians.
    pub density: Box<dyn DensityControl>,
    /// Keeps density control from doing harm.
    pub guard: Guard,
    /// Steps everything that learns.
    pub optimizer: Box<dyn Optimizer>,
    /// Whether smoothness was switched on.
    pub smooth: bool,
    /// Learning rates that the watchdog lowered.
    pub rates: RateFactors,
    /// Its own numbers.
    pub record: Record,
    /// What is drawn in place of the values, in fine-tuning.
    pub(crate) rounded: Option<Rounded>,
    /// Learned again by a run that is resumed.
    pub(crate) capacities: PairCapacities,
    rows: Option<MovingRows>,
    pub(crate) neighbours: Option<Neighbours>,
}

/// Longest focal length of the training images of `scene` in pixels, rounded up to hundredths.
pub(crate) fn longest_focal(scene: &Scene) -> Option<f64> {
    let focal = |view: usize| (100.0 * (scene.camera(view).fx * scene.camera(view).fy).sqrt()).ceil() / 100.0;
    scene.split(Split::Train).into_iter().map(focal).reduce(f64::max)
}

/// The parts of the trainer that have state.
pub struct Parts {
    /// Between rendered and recorded images.
    pub appearance: Box<dyn Appearance>,
    /// Corrects the poses of training cameras.
    pub poses: Box<dyn Poses>,
    /// Adds, moves and removes Gaussians.
    pub density: Box<dyn DensityControl>,
    /// Steps everything that learns.
    pub optimizer: Box<dyn Optimizer>,
}

/// Names of the parts of a training that learn of cameras: in arrays of checkpoints, in messages, and for the factors of learning rates.
pub(crate) const APPEARANCE: &str = "appearance";
pub(crate) const POSES: &str = "poses";

impl TrainState {
    /// A fresh run.
    pub fn new(set: GaussianSet, moving: Moving, normalisation: Similarity, focal: Option<f64>, parts: Parts) -> Self {
        let Parts { appearance, poses, density, optimizer } = parts;
        let guard = Guard::default();
        Self {
            stage: Stage::Coarse,
            iteration: 0,
            set,
            moving,
            normalisation,
            focal,
            deformer: None,
            appearance,
            poses,
            density,
            guard,
            optimizer,
            smooth: false,
            rates: RateFactors::default(),
            record: Record::default(),
            rounded: None,
            capacities: PairCapacities::default(),
            rows: None,
            neighbours: None,
        }
    }
    /// How the model of a run with `config` is drawn: images that are larger than the training images blur in proportion, unless `config` says from where on.
    pub fn render(&self, config: &RunConfig) -> RenderConfig {
        RenderConfig { focal: config.render.focal.or(self.focal), ..config.render.clone() }
    }
    /// New optimizer state and statistics, as every stage starts with (Swift4D). With `keep_moments` the attributes of the Gaussians keep their optimizer state
    /// after the coarse stage, but for the dynamic scores, which only the score stage fits. A stage that has begun and has no iteration may begin again.
    ///
    /// # Errors
    /// What the optimizer reports where it restores the state that is kept.
    pub fn begin_stage(&mut self, keep_moments: bool, device: &Device) -> Result<()> {
        let kept = (keep_moments && self.stage != Stage::Coarse).then(|| {
            let mut kept = self.optimizer.state();
            let goes_on = |name: &str| path_holds("gaussians", name) && !path_holds("gaussians/dynamic_scores", name);
            kept.arrays.retain(|name, _| goes_on(name));
            kept.steps.retain(|name, _| goes_on(name));
            kept
        });
        self.optimizer.restart("");
        if let Some(kept) = kept {
            self.optimizer.restore(kept)?;
        }
        self.density.begin_stage(self.set.len(), device);
        self.guard.begin_stage(self.set.len());
        Ok(())
    }
    /// The weights of the parts that learn of cameras, by the name of the part.
    pub(crate) fn of_cameras(&self) -> [(&'static str, Vec<&Parameter>); 2] {
        [(APPEARANCE, self.appearance.parameters()), (POSES, self.poses.parameters())]
    }
    /// As [`TrainState::of_cameras`], to be changed.
    pub(crate) fn of_cameras_mut(&mut self) -> [(&'static str, Vec<&mut Parameter>); 2] {
        [(APPEARANCE, self.appearance.parameters_mut()), (POSES, self.poses.parameters_mut())]
    }
    /// The rows the deformer moves; kept until the set changes.
    pub fn moving_rows(&mut self, device: &Device) -> Result<MovingRows> {
        if let Some(rows) = &self.rows {
            return Ok(rows.clone());
        }
        let rows = match self.moving {
            Moving::Scored { .. } => self.moving.rows(&to_vec(self.set.get("dynamic_scores")?.clone(), "dynamic_scores")?),
            other => other.rows(&[]),
        };
        let rows = MovingRows::new(rows, self.set.len(), device);
        self.rows = Some(rows.clone());
        Ok(rows)
    }
    /// What the deformer is asked about, without gradient.
    pub fn spatial_input(&self, deformer: &ModelDeformer, rows: &MovingRows) -> Result<SpatialInput> {
        let attributes = deformer.field.attributes().iter().map(|a| Ok(rows.select(self.set.get(&a.name)?.clone()))).collect::<Result<_>>()?;
        Ok(SpatialInput { means_world: rows.select(self.set.get("means")?.clone()), attributes })
    }
    /// The neighbouring moving Gaussians as of the last change of the set.
    pub(super) fn current_neighbours(&mut self, device: &Device) -> Result<Neighbours> {
        if let Some(neighbours) = &self.neighbours {
            return Ok(neighbours.clone());
        }
        let rows = self.moving_rows(device)?;
        let neighbours = Neighbours::of(&to_vec(rows.select(self.set.get("means")?.clone()), "means")?, device);
        self.neighbours = Some(neighbours.clone());
        Ok(neighbours)
    }
    /// To be called whenever Gaussians or scores changed.
    pub fn invalidate_rows(&mut self) {
        self.neighbours = None;
        self.rows = None;
    }
    /// The Gaussians that may move, or all if none may, without those that are not finite.
    pub fn moving_gaussians(&self) -> Result<HostGaussians> {
        let host = self.set.host_gaussians()?;
        let mut rows = self.moving.rows(&host.dynamic_scores).unwrap_or_default();
        if rows.is_empty() {
            rows = (0..host.len()).collect();
        }
        rows.retain(|&row| host.is_finite(row));
        Ok(host.select(&rows))
    }
    /// All Gaussians, without those that are not finite.
    pub fn finite_gaussians(&self) -> Result<HostGaussians> {
        let host = self.set.host_gaussians()?;
        let rows: Vec<usize> = (0..host.len()).filter(|&row| host.is_finite(row)).collect();
        Ok(host.select(&rows))
    }
}
