//! Morton (Z-curve) order of points. The order of Gaussians carries no meaning, so codecs are free to put neighbours next to each other.

use rayon::prelude::*;

/// Bits per axis: 2^BITS cells.
const BITS: u32 = 21;

/// The indices `[N]` of the points `means` `[N,3]` along the Z-curve of their bounding box. Points of the same cell keep their order.
pub fn order(means: &[f32]) -> Vec<usize> {
    let mut low = [f64::INFINITY; 3];
    let mut high = [f64::NEG_INFINITY; 3];
    for point in means.chunks_exact(3) {
        for axis in 0..3 {
            low[axis] = low[axis].min(f64::from(point[axis]));
            high[axis] = high[axis].max(f64::from(point[axis]));
        }
    }
    let cells = f64::from((1u32 << BITS) - 1);
    let scale: [f64; 3] = std::array::from_fn(|k| if high[k] > low[k] { cells / (high[k] - low[k]) } else { 0.0 });
    let mut keys: Vec<(u64, u32)> = means
        .par_chunks_exact(3)
        .enumerate()
        .map(|(i, point)| {
            let cell = |axis: usize| spread(((f64::from(point[axis]) - low[axis]) * scale[axis]) as u64);
            (cell(0) | cell(1) << 1 | cell(2) << 2, i as u32)
        })
        .collect();
    keys.par_sort_unstable();
    keys.into_iter().map(|(_, i)| i as usize).collect()
}

/// Puts two zero bits between the low 21 bits of `v`.
pub(crate) fn spread(v: u64) -> u64 {
    let v = v & 0x1f_ffff;
    let v = (v | v << 32) & 0x1f_0000_0000_ffff;
    let v = (v | v << 16) & 0x1f_0000_ff00_00ff;
    let v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    let v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

/// Undoes [`spread`]; the bits between are ignored.
pub(crate) fn gather(v: u64) -> u64 {
    let v = v & 0x1249_2492_4924_9249;
    let v = (v | v >> 2) & 0x10c3_0c30_c30c_30c3;
    let v = (v | v >> 4) & 0x100f_00f0_0f00_f00f;
    let v = (v | v >> 8) & 0x1f_0000_ff00_00ff;
    let v = (v | v >> 16) & 0x1f_0000_0000_ffff;
    (v | v >> 32) & 0x1f_ffff
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_spread_to_every_third_place() {
        for bit in 0..21 {
            assert_eq!(spread(1 << bit), 1 << (3 * bit));
        }
        assert!((0..21).all(|bit| gather(spread(1 << bit) | 6 << (3 * bit)) == 1 << bit));
        assert_eq!(spread(0x1f_ffff), (0..21).fold(0, |a, b| a | 1u64 << (3 * b)));
    }

    #[test]
    fn octants_come_one_after_the_other() {
        let corners: Vec<f32> = (0..8).rev().flat_map(|i| [(i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32]).collect();
        assert_eq!(order(&corners), (0..8).rev().collect::<Vec<_>>());
        assert_eq!(order(&[1.0; 9]), [0, 1, 2], "equal points keep their order");
        assert!(order(&[]).is_empty());
    }
}
