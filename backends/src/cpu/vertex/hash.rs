//! Signatures of vertices, vectorised.

use crate::cpu::simd::vectorized;
use crate::ops::field::LevelHash;

/// The signatures `[n, k]` of `vertices` `[n]`, as [`LevelHash::signatures`].
pub fn signatures(hash: &LevelHash, vertices: &[[u32; 3]], out: &mut [f32]) {
    vectorized(
        #[inline(always)]
        || hash.signatures(vertices, out),
    );
}
