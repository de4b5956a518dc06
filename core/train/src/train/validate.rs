//! The curve of validation: views that are kept out of training are scored from time to time.

use super::{Context, TrainState};
use crate::sample::spread_views;
use cc4dgs_core::{Event, Result, Schedule, Split, Stage};

/// Scores of a coarse and of a main stage, at equal distances.
const SCORES: [usize; 2] = [4, 20];
/// The most views of a score.
const VIEWS: usize = 8;

impl Context<'_> {
    /// Emits an [`Event::Validated`] when the iteration is due and `train.validation` keeps views out of training. It changes nothing.
    pub(crate) fn validate(&self, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        let kept_out = self.job.config.train.validation;
        let scores = match schedule.stage {
            Stage::Coarse => SCORES[0],
            Stage::Main => SCORES[1],
            Stage::Score => return Ok(()),
        };
        let index = |iteration: usize| iteration * scores / schedule.length.max(1);
        if kept_out == 0 || index(schedule.iteration) == index(schedule.iteration - 1) {
            return Ok(());
        }
        let scene = &self.job.scene;
        let views = spread_views(scene, &spread_views(scene, &scene.split(Split::Validation), kept_out), VIEWS);
        if views.is_empty() {
            return Ok(());
        }
        let gaussians = state.set.gaussians()?;
        let psnr_db = self.mean_psnr(scene, state, &gaussians, &views, schedule.sh_degree)?;
        self.job.events.emit(&Event::Validated {
            stage: schedule.stage.name().into(),
            iteration: schedule.iteration,
            of: schedule.length,
            views: views.len(),
            psnr_db,
        });
        Ok(())
    }
}
