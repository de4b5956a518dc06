//! Suites that every codec passes, ours and anyone's: call them from a test of your own crate.
//!
//! Each returns what it found wrong, one line per finding; an empty list is a pass. They draw their own inputs and need no data.

mod codec;
mod weight_codec;

pub use codec::codec;
pub use weight_codec::weight_codec;

use crate::Seed;

/// A number of the `k`-th draw of a stream, uniform in -1..1.
pub fn uniform(seed: Seed, k: usize) -> f32 {
    (seed.index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
}
