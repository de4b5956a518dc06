//! One stage of a run, iteration by iteration: which views it draws from, what the main stage begins and ends with, and checkpoints.

use super::log::Log;
use super::pace::Pace;
use super::record::LogRecord;
use super::sampler::{Prefetcher, Sampler};
use super::watchdog::Watchdog;
use super::{Context, TrainState};
use crate::checkpoint;
use crate::checks::Watch;
use crate::config::CoarseFrames;
use cc4dgs_core::{DeformerContext, Error, Event, Result, Schedule, Split, Stage, start_deformer};
use cc4dgs_play::Moving;
use cc4dgs_play::model::ModelDeformer;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::Ordering;
use std::time::Instant;

/// Whether `result` says that an image cannot be read.
fn is_lost_image<T>(result: &Result<T>) -> bool {
    matches!(result, Err(Error::Io { .. } | Error::Data { .. }))
}

impl Context<'_> {
    /// Runs `stage` from where `state` stands to its end.
    pub(super) fn run_stage(&mut self, stage: Stage, state: &mut TrainState, watch: &mut Watch) -> Result<()> {
        let events = self.job.events;
        if self.lengths.length(stage) == 0 || (stage == Stage::Score && self.masks.is_empty()) {
            if stage == Stage::Main {
                self.begin_main(state)?;
                self.warn_of_stillness(state)?;
            }
            return Ok(());
        }
        if state.iteration == 0 {
            if stage != Stage::Coarse {
                self.remove_broken(state)?;
                self.order_rows(state)?;
            }
            state.begin_stage(self.job.config.train.keep_moments, &self.device)?;
            if stage == Stage::Main {
                self.begin_main(state)?;
                // Images are read before anything is added: a run from here adds all of them.
                let added = self.add_key_frames(state);
                self.saved_before_error(added, state)?;
                self.warn_of_stillness(state)?;
                let scored = watch.before_main(self, state);
                self.saved_if_resumable(scored, state)?;
            }
        }
        let first = self.lengths.schedule(stage, state.iteration + 1);
        let mut length = first.length;
        events.emit(&Event::StageStarted { stage: stage.name().into(), iterations: length, gaussians: state.set.len() });
        let began = Instant::now();
        let mut sampler = self.sampler(&first);
        let mut pace = Pace::new(self, stage, state);
        let prefetcher = Prefetcher::new(self.losses.want_depth());
        let resumed_at = state.iteration;
        let mut watchdog = Watchdog::new(state);
        let mut log = Log::new(stage, length, self.job.config.train.log_every).resumed(state.record.log, resumed_at);
        // That of the state that the watchdog remembers.
        let mut log_of_good = log.record();
        // The iteration of the checkpoint on disk.
        let mut saved = resumed_at;
        while state.iteration < self.lengths.length(stage) {
            // A main stage that has begun and has no iteration would begin again, key frames included, when it is resumed.
            if (state.iteration > 0 || stage != Stage::Main) && self.job.stop.load(Ordering::Relaxed) {
                state.record.log = log.record();
                self.save(state)?;
                let at = format!("at iteration {} of stage {}", state.iteration, stage.name());
                return Err(Error::Interrupted(match &self.checkpoint {
                    Some(path) => format!("{at}; everything is in {}, --resume continues", path.display()),
                    None => at,
                }));
            }
            let schedule = self.lengths.schedule(stage, state.iteration + 1);
            if schedule.length != length {
                length = schedule.length;
                sampler = self.sampler(&schedule);
                log.set_length(length);
            }
            let batch = sampler.batch(state.iteration);
            // Scores are fitted to masks.
            if stage != Stage::Score {
                prefetcher.want(self.pyramid.at(schedule.image_scale), sampler.batch(state.iteration + 1));
            }
            let every = self.job.config.train.checkpoint_every;
            let saves = every > 0 && schedule.iteration.is_multiple_of(every) && schedule.iteration < self.lengths.length(stage);
            let check = watchdog.checks(schedule.iteration, length, saves);
            let log_before = log.record();
            let stepped = match stage {
                Stage::Score => self.score_step(state, &schedule, check, &mut log),
                _ => self.photometric_step(&schedule, state, &batch, check, &mut log),
            };
            if is_lost_image(&stepped) {
                // Nothing was learned from this iteration.
                state.record.log = log_before;
            }
            let trouble = self.saved_if_resumable(stepped, state)?;
            if trouble.is_none() {
                let changed = self.change_gaussians(state, &schedule);
                self.good_saved_before_error(changed, &watchdog, (log_of_good, saved), state)?;
            }
            state.iteration = schedule.iteration;
            watchdog.after_iteration(self, state, trouble, length, saves)?;
            if state.iteration < schedule.iteration {
                // Back at an earlier state.
                continue;
            }
            if let Some(timed) = &mut pace {
                let factor = timed.after_iteration(self, &schedule, state.set.len());
                if schedule.iteration >= self.lengths.settles_at() {
                    (pace, self.ends) = (None, None);
                }
                factor.map_or(Ok(()), |factor| self.stretch_main(factor))?;
            }
            let watched = watch.after_iteration(self, state, &schedule);
            if let Some(failure) = self.good_saved_before_error(watched, &watchdog, (log_of_good, saved), state)? {
                state.record.log = log.record();
                self.save(state)?;
                return Err(failure);
            }
            let validated = self.validate(state, &schedule);
            self.good_saved_before_error(validated, &watchdog, (log_of_good, saved), state)?;
            self.observe(state, &schedule, batch.len())?;
            if watchdog.remember(state, length) {
                log_of_good = log.record();
            }
            if saves {
                state.record.log = log.record();
                self.save(state)?;
                saved = state.iteration;
            }
        }
        log.finish(events);
        state.record.log = Default::default();
        state.record.attempts = Default::default();
        if stage == Stage::Main && state.iteration > resumed_at {
            self.simplify(state)?;
        }
        events.emit(&Event::StageFinished { stage: stage.name().into(), seconds: began.elapsed().as_secs_f64(), gaussians: state.set.len() });
        if stage == Stage::Score {
            let moving = state.moving_rows(&self.device)?.count() as u64;
            let all = state.set.len() as u64;
            events.emit(&Event::Work { stage: "score".into(), counter: "Gaussians that move".into(), done: moving, skipped: all - moving });
        }
        Ok(())
    }

    /// What follows the optimizer step of an iteration and changes which Gaussians there are, and which of them may move.
    fn change_gaussians(&self, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        if schedule.stage != Stage::Score {
            self.control_density(schedule, state)?;
        }
        self.settle(state, schedule)?;
        self.recover(state, schedule)
    }

    /// Which views the iterations of the stage of `schedule` see.
    pub(super) fn sampler(&self, schedule: &Schedule) -> Sampler {
        let (train, stage) = (&self.job.config.train, schedule.stage);
        let sampler = Sampler::new(self.stage_views(stage), self.seed.child(stage.name()).child("views"), train.views_per_iteration(stage));
        let ramp = self.time_ramp();
        if stage != Stage::Main || ramp == 0.0 {
            return sampler;
        }
        sampler.with_ramp(|share| schedule.iteration_at(share * ramp), |view| self.job.scene.views[view].time_norm)
    }

    /// The share of the main stage in which frames come in one after another, from the first on. 0 where the canonical space is not the first frame: only that
    /// can be left frame by frame.
    pub(super) fn time_ramp(&self) -> f64 {
        let all_at_once = self.stage_views(Stage::Coarse).len() == self.stage_views(Stage::Main).len();
        if all_at_once { 0.0 } else { self.job.config.train.time_ramp }
    }

    /// The training views a stage draws from.
    pub(super) fn stage_views(&self, stage: Stage) -> Vec<usize> {
        let scene = &self.job.scene;
        let all = scene.split(Split::Train);
        if stage != Stage::Coarse || self.job.config.train.coarse_frames == CoarseFrames::All {
            return all;
        }
        let mut counts: BTreeMap<usize, usize> = BTreeMap::new();
        all.iter().for_each(|&v| *counts.entry(scene.views[v].frame).or_default() += 1);
        // Single images of the first frames may be missing: the frame is the first that half of the cameras see.
        let most = counts.values().copied().max().unwrap_or(0);
        let first = counts.iter().find(|(_, count)| 2 * **count >= most).map_or(0, |(&frame, _)| frame);
        let of_first: Vec<usize> = all.iter().copied().filter(|&v| scene.views[v].frame == first).collect();
        // A single image says nothing of depth: one moving camera needs all of them.
        if of_first.len() >= 2 { of_first } else { all }
    }

    /// The deformer of a `[deformer]` section, over the box of `train.field_box` and started from what moves.
    pub(super) fn new_deformer(&self, state: &TrainState, section: toml::Table) -> Result<ModelDeformer> {
        let first = state.moving_gaussians()?;
        let [box_min, box_max] = self.job.config.train.field_box.corners(&first, || state.finite_gaussians(), &self.job.scene)?;
        let (frame_count, sh_degree) = (self.job.scene.frame_count, state.set.sh_degree);
        let context = DeformerContext { box_min, box_max, frame_count, sh_degree, seed: self.seed.child("field") };
        let field = self.job.registry.build_deformer(&section, &context, &self.device)?;
        let mut deformer = ModelDeformer { field, section, context };
        let name = deformer.name().to_string();
        start_deformer(&name, deformer.field.as_mut(), &first)?;
        Ok(deformer)
    }

    /// Builds the deformer, once the scores are known.
    fn begin_main(&self, state: &mut TrainState) -> Result<()> {
        let deformer = self.new_deformer(state, self.job.config.deformer.clone())?;
        state.set.add_attributes(&deformer.field.attributes(), self.seed.child("attributes"))?;
        state.deformer = Some(deformer);
        Ok(())
    }

    /// Warns where no Gaussian has a score to move, once key frames have added theirs.
    fn warn_of_stillness(&self, state: &mut TrainState) -> Result<()> {
        let may_move = state.moving != Moving::Nothing && state.deformer.as_ref().is_some_and(|deformer| !deformer.field.is_static());
        if may_move && state.moving_rows(&self.device)?.count() == 0 {
            let message = "no dynamic score is over train.zeta: the deformer is skipped".to_string();
            self.job.events.emit(&Event::Warning { object: "deformer".into(), message });
        }
        Ok(())
    }

    /// Leaves out what the trained deformer does not use. Not called again when a finished run is resumed.
    fn simplify(&self, state: &mut TrainState) -> Result<()> {
        let rows = state.moving_rows(&self.device)?;
        let Some(deformer) = state.deformer.as_ref().filter(|_| rows.count() > 0) else { return Ok(()) };
        let spatial = deformer.field.spatial(&state.spatial_input(deformer, &rows)?)?;
        let frames = self.job.scene.frame_count.max(2);
        let times: Vec<f32> = (0..frames).map(|f| f as f32 / (frames - 1) as f32).collect();
        let Some(simple) = deformer.field.simplified(spatial.values, &times)? else { return Ok(()) };
        let mut section = simple.settings;
        section.insert("kind".into(), deformer.name().into());
        self.job.events.emit(&Event::Note { object: "deformer".into(), message: simple.message });
        state.deformer = Some(ModelDeformer { field: simple.field, section, context: deformer.context.clone() });
        state.optimizer.restart("deformer/");
        Ok(())
    }

    /// `result`. Where it says that an image cannot be read, the checkpoint is written before, as an interruption does, unless nothing was learned yet. The
    /// run's own error counts, whatever becomes of it.
    pub(super) fn saved_before_error<T>(&self, result: Result<T>, state: &mut TrainState) -> Result<T> {
        let learned = state.iteration > 0 || (state.stage > Stage::Coarse && self.lengths.length(Stage::Coarse) > 0);
        if let Some(path) = self.checkpoint.as_ref().filter(|_| learned && is_lost_image(&result)) {
            let saved = self.save(state);
            self.warn_of_lost_image(path, saved, state.iteration, state.stage);
        }
        result
    }

    /// Warns that an image cannot be read, and says where the checkpoint `path` of an iteration is, or why it could not be written.
    fn warn_of_lost_image(&self, path: &Path, saved: Result<()>, iteration: usize, stage: Stage) {
        let at = format!("iteration {iteration} of stage {}", stage.name());
        let message = match saved {
            Ok(()) => format!("an image cannot be read; everything until {at} is in {}, --resume continues", path.display()),
            Err(error) => format!("an image cannot be read, and what was learned until {at} is lost: {error}"),
        };
        self.job.events.emit(&Event::Warning { object: "training".into(), message });
    }

    /// As [`Context::saved_before_error`], but for a main stage that has its key frames and no iteration: it would get them again when it is resumed.
    fn saved_if_resumable<T>(&self, result: Result<T>, state: &mut TrainState) -> Result<T> {
        let resumable = state.iteration > 0 || state.stage != Stage::Main || self.job.config.train.key_frames == 0;
        if resumable { self.saved_before_error(result, state) } else { result }
    }

    /// As [`Context::saved_before_error`], in the middle of an iteration: the checkpoint is that of the state that `watchdog` remembers, where the log was
    /// `log`, unless the one on disk, of the iteration `saved`, is newer.
    fn good_saved_before_error<T>(&self, result: Result<T>, watchdog: &Watchdog, (log, saved): (LogRecord, usize), state: &mut TrainState) -> Result<T> {
        if !is_lost_image(&result) || watchdog.return_to_good(self, state).is_err() {
            return result;
        }
        if let Some(path) = self.checkpoint.as_ref().filter(|_| state.iteration < saved) {
            self.warn_of_lost_image(path, Ok(()), saved, state.stage);
            return result;
        }
        state.record.log = log;
        self.saved_if_resumable(result, state)
    }

    /// Writes the checkpoint, where the run has a folder.
    pub(super) fn save(&self, state: &mut TrainState) -> Result<()> {
        self.remove_broken(state)?;
        let Some(path) = &self.checkpoint else { return Ok(()) };
        state.record.seconds_left = self.ends.map(|ends| ends.saturating_duration_since(Instant::now()).as_secs_f64());
        let bytes = checkpoint::save(path, state, &self.settings)?;
        self.job.events.emit(&Event::Saved { path: path.display().to_string(), bytes });
        Ok(())
    }
}
