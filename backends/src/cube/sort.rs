//! Exclusive sums and a stable radix sort of pairs of words. Ranks are counted, so equal inputs give equal outputs, whatever the order of threads.

use super::tensor::{THREADS, empty, signed, spread, upload, workgroups_for};
use crate::ops::sort::SortOps;
use burn::backend::tensor::IntTensor;
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Bits of a digit; a workgroup has one thread per value of a digit.
const DIGIT: u32 = 8;
const MASK: u32 = (1 << DIGIT) - 1;
/// Rounds of one item per thread that a workgroup sorts.
const ROUNDS: u32 = 4;
const BLOCK: u32 = ROUNDS * THREADS;

/// a + b, at most 2^31 - 1, as long as neither is larger. Huge Gaussians can meet more tiles than 32 bits count: their sum must exceed every limit, not wrap.
#[cube]
fn saturating_sum(a: u32, b: u32) -> u32 {
    let sum = a + b;
    select(sum < 0x7fff_ffffu32, sum, 0x7fff_ffffu32)
}

/// Inclusive prefix sum over the threads of a workgroup: running`[thread]` becomes the sum of the values of all threads up to it.
#[cube]
fn add_up(running: &mut Shared<[u32]>, value: u32) {
    let thread = UNIT_POS as usize;
    running[thread] = value;
    sync_cube();
    let mut reach = 1usize;
    while reach < THREADS as usize {
        let mut before = 0u32;
        if thread >= reach {
            before = running[thread - reach];
        }
        sync_cube();
        let own = running[thread];
        running[thread] = saturating_sum(own, before);
        sync_cube();
        reach *= 2;
    }
}

/// values`[i]` becomes the sum of those before it within its workgroup; `sums` gets the workgroups' totals.
#[cube(launch)]
fn scan_in_workgroups(values: &mut [u32], sums: &mut [u32], count: u32) {
    let mut running = Shared::<[u32]>::new_slice(THREADS as usize);
    let at = ABSOLUTE_POS;
    let thread = UNIT_POS as usize;
    let mut value = 0u32;
    if at < count as usize {
        value = values[at];
    }
    add_up(&mut running, value);
    if at < count as usize {
        values[at] = running[thread] - value;
    }
    if UNIT_POS == THREADS - 1 && CUBE_POS < sums.len() {
        sums[CUBE_POS] = running[thread];
    }
}

/// The same over the workgroups' totals, by one workgroup; `total` gets the sum of all.
#[cube(launch)]
fn scan_sums(sums: &mut [u32], total: &mut [u32], count: u32) {
    let mut running = Shared::<[u32]>::new_slice(THREADS as usize);
    let thread = UNIT_POS as usize;
    let mut carry = 0u32;
    let mut start = 0u32;
    while start < count {
        let at = start as usize + thread;
        let mut value = 0u32;
        if at < count as usize {
            value = sums[at];
        }
        add_up(&mut running, value);
        if at < count as usize {
            sums[at] = saturating_sum(carry, running[thread] - value);
        }
        let end = running[THREADS as usize - 1];
        sync_cube();
        carry = saturating_sum(carry, end);
        start += THREADS;
    }
    if UNIT_POS == 0 {
        total[0] = carry;
    }
}

#[cube(launch)]
fn add_sums(values: &mut [u32], sums: &[u32], count: u32) {
    if ABSOLUTE_POS < count as usize {
        let own = values[ABSOLUTE_POS];
        values[ABSOLUTE_POS] = saturating_sum(own, sums[ABSOLUTE_POS / THREADS as usize]);
    }
}

/// Replaces each of the first `count` values (at least one) by the sum of those before it within its workgroup; returns the sums before each workgroup and
/// the sum of all `[1]`.
fn sums_in_two(values: &CubeTensor, count: usize) -> (CubeTensor, CubeTensor) {
    let client = values.client.clone();
    let workgroups = count.div_ceil(THREADS as usize);
    let (sums, total) = (empty(values, [workgroups], DType::U32), empty(values, [1], DType::U32));
    let dim = CubeDim::new_1d(THREADS);
    scan_in_workgroups::launch(&client, workgroups_for(count), dim, values.clone().into_buffer_arg(), sums.clone().into_buffer_arg(), count as u32);
    scan_sums::launch(&client, CubeCount::Static(1, 1, 1), dim, sums.clone().into_buffer_arg(), total.clone().into_buffer_arg(), workgroups as u32);
    (sums, total)
}

/// Replaces each of the first `count` values by the sum of those before it; returns the sum of all `[1]`.
pub fn exclusive_sums(values: &CubeTensor, count: usize) -> CubeTensor {
    if count == 0 {
        return upload(values, &[0u32], DType::U32);
    }
    let (sums, total) = sums_in_two(values, count);
    if count > THREADS as usize {
        let (v, s) = (values.clone().into_buffer_arg(), sums.into_buffer_arg());
        add_sums::launch(&values.client, workgroups_for(count), CubeDim::new_1d(THREADS), v, s, count as u32);
    }
    total
}

/// counts[digit * blocks + block]: how often each digit occurs in each block.
#[cube(launch)]
fn count_digits(keys: &[u32], counts: &mut [u32], count: u32, blocks: u32, shift: u32) {
    let local = Shared::<[Atomic<u32>]>::new_slice(THREADS as usize);
    let thread = UNIT_POS as usize;
    local[thread].store(0u32);
    sync_cube();
    let block = CUBE_POS as u32;
    for round in 0..ROUNDS {
        let at = block * BLOCK + round * THREADS + UNIT_POS;
        if at < count {
            local[((keys[at as usize] >> shift) & MASK) as usize].fetch_add(1u32);
        }
    }
    sync_cube();
    if block < blocks {
        counts[(UNIT_POS * blocks + block) as usize] = local[thread].load();
    }
}

/// Words of a bitmask with a bit per thread.
const WORDS: usize = (THREADS / 32) as usize;

/// Moves every item behind those with a smaller digit and the earlier ones with its own. In each round, each thread sets its bit in its digit's bitmask; the
/// population count of the lower bits is its stable rank.
#[cube(launch)]
fn move_by_digit(
    keys: &[u32],
    values: &[u32],
    starts: &[u32],
    sums: &[u32],
    keys_out: &mut [u32],
    values_out: &mut [u32],
    count: u32,
    blocks: u32,
    shift: u32,
) {
    let mut next = Shared::<[u32]>::new_slice(THREADS as usize);
    let masks = Shared::<[Atomic<u32>]>::new_slice(comptime!(THREADS as usize * WORDS));
    let thread = UNIT_POS as usize;
    let block = CUBE_POS as u32;
    if block < blocks {
        let own = (UNIT_POS * blocks + block) as usize;
        next[thread] = starts[own] + sums[own / THREADS as usize];
    }
    #[unroll]
    for word in 0..WORDS {
        masks[thread * WORDS + word].store(0u32);
    }
    sync_cube();
    for round in 0..ROUNDS {
        let at = block * BLOCK + round * THREADS + UNIT_POS;
        let (own_word, own_bit) = (thread / 32, UNIT_POS % 32);
        let mut key = 0u32;
        let mut digit = 0usize;
        if at < count {
            key = keys[at as usize];
            digit = ((key >> shift) & MASK) as usize;
            masks[digit * WORDS + own_word].fetch_or(1u32 << own_bit);
        }
        sync_cube();
        if at < count {
            let mut rank = (masks[digit * WORDS + own_word].load() & ((1u32 << own_bit) - 1u32)).count_ones();
            #[unroll]
            for word in 0..WORDS {
                let set = masks[digit * WORDS + word].load().count_ones();
                rank += select(word < own_word, set, 0u32);
            }
            let index = (next[digit] + rank) as usize;
            keys_out[index] = key;
            values_out[index] = values[at as usize];
        }
        sync_cube();
        // Each thread updates the digit of its own index.
        let mut used = 0u32;
        #[unroll]
        for word in 0..WORDS {
            used += masks[thread * WORDS + word].load().count_ones();
            masks[thread * WORDS + word].store(0u32);
        }
        next[thread] += used;
        sync_cube();
    }
}

/// `keys` and `values` `[count]` in ascending order of the lowest `bits` of the keys; equal keys keep their order.
pub fn sort_pairs(keys: CubeTensor, values: CubeTensor, count: usize, bits: u32) -> (CubeTensor, CubeTensor) {
    let (mut keys, mut values) = (keys, values);
    if count < 2 {
        return (keys, values);
    }
    let client = keys.client.clone();
    let blocks = count.div_ceil(BLOCK as usize);
    let dim = CubeDim::new_1d(THREADS);
    let counts = empty(&keys, [blocks << DIGIT], DType::U32);
    for pass in 0..bits.div_ceil(DIGIT) {
        let shift = pass * DIGIT;
        let (count32, blocks32) = (count as u32, blocks as u32);
        count_digits::launch(&client, spread(blocks), dim, keys.clone().into_buffer_arg(), counts.clone().into_buffer_arg(), count32, blocks32, shift);
        let (sums, _) = sums_in_two(&counts, blocks << DIGIT);
        let (keys_out, values_out) = (empty(&keys, [count], DType::U32), empty(&keys, [count], DType::U32));
        move_by_digit::launch(
            &client,
            spread(blocks),
            dim,
            keys.into_buffer_arg(),
            values.into_buffer_arg(),
            counts.clone().into_buffer_arg(),
            sums.into_buffer_arg(),
            keys_out.clone().into_buffer_arg(),
            values_out.clone().into_buffer_arg(),
            count32,
            blocks32,
            shift,
        );
        (keys, values) = (keys_out, values_out);
    }
    (keys, values)
}

/// The indices of keys, and the bits of the keys that are sorted by.
#[cube(launch)]
fn number(keys: &[i32], masked: &mut [u32], indices: &mut [u32], mask: u32) {
    if ABSOLUTE_POS < masked.len() {
        masked[ABSOLUTE_POS] = u32::reinterpret(keys[ABSOLUTE_POS]) & mask;
        indices[ABSOLUTE_POS] = ABSOLUTE_POS as u32;
    }
}

impl SortOps for CubeBackend {
    fn order(keys: IntTensor<Self>, bits: u32) -> IntTensor<Self> {
        let keys = into_contiguous(keys);
        let count = keys.meta.shape().num_elements();
        let (masked, indices) = (empty(&keys, [count], DType::U32), empty(&keys, [count], DType::U32));
        if count > 0 {
            let client = keys.client.clone();
            let (k, m, i) = (keys.into_buffer_arg(), masked.clone().into_buffer_arg(), indices.clone().into_buffer_arg());
            number::launch(&client, workgroups_for(count), CubeDim::new_1d(THREADS), k, m, i, u32::MAX >> (32 - bits));
        }
        // Indices are below 2^31.
        signed(sort_pairs(masked, indices, count, bits).1)
    }
}
