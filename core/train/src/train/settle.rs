//! Gaussians that the deformer hardly moves are made static during the main stage, so that neither training nor playback pays for them.
//!
//! Scores say what may move before any motion is known. They err on the safe side: a floor that somebody walks over is seen to change.

use super::{Context, TrainState};
use crate::sample::spread_views;
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, DensityPlan, Event, Result, Schedule, Split, Stage, plural};
use cc4dgs_play::Moving;

/// When it is looked at: shares of the main stage.
const SHARES: [f64; 2] = [1.0 / 3.0, 2.0 / 3.0];
/// The most times over the sequence, and training cameras, at which motion is looked at: of more frames than that, every few.
const TIMES: usize = 64;
const CAMERAS: usize = 24;
/// Changes of other attributes up to this do not count: logarithms of scales, shares of them, components of quaternions, logits, colour coefficients.
const LEAST_CHANGE: f32 = 0.03;
/// Least depth of a Gaussian in front of a camera, in units of the normalised frame.
const LEAST_DEPTH: f64 = 0.05;

impl Context<'_> {
    /// Makes Gaussians static that move by less than `train.settle` pixels in every training camera, when the iteration is due, and all frames are trained on.
    pub(crate) fn settle(&self, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        let most_px = self.job.config.train.settle;
        let Moving::Scored { zeta } = state.moving else { return Ok(()) };
        if most_px <= 0.0 || schedule.stage != Stage::Main || !is_due(schedule, self.time_ramp()) {
            return Ok(());
        }
        let rows = state.moving_rows(&self.device)?;
        let Some(deformer) = state.deformer.as_ref().filter(|d| !d.field.is_static() && rows.count() > 0) else { return Ok(()) };
        let features = deformer.field.spatial(&state.spatial_input(deformer, &rows)?)?.values;
        let (mut shift, mut change) = (vec![0.0f32; rows.count()], vec![0.0f32; rows.count()]);
        let times = self.job.scene.frame_count.clamp(2, TIMES);
        let scales = rows.select(state.set.get("log_scales")?.clone()).exp();
        for k in 0..times {
            let mut offsets = deformer.field.deform(features.clone(), k as f32 / (times - 1) as f32)?;
            // In units of the world; what counts is the share of the Gaussian's own size.
            offsets.scales = offsets.scales.map(|changes| changes / scales.clone());
            if let Some(means) = offsets.means.take() {
                raise(&mut shift, &to_vec((means.clone() * means).sum_dim(1).sqrt(), "offsets")?);
            }
            if let Some(others) = offsets.concatenated() {
                raise(&mut change, &to_vec(others.abs().max_dim(1), "offsets")?);
            }
        }
        let mut scores = to_vec(state.set.get("dynamic_scores")?.clone(), "dynamic_scores")?;
        let means = to_vec(state.set.get("means")?.clone(), "means")?;
        let scene = &self.job.scene;
        let cameras: Vec<&Camera> = spread_views(scene, &scene.split(Split::Train), CAMERAS).into_iter().map(|view| scene.camera(view)).collect();
        let moving = state.moving.rows(&scores).unwrap_or_default();
        let mut settled = 0;
        for (k, &row) in moving.iter().enumerate() {
            let mean = [0, 1, 2].map(|axis| f64::from(means[3 * row + axis]));
            let px = cameras.iter().map(|camera| f64::from(shift[k]) * pixels_per_unit(camera, mean)).fold(0.0, f64::max);
            if px < f64::from(most_px) && change[k] < LEAST_CHANGE {
                scores[row] = scores[row].min(zeta);
                settled += 1;
            }
        }
        // Where all qualify, the deformer has not learned any motion yet.
        if settled == 0 || settled == moving.len() {
            return Ok(());
        }
        let [moves, stand] = [plural(settled, "moves", "move"), plural(settled, "it stands", "they stand")];
        let message = format!("{settled} of {} moving Gaussians {moves} by less than {most_px} pixels: {stand} still from now on", moving.len());
        self.job.events.emit(&Event::Note { object: "deformer".into(), message });
        let count = scores.len();
        state.set.set("dynamic_scores", Tensor::from_data(TensorData::new(scores, [count, 1]), &self.device))?;
        state.invalidate_rows();
        // What moves stays in one piece: gathering and scattering it is slow on graphics cards.
        let mut plan = DensityPlan::unchanged(count);
        self.guard_plan(&mut plan, state, schedule)?;
        if !plan.keeps_all(count) {
            self.carry_out(&plan, state, schedule)?;
            state.density.executed(&plan, &self.device)?;
        }
        Ok(())
    }
}

/// Whether it is looked at after this iteration of the main stage: not before the share `time_ramp`, because what moves in frames that have not come in yet
/// seems to stand still.
fn is_due(schedule: &Schedule, time_ramp: f64) -> bool {
    SHARES.iter().any(|&share| share > time_ramp && schedule.iteration == schedule.iteration_at(share) as usize)
}

/// Raises each of `most` to the value beside it.
fn raise(most: &mut [f32], values: &[f32]) {
    most.iter_mut().zip(values).for_each(|(m, v)| *m = m.max(*v));
}

/// Pixels of `camera` that a unit of length covers at `mean`; 0 behind it.
fn pixels_per_unit(camera: &Camera, mean: [f64; 3]) -> f64 {
    let row = &camera.world_to_camera[2];
    let depth = row[0] * mean[0] + row[1] * mean[1] + row[2] * mean[2] + row[3];
    if depth < LEAST_DEPTH { 0.0 } else { camera.fx.max(camera.fy) / depth }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::TrainConfig;
    use crate::schedule::StageLengths;

    #[test]
    fn a_main_stage_is_looked_at_twice_whatever_its_length_becomes() {
        let due = |image_growth: f64, stretch: f64| -> Vec<usize> {
            let lengths = StageLengths::new(&TrainConfig { iterations: 2800, image_growth, stretch, ..Default::default() }, true, 1.0);
            (1..=lengths.length(Stage::Main)).filter(|&iteration| is_due(&lengths.schedule(Stage::Main, iteration), 0.0)).collect()
        };
        assert_eq!(due(0.0, 1.0), [666, 1333]);
        // The length is settled after 400 iterations, in the second case after 1,200 of the 2,000 that were planned.
        assert_eq!(due(0.0, 4.0).len(), 2);
        assert_eq!((due(0.6, 2.0).len(), due(0.6, 2.0)[0]), (2, 666));
        for length in 3..3000 {
            let thirds = (1..=length).filter(|&iteration| is_due(&Schedule { iteration, ..Schedule::main(length) }, 0.0));
            assert!(thirds.eq([length / 3, 2 * length / 3]), "{length}");
        }
        // All frames are there after two fifths.
        let due: Vec<usize> = (1..=900).filter(|&iteration| is_due(&Schedule { iteration, ..Schedule::main(900) }, 0.4)).collect();
        assert_eq!(due, [600]);
    }

    #[test]
    fn pixels_fall_with_depth() {
        let camera = Camera::look_at("a", (100, 100), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        assert!((pixels_per_unit(&camera, [0.0; 3]) - camera.fx / 4.0).abs() < 1e-9);
        assert_eq!(pixels_per_unit(&camera, [0.0, 0.0, -5.0]), 0.0);
        let mut most = vec![1.0, 2.0];
        raise(&mut most, &[3.0, f32::NAN]);
        assert_eq!(most, [3.0, 2.0]);
    }
}
