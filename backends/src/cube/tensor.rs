//! Device buffers: outputs, uploads, and how launches are spread.

use burn::tensor::{DType, Shape};
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Units of a cube in kernels that treat one item per unit.
pub const UNITS: u32 = 256;

/// The cubes for `items` items at [`UNITS`] per cube, spread over two dimensions where one would be over the limit of 65,535.
pub fn cubes_for(items: usize) -> CubeCount {
    spread(items.div_ceil(UNITS as usize))
}

/// `cubes` cubes (at least one), spread over two dimensions where one would be over the limit of 65,535. There may be more than asked for: kernels
/// check their place.
pub fn spread(cubes: usize) -> CubeCount {
    const LIMIT: usize = 65_535;
    let cubes = cubes.max(1);
    let rows = cubes.div_ceil(LIMIT);
    CubeCount::Static(cubes.div_ceil(rows) as u32, rows as u32, 1)
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

/// A flat tensor that holds `values`.
pub fn upload<T: CubeElement>(like: &CubeTensor, values: &[T], dtype: DType) -> CubeTensor {
    let buffer = like.client.create_from_slice(T::as_bytes(values));
    CubeTensor::new_contiguous(like.client.clone(), like.device.clone(), Shape::from([values.len()]), buffer, dtype)
}

/// `tensor` with its elements side by side in a buffer nobody else holds, so that a kernel may write to it.
pub fn owned(tensor: CubeTensor) -> CubeTensor {
    let tensor = into_contiguous(tensor);
    if tensor.handle.can_mut() {
        return tensor;
    }
    let copy = empty(&tensor, tensor.meta.shape().clone(), tensor.dtype);
    let n = tensor.meta.shape().num_elements();
    let client = tensor.client.clone();
    copy_words::launch(&client, cubes_for(n), CubeDim::new_1d(UNITS), tensor.into_buffer_arg(), copy.clone().into_buffer_arg());
    copy
}

#[cube(launch)]
fn copy_words(from: &[f32], to: &mut [f32]) {
    if ABSOLUTE_POS < to.len() {
        to[ABSOLUTE_POS] = from[ABSOLUTE_POS];
    }
}

/// Whether `value` is a number and not infinite, by its bits: shader compilers may assume that arithmetic never meets anything else.
#[cube]
pub fn is_finite(value: f32) -> bool {
    (u32::reinterpret(value) & 0x7f80_0000u32) != 0x7f80_0000u32
}
