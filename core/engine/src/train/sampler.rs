//! Which views an iteration sees: without replacement, reshuffled every epoch, a function of the iteration alone so that resuming needs no state.

use cc4dgs_core::{Scene, Seed};
use rand::seq::SliceRandom;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};

/// Draws batches of views.
pub struct Sampler {
    views: Vec<usize>,
    seed: Seed,
    batch: usize,
    epoch: Option<(usize, Vec<usize>)>,
}

impl Sampler {
    /// Batches of `batch` out of `views`.
    pub fn new(views: Vec<usize>, seed: Seed, batch: usize) -> Self {
        Self { views, seed, batch, epoch: None }
    }
    /// The views of iteration `index`, from 0.
    pub fn batch(&mut self, index: usize) -> Vec<usize> {
        let n = self.views.len();
        (0..self.batch.min(n))
            .map(|b| {
                let position = index * self.batch + b;
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

/// Decodes coming frames into the scene's cache on a thread of its own.
pub struct Prefetcher(SyncSender<usize>);

impl Prefetcher {
    /// Starts the thread; it ends with this value.
    pub fn new(scene: Arc<Scene>) -> Self {
        let (send, receive) = sync_channel::<usize>(16);
        std::thread::spawn(move || {
            for view in receive {
                // A frame that cannot be read is reported by whoever needs it.
                let _ = scene.frame(view);
            }
        });
        Self(send)
    }
    /// Asks for `views`; never waits.
    pub fn want(&self, views: Vec<usize>) {
        for view in views {
            let _ = self.0.try_send(view);
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
}
