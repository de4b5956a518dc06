//! One photometric step: field, render, loss, backward, Adam. Shared by the coarse and the main stage.

use super::smoothness::{flicker, smoothness};
use super::{Context, TrainState};
use crate::columns::gaussian_rate;
use crate::schedule::Stage;
use burn::tensor::{Int, Tensor, TensorData};
use cc4dgs_backends::ops::image::image_planes;
use cc4dgs_backends::ops::photometric::photometric_loss;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Error, Event, EventSink, RenderSettings, Result, Splats};
use std::collections::BTreeMap;
use std::time::Instant;

/// The columns a photometric step learns.
const LEARNED: [&str; 7] = ["means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest", "extra"];

impl Context<'_> {
    /// One iteration (from 1) of `stage` on the views of `batch`.
    pub(crate) fn photometric_step(&self, stage: Stage, state: &mut TrainState, iteration: usize, batch: &[usize], log: &mut Log) -> Result<()> {
        let train = &self.job.config.train;
        let scene = &self.job.scene;
        let n = state.set.len();
        let progress = iteration as f64 / self.schedule.length(stage) as f64;
        let rows = state.moving_rows(&self.device)?;
        let moving = if state.field.as_ref().is_some_and(|f| !f.field.is_static()) { rows.count(n) } else { 0 };
        self.decide_smoothness(state, iteration, moving)?;

        let leaves = state.set.leaves(&LEARNED);
        let gaussians = state.set.gaussians(&leaves);
        let autodiff = leaves[0].device();
        let (mut features, mut canonical) = (None, None);
        if moving > 0
            && let Some(optimizer) = &mut state.field
        {
            optimizer.track();
            optimizer.field.set_progress(progress as f32);
            // The field is asked about the canonical centres as constants (baselines §10, row 22), which also makes caching exact.
            let centres = Tensor::<2>::from_inner(rows.select(state.set.columns[0].value.clone()));
            let own: Vec<Tensor<2>> = optimizer.field.attributes().iter().map(|a| rows.select(state.set.leaf(&leaves, &a.name))).collect();
            let spatial = optimizer.field.spatial_with(centres.clone(), &own)?;
            log.count_field(spatial.work.vertices_decoded, spatial.work.vertices_queried - spatial.work.vertices_decoded, moving as u64, (n - moving) as u64);
            features = Some(spatial.values);
            canonical = Some(centres);
        }

        let degree = match stage {
            Stage::Coarse => (iteration.saturating_sub(1) / self.schedule.interval(train.sh_interval, 100)).min(train.sh_degree),
            _ => train.sh_degree,
        };
        let background_rgb = self.job.config.background()?;
        let background = Tensor::<1>::from_data(TensorData::new(background_rgb.to_vec(), [3]), &self.device);
        let settings =
            RenderSettings { max_weights: self.wants_weights(stage, iteration), ..self.job.config.render.settings(Some(Tensor::from_inner(background))) };
        let mut total: Option<Tensor<1>> = None;
        let mut probes = Vec::with_capacity(batch.len());
        let mut seen: Option<Tensor<1, Int>> = None;
        let read = log.due(iteration);
        for &view in batch {
            let (camera, time_norm) = (scene.camera(view), scene.views[view].time_norm);
            let moved = match (&features, &state.field) {
                (Some(features), Some(optimizer)) => {
                    optimizer.field.deform(features.clone(), self.noisy_time(time_norm, progress, iteration, view))?.apply(&gaussians, rows.tensor())
                }
                _ => gaussians.clone(),
            };
            let mut splats = Splats::from_gaussians(&moved, degree);
            let probe = Tensor::<2>::zeros([n, 2], &autodiff).require_grad();
            splats.screen_probe = Some(probe.clone());
            let output = self.rasterizer.render(&splats, camera, &settings)?;
            let target = Tensor::<3>::from_inner(image_planes(&scene.frame(view)?, background_rgb, &self.device));
            let photometric = photometric_loss(output.planes, target, train.lambda_c)?;
            if read {
                log.psnr(photometric.numbers()?.psnr_db());
            }
            let loss = photometric.loss.div_scalar(batch.len() as f32);
            total = Some(match total {
                Some(sum) => sum + loss,
                None => loss,
            });
            let radii = output.stats.radii;
            seen = Some(match seen {
                Some(other) => other.max_pair(radii.clone()),
                None => radii.clone(),
            });
            if let Some(weights) = output.stats.max_weights {
                state.stats.add_weights(weights);
            }
            probes.push((probe, radii, camera));
        }
        let Some(mut loss) = total else { return Ok(()) };
        if let (Some(optimizer), Some(&view), Some(centres)) = (&state.field, batch.first(), canonical) {
            let time_norm = scene.views[view].time_norm;
            if state.smooth {
                let seed = self.seed.child("smoothness").index(iteration as u64);
                let field = optimizer.field.as_ref();
                if let Some(term) = smoothness(field, &optimizer.context, centres.clone(), time_norm, train, progress, seed)? {
                    loss = loss + term;
                }
            }
            if let Some(term) = optimizer.field.regularizer(centres, time_norm, progress as f32)? {
                loss = loss + term;
            }
        }
        if read {
            log.loss(to_vec(loss.clone(), "loss")?.first().copied().unwrap_or(f32::NAN), stage, iteration)?;
        }

        let gradients = loss.backward();
        for (probe, radii, camera) in probes {
            if let Some(gradient) = probe.grad(&gradients) {
                state.stats.add_view(gradient, &radii, camera.width, camera.height, batch.len());
            }
        }
        let extent = f64::from(self.extent);
        let of_columns = leaves.iter().map(|leaf| leaf.grad(&gradients)).collect();
        drop(leaves);
        drop(gaussians);
        let visible = if train.sparse_adam { seen } else { None };
        if let Some(visible) = &visible
            && read
        {
            let shown = visible.clone().greater_elem(0).int().sum().into_scalar::<i64>().max(0) as u64;
            log.count_adam(shown, n as u64 - shown.min(n as u64));
        }
        let own: BTreeMap<String, f64> =
            state.field.iter().flat_map(|f| f.field.attributes()).map(|a| (a.name, if a.times_extent { a.lr * extent } else { a.lr })).collect();
        let rate = |name: &str| own.get(name).copied().unwrap_or_else(|| gaussian_rate(&train.lr, name, progress, extent));
        state.set.update(of_columns, rate, visible.as_ref())?;
        if features.is_some()
            && let Some(optimizer) = &mut state.field
        {
            optimizer.update(&gradients, progress, extent)?;
        }
        log.step(self.job.events, iteration, state.set.len());
        Ok(())
    }

    /// `time_norm` with the noise of `train.time_noise`.
    fn noisy_time(&self, time_norm: f32, progress: f64, iteration: usize, view: usize) -> f32 {
        let frames = self.job.config.train.time_noise * (1.0 - 2.0 * progress);
        let intervals = self.job.scene.frame_count.saturating_sub(1);
        if frames <= 0.0 || intervals == 0 {
            return time_norm;
        }
        let seed = self.seed.child("time noise").index(iteration as u64).index(view as u64);
        // Twelve uniforms make a normal number, near enough.
        let normal = (0..12u64).map(|k| (seed.index(k).value() >> 11) as f64 / (1u64 << 53) as f64).sum::<f64>() - 6.0;
        (f64::from(time_norm) + normal * frames / intervals as f64).clamp(0.0, 1.0) as f32
    }

    /// At a quarter and at half of the main stage, when motion has taken shape: measure flicker, and switch smoothness on if the scene needs it.
    fn decide_smoothness(&self, state: &mut TrainState, iteration: usize, moving: usize) -> Result<()> {
        let train = &self.job.config.train;
        if train.lambda_r <= 0.0 || state.smooth || state.stage != Stage::Main || moving == 0 {
            return Ok(());
        }
        if !train.smooth_auto {
            state.smooth = true;
            return Ok(());
        }
        let length = self.schedule.length(Stage::Main);
        if ![4, 2].iter().any(|&share| length >= share && iteration == length / share) {
            return Ok(());
        }
        let rows = state.moving_rows(&self.device)?;
        let Some(optimizer) = &state.field else { return Ok(()) };
        let measured = flicker(optimizer.field.as_ref(), rows.select(state.set.columns[0].value.clone()), self.job.scene.frame_count)?;
        state.smooth = measured > train.flicker_threshold;
        if state.smooth {
            let message = format!("flicker {measured:.3} is over train.flicker_threshold {}: smoothness switched on", train.flicker_threshold);
            self.job.events.emit(&Event::Warning { object: "smoothness".into(), message });
        }
        Ok(())
    }
}

/// Gathers numbers between two log events.
pub(crate) struct Log {
    stage: Stage,
    length: usize,
    every: usize,
    loss: f32,
    psnr_db: f32,
    psnr_sum: (f32, u32),
    since: (Instant, usize),
    work: [(u64, u64); 3],
}

impl Log {
    pub(crate) fn new(stage: Stage, length: usize, every: usize) -> Self {
        Self { stage, length, every: every.max(1), loss: 0.0, psnr_db: 0.0, psnr_sum: (0.0, 0), since: (Instant::now(), 0), work: [(0, 0); 3] }
    }
    /// Whether this iteration's numbers are read back.
    pub(crate) fn due(&self, iteration: usize) -> bool {
        iteration.is_multiple_of(self.every) || iteration == self.length
    }
    pub(crate) fn psnr(&mut self, psnr_db: f32) {
        self.psnr_sum.0 += psnr_db;
        self.psnr_sum.1 += 1;
    }
    pub(crate) fn loss(&mut self, loss: f32, stage: Stage, iteration: usize) -> Result<()> {
        if !loss.is_finite() {
            return Err(Error::backend(
                format!("loss of stage {} at iteration {iteration}", stage.name()),
                format!("it is {loss}"),
                "Lower the learning rates (train.lr) or resume from the last checkpoint with another seed",
            ));
        }
        self.loss = if self.loss == 0.0 { loss } else { 0.9 * self.loss + 0.1 * loss };
        Ok(())
    }
    fn count_field(&mut self, decoded: u64, reused: u64, moved: u64, still: u64) {
        self.work[0].0 += decoded;
        self.work[0].1 += reused;
        self.work[1].0 += moved;
        self.work[1].1 += still;
    }
    fn count_adam(&mut self, updated: u64, skipped: u64) {
        self.work[2].0 += updated;
        self.work[2].1 += skipped;
    }
    pub(crate) fn step(&mut self, events: &dyn EventSink, iteration: usize, gaussians: usize) {
        if !self.due(iteration) {
            return;
        }
        if self.psnr_sum.1 > 0 {
            let psnr = self.psnr_sum.0 / self.psnr_sum.1 as f32;
            self.psnr_db = if self.psnr_db == 0.0 { psnr } else { 0.9 * self.psnr_db + 0.1 * psnr };
            self.psnr_sum = (0.0, 0);
        }
        let steps = (iteration - self.since.1.min(iteration)).max(1);
        let ms = self.since.0.elapsed().as_secs_f32() * 1000.0 / steps as f32;
        self.since = (Instant::now(), iteration);
        let stage = self.stage.name().to_string();
        events.emit(&Event::Iteration { stage, iteration, of: self.length, loss: self.loss, psnr_db: self.psnr_db, gaussians, ms });
    }
    /// Tells the counted work of the stage.
    pub(crate) fn finish(&self, events: &dyn EventSink) {
        let names = ["vertices decoded", "Gaussians deformed", "Gaussians in Adam (sampled)"];
        for (name, (done, skipped)) in names.into_iter().zip(self.work) {
            if done + skipped > 0 {
                events.emit(&Event::Work { stage: self.stage.name().into(), counter: name.into(), done, skipped });
            }
        }
    }
}
