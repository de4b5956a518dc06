//! Conformance suites for codecs and exporters. Call them from a test of the plug-in's own crate.
//!
//! Each returns a list of findings, one line each; an empty list means that the plug-in passed. They generate their own inputs and need no data.

mod codec;
#[cfg(not(target_arch = "wasm32"))]
mod exporter;
mod weight_codec;

pub use codec::codec;
#[cfg(not(target_arch = "wasm32"))]
pub use exporter::{MovingModel, export_facts, exporter};
pub use weight_codec::weight_codec;

use crate::{Error, Result, Seed};

/// The `k`-th random number of `seed`, uniform in -1..1.
pub fn uniform(seed: Seed, k: usize) -> f32 {
    (seed.index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
}

/// What `work` returns where there are so many threads.
fn on_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> Result<T> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|e| Error::backend("threads", e.to_string(), "Run the suite where a program can start threads"))?;
    Ok(pool.install(work))
}
