//! One step of the score stage: dynamic scores are blended like colours and fitted to the temporal-deviation masks (Swift4D).

use super::log::Log;
use super::watchdog::{Trouble, broken_rows_of};
use super::{Context, TrainState};
use crate::gaussian_set::log_linear;
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{LossInput, Result, Schedule, SplatColors, Splats, StepSettings};

impl Context<'_> {
    /// One iteration: one camera, black background, gradient to the scores alone. Returns what is not finite, where that is looked at.
    pub(crate) fn score_step(&self, state: &mut TrainState, schedule: &Schedule, check: bool, log: &mut Log) -> Result<Option<Trouble>> {
        let iteration = schedule.iteration;
        // Drawn without replacement and refilled, as a permutation per round over the cameras.
        let k = self.masks.len();
        let order = self.seed.child("score").index(((iteration - 1) / k) as u64);
        let mut turn: Vec<usize> = (0..k).collect();
        rand::seq::SliceRandom::shuffle(turn.as_mut_slice(), &mut order.rng());
        let mask = &self.masks[turn[(iteration - 1) % k]];

        let leaves = state.set.leaves(|name| name == "dynamic_scores");
        let gaussians = leaves.gaussians()?;
        let mut splats = Splats::from_gaussians(&gaussians, 0);
        splats.colors = SplatColors::Direct(leaves.get("dynamic_scores")?.clone().repeat_dim(1, 3));
        let camera = self.camera_of(&self.job.scene, state, mask.view)?;
        let settings = self.job.config.render.settings(None);
        let output = self.rasterizer.render(&splats, &camera, &settings)?;
        let (w, h) = (camera.width as usize, camera.height as usize);
        let wanted: Vec<f32> = mask.mask.iter().map(|&moves| f32::from(u8::from(moves))).collect();
        let target = Tensor::<3>::from_inner(Tensor::from_data(TensorData::new(wanted, [1, h, w]), &self.device));
        let (view, radii) = (&self.job.scene.views[mask.view], &output.stats.radii);
        let loss = self.score_loss.value(&LossInput::new(&camera, view, &output.planes, &target, &gaussians, radii, schedule))?;
        if log.due(iteration) || check {
            let value = to_vec(loss.clone(), "loss")?.first().copied().unwrap_or(f32::NAN);
            if !value.is_finite() {
                return Ok(Some(Trouble::of("gaussians/dynamic_scores", "the loss of the dynamic scores")));
            }
            if log.due(iteration) {
                log.loss(value);
            }
        }
        let gradients = leaves.gradients(&loss.backward());
        if check && let Some(trouble) = broken_rows_of(&gradients)? {
            return Ok(Some(trouble));
        }
        drop((leaves, gaussians, splats, loss));
        // 0.05 -> 0.005 over 30,000 steps of which 3,000 run; shorter stages take larger steps so that scores can still reach zeta.
        let rate = self.job.config.train.lr.score;
        let stretch = (3000.0 / schedule.length as f64).clamp(1.0, 4.0);
        let lr = log_linear(rate, 0.1 * rate, 0.1 * schedule.progress()) * stretch * state.rates.of_gaussians("dynamic_scores");
        self.step_gaussians(state, gradients, |_| StepSettings { visible: Some(&output.stats.radii), ..StepSettings::new(lr) })?;
        state.invalidate_rows();
        log.step(self.job.events, iteration, state.set.len());
        Ok(None)
    }
}
