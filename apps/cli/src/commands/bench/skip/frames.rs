//! Frames with something switched off.

use super::super::{Spread, WARM_UP};
use super::{EARLY_OUTS, LeftOut, REUSE, SHARES_VERTICES, Switch, available, digest};
use crate::commands::Context;
use crate::interrupt;
use burn::tensor::Device;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, Event, EventSink, Result};
use cc4dgs_play::Model;
use cc4dgs_play::player::{FrameTime, PlayShortcuts, Player};
use cc4dgs_train::sweep::PeakMemory;
use serde::Serialize;
use std::ops::Range;

/// Planes of a rendered image, and those of its colours, which come first.
const PLANES: usize = 5;
const COLOURS: usize = 3;
/// Memory for the images of a turn that others are compared with; there is at least one.
const COMPARED_BYTES: usize = 256 << 20;

/// Playback with something switched off.
#[derive(Serialize)]
pub struct FrameRow {
    pub off: &'static str,
    /// The first frame of each turn, which computes the spatial features.
    pub first_field: Spread,
    pub first_frame: Spread,
    /// Later frames.
    pub field: Spread,
    pub raster: Spread,
    pub frame: Spread,
    /// Over the frame with nothing switched off.
    pub ratio: f64,
    /// All frames played once: the median of the first frames, and all measured later ones but one.
    pub total_field_ms: f64,
    pub total_frame_ms: f64,
    /// Resident memory of the process, MB (10^6 bytes): before a turn, and at most during it. Of the turn with the smallest peak, because memory that another
    /// case freed may still be resident. Includes the scene and the images to compare with, not the memory of a graphics card. `None` where the system cannot
    /// tell.
    pub memory_before_mb: Option<f64>,
    pub peak_memory_mb: Option<f64>,
    /// Largest difference of a colour (0 to 1) from the images with everything switched off. Of each turn as many images are compared as fit in
    /// `COMPARED_BYTES`. In JSON null where it is no finite number.
    pub largest_difference: f32,
    /// Whether all images, first ones too, are the same bits as with nothing switched off.
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

/// Milliseconds of frames.
#[derive(Default)]
struct Times {
    field: Vec<f64>,
    raster: Vec<f64>,
    frame: Vec<f64>,
}

impl Times {
    fn note(&mut self, time: FrameTime) {
        self.field.push(time.field_ms);
        self.raster.push(time.raster_ms);
        self.frame.push(time.field_ms + time.raster_ms);
    }
}

/// Resident memory of the process in one turn, MB.
struct Resident {
    before_mb: f64,
    peak_mb: f64,
}

struct Case {
    off: &'static str,
    work: Work,
    /// The first frame of each turn.
    first: Times,
    later: Times,
    /// Of each turn, where the system tells.
    memory: Vec<Resident>,
    largest_difference: f32,
    same_bits: bool,
}

impl Case {
    fn new(off: &'static str, work: Work) -> Self {
        Self { off, work, first: Times::default(), later: Times::default(), memory: Vec::new(), largest_difference: 0.0, same_bits: true }
    }
    /// Notes how far `colours` are from those `expected`.
    fn compare(&mut self, colours: &[f32], expected: &[f32]) {
        let found = largest_difference(colours, expected);
        if found.total_cmp(&self.largest_difference).is_gt() {
            self.largest_difference = found;
        }
    }
    /// `usual_ms` is the frame with nothing switched off.
    fn row(self, usual_ms: f64) -> FrameRow {
        let Self { off, first, later, memory, largest_difference, same_bits, .. } = self;
        let (first_field, first_frame) = (Spread::of(first.field), Spread::of(first.frame));
        let (total_field_ms, total_frame_ms) = (total(first_field, &later.field), total(first_frame, &later.frame));
        let memory = memory.into_iter().min_by(|a, b| a.peak_mb.total_cmp(&b.peak_mb));
        let frame = Spread::of(later.frame);
        FrameRow {
            off,
            first_field,
            first_frame,
            field: Spread::of(later.field),
            raster: Spread::of(later.raster),
            frame,
            ratio: frame.median_ms / usual_ms,
            total_field_ms,
            total_frame_ms,
            memory_before_mb: memory.as_ref().map(|m| m.before_mb),
            peak_memory_mb: memory.as_ref().map(|m| m.peak_mb),
            largest_difference,
            same_bits,
        }
    }
}

/// Milliseconds of all frames played once: a first one, and all later ones but one.
fn total(first: Spread, later: &[f64]) -> f64 {
    first.median_ms + later.iter().skip(1).sum::<f64>()
}

/// 0 for the same bits; NaN where a value is NaN in one of them.
fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    let differences = a.iter().zip(b).map(|(a, b)| if a.to_bits() == b.to_bits() { 0.0 } else { (a - b).abs() });
    differences.max_by(f32::total_cmp).unwrap_or(0.0)
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
        let mut cases = vec![Case::new("nothing", usual)];
        let mut all = usual;
        for Switch { name, off, .. } in available("frames", self.switches(model, fixed), left_out) {
            let mut work = usual;
            off(&mut work);
            off(&mut all);
            cases.push(Case::new(name, work));
        }
        cases.push(Case::new("all", all));

        let (section, stop) = (model.rasterizer.clone(), interrupt::stop_flag()?);
        let turn = self.frames.div_ceil(self.rounds.max(1)).max(1);
        for (round, first) in (0..self.frames).step_by(turn).enumerate() {
            let turn = first..self.frames.min(first + turn);
            // The case with everything off comes first, because the others are compared with its images. The others change direction each time, because memory
            // that one of them freed may still be resident in the next.
            let mut order: Vec<usize> = (0..cases.len()).collect();
            if round % 2 == 1 {
                order.reverse();
            } else {
                order.rotate_right(1);
            }
            let mut expected = Vec::new();
            let mut digests = vec![Vec::new(); cases.len()];
            for index in order {
                interrupt::check(stop, "measuring; nothing was written")?;
                let case = &mut cases[index];
                self.prepare(model, &case.work, fixed.is_none())?;
                digests[index] = self.turn(model, case, turn.clone(), &mut expected)?;
            }
            for (case, found) in cases.iter_mut().zip(&digests) {
                case.same_bits &= *found == digests[0];
            }
            self.events.emit(&Event::Progress { task: "bench frames".into(), done: turn.end as u64, total: self.frames as u64 });
        }
        self.prepare(model, &usual, false)?;
        model.rasterizer = section;
        let usual_ms = Spread::of(cases[0].later.frame.clone()).median_ms.max(1e-9);
        Ok(cases.into_iter().map(|case| case.row(usual_ms)).collect())
    }
    fn switches(&self, model: &Model, fixed: Option<&str>) -> Vec<FrameSwitch> {
        let no_deformer = model.field.is_none().then(|| "the model has no deformer".to_string());
        let no_vertices = match &model.field {
            None => no_deformer.clone(),
            Some(field) if self.shares_vertices(field.name()) => None,
            Some(field) => Some(format!("the deformer {} decodes no vertices", field.name())),
        };
        let fixed = fixed.map(str::to_string);
        let switch = |name, off: fn(&mut Work), missing: &Option<String>| Switch { name, off, missing: missing.clone() };
        vec![
            switch("static gating", |w| w.play.static_gating = false, &no_deformer),
            switch("feature cache", |w| w.play.feature_cache = false, &no_deformer),
            // With a cache, vertices are decoded for the first frame alone.
            switch("vertex reuse", |w| w.vertex_reuse = false, &no_vertices),
            switch("feature cache, vertex reuse", |w| (w.play.feature_cache, w.vertex_reuse) = (false, false), &no_vertices),
            switch("opacity early out", |w| w.early_outs[0] = false, &fixed),
            switch("transmittance early out", |w| w.early_outs[1] = false, &fixed),
        ]
    }
    /// Whether the deformer `name` decodes vertices that several Gaussians share. A playback layer instead of a deformer is no plug-in and decodes none.
    fn shares_vertices(&self, name: &str) -> bool {
        self.context.registry.deformer(name).is_ok_and(|plugin| plugin.info.capabilities.contains(&SHARES_VERTICES))
    }
    fn player<'m>(&self, model: &'m Model, case: &Case) -> Result<Player<'m>> {
        Ok(Player::with_shortcuts(model, &self.context.registry, self.device, case.work.play)?.on(self.background))
    }
    /// Images of a turn that others are compared with.
    fn compared(&self) -> usize {
        let pixels = self.moments.iter().map(|(camera, _)| camera.width as usize * camera.height as usize).max().unwrap_or(0);
        (COMPARED_BYTES / (pixels * COLOURS * size_of::<f32>()).max(1)).max(1)
    }
    /// Draws a first frame and the frames `turn` and notes their times, and the memory that it took. The colours of the images are compared with those
    /// `expected`, or kept there if there are none yet. Returns a digest of each image.
    fn turn(&self, model: &Model, case: &mut Case, turn: Range<usize>, expected: &mut Vec<Vec<f32>>) -> Result<Vec<u64>> {
        let moment = |frame: usize| &self.moments[frame % self.moments.len()];
        let (camera, time_norm) = moment(turn.start);
        if turn.start == 0 {
            // Compiles the kernels. The features are dropped with the player, so that the first frame computes them.
            self.player(model, case)?.render(camera, *time_norm)?;
        }
        let memory = PeakMemory::begin();
        let before_mb = memory.mb();
        let mut player = self.player(model, case)?;
        let (output, time) = player.render(camera, *time_norm)?;
        case.first.note(time);
        let mut digests = vec![digest(&to_vec(output.planes, "planes")?)];
        for _ in 1..WARM_UP {
            player.render(camera, *time_norm)?;
        }
        let compared = self.compared();
        for (nth, frame) in turn.enumerate() {
            let (camera, time_norm) = moment(frame);
            let (output, time) = player.render(camera, *time_norm)?;
            case.later.note(time);
            let planes = to_vec(output.planes, "planes")?;
            digests.push(digest(&planes));
            let colours = &planes[..planes.len() / PLANES * COLOURS];
            match expected.get(nth) {
                Some(image) => case.compare(colours, image),
                None if nth < compared => expected.push(colours.to_vec()),
                None => (),
            }
        }
        case.memory.extend(before_mb.zip(memory.mb()).map(|(before_mb, peak_mb)| Resident { before_mb, peak_mb: before_mb.max(peak_mb) }));
        Ok(digests)
    }
    /// Gives the model the rasterizer and the deformer of a case; weights stay. `early_outs` says whether the rasterizer has the settings.
    fn prepare(&self, model: &mut Model, work: &Work, early_outs: bool) -> Result<()> {
        if early_outs {
            model.rasterizer.extend(EARLY_OUTS.iter().zip(work.early_outs).map(|(name, on)| (name.to_string(), on.into())));
        }
        let Some(deformer) = &mut model.field else { return Ok(()) };
        if !self.shares_vertices(deformer.name()) {
            return Ok(());
        }
        deformer.section.insert(REUSE.into(), work.vertex_reuse.into());
        let mut built = self.context.registry.build_deformer(&deformer.section, &deformer.context, self.device)?;
        for (new, old) in built.parameters_mut().into_iter().zip(deformer.field.parameters()) {
            new.value = old.value.clone();
        }
        built.set_progress(1.0);
        deformer.field = built;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_of_the_bits_and_nan_is_the_largest() {
        assert_eq!(largest_difference(&[0.5, 1.0, 0.25], &[0.5, 0.75, 0.25]), 0.25);
        assert_eq!(largest_difference(&[f32::NAN, f32::INFINITY], &[f32::NAN, f32::INFINITY]), 0.0);
        assert!(largest_difference(&[f32::NAN, 1.0], &[0.0, 0.0]).is_nan());
        let work = Work { play: PlayShortcuts::default(), vertex_reuse: true, early_outs: [true; 2] };
        let mut case = Case::new("nothing", work);
        case.compare(&[f32::NAN], &[0.0]);
        case.compare(&[1.0], &[0.0]);
        assert!(case.row(1.0).largest_difference.is_nan());
    }

    #[test]
    fn a_row_has_first_frames_and_the_smallest_peak() {
        let work = Work { play: PlayShortcuts::default(), vertex_reuse: true, early_outs: [true; 2] };
        let mut case = Case::new("nothing", work);
        [50.0, 70.0].into_iter().for_each(|field_ms| case.first.note(FrameTime { field_ms, raster_ms: 4.0 }));
        [1.0, 2.0, 3.0].into_iter().for_each(|field_ms| case.later.note(FrameTime { field_ms, raster_ms: 4.0 }));
        case.memory.extend([(40.0, 90.0), (30.0, 80.0)].map(|(before_mb, peak_mb)| Resident { before_mb, peak_mb }));
        let row = case.row(3.0);
        assert_eq!((row.first_field.median_ms, row.first_frame.median_ms), (60.0, 64.0));
        assert_eq!((row.field.median_ms, row.frame.median_ms, row.ratio), (2.0, 6.0, 2.0));
        assert_eq!((row.total_field_ms, row.total_frame_ms), (60.0 + 2.0 + 3.0, 64.0 + 6.0 + 7.0));
        assert_eq!((row.memory_before_mb, row.peak_memory_mb), (Some(30.0), Some(80.0)));
    }
}
