//! One step of the score stage: dynamic scores are blended like colours and fitted to the temporal-deviation masks (baselines §2.2).

use super::step::Log;
use super::{Context, TrainState};
use crate::columns::log_linear;
use crate::schedule::Stage;
use burn::tensor::{Tensor, TensorData};
use cc4dgs_backends::ops::photometric::bce_with_logits_loss;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Result, SplatColors, Splats};

impl Context<'_> {
    /// One iteration (from 1): one camera, black background, gradient to the scores alone.
    pub(crate) fn score_step(&self, state: &mut TrainState, iteration: usize, log: &mut Log) -> Result<()> {
        let length = self.schedule.length(Stage::Score);
        // Drawn without replacement and refilled, as a permutation per round over the cameras.
        let k = self.masks.len();
        let order = self.seed.child("score").index(((iteration - 1) / k) as u64);
        let mut turn: Vec<usize> = (0..k).collect();
        rand::seq::SliceRandom::shuffle(turn.as_mut_slice(), &mut order.rng());
        let mask = &self.masks[turn[(iteration - 1) % k]];

        let leaves = state.set.leaves(&["dynamic_scores"]);
        let gaussians = state.set.gaussians(&leaves);
        let mut splats = Splats::from_gaussians(&gaussians, 0);
        splats.colors = SplatColors::Direct(leaves[6].clone().repeat_dim(1, 3));
        let camera = self.job.scene.camera(mask.view);
        let settings = self.job.config.render.settings(None);
        let output = self.rasterizer.render(&splats, camera, &settings)?;
        let (w, h) = (camera.width as usize, camera.height as usize);
        let target = Tensor::<2>::from_inner(Tensor::from_data(TensorData::new(mask.mask.clone(), [h, w]), &self.device));
        let loss = bce_with_logits_loss(output.planes, target)?;
        if log.due(iteration) {
            log.loss(to_vec(loss.clone(), "loss")?.first().copied().unwrap_or(f32::NAN), Stage::Score, iteration)?;
        }
        let gradients = loss.backward();
        let of_columns = leaves.iter().map(|leaf| leaf.grad(&gradients)).collect();
        drop((leaves, gaussians, splats));
        // 0.05 -> 0.005 over 30,000 steps of which 3,000 run; shorter stages take larger steps so that scores can still reach zeta.
        let rate = self.job.config.train.lr.score;
        let stretch = (3000.0 / length as f64).clamp(1.0, 4.0);
        let lr = log_linear(rate, 0.1 * rate, 0.1 * iteration as f64 / length as f64) * stretch;
        state.set.update(of_columns, |_| lr, Some(&output.stats.radii))?;
        state.invalidate_rows();
        log.step(self.job.events, iteration, state.set.len());
        Ok(())
    }
}
