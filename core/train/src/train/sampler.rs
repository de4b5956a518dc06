//! Which views an iteration sees: without replacement, reshuffled every epoch, a function of the iteration alone so that resuming needs no state.

use cc4dgs_core::{Scene, Seed};
use rand::seq::SliceRandom;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};

/// Draws batches of views.
///
/// With a ramp, later frames come in one after another: a field that starts from the first frame then follows a motion step by step, where all
/// frames at once would first teach the Gaussians to fade away from where things no longer are.
pub struct Sampler {
    /// In the order in which they open.
    views: Vec<usize>,
    /// Iteration from which each may be drawn, ascending.
    opens: Vec<usize>,
    seed: Seed,
    batch: usize,
    epoch: Option<(usize, Vec<usize>)>,
}

impl Sampler {
    /// Batches of `batch` out of `views`, all open from the start.
    pub fn new(views: Vec<usize>, seed: Seed, batch: usize) -> Self {
        Self { opens: vec![0; views.len()], views, seed, batch, epoch: None }
    }
    /// Views of later frames open one after another: `opens` tells the iteration from which those after a share of the time may be drawn, `time_norm` the time
    /// of a view.
    pub fn with_ramp(mut self, opens: impl Fn(f64) -> f64, time_norm: impl Fn(usize) -> f32) -> Self {
        self.views.sort_by(|&a, &b| time_norm(a).total_cmp(&time_norm(b)));
        if let (Some(&first), Some(&last)) = (self.views.first(), self.views.last()) {
            let (from, to) = (time_norm(first), time_norm(last));
            let share = |v: usize| if to > from { (time_norm(v) - from) / (to - from) } else { 0.0 };
            self.opens = self.views.iter().map(|&v| opens(f64::from(share(v))).floor() as usize).collect();
        }
        self
    }
    /// The views that iteration `index`, from 0, may draw: one at least, where there are any.
    pub fn open(&self, index: usize) -> &[usize] {
        let open = self.opens.partition_point(|&from| from <= index);
        &self.views[..open.max(usize::from(!self.views.is_empty()))]
    }
    /// The views of iteration `index`, from 0.
    pub fn batch(&mut self, index: usize) -> Vec<usize> {
        let n = self.views.len();
        let size = self.batch.min(n);
        let open = self.open(index);
        if open.len() < n {
            // The set grows from draw to draw, so there are no epochs yet.
            let mut rng = self.seed.child("ramp").index(index as u64).rng();
            return rand::seq::index::sample(&mut rng, open.len(), size.min(open.len())).into_iter().map(|i| open[i]).collect();
        }
        (0..size)
            .map(|b| {
                let position = index * size + b;
                let epoch = position / n;
                if self.epoch.as_ref().is_none_or(|(e, _)| *e != epoch) {
                    let mut order = self.views.clone();
                    order.shuffle(&mut self.seed.index(epoch as u64).rng());
                    self.epoch = Some((epoch, order));
                }
                self.epoch.as_ref().map_or(self.views[0], |(_, order)| order[position % n])
            })
            .collect()
    }
}

/// Decodes coming frames, and their depth where it is used, into the cache of their scene on a thread of its own.
pub struct Prefetcher(SyncSender<(Arc<Scene>, usize)>);

impl Prefetcher {
    /// Starts the thread; it ends with this value.
    pub fn new(uses_depth: bool) -> Self {
        let (send, receive) = sync_channel::<(Arc<Scene>, usize)>(16);
        std::thread::spawn(move || {
            for (scene, view) in receive {
                // What cannot be read is reported by whoever needs it.
                let _ = scene.frame(view);
                if uses_depth {
                    let _ = scene.depth(view);
                }
            }
        });
        Self(send)
    }
    /// Asks for `views` of `scene`; never waits.
    pub fn want(&self, scene: &Arc<Scene>, views: Vec<usize>) {
        for view in views {
            let _ = self.0.try_send((scene.clone(), view));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_epoch_sees_every_view_once_and_resumes_anywhere() {
        let mut sampler = Sampler::new((10..17).collect(), Seed::root(1), 2);
        let drawn: Vec<usize> = (0..7).flat_map(|i| sampler.batch(i)).collect();
        for epoch in drawn.chunks(7) {
            let mut sorted = epoch.to_vec();
            sorted.sort_unstable();
            assert_eq!(sorted, (10..17).collect::<Vec<_>>());
        }
        let mut late = Sampler::new((10..17).collect(), Seed::root(1), 2);
        assert_eq!(late.batch(5), drawn[10..12]);
    }

    #[test]
    fn a_batch_of_more_views_than_there_are_has_every_view_once() {
        let mut sampler = Sampler::new((10..13).collect(), Seed::root(1), 5);
        for index in 0..4 {
            let mut drawn = sampler.batch(index);
            drawn.sort_unstable();
            assert_eq!(drawn, [10, 11, 12], "iteration {index}");
        }
    }

    #[test]
    fn a_ramp_lets_frames_in_one_after_another() {
        // Three cameras, four frames: view = 3 * frame + camera.
        let time = |view: usize| (view / 3) as f32 / 3.0;
        let mut sampler = Sampler::new((0..12).rev().collect(), Seed::root(1), 1).with_ramp(|share| 300.0 * share, time);
        for index in 0..300 {
            let view = sampler.batch(index)[0];
            assert!(view / 3 <= index / 100, "view {view} at iteration {index}");
            assert_eq!(sampler.open(index).len(), 3 * (index / 100 + 1), "iteration {index}");
        }
        let mut epoch: Vec<usize> = (300..312).map(|i| sampler.batch(i)[0]).collect();
        epoch.sort_unstable();
        assert_eq!(epoch, (0..12).collect::<Vec<_>>());
        assert_eq!(Sampler::new((3..6).collect(), Seed::root(1), 1).open(0), [3, 4, 5], "without a ramp");
        let early = Sampler::new((0..12).collect(), Seed::root(1), 5).with_ramp(|share| 300.0 * share, time).batch(0);
        assert_eq!(early.len(), 3, "no more views than are open");
    }
}
