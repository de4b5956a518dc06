//! A cache of decoded frames and depth, which a scene and the scenes derived from it share within one bound in bytes.

use crate::{DepthImage, FrameSource, Image8, Result};
use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

/// The frames and the depth of a source, cached in [`KeptFrames`] together with those of other sources.
pub(crate) struct FrameCache {
    pub source: Arc<dyn FrameSource>,
    /// Index of this source among those that share `kept`.
    number: usize,
    pub kept: Arc<KeptFrames>,
}

/// The cached frames and depth of a scene and of those derived from it.
pub(crate) struct KeptFrames {
    pub cap: u64,
    caches: AtomicUsize,
    pub state: Mutex<CacheState>,
}

/// A cached value of a view.
#[derive(Clone)]
pub(crate) enum Kept {
    Image(Arc<Image8>),
    Depth(Arc<DepthImage>),
}

/// Index of the source, view, and whether it is the depth.
type Key = (usize, usize, bool);

#[derive(Default)]
pub(crate) struct CacheState {
    /// Cached values, and the clock when each was last used.
    pub frames: HashMap<Key, (Kept, u64)>,
    pub bytes: u64,
    clock: u64,
}

impl FrameCache {
    pub fn new(source: Arc<dyn FrameSource>, kept: Arc<KeptFrames>) -> Self {
        Self { source, number: kept.caches.fetch_add(1, Ordering::Relaxed), kept }
    }
    /// The image of a view. It is decoded outside the lock, and so is depth, so that prefetching threads work in parallel.
    pub fn image(&self, view: usize) -> Result<Arc<Image8>> {
        let key = (self.number, view, false);
        if let Some(Kept::Image(image)) = self.kept.get(key) {
            return Ok(image);
        }
        let image = Arc::new(self.source.load(view)?);
        self.kept.keep(key, Kept::Image(image.clone()));
        Ok(image)
    }
    /// The depth of a view, where its source has one.
    pub fn depth(&self, view: usize) -> Result<Option<Arc<DepthImage>>> {
        let key = (self.number, view, true);
        if let Some(Kept::Depth(depth)) = self.kept.get(key) {
            return Ok(Some(depth));
        }
        let Some(depth) = self.source.depth(view)? else { return Ok(None) };
        let depth = Arc::new(depth);
        self.kept.keep(key, Kept::Depth(depth.clone()));
        Ok(Some(depth))
    }
}

impl Drop for FrameCache {
    /// Removes the values of this source, because nothing can read them any more; their bytes are free for other sources.
    fn drop(&mut self) {
        if let Ok(mut state) = self.kept.state.lock() {
            let CacheState { frames, bytes, .. } = &mut *state;
            frames.retain(|(cache, ..), _| *cache != self.number);
            *bytes = frames.values().map(|(kept, _)| kept.bytes()).sum();
        }
    }
}

impl KeptFrames {
    /// A cache of at most `cap` bytes.
    pub fn new(cap: u64) -> Self {
        Self { cap, caches: AtomicUsize::new(0), state: Mutex::default() }
    }
    fn get(&self, key: Key) -> Option<Kept> {
        let mut state = self.state.lock().ok()?;
        state.clock += 1;
        let now = state.clock;
        let (kept, used) = state.frames.get_mut(&key)?;
        *used = now;
        Some(kept.clone())
    }
    fn keep(&self, key: Key, new: Kept) {
        if let Ok(mut state) = self.state.lock() {
            state.keep(key, new, self.cap);
        }
    }
}

impl Kept {
    pub fn bytes(&self) -> u64 {
        match self {
            Self::Image(image) => image.data.len() as u64,
            Self::Depth(depth) => size_of_val(depth.values.as_slice()) as u64,
        }
    }
}

impl CacheState {
    /// Adds `new`; removes the least recently used values until it fits.
    fn keep(&mut self, key: Key, new: Kept, cap: u64) {
        let size = new.bytes();
        // Values that another thread has added already, and values over the bound, remove nothing.
        if size > cap || self.frames.contains_key(&key) {
            return;
        }
        while self.bytes + size > cap {
            let Some(oldest) = self.frames.iter().min_by_key(|(_, (_, used))| *used).map(|(&key, _)| key) else { break };
            if let Some((old, _)) = self.frames.remove(&oldest) {
                self.bytes -= old.bytes();
            }
        }
        self.bytes += size;
        self.frames.insert(key, (new, self.clock));
    }
}
