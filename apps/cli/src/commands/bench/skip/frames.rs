//! Frames with something switched off.

use super::super::{Spread, WARM_UP};
use super::{EARLY_OUTS, LeftOut, REUSE, SHARES_VERTICES, Switch, available, digest};
use crate::commands::Context;
use crate::interrupt;
use burn::tensor::Device;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, Event, EventSink, Result};
use cc4dgs_play::Model;
use cc4dgs_play::player::{PlayShortcuts, Player};
use serde::Serialize;

/// Playback with something switched off.
#[derive(Serialize)]
pub struct FrameRow {
    pub off: &'static str,
    pub field: Spread,
    pub raster: Spread,
    pub frame: Spread,
    /// Over the frame with nothing switched off.
    pub ratio: f64,
    /// Whether all images are the same bits as with nothing switched off.
    pub same_bits: bool,
}

/// What a frame may go without.
#[derive(Clone, Copy)]
struct Work {
    play: PlayShortcuts,
    vertex_reuse: bool,
    /// By [`EARLY_OUTS`].
    early_outs: [bool; 2],
}

/// How a case goes without something.
type FrameSwitch = Switch<fn(&mut Work)>;

struct Case {
    off: &'static str,
    work: Work,
    /// Field, rasterizer, and both: milliseconds of each frame.
    times: [Vec<f64>; 3],
    same_bits: bool,
}

pub struct FrameBench<'a> {
    pub context: &'a Context<'a>,
    pub device: &'a Device,
    pub background: Option<[f32; 3]>,
    pub moments: &'a [(Camera, f32)],
    /// Frames measured per case.
    pub frames: usize,
    /// Turns of each case.
    pub rounds: usize,
    pub events: &'a dyn EventSink,
}

impl FrameBench<'_> {
    /// A row per case. `fixed` says why the rasterizer's early outs cannot be switched off. The model is as before afterwards.
    pub fn run(&self, model: &mut Model, fixed: Option<&str>, left_out: &mut Vec<LeftOut>) -> Result<Vec<FrameRow>> {
        let usual = Work { play: PlayShortcuts::default(), vertex_reuse: true, early_outs: [true; 2] };
        let mut cases = vec![Case { off: "nothing", work: usual, times: Default::default(), same_bits: true }];
        let mut all = usual;
        for Switch { name, off, .. } in available("frames", self.switches(model, fixed)?, left_out) {
            let mut work = usual;
            off(&mut work);
            off(&mut all);
            cases.push(Case { off: name, work, times: Default::default(), same_bits: true });
        }
        cases.push(Case { off: "all", work: all, times: Default::default(), same_bits: true });

        let (section, stop) = (model.rasterizer.clone(), interrupt::stop_flag()?);
        let turn = self.frames.div_ceil(self.rounds.max(1)).max(1);
        let mut expected = Vec::with_capacity(self.frames);
        for first in (0..self.frames).step_by(turn) {
            let turn = first..self.frames.min(first + turn);
            for (index, case) in cases.iter_mut().enumerate() {
                interrupt::check(stop, "measuring; nothing was written")?;
                self.prepare(model, &case.work, fixed.is_none())?;
                let found = self.turn(model, case, turn.clone())?;
                if index == 0 {
                    expected.extend(found);
                } else {
                    case.same_bits &= found == expected[turn.clone()];
                }
            }
            self.events.emit(&Event::Progress { task: "bench frames".into(), done: turn.end as u64, total: self.frames as u64 });
        }
        self.prepare(model, &usual, false)?;
        model.rasterizer = section;
        let usual_ms = Spread::of(cases[0].times[2].clone()).median_ms.max(1e-9);
        let row = |Case { off, times, same_bits, .. }: Case| {
            let [field, raster, frame] = times.map(Spread::of);
            FrameRow { off, field, raster, frame, ratio: frame.median_ms / usual_ms, same_bits }
        };
        Ok(cases.into_iter().map(row).collect())
    }
    fn switches(&self, model: &Model, fixed: Option<&str>) -> Result<Vec<FrameSwitch>> {
        let no_deformer = model.field.is_none().then(|| "the model has no deformer".to_string());
        let no_vertices = match &model.field {
            None => no_deformer.clone(),
            Some(field) if self.context.registry.deformer(field.name())?.info.capabilities.contains(&SHARES_VERTICES) => None,
            Some(field) => Some(format!("the deformer {} decodes no vertices", field.name())),
        };
        let fixed = fixed.map(str::to_string);
        let switch = |name, off: fn(&mut Work), missing: &Option<String>| Switch { name, off, missing: missing.clone() };
        Ok(vec![
            switch("static gating", |w| w.play.static_gating = false, &no_deformer),
            switch("feature cache", |w| w.play.feature_cache = false, &no_deformer),
            // With a cache, vertices are decoded before the first frame and never again.
            switch("feature cache, vertex reuse", |w| (w.play.feature_cache, w.vertex_reuse) = (false, false), &no_vertices),
            switch("opacity early out", |w| w.early_outs[0] = false, &fixed),
            switch("transmittance early out", |w| w.early_outs[1] = false, &fixed),
        ])
    }
    /// Draws the frames `turn` and notes their times. Returns a digest of each image.
    fn turn(&self, model: &Model, case: &mut Case, turn: std::ops::Range<usize>) -> Result<Vec<u64>> {
        let mut player = Player::with_shortcuts(model, &self.context.registry, self.device, case.work.play)?.on(self.background);
        let moment = |frame: usize| &self.moments[frame % self.moments.len()];
        for _ in 0..WARM_UP {
            let (camera, time_norm) = moment(turn.start);
            player.render(camera, *time_norm)?;
        }
        let mut found = Vec::with_capacity(turn.len());
        for frame in turn {
            let (camera, time_norm) = moment(frame);
            let (output, time) = player.render(camera, *time_norm)?;
            found.push(digest(&to_vec(output.planes, "planes")?));
            for (list, ms) in case.times.iter_mut().zip([time.field_ms, time.raster_ms, time.field_ms + time.raster_ms]) {
                list.push(ms);
            }
        }
        Ok(found)
    }
    /// Gives the model the rasterizer and the deformer of a case; weights stay. `early_outs` says whether the rasterizer has the settings.
    fn prepare(&self, model: &mut Model, work: &Work, early_outs: bool) -> Result<()> {
        if early_outs {
            model.rasterizer.extend(EARLY_OUTS.iter().zip(work.early_outs).map(|(name, on)| (name.to_string(), on.into())));
        }
        let Some(deformer) = &mut model.field else { return Ok(()) };
        let registry = &self.context.registry;
        if !registry.deformer(deformer.name())?.info.capabilities.contains(&SHARES_VERTICES) {
            return Ok(());
        }
        deformer.section.insert(REUSE.into(), work.vertex_reuse.into());
        let mut built = registry.build_deformer(&deformer.section, &deformer.context, self.device)?;
        for (new, old) in built.parameters_mut().into_iter().zip(deformer.field.parameters()) {
            new.value = old.value.clone();
        }
        built.set_progress(1.0);
        deformer.field = built;
        Ok(())
    }
}
