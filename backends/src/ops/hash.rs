//! Hash functions of integer vertices (CC-4DGS, eq. `each_hash_function`): ((A v + b) mod P) mod m, scaled to [-1, 1]^k.
//!
//! The constants come from a seed by SplitMix64 and are never stored.

use cc4dgs_core::Seed;

/// The Mersenne prime 2^31 - 1.
pub const P: u64 = (1 << 31) - 1;

/// The hash functions of one level.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LevelHash {
    /// Columns of A [3]`[k]`, each entry in 1..P.
    pub(crate) a: [Vec<u32>; 3],
    /// b `[k]`, each entry in 0..P.
    pub(crate) b: Vec<u32>,
    /// m.
    pub(crate) modulus: u32,
    /// floor(2^32 / m), for division by multiplication.
    pub(crate) reciprocal: u64,
}

/// SplitMix64 (Steele, Lea and Flood 2014).
struct SplitMix64(u64);

impl SplitMix64 {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
}

impl LevelHash {
    /// `k` functions drawn from `seed`; per function A's three entries, then b. `modulus` is m, held to 2..2^24 so that hashes are exact in float32.
    pub fn new(seed: Seed, k: usize, modulus: u32) -> Self {
        let modulus = modulus.clamp(2, 1 << 24);
        let mut random = SplitMix64(seed.value());
        let mut a: [Vec<u32>; 3] = Default::default();
        let mut b = Vec::with_capacity(k);
        for _ in 0..k {
            for column in &mut a {
                column.push((1 + random.next() % (P - 1)) as u32);
            }
            b.push((random.next() % P) as u32);
        }
        Self { a, b, modulus, reciprocal: (1 << 32) / u64::from(modulus) }
    }
    /// k.
    pub fn len(&self) -> usize {
        self.b.len()
    }
    /// A's three rows `[k]` each, then b [k]: the constants as other devices read them.
    #[cfg(feature = "cube")]
    pub(crate) fn constants(&self) -> Vec<u32> {
        self.a.iter().chain([&self.b]).flatten().copied().collect()
    }
    /// m.
    #[cfg(feature = "cube")]
    pub(crate) fn modulus(&self) -> u32 {
        self.modulus
    }
    /// Whether there are no functions.
    pub fn is_empty(&self) -> bool {
        self.b.is_empty()
    }
}
