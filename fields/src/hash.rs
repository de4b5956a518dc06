//! Hash functions of integer vertices (CC-4DGS, eq. `each_hash_function`): ((A v + b) mod P) mod m, scaled to [-1, 1]^k.
//!
//! The constants come from a seed by SplitMix64 and are never stored.

use cc4dgs_format::Seed;

/// The Mersenne prime 2^31 - 1.
pub const P: u64 = (1 << 31) - 1;

/// The hash functions of one level.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LevelHash {
    /// Columns of A [3]`[k]`, each entry in 1..P.
    a: [Vec<u32>; 3],
    /// b `[k]`, each entry in 0..P.
    b: Vec<u32>,
    /// m.
    modulus: u32,
    /// floor(2^32 / m), for division by multiplication.
    reciprocal: u64,
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
    /// A's three rows `[k]` each, then b `[k]`: the constants as other devices read them.
    pub fn constants(&self) -> Vec<u32> {
        self.a.iter().chain([&self.b]).flatten().copied().collect()
    }
    /// m.
    pub fn modulus(&self) -> u32 {
        self.modulus
    }
    /// Whether there are no functions.
    pub fn is_empty(&self) -> bool {
        self.b.is_empty()
    }
    /// The signatures `[n, k]` of `vertices` `[n]`; entries of a vertex must be below 2^31.
    #[inline(always)]
    pub fn signatures(&self, vertices: &[[u32; 3]], out: &mut [f32]) {
        for (vertex, row) in vertices.iter().zip(out.chunks_exact_mut(self.len().max(1))) {
            self.signature(*vertex, row);
        }
    }
    #[inline(always)]
    fn signature(&self, [x, y, z]: [u32; 3], row: &mut [f32]) {
        let n = row.len();
        let (ax, ay, az, b) = (&self.a[0][..n], &self.a[1][..n], &self.a[2][..n], &self.b[..n]);
        let scale = 2.0 / (self.modulus - 1) as f32;
        let modulus = u64::from(self.modulus);
        for i in 0..n {
            // Each product is below 2^62, so their sum fits; two folds bring it to P or little more.
            let sum = u64::from(ax[i]) * u64::from(x) + u64::from(ay[i]) * u64::from(y) + u64::from(az[i]) * u64::from(z) + u64::from(b[i]);
            let sum = fold(fold(sum));
            let residue = if sum >= P { sum - P } else { sum };
            // The quotient by multiplication is the exact one or one less.
            let remainder = residue - ((residue * self.reciprocal) >> 32) * modulus;
            let hash = if remainder >= modulus { remainder - modulus } else { remainder };
            row[i] = hash as u32 as i32 as f32 * scale - 1.0;
        }
    }
}

/// Congruent to `v` modulo P: 2^31 = 1 there.
#[inline(always)]
fn fold(v: u64) -> u64 {
    (v & P) + (v >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signatures_match_exact_integers() {
        for modulus in [2, 97, 65_536, 1_000_000, 1 << 24] {
            let hash = LevelHash::new(Seed::root(5).index(u64::from(modulus)), 128, modulus);
            for vertex in [[0, 0, 0], [1, 2, 3], [256, 0, 255], [1600, 1600, 1600], [(1 << 31) - 1; 3]] {
                let mut row = vec![0.0f32; 128];
                hash.signatures(&[vertex], &mut row);
                for (i, got) in row.iter().enumerate() {
                    let sum: u128 = (0..3).map(|d| u128::from(hash.a[d][i]) * u128::from(vertex[d])).sum::<u128>() + u128::from(hash.b[i]);
                    let h = (sum % u128::from(P)) % u128::from(modulus);
                    let want = h as f64 * 2.0 / f64::from(modulus - 1) - 1.0;
                    assert!((f64::from(*got) - want).abs() < 3e-7, "{vertex:?} function {i}: {got} instead of {want}");
                }
            }
        }
    }

    #[test]
    fn functions_depend_on_the_seed_alone() {
        assert_eq!(LevelHash::new(Seed::root(1), 16, 1000), LevelHash::new(Seed::root(1), 16, 1000));
        assert_ne!(LevelHash::new(Seed::root(1), 16, 1000), LevelHash::new(Seed::root(2), 16, 1000));
    }
}
