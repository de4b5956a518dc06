//! `cc4dgs bench`: timings on workloads that are made from a seed.

mod agree;
mod field;
mod frame;
mod lookup;
mod parts;
mod play;
mod skip;
mod step;

pub use agree::agree;
pub use field::field;
pub use frame::frame;
pub use lookup::lookup;
pub use parts::{loss, sort};
pub use play::play;
pub use skip::skip;
pub use step::step;

use cc4dgs_backends::bench::{SCENE_CASES, SceneCase, shrunk};
use cc4dgs_core::{Camera, RenderWork, Result, unknown_name};
use cc4dgs_play::player::{PlayWork, Player};
use std::time::Instant;

/// Runs that are not counted: caches fill and kernels compile.
const WARM_UP: usize = 2;

/// Times of `repeats` calls of `run`, which must end with a read-back.
pub fn timed(repeats: usize, mut run: impl FnMut() -> Result<()>) -> Result<Spread> {
    let mut times = Vec::with_capacity(repeats);
    for round in 0..WARM_UP + repeats {
        let began = Instant::now();
        run()?;
        if round >= WARM_UP {
            times.push(began.elapsed().as_secs_f64() * 1e3);
        }
    }
    Ok(Spread::of(times))
}

/// The synthetic scenes of these names (all if there are none), shrunk to a share of their pixels and Gaussians.
pub fn scene_cases(names: &[String], share: f64) -> Result<Vec<SceneCase>> {
    if let Some(unknown) = names.iter().find(|name| !SCENE_CASES.iter().any(|c| c.name == name.as_str())) {
        return Err(unknown_name("--case", unknown, SCENE_CASES.iter().map(|c| c.name.as_ref())));
    }
    let wanted = |case: &&SceneCase| names.is_empty() || names.iter().any(|name| case.name == name.as_str());
    Ok(SCENE_CASES.iter().filter(wanted).map(|case| shrunk(case, share)).collect())
}

/// Median and spread of some times.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Spread {
    /// The middle one, or the mean of the two in the middle.
    pub median_ms: f64,
    /// The shortest.
    pub min_ms: f64,
    /// A tenth of the times are longer.
    pub p90_ms: f64,
}

impl Spread {
    /// Of `times` in milliseconds; zeros if there are none.
    pub fn of(mut times: Vec<f64>) -> Self {
        times.sort_by(f64::total_cmp);
        let (count, at) = (times.len(), |index: usize| times.get(index).copied().unwrap_or(0.0));
        let last = count.saturating_sub(1);
        Self { median_ms: 0.5 * (at(last / 2) + at(last.div_ceil(2))), min_ms: at(0), p90_ms: at((9 * count).div_ceil(10).saturating_sub(1)) }
    }
}

/// How fast a model plays.
#[derive(serde::Serialize)]
pub struct Playback {
    /// Field and rasterizer of the first frame, milliseconds; kernels are compiled and caches are empty.
    first_field_ms: f64,
    first_raster_ms: f64,
    field: Spread,
    raster: Spread,
    frame: Spread,
    /// Frames drawn one after another without waiting in between, per frame.
    playback_ms: f64,
    frames_per_s: f64,
    visible: u64,
    tile_pairs: u64,
    pixel_pairs: u64,
    work: PlayWork,
}

/// Times `frames` frames after some that are not counted, waiting after the field and after the image; and as many without waiting. `moment` is the camera and
/// the time of a frame.
pub fn time_playback<'c>(player: &mut Player, frames: usize, moment: impl Fn(usize) -> (&'c Camera, f32)) -> Result<Playback> {
    let mut times: [Vec<f64>; 3] = Default::default();
    let (mut first, mut counts) = ((0.0, 0.0), RenderWork::default());
    for frame in 0..WARM_UP + frames {
        let (camera, time_norm) = moment(frame);
        let (output, time) = player.render(camera, time_norm)?;
        counts = output.stats.work;
        if frame == 0 {
            first = (time.field_ms, time.raster_ms);
        }
        if frame >= WARM_UP {
            for (list, ms) in times.iter_mut().zip([time.field_ms, time.raster_ms, time.field_ms + time.raster_ms]) {
                list.push(ms);
            }
        }
    }
    let [field, raster, frame] = times.map(Spread::of);
    let mut play = |frames: usize| -> Result<f64> {
        let began = Instant::now();
        for frame in 0..frames {
            let (camera, time_norm) = moment(frame);
            player.play(camera, time_norm)?;
        }
        player.sync()?;
        Ok(began.elapsed().as_secs_f64() * 1e3 / frames as f64)
    };
    play(WARM_UP)?;
    let playback_ms = play(frames)?;
    Ok(Playback {
        first_field_ms: first.0,
        first_raster_ms: first.1,
        field,
        raster,
        frame,
        playback_ms,
        frames_per_s: if playback_ms > 0.0 { 1000.0 / playback_ms } else { 0.0 },
        visible: counts.visible,
        tile_pairs: counts.tile_pairs,
        pixel_pairs: counts.pixel_pairs,
        work: player.work,
    })
}

#[cfg(test)]
mod tests {
    use super::Spread;

    #[test]
    fn the_spread_is_of_the_sorted_times() {
        let spread = Spread::of((0..10).rev().map(f64::from).collect());
        assert_eq!(spread, Spread { median_ms: 4.5, min_ms: 0.0, p90_ms: 8.0 });
        assert_eq!(Spread::of(vec![30.0, 10.0, 20.0]).median_ms, 20.0);
        assert_eq!(Spread::of(Vec::new()).median_ms, 0.0);
    }
}
