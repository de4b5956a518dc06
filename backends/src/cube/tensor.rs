//! Device buffers: outputs, uploads, and how launches are spread.

use burn::tensor::{DType, Shape};
use burn_cubecl::CubeDevice;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::ops::numeric::zeros_client;
use burn_cubecl::tensor::CubeTensor;
use cubecl::client::Client;
use cubecl::prelude::*;
use std::collections::HashMap;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{LazyLock, Mutex, PoisonError};
use std::thread::ThreadId;

/// Threads of a workgroup in kernels with one item per thread.
pub const THREADS: u32 = 256;

/// The workgroups for `items` items at [`THREADS`] per workgroup, over two dimensions where one would exceed the limit of 65,535.
pub fn workgroups_for(items: usize) -> CubeCount {
    spread(items.div_ceil(THREADS as usize))
}

/// `count` workgroups (at least one), over two dimensions where one would exceed the limit of 65,535. There may be more than that: kernels check their
/// index.
pub fn spread(count: usize) -> CubeCount {
    const LIMIT: usize = 65_535;
    let count = count.max(1);
    let rows = count.div_ceil(LIMIT);
    CubeCount::Static(count.div_ceil(rows) as u32, rows as u32, 1)
}

/// A contiguous tensor of `shape` beside `like`, its contents undefined. It holds at least one element, because there are no empty buffers.
pub fn empty(like: &CubeTensor, shape: impl Into<Shape>, dtype: DType) -> CubeTensor {
    let shape = shape.into();
    let buffer = like.client.empty(shape.num_elements().max(1) * dtype.size());
    CubeTensor::new_contiguous(like.client.clone(), like.device.clone(), shape, buffer, dtype)
}

/// The same for float32.
pub fn floats(like: &CubeTensor, shape: impl Into<Shape>) -> CubeTensor {
    empty(like, shape, DType::F32)
}

/// A flat tensor of `count` zeros, at least one, made on the device.
pub fn zeros(like: &CubeTensor, count: usize) -> CubeTensor {
    zeros_client(like.client.clone(), like.device.clone(), Shape::from([count.max(1)]), DType::F32)
}

/// A flat tensor that holds `values`.
pub fn upload<T: CubeElement>(like: &CubeTensor, values: &[T], dtype: DType) -> CubeTensor {
    let buffer = like.client.create_from_slice(T::as_bytes(values));
    CubeTensor::new_contiguous(like.client.clone(), like.device.clone(), Shape::from([values.len()]), buffer, dtype)
}

/// Upper bound on the bytes of a cached constant, and of all of them together.
const LARGEST_KEPT: usize = 64 << 10;
const MOST_KEPT: usize = 8 << 20;
/// Bytes counted per cached constant besides its values: at most 8,192 constants are cached, however small they are.
const OVERHEAD: usize = 1 << 10;

/// Constants by thread (a thread has its own stream of launches), device and type, and how many bytes they have.
#[derive(Default)]
struct Kept {
    arrays: HashMap<(ThreadId, CubeDevice, DType), HashMap<Vec<u8>, CubeTensor>>,
    bytes: usize,
}

static KEPT: LazyLock<Mutex<Kept>> = LazyLock::new(Mutex::default);

/// As [`upload`], for what no kernel writes to. The same values are uploaded once: CubeCL submits all launches before an upload, which costs many times a
/// launch.
pub fn constant<T: CubeElement>(like: &CubeTensor, values: &[T], dtype: DType) -> CubeTensor {
    let bytes = T::as_bytes(values);
    if bytes.len() > LARGEST_KEPT {
        return upload(like, values, dtype);
    }
    let key = (std::thread::current().id(), like.device.clone(), dtype);
    let mut kept = KEPT.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(tensor) = kept.arrays.get(&key).and_then(|arrays| arrays.get(bytes)) {
        return tensor.clone();
    }
    let tensor = upload(like, values, dtype);
    let bytes_needed = bytes.len() + OVERHEAD;
    if kept.bytes + bytes_needed > MOST_KEPT {
        *kept = Kept::default();
    }
    kept.bytes += bytes_needed;
    kept.arrays.entry(key).or_default().insert(bytes.to_vec(), tensor.clone());
    tensor
}

static BINDING_CAP: AtomicU64 = AtomicU64::new(u64::MAX);
static SHARED_CAP: AtomicU64 = AtomicU64::new(u64::MAX);

/// Reinterprets unsigned numbers as signed ones, which burn's integers are.
pub fn signed(values: CubeTensor) -> CubeTensor {
    CubeTensor::new_contiguous(values.client.clone(), values.device.clone(), values.meta.shape().clone(), values.handle.clone(), DType::I32)
}

/// Lowers the limit on the bytes of a buffer that a kernel may read, to emulate a smaller adapter in tests.
pub fn cap_bindings(bytes: u64) {
    BINDING_CAP.store(bytes, Ordering::Relaxed);
}

/// Lowers the limit on the bytes of shared memory per workgroup, to emulate a smaller adapter in tests; every adapter has 16 KiB.
pub fn cap_shared_memory(bytes: u64) {
    SHARED_CAP.store(bytes, Ordering::Relaxed);
}

/// Bytes of shared memory per workgroup.
pub fn shared_bytes(client: &Client) -> usize {
    (client.properties().hardware.max_shared_memory_size as u64).min(SHARED_CAP.load(Ordering::Relaxed)) as usize
}

/// Upper bound on the bytes of an array: CubeCL allocates none that is larger than one binding of the adapter.
pub fn buffer_bytes(client: &Client) -> u64 {
    client.properties().memory.max_page_size
}

/// Upper bound on the bytes of one buffer that a kernel may read.
pub fn binding_bytes(client: &Client) -> u64 {
    indexed(buffer_bytes(client)).min(BINDING_CAP.load(Ordering::Relaxed))
}

/// Upper bound on the words of an array. An index has 32 bits, and [`spread`] launches fewer than 2^17 threads more than there are items: their indices must
/// not wrap, or they would be those of the first items.
const MOST_WORDS: u64 = (1 << 32) - (1 << 17);

/// `bytes`, or less where that is more than [`MOST_WORDS`] words of four bytes. CUDA and Vulkan allocate arrays of tens of gigabytes.
fn indexed(bytes: u64) -> u64 {
    bytes.min(4 * MOST_WORDS)
}

/// 0..`rows` in parts of rows of `width` floats that fit one binding. Parts start at multiples of 256 bytes, as bindings must.
pub fn row_blocks(client: &Client, rows: usize, width: usize) -> Vec<Range<usize>> {
    const ALIGNED: usize = 64;
    let fit = (binding_bytes(client) / (4 * width.max(1) as u64)) as usize / ALIGNED * ALIGNED;
    let step = fit.max(ALIGNED);
    (0..rows).step_by(step).map(|first| first..(first + step).min(rows)).collect()
}

/// Some rows of a contiguous tensor of `width` floats per row, in the same buffer.
pub fn rows_of(tensor: &CubeTensor, rows: &Range<usize>, width: usize) -> CubeTensor {
    let bytes = |rows: usize| 4 * (rows * width) as u64;
    let all = tensor.handle.size_in_used();
    if width == 0 || bytes(rows.len()) == all {
        return tensor.clone();
    }
    let handle = tensor.handle.clone().offset_start(bytes(rows.start)).offset_end(all.saturating_sub(bytes(rows.end)));
    CubeTensor::new_contiguous(tensor.client.clone(), tensor.device.clone(), Shape::from([rows.len() * width]), handle, tensor.dtype)
}

/// `tensor`, contiguous, in a buffer without other owners, so that a kernel may write to it.
pub fn owned(tensor: CubeTensor) -> CubeTensor {
    let tensor = into_contiguous(tensor);
    if tensor.handle.can_mut() {
        return tensor;
    }
    let copy = empty(&tensor, tensor.meta.shape().clone(), tensor.dtype);
    let n = tensor.meta.shape().num_elements();
    let client = tensor.client.clone();
    copy_words::launch(&client, workgroups_for(n), CubeDim::new_1d(THREADS), tensor.into_buffer_arg(), copy.clone().into_buffer_arg());
    copy
}

#[cube(launch)]
fn copy_words(from: &[f32], to: &mut [f32]) {
    if ABSOLUTE_POS < to.len() {
        to[ABSOLUTE_POS] = from[ABSOLUTE_POS];
    }
}

/// A running sum with compensation for rounding (Kahan): `sum` and what it has `lost`, after `value` was added.
#[cube]
pub fn compensated_sum(sum: f32, lost: f32, value: f32) -> (f32, f32) {
    let missing = value - lost;
    let next = sum + missing;
    (next, (next - sum) - missing)
}

/// Adds up one value per thread of a workgroup of [`THREADS`], in the order of the threads, with compensation for rounding (Kahan). The first thread gets the
/// sum, the others 0. All threads of the workgroup must call it.
#[cube]
pub fn sum_of_threads(values: &mut Shared<[f32]>, own: f32) -> f32 {
    // Wait until the values of an earlier call have been read.
    sync_cube();
    values[UNIT_POS as usize] = own;
    sync_cube();
    let mut sum = 0.0f32;
    if UNIT_POS == 0 {
        let mut lost = 0.0f32;
        for k in 0..THREADS as usize {
            let (next, rest) = compensated_sum(sum, lost, values[k]);
            sum = next;
            lost = rest;
        }
    }
    sum
}

/// Whether `value` is finite, by its bits: shader compilers may assume that arithmetic never meets infinities and NaN.
#[cube]
pub fn is_finite(value: f32) -> bool {
    (u32::reinterpret(value) & 0x7f80_0000u32) != 0x7f80_0000u32
}

/// Whether `value` is finite or infinite and not NaN, by its bits as in [`is_finite`].
#[cube]
pub fn is_number(value: f32) -> bool {
    (u32::reinterpret(value) & 0x7fff_ffffu32) <= 0x7f80_0000u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_of_a_binding_can_be_counted_in_32_bits() {
        assert_eq!(indexed(128 << 20), 128 << 20);
        // A quarter of the memory of an H200, which CUDA allocates at once.
        let words = (indexed(35 << 30) / 4) as usize;
        // From one item per thread to one per sixteen threads.
        for per_workgroup in [THREADS as usize, 64, 16] {
            let CubeCount::Static(x, y, z) = spread(words.div_ceil(per_workgroup)) else { panic!("the number of workgroups is known") };
            assert!(x <= 65_535 && y <= 65_535, "{x} x {y} workgroups");
            let items = u64::from(x) * u64::from(y) * u64::from(z) * per_workgroup as u64;
            assert!(items >= words as u64 && items <= 1 << 32, "{items} indices for {words} words");
        }
    }
}
