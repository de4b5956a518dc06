//! `cc4dgs train --view`: a window that shows the model while it trains.

use super::ending::{ended, panicked};
use super::{Context, train};
use crate::args::Train;
use crate::interrupt;
use cc4dgs_core::archive::Manifest;
use cc4dgs_core::{Error, Moving, Result, StoredModel};
use cc4dgs_play::bake::keyframes;
use cc4dgs_play::presentation;
use cc4dgs_player::Content;
use cc4dgs_player::window::{Live, Shown, show};
use cc4dgs_train::train::{Observer, Snapshot, Standing};
use std::io::Write;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Instants of the sequence that a snapshot has; between them, motion is a straight line.
const KEYFRAMES: usize = 12;
/// Least time between two snapshots, and how many times longer than a snapshot takes: taking them costs the training at most a twentieth of its time. What the
/// window draws comes on top; on a machine without a graphics card that is work of the same processor.
const LEAST_PAUSE: Duration = Duration::from_millis(500);
const PAUSE: u32 = 19;

/// Hands snapshots to a window.
struct Watcher {
    live: Arc<Live>,
    /// When the last snapshot was requested, and when the next one may be.
    times: Mutex<(Instant, Instant)>,
}

impl Observer for Watcher {
    fn after_iteration(&self, standing: &Standing, stop: &AtomicBool) -> usize {
        self.live.say(format!("{} {} / {}", standing.stage.name(), standing.iteration, standing.of));
        self.live.wait_while_paused(stop);
        let mut times = self.times.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        let last = standing.iteration == standing.of;
        if !self.live.is_open() || (!last && (now < times.1 || !self.live.wants())) {
            return 0;
        }
        times.0 = now;
        KEYFRAMES.min(standing.frame_count.max(2))
    }
    fn receive(&self, snapshot: Snapshot) {
        match content(snapshot) {
            Ok(content) => self.live.offer(content),
            Err(e) => self.live.fail(e.to_string()),
        }
        let mut times = self.times.lock().unwrap_or_else(PoisonError::into_inner);
        times.1 = Instant::now() + (times.0.elapsed() * PAUSE).max(LEAST_PAUSE);
    }
}

/// The snapshot as a window shows it.
fn content(snapshot: Snapshot) -> Result<Content> {
    let Snapshot { standing, gaussians, rows, moved, background, render, cameras } = snapshot;
    let playback = if rows.is_empty() { None } else { Some(keyframes(&gaussians, &rows, &moved)?) };
    let manifest = Manifest {
        frame_count: standing.frame_count,
        background,
        rasterizer: render.entry(String::new(), Default::default()),
        presentation: presentation::of_cameras(&cameras, None),
        ..Default::default()
    };
    Content::of_model(StoredModel { manifest, gaussians, moving: Moving::Nothing, playback }, 0)
}

/// Trains on a thread of its own while the window has this one, the main thread. The training goes on where the window is closed; the window stays open where
/// the training ends.
pub fn run(args: &Train, with_context: impl FnOnce(&mut (dyn FnMut(&Context) -> Result<()> + Send)) -> Result<()> + Send) -> Result<()> {
    let stop = interrupt::stop_flag()?;
    let (live, now) = (Arc::new(Live::default()), Instant::now());
    let watcher = Watcher { live: live.clone(), times: Mutex::new((now, now)) };
    let title = args.out.file_name().map_or_else(|| args.out.display().to_string(), |name| name.to_string_lossy().into_owned());
    std::thread::scope(|scope| {
        let training = scope.spawn(|| {
            let work = || with_context(&mut |context| train::run(context, args, Some(&watcher)));
            ended(work, |line| watcher.live.end(line))
        });
        let shown = show(&title, Shown::Training(live));
        if shown.as_ref().is_err_and(|e| !matches!(e, Error::Backend { .. })) {
            // Without a window the training stops with a checkpoint, because `--view` asked for one. If the window has lost its device, the training goes on.
            stop.store(true, Ordering::Relaxed);
        }
        let trained = training.join().unwrap_or_else(|_| Err(panicked()));
        match (shown, trained) {
            // The window lost its device; the result of the training counts.
            (Err(lost @ Error::Backend { .. }), trained) => {
                writeln!(std::io::stderr(), "warning: {lost}").ok();
                trained
            }
            (shown, trained) => shown.and(trained),
        }
    })
}
