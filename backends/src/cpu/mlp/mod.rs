//! Small dense networks over many rows: blocks of rows stay in cache from the first layer to the last.

pub mod activation;
pub mod matmul;
pub mod mish;
pub mod relu;

/// Sums `parts` of equal length into the first, in order.
pub(crate) fn sum_in_order(parts: Vec<Vec<f32>>) -> Vec<f32> {
    let mut parts = parts.into_iter();
    let mut total = parts.next().unwrap_or_default();
    for part in parts {
        for (t, p) in total.iter_mut().zip(&part) {
            *t += p;
        }
    }
    total
}

/// Cuts `blocks` blocks into runs for gradient sums: how many blocks each run holds. The number of runs depends on the work alone,
/// never on the threads, so that sums come out the same on any of them.
pub(crate) fn blocks_per_run(blocks: usize) -> usize {
    const RUNS: usize = 16;
    blocks.div_ceil(RUNS).max(1)
}
