//! The order of many keys.

/// The indices of `keys` (all below `bound`) in ascending order, equal keys in their original order: a radix sort over as many 11-bit digits as `bound` needs.
pub fn stable_order(keys: &[u32], bound: u64) -> Vec<u32> {
    const BITS: u32 = 11;
    let mut places: Vec<u32> = (0..keys.len() as u32).collect();
    let mut other = vec![0u32; keys.len()];
    let mut shift = 0;
    while bound.saturating_sub(1) >> shift > 0 {
        let digit = |place: u32| (keys[place as usize] >> shift) as usize & ((1 << BITS) - 1);
        let mut starts = vec![0u32; (1 << BITS) + 1];
        for &place in &places {
            starts[digit(place) + 1] += 1;
        }
        for i in 0..1 << BITS {
            starts[i + 1] += starts[i];
        }
        for &place in &places {
            let next = &mut starts[digit(place)];
            other[*next as usize] = place;
            *next += 1;
        }
        std::mem::swap(&mut places, &mut other);
        shift += BITS;
    }
    places
}
