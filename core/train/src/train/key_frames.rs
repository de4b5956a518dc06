//! Gaussians of key frames: what moves starts with a life at each of them, so that nothing has to be followed from the first frame to the last.

use super::density::least_added;
use super::parents::Parents;
use super::recover::own_lives;
use super::{Context, TrainState};
use crate::data::init::{KeyFrames, KeyPoint, LEAST_INTERVAL, limit_sizes_to};
use crate::init::{SH_C0, from_points};
use crate::masks::DynamicMask;
use cc4dgs_core::{Camera, DensityPlan, Event, HostGaussians, LIFE_ATTRIBUTES, PointCloud, Result, Stage, gate_value, plural};
use cc4dgs_play::Moving;
use cc4dgs_play::model::ModelDeformer;
use glam::Vec3;

/// How far a life reaches before its first and after its last key frame, and its falloff, as shares of the time to the next key frame there.
const REACH: f64 = 0.4;
const FALLOFF: f64 = 0.25;
/// Gates: of what is there for a while, and of what stays.
const TEMPORARY: f32 = 0.01;
const LASTING: f32 = 0.95;
/// Largest standard deviation of a new Gaussian, as a share of the width of the image: a point far from all others would cover much of each image.
const WIDTH_SHARE: f64 = 0.01;
/// Opacity of new Gaussians.
const OPACITY: f32 = 0.6;

impl Context<'_> {
    /// Adds the Gaussians of key frames at the start of the main stage, where `train.key_frames` asks for them, and gives what moved at the first frame a life
    /// there.
    pub(super) fn add_key_frames(&self, state: &mut TrainState) -> Result<()> {
        let (every, frames) = (self.job.config.train.key_frames, self.job.scene.frame_count);
        if every == 0 || frames <= 1 {
            return Ok(());
        }
        let warn = |message: String| self.job.events.emit(&Event::Warning { object: "train.key_frames".into(), message });
        if every >= frames {
            warn(format!("no key frame is used: {every} is not below the {frames} frames of the scene. Choose at most {}, or 0", frames - 1));
            return Ok(());
        }
        let (Moving::Scored { zeta }, false) = (state.moving, self.masks.is_empty()) else {
            warn("key frames need cameras that stand still and dynamic scores (train.dynamic = \"auto\" or \"score\"): none is used".into());
            return Ok(());
        };
        if state.deformer.as_ref().is_none_or(|deformer| own_lives(deformer) != LIFE_ATTRIBUTES.len()) {
            let name = state.deformer.as_ref().map_or("none", ModelDeformer::name);
            let message = format!("the Gaussians of '{name}' have no lives, so key frames add none: set deformer.life = true, or train.key_frames = 0");
            warn(message);
            return Ok(());
        }
        let seed = self.seed.child("key frames");
        // Points have to lie where the cameras that are trained with see them.
        let scene = &self.posed_scene(&self.job.scene, state)?;
        let mask_of = |camera: usize| self.masks.iter().find(|mask| scene.views[mask.view].camera == camera);
        let masks: Vec<Option<&DynamicMask>> = (0..scene.cameras.len()).map(mask_of).collect();
        let moves = |camera: usize, x: f32, y: f32| masks[camera].is_some_and(|mask| covers(mask, &scene.cameras[camera], x, y));
        let frames = match KeyFrames::load(scene, every, moves, self.job.config.train.mask_threshold, seed)? {
            Ok(frames) => frames,
            Err(reason) => {
                warn(format!("no key frame is used: {reason}"));
                return Ok(());
            }
        };
        let now = state.set.len();
        let count = self.most_added(now).unwrap_or_else(|| least_added(now));
        let points = frames.points(count, seed.child("motion"));
        let end = self.job.scene.views.iter().fold(0.0f32, |end, view| end.max(view.time_norm));
        let times = Times { keys: &frames.times, end: f64::from(end) };
        let mut plan = DensityPlan::unchanged(state.set.len());
        let host = state.set.host_gaussians()?;
        let temporary = self.lives_of_first_frame(&mut plan, &host, state, &frames, &times)?;
        let parents = Parents::new(&host, state.moving);
        let coefficients = state.set.get("sh_rest")?.dims()[1];
        let mut capped = 0;
        for key in 0..times.keys.len() {
            let own: Vec<&KeyPoint> = points.iter().filter(|p| p.key == key).collect();
            let cloud = PointCloud { positions: own.iter().map(|p| p.position.to_array()).collect(), colors: own.iter().map(|p| p.color).collect() };
            let mut start = from_points(&cloud, 0, OPACITY);
            capped += limit_sizes_to(scene, &mut start, WIDTH_SHARE);
            for (i, point) in own.into_iter().enumerate() {
                let row = parents.copy(&mut plan, times.position(point).to_array());
                plan.set(row, "log_scales", &start.log_scales[3 * i..3 * i + 3]);
                plan.set(row, "quaternions", &[1.0, 0.0, 0.0, 0.0]);
                plan.set(row, "opacity_logits", &start.opacity_logits[i..=i]);
                plan.set(row, "sh_dc", &start.sh_dc[3 * i..3 * i + 3]);
                if coefficients > 0 {
                    plan.set(row, "sh_rest", &vec![0.0; coefficients]);
                }
                plan.set(row, "dynamic_scores", &[2.0 * zeta + 1.0]);
                if frames.always(point) {
                    times.last(&mut plan, row);
                } else {
                    times.live(&mut plan, row, point);
                }
            }
        }
        plan.report.cloned = points.len();
        let (count, keys) = (points.len(), times.keys.len());
        let [noun, are] = [plural(count, "point", "points"), plural(temporary, "Gaussian of the first frame is", "Gaussians of the first frame are")];
        let message = format!("{count} {noun} of {keys} key frames, {capped} made smaller; {temporary} {are} there for a while");
        self.job.events.emit(&Event::Note { object: "key frames".into(), message });
        let schedule = self.lengths.schedule(Stage::Main, 0);
        plan.check("key frames", &state.set.gaussians()?)?;
        self.guard_plan(&mut plan, state, &schedule)?;
        self.carry_out(&plan, state, &schedule)?;
        state.density.executed(&plan, &self.device)?;
        // More moves now, in a larger box.
        if let Some(ModelDeformer { section, .. }) = state.deformer.take() {
            state.deformer = Some(self.new_deformer(state, section)?);
        }
        Ok(())
    }

    /// Sets the lives of the Gaussians that may move: of those that vanish, one at the first frame. Returns how many vanish.
    fn lives_of_first_frame(&self, plan: &mut DensityPlan, host: &HostGaussians, state: &TrainState, frames: &KeyFrames, times: &Times<'_>) -> Result<usize> {
        let rows = state.moving.rows(&host.dynamic_scores).unwrap_or_default();
        let mean = |row: usize| Vec3::from_slice(&host.means[3 * row..3 * row + 3]);
        let color = |row: usize| [0, 1, 2].map(|k| 0.5 + SH_C0 * host.sh_dc[3 * row + k]);
        let mut temporary = 0;
        let judged = frames.judge(rows.iter().map(|&row| (mean(row), color(row))).collect(), 0);
        for (row, judged) in rows.into_iter().zip(judged) {
            match judged {
                Some(point) if point.alive[1] + 1 < times.keys.len() => {
                    times.live(plan, row, &point);
                    temporary += 1;
                }
                _ => times.last(plan, row),
            }
        }
        Ok(temporary)
    }
}

/// Whether a mask of what moves covers a pixel of its camera, whose coordinates are shares of the image.
fn covers(mask: &DynamicMask, camera: &Camera, x: f32, y: f32) -> bool {
    let (w, h) = (camera.width as usize, camera.height as usize);
    let at = |share: f32, n: usize| ((share * n as f32) as usize).min(n - 1);
    mask.mask.get(at(y, h) * w + at(x, w)).is_some_and(|&moves| moves)
}

/// When the key frames are.
struct Times<'a> {
    /// The time of each, 0..1.
    keys: &'a [f64],
    /// The time of the last frame, which need not be a key frame.
    end: f64,
}

/// When a point is there, as shares of the sequence.
struct Life {
    center: f64,
    half_width: f64,
    falloff: f64,
}

impl Times<'_> {
    /// Time from a key frame to the one before it and to the one after it. The first and the last one have the same on both sides.
    fn intervals(&self, key: usize) -> [f64; 2] {
        let interval = |from: usize, to: usize| (self.keys[to] - self.keys[from]).max(LEAST_INTERVAL);
        let before = key.checked_sub(1).map(|earlier| interval(earlier, key));
        let after = (key + 1 < self.keys.len()).then(|| interval(key, key + 1));
        [before.or(after), after.or(before)].map(|time| time.unwrap_or(1.0))
    }
    /// When a point is there: what is there at the last key frame is there until the end.
    fn life(&self, point: &KeyPoint) -> Life {
        let [first, last] = point.alive.map(|key| self.keys[key]);
        let last = if point.alive[1] + 1 == self.keys.len() { last.max(self.end) } else { last };
        let (before, after) = (self.intervals(point.alive[0])[0], self.intervals(point.alive[1])[1]);
        let (from, to) = (first - REACH * before, last + REACH * after);
        Life { center: 0.5 * (from + to), half_width: 0.5 * (to - from), falloff: FALLOFF * 0.5 * (before + after) }
    }
    /// Where a point is in the middle of its life.
    fn position(&self, point: &KeyPoint) -> Vec3 {
        point.position + point.velocity * (self.life(point).center - self.keys[point.key]) as f32
    }
    /// Gives a row the life and the velocity of a point.
    fn live(&self, plan: &mut DensityPlan, row: usize, point: &KeyPoint) {
        let life = self.life(point);
        plan.set(row, "life_center", &[life.center as f32]);
        plan.set(row, "life_log_half_width", &[life.half_width.ln() as f32]);
        plan.set(row, "life_log_falloff", &[life.falloff.ln() as f32]);
        plan.set(row, "life_gate", &[gate_value(TEMPORARY)]);
        plan.set(row, "velocity", &point.velocity.to_array());
    }
    /// Keeps a row at all times.
    fn last(&self, plan: &mut DensityPlan, row: usize) {
        plan.set(row, "life_gate", &[gate_value(LASTING)]);
        plan.set(row, "velocity", &[0.0; 3]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plan of one Gaussian that has the life of `point`.
    fn lived(times: &Times, point: &KeyPoint) -> DensityPlan {
        let mut plan = DensityPlan::unchanged(1);
        times.live(&mut plan, 0, point);
        plan
    }

    fn value(plan: &DensityPlan, attribute: &str) -> f32 {
        plan.values().iter().find(|v| v.attribute == attribute).map(|v| v.values[0]).unwrap()
    }

    /// From when to when its life is, without the falloff.
    fn ends(plan: &DensityPlan) -> [f32; 2] {
        let (center, half_width) = (value(plan, "life_center"), value(plan, "life_log_half_width").exp());
        [center - half_width, center + half_width]
    }

    #[test]
    fn lives_are_at_the_times_that_views_state() {
        // Five of six frames at k / 6: the last key frame is not at 1.
        let keys = [0.0, 1.0 / 3.0, 2.0 / 3.0];
        let point = KeyPoint { position: Vec3::ZERO, color: [0.5; 3], key: 2, alive: [1, 2], velocity: Vec3::X };
        let plan = lived(&Times { keys: &keys, end: 2.0 / 3.0 }, &point);
        assert!((value(&plan, "life_center") - 0.5).abs() < 1e-6, "between the second and the third");
        assert_eq!(value(&plan, "velocity"), 1.0);
        assert!((value(&plan, "life_log_half_width").exp() - (1.0 / 6.0 + 0.4 / 3.0)).abs() < 1e-6);
        assert!((value(&plan, "life_log_falloff").exp() - 0.25 / 3.0).abs() < 1e-6);
        let simultaneous = Times { keys: &[0.0, 0.0], end: 0.0 }.life(&KeyPoint { key: 0, alive: [0, 0], ..point });
        assert!(simultaneous.half_width > 0.0 && simultaneous.falloff > 0.0);
        // The last frame is later than the last key frame.
        let times = Times { keys: &keys, end: 0.9 };
        let moving = KeyPoint { alive: [2, 2], ..point };
        let plan = lived(&times, &moving);
        let [from, to] = ends(&plan);
        assert!(to as f64 > 0.9 && from as f64 <= 2.0 / 3.0 - 0.4 / 3.0 + 1e-6);
        let at_key = times.position(&moving).x + value(&plan, "velocity") * (keys[2] as f32 - value(&plan, "life_center"));
        assert!((at_key - moving.position.x).abs() < 1e-5, "it is where it was found at its key frame: {at_key}");
    }

    #[test]
    fn lives_reach_towards_neighbours_where_key_frames_are_left_out() {
        // Those at 0.4 and at 0.6 are left out.
        let times = Times { keys: &[0.0, 0.2, 0.8, 1.0], end: 1.0 };
        let point = KeyPoint { position: Vec3::ZERO, color: [0.5; 3], key: 1, alive: [1, 1], velocity: Vec3::X };
        let plan = lived(&times, &point);
        let [from, to] = ends(&plan);
        assert!((from - (0.2 - 0.4 * 0.2)).abs() < 1e-6 && (to - (0.2 + 0.4 * 0.6)).abs() < 1e-6, "{from} to {to}");
        let at_key = times.position(&point).x + value(&plan, "velocity") * (0.2 - value(&plan, "life_center"));
        assert!(at_key.abs() < 1e-6, "it is where it was found at its key frame: {at_key}");
        let [from, to] = ends(&lived(&times, &KeyPoint { key: 2, alive: [2, 2], ..point }));
        assert!((from - (0.8 - 0.4 * 0.6)).abs() < 1e-6 && (to - (0.8 + 0.4 * 0.2)).abs() < 1e-6, "{from} to {to}");
    }
}
