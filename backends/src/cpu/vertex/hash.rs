//! Signatures of vertices: what [`LevelHash`]'s functions give for them.

use crate::cpu::simd::vectorized;
use crate::ops::hash::{LevelHash, P};

impl LevelHash {
    /// The signatures `[n, k]` of `vertices` `[n]`; entries of a vertex must be below 2^31.
    pub fn signatures(&self, vertices: &[[u32; 3]], out: &mut [f32]) {
        vectorized(
            #[inline(always)]
            || {
                for (vertex, row) in vertices.iter().zip(out.chunks_exact_mut(self.len().max(1))) {
                    self.signature(*vertex, row);
                }
            },
        );
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
    use cc4dgs_core::Seed;

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
