//! The order of many keys.

use crate::cpu::raster::parallel::SharedMut;
use rayon::prelude::*;

/// Bits of a digit.
const BITS: u32 = 11;
/// Values of a digit.
const VALUES: usize = 1 << BITS;
/// Most parts that are counted and moved side by side. The order does not depend on it.
const PARTS: usize = 8;
/// Least keys of a part.
const LEAST_PART: usize = 1 << 14;

/// The indices of `keys` (all below `bound`) in ascending order, equal keys in their original order: a radix sort over as many 11-bit digits as `bound` needs.
pub fn stable_order(keys: &[u32], bound: u64) -> Vec<u32> {
    let mut indices: Vec<u32> = (0..keys.len() as u32).collect();
    let mut other = vec![0u32; keys.len()];
    let part = keys.len().div_ceil(PARTS).max(LEAST_PART);
    let mut shift = 0;
    while bound.saturating_sub(1) >> shift > 0 {
        let digit = |index: u32| (keys[index as usize] >> shift) as usize & (VALUES - 1);
        let count = |indices: &[u32]| {
            let mut counts = vec![0u32; VALUES];
            for &index in indices {
                counts[digit(index)] += 1;
            }
            counts
        };
        let mut starts: Vec<Vec<u32>> = indices.par_chunks(part).map(count).collect();
        // Digit after digit, and part after part within each.
        let mut position = 0;
        for value in 0..VALUES {
            for starts in &mut starts {
                (starts[value], position) = (position, position + starts[value]);
            }
        }
        let order = SharedMut::new(&mut other);
        indices.par_chunks(part).zip(&mut starts).for_each(|(indices, starts)| {
            for &index in indices {
                let next = &mut starts[digit(index)];
                // SAFETY: the counts give every index a position of its own.
                unsafe { order.slice(*next as usize, 1)[0] = index };
                *next += 1;
            }
        });
        std::mem::swap(&mut indices, &mut other);
        shift += BITS;
    }
    indices
}
