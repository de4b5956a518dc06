//! Reused work buffers. Fresh pages cost more to fault in than the kernels take to fill them, so buffers go back to a small pool.

use std::ops::{Deref, DerefMut};
use std::sync::Mutex;

/// Upper bound on pooled buffers; more than enough for every thread of a kernel to hold a few.
const KEPT: usize = 64;
/// Upper bound on the floats of a pooled buffer (64 MiB); larger ones are freed.
const KEPT_FLOATS: usize = 16 << 20;

static POOL: Mutex<Vec<Vec<f32>>> = Mutex::new(Vec::new());

/// A borrowed buffer whose contents are arbitrary: write before you read.
pub struct Scratch {
    buffer: Vec<f32>,
    len: usize,
}

/// Takes a buffer of `len` floats with arbitrary contents.
pub fn scratch(len: usize) -> Scratch {
    let mut buffer = POOL.lock().ok().and_then(|mut pool| best_fit(&mut pool, len)).unwrap_or_default();
    if buffer.len() < len {
        buffer.clear();
        buffer.resize(len, 0.0);
    }
    Scratch { buffer, len }
}

/// The smallest pooled buffer that is long enough.
fn best_fit(pool: &mut Vec<Vec<f32>>, len: usize) -> Option<Vec<f32>> {
    let fit = (0..pool.len()).filter(|&i| pool[i].len() >= len).min_by_key(|&i| pool[i].len());
    fit.map(|i| pool.swap_remove(i))
}

impl Deref for Scratch {
    type Target = [f32];
    fn deref(&self) -> &[f32] {
        &self.buffer[..self.len]
    }
}

impl DerefMut for Scratch {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.buffer[..self.len]
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        if self.buffer.len() > KEPT_FLOATS {
            return;
        }
        if let Ok(mut pool) = POOL.lock() {
            if pool.len() >= KEPT
                && let Some(shortest) = (0..pool.len()).min_by_key(|&i| pool[i].len())
            {
                pool.swap_remove(shortest);
            }
            pool.push(std::mem::take(&mut self.buffer));
        }
    }
}
