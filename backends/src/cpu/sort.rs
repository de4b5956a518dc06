//! The order of many keys.

/// The indices of `keys` (all below `bound`) in ascending order, equal keys in their original order: a radix sort over as many 11-bit digits as `bound` needs.
pub fn stable_order(keys: &[u32], bound: u64) -> Vec<u32> {
    const BITS: u32 = 11;
    let mut indices: Vec<u32> = (0..keys.len() as u32).collect();
    let mut other = vec![0u32; keys.len()];
    let mut shift = 0;
    while bound.saturating_sub(1) >> shift > 0 {
        let digit = |index: u32| (keys[index as usize] >> shift) as usize & ((1 << BITS) - 1);
        let mut starts = vec![0u32; (1 << BITS) + 1];
        for &index in &indices {
            starts[digit(index) + 1] += 1;
        }
        for i in 0..1 << BITS {
            starts[i + 1] += starts[i];
        }
        for &index in &indices {
            let next = &mut starts[digit(index)];
            other[*next as usize] = index;
            *next += 1;
        }
        std::mem::swap(&mut indices, &mut other);
        shift += BITS;
    }
    indices
}
