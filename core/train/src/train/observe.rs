//! Looking at a model that is still in training.

use super::{Context, TrainState};
use burn::tensor::Tensor;
use cc4dgs_core::{Camera, Gaussians, HostGaussians, Result, Schedule, Stage};
use cc4dgs_play::RenderConfig;
use std::sync::atomic::AtomicBool;

/// Where a training stands after an iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Standing {
    /// The stage.
    pub stage: Stage,
    /// Iterations of the stage that are done.
    pub iteration: usize,
    /// Iterations of the stage.
    pub of: usize,
    /// Views that the iteration drew: fewer than `train.batch` says where the stage has fewer.
    pub views: usize,
    /// Frames of the sequence.
    pub frame_count: usize,
}

/// A copy of a model in training, in the normalised frame.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// When it was taken.
    pub standing: Standing,
    /// The canonical Gaussians.
    pub gaussians: HostGaussians,
    /// Indices of the Gaussians that the deformer moves, ascending; empty before the main stage.
    pub rows: Vec<u32>,
    /// These Gaussians at even times from 0 to 1.
    pub moved: Vec<HostGaussians>,
    /// Background, RGB in 0..1.
    pub background: [f32; 3],
    /// How it is drawn.
    pub render: RenderConfig,
    /// The cameras of the training views.
    pub cameras: Vec<Camera>,
}

/// Looks at a model while it trains. What an observer does changes no byte of the result.
pub trait Observer: Send + Sync {
    /// Called after every iteration, on the thread that trains. Returns at how many times the observer wants to see the model now, 0 for none. It may block,
    /// which pauses the training, and must return soon after `stop` was set.
    fn after_iteration(&self, standing: &Standing, stop: &AtomicBool) -> usize;
    /// Receives what [`Observer::after_iteration`] asked for.
    fn receive(&self, snapshot: Snapshot);
}

impl Context<'_> {
    /// Shows the model to the observer after an iteration of so many `views`, if there is one and it wants to see it. Nothing of `state` changes.
    pub(crate) fn observe(&self, state: &mut TrainState, schedule: &Schedule, views: usize) -> Result<()> {
        let Some(observer) = self.job.observer else { return Ok(()) };
        let scene = &self.job.scene;
        let standing = Standing { stage: schedule.stage, iteration: schedule.iteration, of: schedule.length, views, frame_count: scene.frame_count };
        let times = observer.after_iteration(&standing, self.job.stop);
        if times == 0 {
            return Ok(());
        }
        let config = self.job.config;
        let gaussians = state.set.host_gaussians()?;
        let (rows, moved) = self.moved(state, &gaussians.dynamic_scores, times)?;
        let cameras = super::training_cameras(scene).into_keys().map(|index| scene.cameras[index].clone()).collect();
        observer.receive(Snapshot { standing, gaussians, rows, moved, background: config.background()?, render: state.render(config), cameras });
        Ok(())
    }
    /// The Gaussians that move by their scores, and what they are at `count` even times.
    fn moved(&self, state: &mut TrainState, scores: &[f32], count: usize) -> Result<(Vec<u32>, Vec<HostGaussians>)> {
        let moving = state.moving_rows(&self.device)?;
        let Some(deformer) = state.deformer.as_ref().filter(|d| !d.field.is_static() && moving.count() > 0) else {
            return Ok(Default::default());
        };
        let attributes = state.set.iter().map(|(name, values)| (name.to_string(), moving.select(values.clone())));
        let canonical = Gaussians::from_attributes(state.set.sh_degree, attributes)?;
        let features: Tensor<2> = deformer.field.spatial(&state.spatial_input(deformer, &moving)?)?.values;
        let at = |k: usize| {
            let time = if count > 1 { k as f32 / (count - 1) as f32 } else { 0.0 };
            deformer.field.deform(features.clone(), time)?.apply(deformer.name(), &canonical, None)?.to_host()
        };
        let moved = (0..count).map(at).collect::<Result<_>>()?;
        let rows = state.moving.rows(scores).map_or_else(|| (0..scores.len() as u32).collect(), |rows| rows.into_iter().map(|r| r as u32).collect());
        Ok((rows, moved))
    }
}
