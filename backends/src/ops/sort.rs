//! Stable sorting of unsigned keys, as tile lists and shared vertices need it.

use super::limits::check_sorted;
use crate::cpu::sort::stable_order;
use crate::cpu::tensor::CpuBackend;
use burn::backend::tensor::IntTensor;
use burn::backend::{Backend, Dispatch, backend_extension};
use burn::tensor::{Int, Tensor};
use cc4dgs_core::{Error, Result};

/// The operation per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"))]
pub trait SortOps: Backend {
    /// Indices of `keys` `[N]` in ascending order of their lowest `bits` bits.
    fn order(keys: IntTensor<Self>, bits: u32) -> IntTensor<Self>;
}

impl<B: CpuBackend> SortOps for B {
    fn order(keys: IntTensor<Self>, bits: u32) -> IntTensor<Self> {
        let bound = 1u64 << bits;
        let keys: Vec<u32> = B::ints(&keys).iter().map(|&k| (k as u32 as u64 % bound) as u32).collect();
        let order: Vec<i64> = stable_order(&keys, bound).into_iter().map(i64::from).collect();
        let n = order.len();
        B::from_ints(order, [n])
    }
}

/// The indices of `keys` `[N]` in ascending order of their lowest `bits` bits (1 to 32), equal ones in their own order. Keys are taken as unsigned 32-bit
/// numbers.
pub fn sort_order(keys: Tensor<1, Int>, bits: u32) -> Result<Tensor<1, Int>> {
    if !(1..=32).contains(&bits) {
        return Err(Error::parameter("sort", format!("{bits} bits"), "Choose 1 to 32"));
    }
    check_sorted(&keys.device(), "sort", "keys", keys.dims()[0], 1)?;
    Ok(Tensor::from_dispatch(<Dispatch as SortOps>::order(keys.into_dispatch(), bits)))
}
